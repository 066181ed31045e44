"""Does the search blame a sound driver? The reference drivers and a lane changer, with ``blame="ego"``.

    python -m tests.benchmarks.negative_control [--drivers careful-human ...] [--seeds 10] [--runs 400]
        [--algorithms distinct pafot] [--npcs 2] [--workers 2]

Every collision for which the ego is responsible would be a finding. With the careful and competent human driver of UN
R157 and the sound lane changer, there should be none, so each of them is read. ``fuzzy-model`` is no negative control:
it runs into a vehicle that cuts in and brakes hard, so its findings are expected. Each driver is searched by the
default algorithm and at random, both in the default scenarios, and by the paper's algorithm in the paper's scenarios.
Prints for each search how its runs ended, how often the ego entered a
different lane, and the explanation of each kind of finding.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import product
from types import MappingProxyType

import numpy as np

import pytest_pafot as pafot
from pytest_pafot.campaign.events import Judged
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.model.trace import LANE
from pytest_pafot.searching import ALGORITHMS
from pytest_pafot.world.reference_drivers import REFERENCES, ReferenceDriver
from tests.benchmarks.command import holds, in_processes, options, seeds_of
from tests.helpers.fuzzy_safety import FuzzySafety
from tests.helpers.sound_driver import SoundLaneChanger

DRIVERS: Mapping[str, Callable[[], ReferenceDriver]] = MappingProxyType(
    {**REFERENCES, "fuzzy-model": FuzzySafety, "sound-lane-changer": SoundLaneChanger}
)
AT_FAULT = "fuzzy-model"
"""A driver that brakes with 4 m/s^2 at most for a leader, and harder too late."""


@dataclass
class Control:
    """One search against one driver."""

    name: str
    counts: Counter[str] = field(default_factory=Counter)
    explained: dict[str, str] = field(default_factory=dict)

    def see(self, event: object) -> None:
        """Count the outcome of a run."""
        if not isinstance(event, Judged):
            return
        run = event.run
        changes = int(np.count_nonzero(np.diff(run.trace.ego[:, LANE])))
        ending = f"{run.trace.outcome}: {run.responsibility}" if run.responsibility else str(run.trace.outcome)
        self.counts.update({ending: 1, "runs": 1, "lane changes": changes, "by position": run.second_opinion == "ego"})
        if event.verdict.failure is not None:
            self.counts["findings"] += 1
            self.explained.setdefault(of_failure(run, event.verdict.failure).slug, run.explain())


def searched(pair: tuple[str, str], seed: int, npcs: int, runs: int) -> Control:
    """Run a search; 0 NPCs means the default number."""
    (name, algorithm), given = pair, {"npcs": npcs} if npcs else {}
    control = Control(name)
    pafot.explore(
        DRIVERS[name], holds=holds, world=pafot.Highway(ads_hz=15), blame="ego", algorithm=algorithm, runs=runs,
        seed=seed, shrink_rollouts=0, on_event=control.see, **given,
    )  # fmt: skip
    return control


def main() -> None:
    searches = (ALGORITHMS[0], "pafot", "random")
    given = options(__doc__, drivers=DRIVERS, algorithms=searches, seeds=10, first_seed=0, runs=400, npcs=0, workers=2)
    total: Counter[tuple[str, str]] = Counter()
    pairs, seeds = product(given.drivers, given.algorithms), seeds_of(given)
    for (name, algorithm), controls in in_processes(given.workers, searched, pairs, seeds, given.npcs, given.runs):
        for seed, control in zip(seeds, controls, strict=True):
            total.update({(name, key): count for key, count in control.counts.items()})
            print(f"{name}, {algorithm}, seed {seed}: {dict(control.counts)}", flush=True)
            for slug, explanation in control.explained.items():
                print(f"{slug}: {explanation}", flush=True)
    for name in given.drivers:
        expected = "no control, findings are expected" if name == AT_FAULT else "control, findings are false verdicts"
        print(f"{name} ({expected}): { {key: count for (of, key), count in total.items() if of == name} }")


if __name__ == "__main__":
    main()
