"""The loop around an algorithm: it requests scenarios, has them evaluated, and passes the evaluations back."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any, Generic, Protocol

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
    GroupEvaluated,
    Restarted,
)
from pytest_pafot.searching.operators import improves
from pytest_pafot.support.errors import OutOfTime

Evaluate = Callable[[Scenario], Evaluation]
"""A function that simulates a scenario and evaluates the run."""

Adapted = Callable[[Algorithm[StateT], int], Algorithm[StateT]]
"""A function that returns the algorithm of a generation, for example with a larger population."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint(Generic[StateT]):
    """The progress of a campaign: with the arguments of :func:`run_campaign` it determines how the campaign continues.

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
    team: Team | None = None,
    adapted: Adapted[StateT] = lambda algorithm, generation: algorithm,
    resumed: Checkpoint[StateT] | None = None,
    border: Callable[[Callable[[], Checkpoint[StateT]]], None] = lambda checkpoint: None,
) -> Generator[Event, None, None]:
    """Run a search, and yield its events as they happen.

    A scenario is simulated only if no earlier run of the campaign shows its result; otherwise the earlier evaluation is
    reused, and its event is marked. An :class:`~pytest_pafot.searching.ask_tell.AheadSearch` simulates all of them,
    because another process may have made the earlier run. The events depend only on the algorithm, the seed and the
    evaluations: every generation has its own random generator, derived from (seed, generation, local generation). Only
    the moment at which a limit ends the campaign, and ``CampaignFinished.seconds``, depend on time.

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
            later; simulating them in advance changes no event. For an
            :class:`~pytest_pafot.searching.ask_tell.AheadSearch` it is called with the scenarios of further
            generations, while earlier ones are still to come.
        team: processes that draw, run and evaluate scenarios of such a search themselves.
        adapted: called with the algorithm and the number of a generation; returns the algorithm that proposes it and
            learns from it. For the first generation it must return the algorithm itself.
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
    is_ahead = draws_ahead(algorithm)
    if resumed is None:
        sums = CampaignFinished(reason="generations", generations=0, evaluated=0, simulated=0, best=None, seconds=0.0)
        resumed = Checkpoint(state=algorithm.start(generation_rng(seed)), sums=sums, news=((),) if is_ahead else ())
        border(partial(replace, resumed))
    campaign = _Campaign(
        algorithm=algorithm,
        evaluate=evaluate,
        started=CampaignStarted(algorithm=algorithm.name, generations=generations, seed=seed),
        last_generation=resumed.generation + (generations or (runs or 0) + bool(resumed.begun or resumed.done)),
        last_run=sys.maxsize if runs is None else resumed.sums.simulated + runs,
        max_seconds=max_seconds,
        clock=clock or (lambda: 0.0),
        stop=stop or (lambda: False),
        seeds_matter=seeds_matter,
        foresee=foresee or (lambda scenarios: None),
        team=team,
        adapted=adapted,
        resumed=resumed,
        border=border,
    )
    return _ahead(campaign) if is_ahead else _by_generation(campaign)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Campaign(Generic[StateT]):
    """The checked arguments of :func:`run_campaign`."""

    algorithm: Algorithm[StateT]
    evaluate: Evaluate
    started: CampaignStarted
    last_generation: int  # the number of the generation before which it ends
    last_run: int  # the number of simulated scenarios after which it ends
    max_seconds: float | Callable[[], float] | None
    clock: Callable[[], float]
    stop: Callable[[], bool]
    seeds_matter: bool
    foresee: Callable[[Iterable[Scenario]], None]
    team: Team | None
    adapted: Adapted[StateT]
    resumed: Checkpoint[StateT]
    border: Callable[[Callable[[], Checkpoint[StateT]]], None]

    def reached(self, sums: CampaignFinished, seconds: float) -> EndReason | None:
        """Return the limit that has been reached, or None; the first scenario is evaluated in any case."""
        if sums.evaluated == self.resumed.sums.evaluated:
            return None
        if self.stop():
            return "stopped"
        if sums.simulated >= self.last_run:
            return "runs"
        most = self.max_seconds() if callable(self.max_seconds) else self.max_seconds
        return "time" if most is not None and seconds >= most else None


