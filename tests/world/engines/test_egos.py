"""Which driver drives an ego, and that every run equals the run by highway-env's own ``env.step``."""

import functools
from dataclasses import replace

import pytest
from highway_env import utils
from highway_env.road import road
from highway_env.vehicle.behavior import AggressiveVehicle, IDMVehicle, LinearVehicle
from highway_env.vehicle.controller import MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from hypothesis import example, given
from hypothesis import strategies as st

from example_ads import defects
from pytest_pafot import Highway, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world import base_world as egos
from pytest_pafot.world.driving.environment import ObjectDriver
from pytest_pafot.world.driving.policy import CONSTANTS, idm_model
from pytest_pafot.world.engines.run import VehiclesOfRun
from pytest_pafot.world.kernel.lanes import Body
from pytest_pafot.world.kernel.loop import ModelDriver, PlannerDriver
from tests.helpers.c_library import c_library
from tests.helpers.run_cases import ALL_EGOS, Case, Hurried, differences
from tests.helpers.world_cases import TRAFFICS, constant_speed

NPCS = [[PositionInstruction(2, 15.0)], [PositionInstruction(4, 20.0)]]
SCENARIO = Scenario(npcs=NPCS, gene_seconds=4.0)


class Own(IDMVehicle):
    """A class that only sets constants, before one of the ways below gives it code."""

    TIME_WANTED = 1.0


class Steers:
    def steering_control(self, target_lane_index):
        return 0.0


class Behind(IDMVehicle, Steers):
    """A base that stands behind IDMVehicle."""


class Described:
    def __get__(self, instance, owner):
        return 1.5 if instance is None else 9.0


class Descriptor(IDMVehicle):
    TIME_WANTED = Described()


class Meta(type(IDMVehicle)):
    def __call__(cls, *given, **named):
        made = super().__call__(*given, **named)
        made.acceleration = lambda **_: -1.0
        return made


class Made(IDMVehicle, metaclass=Meta):
    """A class whose metaclass gives each vehicle a function of its own."""


def test_class_with_code_of_its_own_is_not_driven_by_the_model(monkeypatch):
    assert idm_model(IDMVehicle) is not None
    assert idm_model(Own).constants["TIME_WANTED"] == 1.0
    assert [idm_model(each) for each in (Behind, Descriptor, Made)] == [None] * 3
    for thing, name in (
        (IDMVehicle, "acceleration"),
        (MDPVehicle.__base__, "steering_control"),
        (Vehicle, "step"),
        (road.Road, "neighbour_vehicles"),
        (utils, "not_zero"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(thing, name, lambda *_, **__: 0.0)
            assert idm_model(Own) is None
    assert idm_model(Own) is not None


# --- the same results


def assert_same(case):
    with c_library():
        assert differences(case.run(), case.run_in_gym()) == []


@given(st.integers(10_000, 2**32))
# where the dot product of numpy's linear algebra rounds otherwise than its products and their sum
@example(133_539)
def test_run_equals_that_of_env_step_exactly(seed):
    assert_same(Case.random(seed))


def in_python(cls):
    """Return a vehicle class that drives the same, but has code of its own, so that its objects drive."""
    return type("InPython", (cls,), {"act": lambda self, action=None: cls.act(self, action)})


def test_compared_random_runs_cover_all_egos_and_ends():
    cases = [Case.random(seed) for seed in range(150)]
    outcomes = {case.run().outcome for case in cases}
    assert {case.ego for case in cases} == set(ALL_EGOS)
    assert {Outcome.COMPLETED, Outcome.COLLISION, Outcome.OFF_ROAD, Outcome.ADS_ERROR} <= outcomes
    assert {len(case.scenario.npcs) for case in cases} == set(range(1, 9))
    assert {case.scenario.traffic for case in cases} == set(TRAFFICS)


def test_a_model_that_drives_otherwise_is_noticed(monkeypatch):
    case = Case(Highway(), SCENARIO, IDMVehicle)
    slower = {name: getattr(IDMVehicle, name) for name in CONSTANTS} | {"TIME_WANTED": 1.5000001}
    model = replace(idm_model(IDMVehicle), constants=slower)
    monkeypatch.setattr(egos, "idm_model", lambda ads: model)
    with c_library():
        assert differences(case.run(), case.run_in_gym()) != []


# --- which driver drives


@pytest.fixture
def drivers(monkeypatch):
    """Return the classes of the drivers that drove, in order."""
    classes, drive = [], VehiclesOfRun.drive
    drives = lambda run, driver, *given: classes.append(type(driver)) or drive(run, driver, *given)  # noqa: E731
    monkeypatch.setattr(VehiclesOfRun, "drive", drives)
    return classes


class OwnRules(IDMVehicle):
    def mobil(self, lane_index):
        return False


class OwnStart(Hurried):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


class OwnAttribute(IDMVehicle):
    MAX_SPEED = 30.0


@pytest.mark.parametrize(("ads", "expected"), [
    (constant_speed, PlannerDriver),
    (IDMVehicle, ModelDriver),
    (Hurried, ModelDriver),
    (lambda: Hurried, ModelDriver),
    (functools.partial(IDMVehicle, enable_lane_change=False), ModelDriver),
    (functools.partial(IDMVehicle, target_speed=20.0), ObjectDriver),
    (functools.partial(IDMVehicle, timer=0.3), ObjectDriver),
    (in_python(IDMVehicle), ObjectDriver),
    (OwnRules, ObjectDriver),
    (OwnStart, ObjectDriver),
    (OwnAttribute, ObjectDriver),
    (LinearVehicle, ObjectDriver),
    (AggressiveVehicle, ObjectDriver),
    (MDPVehicle, ObjectDriver),
    (Vehicle, ObjectDriver),
    *((defects.make(name), ObjectDriver) for name in ("healthy", "brakes-weakly")),
])  # fmt: skip
def test_compiled_model_drives_whichever_class_it_equals(drivers, ads, expected):
    Highway().rollout(SCENARIO, ads)
    assert drivers == [expected]


def test_world_says_which_classes_the_compiled_model_drives():
    given = IDMVehicle, Hurried, OwnRules, constant_speed
    assert [Highway().runs_in_kernel(ads) for ads in given] == [True, True, False, False]


@pytest.mark.parametrize("world", [Highway(), World("highway-v0")])
def test_reference_drivers_get_through_as_planners(world, drivers):
    trace = world.rollout_reference(SCENARIO, "careful-human")
    assert trace.outcome is Outcome.COMPLETED
    assert drivers == [PlannerDriver]


def overrun():
    """Record a tick too much.

    The kernel writes without looking at each index, so one look must keep it within its buffer.
    """
    world, npcs = Highway(), [[PositionInstruction(2, 20.0)]]
    scenario = Scenario.repaired(npcs, seed=1, ego_lane=1, ego_speed=20.0)
    run = VehiclesOfRun(world.rules, scenario, Body(5.0, 2.0), world.stock_road)
    for _ in range(world.rules.ticks(scenario) + 1):
        run.loop.moved()


def test_record_has_no_room_for_ticks_beyond_the_run():
    with pytest.raises(IndexError):
        overrun()
