"""The policies, worlds and checks that command-line arguments name."""

from __future__ import annotations

import argparse
import importlib.util
import json
import pkgutil
from collections.abc import Callable, Iterable
from typing import Any

from pytest_pafot.support.errors import RequestError, check_asserts
from pytest_pafot.support.process import cores
from pytest_pafot.support.references import PLANNER, factory_named
from pytest_pafot.support.text import suggest

# The exit code for wrong arguments, as in argparse.
BAD_USE = 2

# The package of example policies. It is in the top folder of a clone, or inside this package if it is installed.
EXAMPLES = "example_ads"

# The end of the help of commands.
ABOUT_POLICIES = (
    "A factory makes a new policy for each run, for example a class with the method __call__(self, observation). A "
    "policy returns (acceleration [m/s^2], steering [rad]). The observation has time, ego, others, lanes, lane_width "
    "and speed_limit. The ego and each other vehicle have x, y, speed, heading, lane, length and width, in SI units. "
    "Steering and y are positive to the right, and lanes are numbered from left to right. With an environment as "
    "--world, a policy uses the observations and actions of that environment, unless its name ends with @planner."
)


def ads_factory(
    reference: str, option: str = "--ads", what: str = "a factory"
) -> Callable[..., Any]:
    """Return the policy factory that the user names on the command line.

    Args:
        reference: a module of ``example_ads``, ``module:factory``, or ``module:factory:argument``.
        option: name of the option, for errors.
        what: description of the expected function, for errors.

    Raises:
        RequestError: if there is no such factory.
    """
    reference = reference.removesuffix(PLANNER)
    if ":" not in reference:
        examples = importlib.import_module(_package_of_examples())
        names = [each.name for each in pkgutil.iter_modules(examples.__path__)]
        others = ("conftest", "defects")  # no policies; the factory of `defects` needs an argument
        policies = [name for name in names if name not in others and not name.startswith("test_")]
        if reference not in names:
            hint = suggest(reference, policies)
            raise RequestError(
                f"{option}: expected one of {', '.join(policies)}, or module:factory for your own policy, "
                f"received {reference!r}{hint}"
            )
    try:
        return factory_named(whole_name(reference), what)
    except ValueError as error:
        raise RequestError(f"{option}: {error}") from error


def whole_name(reference: str) -> str:
    """Return ``module:factory[:argument]`` for a name that :func:`ads_factory` accepts."""
    # Example policies come from the clone in which the command runs, or else from the installed package.
    reference = reference.removesuffix(PLANNER)
    if ":" not in reference:
        reference = f"{EXAMPLES}.{reference}:make"
    if reference.startswith(f"{EXAMPLES}."):
        return f"{_package_of_examples()}{reference.removeprefix(EXAMPLES)}"
    return reference


def add_world_arguments(
    parser: argparse.ArgumentParser, note: str, *, is_needed: bool = False, has_config: bool = True
) -> None:
    """Declare ``--world`` and ``--config``. ``note`` is the end of the help text of ``--world``."""
    parser.epilog = ABOUT_POLICIES
    of_world = "drive in this world: the id of a highway-env environment such as highway-v0, module:id if that module "
    of_world += f"registers it, or module:factory for a factory of a pafot.World or a pafot.SimulatorWorld ({note})"
    parser.add_argument("--world", metavar="WORLD", required=is_needed, help=of_world)
    of_config = "set options of the environment that --world names by id, as in gymnasium.make"
    if has_config:
        parser.add_argument("--config", metavar="JSON", help=of_config)


def chosen_world(
    reference: str | None,
    config: str | None = None,
    policies: Iterable[str] = (),
    *,
    is_planner: bool = False,
) -> Any:
    """Return the world that ``--world`` and ``--config`` describe, or None.

    Args:
        reference, config: values of the options.
        policies: names of policies, which are imported first because they may register the environment.
        is_planner: whether an environment is for a planner in SI units.

    Raises:
        RequestError: if the world or a policy does not exist.
    """
    for each in policies:
        ads_factory(each)
    options = config_of(config)
    if reference is not None:
        from pytest_pafot.searches.request import named_world  # noqa: PLC0415  (takes a while, and few commands need it)

        return named_world(reference, "--world", config=options, is_planner=is_planner)
    if options is not None:
        raise RequestError("--config: expected an environment, received none. Add --world")
    return None


def _package_of_examples() -> str:
    return EXAMPLES if importlib.util.find_spec(EXAMPLES) else f"pytest_pafot.{EXAMPLES}"


def check_function(reference: str) -> Callable[..., Any]:
    """Return the function that ``--check`` names.

    Raises:
        RequestError: if there is no such function.
    """
    if reference.count(":") != 1:
        raise RequestError(
            f"--check: expected module:function, received {reference!r}. The function must take a run"
        )
    function = ads_factory(reference, "--check", "a function that takes a run")
    check_asserts(function)
    return function


def config_of(text: str | None) -> dict[str, Any] | None:
    """Return the environment's options from the JSON in ``--config``, or None if there is no JSON.

    Raises:
        RequestError: if ``text`` is not a JSON object.
    """
    if text is None:
        return None
    expected = "--config: expected JSON such as '{\"vehicles_count\": 20}'"
    try:
        config = json.loads(text, parse_constant=_refuse)
    except ValueError as error:  # includes JSONDecodeError
        raise RequestError(f"{expected}, received {text!r:.100} ({error})") from None
    if not isinstance(config, dict):
        raise RequestError(f"{expected}, received {config!r:.100}")
    return config


def _refuse(constant: str) -> None:
    raise ValueError(f"JSON has no {constant}")  # NaN or Infinity, which Python reads


def worker_count(given: int | None) -> int:
    """Return the number of processes for ``--workers``, by default one per core.

    Raises:
        RequestError: if the number is less than one.
    """
    if given is not None and given < 1:
        raise RequestError(f"--workers: expected a whole number, at least 1, received {given}")
    return given or cores()
