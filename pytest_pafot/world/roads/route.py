"""The ego's way through a road network: its lanes in driving order, and the line that they make.

highway-env's ``RoadNetwork`` is a graph of lanes of any shape. The grid needs one line for measurements along the road.
It consists of the lane in which the ego starts, the lanes to which its route (else ``next_lane``) leads, and the lanes
before the start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from pytest_pafot.model.trace import FloatArray

LaneIndex = tuple[str, str, int]
"""The index of a lane in highway-env: its road section's start and end node, and its number there from the left."""
Angle = TypeVar("Angle", float, FloatArray)

STEP = 0.5
"""The distance between neighbouring points of a line [m]."""
WIDEST_GAP = 10.0
"""The largest gap over which a vehicle drives on from a lane's end to the next lane [m]; in highway-env's roundabouts
it is 6 m."""
SHARPEST_BEND = 1.3
"""The largest angle between the directions of two consecutive lanes [rad]; no vehicle can follow a larger angle."""
DECIDED_BEFORE = 2.5
"""The distance before a lane's end at which highway-env's vehicles choose the next lane [m]."""
ROUGH = 0.06
"""The angle between neighbouring points of a line above which a joint of two lanes is rounded off [rad], because no
vehicle can follow it."""
BLEND = 3.0
"""The length scale over which a joint of two lanes is rounded off, to either side [m]."""


@dataclass(frozen=True, slots=True)
class Piece:
    """The part of a lane that belongs to a way, from ``begin`` to ``end`` in the lane's longitudinal coordinate [m]."""

    index: LaneIndex
    lane: Any
    begin: float
    end: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line for measurements along the road, with a point every 0.5 m.

    Attributes:
        x, y: world coordinates [m], shape [points].
        heading: the direction at each point [rad], without jumps of 2 pi.
        piece: the index of the piece to which each point belongs.
    """

    x: FloatArray
    y: FloatArray
    heading: FloatArray
    piece: np.ndarray[Any, np.dtype[np.intp]]


def way(
    network: Any, start: LaneIndex, at: float, planned: Sequence[Any] | None, *, ahead: float, behind: float
) -> tuple[tuple[Piece, ...], int]:
    """Return the pieces of the ego's way in driving order, and the number of the piece in which the ego starts.

    The ego starts in lane ``start`` at the longitudinal coordinate ``at`` [m]. The way covers the distances ``ahead``
    and ``behind`` [m] if the network continues that far. ``planned`` is the ego's ``route`` in highway-env.
    """
    first = Piece(start, network.get_lane(start), 0.0, float(network.get_lane(start).length))
    before: list[Piece] = []
    piece, wanted = first, behind - at
    while wanted > 0 and (leading := _predecessor(network, piece)) is not None:
        before.insert(0, leading)
        piece, wanted = leading, wanted - leading.end
    after: list[Piece] = []
    route = [step for step in planned or () if tuple(step[:2]) != start[:2]]
    piece, wanted = first, ahead - (first.end - at)
    while wanted > 0 and (following := _successor(network, piece, route)) is not None:
        after.append(following)
        piece, wanted = following, wanted - (following.end - following.begin)
        if route and tuple(route[0][:2]) == following.index[:2]:
            route.pop(0)
    return (*before, first, *after), len(before)


def _successor(network: Any, last: Piece, route: Sequence[Any]) -> Piece | None:
    """Return the next piece on the route, or without a route the nearest piece on which a vehicle can drive on."""
    origin, node, number = last.index
    point = last.lane.position(last.end, 0)
    deciding = last.lane.position(max(last.end - DECIDED_BEFORE, last.begin), 0)
    is_planned = bool(route) and route[0][0] == node
    ends = [route[0][1]] if is_planned else list(network.graph.get(node, {}))
    found: list[tuple[float, Piece]] = []
    for end in ends:
        wanted = route[0][2] if is_planned else None
        chosen, distance = network.next_lane_given_next_road(origin, node, number, end, wanted, deciding)
        lane = network.get_lane((node, end, chosen))
        begin = min(max(float(lane.local_coordinates(point)[0]), 0.0), float(lane.length))
        piece = Piece((node, end, chosen), lane, begin, float(lane.length))
        if piece.end - piece.begin > STEP and is_drivable(last, piece):
            found.append((float(distance), piece))
    return min(found, key=lambda each: each[0])[1] if found else None


def is_dead_end(network: Any, last: Piece) -> bool:
    """Return whether a lane ends where the road goes on in others, such as next to it."""
    return bool(network.graph.get(last.index[1])) and _successor(network, last, ()) is None


def _predecessor(network: Any, piece: Piece) -> Piece | None:
    """Return the nearest piece that leads to a piece; highway-env's networks do not store predecessors."""
    point = np.asarray(piece.lane.position(0, 0))
    lanes = network.lanes_dict().items()
    leading = (Piece(index, lane, 0.0, float(lane.length)) for index, lane in lanes if index[1] == piece.index[0])
    found = [each for each in leading if each.end > STEP and is_drivable(each, piece)]
    return min(found, key=lambda each: np.linalg.norm(each.lane.position(each.end, 0) - point), default=None)


