"""The commits of a policy. git lists them, and checks each commit out into a worktree with the present other files.

No call uses a shell or runs a hook. Nothing is written to the user's folder, index or branches.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pytest_pafot.support.text import visible, visible_lines

OF_A_CALLER = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_COMMON_DIR", "GIT_PREFIX", "GIT_NAMESPACE")
"""Variables that a git hook or alias sets. They are removed, since git would use the user's index because of them."""


class HistoryError(ValueError):
    """An error for a history that cannot be searched. The message says what was expected and what to do."""


def halved(commits: Sequence[str], passes: Callable[[str], bool | None]) -> Sequence[str]:
    """Return the first commit that fails, together with the commits directly before it that have no verdict.

    Args:
        commits: the commits, oldest first. The state before the first commit passes, and the last commit fails.
        passes: returns whether a commit passes; None if it has no verdict.
    """
    low, high, unjudged = -1, len(commits) - 1, set[int]()
    while True:
        known = sorted({low, high, *(place for place in unjudged if low < place < high)})
        # Try the middle of the widest gap between known commits, since commits that cannot be judged come in rows. If
        # all can be judged, this is bisection.
        before, after = max(pairwise(known), key=lambda pair: pair[1] - pair[0])
        if after - before < 2:
            return commits[low + 1 : high + 1]
        place = (before + after) // 2
        verdict = passes(commits[place])
        if verdict is None:
            unjudged.add(place)
        else:
            low, high = (place, high) if verdict else (low, place)


@dataclass(frozen=True, slots=True)
class History:
    """The history of some paths in a repository. The paths are relative to the root of the repository."""

    root: Path
    paths: tuple[str, ...]

    @classmethod
    def of(cls, paths: Iterable[str], folder: Path) -> History:
        """Return the history of paths that are relative to a folder.

        Raises:
            HistoryError: if the folder is in no repository, if a path is outside of it, or if git is missing.
        """
        root = Path(os.path.realpath(_git(folder, "rev-parse", "--show-toplevel").strip("\n")))
        return cls(root, tuple(inside(root, folder, path, "--policy").as_posix() for path in paths))

    def named(self, revision: str) -> str:
        """Return the hash of the commit that a revision such as a branch or a tag names.

        Raises:
            HistoryError: if there is no such commit.
        """
        try:
            return self._git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}").strip()
        except HistoryError:
            raise HistoryError(
                f"expected a commit, a branch or a tag, received {revision!a}, which does not exist in {self.root}; "
                "`git log --oneline` lists commits, and `git fetch --unshallow` adds commits that a shallow clone lacks"
            ) from None

    def described(self, commit: str, form: str) -> str:
        """Return a description of a commit in a format of ``git log``, on one line that is safe to display."""
        return visible(self._git("log", "-1", "--no-show-signature", f"--format={form}", commit).strip())

    def is_ancestor(self, earlier: str, later: str) -> bool:
        """Return whether ``earlier`` is an ancestor of the commit ``later``, or the same commit."""
        return not self._git("rev-list", "-1", earlier, f"^{later}")

    def parents(self, commit: str) -> list[str]:
        """Return the hashes of the parents of a commit."""
        return self._git("rev-list", "-1", "--parents", commit).split()[1:]

    def fork(self, one: str, other: str) -> str | None:
        """Return the hash of the last common ancestor of two commits; None if there is no common ancestor."""
        try:
            return self._git("merge-base", one, other).split()[0]
        except HistoryError:
            return None

    def between(self, good: str, bad: str) -> list[str]:
        """Return the hashes of the commits after ``good`` up to ``bad`` that change the paths, oldest first.

        A merge and all commits that it merged are one commit.
        """
        return self._git("rev-list", "--first-parent", "--reverse", f"{good}..{bad}", "--", *self.paths).split()

    def content(self, commit: str) -> str:
        """Return a text that identifies the files of the paths in a commit: their names, modes and hashes."""
        return self._git("ls-tree", "-r", "-z", commit, "--", *self.paths)

    def diff(self, before: str, after: str) -> list[str]:
        """Return the differences between two commits in the paths, as lines that are safe to display."""
        plain = ("--no-color", "--no-ext-diff", "--no-textconv")
        return visible_lines(self._git("diff", *plain, before, after, "--", *self.paths)).splitlines()

    def uncommitted(self) -> list[str]:
        """Return the files in the user's folder that are not committed as they are, as paths relative to the root."""
        changed = self._git("diff", "--name-only", "--no-renames", "-z", "HEAD")
        new = self._git("ls-files", "--others", "--exclude-standard", "-z")
        return [name for name in f"{changed}{new}".split("\0") if name]

    def is_policy(self, name: str) -> bool:
        """Return whether a path is one of the policy's paths, or in a folder among the policy's paths."""
        return any(Path(name).is_relative_to(path) for path in self.paths)

    @contextmanager
    def worktree(self, extra: Iterable[str]) -> Iterator[Path]:
        """Provide a copy of the user's repository, with the policy as committed, and remove the copy at the end.

        The copy contains the files that git does not ignore, and ``extra``, which are paths relative to the root.
        """
        folder = Path(tempfile.mkdtemp(prefix="pafot-bisect-"))
        tree = folder / self.root.name  # a test may be imported by the name of this folder
        # A signal that ends the process becomes an exit, so that the worktree is removed.
        terminate = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        try:
            self._git("worktree", "add", "--quiet", "--detach", str(tree), "HEAD")
            own = [name for name in self.uncommitted() if self._is_copied(name)]
            for name in own:
                with suppress(OSError):
                    (tree / name).unlink()  # a file that the user deleted, or a link, which must not be written through
            for name in [*own, *extra]:
                _copy(self.root / name, tree / name)
            yield tree
        finally:
            # Ignored by git as well, which inherits it: a second Ctrl-C must not stop the clean-up.
            interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)
            with suppress(HistoryError):
                self._git("worktree", "remove", "--force", "--force", str(tree))
            shutil.rmtree(folder, ignore_errors=True)
            signal.signal(signal.SIGINT, interrupt)
            signal.signal(signal.SIGTERM, terminate)

    def _is_copied(self, name: str) -> bool:
        is_environment = (self.root / name).is_relative_to(sys.prefix) or "__pycache__" in Path(name).parts
        return not is_environment and not self.is_policy(name)

    def put(self, tree: Path, commit: str) -> None:
        """Check the policy's paths out of a commit into a worktree; remove paths that the commit does not have.

        Raises:
            HistoryError: if git fails.
        """
        names = [line.partition("\t")[2] for line in self.content(commit).split("\0")]
        there = [path for path in self.paths if any(Path(name).is_relative_to(path) for name in names if name)]
        _git(tree, "rm", "-r", "-f", "--quiet", "--ignore-unmatch", "--", *self.paths)
        if there:
            _git(tree, "checkout", "--quiet", commit, "--", *there)

    def _git(self, *arguments: str) -> str:
        return _git(self.root, *arguments)


