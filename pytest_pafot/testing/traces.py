"""The promises of a trace, as conditions on its arrays, with the words for a trace that breaks them.

The tolerances are what other simulators do a little differently, such as finding contacts by other shapes, moving with
the speed before or after a step, and changing lanes in one step. Each is far below the smallest mistake that it has to
show: a wrong unit or axis, or a wrong point of a vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from pytest_pafot import Cell, NpcLimits, Scenario, SimulatorWorld, Trace
from pytest_pafot.criticality.measures import Encounters
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, STEERING, Collision, FloatArray, Lane, X, Y
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.support.errors import plain_whole
from pytest_pafot.world.guard.own_worlds import base_world

Promises = Iterator[tuple[Any, str, str]]
"""For each promise: whether it is kept, its words, and what was received instead. A later one may need the earlier."""

ALONG, ACROSS = 0, 1
"""Columns of :attr:`pytest_pafot.Trace.track`."""

ROUNDING = 1e-6
SINGLE = 1e-4
"""The share of a limit by which values with single precision may exceed it."""
AT_START = 0.1
"""The largest difference from the start speed of the scenario, for the ego [m/s]; for NPCs ten times as much."""
DEEP = 0.5
"""The deepest overlap of two boxes that may go unreported, since the shapes of vehicles are no boxes [m]."""
APART = 0.3
"""The largest gap between the boxes of two vehicles in contact, besides what they drive in a tick [m]."""
OUTLIERS = 0.1
"""The share of ticks that may be exceptions, such as a lane change in one tick."""
DISTANCE = 0.1, 4.0
"""The largest difference between the way driven and the speeds: a share, and a lane width of jumps aside [m]."""
DIRECTION = 0.4
"""The largest median angle between the heading and the motion of a vehicle; turned wheels make it slip [rad]."""
MOVING = 2.0
"""The speed above which the direction of motion is known [m/s]."""
SEVERAL = 3
"""The fewest collisions that show whether a world ends its runs too early."""
LEAST = 10
"""The fewest ticks from which a share is taken."""
SMOOTH = 0.5
"""The time over which accelerations are compared with speeds [s]; speeds may be rounded, accelerations a tick late."""
EARLY = 0.2
"""The share of the difference of accelerations from those of the speeds that is left if they are those of a tick later.
"""
STEP = 0.4, 0.1, 2.0
"""The largest difference between a step and the speed in one tick: a share, the rounding of places [m], and the speed
aside of a vehicle whose speed is only that along the road [m/s]."""
SELDOM = 0.9
"""The least share of right steps if the others are jumps."""
WHEELS = 0.2, 4.0
"""The turn by the wheels and the length of a vehicle, at least and at most, as a multiple of the turn of its heading.
The distance between the axles is no part of a trace."""
COARSE = 1.0
"""The largest difference between the data of a lane and the line through its points [m], which may be far apart."""


def is_straight(trace: Trace) -> bool:
    """Return whether the lanes of a trace are straight."""
    return trace.road.is_straight and not any(lane.points for lane in trace.lanes)


def form(world: Any, scenario: Scenario, trace: Trace) -> Promises:
    """Yield what test functions, measures and report pages rely on when they read a trace."""
    if trace.error is not None and not trace.error.is_of_ads:
        yield False, "the methods of the environment return", f"{trace.error.text}\n{trace.error.traceback}"
    yield trace.error is None, "the ADS of the check drives in this world", f"{trace.error}; give a different ads="
    states, start = trace.states, trace.states[0]
    yield states.shape[1] == len(scenario.npcs) + 1, "states contain the ego and each NPC", f"shape {states.shape}"
    rates = [plain_whole(rate) for rate in (trace.physics_hz, trace.ads_hz)]
    yield all(rate is not None and rate > 0 for rate in rates), "physics_hz and ads_hz are whole numbers", f"{rates}"
    yield len(trace.lanes) > 0, "lanes has the lanes of the road", "none"
    for vehicle in range(states.shape[1] if is_straight(trace) else 1):
        speed, allowed, asked = start[vehicle, SPEED], 10 * AT_START if vehicle else AT_START, scenario.ego_speed
        asked = min(asked, trace.ego_vehicle.top_speed, trace.vehicle_type(vehicle).top_speed)
        promise = f"starts as fast as the scenario says, states[0, {vehicle}, SPEED] at scenario.ego_speed"
        received = f"{speed:.2f} m/s for {asked:g} m/s"
        yield abs(speed - asked) <= allowed, f"{_name(vehicle)} {promise}", received
    ways = [None if told is None else told.zone for told in scenario.crossings]
    crossing = np.array([chain[0].crosses for chain in scenario.npcs])
    on_way = np.full((len(states), len(scenario.npcs)), np.nan) if trace.on_way is None else trace.on_way
    has_track = not trace.road.is_straight
    track = trace.road.track[:, 1:] if has_track else np.zeros((1, len(crossing), 1))
    longest = min(float(world.longest_run), scenario.seconds)
    for promise, is_kept in {
        "trace.scenario is the requested scenario": trace.scenario == scenario,
        "trace.executed has a chain for each NPC": len(trace.executed.npcs) == len(scenario.npcs),
        "states are finite": np.isfinite(states).all(),
        "sizes has those of scenario.vehicles": all(
            vehicle == CAR or np.allclose(size, (vehicle.length, vehicle.width))
            for vehicle, size in zip(scenario.vehicles, trace.sizes[1:], strict=False)
        ),
        "vehicles have a length and a width": (trace.sizes > 0).all(),
        "sizes has the length before the width": (trace.sizes[:, 0] >= trace.sizes[:, 1]).all(),
        "the column lane is an index of lanes, or -1": np.isin(states[..., LANE], range(-1, len(trace.lanes))).all(),
        "ads_hz divides physics_hz": trace.physics_hz % trace.ads_hz == 0,
        "no run is longer than longest_run, or its scenario": trace.duration <= longest + 1.5 * trace.dt,
        "there is a collision if the outcome says so": (trace.outcome == "collision") == bool(trace.collision),
        "acceleration and steering of the first row are 0": not start[:, [ACCELERATION, STEERING]].any(),
        "states[..., STEERING] is in rad": (np.abs(states[..., STEERING]) <= math.pi / 2).all(),
        "zones are those of the instructions": [None if zone is None else zone.way for zone in trace.zones] == ways,
        "on_way has the places of crossing NPCs, and NaN for others": (np.isfinite(on_way) == crossing).all(),
        "track is recorded if an NPC crosses": has_track or not crossing.any(),
        "track has NaN only for crossing NPCs": not np.isnan(track[:, ~crossing]).any(),
        "track has the places of all vehicles on the ego's way if the road bends, and lanes[...].points its shape": (
            has_track or not any(map(_bends, trace.lanes))
        ),
    }.items():
        yield is_kept, promise, f"something else in {trace!r}"


def of_runs(world: Any, traces: Sequence[Trace]) -> Promises:
    """Yield the promises of traces that have the right form.

    For a simulator's these are only the motion of its vehicles: experiments have shown the rest, which this package
    calculates. A class that is derived from :class:`pytest_pafot.SimulatorWorld` may do anything, and has all promises.
    """
    if isinstance(base_world(world), SimulatorWorld):
        yield from motion(traces)
        return
    for trace in traces:
        yield from limits(world, trace)
        yield from road(world, trace)
    yield from motion(traces)
    for trace in traces:
        yield from places_at_start(trace)
        yield from contacts(trace)
        yield from end(world, trace)
    yield from touching(traces)


def limits(world: Any, trace: Trace) -> Promises:
    """Yield the limits of the NPCs, if the world states them."""
    stated, npcs, dt = getattr(world, "limits", None), trace.npcs, trace.dt
    if not isinstance(stated, NpcLimits):
        return
    speed = npcs[..., SPEED]
    acceleration = np.concatenate([np.zeros_like(speed[:1]), np.diff(speed, axis=0) / dt])
    is_standing = (speed[1:] <= ROUNDING) | (speed[:-1] <= ROUNDING)
    jerk = np.where(is_standing, 0.0, np.diff(acceleration, axis=0) / dt)
    turns = wrapped(np.diff(npcs[..., HEADING], axis=0))
    angle = trace.angles[:, 1:]
    angle = np.where([zone is None for zone in trace.zones or [None] * npcs.shape[1]], angle, 0.0)
    aside = speed[:-1] * turns / dt
    for npc, vehicle in enumerate(trace.scenario.all_vehicles):
        own = stated.of(vehicle)
        who = "NPCs" if vehicle == CAR else f"a {vehicle.name}"
        for name, values, low, high in (
            ("speed", speed, 0.0, min(own.overspeed * world.speed_limit, vehicle.top_speed)),
            ("acceleration", acceleration, -own.braking, own.acceleration),
            ("jerk", jerk, -own.jerk, own.jerk),
            ("heading", angle, -own.heading, own.heading),
            ("lateral acceleration", aside, -own.lateral_acceleration, own.lateral_acceleration),
        ):
            least, most = float(np.min(values[:, npc], initial=0.0)), float(np.max(values[:, npc], initial=0.0))
            spare = ROUNDING + SINGLE * max(abs(low), high)
            is_kept = low - spare <= least and most <= high + spare
            yield is_kept, f"the {name} of {who} is from {low:g} to {high:g}", f"{least:g} to {most:g}"


def road(world: Any, trace: Trace) -> Promises:
    """Yield that the lanes are lanes, and on a straight road that each vehicle is in the lane that its state names."""
    lanes = trace.lanes
    for number, lane in enumerate(lanes):
        is_lane = all(math.isfinite(each) and each > 0 for each in (lane.length, lane.width, lane.speed_limit))
        yield is_lane, f"lanes[{number}] has a length, a width and a speed_limit", f"{lane}"
    limit = max(lane.speed_limit for lane in lanes)
    fits = world.speed_limit / 3 <= limit <= 3 * world.speed_limit
    promise = "lanes have a speed_limit in m/s that fits the world's speed_limit"
    yield fits, promise, f"{limit:g} and {world.speed_limit:g}"
    yield from _neighbours(lanes) if is_straight(trace) else _bent(lanes)
    for vehicle in _on_grid(trace):
        states = trace.states[:, vehicle]
        is_off, is_inside = states[:, LANE] < 0, np.zeros(len(states), dtype=np.bool_)
        for number, lane in enumerate(lanes):
            is_inside[is_off] |= _away(_line(lane), states[is_off]) < lane.width / 2 - DEEP
            there = _away(_line(lane), states[states[:, LANE] == number])
            is_often_out = len(there) >= LEAST and (there > lane.width / 2 + DEEP).mean() > OUTLIERS
            promise = f"states[..., X] and states[..., Y] of {_name(vehicle)} are within the lane of states[..., LANE]"
            received = f"{there.max(initial=0):.1f} m from the centre line of lanes[{number}], {lane.width:g} m wide"
            # Where lanes meet, a vehicle may already have the number of the next one.
            is_kept = not (is_straight(trace) and (there > lane.width).any()) and not is_often_out
            yield is_kept, f"{promise}, with y to the right of the driving direction", received
        wrong = int((is_inside & is_off).sum())
        received = f"-1 within a lane at {wrong} of {len(states)} ticks"
        yield (
            wrong <= OUTLIERS * len(states),
            f"states[..., LANE] of {_name(vehicle)} is -1 only off the road",
            received,
        )


def _line(lane: Lane) -> FloatArray:
    """Return the points of the centre line of a lane [m]."""
    return np.array(lane.points or [(lane.x + metres * math.cos(lane.heading), lane.y + metres * math.sin(lane.heading))
                                    for metres in (0.0, lane.length)])  # fmt: skip


def _away(line: FloatArray, states: FloatArray) -> FloatArray:
    """Return for rows of states how far they are from a line [m], that of the centre of a lane."""
    parts = np.diff(line, axis=0)
    length = np.maximum(np.hypot(*parts.T), ROUNDING)
    cos, sin = parts.T / length
    x, y = states[:, [X]] - line[:-1, 0], states[:, [Y]] - line[:-1, 1]
    along, across = x * cos + y * sin, y * cos - x * sin
    away: FloatArray = np.hypot(across, along - np.clip(along, 0.0, length)).min(axis=1)
    return away


def _bends(lane: Lane) -> bool:
    """Return whether a lane leaves the line from its start to its end."""
    line = np.array(lane.points or [(lane.x, lane.y)])
    direction = line[-1] - line[0]
    aside = (line - line[0]) @ [-direction[1], direction[0]] / max(float(np.hypot(*direction)), ROUNDING)
    return bool(np.abs(aside).max() > COARSE)


def _bent(lanes: Sequence[Lane]) -> Promises:
    """Yield that the data of lanes agree with their points, and that lanes side by side are listed from the left."""
    for number, lane in enumerate(lanes):
        if not lane.points:
            continue
        parts = np.diff(lane.points, axis=0)
        away = math.dist(lane.points[0], (lane.x, lane.y))
        yield away <= COARSE, f"lanes[{number}].points begins at x and y of the lane", f"{away:.1f} m from there"
        angle = math.remainder(math.atan2(parts[0, 1], parts[0, 0]) - lane.heading, math.tau)
        promise = f"lanes[{number}].heading is the direction of its first points in rad, {CLOCKWISE}"
        yield abs(angle) <= DIRECTION, promise, f"{angle:.2f} rad between them"
        length = float(np.hypot(*parts.T).sum())
        is_long = abs(length - lane.length) <= DISTANCE[0] * length + COARSE
        yield is_long, f"lanes[{number}].length is that of its points in m", f"{lane.length:g} m and {length:g} m"
    for number, (left, right) in enumerate(pairwise(lanes)):
        x, y = right.x - left.x, right.y - left.y
        cos, sin, width = math.cos(left.heading), math.sin(left.heading), (left.width + right.width) / 2
        along, across = x * cos + y * sin, y * cos - x * sin
        # Elsewhere on a road that bends, two lanes in a row of the list need not be neighbours.
        is_beside = abs(along) <= width and abs(across) <= 1.6 * width and math.cos(right.heading - left.heading) > 0.9
        promise = "lanes side by side are listed from the left, with y to the right of the driving direction"
        received = f"lanes[{number + 1}] {-across:g} m to the left of lanes[{number}]"
        yield not is_beside or across > -DEEP, promise, received
        is_width = not is_beside or across < COARSE or across > 0.6 * width
        yield is_width, "lanes[...].width is the width of a lane", f"{width:g} m for lanes {across:.1f} m apart"


def _on_grid(trace: Trace) -> list[int]:
    """Return the vehicles that do not cross. Where ways meet, lanes overlap, and a crossing NPC may be in either."""
    return [0, *(npc + 1 for npc, chain in enumerate(trace.scenario.npcs) if not chain[0].crosses)]


def _neighbours(lanes: Sequence[Lane]) -> Promises:
    shares: list[float] = []  # of the distances of neighbours in the widths of lanes
    for number, (left, right) in enumerate(pairwise(lanes)):
        across = (right.y - left.y) * math.cos(left.heading) - (right.x - left.x) * math.sin(left.heading)
        is_alike = math.cos(right.heading - left.heading) > math.cos(0.1)
        promise = "lanes are listed from the left, with y to the right of the driving direction"
        yield not is_alike or across > 0, promise, f"lanes[{number + 1}] {-across:g} m to the left of lanes[{number}]"
        shares.append(across / ((left.width + right.width) / 2) if is_alike else 1.0)
    # Between two lanes there may be room, but not between all of them.
    is_width = not shares or (min(shares) >= 0.6 and (len(shares) == 1 or min(shares) <= 1.5))
    yield is_width, "lanes[...].width is the width of a lane", f"lanes {max(shares, default=1):.2g} widths apart"


def motion(traces: Iterable[Trace]) -> Promises:
    """Yield that the motion of the vehicles is that of their speeds, headings, accelerations and wheels.

    Lateral motion, accelerations and steering show only in many runs together.
    """
    sideways, errors, turns, early = ([np.zeros((0, columns))] for columns in (2, 2, 3, 2))
    for trace in traces:
        # Without the impact of a collision, which changes speeds at once.
        states, dt = trace.states[: trace.ticks + 1 - (trace.collision is not None)], trace.dt
        if len(states) < 2:
            continue
        speed, rows = states[..., SPEED], states[1:]
        steps, pace = np.diff(states[..., [X, Y]], axis=0), np.abs(speed)
        driven, forwards = np.hypot(*np.moveaxis(steps, 2, 0)), np.where(speed[1:] < 0, -1.0, 1.0)
        course = np.arctan2(forwards * steps[..., 1], forwards * steps[..., 0])
        is_moving = (driven > MOVING * dt) & (pace[1:] > MOVING)
        by_speed = (pace[1:] + pace[:-1]) / 2 * dt
        slip = np.abs(wrapped(course - rows[..., HEADING]))
        for vehicle, (metres, by) in enumerate(zip(driven.sum(0), by_speed.sum(0), strict=True)):
            # A vehicle that changes lanes in one tick jumps aside then.
            stays = states[1:, vehicle, LANE] == states[:-1, vehicle, LANE]
            least, most = np.sort([pace[1:, vehicle], pace[:-1, vehicle]], axis=0) * dt
            step = driven[:, vehicle]
            spare = STEP[1] + STEP[2] * dt
            is_step = (step >= (1 - STEP[0]) * least - spare) & (step <= (1 + STEP[0]) * most + spare) | ~stays
            tick = int(is_step.argmin())
            received = f"a step of {step[tick]:.2f} m and {by_speed[tick, vehicle]:.2f} m by the speed"
            promise = f"states has a row for each tick, at {trace.physics_hz} Hz, none repeated, and no vehicle jumps"
            steps_right = bool(is_step.all()), promise, f"{received}, of {_name(vehicle)} to tick {tick + 1}"
            if is_step.mean() > SELDOM:  # else the speeds are wrong, or the ticks
                yield steps_right
            is_alike = abs(metres - by) <= DISTANCE[0] * max(metres, by) + DISTANCE[1]
            promise = (
                f"states[..., SPEED] of {_name(vehicle)} is its speed along its way, in m/s at {trace.physics_hz} Hz"
            )
            yield is_alike, promise, f"{metres:.1f} m driven and {by:.1f} m by the speeds"
            away = slip[is_moving[:, vehicle], vehicle]
            median = float(np.median(away)) if len(away) >= LEAST else 0.0
            promise = f"states[..., HEADING] of {_name(vehicle)} is the direction of its motion in rad, {CLOCKWISE}"
            yield median <= DIRECTION, promise, f"{median:.2f} rad between heading and motion at half of the ticks"
            yield steps_right
        window = max(round(SMOOTH * trace.physics_hz), 1)
        gained = np.vstack([np.zeros_like(speed[:1]), np.cumsum(rows[..., ACCELERATION] * dt, axis=0)])
        both = [(each[window:] - each[:-window]) / (window * dt) for each in (speed, gained)]
        errors.append(np.stack(both, axis=-1).reshape(-1, 2))
        exact = np.diff(speed, axis=0) / dt
        wrong = [rows[:-1, :, ACCELERATION] - exact[each : len(exact) - 1 + each] for each in (0, 1)]
        early.append(np.stack(wrong, axis=-1).reshape(-1, 2))
        turn = wrapped(np.diff(states[..., HEADING], axis=0))
        who = np.broadcast_to(np.arange(turn.shape[1]) > 0, turn.shape)
        wheels = np.tan(rows[..., STEERING]) * driven * forwards / trace.sizes[:, 0]
        turns.append(np.stack([turn, wheels, who], axis=-1)[is_moving])
        if is_straight(trace):
            along = trace.lanes[0].heading
            angles = np.stack([wrapped(course - along), rows[..., HEADING] - along], axis=-1)[is_moving]
            sideways.append(angles[(np.abs(angles[:, 0]) > 0.02) & (np.abs(angles[:, 0]) < 0.5)])
    course, heading = np.concatenate(sideways).T
    # A world without headings, in which all of them are along the road, is no mistake that matters.
    agree = (np.abs(heading) < 0.01) | ((course * heading > 0) & (np.abs(heading) <= 3 * np.abs(course) + 0.1))
    received = f"headings against lateral motion at {(~agree).sum()} of {len(agree)} ticks"
    promise = f"states[..., HEADING] is the direction of motion in rad, {CLOCKWISE}"
    yield len(agree) < LEAST or agree.mean() >= 0.5, promise, received
    found, told = np.concatenate(errors).T
    error, size = (float(np.sqrt(np.mean(np.square(each)))) if len(each) else 0.0 for each in (told - found, found))
    promise = "states[..., ACCELERATION] is the acceleration that led to a row, in m/s^2, the difference of its speeds"
    received = f"a root mean square difference of {error:.2f} m/s^2, where the speeds have {size:.2f} m/s^2"
    yield error <= DEEP + 0.3 * size, promise, received
    error, of_next = np.sqrt(np.mean(np.square(np.concatenate([[[0.0, 0.0]], *early])), axis=0))
    yield error <= ROUNDING or of_next > EARLY * error, promise, "the acceleration of the next tick"
    turned, steered, is_npc = np.concatenate(turns).T
    is_known = (np.abs(turned) > 1e-4) & (np.abs(steered) > 1e-4)
    for whose, is_one in ((f"of {_name(0)} ", is_npc == 0), ("of NPCs ", is_npc == 1)):
        turn, wheels = turned[is_known & is_one], steered[is_known & is_one]
        is_right = len(turn) < LEAST or turn @ wheels >= -0.5 * np.linalg.norm(turn) * np.linalg.norm(wheels)
        promise = f"states[..., STEERING] {whose}is positive where the vehicle turns clockwise, to the right"
        yield is_right, promise, "the opposite"
        ratio = float(np.median(np.abs(wheels / turn))) if len(turn) >= LEAST else 1.0
        promise = f"states[..., STEERING] {whose}is the angle of the front wheels in rad"
        yield WHEELS[0] <= ratio <= WHEELS[1], promise, f"a turn by the wheels that is {ratio:.2g} times the heading's"


def places_at_start(trace: Trace) -> Promises:
    """Yield that the vehicles start where the scenario says."""
    scenario, start, positions = trace.scenario, trace.states[0], Encounters(trace)
    pairs, touch = list(combinations(range(len(start)), 2)), _depths(trace, slice(1))[0][:, 0] > 0
    touching = " and ".join(map(_name, pairs[int(touch.argmax())]))
    yield not touch.any(), "no vehicles touch at the start", touching
    lane, ahead, right = int(start[0, LANE]), positions.ahead[:, 0], positions.right[:, 0]
    promise = "the ego starts in scenario.ego_lane, states[0, 0, LANE]"
    yield lane == scenario.ego_lane, promise, f"{lane} in {scenario}"
    for npc, (gene, *_) in enumerate(trace.chains):
        if not gene.on_grid:
            continue
        cell, wanted = gene.cell, scenario.ego_lane + gene.cell.column
        reach = 1.5 * float(trace.sizes[[0, npc + 1], 0].sum())
        is_in_row = ahead[npc] * cell.row > 0 if cell.row else abs(ahead[npc]) <= reach
        is_in_lane = start[npc + 1, LANE] == wanted
        if not is_straight(trace):  # where lanes begin and end, numbers of lanes say little
            is_in_lane = right[npc] * cell.column > 0 if cell.column else abs(right[npc]) <= trace.lanes[lane].width
        is_there = (is_in_row and is_in_lane) or not 0 <= wanted < len(trace.lanes)
        promise = f"NPC {npc} starts in the cell of its first instruction in trace.executed, cell {int(cell)}"
        received = f"{ahead[npc]:.1f} m ahead of the ego in lane {int(start[npc + 1, LANE])}, the ego in lane {lane}"
        yield is_there, promise, f"{received}, and {right[npc]:.1f} m to its right"


def contacts(trace: Trace) -> Promises:
    """Yield that no boxes touch before the end of a run, and that its outcome and its collision agree with them."""
    hit, end, rows = trace.collision, trace.ticks + 1, trace.states[-2:]
    pairs, (least, most) = list(combinations(range(trace.states.shape[1]), 2)), _depths(trace)
    is_contact = trace.outcome in ("collision", "invalid")
    velocities = rows[..., [SPEED]] * np.stack([np.cos(rows[..., HEADING]), np.sin(rows[..., HEADING])], axis=-1)
    for pair, deep in zip(pairs, least, strict=True):
        # Some worlds look for contacts before they move, and several vehicles may touch in the last tick.
        step = np.hypot(*(velocities[-1, pair[0]] - velocities[-1, pair[1]])) * trace.dt if is_contact else 0.0
        is_deep = deep > DEEP + np.where(np.arange(end) >= end - 2, step, 0.0)
        if is_contact and (pair[0] or hit is None or pair[1] - 1 == hit.npc):
            is_deep[-1] = False
        ego = "the ego's box touches no NPC's before the end of a run, and then the outcome is collision"
        npcs = "the boxes of two NPCs do not touch before the end of a run, and then the outcome is invalid"
        received = f"an overlap of {deep[is_deep].max(initial=0):.1f} m of {_name(pair[0])} with {_name(pair[1])} "
        received += f"from tick {int(is_deep.argmax())} of {trace.ticks}, outcome {trace.outcome}"
        yield not is_deep.any(), f"{npcs if pair[0] else ego}: {CENTRES}", received
    # The gaps at the end, less what both vehicles drive in a tick towards each other.
    gaps = [-deep[-1] - np.abs(rows[:, a, SPEED] - rows[:, b, SPEED]).max() * trace.dt
            for (a, b), deep in zip(pairs, most, strict=True)]  # fmt: skip
    count = trace.states.shape[1] - 1  # The pairs with the ego come first.
    if trace.outcome == "invalid" and not trace.users_error_text:
        gap, at_object = min(gaps[count:], default=np.inf), any(_at_object(trace, npc + 1) for npc in range(count))
        promise = "boxes of two NPCs, or of one and an obstacle, touch at the end of a run with the outcome invalid"
        yield gap <= DEEP or at_object, promise, f"{gap:.1f} m"
    if hit is not None:
        yield from _collision(trace, hit, gaps[:count], velocities)


CLOCKWISE = "0 along x and growing clockwise, towards y"
CENTRES = "states[..., X], states[..., Y] and states[..., HEADING] are of the centres of boxes with sizes"


def _depths(trace: Trace, rows: slice = slice(None)) -> tuple[FloatArray, FloatArray]:
    """Return how deep the boxes of each two vehicles overlap [m], at least and at most, shape [pairs, rows].

    Some worlds find contacts with boxes that do not turn. So on straight roads the boxes are also taken along the road.
    """
    positions, headings = Encounters(trace), (None, trace.lanes[0].heading) if is_straight(trace) else (None,)
    depths = [positions.depths(rows, heading) for heading in headings]
    return np.min(depths, axis=0), np.max(depths, axis=0)


def touching(traces: Iterable[Trace]) -> Promises:
    """Yield that collisions are no earlier than contacts. One run alone may end a tick before, as it finds contacts."""
    gaps = [-_depths(trace, slice(-1, None))[1][trace.collision.npc, -1] for trace in traces
            if trace.collision is not None and trace.collision.npc in range(len(trace.scenario.npcs))]  # fmt: skip
    early = [gap for gap in gaps if gap > APART]
    promise = f"the boxes of the ego and of collision.npc touch at the last tick of a collision: {CENTRES}"
    received = f"a gap of up to {max(early, default=0):.1f} m at {len(early)} of {len(gaps)} collisions"
    yield len(gaps) < SEVERAL or len(early) <= len(gaps) / 2, promise, received


def _at_object(trace: Trace, vehicle: int) -> bool:
    """Return whether a vehicle is at a fixed object at the end of a run."""
    return Encounters(trace).depth_in(trace.obstacles, vehicle) >= -APART


def _collision(trace: Trace, hit: Collision, gaps: Sequence[float], velocities: FloatArray) -> Promises:
    """Yield each field of a collision; ``velocities`` [m/s] are those of the vehicles in the last two rows."""
    npcs, hz, rows = len(gaps), trace.physics_hz, trace.states[-2:]
    yield hit.tick == trace.ticks, "collision.tick is the last tick of the run", f"{hit.tick} of {trace.ticks}"
    received = f"{hit.time:g} s for tick {hit.tick} at {hz} Hz, which is {hit.tick / hz:g} s"
    promise = "collision.time is the time of collision.tick, tick / physics_hz"
    yield abs(hit.time - hit.tick / hz) <= 0.5 / hz, promise, received
    if hit.npc is None:
        nearest = min(gaps, default=np.inf)
        is_alone = _at_object(trace, 0) and nearest > -DEEP
        promise = "collision.npc is None only if the ego touches one of obstacles, and no NPC"
        yield (
            is_alone,
            promise,
            f"{nearest:.1f} m to an NPC, obstacles {trace.obstacles!r:.100}",
        )
        speed = abs(float(rows[-1, 0, SPEED]))
        is_closing = abs(abs(hit.ego_speed) - speed) <= 1.0 and abs(hit.closing_speed - speed) <= 0.1 * speed + 1.0
        received = f"{hit.ego_speed:g} and {hit.closing_speed:g}, the states have {speed:.1f}"
        promise = "collision.ego_speed and collision.closing_speed with a fixed object are the ego's speed in m/s"
        yield is_closing and hit.npc_speed == 0, promise, received
        return
    is_npc = plain_whole(hit.npc) is not None and 0 <= hit.npc < npcs
    yield is_npc, "collision.npc is the index of an NPC in the scenario, or None", f"{hit.npc!r} of {npcs}"
    is_near, other = gaps[hit.npc] <= APART, int(np.argmin(gaps))
    received = f"a gap of {gaps[hit.npc]:.1f} m to NPC {hit.npc} at tick {hit.tick}"
    promise = "collision.npc is the NPC that the ego touches"
    yield is_near or min(gaps) > 0, promise, f"{received}, NPC {other} touches"
    yield is_near, f"the boxes of the ego and of collision.npc touch at a collision: {CENTRES}", received
    for name, vehicle, given in (("ego_speed", 0, hit.ego_speed), ("npc_speed", hit.npc + 1, hit.npc_speed)):
        speeds = rows[:, vehicle, SPEED]
        is_speed = speeds.min() - DEEP <= given <= speeds.max() + DEEP
        received = f"{given:g}, states[..., SPEED] {speeds[-1]:.1f}"
        yield is_speed, f"collision.{name} is the speed of {_name(vehicle)} at the impact in m/s", received
    closing = [*np.hypot(*(velocities[:, hit.npc + 1] - velocities[:, 0]).T),
               *np.abs(rows[:, 0, SPEED] - rows[:, hit.npc + 1, SPEED])]  # fmt: skip
    is_closing = max(min(closing) - 1.0, 0.0) <= hit.closing_speed <= 1.1 * max(closing) + 1.0
    promise = "collision.closing_speed is the difference of the two velocities at the impact in m/s"
    yield is_closing, promise, f"{hit.closing_speed:g}, the states have {closing[1]:.1f}"
    ego, npc = rows[0, [0, hit.npc + 1]]
    x, y, cos, sin = npc[X] - ego[X], npc[Y] - ego[Y], math.cos(ego[HEADING]), math.sin(ego[HEADING])
    ahead, right = x * cos + y * sin, y * cos - x * sin
    # In line or beside, only one side is right. At a corner, either of two sides is.
    length, width = (trace.sizes[0] + trace.sizes[hit.npc + 1]) / 2
    is_in_line = abs(right) < width - DEEP and abs(ahead) > length - DEEP
    is_beside = abs(ahead) < length - 2 * DEEP and abs(right) > width - DEEP
    sides = {} if is_beside else {"front": ahead > -APART, "rear": ahead < APART}
    sides |= {} if is_in_line else {"right": right > -APART, "left": right < APART}
    received = f"{hit.side!r}, with the NPC {ahead:.1f} m ahead and {right:.1f} m to the right of the ego before"
    yield sides.get(hit.side, False), "collision.side is the side of the ego that was hit", received
    if hit.cell is None and trace.scenario.npcs[hit.npc][0].crosses:
        return
    yield isinstance(hit.cell, Cell), "collision.cell is a cell, a pafot.Cell", f"{hit.cell!r}"
    positions = Encounters(trace)
    now = [positions.last_cell(hit.npc, tick) for tick in (hit.tick, max(hit.tick - 1, 0))]
    near = {each for cell in now if cell is not None for each in (cell, *cell.neighbours)}
    promise = "collision.cell is the cell of the NPC at the impact, or before it came into the ego's own cell"
    yield not near or hit.cell in near, promise, f"{hit.cell!r}, the states have {now[0]!r}"


def end(world: Any, trace: Trace) -> Promises:
    """Yield that a run lasts as long as its outcome says, and that its ticks of events are ticks of the run."""
    scenario, off = trace.scenario, np.flatnonzero(trace.ego[:, LANE] < 0)
    longest = min(float(world.longest_run), scenario.seconds) if not scenario.crossings else 0.0
    # A search names the world's rollout where a run ends early and does not say why.
    says_why = bool(trace.ended) and not trace.ended.endswith(".rollout")
    is_whole = trace.outcome != "safe" or says_why or trace.duration >= longest - 2.5 * trace.dt
    promise = f"states of a run with the outcome safe last {longest:g} s, with physics_hz rows a second"
    received = f"{trace.ticks} ticks at {trace.physics_hz} Hz, {trace.duration:g} s"
    if touching := np.flatnonzero(_depths(trace, slice(-1, None))[1][: len(scenario.npcs), 0] > 0).tolist():
        received += f"; the boxes of the ego and of {_name(touching[0] + 1)} touch then, so is it a collision?"
    yield is_whole, promise, received
    first = int(off[0]) if len(off) else None
    received = f"off_road_tick {trace.off_road_tick}, outcome {trace.outcome}, and the first such row of states {first}"
    promise = "off_road_tick is the first tick with the ego in lane -1, or None"
    yield trace.off_road_tick in (None, first), promise, received
    is_told = trace.outcome != ("off_road" if first is None else "safe")
    yield is_told, "the outcome is off_road if the ego was in lane -1 and nothing else ended the run", received


def _name(vehicle: int) -> str:
    return f"NPC {vehicle - 1}" if vehicle else "the ego"


def wrapped(angles: FloatArray) -> FloatArray:
    """Return angles as the same angles from -pi to pi [rad]."""
    wrapped: FloatArray = (angles + np.pi) % (2 * np.pi) - np.pi
    return wrapped
