"""Checks end to end: a planner with two bugs that are no collisions, from the search to the guard."""

import re

import pytest

from pytest_pafot.corpus.reader import load
from tests.helpers.sessions import set_keys
from tests.plugin.conftest import labels

PLANNER = """
import pytest

class Planner:
    def __init__(self):
        self.acceleration = 0.0

    def __call__(self, observation):
        ego, wanted = observation.ego, 22.0 - observation.ego.speed
        for other in observation.others:
            if other.x > ego.x and abs(other.y - ego.y) < 3.0:
                gap = other.x - ego.x - other.length
                more = ego.speed**2 - other.speed**2
                wanted = min(wanted, WANTED)
        step = min(max(wanted, -8.0), 2.0) - self.acceleration
        self.acceleration += min(max(step, -STEP), STEP)
        return self.acceleration, 0.0

@pytest.fixture
def ads():
    return Planner
"""
BUGGY = PLANNER.replace(
    "WANTED", "-8.0 if gap < 5.0 + 0.1 * ego.speed + more / 12 else 2.0"
).replace("STEP", "99.0")
"""A planner that follows at a tenth of a second, and brakes all at once."""

FIXED = PLANNER.replace("WANTED", "0.5 * (gap - 4.0 - 1.2 * ego.speed - more / 8)").replace(
    "STEP", "2.0"
)

PROPERTY = """
import numpy as np
@pafot.search(vehicles="car")
def test_drives_well(run):
    windows = np.lib.stride_tricks.sliding_window_view(run.headway, 61)
    regained = np.append(windows.max(axis=1), np.full(60, np.inf))  # of four seconds
    pafot.check(regained, name="headway", at_least=0.5, unit="s")
    pafot.check(abs(run.ego.jerk), name="jerk", at_most=40, unit="m/s^3")
"""


@pytest.fixture
def buggy(project, monkeypatch, shrinking):
    """Return a project whose planner has both bugs."""
    monkeypatch.setenv("COLUMNS", "80")
    set_keys(monkeypatch, shrink_runs=20)
    project.pytester.makeconftest(BUGGY)
    project.write(PROPERTY)
    return project


def test_two_checks_make_one_shrunk_finding_each(buggy):
    result = buggy.run_once(runs=48, seed=1)
    result.assert_outcomes(failed=3)
    expected = ["headway", "jerk"]
    assert sorted(re.findall(r"(\w+)-[0-9a-f]{6}\.pafot\.yaml", " ".join(buggy.files))) == expected
    text = result.stdout.str()
    for check in (
        r"jerk = \d+\.\d > 40 m/s\^3 at \d+\.\d s",
        r"headway = 0\.\d+ < 0\.5 s at \d+\.\d s",
    ):
        assert len(re.findall(rf": {check}\.$", text, re.MULTILINE)) == 1
    assert text.count("checks.py") == 0
    assert all(load(buggy.path / name).shrunk.before for name in buggy.files)


def test_fixed_planner_retains_saved_scenarios_as_guards(buggy):
    buggy.run_once(runs=48, seed=1)
    assert labels(buggy.run(runs=0)) == "2 still failing"
    buggy.pytester.makeconftest(FIXED)
    result = buggy.run(runs=4, seed=1)
    result.assert_outcomes(passed=3)
    assert labels(result) == "2 passed (not found again)"
