"""Who drives where: turns Position-Instructions into controls of all NPCs, tick by tick.

The director keeps the gene clock, repairs requests at gene boundaries (paper, section 2.1), latches arrivals
and lets NPCs give way to each other. It sees road coordinates only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from pytest_pafot.grid import Cell, longitudinal_target, repair_gene, toss
from pytest_pafot.scenario import PositionInstruction, Scenario
from pytest_pafot.world import driver
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.road import StraightRoad

ARRIVED_LATERAL = 0.5
"""How near to the cell's centre an NPC has arrived, across the lane [m]; along it, half the cell's length."""
CREEP_SPEED = 3.0
"""Speed at which an NPC ahead of a standing ego moves on to change lanes, as it cannot sideways [m/s]."""


class Pose(NamedTuple):
    """A vehicle in road coordinates: along [m], across [m], heading [rad], speed [m/s]."""

    s: float
    d: float
    heading: float
    speed: float


@dataclass(slots=True)
class _Npc:
    """What the director remembers of one NPC."""

    chain: list[PositionInstruction]
    executed: list[Cell] = field(default_factory=list)
    arrivals: list[int | None] = field(default_factory=list)
    kept_lane: int | None = None
    """The lane held until the gene ends: after arriving, or because the target's lane is gone."""
    kept_speed: float = 0.0
    """The speed driven in it [m/s]."""
    heading_for: int = 0
    """The lane steered to in the previous tick."""
    acceleration: float = 0.0
    course: float = 0.0


