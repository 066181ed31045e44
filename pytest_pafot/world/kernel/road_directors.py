"""The directors of NPCs on roads of any shape: on the ego's way, and at junctions on ways of their own."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from pytest_pafot.model.crossings import EGOS, longer
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions import ACTS, CrossingInstruction
from pytest_pafot.model.scenario import Scenario, on_grid
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.world.kernel.bends import Bends
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.crossing import Crosser, CrossingNpc, LeaderAhead, SharedPlace
from pytest_pafot.world.kernel.director import BaseDirector, Director, Npc, Start
from pytest_pafot.world.kernel.driver import NpcDriver, clear_to_enter, following_speed, gap_speed
from pytest_pafot.world.kernel.lanes import Lanes
from pytest_pafot.world.limits import BEND_SHARE, NpcLimits

LOOK_AHEAD = 3.0
"""The driving time [s] for which a lane must continue so that an NPC enters it; an NPC leaves a lane that ends sooner.
"""
HEADING_SHARE = 0.9
"""The share of the largest angle to a lane that an NPC uses towards its target lane. It leaves a reserve, because at
the beginning and end of a bend the lane that it leaves has a slightly different direction."""
CHANGING_SHARE = 0.3
"""The share of its lateral acceleration that an NPC may use to follow a bend while it speeds up in a lane change."""
BETWEEN_LANES = 0.5
"""The distance from the centre of its target lane beyond which an NPC still changes lanes [m]."""


class NetworkDirector(Director):
    """The director of the NPCs of one run on a :class:`NetworkRoad`.

    It differs from the director of a straight road: NPCs enter only a lane that continues, and leave it before it ends.
    Bends and ends ahead limit the speed. Steering follows the lane. An NPC behind the ego without a lane to pass in
    follows it. Steps on the ring skip cells that do not exist. Bodies have their nominal position across the road, and
    their heading relative to the ego's way; an NPC's course is a direction in the world.
    NPCs may start in the ``start_cells``; all other arguments are as for :class:`Director`.

    Attributes:
        others: the director of the NPCs that drive on their own ways; None if there are none.
    """

    def __init__(
        self, scenario: Scenario, road: Any, limits: NpcLimits, *, start_cells: frozenset[Cell], **common: Any
    ) -> None:
        narrower = replace(limits, heading=HEADING_SHARE * limits.heading)
        lanes = Lanes(road.lane_count, road.lane_width, road.end)
        super().__init__(scenario, lanes, narrower, speed_limit=road.speed_limit, cells=(), **common)
        self.skips = True
        self._road: Any = road
        self.others: JunctionDirector | None = None
        self._bends: Bends = road.bends
        self._width_of_lanes: float = road.lane_width
        self._start_cells = start_cells
        self._jerk = limits.jerk
        self._dt = 1 / common["physics_hz"]
        for npc in self.npcs:
            npc.bends = road.bends_of(scenario.vehicle_of(npc.index))
            npc.lateral = npc.limits.lateral_acceleration

    @property
    def executed(self) -> Scenario:
        """The scenario as driven, if chains can express it; else as requested.

        A chain steps only between neighbouring cells and cannot express skipped cells. If cells were skipped, this is
        the requested scenario, which also gives the same run again.
        """
        return self._scenario if self.driven else super().executed

    @property
    def driven(self) -> tuple[tuple[Cell, ...], ...]:
        """The cell that each NPC drove to in each started gene if cells were skipped; else empty."""
        cells = [tuple(npc.executed) for npc in self._on_grid]
        written = super().executed
        is_written = all(
            [gene.cell for gene in chain[: len(row)]] == list(row)
            for chain, row in zip(written.positions, cells, strict=True)
        )
        return () if is_written else tuple(tuple(row) for row in on_grid(self._scenario.npcs, cells))

    def _first_existing(self) -> frozenset[Cell]:
        return self._start_cells

    def _has_lane(self, npc: Npc, lane: int) -> bool:
        return self._bends.exists(lane, npc.x)

    def _existing(self, ego: Body) -> frozenset[Cell]:
        existing: frozenset[Cell] = self._road.cells(
            ego.x, ego.lane, (self._row + self._clearance) / self._stretch(ego)
        )
        return existing

    def _stretch(self, body: Body) -> float:
        """Return how many metres a vehicle drives in its lane per metre of the way."""
        return self._bends.stretch(body.x, self._bends.across_at(body.lane, body.x))

    def _gap(self, front: Npc, rear: Npc) -> float:
        """Return the gap between two NPCs in one lane [m]; in a bend, that on the side on which it is shorter."""
        distance = front.x - rear.x
        distance *= min(self._stretch(front), self._stretch(rear))
        return distance - (front.length + rear.length) / 2.0

    def _control(self, npc: Npc, ego: Body) -> None:
        goal, wanted = self._aim(npc, ego)
        npc.heading_for = goal
        if self._attentive:
            wanted = self._attending(npc, ego, wanted)
        self._move(npc, goal, self._following(npc, wanted))

    def _move(self, npc: Npc, goal: int, wanted: float) -> None:
        """Set the controls of an NPC for a lane and a speed [m/s]; ways of others, bends and ends limit the speed."""
        if self.others is not None:
            wanted = min(wanted, self.others.ceiling(npc))
        asked = max(npc.asked, 0.0)
        gained = asked * asked / (2.0 * self._jerk)  # speed gained while the accelerator is released
        wanted = min(wanted, npc.bends.speed_at(npc.lane, npc.x) - gained)
        wanted = min(wanted, npc.bends.speed_at(goal, npc.x) - gained)
        if abs(npc.y - goal * self._width_of_lanes) > BETWEEN_LANES:  # so that it can turn back if turned outwards
            changing = math.sqrt(CHANGING_SHARE * npc.lateral / max(self._sharpest(npc, goal), 1e-9))
            wanted = min(wanted, max(npc.speed, changing))
        npc.asked = npc.driver.acceleration(wanted, npc.asked, npc.speed)
        npc.acceleration = npc.asked
        self._steer(npc, goal)

    def _sharpest(self, npc: Npc, goal: int) -> float:
        """Return the largest curvature of a lane that an NPC meets during a lane change [1/m]."""
        return self._bends.sharpest_at(goal, npc.x)

    def _aim(self, npc: Npc, ego: Body) -> tuple[int, float]:
        """Return the lane to steer to, and the speed for the instruction [m/s]."""
        target_lane = ego.lane + npc.column
        stretch, ego_stretch = self._stretch(npc), self._stretch(ego)
        along = self._target(npc, ego) if self._attentive else npc.target
        target = ego.x + along / ego_stretch
        distance = (target - npc.x) * stretch
        shift = npc.shift_lane
        if npc.kept_lane < 0 <= shift:
            self._keep_shift_lane_if_there(npc, shift * self._width_of_lanes)
        elif npc.kept_lane < 0:
            exists = self._bends.exists(target_lane, target)
            self._keep_lane_if_due(npc, target_lane if exists else -1, distance)
        if npc.kept_lane >= 0 or shift >= 0:
            return self._next_lane(npc, npc.kept_lane if npc.kept_lane >= 0 else shift, ego), npc.kept_speed
        goal = self._next_lane(npc, target_lane, ego)
        wanted = ego.speed * stretch / ego_stretch + gap_speed(distance)
        if goal != npc.lane:
            wanted = min(wanted, npc.bends.speed_at(goal, npc.x))
        wanted = self._creeping(npc, goal, wanted)
        if npc.lane == goal == ego.lane and npc.x < ego.x < target:
            gap = (ego.x - npc.x) * stretch - npc.half_lengths
            wanted = min(wanted, following_speed(gap, ego.speed, npc.speed))
        return goal, wanted

    def _next_lane(self, npc: Npc, target_lane: int, ego: Body) -> int:
        """Return the next lane towards the target if that lane continues; a neighbour if the NPC's own lane ends."""
        wanted = self._step(npc, target_lane, ego)
        if wanted != npc.lane or self._goes_on(npc.lane, npc):
            return wanted
        side, other = npc.lane - 1, npc.lane + 1
        if abs(other - ego.lane) < abs(side - ego.lane):
            side, other = other, side
        if self._goes_on(side, npc):
            return self._step(npc, side, ego)
        return self._step(npc, other, ego) if self._goes_on(other, npc) else npc.lane

    def _step(self, npc: Npc, target_lane: int, ego: Body) -> int:
        step = Director._next_lane(self, npc, target_lane, ego)  # C methods have no super()
        is_slow_enough = npc.speed <= npc.bends.speed_at(step, npc.x)
        has_room = step == npc.lane or self.others is None or self.others.leaves_room(npc, step)
        return step if self._goes_on(step, npc) and is_slow_enough and has_room else npc.lane

    def _goes_on(self, lane: int, npc: Npc) -> bool:
        """Return whether a lane exists from an NPC's rear to its place :data:`LOOK_AHEAD` seconds later."""
        rear, later = npc.x - npc.length, npc.x + npc.length + LOOK_AHEAD * npc.speed
        return self._bends.continues(lane, max(rear, 0.0), later)

    def _steer(self, npc: Npc, goal: int) -> None:
        bends, driver = npc.bends, npc.driver
        direction, lean = bends.direction_at(goal, npc.x), bends.lean_at(goal, npc.x)
        later = npc.x + npc.speed * self._dt / bends.stretch(npc.x, bends.across_at(goal, npc.x))
        later_direction, later_lean = bends.direction_at(goal, later), bends.lean_at(goal, later)
        npc.steering = driver.steering_in_bend(
            npc.y - goal * self._width_of_lanes,
            bends.heading_at(npc.x) + npc.heading - direction,
            npc.course - direction if self._tick else 0.0,
            npc.speed,
            lean,
            later_direction + later_lean - direction - lean,
            self._sharpest(npc, goal),
        )
        npc.course = driver.course + direction


