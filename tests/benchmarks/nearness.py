"""Does nearness to a mistake lead to it? How many children of the nearest runs fail, against those of other parents.

    python -m tests.benchmarks.nearness [--scenarios 20000] [--parents 60] [--children 60] [--seed 0]

Random scenarios with highway-env's IDM+MOBIL as the ego; those that fail already are left out. Of the others the
first by each measure have children of one mutation. A row tells how many of these are collisions that the ego answers
for, and how many of the parents have one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from example_ads import idm_mobil
from pytest_pafot import Highway, Scenario
from pytest_pafot.attribution.near_misses import near_misses
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.request import drawn_space
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching import SearchSpace
from pytest_pafot.searching.fitness import resolve
from pytest_pafot.searching.operators import mutate
from pytest_pafot.searching.space import sample
from tests.benchmarks.command import options, print_head

SPACE = SearchSpace(**drawn_space(Highway(), {}))
MISTAKES = ("moved-in-front", "moved-into-side", "kept-no-distance", "braked-for-nothing")


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A run that may be a parent."""

    scenario: Scenario
    fitness: float
    is_collision: bool
    severities: dict[str, float]


def candidates(world: Highway, count: int, rng: np.random.Generator) -> Iterator[Candidate]:
    """Valid random runs that do not fail."""
    fitness = resolve("default", responsible=is_ego_responsible)
    for _ in range(count):
        trace = world.rollout(sample(SPACE, rng), idm_mobil.make)
        if trace.outcome is not Outcome.INVALID and not is_ego_responsible(trace):
            yield Candidate(
                scenario=trace.executed,
                fitness=fitness(trace),
                is_collision=trace.outcome is Outcome.COLLISION,
                severities={each.mistake: each.severity for each in near_misses(trace)},
            )


def row(name: str, parents: Sequence[Candidate], children: int, world: Highway, rng: np.random.Generator) -> str:
    """A line of the table."""

    def fails(scenario: Scenario) -> bool:
        return is_ego_responsible(world.rollout(mutate(scenario, SPACE, rng), idm_mobil.make))

    failing = [sum(fails(parent.scenario) for _ in range(children)) for parent in parents]
    share = sum(failing) / max(len(parents) * children, 1)
    return f"| {name} | {share:.2%} | {sum(map(bool, failing))} of {len(parents)} |"


def main() -> None:
    arguments = options(__doc__, scenarios=20_000, parents=60, children=60, seed=0)
    world, rng = Highway(), np.random.default_rng(arguments.seed)
    pool = list(candidates(world, arguments.scenarios, rng))

    def first(key: Callable[[Candidate], float], among: Sequence[Candidate]) -> Sequence[Candidate]:
        return sorted(among, key=key, reverse=True)[: arguments.parents]

    safe = [each for each in pool if not each.is_collision]
    groups = {
        "any": [pool[int(index)] for index in rng.integers(len(pool), size=arguments.parents)],
        "first by the default fitness": first(lambda each: each.fitness, pool),
        "first by the default fitness, of those without a collision": first(lambda each: each.fitness, safe),
    }
    for mistake in MISTAKES:
        near = [each for each in pool if mistake in each.severities]
        groups[f"nearest to `{mistake}`"] = first(lambda each, mistake=mistake: each.severities[mistake], near)
    print_head("parents", "children that fail by the ego's fault", "parents with any")
    for name, parents in groups.items():
        print(row(name, parents, arguments.children, world, rng), flush=True)


if __name__ == "__main__":
    main()
