"""The search algorithms by name, with random search, users' own algorithms by class, and the checks before a search.

The paper's Random manipulates "the driving behaviours of NPCs at specified intervals" (section 4.2), which can mean
random Position-Instructions or random manoeuvres. There is a search for each. Both sample every scenario independently,
and learn nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, ClassVar

from numpy.random import Generator

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.searching.algorithms.av_fuzzer import AvFuzzerSearch
from pytest_pafot.searching.algorithms.pafot import PafotSearch
from pytest_pafot.searching.fitness import Fitness
from pytest_pafot.searching.plan import Algorithm, GenerationalSearch, GenerationState
from pytest_pafot.searching.space import LANE_SHARES, SearchSpace, sample, sample_manoeuvres
from pytest_pafot.support.references import referred_to
from pytest_pafot.support.text import meant


@dataclass(frozen=True, slots=True)
class RandomSearch:
    """The default search, which samples valid scenarios at random, each by its number.

    Scenario number n follows from the seed and from n alone. So whoever needs it draws it, in any process and order.
    """

    name: ClassVar[str] = "random"
    draws_vehicles: ClassVar[bool] = True

    space: SearchSpace = field(default_factory=SearchSpace)

    def drawn(self, seed: int, number: int) -> Scenario:
        """Return the scenario of a number, which is counted from 0."""
        return sample(self.space, rng_of(seed, number, 0))


@dataclass(frozen=True, slots=True)
class RandomManoeuvreSearch(GenerationalSearch[GenerationState]):
    """A search that samples random manoeuvres, one for each time slice, as AV-Fuzzer has them.

    See the algorithm ``av-fuzzer``. Its generations are as large as those of the paper's search (section 4.2).

    Attributes:
        slices: number of manoeuvres of each NPC; together they last as long as the genes of the space.
    """

    name: ClassVar[str] = "random-manoeuvre"
    is_papers: ClassVar[bool] = True
    instructions: ClassVar[tuple[str, ...]] = ("lanes",)

    slices: int = field(default=5, kw_only=True)

    def start(self, rng: Generator) -> GenerationState:
        """Return the state before the first generation, without using a random number."""
        return GenerationState()

    def propose(self, state: GenerationState, rng: Generator) -> tuple[GenerationState, Iterable[Scenario]]:
        """Propose a generation of random scenarios of Lane-Instructions."""
        space: Any = self.space.sliced(self.slices)
        return state, (sample_manoeuvres(space, rng) for _ in range(self.population))


CLASSES: Mapping[str, type[Any]] = MappingProxyType({
    each.name: each for each in (RandomSearch, PafotSearch, RandomManoeuvreSearch, AvFuzzerSearch)
})  # fmt: skip
"""The algorithms by name."""

ALGORITHMS = tuple(CLASSES)
"""The names that :func:`resolve_algorithm` accepts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmClass:
    """The class of a search algorithm, and the values of its class attributes.

    A class must have the attribute ``name``. Other attributes that it lacks have the defaults below.
    """

    made_by: Callable[..., Any]  # the class
    name: str  # the name in files and reports
    # the fitness that it maximises unless a different one is requested: a name or a function
    fitness: str | Fitness = "default"
    instructions: Sequence[str] = tuple(LANE_SHARES)  # the kinds of instructions that it can sample, last the default
    is_papers: bool = False  # whether its scenarios are the paper's: two NPCs, one start, no patterns
    draws_vehicles: bool = False  # whether NPCs are all vehicles that fit the world, if the mark does not name some

    @property
    def draws_by_number(self) -> bool:
        """True if it draws each scenario by its number, and has no generations."""
        return self.made_by is RandomSearch

    def make(self, space: SearchSpace) -> Algorithm[Any] | RandomSearch:
        """Make the algorithm for a space."""
        made: Algorithm[Any] | RandomSearch = self.made_by(space)
        return made


def resolve_algorithm(given: str | type[Algorithm[Any]]) -> AlgorithmClass:
    """Return the algorithm for a name, a text ``module:Class`` or a class like ``pytest_pafot.searching.Algorithm``.

    Raises:
        ValueError: for anything else; the message lists the names, or what the class must have.
    """
    made_by = _named(given) if isinstance(given, str) else given
    _check_class(made_by)
    said = {each.name: getattr(made_by, each.name) for each in fields(AlgorithmClass) if hasattr(made_by, each.name)}
    return AlgorithmClass(made_by=made_by, **said)


def _named(given: str) -> Any:
    if given in ALGORITHMS:
        return CLASSES[given]
    if ":" in given:
        try:
            return referred_to(given)
        except ValueError as error:
            raise ValueError(f"algorithm: {error}") from error
    hint = meant(given, ALGORITHMS) or "; or give module:Class for an algorithm of your own"
    raise ValueError(f"algorithm: expected one of {', '.join(ALGORITHMS)}, received {given!r}{hint}")


def _check_class(given: Any) -> None:
    if not isinstance(given, type):
        raise ValueError(
            f"algorithm: expected one of {', '.join(ALGORITHMS)}, a class, or module:Class, received {given!r}; give "
            "the class itself, which is called with the space"
        )
    name = getattr(given, "name", None)
    if given is RandomSearch:
        return
    missing = [method for method in ("start", "ask", "tell") if not callable(getattr(given, method, None))]
    missing += sorted(getattr(given, "__abstractmethods__", ()))
    missing += [] if isinstance(name, str) else ["name"]
    if missing:
        raise ValueError(
            f"algorithm: expected a class with a name, start, ask and tell, received {given.__name__} without "
            f"{', '.join(missing)}; derive it from pytest_pafot.searching.GenerationalSearch, or see "
            "pytest_pafot.searching.Algorithm"
        )
    if name in ALGORITHMS and _named(str(name)) is not given:
        raise ValueError(
            f"algorithm: expected a unique name for {given.__name__}, received {name!r}, which is the name of a "
            f"different algorithm in files and reports; set the class attribute `name` of {given.__name__}"
        )
