"""The control of crossing NPCs, each of which follows its own path to the zone where it meets the ego's path.

An NPC adapts its speed to the ego's estimated arrival until a few seconds before it enters its zone. The NPC then keeps
to its plan, because an NPC that slowed down with the ego would hide the ego's failures. In other respects, the NPC
behaves like a driver: it stops for an ego that is already in the zone, follows the vehicle ahead in its lane, and gives
way to other NPCs.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from pytest_pafot.model.crossings import APART, BEFORE_LINE, EGOS, STEP, longer
from pytest_pafot.model.instructions import ACTS, Cell, CrossingInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.world.kernel.director import BaseDirector, NetworkDirector, Npc, Start
from pytest_pafot.world.kernel.driver import (
    NpcDriver,
    clear_to_enter,
    following_speed,
    gap_speed,
    speed_for_braking,
)
from pytest_pafot.world.kernel.lanes import Body, Track
from pytest_pafot.world.limits import BEND_SHARE, NpcLimits

# time before entering its zone at which an NPC stops adapting to the ego's arrival [s]
FREEZE = 3.0
# The limits of the factor by which an NPC changes its speed to adapt to the ego's arrival. With a smaller factor, the
# NPC would wait for an ego that itself waits.
SLOWEST = 0.5
FASTEST = 1.3
PASS, HOLD, STOP, LATE = range(4)  # acts of an NPC at its zone, in the order of ACTS
# distance before a conflict at which an NPC waits until the ego or another NPC has passed [m]
MARGIN = 1.0
SETTING_OFF = 1.1  # time that a waiting NPC needs to reach its zone [s]
# reaction time to an ego that has entered the NPC's zone [s], and hardest braking in that reaction [m/s^2]
RESPONSE = 1.0
ANSWER = 6.0
# when an NPC must decide whether it can still stop: the time in which braking builds up [s], and the braking [m/s^2]
BUILDING_UP = 0.4
BRAKING = 5.0
# lowest speed in predictions, because a vehicle that is nearly stationary may continue [m/s]
LEAST_SPEED = 0.5
ABREAST = 2.0  # distance from a path up to which a vehicle obstructs vehicles on that path [m]
NEVER = -1
# unlike math.inf and math.nan, these are C numbers in compiled code
UNENDING = math.inf
NOWHERE = float("nan")


class SharedPlace:
    """A conflict between the paths of two NPCs."""

    def __init__(self, other: int, own: tuple[float, float], its: tuple[float, float]) -> None:
        self.other = other
        self.begins, self.ends = own  # on the NPC's own path [m]
        self.its_begins, self.its_ends = its  # on the other NPC's path [m]


class LeaderAhead:
    """A vehicle that may be ahead of an NPC in the same lane."""

    def __init__(self, other: int, places: array[float]) -> None:
        self.other = other
        # position on the NPC's path of each point of the vehicle's path [m]; NaN if not on it
        self.places = places

    def place(self, along: float) -> float:
        """Convert a position [m] on the vehicle's path to a position on the NPC's path, or to NaN."""
        point = int(along / STEP + 0.5)
        if 0 <= point < len(self.places):
            return self.places[point]
        return NOWHERE


class CrossingNpc(Body):
    """A crossing NPC, with x along its path, y to the right of the path, and a heading relative to the path."""

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
        # slot of the instruction [s], start along the path [m], and largest lateral acceleration at the start [m/s^2]
        self.slot = self.begins = self.turning = 0.0
        self.track = track
        # positions along its path at which it enters and leaves its zone [m]
        self.enters, self.leaves = zone
        # the same for the ego, along the ego's path [m]
        self.ego_enters, self.ego_leaves = ego_zone
        self.act = act
        self.middle = middle  # position at which it stops if its act is STOP [m]
        self.wanted = speed  # speed of the instruction [m/s]
        self.speeds = array("d", speeds)  # planned speed at each point [m/s]
        # planned time from the first point to each point [s]
        self.times = array("d", [0.0]) * len(speeds)
        self._plan()
        self.asked = 0.0  # acceleration in the previous tick [m/s^2]
        self.course = 0.0  # direction of motion after the previous tick's steering [rad]
        self.entry = UNENDING  # planned time of entering its zone [s]
        self.entered = NEVER  # tick at which it entered its zone
        self.stands_at = UNENDING  # position at which it will stop for an unknown time [m]
        self.is_frozen = False  # true when it no longer adapts to the ego's arrival
        self.is_released = False
        self.noticed = 0  # number of ticks for which it has noticed an ego in its zone
        self.conflicts: list[SharedPlace] = []
        self.leaders: list[LeaderAhead] = []

    def _plan(self) -> None:
        speeds = self.speeds
        times = self.times
        for point in range(len(speeds)):
            most = self.wanted
            if self.act == STOP:
                most = gap_speed(max(self.middle - point * STEP, 0.0))
            speeds[point] = min(speeds[point], self.wanted, most)
            if point > 0:
                # from the mean speed over a step, with a lower limit, so that stops take a finite time
                both = max(speeds[point] + speeds[point - 1], 2e-3)
                times[point] = times[point - 1] + 2.0 * STEP / both

    def lasts(self, since: float, until: float) -> float:
        """Return the time [s] from one position to another at the planned speeds."""
        track = self.track
        return track.value(self.times, until) - track.value(self.times, since)


def stopping_speed(room: float, speed: float) -> float:
    """Return the desired speed [m/s] of a vehicle that must stop within a distance [m], given its speed [m/s]."""
    if room <= 0.0:
        return 0.0
    return min(gap_speed(room), speed_for_braking(speed * speed / (2.0 * room), speed))


def can_stop(room: float, speed: float) -> bool:
    """Return whether a vehicle that drives at a speed [m/s] can stop within a distance [m]."""
    return room >= BUILDING_UP * speed + speed * speed / (2.0 * BRAKING)


class JunctionDirector(BaseDirector):
    """The director for a :class:`NetworkRoad` with crossing NPCs.

    ``grid`` is the director of the NPCs around the ego, or None if there are no such NPCs.
    """

    def __init__(
        self,
        scenario: Scenario,
        road: Any,
        junction: Any,
        limits: NpcLimits,
        *,
        grid: NetworkDirector | None,
        physics_hz: float,
    ) -> None:
        self._scenario = scenario
        self._junction = junction
        self._grid = grid
        self._ego_lane = road.ego_lane
        self._ego_across = road.centre(road.ego_lane)  # nominal lateral position [m]
        self._limits = limits
        self._jerk = limits.jerk
        self._top_speed = limits.top_speed(road.speed_limit)
        self._dt = 1 / physics_hz
        self._response = round(RESPONSE / self._dt)
        self._tick = 0
        others = iter(grid.npcs if grid else ())
        npcs: list[Body] = [
            next(others) if each is None else self._npc(index, each)
            for index, each in enumerate(scenario.crossings)
        ]
        super().__init__(npcs)
        self._crossing = [npc for npc in self.npcs if isinstance(npc, CrossingNpc)]
        # `command` replaces the first with the ego
        self._vehicles = [Body(CAR.length, CAR.width), *self.npcs]
        self._relations = [self._related(number) for number in range(len(self._vehicles))]
        for npc in self._crossing:
            npc.conflicts, npc.leaders = self._relations[npc.index + 1]
        self._numbers = [
            number for number, each in enumerate(scenario.crossings, 1) if each is None
        ]
        if grid is not None:
            grid.others = self

    def _npc(self, index: int, instruction: CrossingInstruction) -> CrossingNpc:
        kind = self._scenario.vehicle_of(index)
        way = self._junction.ways[instruction.zone].for_vehicle(kind, self._limits)
        limits = self._limits.for_vehicle(kind)
        zone = way.way.zone
        act = ACTS.index(instruction.act)
        speeds = way.way.speeds.tolist()
        driver = NpcDriver(limits, min(self._top_speed, kind.top_speed), kind.length, self._dt)
        npc = CrossingNpc(
            way.track,
            instruction.speed,
            speeds,
            zone.npc,
            zone.ego,
            act,
            way.middle,
            (kind.length, kind.width),
            driver,
        )
        npc.index = index
        npc.slot = instruction.slot
        npc.turning = BEND_SHARE * limits.lateral_acceleration
        npc.begins = self._junction.crossings.start(instruction)
        return npc

    def _related(self, number: int) -> tuple[list[SharedPlace], list[LeaderAhead]]:
        # The conflicts of a vehicle's path with other paths, and the vehicles that can be ahead in its lane.
        names = [EGOS, *(EGOS if each is None else each.zone for each in self._scenario.crossings)]
        mine = names[number]
        conflicts = []
        leaders = []
        own_excess = self._vehicles[number].length - CAR.length
        for other, theirs in enumerate(names):
            # the director of the grid handles pairs of vehicles on the ego's path
            if other == number or mine == theirs == EGOS:
                continue
            if other > 0:
                excess = self._vehicles[other].length - CAR.length
                for own, its in self._junction.stretches(mine, theirs):
                    conflict = SharedPlace(other, longer(own, own_excess), longer(its, excess))
                    conflicts.append(conflict)
            places = self._junction.places(mine, theirs)
            if places is not None:
                leaders.append(LeaderAhead(other, places))
        return conflicts, leaders

    @property
    def executed(self) -> Scenario:
        if self._grid is None:
            return self._scenario
        chains = iter(self._grid.executed.npcs)
        npcs = tuple(
            next(chains) if each is None else chain
            for each, chain in zip(self._scenario.crossings, self._scenario.npcs, strict=True)
        )
        if npcs == self._scenario.npcs:
            return self._scenario
        return replace(self._scenario, npcs=npcs)

    @property
    def driven_cells(self) -> tuple[tuple[Cell, ...], ...]:
        if self._grid is None:
            return ()
        cells = self._grid.driven_cells
        if not cells:
            return ()
        on_grid = iter(cells)
        return tuple(next(on_grid) if each is None else () for each in self._scenario.crossings)

    @property
    def arrivals(self) -> tuple[tuple[int | None, ...], ...]:
        rows: list[tuple[int | None, ...]] = []
        for npc in self.npcs:
            if isinstance(npc, Npc):
                rows.append(tuple(npc.arrivals))
            elif npc.entered == NEVER:
                rows.append((None,))
            else:
                rows.append((npc.entered,))
        return tuple(rows)

    def first_cells(self) -> tuple[Cell, ...]:
        if self._grid is None:
            return ()
        return self._grid.first_cells()

    def started(self, starts: list[Start]) -> list[Start]:
        on_grid = iter(starts)
        return [
            self._start(npc) if isinstance(npc, CrossingNpc) else next(on_grid) for npc in self.npcs
        ]

    def _start(self, npc: CrossingNpc) -> Start:
        track = npc.track
        along = npc.begins
        # just after a bend, there is still slip
        turn = math.sin(abs(track.value(track.lean, along))) * 2 / npc.length
        fastest = math.sqrt(npc.turning / max(turn, 1e-9))
        speed = min(track.value(npc.speeds, along), fastest, npc.driver.top_speed)
        return along, (*track.pose(along), speed)

    def command(self, ego: Body) -> None:
        self._vehicles[0] = ego
        if self._grid is not None:
            self._grid.command(ego)
        for npc in self._crossing:
            if npc.x >= npc.enters and npc.entered == NEVER:
                npc.entered = self._tick
            wanted = self._desired_speed(npc, ego)
            wanted = self._giving_way(npc, npc.index, npc.conflicts, wanted)
            wanted = self._following(npc, npc.leaders, wanted)
            npc.asked = npc.driver.acceleration(wanted, npc.asked, npc.speed)
            npc.acceleration = npc.asked
            self._steer(npc)
        self._tick += 1

    def ceiling(self, npc: Npc) -> float:
        number = self._numbers[npc.index]
        conflicts, leaders = self._relations[number]
        return self._following(npc, leaders, self._giving_way(npc, number - 1, conflicts, UNENDING))

    def leaves_room(self, npc: Npc, lane: int) -> bool:
        if lane != self._ego_lane:
            return True
        for leader in self._relations[self._numbers[npc.index]][1]:
            theirs = self._vehicles[leader.other]
            along = leader.place(theirs.x)
            if math.isnan(along):
                continue
            closing_speed = theirs.speed - npc.speed
            if along > npc.x:  # it is ahead of the NPC
                closing_speed = npc.speed - theirs.speed
            gap = abs(along - npc.x) - (npc.length + theirs.length) / 2.0
            if not clear_to_enter(gap, closing_speed):
                return False
        return True

    def _desired_speed(self, npc: CrossingNpc, ego: Body) -> float:
        track = npc.track
        fastest = track.value(track.speed, npc.x)
        wanted = min(npc.wanted, fastest)
        if npc.entered == NEVER and npc.act in (PASS, STOP):
            # until the accelerator is released
            gained = max(npc.asked, 0.0) * max(npc.asked, 0.0) / (2.0 * self._jerk)
            wanted = min(wanted * self._speed_factor(npc, ego), fastest - gained)
        npc.stands_at = UNENDING  # set below if the NPC waits
        if npc.act == STOP:
            npc.stands_at = npc.middle
        elif npc.act != PASS and not npc.is_released and npc.entered == NEVER:
            room = npc.enters - BEFORE_LINE - npc.x
            has_passed = ego.x > npc.ego_leaves
            is_due = npc.act == LATE and self._time_to_entry(npc, ego) <= SETTING_OFF
            is_late = self._tick == 0 and room < npc.speed * npc.speed / (2.0 * ANSWER)
            npc.is_released = has_passed or is_due or is_late
            if not npc.is_released:
                npc.stands_at = npc.enters - BEFORE_LINE
        if npc.stands_at < UNENDING:
            wanted = min(wanted, stopping_speed(npc.stands_at - npc.x, npc.speed))
        # Finally, the NPC brakes for an ego that is in the zone and will stay there.
        if npc.entered == NEVER and self._reacts(npc, ego):
            npc.stands_at = min(npc.stands_at, npc.enters - MARGIN)
            safe = stopping_speed(npc.enters - MARGIN - npc.x, npc.speed)
            wanted = min(wanted, max(safe, speed_for_braking(ANSWER, npc.speed)))
        return wanted

    def _speed_factor(self, npc: CrossingNpc, ego: Body) -> float:
        # The factor for an NPC's speed with which the NPC enters its zone at the planned time.
        left = npc.lasts(npc.x, npc.enters)
        return min(max(left / max(self._time_to_entry(npc, ego), 0.1), SLOWEST), FASTEST)

    def _time_to_entry(self, npc: CrossingNpc, ego: Body) -> float:
        # The time [s] after which an NPC should enter its zone.
        now = self._tick * self._dt
        if not npc.is_frozen:
            speed = max(ego.speed, 0.1)
            first = (npc.ego_enters - ego.x) / speed
            last = (npc.ego_leaves - ego.x) / speed
            crossing = 0.0
            if npc.act != STOP:
                crossing = npc.lasts(npc.enters, npc.leaves)
            # A positive slot means after the ego, a negative slot before the ego, and 0 together with the ego.
            if npc.slot > 0.0:
                due = last + npc.slot
            elif npc.slot < 0.0:
                due = first + npc.slot - crossing
            else:
                due = (first + last - crossing) / 2.0
            # limited to a time that the NPC can reach within SLOWEST and FASTEST
            if npc.act != LATE:
                left = npc.lasts(npc.x, npc.enters)
                due = min(max(due, left / FASTEST), left / SLOWEST)
            npc.entry = now + due
            npc.is_frozen = due <= FREEZE
        return npc.entry - now

    def _reacts(self, npc: CrossingNpc, ego: Body) -> bool:
        """Return whether an NPC reacts to an ego that will still be in its zone when the NPC arrives."""
        if not npc.ego_enters < ego.x < npc.ego_leaves:
            npc.noticed = 0
            return False
        # no reaction if the ego leaves in time, or if the NPC can no longer stop
        if npc.noticed == 0:
            stays = (npc.ego_leaves - ego.x) / max(ego.speed, 0.1)
            comes = npc.lasts(npc.x, npc.enters) * self._slowness(npc)
            room = npc.enters - npc.x - RESPONSE * npc.speed
            if stays < comes or room < npc.speed * npc.speed / (2.0 * ANSWER):
                return False
        npc.noticed += 1
        return npc.noticed > self._response

    def _slowness(self, npc: CrossingNpc) -> float:
        return npc.track.value(npc.speeds, npc.x) / max(npc.speed, LEAST_SPEED)

    def _time_to(self, vehicle: Body, place: float) -> float:
        # The time [s] that a vehicle needs to reach a position on its path at its current speed.
        if isinstance(vehicle, CrossingNpc):
            npc = vehicle
            if place > npc.stands_at:
                return UNENDING
            return npc.lasts(npc.x, place) * self._slowness(npc)
        return (place - vehicle.x) / max(vehicle.speed, LEAST_SPEED)

    def _giving_way(
        self,
        mine: Body,
        index: int,
        conflicts: list[SharedPlace],
        wanted: float,
    ) -> float:
        """Limit a desired speed [m/s] so that an NPC gives way if another NPC would reach a conflict at the same time.

        If both NPCs can wait, the one with the higher index waits. If only one of them can wait, that one does.
        """
        for conflict in conflicts:
            theirs = self._vehicles[conflict.other]
            if mine.x >= conflict.begins or theirs.x >= conflict.its_ends:
                continue
            if self._is_beside(theirs) or self._is_beside(mine):
                continue
            is_in = theirs.x >= conflict.its_begins
            comes = 0.0
            if not is_in:
                comes = self._time_to(theirs, conflict.its_begins)
            if comes > self._time_to(mine, conflict.ends) + APART:  # this NPC passes first
                continue
            leaves = self._time_to(theirs, conflict.its_ends)
            if self._time_to(mine, conflict.begins) > leaves + APART:
                continue
            room = conflict.begins - MARGIN - mine.x
            if not is_in:  # an NPC that can no longer stop does not have to give way
                if not can_stop(room + MARGIN, mine.speed):
                    continue
                can_wait = can_stop(conflict.its_begins - theirs.x, theirs.speed)
                if can_wait and conflict.other > index + 1:
                    continue
            wanted = min(wanted, stopping_speed(room, mine.speed))
        return wanted

    def _is_beside(self, vehicle: Body) -> bool:
        return not isinstance(vehicle, CrossingNpc) and abs(vehicle.y - self._ego_across) > ABREAST

    def _following(self, mine: Body, leaders: list[LeaderAhead], wanted: float) -> float:
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
        direction = track.value(track.heading, npc.x)
        lean = track.value(track.lean, npc.x)
        later = npc.x + npc.speed * self._dt
        turn = track.value(track.heading, later) + track.value(track.lean, later) - direction - lean
        course = 0.0
        if self._tick:
            course = npc.course - direction
        npc.steering = npc.driver.steering_in_bend(
            npc.y,
            npc.heading,
            course,
            npc.speed,
            lean,
            turn,
            track.sharpest[track.point(npc.x)],
        )
        npc.course = npc.driver.course + direction
