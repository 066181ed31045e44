"""Calls of git, which ask about the user's repository and change nothing that others see."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import visible

OF_A_CALLER = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_COMMON_DIR", "GIT_PREFIX", "GIT_NAMESPACE")
"""Variables that a git hook or alias sets. They are removed, since git would use the user's index because of them."""

OFFLINE = {"GIT_ALLOW_PROTOCOL": "", "GIT_LFS_SKIP_SMUDGE": "1", "GIT_TERMINAL_PROMPT": "0"}
"""Variables with which git fetches nothing: no objects that a partial clone lacks, and no files of Git LFS."""

LFS_POINTER = b"version https://git-lfs.github.com/spec/"
"""The beginning of a file in place of one that Git LFS stores."""


def git(folder: Path, *arguments: str) -> str:
    """Run git in a folder and return its output. It fetches nothing, and runs no hook.

    Raises:
        RequestError: if git fails; the message is git's own.
    """
    quiet = ("--no-optional-locks", "--literal-pathspecs", "-c", f"core.hooksPath={os.devnull}")
    command = ["git", "-C", str(folder), *quiet, "-c", "core.fsmonitor=false", "-c", "core.sparseCheckout=false"]
    own = {name: value for name, value in os.environ.items() if name not in OF_A_CALLER}
    try:
        done = subprocess.run(  # noqa: S603  (no shell)
            [*command, *arguments],
            env={**own, **OFFLINE},
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


def repository_of(folder: Path) -> Path:
    """Return the root of the repository around a folder.

    Raises:
        RequestError: if the folder is in no repository, or if git is missing.
    """
    try:
        return Path(os.path.realpath(git(folder, "rev-parse", "--show-toplevel").removesuffix("\n")))
    except RequestError as error:
        fix = "run in a clone, or copy the other version to a module of another name and give its factory"
        raise RequestError(f"expected a folder in a git repository, received {folder} ({error}); {fix}") from None
