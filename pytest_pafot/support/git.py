"""Calls of git, which ask about the user's repository and change nothing that others see."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import visible

OF_A_CALLER = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_COMMON_DIR", "GIT_PREFIX", "GIT_NAMESPACE")
"""Variables that a git hook or alias sets. They are removed, since git would use the user's index because of them."""

OFFLINE = {"GIT_ALLOW_PROTOCOL": ""}
"""The variable with which git fetches nothing, such as objects that a partial clone lacks."""

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""The beginning of a file in place of one that Git LFS stores."""

Since = tuple[str, str]
"""The short hash of a commit, and its day."""


def git(folder: Path, *arguments: str) -> str:
    """Run git in a folder and return its output. It fetches nothing, and runs no hook.

    Raises:
        RequestError: if git fails; the message is git's own.
    """
    quiet = ("--no-optional-locks", "--literal-pathspecs", "-c", f"core.hooksPath={os.devnull}")
    command = ["git", "-C", str(folder), *quiet, "-c", "core.fsmonitor=false"]
    own = {name: value for name, value in os.environ.items() if name not in OF_A_CALLER}
    try:
        done = subprocess.run(  # noqa: S603  (no shell)
            [*command, *arguments],
            env=own | OFFLINE,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
    except FileNotFoundError:
        raise RequestError("expected the program git, received none on the PATH; install it") from None
    except ValueError as error:  # a text that no command line can have
        given = next((each for each in (str(folder), *arguments) if not each.isprintable()), str(folder))
        raise RequestError(f"expected a text for git, received {given!a:.200} ({error}); change it") from None
    if done.returncode:
        command = [each for each in arguments if not each.startswith("--")]
        raise RequestError(f"git {command[0]} in {folder}: {visible(os.fsdecode(done.stderr).strip())}")
    return os.fsdecode(done.stdout)


def added_in(folders: Iterable[Path]) -> dict[Path, Since]:
    """Return the commit that added each file in some folders, as far as git knows it.

    Files that the oldest commit of a shallow clone has are left out, because an earlier commit may have added them.
    """
    found: dict[Path, Since] = {}
    form = ("-z", "--no-show-signature", "--format=%x01%h %cs %p", "--no-color", "--no-renames", "--no-relative")
    for folder in folders:
        with suppress(RequestError, OSError):
            root = Path(os.path.realpath(git(folder, "rev-parse", "--show-toplevel").removesuffix("\n")))
            is_shallow = git(root, "rev-parse", "--is-shallow-repository").strip() == "true"
            log = ("-c", "log.showRoot=true", "log", *form, "--name-only", "--diff-filter=A")
            commit, day, parents = "", "", ""
            for part in git(root, *log, "--", str(folder.resolve())).split("\0"):  # The newest commit is first.
                if part.startswith("\1"):
                    commit, day, parents = part.removeprefix("\1").split(" ", 2)
                elif (name := part.removeprefix("\n")) and (parents.strip() or not is_shallow):
                    found.setdefault(root / name, (commit, day))
    return found
