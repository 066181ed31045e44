"""The loop of a search: it runs and evaluates scenarios, and records every distinct finding at once."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from pytest_pafot.attribution.mistakes import mistake_of
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.events import NO_WORSE, NOT_REPEATED, Find, FindTold, Judged, Listener
from pytest_pafot.campaign.harness import Harness, Simulation, is_same_run
from pytest_pafot.campaign.run_table import columns_of, row_of
from pytest_pafot.campaign.setup_fault import FirstGeneration, unit_doubt
from pytest_pafot.campaign.verdict import PlainFailure, Verdict, headline
from pytest_pafot.corpus.layout import SUFFIX, files_in, relative
from pytest_pafot.corpus.writer import CorpusWriteError, free_path, rewrite, text_of, write
from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.pool import OUT_OF_MEMORY, WORLD_HANGS, ProcessLostError
from pytest_pafot.execution.scenario_pool import Digest, LostRun, expectation
from pytest_pafot.findings.finding import (
    Expect,
    Finding,
    Found,
    Manner,
    Perceived,
    disagreement,
    failed_as,
    message_of,
    portable,
)
from pytest_pafot.findings.signature import CHECK_FAILED, PROCESS_CRASH, Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching import events
from pytest_pafot.searching.ask_tell_loop import Drawer, Group
from pytest_pafot.searching.evaluation import Evaluation, interaction_of
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.errors import OutOfTime, flag
from pytest_pafot.support.interrupts import postponed
from pytest_pafot.support.text import plural
from pytest_pafot.world import codec, protocol
from pytest_pafot.world.driving.ads import is_vehicle_class, weights_digest
from pytest_pafot.world.driving.perception import sight_of
from pytest_pafot.world.guard.failure import UNFIT, let_through
from pytest_pafot.world.guard.hang_guard import runs_end_in

# Values that a search reads from every run. They are read in the process that made the run, to relieve this one.

FITNESS = "fitness"
"""The name under which a trace stores its fitness."""


def read_ahead(fitness: Callable[[Trace], float] | None, trace: Trace) -> None:
    """Compute the values of a trace that the search will need, in the process that made the trace, which stores them.

    ``fitness`` is None if the user's own function computes it, which runs only in the main process.
    """
    trace.reading("interaction", interaction_of)
    unit_doubt(trace)
    mistake_of(trace)
    if fitness is not None:
        trace.reading(FITNESS, fitness)


@dataclass(frozen=True, slots=True, kw_only=True)
class Passed:
    """All that a search needs of a run in which nothing new failed, from the process that made and judged the run."""

    evaluation: Evaluation
    event: Judged
    signature: Signature | None  # of a failure that the session knows; None if nothing failed
    manner: Manner | None  # of the same failure
    is_at_fault: bool  # see :func:`fails_by_ego`
    decisions: int  # of the ADS
    caught: tuple[str, ...]  # the names of checks that failed although the test function passed
    doubt: str  # see :func:`unit_doubt`


FAILING = ("failed", "unpreventable", "common")
"""The kinds of verdicts on runs that failed, including failures that do not count for some reason."""


def fails_by_ego(run: Run, verdict: Verdict) -> bool:
    """Return whether a failed run is a collision for which the ego is responsible.

    An ADS that raised or was slow has failed by itself, even if a collision followed.
    """
    return not verdict.is_ads and is_ego_responsible(run.trace)


UNREMARKABLE = ("passed", "npc", "avoidable", "invalid", "rejected")
"""The kinds of verdicts for which a digest is enough. All other runs are judged in the session, with their traces."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """Read the trace of a run in the process that made it, so that the process of the session need not.

    With a harness, that process judges the run, too, and if nothing failed it sends a digest. Otherwise it sends the
    trace, which stores the values that the search will need.

    Attributes:
        harness: has the test function; None if only the process of the session may call it.
        fitness: the fitness of a trace; None if it is the user's own function, which runs only in the session.
        is_steered_by_checks: as in :class:`SearchLoop`.
        has_table: whether the digest has the columns of the run for the table of runs.
        known: the failures that the session knows, so that no further trace of them must be sent.
    """

    harness: Harness | None
    fitness: Callable[[Trace], float] | None
    is_steered_by_checks: bool
    has_table: bool
    known: set[Signature] = field(default_factory=set)

    def __call__(self, trace: Trace) -> Digest | None:
        """Read a trace; return its digest, or None if the trace must be sent."""
        read_ahead(self.fitness, trace)
        if self.fitness is None or self.harness is None:
            return None
        run = self.harness.seen(trace)
        verdict, signature, manner = self.harness.judge(run), None, None
        if self.known and verdict.kind == "failed" and verdict.failure is not None and self.harness.against is None:
            signature, manner = failed_as(run, verdict.failure)
        if verdict.kind not in UNREMARKABLE and signature not in self.known:
            return None
        event = Judged(
            scenario=trace.scenario,
            executed=trace.executed,
            verdict=replace(verdict, checks=(), exception=None),
            known_responsibility=run.responsibility,
            columns=columns_of(run, verdict) if self.has_table else None,
        )
        return Digest(
            Passed(
                evaluation=_evaluated(trace, verdict, signature, self.fitness, self.is_steered_by_checks),
                event=event,
                signature=signature,
                manner=manner,
                is_at_fault=signature is not None and fails_by_ego(run, verdict),
                decisions=len(trace.actions),
                caught=_caught(verdict),
                doubt=unit_doubt(trace),
            )
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally:
    """The counts of consecutive runs that another process has drawn, run and judged.

    Attributes:
        runs, decisions: the numbers of runs, and of decisions of the ADS in them.
        news: the evaluations that matter to the algorithm.
        judged: all evaluations with their events, if the listener needs each of them; otherwise None.
        health: the figures on the search's health.
        verdicts, caught, responsibilities, outcomes: numbers of runs by kind of verdict, check, responsible, outcome.
        failed: numbers of runs by their known failures.
        manners: for each known failure and manner the id of the first scenario.
        fitness: the finite fitness of each eligible run.
        failing: the number of failing runs.
        random: the counts of :class:`~pytest_pafot.campaign.resuming.RandomBeginning`, in the order of its ``counts``.
        rows: rows for the table of runs.
        doubt: see :func:`unit_doubt`.
        avoidable: see :class:`SearchLoop`.
    """

    runs: int
    decisions: int
    news: tuple[Evaluation, ...]
    judged: tuple[tuple[Evaluation, Judged], ...] | None
    health: Health
    verdicts: Counter[str]
    caught: Counter[str]
    responsibilities: Counter[str]
    outcomes: Counter[str]
    failed: Counter[Signature]
    manners: tuple[tuple[Signature, Manner, str], ...]
    fitness: tuple[float, ...]
    failing: int
    random: tuple[int, int, int, int]
    rows: tuple[dict[str, Any], ...]
    doubt: str
    avoidable: str


@dataclass(slots=True, kw_only=True)
class Counting:
    """The drawing and counting of a search's scenarios in the processes that run them.

    Attributes:
        read: reads and judges each run.
        wants_each: True if the listener needs each run.
        drawer: draws the scenarios; None before the search begins.
        random_runs: the number of random scenarios at the beginning of the search that are counted apart.
        fatal: scenarios in which a process died; they are not run.
    """

    read: Reader
    wants_each: bool
    drawer: Drawer[Any] | None = None
    random_runs: float = 0.0
    fatal: set[Scenario] = field(default_factory=set)

    def scenario(self, generation: int, index: int) -> Scenario | None:
        """Return the scenario of a place; None if no process may run it."""
        assert self.drawer is not None  # noqa: S101  (the search has begun)
        scenario = self.drawer.scenario(generation, index)
        return None if scenario in self.fatal else scenario

    def learn(self, said: tuple[tuple[Evaluation, ...], frozenset[Signature]]) -> None:
        """Learn from the next generation, and remember the failures that the session knows by now."""
        assert self.drawer is not None  # noqa: S101  (the search has begun)
        news, known = said
        self.drawer.learn(news)
        self.read.known.update(known)

    def counted(self, generation: int, start: int, digests: Sequence[Passed]) -> Tally:
        """Count consecutive runs."""
        assert self.drawer is not None  # noqa: S101  (the search has begun)
        drawer, evaluations = self.drawer, [each.evaluation for each in digests]
        left = max(0.0, self.random_runs - drawer.number(generation, start))
        at_random = digests[: len(digests) if left >= len(digests) else int(left)]
        verdicts = [each.event.verdict for each in at_random]
        valid = [each for each in verdicts if not (each.discarded or each.kind == "invalid")]
        failed = sum(each.kind in FAILING for each in valid)
        at_fault = sum(each.is_at_fault for each in at_random)
        has_rows = digests[0].event.columns is not None and not self.wants_each
        return Tally(
            runs=len(digests),
            decisions=sum(each.decisions for each in digests),
            news=tuple(each for each in evaluations if drawer.matters(generation, each)),
            judged=tuple((each.evaluation, each.event) for each in digests) if self.wants_each else None,
            health=Health.of_runs(len(digests), evaluations),
            verdicts=Counter(each.event.verdict.kind for each in digests),
            caught=Counter(name for each in digests for name in each.caught),
            responsibilities=Counter(each.event.responsibility or "none" for each in digests),
            outcomes=Counter(str(each.outcome) for each in evaluations),
            failed=Counter(each.signature for each in digests if each.signature is not None),
            manners=tuple(
                {
                    (each.signature, each.manner): (each.signature, each.manner, each.event.executed.id)
                    for each in reversed(digests)
                    if each.signature is not None and each.manner is not None
                }.values()
            )[::-1],
            fitness=tuple(each.fitness for each in evaluations if each.eligible and math.isfinite(each.fitness)),
            failing=sum(each.failing for each in evaluations),
            random=(len(at_random), len(valid), at_fault, failed - at_fault),
            rows=tuple(
                row_of(each.evaluation, generation) | dict(each.event.columns or {}) for each in digests if has_rows
            ),
            doubt=next((each.doubt for each in digests if each.doubt), ""),
            avoidable=next((each.event.verdict.told for each in digests if each.event.verdict.told), ""),
        )


def _evaluated(
    trace: Trace,
    verdict: Verdict,
    signature: Signature | None,
    fitness: Callable[[Trace], float],
    is_steered_by_checks: bool,
) -> Evaluation:
    """Return what the algorithm sees of a judged run: how bad it was and how it failed, to look for other failures.

    ``signature`` is None if the run is no failure that counts.
    """
    check = verdict.failure.check if verdict.failed and verdict.failure is not None else None
    return Evaluation.of(
        trace,
        fitness=trace.reading(FITNESS, fitness),
        failing=verdict.failed,
        discarded=verdict.discarded,
        kind=signature,
        mistake=(None if signature is None else signature.mistake) if check is None else check.name,
        margins=verdict.margins if is_steered_by_checks else (),
    )


def _caught(verdict: Verdict) -> tuple[str, ...]:
    """Return the names of the checks that failed in a run that passed, because the test function caught the error."""
    return tuple({check.name for check in verdict.checks if not check.holds}) if verdict.kind == "passed" else ()


@dataclass(slots=True, kw_only=True)
class SearchLoop:
    """A search in progress, with everything that it has seen so far."""

    simulation: Simulation
    recorder: Recorder
    fitness: Callable[[Trace], float]  # the fitness of a trace; higher is worse for the ego
    space: SearchSpace | None = None  # the space from which scenarios are sampled; None for replays only
    listener: Listener = lambda event: None
    is_steered_by_checks: bool = True  # True if margins of checks are objectives, in addition to the fitness
    seconds_left: Callable[[], float] = lambda: math.inf  # the time after which a run ends between decisions [s]
    fatal: set[Scenario] = field(default_factory=set)  # scenarios in which a process died; they are not run
    shown: Mapping[Signature, str] = field(default_factory=dict)  # ids of saved scenarios by the failure they show now
    finds: dict[Signature, str] = field(default_factory=dict)  # ids of new findings by signature
    repeats: Counter[str] = field(default_factory=Counter)  # number of other runs that show a new finding, by id
    known: Counter[str] = field(default_factory=Counter)  # number of failing runs by the file that covers them
    # for each failure that a saved scenario shows and each manner of it, the id of the first scenario of this session
    manners: dict[Signature, dict[Manner, str]] = field(default_factory=dict)
    failures: dict[Signature, str] = field(default_factory=dict)  # ids by the failures that runs of this session showed
    verdicts: Counter[str] = field(default_factory=Counter)  # number of verdicts by kind
    told_decisions: int = 0  # number of decisions of the ADS in the runs that other processes judged, and beside runs
    caught: Counter[str] = field(default_factory=Counter)  # number of passed runs by a check that failed in them
    counted: Health = field(default_factory=Health)  # health of the evaluations that were counted
    uncounted: list[events.Evaluated] = field(default_factory=list)
    generation: int = 0  # generation of the main search, from 0
    finished: events.CampaignFinished | None = None  # the last event, once the campaign is over
    skip: BaseException | None = None  # the last skip of the test function
    first: FirstGeneration = field(default_factory=FirstGeneration)
    # number of runs that failed in lock step, by whether they failed alone, too
    repeated: Counter[bool] = field(default_factory=Counter)
    avoidable: str = ""  # what happened in the first run that is excused though braking late avoids the collision
    doubt: str = ""  # a doubt about the units of the ADS's actions, if any
    impure: str = ""  # a scenario in which an ADS that is marked as pure decided otherwise when it made all decisions
    # how the reference itself failed in all its runs so far; empty if it did not in one of them, None before the first
    broken: str | None = None
    counting: Counting | None = None  # how other processes draw and count scenarios; None if they do not

    @property
    def runs(self) -> int:
        """The number of scenarios that were simulated so far."""
        return self.verdicts.total()

    @property
    def decisions(self) -> int:
        """The number of decisions that the ADS has made so far in this session, except to confirm findings."""
        return self.told_decisions + self.simulation.runner.asked - self.recorder.confirm_decisions

    @property
    def health(self) -> Health:
        """The figures that say whether the search tested anything."""
        self.count()
        return self.counted

    @property
    def known_alone(self) -> str:
        """A note if all failures so far are known failures of checks; empty if nothing or anything else failed."""
        checks = {id_ for signature, id_ in self.shown.items() if signature.failure == CHECK_FAILED}
        if not self.known or self.known.total() < self.verdicts["failed"] or not checks.issuperset(self.known):
            return ""
        names = " and ".join(f"saved-{id_}" for id_ in sorted(self.known))
        which = "a failed check" if len(self.known) == 1 else "failed checks"
        return f"all {plural(self.known.total(), 'failing run')} are known, by {names}, {which}; nothing else failed"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the search's health, and about a test function or reference with which nothing can fail."""
        harness = self.simulation.harness
        warnings = self.health.warnings(self.known.total(), acts_in_si=protocol.acts_in_si(harness.world, harness.ads))
        excused = sum(self.verdicts[kind] for kind in ("npc", "avoidable", "unpreventable"))
        if excused and not self.verdicts["passed"] and not self.verdicts["failed"]:
            blame, what = harness.request.blame, "collisions that an NPC is responsible for"
            if self.verdicts["unpreventable"]:
                what = "failures that no reference driver would have prevented, or " + what
            warnings.append(
                f"the test function judged nothing: all runs that it could judge were {what}, which "
                f'blame="{blame}" excludes; search longer'
            )
        warnings += [
            f"check {name!r} failed in {runs} of {self.verdicts['passed']} runs that passed: the test function caught "
            "its exception; do not catch it, or use pafot.target, which never fails"
            for name, runs in sorted(self.caught.items())
        ]
        if self.repeated[False] > self.repeated[True]:  # a few may, because a network rounds differently in a batch
            warnings.append(
                f"{self.repeated[False]} of {plural(self.repeated.total(), 'run')} that failed by the ADS's `batch` "
                "passed when the ADS was called for each alone, which is all that counts; let both decide the same"
            )
        if self.impure:
            warnings.append(
                f"the ADS is marked as pure, but decided otherwise in {self.impure} when it made all decisions, "
                "as it must if it remembers earlier ones: runs may have passed or failed by that; remove `pure`"
            )
        if self.broken:
            warnings.append(
                f"the reference itself failed in all its runs, at first with {self.broken}, so no failure could count; "
                "correct the reference, its factory, or the world= in which it drives"
            )
        return tuple(warnings)

    def evaluate(self, scenario: Scenario) -> Evaluation:
        """Run and judge a scenario; return its evaluation for the algorithm.

        Raises:
            OutOfTime: if the time of the search is over before that; the scenario then counts nowhere.
        """
        run = lost = None
        with runs_end_in(self.seconds_left()):
            if scenario not in self.fatal:
                try:
                    run = self.simulation.made(scenario)
                except ProcessLostError as error:
                    lost = error
            if isinstance(run, Digest):
                return self._taken(run.content)
            if run is not None:
                return self._judged(run)
        self.first.is_alike = False
        self.recorder.release()
        if lost is not None:  # Outside of the handler, so that the finding's exception has no context.
            self.verdicts["failed" if self.lose(lost) else "common"] += 1
        # Nothing is known about a scenario in which a process died, and it is not run again.
        return Evaluation(
            scenario=scenario,
            executed=scenario,
            fitness=0.0,
            failing=False,
            outcome=Outcome.SAFE,
            duration=0.0,
            genes_started=0,
            genes_reached=0,
            interaction=False,
            discarded=True,
        )

    def follow(self, campaign: Iterable[events.Event], tick: Callable[[], None] = lambda: None) -> None:
        """Process the events of a campaign to its end. ``tick`` is called after each event.

        Raises:
            SetupFaultError: if all runs of the first generation end in the same exception.
        """
        for event in campaign:
            self.listener(event)
            match event:
                case events.Evaluated():
                    self.uncounted.append(event)
                case events.GroupEvaluated():
                    self.counted += event.counts.health
                case events.GenerationFinished(local_generation=0):
                    self.generation = event.generation + 1
                    self.first.end()
                case events.LocalSearchStarted():
                    self.generation = event.generation
                case events.LocalSearchFinished():
                    self.generation = event.generation + 1
                case events.CampaignFinished():
                    self.finished = event
            tick()

    def check_pure(self) -> None:
        """Make some runs again with all decisions by the ADS, if decisions of earlier runs took their place."""
        runner, asked = self.simulation.runner, 0
        for _, trace in runner.resumed:
            if asked > runner.reused * PURE_SHARE:
                return
            asked += len(trace.actions)
            if not is_same_run(self.simulation.harness.seen(trace), self.simulation.rerun(trace.scenario)):
                self.impure = trace.scenario.id
                return

    def count(self) -> None:
        """Count the evaluations since the last call. Counting is delayed so that no scenario has to wait for it."""
        self.counted += Health.of(self.uncounted)
        self.uncounted.clear()

    def lose(self, lost: LostRun) -> bool:
        """Record a scenario whose process died or hung, so that it is never run again, not even in later sessions.

        Return whether that is a failure. It is none if the reference does not pass the scenario either.
        """
        self.fatal.add(lost.task)
        if self.simulation.is_common(lost.task):
            return False
        self._count(expectation(lost).signature, lambda: self.recorder.keep_lost(lost, self.generation, self.runs + 1))
        return True

    # The search as a :class:`~pytest_pafot.searching.ask_tell_loop.Team`: other processes draw and count scenarios.

    def begin(self, drawer: Drawer[Any], needed: Callable[[int], int]) -> None:
        """Let other processes draw and count scenarios, as soon as they are in use."""
        if self.counting is not None:
            self.counting.drawer = drawer
            self.simulation.runner.begin_groups(drawer, needed)

    def group(self, generation: int, index: int) -> Group | None:
        """Count the next runs that another process has counted; None if the next one must be evaluated here.

        Raises:
            OutOfTime: if the time of the search is over.
        """
        with runs_end_in(self.seconds_left()):
            part = self.simulation.runner.counted(generation, index)
        if part is None:
            return None
        tally: Tally = part.counted
        for _, event in tally.judged or ():
            self.listener(event)
        self.verdicts.update(tally.verdicts)
        self.told_decisions += tally.decisions
        self.caught.update(tally.caught)
        self.doubt = self.doubt or tally.doubt
        self.avoidable = self.avoidable or tally.avoidable
        if self.first.is_alike:
            self.first.see_others(tally.verdicts)
        if not self.first.is_alike:
            self.recorder.release()
        for signature, runs in tally.failed.items():
            self._count_known(signature, runs)
        for signature, manner, id_ in tally.manners:
            self._see_manner(signature, manner, id_)
        each = None if tally.judged is None else tuple(evaluation for evaluation, _ in tally.judged)
        return Group(runs=tally.runs, news=tally.news, counts=tally, each=each)

    def learn(self, news: tuple[Evaluation, ...]) -> None:
        """Let the other processes learn what the algorithm has learnt, and which failures are known by now."""
        if self.counting is not None:
            # Until two runs differ, the session must see each failure, which may be a fault of the set-up.
            is_sure = not (self.first.is_alike or self.counting.wants_each)
            known = {*self.shown, *self.finds} - self.counting.read.known if is_sure else set()
            self.counting.read.known.update(known)
            self.simulation.runner.tell((news, frozenset(known)))

    def _taken(self, passed: Passed) -> Evaluation:
        """Count a run that another process has judged, and return its evaluation."""
        self.listener(passed.event)
        self.told_decisions += passed.decisions
        self._count_run(None, passed.event.verdict, passed.caught, passed.doubt)
        if passed.signature is not None:
            self._count_known(passed.signature)
            self._see_manner(passed.signature, passed.manner, passed.event.executed.id)
        return passed.evaluation

    def _count_run(self, run: Run | None, verdict: Verdict, caught: Iterable[str], doubt: str) -> None:
        """Count a judged run; ``run`` is None if another process has judged it."""
        self.verdicts[verdict.kind] += 1
        # What says that the set-up is wrong: a check that the function catches, units, the same error in all runs. As
        # soon as two runs differ, the findings that were held back are no fault of the set-up.
        self.caught.update(caught)
        self.doubt = self.doubt or doubt
        self.avoidable = self.avoidable or verdict.told
        if self.first.is_alike:
            self.first.see(run, verdict)
        if not self.first.is_alike:
            self.recorder.release()

    def _judged(self, run: Run) -> Evaluation:
        is_alone = self.simulation.runner.is_alone
        verdict = self.simulation.judge(run)
        judged = [Judged.here(run, verdict)]
        if verdict.failed and not is_alone:  # Run it alone as its replay will, in case a batch mixes up its rows.
            run = self.simulation.run(run.trace.scenario, afresh=True)
            verdict = self.simulation.judge(run)
            judged.append(Judged.here(run, verdict))
            self.repeated[verdict.failed] += 1
        for event in judged:  # After both runs, because the time limit may end the second one, and then none counts.
            self.listener(event)
        self._count_run(run, verdict, _caught(verdict), unit_doubt(run.trace))
        # A failure is known, repeated or new, by its signature; a new one is saved here, before the next run.
        signature, failure = None, verdict.failure if verdict.failed else None
        if failure is not None:
            signature, manner = failed_as(run, failure)
            self._see_manner(signature, manner, run.scenario.id)
            self._count(signature, lambda: self.recorder.keep(run, verdict, self.generation, self.runs))
        if verdict.kind == "skipped":
            self.skip = verdict.exception
        if verdict.reference is not None and self.broken != "":
            broken = verdict.reference.failure if verdict.reference.is_ads else None
            self.broken = "" if broken is None else self.broken or f"{broken.kind}: {broken.message}"
        return _evaluated(run.trace, verdict, signature, self.fitness, self.is_steered_by_checks)

    def _count(self, signature: Signature, keep: Callable[[], str]) -> None:
        """Count a failure as known, as a repetition in this search, or as new; ``keep`` records a new failure."""
        if signature in self.shown or signature in self.finds:
            self._count_known(signature)
        else:
            self.finds[signature] = self.failures[signature] = keep()

    def _see_manner(self, signature: Signature, manner: Manner | None, scenario_id: str) -> None:
        if signature in self.shown and manner is not None:
            self.manners.setdefault(signature, {}).setdefault(manner, scenario_id)

    def _count_known(self, signature: Signature, runs: int = 1) -> None:
        """Count runs with a failure that a saved scenario shows, or that this search has found before."""
        id_ = self.failures[signature] = self.shown.get(signature) or self.finds[signature]
        (self.known if signature in self.shown else self.repeats)[id_] += runs


