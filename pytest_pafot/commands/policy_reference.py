"""The names of policies on the command line, and the exit code for wrong arguments."""

from __future__ import annotations

import difflib
import functools
import importlib
import keyword
import os
import pkgutil
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from pytest_pafot.support.source_files import source_digests
from pytest_pafot.support.text import one_line
from pytest_pafot.world.driving.ads import weights_digest

BAD_USE = 2
"""The exit code for wrong arguments, which argparse uses as well."""

EXAMPLES = "example_ads"
"""The package of example policies: at the top of a clone, or inside this package if it is installed."""

ABOUT_POLICIES = (
    "A factory makes a new policy for each run; a class with the method __call__(self, observation) is one. A policy "
    "returns (acceleration [m/s^2], steering [rad]). Its observation has time, ego, others, lanes, lane_width and "
    "speed_limit; the ego and each of the others have x, y, speed, heading, lane, length and width, in SI units. "
    "Steering, y and lanes grow to the right. With --world, a policy receives and returns what that environment "
    "defines."
)
"""The text on policies in the help of commands."""

MOST_NAMES = 8
"""The largest number of a module's names that an error lists."""


class PlanError(ValueError):
    """An error for wrong arguments of a command. The message says what was expected and what to do."""


def ads_factory(reference: str, option: str = "--ads", what: str = "a factory") -> Callable[..., Any]:
    """Return the ADS factory that the user names on the command line.

    Args:
        reference: the name: a module of ``example_ads``, module:factory, or module:factory:argument.
        option: the name of the option, for errors.
        what: a description of the expected function, for errors.

    Raises:
        PlanError: if there is no such factory.
    """
    parts = reference.split(":")
    if len(parts) > 3 or not all(parts):
        raise PlanError(
            f"{option}: expected the name of a module in {EXAMPLES}, module:factory or module:factory:argument, "
            f"received {reference!r}"
        )
    module_name = _module_name(reference)
    try:
        module = _imported(module_name)
    except ModuleNotFoundError as error:
        if len(parts) == 1 and EXAMPLES in (error.name or ""):
            names = (each.name for each in pkgutil.iter_modules(_imported(EXAMPLES).__path__))
            others = ("conftest", "defects")  # the factory of the second needs an argument
            policies = [name for name in names if name not in others and not name.startswith("test_")]
            near = difflib.get_close_matches(reference, policies, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise PlanError(
                f"{option}: expected one of {', '.join(policies)}, or module:factory for your own policy, "
                f"received {reference!r}{hint}"
            ) from None
        is_file = module_name.endswith(".py")
        dotted = reference.replace(module_name, module_name.removesuffix(".py").replace("/", "."))
        raise PlanError(
            f"{option}: expected a module that can be imported, received {reference!r} ({error}); "
            + (f"give {dotted}" if is_file else "run the command in the folder of the module, or give module:factory")
        ) from None
    except Exception as error:
        received = f"{reference!r}, which raises {described(error)}"
        raise PlanError(f"{option}: expected a module that can be imported, received {received}; correct it") from error
    factory = getattr(module, parts[1] if len(parts) > 1 else "make", None)
    if not callable(factory):
        own = [name for name, each in vars(module).items() if getattr(each, "__module__", "") == module_name]
        fix = f"; it has {', '.join(own[:MOST_NAMES])}" if own else ""
        raise PlanError(f"{option}: expected {what} in {module_name}, received {reference!r}, which is none{fix}")
    return functools.partial(factory, parts[2]) if len(parts) == 3 else factory


def check_function(reference: str) -> Callable[..., Any]:
    """Return the function that ``--check`` names; it is called with a run.

    Raises:
        PlanError: if there is no such function.
    """
    parts = reference.split(":")
    if len(parts) != 2 or not parts[1].isidentifier() or keyword.iskeyword(parts[1]):
        raise PlanError(f"--check: expected the name module:function of a function of a run, received {reference!r}")
    return ads_factory(reference, "--check", "a function of a run")


def described(error: BaseException, folder: Path | None = None) -> str:
    """Describe an exception of the user's code in one line: its class, its message and its place.

    Paths below ``folder``, if there is one, are relative to it.
    """
    frames = traceback.extract_tb(error.__traceback__)
    prefix = "" if folder is None else f"{folder}{os.sep}"
    text = one_line("".join(traceback.format_exception_only(error)).replace(prefix, ""))
    has_place = isinstance(error, SyntaxError) or not frames  # the message of a SyntaxError names the place
    return text if has_place else f"{text} ({frames[-1].filename.removeprefix(prefix)}:{frames[-1].lineno})"


def identity(reference: str) -> dict[str, Any]:
    """Return what identifies a policy and its version: the hashes of its weights and of its source files.

    The source files are those of the user, with all that they import. The code of an example policy that is installed
    with this package has the version of this package.

    Raises:
        PlanError: if there is no policy of the given name.
        AdsFactoryError: if the weights cannot be read.
    """
    factory = ads_factory(reference)
    code = source_digests(_imported(_module_name(reference)), factory, here=Path.cwd())
    return {"weights": weights_digest(factory), "code": code}


def module_of(reference: str) -> str:
    """Return the importable name of a policy's module, for a name that :func:`ads_factory` accepts."""
    return _imported(_module_name(reference)).__name__


def caution(references: Iterable[str]) -> str:
    """Return a warning about policies whose weights have no hash, so that changes may go unnoticed; or empty."""
    names = [each for each in references if not weights_digest(ads_factory(each))]
    if not names:
        return ""
    return (
        f"{' and '.join(names)} provide{'s' if len(names) == 1 else ''} no hash of weights, so only the source "
        "files are known to be the same: if the policy was trained since then, or reads a file that has changed, give "
        "another --out"
    )


def _module_name(reference: str) -> str:
    name, colon, _ = reference.partition(":")
    return name if colon else f"{EXAMPLES}.{name}"


def _imported(module_name: str) -> ModuleType:
    """Import a module. An example policy is imported from the clone in which the command runs, else as installed."""
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name != EXAMPLES:
            raise
        return importlib.import_module(f"pytest_pafot.{module_name}")
