"""Collisions made by hand: two vehicles, each with a plan, until their boxes touch."""

from __future__ import annotations

import numpy as np

from pytest_pafot import criticality
from pytest_pafot.grid import Cell
from pytest_pafot.trace import ACCELERATION, Outcome
from tests.support.traces import LANE_WIDTH, collision_at, trace_of, vehicle

HZ = 15


def driven(x, y=LANE_WIDTH, *, speed=20.0, seconds=20.0, brakes=(), shifts=()):
    """A vehicle that starts at (x, y) and keeps its speed and its line.

    ``brakes`` holds (from [s], deceleration [m/s^2], until the speed [m/s]), ``shifts`` (from [s], to y [m], for [s]).
    """
    ticks = round(seconds * HZ)
    speeds, lines = np.full(ticks + 1, float(speed)), np.full(ticks + 1, float(y))
    for start, deceleration, least in brakes:
        begin = round(start * HZ)
        fall = speeds[begin] - deceleration / HZ * np.arange(ticks + 1 - begin)
        speeds[begin:] = np.clip(fall, *sorted((least, speeds[begin])))
    for start, target, duration in shifts:
        begin = round(start * HZ)
        share = np.clip(np.arange(ticks + 1 - begin) / (duration * HZ), 0, 1)
        lines[begin:] = lines[begin] + (target - lines[begin]) * share
    along = x + np.concatenate(([0.0], np.cumsum(speeds[:-1]))) / HZ
    heading = np.arctan2(np.gradient(lines) * HZ, np.maximum(speeds, 1.0))
    states = vehicle(along, lines, heading=heading, speed=speeds)
    states[1:, ACCELERATION] = np.diff(speeds) * HZ
    return states


def crash(ego, *npcs, npc=0, side="front", cell=Cell.FRONT):
    """The run up to the first contact with an NPC."""
    whole = trace_of(ego, *npcs)
    touching = np.flatnonzero(criticality.gap(whole)[:, npc] == 0)
    assert touching.size, "they never touch"
    tick = int(touching[0])
    return trace_of(
        *(states[: tick + 1] for states in (ego, *npcs)),
        outcome=Outcome.COLLISION,
        collision=collision_at(
            tick, npc=npc, side=side, cell=cell, ego_speed=ego[tick, 3], npc_speed=npcs[npc][tick, 3]
        ),
    )
