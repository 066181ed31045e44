"""How an NPC drives: cascaded proportional control in road coordinates, under hard limits.

Pure functions of numbers. The paper moves NPCs "based on a PID controller" (section 2.1) and gives no gains;
these are chosen so that a lane change at motorway speed takes two seconds without overshoot.
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


def gap_speed(distance: float) -> float:
    """Speed relative to the ego that closes a distance to a cell without overshoot [m/s]."""
    magnitude = min(GAP_GAIN * abs(distance), math.sqrt(2 * GAP_BRAKING * abs(distance)))
    return math.copysign(magnitude, distance)


def following_speed(gap: float, leader_speed: float, own_speed: float) -> float:
    """Highest speed that leaves room to stop behind a leader that brakes [m/s].

    Args:
        gap: bumper to bumper [m].
        leader_speed, own_speed: [m/s].
    """
    room = gap - FOLLOWING_GAP - FOLLOWING_TIME * own_speed
    return math.sqrt(max(leader_speed**2 + 2 * FOLLOWING_BRAKING * room, 0.0))


def stopping_room(top_speed: float) -> float:
    """The gap behind a standing leader from which on :func:`following_speed` allows the top speed [m]."""
    return FOLLOWING_GAP + FOLLOWING_TIME * top_speed + top_speed**2 / (2 * FOLLOWING_BRAKING)


def limited_acceleration(
    desired: float, previous: float, speed: float, top_speed: float, limits: NpcLimits, dt: float
) -> float:
    """The acceleration nearest to a desired one that all limits allow [m/s^2].

    The bound for the top speed leaves room to release the accelerator under the limit of jerk: accelerations
    ``a, a - j dt, a - 2 j dt, ...`` add up to at most ``(a + j dt / 2)^2 / (2 j)`` of speed, so the bound holds
    at the next tick again once it holds at one.
    """
    step = limits.jerk * dt
    before = 0.0 if speed <= 0 and previous < 0 else previous
    release = math.sqrt(2 * limits.jerk * (top_speed - speed)) - step / 2 if speed < top_speed else 0.0
    highest = min(before + step, limits.acceleration, max(release, 0.0))
    lowest = max(before - step, -limits.braking)
    acceleration = lowest if desired < lowest else desired
    acceleration = min(acceleration, highest)
    if speed + acceleration * dt >= 0:
        return acceleration
    acceleration = -speed / dt
    while speed + acceleration * dt < 0:  # rounding must not push an NPC backwards
        acceleration = math.nextafter(acceleration, 0.0)
    return acceleration


def steering_angle(
    offset: float, heading: float, course: float, speed: float, length: float, limits: NpcLimits, dt: float
) -> tuple[float, float]:
    """Steer to the centre of a lane.

    Lateral position, then heading, then turning rate; the course (heading plus slip) turns no faster than the
    lateral acceleration allows, and neither does the heading.

    Args:
        offset: from the lane's centre, positive to the right [m].
        heading: to the lane [rad].
        course: direction of motion in the previous tick, to the lane [rad].
        speed: [m/s].
        length: of the vehicle [m].
        limits: of the NPC.
        dt: physics tick [s].

    Returns:
        steering angle [rad] and the course that it gives [rad], for highway-env's bicycle model.
    """
    if speed < min(0.1, MARGIN * limits.lateral_acceleration * dt / MAX_SLIP):
        return 0.0, heading  # so slow that the wheels may be straightened at once
    if abs(offset) < 1e-3 and abs(heading) < 1e-5 and abs(course) < 1e-5:
        return 0.0, heading  # as good as straight
    distance = abs(offset)
    lateral_limit = MARGIN * limits.lateral_acceleration
    planned = lateral_limit - limits.acceleration * abs(heading)  # speeding up turns heading into lateral speed
    planned = LATERAL_SHARE * max(planned, 0.3 * lateral_limit)
    lateral_speed = min(LATERAL_GAIN * distance, math.sqrt(2 * planned * distance))
    tightest = 2 * math.sin(MAX_SLIP) / length  # curvature of the tightest turn [1/m]
    most = min(limits.heading, TURNED_SHARE * limits.lateral_acceleration / limits.acceleration)
    bound = min(MARGIN * most, math.sqrt(2 * LATERAL_SHARE * distance * tightest))
    wanted = math.asin(lateral_speed / speed) if lateral_speed < speed else bound
    wanted = math.copysign(min(wanted, bound), -offset)
    turn = lateral_limit / speed
    rate = clamped(min(HEADING_GAIN, 0.8 / dt) * (wanted - heading), turn)
    slip = math.asin(clamped(rate * length / 2 / speed, MAX_SLIP))
    new_course = clamped(heading + slip, most)
    new_course = course + clamped(new_course - course, turn * dt)
    slip = clamped(new_course - heading, MAX_SLIP)
    return math.atan(2 * math.tan(slip)), heading + slip


def clamped(value: float, bound: float) -> float:
    """A number cut to [-bound, bound]."""
    return bound if value > bound else -bound if value < -bound else value


def clear_to_enter(gap: float, closing_speed: float) -> bool:
    """Whether a lane may be entered in front of or behind another NPC.

    Args:
        gap: bumper to bumper [m]; negative when they overlap.
        closing_speed: of the rear one on the front one [m/s]; negative when they part.
    """
    closing = max(closing_speed, 0.0)
    return gap > 3.0 + 0.5 * closing + closing**2 / (2 * 3.0)