PURE_SHARE = 1 / 10
"""The share of the decisions that a pure ADS need not make from which on no further run is made to check that it is."""


# The recorder of new findings: it saves each finding, confirms it, and reports it. To confirm a finding, its run is
# made once more, and once in highway-env's own environment.

UNCONFIRMED = "not confirmed: out of time"
"""The remark on a finding that the time limit left no time to run again."""


def difference(run: Run, simulation: Simulation) -> str:
    """Return what differs when the scenario of a run is run again; empty if the finding is confirmed.

    The same world must give a run that is equal to the last bit. In highway-env's own environment, if the world has
    it, the run must end in the same way.
    """
    try:
        if not is_same_run(run, simulation.rerun(run.scenario)):
            return NOT_REPEATED
        differs = _difference_in_gym(run, simulation)
    except ProcessLostError as error:
        return f"the process that ran it again {error.how}"
    if not differs:
        return ""
    harness = simulation.harness
    told = "" if is_vehicle_class(harness.ads) else left_out_text(harness.world)
    return f"in highway-env's own environment: {differs}" + (f"; {told}" if told else "")


def left_out_text(world: Any) -> str:
    """Return a sentence on the environment's own methods that runs do not call, though they matter; or empty."""
    methods = protocol.left_out(world)
    if not methods:
        return ""
    names = " and ".join(f"`{name}`" for name in methods)
    changed = ", ".join(f"`{each}`" for each in dict.fromkeys(chain.from_iterable(methods.values())))
    return (
        f"runs do not call the environment's own {names}, which may change {changed}: write wrappers=[] in its "
        "pafot.World"
    )


