"""Collisions made by hand at a junction with four arms and at a circle; each vehicle follows a plan.

The ego comes from the west. The arms' lanes are 4 m wide, right of the middle. For a vehicle that drives east, y grows
to the right, so a heading grows in a turn to the right. Ways begin 150 m before the junction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from pytest_pafot import criticality
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, Lane, Outcome, X, Y
from pytest_pafot.world.kernel.lanes import Box, side_hit
from tests.helpers.traces import LANE_WIDTH, LENGTH, WIDTH, collision_at, trace_of

HZ = 15
STEP = 0.1
BEFORE, BEHIND = 150.0, 80.0
HALF, SIDE = 6.0, LANE_WIDTH / 2
"""The distances from the middle to the start of the arms, and to the middle of a lane [m]."""
RADIUS, ENTRANCE, ROUND = 20.0, 10.0, 30.0
"""The radii of the circle and of the bend into it, and the distance driven around it [m]."""
ARMS = {"west": 0.0, "north": math.pi / 2, "east": math.pi, "south": -math.pi / 2}
"""The heading of a vehicle that comes from each arm [rad]."""
JOINED, ALIGNED = 0.5, 0.1
"""The distance [m] and angle [rad] within which two ways are one lane."""
WIDER = 1.0
"""The width and length added to boxes to find where two ways meet [m]."""


@dataclass(frozen=True, eq=False)
class Path:
    """A line with a point every ``STEP`` metres: x, y and heading."""

    points: np.ndarray

    def at(self, place):
        """Return x, y and heading at places along the line."""
        places = np.arange(len(self.points)) * STEP
        return np.stack([np.interp(place, places, column) for column in self.points.T], axis=-1)

    def turned(self, angle):
        """Return the line turned about the middle of the junction."""
        x, y, heading = self.points.T
        cos, sin = math.cos(angle), math.sin(angle)
        return Path(np.stack([x * cos - y * sin, x * sin + y * cos, heading + angle], axis=-1))


def drawn(x, y, heading, *parts):
    """Return the line that starts at a place, in parts of a length [m] and a curvature to the right [1/m]."""
    curvature = np.concatenate([np.full(round(length / STEP), bend) for length, bend in parts])
    headings = heading + np.concatenate([[0.0], np.cumsum(curvature) * STEP])
    middle = (headings[1:] + headings[:-1]) / 2
    steps = np.stack([np.cos(middle), np.sin(middle)], axis=-1) * STEP
    places = np.concatenate([[[x, y]], np.array([x, y]) + np.cumsum(steps, axis=0)])
    return Path(np.column_stack([places, headings]))


@lru_cache
def path(name):
    """Return a way by its name: ``west straight`` comes from the west; ``join`` and ``circle`` are at the circle."""
    if name == "circle":  # around it, past the place where the ego joins
        joint = path("join").points[round((BEFORE + ENTRANCE) / STEP)]
        back = math.pi * RADIUS
        first = joint[2] + back / RADIUS
        middle = joint[:2] + RADIUS * np.array([math.sin(joint[2]), -math.cos(joint[2])])
        x, y = middle + RADIUS * np.array([-math.sin(first), math.cos(first)])
        return drawn(x, y, first, (back + ROUND, -1 / RADIUS), (BEHIND, 0.0))
    if name == "join":  # from the west on to the circle
        entrance = (BEFORE, 0.0), (ENTRANCE, 1 / 15.0)
        return drawn(-HALF - BEFORE, SIDE, 0.0, *entrance, (ROUND, -1 / RADIUS), (BEHIND, 0.0))
    arm, turn = name.split()
    bend = {"straight": 0.0, "left": -1 / (HALF + SIDE), "right": 1 / (HALF - SIDE)}[turn]
    length = 2 * HALF if not bend else math.pi / 2 / abs(bend)
    return drawn(-HALF - BEFORE, SIDE, 0.0, (BEFORE, 0.0), (length, bend), (BEHIND, 0.0)).turned(
        ARMS[arm]
    )


def touching(first, second, margin=0.0):
    """Return which boxes of two arrays of poses touch, shape [first, second]; a margin makes the boxes larger."""
    x, y = (second[None, :, axis] - first[:, None, axis] for axis in (0, 1))
    half = (LENGTH + margin) / 2, (WIDTH + margin) / 2
    turn = second[None, :, 2] - first[:, None, 2]
    reach = [half[0] + abs(np.cos(turn)) * half[0] + abs(np.sin(turn)) * half[1]]
    reach += [half[1] + abs(np.sin(turn)) * half[0] + abs(np.cos(turn)) * half[1]]
    apart = np.zeros(x.shape, dtype=bool)
    for heading in (first[:, None, 2], second[None, :, 2]):
        cos, sin = np.cos(heading), np.sin(heading)
        apart |= (abs(x * cos + y * sin) > reach[0]) | (abs(y * cos - x * sin) > reach[1])
    return ~apart


@lru_cache
def zone(ego, npc, priority):
    """Return the zone in which the ways of the ego and of an NPC first meet."""
    lines = path(ego), path(npc)
    firsts = (0.0 if name == "circle" else 100.0 for name in (ego, npc))
    places = [
        np.arange(a, (len(line.points) - 1) * STEP, 0.5)
        for a, line in zip(firsts, lines, strict=True)
    ]
    poses = [line.at(each) for line, each in zip(lines, places, strict=True)]
    meets = touching(*poses, WIDER)
    first, second = (np.flatnonzero(meets.any(axis=axis)) for axis in (1, 0))
    stretches = [
        [each[part[0]], each[part[-1]]] for each, part in zip(places, (first, second), strict=True)
    ]
    joined = _joined(*poses)
    if joined is not None:
        for stretch, each, at in zip(stretches, places, joined, strict=True):
            stretch[1] = each[at] + LENGTH
    before = poses[0][first[0]][2] - poses[1][max(second[0] - 20, 0)][2]
    angle = math.remainder(before, 2 * math.pi)
    origin = (
        "ahead"
        if abs(angle) > 2.5
        else "behind"
        if abs(angle) < 0.6
        else "right"
        if angle > 0
        else "left"
    )
    kind = "merging" if joined is not None else "oncoming" if origin == "ahead" else "crossing"
    own, other = (tuple(map(float, stretch)) for stretch in stretches)
    return Zone(
        way=npc.replace(" ", ">"), kind=kind, origin=origin, ego=own, npc=other, priority=priority
    )


def _joined(first, second):
    """Return the indices at which two lines of poses first become one lane, or None."""
    x, y = (second[None, :, axis] - first[:, None, axis] for axis in (0, 1))
    angle = np.abs(
        np.remainder(second[None, :, 2] - first[:, None, 2] + math.pi, 2 * math.pi) - math.pi
    )
    far = np.hypot(x, y) + (angle >= ALIGNED) * 1e3
    near = far.argmin(axis=1)
    found = np.flatnonzero(far.min(axis=1) < JOINED)
    return None if not found.size else (found[0], near[found[0]])


class Plan(NamedTuple):
    way: str
    enters: float
    speed: float
    changes: tuple[tuple[float, float, float], ...]


def plan(way, enters, speed, *changes):
    """Return the plan of a vehicle on a way that would enter its zone at a time [s], at its first speed [m/s].

    Each change of speed has a start [s], an acceleration [m/s^2] and a final speed [m/s], which decides the sign.
    """
    return Plan(way, float(enters), float(speed), changes)


def _places(begins, plan_, ticks):
    """Return places along the way and speeds."""
    speeds = np.full(ticks + 1, plan_.speed)
    for start, acceleration, final in plan_.changes:
        since = round(start * HZ)
        steps = np.arange(ticks + 1 - since)
        toward = abs(acceleration) if final > speeds[since] else -abs(acceleration)
        speeds[since:] = np.clip(
            speeds[since] + toward / HZ * steps, *sorted((speeds[since], final))
        )
    places = (
        begins - plan_.enters * plan_.speed + np.concatenate(([0.0], np.cumsum(speeds[:-1]))) / HZ
    )
    return places, speeds


def meeting(ego, npc, **road):
    """Return the run of an ego and an NPC up to their first contact, or None if they never touch."""
    whole = driven(ego, npc, **road)
    hits = np.flatnonzero(criticality.gap(whole)[:, 0] == 0)
    return None if not hits.size else _ended(whole, int(hits[0]))


def driven(ego, npc, *, priority="npc", others=(), seconds=20.0):
    """Return the run of an ego and an NPC that drive through each other; ``others`` follow their own plans.

    An NPC whose way begins with ``grid`` drives on the ego's own way and has no zone.
    """
    ticks = round(seconds * HZ)
    zones = [
        None if each.way == "grid" else zone(ego.way, each.way, priority) for each in (npc, *others)
    ]
    own = zones[0] or next(each for each in zones if each)
    vehicles, along = [], []
    for number, each in enumerate((ego, npc, *others)):
        met = zones[number - 1] if number else own
        begins = own.ego[0] if met is None or not number else met.npc[0]
        places, speeds = _places(begins, each, ticks)
        line = path(ego.way if each.way == "grid" else each.way)
        states = np.zeros((ticks + 1, 7))
        states[:, [X, Y, HEADING]] = line.at(places)
        states[:, SPEED] = speeds
        states[1:, ACCELERATION] = np.diff(speeds) * HZ
        vehicles.append(states)
        along.append(places)
    rows = [
        _on_line(along[number])
        if each is ego or each.way == "grid"
        else _track(path(ego.way), vehicles[number])
        for number, each in enumerate((ego, npc, *others))
    ]
    track = np.stack(rows, axis=1)
    for number, states in enumerate(vehicles):
        states[:, LANE] = np.where(np.isnan(track[:, number, 0]), number, 0)
    on_way = np.stack(
        [
            np.full(ticks + 1, np.nan) if met is None else along[n + 1]
            for n, met in enumerate(zones)
        ],
        -1,
    )
    lanes = tuple(
        _lane(ego.way if each.way == "grid" else each.way) for each in (ego, npc, *others)
    )
    return trace_of(
        *vehicles, lanes=lanes, track=track, zones=tuple(zones), on_way=on_way, physics_hz=HZ
    )


def hit(ego, npc, **road):
    """Return :func:`meeting`, which must be a collision."""
    trace = meeting(ego, npc, **road)
    assert trace is not None, "they never touch"
    return trace


def _ended(whole, tick):
    """Return the run up to a tick, with a collision at the side of the ego that was hit."""
    states = whole.states[: tick + 1]
    is_on_way = not np.isnan(whole.track[tick, 1, 0])
    collision = collision_at(
        tick, ego_speed=states[tick, 0, SPEED], npc_speed=states[tick, 1, SPEED]
    )
    if tick:
        boxes = (Box(*row[[X, Y, HEADING]], LENGTH, WIDTH) for row in states[tick - 1, :2])
        collision = replace(collision, side=side_hit(*boxes))
    return replace(
        whole,
        states=states,
        track=whole.track[: tick + 1],
        on_way=whole.on_way[: tick + 1],
        outcome=Outcome.COLLISION,
        collision=replace(collision, cell=collision.cell if is_on_way else None),
    )


def _on_line(along):
    """Return track rows for a vehicle on the ego's way."""
    return np.column_stack([along, np.zeros((len(along), 3)), np.ones(len(along))])


