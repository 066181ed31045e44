"""The policy that a command is given, by name; and what its exit codes say."""

from __future__ import annotations

import difflib
import functools
import hashlib
import importlib
import pkgutil
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from pytest_pafot.world.driving.ads import weights_digest

BAD_USE = 2
"""Exit code for wrong arguments, as argparse has it."""

EXAMPLES = "example_ads"
"""The package of example policies: at the top of a clone, inside of this package where it is installed."""

OF_FILE = "file:"
"""How the identity of a policy begins that tells no hash of its weights."""


class PlanError(ValueError):
    """A comparison that cannot be made; the message says what was expected and what to do."""


def ads_factory(reference: str) -> Callable[..., Any]:
    """The factory that a name stands for.

    Raises:
        PlanError: when there is none.
    """
    parts = reference.split(":")
    if len(parts) > 3 or not all(parts):
        raise PlanError(
            f"--ads: expected the name of a module in {EXAMPLES}, module:factory or module:factory:argument, "
            f"received {reference!r}"
        )
    module_name = _module_name(reference)
    try:
        factory = getattr(_imported(module_name), parts[1] if len(parts) > 1 else "make", None)
    except ModuleNotFoundError as error:
        if len(parts) == 1 and EXAMPLES in (error.name or ""):
            names = (each.name for each in pkgutil.iter_modules(_imported(EXAMPLES).__path__))
            others = ("conftest", "defects")  # the factory of the second needs an argument
            policies = [name for name in names if name not in others and not name.startswith("test_")]
            near = difflib.get_close_matches(reference, policies, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise PlanError(
                f"--ads: expected one of {', '.join(policies)}, or module:factory for a policy of your own, received "
                f"{reference!r}{hint}"
            ) from None
        raise PlanError(
            f"--ads: expected a module that can be imported, received {reference!r} ({error}); run the command where "
            f"the module is, or give module:factory"
        ) from None
    if not callable(factory):
        raise PlanError(f"--ads: expected a factory in {module_name}, received {reference!r}, which is none")
    return functools.partial(factory, parts[2]) if len(parts) == 3 else factory


def identity(reference: str) -> str:
    """What tells a policy from another one of its name: the hash of its weights, else of the file of its module.

    Raises:
        PlanError: when there is none of this name.
        AdsFactoryError: for weights that cannot be read.
    """
    told = weights_digest(ads_factory(reference))
    if told:
        return told
    file = getattr(_imported(_module_name(reference)), "__file__", None)
    return OF_FILE + ("" if file is None else hashlib.sha256(Path(file).read_bytes()).hexdigest())


def module_of(reference: str) -> str:
    """The module that a name stands for, as it can be imported; only of a name that :func:`ads_factory` accepts."""
    return _imported(_module_name(reference)).__name__


def caution(references: Iterable[str]) -> str:
    """What to mind of policies of which only the file of the module is known to be the same; empty for nothing."""
    names = [each for each in references if identity(each).startswith(OF_FILE)]
    if not names:
        return ""
    return (
        f"{' and '.join(names)} tell{'s' if len(names) == 1 else ''} no hash of weights, so that only the file of the "
        "module is known to be the same: if it was trained or changed since then, give another --out"
    )


def _module_name(reference: str) -> str:
    name, colon, _ = reference.partition(":")
    return name if colon else f"{EXAMPLES}.{name}"


def _imported(module_name: str) -> ModuleType:
    """The module; one of the examples comes from the clone in which the command runs, or as it was installed."""
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name != EXAMPLES:
            raise
        return importlib.import_module(f"pytest_pafot.{module_name}")
