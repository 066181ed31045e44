"""The search for the simplest scenario with the same failure."""
# After Zeller and Hildebrandt, "Simplifying and isolating failure-inducing input" (IEEE TSE 28(2), 2002), and MacIver
# and Donaldson, "Test-case reduction via test-case generation" (ECOOP 2020): an order that defines "simpler", one gate
# before each run, and passes that are repeated until none of them helps. Small scenarios are also tried directly,
# because single steps often do not lead to them. This module does not simulate: `shrink` yields requests, and its
# caller sends the answers.

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Container, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import combinations, pairwise, permutations, product, zip_longest
from typing import Any, NamedTuple, TypeVar

from pytest_pafot.model.instructions import (
    LANE_STARTS,
    MAX_SPEED,
    SPEED_STEPS_PER_MPS,
    Instruction,
    LaneInstruction,
    PositionInstruction,
    ScenarioError,
    roughness,
)
from pytest_pafot.model.scenario import (
    EGO_LANE,
    EGO_SPEED,
    GENE_SECONDS,
    Chromosome,
    Scenario,
    continues,
    retimed,
)
from pytest_pafot.model.vehicle_type import CAR, HOSTILE, PAPERS, STYLES, VehicleType
from pytest_pafot.support.text import plural

Start = tuple[int, float]  # the ego's lane and speed [m/s] when a gene starts

# The answer to an attempt: the scenario as executed, and the start of each gene (empty if unknown), or None if the run
# does not fail in the same way.
Shown = tuple[Scenario, tuple[Start, ...]] | None


class Attempt(NamedTuple):
    """A request to run a candidate, and to report whether it fails in the same way."""

    candidate: Scenario
    best: Scenario  # the simplest failing scenario so far


class Likely(NamedTuple):
    """A request to predict whether a small scenario is likely to fail."""

    candidate: Scenario
    best: Scenario


class Ahead(NamedTuple):
    """An announcement of the next candidates, which can run in advance. It requires no response."""

    candidates: Sequence[Scenario]
    more: bool  # False if earlier candidates that were not attempted are no longer needed


ResultT = TypeVar("ResultT")

# A part of shrinking that yields requests, receives the answers, and returns a result.
Asking = Generator[Attempt | Likely | Ahead, Any, ResultT]

# The scenarios that a pass tries, with None for a change that gives no valid scenario.
Candidates = Iterator[Scenario | None]

Pass = Callable[[Scenario], Candidates]

# The numbers of NPCs and instructions of a scenario, and its chains.
Sized = tuple[tuple[int, int], tuple[Chromosome, ...]]

# Steps of speed from coarse to fine, in tenths of m/s like all speeds inside this module.
FIVE, ONE, TENTH = 5 * SPEED_STEPS_PER_MPS, SPEED_STEPS_PER_MPS, 1

# Speeds of the instructions in small scenarios [m/s]. If a small scenario fails, the passes try other speeds in it.
SMALL_SPEEDS = (0.0, 10.0, 20.0, 25.0)

# The largest number of small scenarios for which one pass requests a prediction, which takes about a millisecond.
MOST_SMALL = 300

# At most a tenth of the runs is for the first, quick attempts, so that most of a small budget is left for the passes.
FIRST_PART = 10

# The largest number of simplifications that are tried together with a second simplification.
MOST_FIRST_STEPS = 40

# 2**64 divided by the golden ratio: any number of its multiples is spread evenly modulo 2**64.
GOLDEN = 0x9E3779B97F4A7C15


@dataclass(frozen=True, slots=True, kw_only=True)
class Shrunk:
    """The result of shrinking a scenario.

    Attributes:
        rollouts: number of runs used.
        is_minimal: True if all simpler candidates were tried within the budget and none of them fails. The
            candidates are single simplifications, some pairs of simplifications, and small scenarios.
        before: size of the scenario before shrinking, in words.
    """

    rollouts: int
    is_minimal: bool = True
    before: str = ""