class Director:
    """Drives the NPCs of one run.

    Args:
        scenario: the chains.
        road: on which all drive.
        limits: of every NPC.
        clearance: gap between the ego and the cells ahead and behind [m].
        ego_length: [m].
        length, width: of each NPC [m].
        physics_hz: ticks per second.
    """

    def __init__(
        self,
        scenario: Scenario,
        road: StraightRoad,
        limits: NpcLimits,
        *,
        clearance: float,
        ego_length: float,
        length: float,
        width: float,
        physics_hz: int,
    ) -> None:
        self._scenario = scenario
        self._road = road
        self._limits = limits
        self._clearance = clearance
        self._row = (ego_length + length) / 2
        self._length = length
        self._width = width
        self._dt = 1 / physics_hz
        self._gene_ticks = round(scenario.gene_seconds * physics_hz)
        self._top_speed = limits.overspeed * road.speed_limit
        self._far = length + driver.stopping_room(self._top_speed)
        self._tick = 0
        self._npcs = [_Npc(list(chain)) for chain in scenario.npcs]

    @property
    def executed(self) -> Scenario:
        """The scenario with the genes so far as driven, and those to come as requested."""
        chains = [
            [*(PositionInstruction(c, g.speed) for c, g in zip(npc.executed, npc.chain, strict=False)),
             *npc.chain[len(npc.executed) :]]
            for npc in self._npcs
        ]  # fmt: skip
        return Scenario.repaired(
            chains,
            seed=self._scenario.seed,
            ego_lane=self._scenario.ego_lane,
            ego_speed=self._scenario.ego_speed,
            gene_seconds=self._scenario.gene_seconds,
        )

    @property
    def arrivals(self) -> tuple[tuple[int | None, ...], ...]:
        """Per NPC and started gene, the tick at which the cell was reached."""
        return tuple(tuple(npc.arrivals) for npc in self._npcs)

    def first_cells(self) -> tuple[Cell, ...]:
        """The cells of the first gene as executed, which say where the NPCs start."""
        existing = self._road.cells(self._scenario.ego_lane)
        requested = [chain[0].cell for chain in self._scenario.npcs]
        return repair_gene(None, requested, existing, lambda npc: toss(self._scenario.seed, npc, 0))

    def command(self, ego: Pose, poses: list[Pose]) -> list[tuple[float, float]]:
        """Acceleration [m/s^2] and steering [rad] of each NPC for the coming tick."""
        gene, inside = divmod(self._tick, self._gene_ticks)
        ego_lane = self._road.nearest_lane(ego.d)
        if inside == 0 and gene < self._scenario.genes:
            self._begin_gene(gene, ego_lane, poses)
            self._end_chains(gene, poses)
        lanes = [self._road.nearest_lane(pose.d) for pose in poses]
        controls = [self._control(index, ego, ego_lane, poses, lanes) for index in range(len(poses))]
        self._tick += 1
        return controls

    def _begin_gene(self, gene: int, ego_lane: int, poses: list[Pose]) -> None:
        active = [index for index, npc in enumerate(self._npcs) if gene < len(npc.chain)]
        existing = self._road.cells(ego_lane)
        cells = repair_gene(
            [self._npcs[index].executed[-1] for index in active] if gene else None,
            [self._npcs[index].chain[gene].cell for index in active],
            existing,
            partial(self._toss, gene, active),
        )
        for index, cell in zip(active, cells, strict=True):
            npc = self._npcs[index]
            npc.executed.append(cell)
            npc.arrivals.append(None)
            npc.kept_lane = None
        if gene == 0:
            for npc, pose in zip(self._npcs, poses, strict=True):
                npc.heading_for = self._road.nearest_lane(pose.d)

    def _end_chains(self, gene: int, poses: list[Pose]) -> None:
        """Have NPCs without a further gene keep their lane and speed (paper, section 2)."""
        for npc, pose in zip(self._npcs, poses, strict=True):
            if gene == len(npc.chain) and npc.kept_lane is None:
                npc.kept_lane = self._road.nearest_lane(pose.d)
                npc.kept_speed = pose.speed

    def _toss(self, gene: int, active: list[int], position: int) -> bool:
        return toss(self._scenario.seed, active[position], gene)

    def _control(
        self, index: int, ego: Pose, ego_lane: int, poses: list[Pose], lanes: list[int]
    ) -> tuple[float, float]:
        npc, pose, lane = self._npcs[index], poses[index], lanes[index]
        cell = npc.executed[-1]
        target_lane = ego_lane + cell.column
        distance = ego.s + longitudinal_target(cell, self._row, self._clearance) - pose.s
        if npc.kept_lane is None:
            self._keep_lane_if_due(npc, pose, lane, target_lane, distance)
        if npc.kept_lane is None:
            wanted_speed = ego.speed + driver.gap_speed(distance)
            goal = self._next_lane(index, lane, target_lane, ego, ego_lane, poses)
            if cell.row > 0 and abs(pose.d - self._road.centre(goal)) > ARRIVED_LATERAL:
                wanted_speed = max(wanted_speed, CREEP_SPEED)
        else:
            wanted_speed = npc.kept_speed
            goal = npc.kept_lane
        npc.heading_for = goal
        wanted_speed = min(wanted_speed, self._following_speed(index, goal, poses, lanes))
        npc.acceleration = driver.limited_acceleration(
            driver.SPEED_GAIN * (wanted_speed - pose.speed),
            npc.acceleration,
            pose.speed,
            self._top_speed,
            self._limits,
            self._dt,
        )
        steering, npc.course = driver.steering_angle(
            pose.d - self._road.centre(goal),
            pose.heading,
            npc.course,
            pose.speed,
            self._length,
            self._limits,
            self._dt,
        )
        return npc.acceleration, steering

    def _keep_lane_if_due(self, npc: _Npc, pose: Pose, lane: int, target_lane: int, distance: float) -> None:
        if not 0 <= target_lane < len(self._road.lanes):
            npc.kept_lane = lane
            npc.kept_speed = npc.chain[len(npc.executed) - 1].speed
            return
        beside = abs(pose.d - self._road.centre(target_lane)) <= ARRIVED_LATERAL
        if beside and abs(distance) <= self._length / 2:
            npc.kept_lane = target_lane
            npc.kept_speed = npc.chain[len(npc.executed) - 1].speed
            npc.arrivals[-1] = self._tick

    def _next_lane(self, index: int, lane: int, target_lane: int, ego: Pose, ego_lane: int, poses: list[Pose]) -> int:
        """The lane to steer to now: one step nearer to the target, where nobody is in the way."""
        if lane == target_lane:
            return lane
        step = lane + (1 if target_lane > lane else -1)
        beside_ego = abs(poses[index].s - ego.s) < self._row + self._clearance / 2
        if step == ego_lane and beside_ego:
            return lane  # an NPC cuts in ahead or behind; it does not steer into the ego's side
        if all(self._clear_of(index, other, step, poses) for other in range(len(poses)) if other != index):
            return step
        return lane

    def _clear_of(self, index: int, other: int, lane: int, poses: list[Pose]) -> bool:
        """Whether an NPC may enter a lane as far as one other NPC is concerned."""
        mine, theirs = poses[index], poses[other]
        reach = (self._road.lane_width + self._width) / 2
        in_lane = abs(theirs.d - self._road.centre(lane)) < reach
        claims = self._npcs[other].heading_for == lane and other < index
        if not (in_lane or claims):
            return True
        front, rear = (theirs, mine) if theirs.s > mine.s else (mine, theirs)
        return driver.clear_to_enter(front.s - rear.s - self._length, rear.speed - front.speed)

    def _following_speed(self, index: int, goal: int, poses: list[Pose], lanes: list[int]) -> float:
        """Highest speed that leaves room behind the NPCs ahead [m/s]."""
        mine = poses[index]
        mine_or_goal = (lanes[index], goal)
        speed = math.inf
        for other, theirs in enumerate(poses):
            distance = theirs.s - mine.s
            if other == index or not 0 <= distance < self._far or (distance == 0 and other > index):
                continue
            gap = distance - self._length
            crosses = gap > -self._length / 2 and (
                lanes[other] in mine_or_goal or self._npcs[other].heading_for in mine_or_goal
            )
            if crosses or abs(theirs.d - mine.d) < self._width + 0.6:
                speed = min(speed, driver.following_speed(gap, theirs.speed, mine.speed))
        return speed
