"""Errors at the end of a session appear in its summary, together with the texts of all failures."""

import importlib
import os
import signal
import sys
import time

import pytest

import pytest_pafot.report.page  # noqa: F401  pytester forgets modules that a run imports; this one is patched
from tests.plugin.test_session_records import IS_CUT

FAILURE = "the text of the failure"
FAILS = f"""
@pafot.search(SHORT, shrink_runs=0)  # stop_after=1
def test_fails(run):
    assert run.duration < 1, "{FAILURE}"
"""


def is_whole(result):
    """Return whether a session ended normally with failed tests, and has the text of the failure."""
    text = result.stdout.str()
    assert FAILURE in text
    assert "FAILED test_it.py::test_fails" in text
    return result.ret == pytest.ExitCode.TESTS_FAILED and "INTERNALERROR" not in text


@pytest.mark.parametrize(("function", "error"), [
    ("plugin.reporter.unclaimed", ValueError),
    ("report.page.render_page", ValueError),
    ("report.page.render_page", KeyboardInterrupt),
    ("report.terminal.session_lines", ValueError),
], ids=["records", "report", "interrupt", "summary"])  # fmt: skip
def test_error_at_session_end_is_one_summary_line(project, monkeypatch, function, error):
    def fail(*arguments, **named):
        raise error("a fault")

    project.write(FAILS.replace("test_fails", "test_old"))
    project.run_once()
    project.write(FAILS)
    monkeypatch.setattr(f"pytest_pafot.{function}", fail)
    result = project.run("--pafot-report=x.html")
    assert is_whole(result)
    (line,) = [line for line in result.outlines if "a fault" in line]
    assert line.endswith(f"{error.__name__}: a fault")


def test_unreportable_findings_of_interrupted_session_are_named(project, monkeypatch):
    project.write(IS_CUT)
    monkeypatch.setattr("pytest_pafot.plugin.reporter.report_on", lambda report, when, **_: 1 / 0)
    result = project.run(no_reraise_ctrlc=True)
    assert result.ret == pytest.ExitCode.INTERRUPTED
    result.stdout.fnmatch_lines(
        ["*problem: test_it.py::test_fails?search?: *: ZeroDivisionError: *"]
    )


@pytest.mark.skipif(sys.platform == "win32", reason="files are not counted there")
def test_session_without_free_file_descriptors_still_reports(project):
    project.pytester.makeconftest("""
import os
import resource
import pytest

@pytest.fixture
def ads():
    return lambda: lambda observation: (0.0, 0.0)

@pytest.fixture(scope="session", autouse=True)
def leak():
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
    try:
        while True:
            os.open(os.devnull, os.O_RDONLY)
    except OSError:
        pass
""")
    project.write(FAILS)
    project.leave_behind("test_old.py::test_dies")
    result = project.run("--pafot-report=x.html", apart=True)
    assert is_whole(result)
    result.stdout.fnmatch_lines(["*problem: --pafot-report=x.html: *Too many open files*"])


@pytest.mark.skipif(os.name == "nt", reason="processes have no signals there")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    "step", ["plugin.search_item.exception_for_pytest", "searches.store.relative"]
)
def test_a_signal_while_a_finding_is_reported_does_not_lose_it(project, monkeypatch, step, number):
    """The first step reports the finding to pytest, the second follows the writing of its file."""
    module, _, name = f"pytest_pafot.{step}".rpartition(".")
    function, sent = getattr(importlib.import_module(module), name), []

    def interrupted(*arguments, **named):
        if not sent:
            sent.append(os.kill(os.getpid(), number))
        return function(*arguments, **named)

    project.write(FAILS)
    monkeypatch.setattr(f"{module}.{name}", interrupted)
    result = project.run("--pafot-report=x.html", "--pafot-json=pafot.json", no_reraise_ctrlc=True)
    [file], [found] = project.files, project.record.findings
    assert (result.ret, project.record.exit, found.file) == (2, 2, file)
    assert found.id in (project.path / "x.html").read_text()


def test_the_report_of_a_finding_does_not_show_what_interrupted_its_confirmation(
    project, monkeypatch
):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    project.write(FAILS)
    monkeypatch.setattr("pytest_pafot.searches.bench.Bench.confirm", interrupted)
    text = project.run(no_reraise_ctrlc=True).stdout.str()
    assert f"AssertionError: {FAILURE}" in text
    assert "During handling" not in text


EXITS = """
@pytest.fixture
def leaves():
    pytest.exit("enough", returncode=0)

@pafot.search(SHORT)
def test_in_fixture(run, leaves): pass
"""


