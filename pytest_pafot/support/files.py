"""File writes that succeed completely or have no effect, and git commands."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TypeVar, cast

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import visible

# A lock shows whether the process that wrote a file is still alive: the system releases it however the process ends.
# Process ids are not enough, because sessions in different containers may have the same id.

if sys.platform != "win32":
    import fcntl

_HELD = {errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES}


def hold(descriptor: int) -> bool:
    """Lock a new file, or return False if another process has deleted it."""
    # Forked processes inherit the lock and hold it even after this process has ended.
    try:
        _lock(descriptor)
    except OSError as error:
        # this file system has no locks, so the process id in the name decides
        return error.errno not in _HELD
    return os.fstat(descriptor).st_nlink > 0


def is_held(descriptor: int, pid: int) -> bool:
    """Return whether a file's writer still holds its lock or, on systems without locks, is alive."""
    try:
        _lock(descriptor)
    except OSError as error:
        return error.errno in _HELD or _is_alive(pid)
    return False


def pid_of(path: Path) -> int:
    """Return the process id in a file's name, or 0."""
    # The id is the first part of the name, or follows a dot and a word.
    digits = re.match(r"(?:\.[a-z]+-)?(\d{1,11})-", path.name, re.ASCII)
    if digits is None:
        return 0
    return int(digits[1])


def _is_alive(pid: int) -> bool:
    # Windows has no harmless check (`os.kill(pid, 0)` ends the process there), so every process counts as alive.
    if pid <= 0:
        return False
    if sys.platform == "win32":
        return True
    try:
        os.kill(pid, 0)
    except OSError as error:
        # other errors mean that another user owns the process
        return not isinstance(error, ProcessLookupError)
    return True


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":  # its locks would prevent other processes from reading the file
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


T = TypeVar("T")

# The prefix of temporary files.
TEMPORARY = ".pafot-"

