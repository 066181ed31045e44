"""Random search: every scenario is sampled independently and nothing is learnt.

The paper's Random manipulates "the driving behaviours of NPCs at specified intervals" (section 4.2), which can mean
random Position-Instructions or random manoeuvres. This module has a search for each.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar

from numpy.random import Generator

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import GenerationalSearch, GenerationState
from pytest_pafot.searching.plan import generation_rng
from pytest_pafot.searching.space import SearchSpace, sample, sample_manoeuvres


@dataclass(frozen=True, slots=True)
class RandomSearch:
    """The default search, which samples valid scenarios at random, each by its number.

    Scenario number n follows from the seed and from n alone. So whoever needs it draws it, in any process and order.
    """

    name: ClassVar[str] = "random"
    draws_vehicles: ClassVar[bool] = True

    space: SearchSpace = field(default_factory=SearchSpace)

    def drawn(self, seed: int, number: int) -> Scenario:
        """Return the scenario of a number, which is counted from 0."""
        return sample(self.space, generation_rng(seed, number, 0))


@dataclass(frozen=True, slots=True)
class RandomManoeuvreSearch(GenerationalSearch[GenerationState]):
    """A search that samples random manoeuvres, one for each time slice, as AV-Fuzzer has them.

    See the algorithm ``av-fuzzer``. Its generations are as large as those of the paper's search (section 4.2).

    Attributes:
        slices: number of manoeuvres of each NPC; together they last as long as the genes of the space.
    """

    name: ClassVar[str] = "random-manoeuvre"
    is_papers: ClassVar[bool] = True
    instructions: ClassVar[tuple[str, ...]] = ("lanes",)

    slices: int = field(default=5, kw_only=True)

    def start(self, rng: Generator) -> GenerationState:
        """Return the state before the first generation, without using a random number."""
        return GenerationState()

    def propose(self, state: GenerationState, rng: Generator) -> tuple[GenerationState, Iterable[Scenario]]:
        """Propose a generation of random scenarios of Lane-Instructions."""
        space: Any = self.space.sliced(self.slices)
        return state, (sample_manoeuvres(space, rng) for _ in range(self.population))
