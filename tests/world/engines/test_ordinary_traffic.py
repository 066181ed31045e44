"""Episodes in an environment's own traffic: compiled as with the environment's own steps, for every kind of ADS."""

import copy
import math
import time
from functools import partial

import gymnasium
import numpy as np
import pytest
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle, MDPVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle

import pytest_pafot as pafot
from example_ads import constant_speed, idm_mobil
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world.driving.compiled_vehicle import constants_of
from pytest_pafot.world.engines.ordinary_traffic import drive
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.traffic import OrdinaryTraffic
from pytest_pafot.world.roads.straight import StraightRoad
from tests.benchmarks.traffic_against_highway_env import WITHIN, difference, straying, swerving, undecided
from tests.helpers.c_library import c_library
from tests.helpers.polygons import corners, polygons_meet
from tests.helpers.stages import oracle

SHORT = {"vehicles_count": 10, "duration": 15}
FAST = pafot.World("highway-fast-v0", SHORT)
BRIEF = pafot.World("highway-fast-v0", {**SHORT, "duration": 4})
CRASHING = pafot.World("highway-v0", {**SHORT, "lanes_count": 2, "simulation_frequency": 10, "vehicles_density": 2})
SWERVING = {"vehicles_count": 6, "duration": 5, "action": {"type": "ContinuousAction"}, "policy_frequency": 5}
CONTINUOUS = pafot.World("highway-fast-v0", SWERVING)
MERGE = pafot.World("merge-v0", {"simulation_frequency": 5})
ROUNDABOUT = pafot.World("roundabout-v0")
EXIT = pafot.World("exit-v0", {"vehicles_count": 6, "duration": 6})
RACETRACK = pafot.World("racetrack-oval-v0", {"duration": 8, "block_lane": True})  # with obstacles
INTERSECTION = pafot.World("intersection-v0", {"duration": 5})
STEERED = pafot.World("intersection-v0", {"duration": 5, "action": {"type": "DiscreteAction"}})
LINEAR = pafot.World(
    "highway-fast-v0", {**SHORT, "duration": 3, "other_vehicles_type": "highway_env.vehicle.behavior.LinearVehicle"}
)


def driven(world, factory, seed, **options):
    return drive(world.environment, factory, seed, hang_limit=world.hang_limit, **options)


class Sluggish(IDMVehicle):
    """A vehicle class with its own code that remembers its actions."""

    def act(self, action=None):
        before = self.action["acceleration"]
        super().act()
        self.action["acceleration"] = 0.9 * before + 0.1 * self.action["acceleration"]


class Coasting(Vehicle):
    """A vehicle that has neither a target lane nor a target speed."""

    def act(self, action=None):
        super().act({"acceleration": -0.5, "steering": 0.001})


class OnTheRamp(Vehicle):
    """A vehicle that leaves the motorway of merge-v0, and drives along the ramp to the obstacle at its end."""

    def act(self, action=None):
        super().act({"acceleration": 0.0, "steering": 0.01 * (8.0 - self.position[1]) - 0.3 * self.heading})


def looking_ahead(env):
    """Return a planner that simulates inside the environment and takes the action whose next second has no crash."""

    def act(observation):
        for action in (3, 1, 4):
            future = env.unwrapped.simplify()
            future.step(action)
            if not future.vehicle.crashed:
                return action
        return 4

    return act


@pytest.mark.parametrize(
    ("world", "factory", "options"),
    [
        pytest.param(FAST, undecided, {}, id="meta-actions"),
        pytest.param(CRASHING, undecided, {}, id="others-crash-too"),
        pytest.param(CONTINUOUS, swerving, {"seed": 3}, id="continuous-actions"),
        oracle(FAST, idm_mobil.make, {}, id="vehicle-class"),
        oracle(FAST, lambda: Sluggish, {}, id="vehicle-class-of-its-own"),
        pytest.param(CRASHING, Coasting, {}, id="vehicle-class-without-goals"),
        pytest.param(FAST, constant_speed.make, {"is_planner": True}, id="planner"),
        oracle(FAST, looking_ahead, {}, id="planner-that-simulates"),
    ],
)
def test_compiled_episode_matches_the_steps_of_the_environment(world, factory, options):
    options = {"seed": 0, "is_recorded": True, **options}  # with seed 3 other vehicles try to move ahead of the ego
    compiled = driven(world, factory, **options)
    stepped = driven(world, factory, may_compile=False, **options)
    assert (compiled.steps, stepped.steps) == ("", "that was requested")
    assert difference(compiled, stepped) <= WITHIN
    assert len(compiled.recording.states) == 1 + round(compiled.seconds * compiled.recording.physics_hz)


