"""The common behaviour of loaders, and frames, without the libraries that real models need."""

import json
import pickle
import subprocess
import sys
import types
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete

import pytest_pafot as pafot
from pytest_pafot.policies.baselines import (
    BaselineAds,
    BaselineModel,
    Sb3Policy,
    push_observation,
    stacking_axis,
)
from tests.helpers.tables import table

WORLD = pafot.World("highway-fast-v0", duration=5.0)
CUT_IN = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 10.0)]])


class Weighing:
    """A model with Stable-Baselines3's interface, whose action is a weighted sum of its observation."""

    action_space = Discrete(5)

    def __init__(self, frames):
        self.observation_space = Box(-np.inf, np.inf, (5, 5 * frames), np.float32)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        assert deterministic
        weights = np.arange(1, 1 + 25 * (observation.shape[-1] // 5)).reshape(5, -1)
        return (np.abs(observation * weights).sum(axis=(-1, -2)) * 100).astype(int) % 5, state


@dataclass(frozen=True, kw_only=True)
class Loader(Sb3Policy):
    file: Path = Path(__file__)
    frames: int = 1
    loading_hint: str = ""
    loads: ClassVar = []

    def load(self):
        self.loads.append(self)
        return BaselineModel(Weighing(self.frames), None, self.frames, deterministic=True)

    def __call__(self):
        return BaselineAds(self.loaded)

    def check_world(self, world):
        if not self.loaded.fits(world.observation_space, world.action_space):
            raise TypeError(f"{world.observation_space} {world.action_space}")


def test_the_loaders_are_there_at_no_cost():
    libraries = {"numpy", "torch", "stable_baselines3", "gymnasium", "highway_env"}
    code = f"import sys, pytest_pafot as p; p.policies.sb3; print({libraries} & {{*sys.modules}})"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "set()\n"


def test_policy_is_loaded_once_and_its_factory_pickles():
    first, second = Loader(frames=2), pickle.loads(pickle.dumps(Loader(frames=2)))
    Loader.loads.clear()
    assert first == second
    assert first.loaded is second.loaded
    assert pickle.loads(pickle.dumps(first)).loaded is first.loaded
    assert Loader.loads == [first]


@table("shape", [(5, 5), (3,), (4, 6, 2)])
def test_frames_are_last_observations_padded_with_zeros(shape):
    rng = np.random.default_rng(0)
    seen = [rng.normal(size=shape).astype(np.float32) for _ in range(6)]
    for axis in range(len(shape)):
        stacked = [size * (3 if index == axis else 1) for index, size in enumerate(shape)]
        frames = None
        for newest in range(len(seen)):
            frames = push_observation(frames, seen[newest], 3, stacked)
            last = [
                seen[place] if place >= 0 else np.zeros(shape)
                for place in (newest - 2, newest - 1, newest)
            ]
            assert np.array_equal(frames, np.concatenate(last, axis))
            assert frames.dtype == np.float32


def test_wrong_number_of_frames_is_a_clear_error():
    assert stacking_axis((5, 5), (5, 15), 3) == 1
    assert stacking_axis((5, 5), (5, 15), 2) is None
    with pytest.raises(
        TypeError, match=r"2 observations that stack to the shape \(5, 15\).*Use the frame_stack="
    ):
        push_observation(None, np.zeros((5, 5)), 2, (5, 15))


@table("world", [
    pafot.Highway(),
    pafot.World("highway-fast-v0", config={"action": {"type": "ContinuousAction"}}),
    pafot.World("highway-fast-v0", config={"observation": {"type": "Kinematics", "vehicles_count": 7}}),
])  # fmt: skip
def test_policy_is_compared_with_world_before_any_run(world):
    with pytest.raises(TypeError, match=r"None None|Box.*(Box|7, 5)"):
        world.rollout(CUT_IN, Loader())


class Planner:
    """An ADS whose methods have the names of a factory's."""

    def __call__(self, observation):
        return 1

    def check_world(self, world):
        raise AssertionError

    def preload(self):
        raise AssertionError


def test_planner_class_is_not_asked_for_policy_properties():
    assert WORLD.rollout(CUT_IN, Planner).error is None
    assert pafot.explore(Planner, holds=lambda run: None, world=WORLD, runs=1).summary.runs == 1


def test_a_policy_of_the_world_drives_in_it():
    assert WORLD.rollout(CUT_IN, Loader()).error is None


class Native(pafot.Simulator):
    """A simulator that shows its policy a table, and takes numbers from 0 to 4."""

    native = True

    def start(self, vehicles, seed):
        self.cars = [(each.x, each.y, each.heading, each.speed) for each in vehicles]
        self.taken = []

    def observe(self):
        return np.full((5, 5), len(self.taken), dtype=np.float32)

    def step(self, controls):
        self.taken.append(controls[0].action)
        self.cars = [(each.x, each.y, each.heading, each.speed) for each in controls]

    def states(self):
        return self.cars


class Checking(Loader):
    check_world = Sb3Policy.check_world


def test_a_model_drives_by_what_a_simulator_observes():
    simulator = Native()
    trace = pafot.SimulatorWorld(lambda: simulator, duration=1.0).rollout(CUT_IN, Checking())
    expected = [int(np.arange(1, 26).sum() * tick * 100) % 5 for tick in range(0, 15, 3)]
    assert trace.error is None
    assert simulator.taken[::3] == list(trace.actions) == expected
    with pytest.raises(
        TypeError, match=r"SimulatorWorld, whose observations are pafot\.Observation"
    ):
        pafot.SimulatorWorld(type("Plain", (Native,), {"native": False})).rollout(
            CUT_IN, Checking()
        )


def zipped(path, parameters):
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("data", json.dumps(parameters))
    return path


@pytest.mark.parametrize(("policy", "message"), [
    (lambda folder: pafot.policies.sb3(folder / "model.zip"), "expected a file that can be read, received .*model"),
    (lambda folder: pafot.policies.sb3(folder, frame_stack=0), "expected a frame_stack of 1 or more, received 0"),
])  # fmt: skip
def test_unloadable_policy_error_says_what_to_do(policy, message, tmp_path):
    with pytest.raises(TypeError, match=message):
        pafot.Highway().rollout(CUT_IN, policy(tmp_path))


def test_missing_library_error_names_the_install_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    file = zipped(tmp_path / "model.zip", {"clip_range": 0.2})
    with pytest.raises(
        TypeError, match=r"expected the package torch.*pip install 'pytest-pafot\[sb3\]'"
    ):
        pafot.Highway().rollout(CUT_IN, pafot.policies.sb3(file))


def test_policy_is_loaded_before_isolated_runs_fork():
    Loader.loads.clear()
    pafot.explore(Loader(frames=4), holds=lambda run: None, world=WORLD, runs=1, isolate=True)
    assert Loader.loads == [Loader(frames=4)]


@pytest.fixture
def statistics(tmp_path, monkeypatch):
    """Return a file as ``VecNormalize.save`` writes it: the pickle of an instance."""
    module = "stable_baselines3.common.vec_env.vec_normalize"
    fake = types.ModuleType(module)
    fake.VecNormalize = type("VecNormalize", (), {"__module__": module})
    for end in range(1, 5):  # pickle imports a class by its name
        name = ".".join(module.split(".")[:end])
        monkeypatch.setitem(sys.modules, name, fake if name == module else types.ModuleType(name))
    path = tmp_path / "vecnormalize.pkl"
    path.write_bytes(pickle.dumps(fake.VecNormalize()))
    return path


STORED = {":type:": "<class 'numpy.ndarray'>", ":serialized:": "gASVAAAAAA=="}


def test_statistics_missing_for_the_zip_are_reported(tmp_path):
    """The zip is as ``save`` writes it: with a replay buffer, it contains observations in either case."""
    of_ppo, of_dqn = {"clip_range": 0.2}, {"buffer_size": 9, "exploration_fraction": 0.1}
    file = zipped(tmp_path / "model.zip", {**of_ppo, "_last_original_obs": STORED})
    assert pafot.policies.sb3(file).loading_hint == (
        "model.zip was trained with VecNormalize, as its content shows, but no statistics are given. Unless only "
        "rewards were normalised, the model now receives other numbers than in training. Use sb3(..., "
        "vecnormalize='statistics.pkl')."
    )
    assert pafot.policies.sb3(file, vecnormalize=tmp_path / "given.pkl").loading_hint == ""
    for parameters in (
        of_ppo,
        {**of_ppo, "_last_original_obs": None},
        {**of_dqn, "_last_original_obs": STORED},
    ):
        assert pafot.policies.sb3(zipped(tmp_path / "plain.zip", parameters)).loading_hint == ""
    assert pafot.policies.sb3(tmp_path / "nowhere.zip").loading_hint == ""


def test_statistics_beside_the_zip_are_a_hint(tmp_path, statistics):
    (tmp_path / "buffer.pkl").write_bytes(pickle.dumps({"other": "things"}))
    file = zipped(tmp_path / "model.zip", {"buffer_size": 9, "_last_original_obs": STORED})
    assert pafot.policies.sb3(file).loading_hint == (
        "no statistics of VecNormalize are given for model.zip, but the file vecnormalize.pkl contains some. If the "
        "model was trained with them, it now receives other numbers than in training. "
        f"Use sb3(..., vecnormalize='{statistics}')."
    )
    below = tmp_path / "model"
    below.mkdir()
    statistics.rename(below / statistics.name)  # RL Zoo has them here
    assert f"vecnormalize='{below / statistics.name}')" in pafot.policies.sb3(file).loading_hint
    (below / statistics.name).unlink()
    assert pafot.policies.sb3(file).loading_hint == ""


def test_search_notes_the_hint_of_its_policy_once():
    def notes(ads):
        return pafot.explore(ads, holds=lambda run: None, world=WORLD, generations=1).summary.notes

    hinting = Loader(loading_hint="mind the statistics")
    assert notes(hinting) == ("mind the statistics",)
    assert notes(Loader()) == ()
