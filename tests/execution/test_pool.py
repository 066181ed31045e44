"""Processes that run scenarios: what they answer, and what is told of those that do not."""

import faulthandler
import logging
import multiprocessing
import os
import signal
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.crash_records import leftovers
from pytest_pafot.execution.job import Job
from pytest_pafot.execution.pool import FAREWELL, Lost, Raised
from pytest_pafot.execution.scenario_pool import ExecutionError, pool_for
from tests.support.toy_world import Toy, idle, scenario

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

SCENARIOS = [scenario(number) for number in range(6)]


@pytest.fixture
def pool_of(tmp_path, monkeypatch):
    """Makes pools whose ADS is a function of the number of the scenario; none of their processes remains."""
    pools = []

    def make(drive, size=2, patience=None):
        job = Job(world=Toy(), ads=lambda: drive, records=tmp_path / "records", owner="test_it.py::test_it")
        if patience is not None:
            monkeypatch.setattr(scenario_pool, "GRACE", patience - Toy.hang_limit)
        pools.append(pool_for(job, size))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close(at_once=True)
    assert multiprocessing.active_children() == []
    assert leftovers(tmp_path / "records") == ()


def numbers(pool, scenarios=SCENARIOS):
    """What each answer is the trace of."""
    return [pool.fetch(each)[0].states[0, 0, 0] for each in scenarios]


@pytest.mark.parametrize("size", [1, 2, 5])
def test_answers_are_fetched_in_any_order_whatever_the_number_of_processes(pool_of, size):
    pool = pool_of(lambda number: time.sleep(0.01 * (5 - number)), size)
    pool.expect(SCENARIOS)
    assert numbers(pool, SCENARIOS[::-1]) == [5, 4, 3, 2, 1, 0]


def test_there_are_no_more_processes_than_asked_for_and_they_are_not_this_one(pool_of, tmp_path):
    pool = pool_of(lambda number: (tmp_path / f"{os.getpid()}").touch())
    pool.expect(SCENARIOS)
    numbers(pool)
    pids = {path.name for path in tmp_path.iterdir() if path.is_file()}
    assert 1 <= len(pids) <= 2
    assert str(os.getpid()) not in pids


def test_processes_run_at_the_same_time(pool_of, tmp_path):
    def meet(number):
        (tmp_path / f"{number}").touch()
        while not (tmp_path / f"{1 - number}").exists():
            time.sleep(0.001)

    pool = pool_of(meet)
    pool.expect(SCENARIOS[:2])
    assert numbers(pool, SCENARIOS[:2]) == [0, 1]


def test_traces_come_back_read_only(pool_of):
    pool = pool_of(lambda number: None)
    pool.expect(SCENARIOS)
    states = pool.fetch(SCENARIOS[3])[0].states
    assert np.array_equal(states, np.full((2, 2, 7), 3.0))
    assert not states.flags.writeable


def test_what_raises_is_left_to_this_process(pool_of):
    def fail(number):
        if number == 1:
            raise SystemExit("no such planner")

    pool = pool_of(fail)
    pool.expect(SCENARIOS)
    assert [isinstance(pool.fetch(each), Raised) for each in SCENARIOS] == [False, True, False, False, False, False]


def test_what_cannot_be_sent_is_left_to_this_process(pool_of):
    class Local(UserWarning):
        """Of no module, so that it cannot be pickled."""

    pool = pool_of(lambda number: warnings.warn("a warning", Local, stacklevel=1))
    pool.expect(SCENARIOS[:1])
    assert isinstance(pool.fetch(SCENARIOS[0]), Raised)


def test_an_answer_is_fetched_once_and_only_if_it_was_expected(pool_of):
    pool = pool_of(lambda number: None)
    pool.expect(SCENARIOS[:1])
    assert pool.expects(SCENARIOS[0])
    assert not pool.expects(SCENARIOS[1])
    pool.fetch(SCENARIOS[0])
    with pytest.raises(ValueError, match="expected one that is expected"):
        pool.fetch(SCENARIOS[0])


def test_what_is_not_fetched_is_forgotten_with_the_next_generation(pool_of):
    pool = pool_of(lambda number: time.sleep(0.05))
    pool.expect(SCENARIOS[:4])
    pool.expect(SCENARIOS[4:])
    assert numbers(pool, SCENARIOS[4:]) == [4, 5]
    assert not pool.expects(SCENARIOS[0])


