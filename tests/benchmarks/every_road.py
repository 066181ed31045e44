"""Does a search run on every road of highway-env? IDM and constant speed on each registered environment.

The straight roads are for comparison.

    python -m tests.benchmarks.every_road [--seeds 5] [--generations 10] [--environments merge-v1 ...]
        [--check-every 1] [--workers 2]

Makes a short search for each environment, ego and seed. Prints how many genes are reached, how many runs are invalid or
end without a collision, and the collisions by signature; versions of an environment with equal results share a row.
Checks the NPC limits and the fixed point of every n-th run, and confirms every collision by ``env.step``. Prints how
many runs and collisions it checked, and ends with an error if one of the checks fails.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import groupby, product
from typing import Any

from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle

from pytest_pafot import Run, Scenario, World
from pytest_pafot.findings.finding import disagreement, of_failure
from pytest_pafot.model.trace import Outcome, Trace
from pytest_pafot.searching import Evaluation, PafotSearch
from pytest_pafot.searching.fitness import resolve
from tests.benchmarks.command import options, print_head
from tests.benchmarks.positive_controls import NOT_RUN_COLLISION
from tests.helpers import world_cases
from tests.helpers.campaigns import run_campaign
from tests.helpers.road_cases import ENVIRONMENTS, space_of, violations

STRAIGHT = ("highway-v0", "highway-fast-v0")

EGOS: dict[str, Callable[[], Any]] = {"idm": lambda: IDMVehicle, "constant": lambda: ControlledVehicle}
"""The egos; ``ControlledVehicle`` keeps its lane, so it can keep a constant speed on roads that bend."""

FITNESS = resolve("default")


@dataclass
class Tally:
    """All searches with one ego on one environment."""

    world: World
    ego: str
    check_every: int
    runs: int = 0
    started: int = 0
    reached: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    signatures: Counter[str] = field(default_factory=Counter)
    confirmed: int = 0
    faults: list[str] = field(default_factory=list)

    def evaluate(self, scenario: Scenario) -> Evaluation:
        """Simulate and evaluate a scenario."""
        trace = self.world.rollout(scenario, EGOS[self.ego])
        if self.runs % self.check_every == 0:
            self._check(trace)
        if trace.error is not None:
            self.faults.append(f"{scenario.canonical()}: {trace.error.message}")
        evaluation = Evaluation.of(trace, fitness=FITNESS(trace), failing=trace.collision is not None)
        self.runs += 1
        self.started += evaluation.genes_started
        self.reached += evaluation.genes_reached
        self.outcomes[str(trace.outcome)] += 1
        if trace.collision is not None:
            self._found(trace)
        return evaluation

    def _check(self, trace: Trace) -> None:
        broken = limits_broken(trace, self.world)
        if broken:
            self.faults.append(f"{trace.scenario.canonical()}: {broken}")
        again = self.world.rollout(trace.executed, EGOS[self.ego])
        if again.executed != trace.executed or again.states.tobytes() != trace.states.tobytes():
            self.faults.append(f"{trace.scenario.canonical()}: no fixed point")

    def _found(self, trace: Trace) -> None:
        signature = of_failure(Run(trace), NOT_RUN_COLLISION)
        name = f"{signature.slug} ({signature.responsibility})"
        self.signatures[name] += 1
        differs = disagreement(Run(trace), Run(self.world.rollout_in_gym(trace.executed, EGOS[self.ego])))
        self.confirmed += not differs
        if differs:
            self.faults.append(f"{trace.executed.canonical()}: not confirmed, {differs}")

    def cells(self) -> str:
        """Return the cells of the table's row."""
        others = sorted(set(self.outcomes) - {Outcome.SAFE, Outcome.INVALID, Outcome.COLLISION})
        ends = [str(self.outcomes[Outcome.SAFE]), *(f"{self.outcomes[each]} `{each}`" for each in others)]
        finds = "; ".join(f"{count} {name}" for name, count in self.signatures.most_common())
        reached = self.reached / max(self.started, 1)
        return f"{self.runs} | {reached:.0%} | {self.outcomes[Outcome.INVALID]} | {' + '.join(ends)} | {finds or '-'}"


def limits_broken(trace: Trace, world: World) -> list[str]:
    """Return the limits that the NPCs break, by the road's own lanes if it is not straight."""
    if trace.track is None:
        return world_cases.violations(trace, world.limits, world.speed_limit)
    return violations(trace, world)


def searched(env_id: str, ego: str, arguments: argparse.Namespace) -> Tally:
    """Run all searches with one ego on one environment."""
    tally = Tally(World(env_id), ego, arguments.check_every)
    for seed in range(arguments.seeds):
        search = PafotSearch(space_of(tally.world))
        for _ in run_campaign(search, tally.evaluate, generations=arguments.generations, seed=seed):
            pass
    return tally


def main() -> None:
    arguments = options(
        __doc__, environments=(*STRAIGHT, *ENVIRONMENTS), egos=EGOS, seeds=5, generations=10, check_every=1, workers=2
    )
    print_head("environment", "ego", "runs", "genes reached", "invalid", "no collision", "collisions")
    faults: list[str] = []
    runs = confirmed = 0
    with ProcessPoolExecutor(arguments.workers) as pool:
        pairs = product(arguments.environments, arguments.egos)
        tallies = {pair: pool.submit(searched, *pair, arguments) for pair in pairs}
        for family, versions in groupby(arguments.environments, key=lambda env_id: env_id.rpartition("-v")[0]):
            for ego, env_ids in product(arguments.egos, [list(versions)]):
                alike: dict[str, list[str]] = {}
                for env_id in env_ids:
                    tally = tallies[env_id, ego].result()
                    alike.setdefault(tally.cells(), []).append(env_id.removeprefix(family))
                    runs, confirmed = runs + tally.runs, confirmed + tally.confirmed
                    faults += [f"{env_id} {ego}: {fault}" for fault in tally.faults]
                for cells, named in alike.items():
                    print(f"| {family}{', '.join(named)} | {ego} | {cells} |", flush=True)
    print(f"\n{runs} runs, {confirmed} collisions confirmed, {len(faults)} faults")
    if faults:
        raise SystemExit("\n".join(faults))


if __name__ == "__main__":
    main()
