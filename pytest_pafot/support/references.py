"""Names of the user's objects in texts: ``module:name``, and for a policy also ``module:factory:argument``."""

from __future__ import annotations

import difflib
import functools
import importlib
import os
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from pytest_pafot.support.text import one_line

MOST_NAMES = 8
"""The largest number of a module's names that an error lists."""

PLANNER = "@planner"
"""The suffix of the name of a policy that is a planner in SI units, although it drives in an environment."""


def factory_named(reference: str, what: str = "a factory") -> Callable[..., Any]:
    """Import the factory that a text such as ``module:factory`` or ``module:factory:argument`` refers to.

    The factory of the second is called with the argument, a text. It may have colons itself.

    Raises:
        ValueError: if the text has another form, or does not name anything that can be called; the caller adds the
            place to the message. ``what`` describes what was expected.
    """
    module, _, rest = reference.partition(":")
    name, colon, argument = rest.partition(":")
    if not (module and name) or (colon and not argument):
        raise ValueError(f"expected module:factory or module:factory:argument, received {reference!r}")
    factory = referred_to(f"{module}:{name}", what)
    if not callable(factory):
        received = f"{reference!r}, which is of the type {type(factory).__name__}"
        raise ValueError(f"expected {what}, received {received}; name a function or a class")
    return functools.partial(factory, argument) if argument else factory


def referred_to(reference: str, what: str = "a name") -> Any:
    """Import the object that a text such as ``module:name`` refers to.

    Raises:
        ValueError: if there is no such module, or no such name in it; the caller adds the place to the message.
    """
    module_name, _, name = reference.partition(":")
    module = imported(reference)
    if not hasattr(module, name):
        near = difflib.get_close_matches(name, vars(module), n=1)
        own = [each for each, value in vars(module).items() if getattr(value, "__module__", "") == module_name]
        hint = f"; did you mean {f'{module_name}:{near[0]}'!r}?" if near else ""
        hint = hint or (f"; it has {', '.join(own[:MOST_NAMES])}" if own else "; it has no such name")
        file = getattr(module, "__file__", None) or "built into Python"
        hint += "" if Path(file).is_relative_to(Path.cwd()) else f"; this module is {file}"  # one of the same name
        raise ValueError(f"expected {what} in the module {module_name}, received {reference!r}{hint}")
    return getattr(module, name)


def imported(reference: str) -> ModuleType:
    """Import the module that a text such as ``module:name`` names.

    Raises:
        ValueError: if there is no such module, or it raises; the caller adds the place to the message.
    """
    module_name, _, name = reference.partition(":")
    try:
        if not module_name or module_name.startswith("."):  # which would be relative to nothing
            raise ModuleNotFoundError(f"No module named {module_name!r}", name=module_name)
        return importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # A script without a guard calls sys.exit() in its import.
        # A module that lacks another one raises ModuleNotFoundError, too.
        is_missing = isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(f"{error.name}.")
        way_out = "run where it is, or put its folder on the path (pytest: `pythonpath = .`)"
        path = os.path.relpath(module_name.removesuffix(".py") or ".").replace(os.sep, ".")
        if path != module_name and not path.startswith("."):  # else it is no path, or not below this folder
            way_out = f"give {path}:{name}"
        received = f" ({type(error).__name__}: {error})" if is_missing else f", which raises {described(error)}"
        way_out = way_out if is_missing else "correct it"
        raise ValueError(
            f"expected a module that can be imported, received {reference!r}{received}; {way_out}"
        ) from error


def name_of(factory: Callable[..., Any]) -> str:
    """Return ``module:name`` of a function or a class that a text can refer to; empty for any other factory."""
    name = f"{getattr(factory, '__module__', '')}:{getattr(factory, '__qualname__', '')}"
    try:
        return name if referred_to(name) is factory else ""
    except ValueError:
        return ""


def described(error: BaseException) -> str:
    """Describe an exception of the user's code in one line: its class, its message and its place."""
    # The line of this package that called the user's code, or refused a value, is not where to look.
    # Nor is code that is in no file, such as the `__init__` of a dataclass.
    here = f"{Path(__file__).parents[1]}{os.sep}", "<"
    frames = [each for each in traceback.extract_tb(error.__traceback__) if not each.filename.startswith(here)]
    text = one_line("".join(traceback.format_exception_only(error)))
    has_place = isinstance(error, SyntaxError) or not frames  # the message of a SyntaxError names the place
    return text if has_place else f"{text} ({frames[-1].filename}:{frames[-1].lineno})"
