"""How do random runs end, and whose fault is it? Five sound policies in the traffic of each style.

    python -m tests.benchmarks.endings [--policies NAME ...] [--styles paper hostile ...] [--runs 2000] [--first-seed 0]
        [--instructions both] [--workers 2]

The scenarios are sampled as in the default search, in traffic of the style and with instructions of the given kind.
Prints for each policy and style how many runs passed, how many ended in a collision for which the ego or an NPC is
responsible, by the ego's side that was hit, how many ended otherwise, their mean length, and how many of the
Position-Instructions that began reached their cell, with the cell behind listed separately. The planner FISS has a
tenth of the runs, because each takes seconds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from itertools import product
from types import MappingProxyType
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from example_ads import fiss
from pytest_pafot.campaign.request import drawn_space
from pytest_pafot.model.driving_style import STYLES, Traffic
from pytest_pafot.model.grid import Cell
from pytest_pafot.searching.space import sample, space_on
from pytest_pafot.world.reference_drivers import REFERENCES
from tests.benchmarks.command import in_processes, options, print_head
from tests.helpers.sound_driver import SoundLaneChanger

POLICIES: Mapping[str, Callable[[], Any]] = MappingProxyType(
    {
        "idm+mobil": lambda: IDMVehicle,
        "fiss": lambda: fiss.make,
        "sound-lane-changer": lambda: SoundLaneChanger,
        **{name: lambda name=name: REFERENCES[name] for name in ("careful-human", "idm-aeb")},
    }
)
TENTHS = 10
"""The number of parts that run in different processes."""
SLOW = "fiss"
SIDES = ("front", "rear", "left", "right")


def counted(pair: tuple[str, str], tenth: int, runs: int, first_seed: int, instructions: str) -> Counter[str]:
    """Count the endings of the runs of some scenarios."""
    policy, style = pair
    world, ads = pafot.Highway(ads_hz=15), POLICIES[policy]()
    given = {**drawn_space(world, {"instructions": instructions}), "traffic": Traffic.of(style)}
    space = space_on(world.speed_limit, world.longest_run, given)
    counts: Counter[str] = Counter()
    size = max(runs // TENTHS // (TENTHS if policy == SLOW else 1), 1)
    for number in range(tenth * size, (tenth + 1) * size):
        run = pafot.Run(world.rollout(sample(space, np.random.default_rng([first_seed, number])), ads))
        counts.update({"runs": 1, "seconds": run.duration, ending(run): 1})
        for chain, genes in zip(run.trace.arrivals, run.trace.executed.npcs, strict=True):
            for arrived, gene in zip(chain, genes, strict=False):
                if not isinstance(gene, pafot.PositionInstruction):
                    continue
                name = "behind" if gene.cell is Cell.REAR else "cell"
                counts.update({name: 1, f"{name} reached": arrived is not None})
    return counts


def ending(run: pafot.Run) -> str:
    """Return a run's ending in up to three words."""
    if run.collision is None:
        return str(run.outcome)
    return f"{run.responsibility} {run.collision.side}"


def row(policy: str, style: str, counts: Counter[str]) -> str:
    """Return a row of the table."""
    share = lambda count, of="runs": f"{count / max(counts[of], 1):.1%}"  # noqa: E731
    others = sum(count for name, count in counts.items() if name.split()[0] in ("both", "none", "shared", "unclear"))
    cells = [
        policy, style, share(counts["safe"]), share(sum(counts[f"ego {side}"] for side in SIDES)),
        share(counts["npc rear"]), share(counts["npc left"] + counts["npc right"]), share(counts["npc front"]),
        share(others), share(counts["invalid"]), f"{counts['seconds'] / counts['runs']:.1f}",
        share(counts["cell reached"], "cell"), share(counts["behind reached"], "behind"),
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def main() -> None:
    given = options(__doc__, policies=POLICIES, styles=STYLES, runs=2000, first_seed=0, instructions="both", workers=2)
    print_head(
        "policy", "traffic", "safe", "the ego's fault", "an NPC's: rear", "side", "front", "other", "invalid",
        "mean [s]", "cells reached", "the cell behind",
    )  # fmt: skip
    pairs = product(given.policies, given.styles)
    more = given.runs, given.first_seed, given.instructions
    for (policy, style), parts in in_processes(given.workers, counted, pairs, range(TENTHS), *more):
        print(row(policy, style, sum(parts, Counter())), flush=True)


if __name__ == "__main__":
    main()