class OutOfBudget(Exception):  # noqa: N818  (it ends the passes and is not an error)
    """The exception that ends shrinking when no runs or no time are left."""


def sort_key(scenario: Scenario) -> tuple[int, ...]:
    """Return the key that orders scenarios from simple to complex."""
    parts = [chain[start] for chain in scenario.npcs for start, _ in _parts(chain)]
    start = round(scenario.ego_speed * SPEED_STEPS_PER_MPS)
    # Every number is a non-negative integer, so every chain of simplifications ends.
    return (
        # A reader has to understand each NPC, and then each instruction. Equal consecutive ones count as one.
        len(scenario.npcs),
        len(parts),
        # Staying is simpler than moving, and passing a zone is simpler than holding or stopping.
        sum(map(_moves, scenario.npcs)),
        # A cell determines the position of an NPC, whereas the start of an NPC in lanes depends on the other NPCs.
        sum(not chain[0].on_grid and not chain[0].crosses for chain in scenario.npcs),
        sum(vehicle != CAR for vehicle in scenario.vehicles),
        # The longest chain decides how long the run takes.
        scenario.genes,
        sum(map(len, scenario.npcs)),
        # The usual start is simplest, then round speeds.
        (scenario.ego_lane != EGO_LANE)
        + (scenario.ego_speed != EGO_SPEED and 1 + roughness(start))
        + (scenario.gene_seconds != GENE_SECONDS),
        # Multiples of 5 m/s are simpler than whole numbers, and these than tenths. For slots, whole seconds are simpler
        # than halves, and halves than tenths.
        sum(roughness(_tenths(each)) + each.roughness for each in parts),
        # Slower is simpler, and so is a slot nearer to 0.
        sum(each.weight for each in parts),
        # The paper's traffic adds no rules.
        int(scenario.traffic != PAPERS),
        scenario.seed,
    )


def instructions(scenario: Scenario) -> int:
    """Return the number of instructions, counting equal consecutive instructions as one."""
    return sort_key(scenario)[1]


def size_of(scenario: Scenario, longest_run: float = math.inf) -> str:
    """Return the size of a scenario in words, such as ``2 NPCs, 7 instructions, 60 s``."""
    npcs, told = plural(len(scenario.npcs), "NPC"), plural(instructions(scenario), "instruction")
    return f"{npcs}, {told}, {round(min(scenario.seconds, longest_run), 1):g} s"


def described(scenario: Scenario, longest_run: float = math.inf) -> str:
    """Return the size and the traffic of a scenario in words."""
    return f"{size_of(scenario, longest_run)}, {scenario.traffic} traffic"


