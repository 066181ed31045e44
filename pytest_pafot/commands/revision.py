"""The policy of a revision, next to the present one: the files of both, and whether anything differs between them."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pytest_pafot.campaign.options import REVISION
from pytest_pafot.commands.history import History, HistoryError, copied
from pytest_pafot.commands.revision_process import digest_of
from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.execution.revision_policy import PACKAGE, RevisionError, RevisionPolicy
from pytest_pafot.support.text import visible

OF_COMMAND = "PYTEST_PAFOT_POLICY"
"""The environment variable with the policy that a command names, for the pytest session that it starts."""

NO_PART = (".md", ".rst", SUFFIX)
"""Endings of files that no policy drives by."""
OUTPUTS = ("pafot.json", "pafot.html", "pafot.xml")
"""Files that jobs leave in the folder in which they run."""

SHOWN = 20
"""The largest number of files that are named for each side."""


@dataclass(frozen=True, slots=True)
class Revision:
    """A commit of the user's repository, with a copy of all of its files."""

    history: History
    text: str  # as the user wrote it, such as rev:main
    commit: str
    tree: Path

    @property
    def label(self) -> str:
        """The name of the revision and its commit, for texts."""
        name = self.text.removeprefix(REVISION)
        is_hash = len(name) >= 7 and self.commit.startswith(name)
        return f"{REVISION}{self.commit:.7}" if is_hash else f"{visible(self.text)} ({self.commit:.7})"

    def policy(
        self, here: Path, program: str, name: str, *, copy: str, session: tuple[str, ...] = ()
    ) -> RevisionPolicy:
        """Return a policy of this revision; see :class:`RevisionPolicy` for the arguments."""
        root = self.history.root
        folder = here.relative_to(root) if here.is_relative_to(root) else Path()
        return RevisionPolicy(
            label=self.label,
            commit=self.commit,
            root=root,
            tree=self.tree,
            folder=folder,
            program=program,
            name=name,
            session=session,
            copy=copy,
        )

    def named(self, reference: str, here: Path, *, copy: str) -> RevisionPolicy:
        """Return the policy that a command names as ``module:factory[:argument]``, in this revision."""
        return self.policy(here, "pytest_pafot.commands.revision_process", reference, copy=copy)

    def lacks(self, missing: str) -> bool:
        """Return whether this revision does not have a policy yet, given what a process of it did not find there.

        A file that git ignores is not new: it was not copied.
        """
        if missing.startswith("fixture:"):
            return True
        module, colon, _ = missing.partition(":")
        file = getattr(sys.modules.get(module), "__file__", None)
        root = self.history.root
        if not module or file is None or not (here := Path(os.path.realpath(file))).is_relative_to(root):
            return False
        path = here.relative_to(root)
        return (bool(colon) or not (self.tree / path).exists()) and not self.history.is_ignored(path.as_posix())

    def differing(self, seen: Mapping[str, str], test: str = "", others: Collection[str] = ()) -> list[str]:
        """Return the files by which the present policy may differ from that of this revision; empty if it is the same.

        These are the files that it has seen and that are different now, and changed files that it may see in another
        run: data, which native code opens unnoticed, and modules. A changed module is no part of it if it is not
        imported now, is in no package of it, and is named nowhere in it.

        Args:
            seen: the hashes of the files that the policy of this revision has seen.
            test: the file of the test, if nothing in it is part of the policy.
            others: the other test files of the session, which are imported whether or not the policy needs them.
        """
        root = self.history.root
        changed = {name for name in self.history.uncommitted(self.commit) if _may_count(root / name, name)} - {test}
        differ = {name for name, digest in seen.items() if _digest(root / name) != digest} - {test}
        packages = {PurePosixPath(name).parent for name in seen if name.endswith("__init__.py")}
        loaded = loaded_in(root) - {*others}
        left = {
            name
            for name in changed - {*seen} - loaded
            if name.endswith(".py") and not name.endswith("conftest.py") and PurePosixPath(name).parent not in packages
        }
        differ |= changed - left
        return sorted(differ or self._reachable(seen, left))

    def _reachable(self, seen: Iterable[str], changed: set[str]) -> set[str]:
        """Return the changed modules that are named in files that were seen, or in modules named there, and so on."""
        tree, root = self.tree, self.history.root
        others = {name for name in self.history.listed(self.commit) if name.endswith(".py")} | changed
        words: set[bytes] = set()
        new = set(seen)
        while new:
            others -= new
            for name in new:
                for path in (tree / name, root / name):
                    if path.is_file():
                        words |= set(re.findall(rb"\w+", path.read_bytes()))
            new = {name for name in others if os.fsencode(_module(name)) in words}
        return changed - others


