"""Processes that run scenarios side by side, one scenario each at a time.

The pools of the standard library and of loky lose all that was under way when one process dies, and do not say which
task it was; they fork, as pebble does, which says it, from threads of their own. Here every process has a pipe of its
own, and the one thread of the session serves them all: the process that dies or falls silent names its scenario, the
others notice nothing, and none is forked while a thread of this module holds a lock.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import TracebackType
from typing import Any

from pytest_pafot.execution.captured_output import Echo, listening
from pytest_pafot.execution.crash_records import InFlight, InFlightError, leftovers
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.signature import PROCESS_CRASH
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Outcome, Trace
from pytest_pafot.world.driving.guard import LastResort, last_resort

GRACE = 5.0
"""How much longer than its limit one decision may take, or a process be silent, before it is ended [s]."""

FAREWELL = 2.0
"""How long a process may take to end by itself [s]; what its libraries started ends with it then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Errand:
    """What each process does with the scenarios that it gets.

    Attributes:
        world: with ``rollout``.
        ads: the factory.
        folder: of the records of what is in flight.
        owner: of the records.
        plain_world: the world as data, for the records.
    """

    world: Any
    ads: Callable[[], Any]
    folder: Path
    owner: str
    plain_world: Mapping[str, Any] | None = None

    def in_flight(self) -> InFlight:
        """The record of the process that asks."""
        return InFlight(self.folder, self.owner, world=self.plain_world)

    def run(self, scenario: Scenario) -> Answer:
        """A run and what the ADS said in it; empty where it raised, for the session to see for itself."""
        try:
            with listening() as echo:
                trace = self.world.rollout(scenario, self.ads)
        except BaseException:  # noqa: BLE001  (nothing is lost: the session runs it again, and raises it there)
            return Answer()
        return Answer(trace=trace, echo=echo)


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What a process made of a scenario.

    Attributes:
        trace: None where only a run in the session's own process can show what happens.
        echo: what was said in the run.
    """

    trace: Trace | None = None
    echo: Echo = field(default_factory=Echo)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lost:
    """A scenario whose process did not come back.

    Attributes:
        scenario: that it ran.
        pid: of the process.
        how: it ended, in a few words.
        is_hang: whether it fell silent and was killed.
    """

    scenario: Scenario
    pid: int
    how: str
    is_hang: bool = False

    @property
    def expect(self) -> Expect:
        """What running the scenario is expected to show. Nobody saw it; the ADS is the code that a process dies in."""
        outcome = Outcome.HANG if self.is_hang else Outcome.ADS_ERROR
        message = f"the process that ran this scenario {self.how}"
        return Expect(failure=PROCESS_CRASH, outcome=outcome, time=0.0, message=message)


class ProcessLostError(Exception):
    """What a scenario that was asked for shows cannot be told: its process did not come back."""

    def __init__(self, lost: Lost) -> None:
        super().__init__(f"the process (pid {lost.pid}) that ran {lost.scenario!r} {lost.how}")
        self.lost = lost


def trace_from(answer: Answer | Lost) -> Trace | None:
    """The trace of an answer, once what was said in the run is said again here; None where it must run here.

    Raises:
        ProcessLostError: where the process that made it did not come back.
    """
    __tracebackhide__ = True
    if isinstance(answer, Lost):
        raise ProcessLostError(answer)
    if answer.trace is not None:
        answer.echo.repeat()
    return answer.trace


class Crew:
    """Up to so many processes, started as they are needed. To be used in a ``with`` statement.

    Args:
        errand: of every process. Where processes are not forked, it must be possible to pickle.
        size: number of processes at most.
        method: by which processes are started, see :mod:`multiprocessing`.
        patience: how long a process may run without answering a signal, which Python does between two
            instructions [s].
        grace: how much longer than its limit one decision may take that ignores its interruption [s].
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        errand: Errand,
        size: int,
        *,
        method: str,
        patience: float,
        grace: float = GRACE,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.recovered: list[Lost] = []
        """Processes that died in scenarios that ran to their end when they were tried alone."""
        self.failure = ""
        """Why no process could be started, from which moment on nothing is expected; or empty."""
        self._errand = errand
        self._size = size
        self._context: Any = multiprocessing.get_context(method)
        self._patience = patience
        self._grace = grace
        self._clock = clock
        self._members: list[_Member] = []
        self._pending: deque[Scenario] = deque()
        self._wanted: set[Scenario] = set()
        self._answers: dict[Scenario, Answer | Lost] = {}
        self._suspects: dict[Scenario, Lost] = {}
        self._killed: set[int] = set()

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close(at_once=kind is not None)

    def expect(self, scenarios: Iterable[Scenario]) -> None:
        """Begin with these, in this order; what was expected before and not fetched is of no interest any more."""
        self._pending = deque(() if self.failure else scenarios)
        self._wanted = set(self._pending)
        self._answers, self._suspects = {}, {}
        self._send()

    def insert(self, scenario: Scenario) -> None:
        """Run this one next, beside what is expected."""
        self._wanted.add(scenario)
        if self.failure:
            self._answers[scenario] = Answer()
            return
        self._pending.appendleft(scenario)
        self._send()

    def expects(self, scenario: Scenario) -> bool:
        """Whether :meth:`fetch` can give an answer."""
        return scenario in self._wanted

    def fetch(self, scenario: Scenario) -> Answer | Lost:
        """The answer to an expected scenario, once; waits for it.

        A scenario in which a process died is tried once more while nothing else runs: there may have been too little
        memory for all of them, or somebody killed the process.
        """
        if scenario not in self._wanted:
            raise ValueError(f"scenario: expected one that is expected, and not fetched before, received {scenario!r}")
        while scenario not in self._answers:
            if scenario in self._suspects:
                self._answers[scenario] = self._alone(scenario)
            else:
                self._receive()
            self._send()
        self._wanted.discard(scenario)
        return self._answers.pop(scenario)

    def close(self, *, at_once: bool = False) -> None:
        """End all processes; those that are at work are killed, and ``at_once`` all of them."""
        leaving = [] if at_once else [member for member in self._members if member.dismiss()]
        deadline = self._clock() + FAREWELL
        for member in leaving:
            member.process.join(max(0.0, deadline - self._clock()))
        for member in self._members:
            self._kill(member)
        self._members, self._pending, self._wanted = [], deque(), set()
        self._forget_killed()

    def _alone(self, scenario: Scenario) -> Answer | Lost:
        while any(member.scenario is not None for member in self._members):
            self._receive()
        first = self._suspects.pop(scenario)
        self._give(scenario)
        while scenario not in self._answers and scenario not in self._suspects:
            self._receive()
        second = self._suspects.pop(scenario, None) or self._answers[scenario]
        if isinstance(second, Answer):
            self.recovered.append(first)
        return second

    def _send(self) -> None:
        while self._pending and sum(member.scenario is not None for member in self._members) < self._size:
            self._give(self._pending.popleft())

    def _give(self, scenario: Scenario) -> None:
        idle = next((member for member in self._members if member.scenario is None), None)
        try:
            while idle is None or not idle.take(scenario, self._clock()):
                if idle is not None:  # It ended between two scenarios: nobody's doing.
                    self._remove(idle)
                idle = self._started()
        except OSError as error:
            self._fail(scenario, str(error))

    def _started(self) -> _Member:
        others = [member.connection for member in self._members]
        member = _Member(self._context, self._errand, others, self._grace)
        self._members.append(member)
        return member

    def _fail(self, scenario: Scenario, reason: str) -> None:
        """Without processes, the session runs the scenarios itself."""
        self.failure = self.failure or reason
        for each in (scenario, *self._pending):
            self._answers[each] = Answer()
        self._pending.clear()

    def _receive(self) -> None:
        """Take what is there, after a while at most."""
        busy = {member.connection: member for member in self._members if member.scenario is not None}
        wait(busy, timeout=min(1.0, self._patience / 4))
        for member in busy.values():
            self._look_at(member)

    def _look_at(self, member: _Member) -> None:
        scenario = member.scenario
        if scenario is None:
            return
        is_gone = not member.process.is_alive()  # Asked first: what it sent before its end is there now.
        if member.connection.poll():
            answer = member.answer()
            if answer is not None:
                if scenario in self._wanted:
                    self._answers[scenario] = answer
                return
            is_gone = True
        if member.is_stuck:
            self._remove(member)
            how = f"ignored the interruption of a decision for {self._grace:.1f} s and was ended"
            self._note(Lost(scenario=scenario, pid=member.pid, how=how, is_hang=True), member)
        elif is_gone:
            self._remove(member)
            self._note(Lost(scenario=scenario, pid=member.pid, how=ending(member.process.exitcode)), member)
        elif member.silence(self._clock()) > self._patience:
            self._remove(member)
            how = f"did not answer for {self._patience:.1f} s and was killed"
            self._note(Lost(scenario=scenario, pid=member.pid, how=how, is_hang=True), member)

    def _note(self, lost: Lost, member: _Member) -> None:
        if not member.has_begun:
            self._fail(lost.scenario, f"a process {lost.how} before it had begun")
        elif lost.scenario not in self._wanted:
            return
        elif lost.is_hang:
            self._answers[lost.scenario] = lost
        else:
            self._suspects[lost.scenario] = lost

    def _remove(self, member: _Member) -> None:
        self._kill(member)
        self._members.remove(member)
        self._forget_killed()

    def _kill(self, member: _Member) -> None:
        self._killed.add(member.pid)
        member.kill()

    def _forget_killed(self) -> None:
        """Remove the records of dead processes, which the session is told about otherwise."""
        with suppress(InFlightError):  # A folder that cannot be read holds no records of this session.
            for leftover in leftovers(self._errand.folder):
                if leftover.pid in self._killed and leftover.owner == self._errand.owner:
                    leftover.discard()


