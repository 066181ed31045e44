"""Is the answer of the command ``progress`` true? Two versions of policies, better, worse and equal by construction.

    python -m tests.benchmarks.progress [--policies NAME ...] [--seeds 20] [--first-seed 0] [--scenarios 200]
        [--redraws 200] [--workers 2]

The new version of a policy lacks a defect of the old one, so it is better, and the old one is worse; some have further
defects. Two pairs are equal:

- the new version, and itself with a defect that never shows, because no vehicle drives at 100 m/s;
- two policies that fail equally often, in different scenarios. In each scenario a fair coin decides which of them
  drives as the old version of this policy, and which as the old version of the next one in the table.

Prints for each policy how many of 100 scenarios its versions fail, on how many seeds the answer is that the new version
is better, and that the old one is worse, and how often the opposite. For equal pairs, which are also compared by two
checks, it prints on how many seeds the answer claims a difference. For pairs that differ, it also does so at p 0.05,
and with new coins.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

import pytest_pafot as pafot
from pytest_pafot import Run
from pytest_pafot.extras.episodes.progress_command import (
    APART,
    LEVEL,
    PairRow,
    ProgressPlan,
    Result,
    lines_of,
    verdict_of,
)
from tests.benchmarks import policies_with_defects
from tests.benchmarks.command import in_processes, options, print_head, seeds_of
from tests.benchmarks.planted import PLANTED

REPAIRED: Mapping[str, str] = MappingProxyType(
    {
        "OneCutOff": "cut-off-slow",
        "OneFollower": "follower-as-leader",
        "OneCentred": "cut-in-centred-only",
        "ThreeMixed": "resumes-unasked",
        "ThreeAround": "follower-as-leader",
        "not-a-number": "",
    }
)
"""The defect that the new version of a policy lacks. The last one rarely shows, and has its twin."""
Results = Sequence[Result]


class NeverMatters:
    """A planner with a defect that does not show."""

    def __init__(self, planner: Any) -> None:
        self.planner = planner

    def __call__(self, observation: Any) -> tuple[float, float]:
        acceleration, steering = self.planner(observation)
        return (2.5 if observation.ego.speed > 100 else acceleration), steering


def make(version: str) -> Any:
    """Return the planner of a version: ``OneCutOff/old``, ``OneCutOff/new`` or ``OneCutOff/same``."""
    name, _, which = version.partition("/")
    if name in PLANTED:
        planner = (PLANTED[name].make if which == "old" else PLANTED[name].twin)()()
    else:
        planner = policies_with_defects.make(name, () if which == "old" else (REPAIRED[name],))()
    return NeverMatters(planner) if which == "same" else planner


def drives(run: Run) -> None:
    """Assert that there is no collision, and measure two comforts whose bounds no vehicle breaks."""
    assert not run.collision
    pafot.check(run.ego.acceleration, name="braking", at_least=-100.0, scale=10.0)
    pafot.check(run.ego.jerk, name="jerk", at_most=1e4, scale=100.0)


def driven(name: str, seed: int, scenarios: int) -> dict[str, list[Result]]:
    """Return the results of all versions of a policy in the random scenarios of a seed."""
    made: dict[str, list[Result]] = {}
    for which in ("old", "new", "same"):
        version = f"{__name__}:make:{name}/{which}"
        plan = ProgressPlan(old=version, new=version, check=f"{__name__}:drives", seed=seed)
        made[which] = [Result.of(*each) for each in plan.judged("new", range(scenarios))]
    return made


def rows_of(old: Results, new: Results) -> list[PairRow]:
    """Return the rows of two policies in the same scenarios."""
    return [PairRow(part="scenarios", name="", old=before, new=after) for before, after in zip(old, new, strict=True)]


def verdict(old: Results, new: Results) -> str:
    """Return the verdict without checks, which may rightly find a sound policy less comfortable."""
    plain = [
        replace(row, old=replace(row.old, margins={}), new=replace(row.new, margins={})) for row in rows_of(old, new)
    ]
    return verdict_of(lines_of(plain))


def least_p(old: Results, new: Results) -> float:
    """Return the smallest p of all lines, adjusted for their number."""
    return min(line.p for line in lines_of(rows_of(old, new)))


def tossed(one: Results, other: Results, seed: int) -> float:
    """Return the smallest p if a coin decides the order in each scenario."""
    heads = np.random.default_rng((seed, 17)).integers(2, size=len(one))
    pairs = [(a, b) if head else (b, a) for a, b, head in zip(one, other, heads, strict=True)]
    return least_p([first for first, _ in pairs], [second for _, second in pairs])


def failing(runs: Sequence[dict[str, list[Result]]], which: str) -> str:
    """Return how many of 100 scenarios a version fails."""
    known = [result.failed for each in runs for result in each[which] if result.failed is not None]
    return f"{100 * sum(known) / len(known):.1f}"


def cells(
    runs: Sequence[dict[str, list[Result]]],
    others: Sequence[dict[str, list[Result]]],
    seeds: Sequence[int],
    redraws: int,
) -> Iterator[str]:
    """Yield the table's cells for a policy, compared with the next one."""
    forth, back = ([verdict(each[a], each[b]) for each in runs] for a, b in (("old", "new"), ("new", "old")))
    same = [least_p(each["new"], each["same"]) for each in runs]
    again = [
        [
            tossed(own["old"], other["old"], seed + 1000 * draw)
            for own, other, seed in zip(runs, others, seeds, strict=True)
        ]
        for draw in range(1 + redraws)
    ]
    yield from (failing(runs, "old"), failing(runs, "new"))
    yield from (f"{told.count(right)} of {len(seeds)}" for told, right in ((forth, "better"), (back, "worse")))
    yield str(sum(told not in ("better", APART) for told in forth) + sum(told not in ("worse", APART) for told in back))
    tosses = [p for toss in again[1:] for p in toss]
    claims = [(same, LEVEL), (again[0], LEVEL), (again[0], 0.05), (tosses, LEVEL), (tosses, 0.05)]
    yield from (f"{sum(p <= level for p in values)} of {len(values)}" for values, level in claims)


def main() -> None:
    given = options(__doc__, policies=REPAIRED, seeds=20, first_seed=0, scenarios=200, redraws=200, workers=2)
    seeds, names = seeds_of(given), given.policies
    runs = dict(in_processes(given.workers, driven, names, seeds, given.scenarios))
    print_head("policy", "old fails, of 100", "new fails", "told: better", "told: worse", "opposite", "same, claims",
               "equal, claims", "at 0.05", "tossed again", "at 0.05")  # fmt: skip
    for name, following in zip(names, [*names[1:], names[0]], strict=True):
        print(f"| {name} | {' | '.join(cells(runs[name], runs[following], seeds, given.redraws))} |", flush=True)


if __name__ == "__main__":
    main()
