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


def test_without_retrying_one_death_of_lone_scenario_suffices(job_of, no_fork, tmp_path):
    (tmp_path / "records").mkdir()
    record = {"owner": "it", "pid": 1, "world": None, "scenario": json.loads(ONE.canonical())}
    (tmp_path / "records" / "1-x.inflight").write_text(json.dumps(record))
    (leftover,) = leftovers(tmp_path / "records")
    kept = []
    options = {"isolate": False, "has_died_twice": False, "keep": lambda *given: kept.append(given[1:])}
    retry(leftover, job_of(idle), praise, **options)
    assert kept == [(ONE, None)]
