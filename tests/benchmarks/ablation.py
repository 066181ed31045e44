"""What does each part of a search contribute? One is changed at a time, at equal simulated time.

    python -m tests.benchmarks.ablation [--runs 20] [--hours 3] [--workers 2] [--tables collisions failures]
        [--searches NAME ...]

The ego is highway-env's IDM+MOBIL on the default road. The first table counts collisions, as the paper does: its
algorithm with other grids, fitness terms, populations and genes. The second counts distinct failures for which the ego
is responsible (``blame="ego"``): the default search with and without what it adds to the paper's operators. Both are
Markdown; values are means of a run, with the standard error of the mean.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from example_ads import idm_mobil
from pytest_pafot import Highway, Run, Scenario
from pytest_pafot.campaign.request import drawn_space
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.searching import DistinctSearch, Evaluation, PafotSearch, RandomSearch, SearchSpace
from pytest_pafot.searching.fitness import Steered, resolve, risks
from tests.benchmarks.command import in_processes, options, print_head
from tests.benchmarks.positive_controls import NOT_RUN_COLLISION
from tests.helpers.campaigns import run_campaign

TABLES = ("collisions", "failures")
ENDLESS = 100_000
"""The number of generations, never reached because the simulated time ends a run before."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A search to measure."""

    algorithm: Any = PafotSearch
    world: Highway = field(default_factory=Highway)
    space: SearchSpace = field(default_factory=SearchSpace)
    fitness: Any = "default"
    parameters: tuple[tuple[str, float], ...] = ()
    tells_kinds: bool = True


DEFAULT = Variant()
RISKS = ("ttc", "gap", "shortfall", "time")


def risk(number: int, trace: Trace) -> float:
    """Return one of the four risks of the default fitness, plus 1 for a collision."""
    return risks(trace)[number] + (trace.outcome == Outcome.COLLISION)


COLLISIONS: Mapping[str, Variant] = {
    "random": Variant(algorithm=RandomSearch),
    "pafot, as it is": DEFAULT,
    "the paper's literal grid, clearance 0 m": replace(DEFAULT, world=Highway(clearance=0.0)),
    "clearance 10 m": replace(DEFAULT, world=Highway(clearance=10.0)),
    "fitness: the paper's sum": replace(DEFAULT, fitness="paper"),
    **{f"fitness: {name} alone": replace(DEFAULT, fitness=partial(risk, n)) for n, name in enumerate(RISKS)},
    "children bred again: never (the paper's)": replace(DEFAULT, parameters=(("breeding_attempts", 0),)),
    "no local fuzzer": replace(DEFAULT, parameters=(("local_generations", 0),)),
    "no restarts": replace(DEFAULT, parameters=(("restart_after", ENDLESS),)),
    **{f"population {size}": replace(DEFAULT, parameters=(("population", size),)) for size in (2, 8, 16)},
    "3 genes of 20 s": replace(DEFAULT, space=SearchSpace(genes=3, gene_seconds=20.0)),
    "12 genes of 5 s": replace(DEFAULT, space=SearchSpace(genes=12, gene_seconds=5.0)),
    "1 NPC": replace(DEFAULT, space=SearchSpace(npcs=1)),
    "4 NPCs": replace(DEFAULT, space=SearchSpace(npcs=4)),
}
WIDE = SearchSpace(**drawn_space(Highway(), {}))
"""The space that the default search samples; the paper's algorithm uses the paper's space."""
DISTINCT = Variant(algorithm=DistinctSearch, space=WIDE)
FAILURES: Mapping[str, Variant] = {
    "random": Variant(algorithm=RandomSearch, space=WIDE),
    "random, the paper's space": Variant(algorithm=RandomSearch),
    "pafot": DEFAULT,
    "distinct, as it is": DISTINCT,
    "the paper's space": replace(DISTINCT, space=SearchSpace()),
    "2 NPCs": replace(DISTINCT, space=replace(WIDE, npcs=2, most_npcs=())),
    "no patterns": replace(DISTINCT, space=replace(WIDE, patterns=False)),
    "one start": replace(DISTINCT, space=replace(WIDE, ego_lanes=(), ego_speeds=None)),
    "known failures stay parents": replace(DISTINCT, tells_kinds=False),
    "4 proposals at once": replace(DISTINCT, parameters=(("population", 4),)),
    "64 proposals at once": replace(DISTINCT, parameters=(("population", 64),)),
    "40 random runs": replace(DISTINCT, parameters=(("random_runs", 40),)),
    "one mutation a child": replace(DISTINCT, parameters=(("most_mutations", 1),)),
    "no crossover": replace(DISTINCT, parameters=(("crossover_rate", 0.0),)),
}


