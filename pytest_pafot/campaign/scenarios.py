"""The scenarios of a search in their order, and what became of each, whoever has run it.

There is a class for random scenarios, which are drawn by their numbers, and one for those that an algorithm breeds.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field
from functools import partial
from itertools import filterfalse
from typing import Any

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.tallies import Tally
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import Chunk, LostRun
from pytest_pafot.findings.signature import Signature
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.oracle.run import Facts, Run
from pytest_pafot.searching.algorithms.catalogue import RandomSearch
from pytest_pafot.searching.evaluation import CampaignFinished, CampaignStarted, EndReason, Evaluated, Evaluation, Event
from pytest_pafot.searching.plan import Plan

CHUNK_SECONDS = 0.05
"""The time that the runs of a chunk take together [s]: long beside the time of a message, short beside a search."""

WORTH_SECONDS = 0.3
"""The least time of the runs to come for which other processes are started [s], which takes some tenths of a second."""

CHUNKS_AHEAD = 8
"""The number of chunks for each process that are given before the first of them is counted: runs differ in length, and
nobody should wait for a long one."""

AHEAD, AHEAD_ELSEWHERE = 4, 128
"""The number of scenarios that each process gets in advance, and that all workers of a cluster get, where the session
has to draw them."""

FIRST = 16
"""The number of runs at the beginning that must not all end in the same exception, which would be the set-up's."""


@dataclass(frozen=True, slots=True)
class PendingFailure:
    """A failure before its turn, of some number or generation from 0: a run with its verdict, or a death."""

    of: tuple[Run, Verdict] | LostRun
    generation: int


Done = Run | Tally | LostRun | PendingFailure | Evaluation | Sequence[Event] | None
"""What became of the next scenario of a search, or of the next ones.

- A run was made, in this process or in another one. It must be judged next.
- A tally counts one or several runs that another process has made and judged.
- A lost run says how the process of the scenario died or hung.
- A pending failure is of a later scenario, which has run meanwhile. It is returned again in its turn, and the next
  scenario is still the same.
- An evaluation is that of an earlier run, which shows what the scenario does.
- Events tell of a generation without any scenario.
- None stands for a scenario that is not run, because a process died in it before.
"""


@dataclass(slots=True, kw_only=True)
class Bred:
    """The scenarios of an algorithm that learns, one generation after the other.

    Other processes make the runs of a generation in advance.
    """

    plan: Plan
    bench: Bench

    @property
    def started(self) -> CampaignStarted:
        """The first event."""
        return self.plan.started

    @property
    def generation(self) -> int:
        """The number of the generation, from 0."""
        return self.plan.generation

    @property
    def is_over(self) -> bool:
        """True if there is no further generation."""
        return self.plan.is_over

    @property
    def has_all_runs(self) -> bool:
        """True if as many scenarios were run as were asked for."""
        return self.plan.has_all_runs

    def next(self, fatal: Set[Scenario], known: Iterable[Collection[Signature]] | None) -> Done:
        """Return what became of the next scenario; ``fatal`` are scenarios that are not run.

        Raises:
            OutOfTime: if the time of the search is over before; the scenario then counts nowhere.
            RequestError: as for :meth:`.Bench.run`.
        """
        __tracebackhide__ = True
        plan, bench = self.plan, self.bench
        if plan.is_whole:
            return plan.learn()
        recalled = plan.recalled()
        if recalled is not None:
            return recalled
        if ahead := list(filterfalse(fatal.__contains__, plan.ahead())):
            bench.runner.announce(ahead)
        scenario = plan.scenario()
        if scenario in fatal:
            return None
        try:
            return bench.make(scenario)
        except ProcessLostError as error:
            return error

    def scenario(self) -> Scenario:
        """Return the next scenario."""
        return self.plan.scenario()

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Sequence[Event]:
        """Take the evaluation of the next scenario; return what happens."""
        return self.plan.take(evaluation, reused=reused)

    def take_tally(self, tally: Tally) -> Sequence[Event]:
        """Take a run that another process has judged; return what happens."""
        (evaluation,) = tally.unpacked
        return self.plan.take(evaluation)

    def finished(self, reason: EndReason, seconds: float) -> Iterator[Event]:
        """Yield the last events."""
        return self.plan.finished(reason, seconds)


