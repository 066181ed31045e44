"""The runner of scenarios: who makes a run, and how few calls are between the search and the physics."""

import os
import random
import sys
from dataclasses import replace

import pytest

from pytest_pafot import Cell, Highway, Perception, PositionInstruction, Scenario
from pytest_pafot.execution import runner as runner_module
from pytest_pafot.execution import scenario_pool
from pytest_pafot.execution.crash_records import leftovers
from pytest_pafot.execution.runner import runner_for
from pytest_pafot.execution.scenario_pool import ExecutionError, Job
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.guard.chance import GENERATORS

SCENARIOS = [
    Scenario(npcs=((PositionInstruction(Cell.FRONT, 20.0),),), gene_seconds=2.0, seed=number) for number in range(8)
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


class Batched(Planner):
    def batch(self, observations):
        self.callers.append(frames())
        return [(0.0, 0.0) for _ in observations]


class Pure(Planner):
    pure = True


class Stateful(Planner):
    copyable = True

    def __init__(self):
        super().__init__()
        self.decisions = 0

    def __call__(self, observation):
        self.decisions += 1
        super().__call__(observation)
        return 0.01 * self.decisions, 0.0

    def __deepcopy__(self, memo):
        copied = type(self)()
        copied.decisions = self.decisions
        return copied


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
        runner.announce(SCENARIOS[:4])
        for scenario in SCENARIOS[:4]:
            runner.run(scenario)
    names = callers[-1]
    here = names.index("test_call_depth_from_search_to_run_is_limited")
    assert here - names.index("finish") + 1 <= FRAMES, names[: here + 1]


def test_call_depth_from_search_to_batch_is_limited(runner_of):
    with runner_of(Batched) as runner:
        runner.announce(SCENARIOS[:4])
        for scenario in SCENARIOS[:4]:
            runner.run(scenario)
    names = callers[-1]
    assert names.index("test_call_depth_from_search_to_batch_is_limited") + 1 <= FRAMES


def test_crash_record_stays_written_during_the_verdict(runner_of, tmp_path):
    runner = runner_of(Planner)
    runner.run(SCENARIOS[3])
    (path,) = tmp_path.iterdir()
    assert SCENARIOS[3].canonical() in path.read_text()
    assert leftovers(tmp_path) == ()


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_isolated_runs_never_call_the_ads_here(runner_of):
    with runner_of(Planner, isolate=True, workers=2) as runner:
        runner.announce(SCENARIOS[:3])
        traces = [runner.run(each) for each in SCENARIOS[:3]]
        again = runner.run(SCENARIOS[0], afresh=True)
    assert callers == []
    assert [trace.scenario for trace in (*traces, again)] == [*SCENARIOS[:3], SCENARIOS[0]]
    assert runner.notes == []


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_isolated_runs_raise_the_exception_of_the_factory(runner_of):
    def factory():
        raise LookupError("no such planner")

    with runner_of(factory, isolate=True) as runner, pytest.raises(LookupError, match="no such planner"):
        runner.run(SCENARIOS[0])


def test_isolated_runs_refuse_an_unpicklable_factory(runner_of, monkeypatch):
    monkeypatch.setattr(scenario_pool, "METHOD", "spawn")
    with pytest.raises(ExecutionError, match=r"^--pafot-isolate: expected an ADS factory .* pickled"):
        runner_of(lambda: None, isolate=True).run(SCENARIOS[0])


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_isolated_runs_are_refused_where_no_process_starts(runner_of, monkeypatch):
    def refuse():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", refuse)
    with pytest.raises(ExecutionError, match=r"--pafot-isolate: expected processes .*temporarily unavailable"):
        runner_of(Planner, isolate=True).run(SCENARIOS[0])


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_isolated_runs_start_new_processes_after_closing(runner_of):
    runner = runner_of(Planner, isolate=True)
    for _ in range(2):
        with runner:
            assert runner.run(SCENARIOS[0]).scenario == SCENARIOS[0]
    assert callers == []


def test_pure_ads_decisions_are_reused_unless_fresh(runner_of):
    runner = runner_of(Pure)
    first, asked = runner.run(SCENARIOS[0]), len(callers)
    second, again = runner.run(SCENARIOS[0]), len(callers)
    third = runner.run(SCENARIOS[0], afresh=True)
    assert (again, len(callers)) == (asked, 2 * asked)
    assert first.states.tobytes() == second.states.tobytes() == third.states.tobytes()


def test_copyable_ads_goes_on_from_the_end_of_a_gene_unless_fresh(runner_of):
    runner, longer = runner_of(Stateful), replace(SCENARIOS[0], npcs=(SCENARIOS[0].npcs[0] * 3,))
    asked = []
    for scenario in (SCENARIOS[0], SCENARIOS[0], longer, longer.truncated(2)):
        trace = runner.run(scenario)
        asked.append(len(callers))
        assert trace.states.tobytes() == runner.run(scenario, afresh=True).states.tobytes()
        callers.clear()
    assert asked == [10, 0, 20, 0]
    assert (runner.reused, runner.notes) == (40, [])


class Locked(Stateful):
    def __deepcopy__(self, memo):
        raise TypeError("cannot pickle '_thread.lock' object")


class CopiedOnce(Stateful):
    is_copy = False

    def __deepcopy__(self, memo):
        copied = super().__deepcopy__(memo)
        copied.is_copy = True
        assert not self.is_copy
        return copied


class Itself(Stateful):
    def __deepcopy__(self, memo):
        return self


class Drawing(Stateful):
    def __call__(self, observation):
        return random.gauss(super().__call__(observation)[0], 0.1), 0.0


@pytest.mark.parametrize(("ads", "received"), [
    (Locked, "received TypeError: cannot pickle '_thread.lock' object"),
    (CopiedOnce, "received AssertionError"),
    (Itself, "received the ADS itself as its copy"),
    (Drawing, "received random numbers from global generators"),
])  # fmt: skip
def test_ads_that_cannot_be_copied_makes_all_decisions_and_a_note_says_why(runner_of, ads, received):
    runner = runner_of(ads)
    for scenario in (SCENARIOS[0], SCENARIOS[0], SCENARIOS[1], replace(SCENARIOS[0], seed=9)):
        alone = GENERATORS.run(Highway().rollout, scenario, ads)
        assert runner.run(scenario).states.tobytes() == alone.states.tobytes()
    (note,) = runner.notes
    assert note.startswith("copyable: expected an ADS ")
    assert received in note
    assert note.endswith("or remove `copyable`")
    assert runner.reused == 0


def test_copies_end_if_they_take_longer_than_they_can_save(runner_of, monkeypatch):
    monkeypatch.setattr(runner_module, "COPY_SECONDS", 0.0)
    monkeypatch.setattr(runner_module, "COPY_SHARE", 0.0)
    runner = runner_of(Stateful)
    runner.run(SCENARIOS[0])
    runner.run(SCENARIOS[0])
    assert runner.reused == 0
    assert "received copies that took 0.0 s of the 0.0 s of runs" in runner.notes[0]


@pytest.mark.parametrize("ads", [
    type("Both", (Locked,), {"pure": True}),
    Perception(Locked, latency=0.2),
    type("Undeclared", (Locked,), {"copyable": 1}),
])  # fmt: skip
def test_no_copy_is_made_of_ads_that_needs_none_or_sees_the_past(runner_of, ads):
    runner = runner_of(ads)
    for _ in range(2):
        runner.run(SCENARIOS[0])
    assert runner.notes == []


def test_only_some_copies_are_kept_the_latest_ones(runner_of, monkeypatch):
    monkeypatch.setattr(runner_module.DecisionCache.__init__, "__defaults__", (runner_module.DECISIONS, 2))
    runner, others = runner_of(Stateful), [replace(SCENARIOS[0], ego_speed=20.0 + number) for number in range(3)]
    for scenario in (*others, others[1], others[2], others[0]):
        runner.run(scenario)
    assert runner.reused == 2 * 10


@pytest.mark.parametrize("ads", [Planner, Pure, Stateful])
def test_run_ends_after_the_decisions_that_are_of_interest(runner_of, ads):
    runner = runner_of(ads)
    cut, asked = runner.run(SCENARIOS[0], most=4), runner.decisions
    assert len(cut.actions) == asked == len(callers) == 4
    whole = runner.run(SCENARIOS[0], most=100)
    assert whole.states.tobytes() == runner.run(SCENARIOS[0], afresh=True).states.tobytes()
    runner.run(SCENARIOS[0], most=6)
    assert all(trace.error is None for _, trace in runner.resumed)


def test_run_that_ends_early_closes_what_the_ads_opened_in_it(runner_of):
    closed = []

    class OpensAtItsFirstDecision(Planner):
        def __call__(self, observation):
            self.close = lambda: closed.append(len(self.callers))
            return super().__call__(observation)

    runner_of(OpensAtItsFirstDecision).run(SCENARIOS[0], most=4)
    assert closed == [4]


@pytest.mark.parametrize("pure", [1, "yes", False, None])
def test_anything_but_true_is_no_declaration(runner_of, monkeypatch, pure):
    monkeypatch.setattr(Pure, "pure", pure)
    runner = runner_of(Pure)
    runner.run(SCENARIOS[0])
    asked = len(callers)
    monkeypatch.setattr(Pure, "pure", True)
    runner.run(SCENARIOS[0])
    assert len(callers) == 2 * asked
