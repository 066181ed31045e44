"""How soon does a search find a planted rare defect? Survival curves of 20 policies with one defect each.

    python -m tests.benchmarks.planted_defects [--policies NAME ...] [--arms NAME ...] [--seeds 20] [--first-seed 0]
        [--runs 2000] [--seconds 600] [--workers 2] [--save FILE] [--picture FILE]

Each policy of ``tests.benchmarks.planted`` has a twin, which is the same without the defect. A search with
``blame="ego"`` ends at the first failure in whose scenario the twin does not fail by its own fault. Failures that the
twin shares are counted, and the search continues. It is censored after a number of runs, or of seconds of wall clock.
The twin's runs and time do not count.

``--save`` appends each search to a file of JSON lines as soon as it ends. Searches that are already in the file are not
repeated, so the same command continues after an interruption.
``--picture`` draws the survival curves of all defects together into a file.

Prints a table of all defects together, and one with a line for each defect. Medians have 95 % intervals (Brookmeyer and
Crowley). Ratios to the default search have 95 % bootstrap intervals over seeds, resampled separately for each defect.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import pytest_pafot as pafot
from pytest_pafot import Run, Scenario
from pytest_pafot.algorithms import PafotSearch
from pytest_pafot.algorithms.evaluation import Evaluated
from pytest_pafot.comparison.figures import SETTINGS, STYLES
from pytest_pafot.searches.events import SearchStarted
from pytest_pafot.searches.harness import judge
from tests.benchmarks.command import as_they_end, holds, options, print_head, seeds_of
from tests.benchmarks.planted import PLANTED
from tests.benchmarks.survival import Curve, Sample, common_limit, ratio, ratio_interval

DEFAULT = "default"


@dataclass(frozen=True, slots=True)
class DrawnPafotSearch(PafotSearch):
    """The paper's algorithm in the scenarios of the default search, and not in the paper's."""

    name: ClassVar[str] = "pafot-drawn"
    is_papers: ClassVar[bool] = False
    draws_vehicles: ClassVar[bool] = True


ARMS: Mapping[str, Mapping[str, Any]] = {
    DEFAULT: {},
    "pafot": {"algorithm": PafotSearch},
    "pafot-drawn": {"algorithm": DrawnPafotSearch},
    "cells": {"instructions": "cells"},
    "lanes": {"instructions": "lanes"},
}
"""Further arguments of ``pafot.explore`` for each search; to add a search, add a line."""


@dataclass(frozen=True)
class Searched:
    """The course of a search until it found the defect or was censored."""

    policy: str
    arm: str
    seed: int
    found: bool
    runs: int
    simulated: float  # [s]
    seconds: float  # of wall clock, without the twin's
    shared: int  # the number of failures that the twin shares


MEASURES: Mapping[str, Callable[[Searched], float]] = {
    "runs": lambda each: each.runs,
    "simulated time [s]": lambda each: each.simulated,
    "wall clock [s]": lambda each: each.seconds,
}
FIGURES = ("median", "mean", "median to default's", "mean to default's")
Group = Sequence[Searched]


class EndedError(Exception):
    """The signal that the search has found the defect, or has no budget left."""


def searched(policy: str, arm: str, seed: int, runs: int, seconds: float) -> Searched:
    """Search until the defect of a policy is found or the budget is used."""
    planted, world = PLANTED[policy], pafot.Highway()
    twin = planted.twin()
    began = spent = simulated = 0.0
    count = shared = 0
    found = False

    def twin_fails(scenario: Scenario) -> bool:
        run = Run(world.rollout(scenario, twin))
        return judge(run, holds, blame="ego", test_file=__file__).failed

    def listen(event: object) -> None:
        nonlocal began, spent, simulated, count, shared, found
        if isinstance(event, SearchStarted):
            began = time.perf_counter()
        if not isinstance(event, Evaluated):
            return
        now = time.perf_counter()
        spent = now - began
        count += 1
        simulated += event.evaluation.duration
        if event.evaluation.failing:
            found = not twin_fails(event.evaluation.executed)
            shared += not found
            began += time.perf_counter() - now
        if found or count >= runs or spent >= seconds:
            raise EndedError  # before the search simplifies its finding

    with suppress(EndedError):
        pafot.explore(
            planted.make(), holds=holds, world=world, runs=runs, seed=seed, blame="ego", shrink_runs=0,
            on_event=listen, **ARMS[arm],
        )  # fmt: skip
    return Searched(policy, arm, seed, found, count, simulated, spent, shared)


def loaded(path: str) -> list[Searched]:
    """Return the searches in a file of JSON lines."""
    return [
        Searched(**json.loads(line)) for line in Path(path).read_text(encoding="utf-8").splitlines()
    ]


def saved(searches: Iterable[Searched], path: str) -> Iterator[Searched]:
    """Yield searches; append each of them to a file first."""
    with Path(path).open("a", encoding="utf-8") as file:
        for each in searches:
            print(json.dumps(asdict(each)), file=file, flush=True)
            yield each


def sample(group: Group, measure: str) -> Sample:
    """Return the times of searches by one of the measures."""
    return Sample.of([MEASURES[measure](each) for each in group], [each.found for each in group])


def overall_rows(by_arm: Mapping[str, Group]) -> Iterator[str]:
    """Yield the lines about all defects together; each search is one observation."""
    for measure in MEASURES:
        curves = {arm: sample(group, measure).curve for arm, group in by_arm.items()}
        limit = common_limit(list(curves.values()))
        for arm, group in by_arm.items():
            found = f"{sum(each.found for each in group)} of {len(group)}"
            shared = f"{sum(each.shared for each in group) / len(group):.2f}"
            median = with_interval(curves[arm].median, *curves[arm].median_interval)
            mean = f"{number(curves[arm].mean(limit))} (to {number(limit)})"
            cells = ["set-aside", arm, found, shared, measure, median, mean]
            for figure in (lambda each: each.median, lambda each, limit=limit: each.mean(limit)):
                cells += [ratio_to_default(figure, by_arm, arm, measure)]
            yield f"| {' | '.join(cells)} |"


def ratio_to_default(
    figure: Callable[[Curve], float], by_arm: Mapping[str, Group], arm: str, measure: str
) -> str:
    """Return the ratio of a figure to that of the default search, over the seeds that both were searched with."""
    first, second = (
        {(each.policy, each.seed): each for each in by_arm.get(name, ())} for name in (arm, DEFAULT)
    )
    both = [pair for pair in first if pair in second]
    if arm == DEFAULT or not both:
        return ""
    one, other = (
        sample([searches[pair] for pair in both], measure) for searches in (first, second)
    )
    low, high = ratio_interval(figure, one, other, [policy for policy, _ in both])
    return with_interval(ratio(figure(one.curve), figure(other.curve)), low, high)


def row_of(policy: str, by_arm: Mapping[str, Group], arms: Sequence[str]) -> str:
    """Return the line of a defect: each search's runs until it is found; a missing search has an empty cell."""
    planted = PLANTED[policy]
    curves = {arm: sample(group, "runs").curve for arm, group in by_arm.items()}
    limit = common_limit(list(curves.values()))
    cells = [policy, planted.kind, str(planted.conditions)]
    for arm in arms:
        if arm not in by_arm:
            cells += [""]
            continue
        text = with_interval(curves[arm].median, *curves[arm].median_interval)
        if math.isinf(curves[arm].median):
            text += f", mean {number(curves[arm].mean(limit))} (to {number(limit)})"
        cells += [f"{text}; {sum(each.found for each in by_arm[arm])} of {len(by_arm[arm])}"]
    return f"| {' | '.join(cells)} |"


