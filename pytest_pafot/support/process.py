"""Signals, exit codes, replaced functions, package versions and cores of this process."""

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

# Signals that end a process immediately unless it handles them.
ENDS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
# If Python could not raise an interrupt, it is repeated after this time [s].
AGAIN_SECONDS = 0.05
# After this time, a second interrupt ends the context of `postponed`, and `exit_soon` ends the process even if
# threads or exit functions are still running [s].
PATIENCE = 2.0


class Ended(KeyboardInterrupt):
    """An interrupt by a signal in :data:`ENDS`, with the signal's ``number`` and the exit ``code`` for a shell."""

    def __init__(self, number: int) -> None:
        super().__init__(f"received {signal.Signals(number).name}")
        self.number = number
        self.code = 128 + number


@contextmanager
def interrupted_by_signals(
    note: Callable[[KeyboardInterrupt], None] = lambda interrupt: None,
) -> Iterator[None]:
    """Raise :class:`Ended` in the main thread on the first signal in :data:`ENDS`, and ignore later signals.

    ``note`` receives each interrupt first, including Ctrl-C, because the user's code may catch it.
    """
    # Signals that the user's code handles, or that are ignored as by `nohup`, are left alone. Python drops an exception
    # that a handler raises during a finaliser or a weak reference's callback, so the interrupt is repeated soon after.
    owner = getpid()
    ended = False
    told = sys.unraisablehook

    def received(number: int, _: object) -> None:
        nonlocal ended
        if not ended:
            ended = True
            error = Ended(number)
            note(error)
            raise error

    def pressed(number: int, frame: FrameType | None) -> None:
        if getpid() == owner:
            error = KeyboardInterrupt()
            note(error)
            raise error
        signal.default_int_handler(number, frame)

    def unraisable(lost: sys.UnraisableHookArgs) -> None:
        nonlocal ended
        if not isinstance(lost.exc_value, KeyboardInterrupt) or getpid() != owner:
            told(lost)
            return
        ended = False
        number = getattr(lost.exc_value, "number", signal.SIGINT)
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
            if signal.getsignal(number) is handler:  # the user's code may have replaced it
                signal.signal(number, before[number])


