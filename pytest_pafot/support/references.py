"""The import of the user's objects by names such as ``module:name``, and their source files."""

from __future__ import annotations

import ast
import difflib
import functools
import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from types import FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

from pytest_pafot.support.text import listed, one_line

# The maximum number of names of a module that an error lists.
MOST_NAMES = 8

# The suffix that marks a policy as a planner in SI units, although it drives in an environment.
PLANNER = "@planner"


def factory_named(reference: str, what: str = "a factory") -> Callable[..., Any]:
    """Import the factory in a string such as ``module:factory`` or ``module:factory:argument``."""
    module, _, rest = reference.partition(":")
    name, colon, argument = rest.partition(":")  # the argument may contain colons
    if not (module and name) or (colon and not argument):
        raise ValueError(
            f"expected module:factory or module:factory:argument, received {reference!r}"
        )
    factory = referred_to(f"{module}:{name}", what)
    if not callable(factory):
        received = f"{reference!r}, which has the type {type(factory).__name__}"
        raise ValueError(
            f"expected {what}, received {received}. Name a function or a class instead"
        )
    return functools.partial(factory, argument) if argument else factory


def referred_to(reference: str, what: str = "a name") -> Any:
    """Import the object in a string such as ``module:name``, or raise a ``ValueError``."""
    module_name, _, name = reference.partition(":")
    module = imported(reference)
    if not hasattr(module, name):
        near = difflib.get_close_matches(name, vars(module), n=1)
        own = [
            each
            for each, value in vars(module).items()
            if getattr(value, "__module__", "") == module_name
        ]
        hint = f". Did you mean {f'{module_name}:{near[0]}'!r}?" if near else ""
        names = [*own[:MOST_NAMES], *(["others"] if len(own) > MOST_NAMES else [])]
        hint = hint or f". The module defines {listed(names) or 'no functions or classes'}"
        file = getattr(module, "__file__", None)
        origin = f"was loaded from {file}" if file else "is built into Python"
        # The user may have expected another module with the same name.
        hint += (
            ""
            if Path(file or "").is_relative_to(Path.cwd())
            else f"{' The module' if near else '. It'} {origin}"
        )
        raise ValueError(
            f"expected {what} in the module {module_name}, received {reference!r}{hint}"
        )
    return getattr(module, name)


def imported(reference: str) -> ModuleType:
    """Import the module in a string such as ``module:name``, or raise a ``ValueError``."""
    module_name, _, name = reference.partition(":")
    try:
        if not module_name or module_name.startswith("."):  # a relative name has no package here
            raise ModuleNotFoundError(f"No module named {module_name!r}", name=module_name)
        return importlib.import_module(module_name)
    # A script without a guard calls sys.exit() when it is imported.
    except (Exception, SystemExit) as error:
        # A module that imports a missing module raises ModuleNotFoundError, too.
        is_missing = isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(
            f"{error.name}."
        )
        way_out = "Change to the module's folder, or add it to the Python path (pytest setting: `pythonpath = .`)"
        path = os.path.relpath(module_name.removesuffix(".py") or ".").replace(os.sep, ".")
        # otherwise, it is not a path, or not below this folder
        if path != module_name and not path.startswith("."):
            way_out = f"Write {path}:{name}"
        received = (
            f" ({type(error).__name__}: {error})"
            if is_missing
            else f", whose import raises {described(error)}"
        )
        way_out = way_out if is_missing else "Correct the module"
        raise ValueError(
            f"expected a module that can be imported, received {reference!r}{received}. {way_out}"
        ) from error


def name_of(factory: Callable[..., Any]) -> str:
    """Return the name ``module:name`` of a function or class, or an empty string if it cannot be imported."""
    name = f"{getattr(factory, '__module__', '')}:{getattr(factory, '__qualname__', '')}"
    try:
        return name if referred_to(name) is factory else ""
    except ValueError:
        return ""


def policy_name(factory: Any) -> str:
    """Return the display name ``module:name`` of the class or function that makes a policy."""
    # A lambda has the name of the one class or function that it uses, if it uses no other.
    made = inspect.unwrap(factory)
    while isinstance(made, functools.partial):
        made = made.func
    if isinstance(made, FunctionType) and made.__name__ == "<lambda>":
        uses = inspect.getclosurevars(made)
        used = [
            each
            for each in (*uses.nonlocals.values(), *uses.globals.values())
            if hasattr(each, "__qualname__")
        ]
        made = used[0] if len(used) == 1 else made
    made = made if hasattr(made, "__qualname__") else type(made)
    return f"{made.__module__}:{made.__qualname__}"


