"""The space from which a search samples scenarios, and the dangerous patterns in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.random import Generator

from pytest_pafot.algorithms.crossing_traffic import CrossingTraffic
from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.instructions import (
    SPEED_STEPS_PER_MPS,
    Cell,
    Choices,
    PositionInstruction,
    chains_of,
    known,
    pick,
    random_lanes,
    set_fields,
)
from pytest_pafot.model.scenario import (
    EGO_LANE,
    EGO_SPEED,
    GENE_SECONDS,
    LONGEST_GENE,
    PAPER_SPEED_LIMIT,
    Chains,
    Chromosome,
    Scenario,
    repaired_chains,
)
from pytest_pafot.model.vehicle_type import (
    CAR,
    PAPERS,
    STYLES,
    Style,
    VehicleType,
    named_vehicles,
    without_last_cars,
)
from pytest_pafot.support.errors import POSITIVE, checked_number, checked_whole
from pytest_pafot.support.text import listed, plural

# A limit on a target speed: a factor for the ego's initial speed, and an offset [m/s]. The result is at most the speed
# limit.
Bound = tuple[float, float]

LIMIT = (0.0, math.inf)  # the speed limit


class Step(NamedTuple):
    """One gene of a pattern: a target cell, and the lowest and highest target speed."""

    cell: Cell
    low: Bound
    high: Bound


class Pattern(NamedTuple):
    """A dangerous sequence of an NPC's steps around the ego, with its name and source."""

    name: str
    steps: tuple[Step, ...]
    source: str


# No scenario starts in a dangerous state: NPCs start as in any scenario, and drive into a pattern. Patterns are defined
# for the ego's left side, front or rear. All patterns have the same probability.
# Sources: Najm, Smith, Yanagisawa, "Pre-Crash Scenario Typology for Crash Avoidance Research", NHTSA, DOT HS 810 767,
# 2007; UN Regulation No. 157, annex 4, appendix 3 (critical disturbances: cut-in, cut-out, deceleration) and annex 5.
PATTERNS = (
    Pattern(
        "cut-in and brake",
        (Step(Cell.FRONT_LEFT, (1, -2), (1, 3)), Step(Cell.FRONT, (0, 0), (0.6, 0))),
        "UN R157, annex 4, appendix 3: cut-in; NHTSA: vehicle changing lanes, same direction",
    ),
    Pattern(
        "leader that brakes or stands",
        (Step(Cell.FRONT, (0, 0), (0, 5)),),
        "UN R157, annex 4, appendix 3: deceleration; NHTSA: lead vehicle decelerating, lead vehicle stopped",
    ),
    Pattern(
        "slow leader",
        (Step(Cell.FRONT, (0.3, 0), (0.8, 0)),),
        "NHTSA: lead vehicle moving at lower constant speed; UN R157, annex 5: following a lead vehicle",
    ),
    Pattern(
        "vehicle beside",
        (Step(Cell.LEFT, (1, -2), (1, 2)),),
        "NHTSA: vehicle changing lanes, same direction (the ego changes)",
    ),
    Pattern(
        "fast one from behind in the next lane",
        (Step(Cell.REAR_LEFT, (1, 0), LIMIT), Step(Cell.REAR_LEFT, (1, 0), LIMIT)),
        "NHTSA: vehicle changing lanes, same direction (the ego changes)",
    ),
    Pattern(
        "cut-out",
        (Step(Cell.FRONT, (1, -4), (1, 0)), Step(Cell.FRONT_LEFT, (0, 0), LIMIT)),
        "UN R157, annex 4, appendix 3: cut-out",
    ),
    Pattern(
        "slow one ahead in the next lane",
        (Step(Cell.FRONT_LEFT, (0, 0), (0.5, 0)),),
        "NHTSA: following vehicle making a maneuver (the ego follows)",
    ),
    Pattern(
        "tailgater",
        (Step(Cell.REAR, (1, 0), LIMIT),),
        "NHTSA: lead vehicle decelerating (the ego leads)",
    ),
)
# the lowest and highest target speed on the way from one pattern to the next
WALKING = ((1.0, -2.0), (1.0, 3.0))