def with_interval(value: float, low: float, high: float) -> str:
    """Format a value and its interval, or a dash if nothing is known about it."""
    if not math.isfinite(value) and low in (0, math.inf):
        return "-"
    return f"{number(value)} ({number(low)} to {number(high)})"


def number(value: float) -> str:
    """Format a number with three digits, or a dash if it was not reached."""
    return (
        f"{value:.0f}"
        if 100 <= value < math.inf
        else f"{value:.3g}"
        if math.isfinite(value)
        else "-"
    )


def draw(path: str, overall: Mapping[str, Group]) -> None:
    """Draw all defects together, by runs and by wall clock."""
    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(8.4, 3.4), layout="constrained")
        for axes, measure in zip(
            panels := figure.subplots(1, 2), ("runs", "wall clock [s]"), strict=True
        ):
            draw_curves(axes, overall, measure)
            axes.set(xlabel=measure, ylabel="not found yet [%]")
            axes.set_title("all defects; band: 95 %", fontsize=9, loc="left")
        panels[0].legend(loc="lower left")
        figure.savefig(path, dpi=160)


def draw_curves(axes: Axes, by_arm: Mapping[str, Group], measure: str) -> None:
    """Draw the share that has not found a defect yet, by search."""
    begin = 0.8 * min(MEASURES[measure](each) for group in by_arm.values() for each in group)
    for arm, group in by_arm.items():
        style, curve = STYLES[list(ARMS).index(arm) % len(STYLES)], sample(group, measure).curve
        times = [begin, *curve.times]
        low, high = ([100, *(100 * limit)] for limit in curve.band)
        axes.fill_between(
            times, low, high, step="post", color=style.colour, alpha=0.12, linewidth=0
        )
        axes.step(times, [100, *(100 * curve.shares)], where="post", label=arm, markersize=4, markevery=0.2,
                  **style.curve)  # fmt: skip
    axes.set(xscale="log", ylim=(0, 103))


def grouped(
    searches: Iterable[Searched], policies: Sequence[str], arms: Sequence[str]
) -> dict[str, list[Searched]]:
    """Group the searches of some policies by arm, in the order of the policies and the seeds."""
    ordered = sorted(
        (each for each in searches if each.policy in policies),
        key=lambda each: (each.policy, each.seed),
    )
    groups = {arm: [each for each in ordered if each.arm == arm] for arm in arms}
    return {arm: group for arm, group in groups.items() if group}


def main() -> None:
    given = options(
        __doc__, policies=PLANTED, arms=ARMS, seeds=20, first_seed=0, runs=2000, seconds=600.0, workers=2, save="",
        picture="",
    )  # fmt: skip
    done = loaded(given.save) if given.save and Path(given.save).exists() else []
    # Seeds come first, so that an interrupted run has equally many searches of each defect by each arm.
    tasks = [
        (policy, arm, seed)
        for seed, policy, arm in product(seeds_of(given), given.policies, given.arms)
    ]
    known = {(each.policy, each.arm, each.seed) for each in done}
    new = as_they_end(
        given.workers,
        searched,
        [(*task, given.runs, given.seconds) for task in tasks if task not in known],
    )
    done += saved(new, given.save) if given.save else new
    arms = [arm for arm in given.arms if any(each.arm == arm for each in done)]
    overall = grouped(done, given.policies, arms)
    of_policies = {name: group for name in given.policies if (group := grouped(done, [name], arms))}
    print_head("defects", "search", "found", "failures of the twin, too", "until found", *FIGURES)
    print("\n".join(overall_rows(overall)), flush=True)
    print()
    print_head("defect", "kind", "conditions", *(f"{arm}, median of runs; found" for arm in arms))
    for name, group in of_policies.items():
        print(row_of(name, group, arms))
    if given.picture:
        draw(given.picture, overall)


if __name__ == "__main__":
    main()
