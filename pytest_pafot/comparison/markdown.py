"""The report of a comparison, as Markdown."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from pytest_pafot.comparison import run_measures, statistics
from pytest_pafot.comparison.paper import PAPER, PEAKS
from pytest_pafot.comparison.plan import Plan
from pytest_pafot.comparison.run_measures import SECONDS_PER_HOUR, Comparison, Measures
from pytest_pafot.versions import installed_versions

BIN_SECONDS = 10.0
"""Width of the intervals in which the paper tells when collisions happen [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """What a report is made of.

    Attributes:
        plan: of the comparison.
        command: that made it.
        frame: the rows.
        whole: measures of the runs to their ends.
        equal: the same up to the horizon.
        horizon: the simulated time that all runs have [s].
        longest: how long a scenario lasts that nothing ends early [s].
        wall_seconds: of all runs together, by the clock on the wall; None where unknown.
        figures: titles by file name, without ending.
    """

    plan: Plan
    command: Sequence[str]
    frame: pd.DataFrame
    whole: Sequence[Measures]
    equal: Sequence[Measures]
    horizon: float
    longest: float
    wall_seconds: float | None
    figures: dict[str, str]


def report(material: Material) -> str:
    """The whole text."""
    parts = [
        _head(material),
        _effectiveness(material),
        _efficiency(material),
        _responsibility(material),
        _distinct(material),
        _tests(material),
        _figures(material),
        _terms(material),
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _head(material: Material) -> str:
    plan = material.plan
    hours = sum(each.seconds for each in material.whole) / SECONDS_PER_HOUR
    wall = "" if material.wall_seconds is None else f", {_time(material.wall_seconds)} of computing"
    budget = f"{plan.generations} generations" if plan.generations else f"{plan.seconds:g} simulated seconds"
    hits = "all collisions" if plan.blame == "any" else "collisions that the ego is responsible for (`--blame ego`)"
    packages = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    return f"""
# {" against ".join(plan.names)} on {plan.ads}

```sh
{shlex.join(material.command)}
```

{plan.runs} runs of each algorithm, {budget} each, base seed {plan.seed}; {hours:.1f} h of simulated driving{wall}.
What counts as a failure in the search: {hits}; and faults of the ADS, which are exceptions and hangs. {packages}.

World: `{json.dumps(dict(plan.world))}`.
Scenarios: `{json.dumps(dict(plan.space))}`.
"""


def _effectiveness(material: Material) -> str:
    rows = []
    for name, runs in _by_algorithm(material):
        told = PAPER.get(name)
        scenarios, unique = sum(each.scenarios for each in runs), sum(each.unique for each in runs)
        hits, unique_hits = sum(each.collisions for each in runs), sum(each.unique_collisions for each in runs)
        per_run = [each.collisions for each in runs]
        rows.append(
            [
                name,
                *(f"{scenarios}", "" if told is None else f"{told.scenarios}"),
                *(f"{hits}", "" if told is None else f"{told.collisions}"),
                *(_share(hits, scenarios), f"{unique_hits} of {unique}", _share(unique_hits, unique)),
                "" if told is None else _share(told.collisions, told.scenarios),
                f"{np.mean(per_run):.0f} ({max(per_run)} / {min(per_run)})",
                "" if told is None else "{} ({} / {})".format(*told.per_run),
                f"{sum(each.local_searches for each in runs)}",
                "" if told is None else f"{told.local_searches}",
            ]
        )
    header = [
        "", "scenarios", "paper", "collisions", "paper", "share of all", "unique", "share of unique", "paper",
        "collisions per run (max / min)", "paper", "local searches", "paper",
    ]  # fmt: skip
    return f"""
## How many collisions

The paper's first table, with its numbers beside. A scenario that only repeats what an earlier one of the same search
showed is counted in *all* and not in *unique*; it is not simulated.

{_table(header, rows)}
"""


def _efficiency(material: Material) -> str:
    rows = []
    for name, runs in _by_algorithm(material):
        told = PAPER.get(name)
        seconds, unique = sum(each.seconds for each in runs), sum(each.unique for each in runs)
        hits = sum(each.unique_collisions for each in runs)
        times = _collision_times(material, name)
        rows.append(
            [
                name,
                *(f"{seconds / unique:.2f} s", "" if told is None else f"{told.seconds_per_scenario:.2f} s"),
                f"{seconds / hits:.2f} s" if hits else "no collision",
                "" if told is None else f"{told.hours * SECONDS_PER_HOUR / told.collisions:.2f} s",
                *(f"{seconds / SECONDS_PER_HOUR:.2f} h", "" if told is None else f"{told.hours:.2f} h"),
                f"{np.mean(times):.2f} s ({max(times):.0f} / {min(times):.0f})" if times else "none",
                "" if told is None else "{:.2f} s ({:g} / {:g})".format(*told.time_to_collision),
                _peak(times, material.longest),
                PEAKS.get(name, ""),
            ]
        )
    header = [
        "", "simulated per scenario", "paper", "simulated per collision", "paper", "in total", "paper",
        "time to collision (max / min)", "paper", "most collisions at", "paper",
    ]  # fmt: skip
    return f"""
## How fast

The paper's second table. Simulated time per scenario counts a safe scenario with its full length; per collision it is
all simulated time over all unique collisions.

{_table(header, rows)}

**The time to collision is conditional**: it is the mean over the scenarios that did collide, and says nothing of the
others. It rewards a technique that rarely collides, as long as it does so early. The columns before it do not.
"""


def _responsibility(material: Material) -> str:
    rows = []
    for name, runs in _by_algorithm(material):
        hits = sum(each.unique_collisions for each in runs)
        ego, npc = sum(each.by_ego for each in runs), sum(each.by_npc for each in runs)
        position = sum(each.by_position_npc for each in runs)
        invalid, unique = sum(each.invalid for each in runs), sum(each.unique for each in runs)
        shares = _share(npc, hits), _share(position, hits), _share(invalid, unique)
        rows.append([name, f"{hits}", f"{ego}", f"{npc}", *shares])
    header = [
        "", "unique collisions", "the ego is responsible for", "an NPC alone", "share of NPCs", "the same by position",
        "scenarios in which NPCs crash",
    ]  # fmt: skip
    return f"""
## Who caused them

What the paper does not tell: which of the raw collisions are the NPC's doing. By RSS, and by the position rule of the
authors' released code.

{_table(header, rows)}
"""


def _distinct(material: Material) -> str:
    rows = []
    for name, runs in _by_algorithm(material):
        equal = run_measures.of(name, material.equal)
        estimate = run_measures.survival_of(equal)
        found = sum(each.distinct > 0 for each in equal)
        rows.append(
            [
                name,
                f"{run_measures.distinct_in_all(material.frame, name)}",
                f"{run_measures.faults_in_all(material.frame, name)}",
                f"{np.mean([each.distinct for each in runs]):.2f}",
                f"{np.mean([each.distinct_per_hour for each in runs]):.2f}",
                f"{np.mean([each.distinct for each in equal]):.2f}",
                f"{np.mean([each.distinct_per_hour for each in equal]):.2f}",
                f"{found} of {len(equal)}",
                "not reached" if math.isinf(estimate.median) else f"{estimate.median:.0f} s",
            ]
        )
    hours = f"{material.horizon / SECONDS_PER_HOUR:.2f} h"
    header = [
        "", "in all runs", "faults of the ADS among them", "mean of a run", "per simulated hour",
        f"mean of a run, {hours}", f"per hour, {hours}", f"runs with any, {hours}", "median time to the first",
    ]  # fmt: skip
    return f"""
## Distinct failures for which the ego answers

Collisions that the ego is responsible for, alone or with the NPC, and faults of the ADS itself, by signature: many
collisions are few failures. The columns with {hours} are at equal simulated time, the shortest of all runs. The median
time to the first failure counts runs without one as censored (Kaplan-Meier).

{_table(header, rows)}
"""


def _tests(material: Material) -> str:
    found = run_measures.comparisons(material.whole, material.equal, material.plan.names)
    if not found:
        return "## Statistics\n\nOne algorithm alone, so that nothing is compared."
    adjusted = statistics.holm([each.p for each in found])
    rows = [_test_row(each, p) for each, p in zip(found, adjusted, strict=True)]
    header = ["measure", "at equal", "", "", "median", "median", "A12 [95 %]", "p", "p, Holm", "test"]
    return f"""
## Statistics

Each run is one sample. A12 is the probability that the first algorithm's value is the greater one, ties by half
(Vargha-Delaney; 0.56, 0.64 and 0.71 are called a small, medium and large effect, and so are 0.44, 0.36 and 0.29), with
Newcombe's interval. All tests are two-sided; the last p is adjusted for all tests of this table. Equal seconds are the
first {material.horizon:.0f} simulated seconds of every run. Counts of runs stand in the place of medians for Fisher's
test, Kaplan-Meier medians for the log-rank test.

{_table(header, rows)}
"""


def _test_row(each: Comparison, adjusted: float) -> list[str]:
    effect = "" if each.effect is None else f"{each.effect.a12:.2f} [{each.effect.low:.2f}, {each.effect.high:.2f}]"
    values = [_value(each.first_value), _value(each.second_value)]
    return [each.measure, each.at, each.first, each.second, *values, effect, _p(each.p), _p(adjusted), each.test]


def _figures(material: Material) -> str:
    images = [f"![{title}](figures/{name}.png)\n\n*{title}.*" for name, title in material.figures.items()]
    return "\n\n".join(["## Figures", *images])


def _terms(material: Material) -> str:
    return f"""
## How to read this

- The paper ran on CARLA against its traffic manager, four to six lanes, at a speed limit of 96 km/h; here the world is
  the one above. Its numbers are shown for orientation, and no test compares them.
- AV-Fuzzer's five slices last as long as all genes together, for a comparison over equal times; in its release they
  last 3 s. It simulates only scenarios that crossover or mutation touched, so that a generation of it is fewer
  scenarios than one of the others. That is why equal simulated seconds are shown beside equal generations.
- `results.csv` has a row for every scenario, `runs/` the same run by run.
- Equal arguments and versions give equal rows on any number of workers: {len(material.frame)} rows here.
"""


def _by_algorithm(material: Material) -> Iterable[tuple[str, list[Measures]]]:
    return [(name, run_measures.of(name, material.whole)) for name in material.plan.names]


def _collision_times(material: Material, algorithm: str) -> list[float]:
    frame = material.frame
    rows = frame[(frame["algorithm"] == algorithm) & ~frame["duplicate"]]
    return [float(time) for time in rows["collision_time"].dropna()]


def _peak(times: Sequence[float], longest: float) -> str:
    if not times:
        return ""
    last = max(math.ceil(longest / BIN_SECONDS) - 1, 0)
    counts = np.bincount([min(int(time // BIN_SECONDS), last) for time in times])
    start = int(counts.argmax()) * BIN_SECONDS
    return f"{start:g} to {start + BIN_SECONDS:g} s"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else ""


def _value(value: float) -> str:
    return "none" if math.isinf(value) else f"{value:.4g}"


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 0.0001 else "< 0.0001"


def _time(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds < SECONDS_PER_HOUR else f"{seconds / SECONDS_PER_HOUR:.1f} h"


def wall_seconds(folder: Path) -> float | None:
    """Of all runs in a folder; None where a run has none."""
    files = sorted((folder / "runs").glob("*.csv"))
    times = [path.with_suffix(".seconds") for path in files]
    return sum(float(path.read_text(encoding="utf-8")) for path in times) if all(map(Path.exists, times)) else None