def _by_generation(campaign: _Campaign[StateT]) -> Generator[Event, None, None]:
    """Run a search in which each generation is learnt before the next is drawn.

    Raises:
        CheckpointError: for a checkpoint of a different campaign.
    """
    resumed = campaign.resumed
    cache = EvaluationCache(seeds_matter=campaign.seeds_matter)
    try:
        cache.restore(resumed.remembered)
    except ValueError as error:
        raise CheckpointError(f"remembered: {error}") from None
    for evaluation, reused in resumed.begun:
        if not reused:
            cache.add(evaluation)

    def with_known_runs(checkpoint: Checkpoint[StateT]) -> Checkpoint[StateT]:
        """Return a checkpoint with the known runs added, except those that its ``begun`` already lists."""
        new = sum(not reused for _, reused in checkpoint.begun)
        return replace(checkpoint, remembered=cache.remembered(but=new))

    def unknown(scenarios: Iterable[Scenario]) -> Iterator[Scenario]:
        """Yield once each scenario that no earlier run shows."""
        seen = set()
        for scenario in scenarios:
            if scenario not in seen and cache.recall(scenario) is None:
                seen.add(scenario)
                yield scenario

    def events() -> Generator[Event, None, None]:
        state, sums, told = resumed.state, resumed.sums, list(resumed.begun)
        began = campaign.clock()
        yield campaign.started
        reason: EndReason | None = None
        while reason is None and state.generation < campaign.last_generation:
            # The algorithm draws the scenarios of a generation; the first may run while the last is still sampled.
            before, rng = state, generation_rng(campaign.started.seed, state.generation, state.local_generation)
            algorithm = campaign.adapted(campaign.algorithm, state.generation)
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
            campaign.foresee(islice(unknown(coming), campaign.last_run - sums.simulated))
            state, scenarios = drawing.finished(), drawing.scenarios

            # Each scenario is simulated, unless an earlier run shows its result; limits count after the first one.
            for index, scenario in enumerate(scenarios[len(told) :], start=len(told)):
                reason = campaign.reached(sums, campaign.clock() - began)
                if reason is not None:
                    break
                evaluation = cache.recall(scenario)
                reused = evaluation is not None
                if evaluation is None:
                    try:
                        evaluation = campaign.evaluate(scenario)
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
                if not (isinstance(event, Restarted) and event.generation >= campaign.last_generation):
                    if isinstance(event, GenerationFinished) and event.local_generation == 0:
                        sums = replace(sums, generations=sums.generations + 1)
                    yield event
            if reason is None:
                here, told = Checkpoint(state=state, sums=sums), []
            campaign.border(partial(with_known_runs, here))
        yield replace(sums, reason=reason or "generations", seconds=campaign.clock() - began)

    return events()


@dataclass(frozen=True, slots=True)
class Group:
    """Consecutive scenarios of a generation that another process has drawn, run and evaluated.

    Attributes:
        runs: the number of scenarios.
        news: the evaluations that may matter to the algorithm.
        counts: whatever the caller of the campaign counts of these runs.
        each: the evaluations of all scenarios, which are then reported one by one; None if ``counts`` replaces them.
    """

    runs: int
    news: tuple[Evaluation, ...]
    counts: Any
    each: tuple[Evaluation, ...] | None = None


class Drawer(Generic[StateT]):
    """The scenarios of an :class:`~pytest_pafot.searching.ask_tell.AheadSearch`.

    A scenario follows from the seed, from its place, and from the generations that are learnt before it is drawn. So
    each process draws the same scenarios, as long as it learns the same evaluations.
    """

    def __init__(self, algorithm: Algorithm[StateT], seed: int, state: StateT, adapted: Adapted[StateT]) -> None:
        self._first = algorithm
        self._seed = seed
        self._adapted = adapted
        # the states from which a generation may still be drawn, by the number of generations learnt before
        self._states: dict[int, Any] = {state.generation: state}
        self._drawings: dict[int, Drawing[StateT]] = {}

    def algorithm(self, generation: int) -> Any:
        """Return the algorithm of a generation, an :class:`~pytest_pafot.searching.ask_tell.AheadSearch`."""
        return self._adapted(self._first, generation)

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
        if len(drawing.scenarios) <= index:
            next(islice(drawing, index - len(drawing.scenarios), None))
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
        told: tuple[AlgorithmEvent, ...] = tuple(
            replace(each, is_whole=False) if isinstance(each, GenerationFinished) else each for each in events
        )
        return told


class Team(Protocol):
    """Processes that draw, run and evaluate scenarios themselves."""

    def begin(self, drawer: Drawer[Any], needed: Callable[[int], int]) -> None:
        """Begin a campaign. ``needed`` returns how many scenarios of a generation its limits allow."""

    def group(self, generation: int, index: int) -> Group | None:
        """Return the next scenarios, from an index of a generation on; None if the next one must be evaluated here.

        Raises:
            OutOfTime: if the time of the search is over.
        """

    def learn(self, news: tuple[Evaluation, ...]) -> None:
        """Pass on what the algorithm has learnt from the next generation."""


