"""The report of a comparison, as Markdown."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import pandas as pd

from pytest_pafot.comparison.plan import DIFFERENT, Plan
from pytest_pafot.comparison.resumable import file_name, seconds_of
from pytest_pafot.comparison.run_measures import (
    FAULTS,
    SECONDS_PER_HOUR,
    Results,
    comparisons,
    distinct_in_all,
    first_failures,
    of,
    survival,
)
from pytest_pafot.support.process import installed_versions, versions_text
from pytest_pafot.support.proportions import holm
from pytest_pafot.support.text import csv_text, markdown_table

# The numbers that the paper reports (Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 4.2).


@dataclass(frozen=True, slots=True, kw_only=True)
class Reported:
    """The paper's results for one technique, over ten runs of 100 generations with two NPCs on CARLA."""

    scenarios: int  # total over all runs
    collisions: int  # total over all runs
    local_searches: int  # total over all runs
    per_run: tuple[int, int, int]  # collisions of a run: mean, most, least
    time_to_collision: tuple[float, float, float]  # mean, longest and shortest of scenarios with a collision [s]
    seconds_per_scenario: float  # simulated time of a scenario, 60 s for a safe one [s]
    hours: float  # total simulated time


PAPER_GENERATIONS = 100  # of each run

PAPER: Mapping[str, Reported] = MappingProxyType(
    {
        "pafot": Reported(
            scenarios=4945,
            collisions=3981,
            local_searches=185,
            per_run=(398, 509, 342),
            time_to_collision=(20.65, 60, 3),
            seconds_per_scenario=28.16,
            hours=38.68,
        ),
        "av-fuzzer": Reported(
            scenarios=4327,
            collisions=2438,
            local_searches=80,
            per_run=(243, 378, 144),
            time_to_collision=(34.32, 60, 11),
            seconds_per_scenario=45.53,
            hours=54.73,
        ),
        "random-manoeuvre": Reported(  # the paper's Random, see HOW_TO_READ
            scenarios=4000,
            collisions=997,
            local_searches=0,
            per_run=(99, 113, 85),
            time_to_collision=(37.63, 60, 10),
            seconds_per_scenario=54.42,
            hours=60.47,
        ),
    }
)

PEAKS: Mapping[str, str] = MappingProxyType(
    {"pafot": "10 to 20 s", "av-fuzzer": "20 to 30 s, none before 10 s", "random-manoeuvre": "50 to 60 s"}
)
"""The ten-second interval in which most collisions of each technique happen, according to the paper."""


HITS = {
    "any": "all collisions",
    "ego": "collisions that the ego is responsible for (`--blame ego`)",
    "preventable": "collisions that the ego is responsible for and a reference driver in its place is not (`--blame "
    "preventable`)",
    "avoidable": "collisions that the ego is responsible for, or that braking late, but hard, avoids (`--blame "
    "avoidable`)",
}
"""Descriptions of the collisions that count as failures, by the blame of the comparison."""

BIN_SECONDS = 10.0  # width of the paper's intervals for the times of collisions [s]

HOW_TO_READ = """
## How to read this

- The paper ran on CARLA against its traffic manager, with four to six lanes and a speed limit of 96 km/h; here the
  world is the one above. The paper's numbers are for orientation, and no test compares with them.
- The paper's Random "manipulates the driving behaviours of NPCs at specified intervals", and collided less often than
  its AV-Fuzzer. Its numbers are next to `random-manoeuvre`, whose NPCs use no grid either.
- `NAME@15` is the algorithm NAME with runs of 15 s, which are divided evenly among its genes. So `av-fuzzer@15` has
  slices of 3 s, as in its release. Without `@15`, its five slices together last as long as all genes of the other
  algorithms, as in the paper's reimplementation, whose runs last 60 s.
- Without an `@` an algorithm has the same scenarios as in a test. `NAME@paper` has the paper's scenarios, four in each
  of its generations.
- AV-Fuzzer simulates only scenarios that crossover or mutation changed, so its generations have fewer scenarios than
  those of the others. For this reason the algorithms are also compared at equal simulated seconds.
- `results.csv` has a row for every scenario; `runs/` has the same rows run by run.
- To publish: `runs.csv` has the measures of every run, `statistics.csv` the table above, both with exact numbers, and
  `versions.txt` the versions, as pip reads them.
- Equal arguments and versions give equal rows with any number of workers: {rows} rows here.
"""


