"""CommonRoad XML, in which lanes become lanelets and every vehicle becomes an obstacle with a trajectory."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from commonroad.common.file_writer import CommonRoadFileWriter, OverwriteExistingFile
from commonroad.common.util import Interval
from commonroad.geometry.shape import Rectangle
from commonroad.planning.goal import GoalRegion
from commonroad.planning.planning_problem import PlanningProblem, PlanningProblemSet
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork, LaneletType
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Location, Scenario, Tag
from commonroad.scenario.state import CustomState, ExtendedPMState, InitialState
from commonroad.scenario.trajectory import Trajectory

from pytest_pafot import Trace
from pytest_pafot.export.exporter import edges, states_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.model.trace import ACCELERATION, HEADING, SPEED, FloatArray, X, Y

DECIMALS = 9  # with 4, commonroad-io's default, positions would be up to 0.1 mm off
# Ids are unique in a file: the ego has 1, NPC 0 has 2.
PROBLEM = 1000
FIRST_LANELET = 1001
# The types of vehicles by the last words of their names. CommonRoad has none for vans, which become cars.
TYPES = {"truck": ObstacleType.TRUCK, "motorcycle": ObstacleType.MOTORCYCLE}
NO_DATE = b"2000-01-01"  # replaces today's date, so that equal runs give equal files


def export(finding: Finding, trace: Trace) -> Mapping[str, bytes]:
    """Return a CommonRoad file with one time step per tick. The ego must drive from its start to the last tick."""
    scenario = Scenario(trace.dt)
    lanelets = []
    for number, lane in enumerate(trace.lanes, FIRST_LANELET):
        left, right = edges(lane)
        lanelets.append(
            Lanelet(left, (left + right) / 2, right, number, lanelet_type={LaneletType.HIGHWAY})
        )
    scenario.add_objects(LaneletNetwork.create_from_lanelet_list(lanelets))
    states = states_of(trace)
    for vehicle, (length, width) in enumerate(trace.sizes.tolist()):
        shape = Rectangle(length, width)
        first = _first(states[0, vehicle])
        later = enumerate(states[1:, vehicle], 1)
        rest = [ExtendedPMState(time_step=tick, **_plain(state)) for tick, state in later]
        driven = None
        if rest:
            driven = TrajectoryPrediction(Trajectory(1, rest), shape)
        kind = trace.vehicle_type(vehicle).kind
        obstacle = TYPES.get(kind, ObstacleType.CAR)
        scenario.add_objects(DynamicObstacle(vehicle + 1, obstacle, shape, first, driven))
    # The goal of the planning problem is the time of the last tick.
    end = max(trace.ticks, 1)
    goal = GoalRegion([CustomState(time_step=Interval(end, end))])
    problem = PlanningProblem(PROBLEM, _first(states[0, 0]), goal)
    writer = CommonRoadFileWriter(
        scenario,
        PlanningProblemSet([problem]),
        author="pytest-pafot",
        affiliation="",
        source=finding.id,
        tags={Tag.SIMULATED},
        location=Location(),
        decimal_precision=DECIMALS,
    )
    with tempfile.TemporaryDirectory() as folder:  # commonroad-io can write only to paths
        path = Path(folder) / "run.xml"
        writer.write_to_file(str(path), OverwriteExistingFile.ALWAYS)
        content = re.sub(rb' date="[^"]*"', b' date="' + NO_DATE + b'"', path.read_bytes(), count=1)
    return {f"{finding.id}.xml": content}


def _first(state: FloatArray) -> InitialState:
    return InitialState(time_step=0, yaw_rate=0.0, slip_angle=0.0, **_plain(state))


def _plain(state: FloatArray) -> dict[str, object]:
    # The units are m, rad, m/s and m/s^2.
    orientation, velocity, acceleration = state[[HEADING, SPEED, ACCELERATION]].tolist()
    return {
        "position": np.array(state[[X, Y]]),
        "orientation": orientation,
        "velocity": velocity,
        "acceleration": acceleration,
    }
