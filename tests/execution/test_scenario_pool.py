"""Processes that run scenarios: their answers, their messages, and their files."""

import logging
import os
import sys
import threading
import time
import warnings

import numpy as np
import pytest

from pytest_pafot.execution import runner
from pytest_pafot.execution.crash_records import leftovers
from pytest_pafot.execution.pool import Done, Lost, RunItHere
from pytest_pafot.execution.runner import Job, expectation, pool_for
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world.driving.policy import Policy
from tests.helpers.toy_world import Toy, idle, scenario

SCENARIOS = [scenario(number) for number in range(6)]


@pytest.fixture
def job_of(tmp_path):
    """Return a function that makes jobs in a world without physics."""
    return lambda ads: Job(
        world=Toy(), policy=Policy(ads), records=tmp_path / "records", owner="test_it.py::test_it"
    )


@pytest.fixture
def pool_of(job_of, tmp_path):
    """Return a function that makes pools whose ADS is a function of the scenario's number; remove their records."""
    if sys.platform != "linux":
        pytest.skip("processes are forked on Linux alone")
    pools = []

    def make(drive):
        pools.append(pool_for(job_of(lambda: drive), 1))
        return pools[-1]

    yield make
    for pool in pools:
        pool.close(at_once=True)
    assert leftovers(tmp_path / "records") == ()
    assert list((tmp_path / "records").iterdir()) == []


def fetched(pool, scenario=SCENARIOS[0]):
    pool.expect([scenario])
    return pool.fetch(scenario)


def test_traces_come_back_read_only(pool_of):
    states = fetched(pool_of(lambda number: None), SCENARIOS[3]).value.value.states
    assert np.array_equal(states, np.full((2, 2, 7), 3.0))
    assert not states.flags.writeable


def test_what_raises_is_left_to_this_process(pool_of):
    def fail(number):
        raise SystemExit("no such planner")

    assert isinstance(fetched(pool_of(fail)), RunItHere)


def test_result_that_cannot_be_sent_is_an_exception(pool_of):
    class Local(UserWarning):
        """A warning that belongs to no module, so it cannot be pickled."""

    assert isinstance(
        fetched(pool_of(lambda number: warnings.warn("a warning", Local, stacklevel=1))), RunItHere
    )


def test_scenario_is_on_disk_only_while_it_runs(pool_of, tmp_path):
    def copy_and_die(number):
        (path,) = (tmp_path / "records").iterdir()
        (tmp_path / "copy").write_text(f"{os.getpid()} {path.read_text()}")
        os._exit(9)

    answer = fetched(pool_of(copy_and_die), SCENARIOS[4])
    assert isinstance(answer, Lost)
    lost = answer.death
    assert lost.end == "ended with exit code 9"
    pid, record = (tmp_path / "copy").read_text().split(maxsplit=1)
    assert f'"owner": "test_it.py::test_it", "pid": {pid}, ' in record
    assert SCENARIOS[4].canonical() in record
    assert expectation(lost).outcome is Outcome.ADS_ERROR


def test_process_killed_while_working_leaves_no_record(pool_of, tmp_path):
    def work(number):
        (tmp_path / "at work").touch()
        time.sleep(60)

    pool = pool_of(work)
    pool.expect(SCENARIOS)
    while not (tmp_path / "at work").exists():
        time.sleep(0.001)
    assert len(list((tmp_path / "records").iterdir())) == 1


@pytest.mark.filterwarnings("always")
def test_what_the_ads_says_is_said_again_here(pool_of, capsys, caplog):
    def chat(number):
        print("driving", number)
        print("careful", file=sys.stderr)
        sys.stdout.buffer.write(b"bytes\n")
        logging.getLogger("planner").warning("gap of %d m", number)
        warnings.warn("old interface", DeprecationWarning, stacklevel=1)

    answer = fetched(pool_of(chat))
    assert capsys.readouterr() == ("", "")
    with pytest.warns(DeprecationWarning, match="old interface") as warned:
        answer.value.output.repeat()
    assert warned[0].filename == __file__
    assert capsys.readouterr() == ("driving 0\nbytes\n", "careful\n")
    assert caplog.record_tuples == [("planner", logging.WARNING, "gap of 0 m")]


def test_exception_in_a_thread_of_another_process_is_told_to_the_hook_of_this_one(
    pool_of, monkeypatch
):
    def drive(number):
        thread = threading.Thread(target=lambda: 1 / number, name="planning")
        thread.start()
        thread.join()

    told = []
    monkeypatch.setattr(threading, "excepthook", told.append)
    answer = fetched(pool_of(drive))
    assert not told
    answer.value.output.repeat()
    (ended,) = told
    assert ended.thread.name == "planning"
    assert "1 / number" in str(ended.exc_value)
    assert "ZeroDivisionError" in str(ended.exc_value)


def test_ads_that_closes_stdout_closes_only_its_own(pool_of, capsys):
    def close(number):
        print("last words")
        sys.stdout.close()

    answer = fetched(pool_of(close))
    assert isinstance(answer, Done)
    answer.value.output.repeat()
    assert capsys.readouterr().out == "last words\n"


def test_warning_filters_apply_in_the_scenario_process(pool_of, recwarn):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        answer = fetched(
            pool_of(lambda number: warnings.warn("old interface", DeprecationWarning, stacklevel=1))
        )
    answer.value.output.repeat()
    assert not recwarn.list


@pytest.mark.processes
def test_spawned_processes_run_a_picklable_factory(job_of, monkeypatch):
    monkeypatch.setattr(runner, "METHOD", "spawn")
    with pool_for(job_of(idle), 1) as pool:
        assert fetched(pool, SCENARIOS[1]).value.value.scenario == SCENARIOS[1]
    assert pool.failure == ""
