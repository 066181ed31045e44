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
from contextlib import suppress
from importlib.machinery import ModuleSpec, PathFinder
from itertools import accumulate
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
    if not argument:
        return factory  # type: ignore[no-any-return]
    return functools.partial(factory, argument)


def referred_to(reference: str, what: str = "a name") -> Any:
    """Import the object in a string such as ``module:name``, or raise a ``ValueError``."""
    module_name, _, name = reference.partition(":")
    module = imported(reference)
    if hasattr(module, name):
        return getattr(module, name)
    near = difflib.get_close_matches(name, vars(module), n=1)
    if near:
        hint = f". Did you mean {f'{module_name}:{near[0]}'!r}?"
        subject = " The module"
    else:
        own = [
            each
            for each, value in vars(module).items()
            if getattr(value, "__module__", "") == module_name
        ]
        if len(own) > MOST_NAMES:
            own[MOST_NAMES:] = ["others"]
        hint = f". The module defines {listed(own) or 'no functions or classes'}"
        subject = ". It"
    file = getattr(module, "__file__", None) or ""
    # The user may have expected another module with the same name.
    if not Path(file).is_relative_to(Path.cwd()):
        origin = f"was loaded from {file}" if file else "is built into Python"
        hint += f"{subject} {origin}"
    raise ValueError(f"expected {what} in the module {module_name}, received {reference!r}{hint}")


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
        if isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(
            f"{error.name}."
        ):
            received = f" ({type(error).__name__}: {error})"
            way_out = "Change to the module's folder, or add it to the Python path (pytest setting: `pythonpath = .`)"
            path = os.path.relpath(module_name.removesuffix(".py") or ".")
            path = path.replace(os.sep, ".")
            # otherwise, it is not a path, or not below this folder
            if path != module_name and not path.startswith("."):
                way_out = f"Write {path}:{name}"
        else:
            received = f", whose import raises {described(error)}"
            way_out = "Correct the module"
        raise ValueError(
            f"expected a module that can be imported, received {reference!r}{received}. {way_out}"
        ) from error


def name_of(factory: Callable[..., Any]) -> str:
    """Return the name ``module:name`` of a function or class, or an empty string if it cannot be imported."""
    name = f"{getattr(factory, '__module__', '')}:{getattr(factory, '__qualname__', '')}"
    with suppress(ValueError):
        if referred_to(name) is factory:
            return name
    return ""


def policy_name(factory: Any) -> str:
    """Return the display name ``module:name`` of the class or function that makes a policy."""
    # A lambda has the name of the one class or function that it uses, if it uses no other.
    made = inspect.unwrap(factory)
    while isinstance(made, functools.partial):
        made = made.func
    if isinstance(made, FunctionType) and made.__name__ == "<lambda>":
        uses = inspect.getclosurevars(made)
        values = [*uses.nonlocals.values(), *uses.globals.values()]
        used = [each for each in values if hasattr(each, "__qualname__")]
        if len(used) == 1:
            made = used[0]
    if not hasattr(made, "__qualname__"):
        made = type(made)
    return f"{made.__module__}:{made.__qualname__}"


def described(error: BaseException) -> str:
    """Describe an exception in the user's code in one line: class, message and position."""
    # Skip lines of this package, which only called the user's code or rejected a value, and code without a file, such
    # as the `__init__` of a dataclass.
    skipped = f"{Path(__file__).parents[1]}{os.sep}", "<"
    frames = [
        each
        for each in traceback.extract_tb(error.__traceback__)
        if not each.filename.startswith(skipped)
    ]
    text = one_line("".join(traceback.format_exception_only(error)))
    # the message of a SyntaxError names the place
    if frames and not isinstance(error, SyntaxError):
        text += f" ({frames[-1].filename}:{frames[-1].lineno})"
    return text


# Folders with installed packages.
INSTALLED = ("site-packages", "dist-packages")


class _Source(NamedTuple):
    name: str  # the name of the module
    file: Path


def source_files(*values: object) -> dict[Path, tuple[str, str]]:
    """Return the source files of the user's objects and of their imports, with module names and content hashes."""
    found: dict[Path, tuple[str, str]] = {}
    left: list[_Source] = []
    for value in values:
        left += _defining(value, set())
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
    for part in _held(value):
        if callable(part):
            yield from _defining(part, seen)


def _held(value: object) -> list[object]:
    if isinstance(value, FunctionType):
        held = [cell.cell_contents for cell in value.__closure__ or () if _is_filled(cell)]
        held += [value.__defaults__, value.__kwdefaults__, inspect.unwrap(value)]
    elif isinstance(value, MethodType):
        held = [value.__func__, value.__self__]
    elif isinstance(value, functools.partial):
        held = [value.func, value.args, value.keywords]
    elif callable(value) and not isinstance(value, (ModuleType, type)):
        held = [type(value), *getattr(value, "__dict__", {}).values()]
    else:
        return []
    parts: list[object] = []
    for each in held:
        if isinstance(each, dict):
            parts += each.values()
        elif isinstance(each, (list, tuple)):
            parts += each
        else:
            parts.append(each)
    return parts


def _is_filled(cell: object) -> bool:
    try:
        cell.cell_contents  # type: ignore[attr-defined]  # noqa: B018
    except ValueError:  # a variable that has no value yet
        return False
    return True


def _of_module(name: str) -> Iterator[_Source]:
    # The code of the packages around a module runs when it is imported.
    for part in accumulate(name.split("."), "{}.{}".format):
        file = _file_of(part)
        if file is not None:
            yield _Source(part, file)


def _file_of(name: str) -> Path | None:
    # Nothing is imported here.
    file = None
    module = sys.modules.get(name)
    if module is not None:
        file = getattr(module, "__file__", None)
    else:
        with suppress(ImportError, ValueError):
            spec = _spec_of(name)
            if spec is not None and spec.has_location:
                file = spec.origin
    if file is None:
        return None
    return Path(file)


def _spec_of(name: str) -> ModuleSpec | None:
    package, _, _ = name.rpartition(".")
    if not package:
        # by all finders, including those of editable installs
        return importlib.util.find_spec(name)
    folders = getattr(sys.modules.get(package), "__path__", None)
    if not folders:
        holder = _spec_of(package)
        folders = []
        if holder is not None:
            folders = holder.submodule_search_locations or []
    return PathFinder.find_spec(name, folders)


def _imported(source: _Source, content: bytes) -> Iterator[_Source]:
    if source.file.suffix != ".py":
        return
    try:
        tree = ast.parse(content)
    # the file was broken after its import; its hash has changed in any case
    except (SyntaxError, ValueError):
        return
    package = source.name
    if source.file.stem != "__init__":
        package, _, _ = source.name.rpartition(".")
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
    if any(part in INSTALLED for part in file.parts):
        return False
    return not any(map(file.is_relative_to, _library_folders()))


@functools.cache
def _library_folders() -> tuple[Path, ...]:
    paths = sysconfig.get_paths()
    libraries = (Path(paths[name]).resolve() for name in ("stdlib", "platstdlib"))
    return (*libraries, Path(__file__).resolve().parents[1])
