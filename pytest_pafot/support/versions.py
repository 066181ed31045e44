"""The machine and the packages here: versions on which the result of a run depends, and cores."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from functools import cache
from importlib import metadata

PACKAGES = ("pytest-pafot", "highway-env", "numpy")

RULES = "verdict-rules"
RULES_VERSION = "3"
"""The version of the rules of docs/explanation/verdicts.md. It goes up with each change of a verdict."""


def installed_versions(others: Sequence[str] = ()) -> dict[str, str]:
    """Return the version of each package by its name, ``unknown`` if it has no installed metadata; and of the rules.

    Args:
        others: the names of other packages on which a run depends.
    """
    return {**{package: _version_of(package) for package in (*PACKAGES, *others)}, RULES: RULES_VERSION}


def versions_text(others: Sequence[str] = ()) -> str:
    """Return what gave a result as a file that pip reads: the packages, and as comments Python and the rules."""
    lines = [f"# Python {platform.python_version()}, {platform.machine()}", f"# {RULES} {RULES_VERSION}"]
    packages = {name: _version_of(name) for name in sorted({*PACKAGES, *others})}
    # A package without metadata, such as one that is run from its folder, cannot be installed by its version.
    lines += [f"# {name}" if version == "unknown" else f"{name}=={version}" for name, version in packages.items()]
    return "".join(f"{line}\n" for line in lines)


@cache  # A loaded package does not change, and reading its metadata takes as long as replaying a file.
def _version_of(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"


def cores() -> int:
    """Return the number of cores that this process may use, at least one."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