def shrink(
    scenario: Scenario,
    *,
    rollouts: int,
    top_speed: float = MAX_SPEED,
    plain: Start | None = None,
    plain_seconds: float | None = None,
    ahead: int = 0,
    asks_likely: bool = False,
) -> Asking[tuple[Scenario, Shrunk]]:
    """Search for the simplest scenario that fails in the same way, and return it with statistics.

    Args:
        scenario: failing scenario, as executed.
        rollouts: largest number of attempts.
        top_speed: highest speed [m/s] of any instruction.
        plain, plain_seconds: preferred start of the ego, and preferred duration [s] of a gene; None for no preference.
        ahead: number of candidates to announce in advance.
        asks_likely: True to attempt small scenarios only if they are :class:`Likely` to fail.
    """
    # No candidate is attempted twice. Equal answers lead to the same requests in the same order, and to the same result
    # for any `ahead`. To end the search early, the caller throws OutOfBudget at the next attempt and at all later ones.
    top = int(min(top_speed, MAX_SPEED) * SPEED_STEPS_PER_MPS + 1e-6)
    slowest = min(_tenths(gene) for chain in scenario.npcs for gene in chain)
    low = min(round(STYLES[scenario.traffic].least_speed(top_speed) * SPEED_STEPS_PER_MPS), slowest)
    gate = _Gate(
        best=scenario, rollouts=rollouts // FIRST_PART, low=low, top=top, tried={scenario: scenario},
        ahead=ahead if ahead > 1 else 0,
    )  # fmt: skip
    is_minimal = False
    plainer: Pass = partial(_plainer_start, plain=plain)
    longer: Pass = partial(_plainer_duration, seconds=plain_seconds)
    deletions: tuple[Pass, ...] = (plainer, longer, *passes(), partial(_later, starts=gate.starts))
    with suppress(OutOfBudget):
        # first, because a run that does not fail takes as long as its scenario
        yield from gate.exhausts(_ending)
        yield from gate.exhausts(_alone)
        yield from gate.exhausts(_cars)
    small = partial(
        _small,
        found=gate.best,
        plain=plain or (scenario.ego_lane, scenario.ego_speed),
        is_limited=asks_likely,
    )
    with suppress(OutOfBudget):
        yield from gate.exhausts(plainer)
        yield from gate.exhausts(small, asks_likely=asks_likely)
    gate.rollouts = rollouts - 1  # the last one is for the paper's traffic
    with suppress(OutOfBudget):
        while not is_minimal:
            is_simpler = False
            for each in deletions:
                is_simpler |= yield from gate.exhausts(each)
            # The expensive passes run only if no deletion helps any more.
            is_simpler = is_simpler or (yield from gate.exhausts(small, asks_likely=asks_likely))
            is_minimal = not (is_simpler or (yield from gate.exhausts(_two_steps)))
    gate.rollouts = rollouts
    with suppress(OutOfBudget):
        # Run this pass once, even if the others used up their budget. They do not start again.
        yield from gate.exhausts(_papers_traffic)
    return gate.best, Shrunk(rollouts=gate.spent, is_minimal=is_minimal)


@dataclass(slots=True, kw_only=True)
class _Gate:
    # All attempts go through this class. A candidate must be valid and simpler than the best, and must not have been
    # tried before. Two scenarios are equal if their canonical texts are equal.

    best: Scenario
    rollouts: int
    low: int
    top: int
    tried: dict[Scenario, Scenario | None]
    ahead: int
    spent: int = 0
    # of failing scenarios as executed
    starts: dict[Scenario, tuple[Start, ...]] = field(default_factory=dict)

    def simplifies(self, candidate: Scenario | None) -> Asking[bool]:
        # If the candidate fails in the same way and is simpler, it becomes the best.
        if candidate is None or sort_key(candidate) >= sort_key(self.best):
            return False
        driven = yield from self.driven(candidate)
        if driven is None or sort_key(driven) >= sort_key(self.best):
            return False
        self.best = driven
        return True

    def exhausts(self, candidates: Pass, *, asks_likely: bool = False) -> Asking[bool]:
        # Repeat a pass until it finds no simpler scenario. The result is True if it found any.
        found, skipped = False, 0
        while True:
            place = yield from self._first(candidates(self.best), skipped, asks_likely=asks_likely)
            if place is None and not skipped:
                return found
            # The candidates before the one that helped did not help just now, so they are tried again last.
            found, skipped = found or place is not None, place or 0

    def _first(
        self, candidates: Candidates, skipped: int, *, asks_likely: bool
    ) -> Asking[int | None]:
        # Return the index of the first candidate that simplifies, or None. Announce the candidates after it in advance.
        place, read, told = -1, deque[tuple[int, Scenario | None]](), set[Scenario | None]()
        if self.ahead:
            yield Ahead((), more=False)
        for candidate in candidates:
            if asks_likely and (candidate is None or not (yield Likely(candidate, self.best))):
                continue
            place += 1
            if place < skipped:
                continue
            read.append((place, candidate))
            is_left = self.ahead and self.spent + len(told) < self.rollouts
            if is_left and candidate is not None and self._would_run(candidate, told):
                told.add(candidate)
                yield Ahead((candidate,), more=True)
            while read and len(told) >= self.ahead:
                number, first = read.popleft()
                if (yield from self.simplifies(first)):
                    return number
                told.discard(first)
        for number, first in read:
            if (yield from self.simplifies(first)):
                return number
        return None

    def _would_run(self, candidate: Scenario, told: Container[Scenario | None]) -> bool:
        if candidate in told or candidate in self.tried or not self._is_allowed(candidate):
            return False
        return sort_key(candidate) < sort_key(self.best)

    def _is_allowed(self, candidate: Scenario) -> bool:
        return all(
            self.low <= _tenths(gene) <= self.top for chain in candidate.npcs for gene in chain
        )

    def driven(self, candidate: Scenario) -> Asking[Scenario | None]:
        # The candidate as executed if it fails in the same way, otherwise None.
        if not self._is_allowed(candidate):
            return None
        if candidate not in self.tried:
            if self.spent >= self.rollouts:
                raise OutOfBudget
            shown: Shown = yield Attempt(candidate, self.best)
            self.spent += 1  # counted after the attempt, which may itself raise OutOfBudget
            self.tried[candidate] = None
            if shown is not None:
                driven, self.starts[driven] = shown
                # repair does not change an executed scenario
                self.tried[candidate] = self.tried[driven] = driven
        return self.tried[candidate]