def _ahead(campaign: _Campaign[StateT]) -> Generator[Event, None, None]:
    """Run a search whose generations are drawn before all earlier ones are learnt.

    Raises:
        CheckpointError: for a checkpoint of a different campaign.
    """
    resumed, team, last_generation = campaign.resumed, campaign.team, campaign.last_generation
    drawer = Drawer(campaign.algorithm, campaign.started.seed, resumed.state, campaign.adapted)
    if not resumed.news:
        raise CheckpointError("news: expected the evaluations of at least one generation, received none")
    learnt = list(resumed.news[:-1])  # the generations that were learnt since the oldest state that is still needed
    for news in learnt:
        drawer.learn(news)
    if not drawer.can_draw(resumed.generation):
        raise CheckpointError(
            f"news: expected the evaluations of all generations before {resumed.generation} since generation "
            f"{resumed.state.generation}, received those of {len(learnt)}"
        )
    most = drawer.population(resumed.generation)
    if not 0 <= resumed.done <= most:
        raise CheckpointError(f"done: expected a number of scenarios from 0 to {most}, received {resumed.done}")
    evaluated = drawer.number(resumed.generation, resumed.done)
    if resumed.sums.evaluated != evaluated:
        raise CheckpointError(f"sums: expected {evaluated} evaluated scenarios, received {resumed.sums.evaluated}")
    # The place of the next scenario, the evaluations of its generation that matter, and the totals so far.
    generation, index, coming, sums = resumed.generation, resumed.done, list(resumed.news[-1]), resumed.sums

    def needed(later: int) -> int:
        """Return how many scenarios of a generation the limits allow."""
        left = campaign.last_run - sums.simulated - (drawer.number(later) - drawer.number(generation, index))
        return 0 if later >= last_generation else max(0, min(drawer.population(later), left))

    announced = generation, index  # the first place that was not announced yet

    def further() -> Iterator[Scenario]:
        """Announce and yield all scenarios that can be drawn now. The first run shows the algorithm of later ones."""
        nonlocal announced
        later, start = announced
        while start < needed(later) or (start >= drawer.population(later) and needed(later + 1)):
            if start >= drawer.population(later):
                later, start = later + 1, 0
            if not drawer.can_draw(later) or (later > 0 and drawer.number(generation, index) == 0):
                return
            announced = later, start + 1
            yield drawer.scenario(later, start)
            start += 1

    def events() -> Generator[Event, None, None]:
        nonlocal generation, index, coming, learnt, sums, announced
        began = campaign.clock()
        reason: EndReason | None = None
        yield campaign.started
        if team is not None:
            team.begin(drawer, needed)
        while reason is None and generation < last_generation:
            # One scenario after the other is evaluated here, or several were in another process.
            while index < drawer.population(generation):
                reason = campaign.reached(sums, campaign.clock() - began)
                if reason is not None:
                    break
                try:
                    group = None if team is None else team.group(generation, index)
                    if group is None:
                        announced = max(announced, (generation, index))  # a team has run those before it
                        campaign.foresee(further())
                        scenario = drawer.scenario(generation, index)
                        evaluation = campaign.evaluate(scenario)
                        check_order("evaluate", [scenario], [evaluation])
                        news = (evaluation,) if drawer.matters(generation, evaluation) else ()
                        group = Group(runs=1, news=news, counts=None, each=(evaluation,))
                except OutOfTime:
                    reason = "time"
                    break
                for each in group.news:
                    sums = replace(sums, best=each) if improves(each, sums.best) else sums
                sums = replace(sums, evaluated=sums.evaluated + group.runs, simulated=sums.simulated + group.runs)
                coming += group.news
                first, index = index, index + group.runs
                if group.each is None:
                    yield GroupEvaluated(generation=generation, index=first, runs=group.runs, counts=group.counts)
                for place, evaluation in enumerate(group.each or (), start=first):
                    yield Evaluated(
                        generation=generation, local_generation=0, index=place, evaluation=evaluation, reused=False
                    )

            # The algorithm learns from a whole generation. If the limit on runs cut a generation, it is only reported.
            here = Checkpoint(state=drawer.oldest, sums=sums, news=(*learnt, tuple(coming)), done=index)
            ended: tuple[AlgorithmEvent, ...] = ()
            if reason is None:
                before = drawer.oldest.generation
                ended = drawer.learn(tuple(coming))
                if team is not None:
                    team.learn(tuple(coming))
                learnt = [*learnt, tuple(coming)][drawer.oldest.generation - before :]
                generation, index, coming = generation + 1, 0, []
            elif reason == "runs" and index:
                finished = GenerationFinished(
                    generation=generation, local_generation=0, population=tuple(coming), elites=0, is_whole=False
                )
                ended = (finished,)
            for ending in ended:
                if isinstance(ending, GenerationFinished):
                    sums = replace(sums, generations=sums.generations + 1)
                yield ending
            if reason is None:
                here = Checkpoint(state=drawer.oldest, sums=sums, news=(*learnt, ()))
            campaign.border(partial(replace, here))
        yield replace(sums, reason=reason or "generations", seconds=campaign.clock() - began)

    return events()


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
