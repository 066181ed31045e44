"""OpenDRIVE: the lanes of a trace as roads, which tell where lanes lie and not how they are joined."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from xml.etree import ElementTree

import numpy as np
from scenariogeneration import xodr

from pytest_pafot.export.scene import centre_line, tangents
from pytest_pafot.trace import FloatArray, Lane, Trace

NO_DATE = "2000-01-01T00:00:00"
"""In the place of today, so that equal runs are equal files."""


def road_file(name: str, trace: Trace) -> bytes:
    """One road where all lanes are straight and lie side by side; else a road for each lane, none joined to another."""
    drive = xodr.OpenDrive(name)
    for number, group in enumerate([trace.lanes] if _are_one(trace.lanes) else [(lane,) for lane in trace.lanes]):
        drive.add_road(_road(number, group))
    element = drive.get_element()
    element.find("header").set("date", NO_DATE)
    return text_of(element)


def _are_one(lanes: Sequence[Lane]) -> bool:
    """Whether lanes are straight, begin and end on one line, and each touches the right edge of the one before."""
    first = lanes[0]
    widths = np.array([lane.width for lane in lanes])
    right = np.cumsum(widths) - widths / 2 - widths[0] / 2
    x, y = first.x - right * math.sin(first.heading), first.y + right * math.cos(first.heading)
    there = np.stack([x, y, np.full(len(lanes), first.heading), np.full(len(lanes), first.length)], axis=-1)
    given = [(lane.x, lane.y, lane.heading, lane.length) for lane in lanes]
    return not any(lane.points for lane in lanes) and np.allclose(given, there, atol=1e-6)


def text_of(element: ElementTree.Element) -> bytes:
    """The file of a tree."""
    ElementTree.indent(element)
    content: bytes = ElementTree.tostring(element, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _road(number: int, lanes: Sequence[Lane]) -> xodr.Road:
    """A road whose reference line is the centre of its leftmost lane, with that and all others to the right of it."""
    plan = xodr.PlanView()
    for geometry, start, heading in _geometries(lanes[0]):
        plan.add_fixed_geometry(geometry, *start.tolist(), heading)
    section = xodr.LaneSection(0, xodr.standard_lane())
    for lane in lanes:
        section.add_right_lane(xodr.Lane(lane_type=xodr.LaneType.driving, a=lane.width))
    parts = xodr.Lanes()
    parts.add_laneoffset(xodr.LaneOffset(0, lanes[0].width / 2))
    parts.add_lanesection(section)
    road = xodr.Road(number, plan, parts)
    limit = max(lane.speed_limit for lane in lanes)
    road.add_type(xodr.RoadType.motorway, 0, speed=limit, speed_unit="m/s")
    road.add_elevation(0, 0, 0, 0, 0)
    return road


def _geometries(lane: Lane) -> Iterator[tuple[xodr.Line | xodr.ParamPoly3, FloatArray, float]]:
    """The centre line of a lane as pieces, each with where it starts [m] and its heading there [rad].

    Between two points of a bend it is the cubic with the line's directions in both (Hermite).
    """
    line = centre_line(lane)
    if not lane.points:
        yield xodr.Line(lane.length), line[0], -lane.heading
        return
    directions = tangents(line)
    for start, end, first, last in zip(line, line[1:], directions, directions[1:], strict=False):
        chord = end - start
        length = math.hypot(*chord)
        # In the frame of the piece: its start at the origin, its first direction ahead.
        turned = np.array([first, (-first[1], first[0])])
        u, v = turned @ chord, turned @ last * length
        to, leaving, entering = u, np.array([length, 0.0]), v
        c, d = 3 * to - 2 * leaving - entering, leaving + entering - 2 * to
        cubic = xodr.ParamPoly3(0, length, c[0], d[0], 0, 0, c[1], d[1])
        yield cubic, start, math.atan2(first[1], first[0])