def chain_of_patterns(
    genes: int,
    ego_speed: float,
    choices: Choices,
    rng: Generator,
) -> list[PositionInstruction]:
    """Return a chain of random patterns, joined by steps on the ring."""
    chain: list[PositionInstruction] = []
    while len(chain) < genes:
        chain = followed_by_pattern(chain, ego_speed, choices, rng)
    return chain[:genes]


def followed_by_pattern(
    chain: Sequence[PositionInstruction],
    ego_speed: float,
    choices: Choices,
    rng: Generator,
) -> list[PositionInstruction]:
    """Extend a chain by a random pattern, preceded by steps along the ring to the pattern's first cell.

    ``ego_speed`` is in m/s, and ``choices`` limits the speeds.
    """
    pattern = pick(PATTERNS, rng)
    steps = pattern.steps
    # half of the samples exchange left and right
    if rng.integers(2):
        steps = tuple(step._replace(cell=Cell((3 - step.cell) % 8 + 1)) for step in steps)
    way: list[Step] = []
    if chain:
        cells = _between(chain[-1].cell, steps[0].cell, rng)
        way = [Step(cell, *WALKING) for cell in cells]
    way += steps
    return [*chain, *[_sample_gene(step, ego_speed, choices, rng) for step in way]]


def _sample_gene(
    step: Step,
    ego_speed: float,
    choices: Choices,
    rng: Generator,
) -> PositionInstruction:
    bounds = []
    for share, more in (step.low, step.high):
        speed = (share * ego_speed + more) * SPEED_STEPS_PER_MPS
        bounds.append(int(min(max(speed, choices.low), choices.top)))
    gene: PositionInstruction = known(
        PositionInstruction,
        step.cell,
        Choices(*bounds).any_speed(rng),
    )
    return gene


def _between(first: Cell, last: Cell, rng: Generator) -> list[Cell]:
    """Return the cells between two cells on the shorter side of the ring."""
    clockwise = (last - first) % 8
    is_clockwise = clockwise < 4 or (clockwise == 4 and bool(rng.integers(2)))
    steps = range(-1, clockwise - 8, -1)
    if is_clockwise:
        steps = range(1, clockwise)
    return [Cell((first - 1 + step) % 8 + 1) for step in steps]


# Smallest number of genes of an NPC on a curved road, even in short runs: one each to approach, cut in and brake.
LEAST_GENES = 3
# fraction of the NPCs whose path crosses or joins the ego's path, if the world has such paths
CROSSING = 0.75
CARS = (CAR,)  # the vehicles of a search in which all NPCs are cars
OTHERS = 1 / 6  # fraction of the NPCs that are not cars, if NPCs can be other vehicles
# largest number of other NPCs if there are crossing ones: one ahead of the ego and one behind it
MOST_ON_GRID = 2

