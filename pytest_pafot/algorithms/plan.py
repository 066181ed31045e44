"""The ask-and-tell interface for search algorithms, and the plan of a search."""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from numpy.random import Generator as Rng

from pytest_pafot.algorithms.evaluation import (
    EndReason,
    Evaluated,
    Evaluation,
    EvaluationCache,
    Event,
    Events,
    GenerationFinished,
    LocalSearchFinished,
    NewBest,
    PlanFinished,
    PlanStarted,
    Restarted,
)
from pytest_pafot.algorithms.operators import best_of, improves
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.model.scenario import Scenario, rng_of


class SearchState(Protocol):
    """The parts of an algorithm's state that a search reads. A state is an immutable value."""

    @property
    def generation(self) -> int:
        """The current or next generation of the main search, counted from 0."""

    @property
    def local_generation(self) -> int:
        """The current or next generation of a local search, counted from 1, or 0 in the main search."""


StateT = TypeVar("StateT", bound=SearchState)


class Algorithm(Protocol[StateT]):
    """A search algorithm without internal state, which receives its state and random generator in each call.

    The class is called with a :class:`~pytest_pafot.algorithms.space.SearchSpace`. It can define the attributes of
    :class:`~pytest_pafot.algorithms.catalogue.AlgorithmClass`.
    """

    @property
    def name(self) -> str:
        """The name of the algorithm in files and reports."""

    def start(self, rng: Rng) -> StateT:
        """Return the state before the first generation."""

    def ask(self, state: StateT, rng: Rng) -> tuple[StateT, tuple[Scenario, ...]]:
        """Return the new state, and the scenarios to evaluate next.

        Raises:
            RuntimeError: if ``tell`` was not called after the last ``ask``.
        """

    def tell(
        self,
        state: StateT,
        evaluations: Sequence[Evaluation],
        rng: Rng,
    ) -> tuple[StateT, Events]:
        """Finish a generation. The evaluations are in the order of its scenarios.

        Raises:
            RuntimeError: if ``ask`` was not called before.
            ValueError: if the evaluations do not match the scenarios.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationState:
    """The state of a search without local searches."""

    generation: int = 0  # counted from 0
    local_generation: int = 0  # always 0, because there is no local search
    best: Evaluation | None = None  # None before the first eligible run
    # scenarios under evaluation; None if the next call must be ask
    asked: tuple[Scenario, ...] | None = None
    proposed: int = 0  # number of proposed scenarios so far


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
    def propose(
        self,
        state: GenerationStateT,
        rng: Rng,
    ) -> tuple[GenerationStateT, Iterable[Scenario]]:
        """Return the next state and the scenarios of the next generation."""

    def learn(
        self,
        state: GenerationStateT,
        evaluations: Sequence[Evaluation],
        rng: Rng,
    ) -> GenerationStateT:
        """Return the state after a generation. ``tell`` updates ``best`` and ``generation``."""
        return state

    def ask(
        self,
        state: GenerationStateT,
        rng: Rng,
    ) -> tuple[GenerationStateT, tuple[Scenario, ...]]:
        check_ask(state.asked)
        state, proposed = self.propose(state, rng)
        asked = tuple(proposed)  # an iterator samples the scenarios only now
        return replace(state, asked=asked, proposed=state.proposed + len(asked)), asked

    def tell(
        self,
        state: GenerationStateT,
        evaluations: Sequence[Evaluation],
        rng: Rng,
    ) -> tuple[GenerationStateT, Events]:
        check_evaluations(state.asked, evaluations)
        finished = GenerationFinished(
            generation=state.generation,
            local_generation=0,
            population=tuple(evaluations),
            elites=0,
        )
        candidate = best_of(evaluations)
        new = candidate if improves(candidate, state.best) else None
        generation = state.generation
        learnt = self.learn(state, evaluations, rng)
        learnt = replace(learnt, generation=generation + 1, asked=None, best=new or state.best)
        if new is None:
            return learnt, (finished,)
        best = NewBest(generation=generation, local_generation=0, evaluation=new)
        return learnt, (finished, best)


def end_of_local_search(
    state: SearchState,
    incumbent: Evaluation,
    better: Evaluation | None,
) -> Events:
    """Return the events at the end of a local search. ``better`` is its result, or None if that is not better."""
    finished = LocalSearchFinished(
        generation=state.generation,
        incumbent=incumbent,
        best=better or incumbent,
        replaced=better is not None,
    )
    if better is None:
        return (finished,)
    best = NewBest(
        generation=state.generation,
        local_generation=state.local_generation,
        evaluation=better,
    )
    return best, finished


def check_ask(asked: Sequence[object] | None) -> None:
    """Raise a RuntimeError if ``ask`` is called while scenarios are being evaluated."""
    if asked is not None:
        raise RuntimeError(
            f"ask: expected a call to tell after the last ask, which returned {len(asked)} scenarios, but received a "
            "second ask. Evaluate the scenarios, and pass the state from ask and the evaluations to tell."
        )


def check_evaluations(asked: Sequence[Scenario] | None, evaluations: Sequence[Evaluation]) -> None:
    """Raise an error if evaluations and requested scenarios do not correspond one to one."""
    if asked is None:
        raise RuntimeError(
            "tell: expected a state that ask returned, but received a state in which no scenarios were requested. "
            "Call ask first."
        )
    if len(evaluations) != len(asked):
        raise ValueError(
            f"tell: expected {len(asked)} evaluations, one per scenario, but received {len(evaluations)}. "
            "Evaluate every scenario, including invalid ones."
        )
    for index, (scenario, evaluation) in enumerate(zip(asked, evaluations, strict=True)):
        if evaluation.scenario is not scenario and evaluation.scenario != scenario:
            raise ValueError(
                f"tell: expected the evaluation of {scenario} at index {index}, but received the evaluation of "
                f"{evaluation.scenario}. Pass the evaluations in the order of the scenarios."
            )


MOST = 10_000  # largest population; all scenarios of a generation are in memory together


def check_parameters(
    search: Any,
    *,
    rates: tuple[str, ...] = (),
    factors: tuple[str, ...] = (),
    **least: int,
) -> None:
    """Raise a ValueError that names the first parameter that is out of range."""
    limits: dict[str, tuple[float, float, str]] = {}
    for name in rates:
        limits[name] = 0, 1, "a number from 0 to 1"
    for name in factors:
        limits[name] = 0, sys.float_info.max, "a finite number, at least 0"
    for name, bound in least.items():
        limits[name] = bound, math.inf, f"a whole number, at least {bound}"
        if name == "population":
            limits[name] = bound, MOST, f"a whole number from {bound} to {MOST}"
    for name, (low, high, expected) in limits.items():
        value = getattr(search, name)
        if not low <= value <= high:
            raise ValueError(f"{name}: expected {expected}, but received {value!r}")


class Plan:
    """The scenarios of a search in order, and the state of its algorithm.

    The scenarios depend only on the algorithm, the seed and the evaluations. The caller passes the evaluation of each
    :meth:`scenario` to :meth:`take`.

    Args:
        algorithm: the algorithm to run.
        generations: largest number of generations of the main search; None if ``runs`` is the limit.
        seed: seed of all random numbers.
        runs: largest number of simulated scenarios; None for no limit.
        seeds_matter: True if the seed of a scenario can affect its run even if the chains stay the same.

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
            raise ValueError(
                "generations, runs: expected at least one of them, but received neither"
            )
        given = {"generations": (generations, 1), "runs": (runs, 1), "seed": (seed, 0)}
        for name, (value, least) in given.items():
            if value is not None and value < least:
                raise ValueError(
                    f"{name}: expected a whole number, at least {least}, but received {value!r}"
                )
        self.algorithm = algorithm
        # the first event
        self.started = PlanStarted(algorithm=algorithm.name, generations=generations, seed=seed)
        # The totals over all evaluations so far.
        self.sums = PlanFinished(
            reason="generations",
            generations=0,
            evaluated=0,
            simulated=0,
            best=None,
            seconds=0.0,
        )
        self._last_generation = generations or runs or 0
        self._last_run = runs or sys.maxsize
        self._cache = EvaluationCache(seeds_matter=seeds_matter)
        self._state: Any = algorithm.start(rng_of(seed))
        self._begin()

    def _begin(self) -> None:
        self._cache.forget()
        self._told: list[Evaluation] = []
        self._asked: tuple[Scenario, ...] = ()
        if not self.is_over:
            # Each generation has its own random generator, so its scenarios do not depend on earlier random numbers.
            self._rng = rng_of(
                self.started.seed,
                self._state.generation,
                self._state.local_generation,
            )
            self._state, self._asked = self.algorithm.ask(self._state, self._rng)

    @property
    def generation(self) -> int:
        """The number of the current or next generation."""
        return int(self._state.generation)

    @property
    def is_over(self) -> bool:
        return self.generation >= self._last_generation

    @property
    def has_all_runs(self) -> bool:
        return self.sums.simulated >= self._last_run

    @property
    def is_whole(self) -> bool:
        """True if all scenarios of the generation are evaluated."""
        # If a generation has no scenario, it is complete immediately, and the caller must call `learn`.
        return len(self._told) >= len(self._asked)

    def scenario(self) -> Scenario:
        return self._asked[len(self._told)]

    def recalled(self) -> Evaluation | None:
        """Return the evaluation of the next scenario if it is known from an earlier run, otherwise None."""
        return self._cache.recall(self.scenario())

    def ahead(self) -> list[Scenario]:
        """Return the scenarios of the generation that still need a run, in order."""
        coming = dict.fromkeys(self._asked[len(self._told) :])
        unknown = (each for each in coming if self._cache.recall(each) is None)
        return list(islice(unknown, max(self._last_run - self.sums.simulated, 0)))

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Sequence[Event]:
        """Record the evaluation of the next scenario. ``reused`` is True if :meth:`recalled` returned it."""
        if evaluation.scenario is not self.scenario() and evaluation.scenario != self.scenario():
            raise ValueError(
                f"expected an evaluation of {self.scenario()}, but received one of {evaluation.scenario}"
            )
        event = Evaluated(
            generation=self._state.generation,
            local_generation=self._state.local_generation,
            index=len(self._told),
            evaluation=evaluation,
            reused=reused,
        )
        if not reused:
            self._cache.add(evaluation)
            self.sums = replace(self.sums, simulated=self.sums.simulated + 1)
        self._told.append(evaluation)
        self.sums = replace(self.sums, evaluated=self.sums.evaluated + 1)
        self._improve(evaluation)
        if not self.is_whole:
            return (event,)
        return (event, *self.learn())

    def _improve(self, evaluation: Evaluation) -> None:
        if improves(evaluation, self.sums.best):
            self.sums = replace(self.sums, best=evaluation)

    def learn(self) -> Sequence[Event]:
        """Pass a complete generation to the algorithm, and request the next one."""
        self._state, events = self.algorithm.tell(self._state, tuple(self._told), self._rng)
        happened = []
        for event in events:
            if isinstance(event, Restarted) and event.generation >= self._last_generation:
                continue  # no generation follows, so there is no restart
            if isinstance(event, GenerationFinished) and event.local_generation == 0:
                self.sums = replace(self.sums, generations=self.sums.generations + 1)
            if isinstance(event, NewBest):
                self._improve(event.evaluation)
            happened.append(event)
        self._begin()
        return happened

    def finished(self, reason: EndReason, seconds: float = 0.0) -> Iterator[Event]:
        sums = self.sums
        # A generation that the run limit cut short is reported, but the algorithm does not learn from it.
        if reason == "runs" and self._told:
            local = self._state.local_generation
            yield GenerationFinished(
                generation=self.generation,
                local_generation=local,
                population=tuple(self._told),
                elites=0,
            )
            if local == 0:
                sums = replace(sums, generations=sums.generations + 1)
        yield replace(sums, reason=reason, seconds=seconds)
