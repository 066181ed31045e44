"""The policy of a revision, next to the present one: the files of both, and whether anything differs between them."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pytest_pafot.extending import SUFFIX
from pytest_pafot.extras.revisions.commits import History, copied, is_pointer
from pytest_pafot.extras.revisions.revision_policy import PACKAGE, RevisionPolicy
from pytest_pafot.extras.revisions.revision_process import digest_of, imported_elsewhere
from pytest_pafot.support.errors import RequestError, RevisionError
from pytest_pafot.support.references import REVISION
from pytest_pafot.support.source_files import SHOWN, files_line
from pytest_pafot.support.text import visible

PROCESS = "pytest_pafot.extras.revisions.revision_process"
"""The module whose ``main`` is the process of a policy that a command names."""

NO_PART = (".md", ".rst", SUFFIX)
"""Endings of files that no policy drives by. Pictures are not among them: a policy may drive by a map."""
TESTS = ("test_*.py", "*_test.py")
"""Patterns of the names of test modules."""
OUTPUTS = ("pafot.json", "pafot.html", "pafot.xml")
"""Files that jobs leave in the folder in which they run."""


@dataclass(frozen=True, slots=True)
class Revision:
    """A commit of the user's repository, with a copy of all of its files."""

    history: History
    label: str  # its name and its commit, for texts
    commit: str
    tree: Path
    here: Path  # the current folder
    option: str  # the option that names files to copy, for texts
    copies: tuple[str, ...] = ()  # the present files and folders that it has got

    def policy(self, program: str, name: str, session: tuple[str, ...] = ()) -> RevisionPolicy:
        """Return a policy of this revision; see :class:`RevisionPolicy` for the arguments."""
        root, here = self.history.root, self.here
        return RevisionPolicy(
            label=self.label, commit=self.commit, root=root, tree=self.tree, copy=self.option, program=program,
            folder=here.relative_to(root) if here.is_relative_to(root) else Path(), name=name, session=session,
        )  # fmt: skip

    def lacks(self, missing: str) -> bool:
        """Return whether this revision does not have a policy yet, given what a process of it did not find there.

        A file that git ignores is not new: it was not copied.
        """
        if missing.startswith("fixture:"):
            return True
        module, colon, _ = missing.partition(":")
        root, file = self.history.root, getattr(sys.modules.get(module), "__file__", None)
        if not module or file is None or not (here := Path(os.path.realpath(file))).is_relative_to(root):
            return False
        path = here.relative_to(root)
        return (bool(colon) or not (self.tree / path).exists()) and not self.history.is_ignored(path.as_posix())

    def compared(self, seen: Mapping[str, str], test: str = "", *, is_whole: bool) -> tuple[list[str], str]:
        """Return lines on the files of both sides; and a sentence if nothing differs, else an empty one.

        A file differs if the policy of this revision has seen it, and it is another one now; and if git reports it as
        changed, because the policy may see any file in another run: only documents and tests are no part of a policy.

        Args:
            seen: the hashes of the files that the policy of this revision has seen.
            test: the file of the test, which counts, since it may set the policy up.
            is_whole: False if the policy has files of the user outside of the repository, which no revision has.

        Raises:
            RevisionError: if git fails, or if the present modules of the repository are not imported from it.
        """
        root = self.history.root
        if elsewhere := imported_elsewhere([*sys.modules], root, self.tree, root):
            raise RevisionError(f"{self.label}: {elsewhere}")
        if pointer := next((name for name in sorted(seen) if is_pointer(self.tree / name)), ""):
            raise RevisionError(
                f"{self.label}: expected the files of the policy, received {visible(pointer)}, a pointer of Git LFS, "
                f"as nothing is fetched here; name it with {self.option}, which gives both sides the present one"
            )
        try:
            head, dirty = self.history.named("HEAD"), self.history.uncommitted()
            changed = {name for name in self.history.uncommitted(self.commit) if name == test or _may_count(root, name)}
        except RequestError as error:
            raise RevisionError(f"{self.label}: {error}") from None
        differ = changed | {name for name, digest in seen.items() if _digest(root / name) != digest}
        # New files other than modules are often outputs.
        told = {name for name in differ if name.endswith(".py") or (self.tree / name).exists()}
        names = sorted(name for name in {*seen, *told} if not name.endswith(SUFFIX))  # each finding adds a file
        before, now = ({name: digest for name in names if (digest := _digest(at / name))} for at in (self.tree, root))
        changes = " and changes" if {*names} & {*dirty} else ""
        lines = [files_line(self.label, before, f"now ({head:.7}{changes})", now)]
        if self.copies:
            lines.append(f"copied, so the same on both sides: {', '.join(map(visible, self.copies[:SHOWN]))}")
        is_same = seen.keys() - {test} and is_whole and not differ
        return lines, f"the policy is that of {self.label}: nothing to compare" if is_same else ""


def _may_count(root: Path, name: str) -> bool:
    """Return whether a changed file may be part of a policy. The running pytest_pafot is that of both sides."""
    path = PurePosixPath(name)
    is_other = (
        name.endswith(NO_PART) or path.name in OUTPUTS or "__pycache__" in path.parts or any(map(path.match, TESTS))
    )
    return not is_other and not (root / name).is_relative_to(PACKAGE)


def _digest(path: Path) -> str:
    return digest_of(path) if path.is_file() else ""


@contextmanager
def revision_at(text: str, folder: Path, here: Path, paths: str, option: str) -> Iterator[Revision]:
    """Provide a revision of the repository around a folder, and remove its copy at the end.

    Args:
        text: the revision, with its prefix, such as ``rev:main``.
        folder: a folder in the repository.
        here: the current folder, to which ``paths`` are relative.
        paths: the files and folders to copy, with spaces between them.
        option: the name of the option for these, for errors.

    Raises:
        RevisionError: if there is no such revision, or it cannot be copied.
    """
    name = text.removeprefix(REVISION)
    with ExitStack() as stack:
        try:
            if not name:
                raise RequestError(f"expected a revision, such as {REVISION}main, received {text!r}")
            history = History.of([], folder)
            commit = history.named(name)
            try:
                names = shlex.split(paths)
            except ValueError as error:
                raise RequestError(f"{option}: expected paths as in a shell, received {paths!r}: {error}") from None
            extra = copied(history.root, here, names, option)
            tree = stack.enter_context(history.revision(commit, extra))
            copies = tuple(each for each in extra if (history.root / each).is_dir() or not history.has(commit, each))
        except RequestError as error:
            raise RevisionError(f"{visible(text)}: {error}") from None
        is_hash = len(name) >= 7 and commit.startswith(name)
        label = f"{REVISION}{commit:.7}" if is_hash else f"{visible(text)} ({commit:.7})"
        yield Revision(history, label, commit, tree, here, option, copies)
