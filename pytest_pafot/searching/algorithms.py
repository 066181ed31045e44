"""The search algorithms by name. Those that rest on a library of their own are imported when they are asked for."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Any

from pytest_pafot.searching.search_loop import Algorithm
from pytest_pafot.searching.space import SearchSpace


@dataclass(frozen=True, slots=True)
class Entry:
    """Where an algorithm is.

    Attributes:
        module, class_name: within :mod:`pytest_pafot.searching`.
        fitness: that it maximises unless another one is asked for.
        library: that it needs beside this package, as pip knows it.
        knows_grid: whether its genes are Position-Instructions; else they are Lane-Instructions.
        reads_near_misses: whether it makes use of :attr:`~pytest_pafot.searching.Evaluation.near_misses`.
    """

    module: str
    class_name: str
    fitness: str = "default"
    library: str | None = None
    knows_grid: bool = True
    reads_near_misses: bool = False


CATALOGUE: Mapping[str, Entry] = MappingProxyType(
    {
        "distinct": Entry("distinct", "DistinctSearch", reads_near_misses=True),
        "pafot": Entry("pafot", "PafotSearch"),
        "av-fuzzer": Entry("av_fuzzer", "AvFuzzerSearch", fitness="av-fuzzer", knows_grid=False),
        "random": Entry("random_search", "RandomSearch"),
        "random-manoeuvre": Entry("random_search", "RandomManoeuvreSearch", knows_grid=False),
        "nsga2": Entry("nsga2", "Nsga2Search", library="pymoo"),
        "map-elites": Entry("map_elites", "MapElitesSearch", library="ribs"),
        "cma-es": Entry("cma_es", "CmaEsSearch", library="cmaes"),
    }
)

ALGORITHMS = tuple(CATALOGUE)
"""Names that :func:`algorithm_named` takes."""


def algorithm_named(name: str, space: SearchSpace, **parameters: Any) -> Algorithm[Any]:
    """The search algorithm of a name, with its own parameters, such as ``population=4``.

    Raises:
        ValueError: for a name or a parameter that does not exist, in a message that lists those that do; and where the
            library of the algorithm is not installed, in a message that tells how to install it.
    """
    if name not in CATALOGUE:
        near = difflib.get_close_matches(name, ALGORITHMS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"algorithm: expected one of {', '.join(ALGORITHMS)}, received {name!r}{hint}")
    algorithm = _class(name)
    known = [parameter for parameter in inspect.signature(algorithm).parameters if parameter != "space"]
    for parameter in parameters:
        if parameter not in known:
            raise ValueError(
                f"{parameter}: expected a parameter of the algorithm {name!r}, which takes {', '.join(known)}"
            )
    made: Algorithm[Any] = algorithm(space, **parameters)
    return made


def check_road(name: str, *, is_straight: bool) -> None:
    """Check an algorithm against a road that is straight, or not.

    Raises:
        ValueError: for one with Lane-Instructions where the road is not straight, with those that can be used.
    """
    if CATALOGUE[name].knows_grid or is_straight:
        return
    others = ", ".join(other for other, entry in CATALOGUE.items() if entry.knows_grid)
    raise ValueError(
        f"algorithm: expected one of {others} on a road that is not straight, received {name!r}, whose "
        "Lane-Instructions know no lanes that begin and end; or take a straight road such as pafot.Highway()"
    )


def reads_near_misses(name: str) -> bool:
    """Whether an algorithm makes use of near-misses, so that it is worth looking for them."""
    return CATALOGUE[name].reads_near_misses


def fitness_of(name: str) -> str:
    """The name of the fitness that an algorithm maximises unless another one is asked for."""
    return CATALOGUE[name].fitness


def _class(name: str) -> Any:
    entry = CATALOGUE[name]
    try:
        return getattr(import_module(f"pytest_pafot.searching.{entry.module}"), entry.class_name)
    except ModuleNotFoundError as error:
        if entry.library is None or (error.name or "").partition(".")[0] != entry.library:
            raise
        raise ValueError(
            f"algorithm: expected {name!r} with the library {entry.library}, received an environment without it; "
            f"run `pip install 'pytest-pafot[search]'` or `pip install {entry.library}`"
        ) from None
