"""How an NPC drives, and how a :class:`pytest_pafot.Drive` is steered: cascaded control under hard limits.

The paper moves NPCs "based on a PID controller" (section 2.1) and gives no gains; these are chosen so that a lane
change at motorway speed takes two seconds without overshoot.
"""

from __future__ import annotations

import math

from pytest_pafot.world.limits import NpcLimits

SPEED_GAIN = 1.5
"""Acceleration per speed error [1/s]."""
GAP_GAIN = 0.7
"""Relative speed per distance to the cell's centre [1/s]."""
GAP_BRAKING = 2.5
"""Deceleration by which a far cell is approached, so that it is not overshot [m/s^2]."""
LATERAL_GAIN = 1.4
"""Lateral speed per distance to the lane's centre [1/s]."""
HEADING_GAIN = 5.0
"""Turning rate per heading error [1/s], at most what one tick can hold."""
LATERAL_SHARE = 0.7
"""Share of the lateral acceleration planned for the end of a lane change; the rest is left for control."""
TURNED_SHARE = 0.65
"""Share of the lateral acceleration that may go into speeding up while turned; the rest straightens the vehicle."""
MARGIN = 0.97
"""Share of a lateral limit that is used, so that rounding and changing speed stay inside it."""
FOLLOWING_GAP = 2.0
"""Gap kept behind a standing leader [m]."""
FOLLOWING_TIME = 0.4
"""Time in which braking builds up [s]."""
FOLLOWING_BRAKING = 5.0
"""Braking that an NPC counts on, its leader's and its own [m/s^2]."""
MAX_SLIP = 0.4
"""Largest slip angle, as far as the wheels turn [rad]."""
LEAST_SPARE = 0.15
"""Share of the lateral acceleration that a lane change may take however much a bend takes."""

# Of a Drive, which has a limit of lateral jerk as well. Found by trying: with these numbers no lane is overshot at any
# speed, frequency and limits; larger ones save at most a tenth of the time and overshoot by up to 0.2 m.
LANE_ANGLE = 0.5
"""Largest angle to the lane that a :class:`Drive` steers for [rad], as that of NPCs by default."""
TRACKING_SHARE = 0.4
"""Share of the lateral jerk for coming to the planned lateral speed; the plan's own changes take what is left."""
TRACKING_GAIN = 4.0
"""Lateral acceleration per error of the lateral speed [1/s], at most half of what one tick can hold."""
CLOSEST_GAIN = 3.0
"""Highest planned lateral speed per distance to the lane's centre [1/s]."""
SPEEDING_UP = 6.0
"""Acceleration along the road that a lane change leaves room for: all that an ego has [m/s^2]."""
USEFUL_WIDTH = 2.5
"""A lane change plans with at most the cube root of this times the jerk squared [m]. More acceleration would take so
long to build up that the change became slower; found by trying on lanes of 4 m."""
HALF_TURN = math.pi
"""A number of C's where compiled, which ``math.pi`` is not [rad]."""


def gap_speed(distance: float) -> float:
    """Speed relative to the ego that closes a distance to a cell without overshoot [m/s]."""
    magnitude = min(GAP_GAIN * abs(distance), math.sqrt(2.0 * GAP_BRAKING * abs(distance)))
    return math.copysign(magnitude, distance)


def following_speed(gap: float, leader_speed: float, own_speed: float) -> float:
    """Highest speed that leaves room to stop behind a leader that brakes [m/s].

    Args:
        gap: bumper to bumper [m].
        leader_speed, own_speed: [m/s].
    """
    room = gap - FOLLOWING_GAP - FOLLOWING_TIME * own_speed
    return math.sqrt(max(leader_speed * leader_speed + 2.0 * FOLLOWING_BRAKING * room, 0.0))


def following_gap(speed: float) -> float:
    """Return the gap that an NPC keeps behind a leader of the same speed [m]."""
    return FOLLOWING_GAP + FOLLOWING_TIME * speed


def speed_asking_for(braking: float, speed: float) -> float:
    """Return the wanted speed at which an NPC of a speed brakes so hard [m/s]."""
    return speed - braking / SPEED_GAIN


def stopping_room(top_speed: float) -> float:
    """The gap behind a standing leader from which on :func:`following_speed` allows the top speed [m]."""
    return FOLLOWING_GAP + FOLLOWING_TIME * top_speed + top_speed * top_speed / (2.0 * FOLLOWING_BRAKING)


def clear_to_enter(gap: float, closing_speed: float) -> bool:
    """Whether a lane may be entered in front of or behind another NPC.

    Args:
        gap: bumper to bumper [m]; negative when they overlap.
        closing_speed: of the rear one on the front one [m/s]; negative when they part.
    """
    return gap > closing_room(3.0, closing_speed)


def closing_room(gap: float, closing_speed: float) -> float:
    """Return the gap in which a closing speed is given up without hard braking [m], given the gap at the same speed."""
    closing = max(closing_speed, 0.0)
    return gap + 0.5 * closing + closing * closing / (2.0 * 3.0)


