"""Random search, the baseline: every scenario is sampled independently and nothing is learnt.

The paper's Random manipulates "the driving behaviours of NPCs at specified intervals" (section 4.2), which can mean
random Position-Instructions or random manoeuvres. This module has a search for each.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar

from numpy.random import Generator

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import GenerationalSearch, GenerationState
from pytest_pafot.searching.space import sample, sample_manoeuvres


@dataclass(frozen=True, slots=True)
class RandomSearch(GenerationalSearch[GenerationState]):
    """A search that samples valid scenarios at random, in generations as large as the paper's search (section 4.2)."""

    name: ClassVar[str] = "random"
    counted_at_first: ClassVar[float] = math.inf  # all scenarios are random
    block_runs: ClassVar[int] = 64  # nothing is learnt, so this only lets processes work by themselves

    def start(self, rng: Generator) -> GenerationState:
        """Return the state before the first generation, without using a random number."""
        return GenerationState()

    def propose(self, state: GenerationState, rng: Generator) -> tuple[GenerationState, Iterable[Scenario]]:
        """Propose a generation of random scenarios."""
        return state, (self.drawn(rng) for _ in range(self.population))

    def drawn(self, rng: Generator) -> Scenario:
        """Sample one scenario."""
        return sample(self.space, rng)


@dataclass(frozen=True, slots=True)
class RandomManoeuvreSearch(RandomSearch):
    """A search that samples random manoeuvres, one for each time slice, as AV-Fuzzer has them.

    See the algorithm ``av-fuzzer``.

    Attributes:
        slices: number of manoeuvres of each NPC; together they last as long as the genes of the space.
    """

    name: ClassVar[str] = "random-manoeuvre"
    is_papers: ClassVar[bool] = True
    instructions: ClassVar[tuple[str, ...]] = ("lanes",)

    slices: int = field(default=5, kw_only=True)

    def drawn(self, rng: Generator) -> Scenario:
        """Sample one scenario of Lane-Instructions."""
        return sample_manoeuvres(self.space.sliced(self.slices), rng)
