"""Does the search blame a careful driver at junctions? Random scenarios for ``example_ads.junctions``.

    python -m tests.benchmarks.junction_control [--places roundabout ...] [--runs 2000] [--seed 0] [--algorithm random]
        [--workers 1]

Every collision for which the ego is responsible would be a finding, and there should be none. Prints for each place how
its runs ended, in how many the ego came through the zones of all NPCs, and each collision for which the ego is
responsible, with its scenario.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import pytest_pafot as pafot
from example_ads import junctions
from pytest_pafot.campaign.events import Judged
from pytest_pafot.model.trace import ALONG
from pytest_pafot.searching import ALGORITHMS
from tests.benchmarks.command import in_processes, options
from tests.benchmarks.planted.junctions import PLACES
from tests.benchmarks.positive_controls import holds


@dataclass
class Control:
    """The counts of one search."""

    counts: Counter[str] = field(default_factory=Counter)
    at_fault: list[str] = field(default_factory=list)

    def see(self, event: Any) -> None:
        """Count the outcome of a run."""
        if not isinstance(event, Judged):
            return
        run, trace = event.run, event.run.trace
        ends = [zone.ego[1] for zone in trace.zones if zone is not None]
        ending = f"{trace.outcome}: {run.responsibility}" if run.responsibility else str(trace.outcome)
        came_through = bool(ends) and bool(trace.track[-1, 0, ALONG] > max(ends))
        self.counts.update({"runs": 1, ending: 1, "came through": came_through, "with zones": bool(ends)})
        if event.verdict.failed:
            self.at_fault.append(f"{trace.scenario.canonical()}\n{run.explain()}")


def controlled(name: str, seed: int, runs: int, algorithm: str) -> Control:
    """Search the careful driver at a place."""
    control = Control()
    pafot.explore(
        junctions.make, holds=holds, world=PLACES[name], blame="ego", algorithm=algorithm, runs=runs, seed=seed,
        shrink_rollouts=0, on_event=control.see,
    )  # fmt: skip
    return control


def main() -> None:
    given = options(__doc__, places=PLACES, runs=2000, seed=0, algorithm="random", workers=1)
    if given.algorithm not in ALGORITHMS:
        raise SystemExit(f"--algorithm: expected one of {', '.join(ALGORITHMS)}, received {given.algorithm}")
    for name, (control,) in in_processes(
        given.workers, controlled, given.places, [given.seed], given.runs, given.algorithm
    ):
        print(f"{name}: {dict(control.counts)}", flush=True)
        print(*control.at_fault, sep="\n", flush=True)


if __name__ == "__main__":
    main()
