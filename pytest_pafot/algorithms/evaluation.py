"""The evaluation and ranking of runs, and the events and health of a search."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Self

import numpy as np

from pytest_pafot.algorithms.space import repaired
from pytest_pafot.criticality import min_gap, time_advantage, ttc
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import HEADING, LANE, SPEED, Collision, Outcome, Trace
from pytest_pafot.support.text import plural

# A sort key for runs: eligible, failing, fitness. The first element that differs decides; greater is worse for the ego.
Rank = tuple[bool, bool, float]

# An NPC in the ego's lane interacts with the ego if the headway or the gap is below these limits. NPCs start at a
# headway of 2 s, so the start alone is not an interaction.
INTERACTION_HEADWAY = 1.5  # [s]
INTERACTION_GAP = 2.0  # [m]

# Mean speed of the ego below which a run tests nothing [m/s]. An ego that brakes from 22 m/s and then stays stationary
# has a lower mean speed over 30 s.
BARELY_MOVING = 2.0

# A vehicle is close to the ego if the two would touch within this time at constant speeds and headings [s].
CLOSE = 2.0

LEAVING = {Outcome.OFF_ROAD: "the ego left the road", Outcome.LEFT_ROUTE: "the ego left its route"}

_IMPOSSIBLE: Rank = (False, False, -math.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """A scenario with the results of its run.

    Attributes:
        scenario: the requested scenario.
        executed: the scenario as executed, with repairs during the run.
        fitness: higher is worse for the ego; NaN if the measure failed.
        failing: whether the test function or the ADS failed.
        outcome: how the run ended.
        duration: simulated time [s].
        genes_started: number of genes, over all NPCs, that started before the end of the run.
        genes_reached: number of these genes whose cell or lane the NPC reached.
        interaction: see :func:`has_interaction`.
        discarded: whether the test function rejected or skipped the run, or the process died.
        barely_moved: whether the ego's mean speed was below 2 m/s.
        kind: kind of failure, equal for failures that count as the same; None if unknown.
        margins: name and worst margin of each check, sorted by name.
        collision: the collision in the run, or None.
        ended: see :func:`ended_by`.
        gap: smallest gap to a vehicle [m] if the run ended early, otherwise infinite.
        is_close: whether a vehicle was within two seconds of the ego when the run ended early.
        note: data that the evaluating function adds.
    """

    scenario: Scenario
    executed: Scenario
    fitness: float = field(compare=False)
    failing: bool
    outcome: Outcome
    duration: float
    genes_started: int
    genes_reached: int
    interaction: bool
    discarded: bool = False
    barely_moved: bool = False
    kind: Hashable | None = None
    margins: tuple[tuple[str, float], ...] = ()
    collision: Collision | None = None
    ended: str = ""
    gap: float = math.inf
    is_close: bool = False
    note: Any = field(default=None, compare=False, repr=False)
    # compared instead of `fitness`, because NaN is not equal to itself
    _measured: float | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        fitness = float(self.fitness)
        object.__setattr__(self, "fitness", fitness)
        object.__setattr__(self, "_measured", None if math.isnan(fitness) else fitness)

    @classmethod
    def from_trace(
        cls,
        trace: Trace,
        *,
        fitness: float,
        failing: bool,
        discarded: bool = False,
        kind: Hashable | None = None,
        margins: tuple[tuple[str, float], ...] = (),
        note: Any = None,
    ) -> Self:
        ended = ended_by(trace)
        return cls(
            scenario=trace.scenario,
            executed=trace.executed,
            fitness=fitness,
            failing=failing,
            outcome=trace.outcome,
            duration=trace.duration,
            genes_started=sum(map(len, trace.arrivals)),
            genes_reached=sum(
                [tick is not None for arrivals in trace.arrivals for tick in arrivals]
            ),
            interaction=has_interaction(trace),
            discarded=discarded,
            barely_moved=bool(np.mean(trace.ego[:, SPEED]) < BARELY_MOVING),
            kind=kind,
            margins=margins,
            collision=trace.collision,
            ended=ended,
            gap=min(math.inf, min_gap(trace)) if ended else math.inf,  # infinite instead of NaN
            is_close=bool(ended and (ttc(trace)[-1] < CLOSE).any()),
            note=note,
        )

    @property
    def eligible(self) -> bool:
        """True if the run is valid and has a verdict and a fitness, so that it can become the best."""
        return not (self.outcome is Outcome.INVALID or self.discarded or math.isnan(self.fitness))

    @property
    def rank(self) -> Rank:
        """The key that orders runs in a search, first by whether they fail and then by fitness."""
        # Runs that are not eligible are equal and last, even if they fail: an invalid run shows nothing about the ego,
        # and NaN cannot be compared.
        return (True, self.failing, self.fitness) if self.eligible else _IMPOSSIBLE

    @property
    def depth(self) -> int:
        """The number of genes per NPC that affected the run."""
        # The genes of all NPCs start at the same times, so their total number determines the number per NPC.
        lengths = [len(chain) for chain in self.executed.npcs]
        longest = max(lengths)
        if self.genes_started <= 0:
            return longest
        if min(lengths) == longest:
            return min(-(-self.genes_started // len(lengths)), longest)
        enough = (
            depth
            for depth in range(1, longest)
            if sum(min(n, depth) for n in lengths) >= self.genes_started
        )
        return next(enough, longest)


Population = tuple[Evaluation, ...]


def has_interaction(trace: Trace) -> bool:
    """Return whether an NPC gave the ego a reason to react."""
    # Reasons are a collision, a short headway or gap in the ego's lane, and a close crossing.
    if trace.outcome is Outcome.COLLISION:
        return True
    road = trace.road
    speed = road.column(SPEED)
    lane = road.column(LANE)
    # How far each NPC's centre is ahead of the ego's [m], along the ego's heading or, on curved roads, its path.
    if road.is_straight:
        heading = road.column(HEADING)[0]
        along = (road.x[1:] - road.x[0]) * np.cos(heading)
        ahead = along + (road.y[1:] - road.y[0]) * np.sin(heading)
    else:
        ahead = road.ahead
    lengths = trace.sizes[:, :1]
    gap = np.abs(ahead) - (lengths[0] + lengths[1:]) / 2
    follower = np.where(ahead >= 0, speed[0], speed[1:])
    is_near = gap < np.maximum(INTERACTION_HEADWAY * follower, INTERACTION_GAP)
    if ((lane[1:] == lane[0]) & is_near).any():
        return True
    return any(trace.zones) and bool((time_advantage(trace) < INTERACTION_HEADWAY).any())


def ended_by(trace: Trace) -> str:
    """Return why a run ended early without a collision, or an empty string if it did not."""
    ended = trace.ended
    # If highway-env itself ends a run, as in its merges and intersections, the road ends there.
    if ended and not ended.startswith("highway_env."):
        return ended
    if trace.outcome not in LEAVING:
        return ""
    if ended:
        return ".".join(ended.split(".")[-2:])  # without the module
    if trace.off_road_tick in (None, trace.ticks):
        return LEAVING[trace.outcome]
    return ""


# Results of earlier runs of a search, so that none of the last ten thousand runs is simulated twice.

Chains = tuple[tuple[Hashable, ...], ...]  # one number per gene, or the whole gene
_Key = tuple[object, ...]
_Place = tuple[_Key, int | None]  # a key, and the seed if it matters

# The largest number of remembered runs. They take 25 MB with two NPCs, and 90 MB with six.
EVALUATIONS = 10_000


class EvaluationCache:
    """A cache of evaluations. Its keys contain everything on which the runs depended.

    Args:
        evaluations: evaluations that are known from the start.
        seeds_matter: True if the seed affects more than the repair.
    """

    def __init__(
        self,
        evaluations: Iterable[Evaluation] = (),
        *,
        seeds_matter: bool = False,
    ) -> None:
        self._seeds_matter = seeds_matter
        # by key, then by the seed if it matters
        self._evaluations: dict[_Key, dict[int | None, Evaluation]] = {}
        self._depths: list[int] = []
        # for each run, the oldest first, the places that only it occupies
        self._runs: deque[list[_Place]] = deque()
        for evaluation in evaluations:
            self.add(evaluation)

    def add(self, evaluation: Evaluation) -> None:
        """Add a run to the cache. If several runs have the same key, the first one is kept."""
        if evaluation.depth not in self._depths:
            self._depths = sorted([*self._depths, evaluation.depth])
        own = []
        for key, needed in self._places(evaluation):
            known = self._evaluations.setdefault(key, {})
            if needed not in known:
                known[needed] = evaluation
                own.append((key, needed))
        self._runs.append(own)

    def _places(self, evaluation: Evaluation) -> list[_Place]:
        """Return a run's keys, made from its executed and its requested chains."""
        scenario = evaluation.scenario
        asked = plain_chains(scenario)
        driven = plain_chains(evaluation.executed)
        seed = scenario.seed if self._seeds_matter else None
        places: list[_Place] = [(_key(scenario, driven, evaluation.depth), seed)]
        if asked != driven:
            places.append((_key(scenario, asked, evaluation.depth), scenario.seed))
        return places

    def forget(self, room: int = EVALUATIONS) -> None:
        """Remove the oldest runs until at most ``room`` are left."""
        while len(self._runs) > room:
            for key, needed in self._runs.popleft():
                del self._evaluations[key][needed]
                if not self._evaluations[key]:
                    del self._evaluations[key]

    def recall(self, scenario: Scenario) -> Evaluation | None:
        """Return the evaluation that a run of the scenario would have, or None if it is unknown."""
        # A run that ended in gene d depended only on the start and on the first d genes of each NPC. Another scenario
        # has the same run if these genes equal the executed ones, which the repair does not change for any seed. It
        # also has the same run if they equal the requested ones and the seeds are equal. If `seeds_matter`, the seeds
        # must be equal in both cases.
        chains = plain_chains(scenario)
        for depth in self._depths:
            runs = self._evaluations.get(_key(scenario, chains, depth))
            if runs is None:
                continue
            if None in runs:
                return replace(runs[None], scenario=scenario, executed=scenario)
            if scenario.seed in runs:
                known = runs[scenario.seed]
                pairs = zip(known.executed.npcs, scenario.npcs, strict=True)
                # Genes after the end of the earlier run are taken from the new scenario, so that the search can vary
                # them.
                mixed = [driven[:depth] + own[depth:] for driven, own in pairs]
                # The first of these genes may need repair, because it now follows other cells than those requested.
                executed = repaired(mixed, scenario.seed, scenario)
                return replace(known, scenario=scenario, executed=executed)
        return None


