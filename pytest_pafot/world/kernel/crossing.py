"""How NPCs cross: on a way of their own, at a time that the ego's arrival gives, past each other and the ego.

An NPC follows the ego's estimated arrival until some seconds before it enters its zone, and keeps to its plan from then
on, because an NPC that slows down with the ego hides the ego's failures. What it does besides is what a driver does: it
stops for an ego that is in its zone already, follows whoever is ahead in its lane, and waits where another NPC comes.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence

from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.driver import NpcDriver, following_speed, gap_speed, speed_asking_for

STEP = 0.5
"""Distance of the points of a way [m]."""
FREEZE = 3.0
"""How long before it enters its zone an NPC no longer follows the ego's arrival [s]."""
SLOWEST, FASTEST = 0.5, 1.3
"""Shares of its speed between which an NPC follows the ego's arrival. A slower one would wait for an ego that waits."""
PASS, HOLD, STOP, LATE = range(4)
"""What an NPC does at its zone."""
WAITING = 2.0
"""How far before its zone an NPC holds [m]."""
MARGIN = 1.0
"""How far before a stretch an NPC waits until another one, or the ego, has left it [m]."""
SETTING_OFF = 1.1
"""How long a vehicle that holds takes to its zone [s]."""
RESPONSE, ANSWER = 1.0, 6.0
"""How late an NPC answers an ego that has entered its zone [s], and how hard it brakes then at most [m/s^2]."""
BUILDING_UP, BRAKING = 0.4, 5.0
"""The time in which braking builds up [s] and the braking [m/s^2] with which an NPC counts that may have to wait."""
APART = 0.7
"""What two NPCs leave between each other that drive through one place [s]."""
LEAST_SPEED = 0.5
"""With which somebody is expected to go on who nearly stands [m/s]."""
ABREAST = 2.0
"""Who is not farther beside a way is in the way of who drives there [m]."""
NEVER = -1
UNENDING, NOWHERE = math.inf, float("nan")
"""Numbers that are those of C where compiled, which ``math.nan`` is not."""


class Track:
    """A way as it is driven: its points, and what holds at each of them.

    Args:
        x, y, heading: of the points [m, m, rad].
        lean: angle to the way of a vehicle that follows it without error [rad].
        speed: the highest speed of an NPC [m/s].
        sharpest: largest curvature from a point on, as far as a lane change takes [1/m].

    Attributes:
        along, across, direction: what :meth:`locate` has found.
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
        """Itself: highway-env copies vehicles with all that hangs on them to predict them."""
        return self

    def __reduce__(self) -> tuple[object, ...]:
        """Ways travel to other processes with their worlds."""
        x, y, heading, lean = list(self.x), list(self.y), list(self.heading), list(self.lean)
        return Track, (x, y, heading, lean, list(self.speed), list(self.sharpest))

    def point(self, along: float) -> int:
        """The nearest point to a place."""
        return min(max(int(along / STEP + 0.5), 0), self._last)

    def locate(self, x: float, y: float, near: float) -> None:
        """Find how far along and to the right of the way somebody is near a place, and the direction there.

        Beyond its ends the way goes straight on.
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
        """World x [m], y [m] and heading [rad] of a vehicle that follows the way."""
        return (
            self.value(self.x, along),
            self.value(self.y, along),
            self.value(self.heading, along) + self.value(self.lean, along),
        )

    def value(self, values: array[float], along: float) -> float:
        """One of the lists at a place; as at the ends beyond them."""
        index = min(max(int(along / STEP), 0), self._last - 1)
        share = min(max(along / STEP - index, 0.0), 1.0)
        return values[index] + share * (values[index + 1] - values[index])


class SharedPlace:
    """Where the way of an NPC meets that of another one.

    Attributes:
        other: the other one's number among the vehicles.
        begins, ends: the stretch of the own way [m].
        its_begins, its_ends: that of the other's [m].
    """

    def __init__(self, other: int, own: tuple[float, float], its: tuple[float, float]) -> None:
        self.other = other
        self.begins, self.ends = own
        self.its_begins, self.its_ends = its


