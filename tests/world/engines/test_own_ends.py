"""The environment's own ends of a run: at the tick at which ``env.step`` ends an episode, on every route of a run."""

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

from pytest_pafot import Cell, PositionInstruction, Run, Scenario, World
from pytest_pafot.findings.finding import Finding, Found, handles, unhandled
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.trace import Outcome, X
from pytest_pafot.world.codec import from_dict
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.gym_environment import ENDS, vehicle_classes_kept
from tests.helpers.refusals import refused
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
        rates = {"simulation_frequency": 10, "policy_frequency": 10}
        return super().default_config() | rates | {"least": 1.0}

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
        is_beyond = self.unwrapped.vehicle.position[0] > 300.0
        return seen, reward, terminated, truncated or is_beyond, info


def limited(env):
    return TimeLimit(env, max_episode_steps=4)


STEERING = {"offroad_terminal": True, "action": {"type": "ContinuousAction"}}
ASIDE = np.array([0.0, 0.05], dtype=np.float32)
FAST = {"entry_point": HighwayEnvFast}
STOCK = "highway_env.envs"
CASES = {
    "a goal line": ({"entry_point": Goal}, {}, IDLE, "Goal._is_terminated"),
    "a registered limit of steps": (FAST | {"max_episode_steps": 4}, {}, IDLE, "max_episode_steps=4"),
    "a limit by a wrapper": (FAST, {"wrappers": [limited]}, IDLE, "max_episode_steps=4"),
    "off the road": (
        {"entry_point": HighwayEnv}, {"config": STEERING}, ASIDE, f"{STOCK}.highway_env.HighwayEnv._is_terminated",
    ),
    "an exit": ({"entry_point": Exit}, {}, IDLE, "Exit._is_terminated"),
    "a sum of times": ({"entry_point": Timed}, {}, IDLE, "Timed._is_truncated"),
    "rewards in a wrapper": (FAST, {"wrappers": [Rewarded]}, FASTER, "Rewarded"),
    "truncated by a wrapper": (FAST, {"wrappers": [Fenced]}, IDLE, "Fenced"),
    "behind a merge": (
        {"entry_point": f"{STOCK}:MergeEnv"}, {}, IDLE, f"{STOCK}.merge_env.MergeEnv._is_terminated",
    ),
    "across an intersection": (
        {"entry_point": f"{STOCK}:IntersectionEnv"}, {"duration": 13.0}, 1,
        f"{STOCK}.intersection_env.IntersectionEnv._is_terminated",
    ),
}  # fmt: skip


@pytest.fixture
def ending(register):
    """Return a function that makes the world of an environment, which it registers."""

    def make(entry_point, limit=None, **given):
        name = f"{getattr(entry_point, '__name__', 'ending')}-v{limit or 0}"
        if name not in gymnasium.registry:
            register(name, entry_point=entry_point, max_episode_steps=limit)
        return World(name, **given)

    return make


def scenario_in(world):
    """Return a scenario of 30 s in which an NPC stays behind, where it does not matter."""
    lane, speed = (1, 20.0) if world.start is None else world.start
    npcs = [[PositionInstruction(Cell.REAR, 0.0)] * 3]
    return Scenario(npcs=npcs, ego_lane=lane, ego_speed=speed, gene_seconds=10.0)


def by_reference(world):
    return world.rollout_reference(scenario_in(world), "careful-human")


def cause(trace):
    """Return what failed at the end of a run, and its exception."""
    failed, _, error = trace.ended.partition(": ")
    return f"{failed.split()[0]} {error}"


def by_env_step(world, action, start):
    """Return after how many ticks ``env.step`` ends an episode in which the ego, alone, begins as in a run."""
    config = world.make().unwrapped.config
    with vehicle_classes_kept():
        env = gymnasium.make(world.env_id, config=config, disable_env_checker=True)
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
    world, ads = World("ending-v0", **given), lambda: lambda seen: action
    scenario = scenario_in(world)
    trace, again = world.rollout(scenario, ads), world.rollout_in_gym(scenario, ads)
    assert trace.ticks == by_env_step(world, action, trace.ego[0])
    outcome = Outcome.OFF_ROAD if case == "off the road" else Outcome.COMPLETED
    for run in (trace, again):
        assert (run.ended, run.outcome) == (name, outcome)
    assert again.states == pytest.approx(trace.states, abs=1e-9)
    longer = World("ending-v0", **given, ends="duration").rollout(scenario, ads)
    assert (longer.ended, longer.ticks > trace.ticks) == ("", True)
    assert longer.states[: len(trace.states)].tobytes() == trace.states.tobytes()


