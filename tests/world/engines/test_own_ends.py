"""The environment's own ends of a run: at the tick at which ``env.step`` ends an episode, on every route of a run."""

from __future__ import annotations

import copy
import random
import time

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from highway_env.envs.exit_env import ExitEnv
from highway_env.envs.highway_env import HighwayEnv, HighwayEnvFast
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.controller import ControlledVehicle

from pytest_pafot.findings.finding import Finding, Found, handles, unhandled
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, X
from pytest_pafot.oracle.run import Run
from pytest_pafot.world import World, WorldError
from pytest_pafot.world.codec import from_dict
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.gym_environment import ENDS, vehicle_classes_kept
from tests.helpers.world_cases import constant_speed

IDLE, FASTER = 1, 3


class Goal(HighwayEnvFast):
    def _is_terminated(self):
        return super()._is_terminated() or self.vehicle.position[0] > 260.0


class Exit(ExitEnv):
    def _is_terminated(self):
        return self._is_success() or self.vehicle.position[0] > 430.0


class Timed(HighwayEnvFast):
    """Times that are sums of tenths are not exact, and the episode is as long as highway-env makes it."""

    @classmethod
    def default_config(cls):
        return super().default_config() | {
            "simulation_frequency": 10,
            "policy_frequency": 10,
            "least": 1.0,
        }

    def _is_truncated(self):
        return self.time >= self.config["least"]


class Rewarded(gymnasium.Wrapper):
    def reset(self, **given):
        self.won = 0.0
        return super().reset(**given)

    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        self.won += reward
        return seen, reward, terminated or self.won > 3.5, truncated, info


class Fenced(gymnasium.Wrapper):
    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return (
            seen,
            reward,
            terminated,
            truncated or self.unwrapped.vehicle.position[0] > 300.0,
            info,
        )


def limited(env):
    return TimeLimit(env, max_episode_steps=4)


STEERING = {"type": "ContinuousAction"}
CASES = {
    "a goal line": ({"entry_point": Goal}, {}, IDLE, "Goal._is_terminated"),
    "a registered limit of steps": (
        {"entry_point": HighwayEnvFast, "max_episode_steps": 4}, {}, IDLE, "max_episode_steps=4",
    ),
    "a limit by a wrapper": ({"entry_point": HighwayEnvFast}, {"wrappers": [limited]}, IDLE, "max_episode_steps=4"),
    "off the road": (
        {"entry_point": HighwayEnv}, {"config": {"offroad_terminal": True, "action": STEERING}},
        np.array([0.0, 0.05], dtype=np.float32), "highway_env.envs.highway_env.HighwayEnv._is_terminated",
    ),
    "an exit": ({"entry_point": Exit}, {}, IDLE, "Exit._is_terminated"),
    "a sum of times": ({"entry_point": Timed}, {}, IDLE, "Timed._is_truncated"),
    "rewards in a wrapper": ({"entry_point": HighwayEnvFast}, {"wrappers": [Rewarded]}, FASTER, "Rewarded"),
    "truncated by a wrapper": ({"entry_point": HighwayEnvFast}, {"wrappers": [Fenced]}, IDLE, "Fenced"),
    "behind a merge": (
        {"entry_point": "highway_env.envs:MergeEnv"}, {}, IDLE, "highway_env.envs.merge_env.MergeEnv._is_terminated",
    ),
    "across an intersection": (
        {"entry_point": "highway_env.envs:IntersectionEnv"}, {"duration": 13.0}, 1,
        "highway_env.envs.intersection_env.IntersectionEnv._is_terminated",
    ),
}  # fmt: skip


def scenario_in(world):
    """Return a scenario of 30 s in which an NPC stays behind, where it does not matter."""
    lane, speed = (1, 20.0) if world.start is None else world.start
    return Scenario(
        npcs=[[PositionInstruction(Cell.REAR, 0.0)] * 3],
        ego_lane=lane,
        ego_speed=speed,
        gene_seconds=10.0,
    )


