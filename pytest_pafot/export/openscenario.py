"""OpenSCENARIO XML 1.2 or 1.0 with OpenDRIVE: the road, and the trajectory of every vehicle."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
from scenariogeneration import xodr, xosc

from pytest_pafot import Trace
from pytest_pafot.export.exporter import centre_line, name_of, states_of, tangents
from pytest_pafot.findings.finding import Finding
from pytest_pafot.model.trace import HEADING, SPEED, FloatArray, Lane, X, Y

# In the OpenDRIVE file, the lanes of a trace become roads. It has the position of each lane, but no junctions.

NO_DATE = "2000-01-01T00:00:00"  # replaces today's date, so that equal runs give equal files


def road_file(name: str, trace: Trace) -> bytes:
    """Return an OpenDRIVE file with a single road if all lanes are straight and adjacent, or else a road per lane."""
    drive = xodr.OpenDrive(name)
    groups: list[Sequence[Lane]] = [(lane,) for lane in trace.lanes]
    if _are_one(trace.lanes):
        groups = [trace.lanes]
    for number, group in enumerate(groups):
        # The reference line is the centre of the leftmost lane, which is to the right of it like all other lanes.
        plan = xodr.PlanView()
        for geometry, start, heading in _geometries(group[0]):
            plan.add_fixed_geometry(geometry, *start.tolist(), heading)
        section = xodr.LaneSection(0, xodr.standard_lane())
        for lane in group:
            section.add_right_lane(xodr.Lane(lane_type=xodr.LaneType.driving, a=lane.width))
        parts = xodr.Lanes()
        parts.add_laneoffset(xodr.LaneOffset(0, group[0].width / 2))
        parts.add_lanesection(section)
        road = xodr.Road(number, plan, parts)
        speed = max(lane.speed_limit for lane in group)
        road.add_type(xodr.RoadType.motorway, 0, speed=speed, speed_unit="m/s")
        road.add_elevation(0, 0, 0, 0, 0)
        drive.add_road(road)
    element = drive.get_element()
    element.find("header").set("date", NO_DATE)
    return text_of(element)


def _are_one(lanes: Sequence[Lane]) -> bool:
    # True if the lanes are straight, start and end together, and each touches the right edge of the previous one.
    if any(lane.points for lane in lanes):
        return False
    first = lanes[0]
    widths = np.array([lane.width for lane in lanes])
    right = np.cumsum(widths) - widths / 2 - widths[0] / 2
    x = first.x - right * math.sin(first.heading)
    y = first.y + right * math.cos(first.heading)
    for lane, lane_x, lane_y in zip(lanes, x, y, strict=True):
        given = (lane.x, lane.y, lane.heading, lane.length)
        there = (lane_x, lane_y, first.heading, first.length)
        if not np.allclose(given, there, atol=1e-6):
            return False
    return True


def text_of(element: ElementTree.Element) -> bytes:
    """Return the content of an XML file with this root element."""
    ElementTree.indent(element)
    content: bytes = ElementTree.tostring(element, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _geometries(lane: Lane) -> Iterator[tuple[xodr.Line | xodr.ParamPoly3, FloatArray, float]]:
    # The pieces of a lane's centre line, each with its starting point [m] and its initial heading [rad].
    line = centre_line(lane)
    if not lane.points:
        yield xodr.Line(lane.length), line[0], -lane.heading
        return
    # Between two points of a curve, the piece is a cubic with the direction of the line at both points (Hermite).
    directions = tangents(line)
    for (start, end), (first, last) in zip(pairwise(line), pairwise(directions), strict=True):
        chord = end - start
        length = math.hypot(*chord)
        # In the coordinates of the piece, the start is at the origin, and the first direction is ahead.
        sideways = (-first[1], first[0])
        turned = np.array([first, sideways])
        to = turned @ chord
        leaving = np.array([length, 0.0])
        entering = turned @ last * length
        c_x, c_y = 3 * to - 2 * leaving - entering
        d_x, d_y = leaving + entering - 2 * to
        cubic = xodr.ParamPoly3(0, length, c_x, d_x, 0, 0, c_y, d_y)
        yield cubic, start, math.atan2(first[1], first[0])


# Distance of the rear axle behind the centre, as a fraction of the length. OpenSCENARIO uses the axle's position.
REAR_AXLE = 0.3
# The categories of vehicles by the last words of their names. Any other vehicle is a car with its own size.
CATEGORIES = {
    "van": xosc.VehicleCategory.van,
    "truck": xosc.VehicleCategory.truck,
    "motorcycle": xosc.VehicleCategory.motorbike,
}
# Limits of speed [m/s] and acceleration [m/s^2], so high that every trajectory can be followed.
ANY_SPEED = 100.0
ANY_ACCELERATION = 20.0


def export(finding: Finding, trace: Trace, minor: int = 2) -> Mapping[str, bytes]:
    """Return an OpenSCENARIO file of version 1.2, or of the minor version ``minor``, and its OpenDRIVE file."""
    road = f"{finding.id}.xodr"
    entities = xosc.Entities()
    init = xosc.Init()
    act = xosc.Act("replay", _at("begin", 0, minor))
    at_once = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
    for vehicle, (length, width) in enumerate(trace.sizes.tolist()):
        name = name_of(vehicle)
        states = states_of(trace)[:, vehicle]
        positions = _rear_axles(states, length)
        kind = trace.vehicle_type(vehicle).kind
        box = _vehicle(name, length, width, CATEGORIES.get(kind, xosc.VehicleCategory.car))
        # CARLA's scenario_runner, which reads this version, finds the ego by this property
        if minor == 0:
            box.add_property("type", "simulation" if vehicle else "ego_vehicle")
        entities.add_scenario_object(name, box)
        init.add_init_action(name, xosc.TeleportAction(positions[0]))
        init.add_init_action(name, xosc.AbsoluteSpeedAction(states[0, SPEED], at_once))
        if trace.ticks:  # A run that ends at its first decision has no trajectories.
            act.add_maneuver_group(_replay(name, trace.times.tolist(), positions, minor))
    board = xosc.StoryBoard(init, _at("end", trace.duration, minor, "stop"))
    if trace.ticks:
        story = xosc.Story("replay")
        story.add_act(act)
        board.add_story(story)
    scenario = xosc.Scenario(
        finding.id,
        "pytest-pafot",
        xosc.ParameterDeclarations(),
        entities,
        board,
        xosc.RoadNetwork(road),
        xosc.Catalog(),
        osc_minor_version=minor,
        creation_date=datetime.fromisoformat(NO_DATE),
    )
    return {
        f"{finding.id}.xosc": text_of(scenario.get_element()),
        road: road_file(finding.id, trace),
    }


export_1_0 = partial(export, minor=0)
"""Return the files in OpenSCENARIO 1.0, the version that CARLA's scenario_runner requires."""