class Careless(IDMVehicle):
    """A vehicle class with code of its own, which compiled code does not drive."""

    def act(self, action=None):
        super().act()


def idle():
    return lambda seen: IDLE


EGOS = [constant_speed, lambda: IDMVehicle, lambda: Careless, lambda: ControlledVehicle]


@pytest.mark.parametrize("ego", EGOS)
def test_every_kind_of_ego_ends_at_the_goal(ending, ego):
    """Decisions are once a second, except those of the planner."""
    world = ending(Goal, planner_hz=5 if ego is constant_speed else None)
    trace, again = (run(scenario_in(world), ego) for run in (world.rollout, world.rollout_in_gym))
    every = trace.physics_hz // trace.ads_hz
    assert (trace.ended, trace.ticks % every) == ("Goal._is_terminated", 0)
    assert trace.ego[-1 - every, X] <= 260.0 < trace.ego[-1, X]
    assert (again.ended, again.ticks) == (trace.ended, trace.ticks)


def test_reference_drivers_end_there_too_and_no_run_is_driven_on_past_an_end(ending):
    for world in (ending(Goal), ending(HighwayEnvFast, 4)):
        scenario = scenario_in(world)
        trace = world.rollout(scenario, idle)
        taken = world.take_over(trace, trace.ticks - 5, "careful-human")
        longer = world.lasting(40.0).rollout(scenario, idle)
        assert {each.ended for each in (by_reference(world), taken, longer)} == {trace.ended}
    assert world.longest_run == 4.0
    assert ending(HighwayEnvFast, 4, ends="duration").longest_run == 30.0


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
def test_what_only_steps_end_ends_at_their_tick_whoever_drives(ending, entry_point, wrappers, name):
    """On an empty road, who keeps the speed drives as the idle action does."""
    world = ending(entry_point, wrappers=wrappers)
    scenario = scenario_in(world)
    trace = world.rollout(scenario, idle)
    ticks = by_env_step(world, IDLE, trace.ego[0])
    for other in (
        trace,
        by_reference(world),
        world.take_over(trace, trace.ticks - 5, "careful-human"),
        world.rollout(scenario, lambda: IDMVehicle),
        world.rollout(scenario, lambda: Careless),
    ):
        assert (other.ended, other.ticks, other.outcome) == (name, ticks, Outcome.COMPLETED)
    longer = by_reference(ending(entry_point, wrappers=wrappers, ends="duration"))
    assert (longer.ended, longer.duration) == ("", 30.0)


def test_a_step_may_look_ahead_in_a_copy_of_the_environment(ending):
    first, second = (by_reference(ending(each)) for each in (OwnStep, LooksAhead))
    assert (first.ended, second.ended) == ("OwnStep.step", "LooksAhead.step")
    assert second.states.tobytes() == first.states.tobytes()


def test_planners_have_no_step_of_the_environment_that_could_end_their_runs(ending):
    world = ending(OwnStep, planner_hz=5)
    assert world.rollout(scenario_in(world), constant_speed).ended == ""
    assert by_reference(world).ended == ""


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
    [(FailingReset, 0, "KeyError"), (Doubtful, 5, "ValueError"), (Old, 5, "ValueError")],
)
def test_wrappers_that_fail_beside_an_episode_end_the_run_there(wrapper, ticks, error):
    world = World("highway-fast-v0", wrappers=[wrapper])
    for failed in (
        by_reference(world),
        world.rollout(scenario_in(world), lambda: IDMVehicle),
    ):
        assert cause(failed).startswith(f"{wrapper.__name__} {error}: ")
        assert (failed.ticks, failed.outcome) == (ticks, Outcome.INVALID)


