"""The scenario in flight, on disk before it runs, so that a crash of the whole process names its cause.

Each process writes a file of its own and holds a lock on it; the system releases the lock however the process
ends. A file that nobody holds is what a process left behind. Process ids would not do alone: in containers each
session may have the same one.

A record is signed, with a key that this user has on this machine, for the folder that it lies in. One that comes with
a pull request, from another project or from another machine has no such signature, and no search takes it up.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import secrets
import stat
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.support.files import hold, is_held, open_regular, pid_of, write_if_free

SUFFIX = ".inflight"
TRIED = ".tried"
"""Before the suffix of a record whose scenario was run again and came to its end."""
MAX_BYTES = 1 << 20
KEY_BYTES = 32
_SIGNATURE = b', "signature": "'
"""Before the last value of a record, which is for all that comes before this."""


class KeyFolderError(OSError):
    """The key that signs records cannot be used."""


class CrashRecordError(Exception):
    """The folder cannot be read or written; the search goes on, but a hard crash would not name its scenario."""

    def __init__(self, folder: Path, error: OSError) -> None:
        way_out = "make the folder readable and writable"
        if error.errno in (errno.EMFILE, errno.ENFILE):
            way_out = "close the files that the ADS and the tests open"
        elif isinstance(error, KeyFolderError):
            way_out = "delete that, or let TMPDIR name a folder for temporary files that is yours"
        elif error.errno == errno.EINVAL:
            way_out = "put the folder itself in its place, or name it by its absolute path with pytest's key cache_dir"
        super().__init__(
            f"{folder}: expected a folder that can be read and written, received: {error.strerror or error}; a hard "
            f"crash of this process will not name the scenario that caused it; {way_out}"
        )


class CrashRecord:
    """A process's record of the scenario that it runs now. Never raises into the search."""

    def __init__(self, folder: Path, owner: str, *, world: Mapping[str, Any] | None = None) -> None:
        """Nothing is on disk before the first scenario, so that another process may be given the record until then.

        The folder, where the records of all processes lie, is made when it is missing.
        """
        self.error: CrashRecordError | None = None
        """Why nothing can be recorded, or None; to be shown once."""
        self._folder = folder
        self._descriptor: int | None = None
        self._path = folder
        self._sealed: hashlib.blake2b | None = None
        self._owner = json.dumps(owner)
        self._world = json.dumps(dict(world) if world is not None else None)

    def write(self, *scenarios: Scenario, reference: str = "") -> None:
        """Put a scenario on disk; from now on a crash is its doing. Of several, it is that of one of them.

        ``reference`` is what to call a policy that drives in the place of the ADS.
        """
        alone = scenarios[0].canonical() if len(scenarios) == 1 else "null"
        together = "" if alone != "null" else f', "together": [{", ".join(each.canonical() for each in scenarios)}]'
        process = f'"owner": {self._owner}, "pid": {os.getpid()}, "world": {self._world}'
        if reference:
            process += f', "reference": {json.dumps(reference)}'
        self._put(f'{{{process}, "scenario": {alone}{together}'.encode())

    def clear(self) -> None:
        """Nothing is in flight."""
        if self._descriptor is not None:
            self._put(b"")

    def close(self) -> None:
        """Remove the record; a later :meth:`write` begins a new one."""
        if self._descriptor is None:
            return
        descriptor, self._descriptor = self._descriptor, None
        try:
            os.close(descriptor)
            self._path.unlink(missing_ok=True)
        except OSError as error:
            self.error = CrashRecordError(self._folder, error)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _put(self, record: bytes) -> None:
        if self.error is not None:
            return
        try:
            self._sealed = self._sealed or _seal(self._folder)
            if self._descriptor is None:
                self._descriptor, self._path = _create(self._folder)
            if record:
                record += b'%b%b"}' % (_SIGNATURE, _signature(self._sealed, record))
            os.lseek(self._descriptor, 0, os.SEEK_SET)
            os.write(self._descriptor, record + b"\n")  # the first line counts; longer ones before it stay
        except OSError as error:
            self.error = CrashRecordError(self._folder, error)


def _create(folder: Path) -> tuple[int, Path]:
    _refuse_link(folder)
    folder.mkdir(parents=True, exist_ok=True)
    while True:
        descriptor, name = tempfile.mkstemp(prefix=f"{os.getpid()}-", suffix=SUFFIX, dir=folder)
        if hold(descriptor):
            return descriptor, Path(name)
        os.close(descriptor)
        Path(name).unlink(missing_ok=True)


def _refuse_link(folder: Path) -> None:
    if folder.is_symlink():
        raise OSError(errno.EINVAL, "a link, behind which nothing is written or removed", str(folder))


def _seal(folder: Path) -> hashlib.blake2b:
    """What signs the records of a folder, as yet without one."""
    return hashlib.blake2b(os.fsencode(os.path.realpath(folder)) + b"\0", key=_key(), digest_size=16)


def _signature(seal: hashlib.blake2b, record: bytes) -> bytes:
    seal = seal.copy()
    seal.update(record)
    return seal.hexdigest().encode()


