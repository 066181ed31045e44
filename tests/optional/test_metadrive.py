"""MetaDrive as a world: its own policies, observations, physics, repetition, files and errors."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot import Cell, PositionInstruction, Scenario
from pytest_pafot.model.trace import SPEED, Outcome, X, Y
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.world import WorldError
from pytest_pafot.world.codec import described, from_dict
from pytest_pafot.world.engines.simulation import Control, Vehicle
from tests.helpers.tables import table

pytest.importorskip(
    "metadrive", reason='needs Python 3.11 and pip install "pytest-pafot[metadrive]"'
)

from pytest_pafot.simulators.metadrive import Expert, MetaDrive, expert, idm

PLANNER = pafot.metadrive(duration=6.0)
LIDAR = pafot.metadrive(duration=6.0, observation="lidar")
VEHICLE = pafot.metadrive(duration=6.0, observation="vehicle")
BESIDE = Scenario(npcs=((PositionInstruction(Cell.LEFT, 20.0),),), ego_speed=20.0, gene_seconds=6.0)
"""A scenario with a vehicle next to the ego, into whose lane the expert moves."""


def almost_alone(speed, **given):
    """Return a scenario in which the only other vehicle stays behind."""
    return Scenario(npcs=((PositionInstruction(Cell.REAR_RIGHT, 5.0),),), ego_speed=speed, **given)


class Steady:
    def __call__(self, seen):
        return 0.0, 0.0


def vehicle(x, y, speed=0.0, heading=0.0, length=4.515, width=1.852):
    return Vehicle(x, y, heading, speed, length, width, 0, "car")


def control(of, action=None):
    return Control(0.0, 0.0, of.x, of.y, of.heading, of.speed, action)


# What a policy gets, and what its actions do.


def test_expert_decides_as_metadrives_own_code_does():
    from metadrive.examples.ppo_expert import numpy_expert

    simulator = MetaDrive(map="SSSS", lanes=3, observation="lidar")
    own, other = vehicle(100.0, 3.5, 15.0), vehicle(115.0, 3.5, 10.0)
    simulator.start([own, other], 0)
    policy = Expert()
    for _ in range(20):
        action = policy(simulator.observe())
        assert action == tuple(numpy_expert.expert(simulator._ego, deterministic=True).tolist())
        simulator.step([control(own, action), control(other)])


def test_observation_is_that_of_an_environment_that_drove_to_the_same_place():
    """All but the last action and the yaw rate, which a run that starts there does not have."""
    simulator = MetaDrive(map="SSSS", lanes=4, observation="lidar")
    environment = simulator._env
    environment.reset(seed=0)
    policy, seen = Expert(), None
    while environment.agent.position[0] < 90.0:  # in the middle of a block
        seen = environment.step(
            policy(environment.observations["default_agent"].observe(environment.agent))
        )[0]
    there = environment.agent
    simulator.start(
        [vehicle(*map(float, there.position), float(there.speed), float(there.heading_theta))], 0
    )
    differs = np.abs(simulator.observe() - seen) > 1e-4
    assert set(np.flatnonzero(differs)) <= {5, 6, 7}


def test_lidar_sees_the_others_at_the_start_of_a_run_and_after_a_tick():
    simulator = MetaDrive(map="SSSS", lanes=4, observation="lidar")
    own, ahead, truck = (
        vehicle(100.0, 7.0),
        vehicle(115.0, 7.0),
        vehicle(100.0, 3.5, length=12.0, width=2.5),
    )
    simulator.start([own, ahead, truck], 0)
    first = simulator.observe()
    simulator.step([control(own, (0.0, -1.0)), control(ahead), control(truck)])
    for seen in (first, simulator.observe()):
        assert seen.shape == (275,)
        # the truck, the nearest
        assert seen[19:21] == pytest.approx([0.5, (1 - 3.5 / 50) / 2], abs=1e-3)
        assert seen[23:25] == pytest.approx([(1 + 15 / 50) / 2, 0.5], abs=1e-3)
        # straight ahead, to the rear bumper
        assert seen[35] == pytest.approx((15 - 2.2575) / 50, abs=1e-2)


def test_sensors_change_the_size_of_the_lidar_observation():
    sensors = {"lidar": {"num_others": 0, "num_lasers": 72}, "side_detector": {"num_lasers": 20}}
    simulator = MetaDrive(map="SSSS", lanes=3, observation="lidar", sensors=sensors)
    simulator.start([vehicle(60.0, 3.5, 15.0)], 0)
    assert simulator.observe().shape == (19 - 2 + 20 + 72,)


def test_acceleration_and_steering_of_a_planner_act_as_in_the_packages_own_model():
    braking = PLANNER.rollout(almost_alone(20.0), lambda: lambda seen: (-3.0, 0.0))
    assert np.diff(braking.states[:20, 0, SPEED]).mean() == pytest.approx(-0.3, abs=0.02)
    turning = PLANNER.rollout(almost_alone(10.0), lambda: lambda seen: (0.0, 0.01))
    radius = 4.515 / 2 / math.sin(math.atan(math.tan(0.01) / 2))
    x, y = (turning.states[30, 0, axis] - turning.states[0, 0, axis] for axis in (X, Y))
    assert y == pytest.approx(x**2 / 2 / radius, rel=0.1)  # to the right, which is positive


def test_vehicles_that_overlap_do_not_push_each_other():
    simulator = MetaDrive(map="SSSS", lanes=3)
    own, other = vehicle(100.0, 3.5, 10.0), vehicle(104.0, 3.5, 0.0)
    simulator.start([own, other], 0)
    for _ in range(5):
        simulator.step([control(own, (0.0, 0.1)), control(other)])
    (x, y, _, speed), _ = simulator.states()
    assert (x, y) == pytest.approx((105.0, 3.5), abs=0.3)
    assert speed > 9.5
    assert tuple(simulator._npcs[0].position) == (104.0, 3.5)


def test_ego_follows_a_curve_by_its_own_policy():
    world = pafot.metadrive(
        "SSSCSS", observation="vehicle", start_speed=8.0, start_at=100.0, duration=30.0
    )
    trace = world.rollout(almost_alone(8.0, ego_lane=0, gene_seconds=30.0), idm)
    assert trace.outcome is Outcome.COMPLETED
    turned = trace.states[-1, 0, 2] - trace.states[0, 0, 2]
    assert abs(turned) > math.radians(20)


# Promises of a world.


@table(("world", "ads"), [(PLANNER, Steady), (LIDAR, expert), (VEHICLE, idm)])
def test_runs_repeat_to_the_last_bit_whatever_ran_before(world, ads):
    first = world.rollout(BESIDE, ads)
    PLANNER.rollout(almost_alone(3.0), lambda: lambda seen: (2.0, 0.2))  # with another engine
    world.rollout(Scenario(npcs=((PositionInstruction(Cell.FRONT, 3.0),),), ego_speed=12.0), ads)
    assert np.array_equal(world.rollout(BESIDE, ads).states, first.states)


AGAIN = """
import sys
from tests.optional.test_metadrive import BESIDE, LIDAR, expert
sys.stdout.buffer.write(LIDAR.rollout(BESIDE, expert).states.tobytes())
"""


def test_run_of_the_expert_is_the_same_in_another_process():
    LIDAR.rollout(almost_alone(12.0), expert)
    here = LIDAR.rollout(BESIDE, expert)
    root = Path(__file__).parents[2]
    there = subprocess.run(
        [sys.executable, "-c", AGAIN], cwd=root, check=True, stdout=subprocess.PIPE
    ).stdout
    assert there == here.states.tobytes()


def test_search_of_the_expert_finds_a_collision_that_a_careful_driver_avoids(tmp_path):
    def holds(run):
        assert not run.collision, run.explain()

    given = {"world": LIDAR, "blame": "ego", "npcs": 3, "corpus": tmp_path, "shrink_runs": 12}
    found = pafot.explore(expert, holds=holds, runs=4, seed=6, **given)
    (finding,), (sighting,) = found.findings, found.sightings
    assert finding.expect.responsibility == "ego"
    assert finding.expect.takeover is not None
    assert not sighting.is_flaky
    saved = next(tmp_path.rglob("*.pafot.yaml"))
    assert "kind: metadrive" in saved.read_text()
    assert pafot.load(saved).replay(expert).trace.collision == finding.trace.collision


def test_world_is_made_again_from_its_file():
    sensors = {"lidar": {"num_others": 0}}
    world = pafot.metadrive(
        "SSS", 3, observation="lidar", sensors=sensors, speed_limit=15.0, ads_hz=5
    )
    assert described(from_dict(described(world))) == described(world)


def test_nothing_is_downloaded_and_no_window_is_open():
    LIDAR.rollout(almost_alone(12.0, gene_seconds=1.0), expert)
    import metadrive
    from metadrive.engine.engine_utils import get_engine

    assert not Path(metadrive.__file__).with_name("assets").exists()
    assert get_engine().win is None


# Errors.


def test_environment_of_the_users_own_is_not_closed():
    from metadrive.engine.engine_utils import close_engine, get_engine
    from metadrive.envs.metadrive_env import MetaDriveEnv

    close_engine()
    own = MetaDriveEnv({"log_level": 50, "map": "S", "traffic_density": 0.0})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "metadrive.engine.base_engine.BaseEngine.try_pull_asset", staticmethod(lambda: None)
        )
        own.reset()
    try:
        with pytest.raises(
            WorldError,
            match=r"no other environment in this process, received one that is still open\. Call",
        ):
            _ = pafot.metadrive("SSS").road
        assert get_engine() is not None
    finally:
        own.close()


@table(("world", "ads", "message"), [
    (PLANNER, expert, r"observation='lidar'\) for this policy of MetaDrive"),
    (LIDAR, idm, r"Write `world=pafot.metadrive\(observation='vehicle'\)`"),
    (pafot.Highway(), expert, "received Highway"),
])  # fmt: skip
def test_own_policy_refuses_a_world_without_its_observation(world, ads, message):
    with pytest.raises(AdsFactoryError, match=message):
        world.rollout(BESIDE, ads)


@table(("action", "message"), [
    (0.5, "two numbers from -1 to 1, received 0.5"),
    ("left", "received 'left'"),
    ((0.0, math.nan), "received .0.0, nan."),
    (None, "is a `return` missing?"),
])  # fmt: skip
def test_action_that_is_none_ends_the_run_as_an_error_of_the_policy(action, message):
    trace = LIDAR.rollout(BESIDE, lambda: lambda seen: action)
    assert trace.outcome is Outcome.ADS_ERROR
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(str(trace.error))