def _on_grid(scenario: Scenario) -> Candidates:
    # NPCs in lanes move to the grid: first all of them, then only one, with the same moves from the cell of the start.
    # An NPC in lanes starts in a different cell if another NPC is removed, so it often needs the others. On the grid it
    # needs none of them. The cells are right only if all eight exist around the ego.
    free = iter(
        [cell for cell in LANE_STARTS if all(chain[0].target != cell for chain in scenario.npcs)]
    )
    chains = list(scenario.npcs)
    for npc, chain in enumerate(chains):
        if isinstance(chain[0], LaneInstruction):
            cell, cells = next(free), list[PositionInstruction]()
            for gene in chain:
                cells.append(gene.on_ring(cell))
                cell = cells[-1].cell
            chains[npc] = tuple(cells)
    yield scenario.rechained(chains)
    for npc, chain in enumerate(chains):
        yield _with_chain(scenario, npc, chain)


def _alone(scenario: Scenario) -> Candidates:
    # Each NPC without the others.
    if len(scenario.npcs) == 1:
        return
    for npc in range(len(scenario.npcs)):
        yield scenario.of_npcs([npc])


def _fewer_npcs(scenario: Scenario) -> Candidates:
    # Each NPC alone, then without several NPCs with consecutive indices, the most first.
    npcs = range(len(scenario.npcs))
    yield from _alone(scenario)
    for start, end in _slices(len(npcs), len(npcs) - 1):
        yield scenario.of_npcs([*npcs[:start], *npcs[end:]])


def _cars(scenario: Scenario) -> Candidates:
    # All NPCs become cars, then only one of them.
    kinds = scenario.vehicles
    others = [npc for npc, kind in enumerate(kinds) if kind != CAR]
    if others:
        yield replace(scenario, vehicles=(CAR,) * len(kinds))
    for npc in others:
        yield scenario.with_vehicle(npc, CAR)


def _ending(scenario: Scenario) -> Candidates:
    # Remove the end of the scenario, most of it first.
    most = scenario.genes - 1
    # 1, 2, 4 ... most
    for genes in sorted({1 << power for power in range(most.bit_length())} | {most} - {0}):
        yield scenario.truncated(genes)


def _shorter(scenario: Scenario) -> Candidates:
    # Remove the end of the scenario, then any other interval, long ones first.
    yield from _ending(scenario)
    for start, end in _slices(scenario.genes, scenario.genes - 1):
        chains = list(scenario.npcs)
        for npc, chain in enumerate(chains):
            if not chain[0].crosses:
                chains[npc] = chain[:start] + chain[end:]
        yield _valid(scenario, tuple(chains))


