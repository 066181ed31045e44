"""The interface of search algorithms: a campaign asks them for scenarios and tells them what the runs showed.

A search needs no more than :class:`Algorithm`. :class:`GenerationalSearch` is a base for algorithms without local
searches, ours and others: a subclass defines what it proposes and what it learns.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

from numpy.random import Generator as Rng

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent, GenerationFinished, LocalSearchFinished, NewBest
from pytest_pafot.searching.operators import best_of, improves
from pytest_pafot.searching.space import SearchSpace


class SearchState(Protocol):
    """The parts of an algorithm's state that a campaign reads; a state is a value."""

    @property
    def generation(self) -> int:
        """The generation of the main search that is in progress or comes next, from 0."""

    @property
    def local_generation(self) -> int:
        """The generation of a local search, from 1; 0 in the main search."""


StateT = TypeVar("StateT", bound=SearchState)


class Algorithm(Protocol[StateT]):
    """A search strategy: a value without internal state; all randomness is passed to it.

    Its class is called with a :class:`~pytest_pafot.searching.space.SearchSpace` and the parameter ``population``, and
    may have the attributes of :class:`~pytest_pafot.searching.algorithms.catalogue.AlgorithmClass`.
    """

    @property
    def name(self) -> str:
        """The name in files and reports."""

    def start(self, rng: Rng) -> StateT:
        """Return the state before the first generation."""

    def ask(self, state: StateT, rng: Rng) -> tuple[StateT, tuple[Scenario, ...]]:
        """Return the scenarios to evaluate next; empty if a generation brings nothing new.

        Raises:
            RuntimeError: if the scenarios of the last ask have not been told.
        """

    def tell(
        self, state: StateT, evaluations: Sequence[Evaluation], rng: Rng
    ) -> tuple[StateT, tuple[AlgorithmEvent, ...]]:
        """Finish the requested generation, with its evaluations in the same order.

        Raises:
            RuntimeError: without a previous ask.
            ValueError: if the evaluations are not those of the requested scenarios.
        """


class Drawing(Generic[StateT]):
    """The scenarios of a generation, which can be run while later ones are still being sampled.

    Iterating over it asks an algorithm and yields its scenarios. A :class:`GenerationalSearch` samples each scenario
    only when it is read, unless the class has a different ``ask``.
    """

    def __init__(self, algorithm: Algorithm[StateT], state: StateT, rng: Rng) -> None:
        self.scenarios: list[Scenario] = []
        """The scenarios that were sampled so far."""
        self._state = state
        self._source = self._drawn(algorithm, rng)

    def __iter__(self) -> Iterator[Scenario]:
        for scenario in self._source:
            self.scenarios.append(scenario)
            yield scenario

    def finished(self) -> StateT:
        """Sample all scenarios that were not read, and return the state."""
        deque(self, maxlen=0)
        return self._state

    def _drawn(self, algorithm: Algorithm[StateT], rng: Rng) -> Iterator[Scenario]:
        if isinstance(algorithm, GenerationalSearch) and type(algorithm).ask is GenerationalSearch.ask:
            self._state = yield from algorithm.draw(self._state, rng)
            return
        self._state, scenarios = algorithm.ask(self._state, rng)
        yield from scenarios


