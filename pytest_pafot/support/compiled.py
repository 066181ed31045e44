"""Whether the modules with a ``.pxd`` file run compiled: only if all of them were made from the sources next to them.

A build writes the digests of the sources into a record, as its last step and after it has removed that of an earlier
build. So a record stands for a complete build, for one Python. If the sources were edited since, or are those of
another commit, nothing that is compiled is used. ``setup.py`` runs this file, so it imports nothing of the package.
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
SHARED = "_cython"
"""The name of the module with Cython's own code for arrays, which the others import. The record lies next to it."""
FORCED, ABSENT = "PAFOT_KERNEL", "not compiled at installation"


def typed(*folders: str) -> list[Path]:
    """Return the modules of some folders that have types for the compiler, without suffixes."""
    # Editors keep files such as `.#loop.pxd` there.
    return [path.with_suffix("") for each in folders for path in sorted(Path(PACKAGE, each).glob("[a-z]*.pxd"))]


def record() -> str:
    """Return a line for each source, with its digest and name. How the lines of a source end makes no difference."""
    sources = [path.with_suffix(suffix) for path in typed(*FOLDERS) for suffix in (".pxd", ".py")]
    texts = {path.relative_to(PACKAGE).as_posix(): path.read_bytes().replace(b"\r\n", b"\n") for path in sources}
    return "".join(f"{sha256(text).hexdigest()} {name}\n" for name, text in texts.items())


def why_interpreted() -> str:
    """Return why the sources run interpreted, or an empty text if they run compiled."""
    if os.environ.get("PAFOT_KERNEL") == "interpreted":
        return FORCED
    modules = [PACKAGE / SHARED, *typed(*FOLDERS)]
    if not any(path.with_suffix(suffix).exists() for suffix in EXTENSION_SUFFIXES for path in modules):
        return ABSENT
    made = PACKAGE / f"{SHARED}{EXTENSION_SUFFIXES[0]}.txt"
    lines = made.read_text("utf-8").splitlines() if made.exists() else []
    other = {line.rpartition(" ")[2] for line in {*record().splitlines()}.symmetric_difference(lines)}
    other |= {path.name for path in modules if not path.with_suffix(EXTENSION_SUFFIXES[0]).exists()}
    if not other:
        return ""
    return f"what is compiled does not match {min(other)}; install again, in a clone by `python -m pip install .`"


def load(package: str) -> None:
    """Import all typed modules of a package, so that compiled and interpreted ones are never mixed."""
    folder, reason = sys.modules[package].__path__[0], why_interpreted()
    sys.path_importer_cache.pop(folder, None)
    if reason not in ("", ABSENT):
        sys.path_importer_cache[folder] = FileFinder(folder, (SourceFileLoader, SOURCE_SUFFIXES))
    if reason not in ("", FORCED, ABSENT):
        _warn(f"pytest-pafot runs interpreted, some twenty times slower: {reason}")
    for path in typed(folder):
        import_module(f"{package}.{path.stem}")


@cache
def _warn(text: str) -> None:
    """Show a warning in one line, and once. No filter makes an error of it, which would leave half of the package."""
    warnings.showwarning(RuntimeWarning(text), RuntimeWarning, __file__, 1, line="")
