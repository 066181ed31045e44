"""Locks that say whether the process that wrote a file still lives; the system releases them however it ends.

Process ids would not do alone: in containers each session may have the same one.
"""

from __future__ import annotations

import errno
import os
import re
import sys
from pathlib import Path

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
