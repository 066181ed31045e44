"""Why do Random and AV-Fuzzer collide more, or less, often here than in the paper? One difference changed at a time.

    python -m tests.benchmarks.paper_differences [--scenarios 1000] [--careless 200] [--seed 0]

Random scenarios with highway-env's IDM+MOBIL as the ego, of Position-Instructions (Random here) and of manoeuvres (the
genes of AV-Fuzzer). A row tells which share of them collides. In the rows of NPCs that do not spare the ego's side the
director runs interpreted and is changed in one place, so that fewer scenarios are driven there.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np

from example_ads import idm_mobil
from pytest_pafot import Highway, Scenario
from pytest_pafot.searching import SearchSpace
from pytest_pafot.searching.space import sample, sample_manoeuvres
from pytest_pafot.trace import Outcome
from tests.support.interpreted import InterpretedWorld

NOWHERE = -9
"""A lane that no vehicle is in."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What is changed."""

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
    """A highway on which NPCs change lanes whether or not the ego is beside them."""
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
    """Of so many random scenarios, those that collide, with the standard error [%]."""
    rng = np.random.default_rng(seed)
    hits = sum(world.rollout(draw(space, rng), idm_mobil.make).outcome == Outcome.COLLISION for _ in range(count))
    rate = hits / count
    return f"{rate:.1%} ± {math.sqrt(rate * (1 - rate) / count):.1%}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenarios", type=int, default=1000)
    parser.add_argument("--careless", type=int, default=200, help="scenarios with the interpreted director")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("| changed | Position-Instructions | manoeuvres |\n| --- | --- | --- |")

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


if __name__ == "__main__":
    main()
