"""An ADS that ignores interruptions: the session ends with its findings, and the next one names the scenario."""

import os
import sys

import pytest

import pytest_pafot.execution.runner
from pytest_pafot.corpus.reader import load
from pytest_pafot.model.trace import Outcome
from pytest_pafot.plugin import search_item
from tests.plugin.test_workers import DIES, IMPATIENT, dear, session  # noqa: F401  (dear is a fixture)

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform == "win32", reason="interruptions are signals"),
]

forks = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

STUCK = """
import time

import pytest

import pytest_pafot.execution.runner
import pytest_pafot.plugin.search_item
from pytest_pafot import Highway

pytest_pafot.execution.runner.GRACE = pytest_pafot.plugin.search_item.GRACE = 0.3

@pytest.fixture
def pafot_world():
    return Highway(hang_limit=0.2)

def swallow():
    while True:
        try:
            pause()
        except BaseException:
            pass

def pause():
    try:
        time.sleep(60)
    finally:
        pause()

def hold():
    sum(range(10**12))  # hours of native code without a look at signals

def drive(observation):
    if observation.time == 1 and observation.others[0].lane == observation.ego.lane:
        HANG()
    return 0.0, 0.0

@pytest.fixture
def ads():
    return lambda: drive
"""

TESTS = """
@pafot.search(SHORT, shrink_runs=0)
def test_it(run):
    assert run.min_distance > 3, "what was found"

def test_ordinary(): pass
"""


@pytest.fixture
def hanging(project):
    """Return a function that writes a project whose ADS hangs after some findings, by a function of the conftest."""

    def write(hang):
        project.pytester.makeconftest(STUCK.replace("HANG", hang))
        project.write(TESTS)
        return project

    return write


def named_by_the_next(project):
    """Return the finding that the next session makes from the record, without hanging, and its result."""
    result = project.run(runs=0, apart=True)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    (path,) = [project.path / name for name in project.files if "hang-" in name]
    return load(path), result


def test_ads_that_ignores_interrupt_ends_session_with_summary(hanging):
    project = hanging("swallow")
    result = project.run("--junitxml=junit.xml", runs=36, seed=6, apart=True)
    assert result.ret == search_item.STATUS
    found = project.files
    assert found
    result.stdout.fnmatch_lines(
        ["*in pause*", "*what was found*", "FAILED test_it.py::test_it?search?*"]
    )
    text = (project.path / "junit.xml").read_text()
    assert text.count("<failure") == 1 + len(found)
    if sys.platform == "linux":
        assert named_by_the_next(project)[0].expect.outcome is Outcome.HANG


def test_native_code_hang_ends_session_with_traceback(hanging):
    project = hanging("hold")
    result = project.run(runs=36, seed=6, apart=True)
    assert result.ret == 1
    result.stderr.fnmatch_lines(["Timeout (*", "*in hold"])
    assert project.files
    if sys.platform == "linux":
        finding, result = named_by_the_next(project)
        assert " 0.5 s " in finding.expect.message


def test_under_xdist_only_the_worker_ends(hanging):
    pytest.importorskip("xdist")
    project = hanging("swallow")
    result = project.run("-n1", runs=36, seed=6, apart=True)
    assert result.parseoutcomes()["passed"] == 1
    assert "(pid " in result.stdout.str()
    assert project.files


@forks
def test_worker_that_ignores_interrupt_ends_but_search_continues(dear, monkeypatch):  # noqa: F811
    monkeypatch.setattr(pytest_pafot.execution.runner, "GRACE", 0.3)
    swallows = DIES.replace("def dies", "def hangs").replace("os._exit(9)", "swallow()")
    project = dear(
        "hangs", swallows + IMPATIENT + STUCK[STUCK.index("def swallow") : STUCK.index("def hold")]
    )
    result, contents = session(project, 2, runs=16)
    finding = next(load(project.path / name) for name in contents if "hang-" in name)
    assert finding.expect.outcome is Outcome.HANG
    assert " 0.3 s" in finding.expect.message
    assert " of 16 " in result.stdout.str()


@pytest.mark.parametrize(("value", "is_ours"), [("0", True), ("30", False)])
def test_faulthandler_timer_is_left_to_pytest_if_used(pytester, monkeypatch, value, is_ours):
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    config = pytester.parseconfigure("-o", f"faulthandler_timeout={value}")
    file = search_item._real_stderr(config)
    assert (file is not None) == is_ours
    if file is not None:
        os.close(file)
