"""How soon does the default search find a planted defect at junctions? Twelve drivers with one defect each.

    python -m tests.benchmarks.planted_junctions [--policies NAME ...] [--seeds 10] [--first-seed 0] [--runs 400]
        [--workers 1] [--save FILE] [--twins]

Each driver of ``tests.benchmarks.planted.junctions`` has a twin, which is the same without the defect. A search with
``blame="ego"`` ends at the first failure in whose scenario the twin does not fail by its own fault; failures that the
twin shares are counted, and the search continues. ``--save`` appends each search to a file of JSON lines, and leaves
out those that are already in it. ``--twins`` searches the twins instead, in which nothing should be found.

Prints a line for each defect: on how many seeds it was found, and in which run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from tests.benchmarks.command import as_they_end, options, print_head, seeds_of
from tests.benchmarks.planted.junctions import PLACES, PLANTED, WHERE
from tests.benchmarks.planted_defects import DEFAULT, Searched, loaded, saved, searched


def stands() -> Callable[[Any], tuple[float, float]]:
    """Return a driver that brakes to a standstill, far before any junction."""
    return lambda seen: (-2.0, 0.0)


LONGEST = 3600.0
"""The time limit of a search, which ends by its runs before [s]."""


def search(name: str, seed: int, runs: int, twins: bool) -> Searched:
    """Search a driver, or its twin, which is compared with a driver that shares no failures."""
    planted, shown = PLANTED[name], name
    if twins:
        planted, shown = replace(planted, make=planted.twin, twin=lambda: stands), f"{name}, repaired"
    return searched(shown, DEFAULT, seed, runs, LONGEST, planted, PLACES[WHERE[name]])


def row(name: str, shown: str, group: list[Searched]) -> str:
    """Return the row of a driver."""
    found = sorted(each.runs for each in group if each.found)
    middle = f"{found[len(found) // 2]} ({found[0]} to {found[-1]})" if found else "-"
    what = PLANTED[name].about if shown == name else "nothing is wrong with it"
    cells = [shown, WHERE[name], what, f"{len(found)} of {len(group)}", middle, str(sum(each.shared for each in group))]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    given = options(__doc__, policies=PLANTED, seeds=10, first_seed=0, runs=400, workers=1, save="", twins=False)
    shown = {name: f"{name}, repaired" if given.twins else name for name in given.policies}
    done = loaded([given.save]) if given.save and Path(given.save).exists() else []
    known = {(each.policy, each.seed) for each in done}
    tasks = [
        (name, seed, given.runs, given.twins)
        for seed, name in product(seeds_of(given), given.policies)
        if (shown[name], seed) not in known
    ]
    new = as_they_end(given.workers, search, tasks)
    done += saved(new, given.save) if given.save else new
    print_head(
        "driver", "where", "what is wrong", "found", "in the run (median, least to most)", "failures of its twin, too"
    )
    for name, title in shown.items():
        print(row(name, title, [each for each in done if each.policy == title]), flush=True)


if __name__ == "__main__":
    main()
