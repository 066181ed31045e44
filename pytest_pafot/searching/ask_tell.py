"""The interface of the algorithms of a search, which is ask and tell.

In each generation a :class:`~pytest_pafot.searching.plan.Plan` gets scenarios from ``ask`` of an algorithm, and passes
their evaluations to ``tell``. A search needs only the methods of :class:`Algorithm`. :class:`GenerationalSearch` is a
base class for algorithms without local searches, also for users' own: a subclass defines what it proposes and learns.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from numpy.random import Generator as Rng

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent, GenerationFinished, LocalSearchFinished, NewBest
from pytest_pafot.searching.operators import best_of, improves
from pytest_pafot.searching.space import SearchSpace


class SearchState(Protocol):
    """The parts of an algorithm's state that a campaign reads; a state is an immutable value."""

    @property
    def generation(self) -> int:
        """The current or next generation of the main search, counted from 0."""

    @property
    def local_generation(self) -> int:
        """The current or next generation of a local search, counted from 1; 0 in the main search."""


StateT = TypeVar("StateT", bound=SearchState)


class Algorithm(Protocol[StateT]):
    """A search strategy: a value without internal state; all randomness is passed to it.

    Its class is called with a :class:`~pytest_pafot.searching.space.SearchSpace` and the parameter ``population``, and
    may have the attributes of :class:`~pytest_pafot.searching.algorithms.catalogue.AlgorithmClass`.
    """

    @property
    def name(self) -> str:
        """The name of the algorithm in files and reports."""

    def start(self, rng: Rng) -> StateT:
        """Return the state before the first generation."""

    def ask(self, state: StateT, rng: Rng) -> tuple[StateT, tuple[Scenario, ...]]:
        """Return the new state, and the scenarios to evaluate next; none if the generation has no new scenario.

        Raises:
            RuntimeError: if ``tell`` was not called after the last ``ask``.
        """

    def tell(
        self, state: StateT, evaluations: Sequence[Evaluation], rng: Rng
    ) -> tuple[StateT, tuple[AlgorithmEvent, ...]]:
        """Finish the generation of the last ``ask``, with the evaluations of its scenarios in the same order.

        Raises:
            RuntimeError: if ``ask`` was not called before.
            ValueError: if the evaluations are not those of the requested scenarios.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationState:
    """The state of a search without local searches, between two calls of ``ask`` or ``tell``."""

    generation: int = 0  # counted from 0
    local_generation: int = 0  # always 0, because there is no local search
    best: Evaluation | None = None  # None before the first eligible run
    asked: tuple[Scenario, ...] | None = None  # scenarios under evaluation; None if the next call must be ask
    proposed: int = 0  # number of scenarios so far


GenerationStateT = TypeVar("GenerationStateT", bound=GenerationState)


@dataclass(frozen=True, slots=True)
class GenerationalSearch(ABC, Generic[GenerationStateT]):
    """A base class for algorithms without local searches.

    Attributes:
        space: space from which scenarios are sampled.
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
        """Return the next state and the scenarios of the next generation; an iterator may sample them when read."""

    def learn(self, state: GenerationStateT, evaluations: Sequence[Evaluation], rng: Rng) -> GenerationStateT:
        """Return the state after learning from a generation's runs; ``tell`` updates ``best`` and ``generation``."""
        return state

    def ask(self, state: GenerationStateT, rng: Rng) -> tuple[GenerationStateT, tuple[Scenario, ...]]:
        """Return the scenarios of the next generation."""
        check_ask(state.asked)
        state, proposed = self.propose(state, rng)
        asked = tuple(proposed)
        return replace(state, asked=asked, proposed=state.proposed + len(asked)), asked

    def tell(
        self, state: GenerationStateT, evaluations: Sequence[Evaluation], rng: Rng
    ) -> tuple[GenerationStateT, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of the requested scenarios, in the same order."""
        check_evaluations(state.asked, evaluations)
        finished = GenerationFinished(
            generation=state.generation, local_generation=0, population=tuple(evaluations), elites=0
        )
        candidate = best_of(evaluations)
        new = candidate if improves(candidate, state.best) else None
        learnt = self.learn(state, evaluations, rng)
        learnt = replace(learnt, generation=state.generation + 1, asked=None, best=new or state.best)
        if new is None:
            return learnt, (finished,)
        return learnt, (finished, NewBest(generation=state.generation, local_generation=0, evaluation=new))


def end_of_local_search(
    state: SearchState, incumbent: Evaluation, better: Evaluation | None
) -> tuple[AlgorithmEvent, ...]:
    """Return the events at the end of a local search; ``better`` is its best scenario if that beats the incumbent."""
    finished = LocalSearchFinished(
        generation=state.generation, incumbent=incumbent, best=better or incumbent, replaced=better is not None
    )
    if better is None:
        return (finished,)
    return NewBest(generation=state.generation, local_generation=state.local_generation, evaluation=better), finished


def check_ask(asked: Sequence[object] | None) -> None:
    """Refuse a call of ``ask`` while scenarios are under evaluation; ``asked`` is None if there are none.

    Raises:
        RuntimeError: if ``tell`` was not called after the last ``ask``.
    """
    if asked is not None:
        raise RuntimeError(
            f"ask: expected tell after the last ask, which gave {len(asked)} scenarios, received a second ask; "
            "evaluate the scenarios, and pass tell their evaluations and the state that ask returned"
        )


def check_evaluations(asked: Sequence[Scenario] | None, evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that do not match the requested scenarios one by one.

    Raises:
        RuntimeError: if no scenarios were requested.
        ValueError: if there are more or fewer evaluations, or one is of a different scenario.
    """
    if asked is None:
        raise RuntimeError(
            "tell: expected a state that ask returned, received a state in which no scenarios were requested; "
            "call ask first"
        )
    check_order("tell", asked, evaluations)


def check_order(place: str, scenarios: Sequence[Scenario], evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that do not match the scenarios one by one.

    Raises:
        ValueError: if there are more or fewer evaluations, or one is of a different scenario; the message begins with
            ``place``.
    """
    if len(evaluations) != len(scenarios):
        raise ValueError(
            f"{place}: expected {len(scenarios)} evaluations, one per scenario, received {len(evaluations)}; "
            "evaluate every scenario, including invalid ones"
        )
    for index, (scenario, evaluation) in enumerate(zip(scenarios, evaluations, strict=True)):
        if evaluation.scenario is not scenario and evaluation.scenario != scenario:
            raise ValueError(
                f"{place}: expected the evaluation of {scenario} at {index}, received the evaluation of "
                f"{evaluation.scenario}; keep the order of the scenarios"
            )


MOST = 10_000
"""The largest population. All scenarios of a generation are in memory at once."""


def check_parameters(search: Any, *, rates: tuple[str, ...] = (), factors: tuple[str, ...] = (), **least: int) -> None:
    """Refuse parameters of a search that are out of range: rates outside 0 to 1, negative factors, and low counts.

    Raises:
        ValueError: for the first wrong parameter; the message names it.
    """
    limits: dict[str, tuple[float, float, str]] = dict.fromkeys(rates, (0, 1, "a number from 0 to 1"))
    limits |= {name: (0, math.nextafter(math.inf, 0), "a finite number, at least 0") for name in factors}
    limits |= {name: (bound, math.inf, f"a count of at least {bound}") for name, bound in least.items()}
    if "population" in least:
        limits["population"] = (least["population"], MOST, f"a count from {least['population']} to {MOST}")
    for name, (low, high, expected) in limits.items():
        if not low <= getattr(search, name) <= high:
            raise ValueError(f"{name}: expected {expected}, received {getattr(search, name)!r}")
