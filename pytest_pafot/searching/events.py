"""What a search reports while it runs.

The events of a campaign tell its whole history: the populations, local searches and restarts can be rebuilt
from them. Generations are counted from 0; within a local search ``local_generation`` counts from 1, the first
being the mutants of the incumbent, and it is 0 in the main search.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from pytest_pafot.searching.coverage import Coverage
from pytest_pafot.searching.evaluation import Evaluation

EndReason = Literal["generations", "time", "stopped"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignStarted:
    """The first event of every campaign."""

    algorithm: str
    generations: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """One scenario of a generation was evaluated.

    Attributes:
        index: position in what the algorithm asked for in this generation, from 0.
        reused: whether an earlier run already showed what this scenario does, so that it was not simulated.
    """

    generation: int
    local_generation: int
    index: int
    evaluation: Evaluation
    reused: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationFinished:
    """All scenarios of a generation were evaluated.

    Attributes:
        population: the elites that passed on untouched, then the new ones in the order asked for.
        elites: how many of the population passed on.
    """

    generation: int
    local_generation: int
    population: tuple[Evaluation, ...]
    elites: int


@dataclass(frozen=True, slots=True, kw_only=True)
class NewBest:
    """A generation, or a local search at its end, brought the best scenario since the last restart."""

    generation: int
    local_generation: int
    evaluation: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchStarted:
    """The main search pauses after this generation; mutants of the incumbent evolve."""

    generation: int
    incumbent: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchFinished:
    """The main search goes on.

    Attributes:
        best: of the local search; the incumbent itself if nothing better was found.
        replaced: whether the best took the incumbent's place in the main population.
    """

    generation: int
    incumbent: Evaluation
    best: Evaluation
    replaced: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Restarted:
    """The population was given up.

    Attributes:
        generation: the one whose population is random again.
        stagnant: generations without improvement before it.
    """

    generation: int
    stagnant: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignFinished:
    """The last event of a campaign that was not closed before.

    Attributes:
        reason: ``generations`` when all given ones are finished, ``time`` when the time was over before,
            ``stopped`` when the consumer asked for it.
        generations: of the main search that were finished.
        evaluated: scenarios that were evaluated.
        simulated: those of them that were run.
        best: None when no run was eligible.
        coverage: of the instructions of the simulated scenarios.
        seconds: by the campaign's clock; not reproducible.
    """

    reason: EndReason
    generations: int
    evaluated: int
    simulated: int
    best: Evaluation | None
    coverage: Coverage = field(default_factory=Coverage)
    seconds: float = field(compare=False)


AlgorithmEvent = GenerationFinished | NewBest | LocalSearchStarted | LocalSearchFinished | Restarted
"""What an algorithm returns from ``tell``."""

Event = CampaignStarted | Evaluated | AlgorithmEvent | CampaignFinished
"""What a campaign yields."""