@pytest.mark.parametrize(
    ("die", "how"),
    [
        (lambda: os._exit(9), "ended with exit code 9"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "was ended by SIGKILL"),
        (lambda: (faulthandler.disable(), os.abort()), "was ended by SIGABRT"),
    ],
    ids=["exit", "kill", "abort"],
)
def test_a_process_that_dies_names_its_scenario_and_the_others_are_answered(pool_of, die, how):
    pool = pool_of(lambda number: die() if number == 2 else time.sleep(0.01))
    pool.expect(SCENARIOS)
    answers = [pool.fetch(each) for each in SCENARIOS]
    lost = answers.pop(2)
    assert (lost.task, lost.how, lost.is_hang) == (SCENARIOS[2], how, False)
    assert [answer[0].states[0, 0, 0] for answer in answers] == [0, 1, 3, 4, 5]
    assert pool.recovered == []


def test_a_scenario_in_which_a_process_died_is_tried_once_more_alone(pool_of, tmp_path):
    def work(number):
        running = tmp_path / f"running-{number}"
        if number == 0 and running.exists():
            (tmp_path / "meanwhile").write_text(" ".join(path.name for path in tmp_path.glob("running-*")))
            return
        running.touch()
        if number == 0:
            os._exit(1)
        time.sleep(0.1)
        running.unlink()

    pool = pool_of(work)
    pool.expect(SCENARIOS[:4])
    assert isinstance(pool.fetch(SCENARIOS[0]), tuple)
    assert (tmp_path / "meanwhile").read_text() == "running-0"
    assert [lost.task for lost in pool.recovered] == [SCENARIOS[0]]
    assert numbers(pool, SCENARIOS[1:4]) == [1, 2, 3]


def test_every_scenario_that_kills_its_process_is_named(pool_of):
    pool = pool_of(os._exit)
    pool.expect(SCENARIOS)
    assert [pool.fetch(each).how for each in SCENARIOS] == [f"ended with exit code {number}" for number in range(6)]


def test_a_process_that_dies_between_two_scenarios_is_replaced_and_blames_nobody(pool_of):
    pool = pool_of(lambda number: None, size=1)
    for each in SCENARIOS[:2]:
        pool.expect([each])
        assert isinstance(pool.fetch(each), tuple)
        (process,) = multiprocessing.active_children()
        process.kill()
        process.join()
    assert pool.recovered == []


def test_a_process_that_falls_silent_is_killed_and_its_scenario_is_a_hang(pool_of):
    def work(number):
        if number == 1:  # Not a signal in the world reaches Python code in this thread.
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR2])
            time.sleep(60)

    pool = pool_of(work, patience=0.3)
    pool.expect(SCENARIOS[:3])
    answers = [pool.fetch(each) for each in SCENARIOS[:3]]
    assert isinstance(answers[1], Lost)
    assert answers[1].is_hang
    assert answers[1].how == "did not answer for 0.3 s and was killed"
    assert [isinstance(answers[0], tuple), isinstance(answers[2], tuple)] == [True, True]


def test_a_process_that_is_slow_and_answers_signals_lives(pool_of):
    pool = pool_of(lambda number: time.sleep(1.0), patience=0.3)
    pool.expect(SCENARIOS[:1])
    assert isinstance(pool.fetch(SCENARIOS[0]), tuple)


def test_a_process_that_is_not_looked_at_for_long_is_not_silent(pool_of):
    pool = pool_of(lambda number: time.sleep(0.7), patience=0.3)
    pool.expect(SCENARIOS[:1])
    time.sleep(0.6)
    assert isinstance(pool.fetch(SCENARIOS[0]), tuple)


@pytest.mark.filterwarnings("always")
def test_what_the_ads_says_is_said_again_here(pool_of, capsys, caplog):
    def chat(number):
        print("driving", number)
        print("careful", file=sys.stderr)
        sys.stdout.buffer.write(b"bytes\n")
        logging.getLogger("planner").warning("gap of %d m", number)
        warnings.warn("old interface", DeprecationWarning, stacklevel=1)

    pool = pool_of(chat)
    pool.expect(SCENARIOS[:1])
    _, echo = pool.fetch(SCENARIOS[0])
    assert capsys.readouterr() == ("", "")
    with pytest.warns(DeprecationWarning, match="old interface") as warned:
        echo.repeat()
    assert warned[0].filename == __file__
    assert capsys.readouterr() == ("driving 0\nbytes\n", "careful\n")
    assert caplog.record_tuples == [("planner", logging.WARNING, "gap of 0 m")]


