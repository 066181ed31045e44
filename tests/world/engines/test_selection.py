"""The kernel and highway-env's objects: which one runs, and that both give the same trace."""

from __future__ import annotations

import functools
import json
import pickle
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from highway_env.vehicle.behavior import AggressiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from hypothesis import example, given, settings
from hypothesis import strategies as st

from example_ads import defects
from pytest_pafot import Highway, Outcome, PositionInstruction, Scenario, World, WorldError
from pytest_pafot.model.driving_style import STYLES
from pytest_pafot.model.scenario import CrossingInstruction
from pytest_pafot.searching import sample
from pytest_pafot.world import from_dict, kernel
from pytest_pafot.world.driving.idm_model import CONSTANTS, idm_model
from pytest_pafot.world.engines import selection as engines
from pytest_pafot.world.kernel import bodies
from tests.helpers.c_library import c_library
from tests.helpers.engine_cases import ALL_EGOS, Case, Hurried, differences, digest
from tests.helpers.interpreted import InterpretedWorld
from tests.helpers.road_cases import space_of, world_of
from tests.helpers.stages import mostly_oracle, oracle
from tests.helpers.tables import table
from tests.helpers.world_cases import TRAFFICS

SCENARIO = Scenario(npcs=[[PositionInstruction(2, 15.0)], [PositionInstruction(4, 20.0)]], gene_seconds=4.0)


def idle():
    return lambda observation: (0.0, 0.0)


# --- the same results


def assert_same(case):
    with c_library():
        assert differences(case.run("kernel"), case.run("highway-env")) == []


@given(st.integers(10_000, 2**32))
@example(133_539)  # where the dot product of numpy's linear algebra rounds otherwise than its products and their sum
def test_both_engines_give_exactly_the_same_trace(seed):
    assert_same(Case.random(seed))


@pytest.mark.oracle
@pytest.mark.parametrize("ego", ALL_EGOS, ids=lambda ego: ego.__name__)
@settings(max_examples=12)
@given(seed=st.integers(10_000, 2**32))
def test_both_engines_give_same_trace_for_every_ego(ego, seed):
    assert_same(replace(Case.random(seed), ego=ego))


@pytest.mark.parametrize("first", [10_000, oracle(10_020)])
def test_numpy_rounding_changes_positions_by_less_than_centimetre(first):
    """This is true of nearly all runs, but rounding can decide a vehicle's action, so the test names these runs."""
    cases = [Case.random(seed) for seed in range(first, first + 20)]
    # The model of an IDM ego that wants to stand oscillates around 0 m/s, which amplifies any rounding.
    cases = [case for case in cases if case.ego not in (IDMVehicle, Hurried) or case.scenario.ego_speed > 0]
    assert len(cases) > 13
    for case in cases:
        fast, stock = case.run("kernel"), case.run("highway-env")
        assert (fast.outcome, fast.executed, fast.arrivals) == (stock.outcome, stock.executed, stock.arrivals)
        assert abs(fast.states[..., :2] - stock.states[..., :2]).max() < 0.01


def test_compared_random_runs_cover_all_egos_and_ends():
    cases = [Case.random(seed) for seed in range(150)]
    outcomes = {case.run("kernel").outcome for case in cases}
    assert {case.ego for case in cases} == set(ALL_EGOS)
    assert {Outcome.SAFE, Outcome.COLLISION, Outcome.OFF_ROAD, Outcome.ADS_ERROR} <= outcomes
    assert {len(case.scenario.npcs) for case in cases} == set(range(1, 9))
    assert {case.scenario.traffic for case in cases} == set(TRAFFICS)


def test_a_kernel_that_drives_otherwise_is_noticed(monkeypatch):
    case = Case(Highway(), SCENARIO, IDMVehicle)
    slower = {name: getattr(IDMVehicle, name) for name in CONSTANTS} | {"TIME_WANTED": 1.5000001}
    model = replace(idm_model(IDMVehicle), constants=slower)
    monkeypatch.setattr(engines, "idm_model", lambda ads: model)
    with c_library():
        assert differences(case.run("kernel"), case.run("highway-env")) != []


@pytest.fixture(scope="module")
def interpreted():
    return InterpretedWorld()


@pytest.mark.parametrize("seeds", [range(12), oracle(range(12, 40))], ids=str)
def test_interpreted_and_compiled_kernel_give_same_traces(interpreted, seeds):
    for case in map(Case.random, seeds):
        compiled = digest(case.run("kernel"))
        with interpreted.in_place():
            world = interpreted.room.from_dict(case.world.to_dict())
            assert digest(replace(case, world=world).run("kernel")) == compiled


@pytest.mark.parametrize("style", mostly_oracle(STYLES, STYLES[0]))
def test_interpreted_and_compiled_npcs_match_in_bends(interpreted, style):
    world = world_of("roundabout-v1", duration=10.0)
    scenario = sample(space_of(world, traffic=style), np.random.default_rng(2))
    compiled = digest(world.rollout(scenario, IDMVehicle))
    with interpreted.in_place():
        again = interpreted.room.from_dict(world.to_dict())
        assert digest(again.rollout(scenario, IDMVehicle)) == compiled


