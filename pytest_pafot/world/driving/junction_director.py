"""Who drives where at a junction: NPCs that cross the ego's way on ways of their own, beside those on the grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_pafot.model.crossings import STEP
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import CrossingInstruction, Scenario, on_grid
from pytest_pafot.world.driving.network_director import NetworkDirector
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.driver import NpcDriver
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.junction import CrossingWay, Junction

FREEZE = 3.0
"""How long before it enters its zone an NPC no longer follows the ego's arrival [s]."""
SLOWEST, FASTEST = 0.5, 1.5
"""Shares of its speed between which an NPC follows the ego's arrival."""


class CrossingNpc(Body):
    """An NPC on a way of its own: its body has the place along it, the distance to its right and the angle to it.

    Attributes:
        index: in the scenario.
        way: on which it drives.
        enters, leaves: where its zone begins and ends [m].
        first_state: where it starts along its way [m], and its x, y, heading and speed in the world there.
        asked: the acceleration asked for in the previous tick [m/s^2].
        course: direction of motion that the previous tick's steering gave [rad].
        entry: when it is planned to enter its zone [s].
        is_frozen: whether that is decided.
        entered: the tick at which it entered its zone.
    """

    def __init__(
        self, index: int, instruction: CrossingInstruction, way: CrossingWay, junction: Junction, size: Sequence[float]
    ) -> None:
        super().__init__(*size)
        self.index = index
        self.instruction = instruction
        self.way = way
        self.enters, self.leaves = way.way.zone.npc
        self.speeds = np.minimum(way.way.speeds, instruction.speed).tolist()
        self.times = way.way.times(instruction.speed).tolist()
        self.crossing = self.time(self.leaves) - self.time(self.enters)
        start = junction.crossings.start(instruction)
        self.first_state = start, (*way.start(start), way.value(self.speeds, start))
        self.asked = 0.0
        self.course: float | None = None
        self.entry = math.inf
        self.is_frozen = False
        self.entered: int | None = None

    def time(self, along: float) -> float:
        """Return when it is at a place that drives as its instruction says [s]."""
        return self.way.value(self.times, along)


class JunctionDirector:
    """Drives the NPCs of one run on a :class:`NetworkRoad` with ways of other traffic.

    Args:
        scenario: the instructions, of which some are Crossing-Instructions.
        junction: the ways.
        limits: of every NPC.
        top_speed: of every NPC [m/s].
        grid: who drives the NPCs on the grid; None without.
        length, width: of each NPC [m].
        physics_hz: ticks per second.

    Attributes:
        npcs: one for each chain; their owner puts them where they are before each tick.
    """

    def __init__(
        self,
        scenario: Scenario,
        junction: Junction,
        limits: NpcLimits,
        *,
        top_speed: float,
        grid: NetworkDirector | None,
        length: float,
        width: float,
        physics_hz: int,
    ) -> None:
        self._scenario = scenario
        self._junction = junction
        self._grid = grid
        self._dt = 1 / physics_hz
        self._tick = 0
        self._driver = NpcDriver(limits, top_speed, length, self._dt)
        others = iter(grid.npcs if grid else ())
        self._crossing: list[CrossingNpc] = []
        self.npcs: list[Body] = []
        for index, instruction in enumerate(scenario.crossings):
            if instruction is None:
                self.npcs.append(next(others))
                continue
            way = junction.ways[instruction.zone]
            self._crossing.append(CrossingNpc(index, instruction, way, junction, (length, width)))
            self.npcs.append(self._crossing[-1])

    @property
    def executed(self) -> Scenario:
        """The scenario with the genes so far as driven, and those to come as requested."""
        if self._grid is None:
            return self._scenario
        chains = iter(self._grid.executed.npcs)
        npcs = [
            next(chains) if each is None else chain
            for each, chain in zip(self._scenario.crossings, self._scenario.npcs, strict=True)
        ]
        return self._scenario if tuple(npcs) == self._scenario.npcs else replace(self._scenario, npcs=tuple(npcs))

    @property
    def driven(self) -> tuple[tuple[Cell, ...], ...]:
        """Per NPC and started gene, the cell that it drove to, where ``executed`` cannot say so; else nothing."""
        rows = () if self._grid is None else self._grid.driven
        return tuple(tuple(row) for row in on_grid(self._scenario.npcs, rows)) if rows else ()

    @property
    def arrivals(self) -> tuple[tuple[int | None, ...], ...]:
        """Per NPC and started gene, the tick at which the cell was reached, or the zone entered."""
        others = iter(() if self._grid is None else self._grid.arrivals)
        return tuple((npc.entered,) if isinstance(npc, CrossingNpc) else next(others) for npc in self.npcs)

    def first_cells(self) -> tuple[Cell, ...]:
        """The cells of the first gene of those on the grid, which say where they start."""
        return () if self._grid is None else self._grid.first_cells()

    def starts(self) -> list[tuple[float, tuple[float, float, float, float]] | None]:
        """Return where each NPC that crosses starts on its way [m], and its x, y, heading and speed in the world there.

        One on the grid has None.
        """
        return [npc.first_state if isinstance(npc, CrossingNpc) else None for npc in self.npcs]

    def command(self, ego: Body) -> None:
        """Set acceleration and steering of each NPC for the coming tick."""
        if self._grid is not None:
            self._grid.command(ego)
        for npc in self._crossing:
            self._control(npc, ego)
        self._tick += 1

    def _control(self, npc: CrossingNpc, ego: Body) -> None:
        if npc.x >= npc.enters and npc.entered is None:
            npc.entered = self._tick
        wanted = npc.way.value(npc.speeds, npc.x)
        if npc.entered is None:
            fastest = npc.way.value(npc.way.column.speed, npc.x)
            wanted = min(self._share(npc, ego) * wanted, fastest)
        npc.acceleration = npc.asked = self._driver.acceleration(wanted, npc.asked, npc.speed)
        self._steer(npc)

    def _share(self, npc: CrossingNpc, ego: Body) -> float:
        """Return the share of its speed at which an NPC enters its zone when it is to [s]."""
        now = self._tick * self._dt
        left = npc.time(npc.enters) - npc.time(npc.x)
        if not npc.is_frozen:
            first, last = npc.way.way.zone.ego
            speed = max(ego.speed, 0.1)
            window = (first - ego.x) / speed, (last - ego.x) / speed
            entry = self._junction.crossings.entry(npc.instruction, window)
            entry = min(max(entry, left / FASTEST), left / SLOWEST)
            npc.entry = now + entry
            npc.is_frozen = entry <= FREEZE
        return min(max(left / max(npc.entry - now, 0.1), SLOWEST), FASTEST)

    def _steer(self, npc: CrossingNpc) -> None:
        way, column = npc.way, npc.way.column
        direction, lean = way.value(column.direction, npc.x), way.value(column.lean, npc.x)
        later = npc.x + npc.speed * self._dt
        turn = way.value(column.direction, later) + way.value(column.lean, later) - direction - lean
        npc.steering = self._driver.steering_in_bend(
            npc.y,
            npc.heading,
            0.0 if npc.course is None else npc.course - direction,
            npc.speed,
            lean,
            turn,
            column.sharpest[min(max(round(npc.x / STEP), 0), len(column.sharpest) - 1)],
        )
        npc.course = self._driver.course + direction