class JunctionDirector(BaseDirector):
    """The director of the NPCs of one run on a :class:`NetworkRoad` with ways of other traffic.

    Args:
        scenario: the scenario, with some Crossing-Instructions.
        road: the ego's way.
        junction: the ways of other traffic.
        limits: the limits of every NPC.
        grid: the director of the NPCs on the grid; None without them.
        physics_hz: ticks per second.

    Attributes:
        npcs: one NPC for each chain; the loop updates their places after each tick.
    """

    def __init__(
        self,
        scenario: Scenario,
        road: Any,
        junction: Any,
        limits: NpcLimits,
        *,
        grid: NetworkDirector | None,
        physics_hz: int,
    ) -> None:
        self._scenario = scenario
        self._junction = junction
        self._grid = grid
        self._ego_lane = road.ego_lane
        self._limits = limits
        self._top_speed = limits.top_speed(road.speed_limit)
        self._dt = 1 / physics_hz
        others = iter(grid.npcs if grid else ())
        npcs: list[Body] = [
            next(others) if each is None else self._npc(index, each) for index, each in enumerate(scenario.crossings)
        ]
        super().__init__(npcs)
        self._crossing = [npc for npc in self.npcs if isinstance(npc, CrossingNpc)]
        self._vehicles = [Body(CAR.length, CAR.width), *self.npcs]  # the ego is put there by the first command
        ego_lane = road.centre(road.ego_lane)
        self._crosser = Crosser(self._crossing, self._vehicles, limits.jerk, ego_lane, self._dt)
        self._relations = [self._related(number) for number in range(len(self._vehicles))]
        for npc in self._crossing:
            npc.conflicts, npc.leaders = self._relations[npc.index + 1]
        self._numbers = [number for number, each in enumerate(scenario.crossings, 1) if each is None]
        if grid is not None:
            grid.others = self

    def _npc(self, index: int, instruction: CrossingInstruction) -> CrossingNpc:
        kind = self._scenario.vehicle_of(index)
        way, limits = self._junction.ways[instruction.zone].of(kind, self._limits), self._limits.of(kind)
        zone = way.way.zone
        act, speeds = ACTS.index(instruction.act), way.way.speeds.tolist()
        driver = NpcDriver(limits, min(self._top_speed, kind.top_speed), kind.length, self._dt)
        npc = CrossingNpc(
            way.track, instruction.speed, speeds, zone.npc, zone.ego, act, way.middle, (kind.length, kind.width), driver
        )
        npc.index, npc.slot = index, instruction.slot
        npc.turning = BEND_SHARE * limits.lateral_acceleration
        npc.begins = self._junction.crossings.start(instruction)
        return npc

    def _related(self, number: int) -> tuple[list[SharedPlace], list[LeaderAhead]]:
        """Return the places at which a vehicle's way meets others, and the vehicles that may be ahead in its lane.

        Pairs of vehicles on the ego's way are left out, because the director of the grid handles them.
        """
        names = [EGOS, *(EGOS if each is None else each.zone for each in self._scenario.crossings)]
        mine, conflicts, leaders = names[number], [], []
        for other, theirs in enumerate(names):
            if other == number or mine == theirs == EGOS:
                continue
            if other > 0:
                sizes = [self._vehicles[each].length - CAR.length for each in (number, other)]
                conflicts += [
                    SharedPlace(other, *(longer(*each) for each in zip(stretches, sizes, strict=True)))
                    for stretches in self._junction.stretches(mine, theirs)
                ]
            if (places := self._junction.places(mine, theirs)) is not None:
                leaders.append(LeaderAhead(other, places))
        return conflicts, leaders

    @property
    def executed(self) -> Scenario:
        """The scenario with the genes that have begun as driven, and the later genes as requested."""
        if self._grid is None:
            return self._scenario
        chains = iter(self._grid.executed.npcs)
        npcs = tuple(
            next(chains) if each is None else chain
            for each, chain in zip(self._scenario.crossings, self._scenario.npcs, strict=True)
        )
        return self._scenario if npcs == self._scenario.npcs else replace(self._scenario, npcs=npcs)

    @property
    def driven(self) -> tuple[tuple[Cell, ...], ...]:
        """The cell that each NPC drove to in each started gene if ``executed`` cannot express it; else empty."""
        return self._with_crossing(() if self._grid is None else self._grid.driven)

    def _with_crossing(self, rows: tuple[tuple[Any, ...], ...]) -> tuple[tuple[Any, ...], ...]:
        """Return the rows of the NPCs around the ego, with an empty one for each that crosses; empty without rows."""
        others = iter(rows)
        return tuple(next(others) if each is None else () for each in self._scenario.crossings) if rows else ()

    @property
    def arrivals(self) -> tuple[tuple[int | None, ...], ...]:
        """The tick at which each NPC reached the cell of each started gene, or entered its zone; None if it has not."""
        others = iter(() if self._grid is None else self._grid.arrivals)
        return tuple(
            (npc.entered if npc.entered >= 0 else None,) if isinstance(npc, CrossingNpc) else next(others)
            for npc in self.npcs
        )

    def first_cells(self) -> tuple[Cell, ...]:
        """Return the cells of the first gene of NPCs on the grid, in which they start."""
        return () if self._grid is None else self._grid.first_cells()

    def started(self, starts: list[Start]) -> list[Start]:
        """Return the starts of all NPCs, given those of the NPCs on the grid."""
        on_grid = iter(starts if self._grid is None else self._grid.started(starts))
        return [self._start(npc) if isinstance(npc, CrossingNpc) else next(on_grid) for npc in self.npcs]

    def _start(self, npc: CrossingNpc) -> Start:
        track, along = npc.track, npc.begins
        turn = math.sin(abs(track.value(track.lean, along))) * 2 / npc.length  # by the slip left from a bend behind it
        fastest = math.sqrt(npc.turning / max(turn, 1e-9))
        return along, (*track.pose(along), min(track.value(npc.speeds, along), fastest, npc.driver.top_speed))

    def command(self, ego: Body) -> None:
        """Set acceleration and steering of each NPC for the coming tick."""
        self._vehicles[0] = ego
        if self._grid is not None:
            self._grid.command(ego)
        self._crosser.command(ego)

    def ceiling(self, npc: Npc) -> float:
        """Return the highest speed at which an NPC on the grid does not drive into crossing NPCs [m/s]."""
        number = self._numbers[npc.index]
        conflicts, leaders = self._relations[number]
        return self._crosser.ceiling(npc, number - 1, conflicts, leaders)

    def leaves_room(self, npc: Npc, lane: int) -> bool:
        """Return whether NPCs that have come onto the ego's lane leave room for an NPC on the grid to enter it."""
        if lane != self._ego_lane:
            return True
        for leader in self._relations[self._numbers[npc.index]][1]:
            theirs = self._vehicles[leader.other]
            along = leader.place(theirs.x)
            if math.isnan(along):
                continue
            front, rear = (theirs, npc) if along > npc.x else (npc, theirs)
            if not clear_to_enter(abs(along - npc.x) - (npc.length + theirs.length) / 2.0, rear.speed - front.speed):
                return False
        return True