OFF_STRAIGHT_ROADS = [
    pytest.param(MERGE, undecided, id="merge-policy"),
    pytest.param(MERGE, Sluggish, id="merge-vehicle-class-of-its-own"),
    pytest.param(MERGE, OnTheRamp, id="merge-obstacle"),
    pytest.param(ROUNDABOUT, idm_mobil.make, id="roundabout-vehicle-class"),
    pytest.param(ROUNDABOUT, undecided, id="roundabout-policy"),
    pytest.param(EXIT, undecided, id="exit-policy"),
    pytest.param(RACETRACK, straying, id="racetrack-continuous-actions"),
    pytest.param(INTERSECTION, idm_mobil.make, id="intersection-vehicle-class"),
    pytest.param(INTERSECTION, lambda: lambda seen: 2, id="intersection-policy"),
    pytest.param(STEERED, lambda: lambda seen: 4, id="intersection-policy-that-steers"),
]


@pytest.mark.parametrize(("world", "factory"), OFF_STRAIGHT_ROADS)
def test_episode_on_other_roads_is_same_to_the_last_bit(world, factory):
    factory = (lambda: factory) if isinstance(factory, type) else factory
    with c_library():
        compiled = driven(world, factory, 2, is_recorded=True)
        stepped = driven(world, factory, 2, is_recorded=True, may_compile=False)
    assert (compiled.steps, stepped.steps) == ("", "that was requested")
    assert difference(compiled, stepped) == 0.0
    if factory is OnTheRamp:
        assert compiled.outcome is Outcome.COLLISION


@pytest.mark.parametrize("may_compile", [True, False])
def test_planner_sees_the_traffic_that_is_recorded(may_compile):
    """Its lanes are 4 m wide, with the centre of the first one at y = 0; it sees its own last controls."""
    seen = []
    world = pafot.World("highway-fast-v0", {**SHORT, "duration": 3})

    def planner():
        return lambda now: seen.append(now) or (0.5, 0.002)

    episode = driven(world, planner, 0, is_planner=True, is_recorded=True, may_compile=may_compile)
    assert len(seen) == 15
    for now, states in zip(seen, episode.recording.states, strict=False):
        assert now.array[:, :4] == pytest.approx(states, abs=1e-9)
        assert now.array[:, 4].tolist() == np.round(states[:, 1] / 4.0).tolist()
    assert {(now.acceleration, now.steering) for now in seen[1:]} == {(0.5, 0.002)}


def test_standing_vehicles_crash_exactly_if_their_boxes_overlap():
    rng, lanes, found = np.random.default_rng(0), StraightRoad.uniform(4, 500.0, 4.0, 30.0).grid, []
    constants = constants_of(Vehicle)
    for _ in range(300):
        poses = np.column_stack([rng.uniform(0, 6, (2, 2)), rng.uniform(-np.pi, np.pi, 2), np.zeros(2)])
        pair = []
        for pose in poses:
            pair.append(GoalVehicle(constants, lanes, 30.0))
            pair[-1].has_goal = pair[-1].drives_itself = False
            pair[-1].start(*pose.tolist(), False)
        boxes = [corners(pose, 5.0, 2.0) for pose in poses.tolist()]
        OrdinaryTraffic(pair, [], 0.1).step()
        found.append(pair[0].crashed)
        assert found[-1] == polygons_meet(*boxes), poses
    assert 100 < sum(found) < 250


def test_crash_is_cut_where_highway_env_flags_it():
    episode = driven(FAST, constant_speed.make, 1, is_planner=True, is_recorded=True)
    assert episode.outcome is Outcome.COLLISION
    ends = episode.recording.states[-1]
    assert 4.5 < np.abs(ends[1:, 0] - ends[0, 0])[np.abs(ends[1:, 1] - ends[0, 1]) < 2].min() < 6.0


