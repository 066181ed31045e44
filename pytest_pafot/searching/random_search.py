"""Random search, the baseline: every scenario is drawn anew and nothing is learnt.

The paper's Random manipulates "the driving behaviours of NPCs at specified intervals" (section 4.2), which can be read
as random Position-Instructions or as random manoeuvres. Both are here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.ask_tell import check_ask, check_evaluations, end_of_generation
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent
from pytest_pafot.searching.space import SearchSpace, sample, sample_manoeuvres


@dataclass(frozen=True, slots=True, kw_only=True)
class RandomState:
    """Where a search is, between two calls.

    Attributes:
        generation: from 0.
        local_generation: always 0; there is no local search.
        best: so far; None before the first eligible run.
        asked: scenarios that are out for evaluation.
    """

    generation: int = 0
    local_generation: int = 0
    best: Evaluation | None = None
    asked: tuple[Scenario, ...] = ()


@dataclass(frozen=True, slots=True)
class RandomSearch:
    """Random valid scenarios, as many a generation as the genetic algorithm has individuals (section 4.2).

    Attributes:
        space: of the scenarios.
        population: scenarios in a generation.
    """

    name: ClassVar[str] = "random"

    space: SearchSpace = field(default_factory=SearchSpace)
    population: int = field(default=4, kw_only=True)

    def __post_init__(self) -> None:
        if self.population < 1:
            raise ValueError(f"population: expected at least one scenario, received {self.population!r}")

    def start(self, rng: np.random.Generator) -> RandomState:
        """The state before the first generation; it needs no draw."""
        return RandomState()

    def drawn(self, rng: np.random.Generator) -> Scenario:
        """One scenario."""
        return sample(self.space, rng)

    def ask(self, state: RandomState, rng: np.random.Generator) -> tuple[RandomState, tuple[Scenario, ...]]:
        """The scenarios of the next generation.

        Raises:
            RuntimeError: when the last ask has not been told.
        """
        check_ask(state.asked)
        asked = tuple(self.drawn(rng) for _ in range(self.population))
        return replace(state, asked=asked), asked

    def tell(
        self,
        state: RandomState,
        evaluations: Sequence[Evaluation],
        rng: np.random.Generator,
    ) -> tuple[RandomState, tuple[AlgorithmEvent, ...]]:
        """Finish a generation with the evaluations of what was asked for, in the same order.

        Raises:
            RuntimeError: without an ask before.
            ValueError: when the evaluations are not those of the scenarios asked for.
        """
        check_evaluations(state.asked, evaluations)
        best, events = end_of_generation(state.generation, state.best, evaluations)
        return replace(state, generation=state.generation + 1, best=best, asked=()), events


@dataclass(frozen=True, slots=True)
class RandomManoeuvreSearch(RandomSearch):
    """Random manoeuvres in the slices of AV-Fuzzer, see :class:`~pytest_pafot.searching.av_fuzzer.AvFuzzerSearch`.

    Attributes:
        slices: manoeuvres of each NPC, which together last as long as the genes of the space.
    """

    name: ClassVar[str] = "random-manoeuvre"

    slices: int = field(default=5, kw_only=True)

    def drawn(self, rng: np.random.Generator) -> Scenario:
        """One scenario of Lane-Instructions."""
        return sample_manoeuvres(self.space.sliced(self.slices), rng)
