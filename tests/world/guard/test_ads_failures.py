"""An ADS that raises, returns nonsense, hangs or is slow has its own outcome, never a collision or a crash."""

import asyncio
import bdb
import contextlib
import math
import signal
import subprocess
import sys
import threading
import time
import unittest
from contextlib import nullcontext

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, PositionInstruction, Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.support.process import Ended, interrupted_by_signals
from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard
from tests.helpers.stopped_clock import StoppedClock
from tests.helpers.tables import table
from tests.world.driving.test_ads import CONTINUOUS, GYM, HIGHWAY, SCENARIO, always, worlds

# --- ADSs that fail


class CustomFault(Exception):  # noqa: N818
    pass


def failing_after(decisions, fail, idle):
    """Return a factory of ADSs that drive for a number of decisions, then call ``fail``."""

    def factory():
        count = iter(range(1000))

        def drive(observation):
            return idle if next(count) < decisions else fail()

        return drive

    return factory


@worlds
def test_raising_ads_ends_run_with_its_own_traceback(world, idle):
    def deep():
        raise CustomFault("the map\nhas no  lane 7")

    def fail():
        return deep()

    trace = world.rollout(SCENARIO, failing_after(2, fail, idle))
    every = world.physics_hz // world.ads_hz if world is GYM else 3
    assert (trace.outcome, trace.collision) == (Outcome.ADS_ERROR, None)
    assert trace.ticks == trace.error.tick == 2 * every
    assert (trace.error.kind, trace.error.message) == ("CustomFault", "the map has no lane 7")
    report = trace.error.traceback
    places = [line.split()[-1] for line in report.splitlines() if line.startswith("  File")]
    assert places == ["drive", "fail", "deep"]
    assert "pytest_pafot" not in report
    assert len(trace.actions) == 2


class Panic(BaseException):
    """An error like the one that a native library's bindings raise."""


class Mute(Exception):  # noqa: N818
    """An error without a text."""

    def __str__(self):
        raise RuntimeError("no words")


FAULTS = [
    ValueError(), TypeError("x"), StopIteration(), SystemExit(2), ExceptionGroup("g", [ValueError("y")]), Panic("rust"),
    Mute(),
    GeneratorExit(), asyncio.CancelledError(), BaseExceptionGroup("g", [SystemExit(2)]), unittest.SkipTest("no map"),
    pytest.skip.Exception("no GPU"), pytest.fail.Exception("no map"), pytest.xfail.Exception("never"),
    pytest.exit.Exception("enough"), pytest.exit.Exception("green", 0),
    ExceptionGroup("g", [pytest.exit.Exception("green", 0)]),
]  # fmt: skip
INTERRUPTIONS = [
    KeyboardInterrupt(), bdb.BdbQuit(),
    BaseExceptionGroup("g", [ValueError("y"), BaseExceptionGroup("h", [KeyboardInterrupt()])]),
]  # fmt: skip


@worlds
@pytest.mark.parametrize("fault", FAULTS, ids=repr)
def test_anything_an_ads_raises_is_an_ads_error(world, idle, fault):
    def fail():
        raise fault

    trace = world.rollout(SCENARIO, failing_after(1, fail, idle))
    assert (trace.outcome, trace.error.kind) == (Outcome.ADS_ERROR, type(fault).__name__)
    assert type(fault).__name__ in trace.error.traceback


@pytest.mark.parametrize(("status", "ends_the_session"), [(None, True), (0, False)])
def test_signal_handler_may_end_session_only_as_failed(status, ends_the_session):
    def handler(number, frame):
        pytest.exit("terminated", returncode=status)

    before = signal.signal(signal.SIGTERM, handler)
    try:
        ads = failing_after(1, lambda: signal.raise_signal(signal.SIGTERM), (0.0, 0.0))
        with pytest.raises(pytest.exit.Exception) if ends_the_session else nullcontext():
            assert Highway().rollout(SCENARIO, ads).error.kind == "Exit"
    finally:
        signal.signal(signal.SIGTERM, before)


@worlds
@pytest.mark.parametrize("interruption", INTERRUPTIONS, ids=repr)
def test_interruption_inside_an_ads_is_no_finding(world, idle, interruption):
    def fail():
        raise interruption

    with pytest.raises(type(interruption)) as caught:
        world.rollout(SCENARIO, failing_after(1, fail, idle))
    assert caught.value is interruption
    assert hang_guard._WATCHDOG.guards == []


@table("lost", [
    {"position": np.array([math.nan, 0.0])},
    {"heading": math.inf},
    {"speed": math.nan},
    {"action": None},
    {"action": {}},
    {"position": None},
])  # fmt: skip
def test_vehicle_class_without_finite_state_or_action_is_ads_error(lost):
    for world in (HIGHWAY, GYM):
        trace = world.rollout(SCENARIO, stepping(4, lambda vehicle: vars(vehicle).update(lost)))
        assert (trace.outcome, trace.ticks, trace.error.tick) == (Outcome.ADS_ERROR, 3, 3)
        assert np.isfinite(trace.states).all()


