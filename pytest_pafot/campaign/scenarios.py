"""The scenarios of a search in order, and their results."""
# There is a class for random scenarios, which are drawn by their numbers, and one for scenarios that an algorithm
# breeds.

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.results import Counts, Result, State
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Apart, Chunk, LostRun
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.algorithms.catalogue import RandomSearch
from pytest_pafot.searching.evaluation import CampaignFinished, CampaignStarted, EndReason, Evaluated, Evaluation, Event
from pytest_pafot.searching.plan import Algorithm, Plan

# The time that the runs of a chunk take together [s]: long compared to the time of a message, short compared to a
# search.
CHUNK_SECONDS = 0.05

# The shortest time of the runs to come for which other processes are started [s], which takes some tenths of a second.
WORTH_SECONDS = 0.3

# The number of chunks for each process that are given before the first of them is counted: runs differ in length, and
# nobody should wait for a long one.
CHUNKS_AHEAD = 8

# The number of runs at the beginning that must not all end in the same exception, which would be the set-up's.
FIRST = 16


@dataclass(frozen=True, slots=True)
class Early:
    """A failing result before its turn, and its number."""

    result: Result
    number: int


# The result of the next scenario of a search, or of several:
# - A result is that of its run, in this process or in another one.
# - Counts are those of one or several runs that another process has made.
# - A lost run says how the process of the scenario died or hung.
# - An early result is of a later scenario that has already run. It is returned again in its turn, and the next scenario
#   stays the same.
# - An evaluation is that of an earlier run, which shows the result of the scenario.
# - Events describe a generation without any scenario.
# - None means that the scenario is not run, because a process died in it before.
Done = Result | Counts | LostRun | Early | Evaluation | Sequence[Event] | None


class Bred(Plan):
    """The scenarios of an algorithm that learns, generation by generation."""

    # Other processes make the runs of a generation in advance.

    def __init__(self, bench: Bench, algorithm: Algorithm[Any], **limits: Any) -> None:
        self.bench = bench
        super().__init__(algorithm, **limits)

    def _begin(self) -> None:
        super()._begin()
        self._results: Iterator[Result | LostRun] = iter(())  # of the rest of the generation

    def next(self, state: State) -> Done:
        """Return the result of the next scenario.

        Raises:
            OutOfTime: if the time of the search runs out first. The scenario is then not counted.
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

        self._results = self.bench.results(self.ahead(), state, skips)
        return next(self._results)


def chunk_size(run_seconds: float, left: int, workers: int) -> int:
    """Return the number of runs of a chunk."""
    # Few if runs are long, or if few are left for each process.
    return max(1, min(round(CHUNK_SECONDS / run_seconds), left // (2 * workers)))


@dataclass(slots=True)
class _Driven:
    # A chunk that another process simulates: its messages that are not yet counted, and the next number.

    said: deque[Any]
    heard: int


@dataclass(slots=True, kw_only=True)
class Numbers:
    """The scenarios of a random search, with other processes ahead of it."""

    # Other processes draw and simulate chunks of numbers, and report their counts and the runs that the session must
    # see. If only the session may evaluate, it draws the scenarios, and others only make the runs.

    algorithm: RandomSearch
    seed: int
    runs: int | None  # None for no limit
    bench: Bench
    number: int = 0  # of the next scenario to be counted
    _given: int = 0  # the first number that no other process has
    _results: Iterator[Result | LostRun] = field(default_factory=lambda: iter(()))  # that no process drives on its own
    _driven: dict[Chunk, _Driven] = field(default_factory=dict)  # in the order of their numbers
    _early: deque[Early] = field(default_factory=deque)  # what failed in later chunks, as it is heard
    _alone: int = 0  # the end of the chunk in which a process died: its scenarios are run one by one
    _suspect: LostRun | None = None  # that death, as long as no scenario is known to be the cause

    def __post_init__(self) -> None:
        if self.bench.driver is not None:
            self.bench.driver.drawn = partial(self.algorithm.drawn, self.seed)
            if isinstance(self.bench.runner, Apart):
                self.bench.runner.end()  # processes that were started before cannot draw

    @property
    def started(self) -> CampaignStarted:
        return CampaignStarted(algorithm=self.algorithm.name, generations=None, seed=self.seed)

    @property
    def generation(self) -> int:
        """The number of the next scenario."""
        # Each scenario is a generation.
        return self.number

    @property
    def is_over(self) -> bool:
        return False

    @property
    def has_all_runs(self) -> bool:
        """True if all requested scenarios were run."""
        return self.number >= self._end

    @property
    def _end(self) -> int:
        return sys.maxsize if self.runs is None else self.runs

    def scenario(self) -> Scenario:
        return self.algorithm.drawn(self.seed, self.number)

    def next(self, state: State) -> Done:
        """Return the results of the next scenario, or of several.

        Raises:
            OutOfTime: if the time of the search runs out first. The scenario is then not counted.
            RequestError: as for :meth:`.Bench.run`.
        """
        __tracebackhide__ = True
        # Until two runs differ, which shows that no fault of the set-up is their cause, they are made one by one.
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
            # Where processes drive on their own, this run alone, whose time is measured, or the rest of a chunk.
            end = self._end if self.bench.driver is None else max(self._alone, self.number + 1)
            drawn = map(partial(self.algorithm.drawn, self.seed), range(self.number, end))
            self._results = self.bench.results(drawn, state, state.fatal.__contains__)
            result = next(self._results)
        if isinstance(result, ProcessLostError):
            self._suspect = None  # The scenario that killed the process of its chunk has run again, and did so.
        return result

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Sequence[Event]:
        event = Evaluated(generation=self.number, local_generation=0, index=0, evaluation=evaluation, reused=reused)
        self.count(1)
        return (event,)

    def count(self, runs: int) -> None:
        self.number += runs
        self._given = max(self._given, self.number)
        if self._suspect is not None and self.number >= self._alone and isinstance(self.bench.runner, Apart):
            self.bench.runner.recovered.append(self._suspect)
            self._suspect = None

    def finished(self, reason: EndReason, seconds: float) -> Iterator[Event]:
        self._results = iter(())
        yield CampaignFinished(
            reason=reason, generations=0, evaluated=self.number, simulated=self.number, best=None, seconds=seconds
        )

    def _give(self, state: State) -> None:
        # Other processes draw and simulate the next numbers if that is worth it.
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
        # None if the session must run the next number, and as soon as something has failed in a later chunk.
        runner, chunk = self.bench.runner, next(iter(self._driven), None)
        if not isinstance(runner, Apart):
            return None
        head = None if chunk is None or chunk.first > self.number else self._driven[chunk]
        # Messages on other chunks come in between, and are stored until their turn.
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
        if not isinstance(said, tuple):  # The chunk is over, or its process cannot go on with it.
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
