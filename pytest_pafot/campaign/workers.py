"""The runs of one search: the processes that make and judge them, their limits, and the records of crashes."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

from pytest_pafot.attribution.mistakes import mistake_of
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.events import NOT_REPEATED, Judged
from pytest_pafot.campaign.harness import Harness, is_same_run, refusals
from pytest_pafot.campaign.run_table import columns_of, row_of
from pytest_pafot.campaign.setup_fault import unit_doubt
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.execution.crash_records import CrashRecord, Leftover
from pytest_pafot.execution.elsewhere import DrivesElsewhere
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Runner, replay_in_gym_apart
from pytest_pafot.execution.scenario_pool import Digest, LostRun
from pytest_pafot.findings.finding import Manner, disagreement, failed_as, message_of
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.evaluation import Evaluation, interaction_of
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.plan import AheadPlan, Drawer, Plan
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.ads import is_vehicle_class
from pytest_pafot.world.guard.chance import GENERATORS
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
"""The kinds of verdicts for which a digest is enough, as it is for failures that the search knows. All other runs are
judged in the session, with their traces.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """Read the trace of a run in the process that made it, so that the process of the session need not.

    With a harness, that process judges the run, too, and sends a digest if nothing failed, or nothing new. Otherwise it
    sends the trace, which stores the values that the search will need.

    Attributes:
        harness: has the test function; None if only the process of the session may call it.
        fitness: the fitness of a trace; None if it is the user's own function, which runs only in the session.
        is_steered_by_checks: True if margins of checks are objectives, in addition to the fitness.
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
                evaluation=evaluated(trace, verdict, signature, self.fitness, self.is_steered_by_checks),
                event=event,
                signature=signature,
                manner=manner,
                is_at_fault=signature is not None and fails_by_ego(run, verdict),
                decisions=len(trace.actions),
                caught=caught_in(verdict),
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
        random: the counts of :class:`~pytest_pafot.campaign.state.RandomRuns`, in the order of its fields.
        rows: rows for the table of runs.
        doubt: see :func:`unit_doubt`.
        avoidable: see :class:`~pytest_pafot.campaign.state.State`.
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
            avoidable=next((each.event.verdict.excused for each in digests if each.event.verdict.excused), ""),
        )


def evaluated(
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


def caught_in(verdict: Verdict) -> tuple[str, ...]:
    """Return the names of the checks that failed in a run that passed, because the test function caught the error."""
    return tuple({check.name for check in verdict.checks if not check.holds}) if verdict.kind == "passed" else ()


PURE_SHARE = 1 / 10
"""The share of the decisions that a pure ADS need not make from which on no further run is made to check that it is."""


@dataclass(slots=True, kw_only=True)
class Workers:
    """The runs of one search. Until a run is judged, its scenario is on disk in the crash record of this process."""

    harness: Harness
    runner: Runner
    record: CrashRecord
    reference: Runner | None = None  # the runner of the reference
    counting: Counting | None = None  # how other processes draw and count scenarios; None if they do not
    fitness: Callable[[Trace], float]  # the fitness of a trace; higher is worse for the ego
    is_steered_by_checks: bool = True  # as in :class:`Reader`
    clock: Callable[[], float] = time.monotonic  # returns the seconds since some fixed moment
    counted_decisions: int = 0  # number of decisions of the ADS in runs that others judged, and beside runs
    until: float = math.inf  # the time at which confirming findings ends [s]
    confirm_decisions: int = 0  # the number of decisions of the ADS that confirmed findings
    confirm_seconds: float = 0.0  # the time that this took [s]
    pace: float = 0.0  # the longest time to confirm one second of a run so far [s]

    @property
    def decisions(self) -> int:
        """The number of decisions that the ADS has made so far in this session, except to confirm findings."""
        return self.counted_decisions + self.runner.asked - self.confirm_decisions

    def evaluation(self, run: Run, verdict: Verdict, signature: Signature | None) -> Evaluation:
        """Return what the algorithm sees of a run that this process has judged."""
        return evaluated(run.trace, verdict, signature, self.fitness, self.is_steered_by_checks)

    def impure(self) -> tuple[str, str] | None:
        """Make some runs again with all decisions by the ADS, if decisions of earlier runs took their place.

        Each is made up to as many decisions after those as they were. Return the id of a scenario with another run, and
        the mark of the ADS that allows no other; None if there is none.
        """
        asked = 0
        for reused, trace in self.runner.resumed:
            if asked > self.runner.reused * PURE_SHARE:
                break
            again = self.rerun(trace.scenario, most=2 * reused)
            asked += len(again.trace.actions)
            is_cut = len(again.trace.actions) == 2 * reused < len(trace.actions)
            same = again.trace.states.tobytes() == trace.states[: len(again.trace.states)].tobytes()
            if not (same if is_cut else is_same_run(self.harness.seen(trace), again)):
                return trace.scenario.id, self.runner.mark
        return None

    def begin(self, plan: Plan[Any], random_runs: float, fatal: set[Scenario]) -> None:
        """Let other processes draw and count the scenarios of a plan, as soon as they are in use, if that is possible.

        ``random_runs`` and ``fatal`` are as in :class:`Counting`.
        """
        if self.counting is not None and isinstance(plan, AheadPlan):
            self.counting.drawer, self.counting.random_runs, self.counting.fatal = plan.drawer, random_runs, fatal
            self.runner.begin_groups(plan.drawer, plan.needed)

    def next(self, plan: Plan[Any], fatal: Set[Scenario]) -> Run | Passed | Tally | LostRun | None:
        """Return what became of the next scenario of a plan, or of the next ones.

        That is the run, which must be judged next; what the process said that has made and judged the run; the counts
        of several runs; or how a process died or hung. It is None for a scenario of ``fatal``, which is not run.

        Raises:
            OutOfTime: if the time of the search is over before; the scenario then counts nowhere.
            RequestError: as for :meth:`run`.
        """
        __tracebackhide__ = True
        if self.counting is not None and isinstance(plan, AheadPlan):
            part = self.runner.counted(plan.generation, plan.index)
            if part is not None:
                tally: Tally = part.counted
                self.counted_decisions += tally.decisions
                return tally
        ahead = plan.ahead()
        if ahead is not None:
            self.runner.announce((each for each in ahead if each not in fatal), more=plan.is_ahead)
        scenario = plan.scenario()
        if scenario in fatal:
            return None
        try:
            with self._recorded(), refusals():
                made = self.runner.made(scenario)
        except ProcessLostError as error:
            return error
        if isinstance(made, Digest):
            passed: Passed = made.content
            self.counted_decisions += passed.decisions
            return passed
        return self.harness.seen(made)

    def learn(self, news: Sequence[Evaluation], known: Iterable[Collection[Signature]]) -> None:
        """Let the processes that draw scenarios learn what the algorithm has learnt, and the failures known by now."""
        if self.counting is not None and self.counting.drawer is not None:
            before = self.counting.read.known
            new = frozenset() if self.counting.wants_each else frozenset().union(*known) - before
            before.update(new)
            self.runner.tell((tuple(news), new))

    def run(self, scenario: Scenario, *, afresh: bool = False, most: int | None = None) -> Run:
        """Run a scenario. The caller must call :meth:`judge` next, which also clears the crash record.

        For ``afresh`` and ``most`` see :meth:`pytest_pafot.execution.runner.Runner.made`.

        Raises:
            ProcessLostError: if the run was in another process, and that process died or hung.
            RequestError: for a world, factory or scenario that does not fit.
            OutOfTime: if the time of the search is over.
        """
        __tracebackhide__ = True
        with self._recorded(), refusals():
            trace = self.runner.run(scenario, afresh=afresh, most=most)
        return self.harness.seen(trace)

    def judge(self, run: Run, scenario: Scenario | None = None) -> Verdict:
        """Judge the last run. If it fails, the reference is run in ``scenario``, by default in the run's scenario."""
        __tracebackhide__ = True
        with self._recorded():
            verdict = self.harness.judge(run)
            if verdict.failed and self.reference is not None:
                verdict = verdict.beside(self.harness.judge_reference(self.reference, scenario or run.scenario))
        self.record.clear()
        return verdict

    def is_common(self, scenario: Scenario) -> bool:
        """Return whether a failure in a scenario does not count, because the reference does not pass it either."""
        __tracebackhide__ = True
        if self.reference is None:
            return False
        verdict = self.harness.judge_reference(self.reference, scenario)
        self.record.clear()
        return not verdict.passes

    def rerun(self, scenario: Scenario, *, most: int | None = None) -> Run:
        """Run a scenario from scratch, without a verdict; ``most`` is as for :meth:`run`."""
        __tracebackhide__ = True
        run = self.run(scenario, afresh=True, most=most)
        self.record.clear()
        return run

    def rerun_one_by_one(self, leftover: Leftover) -> None:
        """Run the scenarios of a batch in which a process died one by one, to see which scenario is the cause."""
        __tracebackhide__ = True
        leftover.discard()  # first, or after a second death every session would run the whole batch again
        for scenario in leftover.scenarios:
            self.rerun(scenario)

    def rerun_in_gym(self, scenario: Scenario) -> Run | None:
        """Run a scenario with ``env.step`` of highway-env's own environment; None if the world has no environment."""
        __tracebackhide__ = True
        world = self.harness.world
        if not world.replays_in_gym:
            return None
        self.record.write(scenario)
        ads = self.harness.ads
        with self._recorded(), refusals():
            if isinstance(ads, DrivesElsewhere):
                trace = ads.driven("rollout_in_gym", world, scenario)
            elif self.harness.request.settings.isolate:
                trace = replay_in_gym_apart(self.harness.job(), self.record, scenario)
            else:
                trace = GENERATORS.run(world.rollout_in_gym, scenario, self.harness.drawing(ads))
        self.runner.asked += len(trace.actions)
        self.record.clear()
        return Run(trace, decision_limit=self.harness.request.decision_limit)

    def difference(self, run: Run) -> str:
        """Return what differs when a run is repeated; empty if nothing does. Measure how long that takes.

        Raises:
            OutOfTime: if the time of the search is over.
        """
        began, asked = self.clock(), self.runner.asked
        try:
            with runs_end_in(self.until - began):
                differs = difference(run, self)
        finally:
            seconds = self.clock() - began
            self.confirm_seconds += seconds
            self.confirm_decisions += self.runner.asked - asked
        self.pace = max(self.pace, seconds / max(run.duration, 1.0))
        return differs

    @contextmanager
    def _recorded(self) -> Iterator[None]:
        """Clear the crash record of a run that the time limit ends, because no process died in it."""
        __tracebackhide__ = True
        try:
            yield
        except OutOfTime:
            self.record.clear()
            raise


