"""The loop of a search: in each generation an algorithm proposes scenarios, and learns from their evaluations."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any, Generic

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import Algorithm, Drawing, StateT, check_order
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.evaluation_cache import EvaluationCache, Remembered
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
from pytest_pafot.support.errors import OutOfTime

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

    def exceeded(left: int, seconds: float) -> EndReason | None:
        if stop is not None and stop():
            return "stopped"
        if left <= 0:
            return "runs"
        most = max_seconds() if callable(max_seconds) else max_seconds
        return "time" if most is not None and seconds >= most else None

    evaluator = _Evaluator(evaluate, foresee, EvaluationCache(seeds_matter=seeds_matter))
    if resumed is None:
        sums = CampaignFinished(reason="generations", generations=0, evaluated=0, simulated=0, best=None, seconds=0.0)
        resumed = Checkpoint(state=algorithm.start(generation_rng(seed)), sums=sums)
        border(partial(evaluator.remembering, resumed))
    evaluator.restore(resumed)
    campaign = _Campaign(
        adapted=adapted,
        evaluator=evaluator,
        exceeded=exceeded,
        now=now,
        border=border,
        seed=seed,
        generations=resumed.state.generation + (generations or (runs or 0) + bool(resumed.begun)),
        runs=sys.maxsize if runs is None else resumed.sums.simulated + runs,
    )
    begun = CampaignStarted(algorithm=algorithm.name, generations=generations, seed=seed)
    return campaign.events(algorithm, begun, resumed)


def generation_rng(seed: int, *generation: int) -> np.random.Generator:
    """Return the random generator of a generation; it depends only on the seed and the numbers of the generation."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=generation))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Campaign(Generic[StateT]):
    """The loop of a campaign, with the totals at which it ends."""

    adapted: Callable[[Algorithm[StateT], StateT], Algorithm[StateT]]
    evaluator: _Evaluator
    exceeded: Callable[[int, float], EndReason | None]  # arguments: remaining runs, elapsed seconds
    now: Callable[[], float]
    border: Callable[[Callable[[], Checkpoint[StateT]]], None]
    seed: int
    generations: int
    runs: int

    def events(
        self, algorithm: Algorithm[StateT], begun: CampaignStarted, resumed: Checkpoint[StateT]
    ) -> Generator[Event, None, None]:
        started, state, end, told = self.now(), resumed.state, resumed.sums, list(resumed.begun)
        yield begun
        reason: EndReason | None = None
        while reason is None and state.generation < self.generations:
            rng = generation_rng(self.seed, state.generation, state.local_generation)
            algorithm = self.adapted(algorithm, state)
            last = state
            state, scenarios = self._asked(Drawing(algorithm, state, rng), told, self.runs - end.simulated)
            while len(told) < len(scenarios):
                if end.evaluated > resumed.sums.evaluated:
                    reason = self.exceeded(self.runs - end.simulated, self.now() - started)
                if reason is not None:
                    break
                try:
                    evaluation, reused = self.evaluator.evaluated(scenarios[len(told)])
                except OutOfTime:
                    reason = "time"
                    break
                event = Evaluated(
                    generation=state.generation,
                    local_generation=state.local_generation,
                    index=len(told),
                    evaluation=evaluation,
                    reused=reused,
                )
                told.append((evaluation, reused))
                end = replace(
                    end,
                    evaluated=end.evaluated + 1,
                    simulated=end.simulated + (not reused),
                    best=evaluation if improves(evaluation, end.best) else end.best,
                )
                yield event
            here = Checkpoint(state=last, sums=end, begun=tuple(told))
            state, events = self._finished(algorithm, state, told, rng, reason)
            for tell in events:
                # A restart without a following generation does not take place.
                if not (isinstance(tell, Restarted) and tell.generation >= self.generations):
                    if isinstance(tell, GenerationFinished) and tell.local_generation == 0:
                        end = replace(end, generations=end.generations + 1)
                    yield tell
            if reason is None:
                here, told = Checkpoint(state=state, sums=end), []
            self.border(partial(self.evaluator.remembering, here))
        yield replace(end, reason=reason or "generations", seconds=self.now() - started)

    def _asked(
        self, drawing: Drawing[StateT], told: Sequence[tuple[Evaluation, bool]], left: int
    ) -> tuple[StateT, Sequence[Scenario]]:
        """Return the scenarios of a generation; the first may run while the last is still being sampled."""
        if told:
            drawing.finished()
            try:  # a resumed search may request other scenarios than the one that began the generation
                check_order("begun", drawing.scenarios[: len(told)], [evaluation for evaluation, _ in told])
            except ValueError as error:
                raise CheckpointError(str(error)) from None
            self.evaluator.foresee(drawing.scenarios[len(told) :], left)
        else:
            self.evaluator.forget()
            self.evaluator.foresee(drawing, left)
        return drawing.finished(), drawing.scenarios

    def _finished(
        self,
        algorithm: Algorithm[StateT],
        state: StateT,
        told: Sequence[tuple[Evaluation, bool]],
        rng: np.random.Generator,
        reason: EndReason | None,
    ) -> tuple[StateT, tuple[AlgorithmEvent, ...]]:
        evaluations = tuple(evaluation for evaluation, _ in told)
        if reason is None:
            return algorithm.tell(state, evaluations, rng)
        if reason != "runs" or not evaluations:
            return state, ()
        # The algorithm does not receive these evaluations, because no other generation follows.
        finished = GenerationFinished(
            generation=state.generation, local_generation=state.local_generation, population=evaluations, elites=0
        )
        return state, (finished,)