def clamped(value: float, bound: float) -> float:
    """A number cut to [-bound, bound]."""
    return bound if value > bound else -bound if value < -bound else value


class NpcDriver:
    """Pedals and wheel of every NPC of a run.

    Args:
        limits: of every NPC.
        top_speed: [m/s].
        length: of an NPC [m].
        dt: physics tick [s].
        lateral_speed: highest speed across the road [m/s].

    Attributes:
        course: direction of motion that the last steering gives, to the lane [rad].
    """

    def __init__(
        self, limits: NpcLimits, top_speed: float, length: float, dt: float, lateral_speed: float = math.inf
    ) -> None:
        lateral = limits.lateral_acceleration
        self._dt = dt
        self._lateral_speed = lateral_speed
        self._top_speed = top_speed
        self._acceleration = limits.acceleration
        self._braking = limits.braking
        self._jerk_step = limits.jerk * dt
        self._jerk_twice = 2.0 * limits.jerk
        self._half_length = length / 2.0
        self._lateral_limit = MARGIN * lateral
        self._slow = min(0.1, MARGIN * lateral * dt / MAX_SLIP)
        self._tightest = 2.0 * math.sin(MAX_SLIP) / length  # curvature of the tightest turn [1/m]
        self._most = min(limits.heading, TURNED_SHARE * lateral / limits.acceleration)
        self._heading_gain = min(HEADING_GAIN, 0.8 / dt)
        self.course = 0.0

    def acceleration(self, wanted_speed: float, previous: float, speed: float) -> float:
        """The acceleration towards a speed, as near to what is desired as all limits allow [m/s^2].

        The bound for the top speed leaves room to release the accelerator under the limit of jerk: accelerations
        ``a, a - j dt, a - 2 j dt, ...`` add up to at most ``(a + j dt / 2)^2 / (2 j)`` of speed, so the bound holds
        at the next tick again once it holds at one.
        """
        acceleration = SPEED_GAIN * (wanted_speed - speed)
        before = 0.0 if speed <= 0.0 and previous < 0.0 else previous
        lowest, highest = before - self._jerk_step, before + self._jerk_step
        lowest = lowest if lowest > -self._braking else -self._braking  # max and min cost much where interpreted
        acceleration = lowest if acceleration < lowest else acceleration
        acceleration = highest if acceleration > highest else acceleration
        if acceleration > 0.0:
            return self._released(acceleration, speed)
        if speed + acceleration * self._dt < 0.0:
            acceleration = -speed / self._dt
            while speed + acceleration * self._dt < 0.0:  # rounding must not push an NPC backwards
                acceleration = math.nextafter(acceleration, 0.0)
        return acceleration

    def _released(self, acceleration: float, speed: float) -> float:
        """What of an acceleration the own limit and the top speed allow [m/s^2]."""
        release = 0.0
        if speed < self._top_speed:
            release = math.sqrt(self._jerk_twice * (self._top_speed - speed)) - self._jerk_step / 2.0
            release = max(release, 0.0)
        acceleration = min(acceleration, self._acceleration)
        return release if acceleration > release else acceleration

    def steering(self, offset: float, heading: float, course: float, speed: float) -> float:
        """The angle that steers to the centre of a lane [rad], for highway-env's bicycle model.

        Lateral position, then heading, then turning rate; the course (heading plus slip) turns no faster than the
        lateral acceleration allows, and neither does the heading.

        Args:
            offset: from the lane's centre, positive to the right [m].
            heading: to the lane [rad].
            course: direction of motion in the previous tick, to the lane [rad].
            speed: [m/s].
        """
        if -1e-3 < offset < 1e-3 and -1e-5 < heading < 1e-5 and -1e-5 < course < 1e-5:
            self.course = heading
            return 0.0  # as good as straight
        return self.steering_in_bend(offset, heading, course, speed, 0.0, 0.0, 0.0)

    def steering_in_bend(
        self, offset: float, heading: float, course: float, speed: float, lean: float, turn: float, sharpest: float
    ) -> float:
        """The angle that steers to the centre of a lane that turns [rad], for highway-env's bicycle model.

        The heading of a vehicle that keeps its angle to a lane that turns differs from its course by the lean. The
        course is bounded by what that leaves of the largest angle: in a bend the wheel comes back only slowly, with
        what following the lane leaves of the lateral acceleration, and meanwhile the heading goes after the course.

        Args:
            offset, heading, course, speed: as for :meth:`steering`; angles are to the lane's direction here.
            lean: angle to the lane of a vehicle that follows it without error; a car in a bend points inwards less than
                it moves [rad].
            turn: by how much the heading of such a vehicle turns in the coming tick [rad].
            sharpest: largest curvature of the lane from here to where a lane change could end [1/m].
        """
        self.course = heading
        if speed < self._slow:
            return 0.0  # so slow that the wheels may be straightened at once
        distance = abs(offset)
        aside = heading - lean
        spare = self._lateral_limit - sharpest * speed * speed
        planned = spare - self._acceleration * abs(aside)  # speeding up turns it into lateral speed
        planned = LATERAL_SHARE * max(planned, LEAST_SPARE * self._lateral_limit)
        lateral_speed = min(LATERAL_GAIN * distance, math.sqrt(2.0 * planned * distance), self._lateral_speed)
        bound = min(MARGIN * self._most - abs(lean), math.sqrt(2.0 * LATERAL_SHARE * distance * self._tightest))
        bound = max(bound, 0.0)
        wanted = math.asin(lateral_speed / speed) if lateral_speed < speed else bound
        wanted = math.copysign(min(wanted, bound), -offset)
        fastest = self._lateral_limit / speed
        rate = clamped(turn / self._dt + self._heading_gain * (wanted - aside), fastest)
        slip = math.asin(clamped(rate * self._half_length / speed, MAX_SLIP))
        most = max(self._most - abs(lean), 0.0)
        if self._lateral_speed < speed:  # who speeds up must straighten, or the same angle is more speed across
            most = min(most, math.asin(self._lateral_speed / speed))
        new_course = clamped(heading + slip, most)
        new_course = course + clamped(new_course - course, fastest * self._dt)
        slip = clamped(new_course - heading, MAX_SLIP)
        self.course = heading + slip
        return math.atan(2.0 * math.tan(slip))


