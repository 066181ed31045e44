"""The Frenet planner of PythonRobotics, by Atsushi Sakai and others, behind an adapter.

Kind (a), for ``pafot.Highway``. Needs matplotlib, and the environment variable ``PYTHON_ROBOTICS`` with the folder of a
clone of https://github.com/AtsushiSakai/PythonRobotics (commit b38c510, MIT licence). Nothing in it was changed.

``frenet_optimal_planning`` samples paths, checks them, and chooses one. The adapter sets its constants:

- the course is the middle of the road, with one lateral sample for the centre of each lane. The cost of the distance to
  the course is 0, because it would prefer the lanes in the middle;
- the target speed is the speed limit, and slower speeds down to nearly 0 are samples, too;
- steps are 0.4 s instead of 0.2 s, and the horizon is 4.7 s instead of 5 s, which leaves two durations. Both save time;
- below 3 m/s it uses their mode for low speeds.

The adapter adds:

- points for moving vehicles. The planner knows only points that do not move, so another vehicle is where the ego would
  meet it if the ego kept its speed. Vehicles ahead brake gently, others keep their speed, and a lane change ends in the
  next lane. Vehicles behind in the ego's lane are left out;
- the steering: pure pursuit of the path. The acceleration is the planned one;
- braking without a path: hard, and in the lane of the last path, or in the ego's lane if a vehicle is near in that one.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pytest_pafot import Drive, Observation

from . import import_from_clone, lane_ahead

import_from_clone(
    "PYTHON_ROBOTICS",
    "AtsushiSakai/PythonRobotics",
    "b38c510e083d69a5755d98d0680bd50f3d9a91fa",
    "PathPlanning/FrenetOptimalTrajectory",
)
from FrenetOptimalTrajectory import frenet_optimal_trajectory as theirs  # noqa: E402 - of the clone

theirs.DT, theirs.MAX_T, theirs.MAX_ACCEL, theirs.K_D, theirs.N_S_SAMPLE = 0.4, 4.7, 8.0, 0.0, 5
LOW_SPEED = 3.0
# It moves along with the ego, because the road is straight.
COURSE = theirs.cubic_spline_planner.CubicSpline2D([0.0, 200.0, 400.0, 600.0], [0.0] * 4)
START = 10.0
FAR_POINT = np.array([[-1e3, 0.0]])  # the planner needs at least one

MARGIN_ALONG, MARGIN_ACROSS = 2.0, 0.5
POINT_SPACING: npt.NDArray[np.float64] = np.array([3.0, 0.25])
GENTLE_BRAKING = 2.0
PURSUIT_TIME = 0.8


class FrenetPlanner:
    """A driver that plans again at each decision."""

    def __init__(self, desired_speed: float | None = None) -> None:
        self._desired_speed, self._acceleration = desired_speed, 0.0
        self._lane: int | None = None

    def __call__(self, seen: Observation) -> tuple[float, float] | Drive:
        """Return acceleration [m/s^2] and steering angle [rad], or brake in a lane without a path."""
        self._configure(seen)
        ego, middle = seen.ego, sum(seen.lane_centres) / seen.lanes
        curvature = -math.sin(math.atan(math.tan(seen.steering) / 2)) / (ego.length / 2)
        course_there = (START, START, 0.0, 0.0, 0.0, 0.0)  # distance, x, y, direction, curvature and its change
        state = (START, middle - ego.y, max(ego.speed, 0.1), self._acceleration, -ego.heading, curvature)
        along, across = theirs.CartesianFrenetConverter.cartesian_to_frenet(*course_there, *state)
        points = self._points(seen) * [1, -1] + [START - ego.x, middle]
        path, _ = theirs.frenet_optimal_planning(COURSE, *along, *across, np.vstack([FAR_POINT, points]))
        if path is None:
            self._acceleration = 0.0
            return Drive(lane=self._refuge(seen), acceleration=-theirs.MAX_ACCEL)
        self._lane = int(np.argmin(np.abs(np.array(seen.lane_centres) - middle + path.d[-1])))
        times = path.t[: len(path.a)]
        self._acceleration = float(np.interp(seen.decision_period, times, path.a))
        x = max(float(np.interp(PURSUIT_TIME, times, path.x)) - START, 3.0)
        y = -float(np.interp(x + START, path.x, path.y)) + middle - ego.y
        bend = 2.0 * math.sin(math.atan2(y, x) - ego.heading) / math.hypot(x, y)
        return float(np.interp(seen.decision_period / 2, times, path.a)), math.atan(ego.length * bend)

    def _configure(self, seen: Observation) -> None:
        is_slow = seen.ego.speed < LOW_SPEED
        strategy = theirs.LowSpeedLateralMovementStrategy if is_slow else theirs.HighSpeedLateralMovementStrategy
        theirs.LATERAL_MOVEMENT_STRATEGY = strategy()
        target = self._desired_speed or seen.speed_limit
        theirs.TARGET_SPEED, theirs.MAX_SPEED = target, max(1.1 * target, seen.ego.speed + 1.0)
        theirs.D_T_S = 0.99 * target / theirs.N_S_SAMPLE
        # The planner samples up to the width without including it, so without the last number a lane would be missing.
        theirs.MAX_ROAD_WIDTH, theirs.D_ROAD_W = (seen.lanes - 1) * seen.lane_width / 2 + 1e-6, seen.lane_width
        widest = max((each.width for each in seen.others), default=seen.ego.width)
        theirs.ROBOT_RADIUS = (seen.ego.width + widest) / 2 + MARGIN_ACROSS

    def _refuge(self, seen: Observation) -> int:
        """Return the lane of the last path, or the ego's lane if a vehicle is near in that one."""
        ego = seen.ego
        is_taken = any(
            each.lane == self._lane
            and abs(each.x - ego.x) < each.length + ego.length + MARGIN_ALONG + abs(each.speed - ego.speed)
            for each in seen.others
        )
        return ego.lane if self._lane is None or is_taken else self._lane

    def _points(self, seen: Observation) -> npt.NDArray[np.float64]:
        """Return points along each other vehicle where the ego could meet it, of shape [points, 2]."""
        ego, times, found = seen.ego, np.arange(0.0, theirs.MAX_T, 0.2), [np.empty((0, 2))]
        for other, lateral in zip(seen.others, seen.lateral_velocities[1:], strict=True):
            half = (other.length + ego.length) / 2  # the ego is a point, so the other is longer
            braking = GENTLE_BRAKING if other.x > ego.x else 0.0
            stop = other.speed / braking if braking else math.inf
            moving = np.minimum(times, stop)
            xs = other.x + (other.speed * moving - braking * moving**2 / 2)
            lane = lane_ahead(seen.lane_centres, other.y, lateral)
            target = other.y if lane is None else seen.lane_centres[lane]
            moved = np.minimum(abs(lateral) * times, abs(target - other.y))
            ys = other.y + math.copysign(1.0, target - other.y) * moved
            meets = (np.abs(xs - ego.x - ego.speed * times) < half + MARGIN_ALONG) | (moving == stop)
            if other.x < ego.x - half:
                meets &= np.abs(ys - ego.y) > theirs.ROBOT_RADIUS
            offsets = np.linspace(-half, half, 5)
            found.extend(np.column_stack([xs[meets] + offset, ys[meets]]) for offset in offsets)
        # Points in the same cell count once, because planning time grows with their number.
        return np.unique(np.round(np.vstack(found) / POINT_SPACING), axis=0) * POINT_SPACING


def make(desired_speed: str = "") -> FrenetPlanner:
    """Return a fresh planner; without a desired speed [m/s] it keeps the speed limit."""
    return FrenetPlanner(float(desired_speed) if desired_speed else None)
