"""The policy that a command receives by name, and the exit code for wrong arguments."""

from __future__ import annotations

import difflib
import functools
import hashlib
import importlib
import keyword
import pkgutil
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from pytest_pafot.support.text import one_line
from pytest_pafot.world.driving.ads import weights_digest

BAD_USE = 2
"""The exit code for wrong arguments, the same as argparse's."""

EXAMPLES = "example_ads"
"""The package of example policies: at the top of a clone, or inside this package if it is installed."""

OF_FILE = "file:"
"""The prefix of the identity of a policy that has no hash of its weights."""


ABOUT_POLICIES = (
    "A factory makes a new policy for each run; a class with the method __call__(self, observation) is one. A policy "
    "returns (acceleration [m/s^2], steering [rad]). Its observation has time, ego, others, lanes, lane_width and "
    "speed_limit; the ego and each of the others have x, y, speed, heading, lane, length and width, in SI units. "
    "Steering, y and lanes grow to the right. With --world, a policy receives and returns what that environment "
    "defines."
)
"""What the help says of policies."""

MOST_NAMES = 8
"""The number of names of a module that an error lists."""


class PlanError(ValueError):
    """Wrong arguments of a command; the message says what was expected and what to do."""


def ads_factory(reference: str, option: str = "--ads", what: str = "a factory") -> Callable[..., Any]:
    """Return the factory with a name.

    Args:
        reference: the name.
        option: the name of the argument, for errors.
        what: description of the expected function, for errors.

    Raises:
        PlanError: if there is none.
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
    """Return the function of a run that ``--check`` names.

    Raises:
        PlanError: if there is none.
    """
    parts = reference.split(":")
    if len(parts) != 2 or not parts[1].isidentifier() or keyword.iskeyword(parts[1]):
        raise PlanError(f"--check: expected module:function of a function of a run, received {reference!r}")
    return ads_factory(reference, "--check", "a function of a run")


def described(error: BaseException) -> str:
    """Return the kind, the message and the place of an exception of the user's code, in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    text = one_line("".join(traceback.format_exception_only(error)))
    has_place = isinstance(error, SyntaxError) or not frames  # the message of a SyntaxError names the place
    return text if has_place else f"{text} ({frames[-1].filename}:{frames[-1].lineno})"


def identity(reference: str) -> str:
    """Return what identifies a version of a policy: the hash of its weights, or else of its module's file.

    Raises:
        PlanError: if there is no policy of this name.
        AdsFactoryError: if the weights cannot be read.
    """
    told = weights_digest(ads_factory(reference))
    if told:
        return told
    file = getattr(_imported(_module_name(reference)), "__file__", None)
    return OF_FILE + ("" if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest())


def module_of(reference: str) -> str:
    """Return the importable name of a policy's module; :func:`ads_factory` must accept the policy's name."""
    return _imported(_module_name(reference)).__name__


def caution(references: Iterable[str]) -> str:
    """Return a warning about policies of which only the module's file is known to be unchanged; empty if none."""
    names = [each for each in references if identity(each).startswith(OF_FILE)]
    if not names:
        return ""
    return (
        f"{' and '.join(names)} provide{'s' if len(names) == 1 else ''} no hash of weights, so only the module's file "
        "is known to be the same: if the policy was trained or changed since then, give a different --out"
    )


def _module_name(reference: str) -> str:
    name, colon, _ = reference.partition(":")
    return name if colon else f"{EXAMPLES}.{name}"


def _imported(module_name: str) -> ModuleType:
    """Import a module; an example comes from the clone in which the command runs, or else from the installation."""
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name != EXAMPLES:
            raise
        return importlib.import_module(f"pytest_pafot.{module_name}")
