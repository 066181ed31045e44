"""Shrinking: the simplest scenario in which the same property fails with the same signature.

After Zeller and Hildebrandt, "Simplifying and isolating failure-inducing input" (IEEE TSE 28(2), 2002), and
MacIver and Donaldson, "Test-case reduction via test-case generation" (ECOOP 2020): an order that says what "simpler"
means, one gate before each run, and passes that are repeated until none of them helps. What single steps do not lead
to is often found by trying small scenarios as such.
Nothing is simulated here: whether a scenario still fails is asked of a function.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import combinations, pairwise, permutations, product
from typing import Any

from pytest_pafot.model.driving_style import PAPERS, Traffic
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import (
    EGO_LANE,
    EGO_SPEED,
    GENE_SECONDS,
    MAX_SPEED,
    SHIFTS,
    SLOT_STEPS_PER_SECOND,
    SPEED_STEPS_PER_MPS,
    Chromosome,
    CrossingInstruction,
    Gene,
    LaneInstruction,
    PositionInstruction,
    Scenario,
    ScenarioError,
    gene_of,
    retimed,
)
from pytest_pafot.support.text import plural

Attempt = Callable[[Scenario], Scenario | None]
"""Runs a scenario: the scenario as driven where the same property fails with the same signature, else None."""

Start = tuple[int, float]
"""The ego's lane and speed [m/s] when a gene begins."""

Starts = Callable[[Scenario], Sequence[Start]]
"""The start of each gene of a scenario as driven that failed; empty where it is not known."""

Candidates = Iterator[Scenario | None]
"""What a pass tries; None stands for a change that gives no valid scenario."""

Pass = Callable[[Scenario], Candidates]

Sized = tuple[tuple[int, int], tuple[Chromosome, ...]]
"""Chains with the numbers of NPCs and of instructions in them."""

FIVE, ONE, TENTH = 5 * SPEED_STEPS_PER_MPS, SPEED_STEPS_PER_MPS, 1
"""Steps of speed, from rough to fine, in tenths of m/s like all speeds inside of this module."""

SECOND, HALF = SLOT_STEPS_PER_SECOND, SLOT_STEPS_PER_SECOND // 2
"""Steps of a slot, in tenths of a second."""


SMALL_SPEEDS = (0.0, 10.0, 20.0, 25.0)
"""Of the instructions of small scenarios [m/s]; other speeds come of the passes on what is found."""

SMALL_SLOTS = (0.0, 0.5, -0.5, 1.0, -1.0, 2.0)
"""Of NPCs that cross in small scenarios [s]."""

FIRST_PART = 10
"""One run of so many is for small scenarios before anything else is tried, so that small budgets serve the passes."""

FOR_SPEEDS = 60
"""Runs that are left for how far the speeds of the result can be changed, at most a fifth of the budget."""

MOST_FIRST_STEPS = 40
"""How many simplifications are tried together with another one."""