def _track(line, states):
    """Return track rows for a vehicle, NaN while it is not on the ego's way."""
    places = np.arange(len(line.points)) * STEP
    rows = np.full((len(states), 5), np.nan)
    low, high = (ends(line.points[:, :2], axis=0) for ends in (np.min, np.max))
    xy = states[:, [X, Y]]
    # Most vehicles are elsewhere for most of the time. That is seen sooner than their nearest point.
    is_around = ((xy > low - LANE_WIDTH) & (xy < high + LANE_WIDTH)).all(axis=1)
    states = states[is_around]
    x, y = (states[:, None, axis] - line.points[None, ::5, axis] for axis in (X, Y))
    near = (x * x + y * y).argmin(axis=1) * 5
    at = line.points[near]
    cos, sin = np.cos(at[:, 2]), np.sin(at[:, 2])
    dx, dy = states[:, X] - at[:, 0], states[:, Y] - at[:, 1]
    across = dy * cos - dx * sin
    angle = np.remainder(states[:, HEADING] - at[:, 2] + math.pi, 2 * math.pi) - math.pi
    found = np.column_stack(
        [places[near] + dx * cos + dy * sin, across, angle, across, np.ones(len(states))]
    )
    is_off = (
        (abs(across) >= LANE_WIDTH / 2)
        | (abs(angle) >= 0.5)
        | (near == 0)
        | (near >= len(places) - 6)
    )
    found[is_off] = np.nan
    rows[is_around] = found
    return rows