def difference(run: Run, workers: Workers) -> str:
    """Return what differs when the scenario of a run is run again; empty if the finding is confirmed.

    The same world must give a run that is equal to the last bit. In highway-env's own environment, if the world has
    it, the run must end in the same way.
    """
    try:
        if not is_same_run(run, workers.rerun(run.scenario)):
            return NOT_REPEATED
        differs = _difference_in_gym(run, workers)
    except ProcessLostError as error:
        return f"the process that ran it again {error.how}"
    if not differs:
        return ""
    harness = workers.harness
    likely_cause = "" if is_vehicle_class(harness.ads) else left_out_text(harness.world)
    return f"in highway-env's own environment: {differs}" + (f"; {likely_cause}" if likely_cause else "")


def left_out_text(world: BaseWorld) -> str:
    """Return a sentence on the environment's own methods that runs do not call, though they matter; or empty."""
    methods = world.left_out
    if not methods:
        return ""
    names = " and ".join(f"`{name}`" for name in methods)
    changed = ", ".join(f"`{each}`" for each in dict.fromkeys(chain.from_iterable(methods.values())))
    return (
        f"runs do not call the environment's own {names}, which may change {changed}: write wrappers=[] in its "
        "pafot.World"
    )


def _difference_in_gym(run: Run, workers: Workers) -> str:
    try:
        other = workers.rerun_in_gym(run.scenario)
    except ProcessLostError:
        raise
    except UNFIT as error:  # any exception of the environment or the ADS is the difference
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
    return "" if other is None else disagreement(run, other)