def described(error: BaseException) -> str:
    """Describe an exception in the user's code in one line: class, message and position."""
    # Skip lines of this package, which only called the user's code or rejected a value, and code without a file, such
    # as the `__init__` of a dataclass.
    here = f"{Path(__file__).parents[1]}{os.sep}", "<"
    frames = [
        each
        for each in traceback.extract_tb(error.__traceback__)
        if not each.filename.startswith(here)
    ]
    text = one_line("".join(traceback.format_exception_only(error)))
    # the message of a SyntaxError names the place
    has_place = isinstance(error, SyntaxError) or not frames
    return text if has_place else f"{text} ({frames[-1].filename}:{frames[-1].lineno})"


# Folders with installed packages.
INSTALLED = ("site-packages", "dist-packages")


class _Source(NamedTuple):
    name: str  # the name of the module
    file: Path


def source_files(*values: object) -> dict[Path, tuple[str, str]]:
    """Return the source files of the user's objects and of their imports, with module names and content hashes."""
    found: dict[Path, tuple[str, str]] = {}
    left = [source for value in values for source in _defining(value, set())]
    while left:
        source = left.pop()
        file = source.file.resolve()
        if file in found or not is_users(file):
            continue
        try:
            content = file.read_bytes()
        # such as a module in an archive, or a file that was removed after its import
        except OSError as error:
            found[file] = source.name, f"unreadable: {error.strerror}"
            continue
        found[file] = source.name, f"sha256:{hashlib.sha256(content).hexdigest()[:16]}"
        left += _imported(source, content)
    return found


def _defining(value: object, seen: set[int]) -> Iterator[_Source]:
    # Includes callables that the object contains, such as the policy inside a wrapper.
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, ModuleType):
        yield from _of_module(value.__name__)
    elif isinstance(value, type):
        for cls in value.__mro__:
            yield from _of_module(cls.__module__)
    elif isinstance(value, FunctionType):
        # not the module's: two modules may have the same name, such as conftest
        file = value.__code__.co_filename
        if not file.startswith("<"):  # such as a function from an interactive session or from exec
            yield _Source(value.__module__ or "", Path(file))
    for each in _held(value):
        parts = (
            each.values()
            if isinstance(each, dict)
            else each
            if isinstance(each, (list, tuple))
            else (each,)
        )
        for part in parts:
            if callable(part):
                yield from _defining(part, seen)


def _held(value: object) -> list[object]:
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
    parts = name.split(".")  # the code of the packages around a module runs when it is imported
    for count in range(1, len(parts) + 1):
        file = _file_of(".".join(parts[:count]))
        if file is not None:
            yield _Source(".".join(parts[:count]), file)


def _file_of(name: str) -> Path | None:
    # Nothing is imported here.
    module = sys.modules.get(name)
    if module is not None:
        file = getattr(module, "__file__", None)
        return None if file is None else Path(file)
    package, _, _ = name.rpartition(".")
    try:
        if not package:
            # by all finders, including those of editable installs
            spec = importlib.util.find_spec(name)
        else:
            holder = sys.modules.get(package)
            spec = PathFinder.find_spec(
                name, getattr(holder, "__path__", None) or _folders_of(package)
            )
    except (ImportError, ValueError):
        return None
    return (
        None if spec is None or not spec.has_location or spec.origin is None else Path(spec.origin)
    )


def _folders_of(package: str) -> list[str]:
    parent, _, _ = package.rpartition(".")
    spec = (
        PathFinder.find_spec(package, _folders_of(parent))
        if parent
        else importlib.util.find_spec(package)
    )
    return [] if spec is None else list(spec.submodule_search_locations or [])


def _imported(source: _Source, content: bytes) -> Iterator[_Source]:
    if source.file.suffix != ".py":
        return
    try:
        tree = ast.parse(content)
    # the file was broken after its import; its hash has changed in any case
    except (SyntaxError, ValueError):
        return
    package = source.name if source.file.stem == "__init__" else source.name.rpartition(".")[0]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = f"{'.' * node.level}{node.module or ''}"
            try:
                base = importlib.util.resolve_name(base, package)
            except ImportError:  # a relative import in a file outside of a package
                continue
            # a name may be a module, too
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            if name.partition(".")[0] not in sys.stdlib_module_names:
                yield from _of_module(name)


def is_users(file: Path) -> bool:
    """Return whether a file belongs to the user, not to a package such as this one."""
    return not any(part in INSTALLED for part in file.parts) and not any(
        map(file.is_relative_to, _library_folders())
    )


@functools.cache
def _library_folders() -> tuple[Path, ...]:
    paths = sysconfig.get_paths()
    libraries = (Path(paths[name]).resolve() for name in ("stdlib", "platstdlib"))
    return (*libraries, Path(__file__).resolve().parents[1])
