"""The thread that watches all decisions of a process exists only when needed."""

import bdb
import contextlib
import math
import os
import signal
import subprocess
import sys
import time
import weakref

import pytest

from pytest_pafot.support.errors import AdsFactoryError, OutOfTime
from pytest_pafot.world import Highway, World
from pytest_pafot.world.driving.policy import make_ads
from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard
from tests.world.driving.test_ads import SCENARIO


@pytest.fixture
def watchdog(monkeypatch):
    """Return a new watchdog, which looks every ten milliseconds."""
    monkeypatch.setattr(hang_guard, "LONGEST_PAUSE", 0.01)
    monkeypatch.setattr(hang_guard, "_WATCHDOG", fresh := hang_guard._Watchdog())
    return fresh


forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="no process can be forked")


def steady():
    return lambda seen: (0.0, 0.0)


def fork_and_go_on():
    pid = os.fork()
    if pid:
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 1


def fork_and_end():
    pid = os.fork()
    if not pid:
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0


def forks_once(fork, when):
    """Return a factory of ADSs that fork in the factory, or in the first decision."""

    def ads():
        if when == "factory":
            fork()
        return decide

    def decide(seen):
        if when == "decision" and seen.time == 0:
            fork()
        return 0.0, 0.0

    return ads


@forks
@pytest.mark.parametrize("when", ["factory", "decision"])
def test_fork_of_the_process_is_allowed_if_the_ads_ends_it(when):
    with pytest.raises(AdsFactoryError):
        Highway(duration=2.0).rollout(SCENARIO, forks_once(fork_and_go_on, when))
    for ads in (forks_once(fork_and_end, when), steady):
        assert Highway(duration=2.0).rollout(SCENARIO, ads).error is None


@forks
def test_a_copy_that_comes_later_is_waited_for(monkeypatch):
    monkeypatch.setattr(hang_guard, "COPY_LATE", 60.0)
    pids = []
    with pytest.raises(AdsFactoryError):
        make_ads(lambda: pids.append(os.fork()))
    os.waitpid(pids[0], 0)


def hang(limit):
    """Return whether a decision that never ends is interrupted."""
    with HangGuard(limit) as watched:
        try:
            try:
                watched.decision_starts()
                while True:
                    time.sleep(0.001)
            finally:
                watched.decision_ends()
        except AdsHang:
            watched.decision_ends()
            return True


def test_watching_thread_ends_and_returns_with_next_run(watchdog):
    for _ in range(2):
        with HangGuard(30.0):
            thread = watchdog._thread
            assert thread.is_alive()
        thread.join(timeout=30)
        assert not thread.is_alive()
        assert watchdog._thread is None
    assert hang(0.05)


def test_short_limit_holds_while_long_one_is_watched(monkeypatch):
    monkeypatch.setattr(hang_guard, "LONGEST_PAUSE", 60.0)
    monkeypatch.setattr(hang_guard, "_WATCHDOG", hang_guard._Watchdog())
    with HangGuard(86400.0):
        time.sleep(0.05)  # the thread has begun its long pause
        started = time.monotonic()
        assert hang(0.05)
        assert time.monotonic() - started < 30


def test_no_decision_starts_when_the_time_of_the_search_is_over():
    now = time.perf_counter()
    with hang_guard.runs_end_in(60.0):
        watched = HangGuard(30.0, clock=lambda: now + 59.0)
        watched.decision_starts()
        watched.clock = lambda: now + 61.0
        with pytest.raises(OutOfTime):
            watched.decision_starts()
        with hang_guard.runs_end_in(math.inf):
            HangGuard(30.0).decision_starts()
        HangGuard(30.0, clock=lambda: now + 61.0, is_limited=False).decision_starts()
    HangGuard(30.0).decision_starts()


def test_decision_that_outlasts_its_search_is_interrupted_late():
    with hang_guard.runs_end_in(10.0):
        watched = HangGuard(1000.0)
    late = watched.until + hang_guard.LATE
    assert watched._interruption(late - 0.1, watched.until - 1.0) is None
    assert watched._interruption(late + 0.1, watched.until - 1.0) is OutOfTime
    assert watched._interruption(late + 1000.0, watched.until - 1.0) is AdsHang


def test_factory_that_never_returns_ends_with_its_search(monkeypatch):
    monkeypatch.setattr(hang_guard, "LATE", 0.1)
    began = time.monotonic()
    with hang_guard.runs_end_in(0.1), pytest.raises(OutOfTime):
        Highway().rollout(SCENARIO, lambda: time.sleep(100))
    assert time.monotonic() - began < 30
    assert Highway().rollout(SCENARIO, steady).ticks > 0


@pytest.mark.parametrize("world", [Highway(), World("highway-v0")], ids=["si", "env"])
def test_run_ends_between_decisions_and_closes_its_ads(world, monkeypatch):
    calls, closed = [], []

    class Ads:
        def __call__(self, observation):
            calls.append(observation)
            return 1 if isinstance(world, World) else (0.0, 0.0)

        def close(self):
            closed.append(self)

    def clock():
        # Only decisions take time. A busy machine may need longer than any limit to make an environment.
        return float(len(calls))

    monkeypatch.setattr(hang_guard, "monotonic", clock)
    monkeypatch.setattr(HangGuard.__init__, "__defaults__", (clock,))
    with hang_guard.runs_end_in(1.5), pytest.raises(OutOfTime):
        world.rollout(SCENARIO, Ads)
    assert len(calls) == 2
    assert len(closed) == 1


