"""The user's source files on which a result depends: those that define given objects, and all that these import.

They are found without running them: a file is parsed for its import statements, also those inside of functions. A
module that is imported by a computed name is not found, nor is a file that the code reads. Installed packages and the
standard library are no files of the user.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import inspect
import sys
import sysconfig
from collections.abc import Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import NamedTuple

INSTALLED = ("site-packages", "dist-packages")
"""The names of folders with installed packages, of which no file is the user's."""


class _Source(NamedTuple):
    name: str  # the name of the module
    file: Path


def source_digests(*values: object, here: Path) -> dict[str, str]:
    """Return the hashes of the files of :func:`source_files`, sorted by their names.

    The keys are paths relative to the folder ``here``, or the names of modules that are not below it.
    """
    files = source_files(*values).items()
    return dict(sorted((_key(name, file, here.resolve()), digest) for file, (name, digest) in files))


def source_files(*values: object) -> dict[Path, tuple[str, str]]:
    """Return the user's source files that define some objects, and all files that these import.

    Each path has the name of its module and the hash of its content. An object is a module, a class, a function, or
    anything that can be called; other objects have no source.
    """
    found: dict[Path, tuple[str, str]] = {}
    left = [source for value in values for source in _defining(value, set())]
    while left:
        source = left.pop()
        file = source.file.resolve()
        if file in found or not is_users(file):
            continue
        try:
            content = file.read_bytes()
        except OSError as error:  # as for a module in an archive, or a file that was removed after its import
            found[file] = source.name, f"unreadable: {error.strerror}"
            continue
        found[file] = source.name, f"sha256:{hashlib.sha256(content).hexdigest()[:16]}"
        left += _imported(source, content)
    return found


def _defining(value: object, seen: set[int]) -> Iterator[_Source]:
    """Yield the sources of an object, and of the callables that it holds, such as the policy behind a wrapper."""
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, ModuleType):
        yield from _of_module(value.__name__)
    elif isinstance(value, type):
        for cls in value.__mro__:
            yield from _of_module(cls.__module__)
    elif isinstance(value, FunctionType):
        file = value.__code__.co_filename  # not its module's, because two modules may have one name, as conftest
        if not file.startswith("<"):  # as of a function that was typed in, or made by exec
            yield _Source(value.__module__ or "", Path(file))
    for each in _held(value):
        parts = each.values() if isinstance(each, dict) else each if isinstance(each, (list, tuple)) else (each,)
        for part in parts:
            if callable(part):
                yield from _defining(part, seen)


def _held(value: object) -> list[object]:
    """Return what a callable holds: single objects, and lists, tuples and dictionaries of objects."""
    if isinstance(value, (ModuleType, type)):
        return []
    if isinstance(value, FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or () if _is_filled(cell)]
        return [*cells, value.__defaults__, value.__kwdefaults__, inspect.unwrap(value)]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, functools.partial):
        return [value.func, value.args, value.keywords]
    return [type(value), *getattr(value, "__dict__", {}).values()] if callable(value) else []


def _is_filled(cell: object) -> bool:
    try:
        cell.cell_contents  # type: ignore[attr-defined]  # noqa: B018
    except ValueError:  # a variable that has no value yet
        return False
    return True


def _of_module(name: str) -> Iterator[_Source]:
    """Yield the source of a module and those of the packages around it, whose code runs when it is imported."""
    parts = name.split(".")
    for count in range(1, len(parts) + 1):
        file = _file_of(".".join(parts[:count]))
        if file is not None:
            yield _Source(".".join(parts[:count]), file)


def _file_of(name: str) -> Path | None:
    """Find the file of a module without importing anything."""
    module = sys.modules.get(name)
    if module is not None:
        file = getattr(module, "__file__", None)
        return None if file is None else Path(file)
    package, _, _ = name.rpartition(".")
    try:
        if not package:
            spec = importlib.util.find_spec(name)  # asks all finders, also those of packages installed to be edited
        else:
            holder = sys.modules.get(package)
            spec = PathFinder.find_spec(name, getattr(holder, "__path__", None) or _folders_of(package))
    except (ImportError, ValueError):
        return None
    return None if spec is None or not spec.has_location or spec.origin is None else Path(spec.origin)


def _folders_of(package: str) -> list[str]:
    """Return the folders in which the modules of a package that is not imported are."""
    parent, _, _ = package.rpartition(".")
    spec = PathFinder.find_spec(package, _folders_of(parent)) if parent else importlib.util.find_spec(package)
    return [] if spec is None else list(spec.submodule_search_locations or [])


def _imported(source: _Source, content: bytes) -> Iterator[_Source]:
    """Yield the sources of all modules that a file imports; nothing for a file that is not Python."""
    if source.file.suffix != ".py":
        return
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError):  # imported before it was broken; its hash has changed in any case
        return
    package = source.name if source.file.stem == "__init__" else source.name.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = f"{'.' * node.level}{node.module or ''}"
            try:
                base = importlib.util.resolve_name(base, package)
            except ImportError:  # a relative import in a file that is no part of a package
                continue
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]  # a name may be a module, too
        else:
            continue
        for name in names:
            if name.partition(".")[0] not in sys.stdlib_module_names:
                yield from _of_module(name)


def is_users(file: Path) -> bool:
    """Return whether a file is the user's, and not of an installed package, the standard library or this package."""
    return not any(part in INSTALLED for part in file.parts) and not any(map(file.is_relative_to, _library_folders()))


@functools.cache
def _library_folders() -> tuple[Path, ...]:
    paths = sysconfig.get_paths()
    libraries = (Path(paths[name]).resolve() for name in ("stdlib", "platstdlib"))
    return (*libraries, Path(__file__).resolve().parents[1])


def _key(name: str, file: Path, here: Path) -> str:
    return file.relative_to(here).as_posix() if file.is_relative_to(here) else name
