"""The commits of a policy. git lists them, and checks each commit out into a worktree with the present other files.

No call uses a shell or runs a hook. Nothing is written to the user's folder, index or branches.
"""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.files import hold, is_held, open_regular, pid_of
from pytest_pafot.support.git import LFS_POINTER, git, repository_of
from pytest_pafot.support.interrupts import undisturbed
from pytest_pafot.support.text import visible, visible_lines

LARGEST_POINTER = 1024
"""The size below which a file is read to learn whether it is a pointer, by the specification of Git LFS [bytes]."""

TREES = "pafot-tree-"
"""The prefix of the temporary folders of worktrees."""

NEW = 60.0
"""The age up to which the folder of a worktree may belong to a process that has not locked it yet [s]."""


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
            RequestError: if the folder is in no repository, if a path is outside of it, or if git is missing.
        """
        root = repository_of(folder)
        return cls(root, tuple(inside(root, folder, path, "--policy").as_posix() for path in paths))

    def named(self, revision: str) -> str:
        """Return the hash of the commit that a revision such as a branch or a tag names.

        Raises:
            RequestError: if there is no such commit.
        """
        try:
            return self._git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}").strip()
        except RequestError:
            kind = ""
            with suppress(RequestError):
                found = self._git("rev-parse", "--verify", "--quiet", "--end-of-options", revision).strip()
                kind = self._git("cat-file", "-t", found).strip()
            if kind:
                expected = f"expected a commit, a branch or a tag, received {revision!a}, which is a {kind}"
                raise RequestError(f"{expected}; name the commit itself") from None
            raise RequestError(
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
        except RequestError:
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
        plain = ("--no-color", "--no-ext-diff", "--no-textconv", "--submodule=log")
        return visible_lines(self._git("diff", *plain, before, after, "--", *self.paths)).splitlines()

    def uncommitted(self, commit: str = "HEAD") -> list[str]:
        """Return the files in the user's folder that are not as in a commit, as paths relative to the root."""
        changed = self._git("diff", "--name-only", "--no-renames", "--ignore-submodules=none", "-z", commit, "--")
        new = self._git("ls-files", "--others", "--exclude-standard", "-z")
        return [name for name in f"{changed}{new}".split("\0") if name]

    def is_ignored(self, name: str) -> bool:
        """Return whether git ignores a file in the user's folder."""
        return bool(self._git("ls-files", "--others", "--ignored", "--exclude-standard", "-z", "--", name))

    def has(self, commit: str, name: str) -> bool:
        """Return whether a commit has a file or a folder, and not only a pointer of Git LFS."""
        listed = self._git("ls-tree", "--long", "-z", commit, "--", name)
        _, kind, hash_, size = [*listed.partition("\t")[0].split(), "", "", "", ""][:4]
        if kind == "blob" and int(size) < LARGEST_POINTER:
            return not self._git("cat-file", "blob", hash_).startswith(LFS_POINTER.decode())
        return bool(listed)

    def with_whole_submodules(self, *commits: str) -> History:
        """Return this history with the submodule in place of each path inside of it: its commits are tried as a whole.

        A path counts as inside of a submodule if it is in one of the commits.
        """
        links = {link for commit in commits for link in _links(self._git("ls-tree", "-r", "-z", commit))}
        wholes = (next((link for link in links if Path(path).is_relative_to(link)), path) for path in self.paths)
        return replace(self, paths=tuple(dict.fromkeys(wholes)))

    def is_policy(self, name: str) -> bool:
        """Return whether a path is one of the policy's paths, or in a folder among the policy's paths."""
        return any(Path(name).is_relative_to(path) for path in self.paths)

    @contextmanager
    def worktree(self, extra: Iterable[str]) -> Iterator[Path]:
        """Provide a copy of the user's repository, with the policy as committed, and remove the copy at the end.

        The copy contains the files that git does not ignore, and ``extra``, which are paths relative to the root.
        """
        with self._tree("HEAD") as tree:
            self._put_submodules(tree, "HEAD", self._modules)
            own = [name for name in self.uncommitted() if self._is_copied(name)]
            for name in own:
                with suppress(OSError):
                    (tree / name).unlink()  # a file that the user deleted, or a link, which must not be written through
            self._copy([*own, *extra], tree)
            yield tree

    @contextmanager
    def revision(self, commit: str, extra: Iterable[str]) -> Iterator[Path]:
        """Provide a copy of all files of a commit, and remove the copy at the end.

        Submodules are copied from what is already cloned. ``extra`` are present files and folders, as paths relative to
        the root; of these, the copy gets only what the commit does not have, or has as a pointer of Git LFS.

        Raises:
            RequestError: if git fails, or a submodule that is checked out here was not cloned with its commit.
        """
        with self._tree(commit) as tree:
            self._put_submodules(tree, commit, self._modules)
            self._copy(extra, tree, replaces=False)
            yield tree

    @property
    def _modules(self) -> list[Path]:
        """The folders in which the submodules of the repository may be cloned."""
        places = self._git("rev-parse", "--git-dir", "--git-common-dir").splitlines()
        return [Path(os.path.normpath(self.root / place / "modules")) for place in places]

    def _copy(self, names: Iterable[str], tree: Path, *, replaces: bool = True) -> None:
        """Copy files, links and all in folders into a worktree; without ``replaces``, only what it does not have."""
        for path in (each for name in names for each in _files(self.root / name) if os.path.lexists(each)):
            target = tree / path.relative_to(self.root)
            if replaces or not os.path.lexists(target) or is_pointer(target):
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, target, follow_symlinks=False)

    def _put_submodules(
        self,
        tree: Path,
        commit: str,
        modules: Sequence[Path],
        *,
        at: str = "",
        clone: str = "",
        paths: Sequence[str] = (),
    ) -> None:
        """Fill the folders of the submodules of a commit from what is already cloned.

        Args:
            tree: the worktree.
            commit: a commit of the repository, or of the submodule ``at``.
            modules: the folders in which submodules may be cloned.
            at: the path of the submodule whose submodules these are; empty for the repository.
            clone: the folder of git of the submodule ``at``.
            paths: only submodules below these paths, which have to be cloned; all without any.

        Raises:
            RequestError: if a submodule that is checked out here, or named by the paths, is not cloned with its commit.
        """
        own = (f"--git-dir={clone}",) if clone else ()
        links = _links(git(self.root, *own, "ls-tree", "-r", "-z", "--full-tree", commit, "--", *paths))
        names = dict[str, str]()
        if links and (tree / at / ".gitmodules").is_file():
            pattern = r"^submodule\..*\.path$"
            listed = git(tree / at, "config", "--file", ".gitmodules", "--null", "--get-regexp", pattern)
            pairs = (each.partition("\n") for each in listed.split("\0") if each)
            names = {path: key.removeprefix("submodule.").removesuffix(".path") for key, _, path in pairs}
        for path, hash_ in links.items():
            here, there = tree / at / path, self.root / at / path
            clones = [*(folder / names.get(path, path) for folder in modules), there / ".git"]
            for found in (each for each in clones if each.is_dir()):
                with suppress(RequestError):
                    git(tree, f"--git-dir={found}", "cat-file", "-e", f"{hash_}^{{tree}}")
                    here.mkdir(parents=True, exist_ok=True)
                    # The index of the commit before names the files that git removes. All others stay.
                    index = {"GIT_INDEX_FILE": str(_index_of(tree, f"{Path(at, path)}"))}
                    read = (f"--git-dir={found}", f"--work-tree={here}", "read-tree", "--reset", "-u", hash_)
                    git(here, *read, environ=index)
                    self._put_submodules(tree, hash_, [found / "modules"], at=f"{Path(at, path)}", clone=str(found))
                    break
            else:
                is_there = any(each.name != ".git" for each in _entries(there))
                if is_there or paths:
                    name = shlex.quote(visible(f"{Path(at, path)}"))
                    way = f"git -C {name} fetch" if is_there else f"git submodule update --init {name}"
                    raise RequestError(
                        f"expected the submodule {visible(path)} to be cloned with its commit {hash_:.10}, received "
                        f"{self.root} without it; nothing is fetched here: run `{way}` first"
                    )

    @contextmanager
    def _tree(self, commit: str) -> Iterator[Path]:
        """Provide a worktree of a commit, and remove it at the end."""
        self._remove_leftovers()
        folder = Path(os.path.realpath(tempfile.mkdtemp(prefix=TREES)))
        tree = folder / self.root.name  # a test may be imported by the name of this folder
        try:
            # The lock shows the next run whether this process has died and left its worktree behind.
            with (folder / f"{os.getpid()}-lock").open("xb") as lock:
                hold(lock.fileno())
                try:
                    self._git("worktree", "add", "--quiet", "--detach", str(tree), commit)
                except RequestError as error:
                    raise RequestError(f"{error}; {self._way_to_a_worktree(folder)}") from None
                yield tree
        finally:
            with undisturbed():
                self._remove(tree)

    def _way_to_a_worktree(self, folder: Path) -> str:
        """Return what to do if git cannot check out a commit into a temporary folder."""
        places = self._git("rev-parse", "--git-dir", "--git-common-dir").splitlines()
        if not all(os.access(self.root / place, os.W_OK) for place in places):
            return "git notes its worktrees there: copy the repository to a folder that you can write, and run there"
        if not shutil.disk_usage(folder).free:
            return f"free some space in {folder.parent}, or set TMPDIR to a folder with space"
        return "run `git fsck`, and mend what it reports"

    def _remove_leftovers(self) -> None:
        """Remove the worktrees of earlier runs that were killed."""
        listed = self._git("worktree", "list", "--porcelain").split("\n")
        trees = [Path(line.removeprefix("worktree ")) for line in listed if line.startswith("worktree ")]
        trees = [tree for tree in trees if tree.parent.name.startswith(TREES)]
        for tree in [*trees, *(folder / self.root.name for folder in _abandoned(Path(tempfile.gettempdir())))]:
            lock = next(tree.parent.glob("*-lock"), None)
            if lock is None or not _is_in_use(lock):
                self._remove(tree)

    def _remove(self, tree: Path) -> None:
        """Remove a worktree with its folder. Git forgets also a worktree whose folder is already gone."""
        with suppress(RequestError):
            self._git("worktree", "remove", "--force", "--force", str(tree))
        shutil.rmtree(tree.parent, ignore_errors=True)

    def _is_copied(self, name: str) -> bool:
        is_environment = (self.root / name).is_relative_to(sys.prefix) or "__pycache__" in Path(name).parts
        return not is_environment and not self.is_policy(name)

    def put(self, tree: Path, commit: str) -> None:
        """Check the policy's paths out of a commit into a worktree; remove paths that the commit does not have.

        Raises:
            RequestError: if git fails.
        """
        content = self.content(commit)
        before = git(tree, "ls-files", "--stage", "-z", "--", *self.paths)
        gone = _links(before).keys() - _links(content).keys()
        for name in gone:
            shutil.rmtree(tree / name, ignore_errors=True)
            _index_of(tree, name).unlink(missing_ok=True)
        # Not `git rm`, which also changes .gitmodules. Files that are not git's stay, such as copied weights.
        for name in _names(before):
            if not (tree / name).is_dir():
                (tree / name).unlink(missing_ok=True)
        names = _names(content)
        there = [path for path in self.paths if any(Path(name).is_relative_to(path) for name in names)]
        if there:
            git(tree, "checkout", "--quiet", commit, "--", *there)
            self._put_submodules(tree, commit, self._modules, paths=there)

    def _git(self, *arguments: str) -> str:
        return git(self.root, *arguments)


