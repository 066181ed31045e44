"""Single runs in a separate process: their results, and what happens to the scenario in flight if it dies."""

import json
import os
import sys
from dataclasses import replace

import pytest

from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.crash_records import leftovers
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import answer_apart, retry, run_apart
from pytest_pafot.execution.scenario_pool import ExecutionError, Job
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.guard.own_worlds import base_world
from tests.helpers.toy_world import Toy, scenario

needs_fork = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

ONE = scenario(1)


@pytest.fixture
def job_of(tmp_path):
    """Return a function that makes jobs whose ADS is a function of the scenario's number."""
    return lambda drive: Job(
        world=base_world(Toy()), policy=Policy(lambda: drive), records=tmp_path / "records", owner="test_it.py::test_it"
    )


@pytest.fixture
def no_fork(monkeypatch):
    monkeypatch.setattr(scenario_pool, "METHOD", "spawn")


def idle(number):
    """Drive without harm."""


def praise(trace):
    """Accept every run."""


def die_in_first(number):
    if number == 1:
        os._exit(9)


@needs_fork
def test_scenario_and_its_verdict_run_in_another_process(job_of, tmp_path, capfd):
    def judge(trace):
        print("judged")
        (tmp_path / f"{trace.scenario.seed}").write_text(f"{os.getpid()}")

    trace, *_ = answer_apart(job_of(idle), ONE, judge, isolate=False)
    assert trace.scenario == ONE
    assert (tmp_path / "1").read_text() != f"{os.getpid()}"
    assert capfd.readouterr().out == ""


@needs_fork
@pytest.mark.parametrize("part", ["run", "verdict"])
def test_process_dying_in_run_or_verdict_is_lost(job_of, part):
    drive, judge = (os._exit, praise) if part == "run" else (idle, lambda trace: os._exit(trace.scenario.seed))
    with pytest.raises(ProcessLostError, match="ended with exit code 1"):
        run_apart(job_of(drive), ONE, judge, isolate=False)


@needs_fork
def test_lost_process_counts_despite_a_successful_retry(job_of, tmp_path):
    def die_once(number):
        if not (tmp_path / "died").exists():
            (tmp_path / "died").touch()
            os._exit(9)

    answer = answer_apart(job_of(die_once), ONE, praise, isolate=False)
    assert isinstance(answer, ProcessLostError)


@needs_fork
def test_exception_of_the_verdict_is_not_raised_here(job_of):
    def fail(trace):
        raise LookupError("no such fixture")

    assert run_apart(job_of(idle), ONE, fail, isolate=False).scenario == ONE


def open_nothing():
    raise OSError("cannot re-initialize CUDA")


@needs_fork
@pytest.mark.parametrize("isolate", [True, False])
def test_exception_of_the_factory_is_raised_with_advice(job_of, isolate):
    job = replace(job_of(idle), policy=Policy(open_nothing))
    kind = OSError if isolate else ExecutionError
    with pytest.raises(kind, match="cannot re-initialize CUDA") as raised:
        run_apart(job, ONE, praise, isolate=isolate)
    told = "".join([str(raised.value), *getattr(raised.value, "__notes__", ())])
    assert "open that in the factory, not before" in told
    assert ("delete the file" in told) is not isolate


@pytest.mark.parametrize("isolate", [False, True])
def test_without_forking_the_ads_must_be_one_that_can_be_pickled(job_of, no_fork, isolate):
    with pytest.raises(ExecutionError, match="expected an ADS factory that can be pickled"):
        run_apart(job_of(idle), ONE, praise, isolate=isolate)


class TestRetrying:
    @pytest.fixture
    def retried(self, job_of, tmp_path):
        """Return the result of a dead process's record, and what is saved."""

        def retried(drive=idle):
            folder = tmp_path / "records"
            folder.mkdir(exist_ok=True)
            record = {"owner": "it", "pid": 1, "world": None, "scenario": json.loads(ONE.canonical())}
            (folder / "1-x.inflight").write_text(json.dumps(record))
            return again(drive)

        def again(drive=idle, *, twice=False):
            (leftover,) = leftovers(tmp_path / "records")
            kept = []
            came = retry(
                leftover,
                job_of(drive),
                praise,
                isolate=False,
                has_died_twice=twice,
                keep=lambda leftover, scenario, lost: kept.append((scenario, lost and lost.end)),
            )
            return came, kept

        retried.again = again
        return retried

    @needs_fork
    def test_retried_scenario_that_completes_is_noted_and_pending(self, retried, tmp_path):
        came, kept = retried()
        assert kept == []
        assert "ran to its end when it was tried again" in came.notes[0]
        assert [each.path for each in leftovers(tmp_path / "records")] == [came.pending.path]

    @needs_fork
    def test_retried_scenario_that_dies_again_is_saved(self, retried, tmp_path):
        came, kept = retried(die_in_first)
        assert kept == [(ONE, "ended with exit code 9")]
        assert (came.notes, came.pending) == ((), None)
        assert leftovers(tmp_path / "records") == ()

    @needs_fork
    def test_sessions_that_are_killed_again_and_again_are_no_finding(self, retried):
        retried()
        for _ in range(2):
            came, kept = retried.again()
            assert kept == []
            assert "killed from outside" in came.notes[0]

    @needs_fork
    def test_scenario_in_which_two_processes_died_is_saved(self, retried):
        retried()
        came, kept = retried.again(twice=True)
        assert (kept, came.pending) == ([(ONE, None)], None)

    def test_without_retrying_one_death_of_lone_scenario_suffices(self, retried, no_fork):
        _, kept = retried()
        assert kept == [(ONE, None)]
