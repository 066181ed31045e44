"""The option `dask`: runs on other machines, the same search."""

import math
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from pytest_pafot.execution.dask_cluster import connect
from pytest_pafot.execution.runner import ExecutionError
from tests.helpers.toy_world import scenario
from tests.optional.test_dask_cluster import job_of
from tests.plugin.test_workers import summary

pytestmark = pytest.mark.processes

NOTE = "*note: --pafot-dask: the workers of the cluster executed the runs"

CONFTEST = """
import os
import pytest
from my_planner import Planner

@pytest.fixture
def ads():
    return Planner
"""

PLANNER = """
class Planner:
    def __call__(self, observation):
        if observation.time > 3 and observation.others[0].lane == 1:
            raise KeyError("lane")
        print("at", observation.time)
        return 0.0, 0.0
"""

MANY = """
@pafot.search(genes=2, gene_seconds=4, shrink_runs=0, npcs=2)
def test_many(run):
    assert not run.collision
    assert run.min_distance > 1.9
"""


@pytest.fixture
def elsewhere(project, monkeypatch):
    """Return a project whose ADS has its own module, and the findings of a search in one process there."""
    # a slow session would report its progress
    monkeypatch.setattr("pytest_pafot.plugin.session.LOG_SECONDS", math.inf)
    project.pytester.makeconftest(CONFTEST)
    project.pytester.makepyfile(my_planner=PLANNER)
    project.write(MANY)
    alone, contents = session(project, project.run_once)
    assert contents
    return project, alone, contents


def session(project, run, *args):
    """Run a session that begins without saved scenarios; return it and what it saved."""
    project.forget()
    result = run("-p", "no:cacheprovider", "--show-capture=stdout", *args, runs=12)
    return result, project.contents


def told(result):
    return [line for line in summary(result) if "--pafot-dask" not in line]


@pytest.fixture(scope="module")
def cluster():
    """Return a scheduler with a worker in its own process, which takes long to start."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=":0"
    ) as started:
        yield started


def test_dask_workers_give_same_results_as_one_process(elsewhere, cluster):
    project, alone, contents = elsewhere
    several, same = session(project, project.run, f"--pafot-dask={cluster.scheduler_address}")
    several.stdout.fnmatch_lines([NOTE])
    assert same == contents
    assert told(several) == told(alone)


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_dask_worker_may_die_and_another_join(cluster, tmp_path):
    def make():
        (tmp_path / f"{os.getppid()}").touch()
        return lambda number: time.sleep(0.01)

    scenarios = [scenario(number) for number in range(60)]
    job = replace(job_of(tmp_path, make), root=Path(__file__).parents[2])
    with connect(cluster.scheduler_address, print) as pool_of:
        pool = pool_of(job)
        pool.expect(scenarios)
        answers = [pool.fetch(each) for each in scenarios[:10]]
        os.kill(int(next(tmp_path.iterdir()).name), signal.SIGKILL)
        cluster.scale(2)
        answers += [pool.fetch(each) for each in scenarios[10:]]
    assert [answer.value.value.scenario for answer in answers] == scenarios
    assert len(list(tmp_path.iterdir())) > 1


def test_a_scheduler_that_does_not_answer_is_named():
    pytest.importorskip("distributed")
    with pytest.raises(  # noqa: SIM117
        ExecutionError, match=r"--pafot-dask=tcp://127\.0\.0\.1:9: expected a running scheduler"
    ):
        with connect("tcp://127.0.0.1:9", print, timeout=0.2):
            pass


def test_a_session_says_that_it_waits_for_the_first_worker(monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr("pytest_pafot.execution.dask_cluster.SOON", 0.1)
    # a worker in a process of its own takes seconds to start
    here = {"processes": False, "protocol": "tcp"}
    with distributed.LocalCluster(
        n_workers=0, threads_per_worker=1, dashboard_address=":0", **here
    ) as empty:
        told = []

        def tell(text):
            told.append(text)
            empty.scale(1)

        with connect(empty.scheduler_address, tell):
            pass
    [text] = told
    assert text.startswith(
        f"--pafot-dask={empty.scheduler_address}: the scheduler has no worker, so no scenario runs"
    )
    assert f"`dask worker {empty.scheduler_address}`" in text