def _later(scenario: Scenario, starts: Mapping[Scenario, Sequence[Start]]) -> Candidates:
    # The run starts at a later gene, the latest one first, with the ego's lane and speed at the start of that gene.
    for gene, (lane, speed) in reversed(list(enumerate(starts.get(scenario, ())))[1:]):
        lasting = [npc for npc, chain in enumerate(scenario.npcs) if len(chain) > gene]
        # the world sets the duration of runs, so a run can continue after the last gene
        if not lasting:
            continue
        left = scenario.of_npcs(lasting)
        npcs = tuple(chain[gene:] for chain in left.npcs)
        yield _valid(replace(left, ego_lane=lane, ego_speed=speed), npcs)


def _plainer_start(scenario: Scenario, plain: Start | None) -> Candidates:
    # The ego gets the preferred start, then only its lane, then only its speed or a rounder speed.
    if plain is None:
        return
    yield replace(scenario, ego_lane=plain[0], ego_speed=plain[1])
    yield replace(scenario, ego_lane=plain[0])
    if scenario.ego_speed == plain[1]:
        return  # The user may have fixed this speed.
    for each in (plain[1], scenario.ego_speed // 5 * 5, scenario.ego_speed // 1):
        yield replace(scenario, ego_speed=each)


def _plainer_duration(scenario: Scenario, seconds: float | None) -> Candidates:
    # Genes get the preferred duration, with the same instructions at the same times. If no instruction has a duration,
    # this has no effect, so the usual value is tried.
    if all(chain[0].crosses for chain in scenario.npcs):
        yield replace(scenario, gene_seconds=GENE_SECONDS)
        return
    if seconds is None or seconds == scenario.gene_seconds:
        return
    chains = [retimed(chain, scenario.gene_seconds, seconds) for chain in scenario.npcs]
    yield scenario.rechained(chains, seconds)


def _shorter_chains(scenario: Scenario) -> Candidates:
    # Remove parts of one chain, long ones first. After its last gene, an NPC keeps its lane and speed.
    for npc, chain in enumerate(scenario.npcs):
        for start, end in _slices(len(chain), len(chain) - 1):
            yield _with_chain(scenario, npc, chain[:start] + chain[end:])


def _merged(scenario: Scenario) -> Candidates:
    # The first or the last instruction of a part of a chain replaces the others in that part.
    for npc, chain in enumerate(scenario.npcs):
        parts = _parts(chain)
        for first, last in _slices(len(parts) - 1, len(parts) - 1):
            (start, _), (after, end) = parts[first], parts[last]
            for instruction in (chain[start], chain[after]):
                merged = chain[:start] + _lasting(instruction, end - start) + chain[end:]
                yield _with_chain(scenario, npc, merged)


def _staying(scenario: Scenario) -> Candidates:
    # An NPC stays in its previous cell or lane from one gene to the end of the chain, or of equal genes in a row.
    for npc, chain in enumerate(scenario.npcs):
        for gene, end in _parts(chain):
            before = chain[gene - 1] if gene else None
            staying = [each.staying(before) for each in chain[gene:]]
            stays = tuple(stay for stay in staying if stay is not None)
            if not stays:
                continue
            yield _with_chain(scenario, npc, chain[:gene] + stays)
            yield _with_chain(scenario, npc, chain[:gene] + stays[: end - gene] + chain[end:])


def _passing(scenario: Scenario) -> Candidates:
    # An NPC passes its zone instead of holding at its line or stopping in the zone.
    for npc, instruction in enumerate(scenario.crossings):
        if instruction is not None and instruction.act != "pass":
            yield _with_chain(scenario, npc, (replace(instruction, act="pass"),))


def _rounder(scenario: Scenario) -> Candidates:
    # A speed becomes the next lower or higher multiple of 5 m/s, then of 1 m/s.
    for npc, start, end, speed in _all_blocks(scenario):
        for unit in (FIVE, ONE):
            below = speed // unit * unit
            yield _with_speed(scenario, npc, start, end, below)
            yield _with_speed(scenario, npc, start, end, below + unit)


def _slower(scenario: Scenario) -> Candidates:
    # A speed is reduced to 0, or by 5, 1 or 0.1 m/s. The pass is repeated as long as it simplifies.
    for npc, start, end, speed in _all_blocks(scenario):
        if scenario.npcs[npc][0].crosses:
            continue
        for lower in (speed, FIVE, ONE, TENTH):
            yield _with_speed(scenario, npc, start, end, speed - lower)


def _plainer(scenario: Scenario) -> Candidates:
    # A slot becomes rounder or nearer to 0.
    for npc, instruction in enumerate(scenario.crossings):
        if instruction is None:
            continue
        for simpler in instruction.plainer():
            yield _with_chain(scenario, npc, (simpler,))


def _plain_seed(scenario: Scenario) -> Candidates:
    if scenario.seed:
        yield replace(scenario, seed=0)


def _papers_traffic(scenario: Scenario) -> Candidates:
    # Hostile traffic, which is the default, becomes the paper's. The other styles stay.
    if scenario.traffic == HOSTILE:
        yield replace(scenario, traffic=PAPERS)


STRUCTURE: tuple[Pass, ...] = (
    _on_grid,
    _fewer_npcs,
    _cars,
    _shorter,
    _merged,
    _staying,
    _shorter_chains,
    _passing,
)


def passes() -> tuple[Pass, ...]:
    """Return all passes, starting with those that shorten runs most."""
    return (*STRUCTURE, _plainer, _rounder, _slower, _plain_seed)


def _small(scenario: Scenario, found: Scenario, plain: Start, *, is_limited: bool) -> Candidates:
    # Small scenarios have one NPC with one or two instructions, or two NPCs with one each, and the ego's preferred or
    # present start. There are thousands of them, and very few fail. With `is_limited`, only some are tried, all with
    # fewer NPCs or instructions than the scenario, because the passes also find those of the same size. The NPCs are
    # cars, or all are the scenario's first vehicle that is not a car. They are on the grid, alternating with the
    # scenario's other kinds of instructions. If NPCs of the scenario cross, only a single NPC that crosses in one of
    # the zones is tried.
    size = len(scenario.npcs), instructions(scenario)
    length = found.genes  # longer chains fail more often
    if size <= (1, 2):
        length = scenario.genes
    starts = dict.fromkeys((plain, (scenario.ego_lane, scenario.ego_speed)))
    cars = replace(scenario, seed=0, vehicles=())
    begins = [replace(cars, ego_lane=lane, ego_speed=speed) for lane, speed in starts]
    kinds = [(), *((vehicle,) for vehicle in scenario.vehicles if vehicle != CAR)][:2]
    by_kind: dict[type[Instruction], list[Instruction]] = {}
    for each in sorted((chain[0] for chain in found.npcs), key=lambda each: each.on_grid):
        by_kind.setdefault(type(each), []).append(each)
    genes = {kind: tuple(kind.small(each, SMALL_SPEEDS)) for kind, each in by_kind.items()}
    genes[PositionInstruction] = tuple(PositionInstruction.small((), SMALL_SPEEDS))
    of_kinds: list[Sequence[Sized]] = []
    for kind, chosen in genes.items():
        if kind.crosses:
            of_kinds.append([((1, 1), ((gene,),)) for gene in chosen])
        elif not found.crossings:
            of_kinds.append(_small_ones(chosen, length))
    small = (each for several in zip_longest(*of_kinds) for each in several if each)
    tried = 0
    for (its_size, npcs), begin, vehicles in product(small, begins, kinds):
        if its_size < size or (its_size == size and not is_limited):
            if is_limited and tried == MOST_SMALL:
                return
            tried += 1
            yield _valid(begin, npcs, vehicles * len(npcs))


@lru_cache(maxsize=16)
def _small_ones(genes: Sequence[Instruction], length: int) -> Sequence[Sized]:
    # The order is mixed, so that the start of the list, however short, has scenarios of each kind. If the most
    # promising ones came first, a limited number of runs would find less.
    ones = [_lasting(gene, times) for gene in genes for times in dict.fromkeys((1, length))]
    small: list[Sized] = [((1, 1), (chain,)) for chain in ones]
    if length > 1:
        for first, second in permutations(genes, 2):
            small.append(((1, 2), ((first, *_lasting(second, length - 1)),)))
    small += (((2, 2), pair) for pair in combinations(ones, 2))
    order = sorted(range(len(small)), key=lambda number: number * GOLDEN % 2**64)
    return [small[number] for number in order]


def _two_steps(scenario: Scenario) -> Candidates:
    # Two simplifications together, if neither works alone, starting with the smallest ones.
    steps = (each for simplified in STRUCTURE for each in simplified(scenario))
    firsts = dict.fromkeys(each for each in steps if each is not None)
    for first in sorted(firsts, key=sort_key, reverse=True)[:MOST_FIRST_STEPS]:
        for simplified in STRUCTURE:
            yield from simplified(first)


def _slices(length: int, most: int) -> Iterator[tuple[int, int]]:
    # [start, end) of consecutive slices of length `most`, then of half that length, and so on down to 1.
    while most > 0:
        yield from ((start, start + most) for start in range(0, length - most + 1, most))
        most //= 2


def _all_blocks(scenario: Scenario) -> Iterator[tuple[int, int, int, int]]:
    # The NPC, [start, end) and the speed in tenths of m/s of each part of its chain.
    for npc, chain in enumerate(scenario.npcs):
        for start, end in _parts(chain):
            yield npc, start, end, _tenths(chain[start])


def _parts(chain: Chromosome) -> list[tuple[int, int]]:
    # Equal instructions in a row are one part, and each lane change is one.
    starts = [0]
    for gene, (before, instruction) in enumerate(pairwise(chain), 1):
        if not continues(before, instruction):
            starts.append(gene)
    return list(pairwise([*starts, len(chain)]))


def _lasting(instruction: Instruction, genes: int) -> Chromosome:
    # An NPC changes lanes only in the first of several genes.
    return (instruction, *(instruction.afterwards,) * (genes - 1))


def _with_speed(scenario: Scenario, npc: int, start: int, end: int, tenths: int) -> Scenario | None:
    chain = scenario.npcs[npc]
    if _mps(tenths) < chain[0].least_speed:
        return None
    changed = tuple(gene.with_speed(_mps(tenths)) for gene in chain[start:end])
    return _with_chain(scenario, npc, chain[:start] + changed + chain[end:])


def _with_chain(scenario: Scenario, npc: int, chain: Chromosome) -> Scenario | None:
    return _valid(scenario, (*scenario.npcs[:npc], chain, *scenario.npcs[npc + 1 :]))


def _valid(
    scenario: Scenario,
    npcs: tuple[Chromosome, ...],
    vehicles: tuple[VehicleType, ...] | None = None,
) -> Scenario | None:
    # None if the chains or vehicles break a rule.
    if vehicles is None:
        vehicles = scenario.vehicles
    try:
        return replace(scenario, npcs=npcs, vehicles=vehicles)
    except ScenarioError:  # for an empty chain, a leap across the ring, or two NPCs in one cell
        return None


def _moves(chain: Chromosome) -> int:
    # Changes of cell or lane, and 1 for an NPC that crosses but does not pass.
    return sum(each.moves(before) for before, each in zip((None, *chain), chain, strict=False))


def _tenths(instruction: Instruction) -> int:
    return round(instruction.speed * SPEED_STEPS_PER_MPS)


def _mps(tenths: int) -> float:
    return tenths / SPEED_STEPS_PER_MPS
