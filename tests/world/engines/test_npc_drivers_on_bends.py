"""Free NPCs on roads of any shape: each is the ego of its driver, along the way of the ego of the run."""

import gymnasium
import numpy as np
import pytest
from highway_env.road.lane import StraightLane
from highway_env.road.regulation import RegulatedRoad
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import CrossingInstruction, Drive, Free, Manoeuvre, Outcome, Run, Scenario, World
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.trace import ACROSS, HEADING, LANE, SPEED, X, Y
from tests.helpers.c_library import c_library
from tests.helpers.road_cases import ROADS, OwnEnvironment
from tests.helpers.stages import mostly_oracle

WITHOUT_RULES = [each for each in ROADS if not each.startswith("intersection")]


def free(driver="idm", beside=0, ahead=30.0, speed=10.0):
    return (Free(beside=beside, ahead=ahead, speed=speed, driver=driver),)


def scenario_on(world, *npcs, **more):
    lane, speed = world.start
    return Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed, **more)


def following(seen):
    """Stay in the lane, behind the vehicle ahead, at 10 m/s."""
    gaps = [each.x - seen.ego.x for each in seen.others if each.lane == seen.ego.lane and each.x > seen.ego.x]
    is_near = min(gaps, default=100.0) < 8.0 + 1.2 * seen.ego.speed
    return Drive(lane=seen.ego.lane, speed=0.0 if is_near else 10.0)


def states(trace):
    return trace.states.tobytes()


# Models of traffic.


class Taken(IDMVehicle):
    """A vehicle that is put where another one is, and wants the speed that it has."""

    target_speed = property(lambda self: self.speed, lambda self, _: None)
    act = None


@pytest.mark.parametrize("driver", ["idm", "mobil"])
@pytest.mark.parametrize("env_id", mostly_oracle(WITHOUT_RULES, "racetrack-v1", "roundabout-v1"))
def test_traffic_drives_as_highway_envs_to_the_last_bit(env_id, driver):
    """The route is that of the ego. The rules of who yields have a test of their own."""
    world = World(env_id, {"neighbour_vehicles_connected_lanes": False}, duration=5.0, planner_hz=5)
    road, (_, speed) = world.road, world.start
    slow = Manoeuvre(beside=0, ahead=65.0, speed=round(0.6 * speed, 1))
    scenario = scenario_on(world, free(driver, ahead=20.0, speed=round(speed, 1)), (slow,))
    with c_library():
        trace = world.rollout(scenario, lambda: lambda seen: (-6.0, 0.0))
        start, along = trace.states[0, 1], float(trace.track[0, 1, 0])
        ahead = [index[:2] for index in road.route[road.line.piece[road.point(along)] :]]
        on = Road(world.network)
        lane = (*ahead[0], world.network.get_closest_lane_index(start[:2], start[2])[2])
        route = [(*section, None) for section in ahead]
        car = IDMVehicle(on, start[:2], start[2], start[SPEED], lane, route=route)
        car.target_speed, car.enable_lane_change = scenario.npcs[0][0].speed, driver == "mobil"
        others = [Taken(on, row[:2], row[2], row[SPEED]) for row in trace.states[0, [0, 2]]]
        on.vehicles = [others[0], car, others[1]]
        assert trace.ticks > 2 * world.physics_hz
        for tick, row in enumerate(trace.states[1:]):
            car.act()
            car.step(1 / world.physics_hz)
            for other, (x, y, heading, its_speed, *_) in zip(others, row[[0, 2]], strict=True):
                other.position, other.heading, other.speed = np.array([x, y]), heading, its_speed
                other.on_state_update()
            assert (*car.position, car.heading, car.speed) == tuple(row[1, :4]), tick


class Split(OwnEnvironment):
    """The road of a Highway as a network: its four straight lanes, of several sections or of one."""

    @classmethod
    def default_config(cls):
        return {**super().default_config(), "ends": [0, 900, 3300], "right": 0.0, "policy_frequency": 5, "duration": 12}

    def _reset(self):
        network, y = RoadNetwork(), self.config["right"]
        for first, last in zip(self.config["ends"], self.config["ends"][1:], strict=False):
            for lane in range(4):
                ends = [first, y + 4 * lane], [last, y + 4 * lane]
                network.add_lane(str(first), str(last), StraightLane(*ends, speed_limit=30))
        self.road = Road(network, np_random=self.np_random)
        self.vehicle = self.action_type.vehicle_class(self.road, [200.0, y + 4.0], 0.0, 20.0)
        self.road.vehicles = [self.vehicle]


@pytest.fixture
def split():
    gymnasium.register("Split-v0", Split)
    yield lambda **config: World("Split-v0", config, duration=12.0, planner_hz=15)
    del gymnasium.registry["Split-v0"]


