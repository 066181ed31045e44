"""The bench of one search, on which its scenarios are run and judged: processes, limits, and records of crashes."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

from pytest_pafot.campaign.harness import Harness, is_same_run, refusals
from pytest_pafot.campaign.tallies import BlockDriver, Recovered, Tally, facts_of
from pytest_pafot.campaign.verdict import Verdict, evaluated, skips
from pytest_pafot.execution.crash_records import CrashRecord, Leftover
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Runner, replay_in_gym_apart
from pytest_pafot.execution.scenario_pool import BlockTask, LostRun, trace_of
from pytest_pafot.findings.finding import disagreement, failed_as, message_of
from pytest_pafot.findings.sighting import NOT_REPEATED
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Facts, Run
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent
from pytest_pafot.searching.fitness import FitnessError
from pytest_pafot.searching.plan import Block, Learnt, Plan
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.failure import UNFIT, let_through
from pytest_pafot.world.guard.hang_guard import runs_end_in


@dataclass(frozen=True, slots=True)
class PendingFailure:
    """A failure in a block that is not counted yet, of some generation from 0: a run with its verdict, or a death."""

    of: tuple[Run, Verdict] | LostRun
    generation: int


DRIVEN_SECONDS, FED_SECONDS = 0.06, 0.004
"""The mean time of a run below which processes drive whole blocks [s]: in any case, so that a block takes some seconds,
and for each process, since the session needs about half of that to hand over one scenario and to take its run."""

AHEAD_ELSEWHERE = 128
"""The number of scenarios of later blocks that the workers of an executor get, since their own number is unknown."""

PURE_SHARE = 1 / 10
"""The share of the decisions that a pure ADS need not make from which on no further run is made to check that it is."""


@dataclass(slots=True, kw_only=True)
class Bench:
    """What runs and judges the scenarios of one search.

    Until a run is judged, its scenario is on disk in the crash record of this process.
    """

    harness: Harness
    runner: Runner
    record: CrashRecord
    reference: Runner | None = None  # the runner of the reference
    driver: BlockDriver | None = None  # how other processes drive blocks; None if they cannot
    fitness: Callable[[Run], float]  # the fitness of a run; higher is worse for the ego
    is_steered_by_checks: bool = True  # as in :class:`~pytest_pafot.campaign.tallies.Reader`
    clock: Callable[[], float] = time.monotonic  # returns the seconds since some fixed moment
    counted_decisions: int = 0  # number of decisions of the ADS in runs that others judged, and beside runs
    refining_end: float = math.inf  # the time at which the work on findings ends [s]
    confirm_decisions: int = 0  # the number of decisions of the ADS that confirmed findings
    confirm_seconds: float = 0.0  # the time that this took [s]
    pace: float = 0.0  # the longest time to confirm one second of a run so far [s]
    # what the processes say that drive blocks, as far as it is not counted, by the number of the block
    _driven: dict[int, deque[Any]] = field(default_factory=dict)
    # failures of later blocks that are new to this process
    _failed: deque[PendingFailure] = field(default_factory=deque)
    _later: dict[int, Block[Any]] = field(default_factory=dict)  # later blocks as far as other processes have run them
    # runs that this process has judged and not counted yet, with their verdicts
    _judged_ahead: dict[Scenario, tuple[Run, Verdict]] = field(default_factory=dict)
    _suspect: ProcessLostError[Any] | None = None  # a death in a block, as long as no scenario is known to be the cause
    _has_died: bool = False  # True if a process has died while it drove a block
    _last: int = 0  # number of the first block that they leave to the session

    @property
    def decisions(self) -> int:
        """The number of decisions that the ADS has made so far in this session, except to confirm findings."""
        return self.counted_decisions + self.runner.decisions - self.confirm_decisions

    def evaluation(self, run: Run, verdict: Verdict, signature: Signature | None) -> Evaluation:
        """Return what the algorithm sees of a run that this process has judged."""
        return evaluated(run, verdict, signature, self.fitness, self.is_steered_by_checks)

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
            if not (same if is_cut else is_same_run(self.harness.run_of(trace), again)):
                return trace.scenario.id, self.runner.mark
        return None

    def begin(self, plan: Plan[Any], random_runs: float) -> None:
        """Prepare for the blocks of a plan; ``random_runs`` is as in :class:`.BlockDriver`."""
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

    def next(self, plan: Plan[Any], fatal: Set[Scenario]) -> Run | Tally | LostRun | PendingFailure | None:
        """Return what became of the next scenario of a plan, or of the next ones.

        That is the run, which must be judged next; the tally of runs that another process has made and judged; or how
        a process died or hung. It is None for a scenario of ``fatal``, which is not run. Or a scenario of a later block
        has failed meanwhile, which will be returned again in its turn.

        Raises:
            OutOfTime: if the time of the search is over before; the scenario then counts nowhere.
            RequestError: as for :meth:`run`.
        """
        __tracebackhide__ = True
        said = self._said(plan, stops=True)
        if self._failed:
            return self._failed.popleft()
        if isinstance(said, (Tally, ProcessLostError)):
            return said
        if isinstance(said, Facts):
            scenario = said.trace.scenario
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
            return made
        run = self.harness.run_of(made)
        judged, _ = self._judged_ahead.get(scenario, (run, None))
        return judged if judged.trace is run.trace else run

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

    def _said(self, plan: Plan[Any], *, stops: bool = False) -> Tally | Facts | LostRun | Learnt | None:
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
            made: Tally | Facts | LostRun | Learnt = what[0]
            processes.count(made.runs if isinstance(made, Tally) else isinstance(made, Facts), what[2])
            if isinstance(made, Facts):
                processes.ready[made.trace.scenario] = what
            else:
                what[1].repeat()
            return made
        if isinstance(what, ProcessLostError):
            self._suspect = what
        del self._driven[plan.number]
        return None

    def _look_at(self, made: object, plan: Plan[Any], number: int) -> None:
        """Judge a run of a later block that has failed, so that it is saved before its turn."""
        if not isinstance(made, (Facts, ProcessLostError)):
            return
        learnt = sum(isinstance(each, tuple) and isinstance(each[0], Learnt) for each in self._driven[number])
        generation = number * (plan.length or 0) + learnt
        if isinstance(made, Facts):
            self._judge_ahead(made, generation)
        else:
            self._failed.append(PendingFailure(made, generation))

    def _judge_ahead(self, made: Trace | Facts, generation: int) -> None:
        scenario = trace_of(made).scenario
        if scenario not in self._judged_ahead:
            self.record.write(scenario)
            run = self.harness.run_of(made)
            verdict = self.finish(run)
            self._judged_ahead[scenario] = run, verdict
            if verdict.failed:
                self._failed.append(PendingFailure((run, verdict), generation))

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
                        if not isinstance(each, Tally):
                            self._judge_ahead(each, block.generation)
                    if len(runs) < len(block.drawn):
                        break
                    evaluations = [
                        each.unpacked[0] if isinstance(each, Tally) else self._evaluated_ahead(scenario)
                        for scenario, each in zip(block.drawn, runs, strict=True)
                    ]
                except unfit:  # raised again as soon as the search comes to this run
                    return
                for each in evaluations:
                    block.take(each)
                block.learn()
                if block.generation // plan.length == number:
                    processes.announce_later(each for each in plan.within(block) if each not in fatal)

    def _evaluated_ahead(self, scenario: Scenario) -> Evaluation:
        """Return what the algorithm sees of a run that is not requested yet."""
        (run, verdict), signature = self._judged_ahead[scenario], None
        if verdict.failed and verdict.failure is not None:
            signature, _ = failed_as(run, verdict.failure)
        evaluation = self.evaluation(run, verdict, signature)
        self._judged_ahead[scenario] = replace(run, facts=facts_of(run, evaluation)), verdict  # for its own turn
        return evaluation

    def run(self, scenario: Scenario, *, afresh: bool = False, most: int | None = None) -> Run:
        """Run a scenario. The caller must call :meth:`finish` next, which also clears the crash record.

        For ``afresh`` and ``most`` see :meth:`pytest_pafot.execution.runner.Runner.made`.

        Raises:
            ProcessLostError: if the run was in another process, and that process died or hung.
            RequestError: for a world, factory or scenario that does not fit.
            OutOfTime: if the time of the search is over.
        """
        __tracebackhide__ = True
        with self._recorded(), refusals():
            trace = self.runner.run(scenario, afresh=afresh, most=most)
        return self.harness.run_of(trace)

    def finish(self, run: Run, scenario: Scenario | None = None) -> Verdict:
        """Judge the last run, and clear its crash record.

        If it fails, the reference is run in ``scenario``, by default in the run's scenario.
        """
        __tracebackhide__ = True
        judged, verdict = self._judged_ahead.pop(run.trace.scenario, (None, None))
        # Another run of the scenario may have another verdict.
        if judged is not None and verdict is not None and judged.trace is run.trace:
            self.record.clear()
            return verdict
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
        policy = self.harness.policy
        with self._recorded(), refusals():
            if policy.elsewhere is not None:
                trace = policy.elsewhere.driven("rollout_in_gym", world, scenario)
            elif self.harness.request.settings.isolate:
                trace = replay_in_gym_apart(self.harness.job(), self.record, scenario)
            else:
                self.record.write(scenario)
                trace = GENERATORS.run(world.rollout_in_gym, scenario, self.harness.drawing(policy).factory)
        self.runner.decisions += len(trace.actions)
        self.record.clear()
        return Run(trace, decision_limit=self.harness.request.decision_limit)

    def confirm(self, run: Run) -> str:
        """Repeat the run of a finding; return what differs, empty if nothing does. Measure how long that takes.

        Raises:
            OutOfTime: if the time of the search is over.
        """
        began, before = self.clock(), self.runner.decisions
        try:
            with runs_end_in(self.refining_end - began):
                differs = difference(run, self)
        finally:
            seconds = self.clock() - began
            self.confirm_seconds += seconds
            self.confirm_decisions += self.runner.decisions - before
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


def difference(run: Run, bench: Bench) -> str:
    """Return what differs when the scenario of a run is run again; empty if the finding is confirmed.

    The same world must give a run that is equal to the last bit. In highway-env's own environment, if the world has
    it, the run must end in the same way.
    """
    try:
        if not is_same_run(run, bench.rerun(run.scenario)):
            return NOT_REPEATED
        differs = _difference_in_gym(run, bench)
    except ProcessLostError as error:
        return f"the process that ran it again {error.how}"
    if not differs:
        return ""
    harness = bench.harness
    likely_cause = "" if harness.policy.drives_itself else left_out_text(harness.world)
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


def _difference_in_gym(run: Run, bench: Bench) -> str:
    try:
        other = bench.rerun_in_gym(run.scenario)
    except ProcessLostError:
        raise
    except UNFIT as error:  # any exception of the environment or the ADS is the difference
        let_through(error)
        return f"{type(error).__name__}: {message_of(error)}"[:165]
    return "" if other is None else disagreement(run, other)
