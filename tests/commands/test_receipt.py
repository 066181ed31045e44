"""A command that gates ends with 0 only if it came to its end, whatever the policy does with its process."""

import os
import re
import subprocess
import sys

import pytest

from tests.helpers.sessions import command_in_a_copy, set_keys

pytestmark = pytest.mark.processes

POLICY = """
import atexit, os, signal, sys, threading

class Old:
    def __call__(self, observation):
        return 0.0, 0.0

class Planner:
    def __call__(self, observation):
        IN_DECISION
        return 0.0, 0.0

def make():
    IN_FACTORY
    return Planner()

def check(run):
    assert not run.collision

ON_IMPORT
"""
SEARCH = "search planner:make --runs 4 --report=x.html"
ENDINGS = {
    "IN_DECISION": ["os._exit(0)", "sys.exit(0)", "os.execv('/bin/true', ['true'])"],
    "IN_FACTORY": ["os._exit(0)", "sys.exit(0)"],
    "ON_IMPORT": [
        "os._exit(0)",
        "os._exit(3)",
        "sys.exit(0)",
        "os.kill(os.getpid(), signal.SIGKILL)",
        "threading.Timer(0.0, os._exit, [0]).start()",
    ],
}


def ended(folder, command, *, options=None, **parts):
    """Run a command on a policy; return its exit code and what it wrote.

    Args:
        options: Those of a new interpreter, if it must be one.
    """
    source = POLICY
    for name in ENDINGS:
        source = source.replace(name, parts.get(name, "pass"))
    (folder / "planner.py").write_text(source)
    if options is None:
        done = command_in_a_copy("pytest_pafot", *command.split(), folder=folder)
        return done.code, done.err + done.out
    line = [sys.executable, *options, "-m", "pytest_pafot", *command.split()]
    done = subprocess.run(
        line, cwd=folder, capture_output=True, text=True, check=False, timeout=120
    )
    return done.returncode, done.stderr + done.stdout


@pytest.fixture(autouse=True)
def outside_of_ci(monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    # loading other plugins takes as long as a search
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTEST_PLUGINS", "pytest_pafot.plugin")
    set_keys(monkeypatch, shrink_runs=0)


def test_the_end_of_an_isolated_process_is_a_finding_of_a_search(tmp_path):
    code, told = ended(tmp_path, f"{SEARCH} --pafot-isolate", IN_DECISION="os._exit(0)")
    assert code == 1
    assert re.search(r"  crash-\w+: ", told)


@pytest.mark.parametrize(
    ("place", "how"), [(place, how) for place, ways in ENDINGS.items() for how in ways]
)
def test_a_policy_that_ends_its_process_is_no_success(tmp_path, place, how):
    check_ending(tmp_path, SEARCH, place, how)


def check_ending(folder, command, place, how):
    """Run a command on a policy that ends its process at a place; it says so, and is no success."""
    code, told = ended(folder, command, **{place: how})
    assert code != 0
    # pytest's, or the policy's own
    assert "Traceback" not in told or not command.startswith("rate")
    assert re.search(
        r"expected (the process|a policy|an ADS|the factory|a module)|SystemExit: 0", told
    )


def test_an_ending_after_the_verdict_is_no_success(tmp_path):
    assert ended(tmp_path, SEARCH, options=(), ON_IMPORT="atexit.register(os._exit, 0)")[0] != 0


def test_assertions_that_are_off_are_refused(tmp_path):
    code, told = ended(tmp_path, f"{SEARCH} --check planner:check", options=["-O"])
    assert (code, "check: " in told) == (2, True), told


def test_a_search_that_comes_to_its_end_keeps_its_code(tmp_path):
    assert ended(tmp_path, SEARCH)[0] == 1
    help_of, wrong = (ended(tmp_path, f"search {option}")[0] for option in ("--help", "--nothing"))
    assert (help_of, wrong) == (0, 2)


def test_the_session_of_a_search_ends_as_pytest_does_if_nobody_reads_its_output(tmp_path):
    (tmp_path / "planner.py").write_text(re.sub("[A-Z]+_[A-Z]+", "pass", POLICY))
    reader, writer = os.pipe()
    os.close(reader)
    line = [sys.executable, "-m", "pytest_pafot", *SEARCH.split()]
    done = subprocess.run(
        line, cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, check=False, text=True
    )
    os.close(writer)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr


def session(folder, *options, **tests):
    """Run a session of some test files under -O; return its output."""
    (folder / "helper.py").write_text("def holds(run):\n    assert not run.collision\n")
    for name, test in tests.items():
        (folder / f"{name}.py").write_text(test)
    (folder / "planner.py").write_text(re.sub("[A-Z]+_[A-Z]+", "pass", POLICY))
    line = [sys.executable, "-O", "-m", "pytest", "--pafot-runs=8", "--pafot-seed=1", *options]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False).stdout


IMPORTS = "import pytest_pafot as pafot\nfrom helper import holds\nfrom planner import Old\n"
MARKED = f"{IMPORTS}@pafot.search(ads=Old)\ndef test_it(run):\n    assert not run.collision\n"
EXPLORED = """
def holds_here(run):
    assert not run.collision

def test_explored():
    assert pafot.explore(Old, holds=holds_here, runs=8, seed=1).findings
"""


@pytest.mark.parametrize("options", [["--assert=plain"], ["-p", "no:assertion"]])
def test_pytest_refuses_a_marked_test_whose_assertions_are_off(tmp_path, options):
    assert "1 error in" in session(tmp_path, *options, test_it=MARKED)


def test_only_assertions_that_pytest_rewrites_hold_without_those_of_python(tmp_path):
    """Two files are refused, and the search of the third one finds what it does with Python's assertions."""
    told = session(
        tmp_path,
        "-rAp",
        test_it=MARKED + EXPLORED,
        test_as_written=f"'PYTEST_DONT_REWRITE'\n{MARKED}",
        test_imported=f"{IMPORTS}test_it = pafot.search(ads=Old)(holds)\n",
    )
    assert re.search(r"^test_as_written\.py E .*\ntest_imported\.py E ", told, re.MULTILINE)
    assert "2 errors in" in told
    assert "(new)." in told
    assert "PASSED test_it.py::test_explored" in told
