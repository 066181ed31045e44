"""A planner as a separate program in any language: it reads an observation and writes a decision, as lines of JSON."""

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

from pytest_pafot import Drive, Observation
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import BadAction
from pytest_pafot.support.errors import refused_policy as refused
from pytest_pafot.support.text import shown

SEEN = (
    *("time", "decision_period", "lanes", "lane_width", "speed_limit", "lane_centres", "road_length"),
    *("acceleration", "steering", "lateral_velocities", "ids", "ego", "others", "crossing"),
)
"""The attributes of a :class:`pytest_pafot.Observation` that are sent to the program as keys, in their order."""

LONGEST_LINE = 1 << 20
"""The longest answer that a program may write [bytes]."""
LAST_WORDS = 2000
"""The length of the end of stderr that is added to the error of a program that has ended [bytes]."""
WORDS = 4000
"""The number of bytes that the session prints from the beginning of a run's stderr, and also from its end."""
GRACE = 1.0
"""The time that a program has to end by itself after its input was closed [s]."""
SLICE = 0.2
"""The longest wait without a check of the time [s], for systems in which the hang limit cannot send a signal."""
CHUNK = 1 << 16
"""The largest number of bytes read from a pipe at once."""


class ProgramEnded(Exception):  # noqa: N818  (findings show this name, so it names the mistake)
    """The program ended instead of answering."""


class ProgramTimeout(Exception):  # noqa: N818  (for the same reason)
    """The program did not answer in time."""


@dataclass(frozen=True, kw_only=True)
class ProgramLoader:
    """The factory that :func:`pytest_pafot.policies.process` makes."""

    command: tuple[str, ...]
    keep: bool = True
    timeout: float | None = None

    def __post_init__(self) -> None:
        if os.name != "posix":
            raise refused("a system with POSIX pipes for a planner that is a program", sys.platform, "run it elsewhere")
        if self.timeout is not None and not (isinstance(self.timeout, (int, float)) and self.timeout > 0):
            raise refused("a timeout above 0 [s], or None", repr(self.timeout), "give it seconds, such as timeout=5")

    def __call__(self) -> ProgramAds:
        """Return a new ADS, with an idle program of this process or with a new program."""
        idle = _idle(self)
        while idle:
            program = idle.pop()
            if program.is_ready:
                return ProgramAds(self, program, is_kept=True)
        return ProgramAds(self, Program(self.command))


@functools.cache
def _idle_in(process: int, loader: ProgramLoader) -> list[Program]:
    """Return the idle programs of a process: a forked process must not use the programs of its parent."""
    return []


def _idle(loader: ProgramLoader) -> list[Program]:
    """Return the programs of this process that are waiting for their next run."""
    return _idle_in(getpid(), loader)


class ProgramAds:
    """An ADS that drives one run with a program."""

    def __init__(self, loader: ProgramLoader, program: Program, *, is_kept: bool = False) -> None:
        self._loader = loader
        self._program = program
        self._is_kept = is_kept
        self._is_first = True
        self._is_asked = False

    def __call__(self, observation: Any) -> Any:
        """Return the program's answer to an observation."""
        line = line_of(observation, reset=self._is_first)
        is_first, self._is_first, self._is_asked = self._is_first, False, True
        try:
            answer = self._program.ask(line, self._loader.timeout)
        except ProgramEnded:
            if not (is_first and self._is_kept):
                raise
            # It was ending after its last scenario, which does not show before its end. It knows nothing of this one.
            self._program = Program(self._loader.command)
            answer = self._program.ask(line, self._loader.timeout)
        action = action_of(answer)
        self._is_asked = False
        return action

    def close(self) -> None:
        """Print the program's stderr; then end it, or keep it for the next run if it has answered everything."""
        try:
            sys.stderr.write(self._program.new_output())
        finally:
            if self._is_asked:
                self._program.kill()
            if self._loader.keep and not self._is_asked:
                _idle(self._loader).append(self._program)
            else:
                self._program.end()


def line_of(observation: Any, *, reset: bool) -> bytes:
    """Format an observation as a line of JSON; ``reset`` is True for the first observation of a run."""
    values: dict[str, Any] = {"reset": reset}
    if isinstance(observation, Observation):
        values |= {name: getattr(observation, name) for name in SEEN}
        values["ego"] = observation.ego._asdict()
        values["others"] = [other._asdict() for other in observation.others]
        values["crossing"] = [
            {**each._asdict(), "zone": asdict(replace(each.zone, line=()))} for each in observation.crossing
        ]
    else:
        values["observation"] = observation
    return json.dumps(values, default=lambda array: array.tolist()).encode() + b"\n"


