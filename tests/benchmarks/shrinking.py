"""How small do findings become? Sizes before and after shrinking, over the policies with a defect.

    python -m tests.benchmarks.shrinking [--generations 20] [--seed 0]

Each policy is searched as ``@pafot.search(blame="ego")`` does it; the first scenario of each signature for which the
ego is responsible is shrunk with the default budget. Prints each finding, and the medians.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from example_ads import blind_lane_change, constant_speed, defects
from pytest_pafot import Highway, Run, Scenario
from pytest_pafot.findings.shrink import Shrunk, instructions, shrink, size_of
from pytest_pafot.findings.signature import Failure, Signature, of_failure
from pytest_pafot.plugin.options import BY_NAME
from pytest_pafot.plugin.shrinking import driven
from pytest_pafot.searching import Evaluation, PafotSearch, SearchSpace, run_campaign
from pytest_pafot.searching.fitness import resolve

COLLIDES = Failure(kind="AssertionError", assertion="assert not run.collision")
BLAMED = ("ego", "both")


@dataclass
class Hunted:
    """The first run of each signature in a search of one policy."""

    world: Highway
    ads: Callable[..., Any]
    first: dict[Signature, Scenario] = field(default_factory=dict)

    def signature(self, run: Run) -> Signature | None:
        """Of a run that fails; None for one that does not, or that an NPC is responsible for."""
        is_failure = run.collision is not None and run.responsibility in BLAMED
        return of_failure(run, COLLIDES) if is_failure else None

    def evaluate(self, scenarios: Sequence[Scenario]) -> list[Evaluation]:
        """Simulate, and keep what is new."""
        return [self._one(scenario) for scenario in scenarios]

    def _one(self, scenario: Scenario) -> Evaluation:
        run = Run(self.world.rollout(scenario, self.ads))
        signature = self.signature(run)
        if signature is not None:
            self.first.setdefault(signature, run.scenario)
        fitness = resolve("default", responsible=lambda trace: Run(trace).responsibility in BLAMED)
        return Evaluation.of(run.trace, fitness=fitness(run.trace), failing=signature is not None)

    def shrunk(self, signature: Signature) -> Shrunk:
        """The finding of a signature, shrunk."""

        def attempt(candidate: Scenario) -> Scenario | None:
            run = Run(self.world.rollout(candidate, self.ads))
            return driven(run) if self.signature(run) == signature else None

        budget = BY_NAME["shrink_rollouts"].default
        assert isinstance(budget, int)
        shrunk = shrink(self.first[signature], attempt, rollouts=budget, top_speed=self.world.speed_limit)
        assert self.signature(Run(self.world.rollout(shrunk.scenario, self.ads))) == signature
        return shrunk


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--generations", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    world, space = Highway(), SearchSpace()
    flawed = [name for name in defects.POLICIES if name != "healthy"]
    policies: dict[str, Callable[..., Any]] = {name: defects.make(name) for name in flawed}
    policies |= {"constant-speed": constant_speed.make, "blind-lane-change": blind_lane_change.make}
    results: list[Shrunk] = []
    for name, ads in policies.items():
        hunted = Hunted(world, ads)
        for _ in run_campaign(
            PafotSearch(space), hunted.evaluate, generations=arguments.generations, seed=arguments.seed
        ):
            pass
        for signature, scenario in hunted.first.items():
            shrunk = hunted.shrunk(signature)
            results.append(shrunk)
            minimal = "" if shrunk.is_minimal else ", not minimal"
            speeds = "; ".join(f"{each.low:g} to {each.high:g} m/s" for each in shrunk.intervals)
            print(
                f"{name:26} {signature.slug:9} {size_of(scenario):32} -> {size_of(shrunk.scenario):30} "
                f"{shrunk.rollouts:4} runs{minimal}   {shrunk.scenario!r} {speeds}",
                flush=True,
            )
    if results:
        npcs = [len(each.scenario.npcs) for each in results]
        counts = [instructions(each.scenario) for each in results]
        print(
            f"{len(results)} findings: median {statistics.median(npcs):g} NPCs (most {max(npcs)}), "
            f"{statistics.median(counts):g} instructions (most {max(counts)}), "
            f"{statistics.median(each.rollouts for each in results):g} runs; "
            f"{sum(each.is_minimal for each in results)} minimal"
        )


if __name__ == "__main__":
    main()