def plain_chains(scenario: Scenario) -> Chains:
    """Return the chains with a number in place of each gene, for fast comparison."""
    return tuple([tuple([gene.code for gene in chain]) for chain in scenario.npcs])


def _key(scenario: Scenario, chains: Chains, depth: int) -> _Key:
    # A run with a fixed duration continues after the last gene of a chain. A longer chain would give another run.
    ends = 0
    if any(len(chain) != len(chains[0]) for chain in chains):
        ends = scenario.genes
    return (
        scenario.ego_lane,
        scenario.ego_speed,
        scenario.gene_seconds,
        scenario.traffic,
        scenario.vehicles,
        ends,
        depth,
        *[chain[:depth] for chain in chains],
    )


# Why a search ended: all generations or runs are done, its time is up, or the caller stopped it.
EndReason = Literal["generations", "runs", "time", "stopped"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanStarted:
    """The first event of every search."""

    algorithm: str
    generations: int | None  # None if the number of runs is the limit
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """The evaluation of one scenario of a generation."""

    generation: int
    local_generation: int
    index: int  # position in the generation's requested scenarios, from 0
    evaluation: Evaluation
    reused: bool  # True if an earlier run provided the evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationFinished:
    """The end of a generation, which is complete or was cut short by the run limit."""

    generation: int
    local_generation: int
    # the unchanged elites, then the new scenarios in the requested order
    population: tuple[Evaluation, ...]
    elites: int  # number of elites in the population


@dataclass(frozen=True, slots=True, kw_only=True)
class NewBest:
    """A scenario that is the best one since the last restart."""

    generation: int
    local_generation: int
    evaluation: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchStarted:
    """The start of a local search, which varies the incumbent while the main search pauses."""

    generation: int
    incumbent: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchFinished:
    """The end of a local search, after which the main search continues."""

    generation: int
    incumbent: Evaluation
    # the best of the local search; the incumbent itself if nothing better was found
    best: Evaluation
    replaced: bool  # whether the best replaced the incumbent in the main population


@dataclass(frozen=True, slots=True, kw_only=True)
class Restarted:
    """A restart of the search with a random population."""

    generation: int  # the generation with the random population
    stagnant: int  # number of generations without improvement before the restart


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanFinished:
    """The last event of a search."""

    reason: EndReason
    generations: int  # finished generations of the main search
    evaluated: int  # evaluated scenarios
    simulated: int  # number of these that were simulated
    best: Evaluation | None  # None if no run was eligible
    # measured by the clock of the search, and therefore not reproducible
    seconds: float = field(compare=False)


# The events that an algorithm returns from `tell`.
AlgorithmEvent = GenerationFinished | NewBest | LocalSearchStarted | LocalSearchFinished | Restarted

Events = tuple[AlgorithmEvent, ...]
Event = PlanStarted | Evaluated | AlgorithmEvent | PlanFinished  # the events of a search


BROKEN = (Outcome.ADS_ERROR, Outcome.HANG)  # outcomes of runs that an error of the ADS cut short
IMMEDIATE = 1.0  # the time before which driving rarely causes an event [s]
MOST_INVALID = 0.25  # fraction of the runs that may be invalid without a warning
# fraction of the valid runs that may test nothing for one reason, and of all runs that may end early, without a warning
MOST_USELESS = 0.5
# fraction of the runs that may end early with a vehicle close without a warning, or that may end early without a note
MOST_CLOSE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """The counts of evaluations on which a search's health warnings are based."""

    evaluated: int = 0  # scenarios that the algorithm requested
    # of these, the scenarios that were run; all other counts are about these runs
    simulated: int = 0
    # runs in which an NPC touched another NPC or a fixed object, or the user's code failed
    invalid: int = 0
    # invalid runs in which the user's code failed
    errors: Counter[str] = field(default_factory=Counter)
    discarded: int = 0  # runs that the user's function rejected or skipped
    genes_started: int = 0  # genes that started, over all NPCs, in runs that no ADS error cut short
    genes_reached: int = 0  # of these, the genes whose target was reached
    valid: int = 0  # runs that were neither invalid nor discarded; the next three are among these
    failing: int = 0  # runs that failed, or whose process died
    # runs without an ADS error in which no NPC gave the ego a reason to react
    no_interaction: int = 0
    barely_moved: int = 0  # runs that passed although the ego barely moved
    # runs that ended early and did not fail, by reason
    ended: Counter[str] = field(default_factory=Counter)
    at_once: int = 0  # of these, the runs that were not discarded and ended within the first second
    # of the runs that ended early, those with a vehicle within two seconds of the ego
    close: int = 0
    gap: float = math.inf  # the smallest gap to another vehicle in runs that ended early [m]

    @classmethod
    def of_runs(cls, evaluated: int, runs: Sequence[Evaluation]) -> Health:
        """Compute the counts from the simulated ``runs`` and the number of all ``evaluated`` scenarios."""
        invalid = [each for each in runs if each.outcome is Outcome.INVALID]
        # The algorithm learns nothing from a run in which the process died, but such a run is an error of the ADS.
        valid = [
            each
            for each in runs
            if each.outcome in BROKEN or not (each.outcome is Outcome.INVALID or each.discarded)
        ]
        driven = [each for each in valid if each.outcome not in BROKEN]
        whole = [each for each in runs if each.outcome not in BROKEN]
        early = [
            each
            for each in whole
            if each.ended and not (each.failing or each.outcome is Outcome.INVALID)
        ]
        return cls(
            evaluated=evaluated,
            simulated=len(runs),
            invalid=len(invalid),
            errors=Counter([each.ended for each in invalid if each.ended]),
            discarded=len(runs) - len(valid) - len(invalid),
            genes_started=sum([each.genes_started for each in whole]),
            genes_reached=sum([each.genes_reached for each in whole]),
            valid=len(valid),
            failing=sum([each.failing for each in valid]),
            no_interaction=sum([not each.interaction for each in driven]),
            barely_moved=sum([each.barely_moved and not each.failing for each in driven]),
            ended=Counter([each.ended for each in early]),
            at_once=sum([each.duration <= IMMEDIATE and not each.discarded for each in early]),
            close=sum([each.is_close for each in early]),
            gap=min([each.gap for each in early], default=math.inf),
        )

    def __add__(self, other: Health) -> Health:
        sums = {name: getattr(self, name) + getattr(other, name) for name in _COUNTS}
        return Health(**sums, gap=min(self.gap, other.gap))

    @property
    def reused(self) -> int:
        """The number of scenarios that reused the result of an earlier run."""
        return self.evaluated - self.simulated

    @property
    def vacuous(self) -> bool:
        """True if most runs were invalid or ended in the first second, or if the user's code made many runs invalid."""
        is_empty = 2 * (self.valid - self.at_once) < self.simulated or not self.simulated
        return is_empty or self._is_at_fault

    @property
    def _is_at_fault(self) -> bool:
        # True if the user's code made so many runs invalid that the search fails.
        return self.errors.total() > MOST_INVALID * self.simulated

    @property
    def reached_share(self) -> float | None:
        """The fraction of started genes whose target was reached, or None if no gene started."""
        return self.genes_reached / self.genes_started if self.genes_started else None

    @property
    def early_ends(self) -> str:
        """A warning about runs that ended early without a collision, or an empty string if there are few."""
        runs = self.ended.total()
        # Runs that end with a vehicle close hide most failures, so a single one is reported.
        if not self.close and runs <= MOST_CLOSE * self.simulated:
            return ""
        (most, _), *others = first = self.ended.most_common(3)
        named = [
            (f"because {'of ' * (name not in LEAVING.values())}{name}", number)
            for name, number in first
        ]
        enders = (
            " and ".join(f"{why} ({number})" for why, number in named) if others else named[0][0]
        )
        advice = (
            'Correct the cause, or let the runs continue with ends="duration" in a pafot.World.'
        )
        if most in LEAVING.values():
            advice = "Check the units and axes of the world and of the ADS's actions."
        return (
            f"{_percent(runs, self.simulated, 'run')} ended early without a collision, {enders}. "
            f"In {self.close} of them, a vehicle was within two seconds of the ego. The smallest gap to a vehicle "
            f"was {self.gap:.1f} m. {advice}"
        )

    @property
    def hides_most(self) -> bool:
        """True if so many runs ended early that the search must warn about them."""
        return (
            self.ended.total() > MOST_USELESS * self.simulated
            or self.close > MOST_CLOSE * self.simulated
        )

    def warnings(self) -> list[str]:
        """Return a warning, with advice, for each sign that the search tested too little."""
        if self.simulated == 0:
            return [
                "no scenario was simulated, so nothing was tested. Give the search more time or more generations."
            ]
        found = []
        if self.errors:
            (most, count), *_ = self.errors.most_common(1)
            which = "One of the errors"
            if count > 1 or len(self.errors) == 1:
                which = "The most frequent error"
            way_out = "Correct it."
            if " failed: " in most:
                way_out = 'Correct it, or write ends="duration" in the world.'
            found.append(
                f"{_percent(self.errors.total(), self.simulated, 'simulated scenario')} tested nothing. {which}: "
                f"{most:.300}. {way_out}"
            )
        if self.vacuous and not self._is_at_fault:
            found.append(
                f"{_percent(self.simulated - self.valid + self.at_once, self.simulated, 'run')} tested nothing ("
                f"{self.invalid} invalid, {self.discarded} rejected or skipped, {self.at_once} ended within the first "
                "second). Use fewer NPCs, reject fewer runs, or correct what ends the runs early."
            )
        touched = self.invalid - self.errors.total()
        if touched > MOST_INVALID * self.simulated:
            found.append(
                f"{_percent(touched, self.simulated, 'simulated scenario')} tested nothing, because an NPC touched "
                "another NPC or a fixed object. Use fewer NPCs, more lanes or shorter runs."
            )
        for count, what in ((self.no_interaction, ALONE), (self.barely_moved, STANDING)):
            if count > MOST_USELESS * self.valid:
                found.append(f"in {_percent(count, self.valid, 'valid run')}, {what}")
        return [*found, self.early_ends] if self.hides_most else found


ALONE = "no NPC came near the ego in the ego's lane. Use more NPCs, more genes, or a higher speed_limit for NPCs."
STANDING = (
    f"the ego's mean speed was below {BARELY_MOVING:g} m/s. Check the units of the ADS's actions."
)
_COUNTS = [each.name for each in fields(Health) if each.name != "gap"]


def _percent(part: int, whole: int, noun: str) -> str:
    return f"{part} of {plural(whole, noun)} ({part / whole:.0%})".replace("%", " %", 1)
