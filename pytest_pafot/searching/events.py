"""The events that a search reports while it runs.

The events of a campaign contain its history: the populations, local searches and restarts can be reconstructed from
them, except where other processes have counted the runs. Generations are counted from 0. Within a local search
``local_generation`` counts from 1, which is the generation of the incumbent's mutants; in the main search it is 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from pytest_pafot.searching.evaluation import Evaluation

EndReason = Literal["generations", "runs", "time", "stopped"]
"""The reason why a campaign ended: all generations or all runs are done, its time is up, or its caller stopped it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignStarted:
    """The first event of every campaign."""

    algorithm: str
    generations: int | None  # None if the number of runs is the limit
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """One scenario of a generation was evaluated."""

    generation: int
    local_generation: int
    index: int  # position in the generation's requested scenarios, from 0
    evaluation: Evaluation
    reused: bool  # True if the evaluation is from an earlier run, because that run shows what the scenario does


@dataclass(frozen=True, slots=True, kw_only=True)
class RunsEvaluated:
    """Consecutive scenarios of a random search were evaluated in another process, which sent only what it counted.

    What it counts is in a subclass.
    """

    generation: int  # the number of the first one
    runs: int  # the number of scenarios; each was simulated
    rows: tuple[dict[str, Any], ...] = ()  # of the table of runs, if the process makes them


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationFinished:
    """All scenarios of a generation were evaluated, or the limit on runs was reached inside the generation."""

    generation: int
    local_generation: int
    population: tuple[Evaluation, ...]  # the unchanged elites, then the new ones in the requested order
    elites: int  # number of elites in the population


@dataclass(frozen=True, slots=True, kw_only=True)
class NewBest:
    """A generation, or a local search at its end, produced the best scenario since the last restart."""

    generation: int
    local_generation: int
    evaluation: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchStarted:
    """The main search pauses after this generation, and mutants of the incumbent evolve."""

    generation: int
    incumbent: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSearchFinished:
    """The local search has ended and the main search continues."""

    generation: int
    incumbent: Evaluation
    best: Evaluation  # of the local search; the incumbent itself if nothing better was found
    replaced: bool  # whether the best took the incumbent's place in the main population


@dataclass(frozen=True, slots=True, kw_only=True)
class Restarted:
    """The search abandoned its population and continues with a random one."""

    generation: int  # the generation with the random population
    stagnant: int  # number of generations without improvement before the restart


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignFinished:
    """The last event of a campaign; it is missing if the generator of the events was closed early."""

    reason: EndReason
    generations: int  # finished generations of the main search
    evaluated: int  # evaluated scenarios
    simulated: int  # those of them that were simulated
    best: Evaluation | None  # None if no run was eligible
    seconds: float = field(compare=False)  # by the campaign's clock; not reproducible


AlgorithmEvent = GenerationFinished | NewBest | LocalSearchStarted | LocalSearchFinished | Restarted
"""The events that an algorithm returns from ``tell``."""

Event = CampaignStarted | Evaluated | RunsEvaluated | AlgorithmEvent | CampaignFinished  # what a campaign yields