class LeaderAhead:
    """Who may be ahead of an NPC in its lane.

    Attributes:
        other: its number among the vehicles.
        places: where along the own way it is when it is at each point of its own [m], NaN where that is elsewhere.
    """

    def __init__(self, other: int, places: array[float]) -> None:
        self.other = other
        self.places = places

    def place(self, along: float) -> float:
        """Where along the own way it is when it is at a place of its own [m]; NaN where that is elsewhere."""
        point = int(along / STEP + 0.5)
        return self.places[point] if 0 <= point < len(self.places) else NOWHERE


class CrossingNpc(Body):
    """An NPC on a way of its own: its body has the place along it, the distance to its right and the angle to it.

    Args:
        track: its way.
        speed: of its instruction [m/s].
        speeds: the highest ones with which its way is driven, at each point [m/s].
        zone: where it enters and leaves its zone [m].
        ego_zone: where the ego does, along its own way [m].
        act: what it does in the zone.
        middle: where it stands that stops in its zone [m].

    Attributes:
        index: in the scenario.
        slot: as in its instruction [s].
        begins: where it starts [m].
        asked: the acceleration asked for in the previous tick [m/s^2].
        course: direction of motion that the previous tick's steering gave [rad].
        wanted: the speed of its instruction [m/s].
        speeds, times: with which speed it drives at each point [m/s], and when it is there, from the first one on [s].
        entry: when it is planned to enter its zone [s].
        entered: the tick at which it did so, -1 before.
        stands_at: where it will stand for nobody knows how long [m].
        conflicts, leaders: who may be in its way, and who may be ahead in its lane.
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
    ) -> None:
        super().__init__(size[0], size[1])
        self.index = 0
        self.slot = self.begins = 0.0
        self.track = track
        self.enters, self.leaves = zone
        self.ego_enters, self.ego_leaves = ego_zone
        self.act = act
        self.middle = middle
        self.wanted = speed
        self.speeds = array("d", speeds)
        for point in range(len(speeds)):
            most = gap_speed(max(middle - point * STEP, 0.0)) if act == STOP else speed
            self.speeds[point] = min(self.speeds[point], speed, most)
        self.times = array("d", [0.0]) * len(speeds)
        for point in range(1, len(speeds)):
            driven = max(self.speeds[point] + self.speeds[point - 1], 2e-3)
            self.times[point] = self.times[point - 1] + 2.0 * STEP / driven
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

    def lasts(self, since: float, until: float) -> float:
        """How long it takes from one place to another at its own speed [s]."""
        track = self.track
        return track.value(self.times, until) - track.value(self.times, since)


def stopping_speed(room: float, speed: float) -> float:
    """The speed to want where one is to stop within some room [m], given the own one [m/s]."""
    if room <= 0.0:
        return 0.0
    return min(gap_speed(room), speed_asking_for(speed * speed / (2.0 * room), speed))


def can_stop(room: float, speed: float) -> bool:
    """Whether a speed [m/s] can be given up within some room [m]."""
    return room >= BUILDING_UP * speed + speed * speed / (2.0 * BRAKING)


class Crosser:
    """Drives all NPCs of a run that cross.

    Args:
        npcs: that cross.
        vehicles: of the run, the ego first; each body has its place along its own way.
        driver: pedals and wheel.
        jerk: the limit of theirs [m/s^3].
        ego_lane: across the road, in the measure of lanes [m], where those on the ego's way are in its lane.
        dt: physics tick [s].
    """

    def __init__(
        self,
        npcs: list[CrossingNpc],
        vehicles: list[Body],
        driver: NpcDriver,
        jerk: float,
        ego_lane: float,
        dt: float,
    ) -> None:
        self._npcs = npcs
        self._vehicles = vehicles
        self._driver = driver
        self._jerk = jerk
        self._ego_lane = ego_lane
        self._dt = dt
        self._response = round(RESPONSE / dt)
        self._tick = 0

    def ceiling(self, mine: Body, index: int, conflicts: list[SharedPlace], leaders: list[LeaderAhead]) -> float:
        """The highest speed of an NPC on the grid that leaves those who cross their places [m/s]."""
        return self._following(mine, leaders, self._giving_way(mine, index, conflicts, UNENDING))

    def command(self, ego: Body) -> None:
        """Set acceleration and steering of each NPC that crosses for the coming tick."""
        for npc in self._npcs:
            if npc.x >= npc.enters and npc.entered == NEVER:
                npc.entered = self._tick
            wanted = self._wanted(npc, ego)
            wanted = self._giving_way(npc, npc.index, npc.conflicts, wanted)
            wanted = self._following(npc, npc.leaders, wanted)
            npc.asked = self._driver.acceleration(wanted, npc.asked, npc.speed)
            npc.acceleration = npc.asked
            self._steer(npc)
        self._tick += 1

    def _wanted(self, npc: CrossingNpc, ego: Body) -> float:
        """The speed that an NPC wants for its instruction and the ego [m/s]."""
        track = npc.track
        fastest = track.value(track.speed, npc.x)
        wanted = min(npc.wanted, fastest)
        if npc.entered == NEVER and npc.act in (PASS, STOP):
            gained = max(npc.asked, 0.0) * max(npc.asked, 0.0) / (2.0 * self._jerk)  # while the accelerator is released
            wanted = min(wanted * self._share(npc, ego), fastest - gained)
        npc.stands_at = UNENDING
        if npc.act == STOP:
            npc.stands_at = npc.middle
        elif npc.act != PASS and not npc.is_released and npc.entered == NEVER:
            room = npc.enters - WAITING - npc.x
            has_passed = ego.x > npc.ego_leaves
            is_due = npc.act == LATE and self._due(npc, ego) <= SETTING_OFF
            is_late = self._tick == 0 and room < npc.speed * npc.speed / (2.0 * ANSWER)
            npc.is_released = has_passed or is_due or is_late
            if not npc.is_released:
                npc.stands_at = npc.enters - WAITING
        if npc.stands_at < UNENDING:
            wanted = min(wanted, stopping_speed(npc.stands_at - npc.x, npc.speed))
        if npc.entered == NEVER and self._answers(npc, ego):
            npc.stands_at = min(npc.stands_at, npc.enters - MARGIN)
            safe = stopping_speed(npc.enters - MARGIN - npc.x, npc.speed)
            wanted = min(wanted, max(safe, speed_asking_for(ANSWER, npc.speed)))
        return wanted

    def _share(self, npc: CrossingNpc, ego: Body) -> float:
        """The share of its speed at which an NPC enters its zone when it is to."""
        left = npc.lasts(npc.x, npc.enters)
        return min(max(left / max(self._due(npc, ego), 0.1), SLOWEST), FASTEST)

    def _due(self, npc: CrossingNpc, ego: Body) -> float:
        """In what time an NPC is to enter its zone [s]."""
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
        """Whether an NPC answers an ego that is in its zone and will still be there when it comes."""
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
        """How much slower than its own speed an NPC drives now."""
        return npc.track.value(npc.speeds, npc.x) / max(npc.speed, LEAST_SPEED)

    def _comes(self, vehicle: Body, place: float) -> float:
        """When somebody will be at a place of its way, driving on as it does now [s]."""
        if isinstance(vehicle, CrossingNpc):
            npc = vehicle
            if place > npc.stands_at:
                return UNENDING
            return npc.lasts(npc.x, place) * self._slower(npc)
        return (place - vehicle.x) / max(vehicle.speed, LEAST_SPEED)

    def _giving_way(self, mine: Body, index: int, conflicts: list[SharedPlace], wanted: float) -> float:
        """A wanted speed, cut to what leaves others a place that they come to at the same time [m/s].

        Where both could wait, the one with the higher index does; where one cannot any more, the other.
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
        """Whether somebody on the ego's road drives beside the ego's lane."""
        return not isinstance(vehicle, CrossingNpc) and abs(vehicle.y - self._ego_lane) > ABREAST

    def _following(self, mine: Body, leaders: list[LeaderAhead], wanted: float) -> float:
        """A wanted speed, cut to what leaves room behind whoever is ahead in the own lane [m/s]."""
        for leader in leaders:
            theirs = self._vehicles[leader.other]
            distance = leader.place(theirs.x) - mine.x
            if not distance > 0.0:  # which NaN is not either
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
        npc.steering = self._driver.steering_in_bend(
            npc.y,
            npc.heading,
            npc.course - direction if self._tick else 0.0,
            npc.speed,
            lean,
            turn,
            track.sharpest[track.point(npc.x)],
        )
        npc.course = self._driver.course + direction
