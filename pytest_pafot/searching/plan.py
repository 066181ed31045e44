"""The plan of a search: which scenario is next, and what the algorithm learns from the runs.

A plan is asked for scenarios and receives their evaluations. It runs nothing and measures no time, so the same
evaluations give the same scenarios.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any, ClassVar, Generic

import numpy as np
from numpy.random import Generator as Rng

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import Algorithm, GenerationalSearch, StateT, check_order, draws_ahead
from pytest_pafot.searching.evaluation import Evaluation, EvaluationCache, Remembered
from pytest_pafot.searching.events import (
    AlgorithmEvent,
    CampaignFinished,
    CampaignStarted,
    EndReason,
    Evaluated,
    Event,
    GenerationFinished,
    Restarted,
)
from pytest_pafot.searching.operators import improves


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint(Generic[StateT]):
    """The progress of a campaign: with the arguments of :func:`plan_of` it determines how the campaign continues.

    Attributes:
        state: state of the algorithm at the last boundary between two generations.
        sums: totals over all evaluations so far.
        remembered: runs that were known at that boundary and need not be simulated again.
        begun: evaluations so far in the generation after that boundary, each with True if an earlier run was reused.
        news: for an :class:`~pytest_pafot.searching.ask_tell.AheadSearch`, the evaluations to learn from, for each
            generation from that boundary on; the last of them is the generation that is under evaluation. ``state`` is
            then the oldest state from which a scenario is still drawn.
        done: for such a search, the number of evaluated scenarios of the last generation in ``news``.
    """

    state: StateT
    sums: CampaignFinished
    remembered: tuple[Remembered, ...] = ()
    begun: tuple[tuple[Evaluation, bool], ...] = ()
    news: tuple[tuple[Evaluation, ...], ...] = ()
    done: int = 0

    @property
    def generation(self) -> int:
        """The number of the generation with which the campaign continues."""
        return self.state.generation + max(len(self.news) - 1, 0)


class CheckpointError(ValueError):
    """A checkpoint that does not belong to the campaign that should continue from it."""


def plan_of(
    algorithm: Algorithm[StateT],
    *,
    generations: int | None,
    seed: int,
    runs: int | None = None,
    for_batches: Algorithm[StateT] | None = None,
    decides_for_many: bool = False,
    seeds_matter: bool = False,
    resumed: Checkpoint[StateT] | None = None,
) -> Plan[StateT]:
    """Return the plan of a search.

    A scenario is simulated only if no earlier run of the search shows its result; otherwise the earlier evaluation is
    taken again, and its event is marked. An :class:`~pytest_pafot.searching.ask_tell.AheadSearch` simulates all of
    them, because another process may have made the earlier run. The scenarios depend only on the algorithm, the seed
    and the evaluations: every generation has its own random generator, derived from (seed, generation, local
    generation).

    Args:
        algorithm: the algorithm to run.
        generations: generations of the main search, at least 1; those of local searches are additional. None if the
            number of ``runs`` is the limit; there are never more generations than runs.
        seed: seed of all random numbers, at least 0.
        runs: number of simulated scenarios after which the search ends, at least 1; None for no limit. If the limit
            is reached inside a generation, it is reported as finished, but the algorithm does not receive its results.
        for_batches: the algorithm of all generations but the first if the policy decides for many runs at once; None
            for ``algorithm``.
        decides_for_many: True if that is known already.
        seeds_matter: True if the seed of a scenario can change its run even if the NPCs drive the same chains.
        resumed: checkpoint of an earlier search with the same arguments, from which ``generations`` and ``runs`` are
            counted. The events of both, one after the other, are those of one uninterrupted search, except for
            :class:`CampaignStarted` and :class:`CampaignFinished`. If the limit on runs cut a generation, both report
            it as finished.

    Raises:
        ValueError: for an argument out of range.
        CheckpointError: for a checkpoint of a different search.
    """
    if generations is None and runs is None:
        raise ValueError("generations, runs: expected at least one of them, received neither")
    for name, value, least in (("generations", generations, 1), ("runs", runs, 1), ("seed", seed, 0)):
        if value is not None and value < least:
            raise ValueError(f"{name}: expected a whole number, at least {least}, received {value!r}")
    is_ahead = draws_ahead(algorithm)
    if resumed is None:
        sums = CampaignFinished(reason="generations", generations=0, evaluated=0, simulated=0, best=None, seconds=0.0)
        resumed = Checkpoint(state=algorithm.start(generation_rng(seed)), sums=sums, news=((),) if is_ahead else ())
    started = CampaignStarted(algorithm=algorithm.name, generations=generations, seed=seed)
    last_generation = resumed.generation + (generations or (runs or 0) + bool(resumed.begun or resumed.done))
    last_run = sys.maxsize if runs is None else resumed.sums.simulated + runs
    algorithms = algorithm, for_batches or algorithm
    arguments = started, algorithms, decides_for_many, last_generation, last_run, resumed
    return AheadPlan(*arguments) if is_ahead else GenerationPlan(*arguments, seeds_matter=seeds_matter)


class Plan(ABC, Generic[StateT]):
    """The scenarios of a search in their order, and what its algorithm has learnt.

    Whoever runs it asks for one :meth:`scenario` after the other and passes its evaluation to :meth:`take`. When a
    generation :attr:`is_whole`, the algorithm must :meth:`learn` from it.

    Args:
        started: the first event.
        algorithms: the algorithm of the first generation, and that of later ones if the policy decides for many runs.
        decides_for_many: True if that is known already.
        last_generation: the number of the generation before which the search ends.
        last_run: the number of simulated scenarios after which it ends.
        resumed: the progress from which it goes on.
    """

    is_ahead: ClassVar[bool]
    """True if generations are drawn before all earlier ones are learnt."""

    def __init__(
        self,
        started: CampaignStarted,
        algorithms: tuple[Algorithm[StateT], Algorithm[StateT]],
        decides_for_many: bool,
        last_generation: int,
        last_run: int,
        resumed: Checkpoint[StateT],
    ) -> None:
        self.started = started
        self.sums = resumed.sums
        """The totals over all evaluations so far."""
        self.decides_for_many = decides_for_many
        """True as soon as the policy has shown that it decides for many runs at once; whoever runs it notes that."""
        self.last_generation = last_generation
        self.last_run = last_run
        self._algorithms = algorithms

    @property
    @abstractmethod
    def generation(self) -> int:
        """The number of the generation that is evaluated, or of the next one."""

    @property
    def is_over(self) -> bool:
        """True if there is no further generation."""
        return self.generation >= self.last_generation

    @property
    def has_all_runs(self) -> bool:
        """True if as many scenarios are simulated as were asked for."""
        return self.sums.simulated >= self.last_run

    @property
    @abstractmethod
    def is_whole(self) -> bool:
        """True if all scenarios of the generation are evaluated."""

    @property
    def news(self) -> tuple[Evaluation, ...]:
        """The evaluations of the generation from which others that draw its scenarios must learn; here, none do."""
        return ()

    @abstractmethod
    def scenario(self) -> Scenario:
        """Return the next scenario."""

    @abstractmethod
    def known(self) -> Evaluation | None:
        """Return the evaluation of the next scenario if an earlier run shows it; None if it has to be simulated."""

    @abstractmethod
    def ahead(self) -> Iterator[Scenario] | None:
        """Return the next scenarios that this method has not returned before; None if there are none.

        They can be simulated in advance: most of them will be asked for, in this order. Each is drawn when it is read.
        """

    @abstractmethod
    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Evaluated:
        """Take the evaluation of the next scenario; ``reused`` if it is :meth:`known`."""

    @abstractmethod
    def learn(self) -> Sequence[AlgorithmEvent]:
        """Let the algorithm learn from a whole generation."""

    @abstractmethod
    def checkpoint(self) -> Checkpoint[StateT]:
        """Return the progress so far."""

    @abstractmethod
    def _cut(self) -> GenerationFinished | None:
        """Return the event of a generation of which only some scenarios are evaluated; None if none are."""

    def finished(self, reason: EndReason, seconds: float = 0.0) -> Iterator[Event]:
        """Yield the last events. A generation that the limit on runs cut is reported, but not learnt.

        No other generation follows, and the next session goes on with the rest of this one.
        """
        sums, cut = self.sums, self._cut() if reason == "runs" else None
        if cut is not None:
            sums = replace(sums, generations=sums.generations + (cut.local_generation == 0))
            yield cut
        yield replace(sums, reason=reason, seconds=seconds)

    def algorithm(self, generation: int) -> Any:
        """Return the algorithm of a generation."""
        return self._algorithms[bool(generation) and self.decides_for_many]

    def _happened(self, events: Iterable[AlgorithmEvent]) -> list[AlgorithmEvent]:
        """Count finished generations; return the events without a restart that no generation follows."""
        happened = []
        for event in events:
            if not (isinstance(event, Restarted) and event.generation >= self.last_generation):
                if isinstance(event, GenerationFinished) and event.local_generation == 0:
                    self.sums = replace(self.sums, generations=self.sums.generations + 1)
                happened.append(event)
        return happened


class GenerationPlan(Plan[StateT]):
    """The plan of a search in which each generation is learnt before the next one is drawn."""

    is_ahead = False

    def __init__(self, *arguments: Any, seeds_matter: bool) -> None:
        super().__init__(*arguments)
        resumed: Checkpoint[StateT] = arguments[-1]
        self._state = resumed.state  # at the last border between two generations
        self._done = list(resumed.begun)  # since then
        self._drawing: Drawing[StateT] | None = None  # of this generation, once it has begun
        self._is_announced = False
        self._rng = generation_rng(self.started.seed)
        self._cache = EvaluationCache(seeds_matter=seeds_matter)
        try:
            self._cache.restore(resumed.remembered)
        except ValueError as error:
            raise CheckpointError(f"remembered: {error}") from None
        for evaluation, reused in resumed.begun:
            if not reused:
                self._cache.add(evaluation)

    @property
    def generation(self) -> int:
        """The number of the generation that is evaluated, or of the next one."""
        return self._state.generation

    @property
    def _begun(self) -> Drawing[StateT]:
        """The scenarios of the generation."""
        if self._drawing is not None:
            return self._drawing
        self._rng = generation_rng(self.started.seed, self._state.generation, self._state.local_generation)
        self._drawing = Drawing(self.algorithm(self._state.generation), self._state, self._rng)
        if not self._done:
            self._cache.forget()  # only here, between two generations, where checkpoints are made
            return self._drawing
        # A resumed search may request other scenarios than the one that began the generation.
        self._drawing.finished()
        try:
            check_order("begun", self._drawing.scenarios[: len(self._done)], [each for each, _ in self._done])
        except ValueError as error:
            raise CheckpointError(str(error)) from None
        return self._drawing

    @property
    def is_whole(self) -> bool:
        """True if all scenarios of the generation are evaluated."""
        return not self._begun.has(len(self._done))

    def scenario(self) -> Scenario:
        """Return the next scenario."""
        return self._begun.scenarios[len(self._done)]

    def known(self) -> Evaluation | None:
        """Return the evaluation of the next scenario if an earlier run shows it; None if it has to be simulated."""
        return self._cache.recall(self.scenario())

    def ahead(self) -> Iterator[Scenario] | None:
        """Return the scenarios of the generation that no earlier run shows, at its beginning."""
        if self._is_announced:
            return None
        self._is_announced = True
        return islice(self._unknown(), self.last_run - self.sums.simulated)

    def _unknown(self) -> Iterator[Scenario]:
        drawing, seen = self._begun, set()
        for scenario in chain(drawing.scenarios[len(self._done) :], drawing):
            if scenario not in seen and self._cache.recall(scenario) is None:
                seen.add(scenario)
                yield scenario

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Evaluated:
        """Take the evaluation of the next scenario; ``reused`` if it is :meth:`known`."""
        if not reused:
            check_order("evaluate", [self.scenario()], [evaluation])
            self._cache.add(evaluation)
        self._done.append((evaluation, reused))
        sums = self.sums
        self.sums = replace(
            sums,
            evaluated=sums.evaluated + 1,
            simulated=sums.simulated + (not reused),
            best=evaluation if improves(evaluation, sums.best) else sums.best,
        )
        return Evaluated(
            generation=self._state.generation,
            local_generation=self._state.local_generation,
            index=len(self._done) - 1,
            evaluation=evaluation,
            reused=reused,
        )

    def learn(self) -> Sequence[AlgorithmEvent]:
        """Let the algorithm learn from a whole generation."""
        algorithm, asked = self.algorithm(self._state.generation), self._begun.finished()
        evaluations = tuple(evaluation for evaluation, _ in self._done)
        self._state, events = algorithm.tell(asked, evaluations, self._rng)
        self._done, self._drawing, self._is_announced = [], None, False
        return self._happened(events)

    def checkpoint(self) -> Checkpoint[StateT]:
        """Return the progress so far."""
        begun = tuple(self._done)
        new = sum(not reused for _, reused in begun)  # which are not listed twice
        return Checkpoint(state=self._state, sums=self.sums, begun=begun, remembered=self._cache.remembered(but=new))

    def _cut(self) -> GenerationFinished | None:
        evaluations = tuple(evaluation for evaluation, _ in self._done)
        if not evaluations:
            return None
        state = self._state
        return GenerationFinished(
            generation=state.generation, local_generation=state.local_generation, population=evaluations, elites=0
        )


class AheadPlan(Plan[StateT]):
    """The plan of a search whose generations are drawn before all earlier ones are learnt."""

    is_ahead = True

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        resumed: Checkpoint[StateT] = arguments[-1]
        self.drawer = drawer = Drawer(self.algorithm, self.started.seed, resumed.state)
        """The scenarios. Other processes may have drawn those of which only counts arrive here."""
        if not resumed.news:
            raise CheckpointError("news: expected the evaluations of at least one generation, received none")
        # the generations that were learnt since the oldest state that is still needed
        self._learnt = list(resumed.news[:-1])
        for news in self._learnt:
            drawer.learn(news)
        if not drawer.can_draw(resumed.generation):
            raise CheckpointError(
                f"news: expected the evaluations of all generations before {resumed.generation} since generation "
                f"{resumed.state.generation}, received those of {len(self._learnt)}"
            )
        most = drawer.population(resumed.generation)
        if not 0 <= resumed.done <= most:
            raise CheckpointError(f"done: expected a number of scenarios from 0 to {most}, received {resumed.done}")
        evaluated = drawer.number(resumed.generation, resumed.done)
        if resumed.sums.evaluated != evaluated:
            raise CheckpointError(f"sums: expected {evaluated} evaluated scenarios, received {resumed.sums.evaluated}")
        # the place of the next scenario, and the evaluations of its generation that matter
        self._generation, self.index, self._coming = resumed.generation, resumed.done, list(resumed.news[-1])
        self._announced = self._generation, self.index  # the first place that :meth:`ahead` has not returned yet

    @property
    def generation(self) -> int:
        """The number of the generation that is evaluated, or of the next one."""
        return self._generation

    @property
    def is_whole(self) -> bool:
        """True if all scenarios of the generation are evaluated."""
        return self.index >= self.drawer.population(self._generation)

    @property
    def news(self) -> tuple[Evaluation, ...]:
        """The evaluations of the generation so far that matter to the algorithm."""
        return tuple(self._coming)

    def scenario(self) -> Scenario:
        """Return the next scenario."""
        return self.drawer.scenario(self._generation, self.index)

    def known(self) -> Evaluation | None:
        """Return None, because each scenario is simulated."""
        return None

    def needed(self, later: int) -> int:
        """Return how many scenarios of a generation the limits allow."""
        drawer = self.drawer
        between = drawer.number(later) - drawer.number(self._generation, self.index)
        left = self.last_run - self.sums.simulated - between
        return 0 if later >= self.last_generation else max(0, min(drawer.population(later), left))

    def ahead(self) -> Iterator[Scenario]:
        """Return all scenarios that can be drawn now. The first run shows the algorithm of later ones."""
        drawer, here = self.drawer, (self._generation, self.index)
        later, start = self._announced = max(self._announced, here)  # other processes have run those before it
        while start < self.needed(later) or (start >= drawer.population(later) and self.needed(later + 1)):
            if start >= drawer.population(later):
                later, start = later + 1, 0
            if not drawer.can_draw(later) or (later > 0 and drawer.number(*here) == 0):
                return
            self._announced = later, start + 1
            yield drawer.scenario(later, start)
            start += 1

    def take(self, evaluation: Evaluation, *, reused: bool = False) -> Evaluated:
        """Take the evaluation of the next scenario."""
        check_order("evaluate", [self.scenario()], [evaluation])
        news = (evaluation,) if self.drawer.matters(self._generation, evaluation) else ()
        (event,) = self.take_all([evaluation], news)
        return event

    def take_all(self, evaluations: Sequence[Evaluation], news: Sequence[Evaluation]) -> list[Evaluated]:
        """Take the evaluations of the next scenarios; ``news`` are those that matter to the algorithm."""
        first = self.index
        self.skip(len(evaluations), news)
        return [
            Evaluated(generation=self._generation, local_generation=0, index=index, evaluation=each, reused=False)
            for index, each in enumerate(evaluations, start=first)
        ]

    def skip(self, runs: int, news: Sequence[Evaluation]) -> None:
        """Take only those evaluations of the next scenarios that matter to the algorithm."""
        sums = self.sums
        for each in news:
            sums = replace(sums, best=each) if improves(each, sums.best) else sums
        self.sums = replace(sums, evaluated=sums.evaluated + runs, simulated=sums.simulated + runs)
        self._coming += news
        self.index += runs

    def learn(self) -> Sequence[AlgorithmEvent]:
        """Let the algorithm learn from a whole generation."""
        before, news = self.drawer.oldest.generation, tuple(self._coming)
        events = self.drawer.learn(news)
        self._learnt = [*self._learnt, news][self.drawer.oldest.generation - before :]
        self._generation, self.index, self._coming = self._generation + 1, 0, []
        return self._happened(events)

    def checkpoint(self) -> Checkpoint[StateT]:
        """Return the progress so far."""
        news = (*self._learnt, tuple(self._coming))
        return Checkpoint(state=self.drawer.oldest, sums=self.sums, news=news, done=self.index)

    def _cut(self) -> GenerationFinished | None:
        if not self.index:
            return None
        population = tuple(self._coming)
        return GenerationFinished(
            generation=self._generation, local_generation=0, population=population, elites=0, is_whole=False
        )


class Drawer(Generic[StateT]):
    """The scenarios of an :class:`~pytest_pafot.searching.ask_tell.AheadSearch`.

    A scenario follows from the seed, from its place, and from the generations that are learnt before it is drawn. So
    each process draws the same scenarios, as long as it learns the same evaluations.
    """

    def __init__(self, algorithm: Callable[[int], Any], seed: int, state: StateT) -> None:
        self.algorithm = algorithm
        """Return the algorithm of a generation, an :class:`~pytest_pafot.searching.ask_tell.AheadSearch`."""
        self._seed = seed
        # the states from which a generation may still be drawn, by the number of generations learnt before
        self._states: dict[int, Any] = {state.generation: state}
        self._drawings: dict[int, Drawing[StateT]] = {}

    def population(self, generation: int) -> int:
        """Return the number of scenarios in a generation."""
        return int(self.algorithm(generation).population)

    def number(self, generation: int, index: int = 0) -> int:
        """Return how many scenarios come before a scenario of a generation. All generations but the first are alike."""
        return index + (self.population(0) + (generation - 1) * self.population(generation) if generation else 0)

    @property
    def oldest(self) -> StateT:
        """The oldest state from which a generation may still be drawn."""
        state: StateT = self._states[min(self._states)]
        return state

    def can_draw(self, generation: int) -> bool:
        """Return whether all generations are learnt that must be learnt before a generation is drawn."""
        return self.algorithm(generation).waits_for(generation) in self._states

    def scenario(self, generation: int, index: int) -> Scenario:
        """Return a scenario of a generation; the scenarios before it are drawn, too, and remembered."""
        drawing = self._drawings.get(generation)
        if drawing is None:
            algorithm = self.algorithm(generation)
            before = self._states[algorithm.waits_for(generation)]
            state = replace(before, generation=generation, proposed=self.number(generation))
            drawing = self._drawings[generation] = Drawing(algorithm, state, generation_rng(self._seed, generation, 0))
        drawing.has(index)
        return drawing.scenarios[index]

    def matters(self, generation: int, evaluation: Evaluation) -> bool:
        """Return whether an evaluation of a generation may change any later state."""
        algorithm = self.algorithm(generation)
        return bool(algorithm.matters(self._states[algorithm.waits_for(generation)], evaluation))

    def learn(self, news: tuple[Evaluation, ...]) -> tuple[AlgorithmEvent, ...]:
        """Learn from the next generation; return the algorithm's events. ``news`` are the evaluations that matter."""
        number = max(self._states)
        algorithm = self.algorithm(number)
        state = replace(self._states[number], asked=tuple(each.scenario for each in news))
        learnt, events = algorithm.tell(state, news, generation_rng(self._seed, number, 0))
        self._states[number + 1] = replace(learnt, proposed=self.number(number + 1))
        for old in range(min(self._states), self.algorithm(number + 1).waits_for(number + 1)):
            del self._states[old]
        for old in [each for each in self._drawings if each <= number]:
            del self._drawings[old]
        happened: tuple[AlgorithmEvent, ...] = tuple(
            replace(each, is_whole=False) if isinstance(each, GenerationFinished) else each for each in events
        )
        return happened


def generation_rng(seed: int, *generation: int) -> np.random.Generator:
    """Return the random generator of a generation; it depends only on the seed and the numbers of the generation."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=generation))


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