def by_env_step(env_id, world, action, start):
    """Return after how many ticks ``env.step`` ends an episode in which the ego, alone, begins as in a run."""
    config = world.make().unwrapped.config
    with vehicle_classes_kept():
        env = gymnasium.make(env_id, config=config, disable_env_checker=True)
        for wrapper in world.wrappers or ():
            env = wrapper(env)
        env.reset(seed=0)
    plain = env.unwrapped
    own, (x, y, heading, speed) = plain.vehicle, start[:4]
    ego = plain.action_type.vehicle_class(plain.road, [x, y], heading, speed)
    if getattr(own, "route", None):
        ego.plan_route_to(own.route[-1][1])
    plain.controlled_vehicles, plain.road.vehicles = [ego], [ego]
    plain.define_spaces()
    plain.config["duration"] = 1000.0  # which the world decides
    is_over = False
    while not is_over:
        _, _, terminated, truncated, _ = env.step(action)
        is_over = terminated or truncated
    return plain.steps


@pytest.mark.oracle
@pytest.mark.parametrize("case", CASES)
def test_a_run_ends_at_the_tick_of_env_step(register, case):
    registered, given, action, name = CASES[case]
    register("ending-v0", **registered)
    world = World("ending-v0", **given)
    scenario = scenario_in(world)
    trace = world.rollout(scenario, lambda: lambda seen: action)
    assert trace.ticks == by_env_step("ending-v0", world, action, trace.ego[0])
    assert (trace.ended, trace.outcome) == (
        name,
        Outcome.OFF_ROAD if case == "off the road" else Outcome.COMPLETED,
    )
    again = world.rollout_in_gym(scenario, lambda: lambda seen: action)
    assert (again.ended, again.outcome) == (trace.ended, trace.outcome)
    assert again.states == pytest.approx(trace.states, abs=1e-9)
    longer = World("ending-v0", **given, ends="duration").rollout(
        scenario, lambda: lambda seen: action
    )
    assert (longer.ended, longer.ticks > trace.ticks) == ("", True)
    assert longer.states[: len(trace.states)].tobytes() == trace.states.tobytes()


class Careless(IDMVehicle):
    """A vehicle class with code of its own, which compiled code does not drive."""

    def act(self, action=None):
        super().act()


def idle():
    return lambda seen: IDLE


@pytest.mark.parametrize(
    "ego", [constant_speed, lambda: IDMVehicle, lambda: Careless, lambda: ControlledVehicle]
)
def test_every_kind_of_ego_ends_at_the_goal(register, ego):
    """Decisions are once a second, except those of the planner."""
    register("ending-v0", entry_point=Goal)
    world = World("ending-v0", planner_hz=5 if ego is constant_speed else None)
    scenario = scenario_in(world)
    trace = world.rollout(scenario, ego)
    every = trace.physics_hz // trace.ads_hz
    assert (trace.ended, trace.ticks % every) == ("Goal._is_terminated", 0)
    assert trace.ego[-1 - every, X] <= 260.0 < trace.ego[-1, X]
    again = world.rollout_in_gym(scenario, ego)
    assert (again.ended, again.ticks) == (trace.ended, trace.ticks)


def test_reference_drivers_end_there_too_and_no_run_is_driven_on_past_an_end(register):
    register("ending-v0", entry_point=Goal)
    register("limited-v0", entry_point=HighwayEnvFast, max_episode_steps=4)
    for world in (World("ending-v0"), World("limited-v0")):
        scenario = scenario_in(world)
        trace = world.rollout(scenario, idle)
        for other in (
            world.rollout_reference(scenario, "careful-human"),
            world.take_over(trace, trace.ticks - 5, "careful-human"),
            world.lasting(40.0).rollout(scenario, idle),
        ):
            assert other.ended == trace.ended
    assert world.longest_run == 4.0
    assert World("limited-v0", ends="duration").longest_run == 30.0


class Plain(gymnasium.RewardWrapper):
    def reward(self, reward):
        return reward + 1.0


class Twice(gymnasium.Wrapper):
    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


