"""Does the search blame a careful driver? The reference drivers as the ADS, with ``blame="ego"``.

    python -m tests.benchmarks.negative_control [--drivers careful-human ...] [--seeds 10] [--generations 50]

Every collision for which the ego is responsible would be a finding; with the careful and competent human driver of
UN R157 there must be none. The search is steered as under ``blame="ego"``. Prints counts per seed, and for each
finding its explanation.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from pytest_pafot import Highway, Outcome, Run, Scenario
from pytest_pafot.attribution.responsibility import is_ego_responsible
from pytest_pafot.searching import Evaluation, PafotSearch, SearchSpace, run_campaign
from pytest_pafot.searching.fitness import resolve
from pytest_pafot.world.reference_drivers import REFERENCES, Driver


@dataclass
class Control:
    """One search against one driver."""

    world: Highway
    name: str
    runs: int = 0
    simulated: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    by_position: int = 0
    findings: list[Run] = field(default_factory=list)

    def evaluate(self, scenarios: Sequence[Scenario]) -> list[Evaluation]:
        """Simulate and judge."""
        return [self._one(scenario) for scenario in scenarios]

    def _one(self, scenario: Scenario) -> Evaluation:
        trace = self.world.rollout(scenario, self._driver)
        found = is_ego_responsible(trace)
        self.runs += 1
        self.simulated += trace.duration
        run = Run(trace)
        self.counts[run.responsibility or str(trace.outcome)] += 1
        self.by_position += run.second_opinion == "ego"
        if found:
            self.findings.append(run)
        return Evaluation.of(trace, fitness=FITNESS(trace), failing=found)

    def _driver(self) -> Driver:
        return REFERENCES[self.name]()


FITNESS = resolve("default", responsible=is_ego_responsible)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drivers", nargs="+", choices=REFERENCES, default=list(REFERENCES))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--generations", type=int, default=50)
    parser.add_argument("--npcs", type=int, default=2)
    arguments = parser.parse_args()
    world, space = Highway(ads_hz=15), SearchSpace(npcs=arguments.npcs)
    for name in arguments.drivers:
        total: Counter[str] = Counter()
        for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
            control, started = Control(world, name), time.perf_counter()
            for _ in run_campaign(PafotSearch(space), control.evaluate, generations=arguments.generations, seed=seed):
                pass
            total += control.counts + Counter(runs=control.runs, position=control.by_position)
            print(
                f"{name} seed {seed:2}: {len(control.findings)} findings in {control.runs} runs "
                f"({control.runs - control.counts['safe'] - control.counts[Outcome.INVALID]} collisions, "
                f"{control.counts[Outcome.INVALID]} invalid), {time.perf_counter() - started:.1f} s",
                flush=True,
            )
            for run in control.findings[:1]:
                print(run.explain(), flush=True)
        print(f"{name}: {dict(total)}; findings: {total['ego'] + total['both']}", flush=True)


if __name__ == "__main__":
    main()
