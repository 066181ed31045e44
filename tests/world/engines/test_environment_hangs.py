"""An environment, or a wrapper, that does not return from a method ends its run as a hang, and is named."""

import signal
import threading
import time
from contextlib import suppress

import gymnasium
import pytest
from highway_env.envs.highway_env import HighwayEnvFast
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import PositionInstruction, Run, Scenario, World
from pytest_pafot.findings.finding import ads_failure
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searches.harness import ads_text
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.support.process import interrupted_by_signals
from pytest_pafot.world.engines.episode import drive_episode
from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import (
    AdsHang,
    LastResort,
    WorldHang,
    last_resort,
    runs_end_in,
)
from pytest_pafot.world.gym_environment import EnvironmentGuard
from tests.helpers.refusals import refused
from tests.helpers.stopped_clock import StoppedClock

SCENARIO = Scenario(npcs=[[PositionInstruction(6, 0.0)] * 2], gene_seconds=5.0)
LATE = 3
"""The tick after which environments hang."""
NEVER, HEALTHY = 1e4, 250.0
"""The time that code takes [s] which hangs, and which does not."""


@pytest.fixture
def clock(monkeypatch):
    """Return the clock of all limits, by which the code of these environments takes its time."""
    Slow.clock = StoppedClock(monkeypatch)
    return Slow.clock


class Slow(gymnasium.Wrapper):
    takes = NEVER
    clock = None

    def step(self, action):
        if self.unwrapped.steps > LATE:
            self.clock.sleep(self.takes)
        return self.env.step(action)


class Healthy(Slow):
    takes = HEALTHY


class Swallowing(Slow):
    def step(self, action):
        try:
            return super().step(action)
        except BaseException:  # noqa: BLE001  (as code that hangs may)
            return self.env.step(action)


class Repeating(gymnasium.Wrapper):
    def step(self, action):
        while True:
            self.env.step(action)
            Slow.clock.sleep(10.0)


class Seeing(gymnasium.ObservationWrapper):
    def observation(self, seen):
        if self.unwrapped.steps > LATE:
            Slow.clock.sleep(NEVER)
        return seen


class Planting(gymnasium.Wrapper):
    def step(self, action):
        self.unwrapped.observation_type.observe = lambda: Slow.clock.sleep(NEVER)
        return self.env.step(action)


class Starting(gymnasium.Wrapper):
    """Its reset hangs after those by which a world looks at it."""

    left = 0

    def reset(self, **given):
        Starting.left -= 1
        if not Starting.left:
            Slow.clock.sleep(NEVER)
        return self.env.reset(**given)


class Stepping(HighwayEnvFast):
    def step(self, action):
        if self.steps > LATE:
            Slow.clock.sleep(NEVER)
        return super().step(action)


class Simulating(HighwayEnvFast):
    def step(self, action):
        return super().step(action)

    def _simulate(self, action=None):
        if self.steps > LATE:
            Slow.clock.sleep(NEVER)
        super()._simulate(action)


def idle():
    return lambda seen: 1


def wrapped(*wrappers, env_id="highway-fast-v0", **given):
    return World(env_id, wrappers=wrappers, duration=10.0, **given)


DRIVES = {
    "policy": lambda world: world.rollout(SCENARIO, idle),
    "class": lambda world: world.rollout(SCENARIO, lambda: IDMVehicle),
    "reference": lambda world: world.rollout_reference(SCENARIO, "careful-human"),
}
by_policy = DRIVES["policy"]


drivers = pytest.mark.parametrize("driven", DRIVES.values(), ids=DRIVES)


def assert_hangs(trace, name):
    """Assert that a run ended as a hang in a method, which its error names."""
    assert (trace.outcome, trace.error.kind) == (Outcome.HANG, "WorldHang")
    assert trace.error.interrupted
    assert trace.error.message.split()[0] == name
    assert trace.ticks == trace.error.tick


@drivers
@pytest.mark.parametrize("wrapper", [Slow, Swallowing, Repeating])
def test_step_that_does_not_return_ends_the_run_as_a_hang(clock, wrapper, driven):
    trace = driven(wrapped(wrapper))
    assert_hangs(trace, f"{wrapper.__name__}.step")
    assert trace.ticks > LATE
    assert "in step" in trace.error.traceback
    assert "pytest_pafot" not in trace.error.traceback


