"""Training episodes are the runs of a world or of its environment, with the environment's own reward."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.seeding import np_random
from highway_env.envs.highway_env import HighwayEnvFast

import pytest_pafot as pafot
from example_ads import ppo
from pytest_pafot.corpus.writer import write
from pytest_pafot.model.instructions import PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support.errors import BadAction, CorpusError
from pytest_pafot.world import WorldError
from tests.findings.builders import plain_finding
from tests.helpers.stages import oracle
from tests.helpers.tables import table
from tests.world.engines.test_ordinary_traffic import world_of  # noqa: F401  (a fixture)
from tests.world.test_gym_environment import Unhurried, register  # noqa: F401  (register is a fixture)

FAST = pafot.World("highway-fast-v0", {"vehicles_count": 12, "duration": 10}, duration=15)
BRAKING = Scenario(npcs=[[PositionInstruction(2, 5.0)]])
SLOW = Scenario(npcs=[[PositionInstruction(2, 10.0)], [PositionInstruction(6, 25.0)]])


def driven(env, seed, policy):
    """Run one episode; return the info of its reset, and the results of all its steps."""
    seen, first = env.reset(seed=seed)
    results = []
    while not results or not (results[-1][2] or results[-1][3]):
        results.append(env.step(policy(seen)))
        seen = results[-1][0]
    return first, results


def keeping(action):
    """Return a policy that always decides the same."""
    return lambda observation: action


class Told(gym.Wrapper):
    """A wrapper that stores the results of an environment's steps."""

    def __init__(self, env):
        super().__init__(env)
        self.results = []

    def step(self, action):
        self.results.append(self.env.step(action))
        return self.results[-1]


@pytest.mark.filterwarnings("ignore:.*A Box observation space")  # this warning comes from the environment
@pytest.mark.parametrize("share", [oracle(0.0), 1.0])
def test_gymnasium_finds_no_fault(share):
    env = gym.make("pytest_pafot.extras.training:pafot/Scenarios-v0", world=FAST, share=share)
    check_env(env.unwrapped)


def test_training_scenarios_equal_the_runs_exactly():
    env = pafot.training_env(FAST, share=1.0)
    for seed in range(5):
        first, results = driven(env, seed, ppo.make())
        trace = FAST.rollout(env.trace.scenario, ppo.make)
        assert first["scenario"] == trace.scenario.id
        assert (env.trace.actions, env.trace.executed) == (trace.actions, trace.executed)
        assert np.array_equal(env.trace.states, trace.states)
        assert results[-1][2] == (trace.outcome == "collision")


@pytest.mark.parametrize(("env_id", "action"), [("highway-fast-v0", 4), oracle("merge-v0", 0)])
def test_observations_and_rewards_match_the_original_environment(env_id, action):
    own = []

    def told(env):
        own.append(Told(env))
        return own[-1]

    env = pafot.training_env(pafot.World(env_id), share=1.0)
    _, results = driven(env, 4, keeping(action))
    pafot.World(env_id, wrappers=[told]).rollout(env.trace.scenario, lambda: keeping(action))
    assert len(own[-1].results) == len(results) > 5
    for ours, theirs in zip(results[:-1], own[-1].results, strict=False):  # here the end is unknown
        assert np.allclose(ours[0], theirs[0], rtol=0, atol=1e-6)
        assert ours[1:4] == (pytest.approx(theirs[1], abs=1e-9), *theirs[2:4])


def test_episode_that_the_environment_ends_has_its_record():
    """The environment ends where the ego is beyond 370 m, and the road at 460 m."""
    world = pafot.World("merge-v0")
    behind = Scenario(npcs=[[PositionInstruction(6, 10.0)] * 3], ego_speed=30.0)
    env = pafot.training_env(world, [behind], share=1.0)
    _, results = driven(env, 0, keeping(1))
    assert results[-1][2:4] == (True, False)
    trace = world.rollout(env.trace.scenario, lambda: keeping(1))
    assert (env.trace.outcome, env.trace.ended) == ("safe", "MergeEnv._is_terminated")
    assert 370 < env.trace.states[-1, 0, 0] < 395
    assert np.array_equal(env.trace.states, trace.states)
    longer = pafot.World("merge-v0", ends="duration").rollout(env.trace.scenario, lambda: keeping(1))
    assert (longer.outcome, longer.ended) == ("end_of_road", "")


