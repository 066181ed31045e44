"""Adapters of policies whose code is not a dependency: their authors' code drives, and its absence is explained."""

import importlib
import os
import sys
from types import ModuleType

import pytest

from pytest_pafot import Cell, Drive, Observation, Outcome, PositionInstruction, Scenario, World
from pytest_pafot.world import VehicleState
from tests.helpers.bicycle import drive

CLONES = {
    "jrc_fsm": ["JRC_FSM"],
    "python_robotics": ["PYTHON_ROBOTICS"],
    "rl_agents": ["RL_AGENTS", "FINITE_MDP"],
}
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the authors' code


def vehicle(*, x=100.0, y=4.0, speed=20.0, heading=0.0):
    return VehicleState(x=x, y=y, heading=heading, speed=speed, lane=round(y / 4.0), length=5.0, width=2.0)


def module(name):
    """Import an adapter, or skip the test where the code that it drives is absent."""
    missing = [variable for variable in CLONES.get(name, []) if variable not in os.environ]
    if missing:
        pytest.skip(f"needs {' and '.join(missing)}, as the docstring of example_ads/{name}.py says")
    return importlib.import_module(f"example_ads.{name}")


@pytest.mark.parametrize("model", ["make", "rss"])
def test_safety_model_accelerates_gently_and_follows_leader(model):
    make = getattr(module("jrc_fsm"), model)
    ego, _ = drive(3, ego=vehicle(), ads=make())
    assert ego.speed == pytest.approx(23.0), "1 m/s^2, which is their car's acceleration in car following"
    ego, (leader,) = drive(15, vehicle(x=160.0, speed=15.0), ego=vehicle(speed=25.0), ads=make())
    assert ego.x < leader.x
    assert ego.speed < 16.0


def test_safety_model_accelerates_again_one_second_after_danger():
    ads = module("jrc_fsm").make()

    def decision(time, x):
        return ads(Observation(time, vehicle(), (vehicle(x=x, speed=10.0),), 3, 4.0, 26.8)).acceleration

    decision(0.0, x=115.0)
    assert [decision(time, x=300.0) for time in (0.2, 0.6, 1.0)] == [0.0, 0.0, 0.0]
    assert decision(1.2, x=300.0) == pytest.approx(1.0)


def test_avlite_returns_to_its_lane_and_follows_leader():
    pytest.importorskip("avlite", reason="needs pip install avlite==0.6.6")
    make = module("avlite").make
    ego, _ = drive(4, ego=vehicle(y=4.8, heading=0.02), ads=make())
    assert ego.y == pytest.approx(4.0, abs=0.1)
    ego, (leader,) = drive(15, vehicle(x=160.0, speed=15.0), ego=vehicle(speed=25.0), ads=make())
    assert (ego.x < leader.x, ego.speed < 16.0, ego.lane) == (True, True, 1)


def test_avlites_pipeline_overtakes_slow_leader():
    pytest.importorskip("avlite", reason="needs pip install avlite==0.6.6")
    ego, (slow,) = drive(7, vehicle(x=150.0, speed=15.0), ego=vehicle(), ads=module("avlite").overtaking())
    assert ego.x > slow.x


def test_frenet_planner_overtakes_and_takes_next_lane():
    make = module("python_robotics").make
    ego, (slow,) = drive(15, vehicle(x=160.0, speed=15.0), ego=vehicle(speed=25.0), ads=make())
    assert ego.x > slow.x
    assert ego.speed == pytest.approx(26.8, abs=0.2)
    assert ego.y == pytest.approx(0.0, abs=0.1)


def test_frenet_planner_without_path_brakes_hard():
    wall = [vehicle(x=112.0, y=y, speed=0.0) for y in (0.0, 4.0, 8.0)]
    answer = module("python_robotics").make()(Observation(0.0, vehicle(), tuple(wall), 3, 4.0, 26.8))
    assert answer == Drive(lane=1, acceleration=-8.0)


@pytest.mark.parametrize("agent", ["make", "value_iteration"])
def test_lookahead_agent_seeks_reward_of_its_environment(agent):
    pytest.importorskip("gym", reason="needs pip install gym==0.26.2")
    slow = Scenario(npcs=[[PositionInstruction(Cell.LEFT, 10.0)]], gene_seconds=6.0)
    trace = World("highway-v0", duration=6.0).rollout(slow, getattr(module("rl_agents"), agent))
    assert trace.outcome is Outcome.SAFE, trace.error
    assert trace.ego[-1, 1] == pytest.approx(12.0, abs=0.1), "the rightmost lane"
    assert trace.ego[-1, 3] == pytest.approx(30.0, abs=0.1), "the highest speed of its meta-actions"


REPOSITORIES = {
    "JRC_FSM": "ec-jrc/JRC-FSM",
    "PYTHON_ROBOTICS": "AtsushiSakai/PythonRobotics",
    "RL_AGENTS": "eleurent/rl-agents",
    "FINITE_MDP": "eleurent/finite-mdp",
}


@pytest.mark.parametrize(("name", "variable"), [(name, each) for name, names in CLONES.items() for each in names])
@pytest.mark.parametrize("is_set", [False, True])
def test_error_without_clone_names_variable_and_repository(monkeypatch, tmp_path, name, variable, is_set):
    monkeypatch.delitem(sys.modules, f"example_ads.{name}", raising=False)
    first = ModuleType("rl_agents")  # the first of two is there
    first.__file__ = str(tmp_path / "rl_agents" / "__init__.py")
    monkeypatch.setitem(sys.modules, "rl_agents", first)
    (tmp_path / "rl_agents").mkdir()
    monkeypatch.setenv("RL_AGENTS", str(tmp_path))
    empty = tmp_path / "empty"
    monkeypatch.setenv(variable, str(empty)) if is_set else monkeypatch.delenv(variable, raising=False)
    with pytest.raises(ImportError) as raised:
        importlib.import_module(f"example_ads.{name}")
    expected = f"{variable}: expected the folder of a clone of https://github.com/{REPOSITORIES[variable]} at commit "
    assert str(raised.value).startswith(expected)
    assert f"received {str(empty) if is_set else None!r}; clone it" in str(raised.value)
    assert str(raised.value).endswith(f"set the environment variable {variable} to its folder")


def test_a_module_of_the_same_name_from_elsewhere_is_refused(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "example_ads.jrc_fsm", raising=False)
    mine = ModuleType("utility")
    mine.__file__ = "/mine/utility.py"
    monkeypatch.setitem(sys.modules, "utility", mine)
    (tmp_path / "utility").mkdir()
    monkeypatch.setenv("JRC_FSM", str(tmp_path))
    with pytest.raises(
        ImportError, match=r"JRC_FSM: expected the package utility of .*, received /mine/utility\.py, of the"
    ):
        importlib.import_module("example_ads.jrc_fsm")
