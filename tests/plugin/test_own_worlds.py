"""Worlds that are code: simulators and wrapped environments are searched and replayed as tests name them."""

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
RING = """
class Ring:
    speed_limit, longest_run = 26.8, 10.0

    def rollout(self, scenario, ads_factory):
        return pafot.Highway(duration=10.0).rollout(scenario, ads_factory)

    def to_dict(self):
        return {}

class Derived(pafot.Highway):
    pass

@pafot.search(genes=2, gene_seconds=5, npcs=1, world=WORLD)
def test_fails(run):
    assert run.VERDICT
"""
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


WAY_OUT = "Derive your own simulator from pafot.Simulator, and pass it to pafot.SimulatorWorld"


@pytest.mark.parametrize(("world", "told"), [
    ("Ring()", f"received <test_it.Ring object at *>. {WAY_OUT}"),
    ("Ring", f"received <class 'test_it.Ring'>. {WAY_OUT}"),
    ("Derived()", "received Derived(*. Use pafot.Highway itself, because a file cannot describe*"),
    ("pafot.Highway", "received <class *Highway'>. Call it: Highway(...)"),
])  # fmt: skip
def test_what_is_no_world_of_the_package_is_refused_with_the_way_out(project, world, told):
    write(project, RING, WORLD=world, VERDICT=PASSES)
    result = project.run(runs=4)
    expected = "expected pafot.Highway(...), pafot.World(...) or pafot.SimulatorWorld(...)"
    result.stdout.fnmatch_lines([f"*@pafot.search(world=...): {expected}, {told}*"])


def test_old_file_of_a_world_with_a_rollout_is_refused_with_the_way_out_and_others_are_replayed(
    project,
):
    write(project, SIMULATOR, VERDICT=FAILS)
    project.run(runs=4)
    path = project.only_file
    assert load(path).world["kind"] == "own"
    old = path.with_name("old-000000.pafot.yaml")
    lines = path.read_text().splitlines(keepends=True)
    start = next(number for number, line in enumerate(lines) if line.startswith("world:"))
    end = next(
        number for number in range(start + 1, len(lines)) if not lines[number].startswith(" ")
    )
    lines[start:end] = ["world: {kind: own, class: Ring, data: {lanes: 3}}\n"]
    old.write_text("".join(lines))
    result = project.run(runs=0)
    result.assert_outcomes(failed=2, skipped=1)
    expected = "expected a file with a pafot.SimulatorWorld, a pafot.Highway or a pafot.World"
    received = (
        "received a simulator of the class Ring with its own rollout, which is no longer supported"
    )
    result.stdout.fnmatch_lines(
        [f"*old-000000.pafot.yaml:*: world: {expected}, {received}. Derive a *, search again *"]
    )


# --- environments in wrappers


def test_finding_in_wrapped_environment_replays_in_its_wrappers(in_highway_env, saved_wrapped):
    assert load(saved_wrapped.only_file).world["wrappers"] == ["FlattenObservation"]
    assert load(saved_wrapped.only_file).flaky is None
    assert labels(saved_wrapped.run(runs=0)) == "1 still failing"
    wrapped(saved_wrapped, verdict=PASSES)
    assert labels(saved_wrapped.run(runs=0)) == "1 passed"


@pytest.mark.parametrize(("wrappers", "shape", "now"), [
    ("wrappers=[FlattenObservation, lambda env: FrameStackObservation(env, 2)]", "(2, 25)", "'FrameStackOb*'"),
    ("", "(5, 5)", "missing"),
])  # fmt: skip
def test_other_wrappers_than_in_the_file_are_drift(saved_wrapped, wrappers, shape, now):
    wrapped(saved_wrapped, wrappers, shape, PASSES)
    result = saved_wrapped.run("--pafot-strict-drift", runs=0)
    result.stdout.fnmatch_lines(
        [f"*drifted*: world.wrappers is [[]'FlattenObservation'] in the file, *{now}* now*"]
    )


def test_a_test_that_names_another_environment_is_refused(saved_wrapped):
    wrapped(saved_wrapped)
    path = saved_wrapped.path / "test_it.py"
    path.write_text(path.read_text().replace("highway-v0", "highway-fast-v0"))
    result = saved_wrapped.run(runs=0)
    result.stdout.fnmatch_lines(
        [
            (
                "*pafot.World('highway-v0') with FlattenObservation, *, received "
                "pafot.World('highway-fast-v0') with Flatten*"
            )
        ]
    )
