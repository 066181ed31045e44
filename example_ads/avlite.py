"""AVLite's local planners and its pure-pursuit controller (``avlite`` on PyPI, MIT licence) behind an adapter.

Kind (a), for ``pafot.Highway``; needs ``pip install avlite==0.6.6``. Nothing in it was changed. ``make`` keeps its lane
with AVLite's planner of speeds. ``overtaking`` drives AVLite's pipeline, a lattice planner followed by that planner.

The adapter translates:

- axes: AVLite's y grows to the left, so y, heading and steering change sign;
- the car: AVLite's car turns about its rear axle at speed * steering / 2.5. The adapter places it at the centre of
  highway-env's bicycle, and steers the bicycle such that it turns as fast;
- the road: the reference path is the centre of the lane in which the ego starts, at the speed limit, on a window of the
  road that does not move.

Of AVLite's settings, the first selects the planner of speeds for the pipeline. The other eight are changed because the
defaults are for 5 m/s. Among other things, the edges of the lattice are longer, and its samples are even instead of
random.
"""

from __future__ import annotations

import logging
import math
from typing import Any

import avlite.c20_planning.c28_local_lattice_planners  # noqa: F401 - registers its planners
import numpy as np
from avlite.c10_perception.c11_perception_model import AgentState, EgoState, PerceptionModel
from avlite.c20_planning.c21_planning_model import GlobalPlan
from avlite.c20_planning.c23_local_planning_strategy import LocalPlanningPipeline
from avlite.c20_planning.c27_local_behavioral_and_velocity_planners import VelocityLocalPlanner
from avlite.c20_planning.c29_settings import PlanningSettings
from avlite.c30_control.c35_pure_pursuit import PurePursuitController
from avlite.c30_control.c39_settings import ControlSettings
from avlite.c50_common.c54_trajectory_tracker import TrajectoryTracker

from pytest_pafot import Observation
from pytest_pafot.world import VehicleState

logging.getLogger("avlite").setLevel(logging.CRITICAL)
PlanningSettings.c23_velocity_strategy = "VelocityLocalPlanner"
PlanningSettings.c28_maneuver_distance = 50
PlanningSettings.c28_sample_distribution = 0
PlanningSettings.c28_sample_size = 7
PlanningSettings.c20_default_ego_velocity = 20.0
PlanningSettings.c27_max_deceleration = 5.0
ControlSettings.c35_lookahead_speed_gain = 1.0
ControlSettings.c32_ego_max_acceleration, ControlSettings.c32_ego_min_acceleration = 3.0, -8.0
SPACING, BEHIND, AHEAD = 2.0, 50.0, 2500.0


class AvLite:
    """A driver with one of AVLite's planners, which it makes at the first observation."""

    def __init__(self, kind: Any) -> None:
        self._kind = kind
        self._planner: Any = None
        self._controller: Any = None
        self._model: Any = None

    def __call__(self, seen: Observation) -> tuple[float, float]:
        """Return acceleration [m/s^2] and steering angle [rad]."""
        ego = EgoState(**_state(seen.ego))
        if self._planner is None:
            self._start(seen, ego)
        self._model.ego_vehicle = ego
        self._model.agent_vehicles = [
            AgentState(**_state(each), agent_id=number + 1) for number, each in zip(seen.ids, seen.others, strict=True)
        ]
        self._planner.step(ego)
        self._planner.replan(self._model)
        command = self._controller.control(ego, self._planner.get_local_plan(), seen.decision_period)
        # The bicycle turns at speed * sin(slip) / 2.5, where the slip is atan(tan(steering) / 2).
        return float(command.acceleration), -math.atan(2 * math.tan(command.steer))

    def _start(self, seen: Observation, ego: Any) -> None:
        x = np.arange(seen.ego.x - BEHIND, seen.ego.x + AHEAD, SPACING)
        y = -seen.lane_centres[seen.ego.lane]
        left, right = seen.lane_width / 2, -(seen.lanes - 0.5) * seen.lane_width
        path, speeds = [(float(each), float(y)) for each in x], [float(seen.speed_limit)] * len(x)
        plan = GlobalPlan(
            start_point=path[0],
            goal_point=path[-1],
            path=path,
            velocity=speeds,
            race_mode=False,
            left_boundary_d=[left - y] * len(x),
            right_boundary_d=[right - y] * len(x),
            left_boundary_x=list(x),
            left_boundary_y=[left] * len(x),
            right_boundary_x=list(x),
            right_boundary_y=[right] * len(x),
            trajectory=TrajectoryTracker(path=path, velocity=speeds),
        )
        self._model = PerceptionModel(ego_vehicle=ego)
        self._planner = self._kind(plan, self._model)
        self._planner.set_global_plan(plan, (ego.x, ego.y))
        self._controller = PurePursuitController()


def _state(car: VehicleState) -> dict[str, float]:
    """Return the fields of AVLite's state of a vehicle."""
    return {
        "x": car.x,
        "y": -car.y,
        "theta": -car.heading,
        "width": car.width,
        "length": car.length,
        "velocity": car.speed,
    }


def make() -> AvLite:
    """Return a driver that keeps its lane."""
    return AvLite(VelocityLocalPlanner)


def overtaking() -> AvLite:
    """Return a driver that also changes lanes."""
    return AvLite(LocalPlanningPipeline)
