"""The runner of scenarios: who makes a run, and how few calls are between the search and the physics."""

import os
import sys

import pytest

from pytest_pafot import Cell, Highway, PositionInstruction, Scenario
from pytest_pafot.execution import runner
from pytest_pafot.execution.crash_records import leftovers
from pytest_pafot.execution.runner import ExecutionError, Job, runner_for
from pytest_pafot.world.driving.policy import Policy

SCENARIOS = [
    Scenario(npcs=((PositionInstruction(Cell.FRONT, 20.0),),), gene_seconds=2.0, seed=number)
    for number in range(8)
]

FRAMES = 8
"""The number of frames from the function that requests a run to that of the run's loop, both included."""


class Planner:
    """A planner that keeps its lane and speed, and records its callers."""

    def __init__(self):
        self.callers = callers

    def __call__(self, observation):
        self.callers.append(frames())
        return 0.0, 0.0


callers = []


def frames():
    """Return the names of the active Python functions, innermost first."""
    frame, names = sys._getframe(2), []
    while frame is not None:
        names.append(frame.f_code.co_name)
        frame = frame.f_back
    return names


@pytest.fixture
def job_of(tmp_path):
    callers.clear()
    return lambda ads, **world: Job(
        world=Highway(**world), policy=Policy(ads), records=tmp_path, owner="test_it.py::test_it"
    )


@pytest.fixture
def runner_of(job_of):
    """Return a function that makes runners, and close their crash records at the end."""
    records = []

    def make(ads, **options):
        job = job_of(ads)
        records.append(job.crash_record())
        return runner_for(job, records[-1], **options)

    yield make
    for record in records:
        record.close()


def test_call_depth_from_search_to_run_is_limited(runner_of):
    with runner_of(Planner) as runner:
        for scenario in SCENARIOS[:4]:
            runner.once(scenario)
    names = callers[-1]
    here = names.index("test_call_depth_from_search_to_run_is_limited")
    assert here - names.index("drive") + 1 <= FRAMES, names[: here + 1]


def test_crash_record_stays_written_during_the_verdict(runner_of, tmp_path):
    runner = runner_of(Planner)
    runner.once(SCENARIOS[3])
    (path,) = tmp_path.iterdir()
    assert SCENARIOS[3].canonical() in path.read_text()
    assert leftovers(tmp_path) == ()


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_isolated_runs_raise_the_exception_of_the_factory(runner_of):
    def factory():
        raise LookupError("no such planner")

    with (
        runner_of(factory, isolate=True) as runner,
        pytest.raises(LookupError, match="no such planner"),
    ):
        runner.once(SCENARIOS[0])


def test_isolated_runs_refuse_an_unpicklable_factory(runner_of, monkeypatch):
    monkeypatch.setattr(runner, "METHOD", "spawn")
    with pytest.raises(
        ExecutionError, match=r"^--pafot-isolate: expected an ADS factory .* pickled"
    ):
        runner_of(lambda: None, isolate=True).once(SCENARIOS[0])


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_isolated_runs_are_refused_where_no_process_starts(runner_of, monkeypatch):
    def refuse():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuse)
    with pytest.raises(
        ExecutionError,
        match=r"--pafot-isolate: expected a process for the ADS, .*temporarily unavailable",
    ):
        runner_of(Planner, isolate=True).once(SCENARIOS[0])


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_isolated_runs_start_new_processes_after_closing(runner_of):
    runner = runner_of(Planner, isolate=True)
    for _ in range(2):
        with runner:
            assert runner.once(SCENARIOS[0]).scenario == SCENARIOS[0]
    assert callers == []


def test_run_ends_after_the_decisions_that_are_of_interest(runner_of):
    runner = runner_of(Planner)
    cut, asked = runner.once(SCENARIOS[0], most=4), runner.decisions
    assert len(cut.actions) == asked == len(callers) == 4
    whole = runner.once(SCENARIOS[0], most=100)
    assert whole.states.tobytes() == runner.once(SCENARIOS[0]).states.tobytes()


def test_run_that_ends_early_closes_what_the_ads_opened_in_it(runner_of):
    closed = []

    class OpensAtItsFirstDecision(Planner):
        def __call__(self, observation):
            self.close = lambda: closed.append(len(self.callers))
            return super().__call__(observation)

    runner_of(OpensAtItsFirstDecision).once(SCENARIOS[0], most=4)
    assert closed == [4]
