"""The construction of a :class:`NetworkRoad` from an environment's road network."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pytest_pafot.model.trace import FloatArray, Lane
from pytest_pafot.model.vehicle_type import CAR, TIGHTEST
from pytest_pafot.support.errors import WorldError
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.network import (
    STEP,
    Column,
    LaneIndex,
    Line,
    NetworkRoad,
    Piece,
    Shaped,
    allowed_speeds,
    bell_curve,
    distances,
    is_dead_end,
    leans,
    line_of,
    sharpest_ahead,
    wrap_angle,
)
from pytest_pafot.world.roads.network import way as way_of

SHORTEST_LANE = 10.0  # length below which the grid ignores a lane next to the path [m]
# distance past a lane's ends within which the lane still counts as next to the path [m]
BEYOND_ENDS = 0.5
SAME_DIRECTION = 0.5  # largest angle between two lanes in the same direction [rad]
SAME_LANE = 1.0  # largest sideways step between neighbouring points of a continuous lane [m]
# longest interruption of a lane that is bridged, for example between two sections [m]
BRIDGED = 10.0
EVENED = 2.0  # length scale over which sideways steps of a lane are rounded off [m]
LANE_CHANGE = 25.0  # length of a lane change at the speeds at which bends matter [m]
# distance of a car's centre from the end of its lane when it stops there [m]
STOP_BEFORE_END = CAR.length / 2 + 1.5
POINT_STEP = 2.0  # distance between the points of a lane in a trace [m]
ROOM_BEHIND = 150.0  # length of the path behind the ego's start [m]

Flags = npt.NDArray[np.bool_]


class _Strip:
    """A lane along the ego's path, stored as arrays with one entry per point of the line."""

    def __init__(self, points: int) -> None:
        self.exists = np.zeros(points, dtype=bool)
        self.across, self.limit, self.width = np.zeros((3, points))


def survey(env: Any, name: str, limits: NpcLimits, ahead: float) -> NetworkRoad:
    """Create the road for an environment that has been reset.

    ``ahead`` is the largest distance [m] that a vehicle can drive. Error messages call the environment ``name``.

    Raises:
        WorldError: if grid coordinates cannot be used on the road.
    """
    network = env.road.network
    ego = env.vehicle
    index, at = _start(network, ego, name)
    pieces, first = way_of(
        network,
        index,
        at,
        getattr(ego, "route", None),
        ahead=ahead,
        behind=ROOM_BEHIND,
    )
    line = line_of(pieces)
    speed = float(ego.speed)
    # the line is the ego's path, and the strips are the lanes along it
    strips = _strips(network, pieces, line, speed)
    curvature = curvature_of(line)
    worst = int(np.abs(curvature).argmax())
    if abs(curvature[worst]) > TIGHTEST:
        raise WorldError(
            field=name,
            expected=f"bends with a radius of at least {1 / TIGHTEST:g} m, which a vehicle with a length of "
            f"{CAR.length:g} m can follow",
            received=f"a bend with a radius of {1 / abs(curvature[worst]):.1f} m at x = {line.x[worst]:.0f} m, "
            f"y = {line.y[worst]:.0f} m",
        )
    start = _place(line, first, np.asarray(pieces[first].lane.position(at, 0)))
    # called again for each type of NPC
    shaped = partial(_columns, line, strips, is_dead_end=is_dead_end(network, pieces[-1]))
    columns, lanes = shaped(limits)
    sections = frozenset(piece.index[:2] for piece in pieces)
    others = {
        index: lane for index, lane in network.lanes_dict().items() if index[:2] not in sections
    }
    road = NetworkRoad(
        lanes=(*lanes, *(_other_lane(lane, speed) for lane in others.values())),
        columns=columns,
        shaped=shaped,
        limits=limits,
        sections=sections,
        route=tuple(piece.index for piece in pieces),
        others=tuple(others),
        line=line,
        lane_width=float(strips[0].width[round(start / STEP)]),
        speed_limit=max(speed, *(float(strip.limit.max()) for strip in strips.values())),
        start=start,
        ego_lane=sorted(strips).index(0),
        ego_speed=speed,
    )
    if road.end - road.start < 2 * CAR.length:
        raise WorldError(
            field=name,
            expected=f"a road that continues for at least {2 * CAR.length:g} m ahead of the ego's start",
            received=f"a road that ends after {road.end - start:.1f} m",
            fix="give the ego a route, or a start that is farther from the end",
        )
    return road


