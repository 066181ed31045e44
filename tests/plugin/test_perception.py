"""A finding of an ADS with imperfect sight: a session's report about it, and about its replay with different sight."""

import pytest

import pytest_pafot as pafot
from pytest_pafot.corpus.reader import load
from pytest_pafot.model.sight import Sight

TEST = """
class Blind:
    def __call__(self, observation):
        return (-9.0 if observation.others else 1.0), 0.0

@pafot.search(SHORT, ads=pafot.Perception(Blind, PERCEPTION))  # stop_after=1
def test_fails(run):
    assert run.ego.speed.max() < 23
"""


def test_finding_names_its_perception_and_replay_the_change(project, tmp_path):
    page = tmp_path / "page.html"
    project.write(TEST.replace("PERCEPTION", "latency=0.1, range=0.0"))
    told = project.run(f"--pafot-report={page}")
    found = "found with a range of 0 m and 0.1 s of latency"
    told.stdout.fnmatch_lines([f"The ego hit NPC *, {found}.", "The ego is responsible."])
    assert load(project.only_file).perception == Sight(latency=0.1, range=0.0)
    assert found in page.read_text(encoding="utf-8").lower()

    change = f"{found}, but run with"
    project.write(TEST.replace("PERCEPTION", "dropout=0.01"))
    result = project.run(runs=0)
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines(["  drifted: *", f"    *{change} 1 % dropout"])

    project.write(TEST.replace("PERCEPTION", "range=0.0"))
    result = project.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines([f"Result of the replay: still failing ({change} a range of 0 m)."])


def no_collision(run):
    assert not run.collision


@pytest.mark.parametrize("sight", [{"range": 90.0}, {"noise": {"position": 2.0}}, {"dropout": 0.1}])
def test_run_is_reused_unless_perception_is_random(sight):
    def careful():
        return lambda observation: (0.0, 0.0)

    common = {
        "world": pafot.Highway(duration=3.0),
        "algorithm": "pafot",
        "npcs": 1,
        "genes": 1,
        "runs": 100,
        "seed": 9,
    }
    found = pafot.explore(pafot.Perception(careful, **sight), holds=no_collision, **common)
    assert bool(found.summary.more_runs["known"]) is ("range" in sight)
