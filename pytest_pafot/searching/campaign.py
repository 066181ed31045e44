"""The loop of a search: in each generation an algorithm proposes scenarios, and learns from their evaluations."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Generic

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import Algorithm, Drawing, StateT, check_order
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
