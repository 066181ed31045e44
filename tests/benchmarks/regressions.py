"""Does a search find what a small change of a policy broke? Three pairs of a policy and its regression, 200 runs each.

    python -m tests.benchmarks.regressions [--seeds 10] [--first-seed 0] [--generations 50] [--npcs 4]
        [--algorithm distinct] [--blame ego] [--workers 2]

Each pair is searched with the policy of before as the reference, and each policy of before against itself, where there
is nothing to find. Prints for each on how many seeds there was a regression, how many distinct ones and runs with one a
search, runs that failed with both, and how many more runs the reference took.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from example_ads.blind_lane_change import BlindLaneChange
from pytest_pafot import Observation, Run
from pytest_pafot.campaign.summary import SearchSummary


class ShorterHeadway(IDMVehicle):  # type: ignore[misc]
    """0.5 s, where it was 1.5 s."""

    TIME_WANTED = 0.5


class WeakerBrakes(IDMVehicle):  # type: ignore[misc]
    """3 m/s^2 at most, where it was 6."""

    ACC_MAX = 3.0


class LaterLook(BlindLaneChange):
    """Acts on where the others were three decisions ago, 0.6 s, where it was on where they are."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: deque[Any] = deque(maxlen=4)

    def __call__(self, observation: Observation) -> tuple[float, float]:
        self._seen.append(observation.others)
        now = observation
        return super().__call__(
            Observation(now.time, now.ego, self._seen[0], now.lanes, now.lane_width, now.speed_limit)
        )


PAIRS: Mapping[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "shorter headway": (ShorterHeadway, IDMVehicle),
    "weaker brakes": (WeakerBrakes, IDMVehicle),
    "later look": (LaterLook, BlindLaneChange),
    "IDM+MOBIL, itself": (IDMVehicle, IDMVehicle),
    "blind lane changes, itself": (BlindLaneChange, BlindLaneChange),
}
"""The policy now and before."""


def never_collides(run: Run) -> None:
    assert not run.collision


def searched(pair: str, seed: int, **settings: Any) -> SearchSummary:
    """One search; finds are not shrunk."""
    now, before = PAIRS[pair]
    return pafot.explore(
        now, against=before, holds=never_collides, node_id=pair, seed=seed, shrink_rollouts=0, **settings
    ).summary


def row(pair: str, searches: list[SearchSummary]) -> str:
    found = sum(bool(each.finds) for each in searches)
    runs, distinct, failing, common = (
        sum(values) / len(searches)
        for values in zip(*((each.runs, len(each.finds), each.failing, each.common) for each in searches), strict=True)
    )
    return (
        f"{pair:27} found on {found} of {len(searches)} seeds; a search: {distinct:.2f} distinct, {failing:.1f} of "
        f"{runs:.0f} runs, {common:.1f} failing with both, {failing + common:.1f} runs of the reference"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--generations", type=int, default=50)
    parser.add_argument("--npcs", type=int, default=4)
    parser.add_argument("--algorithm", default="distinct")
    parser.add_argument("--blame", default="ego")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    settings = {name: getattr(given, name) for name in ("generations", "npcs", "algorithm", "blame")}
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    with ProcessPoolExecutor(given.workers) as pool:
        jobs = {pair: [pool.submit(searched, pair, seed, **settings) for seed in seeds] for pair in PAIRS}
        for pair, futures in jobs.items():
            print(row(pair, [future.result() for future in futures]), flush=True)


if __name__ == "__main__":
    main()
