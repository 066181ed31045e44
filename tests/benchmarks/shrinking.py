"""How small do findings become? Sizes before and after shrinking, over the positive controls.

    python -m tests.benchmarks.shrinking [--runs 400] [--seeds 1] [--first-seed 0] [--workers 2]
        [--policies NAME ...] [--brute-force 5000]

Each policy with a defect is searched as in ``positive_controls``. The first scenario of each kind of failure is shrunk
with the default budget, and the result is run once more to see that it fails in the same way. Prints a row for each
finding, in Markdown, and the medians. A policy may also be a ``module:name`` of a factory or a vehicle class.
``--brute-force`` samples this many simpler scenarios for each finding, of one or two NPCs with one to three
instructions and round speeds, to see whether one of them fails in the same way: what shrinking has missed.
"""

from __future__ import annotations

import argparse
import random
import statistics
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain, islice

from example_ads import defects
from pytest_pafot import Highway, Run, Scenario
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.campaign.simplification import ROLLOUTS, ROLLOUTS_IN_KERNEL, driven, starts_of
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.shrink import Shrunk, Start, instructions, shrink, size_of, sort_key
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import PositionInstruction, ScenarioError
from tests.benchmarks.command import in_processes, options, print_head, seeds_of
from tests.benchmarks.positive_controls import NOT_RUN_COLLISION, factory_of, searched

ROUND_SPEEDS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)


@dataclass(frozen=True)
class Row:
    """The sizes of one finding."""

    policy: str
    signature: Signature
    found: Scenario
    simplest: Scenario
    shrunk: Shrunk
    missed: Scenario | None

    def __str__(self) -> str:
        minimal = "yes" if self.shrunk.is_minimal else "no"
        chains = repr(self.simplest).partition(": ")[2].rstrip(">")
        chains += f", missed: {self.missed!r}" if self.missed else ""
        return (
            f"| {self.policy} | {self.signature.slug} | {size_of(self.found)} | {size_of(self.simplest)} "
            f"| {self.shrunk.rollouts} | {minimal} | `{chains}` |"
        )


def rows(policy: str, seed: int, options: argparse.Namespace) -> list[Row]:
    """Return the findings of a search, shrunk."""
    world, search = Highway(), searched(policy, seed, options)
    firsts: dict[Signature, Scenario] = {}
    for find in search.finds:
        firsts.setdefault(find.signature, find.scenario)

    def signature_of(scenario: Scenario) -> tuple[Run, Signature | None]:
        trace = world.rollout(scenario, factory_of(policy))
        run = Run(trace)
        return run, of_failure(run, NOT_RUN_COLLISION) if is_ego_responsible(trace) else None

    def shrunk(signature: Signature, scenario: Scenario) -> tuple[Scenario, Shrunk, Scenario | None]:
        def attempt(candidate: Scenario) -> Scenario | None:
            try:
                run, observed = signature_of(candidate)
            except ScenarioError:  # It does not fit the road.
                return None
            if observed != signature:
                return None
            starts[driven(run)] = starts_of(run, world.speed_limit)
            return driven(run)

        starts: dict[Scenario, tuple[Start, ...]] = {}
        budget = ROLLOUTS_IN_KERNEL if world.runs_in_kernel(factory_of(policy)) else ROLLOUTS
        simplest, how = shrink(
            scenario,
            attempt,
            rollouts=budget,
            top_speed=world.speed_limit,
            starts=lambda scenario: starts.get(scenario, ()),
        )
        assert signature_of(simplest)[1] == signature
        draws = simpler_at_random(scenario, simplest, seed)
        tried = islice(draws, options.brute_force)
        return simplest, how, next((each for each in tried if signature_of(each)[1] == signature), None)

    return [Row(policy, signature, scenario, *shrunk(signature, scenario)) for signature, scenario in firsts.items()]


def simpler_at_random(found: Scenario, simplest: Scenario, seed: int) -> Iterator[Scenario]:
    """Yield random scenarios that are simpler than ``found``, from its start or that of ``simplest``, up to a limit."""
    rng, seen = random.Random(seed), set()
    for _ in range(40_000):
        total = rng.choice((1, 2, 3))
        counts = (total,) if total == 1 or rng.random() < 0.5 else (total - 1, 1)
        begin = rng.choice((found, simplest))
        with suppress(ScenarioError):
            drawn = replace(begin, npcs=tuple(_chain(count, rng) for count in counts), seed=0)
            if drawn not in seen and sort_key(drawn) < sort_key(simplest):
                seen.add(drawn)
                yield drawn


def _chain(count: int, rng: random.Random) -> tuple[PositionInstruction, ...]:
    cell, chain = rng.randrange(8), []
    for _ in range(count):
        chain += [PositionInstruction(Cell(cell % 8 + 1), rng.choice(ROUND_SPEEDS))] * rng.choice((1, 1, 1, 2))
        cell += rng.choice((-1, 0, 1))
    return tuple(chain)


def summary(found: Sequence[Row]) -> str:
    """Return the medians."""
    scenarios = [row.simplest for row in found]
    npcs, counts = [len(each.npcs) for each in scenarios], [instructions(each) for each in scenarios]
    before = [row.found for row in found]
    return (
        f"{len(found)} findings: median {statistics.median(len(each.npcs) for each in before):g} NPCs and "
        f"{statistics.median(map(instructions, before)):g} instructions as found, "
        f"{statistics.median(npcs):g} NPCs (most {max(npcs)}) and {statistics.median(counts):g} instructions (most "
        f"{max(counts)}) shrunk, in {statistics.median(row.shrunk.rollouts for row in found):g} runs; "
        f"{sum(row.shrunk.is_minimal for row in found)} minimal"
    )


def main() -> None:
    flawed = [name for name in defects.POLICIES if name != "healthy"]
    given = options(
        __doc__, runs=400, seeds=1, first_seed=0, workers=2, policies=flawed, brute_force=0, algorithm="distinct",
        traffic="hostile", before=False,
    )  # fmt: skip
    found: list[Row] = []
    print_head("policy", "failure", "as found", "shrunk", "runs", "minimal", "scenario")
    for _, by_seed in in_processes(given.workers, rows, given.policies, seeds_of(given), given):
        for row in chain.from_iterable(by_seed):
            found.append(row)
            print(row, flush=True)
    if found:
        print(f"\n{summary(found)}")
    if given.brute_force:
        print(f"brute force finds a simpler one of {sum(row.missed is not None for row in found)}")


if __name__ == "__main__":
    main()
