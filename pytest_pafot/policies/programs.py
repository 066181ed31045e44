"""Planners that are separate programs in any language, with which pytest-pafot exchanges lines of JSON."""

from __future__ import annotations

import functools
import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing.util import Finalize
from os import getpid
from typing import Any, NoReturn

from pytest_pafot import LaneCommand, Observation
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import BadAction
from pytest_pafot.support.errors import refused_policy as refused
from pytest_pafot.support.text import safe_repr

# The attributes of a `pytest_pafot.Observation` that the program receives as keys, in their order.
SENT_ATTRIBUTES = (
    "time",
    "decision_period",
    "lanes",
    "lane_width",
    "speed_limit",
    "lane_centres",
    "road_length",
    "acceleration",
    "steering",
    "lateral_velocities",
    "ids",
    "ego",
    "others",
    "crossing",
)

LONGEST_LINE = 1 << 20  # the longest line that a program may write [bytes]
# length of the end of stderr in the error of a program that has ended [bytes]
STDERR_IN_ERROR = 2000
STDERR_PRINTED = 4000  # number of bytes from each end of a run's stderr that the session prints
GRACE = 1.0  # time for a program to end on its own after its input was closed [s]
# longest wait without a check of the time [s], for systems on which the hang limit cannot send a signal
SLICE = 0.2
CHUNK = 1 << 16  # largest number of bytes to read from a pipe in one call


class ProgramEnded(Exception):  # noqa: N818  (findings show this name, so it names the error)
    """An error for a program that ended instead of responding."""


class ProgramTimeout(Exception):  # noqa: N818  (for the same reason)
    """An error for a program that did not respond in time."""


@dataclass(frozen=True, kw_only=True)
class ProgramLoader:
    """The factory that :func:`pytest_pafot.policies.process` makes."""

    command: tuple[str, ...]
    keep: bool = True
    timeout: float | None = None

    def __post_init__(self) -> None:
        if os.name != "posix":
            raise refused(
                "a system with POSIX pipes, for process()",
                sys.platform,
                "run the tests on Linux or macOS",
            )
        timeout = self.timeout
        if timeout is not None and not (isinstance(timeout, (int, float)) and timeout > 0):
            raise refused(
                "a timeout of more than 0 s, or None",
                repr(timeout),
                "use seconds, such as timeout=5",
            )

    def __call__(self) -> ProgramAds:
        """Return a new ADS, with an idle program of this process or else a new program."""
        idle = _idle_in(getpid(), self)
        while idle:
            program = idle.pop()
            if program.is_ready:
                return ProgramAds(self, program, True)
        return ProgramAds(self, Program(self.command))


@functools.cache
def _idle_in(process: int, loader: ProgramLoader) -> list[Program]:
    # one list per process, because a forked process must not use the programs of its parent
    return []


@dataclass(eq=False, repr=False)
class ProgramAds:
    """An ADS that drives one run with a program."""

    _loader: ProgramLoader
    _program: Program
    _is_kept: bool = False
    _is_first: bool = True
    _is_waiting: bool = False

    def __call__(self, observation: Any) -> Any:
        """Return the program's action for an observation."""
        line = line_of(observation, reset=self._is_first)
        is_first = self._is_first
        self._is_first = False
        self._is_waiting = True
        try:
            answer = self._program.ask(line, self._loader.timeout)
        except ProgramEnded:
            if not is_first or not self._is_kept:
                raise
            # The program was still ending after its last scenario, so it has received nothing of this one.
            self._program = Program(self._loader.command)
            answer = self._program.ask(line, self._loader.timeout)
        action = action_of(answer)
        self._is_waiting = False
        return action

    def close(self) -> None:
        try:
            sys.stderr.write(self._program.new_output())
        finally:
            # its late response would be mistaken for a response in the next run
            if self._is_waiting:
                self._program.kill()
            if self._loader.keep and not self._is_waiting:
                _idle_in(getpid(), self._loader).append(self._program)
            else:
                self._program.end()


def line_of(observation: Any, *, reset: bool) -> bytes:
    """Format an observation as a line of JSON. ``reset`` marks the first observation of a run."""
    values: dict[str, Any] = {"reset": reset}
    if isinstance(observation, Observation):
        values |= {name: getattr(observation, name) for name in SENT_ATTRIBUTES}
        values["ego"] = observation.ego._asdict()
        values["others"] = [other._asdict() for other in observation.others]
        values["crossing"] = [
            {**each._asdict(), "zone": asdict(replace(each.zone, line=()))}
            for each in observation.crossing
        ]
    else:
        values["observation"] = observation
    return json.dumps(values, default=lambda array: array.tolist()).encode() + b"\n"