# The kinds of instructions of NPCs that do not cross: Position-Instructions, Lane-Instructions, or either.
Instructions = Literal["cells", "lanes", "both"]
# The probability that an NPC that does not cross has Lane-Instructions.
LANE_SHARES: Mapping[Instructions, float] = MappingProxyType(
    {"cells": 0.0, "lanes": 1.0, "both": 0.5}
)
# The words for these instructions in the description of a space.
DESCRIBED: Mapping[Instructions, str] = MappingProxyType(
    {
        "cells": "",
        "lanes": " with LaneInstructions",
        "both": " with PositionInstructions or LaneInstructions",
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSpace:
    """The common properties of all scenarios of a search. The defaults are the paper's setup (section 4.1).

    Attributes:
        npcs: number of NPCs in a scenario, from 1 to 8.
        genes: number of instructions of each NPC that does not cross.
        gene_seconds: duration of one gene [s].
        speed_limit: highest target speed [m/s]; 26.8 m/s is the paper's 60 mph.
        ego_lane: the ego's initial lane, counted from 0 at the left.
        ego_speed: initial speed of the ego and of all NPCs that do not cross [m/s].
        ego_lanes: lanes from which the ego's initial lane is sampled.
        ego_speeds: lowest and highest initial speed that can be sampled [m/s].
        patterns: whether half of the scenarios and a third of the mutations use dangerous patterns.
        traffic: how the NPCs drive.
        most_npcs: largest number of NPCs for each of the ``ego_lanes``, if the number is sampled.
        least_npcs: smallest number of NPCs, if the number is sampled.
        gene_durations: durations from which a gene's duration is sampled [s].
        crossings: paths that cross the ego's path. Three quarters of all NPCs use them.
        most_on_grid: largest number of NPCs that do not cross, if others do.
        instructions: ``"cells"``, ``"lanes"``, or ``"both"`` with equal probability.
        vehicles: vehicle types for NPCs. If cars are among them, one NPC in six is not a car.
        tick: duration of a tick [s]. Gene durations are rounded to whole ticks, or not at all if this is 0.
    """

    npcs: int = 2
    genes: int = 6
    gene_seconds: float = GENE_SECONDS
    speed_limit: float = PAPER_SPEED_LIMIT
    ego_lane: int = EGO_LANE
    ego_speed: float = EGO_SPEED
    # If the start is sampled, the shrinker prefers `ego_lane` and `ego_speed`.
    ego_lanes: tuple[int, ...] = ()
    ego_speeds: tuple[float, float] | None = None
    patterns: bool = False
    traffic: Style = PAPERS
    most_npcs: tuple[int, ...] = ()
    least_npcs: int = 1
    gene_durations: tuple[float, ...] = ()
    crossings: Crossings | None = None
    most_on_grid: int = MOST_ON_GRID
    instructions: Instructions = "cells"
    vehicles: tuple[VehicleType, ...] = CARS
    tick: float = 0.0

    def __post_init__(self) -> None:
        npcs = checked_whole(
            self.npcs, "npcs", "1 to 8 NPCs, at most one per cell", least=1, most=8
        )
        genes = checked_whole(self.genes, "genes", "at least one instruction per NPC", least=1)
        set_fields(self, npcs=npcs, genes=genes)
        expected = f"a duration of more than 0 s and at most {LONGEST_GENE:g} s"
        checked_number(
            self.gene_seconds, "gene_seconds", expected, least=POSITIVE, most=LONGEST_GENE
        )
        checked_number(
            self.speed_limit, "speed_limit", "a finite speed of at least 0 m/s", least=0.0
        )
        if self.tick:
            durations = tuple(map(self._in_ticks, self.gene_durations))
            seconds = self._in_ticks(self.gene_seconds)
            set_fields(self, gene_seconds=seconds, gene_durations=durations)
        if not isinstance(self.traffic, str) or self.traffic not in STYLES:
            raise ValueError(
                f"traffic: expected one of {', '.join(STYLES)}, but received {self.traffic!r:.100}"
            )
        if self.vehicles != CARS:  # a fast comparison, since each sampled start makes a space
            set_fields(self, vehicles=named_vehicles(self.vehicles))
        if self.instructions not in LANE_SHARES:
            expected = f"one of {', '.join(LANE_SHARES)}"
            raise ValueError(
                f"instructions: expected {expected}, but received {self.instructions!r:.100}"
            )
        low, high = self.ego_speeds or (0.0, 0.0)
        if not 0 <= low <= high < math.inf:
            raise ValueError(
                f"ego_speeds: expected the lowest and the highest speed in m/s, but received {self.ego_speeds!r}"
            )

    def _in_ticks(self, seconds: float) -> float:
        # such as 2.01 instead of 2.0099999999999998
        return round(max(round(seconds / self.tick), 1) * self.tick, 13)

    def sliced(self, slices: int) -> SearchSpace:
        """Return the space with ``slices`` genes per NPC and the same total duration."""
        return replace(self, genes=slices, gene_seconds=self.genes * self.gene_seconds / slices)

    @property
    def plain(self) -> dict[str, Any]:
        """The fields as JSON-compatible data, without ``crossings``."""
        data = asdict(replace(self, crossings=None))
        data["vehicles"] = [vehicle.plain() for vehicle in self.vehicles]
        usual = {
            "crossings": None,
            "most_on_grid": MOST_ON_GRID,
            "instructions": "cells",
            "least_npcs": 1,
            "vehicles": [CAR.plain()],
            "tick": 0.0,
        }
        for name, value in usual.items():
            if data[name] == value:
                del data[name]
        return data

    @property
    def other_vehicles(self) -> tuple[VehicleType, ...]:
        return tuple(vehicle for vehicle in self.vehicles if vehicle != CAR)

    def sample_vehicle(self, rng: Generator) -> VehicleType:
        others = self.other_vehicles
        # No random number is used if all NPCs are cars.
        if not others or (CAR in self.vehicles and rng.random() >= OTHERS):
            return CAR
        return pick(others, rng)

    def with_fitting_vehicles(self, scenario: Scenario) -> Scenario:
        """Replace each vehicle that is too long for the bends in its path with a car."""
        if self.crossings is None or not scenario.vehicles or not scenario.crossings:
            return scenario
        vehicles = list(scenario.vehicles)
        for npc, (vehicle, each) in enumerate(zip(vehicles, scenario.crossings, strict=False)):
            if each and not vehicle.can_follow(self.crossings.ways[each.zone].sharpest):
                vehicles[npc] = CAR
        return replace(scenario, vehicles=tuple(vehicles))

    @property
    def choices(self) -> Choices:
        top = math.floor(self.speed_limit * SPEED_STEPS_PER_MPS + 1e-6)
        least = STYLES[self.traffic].least_speed(self.speed_limit)
        return Choices(min(round(least * SPEED_STEPS_PER_MPS), top), top)

    @property
    def described(self) -> str:
        """A description, such as ``4 NPCs in hostile traffic``."""
        npcs = plural(self.npcs, "NPC")
        if self.most_npcs:
            npcs = f"{min(self.least_npcs, *self.most_npcs)} to {max(self.most_npcs)} NPCs"
        text = npcs + DESCRIBED[self.instructions]
        if self.traffic != PAPERS:
            text += f" in {STYLES[self.traffic].described}"
        if self.zones:
            count = plural(len(self.zones), "zone")
            text += f", most of them on paths that cross the ego's path in {count}"
        speeds = self.ego_speeds or (self.ego_speed,)
        speed = " to ".join(f"{each:g}" for each in dict.fromkeys(speeds))
        lane = f"lane {self.ego_lane}"
        if self.ego_lanes:
            lane = f"lane {self.ego_lanes[0]}"
        if len(self.ego_lanes) > 1:
            lane = f"lanes {self.ego_lanes[0]} to {self.ego_lanes[-1]}"
        text += f"; the ego starts at {speed} m/s in {lane}"
        others = listed([vehicle.name for vehicle in self.other_vehicles], "or")
        if others:
            which = "one NPC in six" if CAR in self.vehicles else "each NPC"
            text += f"; {which} is a {others}"
        return text

    @property
    def zones(self) -> tuple[str, ...]:
        """The names of the zones in which NPCs cross, in order along the ego's path."""
        if self.crossings is None:
            return ()
        return tuple(zone.way for zone in self.crossings.zones)

    @property
    def crossing_traffic(self) -> CrossingTraffic | None:
        """The distribution of instructions for crossing NPCs, or None if no NPC crosses."""
        if self.crossings is None:
            return None
        low = self.choices.low / SPEED_STEPS_PER_MPS
        high = self.choices.top / SPEED_STEPS_PER_MPS
        return CrossingTraffic(self.crossings, low, high, self.most_on_grid)

    def with_sampled_start(self, rng: Generator) -> SearchSpace:
        """Sample the start and the size of a scenario, and return the space restricted to them."""
        is_sampled = self.ego_lanes or self.most_npcs or self.gene_durations or self.ego_speeds
        if not is_sampled:
            return self
        lane = self.ego_lane
        if self.ego_lanes:
            lane = pick(self.ego_lanes, rng)
        speed = self.sample_speed(rng)
        npcs = self.npcs
        if self.most_npcs:
            most = self.most_on(lane)
            npcs = int(rng.integers(min(self.least_npcs, most), most + 1))
        seconds = self.gene_seconds
        if self.gene_durations:
            seconds = pick(self.gene_durations, rng)
        return self.fixed(lane, speed, npcs, self.genes_of(seconds), seconds)

    def fixed(self, lane: int, speed: float, npcs: int, genes: int, seconds: float) -> SearchSpace:
        """Return the space with a fixed start (lane, speed [m/s]), number of NPCs, and genes (number, duration [s])."""
        return replace(
            self,
            ego_lane=lane,
            ego_lanes=(),
            ego_speed=speed,
            ego_speeds=None,
            npcs=npcs,
            most_npcs=(),
            genes=genes,
            gene_seconds=seconds,
            gene_durations=(),
        )

    def most_on(self, lane: int) -> int:
        """Return the largest number of NPCs in a scenario in which the ego starts in ``lane``."""
        lanes = self.ego_lanes or (self.ego_lane,)
        if self.most_npcs and lane in lanes:
            return self.most_npcs[lanes.index(lane)]
        return self.npcs

    def genes_of(self, seconds: float) -> int:
        """Return how many genes of a duration [s] fill the total duration."""
        if seconds == self.gene_seconds:
            return self.genes
        return max(1, math.ceil(self.genes * self.gene_seconds / seconds - 1e-9))

    @property
    def has_speeds(self) -> bool:
        return self.ego_speeds is not None and self.ego_speeds[0] < self.ego_speeds[1]

    def sample_speed(self, rng: Generator) -> float:
        """Sample the initial speed [m/s] of all vehicles."""
        if self.ego_speeds is None:
            return self.ego_speed
        low, high = (speed * SPEED_STEPS_PER_MPS for speed in self.ego_speeds)
        choices = Choices(math.ceil(low - 1e-6), math.floor(high + 1e-6))
        return choices.any_speed(rng)


def space_on(
    speed_limit: float,
    longest_run: float,
    given: Mapping[str, Any],
    start: tuple[int, float, float] | None = None,
) -> SearchSpace:
    """Return the space of scenarios for a world with a speed limit [m/s] and a maximum run duration [s].

    On a curved road, the environment provides ``start``: the ego's lane and speed [m/s], and the ticks per second.

    Raises:
        TypeError, ValueError: if a field in ``given`` is unknown or out of range.
    """
    wanted = dict(given)
    if start is not None:
        # All genes together last as long as the longest run. There are at least three, of at most about ten seconds.
        lane, speed, physics_hz = start
        wanted = {"ego_lane": lane, "ego_speed": speed, **given}
        if "genes" not in wanted:
            least = 1 if "gene_seconds" in wanted else LEAST_GENES
            about = wanted.get("gene_seconds", SearchSpace().gene_seconds)
            wanted["genes"] = max(least, math.ceil(longest_run / about - 1e-9))
        if "gene_seconds" not in wanted:
            ticks = math.floor(longest_run * physics_hz / wanted["genes"] + 1e-9)
            wanted["gene_seconds"] = max(ticks, 1) / physics_hz
    space = SearchSpace(**wanted, speed_limit=speed_limit)
    if "genes" in wanted:
        return space
    genes = math.ceil(longest_run / space.gene_seconds - 1e-9)
    return replace(space, genes=max(1, genes))


def sample(space: SearchSpace, rng: Generator) -> Scenario:
    """Sample a valid scenario."""
    # Vehicles are sampled last, so that the random numbers before them are the same as in a space with only cars.
    scenario = _sample_cars(space, rng)
    if not space.other_vehicles:
        return scenario
    vehicles = tuple(space.sample_vehicle(rng) for _ in scenario.npcs)
    return space.with_fitting_vehicles(replace(scenario, vehicles=vehicles))


def _sample_cars(space: SearchSpace, rng: Generator) -> Scenario:
    # The start, the number of NPCs and the duration of genes are sampled first, then the kinds of instructions.
    space = space.with_sampled_start(rng)
    crossing = space.crossing_traffic
    if crossing is not None:
        return _sample_crossing(space, crossing, rng)
    share = LANE_SHARES[space.instructions]
    in_lanes = 0
    if share:
        in_lanes = int(rng.binomial(space.npcs, share))
    on_grid = _on_grid(space, space.npcs - in_lanes, rng)
    lanes = random_lanes(space.choices, in_lanes, space.genes, rng)
    return repaired([*on_grid, *lanes], fresh_seed(rng), space)


def _on_grid(space: SearchSpace, npcs: int, rng: Generator) -> list[list[PositionInstruction]]:
    if npcs and space.patterns and rng.integers(2):
        # Half of the scenarios have patterns instead of walks.
        return [
            chain_of_patterns(space.genes, space.ego_speed, space.choices, rng) for _ in range(npcs)
        ]
    first = rng.permutation(8)[:npcs, None]
    # NPCs start in distinct cells. Each stays in its cell or steps to either side, with equal probability.
    steps = rng.integers(-1, 2, size=(npcs, space.genes - 1))
    positions = np.cumsum(np.hstack([first, steps]), axis=1)
    walks = (positions % 8 + 1).tolist()
    low, top = space.choices
    speeds = rng.integers(low, top + 1, size=(npcs, space.genes))
    return chains_of(PositionInstruction, walks, speeds.tolist())


def _sample_crossing(space: SearchSpace, crossing: CrossingTraffic, rng: Generator) -> Scenario:
    count = int(rng.binomial(space.npcs, CROSSING))
    count = max(count, space.npcs - space.most_on_grid)
    chains: list[Chromosome] = []
    if count < space.npcs:
        others = replace(space, crossings=None, npcs=space.npcs - count)
        chains += sample(others, rng).npcs
    chains += [(crossing.sample(rng),) for _ in range(count)]
    kept = crossing.without_conflicts(chains, rng)
    return repaired([*kept.values()], fresh_seed(rng), space)


def sample_manoeuvres(space: SearchSpace, rng: Generator) -> Scenario:
    """Sample a scenario in which all NPCs have Lane-Instructions."""
    # no repair, so no seed
    chains = random_lanes(space.choices, space.npcs, space.genes, rng)
    return repaired(chains, 0, space)


def repaired(
    chains: Chains,
    seed: int,
    start: Scenario | SearchSpace,
    vehicles: tuple[VehicleType, ...] | None = None,
) -> Scenario:
    """Make a valid scenario from chains that were sampled or varied (section 2.1 of the paper).

    ``start`` provides everything except the chains, the seed and, if given, the vehicles.
    """
    # a space is a user's input, so the scenario is checked
    make: Callable[..., Scenario] = Scenario
    if isinstance(start, Scenario):
        make = Scenario.trusted
        if vehicles is None:
            vehicles = start.vehicles
    # The result equals that of Scenario.repaired. This is much faster, because it skips the checks. Speed matters here,
    # because a search repairs every child.
    return make(
        npcs=repaired_chains(chains, seed),
        seed=seed,
        ego_lane=start.ego_lane,
        ego_speed=start.ego_speed,
        gene_seconds=start.gene_seconds,
        traffic=start.traffic,
        vehicles=without_last_cars(vehicles or ()),
    )


def fresh_seed(rng: Generator) -> int:
    """Sample a seed for the repair of one scenario."""
    return int(rng.integers(2**31))  # short enough to read in a file
