"""Crash records, which name the scenario in which a process died.

Before a process runs a scenario, it writes the scenario to its own file and locks the file. The system releases the
lock when the process ends, so a file without a lock belongs to a dead process.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import stat
import sys
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from os import getpid
from pathlib import Path
from typing import Any, Self

from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support.files import hold, is_held, open_regular, pid_of, way_out

SUFFIX = ".inflight"
MAX_BYTES = 1 << 20


def records_of(root: Path) -> Path:
    """Return the folder for the crash records of a project, whether it exists or not."""
    # The folder is not in the project, because a repository could contain records. Other users cannot write to it. On
    # Windows, each user has their own folder for temporary files.
    own = "pytest-pafot" if sys.platform == "win32" else f"pytest-pafot-{os.getuid()}"
    name = hashlib.blake2b(os.fsencode(os.path.realpath(root)), digest_size=8).hexdigest()
    return Path(tempfile.gettempdir(), own, name)


class CrashRecordError(Exception):
    """An error for a folder of crash records that cannot be read or written.

    The search continues without records.
    """

    def __init__(self, folder: Path, error: OSError) -> None:
        advice = way_out(error, "or set TMPDIR to another one")
        if error.errno in (errno.EMFILE, errno.ENFILE):
            advice = "Close the files that the ADS and the tests have opened"
        elif error.errno == errno.EPERM:
            advice = "Delete that folder, or set TMPDIR to a folder that belongs to you"
        super().__init__(
            f"{folder}: expected a writable folder for crash records, received the error: {error.strerror or error}. "
            f"{advice}. Otherwise, the scenario is not recorded if this process crashes"
        )


class CrashRecord:
    """The record of the scenario that a process is running. ``error`` contains the error that prevents records."""

    def __init__(
        self,
        folder: Path,
        owner: str,
        *,
        world: Mapping[str, Any] | None = None,
        is_watched: bool = False,
    ) -> None:
        """Prepare a record. Its file is created only for a scenario, so the record can be sent to another process.

        ``is_watched`` is True if a session notices when the process ends.
        """
        self.error: CrashRecordError | None = None  # the error that prevents records, or None
        self._folder = folder
        self._descriptor: int | None = None
        self._path = folder
        self._owner = json.dumps(owner)
        self._world = json.dumps(dict(world) if world is not None else None)
        self._is_watched = is_watched

    def write(self, scenario: Scenario, *, reference: str = "") -> None:
        """Record that a scenario is about to run.

        ``reference`` is the name of the policy that drives instead of the ADS, or empty.
        """
        process = f'"owner": {self._owner}, "pid": {getpid()}, "world": {self._world}'
        if reference:
            process += f', "reference": {json.dumps(reference)}'
        if self._is_watched:
            process += ', "watched": true'
        self._put(f'{{{process}, "scenario": {scenario.canonical()}}}'.encode())

    def clear(self) -> None:
        if self._descriptor is not None:
            self._put(b"")

    def close(self) -> None:
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
            if self._descriptor is None:
                self._descriptor, self._path = _create(self._folder)
            os.lseek(self._descriptor, 0, os.SEEK_SET)
            # Not synchronised with the disk: the record must survive a crash of the process, but not of the machine.
            # only the first line counts, so an old record may be longer
            os.write(self._descriptor, record + b"\n")
        except OSError as error:
            self.error = CrashRecordError(self._folder, error)


def _create(folder: Path) -> tuple[int, Path]:
    while True:
        for each in (folder.parent, folder):
            each.mkdir(mode=0o700, exist_ok=True)
        with suppress(FileNotFoundError):  # another session has removed the folder, which was empty
            _refuse_folder_of_others(folder)
            descriptor, name = tempfile.mkstemp(prefix=f"{getpid()}-", suffix=SUFFIX, dir=folder)
            # Between the creation and the lock, another session may have taken it for the file of a dead process.
            if hold(descriptor):
                return descriptor, Path(name)
            os.close(descriptor)
            Path(name).unlink(missing_ok=True)


def _refuse_folder_of_others(folder: Path) -> None:
    for each in (folder.parent, folder):
        status = each.lstat()
        is_of_others = sys.platform != "win32" and (
            status.st_uid != os.getuid() or status.st_mode & 0o022 != 0
        )
        if is_of_others or not stat.S_ISDIR(status.st_mode):
            raise PermissionError(errno.EPERM, f"other users can write to {each}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Leftover:
    """The record of a process that died."""

    path: Path
    pid: int
    owner: str = ""  # the node id of the test; empty if the record cannot be read
    scenario: Scenario | None = None  # None if the record cannot be read
    world: Mapping[str, Any] | None = None  # as JSON-compatible data
    # the name of the policy that drove instead of the ADS; empty if the ADS drove
    reference: str = ""
    # True if a session watched the process, so both must have died together
    is_watched: bool = False

    def discard(self) -> None:
        with suppress(OSError):  # if it cannot be removed, it is only reported again
            self.path.unlink(missing_ok=True)


def leftovers(folder: Path) -> tuple[Leftover, ...]:
    """Return the records of dead processes, sorted by file name.

    Raises:
        CrashRecordError: if the folder cannot be read.
    """
    try:
        _refuse_folder_of_others(folder)
        paths = sorted(path for path in folder.iterdir() if path.name.endswith(SUFFIX))
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise CrashRecordError(folder, error) from error
    return tuple(filter(None, map(_leftover, paths)))


def left_by(owner: str, folder: Path) -> list[Leftover]:
    """Return the records of processes that died during a test, or an empty list if they cannot be read."""
    try:
        return [leftover for leftover in leftovers(folder) if leftover.owner == owner]
    except CrashRecordError:
        return []


def _leftover(path: Path) -> Leftover | None:
    try:
        with open_regular(path, "r+b") as file:
            if is_held(file.fileno(), pid_of(path)):
                return None
            file.seek(0)
            line = file.read(MAX_BYTES).split(b"\n", 1)[0]
    except OSError:
        return None  # it was removed meanwhile, or belongs to a different user
    leftover = Leftover(path=path, pid=pid_of(path))
    if not line.strip():
        leftover.discard()  # no scenario was running
        return None
    try:
        record = json.loads(line)
        scenario = Scenario.from_canonical(record["scenario"])
        world = dict(record["world"]) if record["world"] is not None else None
        owner, reference = str(record["owner"]), str(record.get("reference", ""))
        leftover = replace(
            leftover, owner=owner, scenario=scenario, world=world, reference=reference
        )
        return replace(leftover, is_watched=bool(record.get("watched")))
    except (ValueError, KeyError, TypeError, AttributeError, ScenarioError, RecursionError):
        return leftover
