"""Where does this differ from the paper, and by how much? One command for both tables of the documents.

    python -m tests.benchmarks.paper_differences [--scenarios 1000] [--careless 200] [--seed 0]
        [--tables collisions readings]

- ``collisions``: why do Random and AV-Fuzzer collide more, or less, often here than in the paper? Random scenarios with
  highway-env's IDM+MOBIL as the ego, of Position-Instructions (Random here) and of manoeuvres (the genes of AV-Fuzzer),
  with one difference at a time. A row has the share that collides. If NPCs do not spare the ego's side, the director is
  changed in one place and runs interpreted, so these rows have fewer scenarios.
- ``readings``: how often does the interpretation of the paper matter? Shares of the genes, operators and runs of such
  scenarios of Position-Instructions.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from example_ads import idm_mobil
from pytest_pafot import Highway, Scenario
from pytest_pafot.criticality import mettc, planned_duration
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.searching import SearchSpace
from pytest_pafot.searching.operators import crossover, mutate, with_chain
from pytest_pafot.searching.space import sample, sample_manoeuvres
from tests.benchmarks.command import options, print_head
from tests.helpers.interpreted import InterpretedWorld

TABLES = ("collisions", "readings")
NOWHERE = -9
"""A lane that contains no vehicle."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """The difference of a row."""

    space: SearchSpace = field(default_factory=SearchSpace)
    headway: float = 2.0
    is_careless: bool = False


SLOW = SearchSpace(ego_speed=18.0)
SHORT = SearchSpace(genes=20, gene_seconds=3.0)
VARIANTS = {
    "as it is": Variant(),
    "an ego of 18 m/s": Variant(space=SLOW),
    "slices of 3 s": Variant(space=SHORT),
    "NPCs start 1 s away": Variant(headway=1.0),
    "NPCs steer into the ego's side": Variant(is_careless=True),
    "that, and an ego of 18 m/s": Variant(space=SLOW, is_careless=True),
    "that, and slices of 3 s": Variant(space=SearchSpace(ego_speed=18.0, genes=20, gene_seconds=3.0), is_careless=True),
}


@contextmanager
def careless() -> Iterator[type[Any]]:
    """Provide a highway on which NPCs change lanes even if the ego is next to them."""
    interpreted = InterpretedWorld()
    with interpreted.in_place():
        from pytest_pafot.world.kernel.director import Director

        spares = Director._next_lane

        def next_lane(self: Any, npc: Any, target_lane: int, ego: Any) -> int:
            return int(spares(self, npc, target_lane, SimpleNamespace(x=ego.x, lane=NOWHERE)))

        with patch.object(Director, "_next_lane", next_lane):
            yield interpreted.room.Highway


def share(
    world: Any, space: SearchSpace, draw: Callable[[SearchSpace, np.random.Generator], Scenario], count: int, seed: int
) -> str:
    """Return the share of random scenarios that collide, with the standard error [%]."""
    rng = np.random.default_rng(seed)
    return told([world.rollout(draw(space, rng), idm_mobil.make).outcome == Outcome.COLLISION for _ in range(count)])


def told(cases: Sequence[bool]) -> str:
    """Return the share of cases that are true, with its standard error."""
    rate = sum(cases) / len(cases)
    return f"{100 * rate:.1f} ± {100 * math.sqrt(rate * (1 - rate) / len(cases)):.1f} %"


def unreached(trace: Trace) -> list[bool]:
    """Return for each later gene that started whether the NPC had not reached the previous cell."""
    return [tick is None for chain in trace.arrivals for tick in chain[:-1]]


def changes_a_cell(scenario: Scenario, rng: np.random.Generator) -> bool:
    """Return whether a mutation changes an instruction's cell, not only its speed."""
    return cells(mutate(scenario, SearchSpace(), rng)) != cells(scenario)


def is_repaired(a: Scenario, b: Scenario, rng: np.random.Generator) -> list[bool]:
    """Return for both children of a crossover whether repair changed the cells of the exchanged chains."""
    exchanged = [
        {cells_of(with_chain(one.npcs, at, chain)) for at in range(len(one.npcs)) for chain in other.npcs}
        for one, other in ((a, b), (b, a))
    ]
    return [cells(child) not in each for child, each in zip(crossover(a, b, rng), exchanged, strict=True)]


def cells(scenario: Scenario) -> Any:
    return cells_of(scenario.npcs)


def cells_of(npcs: Sequence[Any]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(gene.target for gene in chain) for chain in npcs)


def readings(count: int, seed: int) -> dict[str, str]:
    """Return how often each interpretation of the paper makes a difference."""
    rng, world = np.random.default_rng(seed), Highway()
    scenarios = [sample(SearchSpace(), rng) for _ in range(count)]
    traces = [world.rollout(scenario, idm_mobil.make) for scenario in scenarios]
    driven = [trace.executed for trace in traces]
    return {
        "genes that begin with the cell before them not reached": told(
            [case for trace in traces for case in unreached(trace)]
        ),
        "mutations that change a cell, and not a speed alone": told([changes_a_cell(each, rng) for each in driven]),
        "children of a crossover that repair alters": told(
            [case for pair in pairwise(driven) for case in is_repaired(*pair, rng)]
        ),
        "runs whose METTC is the planned duration, finite or not": told(
            [mettc(trace) >= planned_duration(trace) for trace in traces]
        ),
        "runs whose METTC is infinite": told([math.isinf(mettc(trace)) for trace in traces]),
    }


def collisions(arguments: argparse.Namespace) -> None:
    """Print the table, row by row."""
    print()
    print_head("changed", "Position-Instructions", "manoeuvres")

    def row(name: str, variant: Variant, highway: type[Any], count: int) -> None:
        world = highway(headway=variant.headway)
        shares = [share(world, variant.space, draw, count, arguments.seed) for draw in (sample, sample_manoeuvres)]
        print(f"| {name} | {' | '.join(shares)} |", flush=True)

    for name, variant in VARIANTS.items():
        if not variant.is_careless:
            row(name, variant, Highway, arguments.scenarios)
    with careless() as highway:
        for name, variant in VARIANTS.items():
            if variant.is_careless:
                row(name, variant, highway, arguments.careless)


def main() -> None:
    arguments = options(__doc__, scenarios=1000, careless=200, seed=0, tables=TABLES)
    if "readings" in arguments.tables:
        print_head("of random scenarios", "share")
        for name, rate in readings(arguments.scenarios, arguments.seed).items():
            print(f"| {name} | {rate} |")
    if "collisions" in arguments.tables:
        collisions(arguments)


if __name__ == "__main__":
    main()
