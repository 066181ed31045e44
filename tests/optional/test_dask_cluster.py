"""Runs on the workers of a cluster: what is sent, and what happens to lost tasks."""

import multiprocessing
import os
import pickle
import sys
import threading
import time
from concurrent.futures import (
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from functools import partial
from types import ModuleType

import numpy as np
import pytest

from pytest_pafot.execution import dask_cluster
from pytest_pafot.execution.dask_cluster import DaskPool, packed, versions_here
from pytest_pafot.execution.pool import Done, Lost, RunItHere
from pytest_pafot.execution.runner import ExecutionError, Job, runner_for
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world import Highway
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.simulator_world import SimulatorWorld
from tests.helpers.toy_world import Toy, idle, scenario, trace_of
from tests.world.test_simulator import Marking

SPAWN = multiprocessing.get_context("spawn")
SCENARIOS = [scenario(number) for number in range(48)]


class KilledWorker(Exception):  # noqa: N818
    """An error like the one that Dask's scheduler raises."""


class Inline(Executor):
    """An executor of Dask with one worker that runs tasks at once and loses some of them, by number."""

    def __init__(self, lost=(), error=KilledWorker):
        self.sizes, self.lost, self.error = [], lost, error

    def submit(self, run, task, **named):
        future, number = Future(), len(self.sizes)
        self.sizes.append(len(task))
        if number in self.lost:
            future.set_exception(self.error("pafot-1"))
            return future
        future.set_result(run(task))
        return future


ran = []


class InThisProcess:
    """A stand-in for a worker's process."""

    failure = ""

    def __init__(self, work, size, **options):
        self.work, self.recovered = work, []

    def fetch(self, scenario):
        ran.append(getattr(scenario, "scenario", scenario).seed)  # of a whole run, too
        return Done(self.work(scenario, None))


@pytest.fixture
def pool_of(tmp_path, monkeypatch):
    """Return a function that makes pools, whose workers need no own process."""

    def make(executor, ads=idle, worker=InThisProcess):
        monkeypatch.setattr(dask_cluster, "WorkerPool", worker)
        return DaskPool(executor, job_of(tmp_path, ads))

    dask_cluster._kept.cache_clear()
    ran.clear()
    return make


def job_of(folder, ads=idle, world=None):
    return Job(
        world=world or Toy(),
        policy=Policy(ads),
        records=folder,
        owner="test_it.py::test_it",
        root=folder,
    )


def fetched(pool, scenarios=SCENARIOS):
    pool.expect(scenarios)
    return [pool.fetch(each) for each in scenarios]


def traces(answers):
    return [answer.value.value for answer in answers]


def numbers(answers):
    return [trace.scenario.seed for trace in traces(answers)]


def test_runs_equal_local_runs_in_their_order(pool_of):
    answers = fetched(pool_of(Inline()))
    assert all(
        np.array_equal(trace.states, trace_of(trace.scenario).states) for trace in traces(answers)
    )
    assert numbers(answers) == list(range(48))


def test_world_and_ads_are_sent_once_per_worker(pool_of):
    executor, large = Inline(), os.urandom(100_000)
    pool = pool_of(executor, ads=lambda: lambda number: large)
    fetched(pool, SCENARIOS[:1])
    fetched(pool, SCENARIOS[1:2])
    dask_cluster._kept.cache_clear()  # the next task goes to a different worker
    assert numbers(fetched(pool, SCENARIOS[2:3])) == [2]
    fetched(pool, SCENARIOS[3:4])
    assert [size > 100_000 for size in executor.sizes] == [True, False, False, True, False]


@pytest.mark.parametrize("error", [ValueError, ConnectionResetError])
def test_a_task_or_connection_that_fails_is_tried_once_more(pool_of, error):
    pool = pool_of(Inline(lost=(1,), error=error))
    assert numbers(fetched(pool, SCENARIOS[:3])) == [0, 1, 2]
    assert [lost.end for lost in pool.recovered] == [f"was lost ({error.__name__})"]


def test_scenario_lost_twice_is_named_and_others_continue(pool_of):
    first, lost, last = fetched(pool_of(Inline(lost=(1, 3))), SCENARIOS[:3])
    assert numbers([first, last]) == [0, 2]
    assert isinstance(lost, Lost)
    assert lost.death.task == SCENARIOS[1]
    assert str(lost.death).startswith("the worker that ran <Scenario ")


@pytest.mark.parametrize("error", [OSError, CancelledError])
def test_cluster_whose_connections_or_tasks_fail_twice_is_not_used_again(pool_of, error):
    executor = Inline(lost=range(1, 99), error=error)
    pool = pool_of(executor)
    assert [type(answer) for answer in fetched(pool, SCENARIOS[:3])] == [
        Done,
        RunItHere,
        RunItHere,
    ]
    fetched(pool, SCENARIOS[3:6])
    assert len(executor.sizes) == 4
    told = f"--pafot-dask: this process ran the scenarios, because the cluster failed: {error.__name__}: pafot-1"
    assert pool.notes == [told]


def test_cluster_that_refuses_tasks_is_not_used_again(pool_of):
    class ClosedClientError(Exception):
        """Dask's, which is neither a RuntimeError nor an OSError."""

    class Closed(Inline):
        def submit(self, run, task, **named):
            if self.sizes:
                raise ClosedClientError("the client is closed")
            return super().submit(run, task, **named)

    pool = pool_of(Closed())
    assert [type(answer) for answer in fetched(pool, SCENARIOS[:3])] == [RunItHere] * 3
    assert pool.notes[0].endswith("the cluster failed: ClosedClientError: the client is closed")


def test_worker_with_different_package_versions_is_refused(pool_of, monkeypatch):
    pool = pool_of(Inline())
    here = versions_here()
    monkeypatch.setattr(
        dask_cluster, "versions_here", lambda: here | {"numpy": "1.0", "python": "3.9.1"}
    )
    received = rf"at .*: python {here['python']} in this session, 3\.9\.1 there; numpy .* in this session, 1\.0 there"
    with pytest.raises(ExecutionError, match=received):
        fetched(pool)
    assert ran == []


def test_what_a_worker_lacks_is_told(pool_of):
    executor = Inline(lost=range(9), error=ModuleNotFoundError)
    with pytest.raises(
        ExecutionError, match=r"expected workers .* received the error ModuleNotFoundError: pafot-1"
    ):
        fetched(pool_of(executor), SCENARIOS[:1])


def test_modules_of_the_project_travel_by_value(tmp_path, monkeypatch):
    module = ModuleType("my_planner")
    module.__file__ = str(tmp_path / "my_planner.py")
    exec(
        "ANSWER = 7\nclass Planner:\n    def __call__(self, number): return ANSWER\n", vars(module)
    )
    monkeypatch.setitem(sys.modules, "my_planner", module)
    parcel = packed(job_of(tmp_path, module.Planner))
    monkeypatch.delitem(sys.modules, "my_planner")
    assert pickle.loads(parcel.content).policy.factory()(1) == 7


class Unable(InThisProcess):
    def fetch(self, scenario):
        seed = getattr(scenario, "scenario", scenario).seed  # of a whole run
        return (
            RunItHere(LookupError("my-env-v0 is not registered"))
            if seed
            else super().fetch(scenario)
        )


def test_runs_impossible_on_workers_happen_in_the_session(pool_of):
    pool = pool_of(Inline(), worker=Unable)
    assert [type(each) for each in fetched(pool, SCENARIOS[:3])] == [
        Done,
        RunItHere,
        RunItHere,
    ]
    (note,) = pool.notes
    assert "a worker raised LookupError: my-env-v0 is not registered" in note
    assert note.endswith("so this process executed 2 of the runs")


def test_isolated_run_impossible_on_workers_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(dask_cluster, "WorkerPool", Unable)
    dask_cluster._kept.cache_clear()
    job = job_of(tmp_path)
    isolated = runner_for(
        job, job.crash_record(), isolate=True, cluster=partial(DaskPool, Inline())
    )
    assert isolated.once(SCENARIOS[0]) is not None
    with pytest.raises(
        ExecutionError,
        match=r"--pafot-isolate: .*one of them raised LookupError: my-env-v0 is not registered\. Install",
    ):
        isolated.once(SCENARIOS[1])


def test_what_cannot_travel_is_refused(tmp_path):
    lock = threading.Lock()
    with pytest.raises(
        ExecutionError, match=r"can be sent to other machines, received .* TypeError: .*lock"
    ):
        packed(job_of(tmp_path, lambda: lambda number: lock))


def test_missing_cloudpickle_error_says_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cloudpickle", None)
    with pytest.raises(
        ExecutionError, match=r"expected the package cloudpickle, .*'pytest-pafot\[dask\]'"
    ):
        packed(job_of(tmp_path))


class Submitting:
    """An executor of Python as one of Dask, whose tasks have a key."""

    def __init__(self, executor):
        self.executor = executor

    def submit(self, run, task, **named):
        return self.executor.submit(run, task)


@pytest.mark.processes
@pytest.mark.parametrize(
    "how", [ThreadPoolExecutor, partial(ProcessPoolExecutor, mp_context=SPAWN)]
)
def test_simulator_of_a_worker_is_closed_when_the_worker_ends(tmp_path, how):
    world = SimulatorWorld(partial(Marking, tmp_path), duration=1.0)
    with how(1) as executor:
        fetched(
            DaskPool(
                Submitting(executor), job_of(tmp_path, lambda: lambda seen: (0.0, 0.0), world)
            ),
            SCENARIOS[:2],
        )
        assert [*tmp_path.iterdir()] == []
    dask_cluster._kept.cache_clear()  # as the end of this process would
    for process in multiprocessing.active_children():
        process.join(60.0)
    assert len([*tmp_path.iterdir()]) == 1


@pytest.mark.processes
def test_hanging_or_dying_run_leaves_its_worker_alive(tmp_path):
    def drive(observation):
        if len(observation.others) == 2:
            time.sleep(60)
        if len(observation.others) == 3:
            os._exit(9)
        return 0.0, 0.0

    world = Highway(duration=1.0, hang_limit=2.0)
    runs = [
        Scenario(npcs=[[PositionInstruction(cell, 20.0)] for cell in cells])
        for cells in ((2,), (2, 3), (1, 2, 3))
    ]
    with ThreadPoolExecutor(1) as executor:
        first, hangs, dies = fetched(
            DaskPool(Submitting(executor), job_of(tmp_path, lambda: drive, world)), runs
        )
    assert [trace.outcome for trace in traces([first, hangs])] == [Outcome.COMPLETED, Outcome.HANG]
    assert isinstance(dies, Lost)
    assert dies.death.end == "ended with exit code 9"
    # and with it the only end of a pipe for which the process waits
    dask_cluster._kept.cache_clear()
    for process in multiprocessing.active_children():
        process.join(60.0)
    assert multiprocessing.active_children() == []