def chunk_size(run_seconds: float, left: int, workers: int) -> int:
    """Return the number of runs of a chunk: few if runs are long, or if few are left for each process."""
    return max(1, min(round(CHUNK_SECONDS / run_seconds), left // (2 * workers)))


@dataclass(slots=True)
class _Driven:
    """A chunk that another process drives: what it has said that is not counted, and the next number it will say."""

    said: deque[Any]
    heard: int


@dataclass(slots=True, kw_only=True)
class Numbers:
    """The scenarios of a random search in the order of their numbers, while other processes are ahead of it.

    Other processes draw and drive chunks of numbers, and say what they count and which runs the session must see. If
    only the session may judge, it draws the scenarios, and others only make the runs.
    """

    algorithm: RandomSearch
    seed: int
    runs: int | None  # None for no limit
    bench: Bench
    number: int = 0  # of the next scenario to be counted
    _given: int = 0  # the first number that no other process has
    _announced: int = 0  # the first number whose scenario was not announced
    _driven: dict[Chunk, _Driven] = field(default_factory=dict)  # in the order of their numbers
    _pending: deque[PendingFailure] = field(default_factory=deque)  # new to this process
    _alone: int = 0  # the end of the chunk in which a process died: its scenarios are run one by one
    _suspect: LostRun | None = None  # that death, as long as no scenario is known to be the cause

    def __post_init__(self) -> None:
        if self.bench.driver is not None:
            self.bench.driver.drawn = partial(self.algorithm.drawn, self.seed)
            self.bench.runner.end()  # processes that were started before cannot draw

    @property
    def started(self) -> CampaignStarted:
        """The first event."""
        return CampaignStarted(algorithm=self.algorithm.name, generations=None, seed=self.seed)

    @property
    def generation(self) -> int:
        """The number of the next scenario, since each is a generation of its own."""
        return self.number

    @property
    def is_over(self) -> bool:
        """Always False, since there is another scenario after each."""
        return False

    @property
    def has_all_runs(self) -> bool:
        """True if as many scenarios were run as were asked for."""
        return self.number >= self._end

    @property
    def _end(self) -> int:
        return sys.maxsize if self.runs is None else self.runs

    def scenario(self) -> Scenario:
        """Return the next scenario."""
        return self.algorithm.drawn(self.seed, self.number)

    def next(self, fatal: Set[Scenario], known: Iterable[Collection[Signature]] | None) -> Done:
        """Return what became of the next scenario, or of the next ones.

        ``fatal`` are scenarios that are not run, ``known`` the failures of which no further run must be sent; it is
        None as long as this process must see each run.

        Raises:
            OutOfTime: if the time of the search is over before; the scenario then counts nowhere.
            RequestError: as for :meth:`.Bench.run`.
        """
        __tracebackhide__ = True
        bench = self.bench
        if known is not None:
            self._give(fatal, known)
        message = self._message()
        if self._pending:
            return self._pending.popleft()
        if isinstance(message, Tally):
            return message
        scenario = message.trace.scenario if isinstance(message, Facts) else self.scenario()
        if scenario in fatal:
            return None
        if not isinstance(message, Facts):
            self._announce(fatal)
        try:
            return bench.make(scenario)
        except ProcessLostError as error:
            self._suspect = None  # The scenario that killed the process of its chunk has run again, and did so.
            return error

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Sequence[Event]:
        """Take the evaluation of the next scenario; return what happens."""
        event = Evaluated(generation=self.number, local_generation=0, index=0, evaluation=evaluation, reused=reused)
        self._count(1)
        return (event,)

    def take_tally(self, tally: Tally) -> Sequence[Event]:
        """Take runs that another process has judged; return what happens."""
        if tally.judged is not None:
            (evaluation,) = tally.unpacked
            return self.take(evaluation)
        self._count(tally.runs)
        return (tally,)

    def finished(self, reason: EndReason, seconds: float) -> Iterator[Event]:
        """Yield the last event."""
        yield CampaignFinished(
            reason=reason, generations=0, evaluated=self.number, simulated=self.number, best=None, seconds=seconds
        )

    def _count(self, runs: int) -> None:
        self.number += runs
        self._given = max(self._given, self.number)
        if self._suspect is not None and self.number >= self._alone:
            self.bench.runner.recovered.append(self._suspect)
            self._suspect = None

    def _give(self, fatal: Set[Scenario], known: Iterable[Collection[Signature]]) -> None:
        """Let other processes draw and drive the next numbers by themselves, if that is worth it."""
        bench, settings = self.bench, self.bench.harness.request.settings
        run_seconds, workers = bench.runner.run_seconds, settings.workers
        left = self._end - self._given
        if bench.driver is None or not run_seconds or (workers == 1 and not settings.isolate):
            return
        if not self._driven and left * run_seconds < WORTH_SECONDS and not bench.runner.in_use:
            return
        failures = frozenset[Signature]().union(*known)
        while left > 0 and len(self._driven) < CHUNKS_AHEAD * workers:
            size = chunk_size(run_seconds, left, workers)
            chunk = Chunk(self._given, self._given + size, failures, frozenset(fatal))
            if not bench.runner.drive(chunk):
                return
            self._driven[chunk] = _Driven(deque(), chunk.first)
            self._given, left = chunk.end, left - size

    def _announce(self, fatal: Set[Scenario]) -> None:
        """Let other processes make the next runs that no process drives by itself, if they make any."""
        bench, settings = self.bench, self.bench.harness.request.settings
        if self.number < self._alone or bench.driver is not None:  # this run alone, whose time is measured
            ahead = max(self._alone - self.number, 1)
        else:
            ahead = AHEAD_ELSEWHERE if bench.runner.is_elsewhere else AHEAD * settings.workers
        # Half of them are left to be run when the next ones are announced, so nobody waits.
        if self.number + ahead // 2 >= self._announced:
            first, self._announced = max(self._announced, self.number), min(self.number + ahead, self._end)
            drawn = (self.algorithm.drawn(self.seed, number) for number in range(first, self._announced))
            bench.runner.announce(filterfalse(fatal.__contains__, drawn), more=True)

    def _message(self) -> Tally | Facts | None:
        """Return the next message of the process that drives the next number; None if the session must run it.

        Return None as well as soon as something has failed in a later chunk.
        """
        runner = self.bench.runner
        chunk = next(iter(self._driven), None)
        head = None if chunk is None or chunk.first > self.number else self._driven[chunk]
        # Messages on other chunks come in between, and are stored until their turn.
        while heard := runner.hear(waits=head is not None and not head.said and not self._pending):
            driven = self._driven.get(heard[0])
            if driven is not None:
                driven.said.append(heard[1])
                self._look_at(heard[1], driven, is_head=driven is head)
        if head is None or chunk is None or self._pending:
            return None
        said = head.said.popleft()
        if not isinstance(said, tuple):  # The chunk is over, or its process cannot go on with it.
            del self._driven[chunk]
            self._alone = chunk.end
            if isinstance(said, ProcessLostError):
                self._suspect = said
            return None if self.number < chunk.end else self._message()
        made: Tally | Facts | None = said[0]
        runner.count(made.runs if isinstance(made, Tally) else isinstance(made, Facts), said[2])
        if isinstance(made, Facts):
            # The session asks for this run next, and finds it here with the output that it prints for it.
            runner.ready[made.trace.scenario] = said
        else:
            said[1].repeat()
        return made

    def _look_at(self, said: Any, driven: _Driven, *, is_head: bool) -> None:
        """Judge a run of a later chunk that has failed, so that it is saved before its turn."""
        if not isinstance(said, tuple):
            return
        made = said[0]
        if isinstance(made, Facts) and not is_head:
            judged = self.bench.judge_ahead(made)
            if judged is not None and judged[1].failed:
                self._pending.append(PendingFailure(judged, driven.heard))
        driven.heard += made.runs if isinstance(made, Tally) else 1