def _difference_in_gym(run: Run, simulation: Simulation) -> str:
    try:
        other = simulation.rerun_in_gym(run.scenario)
    except ProcessLostError:
        raise
    except UNFIT as error:  # any exception of the environment or the ADS is the difference
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
    return "" if other is None else disagreement(run, other)


UNSEEN_CRASH = Expect(
    failure=PROCESS_CRASH,
    outcome=Outcome.ADS_ERROR,  # The ADS is the only code that can kill a process.
    time=0.0,
    message="the process ended while it ran this scenario",
)
"""The expected result in the file of a scenario in which a process died for an unknown reason."""


@dataclass(slots=True, kw_only=True)
class Recorder:
    """A recorder that saves, confirms and reports the findings of one search."""

    harness: Harness
    seed: int
    confirm: Callable[[Run], str]  # returns what differs when a run is repeated; empty if nothing does
    listener: Listener
    clock: Callable[[], float]  # returns the seconds since some fixed moment
    asked: Callable[[], int]  # returns the number of decisions that the ADS has made so far
    begins: Callable[[str], object] = lambda find_id: None  # is called before a finding is confirmed
    confirm_decisions: int = 0  # those of them that confirmed a finding
    confirm_seconds: float = 0.0  # the time that confirming took [s]
    pace: float = 0.0  # the longest time to confirm one second of a run so far [s]
    until: float = math.inf  # the time at which confirming ends [s]
    # files that existed before the search; their replays do not show the findings that are saved here
    replayed: frozenset[Path] = frozenset()
    kept: dict[str, FindTold] = field(default_factory=dict)  # the findings so far, by id
    unsaved: list[str] = field(default_factory=list)  # ids of findings above the limit of saved scenarios
    first: BaseException | None = None  # the exception of the first finding, for a debugger
    held: list[str] = field(default_factory=list)  # ids of findings that are saved and not reported yet
    dismissed: dict[str, str] = field(default_factory=dict)  # headlines of findings that do not count, by id
    is_holding: bool = True  # False once findings are reported at once, because they are no fault of the set-up

    @property
    def count(self) -> int:
        """The number of distinct findings so far, including findings above the limit, which are not saved."""
        return len(self.kept) + len(self.unsaved) - len(self.held)

    @property
    def firm(self) -> int:
        """The number of findings that can be shrunk."""
        return sum(kept.is_firm for kept in self.kept.values())

    def keep(self, run: Run, verdict: Verdict, generation: int, number: int) -> str:
        """Save a new finding, run its scenario again to confirm it, and report it or hold it back; return its id.

        ``generation`` is counted from 0; ``number``, the number of the run in the search, from 1.
        """
        if verdict.failure is None or verdict.exception is None:
            raise ValueError(f"verdict: expected the verdict on a failed run, received {verdict!r}")
        harness = self.harness
        finding = Finding.of(
            run,
            verdict.failure,
            test=harness.node_id,
            world=codec.described(harness.world),
            found=self._found(generation),
            perception=self._perception,
            against="" if harness.against is None else harness.against.name,
            root=str(harness.root),
        )
        files = files_in(harness.folder)  # Empty if the folder cannot be read; writing into it reports why.
        is_full = max(len(files), len(self.kept)) >= harness.request.settings.max_saved
        # A finding whose file exists already takes no more room.
        if is_full and not os.path.lexists(free_path(harness.folder, finding, self.replayed)[0]):
            self.unsaved.append(finding.id)
            self.first = self.first or verdict.exception
            return finding.id
        # Saved before it is confirmed, so that nothing is lost if the session dies in the second run.
        origin = self._origin(generation, number)
        with postponed():  # Whatever interrupts the search from here on, it ends with a report of what is held.
            kept = self._saved(finding, headline(run, verdict), origin, verdict.exception, verdict.is_timed)
            kept = replace(kept, run=run, number=number, find=replace(kept.find, severity=verdict.severity))
            self.kept[kept.find.id] = kept
            self.held.append(kept.find.id)
        differs = ""
        try:
            if not verdict.is_timed:
                self.begins(kept.find.id)
                differs = self.confirmed(run)
        except OutOfTime:
            kept = replace(kept, find=replace(kept.find, unshrunk=UNCONFIRMED))
        finally:  # The finding must be reported even if these runs are interrupted.
            if differs:
                kept = self.call_flaky(kept, differs)
            self.kept[kept.find.id] = kept
            if not self.is_holding:
                self.tell(kept)
        return kept.find.id

    def confirmed(self, run: Run) -> str:
        """Return what differs when a run is repeated; empty if nothing does. Measure how long that takes.

        Raises:
            OutOfTime: if the time of the search is over.
        """
        began, asked = self.clock(), self.asked()
        try:
            with runs_end_in(self.until - began):
                differs = self.confirm(run)
        finally:
            seconds = self.clock() - began
            self.confirm_seconds += seconds
            self.confirm_decisions += self.asked() - asked
        self.pace = max(self.pace, seconds / max(run.duration, 1.0))
        return differs

    def release(self) -> None:
        """Report the findings that were held back; from now on, each new finding is reported at once."""
        self.is_holding = False
        for find_id in tuple(self.held):
            self.tell(self.kept[find_id])

    def withdraw(self) -> None:
        """Remove the files of findings that were held back, since they are a fault of the set-up.

        A finding whose file cannot be removed is reported.
        """
        withdrawn = [self.kept.pop(find_id) for find_id in self.held]
        self.held.clear()
        self.is_holding = False
        self.unsaved.clear()
        for kept in withdrawn:
            try:
                if kept.file is not None:
                    kept.file.unlink(missing_ok=True)
            except OSError:
                self.tell(kept)
        if not any(kept.file for kept in withdrawn):
            return  # Nothing was saved, and the folders may be behind a link, where nothing may be removed.
        with suppress(OSError):  # Folders with other content stay.
            self._remove_folders()

    def dismiss(self, kept: FindTold, why: str) -> None:
        """Report that a finding does not count, and remove its file."""
        file, find = kept.file, replace(kept.find, label=NO_WORSE, detail=why, unshrunk="")
        if file is not None:
            with suppress(OSError):  # A file that cannot be removed stays, and is told with its path.
                file.unlink(missing_ok=True)
                find = replace(find, path="")
            with suppress(OSError):  # Folders with other content stay.
                self._remove_folders()
        with postponed():
            del self.kept[find.id]
            self.dismissed[find.id] = find.headline
            self.first = next((each.exception for each in self.kept.values()), None)
            self.listener(replace(kept, find=find, is_new=False))

    def _remove_folders(self) -> None:
        for folder in (self.harness.folder, *self.harness.folder.parents[:2]):
            folder.rmdir()

    def tell(self, told: FindTold) -> None:
        """Report a new finding, or an update of a reported finding, to the listener."""
        with postponed():
            self.kept[told.find.id] = told
            if self.first is None or told.find.id == next(iter(self.kept)):
                self.first = told.exception
            self.listener(told)
            if told.find.id in self.held:
                self.held.remove(told.find.id)

    def call_flaky(self, kept: FindTold, difference: str) -> FindTold:
        """Mark a finding as flaky, also in its file; return it. ``difference`` is what did not repeat."""
        marked = self.rewritten(kept, replace(kept.finding, flaky=portable(difference, str(self.harness.root))))
        self.kept[kept.find.id] = replace(marked, find=replace(kept.find, difference=difference, unshrunk=""))
        return self.kept[kept.find.id]

    def rewritten(self, kept: FindTold, finding: Finding) -> FindTold:
        """Replace a finding by a new version, also in its file; return it.

        If the file cannot be written, the old finding is returned, with the reason.
        """
        if kept.file is None:
            return replace(kept, finding=finding, content=text_of(finding) if kept.content else "")
        try:
            return replace(kept, finding=rewrite(kept.file, finding))
        except CorpusWriteError as error:
            return replace(kept, origin=f"{kept.origin}; its file is as first found: {error}")

    def keep_crash(self, leftover: Leftover, scenario: Scenario, again: LostRun | None) -> None:
        """Save and report a scenario in which a process died in an earlier session, as its record ``leftover`` says.

        ``again`` describes how a second process ended that ran the scenario again; None if that is unknown.
        """
        others = " and others in lock step" if leftover.is_lock_step else ""
        text = f"a process (pid {leftover.pid}) died while it ran this scenario{others}, "
        if again is None:
            text += (
                "because of a crash of native code, something that builds up from run to run, such as memory, or a "
                "kill from outside; if it was killed from outside, delete the file"
            )
        else:
            text += f"and the one that ran it again {again.how}: {cause(again, 'delete the file')}"
        expect, line = UNSEEN_CRASH, "crash: a process died while it ran this scenario"
        if again is not None:
            expect, line = expectation(again), _headline(again)
        finding = self._death(scenario, expect, self._found(0, "crash"), leftover.world)
        is_timed = again is not None and again.is_hang
        with postponed():
            self.tell(self._saved(finding, line, "the record of a session that died", PlainFailure(text), is_timed))

    def keep_lost(self, lost: LostRun, generation: int, number: int) -> str:
        """Save and report a scenario whose process died or hung; return its id. The numbers are as in :meth:`keep`."""
        alone = "" if lost.is_hang else ", also when nothing else ran"
        text = f"the {lost.who} that ran this scenario {lost.how}{alone}: "
        text += cause(lost, f"{flag('workers', 1)} finds nothing here; delete the file")
        finding = self._death(lost.task, expectation(lost), self._found(generation), None)
        origin = self._origin(generation, number)
        with postponed():
            kept = self._saved(finding, _headline(lost), origin, PlainFailure(text), lost.is_hang)
            self.tell(kept)
        return kept.find.id

    @property
    def _perception(self) -> Perceived | None:
        sight = sight_of(self.harness.ads)
        return None if sight is None else Perceived(sight=sight)

    def _found(self, generation: int, algorithm: str = "") -> Found:
        algorithm = algorithm or self.harness.request.algorithm.name
        return Found(
            seed=self.seed,
            generation=generation,
            algorithm=algorithm,
            versions=self.harness.versions,
            weights=weights_digest(self.harness.ads),
        )

    def _origin(self, generation: int, number: int) -> str:
        algorithm = self.harness.request.algorithm.name
        return f"{algorithm}, seed {self.seed}, generation {generation}, run {number}"

    def _death(self, scenario: Scenario, expect: Expect, found: Found, world: Mapping[str, Any] | None) -> Finding:
        return Finding(
            id=f"{'hang' if expect.outcome is Outcome.HANG else 'crash'}-{scenario.id}",
            test=self.harness.node_id,
            scenario=scenario,
            world=world or codec.described(self.harness.world),
            expect=expect,
            found=found,
            perception=self._perception,
        )

    def _saved(self, finding: Finding, line: str, origin: str, exception: BaseException, is_timed: bool) -> FindTold:
        path, finding = free_path(self.harness.folder, finding, self.replayed)
        while finding.id in self.kept:
            finding = replace(finding, id=f"{finding.id}-again")
            path = self.harness.folder / f"{finding.id}{SUFFIX}"
        problem = content = ""
        try:
            if self.harness.request.settings.save == "none":
                problem = flag("save", "none")
            # Between the check and the write, another session may use the name for its own finding.
            while not problem and not write(path, finding):
                other, renamed = free_path(self.harness.folder, finding, self.replayed)
                if other == path:
                    break
                path, finding = other, renamed
        except CorpusWriteError as error:
            problem, content = str(error), text_of(finding)
        node_id, told = self.harness.saved_node_id(finding.id), "" if problem else relative(path, self.harness.root)
        find = Find(
            id=finding.id,
            node_id=node_id,
            headline=line,
            path=told,
            detail=problem,
            is_timed=is_timed,
            responsible=finding.expect.responsibility,
        )
        return FindTold(
            finding=finding,
            find=find,
            origin=origin,
            exception=exception,
            file=None if problem else path,
            content=content,
        )


def _headline(lost: LostRun) -> str:
    return f"{'hang' if lost.is_hang else 'crash'}: the process that ran this scenario {lost.how}"


def cause(lost: LostRun, way_out: str) -> str:
    """Return why a process may have died or hung; with ``way_out``, what to do if the scenario is not the cause."""
    if lost.how == OUT_OF_MEMORY:
        return f"the ADS uses more and more memory, or needs that much (then give a larger {flag('memory')})"
    if lost.how == WORLD_HANGS:
        return f"the world hangs, or needs that long (then give it a longer hang_limit and {way_out})"
    if not lost.is_hang:
        return "the likely cause is a crash of native code, an exit or a lack of memory"
    return (
        "the ADS hangs in code that does not return to the interpreter, ignores the interrupt, or uses a library that "
        f"does not work in a forked process (then {way_out})"
    )