def test_other_traffic_or_roads_use_environment_steps():
    assert "makes vehicles yield, also a Sluggish" in driven(INTERSECTION, lambda: Sluggish, 0).steps
    parking = driven(pafot.World("parking-v0", {"duration": 1}), lambda: lambda seen: (0.0, 0.0), 0)
    assert "a Landmark on the road" in parking.steps
    ranged = {**SWERVING, "action": {"type": "ContinuousAction", "speed_range": [0.0, 22.0]}, "duration": 2}
    fast = type("Fast", (IDMVehicle,), {"MAX_SPEED": 50.0})
    assert "its own speed limits" in driven(CONTINUOUS, lambda: fast, 0).steps
    assert "its own limits" in driven(pafot.World("highway-fast-v0", ranged), swerving, 0).steps
    linear = driven(LINEAR, constant_speed.make, 0, is_planner=True)
    assert "LinearVehicle" in linear.steps
    wrapped = pafot.World("highway-fast-v0", {**SHORT, "duration": 3}, wrappers=[gymnasium.wrappers.FlattenObservation])
    shapes = []
    flat = driven(wrapped, lambda: lambda seen: shapes.append(seen.shape) or 1, 0)
    assert "FlattenObservation" in flat.steps
    assert shapes[0] == (25,)


class HighwayOfOurOwn(HighwayEnvFast):
    """An environment with steps that the kernel does not know."""

    def step(self, action):
        return super().step(1)


class HighwayWithLimits(HighwayEnvFast):
    """A straight road whose lanes have different speed limits."""

    def _create_road(self):
        super()._create_road()
        for number, lane in enumerate(self.road.network.lanes_list()):
            lane.speed_limit = 30 - 5 * number


def test_straight_road_with_several_speed_limits_is_compiled_but_not_for_planners():
    gymnasium.register("limits-v0", entry_point=HighwayWithLimits)
    try:
        world = pafot.World("limits-v0", {"vehicles_count": 8, "duration": 6})
        compiled, stepped = (
            driven(world, idm_mobil.make, 0, is_recorded=True, may_compile=may_compile) for may_compile in (True, False)
        )
        assert (compiled.steps, difference(compiled, stepped) <= WITHIN) == ("", True)
        assert "several speed limits" in driven(world, constant_speed.make, 0, is_planner=True).steps
    finally:
        del gymnasium.registry["limits-v0"]


def test_environment_with_its_own_steps_uses_them():
    gymnasium.register("own-highway-v0", entry_point=HighwayOfOurOwn)
    try:
        world = pafot.World("own-highway-v0", {"vehicles_count": 3, "duration": 6})
        assert driven(world, undecided, 0).steps == "HighwayOfOurOwn has its own steps"
        seconds = {driven(world, factory, 3).seconds for factory in (undecided, lambda: lambda seen: 1)}
        assert len(seconds) == 1
    finally:
        del gymnasium.registry["own-highway-v0"]


@pytest.mark.parametrize("may_compile", [True, False])
def test_failing_or_hanging_ads_ends_its_episode(may_compile):
    def raising():
        asked = []

        def act(seen):
            asked.append(seen)
            if len(asked) == 3:
                raise ValueError("no plan")
            return 1

        return act

    failed = driven(FAST, raising, 0, may_compile=may_compile)
    assert (failed.outcome, failed.seconds, failed.error.kind) == (Outcome.ADS_ERROR, 2.0, "ValueError")
    hung = drive(FAST.environment, lambda: lambda seen: time.sleep(5), 0, hang_limit=0.1, may_compile=may_compile)
    assert (hung.outcome, hung.seconds) == (Outcome.HANG, 0.0)
    broken = driven(FAST, lambda: 1 / 0, 0, may_compile=may_compile)
    assert (broken.outcome, broken.error.kind) == (Outcome.ADS_ERROR, "ZeroDivisionError")


def test_a_planner_needs_a_straight_road():
    with pytest.raises(pafot.WorldError, match=r"expected a straight road for a planner in SI units, received .*Merge"):
        driven(pafot.World("merge-v0"), constant_speed.make, 0, is_planner=True)


def test_environment_needing_its_own_ego_says_so():
    with pytest.raises(pafot.WorldError, match="with an ego of the class IDMVehicle, received LaneKeepingEnv"):
        driven(pafot.World("lane-keeping-v0"), idm_mobil.make, 0)
    assert driven(pafot.World("exit-v0", {"vehicles_count": 2, "duration": 2}), idm_mobil.make, 0).seconds == 2.0
    gymnasium.register("ten-steps-v0", entry_point=HighwayEnvFast, max_episode_steps=10)
    try:
        counted = pafot.World("ten-steps-v0", SHORT)
        episodes = [driven(counted, idm_mobil.make, 0, may_compile=compiled) for compiled in (True, False)]
        assert [(each.seconds, bool(each.steps)) for each in episodes] == [(10.0, False), (10.0, True)]
    finally:
        del gymnasium.registry["ten-steps-v0"]


