"""The interface of the algorithms that breed, which is ask and tell, and the plan of a search by one of them.

In each generation a :class:`Plan` gets scenarios from ``ask`` of an algorithm, and passes their evaluations to
``tell``. It runs nothing and measures no time, so the same evaluations give the same scenarios. A search needs only the
methods of :class:`Algorithm`. :class:`GenerationalSearch` is a base class for algorithms without local searches, also
for users' own: a subclass defines what it proposes and learns.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from numpy.random import Generator as Rng

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.searching.evaluation import (
    AlgorithmEvent,
    CampaignFinished,
    CampaignStarted,
    EndReason,
    Evaluated,
    Evaluation,
    EvaluationCache,
    Event,
    GenerationFinished,
    LocalSearchFinished,
    NewBest,
    Restarted,
)
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


class Plan:
    """The scenarios of a search in their order, and what its algorithm has learnt.

    The scenarios depend only on the algorithm, the seed and the evaluations: every generation has its own random
    generator, derived from (seed, generation, local generation). A scenario is simulated only if no earlier run shows
    its result; otherwise the earlier evaluation is taken again, and its event is marked.

    Whoever runs it asks for one :meth:`scenario` after the other and passes its evaluation to :meth:`take`. A
    generation that has no scenario :attr:`is_whole` at once, and must be learnt by :meth:`learn`.

    Args:
        algorithm: the algorithm to run.
        generations: generations of the main search, at least 1; those of local searches are additional. None if the
            number of ``runs`` is the limit; there are never more generations than runs.
        seed: seed of all random numbers, at least 0.
        runs: number of simulated scenarios after which the search ends, at least 1; None for no limit. If the limit
            is reached inside a generation, it is reported as finished, but the algorithm does not receive its results.
        seeds_matter: True if the seed of a scenario can change its run even if the NPCs drive the same chains.

    Raises:
        ValueError: for an argument out of range.
    """

    def __init__(
        self,
        algorithm: Algorithm[Any],
        *,
        generations: int | None,
        seed: int,
        runs: int | None = None,
        seeds_matter: bool = False,
    ) -> None:
        if generations is None and runs is None:
            raise ValueError("generations, runs: expected at least one of them, received neither")
        for name, value, least in (("generations", generations, 1), ("runs", runs, 1), ("seed", seed, 0)):
            if value is not None and value < least:
                raise ValueError(f"{name}: expected a whole number, at least {least}, received {value!r}")
        self.algorithm = algorithm
        self.started = CampaignStarted(algorithm=algorithm.name, generations=generations, seed=seed)
        """The first event."""
        self.sums = CampaignFinished(
            reason="generations", generations=0, evaluated=0, simulated=0, best=None, seconds=0.0
        )
        """The totals over all evaluations so far."""
        self._last_generation = generations or runs or 0
        self._last_run = runs or sys.maxsize
        self._cache = EvaluationCache(seeds_matter=seeds_matter)
        self._state: Any = algorithm.start(rng_of(seed))
        self._begin()

    def _begin(self) -> None:
        """Draw the scenarios of the next generation."""
        self._cache.forget()
        self._told: list[tuple[Evaluation, bool]] = []  # with True if an earlier run shows it
        self._asked: tuple[Scenario, ...] = ()
        if not self.is_over:
            self._rng = rng_of(self.started.seed, self._state.generation, self._state.local_generation)
            self._state, self._asked = self.algorithm.ask(self._state, self._rng)

    @property
    def generation(self) -> int:
        """The number of the generation that is evaluated, or of the next one."""
        number: int = self._state.generation
        return number

    @property
    def is_over(self) -> bool:
        """True if there is no further generation."""
        return self.generation >= self._last_generation

    @property
    def has_all_runs(self) -> bool:
        """True if as many scenarios are simulated as were asked for."""
        return self.sums.simulated >= self._last_run

    @property
    def is_whole(self) -> bool:
        """True if all scenarios of the generation are evaluated."""
        return len(self._told) >= len(self._asked)

    def scenario(self) -> Scenario:
        """Return the next scenario."""
        return self._asked[len(self._told)]

    def recalled(self) -> Evaluation | None:
        """Return the evaluation of the next scenario if an earlier run shows it; None if it has to be simulated."""
        return self._cache.recall(self.scenario())

    def ahead(self) -> list[Scenario]:
        """Return the next scenarios of the generation that no earlier run shows.

        They can be simulated in advance: most of them will be asked for, in this order.
        """
        coming = dict.fromkeys(self._asked[len(self._told) :])
        unknown = (each for each in coming if self._cache.recall(each) is None)
        return [each for each, _ in zip(unknown, range(self._last_run - self.sums.simulated), strict=False)]

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Sequence[Event]:
        """Take the evaluation of the next scenario, and let the algorithm learn from a whole generation.

        ``reused`` says that it is :meth:`recalled`.
        """
        if evaluation.scenario is not self.scenario() and evaluation.scenario != self.scenario():
            raise ValueError(f"expected the evaluation of {self.scenario()}, received that of {evaluation.scenario}")
        event = Evaluated(
            generation=self._state.generation,
            local_generation=self._state.local_generation,
            index=len(self._told),
            evaluation=evaluation,
            reused=reused,
        )
        if not reused:
            self._cache.add(evaluation)
        self._told.append((evaluation, reused))
        sums = self.sums
        self.sums = replace(
            sums,
            evaluated=sums.evaluated + 1,
            simulated=sums.simulated + (not reused),
            best=evaluation if improves(evaluation, sums.best) else sums.best,
        )
        return (event, *(self.learn() if self.is_whole else ()))

    def learn(self) -> Sequence[Event]:
        """Let the algorithm learn from a whole generation, and draw the next one.

        The events lack a restart that no generation follows.
        """
        evaluations = tuple(each for each, _ in self._told)
        self._state, events = self.algorithm.tell(self._state, evaluations, self._rng)
        happened = []
        for event in events:
            if isinstance(event, Restarted) and event.generation >= self._last_generation:
                continue
            if isinstance(event, GenerationFinished) and event.local_generation == 0:
                self.sums = replace(self.sums, generations=self.sums.generations + 1)
            if isinstance(event, NewBest) and improves(event.evaluation, self.sums.best):
                self.sums = replace(self.sums, best=event.evaluation)
            happened.append(event)
        self._begin()
        return happened

    def finished(self, reason: EndReason, seconds: float = 0.0) -> Iterator[Event]:
        """Yield the last events. A generation that the limit on runs cut is reported, but not learnt."""
        sums = self.sums
        if reason == "runs" and self._told:
            population, local = tuple(each for each, _ in self._told), self._state.local_generation
            yield GenerationFinished(
                generation=self.generation, local_generation=local, population=population, elites=0
            )
            sums = replace(sums, generations=sums.generations + (local == 0))
        yield replace(sums, reason=reason, seconds=seconds)