# The advice for each error number. `{}` is replaced by advice on how to name another folder.
_WAYS_OUT = {
    errno.ENOSPC: "Free some space on the disk, {}",
    errno.EDQUOT: "Free some of your disk quota, {}",
    errno.EROFS: "Mount the file system with write access, {}",
    errno.ENAMETOOLONG: "Shorten the name of a folder, of the test or of a parameter, {}",
    errno.ENOTDIR: "Rename or delete the file that has the same name as the folder, {}",
    errno.EEXIST: "Rename or delete the file that has the same name as the folder, {}",
    errno.EISDIR: "Rename or delete the folder that has this name, {}",
    errno.ENOENT: "Create the missing folder, {}",
    errno.EINVAL: "Delete the link or special file that has this name, {}",
    errno.ELOOP: "Remove the link that points to itself from the path, {}",
    errno.EMFILE: "Close files that the policy and the tests open, or raise the limit on open files (ulimit -n)",
    errno.ENFILE: "Close files in other programs on this machine, or raise its limit on open files",
    errno.EIO: "Check the disk and the network, {}",
}


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file so that readers always find the complete old or new content.

    Missing folders are created. A link is replaced. A stream receives the content.

    Raises:
        OSError: if the file cannot be written. No temporary file is left behind.
    """
    if isinstance(content, str):
        content = content.encode()
    if is_stream(path):
        append(path, content)
    else:
        _through_temporary(path, content, Path.replace)


def append(path: Path, content: str | bytes) -> None:
    """Append to a file or write to a stream, but not through a link.

    Raises:
        OSError: if the path is a link or cannot be written. The file keeps its old length.
    """
    if isinstance(content, str):
        content = content.encode()
    rest = memoryview(content)
    with path.open("ab") if is_stream(path) else open_regular(path, "ab") as file:
        size = os.fstat(file.fileno()).st_size
        try:
            while rest:
                rest = rest[os.write(file.fileno(), rest) :]
        except OSError:
            with suppress(OSError):  # a stream has no length
                os.ftruncate(file.fileno(), size)
            raise


def is_stream(path: Path) -> bool:
    """Return whether a path is a pipe, a character device, or a system link to either, such as ``/dev/stdout``."""
    # Content is written into it, because a regular file in its place would take it away from every process.
    folder = os.path.realpath(path.parent)
    is_of_system = re.fullmatch(r"/dev|/proc/\d+/fd", folder) is not None
    try:
        mode = path.stat(follow_symlinks=is_of_system).st_mode
    except (OSError, ValueError):  # the file does not exist, or cannot be written either
        return False
    return stat.S_ISCHR(mode) or stat.S_ISFIFO(mode) or (is_of_system and path.is_symlink())


def write_if_free(path: Path, content: bytes) -> bool:
    """Write a new file like :func:`write_whole`, or return False without writing if the path exists."""
    return _through_temporary(path, content, _publish)


def way_out(error: OSError, elsewhere: str) -> str:
    """Return advice for a file that cannot be written. ``elsewhere`` explains how to choose another folder."""
    return _WAYS_OUT.get(error.errno or 0, "Make the folder writable, {}").format(elsewhere)


@contextmanager
def written_into(folder: Path) -> Iterator[None]:
    """Turn an ``OSError`` raised within the ``with`` block into a ``RequestError`` for ``--out``."""
    try:
        yield
    except OSError as error:
        # Name an existing file that is in the way, but not a temporary file that was being written.
        what = error.filename2 or folder
        if not error.filename2 and isinstance(error, FileExistsError):
            what = error.filename
        raise RequestError(
            f"--out: expected a writable folder, received {what}: {error.strerror or error}. "
            f"{way_out(error, 'or give another folder')}"
        ) from None


def open_regular(path: Path, mode: str = "rb") -> BinaryIO:
    """Open a regular file in a binary mode, or raise an ``OSError`` for a link, pipe or device."""
    with suppress(FileNotFoundError):  # some modes create the file
        # before opening, because opening some devices has side effects
        _check_regular(path, path.lstat())
    file = cast("BinaryIO", open(path, mode, opener=_open_in_place))  # noqa: SIM115  (the caller closes it)
    try:
        _check_regular(path, os.fstat(file.fileno()))  # it may have been replaced in between
    except OSError:
        file.close()
        raise
    return file


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files of killed processes from a folder."""
    for path in folder.glob(f"{TEMPORARY}*.tmp"):
        # a leftover does no harm, because no code reads files with such a name
        with suppress(OSError):
            with open_regular(path, "r+b") as file:
                if is_held(file.fileno(), pid_of(path)):
                    continue
                with suppress(PermissionError):  # Windows does not remove open files
                    # during the lock, so that no process starts to write to the file
                    path.unlink(missing_ok=True)
            path.unlink(missing_ok=True)


def _check_regular(path: Path, status: os.stat_result) -> None:
    if stat.S_ISREG(status.st_mode):
        return
    what = "a special file"
    if stat.S_ISLNK(status.st_mode):
        what = "a symbolic link"
    elif stat.S_ISDIR(status.st_mode):
        what = "a folder"
    raise OSError(errno.EINVAL, f"Is {what}", str(path))


def _open_in_place(path: str, flags: int) -> int:
    # Do not follow a link, and do not wait for the writer of a pipe. Windows has neither of these flags.
    for name in ("O_NOFOLLOW", "O_NONBLOCK"):
        flags |= getattr(os, name, 0)
    return os.open(path, flags, 0o666)


