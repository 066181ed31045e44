"""The scenarios of a search in order, and their results."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

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
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Apart, Chunk, LostRun
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searches.bench import Bench
from pytest_pafot.searches.results import Counts, Result, State

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


# The result of the next scenario of a search, or of several:
# - Result: the scenario was run, in this process or in another one.
# - Counts: another process ran one or more scenarios.
# - LostRun: the process of the scenario died or hung.
# - Early: a later scenario has already failed. Its result is returned again in its turn. The next scenario stays the
#   same.
# - Evaluation: an earlier run shows the result of the scenario.
# - Events: a generation had no scenario.
# - None: the scenario is not run, because a process died in it before.
Done = Result | Counts | LostRun | Early | Evaluation | Sequence[Event] | None


class Bred(Plan):
    """The scenarios of a learning algorithm, grouped by generation."""

    def __init__(self, bench: Bench, algorithm: Algorithm[Any], **limits: Any) -> None:
        self.bench = bench
        super().__init__(algorithm, **limits)

    def _begin(self) -> None:
        super()._begin()
        self._results: Iterator[Result | LostRun] = iter(())  # for the rest of the generation

    def next(self, state: State) -> Done:
        """Return the result of the next scenario.

        Raises:
            OutOfTime: if the search runs out of time. The scenario is not counted.
            RequestError: as for :meth:`.Bench.run`.
        """
        __tracebackhide__ = True
        if self.is_whole:
            return self.learn()
        recalled = self.recalled()
        if recalled is not None:
            return recalled
        if self.scenario() in state.fatal:
            return None
        if (result := next(self._results, None)) is not None:
            return result

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

    said: deque[Any]  # messages that are not yet counted
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
    _results: Iterator[Result | LostRun] = field(default_factory=lambda: iter(()))
    # chunks in other processes, in the order of numbers
    _driven: dict[Chunk, _Driven] = field(default_factory=dict)
    # failures in later chunks, in the order of arrival
    _early: deque[Early] = field(default_factory=deque)
    # the end of the chunk in which a process died; its scenarios are run one by one
    _alone: int = 0
    _suspect: LostRun | None = None  # that death, until the scenario that caused it is known

    def __post_init__(self) -> None:
        if self.bench.driver is not None:
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

    def next(self, state: State) -> Done:
        """Return the result of the next scenario, or of several, as :meth:`Bred.next` does."""
        __tracebackhide__ = True
        # Run scenarios one by one until two runs differ, which shows that the set-up has no fault.
        if not state.is_alike:
            self._give(state)
        message = self._message()
        if self._early:
            return self._early.popleft()
        if message is not None:
            return message
        if self.scenario() in state.fatal:
            return None
        result = next(self._results, None)
        if result is None:
            # If other processes run chunks, run only the next scenario, which measures the time of a run, or the rest
            # of a chunk in which a process died.
            end = self._end if self.bench.driver is None else max(self._alone, self.number + 1)
            drawn = map(partial(self.algorithm.drawn, self.seed), range(self.number, end))
            self._results = self.bench.results(drawn, state, state.fatal.__contains__)
            result = next(self._results)
        if isinstance(result, ProcessLostError):
            # The scenario that killed the process of its chunk has done so again.
            self._suspect = None
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
        if (
            self._suspect is not None
            and self.number >= self._alone
            and isinstance(self.bench.runner, Apart)
        ):
            self.bench.runner.recovered.append(self._suspect)
            self._suspect = None

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
        run_seconds, left = runner.run_seconds, self._end - self._given
        if not self._driven and left * run_seconds < WORTH_SECONDS and not runner.in_use:
            return
        known = frozenset(state.known)
        while left > 0 and len(self._driven) < CHUNKS_AHEAD * workers:
            size = chunk_size(run_seconds, left, workers)
            chunk = Chunk(self._given, self._given + size, known, frozenset(state.fatal))
            if not runner.drive(chunk):
                return
            self._driven[chunk] = _Driven(deque(), chunk.first)
            self._given, left = chunk.end, left - size

    def _message(self) -> Result | Counts | None:
        # Return None if the session must run the next number, or as soon as a scenario of a later chunk has failed.
        runner, chunk = self.bench.runner, next(iter(self._driven), None)
        if not isinstance(runner, Apart):
            return None
        head = None if chunk is None or chunk.first > self.number else self._driven[chunk]
        # Messages about other chunks are stored until their turn.
        while heard := runner.hear(waits=head is not None and not head.said and not self._early):
            driven = self._driven.get(heard[0])
            if driven is None:
                continue
            driven.said.append(heard[1])
            made = heard[1][0] if isinstance(heard[1], tuple) else None
            if isinstance(made, Result) and made.failed is not None and driven is not head:
                self._early.append(Early(made, driven.heard))
            driven.heard += made.runs if isinstance(made, Counts) else 1
        if head is None or chunk is None or self._early:
            return None
        said = head.said.popleft()
        if not isinstance(said, tuple):  # The chunk is finished, or its process cannot continue it.
            del self._driven[chunk]
            self._alone = chunk.end
            if isinstance(said, ProcessLostError):
                self._suspect = said
            return None if self.number < chunk.end else self._message()
        result: Result | Counts | None = said[0]
        if result is not None:
            runner.count(result.runs if isinstance(result, Counts) else 1, said[2])
            said[1].repeat()
        return result