def is_pointer(path: Path) -> bool:
    """Return whether a file is a pointer of Git LFS, which stores the content elsewhere."""
    try:
        with open_regular(path) as file:
            return file.read(len(LFS_POINTER)) == LFS_POINTER
    except OSError:
        return False


def _index_of(tree: Path, name: str) -> Path:
    """Return the file of git's index for a submodule in a worktree."""
    return tree.parent / f"index-{hashlib.sha256(os.fsencode(name)).hexdigest()}"


def _names(listed: str) -> list[str]:
    """Return the names in a list of entries by git."""
    return [line.partition("\t")[2] for line in listed.split("\0") if line]


def _links(listed: str) -> dict[str, str]:
    """Return the submodules in a list of entries by git: the hashes of their commits, by path."""
    entries = (line.partition("\t") for line in listed.split("\0") if line.startswith("160000 "))
    return {path: next(each for each in entry.split()[1:] if len(each) >= 40) for entry, _, path in entries}


def copied(root: Path, folder: Path, paths: Iterable[str], option: str) -> list[str]:
    """Return the paths of an option for files to copy, relative to the root.

    Raises:
        RequestError: if a path is outside of the repository, or does not exist.
    """
    extra = [inside(root, folder, path, option).as_posix() for path in paths]
    lost = [path for path in extra if not (root / path).exists()]
    if lost:
        raise RequestError(f"{option}: expected files and folders, received {', '.join(map(visible, lost))}")
    return extra


