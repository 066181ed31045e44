"""A planner that is a program of its own: one line of JSON in, one out, whatever language it is written in."""

from __future__ import annotations

import functools
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, NoReturn

from pytest_pafot.policies.loading import digest_of, refused
from pytest_pafot.world.kernel.action import BadAction, Drive, shown
from pytest_pafot.world.kernel.observation import Observation

SEEN = (
    *("time", "decision_period", "lanes", "lane_width", "speed_limit", "lane_centres", "road_length"),
    *("acceleration", "steering", "lateral_velocities", "ids", "ego", "others"),
)
"""Of a :class:`pytest_pafot.Observation`, the keys of a line in their order."""

LONGEST_LINE = 1 << 20
"""Of an answer [bytes]."""
LAST_WORDS = 2000
"""Characters of a program's stderr that the error of its end tells."""
GRACE = 1.0
"""How long a program may take to end once its input has ended [s]."""
SLICE = 0.2
"""Longest wait that nothing interrupts, where the hang limit cannot send a signal [s]."""


class ProgramEnded(Exception):  # noqa: N818  (named in findings as the fault it is)
    """The program ended where it should have answered."""


class ProgramTimeout(Exception):  # noqa: N818  (likewise)
    """The program did not answer in its time."""


@dataclass(frozen=True, kw_only=True)
class ProgramLoader:
    """See :func:`pytest_pafot.policies.process`."""

    command: tuple[str, ...]
    keep: bool = True
    timeout: float | None = None

    def __post_init__(self) -> None:
        if os.name != "posix":
            raise refused("a system with POSIX pipes for a planner that is a program", sys.platform, "run it elsewhere")
        if self.timeout is not None and not (isinstance(self.timeout, (int, float)) and self.timeout > 0):
            raise refused("a timeout above 0 [s], or None", repr(self.timeout), "give it seconds, such as timeout=5")

    @functools.cached_property
    def weights_digest(self) -> str:
        """Of the files that the command names, the program's own among them; empty where it names none."""
        files = [Path(word) for word in self.command if Path(word).is_file()]
        return digest_of(files) if files else ""

    def __call__(self) -> ProgramAds:
        """A fresh ADS, with a program that waits for a line, or a new one."""
        idle = _idle(self)
        while idle:
            program = idle.pop()
            if program.is_running:
                return ProgramAds(self, program)
        return ProgramAds(self, Program(self.command))


@functools.cache
def _idle_in(process: int, loader: ProgramLoader) -> list[Program]:
    """By process, since a forked one has the pipes of the other's programs and must not use them."""
    return []


def _idle(loader: ProgramLoader) -> list[Program]:
    """The programs of this process that wait for another run."""
    return _idle_in(os.getpid(), loader)


class ProgramAds:
    """Drives one run by a program."""

    def __init__(self, loader: ProgramLoader, program: Program) -> None:
        self._loader = loader
        self._program = program
        self._is_first = True
        self._is_asked = False

    def __call__(self, observation: Any) -> Any:
        """What the program answers to an observation."""
        line = line_of(observation, reset=self._is_first)
        self._is_first, self._is_asked = False, True
        action = action_of(self._program.ask(line, self._loader.timeout))
        self._is_asked = False
        return action

    def close(self) -> None:
        """Say what the program has said; it ends, or waits for the next run if it has answered everything."""
        sys.stderr.write(self._program.said())
        if self._is_asked:
            self._program.kill()
        if self._loader.keep and not self._is_asked:
            _idle(self._loader).append(self._program)
        else:
            self._program.end()


def line_of(observation: Any, *, reset: bool) -> bytes:
    """An observation as a line of JSON; ``reset`` says whether it is the first one of a run."""
    values: dict[str, Any] = {"reset": reset}
    if isinstance(observation, Observation):
        values |= {name: getattr(observation, name) for name in SEEN}
        values["ego"] = observation.ego._asdict()
        values["others"] = [other._asdict() for other in observation.others]
    else:
        values["observation"] = observation
    return json.dumps(values, default=lambda array: array.tolist()).encode() + b"\n"


def action_of(line: bytes) -> Any:
    """What an answer says: a pair in SI units, a :class:`pytest_pafot.Drive`, or an environment's own action.

    Raises:
        BadAction: where it says none of these.
    """
    answer = None
    with suppress(ValueError):
        answer = json.loads(line)
    if isinstance(answer, dict) and "reset" in answer:  # it has the acceleration and the steering of now
        again = shown(line.decode("utf-8", "replace"))
        raise BadAction(f"expected a decision, as an object without the key reset, received an observation: {again}")
    if isinstance(answer, dict) and "action" in answer:
        return answer["action"]
    if isinstance(answer, dict) and "lane" in answer:
        return Drive(lane=answer["lane"], speed=answer.get("speed"), acceleration=answer.get("acceleration"))
    if isinstance(answer, dict) and answer.keys() >= {"acceleration", "steering"}:
        return answer["acceleration"], answer["steering"]
    raise BadAction(
        "expected a line of JSON with the keys acceleration and steering, or lane and speed, or lane and acceleration, "
        f"or, in a pafot.World, action, received {shown(line.decode('utf-8', 'replace'))}"
    )