class OwnStep(HighwayEnvFast):
    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return seen, reward, terminated or self.vehicle.position[0] > 260.0, truncated, info


class LooksAhead(OwnStep):
    def step(self, action):
        ahead = copy.deepcopy(self)
        ahead._simulate(action)
        assert ahead.vehicle.position[0] > self.vehicle.position[0]
        assert not ahead._is_terminated()
        return super().step(action)


@pytest.mark.oracle
@pytest.mark.parametrize(("entry_point", "wrappers", "name"), [
    (HighwayEnvFast, [Fenced], "Fenced"),
    (HighwayEnvFast, [Rewarded], "Rewarded"),
    (HighwayEnvFast, [Plain, limited], "max_episode_steps=4"),
    (HighwayEnvFast, [Twice, limited], "max_episode_steps=4"),
    (Goal, [Twice], "Goal._is_terminated"),
    (OwnStep, None, "OwnStep.step"),
])  # fmt: skip
def test_what_only_steps_end_ends_at_their_tick_whoever_drives(
    register, entry_point, wrappers, name
):
    """On an empty road, who keeps the speed drives as the idle action does."""
    register("ending-v0", entry_point=entry_point)
    world = World("ending-v0", wrappers=wrappers)
    scenario = scenario_in(world)
    trace = world.rollout(scenario, idle)
    ticks = by_env_step("ending-v0", world, IDLE, trace.ego[0])
    for other in (
        trace,
        world.rollout_reference(scenario, "careful-human"),
        world.take_over(trace, trace.ticks - 5, "careful-human"),
        world.rollout(scenario, lambda: IDMVehicle),
        world.rollout(scenario, lambda: Careless),
    ):
        assert (other.ended, other.ticks, other.outcome) == (name, ticks, Outcome.COMPLETED)
    longer = World("ending-v0", wrappers=wrappers, ends="duration").rollout_reference(
        scenario, "careful-human"
    )
    assert (longer.ended, longer.duration) == ("", 30.0)


def test_a_step_may_look_ahead_in_a_copy_of_the_environment(register):
    register("ending-v0", entry_point=OwnStep)
    register("looking-v0", entry_point=LooksAhead)
    first, second = (
        world.rollout_reference(scenario_in(world), "careful-human")
        for world in map(World, ("ending-v0", "looking-v0"))
    )
    assert (first.ended, second.ended) == ("OwnStep.step", "LooksAhead.step")
    assert second.states.tobytes() == first.states.tobytes()


def test_planners_have_no_step_of_the_environment_that_could_end_their_runs(register):
    register("ending-v0", entry_point=OwnStep)
    world = World("ending-v0", planner_hz=5)
    assert world.rollout(scenario_in(world), constant_speed).ended == ""
    assert world.rollout_reference(scenario_in(world), "careful-human").ended == ""


class Failing(Fenced):
    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return seen, reward, terminated, bool(truncated and info["fence"]), info


class Endless(gymnasium.Wrapper):
    def step(self, action):
        seen, reward, _, _, info = super().step(action)
        return seen, reward, False, False, info


class Thinking(gymnasium.Wrapper):
    def step(self, action):
        time.sleep(0.25)
        return super().step(action)


class FailingReset(Fenced):
    def reset(self, **given):
        raise KeyError("start")


class Doubtful(gymnasium.Wrapper):
    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return seen, reward, np.array([terminated, truncated]), truncated, info


class Old(gymnasium.Wrapper):
    """Its step returns what the older gym expected."""

    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return seen, reward, terminated or truncated, info


@pytest.mark.parametrize(
    ("wrapper", "ticks", "error"),
    [
        (FailingReset, 0, "KeyError: 'start'"),
        (Doubtful, 5, "ValueError: "),
        (Old, 5, "ValueError: step: expected (o"),
    ],
)
def test_wrappers_that_fail_beside_an_episode_end_the_run_there(wrapper, ticks, error):
    world = World("highway-fast-v0", wrappers=[wrapper])
    scenario = scenario_in(world)
    by_reference = world.rollout_reference(scenario, "careful-human")
    for failed in (by_reference, world.rollout(scenario, lambda: IDMVehicle)):
        assert failed.ended.startswith(f"{wrapper.__name__} failed: {error}")
        assert (failed.ticks, failed.outcome) == (ticks, Outcome.INVALID)


