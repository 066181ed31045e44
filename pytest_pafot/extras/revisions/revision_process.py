"""The process that builds and drives the policy of another revision; the files of the user that it sees are noted."""

from __future__ import annotations

import functools
import hashlib
import os
import re
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.machinery import PathFinder
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from pytest_pafot.extending import Policy, Requests, ads_factory
from pytest_pafot.extras.revisions.revision_policy import PACKAGE, RevisionPolicy, mapped
from pytest_pafot.support.errors import AdsFactoryError, RequestError, RevisionError
from pytest_pafot.support.references import described, name_of
from pytest_pafot.support.source_files import is_users, source_files
from pytest_pafot.support.text import one_line, visible

NO_PART = {".git", ".pytest_cache", "__pycache__"}
"""Folders in which no file is of a policy."""

LOOKING = {"_pytest", "_frozen_importlib", "_frozen_importlib_external", "_distutils_hack", "six"}
"""The packages of finders that leave it to the folders of imports where the user's modules are."""

NO_TEST = "test"
"""What a revision lacks if it has no such test."""


@dataclass(eq=False)
class Served:
    """A policy of a revision in its own process, with the connection to the session."""

    connection: Connection
    policy: RevisionPolicy
    opened: set[str]  # the files that this process has opened to read, or started; it grows
    factory: Callable[..., Any] | None = None
    drivers: dict[int, Any] = field(default_factory=dict)  # those of NPCs in the current run
    count: int = 0  # the number of such drivers so far
    _known: set[str] = field(default_factory=set)  # the paths that were looked at
    _modules: set[str] = field(default_factory=set)  # the names of modules that were looked at
    _imported: set[str] = field(default_factory=set)  # those whose files were looked at
    _strangers: set[str] = field(default_factory=set)

    def refused(self) -> str:
        """Return why this is not the policy of the revision, with the way out; empty if nothing shows that."""
        if strangers := self._present():
            # pytest has a finder of its own there, which looks into the folders.
            others = sys.meta_path[: sys.meta_path.index(PathFinder)] if PathFinder in sys.meta_path else []
            names = {getattr(each, "__module__", type(each).__module__) for each in others}
            first = sorted(name for name in names if name.partition(".")[0] not in LOOKING)
            way = "put the folder that an editable installation imports from on the path (pytest: `pythonpath = src`)"
            if first:
                way = f"uninstall what {', '.join(map(visible, first))} imports, whose finder is asked first, and {way}"
            return (
                "expected a policy that imports and opens files of its own revision, received "
                f"{', '.join(map(visible, strangers[:3]))}, of your present files: it would be compared with itself; "
                f"name files relative to the module (`Path(__file__).parent`), and {way}"
            )
        new = sys.modules.keys() - self._modules
        self._modules |= new
        if elsewhere := imported_elsewhere(new, self.policy.tree, self.policy.tree, self.policy.root):
            return elsewhere
        files = [*source_files(self.factory)] if new else []
        if files and not any(file.is_relative_to(self.policy.tree) for file in files):
            return (
                f"expected a policy of the repository {visible(str(self.policy.root))}, received that of "
                f"{visible(str(files[0]))}, which is the same on both sides; run in the repository of the policy"
            )
        return ""

    def answer(self, request: tuple[Callable[..., object], Sequence[Any]]) -> object:
        """Return what a function returns for this and some arguments.

        Raises:
            RevisionError: if this is not the policy of the revision, whatever the function returns or raises.
            Exception: any exception of the function.
        """
        function, arguments = request
        try:
            return function(self, *arguments)
        finally:
            # A decision takes less time than the look at what the process has seen; the end of its run comes soon.
            if function is not Served.decided and (refused := self.refused()):
                raise RevisionError(f"{self.policy.label}: {refused}")

    def made(self, seed: int) -> tuple[int, Any]:
        """Make a driver of an NPC for one run, with random numbers of its own; return its number and its sight.

        Raises:
            AdsFactoryError: if the policy does not decide from observations, or cannot be made.
        """
        assert self.factory is not None  # noqa: S101  (for type checkers: it is served)
        policy = Policy(self.factory)
        ads = policy.make_drawing(seed) if policy.only_observes else None
        if ads is None or ads.drives_itself:
            received = "one that needs env" if ads is None and policy.simulates else "a vehicle class"
            raise AdsFactoryError(
                f"{self.policy.label}: expected a policy that decides from observations as the driver of an NPC, "
                f"received {received}; name its present class in drivers="
            )
        self.count += 1
        self.drivers[self.count] = ads
        return self.count, ads.sight

    def decided(self, number: int, observation: Any) -> Any:
        """Return the decision of a driver of an NPC."""
        return self.drivers[number].decides(observation)

    def ended(self, number: int) -> None:
        """Close a driver of an NPC after its run, if it is of this process."""
        close = getattr(getattr(self.drivers.pop(number, None), "given", None), "close", None)
        if callable(close):
            close()

    def is_whole(self) -> bool:
        """Return whether all files of the user that this process has imported are of the revision."""
        files = [getattr(module, "__file__", None) for module in [*sys.modules.values()]]
        library = Path(sysconfig.get_path("stdlib"))
        # Debian's sitecustomize.py is a link from the standard library to a file in /etc.
        names = [file for file in files if isinstance(file, str) and Path(file).parent != library]
        paths = {*real_paths(names), *source_files(self.factory)}
        return all(path.is_relative_to(self.policy.tree) for path in paths if is_users(path))

    def _present(self) -> list[str]:
        """Return the files of the user's present checkout that this process has opened, imported, mapped or started."""
        # This happens after each run, so only what is new since the last one is looked at: a process has imported a
        # thousand modules and mapped as many pieces of files.
        names = sys.modules.keys() - self._imported
        self._imported |= names
        modules = [getattr(sys.modules.get(name), "__file__", None) for name in names]
        seen = [*(self.opened - self._known), *modules, *_in_memory()]
        new = {name for name in seen if isinstance(name, str)} - self._known
        self._known |= new
        kept_out = [Path(os.path.realpath(each)) for each in (self.policy.tree, PACKAGE, sys.prefix)]
        for real in real_paths(name for name in new if not _is_no_part(Path(name))):
            is_present = real.is_relative_to(self.policy.root) and not any(map(real.is_relative_to, kept_out))
            if is_present and not _is_no_part(real) and real.is_file():
                self._strangers.add(str(real))
        return sorted(self._strangers)

    def hashes(self) -> dict[str, str]:
        """Return the hashes of the files of the revision that this process has seen, by path in the repository."""
        self._present()
        tree = self.policy.tree
        own = sorted(path for path in map(Path, self._known) if path.is_relative_to(tree) and not _is_no_part(path))
        return {path.relative_to(tree).as_posix(): digest_of(path) for path in own if path.is_file()}


