"""A saved scenario that killed or hung a process replays in a separate process and costs only its own item."""

import signal
import sys

import pytest

import pytest_pafot.execution.runner
from tests.plugin.conftest import labels
from tests.plugin.test_against import compared

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform == "win32", reason="processes are ended by signals"),
]

forks = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")

TESTS = """
@pafot.search(SHORT)
def test_it(run): pass

def test_ordinary(): pass
"""

DIES = """
import faulthandler
import os
import signal

import pytest

def drive(observation):
    faulthandler.disable()
    os.kill(os.getpid(), signal.SIGSEGV)

def make():
    return drive

@pytest.fixture
def ads():
    return make
"""
"""A conftest with an ADS that ends every process, including the session's."""

SPAWNS = """
import pytest_pafot.execution.runner

pytest_pafot.execution.runner.METHOD = "spawn"
"""
"""A conftest as on a platform that cannot fork processes."""


@pytest.fixture
def crash(project):
    """Return a project with a saved crash, whose ADS still ends every process in which it runs."""
    project.write(TESTS)
    project.leave_crash("test_it.py::test_it")
    project.run(runs=0)
    assert project.only_id.startswith("crash-")
    project.pytester.makeconftest(DIES)
    return project


def replayed(project, *args, **options):
    """Run a session that replays, in a separate process, so that the test survives in any case."""
    return project.run("--junitxml=junit.xml", *args, apart=True, **{"runs": 0} | options)


@pytest.mark.parametrize("more", ["", SPAWNS], ids=["this platform", "where nothing is forked"])
@pytest.mark.parametrize("runs", [0, 4])
def test_repeated_crash_fails_only_its_own_item(crash, more, runs):
    crash.pytester.makeconftest(DIES + more)
    asked = "-k", "saved or ordinary"
    result = replayed(crash, *asked, runs=runs)
    result.assert_outcomes(failed=1, passed=1, deselected=1)
    assert "SIGSEGV" in result.stdout.str()
    assert labels(result) == "1 still failing"
    assert 'tests="2"' in (crash.path / "junit.xml").read_text()
    assert not crash.records


@forks
def test_search_after_a_saved_crash_runs_isolated(crash):
    result = crash.run(apart=True)
    result.assert_outcomes(failed=1, passed=2)  # the replay fails; the search finds nothing new
    result.stdout.fnmatch_lines(["  crash-*: * (known).", "*note: * --pafot-isolate*"])
    assert labels(result) == "1 still failing"


@forks
def test_search_runs_in_session_once_crash_is_fixed(crash):
    crash.mend()
    result = crash.run()
    result.assert_outcomes(passed=3)
    assert labels(result) == "1 passed (not found again)"
    result.stdout.no_fnmatch_line("*--pafot-isolate*")
    assert not crash.records


@forks
def test_search_runs_isolated_after_a_session_died(project):
    project.write(TESTS)
    project.pytester.makeconftest(DIES)
    assert project.run("-p", "cacheprovider", apart=True).ret == -signal.SIGSEGV
    result = project.run("-p", "cacheprovider", apart=True)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["*found *saved-crash-*", "*note: * --pafot-isolate*"])


@pytest.mark.parametrize("more", ["", SPAWNS], ids=["this platform", "where nothing is forked"])
def test_a_crash_that_comes_no_more_is_fixed(crash, more):
    crash.pytester.makeconftest(
        DIES.replace("os.kill(os.getpid(), signal.SIGSEGV)", "return 0.0, 0.0") + more
    )
    result = replayed(crash)
    result.assert_outcomes(passed=2, skipped=1)
    assert labels(result) == "1 passed"


def test_accepted_crash_is_tried_and_expires_when_fixed(crash):
    crash.accept()
    replayed(crash).assert_outcomes(xfailed=1, passed=1, skipped=1)
    crash.mend()
    result = replayed(crash)
    result.assert_outcomes(failed=1, passed=1, skipped=1)
    result.stdout.fnmatch_lines(["*XPASS(strict)*"])


@forks
def test_ordinary_failure_that_now_kills_process_has_drifted(project):
    project.write(TESTS.replace("pass", "assert run.duration < 1", 1))
    project.run("--pafot-stop-after=1")
    id_ = project.only_id
    project.pytester.makeconftest(DIES)
    asked = f"test_it.py::test_it[saved-{id_}]", "test_it.py::test_ordinary"
    assert replayed(project, *asked).ret == -signal.SIGSEGV
    result = replayed(project, *asked)
    result.assert_outcomes(failed=1, passed=1)
    assert labels(result) == "1 drifted"
    assert "SIGSEGV" in result.stdout.str()


@forks
def test_process_may_die_of_the_test_function(crash):
    crash.mend()
    crash.write(TESTS.replace("pass", "import os; os._exit(9)", 1))
    result = replayed(crash)
    result.assert_outcomes(failed=1, passed=1, skipped=1)
    result.stdout.fnmatch_lines(["* exit code 9*"])


@forks
def test_crash_against_a_reference_is_introduced_or_common(crash):
    drives, keeps = (
        "def make():\n    return drive\n",
        "def make():\n    return lambda seen: (0.0, 0.0)\n",
    )
    # The saved scenario has one other vehicle, those of the search have two.
    once = "def make():\n    return lambda seen: drive(seen) if len(seen.others) == 1 else (0.0, 0.0)\n"
    for before, runs, counts, found in (
        (keeps, 0, [1, 0, 0], 0), (drives, 0, [0, 0, 1], 0), (once, 1, [1, 0, 1], 1),
    ):  # fmt: skip
        crash.pytester.makepyfile(planner_before=f"from conftest import drive\n\n{before}")
        result = replayed(crash, "--pafot-against=planner_before:make", runs=runs)
        assert (labels(result), compared(result)) == ("1 still failing", counts)
        assert len(crash.files) == 1 + found


@forks
def test_output_of_the_other_process_is_captured_once(crash):
    crash.mend()
    crash.write(TESTS.replace("pass", "print('judged'); assert run.duration < 1", 1))
    result = replayed(crash)
    result.assert_outcomes(failed=1, passed=1, skipped=1)
    assert result.stdout.lines.count("judged") == 1
    result.stdout.re_match_lines([r"test_it\.py:\d+: assert 7\.0 < 1\."])


@forks
def test_hang_replays_in_a_process_that_is_killed(crash, monkeypatch):
    monkeypatch.setattr(pytest_pafot.execution.runner, "GRACE", 0.4)
    text = crash.only_file.read_text()
    crash.only_file.write_text(
        text.replace("hang_limit: 30.0", "hang_limit: 0.1").replace("ads_error", "hang")
    )
    crash.pytester.makeconftest(
        DIES.replace("os.kill(os.getpid(), signal.SIGSEGV)", "sum(range(10**12))")
    )
    result = crash.run(runs=0)
    result.assert_outcomes(failed=1, passed=1, skipped=1)
    assert " 0.5 s " in result.stdout.str()
