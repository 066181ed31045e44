"""Free NPCs: each is the ego of its driver, on the same road as the ego."""

import math
import random
import time

import numpy as np
import pytest
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from hypothesis import given, reject
from hypothesis import strategies as st

from pytest_pafot import (
    TRUCK,
    Drive,
    Free,
    Highway,
    LaneInstruction,
    Manoeuvre,
    Outcome,
    PositionInstruction,
    Run,
    Scenario,
    Step,
    World,
    strategies,
)
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.trace import ACCELERATION, LANE, SPEED, STEERING, X, Y
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.world.driving.idm_model import CONSTANTS
from pytest_pafot.world.driving.perception import Perception
from pytest_pafot.world.engines.npc_drivers import IDM
from tests.helpers.c_library import c_library

WORLD = Highway(duration=12.0)


def steady(observation):
    return 0.0, 0.0


def following(observation):
    ego = observation.ego
    gaps = [each.x - ego.x for each in observation.others if abs(each.y - ego.y) < 2 and each.x > ego.x]
    return (-6.0 if min(gaps, default=math.inf) < 5 + 1.2 * ego.speed else 0.5 * (ego.speed < 24)), 0.0


def free(driver="idm", beside=0, ahead=30.0, speed=20.0):
    return (Free(beside=beside, ahead=ahead, speed=speed, driver=driver),)


def run(*npcs, ads=steady, world=WORLD, **more):
    return world.rollout(Scenario(npcs=npcs, **more), lambda: ads)


def states(*traces):
    return {trace.states.tobytes() for trace in traces}


# Models of traffic.


def test_constants_are_those_of_highway_env():
    assert dict(IDM) == {name: getattr(IDMVehicle, name) for name in CONSTANTS}


@pytest.mark.parametrize("driver", ["idm", "mobil"])
@pytest.mark.parametrize("seed", range(8))
def test_traffic_drives_as_highway_envs_to_the_last_bit(driver, seed):
    """The others here are neither, so each wants the speed that it has; and nobody comes to a stand."""
    rng = random.Random(seed)
    scenario = Scenario(
        npcs=(
            free(driver, beside=0, ahead=-25.0 - rng.randrange(20), speed=24.0 + rng.randrange(3)),
            tuple(LaneInstruction(rng.choice(("keep", "left", "right")), 16.0 + rng.randrange(10)) for _ in range(4)),
        ),
        gene_seconds=3.0,
    )
    trace = WORLD.rollout(scenario, lambda: lambda seen: Drive(lane=1, speed=20.0))
    network = RoadNetwork.straight_road_network(WORLD.lanes, length=WORLD.road.length, speed_limit=WORLD.speed_limit)
    road = Road(network)
    start = trace.states[0, 1]
    car = IDMVehicle(road, [start[X], start[Y]], 0.0, start[SPEED], enable_lane_change=driver == "mobil")
    others = [Taken(road, [row[X], row[Y]], row[2], row[SPEED]) for row in trace.states[0, [0, 2]]]
    road.vehicles = [others[0], car, others[1]]
    assert trace.ticks == 180
    with c_library():  # on whose functions all machines agree
        for row in trace.states[1:]:
            car.act()
            car.step(1 / 15)
            for other, (x, y, heading, speed, *_) in zip(others, row[[0, 2]], strict=True):
                other.position, other.heading, other.speed = np.array([x, y]), heading, speed
            assert (*car.position, car.heading, car.speed) == tuple(row[1, :4])


class Taken(IDMVehicle):
    """A vehicle that is put where another one is, and wants the speed that it has."""

    target_speed = property(lambda self: self.speed, lambda self, _: None)
    act = None


def test_idm_keeps_its_lane_and_mobil_overtakes():
    slow = (LaneInstruction("keep", 10.0),)
    kept, overtaken = (
        run(free(driver, ahead=-20.0, speed=26.0, beside=1), slow, ads=steady, gene_seconds=12.0)
        for driver in ("idm", "mobil")
    )
    assert set(kept.states[:, 1, Y]) == {8.0}
    assert (
        abs(run(free("mobil", speed=26.0, ahead=-20.0), ads=lambda _: Drive(lane=1, speed=12.0)).states[-1, 1, Y] - 4)
        > 3
    )
    assert overtaken.outcome is Outcome.SAFE