class Lazy(gymnasium.Wrapper):
    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def test_wrappers_that_fail_or_do_nothing_or_take_long_do_not_stop_reference_drivers(ending):
    failed = by_reference(World("highway-fast-v0", wrappers=[Failing]))
    assert (cause(failed), failed.ticks) == ("Failing KeyError: 'fence'", 30)
    assert failed.outcome is Outcome.INVALID
    failed = by_reference(ending(Wrong, wrappers=[Endless]))
    assert (cause(failed), failed.outcome) == (WRONG, Outcome.INVALID)
    slow = World("highway-fast-v0", wrappers=[Thinking], hang_limit=0.2, duration=2.0)
    for driven in (slow.rollout(scenario_in(slow), idle), by_reference(slow)):
        assert (driven.ended, driven.outcome, driven.duration) == ("", Outcome.COMPLETED, 2.0)
    driven = by_reference(World("highway-fast-v0", wrappers=[Lazy]))
    assert (driven.ended, driven.duration) == ("", 30.0)


FRONT = [[PositionInstruction(Cell.FRONT, 0.0)]]
STOPS = Scenario(npcs=FRONT, ego_speed=30.0, gene_seconds=10.0)


def test_a_collision_within_a_step_ends_the_run_of_a_reference_driver_as_a_collision():
    """It takes over a tick before the collision, and the wrappers' step goes on after it."""
    worlds = World("highway-fast-v0"), World("highway-fast-v0", wrappers=[Twice] * 4)
    hit = worlds[0].rollout(STOPS, idle)
    first, second = (world.take_over(hit, hit.ticks - 1, "careful-human") for world in worlds)
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
def test_the_episode_is_over_for_wrappers_when_the_run_is(ending, duration):
    plain, wrapped = (
        ending(Unlimited, duration=duration, wrappers=each) for each in (None, [Whole])
    )
    for ads in (idle, lambda: Blind):
        first, second = (world.rollout(STOPS, ads) for world in (plain, wrapped))
        assert (second.outcome, second.ticks, second.ended) == (first.outcome, first.ticks, "")
        assert second.outcome is (Outcome.COLLISION if duration > 7.2 else Outcome.COMPLETED)
    assert wrapped.rollout_reference(STOPS, "careful-human").ended == ""


def test_a_policy_has_no_episodes_that_a_step_of_the_older_gym_ends_by_its_info():
    world = World("highway-fast-v0", wrappers=[Old])
    trace = world.rollout(scenario_in(world), idle)
    assert (trace.outcome, trace.error.kind) == (Outcome.ADS_ERROR, "ValueError")


class Wrong(HighwayEnvFast):
    def _is_terminated(self):
        return self.vehicle.position[0] > 260.0 and self.config["goal"]


WRONG = "Wrong._is_terminated KeyError: 'goal'"


@pytest.mark.parametrize("wrappers", [None, []])
def test_an_error_in_an_end_makes_the_run_invalid_and_is_named(ending, wrappers):
    world = ending(Wrong, wrappers=wrappers)
    trace = world.rollout(scenario_in(world), idle)
    assert (trace.outcome, cause(trace)) == (Outcome.INVALID, WRONG)
    assert trace.users_error_text in Run(trace).explain()


def test_a_file_says_what_ends_runs_only_where_that_matters(ending):
    assert "ends" not in ending(Goal).to_dict()
    assert World("highway-v0", ends="duration").to_dict() == World("highway-v0").to_dict()
    for env_id in (ending(Goal).env_id, ending(HighwayEnvFast, 4).env_id, "merge-v0"):
        world = World(env_id, ends="duration")
        assert world.to_dict() == {**World(env_id).to_dict(), "ends": "duration"}
        assert from_dict(world.to_dict()).ends == "duration"
    assert World("highway-v0", wrappers=[Fenced], ends="duration").to_dict()["ends"] == "duration"
    with refused("ends"):
        World("highway-v0", ends="never")


def drifted(ending):
    """Return a finding after the end of a run, and the run that ends before it."""
    stops = Scenario(npcs=FRONT, gene_seconds=10.0)
    found = ending(Goal, ends="duration").rollout(stops, idle)
    assert (found.outcome, found.ego[-1, X] > 261.0) == (Outcome.COLLISION, True)
    failed = Failure(kind="AssertionError", assertion="assert not run.collision")
    seen = Found(seed=1, generation=0, algorithm="")
    finding = Finding.from_run(Run(found), failed, test="t.py::t", world={}, found=seen)
    return finding, Run(ending(Goal).rollout(stops, idle))