class _Member:
    """One process, as the session sees it.

    Attributes:
        scenario: that it runs now.
    """

    def __init__(self, context: Any, errand: Errand, others: list[Connection], grace: float) -> None:
        self.scenario: Scenario | None = None
        self.connection, end = context.Pipe()
        self._beats = context.RawValue("Q", 0)
        self._stuck = context.RawValue("b", 0)
        self._heard = 0
        self._asked_at: float | None = None
        inherited = [*others, self.connection] if context.get_start_method() == "fork" else []
        job = _Job(connection=end, inherited=inherited, beats=self._beats, stuck=self._stuck, grace=grace)
        self.process = context.Process(target=_serve, args=(errand, job), name="pafot-worker")
        with warnings.catch_warnings():
            # Python warns of any thread; those of numerical libraries are documented, and this module has none.
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork", category=DeprecationWarning)
            self.process.start()
        self.pid = int(self.process.pid)
        end.close()

    @property
    def has_begun(self) -> bool:
        """Whether it came so far as to wait for scenarios."""
        return bool(self._beats.value)

    @property
    def is_stuck(self) -> bool:
        """Whether it ended since a decision would not."""
        return bool(self._stuck.value)

    def take(self, scenario: Scenario, now: float) -> bool:
        """Run a scenario; False where the process has ended."""
        try:
            self.connection.send(scenario)
        except OSError:
            return False
        self.scenario, self._asked_at = scenario, None if self.has_begun else now
        return True

    def answer(self) -> Answer | None:
        """What it has sent; None where it ended before it was done."""
        try:
            answer = self.connection.recv()
        except (EOFError, OSError):
            return None
        except Exception:  # noqa: BLE001  (made of what cannot be had here: the session runs it again)
            answer = Answer()
        self.scenario = None
        return answer if isinstance(answer, Answer) else Answer()

    def silence(self, now: float) -> float:
        """Since when it owes an answer to a signal [s]; sends one where it owes none."""
        if self._beats.value != self._heard:
            self._heard, self._asked_at = self._beats.value, None
        if self._asked_at is not None:
            return now - self._asked_at
        if hasattr(signal, "SIGUSR2"):
            self._asked_at = now
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGUSR2)
        return 0.0

    def dismiss(self) -> bool:
        """Ask it to end; False where it is at work, or has ended."""
        if self.scenario is not None:
            return False
        try:
            self.connection.send(None)
        except OSError:
            return False
        return True

    def kill(self) -> None:
        """End it and let nothing of it remain."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def ending(code: int | None) -> str:
    """How a process ended by itself, by its exit code."""
    if code is not None and code < 0:
        with suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Job:
    """What a process needs besides its errand.

    Attributes:
        connection: to the session.
        inherited: those of others, by a fork.
        beats: counts the signals that it answers.
        stuck: set before it ends since a decision would not.
        grace: how long a decision may ignore interruptions [s].
    """

    connection: Connection
    inherited: list[Connection]
    beats: Any
    stuck: Any
    grace: float

    def end(self) -> None:
        """End at once; whatever the session was to be told is told by that."""
        self.stuck.value = 1
        os._exit(1)


def _serve(errand: Errand, job: _Job) -> None:
    """A process: run scenarios until there are no more, or nobody waits for them."""
    connection = job.connection
    for other in job.inherited:
        other.close()  # Else nobody would see the end of the session, or of another process, while this one lives.
    signal.signal(signal.SIGINT, _ignore)  # The session ends its processes itself. What they start is interrupted.
    if hasattr(signal, "SIGUSR2"):
        signal.signal(signal.SIGUSR2, lambda number, frame: _beat(job.beats))
    _beat(job.beats)
    resort = LastResort(end=job.end, grace=job.grace)
    with last_resort(resort), errand.in_flight() as flight, suppress(EOFError, OSError):
        while True:
            scenario = connection.recv()
            if scenario is None:
                return
            flight.record(scenario)
            answer = errand.run(scenario)
            flight.clear()
            _reply(connection, answer)


def _reply(connection: Connection, answer: Answer) -> None:
    try:
        connection.send(answer)
    except OSError:
        raise
    except Exception:  # noqa: BLE001  (it holds what cannot be sent: the session runs it again)
        connection.send(Answer())


def _beat(beats: Any) -> None:
    beats.value += 1


def _ignore(number: int, frame: object) -> None:
    """Unlike SIG_IGN, a function is not inherited by programs that the ADS starts."""
