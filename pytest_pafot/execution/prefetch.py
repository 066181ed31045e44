"""The option ``workers``: once runs turn out to be dear, those of a generation take place ahead, in other processes.

The search asks for one run after the other, as it always does, and gets each from here. So nothing but the time
depends on whether, when and by how many processes it was made. With the option ``isolate`` none takes place here.
"""

from __future__ import annotations

import pickle
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

from pytest_pafot.campaign.request import RequestError
from pytest_pafot.execution.worker_pool import GRACE, Crew, Errand, Lost, trace_from
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.xdist import is_worker

if TYPE_CHECKING:
    from pytest_pafot.campaign.harness import Bench
    from pytest_pafot.scenario import Scenario
    from pytest_pafot.trace import Trace

DEAR = 0.010
"""From this mean duration of a run on, processes are worth their cost [s]: a run that is made in another one costs half
a millisecond more, and starting a process as much as some runs."""

WARM_RUNS = 2
"""Runs that must have been measured before. The first run of a search is not: it loads what the others use."""

METHOD = "fork" if sys.platform == "linux" else "spawn"
"""Forked processes have the factory and the fixtures that it uses. Elsewhere the systems' own libraries do not survive
it, and the factory must be one that can be pickled."""

IN_WORKER = "--pafot-workers is 1 under pytest-xdist, which runs tests in several processes already"


