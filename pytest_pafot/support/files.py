"""Files that are written as a whole or not at all, whoever else reads or writes them at that moment.

The content goes to a temporary file beside the path first. Its name has the process id and it is locked while it is
written, so that the next writer removes what a process that was killed left behind, and nothing else.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import stat
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO, TypeVar, cast

# Locks that say whether the process that wrote a file still lives; the system releases them however it ends.
#
# Process ids would not do alone: in containers each session may have the same one.

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_HELD = frozenset({errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK})
_LOCK_AT = 1 << 30  # beyond any content: Windows keeps others from reading the bytes that are locked


def hold(descriptor: int, *, is_inherited: bool = True) -> bool:
    """Lock a new file; False when another session looked at it before that, and so took it for a dead process's.

    Processes that are forked inherit the lock and keep it, also when this one has ended, unless they are not to. Then
    this process must open the file but once, as it loses the lock by closing it again.
    """
    try:
        _lock(descriptor) if is_inherited else _lock_here(descriptor)
    except OSError as error:
        return error.errno not in _HELD  # without locks on this file system, the process id in the name decides
    return os.fstat(descriptor).st_nlink > 0


def is_held(descriptor: int, pid: int) -> bool:
    """Whether the process that wrote a file still holds it; without locks on this file system, whether it lives."""
    try:
        _lock(descriptor)
    except OSError as error:
        return error.errno in _HELD or _is_alive(pid)
    return False


def pid_of(path: Path) -> int:
    """The process id that the name of a file begins with, after a dot and a word if there is one; 0 without."""
    digits = re.match(r"(?:\.[a-z]+-)?(\d{1,11})-", path.name, re.ASCII)
    return int(digits[1]) if digits else 0


def _is_alive(pid: int) -> bool:
    """Whether a process of this id runs; only asked where the file system has no locks.

    Windows has no harmless question of this kind (``os.kill(pid, 0)`` ends a process there), so that a file
    counts as held.
    """
    if sys.platform == "win32" or pid <= 0:
        return pid > 0
    try:
        os.kill(pid, 0)
    except OSError as error:
        return not isinstance(error, ProcessLookupError)  # another error is of a process that is somebody else's
    return True


if sys.platform == "win32":

    def _lock(descriptor: int) -> None:
        position = os.lseek(descriptor, 0, os.SEEK_CUR)
        os.lseek(descriptor, _LOCK_AT, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        finally:
            os.lseek(descriptor, position, os.SEEK_SET)

    _lock_here = _lock  # Nothing is forked there.

else:

    def _lock(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _lock_here(descriptor: int) -> None:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


T = TypeVar("T")

TEMPORARY = ".pafot-"
"""How the names of files begin that are being written."""

_WAYS_OUT: Mapping[int, str] = MappingProxyType(
    {
        errno.ENOSPC: "free some space on the disk, {}",
        errno.EDQUOT: "free some of your quota of the disk, {}",
        errno.EROFS: "the file system is read-only: mount it so that it can be written, {}",
        errno.ENAMETOOLONG: "shorten the names of the folders, of the test or of its parameters, {}",
        errno.ENOTDIR: "a file lies where a folder should be: rename or delete it, {}",
        errno.EEXIST: "a file lies where a folder should be: rename or delete it, {}",
        errno.EISDIR: "a folder of that name lies there: rename or delete it, {}",
        errno.ENOENT: "make the folder that it is to lie in, {}",
        errno.EINVAL: "a link or a special file is in its place: delete that, {}",
        errno.ELOOP: "a link on the way leads to itself: remove it, {}",
        errno.EMFILE: "close the files that the ADS and the tests open, or raise the limit of open files (ulimit -n)",
        errno.ENFILE: "close files that programs of this machine have open, or raise its limit of open files",
        errno.EIO: "the disk or the network has failed: look after it, {}",
    }
)
"""By the error, with a gap for another folder."""


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, with the folders that it lies in: whoever reads it finds all of it, or what was there before.

    Raises:
        OSError: when it cannot be written; nothing half written is left.
    """
    _through_temporary(path, content.encode() if isinstance(content, str) else content, Path.replace)


def write_if_free(path: Path, content: bytes) -> bool:
    """Write a new file as :func:`write_whole` does; False when the path is taken.

    Of two processes that try at once, the system chooses one.

    Raises:
        OSError: when it cannot be written; nothing half written is left.
    """
    return _through_temporary(path, content, _publish)


def way_out(error: OSError, elsewhere: str) -> str:
    """What to do when a file cannot be written; ``elsewhere`` says how to name another folder."""
    return _WAYS_OUT.get(error.errno or 0, "make the folder writable, {}").format(elsewhere)


def open_regular(path: Path, mode: str = "rb") -> BinaryIO:
    """Open a file in a binary mode, if it is a regular one: no link is followed, no pipe and no device is touched.

    Raises:
        OSError: when it is something else, or cannot be opened.
    """
    with contextlib.suppress(FileNotFoundError):  # a mode that makes the file goes on
        _check_regular(path, path.lstat())  # before it is opened, which alone has effects on some devices
    file = cast("BinaryIO", open(path, mode, opener=_open_in_place))  # noqa: SIM115  (the caller closes it)
    try:
        _check_regular(path, os.fstat(file.fileno()))  # it may be another one by now
    except OSError:
        file.close()
        raise
    return file


def remove_unfinished(folder: Path) -> None:
    """Remove what processes that were killed left half written; what a live one writes stays."""
    for path in folder.glob(f"{TEMPORARY}*.tmp"):
        with contextlib.suppress(OSError):  # what cannot be removed does no harm: nobody reads a file of its name
            with open_regular(path, "r+b") as file:
                if is_held(file.fileno(), pid_of(path)):
                    continue
                with contextlib.suppress(PermissionError):  # Windows removes no open file
                    path.unlink(missing_ok=True)  # while the lock is held, so that nobody begins to write it
            path.unlink(missing_ok=True)


def _check_regular(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        what = "a link" if stat.S_ISLNK(status.st_mode) else "a folder" if stat.S_ISDIR(status.st_mode) else ""
        raise OSError(errno.EINVAL, what or "something else", str(path))


def _open_in_place(path: str, flags: int) -> int:
    """Open what has the name itself; a pipe that nobody writes to does not block. Windows knows neither flag."""
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0), 0o666)


def _through_temporary(path: Path, content: bytes, finish: Callable[[Path, Path], T]) -> T:
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_unfinished(path.parent)
    temporary, file = _create(path.parent)
    try:
        with file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # down to the disk
            if os.name != "nt":
                return finish(temporary, path)  # while the lock is held
        return finish(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _create(folder: Path) -> tuple[Path, BinaryIO]:
    """A new file under a lock that says that this process writes it."""
    while True:
        temporary = folder / f"{TEMPORARY}{os.getpid()}-{secrets.token_hex(8)}.tmp"
        file = temporary.open("xb")
        if hold(file.fileno()):
            return temporary, file
        file.close()
        temporary.unlink(missing_ok=True)


def _publish(temporary: Path, path: Path) -> bool:
    """Give a new file its name unless that is taken."""
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        return False
    except (OSError, NotImplementedError):  # without hard links
        if os.path.lexists(path):
            return False
        try:
            temporary.rename(
                path
            )  # Windows refuses to rename onto a file; elsewhere the later of two equal files stays
        except FileExistsError:
            return False
    return True