def _start(network: Any, ego: Any, name: str) -> tuple[LaneIndex, float]:
    if ego is None or not network.lanes_list():
        received = "an environment without an ego or without lanes"
        raise WorldError(field=name, expected="an ego on a road with lanes", received=received)
    index = network.get_closest_lane_index(ego.position, ego.heading)
    lane = network.get_lane(index)
    at, offset = (float(value) for value in lane.local_coordinates(ego.position))
    turned = abs(wrap_angle(float(ego.heading) - float(lane.heading_at(at))))
    is_beside = abs(offset) > float(lane.width_at(at)) / 2 + 1e-6 or not -1e-6 <= at <= lane.length
    if is_beside or turned > math.pi / 4:  # the grid runs along the ego's lane
        raise WorldError(
            field=name,
            expected="an ego that starts in a lane and faces along it, because the grid follows that lane",
            received=f"an ego {abs(offset):.1f} m from the centre of the nearest lane {index}, at an angle of "
            f"{math.degrees(turned):.0f} degrees",
            fix="open areas such as parking lots have no grid",
        )
    return index, min(max(at, 0.0), float(lane.length))


def _place(line: Line, piece: int, point: FloatArray) -> float:
    # The position [m] along the line of a point on one of the line's pieces.
    # A large additional distance excludes points of other pieces.
    x = point[0] - line.x
    y = point[1] - line.y
    distance = np.hypot(x, y) + np.where(line.piece == piece, 0.0, 1e6)
    near = int(distance.argmin())
    heading = line.heading[near]
    ahead = x[near] * math.cos(heading) + y[near] * math.sin(heading)
    return min(max(near * STEP + float(ahead), 0.0), (len(line.x) - 1) * STEP)


def _strips(
    network: Any, pieces: Sequence[Piece], line: Line, ego_speed: float
) -> dict[int, _Strip]:
    """Return the lanes along the ego's path by number. The ego's lane is 0, and lanes to its left are negative."""
    strips: dict[int, _Strip] = {}
    for point, owner in enumerate(line.piece):
        beside = _beside(network, pieces[owner], line, point)
        for number, (across, lane, longitudinal) in beside.items():
            if number not in strips:
                strips[number] = _Strip(len(line.x))
            strip = strips[number]
            strip.exists[point] = True
            strip.across[point] = across
            strip.limit[point] = max(lane.speed_limit or 0.0, ego_speed)
            strip.width[point] = lane.width_at(longitudinal)
    for number in [each for each in strips if each != 0]:  # the ego's own lane is the line itself
        _bridge(strips[number])
        _smooth(strips[number])
        _drop_broken(strips[number], line)
    return {number: strip for number, strip in strips.items() if strip.exists.any()}


def _beside(
    network: Any, piece: Piece, line: Line, point: int
) -> dict[int, tuple[float, Any, float]]:
    # By number, for each lane at a point of the line: the lateral distance, the lane and the position along the lane.
    x = float(line.x[point])
    y = float(line.y[point])
    heading = float(line.heading[point])
    place = np.array([x, y])
    cos = math.cos(heading)
    sin = math.sin(heading)
    origin, end, own = piece.index
    found = []
    for number, lane in enumerate(network.graph[origin][end]):
        along = float(lane.local_coordinates(place)[0])
        if number == own:
            own_entry = 0.0, lane, min(max(along, 0.0), float(lane.length))
            found.append(own_entry)
            continue
        if not -BEYOND_ENDS <= along <= lane.length + BEYOND_ENDS:
            continue
        if abs(wrap_angle(float(lane.heading_at(along)) - heading)) <= SAME_DIRECTION:
            there_x, there_y = map(float, lane.position(along, 0))
            across = (there_y - y) * cos - (there_x - x) * sin
            found.append((across, lane, along))
    found.sort(key=lambda each: each[0])  # from the left, with the ego's lane as number 0
    own_rank = found.index(own_entry)
    return {rank - own_rank: found[rank] for rank in _adjacent(found, own_rank)}


