"""What searches have in common that keep the worst runs of several kinds, the niches, and vary them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.random import Generator

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.ask_tell import GenerationalSearch, GenerationStateT, check_parameters
from pytest_pafot.searching.space import sample


@dataclass(frozen=True, slots=True)
class NicheSearch(GenerationalSearch[GenerationStateT]):
    """A search whose first scenarios are random, and whose later ones are children of those that it kept.

    Attributes:
        random_runs: scenarios before the first children.
        crossover_rate: probability that two parents swap two NPCs.
    """

    random_runs: int = field(default=20, kw_only=True)
    crossover_rate: float = field(default=0.5, kw_only=True)

    def __post_init__(self) -> None:
        check_parameters(self, rates=("crossover_rate",), population=1, random_runs=1)

    @property
    def random_at_first(self) -> float:
        """Scenarios at the beginning of a search that are random."""
        return max(self.population, self.random_runs)

    def propose(self, state: GenerationStateT, rng: Generator) -> tuple[GenerationStateT, Iterable[Scenario]]:
        """Random scenarios at first and while there is no parent; then children."""
        parents = self.parents(state)
        to_come = self.random_runs - state.proposed if parents else self.population
        return state, (
            sample(self.space, rng) if index < to_come else self.child(parents, rng) for index in range(self.population)
        )

    @abstractmethod
    def parents(self, state: GenerationStateT) -> Sequence[Any]:
        """What children are made of."""

    @abstractmethod
    def child(self, parents: Sequence[Any], rng: Generator) -> Scenario:
        """A scenario that is a variation of one or two parents."""
