"""How a track becomes the steps of a manoeuvre: each is chosen from where the steps before it really lead."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pytest_pafot import Highway, Manoeuvre, Scenario, Step, Trace, VehicleType
from pytest_pafot.extending import ACCELERATION, SPEED, FloatArray, X, Y

MOST_STEPS, WIDTH = 16, 4.0
"""The most steps that a manoeuvre can have, and the width of the lanes in which it is driven [m]."""
FASTEST = 36.3
"""The highest speed of an NPC [m/s]: the highest limit that a highway can have."""
SHORTEST, LEAST_CHANGE = 1.0, 0.15
"""The shortest time for a change of speed [s], and the smallest change [m/s]."""
NEAR = 0.25
"""The distance to the track within which a change of speed is not worth a step [m]."""
FAR, GOOD = (0.5, 0.25, 1.0, 2.0), 1.5
"""The distances from the track that a step may have, tried until the whole stays within the second number [m]. The
nearest one is taken."""
SPANS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
"""The durations of a step that are tried [s]."""
RATES = (0.3, 0.5, 0.8, 1.2, 1.6, 2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0)
"""The accelerations that are tried [m/s^2]."""
JERK, MOST_ACCELERATION, MOST_BRAKING, TICKS = 10.0, 5.0, 8.0, 15
"""What an NPC can do [m/s^3, m/s^2, m/s^2], and its ticks per second."""
LEFT_LANE, SETTLED = 0.6, 0.12
"""The share of a lane after which a vehicle has left it, and within which it still, or again, keeps to its middle."""
ONSET = 0.16
"""The time in which an NPC turns before it drives aside at its lateral speed, as measured [s]."""
MOST_LANES = 6
"""The most lanes that a highway can have."""
PACE, AHEAD = 10, 100.0
"""The number of places per second at which a track is followed; how far from a standing ego the attempts are driven."""


def _changes(shares: FloatArray) -> Iterator[tuple[float, int, float]]:
    """Yield each change of lanes: its beginning [s], to which side, and the lateral speed in lanes of 4 m [m/s]."""
    lane, before = round(float(shares[0])), 0
    for row, share in enumerate(shares.tolist()):
        if abs(share - lane) <= LEFT_LANE:
            continue
        side = 1 if share > lane else -1
        away = side * (shares[before : row + 1] - lane)
        crossed = int(np.flatnonzero(away < 0.5)[-1:].sum())
        kept = np.flatnonzero(away[: crossed + 1] <= max(SETTLED, float(away.min())))
        half = (crossed - (int(kept[-1]) if len(kept) else 0)) / PACE
        lateral = round(min(max(2.0 / max(half - ONSET, 0.1), 0.4), 3.0), 1)
        yield max((before + crossed) / PACE - ONSET - 2.0 / lateral, 0.0), side, lateral
        lane, before = lane + side, before + crossed


def followed(states: FloatArray, shares: FloatArray, vehicle: VehicleType) -> tuple[Step, ...]:
    """Return the steps that follow a track, as near as they can within the steps of a manoeuvre.

    Args:
        states: the states of the track, ``PACE`` per second; shape [rows, 4].
        shares: its places across the road, in lanes.
        vehicle: what drives there.
    """
    tried: list[tuple[float, tuple[Step, ...]]] = []
    for far in FAR:
        tried.append(_stepped(states, shares, vehicle, far))
        if tried[-1][0] <= GOOD:
            break
    return min(tried, key=lambda each: each[0])[1]


def _stepped(
    states: FloatArray, shares: FloatArray, vehicle: VehicleType, far: float
) -> tuple[float, tuple[Step, ...]]:
    """Return steps that stay near the places of a track, and how far they lead from it [m].

    Each step is chosen from where the steps before it really lead: they are driven. It is the longest one that stays
    within ``far`` of the track [m], or else the shortest.
    """
    times, wanted = np.arange(len(states)) / PACE, states[:, X] - states[0, X]
    steps: list[Step] = []
    changes = [*_changes(shares)]
    while np.ptp(np.cumsum([0, *(side for _, side, _ in changes)])) >= MOST_LANES:
        changes.pop()
    left, skipped = [*changes], 0.0
    trace = _driven(states[0], steps, changes, times[-1], vehicle)
    while len(steps) < MOST_STEPS:
        arrived = trace.arrivals[0][0] if steps else 0
        if arrived is None:
            break
        ended = arrived / trace.physics_hz
        due = left[0][0] if left else times[-1]
        begin = _leaves(trace, max(ended, skipped), times, wanted, due)
        side, lateral = 0, 1.5
        if begin is None or begin > due - SHORTEST / 2:
            if not left:
                break
            begin, side, lateral = left.pop(0)
        after = max(math.ceil((begin - ended) * 10 - 1e-6) / 10, 0.0)
        tick = min(arrived + round(after * trace.physics_hz), trace.ticks)
        begin = tick / trace.physics_hz
        spans = [begin + 0.3 + 4.0 / lateral] if side else [begin + each for each in SPANS if begin + each < due]
        spans = [min(each, times[-1]) for each in spans] or [due]
        lane: Any = {0: "keep", 1: "right", -1: "left"}[side]
        step = Step(after=after, lane=lane, lateral_speed=lateral)
        ahead = (times > begin) & (times <= spans[-1])
        if ahead.any():
            own = trace.states[tick, 1] - trace.states[0, 1] * (np.arange(7) == X)
            speed, acceleration = _speed(own, begin, times[ahead], states[ahead], wanted[ahead], spans, far)
            if abs(speed - own[SPEED]) < LEAST_CHANGE and not side:
                skipped = begin + SHORTEST
                continue
            step = replace(step, speed=speed, acceleration=acceleration)
        steps.append(step)
        trace = _driven(states[0], steps, changes, times[-1], vehicle)
    along, across = (
        np.interp(times, trace.times, trace.states[:, 1, each] - trace.states[0, 1, each]) for each in (X, Y)
    )
    missed = np.hypot(along - wanted, across - WIDTH * (shares - round(float(shares[0]))))
    return float(missed.max()), tuple(steps)


def _leaves(trace: Trace, now: float, times: FloatArray, wanted: FloatArray, until: float) -> float | None:
    """Return when a vehicle that keeps its speed from a time on is no more near the track; None if it stays near."""
    tick = min(round(now * trace.physics_hz), trace.ticks)
    span = (times >= now) & (times <= until)
    places = trace.states[tick, 1, X] - trace.states[0, 1, X] + trace.states[tick, 1, SPEED] * (times[span] - now)
    away = np.flatnonzero(np.abs(places - wanted[span]) > NEAR)
    return float(times[span][max(away[0] - 5, 0)]) if len(away) else None


def first_speed(state: FloatArray) -> float:
    """Return the speed at which an NPC starts in the place of a vehicle [m/s]."""
    return round(min(max(float(state[SPEED]), 0.0), FASTEST), 1)


def _driven(
    first: FloatArray,
    steps: Iterable[Step],
    changes: Sequence[tuple[float, int, float]],
    seconds: float,
    vehicle: VehicleType,
) -> Trace:
    """Drive a vehicle with some steps far from a standing ego, on which steps by time do not depend."""
    reached = np.cumsum([0, *(side for _, side, _ in changes)])
    lanes = int(reached.max() - reached.min()) + 1
    manoeuvre = Manoeuvre(beside=0, ahead=AHEAD, speed=first_speed(first), steps=tuple(steps))
    scenario = Scenario(npcs=((manoeuvre,),), ego_lane=-int(reached.min()), ego_speed=0.0, vehicles=(vehicle,))
    world = Highway(lanes=max(lanes, 3), speed_limit=FASTEST, duration=max(seconds, 1.0))
    return world.rollout(scenario, lambda: lambda seen: (0.0, 0.0))


def _speed(
    own: FloatArray,
    begin: float,
    times: FloatArray,
    states: FloatArray,
    wanted: FloatArray,
    spans: Sequence[float],
    far: float,
) -> tuple[float, float]:
    """Return the speed of a step and the acceleration towards it: those that come nearest to places in time.

    Of several ends of the step [s], the last one counts up to which they are within ``far`` of the track, or nearest.
    """
    times = times - begin
    low, high = states[:, SPEED].min() - 2.0, states[:, SPEED].max() + 2.0
    speeds = np.unique(np.round(np.clip(np.linspace(low, high, 20), 0.0, FASTEST), 1))
    targets, rates = (each.ravel() for each in np.meshgrid(speeds, RATES))
    places, reached, done = _predicted(own, targets, rates, times)
    missed = places + own[X] - wanted[:, None]
    best, least = 0, math.inf
    for end in spans:
        count = max(int((times <= end - begin + 1e-6).sum()), 1)
        error = (missed[:count] ** 2).mean(axis=0) + missed[count - 1] ** 2
        error += (reached[count - 1] - states[count - 1, SPEED]) ** 2 + 1e3 * (done > times[count - 1] + 0.2)
        chosen = int(error.argmin())
        off = max(float(np.abs(missed[count // 2 : count, chosen]).max()), far)  # at first it may still come nearer
        if off <= least:
            best, least = chosen, off
    return float(targets[best]), float(rates[best])


def _predicted(
    own: FloatArray, targets: FloatArray, rates: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return how far NPCs drive and how fast, shape [times, targets], and when they are at their speed, as they do it.

    It is the law by which an NPC changes its speed, for many speeds at once.
    """
    place, speed, asked = (
        np.zeros(len(targets)),
        np.full(len(targets), own[SPEED]),
        np.full(len(targets), own[ACCELERATION]),
    )
    done, dt = np.full(len(targets), math.inf), 1 / TICKS
    places, reached = [], []
    for tick in range(math.ceil(times[-1] * TICKS) + 1):
        places.append(place)
        reached.append(speed)
        missing = targets - speed
        done = np.where((np.abs(missing) <= 0.2) & np.isinf(done), tick * dt, done)
        soft = np.minimum(np.sqrt(1.6 * JERK * np.abs(missing)), 5.0 * np.abs(missing))
        wanted = np.sign(missing) * np.where(targets > 0, np.minimum(rates, soft), rates)
        asked = np.clip(
            wanted, np.maximum(asked - JERK * dt, -MOST_BRAKING), np.minimum(asked + JERK * dt, MOST_ACCELERATION)
        )
        place, speed = place + speed * dt, np.maximum(speed + asked * dt, 0.0)
    at = np.arange(len(places)) / TICKS
    nearest = np.clip(np.searchsorted(at, times), 0, len(at) - 1)
    return np.array(places)[nearest], np.array(reached)[nearest], done
