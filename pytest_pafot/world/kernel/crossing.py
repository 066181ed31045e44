"""The control of crossing NPCs, which drive on their own ways and are timed by the ego's arrival at their zone.

An NPC adapts its speed to the ego's estimated arrival until some seconds before it enters its own zone. From then on it
keeps to its plan, because an NPC that slows down with the ego would hide the ego's failures. In all other respects it
acts like a driver: it stops for an ego that is already in its zone, follows the vehicle ahead in its lane, and gives
way to other NPCs.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

from pytest_pafot.model.crossings import APART, BEFORE_LINE, STEP
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.driver import NpcDriver, following_speed, gap_speed, speed_asking_for

FREEZE = 3.0
"""The time before its entry into the zone from which an NPC no longer adapts to the ego's arrival [s]."""
SLOWEST, FASTEST = 0.5, 1.3
"""The smallest and largest factor by which an NPC changes its speed to adapt to the ego's arrival. With a smaller
factor, the NPC would wait for an ego that waits."""
PASS, HOLD, STOP, LATE = range(4)
"""The acts of an NPC at its zone, in the order of ``ACTS``."""
MARGIN = 1.0
"""The distance before a stretch at which an NPC waits until the ego or another NPC has left it [m]."""
SETTING_OFF = 1.1
"""The time that a holding vehicle needs to reach its zone [s]."""
RESPONSE, ANSWER = 1.0, 6.0
"""An NPC's reaction time to an ego that has entered the NPC's zone [s], and its hardest braking for that ego [m/s^2].
"""
BUILDING_UP, BRAKING = 0.4, 5.0
"""The time in which braking builds up [s] and the braking [m/s^2] that an NPC assumes when it may have to wait."""
LEAST_SPEED = 0.5
"""The least speed for predictions, because a vehicle that nearly stands may go on [m/s]."""
ABREAST = 2.0
"""The distance from a way up to which a vehicle obstructs vehicles on that way [m]."""
NEVER = -1
UNENDING, NOWHERE = math.inf, float("nan")
"""Infinity and NaN; unlike ``math.inf`` and ``math.nan``, they are C numbers in compiled code."""


class Track:
    """The points of a way, with the values that an NPC needs at each of them.

    Args:
        x, y, heading: position and direction of the points [m, m, rad].
        lean: the angle to the way of a vehicle that follows it exactly [rad].
        speed: the highest speed of an NPC [m/s].
        sharpest: the largest curvature over the length of a lane change from each point [1/m].

    Attributes:
        along, across, direction: the result of :meth:`locate` [m, m, rad].
    """

    def __init__(
        self,
        x: Sequence[float],
        y: Sequence[float],
        heading: Sequence[float],
        lean: Sequence[float],
        speed: Sequence[float],
        sharpest: Sequence[float],
    ) -> None:
        self._last = len(x) - 1
        self.x, self.y, self.heading = array("d", x), array("d", y), array("d", heading)
        self.lean, self.speed, self.sharpest = array("d", lean), array("d", speed), array("d", sharpest)
        self.along = self.across = self.direction = 0.0

    def __deepcopy__(self, _: object) -> Track:
        """Return itself, because highway-env deep-copies vehicles with their ways to predict them, which is slow."""
        return self

    def __reduce__(self) -> tuple[object, ...]:
        """Return the parts for pickling, because worlds send their ways to other processes."""
        x, y, heading, lean = list(self.x), list(self.y), list(self.heading), list(self.lean)
        return Track, (x, y, heading, lean, list(self.speed), list(self.sharpest))

    def point(self, along: float) -> int:
        """Return the index of the point that is nearest to a place."""
        return min(max(int(along / STEP + 0.5), 0), self._last)

    def locate(self, x: float, y: float, near: float) -> None:
        """Find a vehicle on the way, and set ``along``, ``across`` and ``direction``.

        ``near`` is a place close to the vehicle [m]. Beyond its ends, the way goes straight on.
        """
        place = near
        for _ in range(4):
            index = min(max(int(place / STEP), 0), self._last - 1)
            share = place / STEP - index
            inside = min(max(share, 0.0), 1.0)
            direction = self.heading[index] + inside * (self.heading[index + 1] - self.heading[index])
            dx = x - (self.x[index] + share * (self.x[index + 1] - self.x[index]))
            dy = y - (self.y[index] + share * (self.y[index + 1] - self.y[index]))
            cos, sin = math.cos(direction), math.sin(direction)
            ahead = dx * cos + dy * sin
            place += ahead
            self.across = dy * cos - dx * sin
            self.direction = direction
            if -1e-6 < ahead < 1e-6:
                break
        self.along = place

    def pose(self, along: float) -> tuple[float, float, float]:
        """Return world x [m], y [m] and heading [rad] of a vehicle that follows the way."""
        return (
            self.value(self.x, along),
            self.value(self.y, along),
            self.value(self.heading, along) + self.value(self.lean, along),
        )

    def value(self, values: array[float], along: float) -> float:
        """Return the interpolated value of one of the track's arrays at a place; beyond the ends it is constant."""
        index = min(max(int(along / STEP), 0), self._last - 1)
        share = min(max(along / STEP - index, 0.0), 1.0)
        return values[index] + share * (values[index + 1] - values[index])