def report(results: Results, command: Sequence[str], wall: Mapping[str, float], figures: Mapping[str, str]) -> str:
    """Return the whole report as Markdown.

    ``command`` is the command that made the report. ``wall`` is the wall-clock time of all runs of each algorithm [s];
    empty if unknown. ``figures`` has the title of each figure by its file name without ending.
    """
    parts = [
        _head(results, command, wall),
        _effectiveness(results),
        _efficiency(results, wall),
        _responsibility(results),
        _distinct(results),
        _tests(results),
        "## Figures",
        *(f"![{title}](figures/{name}.png)\n\n*{title}.*" for name, title in figures.items()),
        HOW_TO_READ.format(rows=len(results.frame)),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _head(results: Results, command: Sequence[str], wall: Mapping[str, float]) -> str:
    plan = results.plan
    hours = results.whole["seconds"].sum() / SECONDS_PER_HOUR
    spent = sum(wall.values())
    time = f"{spent / 60:.1f} min" if spent < SECONDS_PER_HOUR else f"{spent / SECONDS_PER_HOUR:.1f} h"
    computing = f", {time} of computing" if wall else ""
    budget = f"{plan.generations} generations" if plan.generations else f"{plan.seconds:g} simulated seconds"
    hits = HITS[plan.blame]
    wider = [name for name in plan.names if plan.drawn and not plan.entrant(name).has_papers_scenarios]
    drawn = f"; of {', '.join(wider)} with `{json.dumps(dict(plan.drawn))}`" if wider else ""
    packages = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    groups = "\n".join(f"- {', '.join(names)}: {scenarios}" for scenarios, names in plan.scenarios.items())
    warning = "" if len(plan.scenarios) == 1 else f"\n**Warning:** {DIFFERENT}.\n\n{groups}\n"
    return f"""
# {" against ".join(plan.names)} on {plan.ads}

```sh
{shlex.join(command)}
```

{plan.runs} runs of each algorithm, {budget} each, base seed {plan.seed}; {hours:.1f} h of simulated driving{computing}.
What counts as a failure in the search: {hits}; and faults of the ADS, which are exceptions and hangs. {packages}.

World: `{json.dumps(dict(plan.world))}`.
Scenarios: `{json.dumps(dict(plan.space))}`{drawn}.
{warning}"""


def _effectiveness(results: Results) -> str:
    rows = []
    for name in results.plan.names:
        told, runs = PAPER.get(name), of(name, results.whole)
        total, per_run = runs.sum(numeric_only=True), runs["collisions"]
        rows.append(
            [
                name,
                *(f"{total.scenarios:.0f}", "" if told is None else f"{told.scenarios}"),
                *(f"{total.collisions:.0f}", "" if told is None else f"{told.collisions}"),
                _share(total.collisions, total.scenarios),
                f"{total.unique_collisions:.0f} of {total['unique']:.0f}",
                _share(total.unique_collisions, total["unique"]),
                "" if told is None else _share(told.collisions, told.scenarios),
                f"{per_run.mean():.0f} ({per_run.max()} / {per_run.min()})",
                "" if told is None else "{} ({} / {})".format(*told.per_run),
                *(f"{total.local_searches:.0f}", "" if told is None else f"{told.local_searches}"),
            ]
        )
    header = [
        "", "scenarios", "paper", "collisions", "paper", "share of all", "unique", "share of unique", "paper",
        "collisions per run (max / min)", "paper", "local searches", "paper",
    ]  # fmt: skip
    return f"""
## How many collisions

The paper's first table, with its numbers next to ours. A scenario that only repeats an earlier one of the same search
is counted in *all*, but not in *unique*; it is not simulated.

{markdown_table(header, rows)}
"""


def _efficiency(results: Results, wall: Mapping[str, float]) -> str:
    rows = []
    for name in results.plan.names:
        told, total = PAPER.get(name), of(name, results.whole).sum(numeric_only=True)
        seconds, hits = total["seconds"], total["unique_collisions"]
        times = of(name, results.frame[~results.frame["reused"]])["collision_time"].dropna()
        rows.append(
            [
                name,
                *(f"{seconds / total['unique']:.2f} s", "" if told is None else f"{told.seconds_per_scenario:.2f} s"),
                f"{seconds / hits:.2f} s" if hits else "no collision",
                "" if told is None else f"{told.hours * SECONDS_PER_HOUR / told.collisions:.2f} s",
                *(f"{seconds / SECONDS_PER_HOUR:.2f} h", "" if told is None else f"{told.hours:.2f} h"),
                f"{times.mean():.2f} s ({times.max():.0f} / {times.min():.0f})" if len(times) else "none",
                "" if told is None else "{:.2f} s ({:g} / {:g})".format(*told.time_to_collision),
                *(_peak(times, results.longest), PEAKS.get(name, "")),
                *(f"{1e3 * wall[name] / total['unique']:.1f} ms" if wall else "",),
                *(f"{1e3 * wall[name] / hits:.1f} ms" if wall and hits else "",),
            ]
        )
    header = [
        "", "simulated per scenario", "paper", "simulated per collision", "paper", "in total", "paper",
        "time to collision (max / min)", "paper", "most collisions at", "paper",
        "wall clock per scenario", "wall clock per collision",
    ]  # fmt: skip
    return f"""
## How fast

The paper's second table. Simulated time per scenario counts a safe scenario with its full length; per collision it is
all simulated time divided by all unique collisions. The wall-clock times are from the machine of this report, and
include evaluating and reporting each scenario. They differ on other machines, but no result depends on them.

{markdown_table(header, rows)}

**The time to collision is conditional**: it is the mean over the scenarios that did collide, and says nothing about the
others. A technique with few but early collisions looks good in it. The columns to its left do not have this flaw.
"""


def _responsibility(results: Results) -> str:
    rows = []
    for name in results.plan.names:
        total = of(name, results.whole).sum(numeric_only=True)
        hits, counts = total.unique_collisions, (total.unique_collisions, total.by_ego, total.by_npc)
        shares = _share(total.by_npc, hits), _share(total.by_position_npc, hits), _share(total.invalid, total["unique"])
        rows.append([name, *(f"{count:.0f}" for count in counts), *shares])
    header = [
        "", "unique collisions", "the ego is responsible for", "an NPC alone", "share of NPCs", "the same by position",
        "scenarios in which NPCs crash",
    ]  # fmt: skip
    return f"""
## Who caused them

The paper does not report this: which of the raw collisions NPCs have caused. Responsibility is by RSS, and by the
position rule of the authors' released code.

{markdown_table(header, rows)}
"""


def _distinct(results: Results) -> str:
    rows = []
    faults = results.frame[results.frame["outcome"].isin(FAULTS)]
    for name in results.plan.names:
        whole, equal = of(name, results.whole), of(name, results.equal)
        median = survival(*first_failures(equal)).median
        distance = equal["inverted_distance"].median()
        means = [runs[column].mean() for runs in (whole, equal) for column in ("distinct", "distinct_per_hour")]
        rows.append(
            [
                name,
                *(f"{distinct_in_all(frame, name)}" for frame in (results.frame, faults)),
                *(f"{mean:.2f}" for mean in means),
                f"{(equal['distinct'] > 0).sum()} of {len(equal)}",
                f"{distance:.3f}" if math.isfinite(distance) else "no failure",
                "not reached" if math.isinf(median) else f"{median:.0f} s",
            ]
        )
    hours = f"{results.horizon / SECONDS_PER_HOUR:.2f} h"
    header = [
        "", "in all runs", "faults of the ADS among them", "mean of a run", "per simulated hour",
        f"mean of a run, {hours}", f"per hour, {hours}", f"runs with any, {hours}",
        f"inverted distance, {hours}", "median time to the first",
    ]  # fmt: skip
    return f"""
## Distinct failures for which the ego answers

Collisions that the ego is responsible for, alone or with the NPC, and faults of the ADS itself, by signature: many
collisions are few failures. The columns with {hours} are at equal simulated time, the shortest of all runs. The median
time to the first failure counts runs without one as censored (Kaplan-Meier).

The inverted distance measures how much of all failures a run has shown, rather than how many kinds. It is the coverage
inverted distance (Sorokin, Safin, Nejati 2024, arXiv:2410.11769), here of the impacts that count as failures, by the
NPC's cell, the ego's side and the closing speed in steps of 5 m/s: the mean, over all such impacts of all runs of this
report, of the distance to the nearest impact of the run, as a share of their range. The table has the median of the
runs. 0 means that a run has shown all of them.

{markdown_table(header, rows)}
"""


def _tests(results: Results) -> str:
    whole = results.whole if results.plan.generations else None
    found = comparisons(whole, results.equal, results.plan.names)
    if not found:
        return "## Statistics\n\nThere is only one algorithm, so nothing is compared."
    adjusted = holm([each.p for each in found])
    rows = [
        [
            *(each.measure, each.at, each.first, each.second),
            *("none" if math.isinf(value) else f"{value:.4g}" for value in each.values),
            "" if each.effect is None else f"{each.effect.a12:.2f} [{each.effect.low:.2f}, {each.effect.high:.2f}]",
            *(_p(each.p), _p(p), each.test),
        ]
        for each, p in zip(found, adjusted, strict=True)
    ]
    header = ["measure", "at equal", "", "", "median", "median", "A12 [95 %]", "p", "p, Holm", "test"]
    return f"""
## Statistics

Each run is one sample. A12 is the probability that the first algorithm's value is greater, counting ties as half
(Vargha-Delaney; 0.56, 0.64 and 0.71 are called a small, medium and large effect, and so are 0.44, 0.36 and 0.29), with
Newcombe's interval. All tests are two-sided; the last p is adjusted for all tests of this table. Equal seconds are the
first {results.horizon:.0f} simulated seconds of every run. Instead of medians, Fisher's test has counts of runs, and
the log-rank test Kaplan-Meier medians.

{markdown_table(header, rows)}
"""


def published(results: Results) -> dict[str, str]:
    """Return the texts of the files to publish, by their names: numbers as CSV, and the versions that gave them.

    An infinite number is ``inf``, such as the time to a failure that never came, and one that is not known is empty.
    """
    whole = results.whole if results.plan.generations else None
    found = comparisons(whole, results.equal, results.plan.names)
    columns = (
        "measure", "at_equal", "first", "second", "value_first", "value_second", "a12", "a12_low", "a12_high", "p",
        "p_holm", "test",
    )  # fmt: skip
    rows = [
        [
            *(each.measure, each.at, each.first, each.second, *each.values),
            *((None,) * 3 if each.effect is None else (each.effect.a12, each.effect.low, each.effect.high)),
            *(each.p, p, each.test),
        ]
        for each, p in zip(found, holm([each.p for each in found]), strict=True)
    ]
    return {
        "runs.csv": results.whole.to_csv(index=False, lineterminator="\n"),
        "statistics.csv": csv_text(columns, rows),
        "versions.txt": versions_text(("gymnasium", "pandas", "scipy")),
    }


def _peak(times: pd.Series[float], longest: float) -> str:
    """Return the ten-second interval in which most collisions happen; empty without collisions."""
    if times.empty:
        return ""
    last = max(math.ceil(longest / BIN_SECONDS) - 1, 0)
    start = int((times // BIN_SECONDS).clip(upper=last).mode().min()) * BIN_SECONDS
    return f"{start:g} to {start + BIN_SECONDS:g} s"


def _share(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f} %" if whole else ""


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 0.0001 else "< 0.0001"


def wall_seconds(plan: Plan, folder: Path) -> dict[str, float]:
    """Return the wall-clock time of all runs of each algorithm [s]; empty if the time of a run is not stored."""
    times = {name: [seconds_of(folder / file_name(name, run)) for run in range(plan.runs)] for name in plan.names}
    if any(seconds is None for each in times.values() for seconds in each):
        return {}
    return {name: sum(filter(None, each)) for name, each in times.items()}