@dataclass(slots=True, kw_only=True)
class Ahead:
    """Gives the runs of one search. To be used in a ``with`` statement, which ends the processes.

    Attributes:
        size: processes at most; with 1, all runs take place in this one.
        hire: makes the crew; None where there cannot be one, with the reason in the notes.
        dear: mean duration of a run from which on the crew is worth its cost [s].
        clock: seconds, monotonic.
        notes: to be told once.
    """

    size: int
    hire: Callable[[], Crew | None]
    dear: float = DEAR
    clock: Callable[[], float] = time.perf_counter
    notes: list[str] = field(default_factory=list)
    _crew: Crew | None = field(default=None, init=False)
    _coming: list[Scenario] = field(default_factory=list, init=False)
    _runs: int = field(default=0, init=False)
    _warm_seconds: float = field(default=0.0, init=False)

    def __enter__(self) -> Ahead:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        crew, self._crew = self._crew, None
        self._coming = []
        if crew is None:
            self.notes += self._reason()
            return
        crew.close(at_once=kind is not None)
        if crew.failure:
            self.notes.append(f"--pafot-workers: one process ran the scenarios, since no other could: {crew.failure}")
        else:
            self.notes.append(f"--pafot-workers={self.size}: in use after {self._runs} runs of this process")
        self.notes += [_recovery(lost) for lost in crew.recovered]

    def foresee(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for."""
        if self._crew is None:
            self._coming = list(scenarios)
        else:
            self._crew.expect(scenarios)

    def run(self, scenario: Scenario, here: Callable[[Scenario], Trace]) -> Trace:
        """A run, made ahead where that was possible, else ``here``.

        Raises:
            ProcessLostError: where the process that made it did not come back.
            Exception: whatever ``here`` raises.
        """
        __tracebackhide__ = True
        if self._crew is not None and self._crew.expects(scenario):
            made = trace_from(self._crew.fetch(scenario))
            return here(scenario) if made is None else made
        if scenario not in self._coming:
            return here(scenario)
        self._coming.remove(scenario)
        started = self.clock()
        trace = here(scenario)
        self._measured(self.clock() - started)
        return trace

    def _reason(self) -> list[str]:
        """Why one process ran all scenarios, where that can be said and is not what was asked for."""
        if self.size == 1 or not self._is_warm:
            return []
        mean, dear = 1000 * self._warm_seconds / (self._runs - 1), 1000 * self.dear
        return [
            f"--pafot-workers={self.size}: not in use, since a run took {mean:.1f} ms, and it pays from {dear:g} ms on"
        ]

    @property
    def _is_warm(self) -> bool:
        return self._runs > WARM_RUNS

    def _measured(self, seconds: float) -> None:
        self._runs += 1
        if self._runs > 1:
            self._warm_seconds += seconds
        if self.size > 1 and self._is_warm and self._warm_seconds >= self.dear * (self._runs - 1):
            self._begin()

    def _begin(self) -> None:
        """Have the rest of the generation made elsewhere, and the following ones."""
        self._crew = self.hire()
        if self._crew is None:
            self.size = 1
        else:
            self._crew.expect(self._coming)
            self._coming = []


@dataclass(slots=True, kw_only=True)
class Isolated:
    """Gives all runs of one search from other processes: the ADS is never called in this one.

    To be used in a ``with`` statement, which ends the processes; what runs after it has others.

    Attributes:
        hire: makes the crew.
        is_wanted: whether runs may take place in lock step, which they may not.
    """

    hire: Callable[[], Crew]
    is_wanted: Literal[False] = False
    _crew: Crew | None = field(default=None, init=False)
    _recovered: list[Lost] = field(default_factory=list, init=False)

    @property
    def notes(self) -> list[str]:
        """To be told once."""
        return [_recovery(lost) for lost in [*self._recovered, *(self._crew.recovered if self._crew else ())]]

    def __enter__(self) -> Isolated:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        crew, self._crew = self._crew, None
        if crew is not None:
            crew.close(at_once=kind is not None)
            self._recovered += crew.recovered

    def foresee(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for."""
        self._hired().expect(scenarios)

    def saw(self, ads: Any) -> None:
        """Whatever the ADS can do besides, it is asked for one run at a time."""

    def was_together(self, trace: Trace) -> bool:
        """No run takes place together with others."""
        return False

    def run(self, scenario: Scenario, here: Callable[[Scenario], Trace]) -> Trace:
        """A run; ``here`` only to raise what it raised in another process beside the ADS.

        Raises:
            ProcessLostError: where the process that made it did not come back.
            RequestError: where there can be no process.
            Exception: whatever ``here`` raises.
        """
        __tracebackhide__ = True
        crew = self._hired()
        if not crew.expects(scenario):
            crew.insert(scenario)
        answer = crew.fetch(scenario)
        if crew.failure:
            raise RequestError(f"--pafot-isolate: expected processes to run the ADS in, received: {crew.failure}")
        trace = trace_from(answer)
        return here(scenario) if trace is None else trace

    def _hired(self) -> Crew:
        self._crew = self._crew or self.hire()
        return self._crew


def ahead_of(bench: Bench) -> Ahead:
    """The runs of an item's search, by as many processes as its settings say."""
    size, notes = _size(bench), list[str]()
    return Ahead(size=size, hire=lambda: hired(bench.errand, size, METHOD, notes), notes=notes)


def isolated_of(bench: Bench) -> Isolated:
    """The same where the ADS shall not run in this process."""
    size = _size(bench)
    return Isolated(hire=lambda: crew_for(bench.errand, size))


def crew_for(errand: Errand, size: int) -> Crew:
    """A crew that there must be.

    Raises:
        RequestError: where its processes cannot be given what they need.
    """
    notes: list[str] = []
    crew = hired(errand, size, METHOD, notes)
    if crew is None:
        raise RequestError(f"--pafot-isolate: {notes[0].partition(': ')[2]}")
    return crew


def _size(bench: Bench) -> int:
    size = bench.request.settings.workers
    if size > 1 and is_worker(bench.item.config):
        messages.send(bench.item, "note", {"text": IN_WORKER})
        return 1
    return size


def hired(errand: Errand, size: int, method: str, notes: list[str]) -> Crew | None:
    """A crew; None with a note where its processes could not be given what they need."""
    if method != "fork":
        try:
            pickle.dumps(errand)
        except Exception as error:  # noqa: BLE001  (whatever the objects of the user raise when they are pickled)
            notes.append(
                "--pafot-workers is 1: where processes cannot be forked, the ADS factory must be one that can be "
                "pickled, such as a class of a module that can be imported, received one that raises "
                f"{type(error).__name__}: {error}"
            )
            return None
    limit = float(getattr(errand.world, "hang_limit", 30.0))
    return Crew(errand, size, method=method, patience=limit + GRACE, grace=GRACE)


def _recovery(lost: Lost) -> str:
    return (
        f"a process (pid {lost.pid}) {lost.how} while it ran {lost.scenario!r}, which ran to its end when it was tried "
        "alone: there may be too little memory for so many workers, or the process was killed from outside"
    )