def test_environment_reward_works_again_after_vehicle_class_ego():
    driven(FAST, idm_mobil.make, 0, may_compile=False)
    env = FAST.environment.with_traffic().unwrapped
    env.reset(seed=0)
    assert env.step(1)[1] > 0.1


def test_compiled_episode_of_highway_env_is_asked_for_no_reward(monkeypatch):
    asked = []
    monkeypatch.setattr(HighwayEnvFast, "_reward", lambda env, action: asked.append(action) or 0.0)
    driven(FAST, lambda: lambda seen: 1, 0)
    assert not asked
    driven(FAST, lambda: lambda seen: 1, 0, may_compile=False)
    assert asked


@pytest.mark.oracle
def test_environment_restores_class_constants_that_it_sets():
    before = IDMVehicle.DISTANCE_WANTED, MDPVehicle.DEFAULT_TARGET_SPEEDS
    episode = driven(pafot.World("intersection-v0", {"duration": 2}), lambda: lambda seen: 0, 0, is_recorded=True)
    assert episode.recording.lanes[0].points
    assert before == (IDMVehicle.DISTANCE_WANTED, MDPVehicle.DEFAULT_TARGET_SPEEDS)


EYES = {
    "range": 60.0,
    "latency": 0.5,
    "noise": {"position": 0.3, "speed": 1.0},
    "dropout": 0.1,
}


def test_imperfect_planner_sight_is_same_compiled_or_stepped():
    shown = []

    def planner():
        shown.append([])
        return lambda observation: (shown[-1].append(observation.array), (0.0, 0.0))[1]

    factory, world = pafot.Perception(planner, **EYES), pafot.World("highway-fast-v0", {**SHORT, "duration": 7})
    for may_compile in (True, False):
        driven(world, factory, 1, is_planner=True, may_compile=may_compile)
    driven(world, planner, 1, is_planner=True)
    compiled, stepped, perfect = shown
    assert compiled == [pytest.approx(each, abs=1e-6) for each in stepped]
    assert {len(each) for each in compiled} != {len(each) for each in perfect}


class LooksAhead(IDMVehicle):
    """A vehicle class that simulates in a copy of its road, and brakes if it crashes there."""

    looks = True

    def act(self, action=None):
        super().act(action)
        if self.looks:
            self.looks = False
            copied = copy.deepcopy(self)
            self.looks = True
            for _ in range(3):
                copied.road.act()
                copied.road.step(0.1)
            self.action["acceleration"] = -6.0 if copied.crashed else copied.speed / 100 - copied.timer


class ChangesGoalInStep(ControlledVehicle):
    """A vehicle class that decides on its speed and lane only after it has moved."""

    def step(self, dt):
        super().step(dt)
        self.target_speed += 0.5
        start, end, lane = self.lane_index
        self.target_lane_index = start, end, max(0, lane - 1)


class SaysThatItCrashed(IDMVehicle):
    """A vehicle class that flags itself as crashed after its first step."""

    def step(self, dt):
        super().step(dt)
        self.crashed = True


class ReadsTimers(IDMVehicle):
    """A vehicle class that brakes by the times since others have last decided on their lanes."""

    def act(self, action=None):
        super().act(action)
        self.action["acceleration"] = -sum(each.timer for each in self.road.vehicles[1:]) / 10


class Unfinished(IDMVehicle):
    """A vehicle class whose acceleration is not a number."""

    def act(self, action=None):
        super().act(action)
        self.action["acceleration"] = math.nan


class RaisesAfterASecond(IDMVehicle):
    """A vehicle class with an error in one of its decisions."""

    asked = 0

    def act(self, action=None):
        if self.asked == 5:
            raise ValueError("no plan")
        self.asked += 1
        super().act(action)


def plain_states(world, vehicle_class, seed, ticks):
    """Return the states of all vehicles at each tick, by highway-env's road alone."""
    env = gymnasium.make(world.env_id, config=world.config).unwrapped
    env.reset(seed=seed)
    old, road, states = env.vehicle, env.road, []
    ego = vehicle_class(road, old.position, old.heading, old.speed)
    road.vehicles = [ego if each is old else each for each in road.vehicles]
    for _ in range(ticks):
        states.append([[*each.position, each.heading, each.speed] for each in road.vehicles])
        road.act()
        road.step(1 / env.config["simulation_frequency"])
    return np.array(states)