class Lazy(gymnasium.Wrapper):
    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def test_wrappers_that_fail_or_do_nothing_or_take_long_do_not_stop_reference_drivers(register):
    scenario = scenario_in(World("highway-fast-v0"))
    failed = World("highway-fast-v0", wrappers=[Failing]).rollout_reference(
        scenario, "careful-human"
    )
    expected = "Failing failed: KeyError: 'fence'"
    assert (failed.ended, failed.ticks, failed.outcome) == (expected, 30, Outcome.INVALID)
    register("ending-v0", entry_point=Wrong)
    failed = World("ending-v0", wrappers=[Endless]).rollout_reference(scenario, "careful-human")
    assert (failed.ended, failed.outcome) == (
        "Wrong._is_terminated failed: KeyError: 'goal'",
        Outcome.INVALID,
    )
    slow = World("highway-fast-v0", wrappers=[Thinking], hang_limit=0.2, duration=2.0)
    for driven in (slow.rollout(scenario, idle), slow.rollout_reference(scenario, "careful-human")):
        assert (driven.ended, driven.outcome, driven.duration) == ("", Outcome.COMPLETED, 2.0)
    driven = World("highway-fast-v0", wrappers=[Lazy]).rollout_reference(scenario, "careful-human")
    assert (driven.ended, driven.duration) == ("", 30.0)


def test_a_collision_within_a_step_ends_the_run_of_a_reference_driver_as_a_collision():
    """It takes over a tick before the collision, and the wrappers' step goes on after it."""
    stops = Scenario(
        npcs=[[PositionInstruction(Cell.FRONT, 0.0)]], ego_speed=30.0, gene_seconds=10.0
    )
    plain, wrapped = World("highway-fast-v0"), World("highway-fast-v0", wrappers=[Twice] * 4)
    hit = plain.rollout(stops, idle)
    first, second = (
        world.take_over(hit, hit.ticks - 1, "careful-human") for world in (plain, wrapped)
    )
    # a step is 16 of 5 ticks
    assert (second.outcome, second.ticks % 80 < 75) == (Outcome.COLLISION, True)
    assert second.states.tobytes() == first.states.tobytes()


class Blind(IDMVehicle):
    def act(self, action=None):
        self.action = {"steering": 0.0, "acceleration": 0.0}


class Unlimited(HighwayEnvFast):
    def _is_truncated(self):
        return False


class Whole(gymnasium.Wrapper):
    def step(self, action):
        for _ in range(1000):
            result = super().step(action)
            if result[2] or result[3]:
                return result
        raise TimeoutError("the episode does not end")


@pytest.mark.parametrize("duration", [20.0, 2.0])
def test_the_episode_is_over_for_wrappers_when_the_run_is(register, duration):
    register("ending-v0", entry_point=Unlimited)
    stops = Scenario(
        npcs=[[PositionInstruction(Cell.FRONT, 0.0)]], ego_speed=30.0, gene_seconds=10.0
    )
    plain, wrapped = (
        World("ending-v0", duration=duration, wrappers=each) for each in (None, [Whole])
    )
    for ads in (idle, lambda: Blind):
        first, second = (world.rollout(stops, ads) for world in (plain, wrapped))
        assert (second.outcome, second.ticks, second.ended) == (first.outcome, first.ticks, "")
        assert second.outcome is (Outcome.COLLISION if duration > 7.2 else Outcome.COMPLETED)
    assert wrapped.rollout_reference(stops, "careful-human").ended == ""


