"""Does the search blame a sound driver? The reference drivers and one who changes lanes, with ``blame="ego"``.

    python -m tests.benchmarks.negative_control [--drivers careful-human ...] [--seeds 10] [--generations 100]
        [--algorithms distinct pafot] [--npcs 2] [--workers 2]

Every collision for which the ego is responsible would be a finding; with the careful and competent human driver of
UN R157 and the sound lane changer there must be none. Each driver is searched by the default algorithm and by the
paper's, steered as under ``blame="ego"``. Prints for each search how its runs ended, how often the ego came into
another lane, and the explanation of each kind of finding.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from pytest_pafot import Highway, Run, Scenario
from pytest_pafot.attribution.near_misses import near_misses
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.signature import Failure
from pytest_pafot.searching import ALGORITHMS, Evaluation, SearchSpace, resolve_algorithm, run_campaign
from pytest_pafot.searching.fitness import resolve
from pytest_pafot.trace import LANE
from pytest_pafot.world.reference_drivers import REFERENCES, ReferenceDriver
from tests.support.sound_driver import SoundLaneChanger

DRIVERS: Mapping[str, Callable[[], ReferenceDriver]] = MappingProxyType(
    {**REFERENCES, "sound-lane-changer": SoundLaneChanger}
)
WORLD = Highway(ads_hz=15)
FITNESS = resolve("default", responsible=is_ego_responsible)
FAILURE = Failure(kind="AssertionError", assertion="assert not run.collision")


@dataclass
class Control:
    """One search against one driver."""

    name: str
    counts: Counter[str] = field(default_factory=Counter)
    explained: dict[str, str] = field(default_factory=dict)

    def evaluate(self, scenarios: Sequence[Scenario]) -> list[Evaluation]:
        """Simulate and judge."""
        return [self._one(scenario) for scenario in scenarios]

    def _one(self, scenario: Scenario) -> Evaluation:
        trace = WORLD.rollout(scenario, DRIVERS[self.name])
        run, found = Run(trace), is_ego_responsible(trace)
        changes = int(np.count_nonzero(np.diff(trace.ego[:, LANE])))
        self.counts.update([f"{trace.outcome}: {run.responsibility}" if run.responsibility else str(trace.outcome)])
        self.counts.update({"runs": 1, "lane changes": changes, "by position": run.second_opinion == "ego"})
        signature = of_failure(run, FAILURE) if found else None
        if signature is not None:
            self.counts["findings"] += 1
            self.explained.setdefault(signature.slug, run.explain())
        return Evaluation.of(
            trace,
            fitness=FITNESS(trace),
            failing=found,
            kind=signature,
            mistake=signature.mistake if signature is not None else None,
            near_misses=near_misses(trace),
        )


def searched(name: str, algorithm: str, seed: int, npcs: int, generations: int) -> Control:
    """One search from start to end."""
    control, search = Control(name), resolve_algorithm(algorithm).make(SearchSpace(npcs=npcs), population=4)
    for _ in run_campaign(search, control.evaluate, generations=generations, seed=seed):
        pass
    return control


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drivers", nargs="+", choices=DRIVERS, default=list(DRIVERS))
    parser.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=[ALGORITHMS[0], "pafot"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--generations", type=int, default=100)
    parser.add_argument("--npcs", type=int, default=2)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    with ProcessPoolExecutor(arguments.workers) as pool:
        jobs = {
            (name, algorithm, seed): pool.submit(searched, name, algorithm, seed, arguments.npcs, arguments.generations)
            for name in arguments.drivers
            for algorithm in arguments.algorithms
            for seed in seeds
        }
        total: Counter[tuple[str, str]] = Counter()
        for (name, algorithm, seed), job in jobs.items():
            control = job.result()
            total.update({(name, key): count for key, count in control.counts.items()})
            print(f"{name}, {algorithm}, seed {seed}: {dict(control.counts)}", flush=True)
            for slug, explanation in control.explained.items():
                print(f"{slug}: {explanation}", flush=True)
    for name in arguments.drivers:
        print(f"{name}: { {key: count for (of, key), count in total.items() if of == name} }")


if __name__ == "__main__":
    main()
