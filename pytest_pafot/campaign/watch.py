"""The limits of a search, and when to report how far it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Progress, SearchEvent
from pytest_pafot.campaign.refine.simplest import rollouts_for
from pytest_pafot.campaign.scenarios import Bred, Numbers
from pytest_pafot.campaign.state import State
from pytest_pafot.campaign.store import Store
from pytest_pafot.searching.evaluation import EndReason

RUNS_TO_CONFIRM = 4
"""The time to find and confirm a failure, as a number of runs.

The scenario is run, run again, and run in highway-env's own environment, which takes about as long as two runs.
"""

RUNS_FOR_MOMENT = 40
"""About how many runs it takes to find the moment of a finding."""

LEAST = 2.0
"""The time that a search has for its replays, its first run and the confirmation of a finding in it, even if its limit
is over by then [s]. So a search of a fast policy tests something even with a very short limit."""


@dataclass(slots=True)
class Watch:
    """The limits of a search, with reports on how far it is. This one asks a function, and reports nothing."""

    stop: Callable[[], bool] = lambda: False

    def reached(self, scenarios: Bred | Numbers) -> EndReason | None:
        """Return the limit that is reached between two scenarios; None if there is none."""
        return "stopped" if self.stop() else "runs" if scenarios.has_all_runs else None

    def seconds_left(self) -> float:
        """Return the time after which a run ends between two decisions [s]."""
        return math.inf

    def after_event(self) -> Iterator[SearchEvent]:
        """Yield a report of the progress if one is due after an event of the plan."""
        yield from ()

    def before_rerun(self, find_id: str) -> Iterator[SearchEvent]:
        """Yield a report of the progress if one is due before a finding is run again."""
        yield from ()


@dataclass(slots=True, kw_only=True)
class TimedWatch(Watch):
    """The watch of a search that has a limit of time or of findings, and a listener that wants to see its progress.

    Attributes:
        node_id: the node id of the search in reports.
        limit: the time at which the search has to end, with shrinking, or infinity [s].
        most: the number of findings after which it ends, or None.
        progress_seconds: the interval between reports of progress [s].
        began: the time at which the loop began [s].
        earliest_end: the earliest time at which it ends for lack of time [s].
        last: the time of the last event of the plan [s].
    """

    node_id: str
    state: State
    bench: Bench
    store: Store
    limit: float
    most: int | None
    progress_seconds: float
    began: float = 0.0
    earliest_end: float = math.inf
    last: float = 0.0
    _runs_before: int = 0
    _reported_at: float = field(init=False)
    # the time [s], without what confirmed findings, and the number of runs after the first one, which loads libraries
    _since: tuple[float, int] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._reported_at = self.state.clock()

    def begin(self, earliest_end: float) -> None:
        """Note that the loop begins now, and the earliest time at which it may end [s]."""
        self.began = self.last = self.state.clock()
        self.earliest_end, self._runs_before = earliest_end, self.state.runs

    def reached(self, scenarios: Bred | Numbers) -> EndReason | None:
        """Return the limit that is reached between two scenarios; None if there is none."""
        if self.most is not None and self.store.count >= self.most:
            return "stopped"
        if scenarios.has_all_runs:
            return "runs"
        return "time" if self.state.clock() >= self._ends() else None

    def seconds_left(self) -> float:
        """Return the time after which a run may be cut [s]. The first run gets its time in any case."""
        ends = self._ends() if self.store.firm else self.limit
        ends = ends if self.state.runs > self._runs_before else max(ends, self.began + LEAST)
        return ends - self.state.clock()

    def _ends(self) -> float:
        """Return when the loop has to end, given its findings so far [s].

        That leaves the time to simplify its findings, or without any, to confirm one in its last run, as far as can be
        told from the runs so far.
        """
        harness, state = self.bench.harness, self.state
        settings, firm = harness.request.settings, self.store.firm
        if self.limit == math.inf:
            return self.earliest_end
        to_simplify = RUNS_TO_CONFIRM + rollouts_for(harness) + RUNS_FOR_MOMENT
        to_compare = 0 if harness.against is None else 2 * settings.pairs
        run_seconds = (state.clock() - self.began) * settings.workers / max(state.runs - self._runs_before, 1)
        seconds = (firm * to_simplify + to_compare or RUNS_TO_CONFIRM) * run_seconds
        return max(self.earliest_end, self.limit - seconds)

    def after_event(self) -> Iterator[SearchEvent]:
        """Yield a report of the progress if one is due after an event of the plan."""
        self.last = self.state.clock()
        if self._since is None and self.state.runs > self._runs_before:
            self._since = self.last - self.bench.confirm_seconds, self.state.runs
        return self.progress()

    def before_rerun(self, find_id: str) -> Iterator[SearchEvent]:
        """Yield a report of the progress if one is due before a finding is run again."""
        return self.progress(f"found {find_id}, running it again")

    @property
    def _run_seconds(self) -> float:
        """The mean time of a run in the process that makes it [s]; 0 if it is not known yet.

        Confirming a finding is left out: at first most failures are new, and later hardly any.
        """
        runner = self.bench.runner
        if runner.in_use:
            return runner.run_seconds
        # The first runs of a cluster come at the same time, after that of one run.
        if self._since is None or (runner.is_elsewhere and not self.state.generation):
            return 0.0
        began, before = self._since
        made = self.state.runs - before
        return (self.state.clock() - self.bench.confirm_seconds - began) / made if made else 0.0

    def progress(self, phase: str = "", of: str = "") -> Iterator[SearchEvent]:
        """Yield a report of the progress if one is due, in a phase of the work on a finding."""
        state, runner = self.state, self.bench.runner
        now = state.clock()
        if now - self._reported_at < self.progress_seconds:
            return
        self._reported_at = now
        settings = self.bench.harness.request.settings
        run_seconds = self._run_seconds
        runs_left = 0 if settings.runs is None else settings.runs - state.runs
        decisions = self.bench.decisions
        yield Progress(
            node_id=self.node_id,
            generation=min(state.generation + 1, settings.generations or state.generation + 1),
            generations=settings.generations,
            runs=state.runs,
            budget=settings.runs,
            failing=state.counts.kinds["failed"],
            finds=self.store.count,
            seconds=state.seconds,
            left=runs_left * run_seconds / max(runner.in_use, 1),
            decision_seconds=run_seconds * state.runs / decisions if decisions else 0.0,
            is_limited=self.limit < math.inf,
            phase=phase,
            of=of,
        )
