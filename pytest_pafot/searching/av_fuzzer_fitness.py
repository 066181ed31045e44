"""AV-Fuzzer's own fitness: how little room the braking distance leaves, as its authors released it.

Source: Li et al., "AV-FUZZER: Finding Safety Violations in Autonomous Driving Systems", ISSRE 2020, and the released
code, which is what the numbers are of.
"""

from __future__ import annotations

import math

import numpy as np

from pytest_pafot.criticality import Encounters, RoadFrame
from pytest_pafot.trace import HEADING, SPEED, FloatArray, Trace

FAR = 130.0
"""Stands for every distance that no sample gives, and for all beyond it [m]."""

SAMPLES_PER_SECOND = 4
CAR_LENGTH = 4.6
"""Taken off the distance of centres; also the least distance along the road in both cases [m]."""

NEAR = 20.0
"""The largest distance along the road in both cases [m]."""

BESIDE = 2.0
"""... and across it [m]."""

TURNING = math.radians(1.0)
"""Heading to the road from which on the ego counts as changing lanes [rad]."""


def braking_distance(speed: FloatArray) -> FloatArray:
    """Way to a standstill, a polynomial fitted by the authors to their vehicle [m]; any shape, speed in m/s."""
    return np.maximum(0.0467 * speed**2 + 0.4116 * speed - 1.9913 + 0.5, 0.0)


def av_fuzzer_fitness(trace: Trace) -> float:
    """(130 - min d / 2 - min delta / 2) / (NPCs - 1), higher = worse for the ego.

    d is the distance of the centres [m], delta what d - 4.6 m leaves of the braking distance: the ego's where the NPC
    is 4.6 to 20 m ahead, the NPC's where it is as far behind while the ego's heading is more than one degree off the
    road, both at less than 2 m across; else 130 m. The minima are over all NPCs and four samples a second. The released
    code goes on sampling after an impact, so the tick of the collision counts as well. It divides by the number of NPCs
    less one; with a single NPC, for which it fails, nothing is divided.
    """
    ticks = _sampled(trace)
    frame = RoadFrame(trace)
    ahead, right = frame.ahead[:, ticks], frame.right[:, ticks]
    cos, sin = Encounters(trace).road
    heading = trace.ego[:, HEADING]
    turns = np.abs(np.sin(heading) * cos[0] - np.cos(heading) * sin[0])[ticks] > math.sin(TURNING)
    distance = np.hypot(ahead, right)
    beside = np.abs(right) < BESIDE
    in_front = beside & (ahead > CAR_LENGTH) & (ahead < NEAR)
    cut_off = beside & (ahead < -CAR_LENGTH) & (ahead > -NEAR) & turns
    room = distance - CAR_LENGTH
    front = np.where(in_front, room - braking_distance(trace.ego[ticks, SPEED]), FAR)
    rear = np.where(cut_off, room - braking_distance(trace.npcs[ticks, :, SPEED].T), FAR)
    least_distance = min(float(distance.min()), FAR)
    least_room = float(np.minimum(front, rear).min())
    return (FAR - 0.5 * least_distance - 0.5 * least_room) / max(len(trace.scenario.npcs) - 1, 1)


def _sampled(trace: Trace) -> list[int]:
    """Ticks nearest to every quarter of a second, and that of a collision."""
    count = int(trace.duration * SAMPLES_PER_SECOND + 1e-9) + 1
    ticks = [round(sample * trace.physics_hz / SAMPLES_PER_SECOND) for sample in range(count)]
    hit = [] if trace.collision is None else [trace.collision.tick]
    return sorted({min(tick, trace.ticks) for tick in (*ticks, *hit)})
