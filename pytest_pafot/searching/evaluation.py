"""What a search knows of its runs: their results and their order, its events, and its health.

The events of a campaign contain its history: the populations, local searches and restarts can be reconstructed from
them, except where other processes have counted the runs. Generations are counted from 0. Within a local search
``local_generation`` counts from 1, which is the generation of the incumbent's mutants; in the main search it is 0.
The health of a search is counts over its evaluations, which show whether it tested anything.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Self

import numpy as np

from pytest_pafot.criticality import Encounters, min_gap, time_advantage, ttc
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import HEADING, LANE, SPEED, Collision, Outcome, Trace, X, Y
from pytest_pafot.searching.space import repaired
from pytest_pafot.support.text import plural

Rank = tuple[bool, bool, float]
"""A sort key for runs: eligible, failing, fitness. The first difference decides; greater is worse for the ego."""

# An NPC in the ego's lane interacts with it within this time of the follower's travel [s]. It is less than the 2 s at
# which NPCs start, so that a start by itself is no interaction ...
INTERACTION_HEADWAY = 1.5
INTERACTION_GAP = 2.0  # ... or within this gap at any speed [m]

BARELY_MOVING = 2.0
"""Mean speed of the ego below which a run tests nothing [m/s]; stopping from 22 m/s gives a lower mean after 30 s."""

CLOSE = 2.0
"""A vehicle is within two seconds of the ego if, at their speeds and headings, they would touch in that time [s]."""

LEAVING = {Outcome.OFF_ROAD: "the ego's leaving the road", Outcome.LEFT_ROUTE: "the ego's leaving its route"}

_IMPOSSIBLE: Rank = (False, False, -math.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """A scenario with the results of its run.

    Attributes:
        scenario: the scenario as requested.
        executed: the scenario as driven, including the repair inside the run.
        fitness: higher is worse for the ego; NaN if the measure failed.
        failing: whether the run failed, by the user's test function or by an error of the ADS.
        outcome: how the run ended.
        duration: simulated time [s].
        genes_started: number of genes that began before the run ended, summed over all NPCs.
        genes_reached: number of started genes whose cell or lane the NPC reached.
        interaction: whether an NPC ever gave the ego a reason to react, see :func:`has_interaction`.
        discarded: whether the user's test function declined to give a verdict on the run, or its process ended.
        barely_moved: whether the ego's mean speed was below 2 m/s.
        kind: kind of the failure, equal for failures that count as the same. None if nothing failed or it is unknown.
        margins: name and worst margin of each check in the user's test function
            (:attr:`pytest_pafot.oracle.run.Check.margin`), sorted by name.
        collision: collision of the run; None without one.
        ended: what ended the run early, without a collision, see :func:`ended_by`; empty if nothing did.
        gap: the smallest gap to another vehicle in a run that ended early [m]; infinite in other runs.
        is_close: whether a vehicle was within two seconds of the ego when the run ended early, see :data:`CLOSE`.
        note: any data that ``evaluate`` adds, to get it back with the evaluation, also if the evaluation is reused.
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
    _measured: float | None = field(init=False, repr=False)  # compared for fitness; NaN is not equal to itself

    def __post_init__(self) -> None:
        fitness = float(self.fitness)
        object.__setattr__(self, "fitness", fitness)
        object.__setattr__(self, "_measured", None if math.isnan(fitness) else fitness)

    @classmethod
    def of(
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
        """Make the evaluation of a run from its trace and from the given fitness, verdict and note."""
        ended = ended_by(trace)
        return cls(
            scenario=trace.scenario,
            executed=trace.executed,
            fitness=fitness,
            failing=failing,
            outcome=trace.outcome,
            duration=trace.duration,
            genes_started=sum(map(len, trace.arrivals)),
            genes_reached=sum([tick is not None for arrivals in trace.arrivals for tick in arrivals]),
            interaction=has_interaction(trace),
            discarded=discarded,
            barely_moved=bool(np.mean(trace.ego[:, SPEED]) < BARELY_MOVING),
            kind=kind,
            margins=margins,
            collision=trace.collision,
            ended=ended,
            gap=min(math.inf, min_gap(trace)) if ended else math.inf,  # and not NaN
            is_close=bool(ended and (ttc(trace)[-1] < CLOSE).any()),
            note=note,
        )

    @property
    def eligible(self) -> bool:
        """True if the run may become the best of a search: it is valid and has a verdict and a fitness."""
        return not (self.outcome is Outcome.INVALID or self.discarded or math.isnan(self.fitness))

    @property
    def rank(self) -> Rank:
        """The key by which a search orders runs: failing runs outrank all others; then the fitness decides.

        Invalid and discarded runs and those without a fitness come last, all equal, even if they fail: an invalid run
        says nothing about the ego, and NaN cannot be compared.
        """
        return (True, self.failing, self.fitness) if self.eligible else _IMPOSSIBLE

    @property
    def depth(self) -> int:
        """The number of genes per NPC on which the run depended: those that began, or all if none began.

        The genes of all NPCs begin at the same times, so ``genes_started`` determines this number. An evaluation in
        which no gene was started says nothing about any other scenario.
        """
        lengths = [len(chain) for chain in self.executed.npcs]
        longest = max(lengths)
        if self.genes_started <= 0:
            return longest
        if min(lengths) == longest:
            return min(-(-self.genes_started // len(lengths)), longest)
        enough = (depth for depth in range(1, longest) if sum(min(n, depth) for n in lengths) >= self.genes_started)
        return next(enough, longest)


def has_interaction(trace: Trace) -> bool:
    """Return whether an NPC gave the ego a reason to react.

    There is a reason to react if the ego collided, if an NPC was in its lane at a headway below 1.5 s or a gap below
    2 m, and if the ego and an NPC that crosses were expected in their zone within 1.5 s of each other.
    """
    if trace.outcome is Outcome.COLLISION:
        return True
    columns = (X, Y, HEADING, SPEED, LANE)
    x, y, heading, speed, lane = (np.ascontiguousarray(trace.states[..., each].T) for each in columns)
    # How far each NPC's centre is ahead of the ego's [m]: along the ego's heading, or on bent roads along its way.
    if trace.road.is_straight:
        ahead = (x[1:] - x[0]) * np.cos(heading[0]) + (y[1:] - y[0]) * np.sin(heading[0])
    else:
        ahead = Encounters(trace).ahead
    gap = np.abs(ahead) - (trace.sizes[0, 0] + trace.sizes[1:, :1]) / 2
    follower = np.where(ahead >= 0, speed[0], speed[1:])
    is_close = (lane[1:] == lane[0]) & (gap < np.maximum(INTERACTION_HEADWAY * follower, INTERACTION_GAP))
    meets = any(trace.zones) and (time_advantage(trace) < INTERACTION_HEADWAY).any()
    return bool(is_close.any() or meets)


def ended_by(trace: Trace) -> str:
    """Return what ended a run early, without a collision; empty if nothing did.

    The ends of highway-env itself, of its merges and intersections, are ends of their roads.
    """
    is_own = not trace.ended.startswith("highway_env.")
    is_cut = trace.outcome in LEAVING and (trace.ended or trace.off_road_tick in (None, trace.ticks))
    if is_own and trace.ended:
        return trace.ended
    return (".".join(trace.ended.split(".")[-2:]) or LEAVING[trace.outcome]) if is_cut else ""  # without the module


# Results of earlier runs of a campaign, so that none of the last ten thousand runs is simulated twice.

Chains = tuple[tuple[Hashable, ...], ...]  # one number per gene, or the whole gene
_Key = tuple[object, ...]
_Place = tuple[_Key, int | None]  # a key, and the seed if it matters

EVALUATIONS = 10_000
"""The largest number of remembered runs, in 25 MB with two NPCs and 90 MB with six; a forgotten run is simulated
again."""


class EvaluationCache:
    """A cache of evaluations; the key of an evaluation is everything that its run depended on.

    A run that ended in gene ``d`` depended only on the start and on the first ``d`` genes of each NPC. A different
    scenario gives the same run in two cases. Either its start and these genes equal the start and genes that were
    driven, which repair does not change for any seed. Or they equal those that were requested, and the seed is equal.

    Args:
        evaluations: evaluations that are known from the beginning.
        seeds_matter: True if the seed affects more than the repair, such as what the ADS sees. The seeds must then be
            equal in both cases.
    """

    def __init__(self, evaluations: Iterable[Evaluation] = (), *, seeds_matter: bool = False) -> None:
        self._seeds_matter = seeds_matter
        self._evaluations: dict[_Key, dict[int | None, Evaluation]] = {}  # by key, then by the seed if it matters
        self._depths: list[int] = []
        self._runs: deque[list[_Place]] = deque()  # the places that lead only to each run, the oldest first
        for evaluation in evaluations:
            self.add(evaluation)

    def add(self, evaluation: Evaluation) -> None:
        """Remember a run; if several runs have the same key, the first one stays."""
        if evaluation.depth not in self._depths:
            self._depths = sorted([*self._depths, evaluation.depth])
        own = [(key, need) for key, need in self._places(evaluation) if need not in self._evaluations.get(key, {})]
        for key, needed in own:
            self._evaluations.setdefault(key, {})[needed] = evaluation
        self._runs.append(own)

    def _places(self, evaluation: Evaluation) -> list[_Place]:
        """Return the keys under which a run is found: its chains as driven, and as requested if they differ."""
        depth = evaluation.depth
        asked = driven = plain_chains(evaluation.scenario)
        if evaluation.executed is not evaluation.scenario:
            driven = plain_chains(evaluation.executed)
        seed = evaluation.scenario.seed if self._seeds_matter else None
        keys = [(driven, seed)] if asked == driven else [(driven, seed), (asked, evaluation.scenario.seed)]
        return [(_key(evaluation.scenario, chains, depth), needed) for chains, needed in keys]

    def forget(self, room: int = EVALUATIONS) -> None:
        """Forget the oldest runs until at most ``room`` runs are left."""
        while len(self._runs) > room:
            for key, needed in self._runs.popleft():
                del self._evaluations[key][needed]
                if not self._evaluations[key]:
                    del self._evaluations[key]

    def recall(self, scenario: Scenario) -> Evaluation | None:
        """Return the evaluation that a run of the scenario would have, or None if no earlier run shows it.

        Genes that begin after the end of the earlier run are the scenario's own, so that the search can vary them.
        """
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
                mixed = [driven[:depth] + own[depth:] for driven, own in pairs]
                # The first of these genes may need repair, because it now follows other cells than those requested.
                return replace(known, scenario=scenario, executed=repaired(mixed, scenario.seed, scenario))
        return None


def plain_chains(scenario: Scenario) -> Chains:
    """Return the chains with a number for each gene, which is fast to hash and compare; speeds are at most 1000 m/s."""
    return tuple([tuple([gene.code for gene in chain]) for chain in scenario.npcs])


def _key(scenario: Scenario, chains: Chains, depth: int) -> _Key:
    # A run whose end does not depend on its chains goes on after the last gene, which a longer chain would not.
    ends = 0 if all(len(chain) == len(chains[0]) for chain in chains) else scenario.genes
    start = (scenario.ego_lane, scenario.ego_speed, scenario.gene_seconds, scenario.traffic, scenario.vehicles)
    return (*start, ends, depth, *[chain[:depth] for chain in chains])


EndReason = Literal["generations", "runs", "time", "stopped"]
"""The reason why a campaign ended: all generations or all runs are done, its time is up, or its caller stopped it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignStarted:
    """The first event of every campaign."""

    algorithm: str
    generations: int | None  # None if the number of runs is the limit
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """One scenario of a generation was evaluated."""

    generation: int
    local_generation: int
    index: int  # position in the generation's requested scenarios, from 0
    evaluation: Evaluation
    reused: bool  # True if the evaluation is from an earlier run, because that run shows what the scenario does


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationFinished:
    """All scenarios of a generation were evaluated, or the limit on runs was reached inside the generation."""

    generation: int
    local_generation: int
    population: tuple[Evaluation, ...]  # the unchanged elites, then the new ones in the requested order
    elites: int  # number of elites in the population


@dataclass(frozen=True, slots=True, kw_only=True)
class NewBest:
    """A generation, or a local search at its end, produced the best scenario since the last restart."""

    generation: int
    local_generation: int
    evaluation: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchStarted:
    """The main search pauses after this generation, and mutants of the incumbent evolve."""

    generation: int
    incumbent: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchFinished:
    """The local search has ended and the main search continues."""

    generation: int
    incumbent: Evaluation
    best: Evaluation  # of the local search; the incumbent itself if nothing better was found
    replaced: bool  # whether the best took the incumbent's place in the main population


@dataclass(frozen=True, slots=True, kw_only=True)
class Restarted:
    """The search abandoned its population and continues with a random one."""

    generation: int  # the generation with the random population
    stagnant: int  # number of generations without improvement before the restart


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignFinished:
    """The last event of a campaign; it is missing if the generator of the events was closed early."""

    reason: EndReason
    generations: int  # finished generations of the main search
    evaluated: int  # evaluated scenarios
    simulated: int  # those of them that were simulated
    best: Evaluation | None  # None if no run was eligible
    seconds: float = field(compare=False)  # by the campaign's clock; not reproducible


AlgorithmEvent = GenerationFinished | NewBest | LocalSearchStarted | LocalSearchFinished | Restarted
"""The events that an algorithm returns from ``tell``."""

Event = CampaignStarted | Evaluated | AlgorithmEvent | CampaignFinished  # what a campaign yields


BROKEN = (Outcome.ADS_ERROR, Outcome.HANG)  # outcomes of runs that an error of the ADS cut short
IMMEDIATE = 1.0  # [s]; driving hardly causes anything before this time
MOST_INVALID = 0.25  # share of the runs
MOST_USELESS = 0.5  # share of the valid runs for each kind of run that tests nothing, and of all for early ends
MOST_CLOSE = 0.1  # share of the runs that may end early with a vehicle close, or early without a note


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Counts over the evaluations of a search. All but ``evaluated`` count only simulated scenarios."""

    evaluated: int = 0  # scenarios that the algorithm requested
    simulated: int = 0  # those of them that were run; the others were known
    invalid: int = 0  # runs in which two NPCs, or one and a fixed object, touched, or code of the user's failed
    errors: Counter[str] = field(default_factory=Counter)  # those of them in which code of the user's failed
    discarded: int = 0  # runs that the user's function declined
    genes_started: int = 0  # over all NPCs, like the next; without runs that an ADS error cut short
    genes_reached: int = 0
    valid: int = 0  # runs that were neither invalid nor discarded; the next three are among these
    failing: int = 0  # runs that failed, or whose process ended
    no_interaction: int = 0  # runs in which no NPC gave the ego a reason to react; without ADS errors, too
    barely_moved: int = 0  # runs that passed although the ego hardly drove
    ended: Counter[str] = field(default_factory=Counter)  # runs that ended early and did not fail, by what ended them
    at_once: int = 0  # those of them that are valid and ended within the first second
    close: int = 0  # those of them that ended with a vehicle within two seconds of the ego
    gap: float = math.inf  # the smallest gap to another vehicle in them [m]

    @classmethod
    def of_runs(cls, evaluated: int, runs: Sequence[Evaluation]) -> Health:
        """Count over the evaluations of simulated scenarios; ``evaluated`` is the number of all scenarios."""
        invalid = [each for each in runs if each.outcome is Outcome.INVALID]
        # A run that ended its process teaches the algorithm nothing, but it is an error of the ADS.
        valid = [
            each for each in runs if each.outcome in BROKEN or not (each.outcome is Outcome.INVALID or each.discarded)
        ]
        driven = [each for each in valid if each.outcome not in BROKEN]
        whole = [each for each in runs if each.outcome not in BROKEN]
        early = [each for each in whole if each.ended and not (each.failing or each.outcome is Outcome.INVALID)]
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
        """Return the health of two searches, or of two parts of one search, together."""
        sums = {name: getattr(self, name) + getattr(other, name) for name in _COUNTS}
        return Health(**sums, gap=min(self.gap, other.gap))

    @property
    def reused(self) -> int:
        """The number of scenarios that were not simulated, because an earlier run showed what they do."""
        return self.evaluated - self.simulated

    @property
    def vacuous(self) -> bool:
        """True if most runs cannot have shown anything: they were not valid, or ended within the first second.

        Or if the user's code made more than a quarter of the runs invalid.
        """
        is_empty = 2 * (self.valid - self.at_once) < self.simulated or not self.simulated
        return is_empty or self._is_at_fault

    @property
    def _is_at_fault(self) -> bool:
        """True if code of the user's made so many runs invalid that the search fails."""
        return self.errors.total() > MOST_INVALID * self.simulated

    @property
    def reached_share(self) -> float | None:
        """The share of started genes whose target was reached; None if none was started."""
        return self.genes_reached / self.genes_started if self.genes_started else None

    @property
    def early_ends(self) -> str:
        """A sentence on the runs that ended early without a collision; empty if they are few and no vehicle is close.

        Runs that end with a vehicle close hide most, so one of them is enough.
        """
        runs = self.ended.total()
        if not self.close and runs <= MOST_CLOSE * self.simulated:
            return ""
        (most, _), *others = first = self.ended.most_common(3)
        enders = " and ".join(f"{name} ({number})" for name, number in first) if others else most
        advice = 'correct what ended them, or let them go on with ends="duration" in a pafot.World'
        if most in LEAVING.values():
            advice = "check the units and axes of the world, and of what the ADS returns"
        return (
            f"{_percent(runs, self.simulated)} runs ended early without a collision, by {enders}, "
            f"{self.close} of them with a vehicle within two seconds of the ego; the smallest gap to a vehicle in "
            f"these runs was {self.gap:.1f} m; {advice}"
        )

    @property
    def hides_most(self) -> bool:
        """True if the search warns of early ends: of more than half of the runs, or a tenth with a vehicle close."""
        return self.ended.total() > MOST_USELESS * self.simulated or self.close > MOST_CLOSE * self.simulated

    def warnings(self) -> list[str]:
        """Return a warning, with advice, for each sign that the search tested too little; empty if there is none."""
        if self.simulated == 0:
            return ["no scenario was simulated, so nothing was tested; give the search generations and time"]
        found = []
        if self.errors:
            (most, count), *_ = self.errors.most_common(1)
            which = "most often" if count > 1 or len(self.errors) == 1 else "such as by"
            way_out = 'correct it, or write ends="duration" in the world' if " failed: " in most else "correct it"
            found.append(
                f"{self.errors.total()} of {plural(self.simulated, 'simulated scenario')} tested nothing; {which} "
                f"{most:.300}; {way_out}"
            )
        if self.vacuous and not self._is_at_fault:
            found.append(
                f"most of {plural(self.simulated, 'simulated scenario')} tested nothing: {self.invalid} were invalid, "
                f"{self.discarded} were rejected or skipped, {self.at_once} ended within the "
                "first second; use fewer NPCs, reject less, or correct what ends runs"
            )
        touched = self.invalid - self.errors.total()
        if touched > MOST_INVALID * self.simulated:
            found.append(
                f"{_percent(touched, self.simulated)} simulated scenarios tested nothing, because two NPCs, or an NPC "
                "and a fixed object, touched; use fewer NPCs, more lanes or shorter runs"
            )
        for count, what in ((self.no_interaction, ALONE), (self.barely_moved, STANDING)):
            if count > MOST_USELESS * self.valid:
                found.append(f"{_percent(count, self.valid)} valid runs {what}")
        return [*found, self.early_ends] if self.hides_most else found


ALONE = "never brought an NPC near the ego in its lane; raise the number of NPCs, the genes, or the speed_limit of NPCs"
STANDING = f"had an ego with a mean speed below {BARELY_MOVING:g} m/s; check the units of what the ADS returns"
_COUNTS = [each.name for each in fields(Health) if each.name != "gap"]


def _percent(part: int, whole: int) -> str:
    return f"{part / whole:.0%} ({part}) of {whole}".replace("%", " %", 1)
