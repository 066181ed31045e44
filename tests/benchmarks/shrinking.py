"""How small do findings become? Sizes before and after shrinking, by the kind of the NPCs' instructions.

    python -m tests.benchmarks.shrinking [--runs 400] [--seeds 1] [--first-seed 0] [--workers 2]
        [--policies NAME ...] [--instructions both] [--each 0] [--save FILE] [--load FILE]
        [--brute-force 5000]

Each policy with a defect is searched as in ``positive_controls``, once for each of ``--instructions``, such as
``cells lanes both``. The first scenario of each kind of failure, or of at most ``--each`` kinds of failure a search, is
shrunk with the default budget and the preferences of a session, and the result is run once more to see that it fails in
the same way. Prints a row for each finding, in Markdown, and the medians and means by kind of instructions. A policy
may also be a planted one, one of ``policies_with_defects``, or a ``module:name`` of a factory or a vehicle class.

``--save`` appends the findings as found to a file of JSON lines, and shrinks nothing; ``--load`` shrinks those of a
file, so that two versions of the shrinker can be compared with the same findings.

``--brute-force`` samples this many simpler scenarios for each finding, of one or two NPCs with one to three
instructions and round speeds, to see whether one of them fails in the same way: what shrinking has missed.
"""

from __future__ import annotations

import argparse
import json
import random
import statistics
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice, product
from pathlib import Path

from example_ads import defects
from pytest_pafot import Highway, Run, Scenario
from pytest_pafot.campaign.refine.runs import driven
from pytest_pafot.campaign.refine.simplest import ROLLOUTS, ROLLOUTS_IN_KERNEL, starts_of
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.shrink import Shrunk, Start, size_of, sort_key
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions import SHIFTS, LaneInstruction, PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import EGO_LANE, EGO_SPEED, GENE_SECONDS, Chromosome
from tests.benchmarks.command import as_they_end, options, print_head, seeds_of
from tests.benchmarks.positive_controls import NOT_RUN_COLLISION, factory_of, searched
from tests.helpers.shrinking import shrink

ROUND_SPEEDS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
SIZES = ("NPCs", "instructions", "moves", "NPCs in lanes", "genes", "genes of all NPCs")
"""What the first fields of a sort key count."""


@dataclass(frozen=True)
class Found:
    """A failing scenario as found, in a search for scenarios with one kind of instructions."""

    kind: str
    policy: str
    seed: int
    scenario: Scenario


@dataclass(frozen=True)
class Row:
    """The sizes of one finding."""

    found: Found
    signature: Signature
    simplest: Scenario
    shrunk: Shrunk
    missed: Scenario | None

    def __str__(self) -> str:
        minimal = "yes" if self.shrunk.is_minimal else "no"
        chains = repr(self.simplest).partition(": ")[2].rstrip(">")
        chains += f", missed: {self.missed!r}" if self.missed else ""
        return (
            f"| {self.found.kind} | {self.found.policy} | {self.signature.slug} | {size_of(self.found.scenario)} "
            f"| {size_of(self.simplest)} | {self.shrunk.rollouts} | {minimal} | `{chains}` |"
        )


def found_in(policy: str, seed: int, kind: str, options: argparse.Namespace) -> list[Found]:
    """Return the first scenario of each kind of failure that a search finds."""
    firsts: dict[Signature, Scenario] = {}
    for find in searched(policy, seed, argparse.Namespace(**{**vars(options), "instructions": kind})).finds:
        firsts.setdefault(find.signature, find.scenario)
    return [Found(kind, policy, seed, each) for each in islice(firsts.values(), options.each or None)]


def row_of(found: Found, brute_force: int) -> Row:
    """Return a finding, shrunk."""
    world, starts = Highway(), dict[Scenario, tuple[Start, ...]]()

    def signature_of(scenario: Scenario) -> tuple[Run, Signature | None]:
        run = Run(world.rollout(scenario, factory_of(found.policy)))
        return run, of_failure(run, NOT_RUN_COLLISION) if run.attribution.blames_ego else None

    def attempt(candidate: Scenario) -> Scenario | None:
        try:
            run, observed = signature_of(candidate)
        except ScenarioError:  # It does not fit the road.
            return None
        if observed is None or (observed, observed.fault) != (signature, signature.fault):
            return None
        starts[driven(run)] = starts_of(run, world.speed_limit)
        return driven(run)

    signature = signature_of(found.scenario)[1]
    assert signature is not None
    simplest, shrunk = shrink(
        found.scenario,
        attempt,
        rollouts=ROLLOUTS_IN_KERNEL if world.runs_in_kernel(factory_of(found.policy)) else ROLLOUTS,
        top_speed=world.speed_limit,
        starts=lambda scenario: starts.get(scenario, ()),
        plain=(EGO_LANE, EGO_SPEED),
        plain_seconds=GENE_SECONDS,
    )
    assert signature_of(simplest)[1] == signature
    tried = islice(simpler_at_random(found.scenario, simplest, found.seed), brute_force)
    missed = next((each for each in tried if signature_of(each)[1] == signature), None)
    return Row(found, signature, simplest, shrunk, missed)