@pytest.mark.parametrize(("ci", "code"), [("", 0), ("true", 2)])
def test_no_session_on_ci_passes_without_its_searches(project, monkeypatch, ci, code):
    monkeypatch.setenv("CI", ci)
    project.write(EXITS)
    result = project.run("--pafot-json=pafot.json")
    assert (result.ret, project.record.exit) == (code, code)
    assert len(project.record.problems) == bool(code)


UNRUN = """
import pytest

@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item):
    return True
"""


@pytest.mark.parametrize(
    "arguments", [(), pytest.param(("-n", "2"), marks=pytest.mark.processes)], ids=["one", "xdist"]
)
def test_no_session_on_ci_passes_whose_items_a_hook_leaves_out(project, monkeypatch, arguments):
    monkeypatch.setenv("CI", "true")
    conftest = project.path / "conftest.py"
    conftest.write_text(conftest.read_text() + UNRUN)
    project.write(f"{EXITS}\n@pafot.search(SHORT)\ndef test_other(run):\n    pass\n")
    assert project.run(*arguments, "--pafot-json=pafot.json").ret == 2
    (problem,) = project.record.problems
    assert problem.startswith("2 items ")


ALWAYS = """
import pytest_pafot as pafot

@pafot.search(ads=lambda: lambda observation: (0.0, 0.0), runs=3, genes=2)
def test_fails(run):
    assert run is None
"""
SWALLOWS = """
import pytest

@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item, call):
    report = yield
    if report.failed:
        report.outcome, report.longrepr = "passed", None
    return report
"""
LEAVES = """
import pytest

def pytest_runtest_logfinish():
    pytest.exit("enough", returncode=0)
"""


def test_no_session_passes_whose_failures_a_hook_calls_passed(project):
    (project.path / "conftest.py").write_text(SWALLOWS)
    project.write(ALWAYS)
    project.run("--pafot-shrink-runs=0").assert_outcomes(failed=2)
    result = project.run("--pafot-runs=0")
    result.assert_outcomes(failed=1, skipped=1)


@pytest.mark.parametrize(("ci", "code"), [("", 0), ("true", 1)])
def test_no_session_on_ci_passes_that_ends_in_time_after_a_failure(project, monkeypatch, ci, code):
    monkeypatch.setenv("CI", ci)
    (project.path / "conftest.py").write_text(LEAVES)
    project.write(ALWAYS)
    result = project.run("--pafot-shrink-runs=0", "--pafot-json=pafot.json")
    assert (result.ret, len(project.record.problems)) == (code, code)


def test_failures_of_other_tests_end_a_session_on_ci_as_its_hooks_say(project, monkeypatch):
    monkeypatch.setenv("CI", "true")
    (project.path / "conftest.py").write_text(LEAVES)
    project.write("def test_of_something_else():\n    assert False\n")
    assert project.run().ret == 0


EXITING = """
import os, threading, time
{imported}

class Ends:
    def __init__(self):
        threading.Thread(target=late, daemon={daemon}).start()

    def __call__(self, seen):
        open("started", "w").close()
        time.sleep(0.01)
        return {ends}

def late():
    {late}

@pafot.search(SHORT, ads=Ends, runs={runs})
def test_it(run):
    assert {holds}
"""


PLAIN = {
    "imported": "",
    "daemon": True,
    "ends": "0.0, 0.0",
    "late": "pass",
    "runs": 1,
    "holds": "run",
}


@pytest.mark.parametrize(("changes", "code"), [
    ({"ends": "os._exit(0)"}, 2),
    ({"ends": "os.execv('/bin/true', ['true'])"}, 2),
    ({"ends": "os.abort()"}, -signal.SIGABRT),
    ({"imported": "os._exit(0)"}, 2),
    ({"late": "time.sleep(0.2); os._exit(0)", "runs": 1000}, 2),
    ({"late": "threading.main_thread().join(); os._exit(0)", "daemon": False, "holds": "0"}, 1),
], ids=["_exit", "exec", "abort", "import", "thread", "late_thread"])  # fmt: skip
@pytest.mark.skipif(os.name == "nt", reason="processes have no signals there")
def test_no_session_passes_that_a_policy_ends(project, changes, code):
    project.write(EXITING.format(**PLAIN | changes))
    assert project.run("--pafot-shrink-runs=0", fresh=True).ret == code


@pytest.mark.skipif(os.name == "nt", reason="processes have no signals there")
@pytest.mark.parametrize("late", ["time.sleep(60)", "while True: pass"])
def test_interrupted_session_waits_for_no_thread_of_a_policy(project, late):
    changes = {"daemon": False, "late": late, "runs": 1000, "holds": "os.kill(os.getpid(), 2)"}
    project.write(EXITING.format(**PLAIN | changes))
    begin = time.monotonic()
    result = project.run("--junitxml=x.xml", fresh=True)
    assert (result.ret, (project.path / "x.xml").exists()) == (2, True)
    assert time.monotonic() - begin < 40
