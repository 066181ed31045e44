"""The code of an environment sees the NPCs as vehicles of the environment's own traffic, as it does in ``env.step``."""

import random
from abc import abstractmethod

import gymnasium
import numpy as np
import pytest
from highway_env.envs import HighwayEnv, IntersectionEnv, MergeEnv, RoundaboutEnv
from highway_env.envs.common.observation import ObservationType
from highway_env.road.road import Road
from highway_env.vehicle.behavior import AggressiveVehicle, IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle
from highway_env.vehicle.graphics import VehicleGraphics
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

from pytest_pafot import CrossingInstruction, LaneInstruction, PositionInstruction, Scenario, World
from pytest_pafot.algorithms import sample
from pytest_pafot.model.trace import LANE
from pytest_pafot.world.codec import from_dict
from tests.helpers.c_library import c_library
from tests.helpers.refusals import refused
from tests.helpers.road_cases import space_of
from tests.helpers.run_cases import differences
from tests.helpers.tables import table
from tests.helpers.world_cases import constant_speed

IDLE = 1


def observing(base, reads):
    """Return a class of environments whose observation is what a function reads of them."""

    class Read(ObservationType):
        def space(self):
            return gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)

        def observe(self):
            return reads(self.env)

    class Observing(base):
        def define_spaces(self):
            super().define_spaces()
            self.observation_type = Read(self)
            self.observation_space = self.observation_type.space()

    return Observing


def others(env):
    return [each for each in env.road.vehicles if each is not env.vehicle]


# What public environments, observations and supervisors read of other vehicles, in other words.


def forecast(env):
    """What a supervisor for merging expects of the vehicles that are of exactly this class: their own next controls."""
    found = [each for each in others(env) if type(each) is IDMVehicle]
    ahead = [env.road.neighbour_vehicles(each)[0] for each in found]
    return [
        (each.acceleration(each, leader), each.steering_control(each.target_lane_index))
        for each, leader in zip(found, ahead, strict=True)
    ]


def delayed(env):
    """What a planner with slow communication takes for the states of others, extrapolated by their driver model."""
    found = []
    for each in others(env):
        gain = 0.0
        if isinstance(each, IDMVehicle):
            gain = each.acceleration(each, *env.road.neighbour_vehicles(each, each.lane_index))
        x = each.position[0] + 0.3 * each.speed + 0.045 * gain
        found.append((x, each.speed + 0.3 * gain))
    return found


def shares_of_lanes(env):
    """What a reward for each vehicle nearby counts: the lane that it aims at, if it does, and whether it crashed."""
    near = env.road.close_vehicles_to(env.vehicle, 200.0, count=4, see_behind=True)
    lanes = [
        each.target_lane_index if isinstance(each, ControlledVehicle) else each.lane_index
        for each in near
    ]
    return [(lane[2] / 3, float(each.crashed)) for lane, each in zip(lanes, near, strict=True)]


def by_model(env):
    """What a simulation in tensors copies from an environment: its driver models, with their constants."""
    models = [each for each in env.road.vehicles if isinstance(each, IDMVehicle)]
    names = "target_speed", "timer", "DISTANCE_WANTED", "TIME_WANTED", "DELTA", "LANE_CHANGE_DELAY"
    values = [[each.LENGTH, *(getattr(each, name) for name in names)] for each in models]
    return [len(env.road.vehicles) - len(models), values]


def colours(env):
    """What highway-env's own images show: the colour of each vehicle by its class."""
    return [VehicleGraphics.get_color(each) for each in env.road.vehicles]


def merging(env):
    """What the reward of highway-env's merge counts: how far vehicles with a target are from its speed."""
    aims = [each for each in env.road.vehicles if isinstance(each, ControlledVehicle)]
    return [float((each.target_speed - each.speed) / each.target_speed) for each in aims]


LEFT_AND_ON = Scenario(
    npcs=[[LaneInstruction("left", 22.0)], [LaneInstruction("keep", 18.0)]],
    ego_lane=2,
    ego_speed=20.0,
    gene_seconds=8.0,
)
"""One NPC that changes to the lane at its left, and one that stays in its lane."""


