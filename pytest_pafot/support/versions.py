"""Versions of the packages that decide how a run goes."""

from __future__ import annotations

from functools import cache
from importlib import metadata

PACKAGES = ("pytest-pafot", "highway-env", "numpy")


def installed_versions() -> dict[str, str]:
    """Return the installed version by package; ``unknown`` for one that is not installed as a package."""
    return {package: _version_of(package) for package in PACKAGES}


@cache  # A loaded package does not change, and reading its metadata takes as long as replaying a file.
def _version_of(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