def loaded_in(root: Path) -> set[str]:
    """Return the files below a folder that are imported in this process, as paths relative to the folder."""
    files = (getattr(module, "__file__", None) for module in [*sys.modules.values()])
    paths = (Path(os.path.realpath(file)) for file in files if isinstance(file, str))
    return {path.relative_to(root).as_posix() for path in paths if path.is_relative_to(root)}


def _module(name: str) -> str:
    path = PurePosixPath(name)
    return path.parent.name if path.stem == "__init__" else path.stem


def _may_count(path: Path, name: str) -> bool:
    """Return whether a changed file may be part of a policy. The running pytest_pafot is that of both sides."""
    is_part = not name.endswith(NO_PART) and path.name not in OUTPUTS and not name.startswith(".github/")
    return is_part and not path.is_relative_to(PACKAGE)


def _digest(path: Path) -> str:
    return digest_of(path) if path.is_file() else ""


@contextmanager
def revision_at(
    text: str, folder: Path, here: Path, paths: str, option: str, terminated: Callable[[], None] | None = None
) -> Iterator[Revision]:
    """Provide a revision of the repository around a folder, and remove its copy at the end.

    Args:
        text: the revision, with its prefix, such as ``rev:main``.
        folder: a folder in the repository.
        here: the current folder, to which ``paths`` are relative.
        paths: the files and folders to copy, with spaces between them.
        option: the name of the option for these, for errors.
        terminated: see :meth:`History.revision`.

    Raises:
        RevisionError: if there is no such revision, or it cannot be copied.
    """
    name = text.removeprefix(REVISION)
    with ExitStack() as stack:
        try:
            if not name:
                raise HistoryError(f"expected a revision, such as {REVISION}main, received {text!r}")
            history = History.of([], folder)
            commit = history.named(name)
            try:
                names = shlex.split(paths)
            except ValueError as error:
                raise HistoryError(f"{option}: expected paths as in a shell, received {paths!r}: {error}") from None
            extra = copied(history.root, here, names, option)
            tree = stack.enter_context(history.revision(commit, extra, terminated))
        except HistoryError as error:
            raise RevisionError(f"{visible(text)}: {error}") from None
        yield Revision(history, text, commit, tree)


def files_line(who: str, files: Mapping[str, str]) -> str:
    """Return a line with the files of one side, each with the beginning of its hash."""
    named = [f"{visible(name)} {digest[:7]}" for name, digest in [*files.items()][:SHOWN]]
    more = [f"and {len(files) - SHOWN} more"] if len(files) > SHOWN else []
    return f"{who}: {', '.join([*named, *more]) or 'no files'}"


def sides(revision: Revision, seen: Mapping[str, str], differ: list[str]) -> list[str]:
    """Return a line for each side with its commit and the user's files that it has imported or opened."""
    root, history = revision.history.root, revision.history
    names = [*seen, *(name for name in differ if name in loaded_in(root))]
    now = {name: digest for name in dict.fromkeys(names) if (digest := _digest(root / name))}
    changed = " and changes" if {*now, *seen} & {*history.uncommitted()} else ""
    # Those that differ come first, because long lists are cut.
    order = sorted(seen, key=lambda name: (name not in differ, name))
    present = sorted(now, key=lambda name: (name not in differ, name))
    return [
        files_line(revision.label, {name: seen[name] for name in order}),
        files_line(f"now ({history.named('HEAD'):.7}{changed})", {name: now[name] for name in present}),
    ]
