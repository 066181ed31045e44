"""The director, which controls the NPCs tick by tick according to their instructions.

The director starts each gene on time, replaces impossible cells at the start of a gene (paper, section 2.1), records
arrivals, and makes NPCs give way to each other. All its positions are in road coordinates.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat
from typing import Any

from pytest_pafot.model.instructions import (
    LANE_STARTS,
    Cell,
    longitudinal_target,
    repair_gene,
    toss,
)
from pytest_pafot.model.scenario import Chromosome, Scenario, on_grid, with_targets
from pytest_pafot.model.vehicle_type import AMPLE, CAR, STYLES
from pytest_pafot.world.kernel.driver import (
    NpcDriver,
    clear_to_enter,
    closing_room,
    following_gap,
    following_speed,
    gap_speed,
    speed_for_braking,
    stopping_room,
)
from pytest_pafot.world.kernel.lanes import Bends, Body, Lanes
from pytest_pafot.world.limits import NpcLimits

# lateral distance from a cell's centre within which an NPC has arrived [m]; along the lane, it is half the NPC's length
ARRIVED_LATERAL = 0.5
# lowest speed of an NPC that changes lanes ahead of a stationary ego, because a car cannot move sideways [m/s]
CREEP_SPEED = 3.0
# smallest lateral gap of NPCs that drive side by side [m]; at a smaller gap, each obstructs the other
BESIDE = 0.6
NO_LANE = -1

Start = tuple[float, tuple[float, float, float, float]]
"""The start of a vehicle: the position [m] along its path, and a tuple of x [m], y [m], heading [rad] and speed [m/s].
"""

# The following numbers are for attentive traffic. Verdicts do not expect more of an NPC when the ego moves in ahead of
# the NPC, or brakes there for no reason.
# lateral gap to the ego's box up to which an NPC counts as directly behind or ahead of the ego [m]
TRACK = 0.3
REACTION = 1.0  # reaction time of an NPC to unexpected behaviour of the ego [s]
ANSWER = 6.0  # hardest braking of an NPC in that reaction [m/s^2]
# reaction time and braking of the ego for which an NPC leaves room when it moves in ahead [s, m/s^2]
ENTRY_TIME = 0.35
ENTRY_BRAKING = 6.0
ENTRY_GAP = 1.5  # smallest gap at which an NPC moves in behind an ego of equal speed [m]
NOT_BEHIND = -1

# The following numbers are for roads with bends.
# driving time for which a lane must continue so that an NPC enters it or stays in it [s]
LOOK_AHEAD = 3.0
# The proportion of the largest angle to a lane that an NPC uses relative to its target lane. The rest is a reserve,
# because the lane that the NPC leaves has a slightly different direction at the start and end of a bend.
HEADING_SHARE = 0.9
# proportion of an NPC's lateral acceleration for following a bend while the NPC speeds up in a lane change
CHANGING_SHARE = 0.3
# distance from the centre of the target lane above which an NPC is still changing lanes [m]
BETWEEN_LANES = 0.5


class Npc(Body):
    """An NPC in road coordinates, with the data that a director stores about it."""

    def __init__(
        self,
        index: int,
        chain: Chromosome,
        length: float,
        width: float,
    ) -> None:
        super().__init__(length, width)
        self.driver: Any = None
        self.limits: Any = None
        self.bends: Any = None  # the road with this NPC's speeds and leans; None on a straight road
        self.top_speed = self.half_lengths = self.longer = self.lateral = 0.0
        # index of the chain in the director's scenario, which has no crossing NPCs
        self.index = index
        self.chain: tuple[Any, ...] = chain
        self.executed: list[Any] = []  # cells or lanes of the started genes
        self.arrivals: list[int | None] = []  # tick of the arrival in each started gene, or None
        self.row = 0
        self.column = 0
        self.target = 0.0  # distance from the ego to the cell's centre along the road [m]
        self.target_speed = 0.0
        # lane that is kept until the gene ends, after arrival or without a target lane
        self.kept_lane = NO_LANE
        self.kept_speed = 0.0  # desired speed in the kept lane or the shift lane [m/s]
        self.shift_lane = NO_LANE  # target lane of a Lane-Instruction
        self.heading_for = 0  # lane to which the NPC steered in the previous tick
        self.asked = 0.0  # acceleration in the previous tick [m/s^2]
        self.course = 0.0  # direction of motion after the previous tick's steering [rad]
        # The number of ticks for which the NPC has been directly behind the ego. If the NPC moved there itself, the
        # count starts at the reaction time, so that the NPC reacts immediately.
        self.behind = NOT_BEHIND


class BaseDirector:
    """The base class of directors, which control the NPCs of one run.

    For the trace, subclasses also define ``first_cells``, ``arrivals``, ``executed`` and ``driven_cells``.
    """

    def __init__(self, npcs: list[Any]) -> None:
        self.npcs = npcs

    def started(self, starts: list[Start]) -> list[Start]:
        """Add the starts of crossing NPCs, if any, to the starts of the NPCs around the ego, and return all starts."""
        return starts

    def command(self, ego: Body) -> None:
        """Set the controls of each NPC for the coming tick."""

    def ceiling(self, npc: Npc) -> float:
        """Return the highest speed [m/s] at which another director's NPC avoids this director's NPCs."""
        raise NotImplementedError

    def leaves_room(self, npc: Npc, lane: int) -> bool:
        """Return whether this director's NPCs leave room for another director's NPC to enter a lane."""
        raise NotImplementedError


class Director(BaseDirector):
    """The director for straight roads.

    ``cells`` contains, for each lane of the ego, the cells that exist. ``clearance`` is the gap [m] between the ego and
    the cells ahead and behind. If ``skips`` is true, NPCs that step from cell to cell around the ego skip cells that do
    not exist.
    """

    def __init__(
        self,
        scenario: Scenario,
        lanes: Lanes,
        limits: NpcLimits,
        *,
        speed_limit: float,
        cells: Sequence[frozenset[Cell]],
        clearance: float,
        ego_length: float,
        physics_hz: float,
    ) -> None:
        kinds = scenario.all_vehicles
        super().__init__(
            [
                Npc(index, chain, kind.length, kind.width)
                for index, (chain, kind) in enumerate(zip(scenario.npcs, kinds, strict=True))
            ]
        )
        self._scenario = scenario
        self._on_grid = [npc for npc in self.npcs if npc.chain[0].on_grid]
        self._in_lanes = [npc for npc in self.npcs if not npc.chain[0].on_grid]
        self.skips = False
        self._cells = cells
        self._clearance = clearance
        self._lane_width = lanes.width
        self._last_lane = lanes.count - 1
        self._genes = scenario.genes
        self._gene_ticks = round(scenario.gene_seconds * physics_hz)
        traffic = STYLES[scenario.traffic]
        # largest half_lengths, and distance from which no NPC follows another [m]
        self._row = self._far = 0.0
        self._is_mixed = bool(scenario.vehicles)
        self._aside = CAR.width + BESIDE
        before: Any = None
        for npc, kind in zip(self.npcs, kinds, strict=True):
            # equal vehicles share a controller, which keeps no state between two calls
            if kind is not before:
                before = kind
                own = limits.for_vehicle(kind)
                top_speed = min(limits.overspeed * speed_limit, kind.top_speed)
                driver = NpcDriver(
                    own,
                    top_speed,
                    npc.length,
                    1 / physics_hz,
                    traffic.lateral_speed,
                )
                # half the length of ego and NPC together, and half the length by which the NPC exceeds a car [m]
                half_lengths = (ego_length + npc.length) / 2.0
                longer = max(npc.length - CAR.length, 0.0) / 2.0
                self._row = max(self._row, half_lengths)
                self._far = max(self._far, npc.length + stopping_room(top_speed))
            npc.limits = own
            npc.driver = driver
            npc.top_speed = top_speed
            npc.half_lengths = half_lengths
            npc.longer = longer
        self._attentive = traffic.is_attentive
        self._least_share = traffic.least_speed_share
        self._speed_limit = speed_limit
        self._least_gap = traffic.least_gap
        self._time_gap = traffic.time_gap
        self._ample = AMPLE
        # largest reduction of the current speed [m/s]
        self._easing = -speed_for_braking(traffic.braking, 0.0)
        self._reaction = max(round(REACTION * physics_hz), 1)
        self._delay = self._reaction / physics_hz
        # number of stored ticks; the ego's braking is computed from two speeds
        self._kept = self._reaction + 1
        if self._attentive:
            # a ring buffer of the ego's x and speed
            self._seen = array("d", [0.0]) * (2 * self._kept)
        self._tick = 0
        self._gene = 0
        self._left = 0

    @property
    def executed(self) -> Scenario:
        """The scenario, in which started genes are as executed, and the others as requested."""
        scenario: Scenario = self._scenario
        on_grid, in_lanes = (
            [
                (done, gene)
                for npc in npcs
                for done, gene in zip(npc.executed, npc.chain, strict=False)
            ]
            for npcs in (self._on_grid, self._in_lanes)
        )
        if all(cell == gene.cell for cell, gene in on_grid) and all(
            lane == gene.lane for lane, gene in in_lanes
        ):
            return scenario
        return scenario.rechained(with_targets(scenario.npcs, [npc.executed for npc in self.npcs]))

    @property
    def driven_cells(self) -> tuple[tuple[Cell, ...], ...]:
        """The cells that the NPCs aimed for in their started genes, or an empty tuple if ``executed`` contains them."""
        return ()

    @property
    def arrivals(self) -> tuple[tuple[int | None, ...], ...]:
        """The tick at which each NPC arrived in each started gene, or None if the NPC has not arrived."""
        return tuple([tuple(npc.arrivals) for npc in self.npcs])

    def first_cells(self) -> tuple[Cell, ...]:
        """Return the cells in which the NPCs start, with impossible cells replaced."""
        # NPCs on the grid come first. The other NPCs get the remaining cells.
        held = self._first_on_grid()
        remaining = self._first_existing().difference(held)
        on_grid = iter(held)
        free = iter([cell for cell in LANE_STARTS if cell in remaining])
        return tuple([next(on_grid if npc.chain[0].on_grid else free) for npc in self.npcs])

    def _first_on_grid(self) -> tuple[Cell, ...]:
        wanted = [npc.chain[0].cell for npc in self._on_grid]
        return self._repaired(None, wanted, self._first_existing(), self._on_grid, 0)

    def command(self, ego: Body) -> None:
        if self._left == 0:
            self._left = self._gene_ticks
            if self._gene < self._genes:
                self._begin_gene(ego)
                # an NPC keeps lane and speed after the end of a shorter chain (paper, section 2)
                for npc in self.npcs:
                    if self._gene == len(npc.chain) and npc.kept_lane == NO_LANE:
                        npc.kept_lane = npc.lane
                        npc.kept_speed = npc.speed
            self._gene += 1
        self._left -= 1
        for npc in self.npcs:
            self._control(npc, ego)
        if self._attentive:
            self._remember(ego)
        self._tick += 1

    def _is_led(self, ego: Body) -> bool:
        # Whether any NPC is directly ahead of the ego, at any distance.
        for npc in self.npcs:  # noqa: SIM110  (any() makes a closure, which cannot be compiled)
            if npc.x > ego.x and abs(npc.y - ego.y) < (npc.width + ego.width) / 2.0 + TRACK:
                return True
        return False

    def _remember(self, ego: Body) -> None:
        # Store the ego's position and speed, for delayed reactions of NPCs.
        seen = self._seen
        # before the first tick, the ego is assumed to have driven at its start speed
        if self._tick == 0:
            for place in range(1, self._kept):
                driven = (self._kept - place) * self._delay / self._reaction * ego.speed
                seen[2 * place] = ego.x - driven / self._stretch(ego)
                seen[2 * place + 1] = ego.speed
        place = self._tick % self._kept
        seen[2 * place] = ego.x
        seen[2 * place + 1] = ego.speed

    def _begin_gene(self, ego: Body) -> None:
        gene = self._gene
        active = [npc for npc in self._on_grid if gene < len(npc.chain)]
        if gene:
            before = [npc.executed[-1] for npc in active]
            wanted = [npc.chain[gene].cell for npc in active]
            cells = self._repaired(before, wanted, self._existing(ego), active, gene)
        else:
            cells = self._first_on_grid()
            for npc in self.npcs:
                npc.heading_for = npc.lane
        for npc, cell in zip(active, cells, strict=True):
            npc.executed.append(cell)
            npc.arrivals.append(None)
            npc.row = cell.row
            npc.column = cell.column
            npc.target = longitudinal_target(cell, npc.half_lengths, self._clearance)
            npc.target_speed = npc.chain[gene].speed
            npc.kept_lane = NO_LANE
        # if the lane of a Lane-Instruction does not exist, the NPC keeps its lane
        for npc in self._in_lanes:
            if gene < len(npc.chain):
                instruction = npc.chain[gene]
                wanted_lane = npc.lane + instruction.column
                has_lane = self._has_lane(npc, wanted_lane)
                npc.executed.append(instruction.lane if has_lane else "keep")
                npc.arrivals.append(None)
                npc.shift_lane = npc.lane
                if has_lane:
                    npc.shift_lane = wanted_lane
                npc.kept_speed = instruction.speed
                npc.kept_lane = NO_LANE

    def _has_lane(self, npc: Npc, lane: int) -> bool:
        return 0 <= lane <= self._last_lane

    def _first_existing(self) -> frozenset[Cell]:
        return self._cells[self._scenario.ego_lane]

    def _existing(self, ego: Body) -> frozenset[Cell]:
        return self._cells[ego.lane]

    def _repaired(
        self,
        before: list[Cell] | None,
        wanted: list[Cell],
        existing: frozenset[Cell],
        npcs: list[Npc],
        gene: int,
    ) -> tuple[Cell, ...]:
        coins = map(toss, repeat(self._scenario.seed), [npc.index for npc in npcs], repeat(gene))
        return repair_gene(before, wanted, existing, coins, skipping=self.skips)

    def _control(self, npc: Npc, ego: Body) -> None:
        # Arrivals come first, because they determine the desired lane and speed in this tick.
        target = npc.target
        if self._attentive:
            target = self._target(npc, ego)
        distance = ego.x + target - npc.x
        if npc.kept_lane == NO_LANE and npc.shift_lane == NO_LANE:
            self._keep_lane_if_due(npc, ego.lane + npc.column, distance)
        elif npc.kept_lane == NO_LANE:
            self._keep_shift_lane_if_there(npc, npc.shift_lane * self._lane_width)
        if npc.kept_lane != NO_LANE:
            wanted_speed = npc.kept_speed
            goal = npc.kept_lane
        elif npc.shift_lane != NO_LANE:
            wanted_speed = npc.kept_speed
            goal = self._next_lane(npc, npc.shift_lane, ego)
        else:
            goal = self._next_lane(npc, ego.lane + npc.column, ego)
            wanted_speed = self._creeping(npc, goal, ego.speed + gap_speed(distance))
        npc.heading_for = goal
        if self._attentive:
            wanted_speed = self._attending(npc, ego, wanted_speed)
        wanted_speed = self._following(npc, wanted_speed)
        driver = npc.driver
        npc.asked = driver.acceleration(wanted_speed, npc.asked, npc.speed)
        npc.acceleration = npc.asked
        npc.steering = driver.steering(
            npc.y - goal * self._lane_width,
            npc.heading,
            npc.course,
            npc.speed,
        )
        npc.course = driver.course

    def _target(self, npc: Npc, ego: Body) -> float:
        # The position [m] along the road of an attentive NPC's cell, relative to the ego.
        if npc.row == 0 or npc.column != 0:
            return npc.target
        # in the ego's lane: an NPC behind the ego follows it, and an NPC ahead needs room to move in
        if npc.row < 0:
            return -(npc.half_lengths + max(self._clearance, following_gap(ego.speed)))
        return npc.half_lengths + max(self._clearance, self._ahead(ego) + self._ample)

    def _ahead(self, ego: Body) -> float:
        # The gap [m] that this driving style requires for moving in ahead of an ego at the same speed.
        return max(self._least_gap, self._time_gap * ego.speed)

    def _stretch(self, body: Body) -> float:
        # The distance that a vehicle covers per metre along the road.
        return 1.0

    def _attending(self, npc: Npc, ego: Body, speed: float) -> float:
        """Limit a desired speed [m/s] according to the driving style and the gap to an ego ahead."""
        least_speed = self._least_share * min(self._speed_limit, ego.speed)
        speed = max(speed, least_speed, npc.speed - self._easing)
        is_in_track = abs(ego.y - npc.y) < (npc.width + ego.width) / 2.0 + TRACK
        moves_in = npc.heading_for == ego.lane and npc.lane != ego.lane
        if npc.x >= ego.x or not (is_in_track or moves_in):
            npc.behind = NOT_BEHIND
            return speed
        if npc.behind == NOT_BEHIND:
            sideways = abs(npc.speed * npc.heading)
            has_moved_in = self._tick == 0 or sideways >= abs(ego.speed * ego.heading)
            npc.behind = 0
            if has_moved_in:
                npc.behind = self._reaction
        elif npc.behind < self._reaction:
            npc.behind += 1
        if npc.behind < self._reaction:
            return speed
        # The NPC expects an ego behind another NPC to brake, and reacts immediately. Otherwise, it reacts late.
        is_led = self._is_led(ego)
        x = ego.x
        ego_speed = ego.speed
        # expected distance that the ego has driven since then, if it is still braking as before [m]
        ahead = 0.0
        if not is_led and self._tick > 0:
            seen = self._seen
            # the two oldest entries
            before = self._tick % self._kept
            place = (self._tick + 1) % self._kept
            x = seen[2 * place]
            ego_speed = seen[2 * place + 1]
            gained = ego_speed - seen[2 * before + 1]
            braking = max(-gained * self._reaction / self._delay, 0.0)
            seconds = self._delay
            if 0.0 < ego_speed < braking * self._delay:
                seconds = ego_speed / braking
            ahead = (ego_speed - braking * seconds / 2.0) * seconds
            ego_speed -= braking * seconds
        gap = (x - npc.x) * self._stretch(npc) + ahead - npc.half_lengths
        # a reversing ego counts as stationary
        safe = following_speed(gap, max(ego_speed, 0.0), npc.speed)
        if not is_led:
            safe = max(safe, speed_for_braking(ANSWER, npc.speed))
        return min(speed, safe)

    def _may_enter(self, npc: Npc, ego: Body) -> bool:
        gap = abs(npc.x - ego.x) * self._stretch(ego) - npc.half_lengths
        if npc.x > ego.x:
            # An NPC with a Lane-Instruction brakes to its target speed while it moves in. An NPC on the grid first
            # reaches its cell.
            speed = npc.speed
            if npc.shift_lane != NO_LANE:
                speed = min(npc.speed, npc.kept_speed)
            closing = max(ego.speed - speed, 0.0)
            return gap > self._ahead(ego) + closing * (ENTRY_TIME + closing / (2.0 * ENTRY_BRAKING))
        return gap > closing_room(ENTRY_GAP, npc.speed - ego.speed)

    def _creeping(self, npc: Npc, goal: int, speed: float) -> float:
        if npc.row > 0 and abs(npc.y - goal * self._lane_width) > ARRIVED_LATERAL:
            return max(speed, CREEP_SPEED)
        return speed

    def _keep_lane_if_due(self, npc: Npc, target_lane: int, distance: float) -> None:
        if not 0 <= target_lane <= self._last_lane:
            npc.kept_lane = npc.lane
            npc.kept_speed = npc.target_speed
            return
        beside = abs(npc.y - target_lane * self._lane_width) <= ARRIVED_LATERAL
        if beside and abs(distance) <= npc.length / 2.0:
            npc.kept_lane = target_lane
            npc.kept_speed = npc.target_speed
            npc.arrivals[-1] = self._tick

    def _keep_shift_lane_if_there(self, npc: Npc, centre: float) -> None:
        if abs(npc.y - centre) <= ARRIVED_LATERAL:
            npc.kept_lane = npc.shift_lane
            npc.arrivals[-1] = self._tick

    def _next_lane(self, npc: Npc, target_lane: int, ego: Body) -> int:
        """Return the next lane on the way to the target lane, or the present lane if there is no room."""
        lane = npc.lane
        if lane == target_lane:
            return lane
        step = lane + 1 if target_lane > lane else lane - 1
        beside_ego = abs(npc.x - ego.x) < npc.half_lengths + self._clearance / 2.0
        if step == ego.lane and (beside_ego or (self._attentive and not self._may_enter(npc, ego))):
            # an NPC moves in ahead of the ego or behind it, but does not steer into its side
            return lane
        for other in self.npcs:  # an NPC enters only a lane with room
            if other is not npc and not self._clear_of(npc, other, step):
                return lane
        return step

    def _clear_of(self, mine: Npc, theirs: Npc, lane: int) -> bool:
        # Whether the NPC `theirs` leaves room for the NPC `mine` to enter a lane.
        reach = (self._lane_width + theirs.width) / 2.0 + theirs.longer * abs(theirs.heading)
        in_lane = abs(theirs.y - lane * self._lane_width) < reach
        claims = theirs.heading_for == lane and theirs.index < mine.index
        if not (in_lane or claims):
            return True
        front = mine
        rear = theirs
        if theirs.x > mine.x:  # in compiled code, a conditional expression would create a tuple
            front = theirs
            rear = mine
        return clear_to_enter(self._gap(front, rear), rear.speed - front.speed)

    def _gap(self, front: Npc, rear: Npc) -> float:
        return front.x - rear.x - (front.length + rear.length) / 2.0

    def _following(self, mine: Npc, speed: float) -> float:
        lane = mine.lane
        goal = mine.heading_for
        for theirs in self.npcs:
            distance = theirs.x - mine.x
            if distance < 0.0 or distance >= self._far or theirs is mine:
                continue
            # of two NPCs at the same position, the one with the higher index follows
            if distance == 0.0 and theirs.index > mine.index:
                continue
            aside = self._aside
            if self._is_mixed:
                aside = (mine.width + theirs.width) / 2.0 + BESIDE
                aside += mine.longer * abs(mine.heading) + theirs.longer * abs(theirs.heading)
            is_beside = abs(theirs.y - mine.y) < aside
            crosses = (
                theirs.lane == lane
                or theirs.lane == goal
                or theirs.heading_for == lane
                or theirs.heading_for == goal
            )
            if not (is_beside or crosses):
                continue
            gap = self._gap(theirs, mine)
            if is_beside or gap > -(mine.length + theirs.length) / 4.0:
                safe = following_speed(gap, theirs.speed, mine.speed)
                speed = safe if safe < speed else speed
        return speed


class NetworkDirector(Director):
    """The director for a :class:`NetworkRoad`.

    NPCs enter only lanes that continue, and leave a lane before it ends. An NPC that cannot pass the ego in another
    lane follows the ego. Bodies have a nominal lateral position, and a heading relative to the ego's path. An NPC's
    ``course`` is a direction in the world. ``others`` is the director of the crossing NPCs, or None.
    """

    def __init__(
        self,
        scenario: Scenario,
        road: Any,
        limits: NpcLimits,
        *,
        start_cells: frozenset[Cell],
        **common: Any,
    ) -> None:
        narrower = replace(limits, heading=HEADING_SHARE * limits.heading)
        lanes = Lanes(road.lane_count, road.lane_width, road.end)
        super().__init__(
            scenario,
            lanes,
            narrower,
            speed_limit=road.speed_limit,
            cells=(),
            **common,
        )
        self.skips = True
        self._road: Any = road
        self.others: BaseDirector | None = None
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
        # A chain contains only steps between neighbouring cells, so it cannot express a step that skipped a cell.
        if self.driven_cells:
            return self._scenario
        return super().executed

    @property
    def driven_cells(self) -> tuple[tuple[Cell, ...], ...]:
        cells = [tuple(npc.executed) for npc in self._on_grid]
        written = super().executed
        is_written = all(
            tuple([gene.cell for gene in chain[: len(row)]]) == row
            for chain, row in zip(written.positions, cells, strict=True)
        )
        if is_written:
            return ()
        return tuple(tuple(row) for row in on_grid(self._scenario.npcs, cells))

    def _first_existing(self) -> frozenset[Cell]:
        return self._start_cells

    def _has_lane(self, npc: Npc, lane: int) -> bool:
        return self._bends.exists(lane, npc.x)

    def _existing(self, ego: Body) -> frozenset[Cell]:
        existing: frozenset[Cell] = self._road.cells(
            ego.x,
            ego.lane,
            (self._row + self._clearance) / self._stretch(ego),
        )
        return existing

    def _stretch(self, body: Body) -> float:
        return self._bends.stretch(body.x, self._bends.across_at(body.lane, body.x))

    def _gap(self, front: Npc, rear: Npc) -> float:
        distance = front.x - rear.x
        # in a bend, the shorter distance counts
        distance *= min(self._stretch(front), self._stretch(rear))
        return distance - (front.length + rear.length) / 2.0

    def _control(self, npc: Npc, ego: Body) -> None:
        goal, wanted = self._aim(npc, ego)
        npc.heading_for = goal
        if self._attentive:
            wanted = self._attending(npc, ego, wanted)
        self._move(npc, goal, self._following(npc, wanted))

    def _move(self, npc: Npc, goal: int, wanted: float) -> None:
        if self.others is not None:  # crossing NPCs, bends and ends of lanes limit the speed
            wanted = min(wanted, self.others.ceiling(npc))
        asked = max(npc.asked, 0.0)
        # speed gained while the accelerator is released
        gained = asked * asked / (2.0 * self._jerk)
        wanted = min(wanted, npc.bends.speed_at(npc.lane, npc.x) - gained)
        wanted = min(wanted, npc.bends.speed_at(goal, npc.x) - gained)
        # an NPC that is turned outwards must turn back
        if abs(npc.y - goal * self._width_of_lanes) > BETWEEN_LANES:
            changing = math.sqrt(
                CHANGING_SHARE * npc.lateral / max(self._sharpest(npc, goal), 1e-9)
            )
            wanted = min(wanted, max(npc.speed, changing))
        npc.asked = npc.driver.acceleration(wanted, npc.asked, npc.speed)
        npc.acceleration = npc.asked
        self._steer(npc, goal)

    def _sharpest(self, npc: Npc, goal: int) -> float:
        return self._bends.sharpest_at(goal, npc.x)

    def _aim(self, npc: Npc, ego: Body) -> tuple[int, float]:
        # The lane to steer to, and the desired speed [m/s] for the NPC's instruction.
        target_lane = ego.lane + npc.column
        stretch = self._stretch(npc)
        ego_stretch = self._stretch(ego)
        along = npc.target
        if self._attentive:
            along = self._target(npc, ego)
        target = ego.x + along / ego_stretch
        distance = (target - npc.x) * stretch
        shift = npc.shift_lane
        if npc.kept_lane < 0 <= shift:
            self._keep_shift_lane_if_there(npc, shift * self._width_of_lanes)
        elif npc.kept_lane < 0:
            due_lane = target_lane
            if not self._bends.exists(target_lane, target):
                due_lane = NO_LANE
            self._keep_lane_if_due(npc, due_lane, distance)
        # If the goal is a lane, the desired speed is the instruction's. If it is a cell, it depends on the ego's speed.
        if npc.kept_lane >= 0 or shift >= 0:
            if npc.kept_lane >= 0:
                shift = npc.kept_lane
            return self._next_lane(npc, shift, ego), npc.kept_speed
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
        # The next lane towards the target lane, or a neighbouring lane if the NPC's own lane ends.
        wanted = self._step(npc, target_lane, ego)
        if wanted != npc.lane or self._goes_on(npc.lane, npc):
            return wanted
        # The NPC's lane ends, so it prefers the neighbouring lane that is nearer to the ego's lane.
        side = npc.lane - 1
        other = npc.lane + 1
        if abs(other - ego.lane) < abs(side - ego.lane):
            side, other = other, side
        if self._goes_on(side, npc):
            return self._step(npc, side, ego)
        if self._goes_on(other, npc):
            return self._step(npc, other, ego)
        return npc.lane

    def _step(self, npc: Npc, target_lane: int, ego: Body) -> int:
        step = Director._next_lane(self, npc, target_lane, ego)  # C methods have no super()
        is_slow_enough = npc.speed <= npc.bends.speed_at(step, npc.x)
        has_room = step == npc.lane or self.others is None or self.others.leaves_room(npc, step)
        if self._goes_on(step, npc) and is_slow_enough and has_room:
            return step
        return npc.lane

    def _goes_on(self, lane: int, npc: Npc) -> bool:
        rear = npc.x - npc.length
        later = npc.x + npc.length + LOOK_AHEAD * npc.speed
        return self._bends.continues(lane, max(rear, 0.0), later)

    def _steer(self, npc: Npc, goal: int) -> None:
        bends = npc.bends
        driver = npc.driver
        direction = bends.direction_at(goal, npc.x)
        lean = bends.lean_at(goal, npc.x)
        # the position after the coming tick, from which the change of direction in that tick follows
        later = npc.x + npc.speed * self._dt / bends.stretch(npc.x, bends.across_at(goal, npc.x))
        later_direction = bends.direction_at(goal, later)
        later_lean = bends.lean_at(goal, later)
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
