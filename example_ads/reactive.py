"""CommonRoad's reactive planner (``commonroad-reactive-planner`` on PyPI) behind an adapter.

Kind (a), for ``pafot.Highway``; needs ``pip install "commonroad-reactive-planner>=2025.1,<2026"``: Linux, and Python
3.9 to 3.11. The planner samples polynomials in the coordinates of a reference path, and takes the cheapest that is
drivable and collides with no prediction (Werling et al., ICRA 2010, doi 10.1109/ROBOT.2010.5509799). Nothing in it was
changed.

The adapter translates:

- axes: the planner's y grows to the left, so y, heading and steering change sign;
- the car: highway-env's bicycle has a wheelbase of the vehicle's length, and the planner's states are those of the
  rear axle;
- the road: the reference path is the centre of the lane in which the ego starts, and plans may end in any lane. The
  road is straight, so the frame moves along with the ego, and a short path is enough;
- the others: the planner takes predictions as given. They keep their speed, and those that move sideways end in the
  middle of the next lane.

Where the planner finds no trajectory, it returns none, and the adapter brakes in the lane.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

import pytest_pafot as pafot

from . import lane_ahead
from .fiss import MAX_DECELERATION, MAX_STEERING, MAX_STEERING_RATE, PREDICTION_STEP

if TYPE_CHECKING:
    from pytest_pafot import Observation

ORIGIN = 100.0
PATH_LENGTH = 600.0
PATH_SPACING = 2.0
BOUNDARY = 1.0

# Half of the default horizon, for planning time, with twice the ratio: the lowest speed that is sampled stays the same.
HORIZON_STEPS = 30
DECELERATION_RATIO = 0.25
# The others are taken to be larger by this on each side, because the car does not follow a plan exactly.
MARGIN_ALONG = 0.5
MARGIN_ACROSS = 0.25
MIN_SPEED = 0.01


class ReactivePlanner:
    """The planner, which plans anew at each decision."""

    def __init__(self, desired_speed: float | None = None) -> None:
        self._desired_speed = desired_speed
        self._planner: Any = None
        self._lane_centre = 0.0
        self._planned = (0.0, 0.0)

    def __call__(self, observation: Observation) -> tuple[float, float] | pafot.Drive:
        """Return acceleration [m/s^2] and steering angle [rad], or brake in the lane without a trajectory."""
        if self._planner is None:
            self._start(observation)
        planner, state = self._planner, self._state(observation)
        planner.reset(
            initial_state_cart=state,
            collision_checker=self._collision_checker(observation),
            coordinate_system=planner.coordinate_system,
        )
        desired = observation.speed_limit if self._desired_speed is None else self._desired_speed
        planner.set_desired_velocity(desired, current_speed=max(state.velocity, MIN_SPEED))
        plan = planner.plan()
        if plan is None:
            self._planned = (-MAX_DECELERATION if state.velocity > MIN_SPEED else 0.0, 0.0)
            return pafot.Drive(lane=observation.ego.lane, acceleration=-MAX_DECELERATION)
        steps = round(observation.decision_period / planner.dt)
        states = plan[0].state_list[: steps + 1]
        self._planned = (states[-1].acceleration, states[-1].steering_angle)
        acceleration = (states[-1].velocity - states[0].velocity) / (steps * planner.dt)
        return float(acceleration), -float(np.mean([each.steering_angle for each in states]))

    def _start(self, observation: Observation) -> None:
        from commonroad.scenario.scenario import Scenario  # noqa: PLC0415 - not a dependency
        from commonroad_clcs.config import CLCSParams  # noqa: PLC0415
        from commonroad_rp import reactive_planner  # noqa: PLC0415
        from commonroad_rp.utility.config import ReactivePlannerConfiguration  # noqa: PLC0415
        from commonroad_rp.utility.utils_coordinate_system import CoordinateSystem  # noqa: PLC0415

        ego, config = observation.ego, ReactivePlannerConfiguration()
        config.vehicle.length, config.vehicle.width = ego.length, ego.width
        config.vehicle.wb_front_axle = config.vehicle.wb_rear_axle = ego.length / 2
        config.vehicle.a_max = MAX_DECELERATION
        config.vehicle.delta_min, config.vehicle.delta_max = -MAX_STEERING, MAX_STEERING
        config.vehicle.v_delta_min, config.vehicle.v_delta_max = -MAX_STEERING_RATE, MAX_STEERING_RATE
        config.vehicle._update_computed_params()
        left, right = observation.lane_centres[0], observation.lane_centres[-1]
        self._lane_centre = -observation.lane_centres[ego.lane]
        config.sampling.d_min, config.sampling.d_max = -right - self._lane_centre, -left - self._lane_centre
        config.planning.time_steps_computation = HORIZON_STEPS
        config.sampling.max_deceleration_ratio = DECELERATION_RATIO
        config.debug.multiproc, config.debug.logging_level = False, "ERROR"
        config.update(scenario=Scenario(config.planning.dt))
        self._planner = reactive_planner.ReactivePlanner(config)
        xs = np.arange(0.0, PATH_LENGTH, PATH_SPACING)
        path = np.column_stack([xs, np.full_like(xs, self._lane_centre)])
        self._planner.set_reference_path(coordinate_system=CoordinateSystem(path, False, CLCSParams()))

    def _state(self, observation: Observation) -> Any:
        """Return the state of the rear axle, with the acceleration and the steering that were planned for now."""
        from commonroad_rp.state import ReactivePlannerState  # noqa: PLC0415

        ego, vehicle = observation.ego, self._planner.vehicle_params
        acceleration, steering = self._planned
        # The bicycle's centre moves with the slip angle atan(tan(steering) / 2), and its rear axle along its heading.
        speed = ego.speed * math.cos(math.atan(math.tan(observation.steering) / 2))
        # The planner takes a state beyond its own bounds for infeasible, and rounding can bring it there.
        highest = vehicle.a_max * min(1.0, vehicle.v_switch / max(speed, MIN_SPEED))
        to_axle = vehicle.wb_rear_axle
        x, y = ORIGIN - to_axle * math.cos(ego.heading), ego.y - to_axle * math.sin(ego.heading)
        return ReactivePlannerState(
            time_step=0,
            position=np.array([x, -y]),
            velocity=speed,
            orientation=-ego.heading,
            acceleration=float(np.clip(acceleration, -0.99 * vehicle.a_max, 0.99 * highest)),
            steering_angle=steering,
            yaw_rate=speed * math.tan(steering) / vehicle.wheelbase,
        )

    def _collision_checker(self, observation: Observation) -> Any:
        import commonroad_dc.pycrcc as shapes  # noqa: PLC0415

        checker = shapes.CollisionChecker()
        right, left = -observation.lane_centres[-1] - observation.lane_width / 2, observation.lane_width / 2
        for middle in (right - BOUNDARY / 2, left + BOUNDARY / 2):
            checker.add_collision_object(shapes.RectOBB(PATH_LENGTH / 2, BOUNDARY / 2, 0.0, PATH_LENGTH / 2, middle))
        lateral_velocities = observation.lateral_velocities[1:]
        for other, lateral in zip(observation.others, lateral_velocities, strict=True):
            half_length, half_width = other.length / 2 + MARGIN_ALONG, other.width / 2 + MARGIN_ACROSS
            lane = lane_ahead(observation.lane_centres, other.y, lateral)
            target = other.y if lane is None else observation.lane_centres[lane]
            x = ORIGIN + other.x - observation.ego.x
            moving = shapes.TimeVariantCollisionObject(0)
            for time in np.arange(self._planner.N + 1) * PREDICTION_STEP:
                moved = min(abs(lateral) * time, abs(target - other.y))
                y = other.y + math.copysign(moved, target - other.y)
                moving.append_obstacle(shapes.RectOBB(half_length, half_width, 0.0, x + other.speed * time, -y))
            checker.add_collision_object(moving)
        return checker


def make(desired_speed: str = "") -> ReactivePlanner:
    """Return a fresh planner; without a desired speed [m/s] it keeps the speed limit."""
    return ReactivePlanner(float(desired_speed) if desired_speed else None)