class Program:
    """A program under way, which ends when nobody needs it any more, or with this process.

    Raises:
        AdsFactoryError: when it cannot be started.
    """

    def __init__(self, command: Sequence[str]) -> None:
        self._name = os.path.basename(command[0])  # noqa: PTH119  (of any text)
        self._buffer = bytearray()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  (a pipe would have to be read all the time)
        self._heard = 0
        try:
            self._process = subprocess.Popen(  # noqa: S603  (the user's own program)
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                process_group=0,
            )
        except OSError as error:
            self._errors.close()
            received = f"{list(command)} ({error.strerror})"
            raise refused("a program that can be started", received, "correct the path, or build it first") from None
        self._to: Any = self._process.stdin
        self._from: Any = self._process.stdout
        self.end = Finalize(self, _end, (self._process, self._errors), exitpriority=0)
        """Ends the program, once; called by itself where this is forgotten, and when this process ends in order.

        Unlike a finalizer of ``weakref`` it is called in processes of the pool, too, and not in forked ones for others.
        """

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def kill(self) -> None:
        """End it at once, with all that it has started."""
        if self.is_running:
            os.killpg(self._process.pid, signal.SIGKILL)

    def ask(self, line: bytes, timeout: float | None) -> bytes:
        """The line that the program answers to a line.

        Args:
            line: with its end.
            timeout: until the whole answer is there [s]; None for any time.

        Raises:
            ProgramEnded: when it ends before that.
            ProgramTimeout: when it takes longer.
            BadAction: when it says more than one line, or a long one.
        """
        pending, started = memoryview(line), time.monotonic()
        if select.select([self._from], [], [], 0)[0]:
            self._read()
        while b"\n" not in self._buffer or pending:
            if self._buffer and len(pending) == len(line):
                raise _more(self._line())
            if timeout is not None and time.monotonic() - started > timeout:
                raise ProgramTimeout(f"{self._name} did not answer within {timeout:g} s")
            can_read, can_write, _ = select.select([self._from], [self._to] if pending else [], [], SLICE)
            if can_read:
                self._read()
            elif can_write:
                pending = pending[self._write(pending[: select.PIPE_BUF]) :]
        answer = self._line()
        if self._buffer:
            raise _more(self._line())
        return answer

    def _write(self, part: memoryview) -> int:
        """Of so much a pipe always takes all at once where it takes anything."""
        try:
            return os.write(self._to.fileno(), part)
        except BrokenPipeError:
            self._gone()

    def _read(self) -> None:
        part = os.read(self._from.fileno(), 1 << 16)
        if not part:
            self._gone()
        self._buffer += part
        if len(self._buffer) > LONGEST_LINE:
            begins = shown(bytes(self._buffer[:80]))
            raise BadAction(f"expected a line of at most {LONGEST_LINE} bytes, received one that begins with {begins}")

    def _line(self) -> bytes:
        line, _, rest = bytes(self._buffer).partition(b"\n")
        self._buffer[:] = rest
        return line

    def _gone(self) -> NoReturn:
        """The program has closed an end of its; it is over, or as good as that."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE)
        code = self._process.returncode
        how = "closed its output" if code is None else f"ended with exit code {code}"
        if code is not None and code < 0:
            how = f"was ended by signal {-code}, {signal.strsignal(-code)},"
        error = ProgramEnded(f"{self._name} {how} in the place of an answer")
        words = self.said(is_told=False)[-LAST_WORDS:]
        if words:
            error.add_note(f"the end of its stderr:\n{words}")
        raise error

    def said(self, *, is_told: bool = True) -> str:
        """What the program has written to its stderr since it was last told."""
        # Program and session share the file's position, which is the program's: neither reading at a place nor cutting
        # the file moves it. What was cut off is a hole.
        descriptor = self._errors.fileno()
        text = os.pread(descriptor, max(0, os.fstat(descriptor).st_size - self._heard), self._heard)
        if is_told:
            self._heard += len(text)
            os.ftruncate(descriptor, 0)
        return text.decode("utf-8", "replace")


def _more(line: bytes) -> BadAction:
    return BadAction(
        f"expected one line for each observation, received another: {shown(line)}; messages belong to stderr"
    )


def _end(process: subprocess.Popen[bytes], errors: Any) -> None:
    """Close a program's pipes, and kill what has not ended soon after."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
    try:
        process.wait(GRACE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    errors.close()