def _in_memory() -> set[str]:
    """Return the files that are mapped into the memory, which native code may have opened."""
    maps = Path("/proc/self/maps")
    return {*map(os.fsdecode, {*re.findall(rb"/.*", maps.read_bytes())})} if maps.exists() else set()


def real_paths(names: Iterable[str]) -> Iterator[Path]:
    """Yield the paths of files without links.

    A process has imported a thousand modules from few folders. `os.path.realpath` would look at all folders above each.
    """

    @functools.cache
    def real(name: str) -> str:
        folder, last = os.path.split(name)
        if not last:
            return os.path.realpath(name)
        path = os.path.join(real(folder), last)  # noqa: PTH118  (a path for each of these takes longer)
        return os.path.realpath(path) if last in (".", "..") or os.path.islink(path) else path  # noqa: PTH114

    yield from (Path(real(name)) for name in names)


def _is_no_part(path: Path) -> bool:
    return path.match(f"*.{sys.implementation.cache_tag}*.pyc") or bool(NO_PART & {*path.parts})


@functools.cache
def _importable(tree: Path) -> dict[str, list[tuple[Path, Path]]]:
    """Return the files of a copy by each name of a module that may be theirs, with its folder of imports."""
    found: dict[str, list[tuple[Path, Path]]] = {}
    for file in (path.relative_to(tree) for path in tree.rglob("*.py")):
        parts = file.parent.parts if file.name == "__init__.py" else file.with_suffix("").parts
        for count in range(len(parts)):
            found.setdefault(".".join(parts[count:]), []).append((file, Path(*parts[:count])))
    return found


