"""What a search reports while it runs.

The events of a campaign tell its whole history: the populations, local searches and restarts can be rebuilt
from them. Generations are counted from 0; within a local search ``local_generation`` counts from 1, the first
being the mutants of the incumbent, and it is 0 in the main search.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from pytest_pafot.searching.evaluation import Evaluation

EndReason = Literal["generations", "runs", "time", "stopped"]
"""All are finished, all runs are done, the time was over, the consumer asked for it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignStarted:
    """The first event of every campaign."""

    algorithm: str
    generations: int | None  # None where a number of runs decides
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """One scenario of a generation was evaluated."""

    generation: int
    local_generation: int
    index: int  # position in what the algorithm asked for in this generation, from 0
    evaluation: Evaluation
    reused: bool  # whether an earlier run already showed what this scenario does, so that it was not simulated


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationFinished:
    """All scenarios of a generation were evaluated, or the last of the runs was within it."""

    generation: int
    local_generation: int
    population: tuple[Evaluation, ...]  # the elites that passed on untouched, then the new ones in the order asked for
    elites: int  # how many of the population passed on


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
    """The main search goes on."""

    generation: int
    incumbent: Evaluation
    best: Evaluation  # of the local search; the incumbent itself if nothing better was found
    replaced: bool  # whether the best took the incumbent's place in the main population


@dataclass(frozen=True, slots=True, kw_only=True)
class Restarted:
    """The population was given up."""

    generation: int  # the one whose population is random again
    stagnant: int  # generations without improvement before it


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignFinished:
    """The last event of a campaign that was not closed before."""

    reason: EndReason
    generations: int  # of the main search that were finished
    evaluated: int  # scenarios that were evaluated
    simulated: int  # those of them that were run
    best: Evaluation | None  # None when no run was eligible
    seconds: float = field(compare=False)  # by the campaign's clock; not reproducible


AlgorithmEvent = GenerationFinished | NewBest | LocalSearchStarted | LocalSearchFinished | Restarted
"""What an algorithm returns from ``tell``."""

Event = CampaignStarted | Evaluated | AlgorithmEvent | CampaignFinished  # what a campaign yields