GOLDEN = 0x9E3779B97F4A7C15
"""2**64 over the golden ratio: its multiples modulo 2**64 are spread evenly, however many there are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedInterval:
    """The target speeds of one instruction at which the scenario still fails, everything else being equal.

    The ends are found by steps that double while the scenario fails and are halved where it does not. All speeds
    that were tried between them fail; those in between were not all tried.

    Attributes:
        npc, gene: where the instruction first stands in the scenario.
        low, high: [m/s].
    """

    npc: int
    gene: int
    low: float
    high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Shrunk:
    """How a scenario became simpler.

    Attributes:
        rollouts: runs that it took.
        is_minimal: whether everything simpler that is tried was tried within the budget, and passes: each single step
            of the passes, each small scenario (one NPC with one or two instructions, two with one each, of few
            speeds; or one that crosses, in a zone of the scenario, with few slots), and pairs of a limited number of
            steps. It says nothing of what is not in these lists.
        speeds: for each instruction of the simpler scenario, by NPC and gene, the speeds at which it still fails; as
            far as the budget reached.
    """

    rollouts: int
    is_minimal: bool = True
    speeds: tuple[SpeedInterval, ...] = ()


class OutOfBudget(Exception):  # noqa: N818  (it ends the passes and is no error)
    """No runs are left, or no time for them."""


def sort_key(scenario: Scenario) -> tuple[int, ...]:
    """The order of "simpler": of two scenarios the one with the smaller key, compared from the left.

    1. NPCs, since each of them is a participant to understand.
    2. Instructions to read: equal ones that follow each other count once.
    3. Moves from one cell or lane to another; staying is simpler. Of who crosses, holding or stopping; passing is
       simpler.
    4. Genes of the longest chain, which is the length of the run; then genes in total.
    5. How the ego starts: in lane 1 and at 22 m/s before anything else, of which round speeds come first; and genes of
       10 s before those of another duration.
    6. How rough the speeds are: multiples of 5 m/s before whole ones before tenths; and slots: whole seconds before
       halves before tenths.
    7. The sum of the speeds of the instructions: slower is simpler. Of who crosses, how far its slot is from 0, and not
       its speed.
    8. The traffic: the paper's has no rules of its own.
    9. The seed of the repair, of which 0 is the plainest.

    Every part is a whole number, at least 0, so that every chain of simplifications ends.
    """
    speeds = [_tenths(chain[start]) for chain in scenario.npcs for start, _ in blocks(chain)]
    slots = [round(abs(each.slot) * SLOT_STEPS_PER_SECOND) for each in scenario.crossings if each is not None]
    crossing = sum(_tenths(each) for each in scenario.crossings if each is not None)
    start = round(scenario.ego_speed * SPEED_STEPS_PER_MPS)
    return (
        len(scenario.npcs),
        len(speeds),
        sum(map(_moves, scenario.npcs)),
        scenario.genes,
        sum(map(len, scenario.npcs)),
        (scenario.ego_lane != EGO_LANE)
        + (scenario.ego_speed != EGO_SPEED and 1 + _roughness(start))
        + (scenario.gene_seconds != GENE_SECONDS),
        sum(map(_roughness, speeds)) + sum((slot % SECOND > 0) + (slot % HALF > 0) for slot in slots),
        sum(speeds) - crossing + sum(slots),
        int(scenario.traffic != PAPERS),
        scenario.seed,
    )


def _roughness(tenths: int) -> int:
    return (tenths % FIVE > 0) + (tenths % ONE > 0)


def instructions(scenario: Scenario) -> int:
    """How many instructions there are to read; equal ones that follow each other count once."""
    return sort_key(scenario)[1]


def size_of(scenario: Scenario, longest_run: float = math.inf) -> str:
    """The size of a scenario in words, given the world's longest run [s]: ``2 NPCs, 7 instructions, 60 s``."""
    npcs, told = plural(len(scenario.npcs), "NPC"), plural(instructions(scenario), "instruction")
    return f"{npcs}, {told}, {min(scenario.seconds, longest_run):g} s"