def imported_elsewhere(names: Iterable[str], own: Path, tree: Path, root: Path) -> str:
    """Return why modules of the repository are not imported from its folder ``own``, with the way out; or empty.

    A module of the copy ``tree`` is known by its name with its packages. A name without packages is common, so its file
    has to be that of the copy or of the present repository ``root`` as well.
    """
    importable = _importable(tree)
    # Few of the thousand modules of a process have such a name, and to look at a file takes longer.
    found = {name: getattr(sys.modules.get(name), "__file__", None) for name in sorted(names) if name in importable}
    foreign = {name: file for name, file in found.items() if name.partition(".")[0] not in sys.stdlib_module_names}
    files = {name: file for name, file in foreign.items() if isinstance(file, str)}
    prefix = os.path.realpath(sys.prefix)
    for name, real in zip(files, real_paths(files.values()), strict=True):
        is_own = real.is_relative_to(own) and not real.is_relative_to(prefix)
        if is_own or real.is_relative_to(PACKAGE) or not real.is_file():
            continue
        for place, folder in importable[name]:
            same = [each / place for each in (tree, root) if (each / place).is_file()]
            is_alike = real.stat().st_size > 0 and digest_of(real) in map(digest_of, same)
            if "." in name or is_alike:
                return (
                    f"expected modules of the repository, received {visible(name)} from {visible(str(real))}, which is "
                    "the same on both sides; run where the checkout is imported: `pip install -e .`, or "
                    f"PYTHONPATH={visible(folder.as_posix())}"
                )
    return ""


def digest_of(path: Path) -> str:
    """Return the hash of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def begun(descriptor: int) -> Iterator[Served]:
    """Take the place of the user's session in the copy of the revision: its imports come from there."""
    opened: set[str] = set()

    def hear(event: str, arguments: tuple[Any, ...]) -> None:
        names: list[Any] = [arguments[0]]
        if event == "subprocess.Popen":
            program, words, folder, _ = arguments
            words = [words] if isinstance(words, str | bytes | os.PathLike) else words
            split = [each for word in map(os.fsdecode, words) for each in (word, *word.split())]
            names = [Path(os.fsdecode(folder or ""), os.fsdecode(each)) for each in (program or "", *split)]
        elif event == "sqlite3.connect":
            names = [os.fsdecode(arguments[0]).removeprefix("file:").partition("?")[0]]
        elif (
            event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_TRUNC | os.O_EXCL)
        ):
            return  # what it reads there is its own
        elif event not in ("open", "ctypes.dlopen"):
            return
        for name in names:
            if isinstance(name, str | bytes | os.PathLike):
                with suppress(OSError, ValueError):  # such as a current folder that was removed
                    opened.add(os.path.abspath(os.fsdecode(name)))  # noqa: PTH100  (links are not followed yet)

    sys.addaudithook(hear)
    os.set_inheritable(descriptor, False)
    with Connection(descriptor) as connection:
        policy, sys.path[:] = connection.recv()
        own = [each for each in sys.path if Path(each).is_relative_to(policy.tree)]
        for name, module in [*sys.modules.items()]:  # finders of editable installations
            places = getattr(module, "MAPPING", None) if name.startswith("__editable__") else None
            if isinstance(places, dict):
                places.update(zip(places, mapped(places.values(), policy.root, policy.tree), strict=True))
                own += [str(Path(each).parent) for each in places.values() if Path(each).is_relative_to(policy.tree)]
        # Programs that the policy starts import from there as well, and not from an editable installation.
        above = os.environ.get("PYTHONPATH", "")
        os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys([*own, *(above.split(os.pathsep) if above else [])]))
        yield Served(connection, policy, opened)


def failed(policy: RevisionPolicy, error: BaseException | str, missing: str = "") -> RevisionError:
    """Return the error for a policy that cannot be built, for a reason or with an exception of the user's code.

    Its ``missing`` is by default the module, or ``module:`` for a name in it, that an import did not find.
    """
    received = one_line(str(error)) if isinstance(error, str | RequestError) else described(error, policy.tree)
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
    if refused := served.refused():
        connection.send(RevisionError(f"{served.policy.label}: {refused}"))
        return
    connection.send(name_of(factory))
    Requests(connection).serve(served.answer)


def main(descriptor: int) -> None:
    """Build the policy that a command names, and serve it."""
    with begun(descriptor) as served:
        policy = served.policy
        try:
            factory = ads_factory(policy.name, policy.label)
            Policy(factory).preload()
        except Exception as error:  # noqa: BLE001  (whatever it raises, the session says so)
            module = policy.name.partition(":")[0]
            served.connection.send(failed(policy, error, f"{module}:" if module in sys.modules else ""))
            return
        serve(served, factory)
