"""Worlds that are code: simulators and wrapped environments are searched and replayed as tests name them."""

import re

import pytest

from pytest_pafot.corpus.reader import load
from tests.plugin.conftest import labels

WRAPPED = """
from gymnasium.wrappers import FlattenObservation, FrameStackObservation

seen = []

def ads():
    return lambda observation: seen.append(observation.shape) or 1

@pafot.search(
    genes=2,
    gene_seconds=1,
    npcs=1,
    ads=ads,
    world=pafot.World("highway-v0", duration=2.0, WRAPPERS),
    shrink_runs=2,  # stop_after=1
)
def test_fails(run):
    assert set(seen) == {SHAPE}
    assert run.VERDICT
"""
FAILS, PASSES = "outcome == 'x'", "outcome"
SIMULATOR = """
import math

class Ring(pafot.Simulator):
    def start(self, vehicles, seed):
        self.cars = [[each.x, each.y, each.heading, each.speed] for each in vehicles]

    def step(self, controls):
        self.cars = [[each.x, each.y, each.heading, each.speed] for each in controls]

    def states(self):
        return self.cars

@pafot.search(genes=2, gene_seconds=5, npcs=1, world=pafot.SimulatorWorld(Ring, duration=10.0), shrink_runs=0)
def test_fails(run):  # stop_after=1
    assert run.VERDICT
"""


def write(project, source, **words):
    for word, text in words.items():
        source = source.replace(word, text)
    project.write(source)


def wrapped(project, wrappers="wrappers=[FlattenObservation]", shape="(25,)", verdict=FAILS):
    write(project, WRAPPED, WRAPPERS=wrappers, SHAPE=shape, VERDICT=verdict)


@pytest.fixture
def saved_wrapped(project):
    """Return a project with one scenario that was saved in a wrapped environment."""
    wrapped(project)
    project.run_once(runs=20)
    return project


def test_old_file_of_a_world_with_a_rollout_is_refused_and_others_are_replayed(project):
    write(project, SIMULATOR, VERDICT=FAILS)
    project.run(runs=4)
    path = project.only_file
    assert load(path).world["kind"] == "own"
    old, text = path.with_name("old-000000.pafot.yaml"), path.read_text()
    old.write_text(
        re.sub(
            r"(?m)^world:.*\n( .*\n)*", "world: {kind: own, class: Ring, data: {lanes: 3}}\n", text
        )
    )
    result = project.run("--pafot-json=pafot.json", runs=0)
    result.assert_outcomes(failed=2, skipped=1)
    expected = {"old-000000": "error", load(path).id: "still failing"}
    assert {each.id: each.status for each in project.record.findings} == expected


# --- environments in wrappers


def test_finding_in_wrapped_environment_replays_in_its_wrappers(in_highway_env, saved_wrapped):
    assert load(saved_wrapped.only_file).world["wrappers"] == ["FlattenObservation"]
    assert load(saved_wrapped.only_file).flaky is None
    assert labels(saved_wrapped.run(runs=0)) == "1 still failing"
    wrapped(saved_wrapped, verdict=PASSES)
    assert labels(saved_wrapped.run(runs=0)) == "1 passed"


@pytest.mark.parametrize(("wrappers", "shape"), [
    ("wrappers=[FlattenObservation, lambda env: FrameStackObservation(env, 2)]", "(2, 25)"), ("", "(5, 5)"),
])  # fmt: skip
def test_other_wrappers_than_in_the_file_are_drift_and_another_environment_an_error(
    saved_wrapped, wrappers, shape
):
    wrapped(saved_wrapped, wrappers, shape, PASSES)
    saved_wrapped.run("--pafot-strict-drift", "--pafot-json=pafot.json", runs=0)
    (found,) = saved_wrapped.record.findings
    assert (found.status, "world.wrappers" in found.detail) == ("drifted", True)
    wrapped(saved_wrapped)
    path = saved_wrapped.path / "test_it.py"
    path.write_text(path.read_text().replace("highway-v0", "highway-fast-v0"))
    saved_wrapped.run("--pafot-json=pafot.json", runs=0)
    assert saved_wrapped.record.findings[0].status == "error"