def test_interpreted_and_compiled_npcs_cross_the_same(interpreted):
    world = world_of("intersection-v0")
    crossing = [CrossingInstruction("o1>o3", 0.5, 7.0)], [CrossingInstruction("o3>o0", 1.5, 8.0, "hold")]
    on_grid = [PositionInstruction(2, 8.0)]
    scenario = Scenario(npcs=[*crossing, on_grid], ego_lane=0, ego_speed=10.0)
    compiled = digest(world.rollout(scenario, IDMVehicle))
    with interpreted.in_place():
        again = interpreted.room.from_dict(world.to_dict())
        assert digest(again.rollout(scenario, IDMVehicle)) == compiled


def test_the_kernel_knows_highway_envs_vehicles():
    from pytest_pafot.world.kernel.bodies import NPC_LENGTH, NPC_WIDTH

    assert (Vehicle.LENGTH, Vehicle.WIDTH) == (NPC_LENGTH, NPC_WIDTH)
    body = bodies.Body(5.0, 2.0)
    body.place(0.0, 0.0, 0.0, Vehicle.MAX_SPEED + 1)
    body.acceleration = 3.0
    body.step(0.1)
    assert (body.acceleration, Vehicle.MIN_SPEED) == (-1.0, -Vehicle.MAX_SPEED)


# --- which engine


@pytest.fixture
def ran(monkeypatch):
    """Return the names of the engines that ran, in order."""
    names = []
    for name, engine in (("run_planner", "kernel"), ("run_model", "kernel"), ("_by_objects", "highway-env")):
        original = getattr(engines, name)
        monkeypatch.setattr(
            engines, name, lambda *args, original=original, engine=engine: names.append(engine) or original(*args)
        )
    return names


class OwnRules(IDMVehicle):
    def mobil(self, lane_index):
        return False


class OwnStart(Hurried):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


class OwnAttribute(IDMVehicle):
    MAX_SPEED = 30.0


@pytest.mark.parametrize(
    ("ads", "expected"),
    [
        (idle, "kernel"),
        (IDMVehicle, "kernel"),
        (Hurried, "kernel"),
        (lambda: Hurried, "kernel"),
        (functools.partial(IDMVehicle, enable_lane_change=False), "kernel"),
        (functools.partial(IDMVehicle, target_speed=20.0), "highway-env"),
        (OwnRules, "highway-env"),
        (OwnStart, "highway-env"),
        (OwnAttribute, "highway-env"),
        (LinearVehicle, "highway-env"),
        (AggressiveVehicle, "highway-env"),
        (MDPVehicle, "highway-env"),
        (Vehicle, "highway-env"),
        *((defects.make(name), "highway-env") for name in ("healthy", "brakes-weakly")),
    ],
)
def test_the_kernel_runs_whatever_it_can_drive(ran, ads, expected):
    Highway().rollout(SCENARIO, ads)
    Highway(engine="highway-env").rollout(SCENARIO, ads)
    assert ran == [expected, "highway-env"]


@table("ads", [OwnRules, LinearVehicle, functools.partial(IDMVehicle, timer=0.3)])
def test_kernel_only_world_says_why_it_cannot_drive(ads):
    with pytest.raises(WorldError, match=r"engine: expected an ADS that the kernel can drive.*use engine=\"auto\""):
        Highway(engine="kernel").rollout(SCENARIO, ads)


@table("engine", ["fast", "", None, 1])
def test_an_engine_has_a_name(engine):
    with pytest.raises(WorldError, match=r"engine: expected one of auto, kernel, highway-env, received"):
        Highway(engine=engine)


def test_engine_is_not_part_of_a_saved_world():
    worlds = [Highway(engine=engine) for engine in ("auto", "kernel", "highway-env")]
    assert len({json.dumps(world.to_dict()) for world in worlds}) == 1
    assert all(from_dict(world.to_dict()) == world for world in worlds)
    with pytest.raises(WorldError, match="engine"):
        from_dict({**Highway().to_dict(), "engine": "warp"})


@pytest.mark.parametrize("world", [Highway(engine="highway-env"), Highway(), World("highway-v0")])
def test_reference_drivers_get_through_by_either_engine(world, ran):
    trace = world.rollout_reference(SCENARIO, "idm-aeb")
    assert trace.outcome is Outcome.SAFE
    assert ran == ["highway-env" if world == Highway() and world.engine == "highway-env" else "kernel"]


@pytest.mark.parametrize("name", ["careful-human", "fuzzy-safety", "idm-aeb"])
def test_reference_drivers_drive_the_same_by_both_engines(name):
    for seed in range(5):
        case = Case.random(seed)
        pair = [replace(case.world, engine=e).rollout_reference(case.scenario, name) for e in ("auto", "highway-env")]
        assert differences(*pair) == []


@pytest.mark.skipif(not kernel.is_compiled(), reason="the kernel is not compiled here")
def test_compiled_kernel_matches_the_present_source():
    folder = Path(kernel.__file__).parent
    for name in kernel.MODULES:
        compiled = Path(import_module(f"{kernel.__name__}.{name}").__file__).stat().st_mtime
        for source in (folder / f"{name}.py", folder / f"{name}.pxd"):
            assert source.stat().st_mtime <= compiled + 1, f"{source.name} is newer; run: python -m pip install ."


def test_every_kernel_module_has_types_for_compiler():
    folder = Path(kernel.__file__).parent
    names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert names == set(kernel.MODULES) == {path.stem for path in folder.glob("*.pxd")}


def test_road_and_lanes_can_be_pickled():
    world = Highway()
    again = pickle.loads(pickle.dumps(world.rules))
    assert again == world.rules
    assert (again.road.grid.count, again.road.grid.width) == (4, 4.0)
