"""The commits that added saved scenarios, as git knows them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.git import git, repository_of

Since = tuple[str, str]
"""The short hash of a commit, and its day."""


def place_of(path: Path) -> Path:
    """Return the path of a file without links in its folder, by which a file is known whoever names it."""
    return Path(os.path.realpath(path.parent), path.name)


def added_in(folders: Iterable[Path], given: Iterable[Path]) -> dict[Path, Since]:
    """Return the commit that added each file in some folders, as far as git knows it; git is asked once a repository.

    ``given`` are folders in the repositories. Without git, or outside of a repository, no commit is known.
    """
    real = [Path(os.path.realpath(folder)) for folder in folders]
    roots: dict[Path, None] = {}
    for folder in given:
        with suppress(RequestError):
            roots[repository_of(folder)] = None
    found: dict[Path, Since] = {}
    for root in roots:
        inside = sorted(folder.relative_to(root).as_posix() for folder in real if folder.is_relative_to(root))
        with suppress(RequestError, OSError):
            found |= {root / name: since for name, since in _added(root, inside).items()}
    return found


def _added(root: Path, paths: Iterable[str]) -> dict[str, Since]:
    """Return the commit that added each file in the paths: its short hash and its day, by the file's path.

    Files that the oldest commit of a shallow clone has are left out, because an earlier commit may have added them.

    Raises:
        RequestError: if git fails, or there is no commit.
    """
    is_shallow = git(root, "rev-parse", "--is-shallow-repository").strip() == "true"
    form = ("-z", "--no-show-signature", "--format=%x01%h %cs %p", "--no-color", "--no-renames", "--no-relative")
    log = ("-c", "log.showRoot=true", "log", *form, "--name-only", "--diff-filter=A")
    found: dict[str, Since] = {}
    commit, day, parents = "", "", ""
    for part in git(root, *log, "--", *paths).split("\0"):  # The newest commit is first.
        if part.startswith("\1"):
            commit, day, parents = part.removeprefix("\1").split(" ", 2)
        elif (name := part.removeprefix("\n")) and (parents.strip() or not is_shallow):
            found.setdefault(name, (commit, day))
    return found
