"""The command `python -m pytest_pafot search`: a finding without a test file, and a test file to keep it."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pytest_pafot.__main__ import main
from tests.helpers.processes import begun
from tests.helpers.sessions import Copy, command_in_a_copy, set_keys

POLICY = """\
import pytest_pafot as pafot


class Planner:
    def __call__(self, observation):
        return 0.0, 0.0


def make(name):
    assert name == "fast"
    return Planner()


def idle():
    return lambda observation: 1


def keeps_moving(run):
    pafot.check(run.ego.speed, name="speed", at_least=30.0)
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "a_planner.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(subprocess, "Popen", Copy)
    set_keys(monkeypatch, shrink_runs=0)
    return tmp_path


ENDLESS = ["pytest_pafot", "search", "a_planner:Planner", "--runs", "100000", "--seed", "2"]
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}


def python(*arguments):
    done = command_in_a_copy(*arguments)
    return done.code, done.out


LIKE_THIS = "search a_planner:Planner --runs 4 --seed 2"


@pytest.mark.processes
def test_search_command_saves_a_finding_and_writes_tests(here, monkeypatch):
    set_keys(monkeypatch, shrink_runs=None)
    code, told = python("pytest_pafot", *LIKE_THIS.split(), "--", "-q")
    assert code == 1
    assert "leader-unanswered" in told
    assert (here / "pafot.html").exists()
    last = told.rstrip().splitlines()[-1]
    assert f" {LIKE_THIS} --write-test" in last

    assert (
        command_in_a_copy("pytest_pafot", "search", "a_planner:Planner", "--write-test").code == 0
    )
    assert {"a_planner.py", "test_safety.py"} <= {path.name for path in here.iterdir()}
    assert (
        '@pafot.search(ads="a_planner:Planner", blame="ego")'
        in (here / "test_safety.py").read_text()
    )


WORLDS = """\
import gymnasium
import pytest_pafot as pafot

gymnasium.register("mine-v0", entry_point="highway_env.envs.highway_env:HighwayEnvFast")


def short(seconds):
    return pafot.World("mine-v0", duration=float(seconds), wrappers=[lambda env: gymnasium.ObservationWrapper(env)])


class Road(pafot.Simulator):
    speed_limit = 20.0

    def start(self, vehicles, seed):
        self.rows = [each[:4] for each in vehicles]

    def step(self, controls):
        self.rows = [(each.x, each.y, each.heading, each.speed) for each in controls]

    def states(self):
        return self.rows


def road():
    return pafot.SimulatorWorld(Road, duration=10.0)
"""


@pytest.mark.processes
@pytest.mark.parametrize(("policy", "world", "argument"), [
    ("a_planner:Planner", "worlds:road", ', world="worlds:road"'),
    ("a_planner:Planner@planner", "worlds:mine-v0", ", world=pafot.World('mine-v0', planner_hz=5)"),
])  # fmt: skip
def test_search_command_drives_in_a_world_of_the_user(here, policy, world, argument):
    (here / "worlds.py").write_text(WORLDS)
    given = ["pytest_pafot", "search", policy, "--world", world, "--blame=any"]
    given.append("--check=a_planner:keeps_moving")
    code, told = python(*given, "--runs", "4", "--seed", "2", "--", "-q")
    assert (code, "(new)." in told) == (1, True), told
    assert python(*given, "--write-test")[0] == 0
    test = (here / "test_safety.py").read_text()
    assert f'@pafot.search(ads="a_planner:Planner"{argument})' in test
    assert ("import worlds\n" in test) == ("mine" in world)
    assert python("pytest", "-q", "--pafot-runs=1", "--pafot-seed=2")[0] == 1