@forks
@pytest.mark.skipif(
    not hasattr(signal, "pthread_kill"), reason="elsewhere a decision cannot be asked where it is"
)
def test_debugger_may_pause_a_decision_beyond_its_limit(watchdog):
    tracer = sys.gettrace()
    try:
        with HangGuard(0.02) as watched:
            watched.decision_starts()
            began = watched.started
            bdb.Bdb().runcall(time.sleep, 0.1)
            assert watched.started > began
            watched.decision_ends()
    finally:
        sys.settrace(tracer)
    assert hang(0.02)


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_no_interruption_is_lost_in_what_python_calls_when_an_object_goes():
    class Going:
        pass

    def hang():
        noted = weakref.WeakKeyDictionary()
        while True:
            noted[Going()] = None

    for _ in range(8):
        with HangGuard(0.01) as guard:
            guard.decision_starts()
            with pytest.raises(AdsHang):
                hang()
            guard.decision_ends()


def test_interruption_that_arrives_late_is_waited_for():
    """It was sent, and arrives ten lines later: still in the call that waits for it, and not in the code behind it."""
    watched, tracer, lines = HangGuard(30.0), sys.gettrace(), []
    watched._sent = True

    def arrive(frame, event, argument):
        lines.append(event)
        if lines.count("line") == 10:
            raise AdsHang
        return arrive

    sys.settrace(arrive)
    try:
        watched.settle()
    finally:
        sys.settrace(tracer)
    assert lines.count("line") == 10


WATCHES = """
import os, sys
from pytest_pafot import Highway, PositionInstruction, Scenario
world, scenario = Highway(hang_limit=0.2), Scenario(npcs=[[PositionInstruction(1, 25.0)]])
def spin(observation):
    while True:
        pass
world.rollout(scenario, lambda: lambda observation: (0.0, 0.0))  # starts the watching thread
child = os.fork()
if not child:
    os._exit(world.rollout(scenario, lambda: spin).outcome != "hang")
"""
NEED_NOT_WAIT = """
import faulthandler, os, sys
from pytest_pafot.world.guard.hang_guard import HangGuard, LastResort, last_resort
with last_resort(LastResort(end=lambda: None, grace=5.0, file=2)), HangGuard(30.0):
    child = os.fork()
    if not child:
        faulthandler.cancel_dump_traceback_later()
        os._exit(0)
"""


@forks
@pytest.mark.processes
@pytest.mark.parametrize("code", [WATCHES, NEED_NOT_WAIT])
def test_forked_process_watches_its_own_decisions_and_need_not_wait_for_parent_timer(code):
    code += "\nsys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, timeout=60)


def swallow(seconds, limit):
    """Make a decision that ignores interruptions until two looks have found it overdue for this long."""
    found = []
    with HangGuard(limit) as watched:
        look = watched.look
        watched.look = lambda: found.append(look()) or found[-1]
        if hasattr(signal, "SIGUSR1"):
            signal.signal(signal.SIGUSR1, signal.SIG_IGN)
        watched.decision_starts()
        while sum(ignored > seconds for ignored in found) < 2:
            with contextlib.suppress(AdsHang):
                time.sleep(0.001)
        with contextlib.suppress(AdsHang):
            watched.decision_ends()
        watched.decision_ends()


@pytest.mark.parametrize(("grace", "is_ended"), [(0.05, True), (60.0, False)])
def test_last_resort_ends_decisions_that_ignore_interruption(watchdog, grace, is_ended):
    ends = []
    with hang_guard.last_resort(hang_guard.LastResort(end=lambda: ends.append(1), grace=grace)):
        swallow(0.05, limit=0.02)
        assert hang(0.02)
    assert bool(ends) == is_ended
    swallow(0.05, limit=0.02)
    assert bool(ends) == is_ended, "outside there is none"


class Timer:
    """A stand-in for faulthandler's timer."""

    def __init__(self):
        self.seconds = []

    def dump_traceback_later(self, seconds, **options):
        assert options == {"exit": True, "file": 2}
        self.seconds.append(seconds)

    def cancel_dump_traceback_later(self):
        self.seconds.append(None)


def comes_true(condition):
    """Return whether a condition becomes true within half a minute."""
    deadline = time.monotonic() + 30
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    return condition()


def test_timer_runs_only_while_runs_are_active(watchdog, monkeypatch):
    monkeypatch.setattr(hang_guard, "faulthandler", timer := Timer())
    monkeypatch.setattr(hang_guard, "_is_debugged", lambda: False)
    with hang_guard.last_resort(hang_guard.LastResort(end=lambda: None, grace=5.0, file=2)):
        with HangGuard(10.0):
            assert {*timer.seconds} == {15.01}  # once, and once more if a look came before this
            with HangGuard(30.0):
                assert timer.seconds[-1] == 35.01
                count = len(timer.seconds)
                assert comes_true(lambda: len(timer.seconds) > count), "put off by each look"
        assert comes_true(lambda: timer.seconds[-1] is None)
        with HangGuard(10.0):
            assert timer.seconds[-1] == 15.01
    assert timer.seconds[-1] is None


def test_outer_guard_interrupts_inside_an_inner_one():
    with HangGuard(0.05) as outer, HangGuard(30.0) as inner:
        outer.decision_starts()
        inner.decision_starts()
        with pytest.raises(AdsHang):
            time.sleep(20)
        outer.decision_ends()
        inner.decision_ends()
