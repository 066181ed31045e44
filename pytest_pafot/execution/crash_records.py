"""The scenario in flight, on disk before it runs, so that a crash of the whole process names its cause.

Each process writes a file of its own and holds a lock on it; the system releases the lock however the process
ends. A file that nobody holds is what a process left behind. Process ids would not do alone: in containers each
session may have the same one.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from pytest_pafot.locks import hold, is_held, pid_of
from pytest_pafot.scenario import Scenario, ScenarioError

SUFFIX = ".inflight"
TRIED = ".tried"
"""Before the suffix of a record whose scenario was run again and came to its end."""
MAX_BYTES = 1 << 20


class InFlightError(Exception):
    """The folder cannot be read or written; the search goes on, but a hard crash would not name its scenario."""


class CrashRecord:
    """A process's record of the scenario that it runs now. Never raises into the search.

    Attributes:
        error: why nothing can be recorded, or None; to be shown once.
    """

    def __init__(self, folder: Path, owner: str, *, world: Mapping[str, Any] | None = None) -> None:
        """Nothing is written before the first record.

        Args:
            folder: where the records of all processes lie; made when it is missing.
            owner: node id of the test.
            world: that the scenarios run in, as plain data.
        """
        self.error: InFlightError | None = None
        self._folder = Path(folder)
        self._descriptor: int | None = None
        self._path: Path | None = None
        self._owner = json.dumps(owner)
        self._world = json.dumps(dict(world) if world is not None else None)

    def write(self, *scenarios: Scenario) -> None:
        """Put a scenario on disk; from now on a crash is its doing. Of several, it is that of one of them."""
        alone = scenarios[0].canonical() if len(scenarios) == 1 else "null"
        together = "" if alone != "null" else f', "together": [{", ".join(each.canonical() for each in scenarios)}]'
        process = (
            f'"owner": {self._owner}, "pid": {os.getpid()}, "world": {self._world}'  # perhaps one forked meanwhile
        )
        self._put(f'{{{process}, "scenario": {alone}{together}}}\n'.encode())

    record = write

    def clear(self) -> None:
        """Nothing is in flight."""
        if self._descriptor is not None:
            self._put(b"\n")

    def close(self) -> None:
        """Remove the record; a later :meth:`write` begins a new one."""
        if self._descriptor is None or self._path is None:
            return
        descriptor, self._descriptor = self._descriptor, None
        try:
            os.close(descriptor)
            self._path.unlink(missing_ok=True)
        except OSError as error:
            self.error = _error(self._folder, error)

    def __enter__(self) -> CrashRecord:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _put(self, line: bytes) -> None:
        if self.error is not None:
            return
        try:
            if self._descriptor is None:
                self._descriptor, self._path = _create(self._folder)
            os.lseek(self._descriptor, 0, os.SEEK_SET)
            os.write(self._descriptor, line)  # the first line counts; longer ones before it need no truncation
        except OSError as error:
            self.error = _error(self._folder, error)


InFlight = CrashRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class Leftover:
    """What a process that ended without a word was running.

    Attributes:
        path: of the record.
        pid: of the process.
        owner: node id of the test; empty where the record cannot be read.
        scenario: in flight; None where the record cannot be read, or where several were.
        world: that it ran in, or None.
        together: scenarios that were in flight at once, one of which it was.
    """

    path: Path
    pid: int
    owner: str
    scenario: Scenario | None
    world: Mapping[str, Any] | None = field(default=None)
    together: tuple[Scenario, ...] = ()

    @property
    def is_tried(self) -> bool:
        """Whether an earlier session ran it again without harm, and died as well before it was through."""
        return self.path.name.endswith(TRIED + SUFFIX)

    def tried(self) -> Leftover:
        """Mark the record until the session that ran it again is through with its search; returns the marked one."""
        marked = self.path.with_name(self.path.name.removesuffix(SUFFIX) + TRIED + SUFFIX)
        with contextlib.suppress(OSError):  # a record that keeps its name is run again, which loses nothing
            self.path.rename(marked)
            return replace(self, path=marked)
        return self

    def discard(self) -> None:
        """Remove the record once it is reported; another process may have done so already."""
        with contextlib.suppress(OSError):  # a record that stays is reported again, which loses nothing
            self.path.unlink(missing_ok=True)


def leftovers(folder: Path) -> tuple[Leftover, ...]:
    """The records of processes that are gone, by name; those of live ones, this one included, are left alone.

    Records of processes that ended between two scenarios are removed. A folder that is not there has none.

    Raises:
        InFlightError: when the folder cannot be read.
    """
    try:
        paths = sorted(path for path in Path(folder).iterdir() if path.name.endswith(SUFFIX))
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise _error(Path(folder), error) from error
    found = [_leftover(path) for path in paths]
    return tuple(leftover for leftover in found if leftover is not None)


def _create(folder: Path) -> tuple[int, Path]:
    folder.mkdir(parents=True, exist_ok=True)
    while True:
        descriptor, name = tempfile.mkstemp(prefix=f"{os.getpid()}-", suffix=SUFFIX, dir=folder)
        if hold(descriptor):
            return descriptor, Path(name)
        os.close(descriptor)
        Path(name).unlink(missing_ok=True)


def _leftover(path: Path) -> Leftover | None:
    try:
        with path.open("r+b") as file:
            if is_held(file.fileno(), pid_of(path)):
                return None
            file.seek(0)
            line = file.read(MAX_BYTES).split(b"\n", 1)[0]
    except OSError:
        return None  # it has gone meanwhile, or belongs to somebody else
    if line.strip():
        return _parsed(path, line)
    with contextlib.suppress(OSError):  # an empty record tells nothing, whether it stays or goes
        path.unlink(missing_ok=True)
    return None


def _parsed(path: Path, line: bytes) -> Leftover:
    try:
        record = json.loads(line)
        owner, world = str(record["owner"]), dict(record["world"]) if record["world"] is not None else None
        together = tuple(Scenario.from_canonical(each) for each in record.get("together", ()))
        scenario = None if together else Scenario.from_canonical(record["scenario"])
    except (ValueError, KeyError, TypeError, ScenarioError, RecursionError):
        return Leftover(path=path, pid=pid_of(path), owner="", scenario=None)
    return Leftover(path=path, pid=pid_of(path), owner=owner, scenario=scenario, world=world, together=together)


def _error(folder: Path, error: OSError) -> InFlightError:
    reason = error.strerror or str(error)
    is_full = error.errno in (errno.EMFILE, errno.ENFILE)
    way_out = "close the files that the ADS and the tests open" if is_full else "make the folder readable and writable"
    return InFlightError(
        f"{folder}: expected a folder that can be read and written, received: {reason}; a hard crash of this process "
        f"will not name the scenario that caused it; {way_out}"
    )