def _adjacent(found: list[tuple[float, Any, float]], own: int) -> Iterator[int]:
    """Yield the rank of the ego's lane in ``found``, and then the ranks of the adjacent lanes on each side."""
    yield own
    for way_out in (range(own, -1, -1), range(own, len(found))):
        for before, rank in pairwise(way_out):
            across, lane, at = found[rank]
            its_across, its_lane, its_at = found[before]
            apart = abs(across - its_across)
            width = float(lane.width_at(at) + its_lane.width_at(its_at)) / 2
            if not 0.6 * width < apart < 1.5 * width:  # the lanes overlap or are separated
                break
            yield rank


def _bridge(strip: _Strip) -> None:
    for before, after in pairwise(_parts(strip.exists)):
        last = before[-1]
        following = after[0]
        is_near = (following - last) * STEP <= BRIDGED
        if is_near and abs(strip.across[following] - strip.across[last]) <= SAME_LANE:
            between = np.arange(last + 1, following)
            strip.across[between] = np.interp(
                between,
                [last, following],
                strip.across[[last, following]],
            )
            strip.limit[between] = strip.limit[last]
            strip.width[between] = strip.width[last]
            strip.exists[between] = True


def _smooth(strip: _Strip) -> None:
    weights, reach = bell_curve(EVENED)
    for part in _parts(strip.exists):
        padded = np.pad(strip.across[part], reach, mode="edge")
        strip.across[part] = np.convolve(padded, weights, mode="valid")


def _drop_broken(strip: _Strip, line: Line) -> None:
    # cut the lane at steps that were too large to bridge or to round off
    strip.exists[np.flatnonzero(np.abs(np.diff(strip.across)) > SAME_LANE)] = False
    for part in _parts(strip.exists):
        # parts that are too short or too sharply curved are dropped
        if len(part) * STEP < SHORTEST_LANE:
            strip.exists[part] = False
            continue
        _, _, direction, lengths = _course(line, strip.across, part)
        if np.abs(_curvature(direction, lengths)).max() > TIGHTEST:
            strip.exists[part] = False


def _parts(exists: Flags) -> list[npt.NDArray[np.intp]]:
    indices = np.flatnonzero(exists)
    if indices.size:
        return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    return []