def test_traffic_does_not_reverse():
    trace = run(free(ahead=20.0, speed=3.0), free(ahead=27.0, speed=0.0), ads=lambda _: (-6.0, 0.0))
    assert trace.states[:, 1:, SPEED].min() >= 0


# The policy under test, and others.


def test_policy_drives_an_npc_as_its_ego():
    """Two equal cars, each with an empty road ahead, drive alike, whichever of them is the ego."""
    seen = []

    class Noting:
        def __call__(self, observation):
            seen.append(observation)
            return 0.5, 0.0

    WORLD.rollout(Scenario(npcs=(free("policy", beside=2, ahead=30.0, speed=20.0), free())), Noting)
    (mine, its) = seen[:2]
    assert mine.ego == its.others[0]
    assert its.ego == mine.others[0]
    assert its.others[1] == mine.others[1]
    assert its.ids == (0, 1)
    assert (seen[3].ego.speed, seen[3].acceleration) == (pytest.approx(20.1), 0.5)
    assert its.array.tolist() == [list(each) for each in (its.ego, *its.others)]
    assert seen[3].acceleration == 0.5


def test_controls_of_a_planner_hold_until_its_next_decision():
    world = WORLD.with_drivers({"turning": lambda: lambda seen: (0.5, 0.01)})
    trace = run(free("turning", beside=-1, ahead=60.0), world=world, gene_seconds=1.0)
    assert set(trace.states[1:, 1, STEERING]) == {0.01}
    assert set(trace.states[1:, 1, ACCELERATION]) == {0.5}


class Lively(IDMVehicle):
    COMFORT_ACC_MAX = 6.0


def test_named_drivers_are_those_of_the_world():
    world = WORLD.with_drivers({"last": lambda: lambda _: Drive(lane=3, speed=12.0), "fast": Lively})
    trace = run(free("last", beside=1), free("fast", beside=-1, ahead=-30.0, speed=25.0), world=world)
    assert trace.states[-1, 1, Y] == pytest.approx(12.0, abs=0.1)
    assert trace.states[-1, 1, SPEED] == pytest.approx(12.0, abs=0.1)
    assert trace.states[-1, 2, X] > 200 + 12 * 22
    assert world == WORLD
    assert world.to_dict() == WORLD.to_dict()


def test_each_run_and_npc_has_a_driver_of_its_own():
    made = []

    class Counting:
        def __init__(self):
            made.append(self)

        def __call__(self, observation):
            return 0.0, 0.0

        def close(self):
            closed.append(self)

    closed = []
    world = WORLD.with_drivers({"counting": Counting})
    run(free("counting"), free("counting", beside=1), world=world)
    assert len(made) == 2
    assert closed == made


@pytest.mark.parametrize("driver", ["idm", "mobil", "policy"])
def test_run_is_repeated_by_gymnasium_and_by_drivers_that_take_over(driver):
    scenario = Scenario(npcs=(free(driver), free(driver, ahead=-20.0, speed=24.0), (PositionInstruction(2, 18.0),)))
    world = WORLD.with_drivers({"policy": lambda: following})
    trace = world.rollout(scenario, lambda: following)
    assert states(trace) == states(world.rollout_in_gym(scenario, lambda: following))
    taken = world.take_over(trace, 60, "steady-braking")
    assert (taken.states[:61] == trace.states[:61]).all()
    assert world.rollout_reference(scenario, "careful-human").outcome is not None


def test_ego_that_drives_itself_meets_free_npcs():
    trace = WORLD.rollout(Scenario(npcs=(free("policy", speed=15.0), free("mobil", ahead=-20.0))), lambda: IDMVehicle)
    assert trace.outcome is Outcome.SAFE
    assert trace.states[-1, 1, SPEED] == 15.0  # its start speed is the speed that it wants


