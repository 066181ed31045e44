"""The machine and the packages here: versions on which the result of a run depends, and cores."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path, PurePosixPath

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


def cores(root: Path = Path("/")) -> int:
    """Return the number of cores that this process may use, at least one: by its affinity and its cgroup's quota.

    Args:
        root: the folder with ``proc`` and ``sys``.
    """
    counts = [len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1]
    for quota, *period in cpu_limits(root):  # [us] of all cores together in each period
        counts.append(-(-quota // (period or [100_000])[0]))  # rounded up; the kernel's default
    return min(counts)


def cpu_limits(root: Path) -> Iterator[list[int]]:
    """Yield the numbers in ``cpu.max`` of this process's cgroup and of those around it, where there is a limit.

    A container, a job of Slurm or a unit of systemd is a cgroup. Only version 2 is read, which Linux alone has.
    """
    # Where a container hides its own path, this is its root, and the file is directly in the mounted folder.
    groups = [PurePosixPath()]
    with suppress(OSError):
        lines = os.fsdecode((root / "proc/self/cgroup").read_bytes()).splitlines()
        own = [PurePosixPath(line.removeprefix("0::/")) for line in lines if line.startswith("0::/")]
        groups = [group for path in own for group in (path, *path.parents)] or groups
    for group in dict.fromkeys(groups):
        # The outermost cgroup of a machine has no limits, "max" is none, and a container may emulate the files badly.
        with suppress(OSError, ValueError):
            numbers = [int(word) for word in (root / "sys/fs/cgroup" / group / "cpu.max").read_text("ascii").split()]
            if numbers and min(numbers) > 0:
                yield numbers
