"""Do loaded policies decide as in their libraries, and what does a run cost, one by one and in lock step?

    python -m pip install ".[sb3,onnx]" onnx && python -m tests.benchmarks.loaders [SCENARIOS]

Models are made on the spot: PPO behind VecNormalize and three frames, DQN, a module of torch, a network in an ONNX
file, and the documents' planner in C. Each drives random scenarios by ``env.step`` of ``gymnasium.make``'s environment,
and so does the library itself: ``model.predict`` behind Stable-Baselines3's own wrappers, or the module. *Same* counts
the runs whose actions and states are equal to the last bit. The milliseconds of a run, and the share of them inside the
policy, are for ``rollout`` and for ``rollout_batch`` with 64 scenarios at once.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch

import pytest_pafot as pafot
from pytest_pafot.searching import SearchSpace, sample
from tests.benchmarks.command import print_head
from tests.helpers.onnx_files import saved_network
from tests.helpers.sb3_models import ENV, InItsWrappers, saved_model

WORLD = pafot.World(ENV, duration=20.0)
ROAD = pafot.Highway(duration=20.0)
TOGETHER = 64
Factory = Callable[[], Any]


class Timed:
    """An ADS factory that measures how long its ADSs take to decide [s]."""

    def __init__(self, factory: Factory) -> None:
        self._factory = factory
        self.seconds = 0.0

    def __call__(self) -> Any:
        ads = self._factory()
        decide = self._timed(ads)
        if hasattr(ads, "batch"):
            decide.batch = self._timed(ads.batch)
        if hasattr(ads, "close"):
            decide.close = ads.close
        return decide

    def _timed(self, function: Callable[[Any], Any]) -> Any:
        def timed(seen: Any) -> Any:
            started = time.perf_counter()
            try:
                return function(seen)
            finally:
                self.seconds += time.perf_counter() - started

        return timed


def scenarios(count: int) -> list[pafot.Scenario]:
    """Return random scenarios for both worlds."""
    rng = np.random.default_rng(5)
    space = SearchSpace(npcs=4, genes=2, gene_seconds=10.0, speed_limit=26.0)
    return [sample(space, rng) for _ in range(count)]


def same(a: pafot.Trace, b: pafot.Trace) -> bool:
    """Return whether two runs are equal to the last bit."""
    return np.array_equal(a.actions, b.actions) and a.states.tobytes() == b.states.tobytes()


def cost(drive: Callable[[Factory], Any], factory: Factory, count: int) -> str:
    """Return the milliseconds of a run, and the share inside the policy, after everything is loaded."""
    timed = Timed(factory)
    started = time.perf_counter()
    drive(timed)
    seconds = time.perf_counter() - started
    return f"{1000 * seconds / count:.2f} ms, {timed.seconds / seconds:.0%}"


def row(name: str, world: Any, factory: Factory, oracle: Factory | None, given: list[pafot.Scenario]) -> str:
    """Return a row of the table."""
    told = "-"
    if oracle is not None:
        pairs = [(world.rollout_in_gym(each, factory), world.rollout_in_gym(each, oracle)) for each in given]
        told = f"{sum(same(a, b) for a, b in pairs)} of {len(pairs)}"
    world.rollout(given[0], factory)  # loads the model before the measurement

    def alone(ads: Factory) -> None:
        for each in given:
            world.rollout(each, ads)

    def together(ads: Factory) -> None:
        for start in range(0, len(given), TOGETHER):
            world.rollout_batch(given[start : start + TOGETHER], ads)

    batched = cost(together, factory, len(given)) if decides_for_many(factory) else "-"
    return f"| {name} | {told} | {cost(alone, factory, len(given))} | {batched} |"


def decides_for_many(factory: Factory) -> bool:
    """Return whether the factory's ADSs have ``batch``."""
    ads = factory()
    getattr(ads, "close", bool)()
    return hasattr(ads, "batch")


def network() -> Any:
    """Return a torch module as small as the other models."""
    torch.manual_seed(3)
    return torch.nn.Sequential(
        torch.nn.Flatten(), torch.nn.Linear(25, 32), torch.nn.Tanh(), torch.nn.Linear(32, 5)
    ).eval()


def by_module(module: Any) -> Factory:
    """Return the module itself as an ADS factory."""
    return lambda: lambda seen: int(module(torch.from_numpy(seen)[None])[0].argmax())


def planner_in_c(folder: Path) -> list[str]:
    """Compile the documents' planner in C and return its command."""
    text = (Path(__file__).parents[2] / "docs" / "guide" / "networks.md").read_text(encoding="utf-8")
    (source,) = re.findall(r"```text\n/\* planner.c \*/\n(.*?)```", text, re.DOTALL)
    (folder / "planner.c").write_text(source)
    subprocess.run(["cc", "-O2", "-o", "planner", "planner.c"], check=True, cwd=folder)
    return [str(folder / "planner")]


def main(count: int = 200) -> None:
    """Print the table."""
    given = scenarios(count)
    print_head("Policy", "Same as by hand", "One by one: a run, of it inside the policy", "In lock step")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for place in ("framed", "dqn"):
            (folder / place).mkdir()
        ppo, dqn = stable_baselines3.PPO, stable_baselines3.DQN
        learning = {"steps": 1024, "n_steps": 128, "learning_rate": 0.01}
        file, statistics = saved_model(folder / "framed", ppo, frames=3, is_normalised=True, **learning)
        model = ppo.load(file, device="cpu")
        framed = pafot.policies.sb3(file, vecnormalize=statistics, frame_stack=3)
        print(
            row("PPO, VecNormalize, 3 frames", WORLD, framed, lambda: InItsWrappers(model, WORLD, statistics, 3), given)
        )
        file, _ = saved_model(folder / "dqn", dqn)
        of_dqn = dqn.load(file, device="cpu")
        print(row("DQN", WORLD, pafot.policies.sb3(file), lambda: InItsWrappers(of_dqn, WORLD), given))
        print(row("torch module", WORLD, pafot.policies.torch(network()), by_module(network()), given))
        onnx = pafot.policies.onnx(saved_network(folder / "policy.onnx", 25, 5, ["runs", 25]))
        print(row("ONNX file", WORLD, onnx, None, given))
        print(row("planner in C", ROAD, pafot.policies.process(planner_in_c(folder)), None, given))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
