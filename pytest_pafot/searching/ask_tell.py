"""The loop of a search, and the interface of the algorithms in it, which is ask and tell.

In each generation :func:`run_campaign` gets scenarios from ``ask`` of an algorithm and passes their evaluations to
``tell``. A search needs only the methods of :class:`Algorithm`. :class:`GenerationalSearch` is a base class for
algorithms without local searches, also for users' own: a subclass defines what it proposes and what it learns.
"""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from typing import Any, ClassVar, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.random import Generator as Rng

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.evaluation import Evaluation, EvaluationCache, Remembered
from pytest_pafot.searching.events import (
    AlgorithmEvent,
    CampaignFinished,
    CampaignStarted,
    EndReason,
    Evaluated,
    Event,
    GenerationFinished,
    LocalSearchFinished,
    NewBest,
    Restarted,
)
from pytest_pafot.searching.operators import best_of, improves
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.errors import OutOfTime


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


class Drawing(Generic[StateT]):
    """The scenarios of a generation, which can be run while later ones are still being sampled.

    Iterating over this object yields the scenarios that the algorithm proposes. A :class:`GenerationalSearch` samples
    each scenario only when it is read, unless its class overrides ``ask``.
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
        """Sample all scenarios that were not read yet, and return the algorithm's state after them."""
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
    """The additional methods of an algorithm whose search ``--pafot-resume`` can continue in a later session."""

    def stored(self, state: Any) -> Any:
        """Return a state between two generations as plain data; see :func:`~pytest_pafot.searching.plain.plain`."""

    def restored(self, data: Any) -> Any:
        """Return the state from plain data; the search then continues as if it had never stopped.

        Raises:
            ValueError: for data that is not from this algorithm.
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
        """Return the evaluations from earlier generations that also belong to the requested one; none by default."""
        return ()


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
                f"{place}: expected the evaluation of {scenario!r} at {index}, received the evaluation of "
                f"{evaluation.scenario!r}; keep the order of the scenarios"
            )


MOST = 10_000
"""The largest population. All scenarios of a generation are in memory at once, with their runs in lock step."""


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


# The loop around an algorithm.

Evaluate = Callable[[Scenario], Evaluation]
"""A function that simulates a scenario and evaluates the run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint(Generic[StateT]):
    """The progress of a campaign: with the arguments of :func:`run_campaign` it determines how the campaign continues.

    Attributes:
        state: state of the algorithm at the last boundary between two generations.
        sums: totals over all evaluations so far.
        remembered: runs that were known at that boundary and need not be simulated again.
        begun: evaluations so far in the generation after that boundary, each with True if an earlier run was reused.
    """

    state: StateT
    sums: CampaignFinished
    remembered: tuple[Remembered, ...] = ()
    begun: tuple[tuple[Evaluation, bool], ...] = ()


class CheckpointError(ValueError):
    """A checkpoint that does not belong to the campaign that should continue from it."""


