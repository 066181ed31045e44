"""The report of a comparison, in Markdown."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence

from pytest_pafot.comparison.plan import DIFFERENT
from pytest_pafot.comparison.run_measures import (
    FAULTS,
    Comparison,
    Results,
    first_failures,
    rows_of,
    survival,
)
from pytest_pafot.support.process import installed_versions
from pytest_pafot.support.text import markdown_table
from pytest_pafot.world.codec import described

# The collisions that count as failures, by the blame of the comparison.
HITS = {
    "any": "all collisions",
    "ego": "collisions for which the ego is responsible (`--blame ego`)",
}

HOW_TO_READ = """
## How to read this

- `NAME@15` is the algorithm NAME with runs of 15 s, which are divided evenly among its genes. With `av-fuzzer@15`, a
  slice lasts 3 s, as in the released code. Without `@15`, its five slices together last as long as all genes of the
  other algorithms. The reimplementation of the paper does the same, with runs of 60 s.
- Without an `@`, an algorithm has the same scenarios as in a test. `NAME@paper` has the paper's scenarios, four per
  generation.
- `results.csv` has a row for every scenario, `runs.csv` has the measures of every run, and `statistics.csv` has the
  tests with exact numbers.
- The same arguments and versions give the same rows, for any number of workers.
"""


def report(
    results: Results,
    tests: Sequence[Comparison],
    command: Sequence[str],
    figures: Mapping[str, str],
) -> str:
    """Return the report.

    ``command`` is the command that creates it, and ``figures`` maps file names to titles.
    """
    parts = [
        _head(results, command),
        _distinct(results),
        _collisions(results),
        _statistics(tests),
        "## Figures",
        *(f"![{title}](figures/{name}.png)\n\n*{title}.*" for name, title in figures.items()),
        HOW_TO_READ,
    ]
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _head(results: Results, command: Sequence[str]) -> str:
    plan = results.plan
    packages = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    groups = "\n".join(
        f"- {', '.join(names)}: {scenarios}" for scenarios, names in plan.scenarios.items()
    )
    warning = ""
    if len(plan.scenarios) > 1:
        warning = f"\n**Warning:** {DIFFERENT}.\n"
    return f"""
# {" against ".join(plan.names)} on {plan.ads}

```sh
{shlex.join(command)}
```

Each algorithm has {plan.runs} runs of {plan.seconds:g} simulated seconds. The base seed is {plan.seed}. All numbers are
for the same simulated time: only scenarios that end in the first {results.horizon:.0f} s count, because the shortest
run is that long. The search counts as failures {HITS[plan.blame]}, and exceptions and hangs of the ADS.
{packages}.

World: `{json.dumps(described(plan.made_world()))}`.
{warning}
Scenarios:

{groups}
"""


def _distinct(results: Results) -> str:
    failures = results.frame[results.frame["is_ego_failure"]]
    rows = []
    for name in results.plan.names:
        runs = rows_of(name, results.runs)
        own = rows_of(name, failures)
        faults = own[own["outcome"].isin(FAULTS)]
        median = survival(*first_failures(runs, results.horizon)).median
        rows.append(
            [
                name,
                own["signature"].nunique(),
                faults["signature"].nunique(),
                f"{runs['distinct'].mean():.2f}",
                f"{(runs['distinct'] > 0).sum()} of {len(runs)}",
                "not reached" if math.isinf(median) else f"{median:.0f} s",
            ]
        )
    # The program that updates the figures in docs/comparisons finds columns by these headers.
    header = [
        "", "in all runs", "faults of the ADS among them", "mean of a run", "runs with any", "median time to the first",
    ]  # fmt: skip
    return f"""
## Distinct failures for which the ego is responsible

These are collisions for which the ego is responsible, alone or with the NPC, and ADS errors. Failures with the same
signature count once. For the median time to the first failure, runs without one are censored (Kaplan-Meier).

{markdown_table(header, rows)}
"""


def _collisions(results: Results) -> str:
    rows = []
    for name in results.plan.names:
        runs = rows_of(name, results.runs)
        total = runs.sum(numeric_only=True)
        time = "no collision"
        if total.collisions:
            time = f"{len(runs) * results.horizon / total.collisions:.2f} s"
        rows.append(
            [
                name,
                f"{total.collisions:.0f} of {total.scenarios:.0f}",
                _share(total.collisions, total.scenarios),
                time,
                f"{total.by_ego:.0f}",
                f"{total.by_npc:.0f}",
                _share(total.by_npc, total.collisions),
            ]
        )
    header = [
        "", "unique", "share of unique", "simulated per collision", "the ego is responsible for", "an NPC alone",
        "share of NPCs",
    ]  # fmt: skip
    return f"""
## All collisions

A scenario that repeats an earlier one of the same search is not simulated, nor is it *unique*. The simulated time per
collision is the total simulated time divided by the number of unique collisions. Responsibility is determined by RSS.

{markdown_table(header, rows)}
"""


def _statistics(tests: Sequence[Comparison]) -> str:
    if not tests:
        return "## Statistics\n\nThere is only one algorithm, so there is no comparison."
    rows = []
    for each in tests:
        effect = ""
        if each.a12 is not None:
            effect = f"{each.a12:.2f} [{each.a12_low:.2f}, {each.a12_high:.2f}]"
        rows.append(
            [
                each.measure,
                each.first,
                each.second,
                _median(each.value_first),
                _median(each.value_second),
                effect,
                _p(each.p),
                _p(each.p_holm),
                each.test,
            ]
        )
    header = ["measure", "", "", "median", "median", "A12 [95 %]", "p", "p, Holm", "test"]
    return f"""
## Statistics

Each run is one sample. A12 is the probability that the value of the first algorithm is greater, where ties count half
(Vargha-Delaney, with Newcombe's interval). Values of 0.56, 0.64 and 0.71 are called small, medium and large effects,
as are 0.44, 0.36 and 0.29. All tests are two-sided. The last p is adjusted for all tests of this table. Fisher's test
shows counts of runs instead of medians, and the log-rank test shows Kaplan-Meier medians.

{markdown_table(header, rows)}
"""


def _share(part: float, whole: float) -> str:
    if not whole:
        return ""
    return f"{100 * part / whole:.1f} %"


def _median(value: float) -> str:
    return "none" if math.isinf(value) else f"{value:.4g}"


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= 0.0001 else "< 0.0001"