def is_drivable(last: Piece, piece: Piece) -> bool:
    """Return whether a vehicle can drive from the end of one piece to the beginning of the next.

    It cannot if the next lane is beside the end, as where a ramp's lane ends: a vehicle changes lanes before.
    """
    step = np.asarray(piece.lane.position(piece.begin, 0)) - np.asarray(last.lane.position(last.end, 0))
    heading = float(last.lane.heading_at(last.end))
    turn = wrapped(float(piece.lane.heading_at(piece.begin)) - heading)
    sideways = abs(step[1] * math.cos(heading + turn / 2) - step[0] * math.sin(heading + turn / 2))
    is_beside = sideways > 0.6 * float(last.lane.width_at(last.end))
    return float(np.hypot(*step)) <= WIDEST_GAP and abs(turn) <= SHARPEST_BEND and not is_beside


def line_of(pieces: Sequence[Piece]) -> Line:
    """Join the centre lines of the pieces to one line, with gaps and bends between them rounded off."""
    points, owners = _spaced(*_sampled(pieces))
    joints = []
    for joint in (np.flatnonzero(np.diff(owners)) + 1).tolist():
        near = points[max(joint - 4, 0) : joint + 6]
        heading = np.unwrap(np.arctan2(*np.diff(near, axis=0).T[::-1]))
        if len(heading) > 1 and np.abs(np.diff(heading)).max() > ROUGH:
            joints.append(joint)
    if joints:
        points, owners = _spaced(_rounded(points, joints), owners)
    dx, dy = np.gradient(points[:, 0]), np.gradient(points[:, 1])
    return Line(x=points[:, 0], y=points[:, 1], heading=np.unwrap(np.arctan2(dy, dx)), piece=owners)


def _sampled(pieces: Sequence[Piece]) -> tuple[FloatArray, FloatArray]:
    rows: list[tuple[float, float]] = []
    owners: list[int] = []
    for number, piece in enumerate(pieces):
        count = max(2, math.ceil((piece.end - piece.begin) / STEP) + 1)
        for longitudinal in np.linspace(piece.begin, piece.end, count).tolist():
            x, y = map(float, piece.lane.position(longitudinal, 0))
            if rows and math.dist((x, y), rows[-1]) < STEP / 10:  # the last piece ends where this one begins
                owners[-1] = number
            else:
                rows.append((x, y))
                owners.append(number)
    return np.array(rows), np.array(owners)


def _spaced(points: FloatArray, owners: Any) -> tuple[FloatArray, Any]:
    """Resample a line at equal distances, and return its points and the piece of each."""
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    places = np.arange(0.0, length[-1] + STEP / 2, STEP)
    spaced = np.stack([np.interp(places, length, points[:, axis]) for axis in (0, 1)], axis=-1)
    return spaced, owners[np.clip(np.searchsorted(length, places - 1e-9), 0, len(owners) - 1)]


def _rounded(points: FloatArray, joints: Sequence[int]) -> FloatArray:
    reach = round(3 * BLEND / STEP)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * STEP / BLEND) ** 2)
    kernel /= kernel.sum()
    ends = points[0] - (points[1] - points[0]) * np.arange(reach, 0, -1)[:, None]
    beyond = points[-1] + (points[-1] - points[-2]) * np.arange(1, reach + 1)[:, None]
    padded = np.concatenate([ends, points, beyond])
    smooth = np.stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in (0, 1)], axis=-1)
    places = np.arange(len(points))
    share = np.zeros(len(points))
    for joint in joints:
        distance = np.abs(places - joint) * STEP
        share = np.maximum(share, np.clip(2 - distance / (2 * BLEND), 0.0, 1.0))
    share = (share * share * (3 - 2 * share))[:, None]
    return points * (1 - share) + smooth * share


def wrapped(angle: Angle) -> Angle:
    """Return an angle or an array of angles wrapped to [-pi, pi) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
