"""The commits of a policy: git is asked for them, and puts each into a worktree beside the files of now.

No call goes through a shell or runs a hook. Nothing is written to the user's folder, index or branches.
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
"""Variables by which a hook or an alias of git would make it write into the user's index from any folder."""


class HistoryError(ValueError):
    """A history in which nothing can be looked for; the message says what was expected and what to do."""


def halved(commits: Sequence[str], passes: Callable[[str], bool | None]) -> Sequence[str]:
    """Return the commits of which one is the first to fail: it alone, unless those before it cannot be judged.

    Args:
        commits: the oldest first; the state before all of them passes, and the last of them fails.
        passes: whether a commit does; None where it cannot be judged.
    """
    low, high, unjudged = -1, len(commits) - 1, set[int]()
    while True:
        known = sorted({low, high, *(place for place in unjudged if low < place < high)})
        # The widest gap, since commits that cannot be judged stand in rows; without any that is halving.
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
    """The commits of some paths, which are relative to the root of a repository."""

    root: Path
    paths: tuple[str, ...]

    @classmethod
    def of(cls, paths: Iterable[str], folder: Path) -> History:
        """Return the history of paths that are relative to a folder.

        Raises:
            HistoryError: where the folder lies in no repository, or a path outside of it; and without git.
        """
        root = Path(os.path.realpath(_git(folder, "rev-parse", "--show-toplevel").strip("\n")))
        return cls(root, tuple(inside(root, folder, path, "--policy").as_posix() for path in paths))

    def named(self, revision: str) -> str:
        """Return the hash of the commit that a name stands for.

        Raises:
            HistoryError: where there is none.
        """
        try:
            return self._git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}").strip()
        except HistoryError:
            raise HistoryError(
                f"expected a commit, a branch or a tag, received {revision!a}, which is none in {self.root}; "
                "`git log --oneline` lists commits, and `git fetch --unshallow` gets those that a clone may lack"
            ) from None

    def described(self, commit: str, form: str) -> str:
        """Return what a format of git's says of a commit, on one line that is safe to show."""
        return visible(self._git("log", "-1", "--no-show-signature", f"--format={form}", commit).strip())

    def is_ancestor(self, earlier: str, later: str) -> bool:
        """Return whether a commit is another one, or one that led to it."""
        return not self._git("rev-list", "-1", earlier, f"^{later}")

    def parents(self, commit: str) -> list[str]:
        """Return the hashes of the parents of a commit."""
        return self._git("rev-list", "-1", "--parents", commit).split()[1:]

    def fork(self, one: str, other: str) -> str | None:
        """Return the commit from which two lines part; None where they have none in common."""
        try:
            return self._git("merge-base", one, other).split()[0]
        except HistoryError:
            return None

    def between(self, good: str, bad: str) -> list[str]:
        """Return the hashes of the commits after one up to another that change the paths, the oldest first.

        A merge counts as one commit.
        """
        return self._git("rev-list", "--first-parent", "--reverse", f"{good}..{bad}", "--", *self.paths).split()

    def content(self, commit: str) -> str:
        """Return what identifies the paths of a commit: names, modes and hashes of their files."""
        return self._git("ls-tree", "-r", "-z", commit, "--", *self.paths)

    def diff(self, before: str, after: str) -> list[str]:
        """Return what differs between the paths of two commits, in lines that are safe to show."""
        plain = ("--no-color", "--no-ext-diff", "--no-textconv")
        return visible_lines(self._git("diff", *plain, before, after, "--", *self.paths)).splitlines()

    def uncommitted(self) -> list[str]:
        """Return the files of the user's folder that differ from its commit, as paths relative to the root."""
        changed = self._git("diff", "--name-only", "--no-renames", "-z", "HEAD")
        new = self._git("ls-files", "--others", "--exclude-standard", "-z")
        return [name for name in f"{changed}{new}".split("\0") if name]

    def is_policy(self, name: str) -> bool:
        """Return whether a path is one of the policy's, or lies below one."""
        return any(Path(name).is_relative_to(path) for path in self.paths)

    @contextmanager
    def worktree(self, extra: Iterable[str]) -> Iterator[Path]:
        """Make a copy of the user's folder as it is now, the policy as committed, and remove it at the end.

        It has what git tracks or does not ignore, and ``extra``: paths relative to the root.
        """
        folder = Path(tempfile.mkdtemp(prefix="pafot-bisect-"))
        tree = folder / self.root.name  # a test may be imported by the name of this folder
        terminate = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # that is: clean up
        try:
            self._git("worktree", "add", "--quiet", "--detach", str(tree), "HEAD")
            own = [name for name in self.uncommitted() if self._is_copied(name)]
            for name in own:
                with suppress(OSError):
                    (tree / name).unlink()  # what was deleted; and a link, behind which nothing shall be written
            for name in [*own, *extra]:
                _copy(self.root / name, tree / name)
            yield tree
        finally:
            interrupt = signal.signal(signal.SIGINT, signal.SIG_IGN)  # for git as well: a second Ctrl-C can wait
            with suppress(HistoryError):
                self._git("worktree", "remove", "--force", "--force", str(tree))
            shutil.rmtree(folder, ignore_errors=True)
            signal.signal(signal.SIGINT, interrupt)
            signal.signal(signal.SIGTERM, terminate)

    def _is_copied(self, name: str) -> bool:
        is_environment = (self.root / name).is_relative_to(sys.prefix) or "__pycache__" in Path(name).parts
        return not is_environment and not self.is_policy(name)

    def put(self, tree: Path, commit: str) -> None:
        """Put the paths of a commit into a worktree, without those that it does not have.

        Raises:
            HistoryError: where git cannot.
        """
        names = [line.partition("\t")[2] for line in self.content(commit).split("\0")]
        there = [path for path in self.paths if any(Path(name).is_relative_to(path) for name in names if name)]
        _git(tree, "rm", "-r", "-f", "--quiet", "--ignore-unmatch", "--", *self.paths)
        if there:
            _git(tree, "checkout", "--quiet", commit, "--", *there)

    def _git(self, *arguments: str) -> str:
        return _git(self.root, *arguments)


def inside(root: Path, folder: Path, path: str, what: str) -> Path:
    """Return a path relative to a root, of one that is given relative to a folder.

    Raises:
        HistoryError: where it lies elsewhere.
    """
    found = Path(os.path.normpath(Path(os.path.realpath(folder)) / path))
    if not found.is_relative_to(root):
        raise HistoryError(f"{what}: expected a path inside of the repository {root}, received {visible(path)}")
    return found.relative_to(root)


def _copy(source: Path, target: Path) -> None:
    if source.is_dir() and not source.is_symlink():  # a repository in this one, or what the user has named
        shutil.copytree(source, target, symlinks=True, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".git"))
    elif os.path.lexists(source):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, target, follow_symlinks=False)


def _git(folder: Path, *arguments: str) -> str:
    """Return what git prints.

    Raises:
        HistoryError: where it fails, with its own words.
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