def run_campaign(
    algorithm: Algorithm[StateT],
    evaluate: Evaluate,
    *,
    generations: int | None,
    seed: int,
    runs: int | None = None,
    max_seconds: float | Callable[[], float] | None = None,
    clock: Callable[[], float] | None = None,
    stop: Callable[[], bool] | None = None,
    seeds_matter: bool = False,
    foresee: Callable[[Iterable[Scenario]], None] | None = None,
    adapted: Callable[[Algorithm[StateT], StateT], Algorithm[StateT]] = lambda algorithm, state: algorithm,
    resumed: Checkpoint[StateT] | None = None,
    border: Callable[[Callable[[], Checkpoint[StateT]]], None] = lambda checkpoint: None,
) -> Generator[Event, None, None]:
    """Run a search, and yield its events as they happen.

    A scenario is simulated only if no earlier run of the campaign shows its result; otherwise the earlier evaluation is
    reused, and its event is marked. The events depend only on the algorithm, the seed and the evaluations: every
    generation has its own random generator, derived from (seed, generation, local generation). Only the moment at which
    a limit ends the campaign, and ``CampaignFinished.seconds``, depend on time.

    If the generator is closed, the campaign ends at the last event, without a further evaluation.

    Args:
        algorithm: the algorithm to run.
        evaluate: simulates a scenario; an exception in it ends the campaign and reaches the consumer. ``OutOfTime``
            ends it as ``max_seconds`` does, and the scenario counts nowhere.
        generations: generations of the main search, at least 1; those of local searches are additional. None if the
            number of ``runs`` is the limit; there are never more generations than runs.
        seed: seed of all random numbers, at least 0.
        runs: number of simulated scenarios after which the campaign ends, at least 1; None for no limit. If the limit
            is reached inside a generation, it is reported as finished, but the algorithm does not receive its results.
        max_seconds: time limit [s], checked between two calls of ``evaluate``, so at least one scenario is simulated.
            If it is a function, each check calls it, so the limit may depend on the evaluations so far.
        clock: seconds since any fixed moment; required by ``max_seconds``. Without a clock no time is measured.
        stop: called between two calls of ``evaluate``; returns whether to end the campaign.
        seeds_matter: True if the seed of a scenario can change its run even if the NPCs drive the same chains.
        foresee: called at the beginning of each generation with its scenarios that no earlier run shows, in order, as
            an iterable that may sample each scenario only when it is read. Most of them are passed to ``evaluate``
            later; simulating them in advance changes no event.
        adapted: called before each generation with the current algorithm and its state; returns the algorithm to
            continue with.
        resumed: checkpoint of an earlier campaign with the same arguments, from which ``generations`` and ``runs``
            are counted. The events of both campaigns, one after the other, are those of one uninterrupted campaign,
            except for :class:`CampaignStarted` and :class:`CampaignFinished`. If the limit on runs cut a generation,
            both campaigns report it as finished.
        border: called at the beginning of a campaign that is not resumed, and after the events of each generation. It
            receives a function that makes the checkpoint and can be called until the next event is requested.

    Raises:
        ValueError: for an argument out of range, before anything runs.
        CheckpointError: for a checkpoint of a different campaign, before anything runs.
    """
    if generations is None and runs is None:
        raise ValueError("generations, runs: expected at least one of them, received neither")
    for name, value, least in (("generations", generations, 1), ("runs", runs, 1), ("seed", seed, 0)):
        if value is not None and value < least:
            raise ValueError(f"{name}: expected a whole number, at least {least}, received {value!r}")
    if isinstance(max_seconds, (int, float)) and not max_seconds >= 0:
        raise ValueError(f"max_seconds: expected seconds, at least 0, or None for no limit, received {max_seconds!r}")
    if max_seconds is not None and clock is None:
        raise ValueError(
            "clock: expected a function that returns seconds with max_seconds, received None; give time.monotonic"
        )
    now = clock or (lambda: 0.0)
    cache = EvaluationCache(seeds_matter=seeds_matter)

    def with_known_runs(checkpoint: Checkpoint[StateT]) -> Checkpoint[StateT]:
        """Return a checkpoint with the known runs added, except those that its ``begun`` already lists."""
        new = sum(not reused for _, reused in checkpoint.begun)
        return replace(checkpoint, remembered=cache.remembered(but=new))

    if resumed is None:
        sums = CampaignFinished(reason="generations", generations=0, evaluated=0, simulated=0, best=None, seconds=0.0)
        resumed = Checkpoint(state=algorithm.start(generation_rng(seed)), sums=sums)
        border(partial(with_known_runs, resumed))
    try:
        cache.restore(resumed.remembered)
    except ValueError as error:
        raise CheckpointError(f"remembered: {error}") from None
    for evaluation, reused in resumed.begun:
        if not reused:
            cache.add(evaluation)
    last_generation = resumed.state.generation + (generations or (runs or 0) + bool(resumed.begun))
    last_run = sys.maxsize if runs is None else resumed.sums.simulated + runs

    def unknown(scenarios: Iterable[Scenario]) -> Iterator[Scenario]:
        """Yield once each scenario that no earlier run shows."""
        seen = set()
        for scenario in scenarios:
            if scenario not in seen and cache.recall(scenario) is None:
                seen.add(scenario)
                yield scenario

    def events(algorithm: Algorithm[StateT], resumed: Checkpoint[StateT]) -> Generator[Event, None, None]:
        started, state, sums, told = now(), resumed.state, resumed.sums, list(resumed.begun)
        yield CampaignStarted(algorithm=algorithm.name, generations=generations, seed=seed)
        reason: EndReason | None = None
        while reason is None and state.generation < last_generation:
            # The algorithm draws the scenarios of a generation; the first may run while the last is still sampled.
            before, rng = state, generation_rng(seed, state.generation, state.local_generation)
            algorithm = adapted(algorithm, state)
            drawing = Drawing(algorithm, state, rng)
            coming: Iterable[Scenario] = drawing
            if told:  # a resumed search may request other scenarios than the one that began the generation
                drawing.finished()
                coming = drawing.scenarios[len(told) :]
                try:
                    check_order("begun", drawing.scenarios[: len(told)], [evaluation for evaluation, _ in told])
                except ValueError as error:
                    raise CheckpointError(str(error)) from None
            else:
                cache.forget()  # only here, between two generations, where checkpoints are made
            if foresee is not None:
                foresee(islice(unknown(coming), last_run - sums.simulated))
            state, scenarios = drawing.finished(), drawing.scenarios

            # Each scenario is simulated, unless an earlier run shows its result; limits count after the first one.
            for index, scenario in enumerate(scenarios[len(told) :], start=len(told)):
                if sums.evaluated > resumed.sums.evaluated:
                    seconds = now() - started
                    if stop is not None and stop():
                        reason = "stopped"
                    elif sums.simulated >= last_run:
                        reason = "runs"
                    elif max_seconds is not None:
                        most = max_seconds() if callable(max_seconds) else max_seconds
                        reason = "time" if seconds >= most else None
                    if reason is not None:
                        break
                evaluation = cache.recall(scenario)
                reused = evaluation is not None
                if evaluation is None:
                    try:
                        evaluation = evaluate(scenario)
                    except OutOfTime:
                        reason = "time"
                        break
                    check_order("evaluate", [scenario], [evaluation])
                    cache.add(evaluation)
                told.append((evaluation, reused))
                sums = replace(
                    sums,
                    evaluated=sums.evaluated + 1,
                    simulated=sums.simulated + (not reused),
                    best=evaluation if improves(evaluation, sums.best) else sums.best,
                )
                yield Evaluated(
                    generation=state.generation,
                    local_generation=state.local_generation,
                    index=index,
                    evaluation=evaluation,
                    reused=reused,
                )

            # The algorithm learns from a whole generation. A generation that the limit on runs cut is only reported:
            # the algorithm does not receive its evaluations, because no other generation follows.
            here = Checkpoint(state=before, sums=sums, begun=tuple(told))
            evaluations = tuple(evaluation for evaluation, _ in told)
            ended: tuple[AlgorithmEvent, ...] = ()
            if reason is None:
                state, ended = algorithm.tell(state, evaluations, rng)
            elif reason == "runs" and evaluations:
                cut = GenerationFinished(
                    generation=state.generation,
                    local_generation=state.local_generation,
                    population=evaluations,
                    elites=0,
                )
                ended = (cut,)
            for event in ended:
                # A restart without a following generation does not take place.
                if not (isinstance(event, Restarted) and event.generation >= last_generation):
                    if isinstance(event, GenerationFinished) and event.local_generation == 0:
                        sums = replace(sums, generations=sums.generations + 1)
                    yield event
            if reason is None:
                here, told = Checkpoint(state=state, sums=sums), []
            border(partial(with_known_runs, here))
        yield replace(sums, reason=reason or "generations", seconds=now() - started)

    return events(algorithm, resumed)


def generation_rng(seed: int, *generation: int) -> np.random.Generator:
    """Return the random generator of a generation; it depends only on the seed and the numbers of the generation."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=generation))
