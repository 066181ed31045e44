"""The option `isolate`: the ADS runs only in other processes, which may die, and the search is the same."""

import os
import sys

import pytest

from pytest_pafot.corpus.reader import load
from tests.helpers.sessions import set_keys
from tests.plugin import test_workers

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone"),
]

CONFTEST = """
import os

import pytest

SESSION = os.getpid()

def note():
    open(f"pid-{os.getpid()}", "w").close()

def keep(observation):
    return 0.0, 0.0

MORE

@pytest.fixture
def ads():
    def make():
        note()
        return DRIVE
    return make
"""

MANY = """
@pafot.search(genes=2, gene_seconds=4, npcs=2, ego_lane=1, ego_speed=22)
def test_many(run):
    assert not run.collision
    assert run.min_distance > 1.9

def test_ordinary(): pass
"""

DIES = """
def drive(observation):
    ego, other = observation.ego, observation.others[0]
    if observation.time == 1 and other.lane == ego.lane:
        os._exit(9)
    return 0.0, 0.0
"""


@pytest.fixture
def isolated(project, monkeypatch):
    """Return a function that writes a project whose ADS has some source text."""
    set_keys(monkeypatch, shrink_runs=20)  # none of these tests needs the default of 300

    def write(drive="keep", more="", test=MANY):
        project.pytester.makeconftest(CONFTEST.replace("DRIVE", drive).replace("MORE", more))
        project.write(test)
        return project

    return write


def session(project, *args, runs=12):
    """Run a session that begins without saved scenarios; return it and what it saved."""
    project.forget()
    result = project.run("-p", "no:cacheprovider", *args, runs=runs)
    return result, project.contents


FAILS = """
def fails(observation):
    if observation.time > 3 and observation.others[0].lane == 1:
        raise KeyError('lane')
    print('at', observation.time)
    return 0.0, 0.0
"""


def summary(result):
    """Return a session's output without what the policy prints: no other process cuts a run that is of no interest."""
    return [line for line in test_workers.summary(result) if not line.startswith("at ")]


@pytest.mark.parametrize(
    ("drive", "more"), [("keep", ""), ("fails", FAILS)], ids=["plain", "raises"]
)
def test_isolated_search_finds_and_saves_the_same(isolated, drive, more):
    project = isolated(drive, more)
    here, contents = session(project)
    assert any("shrunk: {" in text for text in contents.values())
    apart, same = session(project, "--pafot-isolate")
    assert same == contents
    assert summary(apart) == summary(here)
    if drive == "keep":  # what isolation and workers do does not depend on the policy
        several, same = session(project, "--pafot-isolate", "--pafot-workers=2")
        assert same == contents
        assert summary(several) == summary(here)


def test_ads_never_runs_in_the_session_process(isolated):
    project = isolated(test=MANY.replace("npcs=2", "npcs=2, isolate=True"))
    _, contents = session(project, runs=12)
    assert len(contents) > 1
    assert len(pids(project)) == 2, (
        "one process for the search, one for what follows it, and no more for each finding"
    )
    project.run("-p", "no:cacheprovider", runs=4)
    assert len(pids(project)) > 3
    assert f"pid-{os.getpid()}" not in pids(project)


def test_ads_that_ends_its_process_is_a_finding(isolated):
    project = isolated("drive", DIES)
    result = project.run("--pafot-isolate", "--pafot-shrink-runs=0", runs=12, apart=True)
    (crash,) = [name for name in project.files if "crash-" in name]
    assert load(project.path / crash).expect.message.endswith(" exit code 9")
    assert len(project.files) > 1
    result.assert_outcomes(failed=1 + len(project.files), passed=1)
    options = ("--pafot-isolate", "--pafot-shrink-runs=0", "--pafot-json=pafot.json")
    project.run(*options, runs=12, apart=True)
    (search,) = project.record.searches
    assert search.reason == "all runs done"
    assert crash.rpartition("/")[2][:-11] in search.known
    assert not project.records


def test_exception_of_another_process_is_not_retried_here(isolated):
    more = "def breaks(observation):\n    note()\n    runner.run_recorded = None\n    return 0.0, 0.0\n"
    project = isolated("breaks", f"from pytest_pafot.execution import runner\n\n{more}")
    result = project.run("--pafot-isolate", "-p", "no:cacheprovider", runs=4)
    result.stdout.fnmatch_lines(["*TypeError: 'NoneType'*"])
    assert result.parseoutcomes()["passed"] == 1
    assert f"pid-{os.getpid()}" not in {path.name for path in project.path.glob("pid-*")}


LONE = """
def drive(observation):
    if len(observation.others) == 1:
        os._exit(9)
    return 0.0, 0.0
"""


def test_process_death_while_shrinking_is_a_finding(isolated):
    project = isolated("drive", LONE)
    # Each attempt that leaves one NPC ends a process.
    result = project.run("--pafot-isolate", "--pafot-stop-after=1", runs=4, apart=True)
    crash, other = sorted(project.files, key=lambda name: "crash-" not in name)
    assert len(load(project.path / crash).scenario.npcs) == 1
    assert load(project.path / other).shrunk is not None
    result.assert_outcomes(failed=3, passed=1)
    result.stdout.fnmatch_lines(["  crash-*: 0 runs (new)."])  # none of the search


ONCE = """
import pathlib

def drive(observation):
    runs = pathlib.Path("runs")
    if observation.time == 0:
        runs.write_text((runs.read_text() if runs.exists() else "") + ".")
    if len(runs.read_text()) > 1:
        os._exit(9)
    return 0.0, 0.0
"""


def test_finding_whose_rerun_kills_process_is_flaky(isolated):
    project = isolated(
        "drive", ONCE, MANY.replace("assert not run.collision", "assert run.duration < 1")
    )
    result = project.run("--pafot-isolate", "--pafot-stop-after=1", runs=4, apart=True)
    assert load(project.only_file).flaky.endswith(" exit code 9")
    result.assert_outcomes(failed=2, passed=1)


def pids(project):
    return {path.name for path in project.path.glob("pid-*")}


EXITS = """
import os

SESSION = PID

class Exits:
    def __call__(self, observation):
        if os.getpid() != SESSION:
            os._exit(0)
        return 0.0, 0.0
"""
SCENARIO = (
    "SCENARIO = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 15.0)]], ego_speed=20.0)\n"
)


SIMULATED = """
def test_exits(pafot_simulate):
    pafot_simulate(SCENARIO, Exits)

def test_notes(pafot_simulate):
    seen = []
    def drive(observation):
        seen.append(observation.time)
        return 0.0, 0.0
    run = pafot_simulate(SCENARIO, lambda: drive)
    assert len(seen) == len(set(seen)) == len(run.trace.actions)
"""


def test_simulated_scenario_is_isolated_as_well_and_the_test_sees_what_its_policy_notes(project):
    """Run a test with a policy that ends only other processes than that of the session, which sees it do so."""
    project.write(EXITS.replace("PID", str(os.getpid())) + SCENARIO + SIMULATED)
    result = project.run("--pafot-isolate", runs=None)
    result.assert_outcomes(failed=1, passed=1)
    result.stdout.fnmatch_lines(["* exit code 0*"])
    project.run(runs=None).assert_outcomes(passed=2)
