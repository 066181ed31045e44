"""An adapter for the published planner FISS+ (``fiss-planner`` on PyPI) and its model-predictive controller.

It is for ``pafot.Highway``, and requires ``pip install "pytest-pafot[fiss]"``, which has wheels for Linux and macOS.
FISS+ samples trajectories in lane coordinates, searches them best first, and checks each against the predicted motion
of other vehicles (Sun et al., IROS 2023, doi 10.1109/IROS55552.2023.10341498). The planner was not changed.

The adapter makes these translations:

- Axes: the planner's y is positive to the left, so the signs of y, heading and steering change.
- Vehicle: highway-env's bicycle model turns about its centre, and its wheelbase is the length of the vehicle.
- Map: planning time increases with the map's length, so the planner sees only a section of the road around the ego.
- Traffic: vehicles behind in the same lane are assumed to keep their distance, as in the planner's adapter for CARLA.
  Otherwise, there would be no valid trajectory ahead of a vehicle that tailgates.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from pytest_pafot import Observation

MAP_BEHIND = 100.0
MAP_AHEAD = 500.0
MAP_RENEWED_AHEAD = 250.0
MAP_SPACING = 10.0

PREDICTION_STEP = 0.1
CONTROL_STEP = 0.1
CONTROL_HORIZON = 15

MAX_DECELERATION = 8.0
MAX_STEERING = 0.4
MAX_STEERING_RATE = 2.0


class FissPlanner:
    """FISS+ and its controller, both called once per decision."""

    def __init__(self) -> None:
        import fiss_planner  # noqa: PLC0415 - the extra `fiss`

        self._fiss: Any = fiss_planner
        self._planner: Any = None
        self._controller: Any = None
        self._map: Any = None
        self._map_end = -math.inf
        self._action = (0.0, 0.0)

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Return the acceleration [m/s^2] and the steering angle [rad]."""
        if self._planner is None:
            self._start(observation)
        if observation.ego.x + MAP_RENEWED_AHEAD > self._map_end:
            self._move_map(observation)
        ego = self._ego_state(observation)
        plan = self._planner.step(
            observation.time, ego, self._obstacles(observation), observation.speed_limit
        )
        command = self._controller.compute(ego, plan.trajectory, 0.0)
        self._action = (float(command.accel), -float(command.steer))
        return self._action

    def _start(self, observation: Observation) -> None:
        vehicle = self._fiss.VehicleParams()
        vehicle.length, vehicle.width = observation.ego.length, observation.ego.width
        vehicle.wheelbase, vehicle.rear_axle_to_center = vehicle.length, vehicle.length / 2
        vehicle.max_speed = 1.2 * observation.speed_limit
        vehicle.max_decel = MAX_DECELERATION
        vehicle.max_steer, vehicle.max_steer_rate = MAX_STEERING, MAX_STEERING_RATE
        config = self._fiss.LocalPlannerConfig()
        config.planner.collision.ignore_rear_in_lane = True
        control = self._fiss.MpcConfig()
        control.dt, control.horizon = CONTROL_STEP, CONTROL_HORIZON
        self._planner = self._fiss.LocalPlanner(config, vehicle)
        self._controller = self._fiss.MpcController(vehicle, control)

    def _move_map(self, observation: Observation) -> None:
        start = observation.ego.x - MAP_BEHIND
        xs = start + np.arange(0.0, MAP_BEHIND + MAP_AHEAD + MAP_SPACING, MAP_SPACING)
        self._map = self._fiss.RoadMap()
        for lane in range(observation.lanes):
            self._map.add_lane(self._lane(lane, observation, xs))
        self._map.finalize()
        self._map_end = float(xs[-1])
        self._planner.set_map(self._map)

    def _lane(self, number: int, observation: Observation, xs: npt.NDArray[np.float64]) -> Any:
        """Return one lane of the map. Ids start at 1 at the left, because 0 and negative ids mean no lane."""
        centre, half = -number * observation.lane_width, observation.lane_width / 2
        lane = self._fiss.MapLane()
        lane.id = number + 1
        lane.centerline = np.column_stack([xs, np.full_like(xs, centre)])
        lane.left = np.column_stack([xs, np.full_like(xs, centre + half)])
        lane.right = np.column_stack([xs, np.full_like(xs, centre - half)])
        lane.speed_limit = observation.speed_limit
        if number > 0:
            lane.left_neighbor, lane.can_change_left = number, True
        if number < observation.lanes - 1:
            lane.right_neighbor, lane.can_change_right = number + 2, True
        return lane

    def _ego_state(self, observation: Observation) -> Any:
        ego = observation.ego
        acceleration, steering = self._action
        # The curvature at the centre of the bicycle model, for the slip angle atan(tan(steering) / 2).
        curvature = -math.sin(math.atan(math.tan(steering) / 2)) / (ego.length / 2)
        return self._fiss.EgoState(ego.x, -ego.y, -ego.heading, ego.speed, acceleration, curvature)

    def _obstacles(self, observation: Observation) -> list[Any]:
        horizon = self._planner.config.planner.sampling.max_t + 0.5
        return [
            self._fiss.predict_lane_following(
                self._map,
                number,
                other.x,
                -other.y,
                -other.heading,
                other.speed,
                other.length,
                other.width,
                horizon,
                PREDICTION_STEP,
            )
            for number, other in enumerate(observation.others)
        ]


def make() -> FissPlanner:
    """Return a new planner without any state."""
    return FissPlanner()
