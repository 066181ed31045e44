"""Is every known defect found? The policies of ``example_ads.defects``, searched with ``blame="ego"``.

    python -m tests.benchmarks.positive_controls [--seeds 10] [--first-seed 0] [--runs 400] [--workers 2]
        [--policies NAME ...] [--algorithm distinct] [--traffic hostile]
        [--instructions both]

The searches are those of ``pafot.explore``, with the defaults and without shrinking. Prints for each policy on how many
seeds there was a collision for which the ego is responsible, in which run first, how many distinct signatures there are
and which, and the explanation of the most frequent one with the mechanism that it should describe. ``healthy`` is
IDM+MOBIL without a defect.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pkgutil import resolve_name
from statistics import median
from types import MappingProxyType
from typing import Any

import pytest_pafot as pafot
from example_ads import defects
from pytest_pafot import Run, Scenario
from pytest_pafot.attribution.responsibility import Fault
from pytest_pafot.campaign.events import Judged
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.signature import Failure, Signature
from pytest_pafot.searching import ALGORITHMS
from tests.benchmarks import policies_with_defects, policies_with_defects_2
from tests.benchmarks.command import in_processes, options, seeds_of
from tests.benchmarks.planted import PLANTED

NOT_RUN_COLLISION = Failure(kind="AssertionError", assertion="assert not run.collision")

MECHANISM: Mapping[str, str] = MappingProxyType(
    {
        "healthy": "none",
        "follows-too-close": "front: no longer able to stop behind a leader that brakes",
        "brakes-late-above-20": "front: no response to a leader",
        "brakes-weakly": "front: response too weak",
        "blind-beside-front-wheel": "side: moves into a vehicle beside it; front: no response to its cut-in",
        "sees-old-speeds": "front: response too late; rear or side: enters a lane before somebody fast",
        "sees-cut-ins-late": "front: no response to a cut-in",
        "ignores-standing-vehicles": "front: speeds up into a slow or standing leader",
        "forgets-after-lane-change": "front: no response to a leader after the own lane change",
        "looks-only-ahead": "side or rear: enters a lane in which somebody follows",
        "changes-lanes-unchecked": "side or rear: enters a lane that is taken",
        "trusts-any-gap-behind": "rear: enters a lane just ahead of somebody faster",
        "brakes-for-ghosts": "rear: brakes hard with nothing ahead",
        "stops-in-its-lane": "rear: stops with nothing ahead",
        "two-defects": "two kinds: no answer to a slow leader; enters a lane in which somebody follows",
    }
)
"""The mechanisms that the explanations should describe."""

FAULTS: Mapping[str, frozenset[Fault]] = MappingProxyType(
    {
        "follows-too-close": frozenset({"leader-unanswered", "cut-in-unanswered"}),
        "brakes-late-above-20": frozenset({"leader-unanswered", "cut-in-unanswered"}),
        "brakes-weakly": frozenset({"leader-unanswered", "cut-in-unanswered"}),
        "blind-beside-front-wheel": frozenset({"entered-lane", "cut-in-unanswered"}),
        "sees-old-speeds": frozenset({"leader-unanswered", "cut-in-unanswered", "entered-lane"}),
        "sees-cut-ins-late": frozenset({"cut-in-unanswered"}),
        "ignores-standing-vehicles": frozenset({"leader-unanswered"}),
        "forgets-after-lane-change": frozenset({"leader-unanswered", "cut-in-unanswered"}),
        "looks-only-ahead": frozenset({"entered-lane"}),
        "changes-lanes-unchecked": frozenset({"entered-lane"}),
        "trusts-any-gap-behind": frozenset({"entered-lane"}),
        "brakes-for-ghosts": frozenset({"braked-for-nothing"}),
        "stops-in-its-lane": frozenset({"stopped-for-nothing"}),
        "two-defects": frozenset({"leader-unanswered", "entered-lane"}),
    }
)
"""The kinds of failure that each mechanism causes."""


@dataclass(frozen=True, kw_only=True)
class Find:
    """A colliding run for which the ego is responsible; ``number`` counts the runs of its search from 1."""

    number: int
    scenario: Scenario
    signature: Signature
    explanation: str


@dataclass(frozen=True)
class Searched:
    """The failing runs of a search, and its number of runs."""

    finds: tuple[Find, ...]
    runs: int


def factory_of(policy: str) -> Any:
    """Return the ADS of a known or planted defect, one of the policies with defects, or the object at ``module:name``.

    All names differ: those of example_ads.defects, PLANTED and the two modules of policies with defects.
    """
    if ":" in policy:
        return resolve_name(policy)
    if policy in PLANTED:
        return PLANTED[policy].make()
    made = next((each for each in (policies_with_defects, policies_with_defects_2) if policy in each.POLICIES), defects)
    return made.make(policy)


def holds(run: Run) -> None:
    assert not run.collision


def searched(policy: str, seed: int, options: argparse.Namespace) -> Searched:
    """Run a search from start to end."""
    finds: list[Find] = []
    runs = 0

    def listen(event: object) -> None:
        nonlocal runs
        if not isinstance(event, Judged):
            return
        runs += 1
        if event.verdict.failure is not None:
            signature, explanation = of_failure(event.run, event.verdict.failure), event.run.explain()
            scenario = event.run.scenario
            finds.append(Find(number=runs, scenario=scenario, signature=signature, explanation=explanation))

    pafot.explore(
        factory_of(policy), holds=holds, world=pafot.Highway(), blame="ego", runs=options.runs, seed=seed,
        shrink_rollouts=0, on_event=listen, algorithm=options.algorithm, traffic=options.traffic,
        instructions=options.instructions,
    )  # fmt: skip
    return Searched(tuple(finds), runs)


def report(policy: str, searches: Sequence[Searched]) -> str:
    """Return what the searches of a policy found."""
    firsts = [search.finds[0].number if search.finds else None for search in searches]
    named = [
        next((find.number for find in search.finds if find.signature.fault in FAULTS.get(policy, ())), None)
        for search in searches
    ]
    finds = [find for search in searches for find in search.finds]
    kinds = Counter(find.signature for find in finds)
    per_seed = [len({find.signature for find in search.finds}) for search in searches]
    lines = [
        f"{policy}: found on {sum(first is not None for first in firsts)} of {len(searches)} seeds, first in runs "
        f"{numbers(firsts)}; as the mechanism shows on {sum(number is not None for number in named)}, first in runs "
        f"{numbers(named)}; {len(finds)} finds in "
        f"{sum(search.runs for search in searches)} runs; signatures per seed {per_seed}, {len(kinds)} in all",
        *(f"    {count:4} x {signature.mistake or signature.slug}" for signature, count in kinds.most_common()),
    ]
    if kinds:
        usual = kinds.most_common(1)[0][0]
        explanation = next(find.explanation for find in finds if find.signature == usual)
        lines += [f"    expected: {MECHANISM[policy]}", *(f"    said: {line}" for line in _sentence(explanation))]
    return "\n".join(lines)


def numbers(firsts: Sequence[int | None]) -> str:
    """Return the runs in which something first happened, by seed."""
    return " ".join("-" if first is None else str(first) for first in firsts)


def _sentence(explanation: str) -> list[str]:
    """Return the lines of an explanation that say what happened and who is responsible."""
    lines = explanation.splitlines()
    end = next(number for number, line in enumerate(lines) if line.startswith("  from [s]"))
    return [line.strip() for line in (lines[0], *lines[3:end])]


def main() -> None:
    given = options(
        __doc__, seeds=10, first_seed=0, algorithm=ALGORITHMS[0], runs=400, workers=2, policies=defects.POLICIES,
        traffic="hostile", instructions="both",
    )  # fmt: skip
    every: list[Searched] = []
    for name, searches in in_processes(given.workers, searched, given.policies, seeds_of(given), given):
        print(report(name, searches), flush=True)
        every += searches
    firsts = [search.finds[0].number if search.finds else math.inf for search in every]
    print(f"found on {sum(map(math.isfinite, firsts))} of {len(every)} seeds, in the median in run {median(firsts):g}")


if __name__ == "__main__":
    main()