def test_vehicle_class_raising_in_step_is_ads_error():
    def breaks(vehicle):
        raise CustomFault("tyre")

    for run in (HIGHWAY.rollout, HIGHWAY.rollout_in_gym):
        trace = run(SCENARIO, stepping(31, breaks))
        assert (trace.outcome, trace.error.text) == (Outcome.ADS_ERROR, "CustomFault: tyre")
        assert trace.error.tick == trace.ticks == 30


def stepping(count, does):
    """Return a vehicle class that does something in one of its steps."""

    class Stepping(IDMVehicle):
        steps = 0

        def step(self, dt):
            super().step(dt)
            self.steps += 1
            if self.steps == count:
                does(self)

    return Stepping


@table("action", [
    None, 1.0, (1.0,), (1.0, 0.0, 0.0), (math.nan, 0.0), (0.0, math.inf), ("a", 0.0), "12", b"12", {1: 0, 2: 0},
    ("1", "2"),
    {1, 2}, np.zeros(3), np.array([1.0, np.nan]), (None, 0.0), (1j, 0.0), (10**400, 0.0), np.zeros((2, 2)), ...,
    np.zeros((1000, 3)),
])  # fmt: skip
def test_anything_but_two_finite_numbers_is_bad_action(action):
    trace = HIGHWAY.rollout(SCENARIO, failing_after(1, lambda: action, (0.0, 0.0)))
    error = trace.error
    assert (trace.outcome, error.kind, error.traceback) == (Outcome.ADS_ERROR, "BadAction", "")
    assert (error.tick, trace.ticks) == (3, 3)
    assert len(error.message) < 250
    assert "\n" not in error.message


DISCRETE = [None, 5, -1, 1.0, "1", [1, 2], np.array([]), np.float32(1), True, {}, np.zeros(5)]
CONTINUOUS_ACTIONS = [
    None, 0.1, [0.1], [0.1, 0.2, 0.3], [[0.1], [0.2]], [math.nan, 0.0], np.float32([0, np.inf]), "12", ["a", "b"],
    [1j, 0], [None, 0.0], [[1], [2, 3]], {},
]  # fmt: skip


@table(("world", "action"), [
    *((GYM, action) for action in DISCRETE), *((CONTINUOUS, action) for action in CONTINUOUS_ACTIONS),
])  # fmt: skip
def test_wrong_action_for_an_environment_is_a_bad_action(world, action):
    trace = world.rollout(SCENARIO, always(action))
    assert (trace.outcome, trace.error.kind) == (Outcome.ADS_ERROR, "BadAction")


# --- ADSs that hang


def sleeping():
    time.sleep(30)


def spinning():
    while True:
        pass


def spinning_deaf():
    """Spin without end, and swallow the first interruption."""
    try:
        spinning()
    except BaseException:  # noqa: BLE001
        spinning()


def spinning_and_going_on():
    """Spin until the interruption, and return as if nothing had happened."""
    with contextlib.suppress(BaseException):
        spinning()


@pytest.fixture
def clock(monkeypatch):
    """Return the clock of all limits, which only tests advance, so that no healthy decision is ever too slow."""
    return StoppedClock(monkeypatch)


@worlds
@pytest.mark.parametrize("hang", [sleeping, spinning, spinning_deaf, spinning_and_going_on])
def test_hang_is_interrupted_and_reported_with_its_place(world, idle, hang, clock):
    def hangs():
        clock.now += 1.0
        hang()
        return idle

    world = type(world)(**({"env_id": "highway-v0"} if world is GYM else {}), hang_limit=0.2)
    trace = world.rollout(SCENARIO, failing_after(1, hangs, idle))
    assert (trace.outcome, trace.error.kind) == (Outcome.HANG, "Hang")
    assert hang.__name__ in trace.error.traceback
    assert "pytest_pafot" not in trace.error.traceback
    assert trace.ticks == trace.error.tick > 0
    assert len(trace.actions) == 1
    assert world.rollout(SCENARIO, always(idle)).outcome is Outcome.COMPLETED


@pytest.mark.skipif(sys.platform == "win32", reason="processes have no signals there")
@table(
    ("number", "error"),
    [(signal.SIGINT, KeyboardInterrupt), (getattr(signal, "SIGTERM", None), Ended)],
)
@worlds
def test_interrupt_that_an_ads_catches_ends_the_run_all_the_same(world, idle, number, error):
    calls = []

    def ads(observation):
        calls.append(observation)
        with contextlib.suppress(BaseException):
            signal.raise_signal(number)
        return idle

    # a shell's background jobs ignore SIGINT
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with interrupted_by_signals(hang_guard.note_interrupt), pytest.raises(error):
            world.rollout(SCENARIO, lambda: ads)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(calls) == 1