class _Evaluator:
    """The only place that has scenarios simulated: it reuses the evaluations of runs that are known already."""

    def __init__(
        self, evaluate: Evaluate, foresee: Callable[[Iterable[Scenario]], None] | None, cache: EvaluationCache
    ) -> None:
        self._evaluate = evaluate
        self._foresee = foresee
        self._cache = cache

    def restore(self, checkpoint: Checkpoint[Any]) -> None:
        """Restore the known runs from a checkpoint.

        Raises:
            CheckpointError: if they are not the runs of a campaign.
        """
        try:
            self._cache.restore(checkpoint.remembered)
        except ValueError as error:
            raise CheckpointError(f"remembered: {error}") from None
        for evaluation, reused in checkpoint.begun:
            if not reused:
                self._cache.add(evaluation)

    def remembering(self, checkpoint: Checkpoint[StateT]) -> Checkpoint[StateT]:
        """Return a checkpoint with the known runs added, except those that its ``begun`` already lists."""
        new = sum(not reused for _, reused in checkpoint.begun)
        return replace(checkpoint, remembered=self._cache.remembered(but=new))

    def forget(self) -> None:
        """Forget old runs; only allowed between two generations, where checkpoints are made."""
        self._cache.forget()

    def foresee(self, scenarios: Iterable[Scenario], most: int) -> None:
        """Announce the scenarios that will be evaluated, without those whose result is known."""
        if self._foresee is not None:
            self._foresee(islice(self._unknown(scenarios), most))

    def _unknown(self, scenarios: Iterable[Scenario]) -> Iterator[Scenario]:
        """Yield once each scenario that no earlier run shows."""
        seen = set()
        for scenario in scenarios:
            if scenario not in seen and self._cache.recall(scenario) is None:
                seen.add(scenario)
                yield scenario

    def evaluated(self, scenario: Scenario) -> tuple[Evaluation, bool]:
        """Return the evaluation of a scenario, and whether it is from an earlier run."""
        known = self._cache.recall(scenario)
        if known is not None:
            return known, True
        new = self._evaluate(scenario)
        check_order("evaluate", [scenario], [new])
        self._cache.add(new)
        return new, False