class SharedPlace:
    """A place at which the way of an NPC meets the way of another NPC.

    Attributes:
        other: the other NPC's number among the vehicles.
        begins, ends: the stretch of the NPC's own way [m].
        its_begins, its_ends: the stretch of the other NPC's way [m].
    """

    def __init__(self, other: int, own: tuple[float, float], its: tuple[float, float]) -> None:
        self.other = other
        self.begins, self.ends = own
        self.its_begins, self.its_ends = its


class LeaderAhead:
    """A vehicle that may be ahead of an NPC in its lane.

    Attributes:
        other: the vehicle's number among the vehicles.
        places: for each point of the vehicle's way, its place along the NPC's way [m]; NaN if it is not on that way.
    """

    def __init__(self, other: int, places: array[float]) -> None:
        self.other = other
        self.places = places

    def place(self, along: float) -> float:
        """Convert the vehicle's place along its own way to the NPC's way [m]; return NaN if it is not on that way."""
        point = int(along / STEP + 0.5)
        return self.places[point] if 0 <= point < len(self.places) else NOWHERE


class CrossingNpc(Body):
    """A crossing NPC; x is its place along its own way, y its distance to the right, heading its angle to the way.

    Args:
        track: its way.
        speed: the speed of its instruction [m/s].
        speeds: the highest speed at each point of its way [m/s].
        zone: the places at which it enters and leaves its zone [m].
        ego_zone: the places at which the ego enters and leaves the zone, along its own way [m].
        act: its act at the zone.
        middle: the place at which it stops if it stops in its zone [m].
        size: its length and width [m].
        driver: its controller of acceleration and steering.

    Attributes:
        index: its index in the scenario.
        slot: the slot of its instruction [s].
        begins: its start along its way [m].
        turning: its largest lateral acceleration at the start [m/s^2].
        asked: the acceleration in the previous tick [m/s^2].
        course: the direction of motion after the previous tick's steering [rad].
        wanted: the speed of its instruction [m/s].
        speeds, times: its speed at each point [m/s], and its time there since the first point [s].
        entry: the planned time of entering its zone [s].
        entered: the tick at which it entered its zone, -1 before it.
        stands_at: the place at which it will stand for an unknown time [m]; infinite if there is none.
        conflicts, leaders: the vehicles that may be in its way, and those that may be ahead in its lane.
    """

    def __init__(
        self,
        track: Track,
        speed: float,
        speeds: Sequence[float],
        zone: tuple[float, float],
        ego_zone: tuple[float, float],
        act: int,
        middle: float,
        size: tuple[float, float],
        driver: NpcDriver,
    ) -> None:
        super().__init__(size[0], size[1])
        self.driver = driver
        self.index = 0
        self.slot = self.begins = self.turning = 0.0
        self.track = track
        self.enters, self.leaves = zone
        self.ego_enters, self.ego_leaves = ego_zone
        self.act = act
        self.middle = middle
        self.wanted = speed
        self.speeds = array("d", speeds)
        self.times = array("d", [0.0]) * len(speeds)
        self._plan()
        self.asked = 0.0
        self.course = 0.0
        self.entry = UNENDING
        self.entered = NEVER
        self.stands_at = UNENDING
        self.is_frozen = False
        self.is_released = False
        self.noticed = 0
        self.conflicts: list[SharedPlace] = []
        self.leaders: list[LeaderAhead] = []

    def _plan(self) -> None:
        """Limit the speeds at all points to those of the instruction, and set the times there."""
        speeds, times = self.speeds, self.times
        for point in range(len(speeds)):
            most = gap_speed(max(self.middle - point * STEP, 0.0)) if self.act == STOP else self.wanted
            speeds[point] = min(speeds[point], self.wanted, most)
            if point > 0:
                times[point] = times[point - 1] + 2.0 * STEP / max(speeds[point] + speeds[point - 1], 2e-3)

    def lasts(self, since: float, until: float) -> float:
        """Return the time that the NPC needs from one place to a later place at its planned speeds [s]."""
        track = self.track
        return track.value(self.times, until) - track.value(self.times, since)


