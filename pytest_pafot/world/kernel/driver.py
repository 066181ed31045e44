"""Cascaded controllers with hard limits, for NPCs and for the steering of a :class:`pytest_pafot.LaneCommand`.

In the paper, NPCs move "based on a PID controller" (section 2.1), but the gains are not stated. With the gains in this
module, a lane change at motorway speed takes two seconds without overshoot.
"""

from __future__ import annotations

import math

from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.world.limits import NpcLimits

SPEED_GAIN = 1.5  # acceleration per unit of speed error [1/s]
GAP_GAIN = 0.7  # speed relative to the ego, per metre of distance to the cell's centre [1/s]
# planned deceleration relative to the ego on the way to a distant cell, to avoid overshoot [m/s^2]
GAP_BRAKING = 2.5
LATERAL_GAIN = 1.4  # lateral speed per metre of distance to the lane's centre [1/s]
# turning rate per unit of heading error [1/s]; reduced if long ticks would make the control unstable
HEADING_GAIN = 5.0
# proportion of the lateral acceleration that is planned for the end of a lane change; the rest is left for corrections
LATERAL_SHARE = 0.7
# proportion of the lateral acceleration for speeding up at an angle to the lane; the rest straightens the vehicle
TURNED_SHARE = 0.65
# proportion of a lateral limit that the control uses, so that rounding and speed changes cannot exceed the limit
MARGIN = 0.97
FOLLOWING_GAP = 2.0  # gap to a stationary vehicle ahead [m]
FOLLOWING_TIME = 0.4  # time in which braking builds up [s]
FOLLOWING_BRAKING = 5.0  # braking that an NPC assumes for its leader and for itself [m/s^2]
CAR_LENGTH = CAR.length  # [m]; unlike CAR.length, it is a C number in compiled code
MAX_SLIP = 0.4  # largest slip angle, which limits the steering of the wheels [rad]
# proportion of the lateral acceleration that a lane change may always use, even in a sharp bend
LEAST_SPARE = 0.15

# The following numbers are for a LaneCommand, which also limits lateral jerk. They were found by trial: no lane change
# overshoots, regardless of speed, frequency and limits. Larger numbers save at most a tenth of the time, but cause
# overshoot of up to 0.2 m.
LANE_ANGLE = 0.5
"""The largest angle [rad] to the lane during a LaneCommand's lane change, equal to the default limit for NPCs."""
# proportion of the lateral jerk for reaching the planned lateral speed; the rest is for changes of the plan
TRACKING_SHARE = 0.4
# lateral acceleration per unit of lateral speed error [1/s]; at most 0.5 / dt, for stability
TRACKING_GAIN = 4.0
CLOSEST_GAIN = 3.0  # highest planned lateral speed per metre of distance to the lane's centre [1/s]
# assumed acceleration along the road during a lane change, which is an ego's maximum [m/s^2]
SPEEDING_UP = 6.0
# A length that limits the planned lateral acceleration to cbrt(length * jerk^2) [m]. A higher acceleration would take
# so long to build up that the lane change would be slower. The length was found by trial on lanes 4 m wide.
USEFUL_WIDTH = 2.5
HALF_TURN = math.pi  # [rad]; unlike math.pi, it is a C number in compiled code


def gap_speed(distance: float) -> float:
    """Return the speed [m/s] relative to the ego at which an NPC closes the distance to its cell without overshoot."""
    magnitude = min(GAP_GAIN * abs(distance), math.sqrt(2.0 * GAP_BRAKING * abs(distance)))
    return math.copysign(magnitude, distance)


def following_speed(gap: float, leader_speed: float, own_speed: float) -> float:
    """Return the highest speed [m/s] that leaves room to stop behind a braking leader.

    ``gap`` [m] is measured from bumper to bumper.
    """
    room = gap - FOLLOWING_GAP - FOLLOWING_TIME * own_speed
    return math.sqrt(max(leader_speed * leader_speed + 2.0 * FOLLOWING_BRAKING * room, 0.0))


def following_gap(speed: float) -> float:
    """Return the gap [m] that an NPC keeps behind a leader at the same speed."""
    return FOLLOWING_GAP + FOLLOWING_TIME * speed


def speed_for_braking(braking: float, speed: float) -> float:
    """Return the desired speed [m/s] that makes an NPC brake with a given deceleration."""
    return speed - braking / SPEED_GAIN


def stopping_room(top_speed: float) -> float:
    """Return the smallest gap [m] to a stationary leader at which an NPC may drive at its top speed."""
    return (
        FOLLOWING_GAP
        + FOLLOWING_TIME * top_speed
        + top_speed * top_speed / (2.0 * FOLLOWING_BRAKING)
    )


def clear_to_enter(gap: float, closing_speed: float) -> bool:
    """Return whether an NPC may enter a lane in front of or behind another NPC.

    The closing speed [m/s] is the rear NPC's speed minus the front NPC's speed.
    """
    return gap > closing_room(3.0, closing_speed)


