"""What a search algorithm is: it is asked for scenarios, and told what their runs showed.

:class:`Algorithm` is all that a search needs. :class:`GenerationalSearch` is a base for algorithms without local
searches, ours and those of others: a subclass says what it proposes and what it learns.
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
    """What a campaign needs to know of an algorithm's state, which is a value."""

    @property
    def generation(self) -> int:
        """The generation of the main search that is in progress or comes next, from 0."""

    @property
    def local_generation(self) -> int:
        """Within a local search the generation from 1; 0 in the main search."""


StateT = TypeVar("StateT", bound=SearchState)


class Algorithm(Protocol[StateT]):
    """A search strategy: a value with no state of its own and no randomness but what it is given.

    Its class is called with a :class:`~pytest_pafot.searching.space.SearchSpace` and the parameter ``population``, and
    may have the attributes of :class:`~pytest_pafot.searching.algorithms.catalogue.AlgorithmClass`.
    """

    @property
    def name(self) -> str:
        """By which files and reports call it."""

    def start(self, rng: Rng) -> StateT:
        """The state before the first generation."""

    def ask(self, state: StateT, rng: Rng) -> tuple[StateT, tuple[Scenario, ...]]:
        """The scenarios to evaluate next; none where a generation brings nothing new.

        Raises:
            RuntimeError: when the last ask has not been told.
        """

    def tell(
        self, state: StateT, evaluations: Sequence[Evaluation], rng: Rng
    ) -> tuple[StateT, tuple[AlgorithmEvent, ...]]:
        """Finish the generation that was asked for, with its evaluations in the same order.

        Raises:
            RuntimeError: without an ask before.
            ValueError: when the evaluations are not those of the scenarios asked for.
        """