def inside(root: Path, folder: Path, path: str, what: str) -> Path:
    """Convert a path that is relative to ``folder`` to a path that is relative to ``root``.

    ``what`` names the option of the path in an error.

    Raises:
        RequestError: if the path is outside of the root.
    """
    found = Path(os.path.normpath(Path(os.path.realpath(folder)) / path))
    if not found.is_relative_to(root):
        raise RequestError(f"{what}: expected a path inside the repository {root}, received {visible(path)}")
    return found.relative_to(root)


def _abandoned(places: Path) -> Iterator[Path]:
    """Yield the folders of worktrees of this user that are not new, whether or not git knows them.

    A process that is killed between two steps leaves a folder that has no lock yet, or that git does not list.
    """
    for folder in places.glob(f"{TREES}*"):
        with suppress(OSError):
            status = folder.lstat()
            is_own = sys.platform == "win32" or status.st_uid == os.getuid()
            if is_own and stat.S_ISDIR(status.st_mode) and time.time() - status.st_mtime > NEW:
                yield folder


def _is_in_use(lock: Path) -> bool:
    """Return whether the process that made a worktree still holds its lock."""
    try:
        with open_regular(lock, "r+b") as file:
            return is_held(file.fileno(), pid_of(lock))
    except OSError:  # of a different user
        return True


def _files(path: Path) -> Iterator[Path]:
    """Yield a file or a link, or all those in a folder, without those of git."""
    if not path.is_dir() or path.is_symlink():
        yield path
        return
    for entry in _entries(path):
        if entry.name != ".git":
            yield from _files(entry)


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []
