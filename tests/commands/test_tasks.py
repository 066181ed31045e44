"""Tasks of a command that run in other processes."""

import os

import pytest

from pytest_pafot.commands.tasks import run_tasks

pytestmark = pytest.mark.processes


def work(task):
    if task == "ends":
        os._exit(5)
    if task == "raises":
        raise LookupError("no such planner")
    return task.upper()


@pytest.mark.parametrize("workers", [1, 2])
def test_each_task_comes_with_its_result(workers):
    assert sorted(run_tasks(work, ["a", "b", "c"], workers)) == [("a", "A"), ("b", "B"), ("c", "C")]


def test_error_of_a_task_is_raised_and_lost_process_comes_with_a_way_out():
    with pytest.raises(LookupError):
        list(run_tasks(work, ["a", "raises"], 2))
    with pytest.raises(ChildProcessError, match="exit code 5"):
        list(run_tasks(work, ["a", "ends"], 2))