@pytest.mark.oracle
@pytest.mark.parametrize("driver", ["idm", "mobil", "own"])
def test_on_a_straight_network_all_drive_as_on_a_highway(split, driver):
    """The bend of infinite radius: sections of the same lanes, whose joint the vehicles pass."""
    slow = Manoeuvre(beside=0, ahead=70.0, speed=12.0)
    npcs = free(driver, ahead=20.0, speed=24.0), free(driver, ahead=-25.0, speed=26.0, beside=1), (slow,)
    scenario = Scenario(npcs=npcs, ego_lane=1, ego_speed=20.0)
    straight, network = (
        split(ends=ends, neighbour_vehicles_connected_lanes=True)
        .with_drivers({"own": lambda: follower_in_pairs})
        .rollout(scenario, lambda: follower_in_pairs)
        for ends in ([0, 3300], [0, 300, 3300])
    )
    assert straight.road.is_straight
    assert not network.road.is_straight
    assert (straight.outcome, straight.ticks) == (network.outcome, network.ticks)
    np.testing.assert_allclose(network.states[..., :6], straight.states[..., :6], rtol=0, atol=1e-9)
    assert (abs(straight.states[-1, 1, Y] - 4.0) > 1.0) == (driver == "mobil")


def follower_in_pairs(seen):
    gaps = [each.x - seen.ego.x for each in seen.others if abs(each.y - seen.ego.y) < 2 and each.x > seen.ego.x]
    return (-6.0 if min(gaps, default=100.0) < 5 + 1.2 * seen.ego.speed else 0.5 * (seen.ego.speed < 24)), 0.0


@pytest.mark.parametrize("driver", ["idm", "own"])
def test_road_may_start_beside_the_origin(split, driver):
    scenario = Scenario(npcs=(free(driver, speed=15.0, beside=1), free(driver, ahead=-25.0)), ego_lane=1)
    here, there = (
        split(ends=[0, 3300], right=right)
        .with_drivers({"own": lambda: follower_in_pairs})
        .rollout(scenario, lambda: follower_in_pairs)
        for right in (0.0, 50.0)
    )
    np.testing.assert_allclose(there.states[..., Y] - 50.0, here.states[..., Y], rtol=0, atol=1e-9)
    np.testing.assert_allclose(there.states[..., [X, SPEED]], here.states[..., [X, SPEED]], rtol=0, atol=1e-9)


def test_traffic_wants_its_speed_also_where_a_bend_makes_it_start_more_slowly():
    world = World("racetrack-v0", duration=12.0, planner_hz=5)
    trace = world.rollout(scenario_on(world, free(ahead=25.0, speed=10.0)), lambda: following)
    assert trace.states[0, 1, SPEED] < 9.5
    assert trace.states[:, 1, SPEED].max() > 9.5


class Crossed(OwnEnvironment):
    """A road without priority, which leads across one with priority."""

    @classmethod
    def default_config(cls):
        return {**super().default_config(), "duration": 20, "rules": True}

    def _reset(self):
        network = RoadNetwork()
        network.add_lane("w", "m", StraightLane([-150, 0], [30, 0], speed_limit=10))
        network.add_lane("m", "e", StraightLane([30, 0], [400, 0], speed_limit=10))
        network.add_lane("n", "s", self.lane())
        self.road = (RegulatedRoad if self.config["rules"] else Road)(network, np_random=self.np_random)
        self.vehicle = self.action_type.vehicle_class(self.road, [-80.0, 0.0], 0.0, 10.0)
        self.road.vehicles = [self.vehicle]

    def lane(self):
        return StraightLane([0, -150], [0, 150], speed_limit=10, priority=1)


class Painted(Crossed):
    """The same with a lane of a class of the user's own."""

    def lane(self):
        return type("Lane", (StraightLane,), {})([0, -150], [0, 150], speed_limit=10)


@pytest.fixture
def crossed():
    gymnasium.register("Crossed-v0", Crossed)
    gymnasium.register("Painted-v0", Painted)
    yield lambda env_id="Crossed-v0", **config: World(env_id, config, planner_hz=5)
    del gymnasium.registry["Crossed-v0"], gymnasium.registry["Painted-v0"]


def test_traffic_obeys_the_rules_of_the_road_as_an_ego_does(crossed):
    """It yields to an NPC that arrives at the same time, and nobody knows that this one will wait."""
    npc = CrossingInstruction("n>s", -0.5, 8.0, "hold")
    regulated, other = (
        world.rollout(scenario_on(world, (npc,), free(ahead=10.0)), lambda: lambda seen: (0.0, 0.0))
        for world in (crossed(), crossed(rules=False))
    )
    assert regulated.states[:, 2, SPEED].min() < 8.0
    assert other.states[:, 2, SPEED].min() > 9.9