def action_of(line: bytes) -> Any:
    """Return the action in a program's answer: a pair in SI units, a ``Drive``, or an environment's own action.

    Raises:
        BadAction: if the line is none of these.
    """
    answer = None
    with suppress(ValueError, RecursionError):  # not JSON, not text, 5000 digits, or 100,000 brackets
        answer = json.loads(line, object_pairs_hook=_without_repetition)
    # An echoed observation also has the keys acceleration and steering, so this check must be first.
    if isinstance(answer, dict) and "reset" in answer:
        again = shown(line.decode("utf-8", "replace"))
        raise BadAction(f"expected a decision, as an object without the key reset, received an observation: {again}")
    if isinstance(answer, dict) and "action" in answer:
        return answer["action"]
    if isinstance(answer, dict) and "lane" in answer:
        return Drive(**{field.name: answer[field.name] for field in fields(Drive) if field.name in answer})
    if isinstance(answer, dict) and answer.keys() >= {"acceleration", "steering"}:
        return answer["acceleration"], answer["steering"]
    raise BadAction(
        "expected a line of JSON with the keys acceleration and steering, or lane and speed, or lane and acceleration, "
        f"or, in a pafot.World, action, received {shown(line.decode('utf-8', 'replace'))}"
    )


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse an object with a repeated key, because libraries differ in which value they use."""
    values = dict(pairs)
    if len(values) < len(pairs):
        raise ValueError("a key is repeated")
    return values


class Program:
    """A running program, which ends when it is no longer needed, or when this process ends.

    The program leads a process group. The whole group is killed once the program has ended, even if it ended by itself:
    processes that it leaves running would keep the pipes open and the machine busy.

    Raises:
        AdsFactoryError: if the program cannot be started.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._name = os.path.basename(command[0])  # noqa: PTH119  (the name may be any text)
        self._buffer = bytearray()
        self._words = bytearray()
        self._left_out = 0
        try:
            self._process = subprocess.Popen(  # noqa: S603  (the user's own program)
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                process_group=0,
            )
        except OSError as error:
            received = f"{list(command)} ({error.strerror})"
            raise refused("a program that can be started", received, "correct the path, or build it first") from None
        self._to, self._from, self._errors = (
            pipe.fileno() for pipe in (self._process.stdin, self._process.stdout, self._process.stderr) if pipe
        )
        self._sources = [self._from, self._errors]
        self.end = Finalize(self, _end, (self._process,), exitpriority=0)
        """A function that ends the program; only its first call has an effect.

        It is also called when this object is garbage-collected, and when this process ends normally. Unlike a
        ``weakref`` finalizer, it is called in worker processes, too, but not in a fork for the programs of the parent.
        """

    @property
    def is_ready(self) -> bool:
        """True if the program waits for a line: it has not ended, and has written nothing since its last answer."""
        with suppress(ProgramEnded, BadAction):
            self._hear(0.0)
            return not self._buffer
        return False

    def kill(self) -> None:
        """Kill the program at once, with all processes of its group."""
        _kill(self._process)

    def ask(self, line: bytes, timeout: float | None) -> bytes:
        """Send a line to the program and return the line that it answers.

        Args:
            line: the line, including its newline.
            timeout: longest time for the whole answer [s]; None for no limit.

        Raises:
            ProgramEnded: if the program ends before it has answered.
            ProgramTimeout: if the answer takes longer than ``timeout``.
            BadAction: if the program writes more than one line, or a line that is too long.
        """
        pending, started = memoryview(line), monotonic()
        self._hear(0.0)
        while b"\n" not in self._buffer or pending:
            if self._buffer and len(pending) == len(line):
                raise _more(self._line())
            if timeout is not None and monotonic() - started > timeout:
                raise ProgramTimeout(f"{self._name} did not answer within {timeout:g} s")
            if self._hear(SLICE, is_asking=bool(pending)):
                try:  # a pipe takes up to PIPE_BUF bytes completely or not at all
                    pending = pending[os.write(self._to, pending[: select.PIPE_BUF]) :]
                except BrokenPipeError:
                    self._gone("input")
        answer = self._line()
        if self._buffer:
            raise _more(self._line())
        return answer

    def _hear(self, seconds: float, *, is_asking: bool = False) -> bool:
        """Wait up to ``seconds`` for output, and read it; return whether the program accepts more of its input line.

        The program's stderr is read as well, because a program that fills its stderr pipe would stop answering.
        """
        pipes = select.poll()  # select.select refuses descriptors from 1024 on
        for source in self._sources:
            pipes.register(source, select.POLLIN)
        if is_asking:
            pipes.register(self._to, select.POLLOUT)
        ready = {descriptor for descriptor, _ in pipes.poll(1000.0 * seconds)}
        if self._errors in ready:
            self._read_words()
        if self._from in ready:
            self._read()
        elif self._to in ready:
            return True
        elif _has_ended(self._process, 0.0) and self._from not in {descriptor for descriptor, _ in pipes.poll(0)}:
            self._gone()  # A process that the program has started may keep the pipe open.
        return False

    def _read(self) -> None:
        part = os.read(self._from, CHUNK)
        if not part:
            self._gone()
        self._buffer += part
        if len(self._buffer) > LONGEST_LINE:
            begins = shown(bytes(self._buffer[:80]))
            raise BadAction(f"expected a line of at most {LONGEST_LINE} bytes, received one that begins with {begins}")

    def _read_words(self) -> None:
        """Read from the program's stderr, of which only the beginning and the end are stored, to save memory."""
        part = os.read(self._errors, CHUNK)
        if not part:
            self._sources.remove(self._errors)
        self._words += part
        middle = max(0, len(self._words) - 2 * WORDS)
        del self._words[WORDS : WORDS + middle]
        self._left_out += middle

    def _line(self) -> bytes:
        line, _, rest = bytes(self._buffer).partition(b"\n")
        self._buffer[:] = rest
        return line

    def _gone(self, closed: str = "output") -> NoReturn:
        """Raise the error of a program that has closed its input or output, and so has ended or soon will."""
        _has_ended(self._process, GRACE)
        code = self._process.returncode
        how = f"closed its {closed}" if code is None else f"ended with exit code {code}"
        if code is not None and code < 0:
            how = f"was ended by signal {-code}, {signal.strsignal(-code)},"
        # The text is part of the signature of saved findings: other words would make known failures new ones.
        error = ProgramEnded(f"{self._name} {how} in the place of an answer")
        self._read_rest()
        if self._words:
            words = self._words[-LAST_WORDS:].decode("utf-8", "replace")
            error.add_note(f"the end of its stderr:\n{words}")
        raise error

    def _read_rest(self) -> None:
        """Read the rest of stderr, up to a limit, because a program may fill the pipe faster than it is read."""
        for _ in range(LONGEST_LINE // CHUNK):
            pipe = select.poll()
            pipe.register(self._errors, select.POLLIN)
            if self._errors not in self._sources or not pipe.poll(0):
                return
            self._read_words()

    def new_output(self) -> str:
        """Return what the program wrote to stderr since the last call; a long text loses its middle."""
        self._read_rest()
        words, left_out = bytes(self._words), self._left_out
        self._words.clear()
        self._left_out = 0
        if left_out:
            note = f"\n[... {left_out} bytes that {self._name} wrote to stderr are left out ...]\n"
            words = words[:WORDS] + note.encode() + words[WORDS:]
        return words.decode("utf-8", "replace")


def _more(line: bytes) -> BadAction:
    return BadAction(
        f"expected one line for each observation, received another: {shown(line)}; messages belong to stderr"
    )


def _has_ended(process: subprocess.Popen[bytes], seconds: float) -> bool:
    """Return whether a program ends within ``seconds``; if it has ended, the rest of its process group is killed.

    The group is killed at once, because the system may reuse the number of the group as soon as the group is empty.
    """
    if process.returncode is None:
        with suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
            _kill_group(process)
    return process.returncode is not None


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a program with its process group, unless it has ended."""
    if process.returncode is None:
        _kill_group(process)
        process.wait()


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError, PermissionError):  # no process is left, or it runs as a different user
        os.killpg(process.pid, signal.SIGKILL)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Close a program's input and output, and kill the program if it does not end within one second."""
    pipes: Any = (process.stdin, process.stdout, process.stderr)
    *both, errors = pipes
    for pipe in both:
        pipe.close()
    words, until = select.poll(), monotonic() + GRACE
    words.register(errors, select.POLLIN)
    try:
        while not _has_ended(process, 0.0) and (left := until - monotonic()) > 0.0:
            # Continue to read stderr, because its last words must neither block nor kill it.
            if words.poll(1000.0 * min(left, SLICE / 10)) and not os.read(errors.fileno(), CHUNK):
                _has_ended(process, left)
                break
    finally:  # also if the user interrupts this
        _kill(process)
        errors.close()