def simpler_at_random(found: Scenario, simplest: Scenario, seed: int) -> Iterator[Scenario]:
    """Yield random scenarios that are simpler than ``found``, from its start or that of ``simplest``, up to a limit."""
    rng, seen = random.Random(seed), set()
    kinds = list(dict.fromkeys(type(npc[0]) for npc in found.npcs))
    for _ in range(40_000):
        total = rng.choice((1, 2, 3))
        counts = (total,) if total == 1 or rng.random() < 0.5 else (total - 1, 1)
        begin = rng.choice((found, simplest))
        with suppress(ScenarioError):
            npcs = tuple(_chain(count, LaneInstruction in kinds and rng.choice(kinds), rng) for count in counts)
            drawn = replace(begin, npcs=npcs, seed=0)
            if drawn not in seen and sort_key(drawn) < sort_key(simplest):
                seen.add(drawn)
                yield drawn


def _chain(count: int, kind: object, rng: random.Random) -> Chromosome:
    if kind is LaneInstruction:
        return tuple(LaneInstruction(rng.choice(SHIFTS), rng.choice(ROUND_SPEEDS)) for _ in range(count))
    cell, chain = rng.randrange(8), []
    for _ in range(count):
        chain += [PositionInstruction(Cell(cell % 8 + 1), rng.choice(ROUND_SPEEDS))] * rng.choice((1, 1, 1, 2))
        cell += rng.choice((-1, 0, 1))
    return tuple(chain)


def summary(kind: str, rows: Sequence[Row]) -> str:
    """Return the medians and means of the findings of one kind."""
    before, after = ([sort_key(each) for each in scenarios] for scenarios in zip(*map(_both, rows), strict=True))
    sizes = [
        f"{name} {_average(old)} as found, {_average(new)} shrunk (most {max(new)})"
        for name, old, new in zip(SIZES, zip(*before, strict=True), zip(*after, strict=True), strict=False)
    ]
    spent, minimal = [row.shrunk.rollouts for row in rows], sum(row.shrunk.is_minimal for row in rows)
    return f"{kind}, {len(rows)} findings: {'; '.join(sizes)}; runs {_average(spent)}; {minimal} minimal"


def _both(row: Row) -> tuple[Scenario, Scenario]:
    return row.found.scenario, row.simplest


def _average(counts: Sequence[int]) -> str:
    return f"{statistics.median(counts):g} (mean {statistics.mean(counts):.2f})"


def main() -> None:
    flawed = [name for name in defects.POLICIES if name != "healthy"]
    given = options(
        __doc__, runs=400, seeds=1, first_seed=0, workers=2, policies=flawed, instructions=["both"],
        each=0, save="", load="", brute_force=0, algorithm="distinct", traffic="hostile",
    )  # fmt: skip
    if given.load:
        lines = map(json.loads, Path(given.load).read_text(encoding="utf-8").splitlines())
        found = [Found(*names, Scenario.from_canonical(plain)) for *names, plain in lines]
    else:
        searches = ((*names, given) for names in product(given.policies, seeds_of(given), given.instructions))
        found = sorted(chain.from_iterable(as_they_end(given.workers, found_in, searches)), key=_order)
    if given.save:
        with Path(given.save).open("a", encoding="utf-8") as file:
            for each in found:
                print(json.dumps([each.kind, each.policy, each.seed, each.scenario.plain()]), file=file)
        return
    rows: dict[str, list[Row]] = {}
    print_head("instructions", "policy", "failure", "as found", "shrunk", "runs", "minimal", "scenario")
    for row in as_they_end(given.workers, row_of, ((each, given.brute_force) for each in found)):
        rows.setdefault(row.found.kind, []).append(row)
        print(row, flush=True)
    print()
    for kind, of_kind in sorted(rows.items()):
        print(summary(kind, of_kind))
        if given.brute_force:
            print(f"brute force finds a simpler one of {sum(row.missed is not None for row in of_kind)}")


def _order(found: Found) -> tuple[str, str, int, str]:
    return found.kind, found.policy, found.seed, found.scenario.canonical()


if __name__ == "__main__":
    main()