def action_of(line: bytes) -> Any:
    """Return the action in a program's line: a pair in SI units, a ``LaneCommand``, or an action for the environment.

    Raises:
        BadAction: if the line contains anything else.
    """
    # The messages are part of the signatures of saved findings. With other words, known failures would become new ones.
    expected = (
        "expected a line of JSON with the keys acceleration and steering, or lane and speed, or lane and acceleration, "
        "or, in a pafot.World, action, received"
    )
    answer: Any = None
    # not JSON, not text, 5000 digits, or 100,000 brackets
    with suppress(ValueError, RecursionError):
        answer = json.loads(line, object_pairs_hook=_without_repetition)
    match answer:
        # An echoed observation also has the keys acceleration and steering, so this check must be first.
        case {"reset": _}:
            expected = (
                "expected a decision, as an object without the key reset, received an observation:"
            )
        case {"action": action}:
            return action
        case {"lane": _}:
            names = [each.name for each in fields(LaneCommand)]
            return LaneCommand(**{name: answer[name] for name in names if name in answer})
        case {"acceleration": acceleration, "steering": steering}:
            return acceleration, steering
    raise BadAction(f"{expected} {safe_repr(line.decode('utf-8', 'replace'))}")


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError("a key is repeated")  # libraries differ in which value they use
    return values


