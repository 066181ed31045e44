"""The same scenario gives the same trace, also in other processes, with other hash seeds and other random states."""

import functools
import hashlib
import json
import os
import pickle
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, Scenario, World
from tests.helpers.world_cases import EGOS, chains, constant_speed

ROOT = Path(__file__).parents[2]


def policy():
    actions = iter(np.random.default_rng(1).integers(5, size=1000))
    return lambda observation: next(actions)


def shooter(env):
    return lambda observation: int(env.action_space.sample())


SHUFFLED = {"observation": {"type": "Kinematics", "order": "shuffled", "vehicles_count": 3}}


def hungry(env_action=1):
    """Return a policy whose action depends on every bit of a shuffled observation."""
    return lambda observation: int(hashlib.sha256(observation.tobytes()).digest()[0] % 5)


def cases():
    """Yield (world, ADS factory) of every kind."""
    yield from ((Highway(duration=8.0), ego) for ego in EGOS)
    yield from ((World("highway-v0", duration=8.0), ads) for ads in (policy, shooter, IDMVehicle))
    yield World("highway-v0", config=SHUFFLED, duration=8.0), functools.partial(hungry)


def digests():
    """Return a digest of each case's traces over a few scenarios with conflicts, vanished lanes and repairs."""
    result = []
    for number, (world, ads) in enumerate(cases()):
        rng, digest = random.Random(number), hashlib.sha256()
        for lane in (0, 3):
            npcs = chains(rng, 4, 4, 26.8)
            scenario = Scenario.repaired(npcs, seed=lane, ego_lane=lane, gene_seconds=2.0)
            trace = world.rollout(scenario, ads)
            actions = [np.asarray(action).tolist() for action in trace.actions]
            told = (
                trace.executed.canonical(),
                trace.outcome,
                trace.collision,
                trace.arrivals,
                actions,
            )
            digest.update(trace.states.tobytes() + repr(told).encode())
        result.append(digest.hexdigest())
    return result


ELSEWHERE = """
import json, sys
from pytest_pafot import Highway, PositionInstruction, Scenario

def imported(*names):
    return [name for name in names if name in sys.modules]

found = {}
import example_ads.defects
from example_ads import ppo
ppo.make()
found["with the examples"] = imported("highway_env", "torch", "stable_baselines3")

world, scenario = Highway(), Scenario(npcs=[[PositionInstruction(2, 0.0)]])
trace = world.rollout(scenario, lambda: lambda seen: (0.0, 0.0))
world.rollout_reference(scenario, "careful-human")
found["by the kernel"] = trace.outcome, imported("highway_env", "gymnasium", "pygame")

from tests.world.test_determinism import digests
print(json.dumps({**found, "digests": digests()}))
"""


@pytest.fixture(scope="module")
def elsewhere():
    """Return the results of a process with a different hash seed, and its imports over time."""
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    command = [sys.executable, "-c", ELSEWHERE]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def first():
    return digests()


@pytest.mark.processes
def test_other_process_with_other_hash_seed_agrees_and_imports_large_libraries_late(
    first, elsewhere
):
    assert elsewhere["digests"] == first
    assert elsewhere["with the examples"] == []
    assert elsewhere["by the kernel"] == ["collision", []]


def test_global_random_numbers_are_neither_used_nor_moved(first):
    random.seed(99)
    np.random.seed(99)
    state, numpys = random.getstate(), np.random.get_state()
    assert digests() == first
    assert random.getstate() == state
    assert pickle.dumps(np.random.get_state()) == pickle.dumps(numpys)


def test_used_world_can_be_sent_to_another_process():
    scenario = Scenario.repaired(chains(random.Random(2), 2, 3, 26.8), gene_seconds=2.0)
    for world, ads in ((Highway(), constant_speed), (World("highway-v0"), policy)):
        trace = world.rollout(scenario, ads)
        sent = pickle.loads(pickle.dumps(world))
        assert sent == world
        assert sent.rollout(scenario, ads).states.tobytes() == trace.states.tobytes()


# The modules that are imported with highway-env.


HEAVY = """
import sys
import pytest_pafot.world.engines.gym_replay
from pytest_pafot.world.stock import observation

heavy = {"matplotlib", "matplotlib.pyplot", "pandas"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)

import gymnasium, highway_env.vehicle.dynamics as dynamics
shown, _ = gymnasium.make("highway-v0").reset(seed=1)
assert shown.shape == (5, 5)
import matplotlib, pandas
assert observation.pd.DataFrame is pandas.DataFrame
assert dynamics.plt.subplots.__module__ == "matplotlib.pyplot"
assert heavy < set(sys.modules)
"""


@pytest.mark.processes
def test_plot_and_table_libraries_are_imported_when_used():
    subprocess.run([sys.executable, "-c", HEAVY], check=True)


FROZEN = """
import datetime, sys, time
from pytest_pafot.support import monotonic

class Date(datetime.date): ...
class Datetime(datetime.datetime, Date): ...
datetime.date, datetime.datetime = Date, Datetime
clocks = {id(getattr(time, name)) for name in ("time", "monotonic", "perf_counter")}
for module in list(sys.modules.values()):
    for name in [name for name, value in vars(module).items() if id(value) in clocks]:
        setattr(module, name, lambda: 0.0)

import pytest_pafot.world.engines.gym_replay
from pytest_pafot.world.stock import observation
assert observation.pd.DataFrame({"x": [1]}).x.sum() == 1
assert (datetime.date, datetime.datetime) == (Date, Datetime)
assert 0.0 == time.monotonic() < monotonic() < monotonic()
"""


@pytest.mark.processes
def test_pandas_can_be_imported_while_a_test_freezes_the_clock():
    """As freezegun does it. Parts of pandas are compiled for the true classes, and the process died."""
    subprocess.run([sys.executable, "-c", FROZEN], check=True)