def test_a_policy_has_no_episodes_that_a_step_of_the_older_gym_ends_by_its_info():
    world = World("highway-fast-v0", wrappers=[Old])
    trace = world.rollout(scenario_in(world), idle)
    assert trace.outcome is Outcome.ADS_ERROR
    assert trace.error.message.startswith(
        "step: expected (observation, reward, terminated, truncated, info), as in g"
    )


class Wrong(HighwayEnvFast):
    def _is_terminated(self):
        return self.vehicle.position[0] > 260.0 and self.config["goal"]


@pytest.mark.parametrize("wrappers", [None, []])
def test_an_error_in_an_end_makes_the_run_invalid_and_is_named(register, wrappers):
    register("ending-v0", entry_point=Wrong)
    world = World("ending-v0", wrappers=wrappers)
    trace = world.rollout(scenario_in(world), idle)
    assert (trace.outcome, trace.ended) == (
        Outcome.INVALID,
        "Wrong._is_terminated failed: KeyError: 'goal'",
    )
    assert trace.users_error_text in Run(trace).explain()


def test_a_file_says_what_ends_runs_only_where_that_matters(register):
    register("ending-v0", entry_point=Goal)
    register("limited-v0", entry_point=HighwayEnvFast, max_episode_steps=4)
    assert "ends" not in World("ending-v0").to_dict()
    assert World("highway-v0", ends="duration").to_dict() == World("highway-v0").to_dict()
    for env_id in ("ending-v0", "limited-v0", "merge-v0"):
        world = World(env_id, ends="duration")
        assert world.to_dict() == {**World(env_id).to_dict(), "ends": "duration"}
        assert from_dict(world.to_dict()).ends == "duration"
    assert World("highway-v0", wrappers=[Fenced], ends="duration").to_dict()["ends"] == "duration"
    with pytest.raises(
        WorldError, match="ends: expected 'environment' or 'duration', received 'never'"
    ):
        World("highway-v0", ends="never")


def test_a_failure_behind_the_end_has_drifted(register):
    register("ending-v0", entry_point=Goal)
    stops = Scenario(npcs=[[PositionInstruction(Cell.FRONT, 0.0)]], gene_seconds=10.0)
    found = World("ending-v0", ends="duration").rollout(stops, idle)
    assert (found.outcome, found.ego[-1, X] > 261.0) == (Outcome.COLLISION, True)
    failed = Failure(kind="AssertionError", assertion="assert not run.collision")
    seen = Found(seed=1, generation=0, algorithm="")
    finding = Finding.from_run(Run(found), failed, test="t.py::t", world={}, found=seen)
    now = World("ending-v0").rollout(stops, idle)
    assert not handles(finding, Run(now))
    said = unhandled(finding, Run(now))
    assert (
        said == "Goal._is_terminated ended the run after 3.0 s, before the saved failure at 6.4 s"
    )


class Judge:
    """A helper of the user's own, which remembers."""

    def __init__(self, road):
        self.road, self.asked = road, 0

    def says(self, env):
        assert self.road is env.road
        self.asked += 1
        return self.asked == 7


class Remembering(HighwayEnvFast):
    """It counts in all places that are changed in place."""

    def _reset(self):
        super()._reset()
        self.seen, self.judge = [], Judge(self.road)
        self.config["asked"] = 0

    def _is_terminated(self):
        self.seen.append(self.vehicle.position[0])
        return len(self.seen) == 7

    def _is_truncated(self):
        self.config["asked"] += 1
        return self.judge.says(self) and self.config["asked"] == 7


@pytest.mark.parametrize("name", ["_is_terminated", "_is_truncated"])
def test_what_an_end_remembers_is_that_of_its_run_alone(register, name):
    """An episode ends with its seventh step, whatever ran before, and whoever drives."""
    ends = type(
        "Ends",
        (Remembering,),
        {each: getattr(HighwayEnvFast, each) for each in ENDS if each != name},
    )
    register("ending-v0", entry_point=ends)
    world, planners = World("ending-v0"), World("ending-v0", planner_hz=5)
    scenario = scenario_in(world)
    for _ in range(2):
        assert world.rollout(scenario, idle).duration == 7.0
        assert world.rollout(scenario, lambda: IDMVehicle).duration == 7.0
        assert world.rollout_reference(scenario, "careful-human").duration == 7.0
        assert planners.rollout(scenario, constant_speed).duration == 7 / 5
    assert world.rollout_in_gym(scenario, idle).duration == 7.0