@pytest.mark.parametrize("reads", [forecast, delayed, shares_of_lanes, by_model, colours, merging])
def test_public_readers_see_the_values_of_the_environments_own_vehicles(register, reads):
    seen, poses = [], []

    def noting(env):
        vehicles = env.road.vehicles
        poses.append([(e.position.copy(), float(e.heading), float(e.speed)) for e in vehicles])
        return reads(env)

    register("read-v0", entry_point=observing(HighwayEnv, noting))
    world = World("read-v0", config={"policy_frequency": 5}, duration=4.0)
    poses.clear()
    world.rollout(LEFT_AND_ON, lambda: lambda values: seen.append((values, poses[-1])) or IDLE)
    assert len(seen) == 20
    config = {"vehicles_count": 0, "policy_frequency": 5}
    env = gymnasium.make("highway-v0", config=config).unwrapped
    env.reset(seed=0)
    places = [position for position, *_ in seen[0][1][1:]]
    starts = [(sum(place) * np.pi % 1.0, round(place[1] / 4.0)) for place in places]
    for number, (values, (ego, *npcs)) in enumerate(seen):
        made = env.action_type.vehicle_class(env.road, *ego)
        env.road.vehicles, env.controlled_vehicles = [made], [made]
        changes = (1 if number else 0, 0)
        for pose, speed, change, (timer, lane) in zip(
            npcs, (22.0, 18.0), changes, starts, strict=True
        ):
            given = {"target_lane_index": ("0", "1", lane - change), "target_speed": speed}
            env.road.vehicles.append(IDMVehicle(env.road, *pose, **given, timer=timer))
        assert repr(values) == repr(reads(env))


ATTRIBUTES = (
    "lane_index", "target_lane_index", "target_speed", "route", "timer", "enable_lane_change", "crashed", "hit",
    "impact", "check_collisions", "collidable", "solid", "on_road", "prediction_type", "destination", "velocity",
    "direction", "lane_offset", "diagonal", "LENGTH", "WIDTH", "DISTANCE_WANTED", "COMFORT_ACC_MAX", "mood",
)  # fmt: skip


def plain(value):
    return value.tolist() if isinstance(value, np.ndarray) else value


def everything(env):
    """What there is to read of the others, as plain numbers and texts: all of them hold in ``env.step``."""
    found = []
    for each in others(env):
        numbers = each.to_dict(env.vehicle) | each.action
        found.append((
            type(each),
            env.road.network.get_lane(each.lane_index) is each.lane,
            {name: float(value) for name, value in numbers.items()},
            [(name, plain(getattr(each, name, None))) for name in ATTRIBUTES],
        ))  # fmt: skip
    return found


class Own(IDMVehicle):
    """A class that would move otherwise, has a place for one more attribute, and looks for others when it is made."""

    __slots__ = ("mood",)
    MAX_SPEED = 10.0

    def __init__(self, road, position, *given, **more):
        super().__init__(road, np.array(position) + 1.0, *given, **more)
        self.mood = road.vehicles[0].speed + road.np_random.uniform()

    def act(self, action=None):
        raise RuntimeError("it acts")

    def step(self, dt):
        self.position = self.position + 100.0

    def clip_actions(self):
        self.action["acceleration"] = 9.0

    def on_state_update(self):
        self.speed = 3.0

    def handle_collisions(self, other, dt=0):
        self.crashed = True


class Tagged(type(IDMVehicle)):
    """A class of classes with an argument."""

    def __new__(cls, name, bases, body, tag=None):
        return super().__new__(cls, name, bases, body)


class Made(IDMVehicle, metaclass=Tagged, tag=1):
    pass


def naming(kind):
    """Return a configuration that names a class of vehicles."""
    return {"other_vehicles_type": f"{kind.__module__}.{kind.__qualname__}"}


class Slowing(gymnasium.Wrapper):
    """A wrapper that slows the traffic down after a reset, which has no effect on NPCs."""

    def reset(self, **options):
        result = super().reset(**options)
        for each in others(self.unwrapped):
            each.speed *= 0.5
            each.position += 1.0
        return result


CROSSES = [[CrossingInstruction("o1>o3", 0.5, 8.0)]]


