"""Is each defect one finding, and each finding one defect?

    python -m tests.benchmarks.distinctness [--seeds 10] [--first-seed 0] [--runs 400] [--workers 2]
        [--policies NAME ...]

Searches policies whose defects are known, and decides for each failing run which defect is to blame: the one whose
repair, without any other, makes the scenario pass. The policies are those of ``policies_with_defects_2``, which had no
influence on the rules that separate findings.

Prints for each policy the findings of each search, in how many searches each defect has its own finding, and in how
many there is no other; the V-measure of its failing runs (Rosenberg and Hirschberg 2007; classes: defects, clusters:
findings, each run in the one that it counts for; without runs that no single repair, or more than one, makes pass),
mean of the searches; and the names of each defect's findings: the confusion matrix.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Any

import pytest_pafot as pafot
from pytest_pafot import Run, Scenario
from pytest_pafot.campaign.events import Judged
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.signature import Failure, Signature
from tests.benchmarks import policies_with_defects_2
from tests.benchmarks.command import holds, in_processes, options, print_head, seeds_of

NOT_RUN_COLLISION = Failure(kind="AssertionError", assertion="assert not run.collision")

Label = frozenset[str]
"""Defects, each of whose repairs makes a scenario pass."""


@dataclass(frozen=True)
class Subject:
    """A policy, its defects, and a factory of the policy with some of them repaired."""

    name: str
    defects: tuple[str, ...]
    make: Callable[[Sequence[str]], Any]

    def label(self, scenario: Scenario) -> Label:
        """Return the defects that are to blame for a failing scenario."""
        return frozenset(each for each in self.defects if not self._fails(scenario, (each,)))

    def signature(self, scenario: Scenario) -> Signature:
        """Return the signature of the run of the policy with all its defects."""
        return of_failure(self._run(scenario, ()), NOT_RUN_COLLISION)

    def _fails(self, scenario: Scenario, repaired: Sequence[str]) -> bool:
        return self._run(scenario, repaired).responsibility in ("ego", "both")

    def _run(self, scenario: Scenario, repaired: Sequence[str]) -> Run:
        return Run(pafot.Highway().rollout(scenario, self.make(repaired)))


@dataclass(frozen=True)
class Searched:
    """One search: the signature and label of each finding and of each failing run."""

    findings: list[tuple[Signature, Label]]
    runs: list[tuple[Signature, Label]]


SUBJECTS = {
    name: Subject(name, found, partial(policies_with_defects_2.make, name))
    for name, (_, found) in policies_with_defects_2.POLICIES.items()
}


def searched(name: str, seed: int, options: argparse.Namespace) -> Searched:
    """Run a search and label its findings and failing runs."""
    subject = SUBJECTS[name]
    failing = {}

    def listen(event: object) -> None:
        if isinstance(event, Judged) and event.verdict.failure is not None:
            failing[event.run.scenario] = of_failure(event.run, event.verdict.failure)

    found = pafot.explore(
        subject.make(()),
        holds=holds,
        blame="ego",
        runs=options.runs,
        seed=seed,
        on_event=listen,
    )
    return Searched(
        findings=[(subject.signature(each.scenario), subject.label(each.scenario)) for each in found.findings],
        runs=[(signature, subject.label(scenario)) for scenario, signature in failing.items()],
    )


def v_measure(classes: Sequence[Hashable], clusters: Sequence[Hashable]) -> float:
    """Return the harmonic mean of homogeneity and completeness, 0 to 1; 1 if everything is correctly one group."""

    def entropy(labels: Iterable[Hashable]) -> float:
        counts = Counter(labels)
        return -sum(count / counts.total() * math.log(count / counts.total()) for count in counts.values())

    of_classes, of_clusters = entropy(classes), entropy(clusters)
    shared = of_classes + of_clusters - entropy(zip(classes, clusters, strict=True))
    homogeneity = shared / of_classes if of_classes else 1.0
    completeness = shared / of_clusters if of_clusters else 1.0
    return 2 * homogeneity * completeness / (homogeneity + completeness) if homogeneity + completeness else 0.0


def agreement(search: Searched) -> float | None:
    """Return the V-measure of a search, or None if no run has exactly one defect to blame."""
    told = [(label, signature) for signature, label in search.runs if len(label) == 1]
    return v_measure(*zip(*told, strict=True)) if told else None


def row(subject: Subject, searches: Sequence[Searched]) -> str:
    """Return the row of a policy."""
    counts = [len(search.findings) for search in searches]
    complete = [has_each(subject.defects, [label for _, label in search.findings]) for search in searches]
    exact = sum(each and count == len(subject.defects) for each, count in zip(complete, counts, strict=True))
    values = [value for value in map(agreement, searches) if value is not None]
    return (
        f"| {subject.name} | {len(subject.defects)} | {statistics.mean(counts):.2f} | {' '.join(map(str, counts))} "
        f"| {sum(complete)} | {exact} | {statistics.mean(values) if values else math.nan:.2f} |"
    )


def confused(searches: Sequence[Searched]) -> str:
    """Return how often findings of each kind are due to each defect."""
    found = ((signature, " or ".join(sorted(label))) for search in searches for signature, label in search.findings)
    called = Counter(f"{label or 'no single defect'}: {told(signature)}" for signature, label in found)
    return "\n".join(f"    {count:3} x {name}" for name, count in sorted(called.items()))


def has_each(wanted: Sequence[str], labels: Sequence[Label]) -> bool:
    """Return whether each defect has its own finding."""
    chosen = permutations(labels, len(wanted))
    return any(all(name in label for name, label in zip(wanted, each, strict=True)) for each in chosen)


def told(signature: Signature) -> str:
    """Return the part of a signature that a user sees."""
    return signature.mistake or signature.slug


def main() -> None:
    given = options(__doc__, seeds=10, first_seed=0, runs=400, workers=2, policies=SUBJECTS)
    print_head("policy", "defects", "findings", "by seed", "every defect found", "one finding each", "V-measure")
    done: dict[int, list[Searched]] = {}
    matrix = ""
    chosen = [name for name in SUBJECTS if name in given.policies]
    for name, searches in in_processes(given.workers, searched, chosen, seeds_of(given), given):
        done.setdefault(len(SUBJECTS[name].defects), []).extend(searches)
        print(row(SUBJECTS[name], searches), flush=True)
        matrix += f"{name}\n{confused(searches)}\n"
    print(matrix, end="")
    for number, searches in sorted(done.items()):
        values = [value for value in map(agreement, searches) if value is not None]
        print(
            f"{number} defects: {statistics.mean(len(each.findings) for each in searches):.2f} findings a search, "
            f"V-measure {statistics.mean(values) if values else math.nan:.2f}"
        )


if __name__ == "__main__":
    main()
