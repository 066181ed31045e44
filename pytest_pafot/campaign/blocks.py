"""The runs of a plan in their order, whoever makes them: whole blocks in other processes, and runs of later blocks."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Sequence, Set
from dataclasses import dataclass, field
from itertools import filterfalse
from typing import Any

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.tallies import Recovered, Tally
from pytest_pafot.campaign.verdict import Verdict, skips
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import BlockTask, LostRun
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import Facts, Run
from pytest_pafot.searching.events import AlgorithmEvent
from pytest_pafot.searching.fitness import FitnessError
from pytest_pafot.searching.plan import Block, Learnt, Plan

DRIVEN_SECONDS, FED_SECONDS = 0.06, 0.004
"""The mean time of a run below which processes drive whole blocks [s]: in any case, so that a block takes some seconds,
and for each process, since the session needs about half of that to hand over one scenario and to take its run."""

AHEAD_ELSEWHERE = 128
"""The number of scenarios of later blocks that the workers of a cluster get, since their own number is unknown."""


@dataclass(frozen=True, slots=True)
class PendingFailure:
    """A failure in a block that is not counted yet, of some generation from 0: a run with its verdict, or a death."""

    of: tuple[Run, Verdict] | LostRun
    generation: int


RunResult = Run | Tally | LostRun | PendingFailure | None
"""What became of the next scenario of a plan, or of the next ones.

- A run was made, in this process or in another one. It must be judged next.
- A tally counts one or several runs that another process has made and judged.
- A lost run says how the process of the scenario died or hung.
- A pending failure is of a later block, whose process has sent it meanwhile. It is returned again in its turn, and the
  next scenario is still the same.
