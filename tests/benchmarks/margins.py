"""Does a check find a property's failure as early as a hand-written fitness? Runs until the first failure.

    python -m tests.benchmarks.margins [--policies idm careful-human] [--seeds 20] [--first-seed 0] [--runs 240]
        [--workers 2]

There are four measures (a headway, a jerk, a gap, a mean speed) for each policy, each with a bound that one of 200
random runs breaks. Each is searched as a check, as a plain assertion with a hand-written fitness, as a plain assertion
only (then danger steers the search), and by random scenarios. Prints how many searches found a failure, by measure and
in total. A policy may also be one of the ``planners``; nothing here was tuned on these.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from example_ads import defects
from pytest_pafot import Run, Trace
from pytest_pafot.campaign.events import Judged
from pytest_pafot.world.reference_drivers import REFERENCES
from tests.benchmarks.command import options, print_head, seeds_of
from tests.benchmarks.planners import GippsBased, IdmBased, Planner

POLICIES: Mapping[str, Any] = {
    "idm": IDMVehicle,
    "careful-human": REFERENCES["careful-human"],
    "healthy": defects.make("healthy"),
    "brakes-weakly": defects.make("brakes-weakly"),
    **{planner.__name__: planner for planner in (GippsBased, IdmBased, Planner)},
}
ONE_IN, RANDOM_RUNS = 200, 4000


@dataclass(frozen=True)
class Property:
    """A measure of a policy's runs, higher = worse, that must not be above a bound."""

    policy: str
    measure: str
    bound: float = 0.0
    scale: float = 1.0

    def worst(self, run: Run) -> float:
        """Return the measure's worst value in a run."""
        return MEASURES[self.measure](run)

    def check(self, run: Run) -> None:
        """Check the bound with a margin."""
        pafot.check(self.worst(run), name=self.measure, at_most=self.bound, scale=self.scale)

    def plainly(self, run: Run) -> None:
        """Assert the bound without a margin."""
        assert not self.worst(run) > self.bound

    def fitness(self, trace: Trace) -> float:
        """Return the hand-written fitness."""
        return self.worst(Run(trace))


def _headway(run: Run) -> float:
    return -float(np.min(run.headway))


def _jerk(run: Run) -> float:
    return float(np.abs(run.ego.jerk).max())


def _gap(run: Run) -> float:
    return -run.min_distance


def _slowness(run: Run) -> float:
    return -float(np.mean(run.ego.speed))


MEASURES: Mapping[str, Callable[[Run], float]] = {
    "headway": _headway, "jerk": _jerk, "gap": _gap, "keeps-up": _slowness
}  # fmt: skip
ARMS = {
    "check": "as a check",
    "by hand": "as an assertion, with a fitness by hand",
    "plain": "as an assertion alone",
    "random": "by random scenarios",
}


def bounded(policy: str, measure: str) -> Property:
    """Return a property whose bound one of 200 random runs breaks, or a few more if their worst values are equal."""
    values: list[float] = []

    def note(event: Any) -> None:
        if isinstance(event, Judged) and event.verdict.kind == "passed":
            values.append(MEASURES[measure](event.run))

    pafot.explore(
        POLICIES[policy], holds=lambda run: None, runs=RANDOM_RUNS, algorithm="random", on_event=note, blame="ego",
        seed=12345,
    )  # fmt: skip
    finite = sorted(value for value in values if np.isfinite(value))
    least = finite[-max(len(values) // ONE_IN, 1)]
    bound = max((value for value in finite if value < least), default=least)
    return Property(policy, measure, bound=bound, scale=finite[-1] - finite[0] or 1.0)


def runs_until_found(each: Property, arm: str, seed: int, budget: int) -> int | None:
    """Return the number of runs until the first failure, or None if there is none."""
    runs, found = 0, []

    def count(event: Any) -> None:
        nonlocal runs
        if isinstance(event, Judged):
            runs += 1
            if event.verdict.failed:
                found.append(runs)

    more = {"by hand": {"fitness": each.fitness}, "random": {"algorithm": "random"}}.get(arm, {})
    pafot.explore(
        POLICIES[each.policy],
        holds=each.check if arm == "check" else each.plainly,
        runs=budget,
        seed=seed,
        blame="ego",
        stop_after=1,
        shrink_rollouts=0,
        on_event=count,
        **more,
    )
    return found[0] if found else None


def main() -> None:
    given = options(__doc__, seeds=20, first_seed=0, runs=240, workers=2, policies=["idm", "careful-human"])
    with ProcessPoolExecutor(given.workers) as pool:
        properties = list(pool.map(bounded, *zip(*product(given.policies, MEASURES), strict=True)))
        jobs = {
            (each, arm, seed): pool.submit(runs_until_found, each, arm, seed, given.runs)
            for each, arm, seed in product(properties, ARMS, seeds_of(given))
        }
        founds = (f"{each}, found" for each in (*MEASURES, "all"))
        print_head("searched for", *founds, "mean runs, a miss counted as all")
        for arm, told in ARMS.items():
            found = {
                measure: [job.result() for (each, by, _), job in jobs.items() if by == arm and each.measure == measure]
                for measure in MEASURES
            }
            every = [runs for each in found.values() for runs in each]
            shown = [f"{sum(runs is not None for runs in each)} of {len(each)}" for each in (*found.values(), every)]
            mean = statistics.mean(given.runs if runs is None else runs for runs in every)
            print(f"| {told} | {' | '.join(shown)} | {mean:.0f} |")


if __name__ == "__main__":
    main()
