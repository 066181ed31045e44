"""The director of NPCs at a junction: some NPCs cross the ego's way on their own ways, and others are on the grid."""

from __future__ import annotations

import math
from dataclasses import replace

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import ACTS, CrossingInstruction, Scenario
from pytest_pafot.world.driving.network_director import NetworkDirector
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.crossing import Crosser, CrossingNpc, LeaderAhead, SharedPlace
from pytest_pafot.world.kernel.director import Npc
from pytest_pafot.world.kernel.driver import NpcDriver, clear_to_enter
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.junction import EGOS, Junction
from pytest_pafot.world.roads.network import BEND_SHARE, NetworkRoad

Start = tuple[float, tuple[float, float, float, float]]
"""A vehicle's start: the place along its way [m], and its x [m], y [m], heading [rad] and speed [m/s] there."""


class JunctionDirector:
    """The director of the NPCs of one run on a :class:`NetworkRoad` with ways of other traffic.

    Args:
        scenario: the scenario, with some Crossing-Instructions.
        road: the ego's way.
        junction: the ways of other traffic.
        limits: the limits of every NPC.
        grid: the director of the NPCs on the grid; None without them.
        length, width: the size of each NPC [m].
        physics_hz: ticks per second.

    Attributes:
        npcs: one NPC for each chain; the engine updates their places before each tick.
    """

    def __init__(
        self,
        scenario: Scenario,
        road: NetworkRoad,
        junction: Junction,
        limits: NpcLimits,
        *,
        grid: NetworkDirector | None,
        length: float,
        width: float,
        physics_hz: int,
    ) -> None:
        self._scenario = scenario
        self._junction = junction
        self._grid = grid
        self._ego_lane = road.ego_lane
        self._turning = BEND_SHARE * limits.lateral_acceleration
        others = iter(grid.npcs if grid else ())
        self.npcs: list[Body] = [
            next(others) if each is None else self._npc(index, each, length, width)
            for index, each in enumerate(scenario.crossings)
        ]
        self._crossing = [npc for npc in self.npcs if isinstance(npc, CrossingNpc)]
        self._vehicles = [Body(length, width), *self.npcs]
        dt, top_speed = 1 / physics_hz, limits.top_speed(road.speed_limit)
        driver = NpcDriver(limits, top_speed, length, dt)
        ego_lane = road.centre(road.ego_lane)
        self._crosser = Crosser(self._crossing, self._vehicles, driver, limits.jerk, ego_lane, dt)
        self._relations = [self._related(number) for number in range(len(self._vehicles))]
        for npc in self._crossing:
            npc.conflicts, npc.leaders = self._relations[npc.index + 1]
        if grid is not None:
            self._numbers = [number for number, each in enumerate(scenario.crossings, 1) if each is None]
            grid.others = self

    def _npc(self, index: int, instruction: CrossingInstruction, length: float, width: float) -> CrossingNpc:
        way = self._junction.ways[instruction.zone]
        zone = way.way.zone
        act, speeds = ACTS.index(instruction.act), way.way.speeds.tolist()
        size = length, width
        npc = CrossingNpc(way.track, instruction.speed, speeds, zone.npc, zone.ego, act, way.middle, size)
        npc.index, npc.slot = index, instruction.slot
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
                conflicts += [SharedPlace(other, *stretches) for stretches in self._junction.stretches(mine, theirs)]
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
        rows = () if self._grid is None else self._grid.driven
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

    def starts(self) -> list[Start | None]:
        """Return the start of each crossing NPC, None for each NPC on the grid."""
        return [self._start(npc) if isinstance(npc, CrossingNpc) else None for npc in self.npcs]

    def _start(self, npc: CrossingNpc) -> Start:
        track, along = npc.track, npc.begins
        turn = math.sin(abs(track.value(track.lean, along))) * 2 / npc.length  # by the slip left from a bend behind it
        fastest = math.sqrt(self._turning / max(turn, 1e-9))
        return along, (*track.pose(along), min(track.value(npc.speeds, along), fastest))

    def command(self, ego: Body) -> None:
        """Set acceleration and steering of each NPC for the coming tick."""
        self._vehicles[0] = ego
        if self._grid is not None:
            self._grid.command(ego)
        self._crosser.command(ego)

    def ceiling(self, npc: Npc) -> float:
        """Return the highest speed at which an NPC on the grid does not drive into crossing NPCs [m/s]."""
        number = self._numbers[npc.index]
        return self._crosser.ceiling(npc, number - 1, *self._relations[number])

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
            if not clear_to_enter(abs(along - npc.x) - npc.length, rear.speed - front.speed):
                return False
        return True