def test_crash_ends_scenario_with_the_reward_for_crashes():
    """Speeds below the rewarded range, in the second of three lanes: -1 of -1 to 0.5, and half of 0.1."""
    env = pafot.training_env(FAST, [Scenario(npcs=BRAKING.npcs, ego_speed=18.0)], share=1.0)
    _, results = driven(env, 0, keeping(1))
    _, reward, is_terminated, is_truncated, info = results[-1]
    assert (is_terminated, is_truncated, info["crashed"], info["responsible"]) == (True, False, True, "ego")
    assert reward == pytest.approx((-1 + 0.05 + 1) / 1.5, abs=0.05)
    assert not any(each[4]["crashed"] or each[4]["responsible"] for each in results[:-1])


@pytest.mark.parametrize("decide", [oracle(ppo.make(), id="careful"), pytest.param(keeping(3), id="faster")])
def test_ordinary_traffic_is_that_of_the_environment_itself(decide):
    env, plain = pafot.training_env(FAST, share=0.0), gym.make(FAST.env_id, config=FAST.config)
    first, results = driven(env, 3, decide)
    rng, _ = np_random(3)
    rng.random()
    _, expected = driven(plain, int(rng.integers(2**31)), decide)
    assert (first["is_scenario"], first["scenario"], env.trace) == (False, "", None)
    assert len(results) == len(expected)
    assert results[-1][2] == expected[-1][2]
    for ours, theirs in zip(results[:-1], expected[:-1], strict=True):
        assert np.allclose(ours[0], theirs[0], rtol=0, atol=1e-6)
        assert ours[1:4] == (pytest.approx(theirs[1], abs=1e-9), *theirs[2:4])


def kinds(env, seed, count):
    """Return the id of each episode's scenario, empty in ordinary traffic."""
    infos = (env.reset(seed=None if number else seed)[1] for number in range(count))
    return [info["scenario"] for info in infos]


def test_share_of_scenarios_follows_from_the_seed():
    env = pafot.training_env(FAST, share=0.75)
    drawn = kinds(env, 7, 24)
    assert 14 <= sum(map(bool, drawn)) <= 22
    assert len(set(drawn)) == sum(map(bool, drawn)) + 1
    assert kinds(pafot.training_env(FAST, share=0.75), 7, 24) == drawn
    assert kinds(env, 8, 24) != drawn


def test_scenarios_come_from_folder_list_or_function(tmp_path):
    for number, each in enumerate((BRAKING, SLOW)):
        write(tmp_path / "test_safety" / f"test_{number}" / "front-2.pafot.yaml", plain_finding(scenario=each))
    both = {BRAKING.id, SLOW.id}
    assert set(kinds(pafot.training_env(FAST, tmp_path, share=1.0), 0, 12)) == both
    assert set(kinds(pafot.training_env(FAST, str(tmp_path / "test_safety" / "test_1"), share=1.0), 0, 3)) == {SLOW.id}
    assert set(kinds(pafot.training_env(FAST, [BRAKING, SLOW], share=1.0), 0, 12)) == both
    assert set(kinds(pafot.training_env(FAST, lambda rng: SLOW, share=1.0), 0, 3)) == {SLOW.id}