def _course(
    line: Line, across: FloatArray, part: npt.NDArray[np.intp]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    # x [m], y [m], direction [rad] and distance [m] from the start at each point of one part of a lane.
    heading = line.heading[part]
    x = line.x[part] - np.sin(heading) * across[part]
    y = line.y[part] + np.cos(heading) * across[part]
    turned = np.arctan2(np.gradient(y), np.gradient(x)) - heading
    # Not wrap_angle(turned), which rounds differently: runs of saved scenarios would change.
    direction = heading + (turned + np.pi) % (2 * np.pi) - np.pi
    return x, y, direction, distances(np.stack([x, y], axis=-1))


def curvature_of(line: Line) -> FloatArray:
    """Return the curvature [1/m] of a line at each of its points."""
    return _curvature(line.heading, np.arange(len(line.x), dtype=np.float64) * STEP)


def lone_column(line: Line, pieces: Sequence[Piece], ego_speed: float) -> Shaped:
    """Return a function that creates the only lane of a path."""
    strip = _Strip(len(line.x))
    strip.exists[:] = True
    for number, piece in enumerate(pieces):
        strip.limit[line.piece == number] = max(piece.lane.speed_limit or 0.0, ego_speed)
    return partial(_columns, line, {0: strip})


def _curvature(direction: FloatArray, lengths: FloatArray) -> FloatArray:
    raw = np.gradient(direction) / np.maximum(np.gradient(lengths), 1e-9)
    padded = np.concatenate([raw[:1], raw, raw[-1:]])
    return np.convolve(padded, np.full(3, 1 / 3), mode="valid")  # the mean of three points


def _columns(
    line: Line,
    strips: dict[int, _Strip],
    limits: NpcLimits,
    vehicle_length: float = CAR.length,
    *,
    is_dead_end: bool = False,
) -> tuple[tuple[Column, ...], list[Lane]]:
    """Return the path's lanes, and the lanes for a trace, in which the first parts of lanes precede all other parts."""
    firsts: list[Lane] = []
    others: list[Lane] = []
    columns = []
    numbers = sorted(strips)
    for number in numbers:
        strip = strips[number]
        known = np.flatnonzero(strip.exists)
        column = {
            "across": np.interp(np.arange(len(line.x)), known, strip.across[known]),  # also in gaps
            "direction": line.heading.copy(),
            "lean": np.zeros(len(line.x)),
            "speed": np.zeros(len(line.x)),
            "sharpest": np.zeros(len(line.x)),
        }
        part_of = np.full(len(line.x), -1)
        for order, part in enumerate(_parts(strip.exists)):
            x, y, direction, lengths = _course(line, strip.across, part)
            column["direction"][part] = direction
            column["lean"][part] = leans(direction, lengths, vehicle_length)
            curvature = _curvature(direction, lengths)
            column["sharpest"][part] = sharpest_ahead(curvature, lengths, LANE_CHANGE)
            # NPCs stop where a lane ends before the line ends, and where the ego's lane is a dead end.
            goes_on = part[-1] == len(line.x) - 1 and not (is_dead_end and number == 0)
            stops = None
            if not goes_on:
                stops = float(lengths[-1]) - (STOP_BEFORE_END + (vehicle_length - CAR.length) / 2)
            column["speed"][part] = allowed_speeds(
                curvature,
                strip.limit[part],
                stops,
                lengths,
                limits,
            )
            lane = _lane(
                x,
                y,
                direction,
                lengths,
                float(strip.width[part].mean()),
                float(strip.limit[part].max()),
            )
            # in the trace, the first parts of all lanes come first
            if order == 0:
                part_of[part] = len(firsts)
                firsts.append(lane)
            else:
                part_of[part] = len(numbers) + len(others)
                others.append(lane)
        columns.append(
            Column(
                exists=strip.exists.tolist(),
                part=part_of.tolist(),
                **{name: values.tolist() for name, values in column.items()},
            )
        )
    return tuple(columns), [*firsts, *others]


def _lane(
    x: FloatArray,
    y: FloatArray,
    direction: FloatArray,
    lengths: FloatArray,
    width: float,
    speed_limit: float,
) -> Lane:
    points = list(zip(x.tolist(), y.tolist(), strict=True))
    shown = points[:: round(POINT_STEP / STEP)]
    if shown[-1] is not points[-1]:
        shown.append(points[-1])
    # a straight lane needs no points
    if np.abs(direction - direction[0]).max() < 1e-9:
        shown = []
    return Lane(
        x=float(x[0]),
        y=float(y[0]),
        heading=float(direction[0]),
        length=float(lengths[-1]),
        width=width,
        speed_limit=speed_limit,
        points=tuple(shown),
    )


def _other_lane(lane: Any, ego_speed: float) -> Lane:
    count = max(2, math.ceil(lane.length / STEP))
    places = np.linspace(0.0, float(lane.length), count).tolist()
    points = np.array([lane.position(place, 0) for place in places], dtype=float)
    direction = np.unwrap([float(lane.heading_at(place)) for place in places])
    limit = max(lane.speed_limit or 0.0, ego_speed)
    width = float(lane.width_at(lane.length / 2))
    return _lane(points[:, 0], points[:, 1], direction, distances(points), width, limit)


SECTION = 5.0  # length of the sections that `network_of` makes [m]
ALMOST = 1e-4  # largest distance of a point of a straight lane from its exact position [m]
MOST_OVERLAP = 0.1  # largest overlap of neighbouring lanes as a proportion of their width
# angle between the ends of a section up to which a lane counts as straight there [rad]
STRAIGHT = 1e-7


def straight_along(
    lines: Sequence[FloatArray], width: float
) -> tuple[tuple[float, float, float], float] | None:
    """Return the start and the length [m] of a road with equal straight lanes, or None for other lanes.

    The start consists of the x [m], y [m] and heading [rad] of the leftmost lane.

    Args:
        lines: the centre lines from the left, each as an array of shape [points, 2] with points [m] in the direction of
            driving.
        width: the width [m] of the lanes.
    """
    origin = lines[0][0]
    x, y = lines[0][-1] - origin
    heading = math.atan2(y, x)
    forward = np.array([math.cos(heading), math.sin(heading)])
    right = np.array([-forward[1], forward[0]])
    begin = 0.0
    end = math.inf
    for number, line in enumerate(lines):
        moved = line - origin
        along = moved @ forward
        across = moved @ right
        if np.abs(across - number * width).max() > ALMOST or (np.diff(along) <= 0.0).any():
            return None
        begin = max(begin, float(along[0]))
        end = min(end, float(along[-1]))
        if abs(along[0]) > width or abs(along[-1] - np.hypot(x, y)) > width:
            return None  # a lane that starts or ends at another position
    x, y = origin + begin * forward
    return (float(x), float(y), heading), end - begin


def network_of(
    lines: Sequence[FloatArray], width: float, speed_limit: float, name: str = ""
) -> Any:
    """Create a highway-env network with a lane along each centre line.

    ``lines`` are as for :func:`straight_along`, but can have different lengths. Error messages give ``name`` as the
    owner of the lanes.

    Raises:
        WorldError: if the lanes are not in order from the left, or overlap.
    """
    from pytest_pafot.world.stock import CircularLane, RoadNetwork, StraightLane  # noqa: PLC0415  (highway-env)

    curves = [_curve(line) for line in lines]
    longest = max(curves, key=len)
    # the ends of sections, at the same positions for all lanes
    stations = longest[:: max(1, round(SECTION))]
    if len(stations) > 1 and math.dist(stations[-1], longest[-1]) > SECTION / 2:
        stations = np.vstack([stations, longest[-1:]])
    tangent = _gradient(stations)
    tangent /= np.hypot(*tangent.T)[:, None]
    # farther points belong to another turn of a spiral, or to a loop's other side
    reach = 2.0 * width * len(lines)
    ways = [_at_stations(curve, stations, tangent, reach) for curve in curves]
    _check_order(ways, tangent, width, name)
    turns = [_directions(way) for way in ways]
    network = RoadNetwork()
    common = {"width": width, "speed_limit": speed_limit}
    # in each section, each lane is a straight line or a circle through both ends
    for number, (here, there) in enumerate(pairwise(range(len(stations)))):
        for way, turn in zip(ways, turns, strict=True):
            start = way[here]
            end = way[there]
            angle = float(turn[there] - turn[here])
            if not np.isfinite([*start, *end]).all():
                continue
            if not abs(angle) > STRAIGHT:
                network.add_lane(str(number), str(number + 1), StraightLane(start, end, **common))
                continue
            chord = math.dist(start, end)
            dx, dy = end - start
            radius = chord / (2.0 * math.sin(abs(angle) / 2.0))
            side = math.copysign(1.0, angle)  # 1 to the right, where y is positive
            toward = math.atan2(dy, dx) + side * math.pi / 2
            away = radius * math.cos(angle / 2.0)
            centre = (start + end) / 2 + away * np.array([math.cos(toward), math.sin(toward)])
            begin = math.atan2(*(start - centre)[::-1])
            lane = CircularLane(centre, radius, begin, begin + angle, clockwise=angle > 0, **common)
            network.add_lane(str(number), str(number + 1), lane)
    return network


def _check_order(ways: Sequence[FloatArray], tangent: FloatArray, width: float, name: str) -> None:
    for number, (left, right) in enumerate(pairwise(ways), start=1):
        to_the_right = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        across = ((right - left) * to_the_right).sum(axis=1)
        if np.isnan(across).all():
            continue
        apart = float(np.nanmedian(across))
        least = float(np.nanmin(across))
        most = float(np.nanmax(across))
        if apart < (1.0 - MOST_OVERLAP) * width and most - least > width / 2:
            expected = (
                f"a lane {width:g} m to the right of lanes[{number - 1}] along its entire length"
            )
            received = f"a lane that is {least:.1f} to {most:.1f} m to the right"
            fix = "are the lines shifted along a coordinate axis instead of across the road?"
            raise WorldError(
                field=f"{name}.lanes[{number}]",
                expected=expected,
                received=received,
                fix=fix,
            )
        if apart < 0.0:
            expected = "lanes in order from left to right, as a driver sees them"
            received = f"a lane {-apart:.1f} m to the left of the previous lane"
            fix = "is y_is_left wrong, or are the points in reverse order? Otherwise, reverse the list of lanes"
            raise WorldError(
                field=f"{name}.lanes[{number}]",
                expected=expected,
                received=received,
                fix=fix,
            )
        if apart < (1.0 - MOST_OVERLAP) * width:
            expected = (
                f"at most {apart:.2f} m, the distance between the centre lines of lanes "
                f"{number - 1} and {number}"
            )
            fix = "are lane_width and the points of the lanes in the unit that `metres` specifies?"
            raise WorldError(
                field=f"{name}.lane_width",
                expected=expected,
                received=f"{width:.2f} m",
                fix=fix,
            )


def _gradient(points: FloatArray, *places: FloatArray) -> Any:
    # at the ends of a line, tangents of a parabola, so that a bend starts with its curvature
    edge_order: Literal[1, 2] = 1
    if len(points) > 2:
        edge_order = 2
    return np.gradient(points, *places, axis=0, edge_order=edge_order)


def _directions(way: FloatArray) -> FloatArray:
    # The direction [rad] of a lane at each point.
    slopes = np.zeros_like(way)
    known = np.flatnonzero(np.isfinite(way[:, 0]))
    if len(known) > 1:
        slopes[known] = _gradient(way[known])
    dx, dy = slopes.T
    directions: FloatArray = np.unwrap(np.arctan2(dy, dx))
    return directions


def _curve(line: FloatArray) -> FloatArray:
    """Return points about a metre apart on a smooth curve through a line's points (Catmull and Rom 1974)."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    places = distances(line)
    slopes = _gradient(line, places)
    count = max(2, round(float(places[-1])) + 1)
    wanted = np.linspace(0.0, places[-1], count)
    part = np.searchsorted(places, wanted, side="right") - 1
    part = np.clip(part, 0, len(steps) - 1)
    share = ((wanted - places[part]) / steps[part])[:, None]
    length = steps[part][:, None]
    square = share**2
    cube = share**3
    curve: FloatArray = (
        (2 * cube - 3 * square + 1) * line[part]
        + (cube - 2 * square + share) * length * slopes[part]
        + (3 * square - 2 * cube) * line[part + 1]
        + (cube - square) * length * slopes[part + 1]
    )
    return curve


def _at_stations(
    curve: FloatArray, stations: FloatArray, tangent: FloatArray, reach: float
) -> FloatArray:
    """Return, for each station, the nearest point of a curve on either side, or NaN if there is none nearby."""
    found = np.full_like(stations, np.nan)
    for number, (station, direction) in enumerate(zip(stations, tangent, strict=True)):
        ahead = (curve - station) @ direction
        crossing = np.flatnonzero((ahead[:-1] <= 1e-6) & (ahead[1:] >= -1e-6))
        if not crossing.size:
            continue
        x, y = (curve[crossing] - station).T
        distances_there = np.hypot(x, y)
        if distances_there.min() > reach:
            continue
        near = crossing[distances_there.argmin()]
        share = -ahead[near] / (ahead[near + 1] - ahead[near])
        found[number] = curve[near] + min(max(share, 0.0), 1.0) * (curve[near + 1] - curve[near])
    return found
