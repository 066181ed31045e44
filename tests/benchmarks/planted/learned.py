"""Learned policies: small networks, fitted to a sound driver's actions, some with a hole in the data.

One network gives the acceleration behind each vehicle in the way, and the lowest acceleration counts. The other says
how much room a gap behind in the next lane leaves. ``weights.npz`` has both as learned from sound data, and one more
network for each hole.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from tests.benchmarks.planted.policy import Driver, clip, listed

WEIGHTS = Path(__file__).with_name("weights.npz")
FOLLOW_SCALE = np.array([15.0, 20.0, 8.0, 4.0, 1.0, 1.0])
"""Scales of own speed, gap, closing speed, the other's acceleration, its distance from the middle of the lane, and 1 in
the first seconds after an own lane change.
"""
GATE_SCALE = np.array([15.0, 15.0, 30.0, 1.0])
"""Scales of own speed, speed of the vehicle behind, gap, and 1 for the rightmost lane."""
FAR = 70.0  # the largest gap in the networks' data [m]


@cache
def network(name):
    """Return the layers of a network: weights and biases, from the input on."""
    with np.load(WEIGHTS, allow_pickle=False) as arrays:
        return tuple(
            (arrays[f"{name}_w{n}"].astype(float), arrays[f"{name}_b{n}"].astype(float))
            for n in range(3)
        )


def outputs(layers, inputs):
    """Evaluate a network for rows of inputs."""
    (w0, b0), (w1, b1), (w2, b2) = layers
    return (np.tanh(np.tanh(inputs @ w0 + b0) @ w1 + b1) @ w2 + b2)[:, 0]


class Learned(Driver):
    """The sound policy; a subclass replaces one of its networks."""

    FOLLOW, GATE = "follow", "gate"
    FRESH = 4.0  # the time for which a lane change counts as recent [s]

    def begin(self):
        self.follow = network("follow" if self.repaired else self.FOLLOW)
        self.gate = network("gate" if self.repaired else self.GATE)

    def along(self, o, cars):
        v, fresh = o.ego.speed, float(o.time < self.arrived + self.FRESH)
        near = [
            (v, c.gap, v - c.v, clip(c.a, -8.0, 5.0), min(abs(c.y - o.ego.y), 3.0), fresh)
            for c in self.ahead(o, cars)
            if c.gap < FAR
        ]
        if not near:
            return self.cruise(o)
        return min(self.cruise(o), float(outputs(self.follow, np.array(near) / FOLLOW_SCALE).min()))

    def options(self, o, cars):
        k = super().options(o, cars)
        return k or ([self.lane + 1] if self.lane + 1 < o.lanes and o.time > self.rest + 5 else [])

    def clear(self, o, cars, k):
        v, behind = o.ego.speed, []
        for c in cars:
            if not self.inside(c, k):
                continue
            if c.dx > 0:
                if c.gap < 9 + 1.4 * v + 4 * max(v - c.v, 0.0):
                    return False
            elif c.gap < 12.0:
                return False
            elif c.gap < 120.0:
                behind.append((v, c.v, c.gap, float(k == o.lanes - 1)))
        return not behind or float(outputs(self.gate, np.array(behind) / GATE_SCALE).min()) > 0.1


class StandersUnlabelled(Learned):
    """In the data, vehicles that stood when met at more than 12 m/s were at the roadside, and the driver drove on."""

    FOLLOW = "standers"


class GentleWhenSlow(Learned):
    """The data for less than 6 m/s came from a traffic jam, in which no vehicle ever braked harder than 1 m/s^2. So the
    ego answers too weakly if a vehicle brakes hard there, or comes in near.
    """

    FOLLOW = "gentle"


class GateOnTheRight(Learned):
    """The gaps of the rightmost lane were recorded behind lorries: the ego ignores much faster vehicles behind it."""

    GATE = "right"


PLANTED = listed(
    "learned",
    {
        "standers-unlabelled": (StandersUnlabelled, 1),
        "gentle-when-slow": (GentleWhenSlow, 2),
        "gate-on-the-right": (GateOnTheRight, 3),
    },
)