@pytest.mark.parametrize("may_compile", [True, False])
@pytest.mark.parametrize(
    ("vehicle_class", "seconds", "error"),
    [
        (LooksAhead, 4.0, None),
        (ChangesGoalInStep, None, None),
        (SaysThatItCrashed, 0.2, None),
        (ReadsTimers, None, None),
        (Unfinished, 0.0, "BadAction"),
        (RaisesAfterASecond, 1.0, "ValueError"),
    ],
)
def test_vehicle_class_drives_as_on_the_road_alone(vehicle_class, seconds, error, may_compile):
    episode = driven(BRIEF, lambda: vehicle_class, 0, is_recorded=True, may_compile=may_compile)
    assert (bool(episode.steps), episode.error and episode.error.kind) == (not may_compile, error)
    assert seconds in (episode.seconds, None)
    frames = round(5 * episode.seconds)
    assert len(episode.recording.states) == frames + 1
    plain = plain_states(BRIEF, vehicle_class, 0, frames)
    assert frames == 0 or np.abs(episode.recording.states[:-1] - plain).max() <= WITHIN


class MovedAside(HighwayEnvFast):
    """Vehicles start closer to another lane than to theirs."""

    def _create_vehicles(self):
        super()._create_vehicles()
        for each in self.road.vehicles:
            each.position = each.position + np.array([0.0, 3.0])


class Touched(HighwayEnvFast):
    """Two vehicles are in a contact before the start."""

    def _reset(self):
        super()._reset()
        if len(self.road.vehicles) == 1:
            return
        _, one, other = self.road.vehicles[:3]
        other.position, other.speed = one.position + np.array([5.2, 0.0]), 10.0
        one.check_collisions, one.speed = True, 30.0
        while one.impact is None:
            self.road.step(0.01)


class OneVehicleBrakes(HighwayEnvFast):
    """A vehicle has its own function to act."""

    def _create_vehicles(self):
        super()._create_vehicles()
        for each in self.road.vehicles[1:2]:
            each.act = partial(Vehicle.act, each, {"steering": 0.0, "acceleration": -3.0})


class SlowRoad(HighwayEnvFast):
    """The road has its own function to step."""

    def _create_road(self):
        super()._create_road()
        own = self.road.step

        def step(dt):
            own(dt)
            for each in self.road.vehicles[1:]:
                each.speed *= 0.97

        self.road.step = step


class Ghosts(HighwayEnvFast):
    """Nothing crashes with other vehicles."""

    def _create_vehicles(self):
        super()._create_vehicles()
        for each in self.road.vehicles[1:]:
            each.solid = False


class NoSideLanes(RoadNetwork):
    """A network on which nobody changes lanes."""

    def side_lanes(self, lane_index):
        return []


class WithoutLaneChanges(HighwayEnvFast):
    """The road has a network of another class."""

    def _create_road(self):
        super()._create_road()
        network = NoSideLanes()
        network.graph, self.road.network = self.road.network.graph, network


class LongObstacle(HighwayEnvFast):
    """An obstacle is longer than highway-env's."""

    def _create_vehicles(self):
        super()._create_vehicles()
        obstacle = Obstacle(self.road, [self.vehicle.position[0] + 120, 4.0])
        obstacle.LENGTH = 20.0
        self.road.objects.append(obstacle)


class GhostObstacle(LongObstacle):
    """Nothing crashes with an obstacle."""

    def _create_vehicles(self):
        super()._create_vehicles()
        self.road.objects[0].collidable = False


class AddsObstacle(HighwayEnvFast):
    """An obstacle appears ahead of the ego."""

    def _is_truncated(self):
        if self.steps == 10:
            place = self.vehicle.position + np.array([60.0, 0.0])
            self.road.objects.append(Obstacle(self.road, place))
        return super()._is_truncated()


class AddsVehicles(HighwayEnvFast):
    """A vehicle without a goal appears ahead of the ego."""

    def _is_truncated(self):
        if self.steps == 10:
            self.road.vehicles.append(Vehicle(self.road, self.vehicle.position + np.array([40.0, 0.0]), 0.0, 5.0))
        return super()._is_truncated()


class EnoughReward(HighwayEnvFast):
    """An episode ends after some reward."""

    def _reset(self):
        super()._reset()
        self.total = 0.0

    def _reward(self, action):
        self.total += super()._reward(action)
        return super()._reward(action)

    def _is_terminated(self):
        return super()._is_terminated() or self.total > 3.0


class EndsByReward(HighwayEnvFast):
    """An episode ends by highway-env's own reward."""

    def _is_terminated(self):
        return super()._is_terminated() or (self.steps > 6 and self._reward(1) < 2.0)