@lru_cache
def _lane(way):
    line = path(way)
    points = tuple((float(x), float(y)) for x, y, _ in line.points[::10])
    (x, y), heading = points[0], float(line.points[0, 2])
    length = (len(points) - 1) * STEP * 10
    return Lane(
        x=x, y=y, heading=heading, length=length, width=LANE_WIDTH, speed_limit=15.0, points=points
    )


MEETINGS = (
    ("west straight", "north straight"), ("west straight", "south straight"), ("west straight", "east left"),
    ("west left", "east straight"), ("west left", "north straight"), ("west left", "south left"),
    ("west right", "north straight"), ("west straight", "south right"), ("west straight", "north left"),
    ("west left", "east right"), ("join", "circle"), ("circle", "join"),
)  # fmt: skip
"""Pairs of the ego's way and an NPC's way."""


def random_collision(number):
    """Return the random collision at a junction with a number; the first in which the vehicles touch counts."""
    rng = np.random.default_rng(number)
    while (met := random_meeting(rng)) is None or met.ticks < 2:
        pass
    return met


def random_meeting(rng):
    """Return a random collision at a junction, or None if the sampled vehicles do not touch.

    The speeds of both may change three times. Some runs have an NPC on the ego's own way, and some have a second NPC.
    """
    ego, npc = MEETINGS[rng.integers(len(MEETINGS))]
    ways = [npc, *([npc, "grid"] if rng.random() < 0.3 else [])]
    if rng.random() < 0.15:
        ways = ["grid", npc]
    enters = rng.uniform(2.0, 5.0)
    first, *others = [
        _random_plan(rng, way, enters + rng.normal(1.0 if way == "grid" else 0.0, 1.5))
        for way in ways
    ]
    priority = ("ego", "npc", "none")[rng.choice(3, p=[0.4, 0.4, 0.2])]
    return meeting(_random_plan(rng, ego, enters), first, priority=priority, others=others)


def _random_plan(rng, way, enters):
    speed, changes, since = rng.uniform(2.0, 11.0), [], 0.0
    for _ in range(rng.integers(4)):
        since += rng.uniform(0.1, 3.0)
        final = rng.choice([0.0, rng.uniform(0.0, 14.0)])
        changes.append((since, rng.uniform(0.5, 8.0), final))
    return plan(way, max(enters, 0.3), speed, *changes)
