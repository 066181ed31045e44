"""The choice between compiled and interpreted modules.

Modules with a ``.pxd`` file run compiled only if all were built from the sources next to them. This file imports
nothing from the package, because ``setup.py`` runs it.
"""

from __future__ import annotations

import os
import sys
import warnings
from functools import cache
from hashlib import sha256
from importlib import import_module
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES, FileFinder, SourceFileLoader
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
FOLDERS = ("criticality", "world/kernel")
# The module with Cython's code for arrays, which the other modules import. The record of the build is next to it.
SHARED = "_cython"
FORCED, ABSENT = "PAFOT_KERNEL", "not compiled at installation"


def typed(*folders: str) -> list[Path]:
    """Return the paths, without suffixes, of those modules in the folders that have a ``.pxd`` file."""
    found: list[Path] = []
    for each in folders:
        # Editors create files such as `.#loop.pxd` there.
        files = sorted(Path(PACKAGE, each).glob("[a-z]*.pxd"))
        found += [path.with_suffix("") for path in files]
    return found


def record() -> str:
    """Return the record of a build: one line per source, with its digest and name."""
    # A build writes this as its last step, after it has removed the record of an earlier build. So the file means that
    # the build is complete. Line endings make no difference.
    lines = ""
    for path in typed(*FOLDERS):
        for source in (path.with_suffix(".pxd"), path.with_suffix(".py")):
            text = source.read_bytes().replace(b"\r\n", b"\n")
            name = source.relative_to(PACKAGE).as_posix()
            lines += f"{sha256(text).hexdigest()} {name}\n"
    return lines


def why_interpreted() -> str:
    """Return why the modules run interpreted, or an empty string if they run compiled."""
    if os.environ.get("PAFOT_KERNEL") == "interpreted":
        return FORCED
    modules = [PACKAGE / SHARED, *typed(*FOLDERS)]
    if not any(
        path.with_suffix(suffix).exists() for suffix in EXTENSION_SUFFIXES for path in modules
    ):
        return ABSENT
    # Sources that have changed since the build must not run together with compiled modules.
    made = PACKAGE / f"{SHARED}{EXTENSION_SUFFIXES[0]}.txt"
    lines = {*record().splitlines()}
    if made.exists():
        lines ^= {*made.read_text("utf-8").splitlines()}
    other = {line.rpartition(" ")[2] for line in lines}
    other |= {path.name for path in modules if not path.with_suffix(EXTENSION_SUFFIXES[0]).exists()}
    if not other:
        return ""
    return f"the compiled modules do not match {min(other)}. Install again (in a clone: `python -m pip install .`)"


def load(package: str) -> None:
    """Import all typed modules of a package, either all compiled or all interpreted."""
    folder = sys.modules[package].__path__[0]
    reason = why_interpreted()
    sys.path_importer_cache.pop(folder, None)
    if reason not in ("", ABSENT):
        sys.path_importer_cache[folder] = FileFinder(folder, (SourceFileLoader, SOURCE_SUFFIXES))
    if reason not in ("", FORCED, ABSENT):
        _warn(
            f"pytest-pafot runs interpreted, which is about twenty times slower, because {reason}"
        )
    for path in typed(folder):
        import_module(f"{package}.{path.stem}")


@cache
def _warn(text: str) -> None:
    # Print one line, only once. No filter can turn it into an error, which would leave half of the package imported.
    warnings.showwarning(RuntimeWarning(text), RuntimeWarning, __file__, 1, line="")
