"""What the extras add to the core, as text, so that nothing of them is imported before somebody asks for it.

The core imports no module of ``extras/``: it opens one by a name of this file. An extra imports what is public, the
names of :mod:`pytest_pafot.extending`, and the small tools of ``support/``; what it adds, it names here. A package of
somebody else adds an algorithm as ``module:Class``.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any, NamedTuple

from pytest_pafot.support.errors import RequestError

EXTRAS = "pytest_pafot.extras"
"""The package of the extras."""


class Command(NamedTuple):
    """A command of ``python -m pytest_pafot``: its module has ``add_arguments`` and ``run``."""

    module: str
    help: str
    about: str
    is_gate: bool = False
    """Whether its exit code is a verdict on a policy, so that it has to leave a receipt."""


COMMANDS: Mapping[str, Command] = MappingProxyType({
    "compare": Command(
        f"{EXTRAS}.comparison.command",
        "compare search algorithms on a policy",
        "Run several search algorithms on a policy, several times each, and write results, statistics, figures and a "
        "report. It can be interrupted at any time; the same command continues where it stopped.",
        is_gate=True,
    ),
    "rate": Command(
        f"{EXTRAS}.episodes.rate_command",
        "count how often a policy crashes by itself",
        "Drive seeded episodes in the environment's own traffic, without a search, and count the crashes of one "
        "policy, or of several on the same seeds.",
        is_gate=True,
    ),
    "export": Command(
        f"{EXTRAS}.export.export_command",
        "write the run of a finding as files for other tools",
        "Run the scenario of a saved finding once more, and write the paths of all vehicles and the road.",
    ),
})  # fmt: skip
"""The commands of the extras by name."""

ALGORITHMS: Mapping[str, str] = MappingProxyType({
    "av-fuzzer": f"{EXTRAS}.algorithms.av_fuzzer:AvFuzzerSearch",
})  # fmt: skip
"""The search algorithms that only comparisons need, by name."""

NAMES: Mapping[str, str] = MappingProxyType({
    "policies": f"{EXTRAS}.policies",
    "sumo": f"{EXTRAS}.sumo:sumo",
})  # fmt: skip
"""The public names of ``pytest_pafot`` that an extra has."""

DASK = f"{EXTRAS}.dask_cluster:connected"
"""A context manager for the option ``dask``: a function that makes pools of the workers of a scheduler."""


def opened(place: str) -> Any:
    """Import and return a module, or what has a name in it: ``module`` or ``module:name``.

    Raises:
        RequestError: if this installation has no extras.
    """
    module, _, name = place.partition(":")
    try:
        found = import_module(module)
    except ModuleNotFoundError as error:
        if not str(error.name).startswith(EXTRAS):
            raise
        raise RequestError(
            f"expected a whole installation of pytest-pafot, received one without {error.name}; install it again"
        ) from None
    return getattr(found, name) if name else found