@drivers
def test_innermost_method_of_the_user_is_named_and_none_of_a_library(clock, driven, register):
    for kind, name in ((Seeing, "Seeing.observation"), (Planting, "Planting.step")):
        assert_hangs(by_policy(wrapped(kind)), name)
    register("stepping-v0", entry_point=Stepping)
    assert_hangs(driven(World("stepping-v0", duration=10.0)), "Stepping.step")
    register("simulating-v0", entry_point=Simulating)
    world = World("simulating-v0", duration=10.0)
    for trace in (by_policy(world), world.rollout_in_gym(SCENARIO, idle)):
        assert_hangs(trace, "Simulating._simulate")


def test_nothing_that_is_said_names_the_policy(clock):
    run = Run(by_policy(wrapped(Slow)))
    assert "policy" not in f"{run.explain()} {ads_text(ads_failure(run))}"


def starting():
    """Return a world whose next reset hangs, after those by which a world looks at it."""
    world = wrapped(Starting)
    world.check_fits(SCENARIO)
    Starting.left = 1
    return world


def test_reset_that_does_not_return_ends_the_run_or_the_look_at_the_world(clock):
    trace = by_policy(starting())
    assert_hangs(trace, "Starting.reset")
    assert (trace.ticks, trace.actions) == (0, ())
    Starting.left = 1
    with refused("env_id"):
        wrapped(Starting).check_fits(SCENARIO)


@drivers
def test_slow_environment_is_not_interrupted(clock, driven):
    trace = driven(wrapped(Healthy))
    assert (trace.outcome, trace.duration) == (Outcome.COMPLETED, 10.0)
    assert clock.slept > 1000.0


def test_episode_of_own_traffic_ends_as_a_hang(clock):
    error = drive_episode(wrapped(Slow), idle, 3).error
    assert (error.interrupted, error.message.split()[0]) == (True, "Slow.step")
    with refused("env_id"):
        drive_episode(starting(), idle, 3)


def test_interrupt_that_a_wrapper_catches_ends_the_run():
    class Catching(gymnasium.Wrapper):
        def step(self, action):
            with suppress(BaseException):
                signal.raise_signal(signal.SIGINT)
            return self.env.step(action)

    world = wrapped(Catching)
    world.check_fits(SCENARIO)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with interrupted_by_signals(hang_guard.note_interrupt), pytest.raises(KeyboardInterrupt):
            by_policy(world)
    finally:
        signal.signal(signal.SIGINT, before)


def test_step_that_outlasts_its_search_is_cut(monkeypatch):
    class Sleeping(gymnasium.Wrapper):
        def step(self, action):
            time.sleep(60.0)

    monkeypatch.setattr(hang_guard, "LATE", 0.1)
    world = wrapped(Sleeping)
    world.check_fits(SCENARIO)
    with runs_end_in(0.5), pytest.raises(OutOfTime):
        by_policy(world)


def test_environment_that_ignores_interruptions_is_a_world_that_hangs(monkeypatch):
    """A process ends as it does for a user's own world, and not as for a policy that ignores them."""
    monkeypatch.setattr(hang_guard, "LONGEST_PAUSE", 0.01)
    monkeypatch.setattr(hang_guard, "LEAST_FOR_WORLD", 0.01)
    monkeypatch.setattr(hang_guard, "_WATCHDOG", hang_guard._Watchdog())
    ends, is_over = [], threading.Event()

    def ignore():
        while not is_over.is_set():
            with suppress(AdsHang):
                is_over.wait(60.0)

    def end_world():
        ends.append("world")
        is_over.set()

    resort = LastResort(end=lambda: ends.append("policy"), grace=0.5, end_world=end_world)
    guard = EnvironmentGuard(0.01)
    with last_resort(resort), guard, pytest.raises(WorldHang), guard.call():
        ignore()
    assert ends[0] == "world"


def test_native_code_is_noticed_as_soon_as_in_other_worlds():
    """A step of the environment would else set the timer for it, which still runs when the next decision begins."""
    guard = EnvironmentGuard(30.0)
    with guard.call():
        assert (guard.limit, guard.silence) == (300.0, 30.0)