@runtime_checkable
class ResumableSearch(Protocol):
    """The additional methods of an algorithm whose search ``--pafot-resume`` can continue in a different session."""

    def stored(self, state: Any) -> Any:
        """Return a state between two generations as plain data; see :func:`~pytest_pafot.searching.plain.plain`."""

    def restored(self, data: Any) -> Any:
        """Return the state from plain data; the search then continues as if it had never stopped.

        Raises:
            ValueError: for data that is not from this algorithm.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationState:
    """The state of a search without local searches, between two calls."""

    generation: int = 0  # counted from 0
    local_generation: int = 0  # always 0, because there is no local search
    best: Evaluation | None = None  # None before the first eligible run
    asked: tuple[Scenario, ...] | None = None  # scenarios under evaluation; None if the next call must be ask
    proposed: int = 0  # number of scenarios so far


GenerationStateT = TypeVar("GenerationStateT", bound=GenerationState)


@dataclass(frozen=True, slots=True)
class GenerationalSearch(ABC, Generic[GenerationStateT]):
    """An algorithm without local searches.

    Attributes:
        space: space of the scenarios.
        population: number of scenarios in a generation.
    """

    name: ClassVar[str]

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)

    def __post_init__(self) -> None:
        check_parameters(self, population=1)

    @abstractmethod
    def start(self, rng: Rng) -> GenerationStateT:
        """Return the state before the first generation."""

    @abstractmethod
    def propose(self, state: GenerationStateT, rng: Rng) -> tuple[GenerationStateT, Iterable[Scenario]]:
        """Return the next state, and the scenarios of the next generation, which may be sampled as they are read."""

    def learn(self, state: GenerationStateT, evaluations: Sequence[Evaluation], rng: Rng) -> GenerationStateT:
        """Return the state with what a generation's runs show; its best and its generation are updated elsewhere."""
        return state

    def ask(self, state: GenerationStateT, rng: Rng) -> tuple[GenerationStateT, tuple[Scenario, ...]]:
        """Return the scenarios of the next generation."""
        check_ask(state.asked)
        state, proposed = self.propose(state, rng)
        asked = tuple(proposed)
        return replace(state, asked=asked, proposed=state.proposed + len(asked)), asked

    def draw(self, state: GenerationStateT, rng: Rng) -> Generator[Scenario, None, GenerationStateT]:
        """Yield the scenarios of :meth:`ask` one by one, for a :class:`Drawing`."""
        check_ask(state.asked)
        state, proposed = self.propose(state, rng)
        asked = []
        for scenario in proposed:
            asked.append(scenario)
            yield scenario
        return replace(state, asked=tuple(asked), proposed=state.proposed + len(asked))

    def tell(
        self, state: GenerationStateT, evaluations: Sequence[Evaluation], rng: Rng
    ) -> tuple[GenerationStateT, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of the requested scenarios, in the same order."""
        check_evaluations(state.asked, evaluations)
        kept = self.kept(state)
        finished = GenerationFinished(
            generation=state.generation, local_generation=0, population=(*kept, *evaluations), elites=len(kept)
        )
        candidate = best_of(evaluations)
        new = candidate if improves(candidate, state.best) else None
        learnt = self.learn(state, evaluations, rng)
        learnt = replace(learnt, generation=state.generation + 1, asked=None, best=new or state.best)
        if new is None:
            return learnt, (finished,)
        return learnt, (finished, NewBest(generation=state.generation, local_generation=0, evaluation=new))

    def kept(self, state: GenerationStateT) -> Sequence[Evaluation]:
        """Return the evaluations that pass unchanged into the requested generation."""
        return ()


def end_of_local_search(
    state: SearchState, incumbent: Evaluation, better: Evaluation | None
) -> tuple[AlgorithmEvent, ...]:
    """Return an algorithm's events at the end of a local search, which may have found a better scenario."""
    finished = LocalSearchFinished(
        generation=state.generation, incumbent=incumbent, best=better or incumbent, replaced=better is not None
    )
    if better is None:
        return (finished,)
    return NewBest(generation=state.generation, local_generation=state.local_generation, evaluation=better), finished


def check_ask(asked: Sequence[object] | None) -> None:
    """Refuse an ask while scenarios are under evaluation; ``asked`` is None if there are none.

    Raises:
        RuntimeError: if the scenarios of the state's last ask have not been told.
    """
    if asked is not None:
        raise RuntimeError(
            f"ask: expected tell after the last ask, which gave {len(asked)} scenarios; received another ask; "
            "evaluate them and pass the state that ask returned to tell"
        )


def check_evaluations(asked: Sequence[Scenario] | None, evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that do not belong one by one to the requested scenarios.

    Raises:
        RuntimeError: if no scenarios were requested.
        ValueError: if the number or a scenario differs.
    """
    if asked is None:
        raise RuntimeError(
            "tell: expected an ask before; received a state without one; pass the state that ask returned"
        )
    check_order("tell", asked, evaluations)


def check_order(place: str, scenarios: Sequence[Scenario], evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that do not belong one by one to the scenarios.

    Raises:
        ValueError: if the number or a scenario differs; it names the place.
    """
    if len(evaluations) != len(scenarios):
        raise ValueError(
            f"{place}: expected {len(scenarios)} evaluations, one per scenario, received {len(evaluations)}; "
            "evaluate every scenario, including invalid ones"
        )
    for index, (scenario, evaluation) in enumerate(zip(scenarios, evaluations, strict=True)):
        if evaluation.scenario is not scenario and evaluation.scenario != scenario:
            raise ValueError(
                f"{place}: expected the evaluation of {scenario!r} at {index}, received one of "
                f"{evaluation.scenario!r}; keep the order of the scenarios"
            )


def check_parameters(search: Any, *, rates: tuple[str, ...] = (), factors: tuple[str, ...] = (), **least: int) -> None:
    """Refuse parameters of a search that are out of range: rates, factors, and counts below their lower limit.

    Raises:
        ValueError: for the first wrong parameter, by name.
    """
    limits: dict[str, tuple[float, float, str]] = dict.fromkeys(rates, (0, 1, "a number from 0 to 1"))
    limits |= {name: (0, math.nextafter(math.inf, 0), "a finite number, at least 0") for name in factors}
    limits |= {name: (bound, math.inf, f"a count of at least {bound}") for name, bound in least.items()}
    for name, (low, high, expected) in limits.items():
        if not low <= getattr(search, name) <= high:
            raise ValueError(f"{name}: expected {expected}, received {getattr(search, name)!r}")