class Drawing:
    """A driver that draws from both global generators."""

    def __call__(self, observation):
        return random.uniform(-1, 1) + np.random.normal(), 0.0


def test_draws_follow_from_the_seed_and_not_from_the_ego():
    world = WORLD.with_drivers({"drawing": Drawing})
    scenario = Scenario(npcs=(free("drawing", beside=2), free("drawing", beside=1, ahead=-30.0)))
    before = random.getstate(), np.random.get_state()[1].tolist()
    first = world.rollout(scenario, lambda: steady)
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before

    def drawing_too(observation):
        random.random()
        np.random.random()
        return 0.0, 0.0

    again = world.rollout(scenario, lambda: drawing_too)
    assert states(first) == states(again)
    speeds = first.states[:, 1:, SPEED]
    assert abs(speeds[-1, 0] - 20 - (speeds[-1, 1] - 20)) > 0.1
    other = world.rollout(Scenario(npcs=scenario.npcs, seed=1), lambda: steady)
    assert (other.states[:, 1:, SPEED] != speeds).any()


def test_imperfect_sight_is_that_of_the_driver():
    seen = []
    blind = Perception(lambda: lambda observation: seen.append(observation) or (0.0, 0.0), range=10.0)
    run(free("blind"), world=WORLD.with_drivers({"blind": blind}))
    assert seen[0].others == ()


@pytest.mark.parametrize("driver", ["idm", "mobil", "policy", "long"])
def test_free_npc_has_the_box_of_its_vehicle(driver):
    """A class has a length of its own, which counts no more than for the vehicles that the director moves."""
    world = WORLD.with_drivers({"long": type("Long", (IDMVehicle,), {"LENGTH": 8.0})})
    npcs = (free(driver, speed=26.0), free(driver, beside=1, ahead=-30.0, speed=18.0))
    scenario = Scenario(npcs=npcs, vehicles=("truck",))
    trace = world.rollout(scenario, lambda: following)
    assert trace.sizes.tolist() == [[5.0, 2.0], [12.0, 2.55], [5.0, 2.0]]
    assert trace.states[0, 1, X] - trace.states[0, 0, X] == pytest.approx(30.0 + (5.0 + 12.0) / 2)
    assert trace.states[0, 1, SPEED] == TRUCK.top_speed
    assert states(trace) == states(world.rollout_in_gym(scenario, lambda: following))


def test_driver_of_a_truck_sees_its_size():
    seen = []
    world = WORLD.with_drivers({"own": lambda: lambda observation: seen.append(observation) or (0.0, 0.0)})
    world.rollout(Scenario(npcs=(free("own"),), vehicles=("truck",)), lambda: steady)
    assert (seen[0].ego.length, seen[0].ego.width, seen[0].others[0].length) == (12.0, 2.55, 5.0)


def test_idm_in_a_truck_stops_behind_another_one():
    scenario = Scenario(
        npcs=(free(beside=1, ahead=20.0), free(beside=1, ahead=80.0, speed=0.0)), vehicles=("truck", "truck")
    )
    trace = WORLD.rollout(scenario, lambda: steady)
    assert trace.outcome is Outcome.SAFE
    assert trace.states[-1, 1, SPEED] < 0.5
    assert 2.0 < trace.states[-1, 2, X] - trace.states[-1, 1, X] - TRUCK.length < 8.0


# Failures of drivers.


