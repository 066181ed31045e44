"""The way of the ego through a road network: which lanes, in which order, and the line that they make.

``RoadNetwork`` of highway-env is a graph of lanes with shapes of any kind. The grid needs one line to measure along:
the lane that the ego starts in, what its route (else ``next_lane``) leads to, and the lanes by which it came.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from pytest_pafot.model.trace import FloatArray

LaneIndex = tuple[str, str, int]
"""Of highway-env: the nodes that a road section leads from and to, and the lane's number in it, from the left."""
Angle = TypeVar("Angle", float, FloatArray)

STEP = 0.5
"""Distance of the points of a line [m]."""
WIDEST_GAP = 10.0
"""Between the end of a lane and the beginning of the next [m]; highway-env's roundabouts have gaps of 6 m."""
SHARPEST_BEND = 1.3
"""Between the directions of two lanes where they meet [rad]; more is no way to drive."""
DECIDED_BEFORE = 2.5
"""How far before the end of a lane highway-env's vehicles choose the next one [m]."""
ROUGH = 0.06
"""Between the directions of neighbouring points of a line [rad]; no vehicle can follow more at a joint of two lanes."""
BLEND = 3.0
"""How far to either side a gap or bend between two lanes is rounded off [m]."""


@dataclass(frozen=True, slots=True)
class Piece:
    """A lane of the way, from a longitudinal coordinate of the lane to another [m]."""

    index: LaneIndex
    lane: Any
    begin: float
    end: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """A line to measure along, a point every 0.5 m.

    Attributes:
        x, y: world coordinates [m], shape [points].
        heading: [rad], without jumps.
        piece: index of the piece that each point belongs to.
    """

    x: FloatArray
    y: FloatArray
    heading: FloatArray
    piece: np.ndarray[Any, np.dtype[np.intp]]


def way(
    network: Any, start: LaneIndex, at: float, planned: Sequence[Any] | None, *, ahead: float, behind: float
) -> tuple[tuple[Piece, ...], int]:
    """The lanes of the ego's way in driving order, and the number of the one that the ego starts in.

    Looked for so far ahead and behind [m] of the longitudinal coordinate at which the ego starts in its lane [m], along
    its route as highway-env has it.
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
    """The piece that the route asks for, else the nearest one that can be driven on to."""
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


def _predecessor(network: Any, piece: Piece) -> Piece | None:
    """The nearest piece that leads to one; highway-env's networks know no predecessors."""
    point = np.asarray(piece.lane.position(0, 0))
    lanes = network.lanes_dict().items()
    leading = (Piece(index, lane, 0.0, float(lane.length)) for index, lane in lanes if index[1] == piece.index[0])
    found = [each for each in leading if each.end > STEP and is_drivable(each, piece)]
    return min(found, key=lambda each: np.linalg.norm(each.lane.position(each.end, 0) - point), default=None)


def is_drivable(last: Piece, piece: Piece) -> bool:
    """Return whether a vehicle can drive from the end of one lane on to the beginning of another."""
    step = np.asarray(piece.lane.position(piece.begin, 0)) - np.asarray(last.lane.position(last.end, 0))
    turn = piece.lane.heading_at(piece.begin) - last.lane.heading_at(last.end)
    return float(np.hypot(*step)) <= WIDEST_GAP and abs(wrapped(float(turn))) <= SHARPEST_BEND


def line_of(pieces: Sequence[Piece]) -> Line:
    """The centre lines of the pieces as one line; gaps and bends between them are rounded off."""
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
    rows: list[FloatArray] = []
    owners: list[int] = []
    for number, piece in enumerate(pieces):
        count = max(2, math.ceil((piece.end - piece.begin) / STEP) + 1)
        for longitudinal in np.linspace(piece.begin, piece.end, count):
            point = np.asarray(piece.lane.position(float(longitudinal), 0), dtype=float)
            if rows and np.hypot(*(point - rows[-1])) < STEP / 10:
                owners[-1] = number
            else:
                rows.append(point)
                owners.append(number)
    return np.array(rows), np.array(owners)


def _spaced(points: FloatArray, owners: Any) -> tuple[FloatArray, Any]:
    """A line with its points moved to equal distances along it, and the piece that each belongs to."""
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
    """An angle or an array of angles in [-pi, pi) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
