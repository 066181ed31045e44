"""OpenSCENARIO XML 1.2 with OpenDRIVE: the road, and every vehicle on the trajectory that it drove."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime

import numpy as np
from scenariogeneration import xosc

from pytest_pafot.export.opendrive import NO_DATE, road_file, text_of
from pytest_pafot.export.scene import name_of, states_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.trace import HEADING, SPEED, FloatArray, Trace, X, Y

MINOR_VERSION = 2
REAR_AXLE = 0.3
"""Behind the centre of a vehicle, by its length. OpenSCENARIO says where that axle is, a trace where the centre is."""
ANY_SPEED, ANY_ACCELERATION = 100.0, 20.0
"""Limits that no vehicle of a trace reaches [m/s], [m/s^2], so that none is held back from its trajectory."""


def export(finding: Finding, trace: Trace) -> Mapping[str, bytes]:
    """The scenario, and the road that it names."""
    road = f"{finding.id}.xodr"
    entities, init = xosc.Entities(), xosc.Init()
    act = xosc.Act("replay", _at("begin", 0))
    for vehicle, size in enumerate(trace.sizes.tolist()):
        name = name_of(vehicle)
        states = states_of(trace)[:, vehicle]
        positions = _rear_axles(states, size[0])
        entities.add_scenario_object(name, _vehicle(name, *size))
        init.add_init_action(name, xosc.TeleportAction(positions[0]))
        init.add_init_action(name, xosc.AbsoluteSpeedAction(states[0, SPEED], _at_once()))
        if trace.ticks:  # A run that ends with its first decision has no trajectories.
            act.add_maneuver_group(_replay(name, trace.times.tolist(), positions))
    board = xosc.StoryBoard(init, _at("end", trace.duration, "stop"))
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
        osc_minor_version=MINOR_VERSION,
        creation_date=datetime.fromisoformat(NO_DATE),
    )
    return {f"{finding.id}.xosc": text_of(scenario.get_element()), road: road_file(finding.id, trace)}


def _rear_axles(states: FloatArray, length: float) -> list[xosc.WorldPosition]:
    """Where the middle of the rear axle of a vehicle is, at each tick."""
    heading = states[:, HEADING]
    back = REAR_AXLE * length * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    places = states[:, [X, Y]] - back
    return [xosc.WorldPosition(x, y, 0, h) for (x, y), h in zip(places.tolist(), heading.tolist(), strict=True)]


def _vehicle(name: str, length: float, width: float) -> xosc.Vehicle:
    box = xosc.BoundingBox(width, length, 1.5, REAR_AXLE * length, 0, 0.75)
    front, rear = (xosc.Axle(0.5, 0.6, 0.8 * width, place, 0.3) for place in (2 * REAR_AXLE * length, 0))
    category = xosc.VehicleCategory.car
    return xosc.Vehicle(name, category, box, front, rear, ANY_SPEED, ANY_ACCELERATION, ANY_ACCELERATION)


def _replay(name: str, times: list[float], positions: list[xosc.WorldPosition]) -> xosc.ManeuverGroup:
    trajectory = xosc.Trajectory(f"{name} drove", False)
    trajectory.add_shape(xosc.Polyline(times, positions))
    follow = xosc.FollowTrajectoryAction(trajectory, xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1, 0)
    event = xosc.Event(f"{name} drives", xosc.Priority.override)
    event.add_trigger(_at(f"{name} begins", 0))
    event.add_action(f"{name} follows", follow)
    manoeuvre = xosc.Maneuver(f"{name} replays")
    manoeuvre.add_event(event)
    group = xosc.ManeuverGroup(f"{name} acts")
    group.add_actor(name)
    group.add_maneuver(manoeuvre)
    return group


def _at(name: str, seconds: float, triggers: str = "start") -> xosc.ValueTrigger:
    condition = xosc.SimulationTimeCondition(seconds, xosc.Rule.greaterOrEqual)
    return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, triggeringpoint=triggers)


def _at_once() -> xosc.TransitionDynamics:
    return xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
