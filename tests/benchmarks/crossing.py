"""How well do NPCs that cross keep their slots, and how do random runs at junctions end?

    python -m tests.benchmarks.crossing [--worlds intersection-v0 roundabout-v0] [--egos steady own idm careful-human]
        [--runs 200] [--seed 1] [--npcs 2] [--acts pass hold stop]

The scenarios are random, without a search: they have the requested number of NPCs, at random zones with slots of at
most 2.5 s, and no two NPCs clash. Egos: one that keeps its speed whatever happens, a policy of the environment that
keeps its speed, highway-env's own IDM+MOBIL, and a reference driver. Prints for each ego the shares of runs by their
outcome, and how far NPCs that pass missed their slots, if both vehicles were through the zone before the run ended:
median, nine tenths, and all.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle
from numpy.random import Generator

from pytest_pafot import CrossingInstruction, Scenario, Trace, World
from pytest_pafot.model.trace import ALONG
from pytest_pafot.world.reference_drivers import REFERENCES
from tests.benchmarks.command import options

WORLDS = ("intersection-v0", "intersection-v1", "roundabout-v0")
ACTS = ("pass", "hold", "stop", "late")
WIDEST = 2.5
"""The widest slot to sample [s]."""
IDLE = 1
"""The decision of a policy that keeps its speed."""


class Steady(ControlledVehicle):  # type: ignore[misc]
    """Keep the route and the first speed."""

    first: float | None = None

    def act(self, action: Any = None) -> None:
        """Steer, and ignore highway-env's rules for its roads, which would brake."""
        self.first = self.target_speed = self.speed if self.first is None else self.first
        super().act()


EGOS: Mapping[str, Any] = MappingProxyType({"steady": Steady, "own": lambda: lambda seen: IDLE, "idm": IDMVehicle})
DRIVERS = (*EGOS, *REFERENCES)


def drawn(world: World, rng: Generator, npcs: int, acts: list[str]) -> Scenario:
    """Return a random scenario that fits the world, in which no NPCs clash."""
    lane, speed = world.start or (0, 0.0)
    ways, fastest = sorted(world.crossings.ways), min(world.speed_limit, 10.0)
    while True:
        chains = [
            [
                CrossingInstruction(
                    ways[rng.integers(len(ways))],
                    round(float(rng.uniform(-WIDEST, WIDEST)), 1),
                    round(float(rng.uniform(0.4, 1.0) * fastest), 1),
                    acts[rng.integers(len(acts))],
                )
            ]
            for _ in range(npcs)
        ]
        scenario = Scenario(npcs=chains, ego_lane=lane, ego_speed=speed)
        told = [each for each in scenario.crossings if each is not None]
        if all(map(world.crossings.fits, told)) and not world.crossings.clashes(scenario):
            return scenario


def missed(trace: Trace) -> list[float]:
    """Return how far each passing NPC missed its slot [s], if the ego and the NPC both left the zone."""
    found = []
    for npc, (instruction, zone) in enumerate(zip(trace.scenario.crossings, trace.zones, strict=True)):
        if instruction is None or zone is None or trace.on_way is None or instruction.act != "pass":
            continue
        ego, way = trace.track_of(0)[:, ALONG], trace.on_way[:, npc]
        if ego[-1] < zone.ego[1] or way[-1] < zone.npc[1]:
            continue
        (ego_in, ego_out), (npc_in, npc_out) = (
            np.interp(zone.ego, ego, trace.times),
            np.interp(zone.npc, way, trace.times),
        )
        if instruction.slot > 0:
            found.append(float(npc_in - ego_out - instruction.slot))
        elif instruction.slot < 0:
            found.append(float(npc_out - ego_in - instruction.slot))
        else:
            found.append(float((npc_in + npc_out - ego_in - ego_out) / 2))
    return found


def measured(world: World, ego: str, scenarios: list[Scenario], tell: Callable[[Trace], str]) -> None:
    """Print how scenarios with an ego ended."""
    counts: Counter[str] = Counter()
    errors: list[float] = []
    spent = 0.0
    for scenario in scenarios:
        begun = time.process_time()
        trace = world.rollout_reference(scenario, ego) if ego in REFERENCES else world.rollout(scenario, EGOS[ego])
        spent += time.process_time() - begun
        counts[tell(trace)] += 1
        errors += map(abs, missed(trace))
    shares = ", ".join(f"{outcome} {100 * count / len(scenarios):.1f} %" for outcome, count in counts.most_common())
    quantiles = np.quantile(errors, (0.5, 0.9, 1.0)) if errors else np.full(3, np.nan)
    told = ", ".join(f"{value:.2f}" for value in quantiles)
    print(f"{world.env_id}, {ego}: {shares}; slots missed by {told} s (median, 0.9, all of {len(errors)}); ", end="")
    print(f"{1000 * spent / len(scenarios):.1f} ms a run", flush=True)


def main() -> None:
    """Measure."""
    given = options(__doc__, worlds=WORLDS, egos=DRIVERS, runs=200, seed=1, npcs=2, acts=ACTS)
    for env_id in given.worlds:
        world, rng = World(env_id), np.random.default_rng(given.seed)
        scenarios = [drawn(world, rng, given.npcs, given.acts) for _ in range(given.runs)]
        for ego in given.egos:
            if env_id != "intersection-v1" or ego != "own":  # its policy decides in numbers
                measured(world, ego, scenarios, lambda trace: str(trace.outcome))


if __name__ == "__main__":
    main()