class LaneTracker:
    """Steers a car along lanes and from one to another, under limits of lateral acceleration and jerk.

    It plans the lateral speed from which the car can still stop at the lane's centre, and turns the course (heading
    plus slip) towards it. The heading goes after the course as a bicycle's does, which changes no faster.

    Args:
        length: of the car [m].
        dt: physics tick [s].
    """

    def __init__(self, length: float, dt: float) -> None:
        self._dt = dt
        self._half_length = length / 2.0
        self._tightest = 2.0 * math.sin(MAX_SLIP) / length  # curvature of the tightest turn [1/m]
        self._gain = min(TRACKING_GAIN, 0.5 / dt)
        self._course = self._acceleration = self._angle = 0.0

    def begin(self, heading: float, angle: float, speed: float, most: float) -> None:
        """Take over from another, who held an angle in the last tick [rad, rad, m/s], with at most so much [m/s^2]."""
        slip = math.atan(0.5 * math.tan(angle))
        rate = speed * math.sin(slip) / self._half_length
        self._course = heading + slip - rate * self._dt
        self._acceleration = clamped(speed * rate, most)  # a sharper turn is given up at once: it led off the road
        self._angle = angle

    def steering(self, offset: float, heading: float, speed: float, most: float, jerk: float) -> float:
        """Return the angle for the coming tick [rad], for highway-env's bicycle model.

        Args:
            offset: from the lane's centre, positive to the right [m].
            heading: to the lane [rad].
            speed: [m/s].
            most, jerk: limits of lateral acceleration [m/s^2] and jerk [m/s^3].
        """
        if speed < 0.01:
            self._acceleration = 0.0
            return self._angle  # it stands; the wheels do not turn
        turning = self._tightest * speed * speed
        # The heading goes after the course within half the car's length. Speeding up there makes its turn sharper.
        share = speed * speed / (speed * speed + 2.0 * SPEEDING_UP * self._half_length)
        limit, step = MARGIN * min(share * most, turning), MARGIN * jerk
        planned = LATERAL_SHARE * min(limit, math.cbrt(step * step * USEFUL_WIDTH))
        # The way to stop from a lateral speed v is v^2 / 2a, and what building up the braking a takes, v a / 2j.
        ramp = max(planned * planned / (2.0 * LATERAL_SHARE * step), planned / CLOSEST_GAIN)
        lateral_speed = math.sqrt(ramp * ramp + 2.0 * planned * abs(offset)) - ramp
        slope = planned / (lateral_speed + ramp)
        if lateral_speed > speed * math.sin(LANE_ANGLE):
            lateral_speed, slope = speed * math.sin(LANE_ANGLE), 0.0
        missing = speed * _turn(math.asin(math.copysign(lateral_speed, -offset) / speed) - self._course)
        wanted = self._towards(missing, TRACKING_SHARE * step) - slope * speed * math.sin(self._course)
        change = clamped(clamped(wanted, limit) - self._acceleration, step * self._dt)
        self._acceleration = clamped(self._acceleration + change, turning)
        self._course += self._acceleration / speed * self._dt
        # In a tick in which the heading would come farther than the course, it is brought just there.
        reach = max(speed * self._dt / self._half_length, 1.0)
        slip = clamped(_turn(self._course - heading) / reach, MAX_SLIP)
        self._angle = math.atan(2.0 * math.tan(slip))
        return self._angle

    def _towards(self, missing: float, jerk: float) -> float:
        """Return an acceleration that brings a speed that is missing under a limit of jerk, without overshoot."""
        size = abs(missing)
        if size * self._gain * self._gain <= jerk:
            return self._gain * missing
        return math.copysign(math.sqrt(2.0 * jerk * (size - jerk / (2.0 * self._gain * self._gain))), missing)


def _turn(angle: float) -> float:
    """Return the same direction as an angle from -pi to pi [rad]."""
    return (angle + HALF_TURN) % (2.0 * HALF_TURN) - HALF_TURN