def stopping_speed(room: float, speed: float) -> float:
    """Return the desired speed of a vehicle that is to stop within some room [m], given its current speed [m/s]."""
    if room <= 0.0:
        return 0.0
    return min(gap_speed(room), speed_asking_for(speed * speed / (2.0 * room), speed))


def can_stop(room: float, speed: float) -> bool:
    """Return whether a vehicle at a speed [m/s] can stop within some room [m]."""
    return room >= BUILDING_UP * speed + speed * speed / (2.0 * BRAKING)


class Crosser:
    """The director of all crossing NPCs of a run.

    Args:
        npcs: the crossing NPCs.
        vehicles: all vehicles of the run, the ego first; each body has its place along its own way.
        jerk: the NPCs' limit of jerk [m/s^3].
        ego_lane: the nominal position across the road of the ego's lane [m].
        dt: physics tick [s].
    """

    def __init__(
        self,
        npcs: list[CrossingNpc],
        vehicles: list[Body],
        jerk: float,
        ego_lane: float,
        dt: float,
    ) -> None:
        self._npcs = npcs
        self._vehicles = vehicles
        self._jerk = jerk
        self._ego_lane = ego_lane
        self._dt = dt
        self._response = round(RESPONSE / dt)
        self._tick = 0

    def ceiling(self, mine: Body, index: int, conflicts: list[SharedPlace], leaders: list[LeaderAhead]) -> float:
        """Return the highest speed at which an NPC on the grid does not drive into crossing NPCs [m/s]."""
        return self._following(mine, leaders, self._giving_way(mine, index, conflicts, UNENDING))

    def command(self, ego: Body) -> None:
        """Set acceleration and steering of each crossing NPC for the coming tick."""
        for npc in self._npcs:
            if npc.x >= npc.enters and npc.entered == NEVER:
                npc.entered = self._tick
            wanted = self._wanted(npc, ego)
            wanted = self._giving_way(npc, npc.index, npc.conflicts, wanted)
            wanted = self._following(npc, npc.leaders, wanted)
            npc.asked = npc.driver.acceleration(wanted, npc.asked, npc.speed)
            npc.acceleration = npc.asked
            self._steer(npc)
        self._tick += 1

    def _wanted(self, npc: CrossingNpc, ego: Body) -> float:
        """Return the desired speed of an NPC for its instruction and the ego [m/s]."""
        track = npc.track
        fastest = track.value(track.speed, npc.x)
        wanted = min(npc.wanted, fastest)
        if npc.entered == NEVER and npc.act in (PASS, STOP):
            gained = max(npc.asked, 0.0) * max(npc.asked, 0.0) / (2.0 * self._jerk)  # until the accelerator is released
            wanted = min(wanted * self._share(npc, ego), fastest - gained)
        npc.stands_at = UNENDING
        if npc.act == STOP:
            npc.stands_at = npc.middle
        elif npc.act != PASS and not npc.is_released and npc.entered == NEVER:
            room = npc.enters - BEFORE_LINE - npc.x
            has_passed = ego.x > npc.ego_leaves
            is_due = npc.act == LATE and self._due(npc, ego) <= SETTING_OFF
            is_late = self._tick == 0 and room < npc.speed * npc.speed / (2.0 * ANSWER)
            npc.is_released = has_passed or is_due or is_late
            if not npc.is_released:
                npc.stands_at = npc.enters - BEFORE_LINE
        if npc.stands_at < UNENDING:
            wanted = min(wanted, stopping_speed(npc.stands_at - npc.x, npc.speed))
        if npc.entered == NEVER and self._answers(npc, ego):
            npc.stands_at = min(npc.stands_at, npc.enters - MARGIN)
            safe = stopping_speed(npc.enters - MARGIN - npc.x, npc.speed)
            wanted = min(wanted, max(safe, speed_asking_for(ANSWER, npc.speed)))
        return wanted

    def _share(self, npc: CrossingNpc, ego: Body) -> float:
        """Return the factor by which an NPC changes its speed to enter its zone at the planned time."""
        left = npc.lasts(npc.x, npc.enters)
        return min(max(left / max(self._due(npc, ego), 0.1), SLOWEST), FASTEST)

    def _due(self, npc: CrossingNpc, ego: Body) -> float:
        """Return the time until an NPC is to enter its zone [s]."""
        now = self._tick * self._dt
        if not npc.is_frozen:
            speed = max(ego.speed, 0.1)
            first, last = (npc.ego_enters - ego.x) / speed, (npc.ego_leaves - ego.x) / speed
            crossing = 0.0 if npc.act == STOP else npc.lasts(npc.enters, npc.leaves)
            if npc.slot > 0.0:
                due = last + npc.slot
            else:
                due = first + npc.slot - crossing if npc.slot < 0.0 else (first + last - crossing) / 2.0
            if npc.act != LATE:
                left = npc.lasts(npc.x, npc.enters)
                due = min(max(due, left / FASTEST), left / SLOWEST)
            npc.entry = now + due
            npc.is_frozen = due <= FREEZE
        return npc.entry - now

    def _answers(self, npc: CrossingNpc, ego: Body) -> bool:
        """Return whether an NPC reacts to an ego that is in its zone and will still be there when the NPC arrives."""
        if not npc.ego_enters < ego.x < npc.ego_leaves:
            npc.noticed = 0
            return False
        if npc.noticed == 0:
            stays = (npc.ego_leaves - ego.x) / max(ego.speed, 0.1)
            comes = npc.lasts(npc.x, npc.enters) * self._slower(npc)
            room = npc.enters - npc.x - RESPONSE * npc.speed
            if stays < comes or room < npc.speed * npc.speed / (2.0 * ANSWER):
                return False
        npc.noticed += 1
        return npc.noticed > self._response

    def _slower(self, npc: CrossingNpc) -> float:
        """Return the ratio of an NPC's planned speed at its place to its current speed."""
        return npc.track.value(npc.speeds, npc.x) / max(npc.speed, LEAST_SPEED)

    def _comes(self, vehicle: Body, place: float) -> float:
        """Return the time until a vehicle reaches a place of its way if it drives on as now [s]."""
        if isinstance(vehicle, CrossingNpc):
            npc = vehicle
            if place > npc.stands_at:
                return UNENDING
            return npc.lasts(npc.x, place) * self._slower(npc)
        return (place - vehicle.x) / max(vehicle.speed, LEAST_SPEED)

    def _giving_way(self, mine: Body, index: int, conflicts: list[SharedPlace], wanted: float) -> float:
        """Limit a desired speed so that an NPC gives way at places that others reach at the same time [m/s].

        If both NPCs can wait, the NPC with the higher index does. If one of them can no longer wait, the other waits.
        """
        for conflict in conflicts:
            theirs = self._vehicles[conflict.other]
            if mine.x >= conflict.begins or theirs.x >= conflict.its_ends:
                continue
            if self._is_beside(theirs) or self._is_beside(mine):
                continue
            is_in = theirs.x >= conflict.its_begins
            comes = 0.0 if is_in else self._comes(theirs, conflict.its_begins)
            if comes > self._comes(mine, conflict.ends) + APART:
                continue
            if self._comes(mine, conflict.begins) > self._comes(theirs, conflict.its_ends) + APART:
                continue
            room = conflict.begins - MARGIN - mine.x
            if not is_in:
                can_wait = can_stop(conflict.its_begins - theirs.x, theirs.speed)
                if not can_stop(room + MARGIN, mine.speed) or (can_wait and conflict.other > index + 1):
                    continue
            wanted = min(wanted, stopping_speed(room, mine.speed))
        return wanted

    def _is_beside(self, vehicle: Body) -> bool:
        """Return whether a vehicle on the ego's road is outside the ego's lane."""
        return not isinstance(vehicle, CrossingNpc) and abs(vehicle.y - self._ego_lane) > ABREAST

    def _following(self, mine: Body, leaders: list[LeaderAhead], wanted: float) -> float:
        """Limit a desired speed to what leaves room behind the vehicles ahead in the lane [m/s]."""
        for leader in leaders:
            theirs = self._vehicles[leader.other]
            distance = leader.place(theirs.x) - mine.x
            if not distance > 0.0:  # also false for NaN
                continue
            if self._is_beside(theirs):
                continue
            gap = distance - (mine.length + theirs.length) / 2.0
            wanted = min(wanted, following_speed(gap, theirs.speed, mine.speed))
        return wanted

    def _steer(self, npc: CrossingNpc) -> None:
        track = npc.track
        direction, lean = track.value(track.heading, npc.x), track.value(track.lean, npc.x)
        later = npc.x + npc.speed * self._dt
        turn = track.value(track.heading, later) + track.value(track.lean, later) - direction - lean
        npc.steering = npc.driver.steering_in_bend(
            npc.y,
            npc.heading,
            npc.course - direction if self._tick else 0.0,
            npc.speed,
            lean,
            turn,
            track.sharpest[track.point(npc.x)],
        )
        npc.course = npc.driver.course + direction