class Program:
    """A running program, which is ended when it is no longer needed or when this process ends.

    Raises:
        AdsFactoryError: if the program cannot be started.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._name = os.path.basename(command[0])  # noqa: PTH119  (the name may be any text)
        self._buffer = bytearray()
        self._stderr = bytearray()
        self._omitted = 0
        try:
            self._process = subprocess.Popen(  # noqa: S603  (the user's own program)
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                # The whole group is killed after the program has ended, even if it ended on its own. Processes that it
                # left running would keep the pipes open and the machine busy.
                process_group=0,
            )
        except OSError as error:
            received = f"{list(command)} ({error.strerror})"
            fix = "correct the path, or build it first"
            raise refused("a program that can be started", received, fix) from None
        pipes: Any = self._process
        self._to = pipes.stdin.fileno()
        self._from = pipes.stdout.fileno()
        self._errors = pipes.stderr.fileno()
        self._sources = [self._from, self._errors]
        # Also ends the program when this object is garbage-collected and when this process ends normally. Unlike a
        # `weakref` finalizer, it works in worker processes, but does not end the programs of a forked process's parent.
        self.end = Finalize(self, _end, (self._process,), exitpriority=0)

    @property
    def is_ready(self) -> bool:
        """True if the program is running and waits for a line, without having written anything in advance."""
        with suppress(ProgramEnded, BadAction):
            self._receive(0.0)
            return not self._buffer
        return False

    def kill(self) -> None:
        _kill(self._process)

    def ask(self, line: bytes, timeout: float | None) -> bytes:
        """Send a line to the program, and return the line that it writes within ``timeout`` [s].

        Raises:
            ProgramEnded: if the program ends first.
            ProgramTimeout: if the line takes longer.
            BadAction: if the program writes more than one line, or a line that is too long.
        """
        pending = memoryview(line)
        started = monotonic()
        self._receive(0.0)
        while b"\n" not in self._buffer or pending:
            if self._buffer and len(pending) == len(line):
                raise _extra_line(self._line())
            if timeout is not None and monotonic() - started > timeout:
                raise ProgramTimeout(f"{self._name} did not answer within {timeout:g} s")
            if self._receive(SLICE, is_asking=bool(pending)):
                try:  # a pipe takes up to PIPE_BUF bytes completely or not at all
                    pending = pending[os.write(self._to, pending[: select.PIPE_BUF]) :]
                except BrokenPipeError:
                    self._raise_ended("input")
        answer = self._line()
        if self._buffer:
            raise _extra_line(self._line())
        return answer

    def _receive(self, seconds: float, *, is_asking: bool = False) -> bool:
        # Wait for output and read it. The result is True if the program accepts more of its input line.
        pipes = select.poll()  # select.select rejects descriptors above 1023
        for source in self._sources:
            pipes.register(source, select.POLLIN)
        if is_asking:
            pipes.register(self._to, select.POLLOUT)
        ready = dict(pipes.poll(1000.0 * seconds))
        if self._errors in ready:
            self._read_stderr()  # a program that fills its stderr pipe would stop responding
        if self._from in ready:
            self._read()
        elif self._to in ready:
            return True
        elif _has_ended(self._process, 0.0) and self._from not in dict(pipes.poll(0)):
            # although a process that the program has started may keep the pipe open
            self._raise_ended()
        return False

    def _read(self) -> None:
        part = os.read(self._from, CHUNK)
        if not part:
            self._raise_ended()
        self._buffer += part
        if len(self._buffer) > LONGEST_LINE:
            begins = safe_repr(bytes(self._buffer[:80]))
            raise BadAction(
                f"expected a line of at most {LONGEST_LINE} bytes, received one that begins with {begins}"
            )

    def _read_stderr(self) -> None:
        part = os.read(self._errors, CHUNK)
        if not part:
            self._sources.remove(self._errors)
        self._stderr += part
        # only the start and the end are stored, to save memory
        middle = max(0, len(self._stderr) - 2 * STDERR_PRINTED)
        del self._stderr[STDERR_PRINTED : STDERR_PRINTED + middle]
        self._omitted += middle

    def _line(self) -> bytes:
        line, _, rest = bytes(self._buffer).partition(b"\n")
        self._buffer[:] = rest
        return line

    def _raise_ended(self, closed: str = "output") -> NoReturn:
        # A program that has closed its input or output has ended, or will end soon.
        _has_ended(self._process, GRACE)
        code = self._process.returncode
        how = f"ended with exit code {code}"
        if code is None:
            how = f"closed its {closed}"
        elif code < 0:
            how = f"was ended by signal {-code}, {signal.strsignal(-code)},"
        # The message is part of the signature of saved findings. With other words, known failures would become new.
        error = ProgramEnded(f"{self._name} {how} in the place of an answer")
        self._read_rest()
        if self._stderr:
            words = self._stderr[-STDERR_IN_ERROR:].decode("utf-8", "replace")
            error.add_note(f"the end of its stderr:\n{words}")
        raise error

    def _read_rest(self) -> None:
        # a limit, because a program may write faster than this reads
        for _ in range(LONGEST_LINE // CHUNK):
            pipe = select.poll()
            pipe.register(self._errors, select.POLLIN)
            if self._errors not in self._sources or not pipe.poll(0):
                return
            self._read_stderr()

    def new_output(self) -> str:
        """Return the output on stderr since the last call, without the middle part if it is long."""
        self._read_rest()
        words = bytes(self._stderr)
        self._stderr.clear()
        if self._omitted:
            note = (
                f"\n[... {self._omitted} bytes that {self._name} wrote to stderr are omitted ...]\n"
            )
            words = words[:STDERR_PRINTED] + note.encode() + words[STDERR_PRINTED:]
            self._omitted = 0
        return words.decode("utf-8", "replace")


def _extra_line(line: bytes) -> BadAction:
    return BadAction(
        f"expected one line for each observation, received another: {safe_repr(line)}; messages belong to stderr"
    )


def _has_ended(process: subprocess.Popen[bytes], seconds: float) -> bool:
    if process.returncode is None:
        with suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
            # Immediately, because the system may reuse the number of the group as soon as the group is empty.
            _kill_group(process)
    return process.returncode is not None


def _kill(process: subprocess.Popen[bytes]) -> None:
    if process.returncode is None:
        _kill_group(process)
        process.wait()


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    # no process is left, or it runs as a different user
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def _end(process: subprocess.Popen[bytes]) -> None:
    pipes: Any = process
    pipes.stdin.close()
    pipes.stdout.close()
    errors = pipes.stderr
    # A program that does not end after its pipes were closed is killed.
    until = monotonic() + GRACE
    words = select.poll()
    words.register(errors, select.POLLIN)
    try:
        while not _has_ended(process, 0.0):
            left = until - monotonic()
            if left <= 0.0:
                break
            # Continue to read stderr, so that the last output of the program neither blocks nor kills it.
            if words.poll(1000.0 * min(left, SLICE / 10)) and not os.read(errors.fileno(), CHUNK):
                _has_ended(process, left)
                break
    finally:  # even if the user interrupts this
        _kill(process)
        errors.close()
