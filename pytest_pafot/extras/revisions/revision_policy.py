"""The policy of another revision of the user's repository, which drives in a process of its own.

The process imports from a copy of that revision. It makes whole runs on request, so it may drive a policy of any kind.
Requests and answers are pickled values between our own processes.
"""

from __future__ import annotations

import math
import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from pytest_pafot import Scenario, ScenarioError, Trace, WorldError
from pytest_pafot.extending import DrivesElsewhere, ProcessLostError, Requests, rollout_of
from pytest_pafot.support.errors import AdsFactoryError, RevisionError
from pytest_pafot.support.text import one_line, visible

T = TypeVar("T")

LONGEST_BUILD = 300.0
"""The longest time for the imports and the fixtures of a revision [s]."""
FAREWELL = 2.0
"""The time for the end of a process that does not answer [s]."""
LONGEST_END = 10.0
"""The longest time for the end of a process, which tears down the fixtures of its test [s]."""
MISSING = ("FileNotFoundError", "ImportError", "ModuleNotFoundError")
"""The exceptions of a policy that lacks a file, such as one that git ignores."""
PACKAGE = Path(__file__).parents[1]
"""The folder of the running pytest_pafot, which the process imports as well, whatever the revision contains."""
BOOT = "import sys; sys.path.insert(0, sys.argv[1]); from {program} import main; main(int(sys.argv[2]))"


@dataclass(frozen=True, slots=True, kw_only=True)
class RevisionPolicy(DrivesElsewhere):
    """A policy of a revision, in place of a factory. Each process that uses it starts its own process for it.

    Attributes:
        label: the name of the revision and its commit, for texts.
        commit: the hash of the commit.
        root, tree: the repository of the user, and the copy of the revision.
        folder: the current folder of the user, relative to the repository.
        program: the module whose ``main`` is the process.
        name: the policy: ``module:factory[:argument]``, or the name of a test in its file.
        session: the arguments of the pytest session that sets up the fixtures of the test; empty without a test.
        copy: the option that names files to copy, for texts.
    """

    label: str
    commit: str
    root: Path
    tree: Path
    folder: Path
    program: str
    name: str
    session: tuple[str, ...] = ()
    copy: str

    @property
    def hint(self) -> str:
        """The likely way out if the policy cannot be used."""
        return f"files that git ignores or that Git LFS stores, such as weights, need {self.copy}"

    def driven(self, method: str, world: Any, scenario: Scenario) -> Trace:
        """See :meth:`DrivesElsewhere.driven`."""
        return self.call(rolled, method, world, scenario)

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """Return ``function(built, *arguments)`` as the process computes it; ``built.factory`` is the factory there.

        Raises:
            RevisionError: if the process cannot be started, or the policy cannot be built there.
            ProcessLostError: if the process dies or hangs; it names the last of the arguments.
            Exception: what the function raises.
        """
        return _process(self, os.getpid()).call(function, arguments)

    def start(self) -> str:
        """Start the process, if there is none. Return ``module:name`` of the factory there; empty if it has none.

        Raises:
            RevisionError: if the process cannot be started, or the policy cannot be built there.
        """
        return _process(self, os.getpid()).start()

    def close(self) -> None:
        """End the process of this policy, if there is one."""
        _process(self, os.getpid()).close()


def rolled(built: Any, method: str, world: Any, scenario: Scenario) -> Trace:
    """Run a scenario by a method of the world, in the process of a revision.

    Raises:
        RevisionError: if the policy did not find a file or a module, which says nothing about how it drives.
    """
    trace: Trace = rollout_of(world, method)(scenario, built.factory)
    if trace.error is not None and trace.error.kind in MISSING:
        policy: RevisionPolicy = built.policy
        text = f"{trace.error.kind}: {trace.error.message}".replace(f"{policy.tree}{os.sep}", "")
        raise RevisionError(f"{policy.label}: expected a policy that drives, received {text} in a run; {policy.hint}")
    return trace


def in_copy(text: str, root: Path, tree: Path) -> str:
    """Return the value of a variable, in which paths of the repository ``root`` are those of its copy, if it has them.

    A value is a path, a list of paths, or words of which some are paths.
    """
    here = Path(os.path.realpath(text)) if Path(text).is_absolute() else Path()
    if here.is_relative_to(root) and not here.is_relative_to(os.path.realpath(sys.prefix)):
        copy = tree / here.relative_to(root)
        if copy.exists():
            return str(copy)
    mark = next((each for each in (os.pathsep, " ", "=") if each in text), "")
    return mark.join(in_copy(each, root, tree) for each in text.split(mark)) if mark else text


def mapped(entries: Iterable[str], root: Path, tree: Path) -> list[str]:
    """Return folders of imports, in which those of the repository ``root`` are replaced by those of its copy."""
    folders = []
    for entry in entries:
        here = Path(os.path.realpath(entry or os.curdir))
        is_own = here.is_relative_to(root) and not here.is_relative_to(os.path.realpath(sys.prefix))
        folders.append(str(tree / here.relative_to(root)) if is_own else str(entry))
    return folders


