"""Kinds of failures that the ego answers for, against runs and against seconds of wall clock.

    python -m tests.benchmarks.kinds [--policies NAME ...] [--seeds 20] [--first-seed 0] [--seconds 4] [--workers 2]

The default search, the default search before scenarios were widened, random scenarios of either kind, and the paper's
search, with ``blame="ego"`` and without shrinking, for so many seconds each. The policies are IDM+MOBIL, the PPO of
``example_ads``, five of ``example_ads.defects`` and seven of ``policies_with_defects_2``, on which nothing was tuned.

Prints for each policy the mean number of kinds of each search after numbers of runs and seconds, with the standard
error, the median run of the first, and how many runs there were; then, for each of these numbers, on which policies the
default search is ahead of another, or behind (a test of two samples, Mann-Whitney, Holm over all pairs, 5 %). There,
*before* is the default search before scenarios were widened.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar

from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from example_ads import defects, fiss, ppo
from pytest_pafot.campaign.events import Judged, SearchStarted
from pytest_pafot.comparison.statistics import compared, holm
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.searching import DistinctSearch, PafotSearch, RandomSearch
from tests.benchmarks import policies_with_defects_2 as held_out
from tests.benchmarks.command import in_processes, options, print_head, seeds_of
from tests.benchmarks.positive_controls import holds

TUNED_ON = ("follows-too-close", "sees-cut-ins-late", "ignores-standing-vehicles", "looks-only-ahead", "two-defects")
NOT_TUNED_ON = (
    "LeaderGains", "RelativeTwice", "WayBack", "LaneTruncated", "RampLimit", "TwoStandAndBack", "ThreeVotes"
)  # fmt: skip
POLICIES: Mapping[str, Callable[[], Any]] = {
    "idm": lambda: IDMVehicle,
    "ppo": lambda: ppo.make,
    "fiss": lambda: fiss.make,
    **{name: lambda name=name: defects.make(name) for name in TUNED_ON},
    **{name: lambda name=name: held_out.make(name) for name in NOT_TUNED_ON},
}
AFTER_RUNS, AFTER_SECONDS = (27, 110, 400), (4.0, 20.0)
ENDLESS = 10_000_000


class NarrowSearch(DistinctSearch):
    """The default search in the paper's scenarios."""

    name: ClassVar[str] = "narrow"
    is_papers: ClassVar[bool] = True


class NarrowRandomSearch(RandomSearch):
    """Random scenarios as the paper draws them."""

    name: ClassVar[str] = "narrow-random"
    is_papers: ClassVar[bool] = True


ARMS: Mapping[str, Mapping[str, Any]] = {
    "default": {},
    "before": {"algorithm": NarrowSearch, "population": 4},
    "random": {"algorithm": RandomSearch},
    "random before": {"algorithm": NarrowRandomSearch},
    "pafot": {"algorithm": PafotSearch},
}


@dataclass(frozen=True)
class Searched:
    """When each kind was found, by the number of the run and by the clock [s], and how much there was."""

    found: tuple[tuple[int, float], ...]
    runs: int
    invalid: int

    def kinds(self, *, runs: float = ENDLESS, seconds: float = ENDLESS) -> int | None:
        """After so many runs or seconds; None where there were not so many."""
        if runs < ENDLESS and self.runs < runs:
            return None
        return sum(run <= runs and second <= seconds for run, second in self.found)


def searched(pair: tuple[str, str], seed: int, seconds: float) -> Searched:
    """One search."""
    policy, arm = pair
    found: dict[Any, tuple[int, float]] = {}
    runs = invalid = 0
    began = 0.0

    def listen(event: object) -> None:
        nonlocal runs, invalid, began
        if isinstance(event, SearchStarted):
            began = time.perf_counter()
        if isinstance(event, Judged):
            runs += 1
            invalid += event.verdict.kind == "invalid"
            if event.verdict.failure is not None:
                kind = of_failure(event.run, event.verdict.failure)
                found.setdefault(kind, (runs, time.perf_counter() - began))

    world = pafot.World("highway-v0") if policy == "ppo" else pafot.Highway()
    pafot.explore(
        POLICIES[policy](), holds=holds, world=world, runs=ENDLESS, max_time=1.5 * seconds, seed=seed, blame="ego",
        shrink_rollouts=0, on_event=listen, **ARMS[arm],
    )  # fmt: skip
    return Searched(tuple(sorted(found.values())), runs, invalid)


