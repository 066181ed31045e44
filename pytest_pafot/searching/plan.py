"""The plan of a search that breeds: which scenario is next, and what the algorithm learns from the runs.

A plan is asked for scenarios and receives their evaluations. It runs nothing and measures no time, so the same
evaluations give the same scenarios.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from numpy.random import Generator as Rng

from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.searching.ask_tell import Algorithm
from pytest_pafot.searching.evaluation import Evaluation, EvaluationCache
from pytest_pafot.searching.events import (
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
        self._state: Any = algorithm.start(generation_rng(seed))
        self._begin()

    def _begin(self) -> None:
        """Draw the scenarios of the next generation."""
        self._cache.forget()
        self._told: list[tuple[Evaluation, bool]] = []  # with True if an earlier run shows it
        self._asked: tuple[Scenario, ...] = ()
        self._is_announced = False
        if not self.is_over:
            self._rng = generation_rng(self.started.seed, self._state.generation, self._state.local_generation)
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

    def ahead(self) -> Iterator[Scenario]:
        """Yield the scenarios of the generation that no earlier run shows, at its beginning; later none.

        They can be simulated in advance: most of them will be asked for, in this order.
        """
        if not self._is_announced:
            self._is_announced = True
            unknown = (each for each in dict.fromkeys(self._asked) if self._cache.recall(each) is None)
            yield from (each for each, _ in zip(unknown, range(self._last_run - self.sums.simulated), strict=False))

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


def generation_rng(seed: int, *generation: int) -> Rng:
    """Return the random generator of a generation; it depends only on the seed and the numbers of the generation."""
    return rng_of(seed, *generation)
