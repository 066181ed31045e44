"""What each extra promises, in short. The stage of tests/optional has the details, and what goes wrong."""

import csv
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.__main__ import COMMANDS, main
from pytest_pafot.searching import SearchSpace, resolve_algorithm
from tests.plugin.conftest import found, project  # noqa: F401
from tests.searching.conftest import make_evaluation  # noqa: F401

SAVED = Path(__file__).parent / "corpus" / "saved" / "collision-xfail.pafot.yaml"
FAST = pafot.World("highway-fast-v0", {"vehicles_count": 8, "duration": 6})
CUT_IN = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 10.0)]])
ROAD = pafot.Highway(duration=4.0)
POLICIES = """
def keeps_speed():
    return lambda seen: (0.0, 0.0)

def brakes():
    return lambda seen: (-4.0 if seen.ego.speed > 5.0 else 0.0, 0.0)

def raises():
    return lambda seen: 1 / 0
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Go to a folder with policies."""
    (tmp_path / "policies.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(os.environ, "PYTEST_PAFOT_DRIVES", "")
    return tmp_path


@pytest.fixture
def told(here, capsys):
    """Return a function that runs a command, and returns its exit code and its output."""

    def run(command, *arguments):
        code = main([*command.split(), *map(str, arguments)])
        return code, "".join(capsys.readouterr())

    return run


def test_every_command_explains_itself(capsys):
    for name, command in COMMANDS.items():
        with pytest.raises(SystemExit, match="0"):
            main([name, "--help"])
        assert command.about[:20] in " ".join(capsys.readouterr().out.split())


def test_rate_counts_crashes_of_a_policy_in_ordinary_traffic(told):
    config = json.dumps(FAST.to_dict()["config"])
    options = ["--world", "highway-fast-v0", "--config", config, "--episodes", "2", "--workers", "1"]
    code, text = told("rate --ads policies:keeps_speed@planner", *options)
    assert (code, "of 2 episodes crashed" in text) == (0, True)
    code, text = told("rate --ads policies:raises@planner", *options)
    assert (code, "the ADS failed in 2 episodes" in text) == (1, True), text


def test_export_writes_the_run_of_a_saved_file(told, here):
    code, text = told("export", SAVED, "--to", "csv", "--ads", "constant_speed")
    assert (code, text) == (0, "collision-xfail.csv\n")
    rows = list(csv.DictReader((here / "collision-xfail.csv").read_text().splitlines()))
    assert (rows[0]["time"], rows[0]["vehicle"], rows[0]["speed"]) == ("0.0", "ego", "22.0")


PROGRAM = """
import json, sys
for line in sys.stdin:
    json.loads(line)
    print(json.dumps({"acceleration": -1.0, "steering": 0.0}), flush=True)
"""


def test_program_in_any_language_is_a_policy(tmp_path):
    (tmp_path / "planner.py").write_text(PROGRAM)
    ads = pafot.policies.process([sys.executable, "-S", "-E", str(tmp_path / "planner.py")])
    trace = ROAD.rollout(CUT_IN, ads)
    assert trace.error is None
    assert {acceleration for acceleration, _ in trace.actions} == {-1.0}


class Wrong:
    """A world that hides what it is."""

    speed_limit, longest_run, hang_limit = 26.8, 4.0, 0.3

    def rollout(self, scenario, ads_factory):
        return ROAD.rollout(scenario, ads_factory)

    def to_dict(self):
        return {"number": object()}


@pytest.mark.filterwarnings("ignore:check_world. no collision:RuntimeWarning")
def test_check_world_accepts_a_right_world_and_names_what_is_wrong():
    from pytest_pafot.testing import check_world

    short = {"npcs": 1, "genes": 1, "gene_seconds": 1.0, "runs": 1}
    check_world(pafot.Highway(duration=1.0, hang_limit=0.05), **short)
    with pytest.raises(AssertionError, match="to_dict"):
        check_world(Wrong(), **short)


def test_algorithm_asks_and_is_told(make_evaluation):  # noqa: F811
    search, rng = resolve_algorithm("av-fuzzer").make(SearchSpace(npcs=2)), np.random.default_rng(1)
    state, asked = search.ask(search.start(rng), rng)
    assert len(asked) > 0
    state, events = search.tell(state, [make_evaluation(each) for each in asked], rng)
    assert events


@pytest.mark.processes
def test_compare_writes_a_report_on_two_algorithms(told, here, monkeypatch):
    monkeypatch.setattr("pytest_pafot.comparison.figures.draw_all", lambda measured, folder: {})
    options = "--runs 2 --generations 1 --duration 10 --workers 1 --out out"
    code, text = told(f"compare --ads constant_speed --algorithms pafot,random {options}")
    assert (code, text.splitlines()[0]) == (0, "out/report.md")
    report = (here / "out" / "report.md").read_text()
    assert "2 runs of each algorithm" in report
    assert "| random |" in report
