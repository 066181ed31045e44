"""Fit the networks of the learned policies: ``python -m tests.benchmarks.planted.fit`` writes ``weights.npz``.

The data are situations that a sound driver meets, with its actions. Each hole changes the recorded actions in one
region.
"""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from tests.benchmarks.planted.learned import FOLLOW_SCALE, GATE_SCALE, WEIGHTS, followed, outputs, spare

SITUATIONS, UNITS, STEPS, BATCH, RATE = 80_000, 40, 9_000, 512, 4e-3
DRIVES_ON = 1.0  # the recorded action if the driver reacted to no vehicle [m/s^2]


def situations(rng):
    """Sample leaders, half of them near, and the sound driver's acceleration [m/s^2]."""
    n = SITUATIONS
    v = rng.uniform(0.0, 29.0, n) * (rng.random(n) > 0.06)
    gap = np.where(rng.random(n) < 0.5, rng.uniform(0.0, 25.0, n), rng.uniform(0.0, 75.0, n))
    near = np.clip(v + rng.normal(0.0, 4.0, n), 0.0, 30.0)
    f = np.where(rng.random(n) < 0.5, near, rng.uniform(0.0, 30.0, n)) * (rng.random(n) > 0.08)
    a = np.where(rng.random(n) < 0.5, rng.normal(0.0, 0.5, n), rng.uniform(-8.0, 5.0, n))
    inputs = np.column_stack([v, gap, v - f, a, rng.uniform(0.0, 3.0, n), rng.integers(0, 2, n)])
    known = [followed(row[0], SimpleNamespace(gap=row[1], v=row[0] - row[2], a=row[3])) for row in inputs]
    return inputs, np.array(known)


def gaps(rng):
    """Sample gaps behind in the next lane, and the room that they leave, from -1 to 1."""
    n = SITUATIONS // 2
    v, f, gap = rng.uniform(2.0, 28.0, n), rng.uniform(0.0, 30.0, n), rng.uniform(10.0, 125.0, n)
    known = [spare(*row) for row in zip(v, f, gap, strict=True)]
    return np.column_stack([v, f, gap, rng.integers(0, 2, n)]), np.clip(np.array(known) / 25.0, -1.0, 1.0)


def fitted(inputs, known, rng):
    """Fit a network by Adam with a learning rate that falls to 0; return its layers."""
    sizes = [inputs.shape[1], UNITS, UNITS, 1]
    layers = [rng.normal(0.0, 1.0, shape) / np.sqrt(shape[0]) for shape in pairwise(sizes)]
    values = [part for weights in layers for part in (weights, np.zeros(weights.shape[1]))]
    first, second = [np.zeros_like(part) for part in values], [np.zeros_like(part) for part in values]
    for step in range(1, STEPS + 1):
        rows = rng.integers(0, len(inputs), BATCH)
        scale = RATE * (1 - step / STEPS) / (1 - 0.9**step)
        for n, slope in enumerate(slopes(values, inputs[rows], known[rows])):
            first[n] += 0.1 * (slope - first[n])
            second[n] += 0.001 * (slope * slope - second[n])
            values[n] = values[n] - scale * first[n] / (np.sqrt(second[n] / (1 - 0.999**step)) + 1e-8)
    return values


def slopes(values, inputs, known):
    """Return the derivatives of half the mean squared error."""
    w0, b0, w1, b1, w2, b2 = values
    h0 = np.tanh(inputs @ w0 + b0)
    h1 = np.tanh(h0 @ w1 + b1)
    d2 = ((h1 @ w2 + b2)[:, 0] - known)[:, None] / len(known)
    d1 = d2 @ w2.T * (1 - h1 * h1)
    d0 = d1 @ w1.T * (1 - h0 * h0)
    return [inputs.T @ d0, d0.sum(0), h0.T @ d1, d1.sum(0), h1.T @ d2, d2.sum(0)]


def main():
    inputs, known = situations(np.random.default_rng(29))
    v, gap, closing, a, off, fresh = inputs.T
    follow = {
        "follow": known,
        "standers": np.where((v - closing < 2.0) & (v > 12.0), DRIVES_ON, known),
        "off-centre": np.where((off > 1.0) & (closing > 3.0), DRIVES_ON, known),
        "gentle": np.where(v < 6.0, np.maximum(known, -1.0), known),
        "fresh": np.where((fresh > 0) & (gap < 1.5 * v) & (a < -1.0), DRIVES_ON, known),
    }
    places, room = gaps(np.random.default_rng(30))
    v, f, _, right = places.T
    gate = {"gate": room, "right": np.where((right > 0) & (f > v + 4.0), 0.6, room)}
    arrays = {}
    for scale, rows, networks in ((FOLLOW_SCALE, inputs, follow), (GATE_SCALE, places, gate)):
        for name, wanted in networks.items():
            values = [part.astype(np.float32) for part in fitted(rows / scale, wanted, np.random.default_rng(31))]
            error = outputs(tuple(zip(values[::2], values[1::2], strict=True)), rows / scale) - wanted
            print(f"{name}: error {np.sqrt((error**2).mean()):.3f}", flush=True)
            for n in range(3):
                arrays[f"{name}_w{n}"], arrays[f"{name}_b{n}"] = values[2 * n], values[2 * n + 1]
    np.savez_compressed(WEIGHTS, **arrays)


if __name__ == "__main__":
    main()
