"""The built-in search algorithms by name, and checks of users' algorithms."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, ClassVar

from numpy.random import Generator

from pytest_pafot.algorithms.av_fuzzer import AvFuzzerSearch
from pytest_pafot.algorithms.fitness import Fitness
from pytest_pafot.algorithms.pafot import PafotSearch
from pytest_pafot.algorithms.plan import Algorithm, GenerationalSearch, GenerationState
from pytest_pafot.algorithms.space import LANE_SHARES, SearchSpace, sample, sample_manoeuvres
from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.support.references import referred_to
from pytest_pafot.support.text import listed, suggest


@dataclass(frozen=True, slots=True)
class RandomSearch:
    """The default search, which samples valid scenarios at random.

    Scenario n depends only on n and the seed, so any process can sample it.
    """

    name: ClassVar[str] = "random"
    draws_vehicles: ClassVar[bool] = True

    space: SearchSpace = field(default_factory=SearchSpace)

    def drawn(self, seed: int, number: int) -> Scenario:
        """Return the scenario with this number, counted from 0, in a search with this seed."""
        return sample(self.space, rng_of(seed, number, 0))


@dataclass(frozen=True, slots=True)
class RandomManoeuvreSearch(GenerationalSearch[GenerationState]):
    """A search that samples random manoeuvres, one per time slice, as in AV-Fuzzer.

    Attributes:
        slices: number of manoeuvres per NPC. Together, they last as long as the genes in the space.
    """

    # The random search of the paper manipulates "the driving behaviours of NPCs at specified intervals" (section 4.2).
    # That can mean Position-Instructions or manoeuvres, so there is a random search for each.
    name: ClassVar[str] = "random-manoeuvre"
    is_papers: ClassVar[bool] = True
    instructions: ClassVar[tuple[str, ...]] = ("lanes",)

    # The generations are as large as those of the paper's search (section 4.2).
    slices: int = field(default=5, kw_only=True)

    def start(self, rng: Generator) -> GenerationState:
        return GenerationState()

    def propose(
        self,
        state: GenerationState,
        rng: Generator,
    ) -> tuple[GenerationState, Iterable[Scenario]]:
        space: Any = self.space.sliced(self.slices)
        return state, (sample_manoeuvres(space, rng) for _ in range(self.population))


CLASSES: Mapping[str, type[Any]] = MappingProxyType({
    each.name: each for each in (RandomSearch, PafotSearch, RandomManoeuvreSearch, AvFuzzerSearch)
})  # fmt: skip

ALGORITHMS = tuple(CLASSES)
"""The names that :func:`resolve_algorithm` accepts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmClass:
    """A search algorithm's class, with its class attributes or their defaults."""

    made_by: Callable[..., Any]  # the class
    name: str  # the name in files and reports; a class must define it
    # the fitness that it maximises unless the user requests another one: a name or a function
    fitness: str | Fitness = "default"
    # kinds of instructions that it can sample, default last
    instructions: Sequence[str] = tuple(LANE_SHARES)
    # whether its scenarios are like the paper's: two NPCs, one start and no patterns
    is_papers: bool = False
    # whether it samples from all vehicles that fit the world, if the mark names none
    draws_vehicles: bool = False

    @property
    def draws_by_number(self) -> bool:
        """True if the algorithm samples each scenario by its number."""
        return self.made_by is RandomSearch

    def make(self, space: SearchSpace) -> Algorithm[Any] | RandomSearch:
        made: Algorithm[Any] | RandomSearch = self.made_by(space)
        return made


def resolve_algorithm(given: str | type[Algorithm[Any]]) -> AlgorithmClass:
    """Return the algorithm for a built-in name, a string ``module:Class``, or a class.

    Raises:
        ValueError: for anything else.
    """
    made_by = _named(given) if isinstance(given, str) else given
    _check_class(made_by)
    names = [each.name for each in fields(AlgorithmClass) if hasattr(made_by, each.name)]
    said = {name: getattr(made_by, name) for name in names}
    return AlgorithmClass(made_by=made_by, **said)


def _named(given: str) -> Any:
    if given in ALGORITHMS:
        return CLASSES[given]
    if ":" in given:
        try:
            return referred_to(given)
        except ValueError as error:
            raise ValueError(f"algorithm: {error}") from error
    hint = suggest(given, ALGORITHMS) or ". Use module:Class for your own algorithm."
    raise ValueError(
        f"algorithm: expected one of {', '.join(ALGORITHMS)}, but received {given!r}{hint}"
    )


def _check_class(given: Any) -> None:
    if not isinstance(given, type):
        raise ValueError(
            f"algorithm: expected one of {', '.join(ALGORITHMS)}, a class or module:Class, but received {given!r:.100}."
            " Pass the class itself, not an instance. The search calls the class with the space."
        )
    if given is RandomSearch:
        return
    name = getattr(given, "name", None)
    methods = ("start", "ask", "tell")
    missing = [method for method in methods if not callable(getattr(given, method, None))]
    missing += sorted(getattr(given, "__abstractmethods__", ()))
    if not isinstance(name, str):
        missing.append("name")
    if missing:
        raise ValueError(
            f"algorithm: expected a class with name, start, ask and tell, but {given.__name__} lacks "
            f"{listed(missing)}. Derive it from pytest_pafot.algorithms.GenerationalSearch, or implement "
            "pytest_pafot.algorithms.Algorithm."
        )
    if name in ALGORITHMS and _named(str(name)) is not given:
        raise ValueError(
            f"algorithm: expected a unique name for {given.__name__}, but received {name!r}, which files and "
            f"reports use for a built-in algorithm. Change the class attribute `name` of {given.__name__}."
        )