@pytest.mark.parametrize("driver", ["idm", "mobil", "own"])
def test_free_truck_keeps_the_limits_of_a_truck(driver):
    """The vehicle ahead brakes it, and then goes off; the own planner asks for more than a car can do."""
    world = Highway(duration=20.0).with_drivers({"own": lambda: lambda seen: (8.0 if seen.time < 15.0 else -12.0, 0.0)})
    away = Step(after=5.0, speed=25.0, acceleration=4.0)
    leader = (Manoeuvre(beside=1, ahead=75.0 if driver != "own" else 300.0, speed=10.0, steps=(away,)),)
    trace = run(free(driver, beside=1, speed=22.0), leader, world=world, vehicles=("truck", "car"))
    assert trace.outcome is Outcome.SAFE
    npc = trace.npcs[:, 0]
    assert npc[:, ACCELERATION].max() == pytest.approx(TRUCK.acceleration)
    assert npc[:, ACCELERATION].min() >= -TRUCK.braking - 1e-9
    assert npc[:, SPEED].max() <= TRUCK.top_speed + 1e-6


def raising(observation):
    raise ValueError("no way ahead")


@pytest.mark.parametrize(
    ("driver", "message"),
    [(raising, "no way ahead"), (lambda _: "left", "acceleration"), (lambda _: Drive(lane=9, speed=1.0), "lane")],
)
def test_failing_driver_makes_the_run_invalid(driver, message):
    trace = run(free(), free("own", beside=1), world=WORLD.with_drivers({"own": lambda: driver}))
    assert trace.outcome is Outcome.INVALID
    assert trace.error is None
    npc, error = trace.npc_error
    assert npc == 1
    assert message in error.message
    assert trace.ticks == 0


def test_hanging_driver_makes_the_run_invalid():
    def hanging(observation):
        if observation.time > 1.0:
            time.sleep(60)
        return 0.0, 0.0

    world = Highway(duration=12.0, hang_limit=0.1).with_drivers({"own": lambda: hanging})
    trace = run(free("own"), world=world)
    assert trace.outcome is Outcome.INVALID
    assert trace.npc_error[1].interrupted
    assert trace.ticks == 18


def test_policy_of_an_npc_that_raises_is_no_failure_of_the_ego():
    def only_in_lane_1(observation):
        if observation.ego.lane != 1:
            raise ValueError("unknown lane")
        return 0.0, 0.0

    assert run(free("policy", beside=1), ads=only_in_lane_1).npc_error[1].kind == "ValueError"


# What is refused.


def test_unknown_driver_is_refused():
    with pytest.raises(ScenarioError, match=r"npcs\[0\]\[0\]\.driver: expected one of idm, mobil, policy, received"):
        run(free("last"))


@pytest.mark.parametrize("name", ["", 3, "a b", "x" * 41])
def test_name_of_a_driver_is_checked(name):
    with pytest.raises(ScenarioError, match="expected idm, mobil, policy, or a name"):
        free(name)


def test_names_of_models_are_not_for_others():
    with pytest.raises(ScenarioError, match="expected other names than idm and mobil, received idm"):
        WORLD.with_drivers({"idm": lambda: steady})


def test_policy_that_cannot_drive_npcs_is_refused():
    scenario = Scenario(npcs=(free("policy"),), ego_lane=1)
    with pytest.raises(ScenarioError, match=r"npcs\[0\]\[0\].driver: expected a run that knows the policy"):
        World("highway-v0", duration=4.0).rollout(scenario, lambda: lambda seen: 1)
    with pytest.raises(ScenarioError, match="needs the environment itself"):
        run(free("own"), world=WORLD.with_drivers({"own": lambda env: steady}))
    with pytest.raises(AdsFactoryError, match=r"drivers\['own'\]: expected the factory to return an ADS"):
        run(free("own"), world=WORLD.with_drivers({"own": lambda: 3}))

    class Own(IDMVehicle):
        def act(self, action=None):
            super().act(action)

    with pytest.raises(ScenarioError, match="a vehicle class with code of its own"):
        run(free("own"), world=WORLD.with_drivers({"own": Own}))