@dataclass
class Tally:
    """The counts of one run."""

    runs: int = 0
    collisions: int = 0
    seconds: float = 0.0
    blamed: int = 0
    kinds: set[Any] = field(default_factory=set)


def measured(named: tuple[str, bool], seed: int, hours: float) -> Tally:
    """Run a search for some simulated hours, with blame if it is from the second table."""
    name, blame = named
    variant, tally = (FAILURES if blame else COLLISIONS)[name], Tally()
    fitness = Steered(resolve(variant.fitness), is_for_ego=blame)

    def one(scenario: Scenario) -> Evaluation:
        trace = variant.world.rollout(scenario, idm_mobil.make)
        run = Run(trace)
        is_hit, is_blamed = trace.outcome is Outcome.COLLISION, run.attribution.blames_ego
        kind = of_failure(run, NOT_RUN_COLLISION) if is_blamed else None
        tally.runs += 1
        tally.seconds += trace.duration
        tally.collisions += is_hit
        tally.blamed += is_blamed
        tally.kinds |= {kind} - {None}
        return Evaluation.of(
            trace,
            fitness=fitness(run),
            failing=is_blamed if blame else is_hit,
            kind=kind if variant.tells_kinds else None,
            mistake=None if kind is None else kind.mistake,
        )

    algorithm = variant.algorithm(variant.space, **dict(variant.parameters))
    for _ in run_campaign(algorithm, one, generations=ENDLESS, seed=seed):
        if tally.seconds >= hours * 3600:
            break
    return tally


def mean(values: Sequence[float], digits: int, scale: float = 1.0) -> str:
    """Format the mean with its standard error."""
    spread = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else 0.0
    return f"{statistics.mean(values) * scale:.{digits}f} ± {spread * scale:.{digits}f}"


def collisions_row(name: str, runs: Sequence[Tally]) -> str:
    share = mean([run.collisions / run.runs for run in runs], 1, 100)
    each = mean([run.seconds / max(run.collisions, 1) for run in runs], 0)
    return f"| {name} | {share} % | {each} | {mean([run.seconds / run.runs for run in runs], 1)} |"


def failures_row(name: str, runs: Sequence[Tally]) -> str:
    some = sum(bool(run.kinds) for run in runs)
    kinds, blamed = mean([len(run.kinds) for run in runs], 2), mean([run.blamed for run in runs], 1)
    return f"| {name} | {kinds} | {some} of {len(runs)} | {blamed} |"


def main() -> None:
    every = dict.fromkeys([*COLLISIONS, *FAILURES])
    given = options(__doc__, runs=20, hours=3.0, workers=2, tables=TABLES, searches=every)

    def table(
        variants: Mapping[str, Variant], blame: bool, row: Callable[[str, Sequence[Tally]], str], *head: str
    ) -> None:
        print()
        print_head("search", *head)
        names = [(name, blame) for name in variants if name in given.searches]
        for (name, _), runs in in_processes(given.workers, measured, names, range(given.runs), given.hours):
            print(row(name, runs), flush=True)

    if "collisions" in given.tables:
        head = "colliding share of runs", "simulated s per collision", "simulated s per run"
        table(COLLISIONS, False, collisions_row, *head)
    if "failures" in given.tables:
        head = "distinct ego-responsible failures", "runs with any", "ego-responsible collisions"
        table(FAILURES, True, failures_row, *head)


if __name__ == "__main__":
    main()