def test_traffic_brakes_behind_fixed_objects():
    world = World("merge-v0", duration=20.0, planner_hz=5)
    lane = world.lanes - 1  # which ends at one
    ahead = next(each for each in range(20, 400) if world.road.has_lane(lane, world.road.start + each + 5))
    beside = lane - world.start[0]
    scenario = scenario_on(world, free(beside=beside, ahead=float(ahead), speed=20.0))
    trace = world.rollout(scenario, lambda: lambda seen: (-3.0, 0.0))
    assert trace.outcome is Outcome.SAFE


def test_lanes_of_other_classes_are_refused_for_models_and_not_for_planners(crossed):
    world = crossed("Painted-v0").with_drivers({"own": lambda: following})
    with pytest.raises(ScenarioError, match=r"driver: expected a planner, on a road with lanes of other classes"):
        world.rollout(scenario_on(world, free("idm")), lambda: following)
    assert world.rollout(scenario_on(world, free("own")), lambda: following).npc_error is None


# Planners.


def test_planner_sees_the_road_from_its_own_place():
    seen = []

    class Noting:
        def __call__(self, observation):
            seen.append(observation)
            return following(observation)

    world = World("racetrack-v0", duration=12.0, planner_hz=5)
    trace = world.rollout(scenario_on(world, free("policy", ahead=18.0, speed=10.0), free(ahead=45.0)), Noting)
    for mine, its in zip(seen[::2], seen[1::2], strict=True):
        (me, it), (there, here) = (mine.ego, its.ego), (its.others[0], mine.others[0])
        assert (here.lane, here.y, here.speed, here.heading) == (it.lane, it.y, it.speed, it.heading)
        assert (there.lane, there.y, there.speed, there.heading) == (me.lane, me.y, me.speed, me.heading)
        assert there.x - it.x == pytest.approx(me.x - here.x)
        assert its.ids == (0, 1)
    assert len(seen) == 2 * len(trace.actions)
    assert seen[-1].acceleration == trace.states[-4, 1, 4]


@pytest.mark.oracle
@pytest.mark.parametrize("env_id", mostly_oracle(ROADS, "racetrack-v1", "intersection-v0"))
def test_run_is_the_same_in_steps_of_the_environment(env_id):
    """And all NPCs stay on the road, those of planners in their lane. To make a world takes longer than the runs."""
    world = World(env_id, duration=6.0, planner_hz=5).with_drivers({"own": lambda: following})
    for driver, ahead in (("idm", 28.0), ("mobil", 28.0), ("mobil", -20.0), ("own", 28.0)):
        scenario = scenario_on(world, free(driver, ahead=ahead))
        try:
            world.check_fits(scenario)
        except ScenarioError:  # the road begins just behind the ego
            continue
        with c_library():
            trace = world.rollout(scenario, lambda: following)
            assert states(trace) == states(world.rollout_in_gym(scenario, lambda: following)), (driver, ahead)
        assert trace.outcome is not Outcome.INVALID, (driver, ahead)
        if driver == "own":
            assert abs(trace.track[:, 1, ACROSS]).max() < 0.5
            assert (trace.states[:, 1, LANE] >= 0).all()


def test_planner_on_the_egos_way_sees_the_npcs_that_cross():
    seen = []
    world = World("intersection-v1", duration=8.0, planner_hz=5)
    world = world.with_drivers({"own": lambda: lambda observation: seen.append(observation) or following(observation)})
    crossing = world.crossings
    zone = crossing.zones[0]
    npc = CrossingInstruction(zone.way, 2.0, 8.0, "pass")
    trace = world.rollout(scenario_on(world, (npc,), free("own", ahead=10.0)), lambda: following)
    (other,) = seen[0].crossing
    assert (other.id, other.zone.way) == (1, zone.way)
    assert other.ego_distance == pytest.approx(zone.ego[0] - trace.track[0, 2, 0])
    assert other.distance == pytest.approx(zone.npc[0] - trace.on_way[0, 0])
    assert [each.x for each in seen[0].others] == [pytest.approx(seen[0].ego.x - 15.0)]


# Whose fault it is.


def test_free_npc_that_runs_into_the_ego_in_a_bend_is_at_fault():
    def blind(seen):
        return Drive(lane=seen.ego.lane, speed=10.0)

    def slowing(seen):
        return Drive(lane=seen.ego.lane, speed=10.0 if seen.time < 4.0 else 3.0)

    world = World("racetrack-v0", duration=20.0, planner_hz=5).with_drivers({"own": lambda: blind})
    trace = world.rollout(scenario_on(world, free("own", ahead=-8.0)), lambda: slowing)
    run = Run(trace)
    assert run.collision
    assert abs(trace.states[-1, 1, HEADING] - trace.states[-15, 1, HEADING]) > 0.2, "it turns"
    assert run.responsibility == "npc"
    assert "NPC 0 is responsible." in run.explain()