class Chance(HighwayEnvFast):
    def _is_terminated(self):
        return random.random() < 0.2 or np.random.random() < 0.1


class Lottery(gymnasium.Wrapper):
    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return (
            seen,
            reward,
            terminated or random.random() < 0.2 or np.random.random() < 0.1,
            truncated,
            info,
        )


@pytest.mark.parametrize("given", [{}, {"wrappers": [Lottery]}])
def test_ends_by_chance_depend_on_the_seed_of_the_scenario_alone(register, given):
    """Whoever drives, and whatever the process has drawn before."""
    register("ending-v0", entry_point=HighwayEnvFast if given else Chance)
    world = World("ending-v0", **given)
    scenario = scenario_in(world)
    trace, seen = GENERATORS.run(World("ending-v0", ends="duration").rollout, scenario, idle), []
    for seed in (1, 2, 3):
        random.seed(seed)
        np.random.seed(seed)
        by_reference = world.rollout_reference(scenario, "careful-human")
        taken = world.take_over(trace, 10, "careful-human")
        seen.append(
            (GENERATORS.run(world.rollout, scenario, idle).ticks, by_reference.ticks, taken.ticks)
        )
        assert random.random() == random.Random(seed).random()  # given back
    assert len({*seen}) == 1
    assert len({*seen[0]}) == 1


class TwentySteps(HighwayEnvFast):
    def _is_truncated(self):
        return self.time * self.config["policy_frequency"] >= 20


def test_an_end_reads_the_rate_of_the_steps_after_which_it_is_asked(register):
    register("ending-v0", entry_point=TwentySteps)
    planners, others = World("ending-v0", planner_hz=5), World("ending-v0")
    for world, ads, seconds in (
        (planners, constant_speed, 4.0),
        (others, idle, 20.0),
        (others, lambda: IDMVehicle, 20.0),
    ):
        scenario = scenario_in(world)
        assert world.rollout(scenario, ads).duration == pytest.approx(seconds)
        assert world.rollout_in_gym(scenario, ads).duration == pytest.approx(seconds)


class Skipping(HighwayEnvFast):
    def step(self, action):
        for _ in range(3):
            result = super().step(action)
        return result


@pytest.mark.parametrize("wrappers", [None, []])
def test_a_limit_counts_steps_of_the_environment_that_repeat_actions(register, wrappers):
    register("limited-v0", entry_point=Skipping, max_episode_steps=4)
    world = World("limited-v0", wrappers=wrappers)
    trace = world.rollout(scenario_in(world), idle)
    assert (trace.ended, trace.duration) == ("max_episode_steps=4", 12.0)
    assert World("limited-v0", wrappers=wrappers, ends="duration").to_dict()["ends"] == "duration"


class SetOnItself(HighwayEnvFast):
    def __init__(self, *args, **given):
        super().__init__(*args, **given)
        self._is_terminated = lambda: self.vehicle.position[0] > 260.0


@pytest.mark.parametrize("entry_point", [SetOnItself, OwnStep])
def test_an_end_need_not_be_a_method_of_the_class(register, entry_point):
    """The goal is that of ``Goal``, in all of them."""
    register("goal-v0", entry_point=Goal)
    register("ending-v0", entry_point=entry_point)
    expected, world = World("goal-v0"), World("ending-v0")
    scenario = scenario_in(world)
    trace = world.rollout(scenario, idle)
    assert trace.ended.startswith(entry_point.__name__)
    assert trace.ticks == expected.rollout(scenario, idle).ticks
    assert World("ending-v0", ends="duration").rollout(scenario, idle).ended == ""
    assert World("ending-v0", ends="duration").to_dict()["ends"] == "duration"