def shrink(
    scenario: Scenario,
    attempt: Attempt,
    *,
    rollouts: int,
    top_speed: float = MAX_SPEED,
    starts: Starts = lambda scenario: (),
    plain: Start | None = None,
    plain_seconds: float | None = None,
) -> tuple[Scenario, Shrunk]:
    """The simplest scenario that was found to fail in the same way as one that fails, as driven; and how it came about.

    Args:
        scenario: as driven; it fails.
        attempt: never asked twice about the same scenario, and in the same order as long as it answers alike; what
            ends it before its rollouts is to raise :class:`OutOfBudget` from then on.
        rollouts: how often it may be asked.
        top_speed: that no instruction may exceed [m/s].
        starts: lets a scenario begin later, in the ego's state of that moment.
        plain: at which the ego shall rather start.
        plain_seconds: that a gene shall rather last [s].
    """
    top = int(min(top_speed, MAX_SPEED) * SPEED_STEPS_PER_MPS + 1e-6)
    tried: dict[Scenario, Scenario | None] = {scenario: scenario}
    slowest = min(_tenths(gene) for chain in scenario.npcs for gene in chain)
    least = 0.0 if top_speed == MAX_SPEED else scenario.traffic.least_speed(top_speed)
    low = min(round(least * SPEED_STEPS_PER_MPS), slowest)
    gate = _Gate(best=scenario, attempt=attempt, rollouts=rollouts // FIRST_PART, low=low, top=top, tried=tried)
    intervals: list[SpeedInterval] = []
    is_minimal = False
    plainer: Pass = partial(_plainer_start, plain=plain)
    longer: Pass = partial(_plainer_duration, seconds=plain_seconds)
    deletions: tuple[Pass, ...] = (plainer, longer, *PASSES, partial(_later, starts=starts))
    small = partial(_small, found=scenario, plain=plain or (scenario.ego_lane, scenario.ego_speed))
    with suppress(OutOfBudget):
        gate.exhausts(plainer)
        gate.exhausts(small)
    gate.rollouts = rollouts - min(FOR_SPEEDS, rollouts // 5)
    with suppress(OutOfBudget):
        while sum(map(gate.exhausts, deletions)) or gate.exhausts(small) or gate.exhausts(_two_steps):
            pass  # Each of the deletions in every round; what takes many runs when they find nothing more.
        is_minimal = True
    gate.rollouts = rollouts
    with suppress(OutOfBudget):
        gate.exhausts(_papers_traffic)  # once, also where the passes spent their budget: they are not begun again
        intervals.extend(_intervals(gate))
    return gate.best, Shrunk(rollouts=gate.spent, is_minimal=is_minimal, speeds=tuple(intervals))


@dataclass(slots=True, kw_only=True)
class _Gate:
    """The one gate before each run: a candidate must be valid, simpler than the best, and not tried before.

    Scenarios are equal when their canonical texts are: speeds in tenths, cells in 1 to 8.
    """

    best: Scenario
    attempt: Attempt
    rollouts: int
    low: int
    top: int
    tried: dict[Scenario, Scenario | None]
    spent: int = 0

    def simplifies(self, candidate: Scenario | None) -> bool:
        """Whether a candidate fails likewise and is simpler; it is the best from then on."""
        if candidate is None or sort_key(candidate) >= sort_key(self.best):
            return False
        driven = self.driven(candidate)
        if driven is None or sort_key(driven) >= sort_key(self.best):
            return False
        self.best = driven
        return True

    def exhausts(self, candidates: Pass) -> bool:
        """Apply a pass until it finds nothing more; whether it found anything."""
        found = False
        while any(self.simplifies(candidate) for candidate in candidates(self.best)):
            found = True
        return found

    def driven(self, candidate: Scenario) -> Scenario | None:
        """The candidate as driven where it fails likewise.

        Raises:
            OutOfBudget: when that is not known and no runs, or no time, are left.
        """
        if any(not self.low <= _tenths(gene) <= self.top for chain in candidate.npcs for gene in chain):
            return None
        if candidate not in self.tried:
            if self.spent >= self.rollouts:
                raise OutOfBudget
            driven = self.tried[candidate] = self.attempt(candidate)
            self.spent += 1  # after the attempt, which may refuse as well
            if driven is not None:
                self.tried[driven] = driven  # A scenario as driven is a fixed point of the repair.
        return self.tried[candidate]


def _fewer_npcs(scenario: Scenario) -> Candidates:
    """One alone, then all but a run of them, long runs first."""
    npcs = scenario.npcs
    for npc in npcs if len(npcs) > 1 else ():
        yield replace(scenario, npcs=(npc,))
    for start, end in _slices(len(npcs), len(npcs) - 1):
        yield replace(scenario, npcs=npcs[:start] + npcs[end:])


def _shorter(scenario: Scenario) -> Candidates:
    """Without the tail, then without any other stretch of time, long ones first."""
    most = scenario.genes - 1
    for genes in sorted({1 << power for power in range(most.bit_length())} | {most} - {0}):  # 1, 2, 4 ... most
        yield scenario.truncated(genes)
    for start, end in _slices(scenario.genes, most):
        cut = (chain if _crosses(chain) else chain[:start] + chain[end:] for chain in scenario.npcs)
        yield _valid(scenario, tuple(cut))


def _later(scenario: Scenario, starts: Starts) -> Candidates:
    """From a later gene on, the ego in the lane and at the speed that it had come to; the latest first."""
    for gene, (lane, speed) in reversed(list(enumerate(starts(scenario)))[1:]):
        npcs = tuple(chain[gene:] for chain in scenario.npcs if len(chain) > gene)
        yield _valid(replace(scenario, ego_lane=lane, ego_speed=speed), npcs)


def _plainer_start(scenario: Scenario, plain: Start | None) -> Candidates:
    """The ego at the plain start, then in its lane or at its speed, then at a round speed where it has not that one."""
    if plain is None:
        return
    yield replace(scenario, ego_lane=plain[0], ego_speed=plain[1])
    yield replace(scenario, ego_lane=plain[0])
    if scenario.ego_speed == plain[1]:
        return  # Whoever searches may have fixed it.
    for each in (plain[1], scenario.ego_speed // 5 * 5, scenario.ego_speed // 1):
        yield replace(scenario, ego_speed=each)


def _plainer_duration(scenario: Scenario, seconds: float | None) -> Candidates:
    """Genes that last as long as those of a search that does not draw it, and ask for the same at the same times.

    Where all NPCs cross, which know no duration, the usual one.
    """
    if all(map(_crosses, scenario.npcs)):
        yield replace(scenario, gene_seconds=GENE_SECONDS)
        return
    if seconds is None or seconds == scenario.gene_seconds:
        return
    chains = [retimed(chain, scenario.gene_seconds, seconds) for chain in scenario.npcs]
    yield scenario.rechained(chains, seconds)


def _shorter_chains(scenario: Scenario) -> Candidates:
    """Without a stretch of one NPC's chain, long ones first; after its last gene it keeps its lane and speed."""
    for npc, chain in enumerate(scenario.npcs):
        for start, end in _slices(len(chain), len(chain) - 1):
            yield _with_chain(scenario, npc, chain[:start] + chain[end:])


def _merged(scenario: Scenario) -> Candidates:
    """A whole chain of one instruction, or one that takes over the block before or after it."""
    for npc, chain in enumerate(scenario.npcs):
        for instruction in dict.fromkeys(chain):
            yield _with_chain(scenario, npc, (instruction,) * len(chain))
        for (start, middle), (_, end) in pairwise(blocks(chain)):
            before, after = chain[start], chain[middle]
            yield _with_chain(scenario, npc, chain[:middle] + (before,) * (end - middle) + chain[end:])
            yield _with_chain(scenario, npc, chain[:start] + (after,) * (middle - start) + chain[middle:])


def _staying(scenario: Scenario) -> Candidates:
    """From one gene to the end, or to the end of its block, an NPC stays in the cell or lane that it was in before."""
    for npc, chain in enumerate(scenario.npcs):
        for gene, end in blocks(chain):
            before = chain[max(gene - 1, 0)]
            if isinstance(before, LaneInstruction):
                stays: Chromosome = tuple(LaneInstruction("keep", each.speed) for each in chain[gene:])
            elif gene > 0 and isinstance(before, PositionInstruction):
                stays = tuple(PositionInstruction(before.cell, each.speed) for each in chain[gene:])
            else:
                continue
            yield _with_chain(scenario, npc, chain[:gene] + stays)
            yield _with_chain(scenario, npc, chain[:gene] + stays[: end - gene] + chain[end:])


def _passing(scenario: Scenario) -> Candidates:
    """An NPC that held at its line, or stopped in its zone, drives through it."""
    for npc, each in enumerate(scenario.crossings):
        if each is not None and each.act != "pass":
            yield _with_chain(scenario, npc, (replace(each, act="pass"),))


def _plainer_slots(scenario: Scenario) -> Candidates:
    """A slot of 0, the whole and half seconds next to it, and what is nearer to 0 by a second, a half or a tenth."""
    for npc, each in enumerate(scenario.crossings):
        if each is None:
            continue
        slot = round(each.slot * SLOT_STEPS_PER_SECOND)
        rounded = [below for unit in (SECOND, HALF) for below in (slot // unit * unit, -(-slot // unit) * unit)]
        nearer = [slot - math.copysign(step, slot) for step in (SECOND, HALF, 1) if step <= abs(slot)]
        for tenths in dict.fromkeys((0, *rounded, *nearer)):
            yield _with_chain(scenario, npc, (replace(each, slot=tenths / SLOT_STEPS_PER_SECOND),))


def _rounder(scenario: Scenario) -> Candidates:
    """The multiples of 5 m/s, then of 1 m/s, next to a speed."""
    for npc, start, end, speed in _all_blocks(scenario):
        for unit in (FIVE, ONE):
            below = speed // unit * unit
            yield _with_speed(scenario, npc, start, end, below)
            yield _with_speed(scenario, npc, start, end, below + unit)


def _slower(scenario: Scenario) -> Candidates:
    """To a standstill, or down by 5, 1 or 0.1 m/s; the pass is repeated as long as that helps."""
    for npc, start, end, speed in _all_blocks(scenario):
        for lower in (speed, FIVE, ONE, TENTH) if not _crosses(scenario.npcs[npc]) else ():
            yield _with_speed(scenario, npc, start, end, speed - lower)


def _plain_seed(scenario: Scenario) -> Candidates:
    if scenario.seed:
        yield replace(scenario, seed=0)


def _papers_traffic(scenario: Scenario) -> Candidates:
    """The paper's traffic instead of the hostile one, which is the default; the other styles stay."""
    if scenario.traffic == Traffic():
        yield replace(scenario, traffic=PAPERS)


STRUCTURE: tuple[Pass, ...] = (_fewer_npcs, _shorter, _merged, _staying, _shorter_chains, _passing)
PASSES: tuple[Pass, ...] = (*STRUCTURE, _plainer_slots, _rounder, _slower, _plain_seed)
"""What a run saves most comes first; all are repeated until none of them finds anything."""


def _small(scenario: Scenario, found: Scenario, plain: Start) -> Candidates:
    """One NPC with one or two instructions, or two with one each; at the ego's plain start, and the present one.

    Where somebody crosses, one NPC that crosses in a zone of the scenario.
    """
    size = len(scenario.npcs), instructions(scenario)
    length = scenario.genes if size <= (1, 2) else found.genes  # A run ends with the failure; the longer, the more.
    targets = SHIFTS if isinstance(found.npcs[0][0], LaneInstruction) else tuple(Cell)
    starts = dict.fromkeys((plain, (scenario.ego_lane, scenario.ego_speed)))
    begins = [replace(scenario, seed=0, ego_lane=lane, ego_speed=speed) for lane, speed in starts]
    small = _small_crossings(found) if found.crossings else _small_ones(targets, length)
    for (its_size, npcs), begin in product(small, begins):
        if its_size <= size:
            yield _valid(begin, npcs)


def _small_crossings(found: Scenario) -> Sequence[Sized]:
    told = [each for each in found.crossings if each is not None]
    speeds = dict.fromkeys((each.zone, round(each.speed / unit) * unit) for unit in (5.0, 1.0) for each in told)
    ones = [CrossingInstruction(zone, slot, speed) for slot in SMALL_SLOTS for zone, speed in speeds if speed > 0]
    return [((1, 1), ((each,),)) for each in ones]


@lru_cache(maxsize=16)
def _small_ones(targets: Sequence[Any], length: int) -> Sequence[Sized]:
    """Every small scenario's numbers of NPCs and instructions, and chains.

    In an order in which any beginning of the list has some of each kind: the most promising first finds fewer.
    """
    genes = [gene_of(target, speed) for target in targets for speed in SMALL_SPEEDS]
    ones = [(gene,) * times for gene in genes for times in dict.fromkeys((1, length))]
    twos = [(first, *(second,) * (length - 1)) for first, second in permutations(genes, 2) if length > 1]
    small: list[Sized] = [*(((1, 1), (chain,)) for chain in ones), *(((1, 2), (chain,)) for chain in twos)]
    small += (((2, 2), pair) for pair in combinations(ones, 2))
    return [each for _, each in sorted(enumerate(small), key=lambda numbered: numbered[0] * GOLDEN % 2**64)]


def _two_steps(scenario: Scenario) -> Candidates:
    """Two simplifications at once, neither of which is one alone; of the first those that leave most."""
    firsts = dict.fromkeys(each for simplified in STRUCTURE for each in simplified(scenario) if each is not None)
    for first in sorted(firsts, key=sort_key, reverse=True)[:MOST_FIRST_STEPS]:
        for simplified in STRUCTURE:
            yield from simplified(first)


def _intervals(gate: _Gate) -> Iterator[SpeedInterval]:
    """For every instruction, how far its speed can go down and up while the scenario fails."""
    scenario = gate.best
    for npc, start, end, speed in _all_blocks(scenario):

        def fails(change: int, npc: int = npc, start: int = start, end: int = end, speed: int = speed) -> bool:
            candidate = _with_speed(scenario, npc, start, end, speed + change)
            return candidate is not None and gate.driven(candidate) is not None

        down = _furthest(fails, -1, most=speed)
        up = _furthest(fails, 1, most=max(gate.top - speed, 0))
        yield SpeedInterval(npc=npc, gene=start, low=_mps(speed - down), high=_mps(speed + up))


def _furthest(holds: Callable[[int], bool], direction: int, most: int) -> int:
    """The largest number of steps found, at most ``most``, for which something holds; it holds for 0.

    The steps double while it holds and are then halved: the number of questions grows with the logarithm.
    """
    good, bad = 0, min(ONE, most)
    while bad > good and holds(direction * bad):
        good, bad = bad, min(2 * bad, most)
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if holds(direction * middle) else (good, middle)
    return good


def _slices(length: int, most: int) -> Iterator[tuple[int, int]]:
    """[start, end) of all runs that are ``most`` long, then half as long, and so on down to 1."""
    while most > 0:
        yield from ((start, start + most) for start in range(length - most + 1))
        most //= 2


def _all_blocks(scenario: Scenario) -> Iterator[tuple[int, int, int, int]]:
    """NPC, [start, end) and speed of each block."""
    for npc, chain in enumerate(scenario.npcs):
        for start, end in blocks(chain):
            yield npc, start, end, _tenths(chain[start])


def blocks(chain: Chromosome) -> list[tuple[int, int]]:
    """[start, end) of each run of equal instructions."""
    starts = [gene for gene in range(len(chain)) if gene == 0 or chain[gene] != chain[gene - 1]]
    return list(pairwise([*starts, len(chain)]))


def _with_speed(scenario: Scenario, npc: int, start: int, end: int, tenths: int) -> Scenario | None:
    chain = scenario.npcs[npc]
    if tenths < 0 or (tenths == 0 and _crosses(chain)):
        return None
    changed = tuple(replace(gene, speed=_mps(tenths)) for gene in chain[start:end])
    return _with_chain(scenario, npc, chain[:start] + changed + chain[end:])


def _with_chain(scenario: Scenario, npc: int, chain: Chromosome) -> Scenario | None:
    return _valid(scenario, (*scenario.npcs[:npc], chain, *scenario.npcs[npc + 1 :]))


def _valid(scenario: Scenario, npcs: tuple[Chromosome, ...]) -> Scenario | None:
    """The scenario with other chains, or None where these break a rule."""
    try:
        return replace(scenario, npcs=npcs)
    except ScenarioError:  # An empty chain, a leap across the ring, or two NPCs in one cell.
        return None


def _crosses(chain: Chromosome) -> bool:
    return isinstance(chain[0], CrossingInstruction)


def _moves(chain: Chromosome) -> int:
    """Changes of cell; of lane those that Lane-Instructions ask for; 1 for who crosses and does not pass."""
    if isinstance(chain[0], CrossingInstruction):
        return int(chain[0].act != "pass")
    cells = [instruction.cell for instruction in chain if isinstance(instruction, PositionInstruction)]
    shifts = sum(isinstance(each, LaneInstruction) and each.lane != "keep" for each in chain)
    return shifts + sum(a != b for a, b in pairwise(cells))


def _tenths(instruction: Gene) -> int:
    return round(instruction.speed * SPEED_STEPS_PER_MPS)


def _mps(tenths: int) -> float:
    return tenths / SPEED_STEPS_PER_MPS
