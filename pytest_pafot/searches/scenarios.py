"""The scenarios of a search in order, and their results.

In a random search, each number has one of the states of `NumberState`. Only `Numbers` changes them::

    WAITING ---- _give, in a chunk for another process ---->  OUT
       |                                                     |  |
       | next, in this process                               |  | its failure arrives before its turn
       v                                                     v  v
     BACK  <--- _messages, in the order of numbers ----  OUT or EARLY

The numbers below `number` are `BACK`, those from `_given` on are `WAITING`, and all others are `OUT` or `EARLY`. If the
process of a chunk dies, its numbers are run one by one, until it is known in which of them a process dies.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any, assert_never

from pytest_pafot.algorithms.catalogue import RandomSearch
from pytest_pafot.algorithms.evaluation import (
    EndReason,
    Evaluated,
    Evaluation,
    Event,
    PlanFinished,
    PlanStarted,
)
from pytest_pafot.algorithms.plan import Algorithm, Plan
from pytest_pafot.execution.pool import Answer, Done, Lost, RunItHere, Said
from pytest_pafot.execution.runner import Apart, Chunk, LostRun, Timed
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searches.bench import Bench
from pytest_pafot.searches.results import Counts, Failed, Result, State, not_run

# The approximate time to run a chunk [s]: long compared with the time of a message, short compared with a search.
CHUNK_SECONDS = 0.05

# Other processes are started only if the remaining runs take at least this time [s], because starting them takes a few
# tenths of a second.
WORTH_SECONDS = 0.3

# The number of chunks per process that are assigned before the first one is counted. Runs differ in length, and no
# process should wait for a long one.
CHUNKS_AHEAD = 8

# If this number of runs at the start all end in the same exception, the set-up has a fault.
FIRST = 16


@dataclass(frozen=True, slots=True)
class Early:
    """A failing result that arrived before its turn."""

    result: Result
    number: int  # number of the scenario in the search


@dataclass(frozen=True, slots=True)
class Reused:
    """An evaluation without a run, because an earlier run shows it, or because a process died in the scenario."""

    evaluation: Evaluation


@dataclass(frozen=True, slots=True)
class NoScenario:
    """A generation for which the algorithm requested no scenario."""

    events: Sequence[Event]


# What a search receives next: the result of a scenario, the counts of one or more scenarios that another process ran, a
# failure that arrived before its turn (its result is returned again in its turn), or one of the two above.
Step = Result | Counts | Early | Reused | NoScenario


class NumberState(Enum):
    """The states of a number in a random search."""

    WAITING = "no process has the scenario"
    OUT = "another process has the scenario"
    EARLY = (
        "the scenario has failed in another process, and its file is saved, but it is not counted"
    )
    BACK = "the scenario is counted"


class Bred(Plan):
    """The scenarios of a learning algorithm, grouped by generation."""

    def __init__(self, bench: Bench, algorithm: Algorithm[Any], **limits: Any) -> None:
        self.bench = bench
        super().__init__(algorithm, **limits)

    def _begin(self) -> None:
        super()._begin()
        self._results: Iterator[Result] = iter(())  # for the rest of the generation

    def next(self, state: State) -> Step:
        """Return the result of the next scenario.

        Raises:
            OutOfTime: if the search runs out of time. The scenario is not counted.
            RequestError: as for :meth:`.Bench.run`.
        """
        __tracebackhide__ = True
        # The algorithm requested no scenario, so it is told so, and asked again.
        if self.is_whole:
            return NoScenario(self.learn())
        recalled = self.recalled()
        if recalled is not None:
            return Reused(recalled)
        if self.scenario() in state.fatal:
            return Reused(not_run(self.scenario()))
        for result in self._results:
            return result

        # A scenario can become known while it waits, because the run of another one shows its result.
        def skips(scenario: Scenario) -> bool:
            return scenario in state.fatal or self._cache.recall(scenario) is not None

        # Other processes run the scenarios of the generation in advance.
        self._results = self.bench.results(self.ahead(), state, skips)
        return next(self._results)


def chunk_size(run_seconds: float, left: int, workers: int) -> int:
    """Return the number of runs in the next chunk."""
    # A chunk is small if runs are long, or if few are left for each process.
    return max(1, min(round(CHUNK_SECONDS / run_seconds), left // (2 * workers)))


@dataclass(slots=True)
class _Driven:
    # The state of a chunk that another process simulates.

    said: deque[Said | Answer]  # messages that are not yet counted, and the answer to the chunk
    heard: int  # number of the next scenario that the process reports


@dataclass(slots=True, kw_only=True)
class Numbers:
    """The scenarios of a random search, each of which is sampled by its number."""

    algorithm: RandomSearch
    seed: int
    runs: int | None  # None for no limit
    bench: Bench
    number: int = 0  # number of the next scenario to be counted
    _given: int = 0  # the first number that is not assigned to another process
    # results of runs outside chunks
    _results: Iterator[Result] = field(default_factory=lambda: iter(()))
    # chunks in other processes, in the order of numbers
    _driven: dict[Chunk, _Driven] = field(default_factory=dict)
    # failures in later chunks, in the order of arrival
    _early: deque[Early] = field(default_factory=deque)
    # the numbers of these failures
    _saved: set[int] = field(default_factory=set)
    # the end of the chunk in which a process died; its scenarios are run one by one
    _alone: int = 0
    # that death, until the scenario that caused it is known
    _suspects: list[LostRun] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.bench.driver is not None:
            # Before the first process is forked. A process that is already running would not receive it.
            self.bench.driver.drawn = partial(self.algorithm.drawn, self.seed)
            if isinstance(self.bench.runner, Apart):
                # processes that are already running cannot sample scenarios
                self.bench.runner.end()

    @property
    def started(self) -> PlanStarted:
        return PlanStarted(algorithm=self.algorithm.name, generations=None, seed=self.seed)

    @property
    def generation(self) -> int:
        """The number of the next scenario, which counts as a generation."""
        return self.number

    @property
    def is_over(self) -> bool:
        return False

    @property
    def has_all_runs(self) -> bool:
        return self.number >= self._end

    @property
    def _end(self) -> int:
        return sys.maxsize if self.runs is None else self.runs

    def scenario(self) -> Scenario:
        return self.algorithm.drawn(self.seed, self.number)

    def state_of(self, number: int) -> NumberState:
        """Return the state of a number."""
        if number < self.number:
            return NumberState.BACK
        if number >= self._given:
            return NumberState.WAITING
        return NumberState.EARLY if number in self._saved else NumberState.OUT

    def next(self, state: State) -> Step:
        """Return the result of the next scenario, or of several, as :meth:`Bred.next` does."""
        __tracebackhide__ = True
        # Run scenarios one by one until two runs differ, which shows that the set-up has no fault.
        if not state.is_alike:
            self._give(state)
        messages = list(self._messages())
        # A failure that arrived before its turn comes first, so that its file is on disk as soon as possible.
        if self._early:
            return self._early.popleft()
        for message in messages:
            return message
        if self.scenario() in state.fatal:
            return Reused(not_run(self.scenario()))
        result = next(self._results, None)
        if result is None:
            # If other processes run chunks, run only the next scenario, which measures the time of a run, or the rest
            # of a chunk in which a process died.
            end = self._end
            if self.bench.driver is not None:
                end = max(self._alone, self.number + 1)
            drawn = map(partial(self.algorithm.drawn, self.seed), range(self.number, end))
            self._results = self.bench.results(drawn, state, state.fatal.__contains__)
            result = next(self._results)
        if result.ended == "lost":
            # The scenario that killed the process of its chunk has done so again.
            self._suspects.clear()
        return result

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Sequence[Event]:
        event = Evaluated(
            generation=self.number,
            local_generation=0,
            index=0,
            evaluation=evaluation,
            reused=reused,
        )
        self.count(1)
        return (event,)

    def count(self, runs: int) -> None:
        self.number += runs
        self._given = max(self._given, self.number)
        if self.number >= self._alone and isinstance(self.bench.runner, Apart):
            # No scenario of the chunk has killed a second process.
            self.bench.runner.recovered += self._suspects
            self._suspects.clear()

    def finished(self, reason: EndReason, seconds: float) -> Iterator[Event]:
        self._results = iter(())
        yield PlanFinished(
            reason=reason,
            generations=0,
            evaluated=self.number,
            simulated=self.number,
            best=None,
            seconds=seconds,
        )

    def _give(self, state: State) -> None:
        # Assign the next numbers to other processes if that saves time. They sample and simulate chunks of scenarios,
        # and report counts and the results that the session needs. If only the session can evaluate runs, it samples
        # the scenarios, and other processes only simulate them.
        runner, workers = self.bench.runner, self.bench.harness.request.settings.workers
        if self.bench.driver is None or not isinstance(runner, Apart) or not runner.run_seconds:
            return
        # Until the first runs are measured, the size of a chunk is unknown.
        run_seconds, left = runner.run_seconds, self._end - self._given
        if not self._driven and left * run_seconds < WORTH_SECONDS and not runner.in_use:
            return
        # The processes return only the signature of a known failure, which is a small message.
        known = frozenset(state.known)
        while left > 0 and len(self._driven) < CHUNKS_AHEAD * workers:
            size = chunk_size(run_seconds, left, workers)
            chunk = Chunk(self._given, self._given + size, known, frozenset(state.fatal))
            # No process works, so the session runs the numbers itself.
            if not runner.drive(chunk):
                return
            self._driven[chunk] = _Driven(deque(), chunk.first)
            self._given, left = chunk.end, left - size

    def _messages(self) -> Iterator[Result | Counts]:
        # Yield the next message about the scenarios in turn. Nothing is yielded if the session must run the next number
        # itself, or as soon as a scenario of a later chunk has failed.
        runner = self.bench.runner
        if not isinstance(runner, Apart):
            return
        while True:
            chunk = next(iter(self._driven), None)
            is_in_turn = chunk is not None and chunk.first <= self.number
            self._listen(runner, chunk if is_in_turn else None)
            if chunk is None or not is_in_turn or self._early:
                return
            match self._driven[chunk].said.popleft():
                case Said(Timed(value) as timed):
                    runner.count(_runs_of(value), timed.seconds)
                    timed.output.repeat()
                    yield value
                    return
                case Said():  # a RunItHere: only this process can run or evaluate the scenario
                    return
                case Done() | RunItHere():
                    pass  # The chunk is finished, or its process cannot continue it.
                case Lost(death):
                    self._suspects.append(death)
                case other:
                    assert_never(other)
            # The next chunk is in turn only if all numbers of this one were counted.
            del self._driven[chunk]
            self._alone = chunk.end
            if self.number < chunk.end:
                return

    def _listen(self, runner: Apart, head: Chunk | None) -> None:
        # Store what the processes say about their chunks. If ``head``, the chunk in turn, has no message, wait for one.
        while True:
            waits = head is not None and not self._driven[head].said and not self._early
            heard = runner.messages(waits=waits)
            if not heard:
                return
            for chunk, said in heard:
                # A chunk of an earlier search, or one whose process was lost, may still have messages
                # on the way.
                driven = self._driven.get(chunk)
                if driven is None:
                    continue
                driven.said.append(said)
                match said:
                    case Said(Timed(Result(failed=Failed()) as result)) if chunk is not head:
                        self._early.append(Early(result, driven.heard))
                        self._saved.add(driven.heard)
                        driven.heard += 1
                    case Said(Timed(value)):
                        driven.heard += _runs_of(value)
                    case _:
                        driven.heard += 1


def _runs_of(value: Result | Counts) -> int:
    return value.runs if isinstance(value, Counts) else 1