def _through_temporary(path: Path, content: bytes, finish: Callable[[Path, Path], T]) -> T:
    # The content goes into a locked temporary file in the same folder, with the process id in its name. So the next
    # writer can remove what killed processes left behind, and only that.
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_unfinished(path.parent)
    temporary, file = _create(path.parent)
    try:
        with file:
            file.write(content)
            file.flush()
            # so that the content is on the disk before the file gets its name
            os.fsync(file.fileno())
            if os.name == "nt":  # cannot rename an open file
                file.close()
            # elsewhere still locked, so that no process removes the file as a leftover
            return finish(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _create(folder: Path) -> tuple[Path, BinaryIO]:
    while True:
        temporary = folder / f"{TEMPORARY}{os.getpid()}-{secrets.token_hex(8)}.tmp"
        file = temporary.open("xb")
        if hold(file.fileno()):
            return temporary, file
        file.close()
        temporary.unlink(missing_ok=True)


def _publish(temporary: Path, path: Path) -> bool:
    # A hard link fails if the name exists, so that only one of two processes publishes the file.
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        return False
    except (OSError, NotImplementedError):  # this file system has no hard links
        if os.path.lexists(path):
            return False
        try:
            # Windows refuses to rename onto a file. On other systems, the later of two equal files wins.
            temporary.rename(path)
        except FileExistsError:
            return False
    return True


# Variables that a git hook or alias sets. With them, git would use the caller's index.
OF_A_CALLER = {
    "GIT_DIR",
    "GIT_WORK_TREE",
    "GIT_INDEX_FILE",
    "GIT_COMMON_DIR",
    "GIT_PREFIX",
    "GIT_NAMESPACE",
}

# With this variable, git fetches nothing, such as missing objects of a partial clone.
OFFLINE = {"GIT_ALLOW_PROTOCOL": ""}

# The start of a file that is a pointer to Git LFS.
LFS_POINTER = b"version https://git-lfs.github.com/spec/"

Since = tuple[str, str]
"""The short hash and the day of a commit."""


def git(folder: Path, *arguments: str) -> str:
    """Run git in a folder, without hooks or network access, and return its output.

    Raises:
        RequestError: if git fails, with git's own message.
    """
    quiet = ("--no-optional-locks", "--literal-pathspecs", "-c", f"core.hooksPath={os.devnull}")
    command = ["git", "-C", str(folder), *quiet, "-c", "core.fsmonitor=false", *arguments]
    own = {name: value for name, value in os.environ.items() if name not in OF_A_CALLER}
    try:
        done = subprocess.run(  # noqa: S603  (no shell)
            command,
            env=own | OFFLINE,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
    except FileNotFoundError:
        raise RequestError(
            "expected the program git, which was not found on the PATH. Install git"
        ) from None
    except ValueError as error:  # a string that no command line can contain
        words = (str(folder), *arguments)
        given = next((each for each in words if not each.isprintable()), words[0])
        raise RequestError(
            f"git: expected a valid name, received {given!a:.200} ({error}). Use another name"
        ) from None
    if done.returncode:
        subcommand = next(each for each in arguments if not each.startswith("--"))
        message = visible(os.fsdecode(done.stderr).strip())
        raise RequestError(f"git {subcommand} in {folder}: {message}")
    return os.fsdecode(done.stdout)


def added_in(folders: Iterable[Path]) -> dict[Path, Since]:
    """Return the commit that added each file in some folders, without files whose commit is unknown."""
    # The files in the oldest commit of a shallow clone are omitted, because an earlier commit may have added them.
    found: dict[Path, Since] = {}
    log = (
        *("-c", "log.showRoot=true", "log", "-z", "--no-show-signature"),
        *("--format=%x01%h %cs %p", "--no-color", "--no-renames", "--no-relative"),
        *("--name-only", "--diff-filter=A", "--"),
    )
    for folder in folders:
        with suppress(RequestError, OSError):
            top = git(folder, "rev-parse", "--show-toplevel").removesuffix("\n")
            root = Path(os.path.realpath(top))
            is_shallow = git(root, "rev-parse", "--is-shallow-repository").strip() == "true"
            commit = day = parents = ""
            # The newest commit is first.
            output = git(root, *log, str(folder.resolve()))
            for part in output.split("\0"):
                name = part.removeprefix("\n")
                if part.startswith("\1"):
                    commit, day, parents = part.removeprefix("\1").split(" ", 2)
                elif name and (parents.strip() or not is_shallow):
                    found.setdefault(root / name, (commit, day))
    return found