@pytest.mark.processes
def test_search_command_uses_the_requested_world_and_check(here):
    arguments = ["search", "a_planner:idle", "--blame", "any", "--check", "a_planner:keeps_moving"]
    config = ["--config", '{"lanes_count": 3, "offroad_terminal": true, "screen_width": null}']
    arguments += ["--world", "highway-v0", *config, "--traffic", "everyday", "--write-test"]
    assert command_in_a_copy("pytest_pafot", *arguments).code == 0
    test = (here / "test_safety.py").read_text()
    assert (
        "@pafot.search(ads=\"a_planner:idle\", world=pafot.World('highway-v0', config={'lanes_count': 3, "
        "'offroad_terminal': True, 'screen_width': None}), traffic=\"everyday\")\n"
        "def test_keeps_moving(run):\n    return holds(run)\n"
    ) in test
    (here / "test_safety.py").unlink()
    assert (
        command_in_a_copy("pytest_pafot", "search", "a_planner:make:fast", "--write-test").code == 0
    )
    assert 'ads="a_planner:make:fast"' in (here / "test_safety.py").read_text()
    code, told = python(
        "pytest_pafot", "search", "example_ads.idm_mobil:make", "--runs", "2", "--seed", "0"
    )
    assert code == 0, told


NAMES = """\
import functools


class ads:
    def __init__(self, name=""):
        assert name in ("", "C:\\\\a b")

    def __call__(self, observation):
        return 0.0, 0.0


pytest = functools.partial(ads)
run = pytest_plugins = holds = lambda: ads()
Tëst = pytest_runtest_setup = list = _ = ads


def test_no_crash(run):
    assert not run.collision


pafot = TestCheck = test_ = test_no_crash
"""


@pytest.mark.processes
@pytest.mark.parametrize(("policy", "check"), [
    ("ads", "test_no_crash"),
    ("pytest", "pafot"),
    ("pytest_plugins", "TestCheck"),
    ("Tëst", "test_"),
    ("ads:C:\\a b", "test_no_crash"),
])  # fmt: skip
def test_search_takes_policies_and_checks_of_any_name(here, policy, check):
    (here / "odd.py").write_text(NAMES, encoding="utf-8")
    given = ["--runs", "4", "--seed", "2", "--blame", "any", "--pafot-shrink-runs=0", "--", "-q"]
    code, told = python(
        "pytest_pafot", "search", f"odd:{policy}", "--check", f"odd:{check}", *given
    )
    assert (code, "4 runs" in told, "(new" in told) == (1, True, True), told
    assert len([*(here / "pafot_found" / "test_safety").iterdir()]) == 1


def test_search_refuses_a_policy_in_a_file_of_its_own_name(here):
    (here / "test_safety.py").write_text(POLICY)
    assert main(["search", "test_safety:Planner"]) == 2