def test_a_failure_behind_the_end_has_drifted(ending):
    finding, now = drifted(ending)
    assert not handles(finding, now)
    assert unhandled(finding, now).startswith("Goal._is_terminated ")


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
def test_what_an_end_remembers_is_that_of_its_run_alone(ending, name):
    """An episode ends with its seventh step, whatever ran before, and whoever drives."""
    others = {each: getattr(HighwayEnvFast, each) for each in ENDS if each != name}
    ends = type("Ends", (Remembering,), others)
    world, planners = ending(ends), ending(ends, planner_hz=5)
    scenario = scenario_in(world)
    for _ in range(2):
        runs = world.rollout(scenario, idle), world.rollout(scenario, lambda: IDMVehicle)
        assert {each.duration for each in (*runs, by_reference(world))} == {7.0}
        assert planners.rollout(scenario, constant_speed).duration == 7 / 5
    assert world.rollout_in_gym(scenario, idle).duration == 7.0


def is_over():
    return random.random() < 0.2 or np.random.random() < 0.1


class Chance(HighwayEnvFast):
    def _is_terminated(self):
        return is_over()


class Lottery(gymnasium.Wrapper):
    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return seen, reward, terminated or is_over(), truncated, info


@pytest.mark.parametrize("given", [{}, {"wrappers": [Lottery]}])
def test_ends_by_chance_depend_on_the_seed_of_the_scenario_alone(ending, given):
    """Whoever drives, and whatever the process has drawn before."""
    cls, seen = HighwayEnvFast if given else Chance, []
    world, longer = ending(cls, **given), ending(cls, ends="duration")
    scenario = scenario_in(world)
    trace = GENERATORS.run(longer.rollout, scenario, idle)
    for seed in (1, 2, 3):
        random.seed(seed)
        np.random.seed(seed)
        runs = by_reference(world), world.take_over(trace, 10, "careful-human")
        own = GENERATORS.run(world.rollout, scenario, idle)
        seen.append((own.ticks, *(each.ticks for each in runs)))
        assert random.random() == random.Random(seed).random()  # given back
    assert len({*seen}) == 1
    assert len({*seen[0]}) == 1


class TwentySteps(HighwayEnvFast):
    def _is_truncated(self):
        return self.time * self.config["policy_frequency"] >= 20


def test_an_end_reads_the_rate_of_the_steps_after_which_it_is_asked(ending):
    planners, others = ending(TwentySteps, planner_hz=5), ending(TwentySteps)
    for world, ads, seconds in (
        (planners, constant_speed, 4.0),
        (others, idle, 20.0),
        (others, lambda: IDMVehicle, 20.0),
    ):
        for run in (world.rollout, world.rollout_in_gym):
            assert run(scenario_in(world), ads).duration == pytest.approx(seconds)


class Skipping(HighwayEnvFast):
    def step(self, action):
        for _ in range(3):
            result = super().step(action)
        return result


@pytest.mark.parametrize("wrappers", [None, []])
def test_a_limit_counts_steps_of_the_environment_that_repeat_actions(ending, wrappers):
    world = ending(Skipping, 4, wrappers=wrappers)
    trace = world.rollout(scenario_in(world), idle)
    assert (trace.ended, trace.duration) == ("max_episode_steps=4", 12.0)
    longer = ending(Skipping, 4, wrappers=wrappers, ends="duration")
    assert longer.to_dict()["ends"] == "duration"


class SetOnItself(HighwayEnvFast):
    def __init__(self, *args, **given):
        super().__init__(*args, **given)
        self._is_terminated = lambda: self.vehicle.position[0] > 260.0


@pytest.mark.parametrize("entry_point", [SetOnItself, OwnStep])
def test_an_end_need_not_be_a_method_of_the_class(ending, entry_point):
    """The goal is that of ``Goal``, in all of them."""
    world, longer = ending(entry_point), ending(entry_point, ends="duration")
    scenario = scenario_in(world)
    trace = world.rollout(scenario, idle)
    assert trace.ended.startswith(entry_point.__name__)
    assert trace.ticks == ending(Goal).rollout(scenario, idle).ticks
    assert longer.rollout(scenario, idle).ended == ""
    assert longer.to_dict()["ends"] == "duration"