@pytest.mark.parametrize(("base", "kind"), [
    *((HighwayEnv, kind) for kind in (IDMVehicle, AggressiveVehicle, ControlledVehicle, Vehicle, Own, Made)),
    *((base, IDMVehicle) for base in (MergeEnv, IntersectionEnv, RoundaboutEnv)),
])  # fmt: skip
def test_env_step_shows_the_same_vehicles_as_runs_of_the_package(register, base, kind):
    register("read-v0", entry_point=observing(base, everything))
    common = {"config": naming(kind), "duration": 6.0, "ends": "duration"}
    world, slowing = World("read-v0", **common), World("read-v0", wrappers=[Slowing], **common)
    space = space_of(world, npcs=2)
    scenarios = [sample(space, np.random.default_rng(seed)) for seed in range(3)]
    if base is IntersectionEnv:
        lane, speed = world.start
        scenarios.append(Scenario(npcs=CROSSES, ego_lane=lane, ego_speed=speed))
    for scenario in scenarios:
        runs = []
        for run in (world.rollout, world.rollout_in_gym, slowing.rollout):
            rng, seen = random.Random(scenario.seed), list[object]()

            def policy(rng=rng, seen=seen):
                return lambda values: seen.append(values) or rng.choice((IDLE, IDLE, 0, 2))

            with c_library():
                runs.append((run(scenario, policy), seen))
        (first, shown), (in_gym, _), _ = runs
        assert first.error is None
        assert shown[0][0][0] is kind
        assert differences(first, in_gym) == []
        for trace, seen in runs[1:]:
            assert trace.states.tobytes() == first.states.tobytes()
            assert repr(seen) == repr(shown)


class Acting(Road):
    """A road that lets its vehicles act itself."""

    def act(self):
        for each in self.vehicles:
            each.act()


class OnActingRoad(HighwayEnv):
    def _create_road(self):
        super()._create_road()
        self.road = Acting(self.road.network, np_random=self.np_random)


def test_what_a_vehicles_own_class_does_moves_no_npc_on_a_road_with_an_act_of_its_own(register):
    register("acting-v0", entry_point=OnActingRoad)
    worlds = [World(name, naming(Own), duration=4.0) for name in ("acting-v0", "highway-v0")]
    with c_library():
        runs = [world.rollout(LEFT_AND_ON, lambda: lambda seen: IDLE) for world in worlds]
    assert runs[0].error is None
    assert runs[0].npcs.tobytes() == runs[1].npcs.tobytes()


def watched(register, base, scenario, kind=IDMVehicle, **given):
    """Return the run of an idle policy in an environment, and the others as its observations find them."""
    seen = []

    def reads(env):
        names = "lane_index", "target_lane_index", "target_speed", "route", "timer"
        return [[getattr(each, name) for name in names] for each in others(env)]

    register("read-v0", entry_point=observing(base, reads))
    world = World("read-v0", duration=6.0, **given)
    return world.rollout(scenario(world), lambda: lambda values: seen.append(values) or IDLE), seen


def test_target_is_the_lane_to_which_an_npc_steers_and_the_speed_of_its_instruction(register):
    config = {"policy_frequency": 15}
    trace, seen = watched(register, HighwayEnv, lambda _: LEFT_AND_ON, config=config)
    start = int(trace.npcs[0, 0, LANE])
    assert [values[0][1][2] for values in seen[:3]] == [start, start - 1, start - 1]
    assert seen[-1][0][0] == seen[-1][0][1] == ("0", "1", start - 1)
    assert {(first[2], second[2]) for first, second in seen} == {(22.0, 18.0)}
    assert all(second[0] == second[1] and second[3] is None for _, second in seen)


def test_npc_that_is_to_stop_has_a_target_speed_by_which_environments_may_divide(register):
    """highway-env's merge divides by it."""
    stops = Scenario(npcs=[[PositionInstruction(1, 0.0)]], ego_lane=1, ego_speed=20.0)
    _, seen = watched(register, HighwayEnv, lambda _: stops)
    assert seen[0][0][2] == 0.01


def test_route_of_a_crossing_npc_leads_to_its_exit_from_where_it_is(register):
    def crossing(world):
        npcs, (lane, speed) = [[CrossingInstruction("o1>o3", -1.0, 9.0)]], world.start
        return Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed)

    _, seen = watched(register, IntersectionEnv, crossing)
    routes = [values[0][3] for values in seen]
    assert routes[0] == [("o1", "ir1", 0), ("ir1", "il3", None), ("il3", "o3", None)]
    assert routes[-1] == routes[0][-len(routes[-1]) :] != routes[0]
    assert {values[0][2] for values in seen} == {9.0}


class Pairs(HighwayEnv):
    """An environment that ends when it finds a driver model that aims at a speed, after a second."""

    def _is_terminated(self):
        models = [each.target_speed for each in others(self) if type(each) is IDMVehicle]
        return self.time > 1.0 and 18.0 in models


