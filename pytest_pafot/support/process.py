"""The process that runs: how it ends in order, what tests replace in it, and the versions and cores that it has."""

from __future__ import annotations

import atexit
import ctypes
import os
import pathlib
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module, metadata
from os import getpid
from pathlib import Path, PurePosixPath
from types import FrameType
from typing import Any

from pytest_pafot.support import monotonic

ENDS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""The signals that end a process without giving it time, unless it handles them."""
AGAIN_SECONDS = 0.05
"""The time after which an interrupt that Python could not raise comes again [s]."""
PATIENCE = 2.0
"""The time for which :func:`postponed` lets its context go on after an interrupt, unless there is another, and
:func:`exit_soon` the threads and exit functions of others [s]."""


class Ended(KeyboardInterrupt):
    """One of :data:`ENDS`, as an interrupt. ``code`` is the exit code that a shell reports for its ``number``."""

    def __init__(self, number: int) -> None:
        super().__init__(f"received {signal.Signals(number).name}")
        self.number, self.code = number, 128 + number


@contextmanager
def interrupted_by_signals(note: Callable[[KeyboardInterrupt], None] = lambda interrupt: None) -> Iterator[None]:
    """Let the first of :data:`ENDS` raise :class:`Ended` in the main thread; further ones have no effect.

    ``note`` receives each interrupt, also one by Ctrl-C, before it is raised, because the user's code may catch it.

    A signal that the user's code handles, or that is ignored as by ``nohup``, is left alone. Python drops what
    a handler raises while a finalizer or the callback of a weak reference runs; such an interrupt comes again shortly.
    """
    owner, ended, told = getpid(), False, sys.unraisablehook

    def received(number: int, _: object) -> None:
        nonlocal ended
        if not ended:
            ended = True
            note(error := Ended(number))
            raise error

    def pressed(number: int, frame: FrameType | None) -> None:
        if getpid() == owner:
            note(error := KeyboardInterrupt())
            raise error
        signal.default_int_handler(number, frame)

    def unraisable(lost: sys.UnraisableHookArgs) -> None:
        nonlocal ended
        if not isinstance(lost.exc_value, KeyboardInterrupt) or getpid() != owner:
            told(lost)
            return
        ended, number = False, lost.exc_value.number if isinstance(lost.exc_value, Ended) else signal.SIGINT
        threading.Timer(AGAIN_SECONDS, os.kill, (owner, number)).start()

    is_main = threading.current_thread() is threading.main_thread()
    mine = [number for number in ENDS if is_main and signal.getsignal(number) == signal.SIG_DFL]
    handlers: dict[int, Callable[[int, FrameType | None], None]] = dict.fromkeys(mine, received)
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        handlers[signal.SIGINT] = pressed
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    if is_main:
        sys.unraisablehook = unraisable
    try:
        yield
    finally:
        if sys.unraisablehook is unraisable:
            sys.unraisablehook = told
        for number, handler in handlers.items():
            if signal.getsignal(number) is handler:  # The user's code may handle it since.
                signal.signal(number, before[number])


@contextmanager
def postponed() -> Iterator[None]:
    """Let an interrupt that comes in this context be raised at its end, so that what it does is not left half done.

    Another interrupt after :data:`PATIENCE` is raised at once, as what the context waits for may never come.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *ENDS)}
    came: list[tuple[int, float]] = []

    def received(number: int, frame: FrameType | None) -> None:
        handler = before[number]
        if came and monotonic() - came[0][1] > PATIENCE and callable(handler):
            handler(number, frame)
        came.append((number, monotonic()))

    mine = [number for number, handler in before.items() if callable(handler) or handler == signal.SIG_DFL]
    for number in mine:  # those that are ignored, as by ``nohup``, stay so
        signal.signal(number, received)
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, before[number])
        for number, _ in came[:1]:
            signal.raise_signal(number)


def _let_forks_end() -> None:
    """Let a process that Python forks end by :data:`ENDS` as it would without a handler of this module.

    Python drops a signal that has a handler and comes before the fork is complete. ``multiprocessing.Pool``, which ends
    its processes by SIGTERM, would now and then wait for one forever. So the signal is blocked until then.
    """
    masks: dict[int, set[int]] = {}  # by thread

    def before() -> None:
        masks[threading.get_ident()] = signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)

    def after() -> None:
        signal.pthread_sigmask(signal.SIG_SETMASK, masks.pop(threading.get_ident()))

    def in_child() -> None:
        for number in ENDS:
            if getattr(signal.getsignal(number), "__module__", "") == __name__:
                signal.signal(number, signal.SIG_DFL)
        after()

    os.register_at_fork(before=before, after_in_parent=after, after_in_child=in_child)


if hasattr(os, "register_at_fork"):
    _let_forks_end()


def bound_to(parent: int, number: int) -> bool:
    """Let Linux send this process a signal as soon as its parent has ended, however it ends; return False elsewhere.

    Linux sends it when the *thread* ends that has started this process, so call this only if that was a main thread.
    """
    if sys.platform != "linux" or ctypes.pythonapi.prctl(1, number) != 0:  # PR_SET_PDEATHSIG
        return False
    if os.getppid() != parent:  # it has ended before that
        os.kill(getpid(), number)
    return True


def exit_soon(code: int) -> None:
    """Let this process end soon after Python has begun to exit, although threads or exit functions would keep it."""

    def end() -> None:
        last = threading.Timer(PATIENCE, os._exit, (code,))
        last.daemon = True
        last.start()
        print(end="", flush=True)
        atexit._run_exitfuncs()  # Python would wait for threads before

    # Python calls it before it waits for threads; there is no public function for that.
    threading._register_atexit(end)  # type: ignore[attr-defined]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore Ctrl-C and :data:`ENDS` in this context, which cleans up; so do the programs that it starts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, *ENDS)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