@cache
def _process(policy: RevisionPolicy, pid: int) -> _Process:
    """Return this process's connection to the process of a policy. A forked process (another ``pid``) has its own."""
    return _Process(policy)


@dataclass(eq=False)
class _Process:
    """A process with the policy of a revision, started by the first call, and again after it died."""

    policy: RevisionPolicy
    _popen: subprocess.Popen[bytes] | None = field(default=None, init=False)
    _requests: Requests = field(init=False)
    _factory: str = field(default="", init=False)
    _log: Any = field(init=False)  # what the process prints, which must not reach the connection
    _last_words: str = field(default="", init=False)  # the last line that an ended process has printed

    def start(self) -> str:
        if self._popen is not None:
            return self._factory
        policy, above = self.policy, os.environ.get("PYTHONPATH", "")
        if not hasattr(socket, "AF_UNIX"):
            raise RevisionError(f"{policy.label}: expected a system with Unix sockets, received {sys.platform}")
        own, other = socket.socketpair()
        self._requests = Requests(Connection(own.detach()))
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  (closed with the process)
        (policy.tree / policy.folder).mkdir(parents=True, exist_ok=True)
        with other:
            # In its own group, so that Ctrl-C leaves it to this process, which ends it with all that it has started.
            self._popen = subprocess.Popen(  # noqa: S603  (no shell)
                [sys.executable, "-c", BOOT.format(program=policy.program), str(PACKAGE.parent), str(other.fileno())],
                cwd=policy.tree / policy.folder,
                env={
                    **{name: in_copy(value, policy.root, policy.tree) for name, value in os.environ.items()},
                    "PYTHONPATH": os.pathsep.join(self._mapped(above.split(os.pathsep) if above else [])),
                    "PYTHONDONTWRITEBYTECODE": "1",
                },
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=subprocess.STDOUT,
                pass_fds=[other.fileno()],
                start_new_session=True,
            )
        try:
            said = self._ask(pickle.dumps((policy, self._mapped(sys.path))), None, LONGEST_BUILD)
        except ProcessLostError as error:
            why = f"{error.how}{self._last_words and f' ({self._last_words})'}"
            raise RevisionError(f"{policy.label}: expected a process with its policy, received {why}") from None
        if isinstance(said, RevisionError):
            self.close()
            raise said
        self._factory = said
        return self._factory

    def call(self, function: Callable[..., T], arguments: tuple[Any, ...]) -> T:
        self.start()
        label = self.policy.label
        try:
            request = pickle.dumps((function, arguments))
        except Exception as error:  # noqa: BLE001  (pickling the user's objects may raise anything)
            raise RevisionError(
                f"{label}: expected a world that can be sent to the process of this revision, received one that raises "
                f"{type(error).__name__}: {error}; define its class in a module"
            ) from None
        said = self._ask(request, arguments[-1] if arguments else function)
        if not isinstance(said, Exception):
            result: T = said
            return result
        if isinstance(said, AdsFactoryError | WorldError | ScenarioError | RevisionError):
            raise said
        text = one_line(visible(f"{type(said).__name__}: {said}".replace(f"{self.policy.tree}{os.sep}", "")))
        raise RevisionError(f"{label}: expected a policy that drives, received {text}; {self.policy.hint}")

    def _ask(self, request: bytes, task: object, limit: float = math.inf) -> Any:
        """Return the answer to a request; without one, end the process, so that the next call starts another."""
        popen = self._popen
        assert popen is not None  # noqa: S101  (for type checkers: it was started)
        try:
            return self._requests.ask(request, popen, limit)
        except BaseException as error:  # also an interrupt: its answer would be taken for that of the next call
            is_lost = isinstance(error, EOFError | OSError)
            self.close(FAREWELL if is_lost else 0.0)
            if not is_lost:
                raise
            is_hang, how = popen.returncode == Requests.STUCK, popen.returncode
            if isinstance(error, TimeoutError):
                how = f"no answer within {limit:g} s"
            elif is_hang:
                how = "hung, ignored every interrupt and was ended"
            raise ProcessLostError(task, pid=popen.pid, how=how, is_hang=is_hang) from None

    def _mapped(self, entries: Iterable[str]) -> list[str]:
        return mapped(entries, self.policy.root, self.policy.tree)

    def close(self, patience: float = LONGEST_END) -> None:
        """End the process, if there is one. It has some time to tear its fixtures down and to end by itself [s]."""
        popen, self._popen = self._popen, None
        if popen is None:
            return
        self._requests.connection.close()  # The process ends at the end of its requests.
        with suppress(subprocess.TimeoutExpired):
            popen.wait(patience)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(popen.pid, signal.SIGKILL)  # Also what the policy has started, even if it has ended itself.
        popen.wait()
        with self._log as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - 4000))
            lines = [line for line in log.read().decode("utf-8", "replace").splitlines() if line.strip()]
        self._last_words = one_line(visible(lines[-1].strip())) if lines else ""