def test_environments_of_one_world_do_not_interfere():
    make = partial(pafot.training_env, FAST, share=0.5)
    together = gym.vector.SyncVectorEnv([make, make])
    seen, _ = together.reset(seed=[5, 6])
    alone = [make(), make()]
    assert all(np.array_equal(env.reset(seed=seed)[0], row) for env, seed, row in zip(alone, (5, 6), seen, strict=True))
    for _ in range(4):
        seen, rewards, *_ = together.step(np.array([1, 0]))
        for env, action, row, reward in zip(alone, (1, 0), seen, rewards, strict=True):
            own, own_reward, *_ = env.step(action)
            assert np.array_equal(own, row)
            assert own_reward == reward


NOWHERE = Scenario(npcs=BRAKING.npcs, ego_lane=5)


@table(
    ("arguments", "error", "message"),
    [
        ({"world": pafot.Highway()}, pafot.WorldError, "an environment with a reward"),
        ({"world": pafot.World("highway-v0", wrappers=[])}, pafot.WorldError, "around the training environment"),
        ({"world": pafot.World("highway-v0", planner_hz=5)}, pafot.WorldError, "world.planner_hz: expected None"),
        ({"world": pafot.World("highway-v0", ego="van")}, pafot.WorldError, "world.ego: expected a car"),
        ({"world": pafot.World("lane-keeping-v0")}, pafot.WorldError, "'lane-keeping-v0', which has its own"),
        ({"share": 1.5}, ValueError, "share: .* 0 to 1, received 1.5"),
        ({"share": True}, ValueError, "share: .* received True"),
        ({"scenarios": []}, ValueError, "scenarios: expected at least one, received none"),
        ({"scenarios": 3}, ValueError, "scenarios: expected a folder .* received 3; without this argument they"),
        ({"scenarios": [BRAKING, "x"]}, ValueError, "scenarios: expected a folder .*'x'"),
        ({"scenarios": "nowhere"}, ValueError, "received nowhere, which is not a folder; a search saves them"),
        ({"scenarios": [NOWHERE]}, ScenarioError, "ego_lane"),
    ],
)
def test_unsuitable_training_arguments_are_refused_with_advice(arguments, error, message):
    with pytest.raises(error, match=message):
        pafot.training_env(**{"world": FAST, **arguments})


def test_unfit_saved_scenario_is_named_with_its_line(tmp_path):
    write(tmp_path / "front-2.pafot.yaml", plain_finding(scenario=NOWHERE))
    with pytest.raises(CorpusError, match=r"front-2.pafot.yaml:\d+: scenario.ego.lane"):
        pafot.training_env(FAST, tmp_path)


def test_a_folder_without_scenarios_is_refused(tmp_path):
    with pytest.raises(ValueError, match="which has none; a search saves them"):
        pafot.training_env(FAST, tmp_path)


def test_step_requires_an_episode_and_valid_action():
    env = pafot.training_env(FAST, [BRAKING], share=1.0)
    with pytest.raises(ResetNeeded, match="call reset"):
        env.step(1)
    driven(env, 0, keeping(3))
    with pytest.raises(ResetNeeded, match="call reset"):
        env.step(1)
    env.reset()
    with pytest.raises(BadAction, match="expected a whole number from 0 to 4, received 5"):
        env.step(5)


class DrivesOn(HighwayEnvFast):
    """An environment that does not end its episodes after crashes."""

    def _is_terminated(self):
        return False


def test_training_episode_ends_at_a_crash(world_of):
    env = pafot.training_env(world_of(DrivesOn, vehicles_count=20, duration=30), share=0.0)
    env.reset(seed=5)
    results = [env.step(3)]
    while not (results[-1][2] or results[-1][3]):
        results.append(env.step(3))
    assert (results[-1][2:4], results[-1][4]["crashed"]) == ((False, True), True)
    assert len(results) < 20


def test_environment_with_a_reset_of_its_own_is_refused(register):
    register("mine-v0", entry_point=Unhurried)
    with pytest.raises(WorldError, match="received 'mine-v0', which has its own"):
        pafot.training_env(pafot.World("mine-v0", duration=8.0))