def closing_room(gap: float, closing_speed: float) -> float:
    """Return the gap [m] that a vehicle needs to lose a closing speed without hard braking.

    At equal speeds, the result is ``gap``.
    """
    closing = max(closing_speed, 0.0)
    return gap + 0.5 * closing + closing * closing / (2.0 * 3.0)


def clamp(value: float, bound: float) -> float:
    """Limit a number to [-bound, bound]."""
    if value > bound:
        return bound
    if value < -bound:
        return -bound
    return value


class NpcDriver:
    """The controller of an NPC's acceleration and steering.

    ``course`` is the direction of motion [rad], relative to the lane, after the last steering command.
    """

    def __init__(
        self,
        limits: NpcLimits,
        top_speed: float,
        length: float,
        dt: float,
        lateral_speed: float = math.inf,
    ) -> None:
        lateral = limits.lateral_acceleration
        self._dt = dt
        self._lateral_speed = lateral_speed
        self.top_speed = top_speed
        self._acceleration = limits.acceleration
        self._braking = limits.braking
        self._jerk_step = limits.jerk * dt
        self._jerk_twice = 2.0 * limits.jerk
        self._half_length = length / 2.0
        self._lateral_limit = MARGIN * lateral
        self._slow = min(0.1, MARGIN * lateral * dt / MAX_SLIP)
        self._tightest = 2.0 * math.sin(MAX_SLIP) / length  # curvature of the tightest turn [1/m]
        self._most = min(limits.heading, TURNED_SHARE * lateral / limits.acceleration)
        # The angle of a long vehicle is limited so that its ends swing out no farther than the ends of a car.
        self._swing = math.inf
        if length > CAR_LENGTH:
            self._swing = math.asin(math.sin(limits.heading) * CAR_LENGTH / length)
        self._heading_gain = min(HEADING_GAIN, 0.8 / dt)
        self.course = 0.0

    def acceleration(self, wanted_speed: float, previous: float, speed: float) -> float:
        """Return the acceleration [m/s^2] towards a desired speed, within all limits."""
        acceleration = SPEED_GAIN * (wanted_speed - speed)
        before = previous
        if speed <= 0.0:
            before = 0.0
        lowest = before - self._jerk_step
        highest = before + self._jerk_step
        # max() is slower if interpreted
        lowest = lowest if lowest > -self._braking else -self._braking
        acceleration = lowest if acceleration < lowest else acceleration
        acceleration = highest if acceleration > highest else acceleration
        # Near the top speed, the acceleration stays low enough to fall to zero in time within the jerk limit. See
        # _released.
        if acceleration > 0.0:
            return self._released(acceleration, speed)
        if speed + acceleration * self._dt < 0.0:
            acceleration = -speed / self._dt
            while speed + acceleration * self._dt < 0.0:  # rounding must not push an NPC backwards
                # not 0, because a simulator may have reversed it
                acceleration = math.nextafter(acceleration, math.inf)
        return acceleration

    def _released(self, acceleration: float, speed: float) -> float:
        release = 0.0
        # Accelerations a, a - j dt, a - 2 j dt, ... add at most (a + j dt / 2)^2 / (2 j) to the speed. So a limit that
        # is met at one tick can also be met at the next.
        if speed < self.top_speed:
            release = math.sqrt(self._jerk_twice * (self.top_speed - speed)) - self._jerk_step / 2.0
            release = max(release, 0.0)
        acceleration = min(acceleration, self._acceleration)
        if acceleration > release:
            return release
        return acceleration

    def steering(
        self,
        offset: float,
        heading: float,
        course: float,
        speed: float,
    ) -> float:
        """Return the steering angle [rad] towards the centre of a lane, for highway-env's bicycle model.

        ``offset`` is the distance [m] to the right of the lane's centre. ``heading`` [rad] and ``course`` [rad], the
        direction of motion in the previous tick, are relative to the lane.
        """
        if -1e-3 < offset < 1e-3 and -1e-5 < heading < 1e-5 and -1e-5 < course < 1e-5:
            self.course = heading
            return 0.0  # straight enough
        return self.steering_in_bend(offset, heading, course, speed, 0.0, 0.0, 0.0)

    def steering_in_bend(
        self,
        offset: float,
        heading: float,
        course: float,
        speed: float,
        lean: float,
        turn: float,
        sharpest: float,
    ) -> float:
        """Return the steering angle [rad] towards the centre of a curved lane.

        Args:
            offset, heading, course, speed: as for :meth:`steering`.
            lean: angle [rad] between the lane and a vehicle that follows the lane exactly.
            turn: heading change [rad] of that vehicle in the coming tick.
            sharpest: largest curvature [1/m] of the lane within the length of a lane change.
        """
        self.course = heading
        if speed < self._slow:
            return 0.0  # slow enough to straighten the wheels immediately
        distance = abs(offset)
        aside = heading - lean
        # Following the lane already uses some lateral acceleration, so steering back takes longer in a bend.
        spare = self._lateral_limit - sharpest * speed * speed
        planned = spare - self._acceleration * abs(aside)  # speeding up also adds lateral speed
        planned = LATERAL_SHARE * max(planned, LEAST_SPARE * self._lateral_limit)
        lateral_speed = min(
            LATERAL_GAIN * distance,
            math.sqrt(2.0 * planned * distance),
            self._lateral_speed,
        )
        # The heading follows the course with a delay and must not exceed its own limit, so the lean reduces the angle.
        bound = min(
            MARGIN * self._most - abs(lean),
            math.sqrt(2.0 * LATERAL_SHARE * distance * self._tightest),
        )
        bound = max(min(bound, self._swing), 0.0)
        wanted = bound
        if lateral_speed < speed:
            wanted = math.asin(lateral_speed / speed)
        wanted = math.copysign(min(wanted, bound), -offset)
        # Neither the heading nor the course may turn faster than this.
        fastest = self._lateral_limit / speed
        rate = clamp(turn / self._dt + self._heading_gain * (wanted - aside), fastest)
        slip = math.asin(clamp(rate * self._half_length / speed, MAX_SLIP))
        most = max(self._most - abs(lean), 0.0)
        if self._lateral_speed < speed:  # at a constant angle, speeding up adds lateral speed
            most = min(most, math.asin(self._lateral_speed / speed))
        new_course = clamp(heading + slip, most)
        new_course = course + clamp(new_course - course, fastest * self._dt)
        slip = clamp(new_course - heading, MAX_SLIP)
        self.course = heading + slip
        return math.atan(2.0 * math.tan(slip))