- None stands for a scenario that is not run, because a process died in it before.
"""


@dataclass(slots=True, kw_only=True)
class Blocks:
    """The blocks of a plan, which are counted in their order, while other processes are ahead of it.

    Where runs are short, a process drives a whole block by itself, and sends messages on it. Where they are long, this
    process draws the scenarios, and others make runs of later blocks while it waits for the last ones of a generation.
    A plan without blocks has neither.
    """

    plan: Plan[Any]
    bench: Bench
    # the messages of the processes that drive blocks, as far as they are not counted, by the number of the block
    _driven: dict[int, deque[Any]] = field(default_factory=dict)
    _pending: deque[PendingFailure] = field(default_factory=deque)  # new to this process
    _later: dict[int, Block[Any]] = field(default_factory=dict)  # later blocks as far as other processes have run them
    _suspect: ProcessLostError[Any] | None = None  # a death in a block, as long as no scenario is known to be the cause
    _has_died: bool = False  # True if a process has died while it drove a block
    _last: int = 0  # number of the first block that they leave to the session

    def begin(self, random_runs: float) -> None:
        """Let processes know the plan; ``random_runs`` is as in :class:`.BlockDriver`."""
        driver = self.bench.driver
        if driver is not None and self.plan.length is not None:
            driver.plan, driver.random_runs = self.plan, random_runs
            self.bench.runner.end()  # processes that were started before do not know the plan

    def give(self, fatal: Set[Scenario], known: Iterable[Collection[Signature]]) -> None:
        """Let other processes drive the next blocks by themselves, if runs are short.

        Whoever drives a block, it is the same. ``fatal`` are scenarios that nobody must run, ``known`` the failures of
        which no further run must be sent.
        """
        plan, processes, settings = self.plan, self.bench.runner, self.bench.harness.request.settings
        if plan.length is None or plan.block.index:
            return
        # This process goes on with a block that it has begun, unless others make the runs, which it would have to miss.
        is_inside = plan.generation % plan.length > 0
        first, workers = plan.number + is_inside, settings.workers
        if (is_inside and (processes.in_use or settings.isolate)) or not self._are_driven(first):
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

    def _are_driven(self, first: int) -> bool:
        """Return whether other processes drive blocks from the block number ``first`` on."""
        bench, settings = self.bench, self.bench.harness.request.settings
        workers, is_apart = settings.workers, settings.isolate
        if bench.driver is None or self.plan.length is None:
            return False
        if not (workers > 1 or is_apart):
            return False
        # Long runs are shared better one by one.
        is_fast = 0 < bench.runner.run_seconds < max(DRIVEN_SECONDS, FED_SECONDS * workers)
        is_worth_it = bool(self._driven) or self.plan.whole_blocks - first >= 2 * workers
        return is_fast and is_worth_it

    def next(self, fatal: Set[Scenario]) -> RunResult:
        """Return what became of the next scenario, or of the next ones; ``fatal`` are scenarios that are not run.

        Raises:
            OutOfTime: if the time of the search is over before; the scenario then counts nowhere.
            RequestError: as for :meth:`.Bench.run`.
        """
        __tracebackhide__ = True
        plan, bench = self.plan, self.bench
        message = self._message(stops=True)
        if self._pending:
            return self._pending.popleft()
        if isinstance(message, (Tally, ProcessLostError)):
            return message
        if isinstance(message, Facts):
            scenario = message.trace.scenario
        else:
            ahead = plan.ahead()
            # While all processes drive blocks, this one makes its runs itself, unless they may end it.
            is_safe = not (self._has_died or bench.harness.request.settings.isolate)
            if ahead is not None and not (self._driven and is_safe):
                bench.runner.announce(filterfalse(fatal.__contains__, ahead), more=plan.length is not None)
            self._foresee(fatal)
            scenario = plan.scenario()
        if scenario in fatal:
            return None
        try:
            return bench.make(scenario)
        except ProcessLostError as error:
            self._suspect = None  # The scenario that killed the process of its block has been run again, and did so.
            return error

    def learn(self) -> Sequence[AlgorithmEvent]:
        """Let the algorithm learn from a whole generation, if the process that drives its block has not done so."""
        plan = self.plan
        number, learnt = plan.number, self._message()
        plan.block.learnt = learnt if isinstance(learnt, Learnt) else None
        events = plan.learn()
        if plan.number != number:
            self._driven.pop(number, None)
            if self._suspect is not None:
                self.bench.runner.recovered.append(self._suspect)
                self._suspect = None
        return events

    def _message(self, *, stops: bool = False) -> Tally | Facts | LostRun | Learnt | None:
        """Return the next message of the process that drives the block of the plan; None if the session must go on.

        With ``stops``, return None as well as soon as something has failed in a later block.
        """
        processes, messages = self.bench.runner, self._driven.get(self.plan.number)
        # Messages on other blocks come in between, and are stored until the turn of their block.
        while heard := processes.hear(waits=messages is not None and not messages and not (stops and self._pending)):
            task, what = heard
            self._has_died |= isinstance(what, ProcessLostError)
            if isinstance(what, tuple) and isinstance(what[0], Recovered):
                processes.recovered.append(what[0].lost)
            elif (driven := self._driven.get(task.number)) is not None:
                driven.append(what)
                if driven is not messages and isinstance(what, tuple):
                    self._look_at(what[0], task.number)
        if messages is None or (stops and self._pending):
            return None
        what = messages.popleft() if messages else None
        if isinstance(what, tuple):
            made: Tally | Facts | LostRun | Learnt = what[0]
            processes.count(made.runs if isinstance(made, Tally) else isinstance(made, Facts), what[2])
            if isinstance(made, Facts):
                # The session asks for this run next, and finds it here with the output that it prints for it.
                processes.ready[made.trace.scenario] = what
            else:
                what[1].repeat()
            return made
        # The process cannot go on with its block. From here on, the session draws and drives the block itself.
        if isinstance(what, ProcessLostError):
            self._suspect = what
        del self._driven[self.plan.number]
        return None

    def _look_at(self, made: object, number: int) -> None:
        """Judge a run of a later block that has failed, so that it is saved before its turn."""
        if not isinstance(made, (Facts, ProcessLostError)):
            return
        learnt = sum(isinstance(each, tuple) and isinstance(each[0], Learnt) for each in self._driven[number])
        generation = number * (self.plan.length or 0) + learnt
        if isinstance(made, Facts):
            self._judge_ahead(made, generation)
        else:
            self._pending.append(PendingFailure(made, generation))

    def _judge_ahead(self, made: Trace | Facts, generation: int) -> None:
        judged = self.bench.judge_ahead(made)
        if judged is not None and judged[1].failed:
            self._pending.append(PendingFailure(judged, generation))

    def _foresee(self, fatal: Set[Scenario]) -> None:
        """Let other processes run scenarios of the next blocks, while the last runs of a generation are waited for."""
        plan, bench = self.plan, self.bench
        processes, workers = bench.runner, bench.harness.request.settings.workers
        if plan.length is None or self._driven or self._are_driven(plan.number + 1):
            return
        scenarios = AHEAD_ELSEWHERE if processes.is_elsewhere else 2 * workers if processes.in_use > 1 else 0
        blocks = -(-scenarios // plan.algorithm.population)
        unfit: tuple[type[BaseException], ...] = (FitnessError, *skips())
        self._later = {number: block for number, block in self._later.items() if number > plan.number}
        for number in range(plan.number + 1, plan.number + 1 + blocks):
            block = self._later.get(number)
            if block is None:
                block = self._later[number] = plan.beginning(number)
                processes.announce_later(filterfalse(fatal.__contains__, plan.within(block)))
            # A block goes on to its next generation as soon as all runs of the last one have come.
            while block.generation // plan.length == number:
                runs = processes.arrived(block.drawn)
                try:
                    for each in runs:
                        if not isinstance(each, Tally):
                            self._judge_ahead(each, block.generation)
                    if len(runs) < len(block.drawn):
                        break
                    evaluations = [
                        each.unpacked[0] if isinstance(each, Tally) else bench.evaluate_ahead(scenario)
                        for scenario, each in zip(block.drawn, runs, strict=True)
                    ]
                except unfit:  # raised again as soon as the search comes to this run
                    return
                for each in evaluations:
                    block.take(each)
                block.learn()
                if block.generation // plan.length == number:
                    processes.announce_later(filterfalse(fatal.__contains__, plan.within(block)))
