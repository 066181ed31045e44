"""The runs of one search: the processes that make and judge them, their limits, and the records of crashes."""

from __future__ import annotations

import math
import pickle
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import chain
from typing import Any

from pytest_pafot.attribution.mistakes import mistake_of
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.events import NOT_REPEATED, Judged
from pytest_pafot.campaign.harness import Harness, is_same_run, refusals
from pytest_pafot.campaign.run_table import columns_of, row_of
from pytest_pafot.campaign.setup_fault import unit_doubt
from pytest_pafot.campaign.verdict import Verdict, skips
from pytest_pafot.execution.crash_records import CrashRecord, Leftover
from pytest_pafot.execution.elsewhere import DrivesElsewhere
from pytest_pafot.execution.pool import KILLED, ProcessLostError
from pytest_pafot.execution.runner import Runner, replay_in_gym_apart
from pytest_pafot.execution.scenario_pool import (
    Answer,
    BlockTask,
    CapturedOutput,
    Digest,
    Job,
    LostRun,
    Said,
    pool_for,
    run_recorded,
)
from pytest_pafot.findings.finding import Manner, disagreement, failed_as, message_of
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.evaluation import Evaluation, interaction_of
from pytest_pafot.searching.events import AlgorithmEvent
from pytest_pafot.searching.fitness import FitnessError
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.plan import Block, Learnt, Plan
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
class Digested(Digest):
    """All that a search needs of a run, in the process that has made and judged it.

    ``trace`` is the run itself if the session must judge it, because it failed in a way that is not known.
    """

    evaluation: Evaluation
    event: Judged
    trace: Trace | None
    signature: Signature | None  # of a failure that counts
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
"""The kinds of verdicts for which a tally is enough, as it is for failures that the search knows. All other runs are
judged in the session, with their traces.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reader:
    """Read the trace of a run in the process that made it, so that the process of the session need not.

    With a harness, that process judges the run, too, and sends a tally if nothing failed. Otherwise it sends the trace,
    which stores the values that the search will need.

    Attributes:
        harness: has the test function; None if only the process of the session may call it.
        fitness: the fitness of a trace; None if it is the user's own function, which runs only in the session.
        is_steered_by_checks: True if margins of checks are objectives, in addition to the fitness.
        has_table: whether a tally has the columns of its runs for the table of runs.
    """

    harness: Harness | None
    fitness: Callable[[Trace], float] | None
    is_steered_by_checks: bool
    has_table: bool

    def __call__(self, trace: Trace) -> Tally | None:
        """Read a trace; return the tally of the run, or None if the trace must be sent."""
        read_ahead(self.fitness, trace)
        digested = self.digested(trace)
        return None if digested is None or digested.trace is not None else Tally.of([digested])

    def digested(self, trace: Trace, known: Collection[Signature] = ()) -> Digested | None:
        """Return what a search needs of a run; None if only the session may judge it.

        Of the ``known`` failures no further trace must be sent.
        """
        if self.fitness is None or self.harness is None:
            return None
        run = self.harness.seen(trace)
        verdict, signature, manner = self.harness.judge(run), None, None
        if verdict.failed and verdict.failure is not None:
            signature, manner = failed_as(run, verdict.failure)
        event = Judged(
            scenario=trace.scenario,
            executed=trace.executed,
            verdict=replace(verdict, checks=(), exception=None),
            known_responsibility=run.responsibility,
            columns=columns_of(run, verdict) if self.has_table else None,
        )
        return Digested(
            evaluation=evaluated(trace, verdict, signature, self.fitness, self.is_steered_by_checks),
            event=event,
            trace=None if verdict.kind in UNREMARKABLE or signature in known else trace,
            signature=signature,
            manner=manner,
            is_at_fault=signature is not None and fails_by_ego(run, verdict),
            decisions=len(trace.actions),
            caught=caught_in(verdict),
            doubt=unit_doubt(trace),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Tally(Digest):
    """The counts of consecutive runs that another process has made and judged.

    Attributes:
        runs, decisions: the numbers of runs, and of decisions of the ADS in them.
        evaluations: the evaluations, packed, because the session seldom needs each of them.
        judged: the event of each run if it was no process that drives a block that made it; otherwise None.
        health: the figures on the search's health.
        verdicts, caught, responsibilities, outcomes: numbers of runs by kind of verdict, check, responsible, outcome.
        failed: numbers of runs by their known failures.
        manners: for each known failure and manner the id of the first scenario.
        fitness: the finite fitness of each eligible run.
        failing: the number of failing runs.
        random: the counts of :class:`~pytest_pafot.campaign.state.RandomRuns`, in the order of its fields.
        rows: rows for the table of runs, unless ``judged`` has their columns.
        doubt: see :func:`unit_doubt`.
        avoidable: see :class:`~pytest_pafot.campaign.state.State`.
    """

    runs: int
    decisions: int
    evaluations: bytes
    judged: tuple[Judged, ...] | None
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

    @classmethod
    def of(cls, runs: Sequence[Digested], generation: int | None = None) -> Tally:
        """Count runs of a generation; without its number, the tally has the event of each run."""
        evaluations, verdicts = [each.evaluation for each in runs], [each.event.verdict for each in runs]
        valid = [each for each in verdicts if not (each.discarded or each.kind == "invalid")]
        failed, at_fault = sum(each.kind in FAILING for each in valid), sum(each.is_at_fault for each in runs)
        rows: list[dict[str, Any]] = []
        if generation is not None:
            rows = [
                row_of(each.evaluation, generation) | dict(each.event.columns)
                for each in runs
                if each.event.columns is not None
            ]
        return cls(
            runs=len(runs),
            decisions=sum(each.decisions for each in runs),
            evaluations=pickle.dumps(evaluations),
            judged=tuple(each.event for each in runs) if generation is None else None,
            health=Health.of_runs(len(runs), evaluations),
            verdicts=Counter(each.kind for each in verdicts),
            caught=Counter(name for each in runs for name in each.caught),
            responsibilities=Counter(each.event.responsibility or "none" for each in runs),
            outcomes=Counter(str(each.outcome) for each in evaluations),
            failed=Counter(each.signature for each in runs if each.signature is not None),
            manners=tuple(
                {
                    (each.signature, each.manner): (each.signature, each.manner, each.event.executed.id)
                    for each in reversed(runs)
                    if each.signature is not None and each.manner is not None
                }.values()
            )[::-1],
            fitness=tuple(each.fitness for each in evaluations if each.eligible and math.isfinite(each.fitness)),
            failing=sum(each.failing for each in evaluations),
            random=(len(runs), len(valid), at_fault, failed - at_fault),
            rows=tuple(rows),
            doubt=next((each.doubt for each in runs if each.doubt), ""),
            avoidable=next((each.excused for each in verdicts if each.excused), ""),
        )


@dataclass(frozen=True, slots=True)
class Recovered:
    """What a process says that drives a block if a process of its own died in a run that was made again."""

    lost: LostRun


@dataclass(slots=True, kw_only=True)
class Driver:
    """The driving of whole blocks of a search in the processes that run its scenarios.

    Attributes:
        reader: reads and judges each run.
        plan: the plan of the search; None before the search begins.
        random_runs: the number of random scenarios at the beginning of the search that are counted apart.
    """

    reader: Reader
    plan: Plan[Any] | None = None
    random_runs: float = 0.0

    def __call__(self, task: BlockTask, job: Job, record: CrashRecord, say: Callable[[Said], object]) -> None:
        """Drive a block and say what comes of it, until it ends or only the session can go on."""
        known = set(task.known)

        def read(trace: Trace) -> Digested | None:
            read_ahead(self.reader.fitness, trace)
            return self.reader.digested(trace, known)

        if not task.is_apart:
            self._drive(task, known, lambda scenario: run_recorded(job, record, scenario, read), say)
            return
        with pool_for(replace(job, read=read, drive=None), 1) as pool:

            def run(scenario: Scenario) -> Answer:
                answer = pool.fetch(scenario)
                while pool.recovered:
                    say((Recovered(pool.recovered.pop()), CapturedOutput(), 0.0))
                return answer

            self._drive(task, known, run, say)

    def _drive(
        self,
        task: BlockTask,
        known: set[Signature],
        run: Callable[[Scenario], Answer],
        say: Callable[[Said], object],
    ) -> None:
        assert self.plan is not None and self.plan.length is not None  # noqa: S101, PT018  (only then there are tasks)
        block = self.plan.beginning(task.number)
        counted: list[tuple[Digested, CapturedOutput, float]] = []

        def count() -> None:  # the runs since the last one that the session must judge
            if counted:
                runs, outputs, seconds = zip(*counted, strict=True)
                tally = Tally.of(runs, block.generation)
                say((tally, reduce(CapturedOutput.followed_by, outputs), sum(seconds)))
                counted.clear()

        for _ in range(self.plan.length):
            first = block.state.proposed
            while not block.is_whole:
                scenario = block.scenario()
                try:
                    answer = None if scenario in task.fatal else run(scenario)
                except MemoryError:  # The session must not use up its memory in the same way.
                    raise
                except Exception:  # noqa: BLE001  (the session runs it again, and reports what is raised)
                    answer = None
                if isinstance(answer, ProcessLostError) and answer.how != KILLED:
                    count()
                    say((answer, CapturedOutput(), 0.0))
                    block.take(unknown(scenario))
                    continue
                digested, output, seconds = answer if isinstance(answer, tuple) else (None, CapturedOutput(), 0.0)
                if not isinstance(digested, Digested):
                    count()
                    return
                block.take(digested.evaluation)
                if digested.trace is None or digested.signature in known:
                    counted.append((digested, output, seconds))
                else:
                    count()
                    say((digested.trace, output, seconds))
                    known |= {each for each in (digested.signature,) if each is not None}
                if first + block.index == self.random_runs:
                    count()
            count()
            events = block.learn()
            say((Learnt.packed(block.state, events), CapturedOutput(), 0.0))


def unknown(scenario: Scenario) -> Evaluation:
    """Return the evaluation of a scenario in which a process died: nothing is known about it."""
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


@dataclass(frozen=True, slots=True)
class Early:
    """A failure in a block that is not counted yet, of some generation from 0: a run with its verdict, or a death."""

    of: Run | LostRun
    verdict: Verdict | None
    generation: int


DRIVEN_SECONDS, FED_SECONDS = 0.06, 0.004
"""The mean time of a run below which processes drive whole blocks [s]: in any case, so that a block takes some seconds,
and for each process, since the session needs about half of that to hand over one scenario and to take its run."""

AHEAD_ELSEWHERE = 128
"""The number of scenarios of later blocks that the workers of an executor get, since their own number is unknown."""

PURE_SHARE = 1 / 10
"""The share of the decisions that a pure ADS need not make from which on no further run is made to check that it is."""


@dataclass(slots=True, kw_only=True)
class Workers:
    """The runs of one search. Until a run is judged, its scenario is on disk in the crash record of this process."""

    harness: Harness
    runner: Runner
    record: CrashRecord
    reference: Runner | None = None  # the runner of the reference
    driver: Driver | None = None  # how other processes drive blocks; None if they cannot
    fitness: Callable[[Trace], float]  # the fitness of a trace; higher is worse for the ego
    is_steered_by_checks: bool = True  # as in :class:`Reader`
    clock: Callable[[], float] = time.monotonic  # returns the seconds since some fixed moment
    counted_decisions: int = 0  # number of decisions of the ADS in runs that others judged, and beside runs
    until: float = math.inf  # the time at which confirming findings ends [s]
    confirm_decisions: int = 0  # the number of decisions of the ADS that confirmed findings
    confirm_seconds: float = 0.0  # the time that this took [s]
    pace: float = 0.0  # the longest time to confirm one second of a run so far [s]
    # what the processes say that drive blocks, as far as it is not counted, by the number of the block
    _driven: dict[int, deque[Any]] = field(default_factory=dict)
    _failed: deque[Early] = field(default_factory=deque)  # failures of later blocks that are new to this process
    _later: dict[int, Block[Any]] = field(default_factory=dict)  # later blocks as far as other processes have run them
    _early: dict[Scenario, Verdict] = field(default_factory=dict)  # on runs that this process has not counted yet
    _suspect: ProcessLostError[Any] | None = None  # a death in a block, as long as no scenario is known to be the cause
    _has_died: bool = False  # True if a process has died while it drove a block
    _last: int = 0  # number of the first block that they leave to the session

    @property
    def decisions(self) -> int:
        """The number of decisions that the ADS has made so far in this session, except to confirm findings."""
        return self.counted_decisions + self.runner.asked - self.confirm_decisions

    def evaluation(self, run: Run, verdict: Verdict, signature: Signature | None) -> Evaluation:
        """Return what the algorithm sees of a run that this process has judged."""
        return evaluated(run.trace, verdict, signature, self.fitness, self.is_steered_by_checks)

    def impure(self) -> str:
        """Make some runs again with all decisions by the ADS, if decisions of earlier runs took their place.

        Return the id of a scenario that ended otherwise; empty if there is none.
        """
        asked = 0
        for _, trace in self.runner.resumed:
            if asked > self.runner.reused * PURE_SHARE:
                return ""
            asked += len(trace.actions)
            if not is_same_run(self.harness.seen(trace), self.rerun(trace.scenario)):
                return trace.scenario.id
        return ""

    def begin(self, plan: Plan[Any], random_runs: float) -> None:
        """Prepare for the blocks of a plan; ``random_runs`` is as in :class:`Driver`."""
        if self.driver is not None and plan.length is not None:
            self.driver.plan, self.driver.random_runs = plan, random_runs
            self.runner.processes.end()  # processes that were started before do not know the plan

    def give_blocks(self, plan: Plan[Any], fatal: Set[Scenario], known: Iterable[Collection[Signature]]) -> None:
        """Let other processes drive the next blocks by themselves, if runs are short.

        Whoever drives a block, it is the same. ``fatal`` are scenarios that nobody must run, ``known`` the failures of
        which no further run must be sent.
        """
        processes, settings = self.runner.processes, self.harness.request.settings
        if plan.length is None or plan.block.index:
            return
        # This process goes on with a block that it has begun, unless others make the runs, which it would have to miss.
        is_inside = plan.generation % plan.length > 0
        first, workers = plan.number + is_inside, settings.workers
        if (is_inside and (processes.in_use or settings.isolate)) or not self._drives_blocks(plan, first):
            return
        failures = frozenset[Signature]().union(*known)
        if not self._driven:  # Each process gets as many blocks, and the scenarios of what is left are shared.
            self._last = plan.whole_blocks - (plan.whole_blocks - first) % workers
        for number in range(first, min(first + 2 * workers, self._last)):
            if number not in self._driven:
                task = BlockTask(number, failures, frozenset(fatal), is_apart=bool(fatal or self._has_died))
                if not processes.drive(task):
                    return
                self._driven[number] = deque()

    def _drives_blocks(self, plan: Plan[Any], first: int) -> bool:
        """Return whether other processes drive blocks from the block number ``first`` on."""
        workers, is_apart = self.harness.request.settings.workers, self.harness.request.settings.isolate
        if self.driver is None or plan.length is None or self.runner.decides_for_many or not (workers > 1 or is_apart):
            return False
        # Long runs are shared better one by one.
        is_fast = 0 < self.runner.processes.run_seconds < max(DRIVEN_SECONDS, FED_SECONDS * workers)
        is_worth_it = bool(self._driven) or plan.whole_blocks - first >= 2 * workers
        return is_fast and is_worth_it

    def next(self, plan: Plan[Any], fatal: Set[Scenario]) -> Run | Tally | LostRun | Early | None:
        """Return what became of the next scenario of a plan, or of the next ones.

        That is the run, which must be judged next; the tally of runs that another process has made and judged; or how
        a process died or hung. It is None for a scenario of ``fatal``, which is not run. Or a scenario of a later block
        has failed meanwhile, which will be returned again in its turn.

        Raises:
            OutOfTime: if the time of the search is over before; the scenario then counts nowhere.
            RequestError: as for :meth:`run`.
        """
        __tracebackhide__ = True
        scenario, said = None, self._said(plan, stops=True)
        if self._failed:
            return self._failed.popleft()
        if isinstance(said, Tally):
            self.counted_decisions += said.decisions
            return said
        if isinstance(said, ProcessLostError):
            return said
        if isinstance(said, Trace):
            scenario = said.scenario
        else:
            ahead = plan.ahead()
            # While all processes drive blocks, this one makes its runs itself, unless they may end it.
            is_safe = not (self._has_died or self.harness.request.settings.isolate)
            if ahead is not None and not (self._driven and is_safe):
                self.runner.announce((each for each in ahead if each not in fatal), more=plan.length is not None)
            self._foresee(plan, fatal)
            scenario = plan.scenario()
        if scenario in fatal:
            return None
        try:
            with self._recorded(), refusals():
                made: Any = self.runner.made(scenario)
        except ProcessLostError as error:
            self._suspect = None
            return error
        if isinstance(made, Tally):
            self.counted_decisions += made.decisions
            return made
        return self.harness.seen(made)

    def learn(self, plan: Plan[Any]) -> Sequence[AlgorithmEvent]:
        """Let the algorithm learn from a whole generation, if the process that drives its block has not done so."""
        number, learnt = plan.number, self._said(plan)
        plan.block.learnt = learnt if isinstance(learnt, Learnt) else None
        events = plan.learn()
        if plan.number != number:
            self._driven.pop(number, None)
            if self._suspect is not None:
                self.runner.processes.recovered.append(self._suspect)
                self._suspect = None
        return events

    def _said(self, plan: Plan[Any], *, stops: bool = False) -> Tally | Trace | LostRun | Learnt | None:
        """Return what the process says next that drives the block of a plan; None if the session must go on.

        With ``stops``, return None as well as soon as something has failed in a later block.
        """
        processes, said = self.runner.processes, self._driven.get(plan.number)
        while heard := processes.hear(waits=said is not None and not said and not (stops and self._failed)):
            task, what = heard
            self._has_died |= isinstance(what, ProcessLostError)
            if isinstance(what, tuple) and isinstance(what[0], Recovered):
                processes.recovered.append(what[0].lost)
            elif (driven := self._driven.get(task.number)) is not None:
                driven.append(what)
                if driven is not said and isinstance(what, tuple):
                    self._look_at(what[0], plan, task.number)
        if said is None or (stops and self._failed):
            return None
        what = said.popleft() if said else None
        if isinstance(what, tuple):
            made: Tally | Trace | LostRun | Learnt = what[0]
            processes.count(made.runs if isinstance(made, Tally) else isinstance(made, Trace), what[2])
            if isinstance(made, Trace):
                processes.ready[made.scenario] = what
            else:
                what[1].repeat()
            return made
        if isinstance(what, ProcessLostError):
            self._suspect = what
        del self._driven[plan.number]
        return None

    def _look_at(self, made: object, plan: Plan[Any], number: int) -> None:
        """Judge a run of a later block that has failed, so that it is saved before its turn."""
        learnt = sum(isinstance(each, tuple) and isinstance(each[0], Learnt) for each in self._driven[number])
        generation = number * (plan.length or 0) + learnt
        if isinstance(made, Trace):
            self._judge_early(made, generation)
        elif isinstance(made, ProcessLostError):
            self._failed.append(Early(made, None, generation))

    def _judge_early(self, made: Trace, generation: int) -> None:
        scenario = made.scenario
        if scenario not in self._early:
            self.record.write(scenario)
            run = self.harness.seen(made)
            verdict = self._early[scenario] = self.judge(run)
            if verdict.failed:
                self._failed.append(Early(run, verdict, generation))

    def _foresee(self, plan: Plan[Any], fatal: Set[Scenario]) -> None:
        """Let other processes run scenarios of the next blocks, while the last runs of a generation are waited for."""
        processes, workers = self.runner.processes, self.harness.request.settings.workers
        if (
            plan.length is None
            or self._driven
            or self._drives_blocks(plan, plan.number + 1)
            or self.runner.decides_for_many
        ):
            return
        scenarios = AHEAD_ELSEWHERE if processes.is_elsewhere else 2 * workers if processes.in_use > 1 else 0
        blocks = -(-scenarios // plan.algorithm(1).population)
        unfit: tuple[type[BaseException], ...] = (FitnessError, *skips())
        self._later = {number: block for number, block in self._later.items() if number > plan.number}
        for number in range(plan.number + 1, plan.number + 1 + blocks):
            block = self._later.get(number)
            if block is None:
                block = self._later[number] = plan.beginning(number)
                processes.announce_later(each for each in plan.within(block) if each not in fatal)
            while block.generation // plan.length == number:
                runs = processes.arrived(block.drawn)
                try:
                    for each in runs:
                        if isinstance(each, Trace):
                            self._judge_early(each, block.generation)
                    if len(runs) < len(block.drawn):
                        break
                    evaluations = [self._evaluated_early(made) for made in runs]
                except unfit:  # raised again as soon as the search comes to this run
                    return
                for each in evaluations:
                    block.take(each)
                block.learn()
                if block.generation // plan.length == number:
                    processes.announce_later(each for each in plan.within(block) if each not in fatal)

    def _evaluated_early(self, made: Trace | Tally) -> Evaluation:
        """Return what the algorithm sees of a run that is not requested yet."""
        if isinstance(made, Tally):
            evaluation: Evaluation = pickle.loads(made.evaluations)[0]  # noqa: S301  (from our own process)
            return evaluation
        run, verdict, signature = self.harness.seen(made), self._early[made.scenario], None
        if verdict.failed and verdict.failure is not None:
            signature, _ = failed_as(run, verdict.failure)
        return self.evaluation(run, verdict, signature)

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
        early = self._early.pop(run.trace.scenario, None)
        if early is not None:
            self.record.clear()
            return early
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

    def rerun(self, scenario: Scenario) -> Run:
        """Run a scenario from scratch, without a verdict."""
        __tracebackhide__ = True
        run = self.run(scenario, afresh=True)
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
