"""The plan of a search: which scenario is next, and what the algorithm learns from the runs.

A plan is asked for scenarios and receives their evaluations. It runs nothing and measures no time, so the same
evaluations give the same scenarios.
"""

from __future__ import annotations

import pickle
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any, Generic

from numpy.random import Generator as Rng

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.searching.ask_tell import Algorithm, GenerationalSearch, StateT, block_runs, check_order
from pytest_pafot.searching.evaluation import Evaluation, EvaluationCache
from pytest_pafot.searching.events import (
    AlgorithmEvent,
    CampaignFinished,
    CampaignStarted,
    EndReason,
    Evaluated,
    Event,
    GenerationFinished,
    NewBest,
    Restarted,
)
from pytest_pafot.searching.operators import improves

LEAST_GENERATIONS = 4
"""The least number of generations of a block. The first one is random, so in fewer hardly anything would be bred."""


def plan_of(
    algorithm: Algorithm[StateT],
    *,
    generations: int | None,
    seed: int,
    runs: int | None = None,
    seeds_matter: bool = False,
) -> Plan[StateT]:
    """Return the plan of a search.

    The scenarios depend only on the algorithm, the seed and the evaluations: every generation has its own random
    generator, derived from (seed, generation, local generation). A search in blocks
    (:func:`~pytest_pafot.searching.ask_tell.block_runs`) begins anew after each of them, and simulates all scenarios.
    In any other search a scenario is simulated only if no earlier run shows its result; otherwise the earlier
    evaluation is taken again, and its event is marked.

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
    if generations is None and runs is None:
        raise ValueError("generations, runs: expected at least one of them, received neither")
    for name, value, least in (("generations", generations, 1), ("runs", runs, 1), ("seed", seed, 0)):
        if value is not None and value < least:
            raise ValueError(f"{name}: expected a whole number, at least {least}, received {value!r}")
    length, of_block = None, block_runs(algorithm)
    if of_block is not None:
        # Whole generations, since an algorithm learns from nothing less.
        length = max(LEAST_GENERATIONS, -(-of_block // algorithm.population))  # type: ignore[attr-defined]
    return Plan(
        started=CampaignStarted(algorithm=algorithm.name, generations=generations, seed=seed),
        algorithm=algorithm,
        length=length,
        last_generation=generations or runs or 0,
        last_run=runs or sys.maxsize,
        seeds_matter=seeds_matter,
    )


class Plan(Generic[StateT]):
    """The scenarios of a search in their order, and what its algorithm has learnt.

    Whoever runs it asks for one :meth:`scenario` after the other and passes its evaluation to :meth:`take`. When a
    generation :attr:`is_whole`, the algorithm must :meth:`learn` from it.

    Args:
        started: the first event.
        algorithm: the algorithm of all generations.
        length: the number of generations of a block; None if the whole search is one.
        last_generation: the number of the generation before which the search ends.
        last_run: the number of simulated scenarios after which it ends.
        seeds_matter: as for :func:`plan_of`.
    """

    def __init__(
        self,
        *,
        started: CampaignStarted,
        algorithm: Algorithm[StateT],
        length: int | None,
        last_generation: int,
        last_run: int,
        seeds_matter: bool,
    ) -> None:
        self.started = started
        self.sums = CampaignFinished(
            reason="generations", generations=0, evaluated=0, simulated=0, best=None, seconds=0.0
        )
        """The totals over all evaluations so far."""
        self.length = length
        self.last_generation = last_generation
        self.last_run = last_run
        self.algorithm: Any = algorithm
        self._is_announced = False
        cache = None if length is not None else EvaluationCache(seeds_matter=seeds_matter)
        self.block = Block(algorithm, started.seed, algorithm.start(generation_rng(started.seed)), cache=cache)
        """The block that is under way."""

    @property
    def generation(self) -> int:
        """The number of the generation that is evaluated, or of the next one."""
        return self.block.generation

    @property
    def is_over(self) -> bool:
        """True if there is no further generation."""
        return self.generation >= self.last_generation

    @property
    def has_all_runs(self) -> bool:
        """True if as many scenarios are simulated as were asked for."""
        return self.sums.simulated >= self.last_run

    @property
    def is_whole(self) -> bool:
        """True if all scenarios of the generation are evaluated."""
        return self.block.is_whole

    def scenario(self) -> Scenario:
        """Return the next scenario."""
        return self.block.scenario()

    def recalled(self) -> Evaluation | None:
        """Return the evaluation of the next scenario if an earlier run shows it; None if it has to be simulated."""
        return self.block.recalled()

    def ahead(self) -> Iterator[Scenario] | None:
        """Return the scenarios of the generation that no earlier run shows, at its beginning; None if it has begun.

        They can be simulated in advance: most of them will be asked for, in this order. Each is drawn when it is read.
        """
        if self._is_announced:
            return None
        self._is_announced = True
        return islice(self.block.unknown(), self.last_run - self.sums.simulated)

    def within(self, block: Block[Any]) -> Iterator[Scenario]:
        """Return the scenarios of a later block's generation that the limits of the search allow."""
        is_over = block.generation >= self.last_generation
        return islice(block.unknown(), 0 if is_over else max(0, self.last_run - block.state.proposed))

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Evaluated:
        """Take the evaluation of the next scenario; ``reused`` if it is :meth:`known`."""
        event = self.block.take(evaluation, reused=reused)
        best = evaluation if improves(evaluation, self.sums.best) else self.sums.best
        self._count(1, not reused, best)
        return event

    def skip(self, runs: int, evaluations: bytes) -> None:
        """Take the evaluations of the next scenarios of the block as another process has packed them."""
        self.block.skip(runs, evaluations)
        self._count(runs, runs, self.sums.best)  # what was learnt tells the best of them

    def _count(self, evaluated: int, simulated: int, best: Evaluation | None) -> None:
        sums = self.sums
        self.sums = replace(sums, evaluated=sums.evaluated + evaluated, simulated=sums.simulated + simulated, best=best)

    def learn(self) -> Sequence[AlgorithmEvent]:
        """Let the algorithm learn from a whole generation, and begin the next block after the last one of a block.

        The events lack a restart that no generation follows.
        """
        happened = []
        for event in self.block.learn():
            if isinstance(event, Restarted) and event.generation >= self.last_generation:
                continue
            if isinstance(event, GenerationFinished) and event.local_generation == 0:
                self.sums = replace(self.sums, generations=self.sums.generations + 1)
            if isinstance(event, NewBest) and improves(event.evaluation, self.sums.best):
                self.sums = replace(self.sums, best=event.evaluation)
            happened.append(event)
        self._is_announced = False
        if self.length is not None and self.generation % self.length == 0:
            self.block = self.beginning(self.number)
        return happened

    def finished(self, reason: EndReason, seconds: float = 0.0) -> Iterator[Event]:
        """Yield the last events. A generation that the limit on runs cut is reported, but not learnt.

        No other generation follows.
        """
        begun = self.block.evaluations()
        best = self.sums.best
        for each, _ in begun:
            best = each if improves(each, best) else best
        sums = replace(self.sums, best=best)
        if reason == "runs" and begun:
            population, local = tuple(each for each, _ in begun), self.block.state.local_generation
            yield GenerationFinished(
                generation=self.generation, local_generation=local, population=population, elites=0
            )
            sums = replace(sums, generations=sums.generations + (local == 0))
        yield replace(sums, reason=reason, seconds=seconds)

    # Blocks, of which other processes can drive later ones.

    @property
    def number(self) -> int:
        """The number of the block that is under way, from 0."""
        return 0 if self.length is None else self.generation // self.length

    @property
    def whole_blocks(self) -> int:
        """The number of blocks, from the first one on, that end within the limits of the search."""
        if self.length is None:
            return 0
        return min(self.last_generation, self.last_run // int(self.algorithm.population)) // self.length

    def beginning(self, number: int) -> Block[StateT]:
        """Return a block at its beginning."""
        assert self.length is not None  # noqa: S101  (only a search in blocks has another one)
        generation, algorithm = number * self.length, self.algorithm
        start = algorithm.start(generation_rng(self.started.seed))
        begun = replace(start, generation=generation, proposed=generation * algorithm.population)
        return Block(algorithm, self.started.seed, begun)


@dataclass(frozen=True, slots=True, kw_only=True)
class Learnt:
    """The state of an algorithm, packed, and its events, after it has learnt from a generation in another process."""

    state: bytes
    events: tuple[AlgorithmEvent, ...]

    @classmethod
    def packed(cls, state: object, events: Iterable[AlgorithmEvent]) -> Learnt:
        """Pack a state. Of the events the evaluations are left out, which are sent before."""
        left = (
            replace(each, population=(), is_whole=False) if isinstance(each, GenerationFinished) else each
            for each in events
        )
        return cls(state=pickle.dumps(state), events=tuple(left))


class Block(Generic[StateT]):
    """Generations of one population, each of which is learnt before the next one is drawn.

    With a cache, a scenario whose result an earlier run shows need not be simulated. Without, the scenarios depend only
    on the algorithm, the seed, the state with which the block begins, and the evaluations of its own runs. So whoever
    drives it, it is the same. What another process has driven is unpacked only where it is needed.
    """

    def __init__(
        self,
        algorithm: Any,
        seed: int,
        state: StateT,
        *,
        cache: EvaluationCache | None = None,
    ) -> None:
        self.generation = state.generation
        """The number of the generation that is evaluated, or of the next one."""
        self.index = 0
        """The number of evaluated scenarios of that generation."""
        self.learnt: Learnt | None = None
        """What another process has learnt from that generation; None if this process learns from it."""
        self._algorithm, self._seed, self._cache = algorithm, seed, cache
        self._state: StateT | bytes = state  # at the last border between two generations
        self._begun: list[tuple[Evaluation, bool] | bytes] = []  # since then
        self._drawing: Drawing[StateT] | None = None  # of this generation, once it has begun
        self._rng = generation_rng(seed)

    @property
    def is_whole(self) -> bool:
        """True if all scenarios of the generation are evaluated."""
        if self._cache is None and self._drawing is None:
            return self.index >= int(self._algorithm.population)
        return not self._drawn.has(self.index)

    def scenario(self) -> Scenario:
        """Return the next scenario."""
        drawn = self._drawn
        drawn.has(self.index)
        return drawn.scenarios[self.index]

    def recalled(self) -> Evaluation | None:
        """Return the evaluation of the next scenario if an earlier run shows it; None if it has to be simulated."""
        return None if self._cache is None else self._cache.recall(self.scenario())

    def unknown(self) -> Iterator[Scenario]:
        """Yield the next scenarios of the generation that no earlier run shows."""
        drawn, seen = self._drawn, set()
        for scenario in chain(drawn.scenarios[self.index :], drawn):
            if scenario not in seen and (self._cache is None or self._cache.recall(scenario) is None):
                seen.add(scenario)
                yield scenario

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Evaluated:
        """Take the evaluation of the next scenario; ``reused`` if it is :meth:`known`."""
        if not reused:
            if self._drawing is not None:
                check_order("evaluate", [self.scenario()], [evaluation])
            if self._cache is not None:
                self._cache.add(evaluation)
        self._begun.append((evaluation, reused))
        self.index += 1
        return Evaluated(
            generation=self.generation,
            local_generation=0 if isinstance(self._state, bytes) else self._state.local_generation,
            index=self.index - 1,
            evaluation=evaluation,
            reused=reused,
        )

    def skip(self, runs: int, evaluations: bytes) -> None:
        """Take the evaluations of the next scenarios as another process has packed them."""
        self._begun.append(evaluations)
        self.index += runs

    def learn(self) -> Sequence[AlgorithmEvent]:
        """Let the algorithm learn from a whole generation, or take what another process has learnt from it."""
        learnt, events = self.learnt, tuple[AlgorithmEvent, ...]()
        if learnt is None:
            asked, evaluations = self._drawn.finished(), tuple(each for each, _ in self.evaluations())
            state, events = self._algorithm.tell(asked, evaluations, self._rng)
            self._state, self.generation = state, state.generation
        else:
            self._state, events = learnt.state, learnt.events
            self.generation += 1
        self._begun, self.index, self._drawing, self.learnt = [], 0, None, None
        return events

    def evaluations(self) -> tuple[tuple[Evaluation, bool], ...]:
        """Return the evaluations of the generation so far, each with True if an earlier run was reused."""
        unpacked: list[tuple[Evaluation, bool]] = []
        for each in self._begun:
            unpacked += [(one, False) for one in pickle.loads(each)] if isinstance(each, bytes) else [each]  # noqa: S301
        self._begun = [*unpacked]
        return tuple(unpacked)

    @property
    def state(self) -> StateT:
        """The state of the algorithm at the last border between two generations."""
        if isinstance(self._state, bytes):
            self._state = pickle.loads(self._state)  # noqa: S301  (from a process of this session)
        state: StateT = self._state  # type: ignore[assignment]  # no bytes any more
        return state

    @property
    def drawn(self) -> tuple[Scenario, ...]:
        """All scenarios of the generation."""
        self._drawn.finished()
        return tuple(self._drawn.scenarios)

    @property
    def _drawn(self) -> Drawing[StateT]:
        """The scenarios of the generation, which are drawn when they are read."""
        if self._drawing is not None:
            return self._drawing
        state = self.state
        self._rng = generation_rng(self._seed, state.generation, state.local_generation)
        self._drawing = Drawing(self._algorithm, state, self._rng)
        if self._cache is not None:
            self._cache.forget()
        return self._drawing


def generation_rng(seed: int, *generation: int) -> Rng:
    """Return the random generator of a generation; it depends only on the seed and the numbers of the generation."""
    return rng_of(seed, *generation)


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

    def has(self, index: int) -> bool:
        """Return whether there is a scenario at an index. It is sampled then, and so are those before it."""
        deque(islice(self, max(0, index + 1 - len(self.scenarios))), maxlen=0)
        return index < len(self.scenarios)

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