def _key() -> bytes:
    """The key of this user on this machine, made when it is first asked for.

    It lies in the folder for temporary files, where no repository has files. Without it, after a restart of the machine
    perhaps, older records are not believed any more, and that is all.

    Raises:
        KeyFolderError: when there can be none, or others could have put it there.
    """
    # On Windows each user has a folder for temporary files.
    name = "pytest-pafot" if sys.platform == "win32" else f"pytest-pafot-{os.getuid()}"
    folder, is_of_others = Path(name), False
    try:
        folder = Path(tempfile.gettempdir(), name)
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if sys.platform != "win32":
            is_of_others = status.st_uid != os.getuid() or status.st_mode & 0o077 != 0
        if is_of_others or not stat.S_ISDIR(status.st_mode):
            raise PermissionError(errno.EPERM, "others may write there")
        path = folder / "key"
        if not os.path.lexists(path):
            write_if_free(path, secrets.token_bytes(KEY_BYTES))
        with open_regular(path) as file:
            key = file.read(KEY_BYTES + 1)
        if len(key) != KEY_BYTES:
            raise OSError(errno.EINVAL, "a damaged key")
    except OSError as error:
        reason = f"{error.strerror or error}: {folder}, where the key of the records is"
        raise KeyFolderError(error.errno, reason) from error
    return key


@dataclass(frozen=True, slots=True, kw_only=True)
class Leftover:
    """What a process that ended without a word was running.

    Attributes:
        owner: node id of the test; empty where the record cannot be read.
        scenarios: in flight: one, or several in lock step, one of which it was; none where the record cannot be read.
        world: that they ran in, as plain data, or None.
        reference: what to call the policy that drove in the place of the ADS; empty where that drove itself.
        is_own: whether a session of this user wrote it in this folder. Anybody may have written another one.
    """

    path: Path
    pid: int
    owner: str = ""
    scenarios: tuple[Scenario, ...] = ()
    world: Mapping[str, Any] | None = None
    reference: str = ""
    is_own: bool = False

    @property
    def scenario(self) -> Scenario | None:
        """That in flight by itself, or None."""
        return self.scenarios[0] if len(self.scenarios) == 1 else None

    @property
    def is_lock_step(self) -> bool:
        """Whether several scenarios were in flight at once."""
        return len(self.scenarios) > 1

    @property
    def is_tried(self) -> bool:
        """Whether an earlier session ran it again without harm, and died as well before it was through."""
        return self.path.name.endswith(TRIED + SUFFIX)

    def tried(self) -> Leftover:
        """Mark the record until the session that ran it again is through with its search; returns the marked one."""
        marked = self.path.with_name(self.path.name.removesuffix(SUFFIX) + TRIED + SUFFIX)
        with suppress(OSError):  # a record that keeps its name is run again, which loses nothing
            self.path.rename(marked)
            return replace(self, path=marked)
        return self

    def discard(self) -> None:
        """Remove the record once it is reported; another process may have done so already."""
        with suppress(OSError):  # a record that stays is reported again, which loses nothing
            self.path.unlink(missing_ok=True)


def leftovers(folder: Path) -> tuple[Leftover, ...]:
    """The records of processes that are gone, by name; those of live ones, this one included, are left alone.

    Records of processes that ended between two scenarios are removed. A folder that is not there has none.

    Raises:
        CrashRecordError: when the folder cannot be read.
    """
    try:
        _refuse_link(folder)
        paths = sorted(path for path in folder.iterdir() if path.name.endswith(SUFFIX))
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise CrashRecordError(folder, error) from error
    seal = None
    with suppress(OSError):  # Without the key no record is believed.
        seal = _seal(folder) if paths else None
    return tuple(filter(None, [_leftover(path, seal) for path in paths]))


def left_by(owner: str, folder: Path) -> list[Leftover]:
    """The leftovers of one owner that a session of this user wrote.

    There are none in a folder that cannot be read: writing there fails as well, and says so.
    """
    try:
        return [leftover for leftover in leftovers(folder) if leftover.is_own and leftover.owner == owner]
    except CrashRecordError:
        return []


def _leftover(path: Path, seal: hashlib.blake2b | None) -> Leftover | None:
    try:
        with open_regular(path, "r+b") as file:
            if is_held(file.fileno(), pid_of(path)):
                return None
            file.seek(0)
            line = file.read(MAX_BYTES).split(b"\n", 1)[0]
    except OSError:
        return None  # it has gone meanwhile, or belongs to somebody else
    signed, _, end = line.rpartition(_SIGNATURE)
    is_own = seal is not None and secrets.compare_digest(end, _signature(seal, signed) + b'"}')
    leftover = Leftover(path=path, pid=pid_of(path), is_own=is_own)
    if not line.strip():
        leftover.discard()  # it tells nothing
        return None
    try:
        record = json.loads(line)
        scenarios = tuple(map(Scenario.from_canonical, record.get("together") or [record["scenario"]]))
        world = dict(record["world"]) if record["world"] is not None else None
        owner, reference = str(record["owner"]), str(record.get("reference", ""))
        return replace(leftover, owner=owner, scenarios=scenarios, world=world, reference=reference)
    except (ValueError, KeyError, TypeError, AttributeError, ScenarioError, RecursionError):
        return leftover
