"""Is every known defect found? The policies of ``example_ads.defects``, searched with ``blame="ego"``.

    python -m tests.benchmarks.positive_controls [--seeds 10] [--first-seed 0] [--generations 20] [--workers 2]
        [--policies NAME ...] [--algorithm distinct] [--until-first]

Prints for each policy on how many seeds the search found a collision that the ego is responsible for, in which
generation first, how many distinct signatures the finds have and which, and
the explanation of the most frequent signature with the mechanism that it should point at. ``healthy`` is IDM+MOBIL
without a defect, searched once in each of the settings that the others are searched in. ``--until-first`` ends each
search at its first find. The algorithm is the default; settings that differ from the default are in ``SETTINGS``.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Any

from example_ads import defects
from pytest_pafot import Highway, Run, Scenario
from pytest_pafot.attribution.near_misses import near_misses
from pytest_pafot.attribution.responsibility import Fault, is_ego_responsible
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.signature import Failure, Signature
from pytest_pafot.searching import ALGORITHMS, Evaluation, SearchSpace, resolve_algorithm, run_campaign
from pytest_pafot.searching.events import GenerationFinished
from pytest_pafot.searching.fitness import resolve

NOT_RUN_COLLISION = Failure(kind="AssertionError", assertion="assert not run.collision")


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What a policy is searched in.

    Attributes:
        world: the road; a larger ``clearance`` has the cells ahead and behind where a policy lets others come.
        space: of the scenarios.
    """

    world: Highway = field(default_factory=Highway)
    space: SearchSpace = field(default_factory=SearchSpace)


DEFAULT = Setting()
FAST_AND_FAR = Setting(world=Highway(clearance=20.0, speed_limit=30.0), space=SearchSpace(ego_speed=28.0))
"""The defect shows above 20 m/s and at gaps of 10 m and more."""
FAST_AND_CROWDED = Setting(
    world=Highway(lanes=3, clearance=5.0, speed_limit=30.0), space=SearchSpace(npcs=3, ego_speed=28.0)
)
"""MOBIL steers round a leader that brakes, so that the gap matters only where no other lane is free."""
CROWDED = Setting(world=Highway(lanes=3, clearance=10.0), space=SearchSpace(npcs=3))
"""Likewise; and IDM never lets anybody come as near ahead as the default clearance, so that genes are not reached."""

SETTINGS: Mapping[str, Setting] = MappingProxyType(
    {
        "brakes-late-above-20": FAST_AND_FAR,
        "brakes-weakly": CROWDED,
        "follows-too-close": FAST_AND_CROWDED,
        "sees-old-speeds": CROWDED,
    }
)
"""Those that are not searched in the default setting."""

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
"""What an explanation should point at."""

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
"""The kinds of failure that the mechanism shows as."""


@dataclass(frozen=True, kw_only=True)
class Find:
    """A colliding run that the ego is responsible for."""

    generation: int
    scenario: Scenario
    signature: Signature
    explanation: str


@dataclass
class Search:
    """One search of a policy, and what it found."""

    policy: str
    seed: int
    setting: Setting
    generation: int = 0
    runs: int = 0
    finds: list[Find] = field(default_factory=list)

    def evaluate(self, scenarios: Sequence[Scenario]) -> list[Evaluation]:
        """Simulate and judge."""
        return [self._one(scenario) for scenario in scenarios]

    def _one(self, scenario: Scenario) -> Evaluation:
        trace = self.setting.world.rollout(scenario, factory_of(self.policy))
        self.runs += 1
        failing, signature = is_ego_responsible(trace), None
        if failing:
            run = Run(trace)
            signature = of_failure(run, NOT_RUN_COLLISION)
            self.finds.append(
                Find(generation=self.generation, scenario=run.scenario, signature=signature, explanation=run.explain())
            )
        fitness = resolve("default", responsible=is_ego_responsible)(trace)
        return Evaluation.of(
            trace,
            fitness=fitness,
            failing=failing,
            kind=signature,
            mistake=signature.mistake if signature is not None else None,
            near_misses=near_misses(trace),
        )


def factory_of(policy: str) -> Any:
    """The vehicle class of a known defect, or what a ``module:name`` says."""
    return resolve_name(policy) if ":" in policy else defects.make(policy)


def searched(policy: str, seed: int, setting: Setting, options: argparse.Namespace) -> Search:
    """One search from start to end."""
    search = Search(policy=policy, seed=seed, setting=setting)
    algorithm = resolve_algorithm(options.algorithm).make(setting.space, population=4)
    stop = (lambda: bool(search.finds)) if options.until_first else None
    for event in run_campaign(algorithm, search.evaluate, generations=options.generations, seed=seed, stop=stop):
        if isinstance(event, GenerationFinished) and event.local_generation == 0:
            search.generation = event.generation + 1
    return search


def report(title: str, mechanism: str, searches: Sequence[Search]) -> str:
    """What the searches of one policy found."""
    firsts = [search.finds[0].generation if search.finds else None for search in searches]
    finds = [find for search in searches for find in search.finds]
    kinds = Counter(find.signature for find in finds)
    per_seed = [len({find.signature for find in search.finds}) for search in searches]
    telling = [any(find.signature.fault in FAULTS.get(title, ()) for find in search.finds) for search in searches]
    lines = [
        f"{title}: found on {sum(first is not None for first in firsts)} of {len(searches)} seeds, first in "
        f"generations {' '.join('-' if first is None else str(first) for first in firsts)}; as the "
        f"mechanism shows on {sum(telling)}; {len(finds)} finds in "
        f"{sum(search.runs for search in searches)} runs; signatures per seed {per_seed}, {len(kinds)} in all",
        *(f"    {count:4} x {signature.mistake or signature.slug}" for signature, count in kinds.most_common()),
    ]
    if kinds:
        usual = kinds.most_common(1)[0][0]
        explanation = next(find.explanation for find in finds if find.signature == usual)
        lines += [f"    expected: {mechanism}", *(f"    said: {line}" for line in _sentence(explanation))]
    return "\n".join(lines)


def _sentence(explanation: str) -> list[str]:
    """The lines of an explanation that say what happened and who is responsible."""
    lines = explanation.splitlines()
    end = next(number for number, line in enumerate(lines) if line.startswith("  from [s]"))
    return [line.strip() for line in (lines[0], *lines[3:end])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--algorithm", choices=ALGORITHMS, default=ALGORITHMS[0])
    parser.add_argument("--generations", type=int, default=20)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--policies", nargs="*", choices=list(defects.POLICIES), default=list(defects.POLICIES))
    parser.add_argument("--until-first", action="store_true")
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.workers) as pool:
        jobs = [
            (title, policy, [
                pool.submit(searched, policy, seed, setting, arguments)
                for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds)
            ])
            for title, policy, setting in rows(arguments.policies)
        ]  # fmt: skip
        for title, policy, futures in jobs:
            print(report(title, MECHANISM[policy], [future.result() for future in futures]), flush=True)


def rows(policies: Iterable[str]) -> Iterable[tuple[str, str, Setting]]:
    """Title, policy and setting of each row; the healthy one has a row for each setting."""
    for policy in policies:
        if policy != "healthy":
            yield policy, policy, SETTINGS.get(policy, DEFAULT)
            continue
        yield "healthy", policy, DEFAULT
        for setting in dict.fromkeys(map(id, SETTINGS.values())):
            names = [name for name in SETTINGS if id(SETTINGS[name]) == setting]
            yield f"healthy, where {' and '.join(names)} are searched", policy, SETTINGS[names[0]]


if __name__ == "__main__":
    main()