def inside(root: Path, folder: Path, path: str, what: str) -> Path:
    """Convert a path that is relative to ``folder`` to a path that is relative to ``root``.

    ``what`` names the option of the path in an error.

    Raises:
        HistoryError: if the path is outside of the root.
    """
    found = Path(os.path.normpath(Path(os.path.realpath(folder)) / path))
    if not found.is_relative_to(root):
        raise HistoryError(f"{what}: expected a path inside the repository {root}, received {visible(path)}")
    return found.relative_to(root)


def _copy(source: Path, target: Path) -> None:
    if source.is_dir() and not source.is_symlink():  # a nested repository, or a folder of --copy
        shutil.copytree(source, target, symlinks=True, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".git"))
    elif os.path.lexists(source):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target, follow_symlinks=False)


def _git(folder: Path, *arguments: str) -> str:
    """Run git in a folder and return its output.

    Raises:
        HistoryError: if git fails; the message is git's own.
    """
    quiet = ("--no-optional-locks", "--literal-pathspecs", "-c", f"core.hooksPath={os.devnull}")
    command = ["git", "-C", str(folder), *quiet, "-c", "core.fsmonitor=false", *arguments]
    environ = {name: value for name, value in os.environ.items() if name not in OF_A_CALLER}
    try:
        done = subprocess.run(command, env=environ, capture_output=True, check=False)  # noqa: S603  (no shell)
    except FileNotFoundError:
        raise HistoryError("expected the program git, received none on the PATH; install it") from None
    if done.returncode:
        raise HistoryError(f"git {arguments[0]} in {folder}: {visible(os.fsdecode(done.stderr).strip())}")
    return os.fsdecode(done.stdout)
