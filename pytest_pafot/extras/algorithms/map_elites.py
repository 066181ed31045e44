"""MAP-Elites with the paper's genes and operators: the fittest scenario of every kind of impact.

The archive, which stores these scenarios, is from the library pyribs.

Source: Mouret, Clune, "Illuminating search spaces by mapping elites", arXiv:1504.04909, 2015.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.random import Generator

from pytest_pafot import Scenario
from pytest_pafot.extending import (
    Evaluation,
    GenerationState,
    NicheSearch,
    SearchSpace,
    first_crossed,
    mutate,
)

if TYPE_CHECKING:
    from ribs.archives import GridArchive


NO_IMPACT = 0  # the cell without a collision; all such runs share one niche, which stores the nearest miss
TOP_CLOSING_SPEED = 30.0  # higher closing speeds share the last niche [m/s]
CLOSING_SPEED_NICHES = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class MapElitesState(GenerationState):
    """The state of the search between two calls of ``ask`` or ``tell``."""

    archive: GridArchive  # from pyribs; its solutions are indices of evaluations; copied before every change
    evaluations: tuple[Evaluation, ...] = ()  # all eligible evaluations so far


@dataclass(frozen=True, slots=True)
class MapElitesSearch(NicheSearch[MapElitesState]):
    """MAP-Elites over scenarios; a niche is the closing speed, with the cell of the impact, or the zone and slot."""

    name: ClassVar[str] = "map-elites"
    library: ClassVar[str] = "ribs"

    def start(self, rng: Generator) -> MapElitesState:
        """Return the state before the first generation: an empty archive."""
        from ribs.archives import GridArchive  # noqa: PLC0415  (slow to import)

        places = 9 if self.space.crossings is None else 9 + self.space.crossings.meeting_places
        ranges = ((-0.5, places - 0.5), (0.0, TOP_CLOSING_SPEED))
        return MapElitesState(archive=GridArchive(solution_dim=1, dims=(places, CLOSING_SPEED_NICHES), ranges=ranges))

    def parents(self, state: MapElitesState) -> list[Evaluation]:
        """Return the elites in the order of their niches, so that a random number always selects the same elite."""
        if not len(state.archive):
            return []
        elites = state.archive.data(["solution", "index"], return_type="dict")
        return [state.evaluations[int(number)] for number in elites["solution"][np.argsort(elites["index"]), 0]]

    def child(self, parents: Sequence[Evaluation], rng: Generator) -> Scenario:
        """Return a mutation of an elite, which is perhaps crossed with a second elite before."""
        a, b = (parents[int(index)].executed for index in rng.integers(len(parents), size=2))
        child = first_crossed(a, b, rng) if rng.random() < self.crossover_rate else a
        return mutate(child, self.space, rng)

    def learn(self, state: MapElitesState, evaluations: Sequence[Evaluation], rng: Generator) -> MapElitesState:
        """Add the runs of a generation to the archive."""
        eligible = [each for each in evaluations if each.eligible and np.isfinite(each.fitness)]
        if not eligible:
            return state
        archive, first = copy.deepcopy(state.archive), len(state.evaluations)
        archive.add(
            solution=np.arange(first, first + len(eligible), dtype=np.float64)[:, None],
            objective=np.array([each.fitness for each in eligible]),
            measures=np.array([niche(each, self.space) for each in eligible]),
        )
        return replace(state, archive=archive, evaluations=(*state.evaluations, *eligible))


def niche(evaluation: Evaluation, space: SearchSpace) -> tuple[float, float]:
    """Return the place of a run in the archive: the cell of the impact, 0 without one, and the closing speed [m/s].

    Instead of a cell, numbers from 9 stand for the zones and slots of NPCs that cross.
    """
    hit = evaluation.collision
    if hit is None:
        return NO_IMPACT, 0.0
    place = evaluation.meeting_place(space.crossings) if hit.npc == evaluation.crossing else None
    return float(hit.cell or NO_IMPACT) if place is None else 9.0 + place, hit.closing_speed
