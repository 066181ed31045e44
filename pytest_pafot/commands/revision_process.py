"""The process that builds and drives the policy of another revision; the files of the user that it sees are noted."""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pytest_pafot.commands.policy_reference import PlanError, ads_factory, described
from pytest_pafot.execution.pool import IGNORED, portable, sendable
from pytest_pafot.execution.revision_policy import PACKAGE, STUCK, RevisionPolicy
from pytest_pafot.support.text import one_line
from pytest_pafot.world.driving.ads import preload
from pytest_pafot.world.guard.hang_guard import LastResort, last_resort

NO_TEST = "test"
"""What a revision lacks if it has no such test."""


class SeenFiles:
    """The files that this process has opened to read, and those of its modules."""

    def __init__(self) -> None:
        self.opened: set[str] = set()
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        if isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR):
            return
        with suppress(OSError, ValueError):  # such as a current folder that was removed
            self.opened.add(os.path.abspath(os.fsdecode(arguments[0])))  # noqa: PTH100  (links are not followed yet)

    def paths(self) -> set[Path]:
        """Return the paths of all files, those of modules as their source."""
        modules = [getattr(module, "__file__", None) for module in [*sys.modules.values()]]
        return {Path(name) for name in {*self.opened, *(each for each in modules if isinstance(each, str))}}


@dataclass(slots=True)
class Built:
    """A policy of a revision, as it was built in this process."""

    policy: RevisionPolicy
    files: SeenFiles
    factory: Callable[..., Any]
    _known: set[Path] = field(default_factory=set)  # the paths that were looked at
    _own: set[Path] = field(default_factory=set)
    _strangers: set[str] = field(default_factory=set)

    def strangers(self) -> list[str]:
        """Return the files of the user's present checkout that this process has seen."""
        new = self.files.paths() - self._known
        self._known |= new
        trees = (self.policy.tree, Path(os.path.realpath(self.policy.tree)))
        kept_out = [Path(os.path.realpath(each)) for each in (PACKAGE, sys.prefix, self.policy.root / ".git")]
        for path in new:
            real = Path(os.path.realpath(path))
            if not real.is_file() or {".git", ".pytest_cache"} & {*path.parts}:
                continue
            is_present = real.is_relative_to(self.policy.root) and not real.is_relative_to(trees[1])
            if is_present and not any(map(real.is_relative_to, kept_out)):
                self._strangers.add(str(real))
            elif any(map(path.is_relative_to, trees)) and path.parent.name != "__pycache__":
                self._own.add(path)
        return sorted(self._strangers)

    def hashes(self) -> dict[str, str]:
        """Return the hashes of the files of the revision that this process has seen, by path in the repository."""
        self.strangers()
        tree = Path(os.path.realpath(self.policy.tree))
        at = {
            path.relative_to(self.policy.tree if path.is_relative_to(self.policy.tree) else tree): path
            for path in self._own
        }
        return {name.as_posix(): digest_of(path) for name, path in sorted(at.items()) if path.is_file()}


def hashes_of(built: Built) -> dict[str, str]:
    """Return the hashes of the files of the revision that its process has seen."""
    return built.hashes()


def digest_of(path: Path) -> str:
    """Return the hash of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True, slots=True)
class Beginning:
    """What the process of a revision has before it builds the policy."""

    connection: Connection
    policy: RevisionPolicy
    files: SeenFiles


@contextmanager
def begun(descriptor: int) -> Iterator[Beginning]:
    """Take the place of the user's session in the copy of the revision: its imports come from there."""
    files = SeenFiles()
    os.set_inheritable(descriptor, False)
    with Connection(descriptor) as connection:
        policy, folders = connection.recv()
        sys.path[:] = folders
        for name, module in [*sys.modules.items()]:  # finders of editable installations
            mapping = getattr(module, "MAPPING", None) if name.startswith("__editable__") else None
            if isinstance(mapping, dict):
                mapping.update(zip(mapping, policy.mapped(mapping.values()), strict=True))
        yield Beginning(connection, policy, files)


def failed(policy: RevisionPolicy, error: BaseException, missing: str = "") -> dict[str, Any]:
    """Return the answer about a policy that cannot be built, with what its revision lacks, if that is why."""
    told = one_line(str(error)) if isinstance(error, PlanError) else described(error, policy.tree)
    return {"error": told, "missing": missing or missing_in(error)}


def missing_in(error: BaseException | None) -> str:
    """Return the module, or ``module:`` for a name in it, that an import did not find; empty for other errors."""
    while error is not None:
        if isinstance(error, ImportError) and error.name:
            return error.name if isinstance(error, ModuleNotFoundError) else f"{error.name}:"
        error = error.__cause__ or error.__context__
    return ""


def name_of(factory: Any) -> str:
    """Return ``module:name`` of a function or a class that can be imported; empty for any other factory."""
    module, name = getattr(factory, "__module__", None), getattr(factory, "__qualname__", None)
    found: Any = sys.modules.get(module) if isinstance(module, str) else None
    for part in name.split(".") if isinstance(name, str) else ["?"]:
        found = getattr(found, part, None)
    return f"{module}:{name}" if found is factory else ""


def serve(beginning: Beginning, factory: Callable[..., Any]) -> None:
    """Answer requests with a factory until there are no more, or the session has ended."""
    preload(factory)
    connection, built = beginning.connection, Built(beginning.policy, beginning.files, factory)
    connection.send({"factory": name_of(factory)})
    # A decision that ignores its interrupt ends this process, not the session.
    resort = LastResort(end=lambda: os._exit(STUCK), grace=IGNORED, file=os.dup(2))
    with last_resort(resort), suppress(EOFError, OSError):
        while True:
            request = connection.recv_bytes()
            try:
                function, arguments = pickle.loads(request)  # noqa: S301  (from the session)
                answer = sendable((function(built, *arguments), built.strangers()))
            except BaseException as error:  # noqa: BLE001  (it is raised again in the session)
                answer = pickle.dumps((portable(error), built.strangers()))
            connection.send_bytes(answer)


def main(descriptor: int) -> None:
    """Build the policy that a command names, and serve it."""
    with begun(descriptor) as beginning:
        try:
            factory = ads_factory(beginning.policy.name, beginning.policy.label)
        except Exception as error:  # noqa: BLE001  (whatever it raises, the session says so)
            module = beginning.policy.name.partition(":")[0]
            lacks = f"{module}:" if module in sys.modules else ""
            beginning.connection.send(failed(beginning.policy, error, lacks))
            return
        serve(beginning, factory)