def test_policy_that_is_named_drives_an_npc_where_that_of_the_run_cannot():
    """These are the ways out of the refusal: a vehicle class, or a world of planners."""
    scenario, keeps = Scenario(npcs=(free("policy"),), ego_lane=1), {"policy": lambda: steady}
    world, of_planners = (World("highway-v0", duration=4.0, planner_hz=hz) for hz in (None, 5))
    with pytest.raises(ScenarioError, match="without it a vehicle class"):
        world.with_drivers(keeps).rollout(scenario, lambda: lambda seen: 1)
    named = world.with_drivers({"policy": IDMVehicle}).rollout(scenario, lambda: lambda seen: 1)
    driven = of_planners.with_drivers(keeps).rollout_reference(scenario, "careful-human")
    assert named.outcome is driven.outcome is Outcome.SAFE


def test_policy_of_an_environment_meets_free_npcs():
    world = World("highway-v0", duration=8.0)
    scenario = Scenario(npcs=(free("mobil", speed=15.0), free("idm", ahead=-30.0, speed=24.0)), ego_lane=1)
    trace = world.rollout(scenario, lambda: lambda seen: 1)
    assert trace.npc_error is None
    assert states(trace) == states(world.rollout_in_gym(scenario, lambda: lambda seen: 1))


@pytest.mark.parametrize("wrappers", [None, []])
@pytest.mark.parametrize("begin", [0.0, 2.0])
def test_failing_driver_makes_an_episode_of_an_environment_invalid(wrappers, begin):
    """It fails where a step begins, which then moves nothing."""
    driver = lambda seen: raising(seen) if seen.time >= begin else steady(seen)  # noqa: E731
    world = World("highway-v0", duration=8.0, wrappers=wrappers).with_drivers({"own": lambda: driver})
    trace = world.rollout_in_gym(Scenario(npcs=(free("own"),), ego_lane=1), lambda: lambda seen: 1)
    assert (trace.outcome, trace.duration, trace.error) == (Outcome.INVALID, begin, None)
    assert trace.npc_error[1].message == "no way ahead"


# On other worlds, and whatever the scenario is.


@pytest.mark.parametrize("planner_hz", [5, None])
def test_planners_drive_in_an_environment_with_a_straight_road(planner_hz):
    world = World("highway-v0", duration=6.0, planner_hz=planner_hz).with_drivers({"last": lambda: following})
    scenario = Scenario(npcs=(free("last", ahead=-30.0, speed=24.0), free("mobil", speed=12.0)), ego_lane=1)
    ads = (lambda: following) if planner_hz else (lambda: lambda seen: 1)
    trace = world.rollout(scenario, ads)
    assert trace.npc_error is None
    assert states(trace) == states(world.rollout_in_gym(scenario, ads))


def test_run_of_a_failed_driver_is_explained():
    trace = run(free("own", beside=1), world=WORLD.with_drivers({"own": lambda: raising}))
    expected = "invalid after 0.0 s: the driver own failed: ValueError: no way ahead (NPC 0)"
    assert Run(trace).explain().splitlines()[0] == expected


scenarios = st.builds(
    lambda frees, seed: Scenario(npcs=tuple((each,) for each in frees), seed=seed, ego_lane=1, ego_speed=18.0),
    st.lists(
        strategies.free_npcs(drivers=["idm", "mobil", "policy"], max_distance=80.0, min_speed=1.0),
        min_size=1,
        max_size=4,
    ),
    st.integers(0, 9),
)


@given(scenarios)
def test_free_npcs_keep_their_limits_in_any_scenario(scenario):
    world = Highway(duration=8.0).with_drivers({"policy": lambda: following})
    try:
        world.check_fits(scenario)
    except ScenarioError:
        reject()
    trace = world.rollout(scenario, lambda: following)
    npcs = trace.states[:, 1:]
    assert npcs[..., SPEED].min() >= -1e-9
    assert npcs[..., SPEED].max() <= world.speed_limit + 1e-6
    assert np.abs(npcs[..., ACCELERATION]).max() <= 6.0 + 1e-9
    assert (npcs[..., LANE] >= 0).all()
    assert states(trace) == states(world.rollout(scenario, lambda: following))
    kept = [each[0].driver != "mobil" for each in scenario.npcs]
    assert (npcs[:, kept, Y] == npcs[0, kept, Y]).all()
