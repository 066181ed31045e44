"""The search algorithms by name, and those of others by class: what can be asked of either before it runs."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any

from pytest_pafot.searching.algorithms.av_fuzzer import AvFuzzerSearch
from pytest_pafot.searching.algorithms.cma_es import CmaEsSearch
from pytest_pafot.searching.algorithms.distinct import DistinctSearch
from pytest_pafot.searching.algorithms.map_elites import MapElitesSearch
from pytest_pafot.searching.algorithms.nsga2 import Nsga2Search
from pytest_pafot.searching.algorithms.pafot import PafotSearch
from pytest_pafot.searching.algorithms.random_search import RandomManoeuvreSearch, RandomSearch
from pytest_pafot.searching.ask_tell import Algorithm
from pytest_pafot.searching.fitness import Fitness, Weights, referred_to
from pytest_pafot.searching.space import SearchSpace

CATALOGUE: Mapping[str, type[Algorithm[Any]]] = MappingProxyType({each.name: each for each in (
    DistinctSearch, PafotSearch, AvFuzzerSearch, RandomSearch, RandomManoeuvreSearch, Nsga2Search, MapElitesSearch,
    CmaEsSearch,
)})  # fmt: skip
"""Ours by name; a new one is imported and listed here."""

ALGORITHMS = tuple(CATALOGUE)  # names that :func:`resolve_algorithm` takes


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmClass:
    """The class of a search algorithm, and what it says of itself by class attributes.

    All but the name may be missing in a class; they are then as here.
    """

    made_by: Callable[..., Algorithm[Any]]  # the class
    name: str  # by which files and reports call it
    # that it maximises unless another one is asked for: a name, weights or a function
    fitness: str | Weights | Fitness = "default"
    knows_grid: bool = True  # whether its genes are Position-Instructions; else they are Lane-Instructions
    is_papers: bool = False  # whether its scenarios are the paper's: two NPCs, one start, no patterns
    batch_population: int | None = None  # scenarios in a generation where the ADS decides for many runs at once
    library: str | None = None  # that it needs beside this package, as it is imported

    def make(self, space: SearchSpace, **parameters: Any) -> Algorithm[Any]:
        """The algorithm on a space, with its own parameters, such as ``population=4``.

        Raises:
            ValueError: for a parameter that does not exist, in a message that lists those that do; and where the
                library of the algorithm is not installed, in a message that tells how to install it.
        """
        if self.library is not None and find_spec(self.library) is None:
            extra = "`pip install 'pytest-pafot[search]'` or " if self.name in CATALOGUE else ""
            raise ValueError(
                f"algorithm: expected {self.name!r} with the library {self.library}, received an environment without "
                f"it; run {extra}`pip install {self.library}`"
            )
        known = [parameter for parameter in inspect.signature(self.made_by).parameters if parameter != "space"]
        for parameter in parameters:
            if parameter not in known:
                raise ValueError(
                    f"{parameter}: expected a parameter of the algorithm {self.name!r}, which takes {', '.join(known)}"
                )
        return self.made_by(space, **parameters)

    def check_road(self, *, is_straight: bool) -> None:
        """Check the algorithm against a road that is straight, or not.

        Raises:
            ValueError: for one with Lane-Instructions where the road is not straight, with those that can be used.
        """
        if self.knows_grid or is_straight:
            return
        others = ", ".join(name for name in ALGORITHMS if resolve_algorithm(name).knows_grid)
        raise ValueError(
            f"algorithm: expected one of {others} on a road that is not straight, received {self.name!r}, whose "
            "Lane-Instructions know no lanes that begin and end; or take a straight road such as pafot.Highway()"
        )


def resolve_algorithm(given: str | type[Algorithm[Any]]) -> AlgorithmClass:
    """The algorithm of a name, of ``module:Class`` or of a class, see :class:`~pytest_pafot.searching.Algorithm`.

    Raises:
        ValueError: for anything else, in a message that lists the names and what the class must have.
    """
    made_by = _named(given) if isinstance(given, str) else given
    _check_class(made_by)
    said = {each.name: getattr(made_by, each.name) for each in fields(AlgorithmClass) if hasattr(made_by, each.name)}
    return AlgorithmClass(made_by=made_by, **said)


def _named(given: str) -> Any:
    if given in CATALOGUE:
        return CATALOGUE[given]
    if ":" in given:
        try:
            return referred_to(given)
        except ValueError as error:
            raise ValueError(f"algorithm: {error}") from error
    near = difflib.get_close_matches(given, ALGORITHMS, n=1)
    hint = f"did you mean {near[0]!r}?" if near else "or give module:Class for an algorithm of your own"
    raise ValueError(f"algorithm: expected one of {', '.join(ALGORITHMS)}, received {given!r}; {hint}")


def _check_class(given: Any) -> None:
    if not isinstance(given, type):
        raise ValueError(
            f"algorithm: expected one of {', '.join(ALGORITHMS)}, a class, or module:Class, received {given!r}; give "
            "the class itself, which is called with the space and population="
        )
    name = getattr(given, "name", None)
    missing = [method for method in ("start", "ask", "tell") if not callable(getattr(given, method, None))]
    missing += sorted(getattr(given, "__abstractmethods__", ()))
    missing += [] if isinstance(name, str) else ["name"]
    if missing:
        raise ValueError(
            f"algorithm: expected a class with a name, start, ask and tell, received {given.__name__} without "
            f"{', '.join(missing)}; derive it from pytest_pafot.searching.GenerationalSearch, or see "
            "pytest_pafot.searching.Algorithm"
        )
    if CATALOGUE.get(str(name), given) is not given:
        raise ValueError(
            f"algorithm: expected a name of its own for {given.__name__}, received {name!r}, by which files and "
            "reports call another one; set its class attribute name"
        )
