"""Single runs in a separate process: their results, and what happens to the scenario in flight if it dies."""

import os
import sys
from dataclasses import replace

import pytest

from pytest_pafot.execution import runner
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import Apart, ExecutionError, Job, judged_apart
from pytest_pafot.world.driving.policy import Policy
from tests.helpers.toy_world import Toy, scenario

needs_fork = pytest.mark.skipif(
    sys.platform != "linux", reason="processes are forked on Linux alone"
)

ONE = scenario(1)
HERE = os.getpid()


@pytest.fixture
def job_of(tmp_path):
    """Return a function that makes jobs whose ADS is a function of the scenario's number."""
    return lambda drive: Job(
        world=Toy(),
        policy=Policy(lambda: drive),
        records=tmp_path / "records",
        owner="test_it.py::test_it",
    )


@pytest.fixture
def no_fork(monkeypatch):
    monkeypatch.setattr(runner, "METHOD", "spawn")


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

    with pytest.raises(ProcessLostError):
        judged_apart(job_of(die_once), ONE, praise)


@needs_fork
def test_exception_of_the_verdict_is_not_raised_here(job_of):
    def fail(trace):
        raise LookupError("no such fixture")

    assert judged_apart(job_of(idle), ONE, fail).scenario == ONE


def open_nothing():
    raise OSError("cannot re-initialize CUDA")


@needs_fork
def test_exception_of_the_factory_is_raised_with_advice(job_of):
    job = replace(job_of(idle), policy=Policy(open_nothing))
    with pytest.raises(OSError, match="cannot re-initialize CUDA") as raised:
        judged_apart(job, ONE, praise)
    assert "Open it inside the factory, not before" in "".join(raised.value.__notes__)


def test_without_forking_the_ads_must_be_one_that_can_be_pickled(job_of, no_fork):
    with pytest.raises(ExecutionError, match="expected an ADS factory that can be pickled"):
        judged_apart(job_of(idle), ONE, praise)


@needs_fork
def test_what_a_function_makes_of_a_scenario_in_a_forked_process_comes_back(job_of):
    job = replace(job_of(idle), read=lambda trace: "what is sent of other runs")
    with job.crash_record() as record, Apart(job, record) as apart:
        assert apart.once_by(ONE, lambda scenario, ads: (scenario.seed, os.getpid() != HERE)) == (
            1,
            True,
        )