def _rear_axles(states: FloatArray, length: float) -> list[xosc.WorldPosition]:
    # The middle of a vehicle's rear axle at each tick.
    heading = states[:, HEADING]
    forwards = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    positions = states[:, [X, Y]] - REAR_AXLE * length * forwards
    rows = zip(positions.tolist(), heading.tolist(), strict=True)
    return [xosc.WorldPosition(x, y, 0, angle) for (x, y), angle in rows]


def _vehicle(
    name: str, length: float, width: float, category: xosc.VehicleCategory
) -> xosc.Vehicle:
    box = xosc.BoundingBox(width, length, 1.5, REAR_AXLE * length, 0, 0.75)
    return xosc.Vehicle(
        name,
        category,
        box,
        xosc.Axle(0.5, 0.6, 0.8 * width, 2 * REAR_AXLE * length, 0.3),
        xosc.Axle(0.5, 0.6, 0.8 * width, 0, 0.3),
        ANY_SPEED,
        ANY_ACCELERATION,
        ANY_ACCELERATION,
    )


def _replay(
    name: str, times: list[float], positions: list[xosc.WorldPosition], minor: int
) -> xosc.ManeuverGroup:
    trajectory = xosc.Trajectory(f"{name} drove", False)
    trajectory.add_shape(xosc.Polyline(times, positions))
    follow = xosc.FollowTrajectoryAction(
        trajectory,
        xosc.FollowingMode.position,
        xosc.ReferenceContext.absolute,
        1,
        0,
    )
    priority = xosc.Priority.override if minor >= 2 else xosc.Priority.overwrite
    event = xosc.Event(f"{name} drives", priority)
    event.add_trigger(_at(f"{name} begins", 0, minor))
    event.add_action(f"{name} follows", follow)
    manoeuvre = xosc.Maneuver(f"{name} replays")
    manoeuvre.add_event(event)
    group = xosc.ManeuverGroup(f"{name} acts")
    group.add_actor(name)
    group.add_maneuver(manoeuvre)
    return group


def _at(name: str, seconds: float, minor: int, triggers: str = "start") -> xosc.ValueTrigger:
    # 1.0 has no other rule that stays true
    rule = xosc.Rule.greaterOrEqual if minor else xosc.Rule.greaterThan
    condition = xosc.SimulationTimeCondition(seconds, rule)
    return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, triggeringpoint=triggers)
