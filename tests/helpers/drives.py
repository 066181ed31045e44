"""Collisions made by hand: two vehicles, each with a plan, until their boxes touch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pytest_pafot import criticality
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import (
    ACCELERATION,
    ACROSS,
    ALONG,
    ANGLE,
    HEADING,
    LANE,
    OFFSET,
    STRETCH,
    Lane,
    Outcome,
    X,
    Y,
)
from tests.helpers.traces import LANE_WIDTH, collision_at, straight_lanes, trace_of, vehicle

HZ = 15


def driven(x, y=LANE_WIDTH, *, speed=20.0, seconds=20.0, brakes=(), shifts=()):
    """Return the states of a vehicle that starts at (x, y) and drives straight on, except for its plan.

    ``brakes``: (start [s], deceleration [m/s^2], final speed [m/s]), ``shifts``: (start [s], new y [m], duration [s]).
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


def crash(ego, *npcs, npc=0, side="front", cell=Cell.FRONT, **road):
    """Return the run up to the first contact with an NPC; ``road`` replaces the straight road with four lanes."""
    whole = trace_of(ego, *npcs, **road)
    touching = np.flatnonzero(criticality.gap(whole)[:, npc] == 0)
    assert touching.size, "they never touch"
    tick = int(touching[0])
    return trace_of(
        *(states[: tick + 1] for states in (ego, *npcs)),
        **{name: value[: tick + 1] if name == "track" else value for name, value in road.items()},
        outcome=Outcome.COLLISION,
        collision=collision_at(
            tick,
            npc=npc,
            side=side,
            cell=cell,
            ego_speed=ego[tick, 3],
            npc_speed=npcs[npc][tick, 3],
        ),
    )


def bent(*vehicles, radius=150.0, ego_lane=1, lane_count=3):
    """Return vehicles of a straight road moved to a road that bends to the right, with its lanes and track.

    They cover the same distance along the ego's way, so those on the outside are faster than their recorded speed.
    """
    middle = LANE_WIDTH * ego_lane
    track = np.zeros((len(vehicles[0]), len(vehicles), 5))
    moved = []
    for number, straight in enumerate(vehicles):
        states, across = straight.copy(), straight[:, Y] - middle
        stretch = (radius - across) / radius
        along = straight[0, X] + np.concatenate(
            ([0.0], np.cumsum(np.diff(straight[:, X]) / stretch[:-1]))
        )
        states[:, X] = (radius - across) * np.sin(along / radius)
        states[:, Y] = radius - (radius - across) * np.cos(along / radius)
        states[:, HEADING] = straight[:, HEADING] + along / radius
        track[:, number, [ALONG, ACROSS, ANGLE]] = np.stack(
            [along, across, straight[:, HEADING]], axis=-1
        )
        track[:, number, OFFSET] = across - (straight[:, LANE] * LANE_WIDTH - middle)
        track[:, number, STRETCH] = stretch
        moved.append(states)
    turns = np.linspace(-0.5, 4.0, 60)
    lanes = []
    for number in range(lane_count):
        inside = radius - (number * LANE_WIDTH - middle)
        points = tuple(zip(inside * np.sin(turns), radius - inside * np.cos(turns), strict=True))
        x, y = points[0]
        lanes.append(
            Lane(
                x=x,
                y=y,
                heading=-0.5,
                length=inside * 4.5,
                width=LANE_WIDTH,
                speed_limit=26.8,
                points=points,
            )
        )
    return moved, {"lanes": tuple(lanes), "track": track}


def merging(*vehicles, on_ramp):
    """Return vehicles of a straight road moved to one with a ramp into lane 1 from the right, with its lanes and track.

    The vehicle ``on_ramp`` follows the ramp: next to the road up to 40 m, and on the road from 140 m. The ego's way is
    the ramp if the ego follows it, otherwise lane 1.
    """
    moved = [states.copy() for states in vehicles]
    merger = moved[on_ramp]
    merger[:, Y] = _ramp(merger[:, X])
    merger[:, HEADING] = np.arctan(np.gradient(merger[:, Y], merger[:, X]))
    merger[:, LANE] = np.where(merger[:, X] < 140.0, 2, 1)
    states = np.stack(moved, axis=1)
    track = np.zeros((*states.shape[:2], 5))
    way = _ramp(states[..., X]) if on_ramp == 0 else np.full_like(states[..., X], LANE_WIDTH)
    slope = np.arctan((_ramp(states[..., X] + 0.1) - _ramp(states[..., X] - 0.1)) / 0.2) * (
        on_ramp == 0
    )
    track[..., ALONG], track[..., ACROSS] = states[..., X], states[..., Y] - way
    track[..., ANGLE], track[..., STRETCH] = states[..., HEADING] - slope, 1.0
    track[..., OFFSET] = np.where(
        states[..., LANE] == 2, 0.0, states[..., Y] - states[..., LANE] * LANE_WIDTH
    )
    ends = np.array([-500.0, 40.0, 140.0])
    ramp = replace(
        straight_lanes()[0], y=12.0, x=-500.0, points=tuple(zip(ends, _ramp(ends), strict=True))
    )
    return moved, {"lanes": (*straight_lanes(2), ramp), "track": track}


def _ramp(x):
    return np.interp(x, [40.0, 140.0], [12.0, 4.0])
