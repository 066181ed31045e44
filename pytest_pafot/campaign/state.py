"""What a search knows of all its runs: its counts and its failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, field, replace

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Judged, SearchEvent
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.campaign.judging import FAILING, Counts, fails_by_ego
from pytest_pafot.campaign.setup_fault import FirstGeneration
from pytest_pafot.campaign.store import Store
from pytest_pafot.campaign.tallies import Tally
from pytest_pafot.execution.scenario_pool import LostRun, expectation
from pytest_pafot.findings.finding import Manner
from pytest_pafot.findings.severity import Severity
from pytest_pafot.findings.sighting import Alike, worse
from pytest_pafot.findings.signature import CHECK_FAILED, Signature
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching import evaluation
from pytest_pafot.searching.evaluation import Health
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support import monotonic
from pytest_pafot.support.text import plural

COUNTED_AT_ONCE = 16
"""The number of evaluations after which their health is counted: then it takes less time than for each alone."""


@dataclass(slots=True)
class RandomRuns:
    """The first runs of a search, whose scenarios are random.

    Attributes:
        evaluated: the number of evaluated scenarios.
        runs: the number of runs that say something about the ego.
        at_fault: the number of those with a collision for which the ego is responsible, alone or with the NPC.
        otherwise: the number of those that failed in any other way, such as by a check or an error of the ADS.
        checks: the number of the latter that failed a check.
        most: the number of random scenarios with which the search begins; infinite if all are random.
        judged: the events of runs whose scenarios were not evaluated yet.
    """

    evaluated: int = 0
    runs: int = 0
    at_fault: int = 0
    otherwise: int = 0
    checks: int = 0
    most: float = field(init=False, default=0.0)
    judged: dict[Scenario, Judged] = field(init=False, default_factory=dict)

    @property
    def is_whole(self) -> bool:
        """True if all random scenarios at the beginning of the search were run."""
        return self.evaluated >= self.most

    @property
    def counts(self) -> Counter[str]:
        """The numbers of runs by what became of them."""
        return Counter(runs=self.runs, at_fault=self.at_fault, otherwise=self.otherwise, checks=self.checks)

    def see(self, event: SearchEvent) -> None:
        """Count an event of the beginning. A scenario may be judged twice before it is evaluated."""
        if self.is_whole:
            return
        if isinstance(event, Judged):
            self.judged[event.scenario] = event
        elif isinstance(event, evaluation.Evaluated):
            judged = self.judged.pop(event.evaluation.scenario, None)
            if judged is None or judged.verdict.discarded or judged.verdict.kind == "invalid":
                self._add(1, 0, 0, 0, 0)
            else:
                is_at_fault = fails_by_ego(judged.verdict, judged.responsibility)
                is_other = judged.verdict.kind in FAILING and not is_at_fault
                self._add(1, 1, is_at_fault, is_other, is_other and judged.verdict.is_check)

    def take(self, evaluated: int, runs: int, at_fault: int, otherwise: int, checks: int) -> None:
        """Count runs that another process has judged, which are all of the beginning or none."""
        if not self.is_whole:
            self._add(evaluated, runs, at_fault, otherwise, checks)

    def _add(self, evaluated: int, runs: int, at_fault: int, otherwise: int, checks: int) -> None:
        self.evaluated, self.runs = self.evaluated + evaluated, self.runs + runs
        self.at_fault, self.otherwise = self.at_fault + at_fault, self.otherwise + otherwise
        self.checks += checks


@dataclass(slots=True, kw_only=True)
class State:
    """A search in progress, with everything that it has seen so far.

    Runs that this process judges are counted by :meth:`take` and, from the events of the plan, by :meth:`see`; those
    that another one judges by :meth:`take_tally`.
    """

    covered: Counter[str] = field(default_factory=Counter)  # number of failing runs by the file that covers them
    counts: Counts = field(default_factory=Counts)  # numbers of runs by verdict, outcome and who was responsible
    caught: Counter[str] = field(default_factory=Counter)  # number of passed runs by a check that failed in them
    doubt: str = ""  # a doubt about the units of the ADS's actions, if any
    avoidable: str = ""  # what happened in the first run that is excused though braking late avoids the collision
    # how the reference itself failed in all its runs so far; empty if it did not in one of them, None before the first
    broken: str | None = None
    fatal: set[Scenario] = field(default_factory=set)  # scenarios in which a process died; they are not run
    random: RandomRuns = field(default_factory=RandomRuns)
    counted: Health = field(default_factory=Health)  # health of the evaluations that were counted

    space: SearchSpace | None = field(init=False, default=None)  # None for replays only
    clock: Callable[[], float] = field(init=False, default=monotonic)  # returns the seconds since some moment
    began: float = field(init=False, default=0.0)  # the time at which this session began [s]
    shown: Mapping[Signature, str] = field(init=False, default_factory=dict)  # ids of saved scenarios by their failure
    finds: dict[Signature, str] = field(init=False, default_factory=dict)  # ids of new findings by signature
    repeats: Counter[str] = field(init=False, default_factory=Counter)  # number of other runs that show one, by id
    # for each failure that a saved scenario shows and each manner of it, the id of the first scenario of this session
    manners: dict[Signature, dict[Manner, str]] = field(init=False, default_factory=dict)
    failures: dict[Signature, str] = field(init=False, default_factory=dict)  # ids by failures that this session showed
    shrink_runs: int = field(init=False, default=0)  # number of attempts to shrink findings, and of runs for rates
    shrink_decisions: int = field(init=False, default=0)  # that the ADS made in these
    moment_runs: int = field(init=False, default=0)  # number of runs in which the ADS is asked again beside a run
    moment_decisions: int = field(init=False, default=0)  # that the ADS made in these
    uncounted: list[evaluation.Evaluated] = field(init=False, default_factory=list)
    # the worst of the runs with a failure: its number in the search, from 0, and how bad it was
    worst: dict[Signature, Alike] = field(init=False, default_factory=dict)
    number: int = field(init=False, default=0)  # number of the run in progress, from 0
    generation: int = field(init=False, default=0)  # generation of the main search, from 0
    finished: evaluation.CampaignFinished | None = field(init=False, default=None)  # the last event of the plan
    skip: BaseException | None = field(init=False, default=None)  # the last skip of the test function
    first_generation: FirstGeneration = field(init=False, default_factory=FirstGeneration)

    @property
    def runs(self) -> int:
        """The number of scenarios that were simulated so far."""
        return self.counts.kinds.total()

    @property
    def health(self) -> Health:
        """The figures that say whether the search tested anything."""
        self.count()
        return self.counted

    def count(self) -> None:
        """Count the evaluations since the last call. Counting is delayed so that no scenario has to wait for it."""
        self.counted += Health.of(self.uncounted)
        self.uncounted.clear()

    @property
    def known_alone(self) -> str:
        """A note if all failures so far are known failures of checks; empty if nothing or anything else failed."""
        checks = {id_ for signature, id_ in self.shown.items() if signature.failure == CHECK_FAILED}
        if (
            not self.covered
            or self.covered.total() < self.counts.kinds["failed"]
            or not checks.issuperset(self.covered)
        ):
            return ""
        names = " and ".join(f"saved-{id_}" for id_ in sorted(self.covered))
        which = "a failed check" if len(self.covered) == 1 else "failed checks"
        return f"all {plural(self.covered.total(), 'failing run')} are known, by {names}, {which}; nothing else failed"

    def warnings(self, harness: Harness) -> tuple[str, ...]:
        """Return warnings about the search's health, and about a test or reference with which nothing can fail."""
        warnings = self.health.warnings()
        excused = sum(self.counts.kinds[kind] for kind in ("npc", "avoidable", "unpreventable"))
        if excused and not self.counts.kinds["passed"] and not self.counts.kinds["failed"]:
            warnings.append(
                f'the test function judged nothing: blame="{harness.request.blame}" excludes all '
                f"{plural(excused, 'failure')} that it could judge; search longer"
            )
        warnings += [
            f"check {name!r} failed in {runs} of {self.counts.kinds['passed']} runs that passed: the test function "
            "caught its exception; do not catch it, or use pafot.target, which never fails"
            for name, runs in sorted(self.caught.items())
        ]
        if self.broken:
            warnings.append(
                f"the reference itself failed in all its runs, at first with {self.broken}, so no failure could count; "
                "correct the reference, its factory, or the world= in which it drives"
            )
        return tuple(warnings)

    @property
    def seconds(self) -> float:
        """The time that the search has taken so far [s]."""
        return self.clock() - self.began

    def see(self, event: SearchEvent) -> None:
        """Count what an event says.

        Raises:
            SetupFaultError: if all runs of the first generation end in the same exception.
        """
        self.random.see(event)
        match event:
            case evaluation.Evaluated():
                self.uncounted.append(event)
                if len(self.uncounted) >= COUNTED_AT_ONCE:
                    self.count()
            case evaluation.GenerationFinished(local_generation=0):
                self.first_generation.end()
            case evaluation.CampaignFinished():
                self.finished = event

    def take(self, run: Run, verdict: Verdict, caught: Iterable[str], doubt: str) -> None:
        """Count a run that this process has judged."""
        self.counts.add(verdict.kind, run.outcome, run.responsibility)
        # What says that the set-up is wrong: a check that the function catches, units, the same error in all runs. As
        # soon as two runs differ, the findings that were held back are no fault of the set-up.
        self.caught.update(caught)
        self.doubt = self.doubt or doubt
        self.avoidable = self.avoidable or verdict.excused
        if self.first_generation.is_alike:
            self.first_generation.see(run, verdict)
        if verdict.kind == "skipped":
            self.skip = verdict.exception
        if verdict.reference is not None and self.broken != "":
            broken = verdict.reference.failure if verdict.reference.is_ads else None
            self.broken = "" if broken is None else self.broken or f"{broken.kind}: {broken.message}"

    def take_tally(self, tally: Tally) -> None:
        """Count runs that another process has judged and counted."""
        self.random.take(*tally.random)
        self.counted += tally.health
        self.counts += tally.counts
        self.caught.update(tally.caught)
        self.doubt = self.doubt or tally.doubt
        self.avoidable = self.avoidable or tally.avoidable
        if self.first_generation.is_alike:
            self.first_generation.see_others(tally.counts.kinds)
        for signature, runs in tally.failed.items():
            if self.knows(signature):  # unless this process has judged the first of these runs otherwise
                self.repeat(signature, runs)
        for signature, each in tally.worst.items():
            self.see_severity(signature, each.severity, each.number if tally.judged is None else self.number)
        for signature, manner, id_ in tally.manners:
            self.see_manner(signature, manner, id_)

    def knows(self, signature: Signature) -> bool:
        """Return whether a saved scenario shows a failure, or this search has found it before."""
        return signature in self.shown or signature in self.finds

    def repeat(self, signature: Signature, runs: int = 1) -> None:
        """Count runs with a failure that the search :meth:`knows`."""
        id_ = self.failures[signature] = self.shown.get(signature) or self.finds[signature]
        (self.covered if signature in self.shown else self.repeats)[id_] += runs

    def see_severity(self, signature: Signature, severity: Severity | None, number: int) -> None:
        """Keep the worst of the runs with a failure, and of equal ones the first."""
        self.worst[signature] = worse(self.worst.get(signature), Alike(number=number, severity=severity))

    def alike(self, find_id: str) -> Alike:
        """Return how many other runs failed like a finding, and the worst of them all."""
        kept = next(
            (self.worst[each] for each, id_ in self.finds.items() if id_ == find_id and each in self.worst), Alike()
        )
        return replace(kept, runs=self.repeats[find_id])

    def add(self, signature: Signature, find_id: str) -> None:
        """Take a new finding."""
        self.finds[signature] = self.failures[signature] = find_id

    def see_manner(self, signature: Signature, manner: Manner | None, scenario_id: str) -> None:
        """Remember how a failure came about that a saved scenario shows."""
        if signature in self.shown and manner is not None:
            self.manners.setdefault(signature, {}).setdefault(manner, scenario_id)

    def forget_findings(self) -> None:
        """Forget the failures of a search whose set-up is at fault: they must not count as findings or as known."""
        self.covered.clear()
        self.failures.clear()
        self.finds.clear()


def lose(lost: LostRun, state: State, bench: Bench, store: Store, runs: int = 0) -> Generator[SearchEvent, None, str]:
    """Record a scenario whose process died or hung, so that it is never run again, not even in later sessions.

    ``runs`` is 1 if a run of the search died, and 0 if it was one to shrink, to examine or to compare a finding.
    Return the kind of the verdict. It is no failure if the reference does not pass the scenario either.
    """
    state.fatal.add(lost.task)
    if bench.is_common(lost.task):
        return "common"
    signature = expectation(lost).signature
    if state.knows(signature):
        state.repeat(signature, runs)
    else:
        sighting = store.add_lost(lost, state.generation)
        yield from store.publish(sighting)
        state.add(signature, sighting.id)
        state.repeats[sighting.id] += runs - 1
    return "failed"