@pytest.mark.processes
def test_search_in_a_project_reports_no_file_of_its_tests(here, monkeypatch):
    marked = "@pafot.search(ads='a_planner:make:fast')\ndef test_it(run):\n    assert False\n"
    (here / "test_mine.py").write_text(f"import pytest_pafot as pafot\n\n{marked}")
    assert python("pytest", "-q", "--pafot-runs=1")[0] == 1
    assert [*here.glob("pafot_corpus/test_mine/test_it/*")]
    monkeypatch.setenv("CI", "1")
    _, told = python("pytest_pafot", "search", "a_planner:Planner", "--runs", "1", "--seed", "0")
    assert re.search(r"\b1 run[, ]", told), told
    assert "saved_scenarios_without_a_test" not in told
    assert " error" not in told


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_a_written_test_follows_no_link(here, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    (here / "test_safety.py").symlink_to(outside / "stolen.py")
    assert main(["search", "a_planner:Planner", "--write-test"]) == 2
    (here / "pafot_found").symlink_to(outside)
    assert main(["search", "a_planner:Planner"]) == 2
    assert [*outside.iterdir()] == []


def test_a_folder_that_is_full_is_told_in_one_line(here, capsys, monkeypatch):
    def fsync(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    assert main(["search", "a_planner:Planner", "--write-test"]) == 2
    told = capsys.readouterr().err
    assert (told.startswith("search: --write-test: "), told.count("\n")) == (True, 1)
    assert not (here / "test_safety.py").exists()


@pytest.mark.processes
def test_an_error_is_no_test_to_keep(here):
    of_another_test = here / "pafot_corpus/test_it/test_a"
    of_another_test.mkdir(parents=True)
    (of_another_test / "front-2-0674d1.pafot.yaml").touch()
    code, told = python("pytest_pafot", "search", "a_planner:keeps_moving", "--runs", "1")
    assert code == 1
    assert "signature (run)" in told
    assert "--write-test" not in told


@pytest.mark.parametrize("arguments", [["--runs", "-1"], ["--report", "x.png"], ["--runz", "3"]])
def test_a_wrong_option_is_told_by_its_name_here(here, capsys, arguments):
    with pytest.raises(SystemExit, match="2"):
        main(["search", "a_planner:Planner", *arguments])
    error = capsys.readouterr().err
    assert arguments[0] in error.rpartition("error: ")[2]
    assert error.startswith("usage: python -m pytest_pafot search ")


def wait_for_a_finding(search):
    told = ""
    while "pafot: found" not in told:
        line = search.stdout.readline()
        assert line, told
        told += line


@pytest.mark.processes
@pytest.mark.skipif(os.name == "nt", reason="a group of processes has no signals there")
def test_an_interrupted_search_ends_with_its_summary_and_its_page(here):
    with begun([sys.executable, "-m", *ENDLESS], **PIPES) as search:
        wait_for_a_finding(search)
        os.killpg(search.pid, signal.SIGINT)
        rest, error = search.communicate(timeout=60)
    assert search.returncode == 130
    assert error == "\nsearch: interrupted\n"
    # an error, if the interrupt comes while the finding is drawn
    assert "report: pafot.html " in rest
    assert (here / "pafot.html").exists()


@pytest.mark.processes
@pytest.mark.skipif(
    sys.platform != "linux", reason="elsewhere a session does not learn that its parent was killed"
)
def test_session_of_a_search_that_is_killed_ends(here):
    with begun([sys.executable, "-m", *ENDLESS], **PIPES) as search:
        wait_for_a_finding(search)
        children = Path(f"/proc/{search.pid}/task/{search.pid}/children").read_text().split()
        os.kill(int(children[0]), signal.SIGKILL)
        # It also waits for the session, which has the same output.
        _, error = search.communicate(timeout=60)
    assert search.returncode == 128 + signal.SIGKILL
    assert error.rstrip().rpartition("\n")[2].startswith("search: ")
    assert "SIGKILL" in error


@pytest.mark.parametrize(("arguments", "place"), [
    (["a_planner:Nobody"], "ADS: "),
    (["broken:Planner"], "ADS: "),
    (["a_planner:Planner", "--check", "foo"], "--check: "),
    (["a_planner:Planner", "--check", "my-planner:make"], "--check: "),
    (["a_planner:Planner", "--against", "nobody"], "--against: "),
])  # fmt: skip
def test_impossible_search_is_reported_and_writes_nothing(here, capsys, arguments, place):
    (here / "my-planner.py").write_text(POLICY)
    (here / "broken.py").write_text("raise ValueError('no gpu')\n")
    assert main(["search", *arguments]) == 2
    assert capsys.readouterr().err.startswith(f"search: {place}")
    assert not (here / "test_safety.py").exists()


@pytest.mark.processes
def test_search_that_is_to_search_nothing_is_refused(here):
    result = command_in_a_copy("pytest_pafot", "search", "a_planner:Planner", "--pafot-runs=0")
    assert (result.code, "search: " in result.err) == (2, True)


@pytest.mark.processes
@pytest.mark.parametrize(
    "check", ["def wrong(run): return True", "async def wrong(run): assert False"]
)
def test_a_check_that_asserts_nothing_does_not_pass(here, check):
    (here / "checks.py").write_text(f"{check}\n")
    given = ["a_planner:Planner", "--check", "checks:wrong", "--runs", "20", "--seed", "2"]
    code, told = python("pytest_pafot", "search", *given)
    assert (code, "1 failed" in told) == (1, True), told
