"""Does a check find a property's failure as soon as a fitness written by hand? Runs until the first failure.

    python -m tests.benchmarks.margins [--seeds 20] [--first-seed 0] [--generations 60] [--workers 2]

Four properties whose bounds random scenarios break once in some hundred runs: a headway, a jerk, a gap, a mean speed.
Each is searched for as a check, as a plain assertion with a fitness written by hand, as a plain assertion alone (the
search is steered by danger then), and by random scenarios.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from pytest_pafot import Run, Trace
from pytest_pafot.campaign.events import Judged
from pytest_pafot.world.reference_drivers import REFERENCES


@dataclass(frozen=True)
class Property:
    """A value of a run, higher = worse, that must not be above a bound."""

    name: str
    ads: Any
    worst: Callable[[Run], float]
    bound: float

    def check(self, run: Run) -> None:
        """With a margin."""
        pafot.check(self.worst(run), name=self.name, at_most=self.bound, scale=max(abs(self.bound), 0.1))

    def plainly(self, run: Run) -> None:
        """Without one."""
        assert not self.worst(run) > self.bound

    def fitness(self, trace: Trace) -> float:
        """By hand."""
        return self.worst(Run(trace))


def _headway(run: Run) -> float:
    return -float(np.min(run.headway))


def _jerk(run: Run) -> float:
    return float(np.abs(run.ego.jerk).max())


def _gap(run: Run) -> float:
    return -run.min_distance


def _slowness(run: Run) -> float:
    return -float(np.mean(run.ego.speed))


PROPERTIES = (
    Property("headway", IDMVehicle, _headway, -0.01),
    Property("jerk", REFERENCES["careful-human"], _jerk, 133.4),
    Property("gap", IDMVehicle, _gap, -0.12),
    Property("keeps-up", IDMVehicle, _slowness, -4.5),
)
ARMS = ("check", "by hand", "plain", "random")


def runs_until_found(index: int, arm: str, seed: int, generations: int) -> int | None:
    """Runs until the first failure; None where there was none."""
    each, runs = PROPERTIES[index], 0
    found: list[int] = []

    def count(event: Any) -> None:
        nonlocal runs
        if isinstance(event, Judged):
            runs += 1
            if event.verdict.failed:
                found.append(runs)

    more = {"by hand": {"fitness": each.fitness}, "random": {"algorithm": "random"}}.get(arm, {})
    pafot.explore(
        each.ads,
        holds=each.check if arm == "check" else each.plainly,
        generations=generations,
        seed=seed,
        blame="ego",
        stop_after=1,
        shrink_rollouts=0,
        on_event=count,
        **more,
    )
    return found[0] if found else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("seeds", 20), ("first-seed", 0), ("generations", 60), ("workers", 2)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    print(
        "| property | arm | found | median runs until then | mean, a miss counted as all runs |\n|---|---|---|---|---|"
    )
    with ProcessPoolExecutor(options.workers) as pool:
        for index, each in enumerate(PROPERTIES):
            for arm in ARMS:
                jobs = [pool.submit(runs_until_found, index, arm, seed, options.generations) for seed in seeds]
                runs = [job.result() or 4 * options.generations for job in jobs]
                found = sum(job.result() is not None for job in jobs)
                row = (each.name, arm, f"{found} of {len(jobs)}", f"{statistics.median(runs):.0f}")
                print(f"| {' | '.join(row)} | {statistics.mean(runs):.0f} |", flush=True)


if __name__ == "__main__":
    main()