class Braked(HighwayEnvFast):
    """Another vehicle is slowed down between two steps."""

    def _is_truncated(self):
        if self.steps == 10:
            self.road.vehicles[1].speed *= 0.5
        return super()._is_truncated()


class Impatient(HighwayEnvFast):
    """The constants of one vehicle change between two steps, which a reward looks at."""

    def _rewards(self, action):
        if self.steps == 10:
            self.road.vehicles[2].TIME_WANTED = 0.3
        return super()._rewards(action)


class WetRoad(HighwayEnvFast):
    """The speed limit falls between two steps."""

    def _info(self, seen, action=None):
        if self.steps == 10:
            for lane in self.road.network.lanes_list():
                lane.speed_limit = 12.0
        return super()._info(seen, action)


class Pushed(HighwayEnvFast):
    """A vehicle is pushed aside between two steps."""

    def _is_truncated(self):
        if self.steps == 10:
            self.road.vehicles[1].impact = np.array([0.0, 0.5])
        return super()._is_truncated()


class Undelayed(HighwayEnvFast):
    """A vehicle has constants with which MOBIL has no answer."""

    def _create_vehicles(self):
        super()._create_vehicles()
        self.road.vehicles[1].LANE_CHANGE_DELAY = 0.0


class Alike(IDMVehicle):
    """A vehicle that is equal to all others of its class."""

    def __eq__(self, other):
        return isinstance(other, Alike)

    __hash__ = IDMVehicle.__hash__


class AllAlike(HighwayEnvFast):
    """An environment with vehicles that say themselves what they are equal to."""

    def _create_vehicles(self):
        super()._create_vehicles()
        self.road.vehicles[1].__class__ = Alike


class Hurried(HighwayEnvFast):
    """An environment that sets the constants of all vehicles when it is made."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        IDMVehicle.TIME_WANTED = 0.4


@pytest.fixture
def world_of():
    """Return a function that makes the world of an environment's class, which is registered for one test."""
    names = []

    def make(cls, **config):
        names.append(f"{cls.__name__}-v0")
        gymnasium.register(names[-1], entry_point=cls)
        return pafot.World(names[-1], {"vehicles_count": 9, "duration": 3, **config})

    yield make
    for name in names:
        del gymnasium.registry[name]


CHANGES = "the environment changes its vehicles or their road"


@pytest.mark.parametrize(
    ("cls", "reason"),
    [
        (MovedAside, ""),
        (Touched, ""),
        (OneVehicleBrakes, "a IDMVehicle has its own steps"),
        (SlowRoad, "the road has its own steps"),
        (Ghosts, "nothing crashes with a IDMVehicle"),
        (WithoutLaneChanges, "the road is a Road with a NoSideLanes"),
        (LongObstacle, ""),
        (GhostObstacle, "nothing crashes with a Obstacle"),
        (AddsObstacle, "the environment changes what is on its road"),
        (AddsVehicles, "the traffic has a Vehicle, not only IDM and MOBIL"),
        (EnoughReward, ""),
        (EndsByReward, ""),
        (Braked, CHANGES),
        (Impatient, CHANGES),
        (WetRoad, CHANGES),
        (Pushed, CHANGES),
        (Undelayed, "a IDMVehicle has constants with which IDM and MOBIL have no answer"),
        (AllAlike, "the traffic has a Alike, not only IDM and MOBIL"),
        (Hurried, ""),
    ],
)
def test_changed_environment_drives_as_by_its_own_steps(world_of, cls, reason):
    world, policy = world_of(cls), lambda: lambda seen: 1
    compiled, stepped = (
        driven(world, policy, 1, is_recorded=True, may_compile=may_compile) for may_compile in (True, False)
    )
    assert (compiled.steps, stepped.steps) == (reason, "that was requested")
    assert difference(compiled, stepped) <= WITHIN


def test_vehicles_of_another_class_that_appear_are_driven_by_the_road():
    aggressive = {"other_vehicles_type": "highway_env.vehicle.behavior.AggressiveVehicle", "duration": 8}
    world = pafot.World("intersection-v0", {**aggressive, "initial_vehicle_count": 1, "spawn_probability": 1.0})
    compiled, stepped = (
        driven(world, lambda: lambda seen: 2, 10, is_recorded=True, may_compile=may_compile)
        for may_compile in (True, False)
    )
    assert compiled.steps == "the traffic has a AggressiveVehicle, not only IDM and MOBIL"
    assert difference(compiled, stepped) <= WITHIN
