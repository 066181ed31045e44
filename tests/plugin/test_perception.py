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
    assert load(project.only_file).perception == Sight(latency=0.1, range=0.0)
    for text in (told.stdout.str(), page.read_text(encoding="utf-8")):
        assert "0.1 s of latency" in text
    for now, label, change in (
        ("dropout=0.01", "drifted", "1 % dropout"), ("range=0.0", "still failing", "0 m"),
    ):  # fmt: skip
        project.write(TEST.replace("PERCEPTION", now))
        project.run("--pafot-json=pafot.json", runs=0)
        (found,) = project.record.findings
        assert (found.status, found.detail.endswith(change)) == (label, True)


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