@contextmanager
def postponed() -> Iterator[None]:
    """Postpone interrupts until the end of this context, so that its work is not left half done."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *ENDS)}
    came: list[tuple[int, float]] = []

    def received(number: int, frame: FrameType | None) -> None:
        handler = before[number]
        # The context may wait for something that never happens, so a later interrupt is handled immediately.
        if came and monotonic() - came[0][1] > PATIENCE and callable(handler):
            handler(number, frame)
        came.append((number, monotonic()))

    mine = []
    for number, handler in before.items():
        if callable(handler) or handler == signal.SIG_DFL:
            mine.append(number)
            signal.signal(number, received)
    # Other signals, such as those ignored by `nohup`, stay ignored.
    try:
        yield
    finally:
        for number in mine:
            signal.signal(number, before[number])
        if came:
            signal.raise_signal(came[0][0])


def _let_forks_end() -> None:
    # A signal in ENDS should end a forked process, as if this module had no handler. But Python drops a signal that has
    # a handler and arrives before the fork is complete. `multiprocessing.Pool` ends its processes by SIGTERM, and would
    # sometimes wait for one forever. So the signal is blocked until then.
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
    """Make Linux send this process a signal when its parent ends, or return False on other systems."""
    # Linux sends the signal when the thread that started this process ends, so the parent must use its main thread.
    if sys.platform != "linux" or ctypes.pythonapi.prctl(1, number) != 0:  # PR_SET_PDEATHSIG
        return False
    if os.getppid() != parent:  # it ended before that call
        os.kill(getpid(), number)
    return True


def exit_soon(code: int) -> None:
    """End this process soon after Python starts to exit, even if threads or exit functions are still running."""

    def end() -> None:
        last = threading.Timer(PATIENCE, os._exit, (code,))
        last.daemon = True
        last.start()
        print(end="", flush=True)
        atexit._run_exitfuncs()  # before Python waits for threads

    # Python calls `end` before it waits for threads. There is no public function for that.
    threading._register_atexit(end)  # type: ignore[attr-defined]


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore Ctrl-C and :data:`ENDS` in this context, and in programs started in it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, *ENDS)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# The name of the receipt, which is in a temporary folder of the process that waits for it.
NAME = "receipt"


def leave_receipt(folder: str, code: int) -> None:
    """Record that the command in this process finished with an exit code."""
    (Path(folder) / NAME).write_text(str(code), encoding="ascii")


def taken_receipt(folder: str, left: int) -> int | None:
    """Remove a receipt and return its exit code, or None if there is no receipt.

    If the exit code is 0, return the process's own exit code, ``left``.
    """
    file = Path(folder) / NAME
    try:
        code = int(file.read_text(encoding="ascii"))
        file.unlink()
    except (OSError, ValueError):
        return None
    return code or ended_with(left)


def ended_with(left: int) -> int:
    """Convert an exit code, which is negative for a signal, to the code that a shell reports."""
    if left < 0:
        return 128 - left
    return left


def unfinished(code: int) -> str:
    """Return the message about a process that ended without a receipt."""
    received = f"an early exit with code {code}"
    likely = "Unless an error above explains it, the policy, its factory or its module ended the process, for example "
    likely += "with sys.exit or os._exit. Raise an error instead"
    if code < 0:
        names = {int(number): number.name for number in signal.Signals}
        received = f"the signal {names.get(-code, -code)}"
        likely = "Did compiled code of the policy crash? `python -X faulthandler -m pytest_pafot ...` shows where"
    if code == -getattr(signal, "SIGKILL", 0):
        likely = (
            "Did the memory run out, or did someone kill it? Free memory, and run the command again"
        )
    return (
        f"expected the process with the policy to finish the command, received {received}. {likely}"
    )


_NAMES = "builtins io json multiprocessing os os.path pathlib secrets shutil signal subprocess tempfile time"
_OWN = [
    (owner, name, value)
    for owner in (*map(import_module, _NAMES.split()), pathlib.PurePath, pathlib.Path)
    for name, value in vars(owner).items()
    if name in ("__import__", "environ")
    or (name[:2] != "__" and (callable(value) or isinstance(value, classmethod)))
]


class _Replaced:
    """The functions of this process that tests have replaced."""

    def __init__(self) -> None:
        # functions that restore the replacements, the last first
        self._back: list[Callable[[], object]] = []

    @contextmanager
    def shown(self, is_shown: bool) -> Iterator[None]:
        """Use the replacements in this context if ``is_shown``, otherwise the original functions."""
        if bool(self._back) != is_shown:
            yield
            return
        enter = self._put_aside
        leave = self._put_back
        if is_shown:
            enter, leave = leave, enter
        enter()
        try:
            yield
        finally:
            leave()

    def _put_aside(self) -> None:
        own = []
        replaced = []
        for owner, name, value in _OWN:
            now = vars(owner).get(name)
            if now is not value:
                own.append((owner, name, value))
                replaced.append((owner, name, now))
        if own:
            self._back.append(lambda: _put(replaced))
        # pyfakefs replaces functions in every module, also in modules that are imported in the meantime.
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
        if value is None:
            delattr(owner, name)
        else:
            setattr(owner, name, value)


REPLACED = _Replaced()


PACKAGES = ("pytest-pafot", "highway-env", "numpy")

RULES = "verdict-rules"
# The version of the rules in docs/explanation/verdicts.md. It increases if a change affects verdicts.
RULES_VERSION = "3"


def installed_versions(others: Sequence[str] = ()) -> dict[str, str]:
    """Return the versions of the verdict rules and of the packages on which a run depends."""
    versions = {package: _version_of(package) for package in (*PACKAGES, *others)}
    return versions | {RULES: RULES_VERSION}


# A loaded package does not change, and reading its metadata takes as long as replaying a file.
@cache
def _version_of(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def cores(root: Path = Path("/")) -> int:
    """Return the number of cores that this process may use. ``root`` is the folder with ``proc`` and ``sys``."""
    counts = [os.cpu_count() or 1]
    if hasattr(os, "sched_getaffinity"):
        counts = [len(os.sched_getaffinity(0))]
    for quota, *period in cpu_limits(root):  # CPU time [us] of all cores together in each period
        # rounded up; 100 ms is the kernel's default
        counts.append(-(-quota // (period or [100_000])[0]))
    return min(counts)


def cpu_limits(root: Path) -> Iterator[list[int]]:
    """Yield the numbers in each ``cpu.max`` file that limits this process's cgroup or a parent cgroup."""
    groups: list[PurePosixPath] = []
    with suppress(OSError):
        content = (root / "proc/self/cgroup").read_bytes()
        for line in os.fsdecode(content).splitlines():
            if line.startswith("0::/"):
                own = PurePosixPath(line.removeprefix("0::/"))
                groups += (own, *own.parents)
    # If a container hides its own path, the root is the cgroup, and the file is directly in the mounted folder.
    for group in dict.fromkeys(groups or [PurePosixPath()]):
        # The outermost cgroup has no file, "max" means no limit, and a container may emulate the files badly.
        with suppress(OSError, ValueError):
            words = (root / "sys/fs/cgroup" / group / "cpu.max").read_text("ascii").split()
            numbers = [*map(int, words)]
            if numbers and min(numbers) > 0:
                yield numbers