def columns(seconds: float) -> dict[str, Callable[[Searched], int | None]]:
    """What is counted of a search, by the heading."""
    by_runs = {f"{n} runs": lambda each, n=n: each.kinds(runs=n) for n in AFTER_RUNS}
    by_time = {f"{s:g} s": lambda each, s=s: each.kinds(seconds=s) for s in AFTER_SECONDS if s <= seconds}
    return by_runs | by_time


def shown(values: Iterable[int | None]) -> str:
    """A mean and its standard error; of fewer searches than there were none."""
    told = [value for value in values if value is not None]
    if len(told) < 2:
        return "-"
    few = f" (of {len(told)})" if None in values else ""
    return f"{statistics.mean(told):.2f} ± {statistics.stdev(told) / len(told) ** 0.5:.2f}{few}"


def rows(policy: str, done: Mapping[str, Sequence[Searched]], seconds: float) -> Iterator[str]:
    """What is told of a policy, a line for each number, with the searches beside each other."""
    lines = {
        heading: [shown([count(each) for each in searches]) for searches in done.values()]
        for heading, count in columns(seconds).items()
    }
    first = [
        statistics.median(each.found[0][0] if each.found else ENDLESS for each in every) for every in done.values()
    ]
    lines["first, median run"] = ["none" if median > ENDLESS / 3 else f"{median:g}" for median in first]
    lines["runs (invalid)"] = [
        f"{sum(each.runs for each in every) / len(every):.0f} "
        f"({sum(each.invalid for each in every) / sum(each.runs for each in every):.1%})"
        for every in done.values()
    ]
    for heading, cells in lines.items():
        if set(cells) != {"-"}:
            yield f"| {policy} | {heading} | {' | '.join(cells)} |"


def duels(done: Mapping[tuple[str, str], Sequence[Searched]], policies: Sequence[str], seconds: float) -> list[str]:
    """Where the default search is ahead of each other, by a test."""
    rows = []
    for heading, count in columns(seconds).items():
        told = {
            pair: [value for each in searches if (value := count(each)) is not None] for pair, searches in done.items()
        }
        pairs = [(policy, arm) for policy, arm in product(policies, list(ARMS)[1:]) if told[policy, arm]]
        pairs = [(policy, arm) for policy, arm in pairs if told[policy, "default"]]
        effects = [compared(told[policy, "default"], told[policy, arm]) for policy, arm in pairs]
        for (policy, arm), effect, p in zip(pairs, effects, holm([each.p for each in effects]), strict=True):
            if p < 0.05:
                rows.append(f"| {heading} | {policy} | {arm} | {effect.a12:.2f} | {p:.2g} |")
    return rows


def main() -> None:
    given = options(__doc__, seeds=20, first_seed=0, workers=2, seconds=4.0, policies=POLICIES)
    print_head("policy", "after", *ARMS)
    done: dict[tuple[str, str], Sequence[Searched]] = {}
    pairs = product(given.policies, ARMS)
    for (policy, arm), searches in in_processes(given.workers, searched, pairs, seeds_of(given), given.seconds):
        done[policy, arm] = searches
        if arm == list(ARMS)[-1]:
            print("\n".join(rows(policy, {each: done[policy, each] for each in ARMS}, given.seconds)), flush=True)
    print()
    print_head("after", "policy", "against", "A12", "p (Holm)")
    print("\n".join(duels(done, given.policies, given.seconds)))


if __name__ == "__main__":
    main()