@pytest.mark.parametrize(("ads", "planner_hz"), [
    (lambda: lambda seen: IDLE, None),
    (constant_speed, 5),
    (lambda: IDMVehicle, None),
    (lambda: type("Mine", (IDMVehicle,), {"act": lambda self, action=None: IDMVehicle.act(self)}), None),
])  # fmt: skip
def test_ends_of_the_environment_see_them_whoever_drives(register, ads, planner_hz):
    register("pairs-v0", entry_point=Pairs)
    world = World("pairs-v0", duration=6.0, planner_hz=planner_hz)
    with c_library():
        runs = world.rollout(LEFT_AND_ON, ads), world.rollout_in_gym(LEFT_AND_ON, ads)
    assert differences(*runs) == []
    assert {run.ended for run in runs} == {"Pairs._is_terminated"}
    assert runs[0].ticks == runs[1].ticks <= 2 * 15


@pytest.mark.parametrize("env_id", ["highway-v0", "intersection-v0"])
def test_ego_that_is_a_vehicle_class_sees_vehicles_without_goals_where_they_are_now(env_id):
    runs = []
    for name in ("rollout", "rollout_in_gym"):
        world, seen = World(env_id, duration=4.0), []

        class Looking(IDMVehicle):
            def act(self, action=None, seen=seen):
                found = [each for each in self.road.vehicles if each is not self]
                seen.append([(*e.position.tolist(), float(e.speed), e.lane_index) for e in found])
                for each in found:
                    assert not isinstance(each, ControlledVehicle)
                    assert not each.check_collisions
                    assert each.target_speed == each.speed
                super().act()

        scenario = sample(space_of(world, npcs=2), np.random.default_rng(3))
        with c_library():
            runs.append((getattr(world, name)(scenario, lambda cls=Looking: cls), seen))
    (trace, shown), (again, shown_again) = runs
    assert trace.error is None
    assert differences(trace, again) == []
    assert shown == shown_again
    for row, states in zip(shown, trace.npcs.tolist(), strict=False):
        assert [each[:3] for each in row] == [(x, y, v) for x, y, _, v, *_ in states]


class Extra(IDMVehicle):
    def __init__(self, road, position, heading, speed, mood):
        super().__init__(road, position, heading, speed)


class Abstract(IDMVehicle):
    @abstractmethod
    def think(self):
        """Think."""


class Computed(IDMVehicle):
    @property
    def speed(self):
        return 7.0

    @speed.setter
    def speed(self, value):
        pass


class Halfway(IDMVehicle):
    def __init__(self, road, position, heading=0.0, speed=0.0):
        Vehicle.__init__(self, road, position, heading, speed)


class Fixed(IDMVehicle):
    def __setattr__(self, name, value):
        if name == "target_speed" and hasattr(self, name):
            raise AttributeError("fixed at the start")
        super().__setattr__(name, value)


class Final(IDMVehicle):
    def __init_subclass__(cls, **given):
        raise TypeError("no class may derive from it")


IMPOSSIBLE = [Extra, Abstract, Computed, Halfway, Fixed, Final, Obstacle]


@table("kind", IMPOSSIBLE)
def test_class_of_which_npcs_cannot_be_is_named_before_the_first_run(register, kind):
    config, asked = naming(kind), []
    with refused("config.other_vehicles_type"):
        World("highway-v0", config=config).rollout(LEFT_AND_ON, lambda: asked.append)
    assert asked == []
    planners = World("highway-v0", config=config, planner_hz=5)
    assert planners.rollout(LEFT_AND_ON, constant_speed).error is None


def test_class_itself_may_be_given_where_the_environment_takes_it(register):
    class Takes(observing(HighwayEnv, lambda env: [type(each) for each in others(env)])):
        @classmethod
        def default_config(cls):
            return {**super().default_config(), "other_vehicles_type": Own}

        def _create_vehicles(self):
            given = self.config["other_vehicles_type"]
            self.config |= naming(IDMVehicle)
            super()._create_vehicles()
            self.config["other_vehicles_type"] = given

    register("takes-v0", entry_point=Takes)
    seen, world = [], World("takes-v0", duration=2.0)
    world.rollout(LEFT_AND_ON, lambda: lambda values: seen.append(values) or IDLE)
    assert seen == [[Own, Own]] * 2


def test_file_may_name_a_vehicle_class_that_the_test_has_imported():
    data = {"kind": "gym", "env_id": "highway-v0", "config": naming(Own)}
    assert from_dict(data).config == naming(Own)
    with refused("world.config.other_vehicles_type"):
        from_dict({**data, "config": naming(Slowing)})