NAME = "receipt"
"""The name of the file, in a temporary folder of the process that waits for it."""


def leave_receipt(folder: str, code: int) -> None:
    """Say that the command of this process has ended with an exit code."""
    (Path(folder) / NAME).write_text(str(code), encoding="ascii")


def taken_receipt(folder: str, left: int) -> int | None:
    """Return the exit code of the command of a process, and remove its receipt; None if it left none.

    ``left`` is the exit code of the process. It counts if the command ended well, and the process then did not.
    """
    file = Path(folder) / NAME
    try:
        code = int(file.read_text(encoding="ascii"))
        file.unlink()
    except (OSError, ValueError):
        return None
    return code or ended_with(left)


def ended_with(left: int) -> int:
    """Return the exit code that a shell reports for a process, which is negative for a signal."""
    return left if left >= 0 else 128 - left


def unfinished(code: int) -> str:
    """Return the message about a process that has ended without a receipt."""
    received = f"exit code {code} before that"
    likely = "unless an error above says why, the policy, its factory or its module ends the process, as sys.exit and "
    likely += "os._exit do: let it raise an error"
    if code < 0:
        names = {int(number): number.name for number in signal.Signals}
        received = f"an end by {names.get(-code, f'signal {-code}')}"
        likely = "likely compiled code of the policy crashed: `python -X faulthandler -m pytest_pafot ...` says where"
    if code == -getattr(signal, "SIGKILL", 0):
        likely = "likely the memory ran out, or somebody ended it: free memory, and run the command again"
    return f"expected the process that drives to finish the command, received {received}; {likely}"


_NAMES = "builtins io json multiprocessing os os.path pathlib secrets shutil signal subprocess tempfile time"
_OWN = [
    (owner, name, value)
    for owner in (*map(import_module, _NAMES.split()), pathlib.PurePath, pathlib.Path)
    for name, value in vars(owner).items()
    if name in ("__import__", "environ") or (name[:2] != "__" and (callable(value) or isinstance(value, classmethod)))
]


class _Replaced:
    """The replaced functions of this process. They are in their places, unless this package works."""

    def __init__(self) -> None:
        self._back: list[Callable[[], object]] = []  # puts them back, the last first; empty if none is put aside

    @contextmanager
    def shown(self, is_shown: bool) -> Iterator[None]:
        """Put aside in this context what is replaced; or put it back, if it is put aside."""
        if bool(self._back) != is_shown:
            yield
            return
        (self._put_back if is_shown else self._put_aside)()
        try:
            yield
        finally:
            (self._put_aside if is_shown else self._put_back)()

    def _put_aside(self) -> None:
        own = [each for each in _OWN if vars(each[0]).get(each[1]) is not each[2]]
        replaced = [(owner, name, vars(owner).get(name)) for owner, name, _ in own]
        self._back += [lambda: _put(replaced)] if replaced else []
        # pyfakefs replaces functions in each module, and these in the modules that are imported meanwhile.
        faked = getattr(sys.modules.get("pyfakefs.fake_filesystem_unittest"), "Patcher", None)
        if faked is not None and faked.PATCHER is not None and faked.PATCHER.is_patching:
            faked.PATCHER.pause()
            self._back.append(faked.PATCHER.resume)
        _put(own)

    def _put_back(self) -> None:
        while self._back:
            self._back.pop()()


def _put(places: Iterable[tuple[Any, str, object]]) -> None:
    for owner, name, value in places:
        delattr(owner, name) if value is None else setattr(owner, name, value)


REPLACED = _Replaced()
"""Those of this process."""


PACKAGES = ("pytest-pafot", "highway-env", "numpy")

RULES = "verdict-rules"
RULES_VERSION = "3"
"""The version of the rules of docs/explanation/verdicts.md. It goes up with each change of a verdict."""


def installed_versions(others: Sequence[str] = ()) -> dict[str, str]:
    """Return the version of each package by its name, ``unknown`` if it has no installed metadata; and of the rules.

    Args:
        others: the names of other packages on which a run depends.
    """
    return {**{package: _version_of(package) for package in (*PACKAGES, *others)}, RULES: RULES_VERSION}


@cache  # A loaded package does not change, and reading its metadata takes as long as replaying a file.
def _version_of(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def cores(root: Path = Path("/")) -> int:
    """Return the number of cores that this process may use, at least one: by its affinity and its cgroup's quota.

    Args:
        root: the folder with ``proc`` and ``sys``.
    """
    counts = [len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1]
    for quota, *period in cpu_limits(root):  # [us] of all cores together in each period
        counts.append(-(-quota // (period or [100_000])[0]))  # rounded up; the kernel's default
    return min(counts)


def cpu_limits(root: Path) -> Iterator[list[int]]:
    """Yield the numbers in ``cpu.max`` of this process's cgroup and of those around it, where there is a limit.

    A container, a job of Slurm or a unit of systemd is a cgroup. Only version 2 is read, which Linux alone has.
    """
    # Where a container hides its own path, this is its root, and the file is directly in the mounted folder.
    groups = [PurePosixPath()]
    with suppress(OSError):
        lines = os.fsdecode((root / "proc/self/cgroup").read_bytes()).splitlines()
        own = [PurePosixPath(line.removeprefix("0::/")) for line in lines if line.startswith("0::/")]
        groups = [group for path in own for group in (path, *path.parents)] or groups
    for group in dict.fromkeys(groups):
        # The outermost cgroup of a machine has no limits, "max" is none, and a container may emulate the files badly.
        with suppress(OSError, ValueError):
            numbers = [int(word) for word in (root / "sys/fs/cgroup" / group / "cpu.max").read_text("ascii").split()]
            if numbers and min(numbers) > 0:
                yield numbers
