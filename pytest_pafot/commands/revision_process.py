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

from pytest_pafot.campaign.harness import name_of
from pytest_pafot.commands.policy_reference import PlanError, ads_factory, described
from pytest_pafot.execution.pool import IGNORED, portable, sendable
from pytest_pafot.execution.revision_policy import PACKAGE, STUCK, RevisionError, RevisionPolicy, mapped
from pytest_pafot.support.text import one_line
from pytest_pafot.world.driving.ads import preload
from pytest_pafot.world.guard.hang_guard import LastResort, last_resort

NO_PART = {".git", ".pytest_cache", "__pycache__"}
"""Folders in which no file is of a policy."""

NO_TEST = "test"
"""What a revision lacks if it has no such test."""


@dataclass(eq=False)
class Served:
    """A policy of a revision in its own process, with the connection to the session."""

    connection: Connection
    policy: RevisionPolicy
    opened: set[str]  # the files that this process has opened to read; it grows
    factory: Callable[..., Any] | None = None
    _known: set[Path] = field(default_factory=set)  # the paths that were looked at
    _strangers: set[str] = field(default_factory=set)

    def strangers(self) -> list[str]:
        """Return the files of the user's present checkout that this process has opened or imported."""
        modules = [getattr(module, "__file__", None) for module in [*sys.modules.values()]]
        new = {Path(name) for name in [*self.opened, *modules] if isinstance(name, str)} - self._known
        self._known |= new
        kept_out = [Path(os.path.realpath(each)) for each in (self.policy.tree, PACKAGE, sys.prefix)]
        for real in (Path(os.path.realpath(path)) for path in new if not NO_PART & {*path.parts}):
            is_present = real.is_relative_to(self.policy.root) and not any(map(real.is_relative_to, kept_out))
            if is_present and not NO_PART & {*real.parts} and real.is_file():
                self._strangers.add(str(real))
        return sorted(self._strangers)

    def hashes(self) -> dict[str, str]:
        """Return the hashes of the files of the revision that this process has seen, by path in the repository."""
        self.strangers()
        tree = self.policy.tree
        own = sorted(path for path in self._known if path.is_relative_to(tree) and not NO_PART & {*path.parts})
        return {path.relative_to(tree).as_posix(): digest_of(path) for path in own if path.is_file()}


def digest_of(path: Path) -> str:
    """Return the hash of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def begun(descriptor: int) -> Iterator[Served]:
    """Take the place of the user's session in the copy of the revision: its imports come from there."""
    opened: set[str] = set()

    def hear(event: str, arguments: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        if isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR):
            return
        with suppress(OSError, ValueError):  # such as a current folder that was removed
            opened.add(os.path.abspath(os.fsdecode(arguments[0])))  # noqa: PTH100  (links are not followed yet)

    sys.addaudithook(hear)
    os.set_inheritable(descriptor, False)
    with Connection(descriptor) as connection:
        policy, sys.path[:] = connection.recv()
        for name, module in [*sys.modules.items()]:  # finders of editable installations
            places = getattr(module, "MAPPING", None) if name.startswith("__editable__") else None
            if isinstance(places, dict):
                places.update(zip(places, mapped(places.values(), policy.root, policy.tree), strict=True))
        yield Served(connection, policy, opened)


def failed(policy: RevisionPolicy, error: BaseException | str, missing: str = "") -> RevisionError:
    """Return the error for a policy that cannot be built, for a reason or with an exception of the user's code.

    Its ``missing`` is by default the module, or ``module:`` for a name in it, that an import did not find.
    """
    received = one_line(str(error)) if isinstance(error, str | PlanError) else described(error, policy.tree)
    cause = None if isinstance(error, str) else error
    while cause is not None and not missing:
        if isinstance(cause, ImportError) and cause.name:
            missing = cause.name if isinstance(cause, ModuleNotFoundError) else f"{cause.name}:"
        cause = cause.__cause__ or cause.__context__
    return RevisionError(
        f"{policy.label}: expected the policy {policy.name} to be built from that revision, received {received}; "
        f"{policy.hint}",
        missing,
    )


def serve(served: Served, factory: Callable[..., Any]) -> None:
    """Answer requests with a factory until there are no more, or the session has ended."""
    served.factory, connection = factory, served.connection
    connection.send(name_of(factory))
    # A decision that ignores its interrupt ends this process, not the session.
    resort = LastResort(end=lambda: os._exit(STUCK), grace=IGNORED, file=os.dup(2))
    with last_resort(resort), suppress(EOFError, OSError):
        while True:
            request = connection.recv_bytes()
            try:
                function, arguments = pickle.loads(request)  # noqa: S301  (from the session)
                answer = sendable((function(served, *arguments), served.strangers()))
            except BaseException as error:  # noqa: BLE001  (it is raised again in the session)
                answer = pickle.dumps((portable(error), served.strangers()))
            connection.send_bytes(answer)


def main(descriptor: int) -> None:
    """Build the policy that a command names, and serve it."""
    with begun(descriptor) as served:
        policy = served.policy
        try:
            factory = ads_factory(policy.name, policy.label)
            preload(factory)
        except Exception as error:  # noqa: BLE001  (whatever it raises, the session says so)
            module = policy.name.partition(":")[0]
            served.connection.send(failed(policy, error, f"{module}:" if module in sys.modules else ""))
            return
        serve(served, factory)
