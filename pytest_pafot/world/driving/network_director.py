"""The director of NPCs on roads of any shape, with lanes that bend, begin and end."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import Scenario, on_grid
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.director import Director, Npc
from pytest_pafot.world.kernel.driver import following_speed, gap_speed
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.network import NetworkRoad

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


class Others(Protocol):
    """The NPCs that drive on their own ways, for which NPCs on the grid leave room."""

    def ceiling(self, npc: Npc) -> float:
        """Return the highest speed at which an NPC on the grid does not drive into NPCs on their own ways [m/s]."""

    def leaves_room(self, npc: Npc, lane: int) -> bool:
        """Return whether the NPCs on their own ways leave room for an NPC on the grid to enter a lane."""


class NetworkDirector(Director):
    """The director of the NPCs of one run on a :class:`NetworkRoad`.

    It differs from the director of a straight road: NPCs enter only a lane that continues, and leave it before it ends.
    Bends and ends ahead limit the speed. Steering follows the lane. An NPC behind the ego without a lane to pass in
    follows it. Steps on the ring skip cells that do not exist. Bodies have their nominal position across the road, and
    their heading relative to the ego's way; an NPC's course is a direction in the world.
    NPCs may start in the ``start_cells``; all other arguments are as for :class:`Director`.

    Attributes:
        others: the NPCs that drive on their own ways; None if there are none.
    """

    others: Others | None = None

    def __init__(
        self, scenario: Scenario, road: NetworkRoad, limits: NpcLimits, *, start_cells: frozenset[Cell], **common: Any
    ) -> None:
        narrower = replace(limits, heading=HEADING_SHARE * limits.heading)
        super().__init__(scenario, road, narrower, **common)
        self.skips = True
        self._network = road
        self._start_cells = start_cells
        self._jerk = limits.jerk
        self._lateral = limits.lateral_acceleration
        self._dt = 1 / common["physics_hz"]

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
        return self._network.exists(lane, npc.x)

    def _existing(self, ego: Body) -> frozenset[Cell]:
        return self._network.cells(ego.x, ego.lane, (self._row + self._clearance) / self._stretch(ego))

    def _stretch(self, body: Body) -> float:
        """Return how many metres a vehicle drives in its lane per metre of the way."""
        across, _, _ = self._network.lane_at(body.lane, body.x)
        return self._network.stretch(body.x, across)

    def _control(self, npc: Npc, ego: Body) -> None:
        goal, wanted = self._aim(npc, ego)
        npc.heading_for = goal
        if self._attentive:
            wanted = self._attending(npc, ego, wanted)
        wanted = self._following(npc, wanted)
        if self.others is not None:
            wanted = min(wanted, self.others.ceiling(npc))
        gained = max(npc.asked, 0.0) ** 2 / (2 * self._jerk)  # speed gained while the accelerator is released
        for lane in (npc.lane, goal):
            wanted = min(wanted, self._network.speed_at(lane, npc.x) - gained)
        if abs(npc.y - self._network.centre(goal)) > BETWEEN_LANES:  # so that it can turn back if turned outwards
            changing = math.sqrt(CHANGING_SHARE * self._lateral / max(self._sharpest(npc, goal), 1e-9))
            wanted = min(wanted, max(npc.speed, changing))
        npc.asked = self._driver.acceleration(wanted, npc.asked, npc.speed)
        npc.acceleration = npc.asked
        self._steer(npc, goal)

    def _sharpest(self, npc: Npc, goal: int) -> float:
        """Return the largest curvature of a lane that an NPC meets during a lane change [1/m]."""
        return self._network.columns[goal].sharpest[self._network.point(npc.x)]

    def _aim(self, npc: Npc, ego: Body) -> tuple[int, float]:
        """Return the lane to steer to, and the speed for the instruction [m/s]."""
        target_lane = ego.lane + npc.column
        stretch, ego_stretch = self._stretch(npc), self._stretch(ego)
        along = self._target(npc, ego) if self._attentive else npc.target
        target = ego.x + along / ego_stretch
        distance = (target - npc.x) * stretch
        shift = npc.shift_lane
        if npc.kept_lane < 0 <= shift:
            self._keep_shift_lane_if_there(npc, self._network.centre(shift))
        elif npc.kept_lane < 0:
            exists = self._network.exists(target_lane, target)
            self._keep_lane_if_due(npc, target_lane if exists else -1, distance)
        if npc.kept_lane >= 0 or shift >= 0:
            return self._next_lane(npc, npc.kept_lane if npc.kept_lane >= 0 else shift, ego), npc.kept_speed
        goal = self._next_lane(npc, target_lane, ego)
        wanted = ego.speed * stretch / ego_stretch + gap_speed(distance)
        if goal != npc.lane:
            wanted = min(wanted, self._network.speed_at(goal, npc.x))
        wanted = self._creeping(npc, goal, wanted)
        if npc.lane == goal == ego.lane and npc.x < ego.x < target:
            gap = (ego.x - npc.x) * stretch - self._row
            wanted = min(wanted, following_speed(gap, ego.speed, npc.speed))
        return goal, wanted

    def _next_lane(self, npc: Npc, target_lane: int, ego: Body) -> int:
        """Return the next lane towards the target if that lane continues; a neighbour if the NPC's own lane ends."""
        wanted = self._step(npc, target_lane, ego)
        if wanted != npc.lane or self._goes_on(npc.lane, npc):
            return wanted
        for side in sorted((npc.lane - 1, npc.lane + 1), key=lambda each: abs(each - ego.lane)):
            if self._goes_on(side, npc):
                return self._step(npc, side, ego)
        return npc.lane

    def _step(self, npc: Npc, target_lane: int, ego: Body) -> int:
        step = super()._next_lane(npc, target_lane, ego)
        is_slow_enough = npc.speed <= self._network.speed_at(step, npc.x)
        has_room = step == npc.lane or self.others is None or self.others.leaves_room(npc, step)
        return step if self._goes_on(step, npc) and is_slow_enough and has_room else npc.lane

    def _goes_on(self, lane: int, npc: Npc) -> bool:
        """Return whether a lane exists from an NPC's rear to its place :data:`LOOK_AHEAD` seconds later."""
        rear, later = npc.x - self._length, npc.x + self._length + LOOK_AHEAD * npc.speed
        return self._network.continues(lane, max(rear, 0.0), later)

    def _steer(self, npc: Npc, goal: int) -> None:
        network, driver = self._network, self._driver
        across, direction, lean = network.lane_at(goal, npc.x)
        reach = npc.speed * self._dt / network.stretch(npc.x, across)
        _, later_direction, later_lean = network.lane_at(goal, npc.x + reach)
        npc.steering = driver.steering_in_bend(
            npc.y - network.centre(goal),
            network.reference(npc.x)[2] + npc.heading - direction,
            npc.course - direction if self._tick else 0.0,
            npc.speed,
            lean,
            later_direction + later_lean - direction - lean,
            self._sharpest(npc, goal),
        )
        npc.course = driver.course + direction