@table("hang", [spinning, spinning_and_going_on])
def test_busy_hang_outside_main_thread_is_interrupted(hang, clock):
    received, world = [], Highway(hang_limit=0.2)

    def hangs():
        clock.now += 1.0
        hang()
        return 0.0, 0.0

    def work():
        both = failing_after(1, hangs, (0, 0)), always((0, 0))
        received.extend(world.rollout(SCENARIO, ads) for ads in both)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(60)
    assert [trace.outcome for trace in received] == [Outcome.HANG, Outcome.COMPLETED]
    assert hang is spinning_and_going_on or "spinning" in received[0].error.traceback


@worlds
def test_hang_in_the_step_of_a_vehicle_class_is_interrupted(world, idle, clock):
    class Stuck(IDMVehicle):
        def step(self, dt):
            super().step(dt)
            if self.speed < 20.0:
                clock.sleep(1000.0)

    brakes = Scenario(npcs=[[PositionInstruction(2, 5.0)]], ego_speed=22.0)
    trace = world.rollout(brakes, Stuck)
    assert trace.outcome is Outcome.HANG
    assert trace.ticks == trace.error.tick > 15
    assert "in step" in trace.error.traceback


def endless_action(clock):
    """Return an action that never ends to become numbers."""

    class Endless:
        def __float__(self):
            clock.sleep(1000.0)

    return Endless(), 0.0


def test_hang_while_an_action_is_read_is_interrupted(clock):
    trace = HIGHWAY.rollout(SCENARIO, failing_after(2, lambda: endless_action(clock), (0.0, 0.0)))
    assert (trace.outcome, trace.ticks, len(trace.actions)) == (Outcome.HANG, 6, 2)
    assert "__float__" in trace.error.traceback


def test_time_between_decisions_is_not_a_hang():
    now = [0.0]
    with HangGuard(0.05, clock=lambda: now[0]) as guard:
        for _ in range(3):
            guard.decision_starts()
            guard.decision_ends()
            now[0] += 0.08
            assert guard.look() == 0.0


def decide(until):
    """Run in a separate frame, like an ADS: CPython 3.13 puts a ``while``'s jump outside the ``try`` around it."""
    while time.perf_counter() < until:
        pass


@pytest.mark.parametrize("inside_thread", [False, True])
def test_late_interruption_never_breaks_the_following_code(inside_thread):
    """Decisions take about the limit, many times: each is interrupted inside, or not at all."""
    escaped = []

    def work():
        try:
            for step in range(30):
                with HangGuard(0.004) as guard:
                    try:
                        try:
                            guard.decision_starts()
                            decide(time.perf_counter() + 0.003 + step * 0.0001)
                        finally:
                            guard.decision_ends()
                    except AdsHang:
                        guard.decision_ends()
                    time.sleep(0)
        except BaseException as error:  # noqa: BLE001
            escaped.append(error)

    if inside_thread:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    else:
        work()
    assert escaped == []


user_signals = pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="no user signals here")


@user_signals
def test_an_interruption_that_comes_late_interrupts_nothing():
    with HangGuard(5.0) as guard:
        signal.raise_signal(signal.SIGUSR1)
        guard.decision_starts()
        signal.raise_signal(signal.SIGUSR1)
        guard.decision_ends()
        signal.raise_signal(signal.SIGUSR1)


@user_signals
def test_user_signal_handler_is_restored_after_run():
    before = signal.signal(signal.SIGUSR1, handler := lambda number, frame: None)
    try:
        HIGHWAY.rollout(SCENARIO, always((0, 0)))
        assert signal.getsignal(signal.SIGUSR1) is handler
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_slow_decisions_are_measured_and_change_nothing_else():
    def slow():
        calls = iter(range(100))
        return lambda observation: time.sleep(0.03 * (next(calls) == 2)) or (0.0, 0.0)

    trace = HIGHWAY.rollout(SCENARIO, slow)
    assert trace.outcome is Outcome.COMPLETED
    assert 0.03 <= trace.max_decision_seconds < 5
    assert trace.states.tobytes() == HIGHWAY.rollout(SCENARIO, always((0.0, 0.0))).states.tobytes()


@pytest.mark.processes
def test_thread_can_be_traced_after_another_thread_hangs():
    # CPython 3.11 hangs in a traced function after its C interface has revoked an exception for a thread.
    code = """
import sys, threading
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard

def decide():
    with HangGuard(0.05) as guard:
        guard.decision_starts()
        try:
            while True:
                pass
        except AdsHang:
            guard.decision_ends()

for _ in range(3):
    thread = threading.Thread(target=decide)
    thread.start()
    thread.join()

def traced():
    return sum(range(100))

sys.settrace(lambda *event: None)
traced()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