def test_an_ads_that_closes_a_standard_stream_closes_that_of_nobody_else(pool_of, capsys):
    def close(number):
        print("last words")
        sys.stdout.close()

    pool = pool_of(close)
    pool.expect(SCENARIOS[:1])
    _, echo = pool.fetch(SCENARIOS[0])
    echo.repeat()
    assert capsys.readouterr().out == "last words\n"


def test_filters_of_warnings_act_in_the_process_that_runs_the_scenario(pool_of):
    def chat(number):
        warnings.warn("old interface", DeprecationWarning, stacklevel=1)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pool = pool_of(chat)
        pool.expect(SCENARIOS[:1])
        assert pool.fetch(SCENARIOS[0])[1].warned == []


def test_an_interrupt_from_the_keyboard_is_for_the_session_alone(pool_of):
    def work(number):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)

    pool = pool_of(work)
    pool.expect(SCENARIOS[:2])
    assert numbers(pool, SCENARIOS[:2]) == [0, 1]


def test_closing_kills_those_at_work_at_once_and_leaves_no_record_of_them(pool_of):
    pool = pool_of(lambda number: time.sleep(60))
    pool.expect(SCENARIOS)
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), pool:
        raise KeyboardInterrupt
    assert time.monotonic() - started < 5
    assert multiprocessing.active_children() == []


def test_the_end_of_a_search_does_not_wait_for_runs_that_nobody_asks_for_any_more(pool_of):
    with pool_of(lambda number: time.sleep(60)) as pool:
        pool.expect(SCENARIOS[:2])
        started = time.monotonic()
    assert time.monotonic() - started < FAREWELL


def test_a_process_that_is_not_needed_any_more_ends_by_itself(pool_of, tmp_path):
    def work(number):
        multiprocessing.util.Finalize(None, (tmp_path / "ended").touch, exitpriority=1)

    with pool_of(work) as pool:
        pool.expect(SCENARIOS[:1])
        pool.fetch(SCENARIOS[0])
    assert (tmp_path / "ended").exists()


def test_processes_end_when_the_session_is_killed(tmp_path):
    def session():
        job = Job(world=Toy(), ads=lambda: write, records=tmp_path / "records", owner="test_it.py::test_it")
        pool = pool_for(job, 2)
        pool.expect(SCENARIOS[:2])
        for each in SCENARIOS[:2]:
            pool.fetch(each)
        os.kill(os.getpid(), signal.SIGKILL)

    def write(number):
        (tmp_path / f"{os.getpid()}").touch()
        while len([path for path in tmp_path.iterdir() if path.is_file()]) < 2:
            time.sleep(0.001)

    process = multiprocessing.get_context("fork").Process(target=session)
    process.start()
    process.join()
    pids = [int(path.name) for path in tmp_path.iterdir() if path.is_file()]
    deadline = time.monotonic() + 5
    while any(is_alive(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert [pid for pid in pids if is_alive(pid)] == []
    assert len(pids) == 2


def is_alive(pid):
    """Whether a process runs: one that nobody has waited for yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_where_no_process_can_be_started_everything_is_left_to_this_one(pool_of, monkeypatch):
    pool = pool_of(lambda number: None)

    def refuse():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuse)
    pool.expect(SCENARIOS)
    assert all(isinstance(pool.fetch(each), Raised) for each in SCENARIOS)
    assert "temporarily unavailable" in pool.failure
    pool.expect(SCENARIOS)
    assert not pool.expects(SCENARIOS[0])


@pytest.fixture
def spawned(monkeypatch):
    monkeypatch.setattr(scenario_pool, "METHOD", "spawn")


def test_processes_that_are_not_forked_run_a_factory_that_can_be_pickled(spawned, tmp_path):
    with pool_for(Job(world=Toy(), ads=idle, records=tmp_path, owner="test_it.py::test_it"), 1) as pool:
        pool.expect(SCENARIOS[:2])
        assert numbers(pool, SCENARIOS[:2]) == [0, 1]
    assert pool.failure == ""


def test_a_factory_that_cannot_be_pickled_where_processes_are_not_forked_is_told(spawned, tmp_path):
    job = Job(world=Toy(), ads=lambda: print, records=tmp_path, owner="test_it.py::test_it")
    with pytest.raises(ExecutionError, match="such as a class of a module that can be imported"):
        pool_for(job, 2)