class Drawing(Generic[StateT]):
    """The scenarios of a generation, which can be run while others are still drawn.

    Iterated over, it asks an algorithm and gives its scenarios. A :class:`GenerationalSearch` draws each when it is
    read, unless it has an ``ask`` of its own.
    """

    def __init__(self, algorithm: Algorithm[StateT], state: StateT, rng: Rng) -> None:
        self.scenarios: list[Scenario] = []
        """Those that were drawn."""
        self._state = state
        self._source = self._drawn(algorithm, rng)

    def __iter__(self) -> Iterator[Scenario]:
        for scenario in self._source:
            self.scenarios.append(scenario)
            yield scenario

    def finished(self) -> StateT:
        """The state, once all that was not read is drawn."""
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
    """What an algorithm can do besides whose search can go on in another session, as ``--pafot-resume`` asks for."""

    def stored(self, state: Any) -> Any:
        """A state between two generations as plain data; see :func:`~pytest_pafot.searching.plain.plain`."""

    def restored(self, data: Any) -> Any:
        """The inverse: the state from which the search goes on as if it had never stopped.

        Raises:
            ValueError: for data that is none of this algorithm.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationState:
    """Where a search without local searches is, between two calls."""

    generation: int = 0  # from 0
    local_generation: int = 0  # always; there is no local search
    best: Evaluation | None = None  # so far; None before the first eligible run
    asked: tuple[Scenario, ...] | None = None  # scenarios that are out for evaluation; None when it is time to ask
    proposed: int = 0  # scenarios so far


GenerationStateT = TypeVar("GenerationStateT", bound=GenerationState)


@dataclass(frozen=True, slots=True)
class GenerationalSearch(ABC, Generic[GenerationStateT]):
    """An algorithm without local searches.

    Attributes:
        space: of the scenarios.
        population: scenarios in a generation.
    """

    name: ClassVar[str]

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)

    def __post_init__(self) -> None:
        check_parameters(self, population=1)

    @abstractmethod
    def start(self, rng: Rng) -> GenerationStateT:
        """The state before the first generation."""

    @abstractmethod
    def propose(self, state: GenerationStateT, rng: Rng) -> tuple[GenerationStateT, Iterable[Scenario]]:
        """The scenarios of the next generation, which may be drawn as they are read, and the state after that."""

    def learn(self, state: GenerationStateT, evaluations: Sequence[Evaluation], rng: Rng) -> GenerationStateT:
        """The state with what the runs of a generation show; its best and its generation follow by themselves."""
        return state

    def ask(self, state: GenerationStateT, rng: Rng) -> tuple[GenerationStateT, tuple[Scenario, ...]]:
        """The scenarios of the next generation."""
        check_ask(state.asked)
        state, proposed = self.propose(state, rng)
        asked = tuple(proposed)
        return replace(state, asked=asked, proposed=state.proposed + len(asked)), asked

    def draw(self, state: GenerationStateT, rng: Rng) -> Generator[Scenario, None, GenerationStateT]:
        """What :meth:`ask` gives, one by one, for a :class:`Drawing`."""
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
        """Finish a generation with the evaluations of what was asked for, in the same order."""
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
        """What passes on untouched into the generation that was asked for."""
        return ()


def end_of_local_search(
    state: SearchState, incumbent: Evaluation, better: Evaluation | None
) -> tuple[AlgorithmEvent, ...]:
    """What an algorithm tells at the end of a local search that has found a better one than its incumbent, or none."""
    finished = LocalSearchFinished(
        generation=state.generation, incumbent=incumbent, best=better or incumbent, replaced=better is not None
    )
    if better is None:
        return (finished,)
    return NewBest(generation=state.generation, local_generation=state.local_generation, evaluation=better), finished


def check_ask(asked: Sequence[object] | None) -> None:
    """Refuse an ask while scenarios are out, which are None where it is time to ask.

    Raises:
        RuntimeError: when the state's last ask has not been told.
    """
    if asked is not None:
        raise RuntimeError(
            f"ask: expected tell after the last ask, which gave {len(asked)} scenarios; received another ask; "
            "evaluate them and pass the state that ask returned to tell"
        )


def check_evaluations(asked: Sequence[Scenario] | None, evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that do not belong one by one to the scenarios asked for.

    Raises:
        RuntimeError: when nothing was asked for.
        ValueError: when the number or a scenario differs.
    """
    if asked is None:
        raise RuntimeError(
            "tell: expected an ask before; received a state without one; pass the state that ask returned"
        )
    check_order("tell", asked, evaluations)


def check_order(place: str, scenarios: Sequence[Scenario], evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that are not those of the scenarios, one by one.

    Raises:
        ValueError: naming the place, when the number or a scenario differs.
    """
    if len(evaluations) != len(scenarios):
        raise ValueError(
            f"{place}: expected {len(scenarios)} evaluations, one per scenario, received {len(evaluations)}; "
            "evaluate each scenario, also the invalid ones"
        )
    for index, (scenario, evaluation) in enumerate(zip(scenarios, evaluations, strict=True)):
        if evaluation.scenario is not scenario and evaluation.scenario != scenario:
            raise ValueError(
                f"{place}: expected the evaluation of {scenario!r} at {index}, received one of "
                f"{evaluation.scenario!r}; keep the order of the scenarios"
            )


def check_parameters(search: Any, *, rates: tuple[str, ...] = (), factors: tuple[str, ...] = (), **least: int) -> None:
    """Refuse numbers of a search that are too small or too large: its rates, factors, and counts by their least value.

    Raises:
        ValueError: naming the first that is wrong.
    """
    limits: dict[str, tuple[float, float, str]] = dict.fromkeys(rates, (0, 1, "a number from 0 to 1"))
    limits |= {name: (0, math.nextafter(math.inf, 0), "a finite number, at least 0") for name in factors}
    limits |= {name: (bound, math.inf, f"a count of at least {bound}") for name, bound in least.items()}
    for name, (low, high, expected) in limits.items():
        if not low <= getattr(search, name) <= high:
            raise ValueError(f"{name}: expected {expected}, received {getattr(search, name)!r}")