class LaneTracker:
    """A controller that steers a car along and between lanes, within limits on lateral acceleration and jerk."""

    def __init__(self, length: float, dt: float) -> None:
        self._dt = dt
        self._half_length = length / 2.0
        self._tightest = 2.0 * math.sin(MAX_SLIP) / length  # curvature of the tightest turn [1/m]
        self._gain = min(TRACKING_GAIN, 0.5 / dt)
        self._course = self._acceleration = self._angle = 0.0  # course is heading plus slip

    def begin(
        self,
        heading: float,
        angle: float,
        speed: float,
        most: float,
    ) -> None:
        """Start with a car's heading [rad], steering angle [rad] and speed [m/s], and its lateral limit [m/s^2]."""
        slip = math.atan(0.5 * math.tan(angle))
        rate = speed * math.sin(slip) / self._half_length
        self._course = heading + slip - rate * self._dt
        self._acceleration = clamp(speed * rate, most)  # a sharper turn would lead off the road
        self._angle = angle

    def steering(
        self,
        offset: float,
        heading: float,
        speed: float,
        most: float,
        jerk: float,
    ) -> float:
        """Return the steering angle [rad] for the coming tick, for highway-env's bicycle model.

        ``most`` limits the lateral acceleration [m/s^2], and ``jerk`` limits the lateral jerk [m/s^3].
        """
        if speed < 0.01:
            self._acceleration = 0.0
            return self._angle  # a stationary car does not turn its wheels
        turning = self._tightest * speed * speed
        # The heading follows the course within half the car's length. Speeding up on that distance sharpens the turn.
        share = speed * speed / (speed * speed + 2.0 * SPEEDING_UP * self._half_length)
        limit = MARGIN * min(share * most, turning)
        step = MARGIN * jerk
        # The course turns towards a lateral speed from which the car can still stop at the lane's centre.
        planned = LATERAL_SHARE * min(limit, math.cbrt(step * step * USEFUL_WIDTH))
        # The stopping distance from a lateral speed v is v^2 / 2a, plus v a / 2j while the deceleration a builds up.
        ramp = max(planned * planned / (2.0 * LATERAL_SHARE * step), planned / CLOSEST_GAIN)
        lateral_speed = math.sqrt(ramp * ramp + 2.0 * planned * abs(offset)) - ramp
        slope = planned / (lateral_speed + ramp)
        if lateral_speed > speed * math.sin(LANE_ANGLE):
            lateral_speed = speed * math.sin(LANE_ANGLE)
            slope = 0.0
        missing = speed * wrap_angle(
            math.asin(math.copysign(lateral_speed, -offset) / speed) - self._course
        )
        wanted = self._towards(missing, TRACKING_SHARE * step) - slope * speed * math.sin(
            self._course
        )
        change = clamp(clamp(wanted, limit) - self._acceleration, step * self._dt)
        self._acceleration = clamp(self._acceleration + change, turning)
        self._course += self._acceleration / speed * self._dt
        # If the heading would pass the course in this tick, it is turned exactly to the course.
        reach = max(speed * self._dt / self._half_length, 1.0)
        slip = clamp(wrap_angle(self._course - heading) / reach, MAX_SLIP)
        self._angle = math.atan(2.0 * math.tan(slip))
        return self._angle

    def _towards(self, missing: float, jerk: float) -> float:
        size = abs(missing)
        if size * self._gain * self._gain <= jerk:
            return self._gain * missing
        return math.copysign(
            math.sqrt(2.0 * jerk * (size - jerk / (2.0 * self._gain * self._gain))), missing
        )


def wrap_angle(angle: float) -> float:
    """Wrap an angle [rad] to [-pi, pi)."""
    return (angle + HALF_TURN) % (2.0 * HALF_TURN) - HALF_TURN
