"""The imperfections of sight that a failure needs: which are tried, and a search's report about its findings."""

import pytest

import pytest_pafot as pafot
from pytest_pafot.campaign.refine.drivers import needed_imperfections
from pytest_pafot.corpus.reader import load
from pytest_pafot.model.sight import Sight
from tests.helpers.perceiving import Careful, Debouncing, GhostFiltering, Oblivious
from tests.helpers.stages import oracle
from tests.helpers.tables import table

ALL = Sight(
    range=60.0,
    latency=0.3,
    noise={"position": 0.5},
    dropout=0.1,
    occlusion=True,
    shuffled=True,
    ghosts={"rate": 0.5, "lifetime": 1.0},
    own_bias={"position": 0.3},
)


def needed(sight, *enough):
    """Return the needed imperfections, and the number of runs, if any of these sets is enough to fail."""
    tried = []

    def fails(other):
        tried.append(other)
        return any(set(names) <= set(other.imperfections) for names in enough)

    return needed_imperfections(sight, fails), len(tried)


def test_failure_with_perfect_sight_needs_no_imperfection():
    assert needed(ALL, ()) == ((), 1)


def test_single_imperfection_is_needed_if_perfect_sight_passes():
    assert needed(Sight(latency=0.3), ("latency",)) == (("latency",), 1)


@table(
    ("enough", "expected"),
    [
        ([("latency",)], ("latency",)),
        ([("range", "occlusion")], ("range", "occlusion")),
        ([("range",), ("dropout",)], ("dropout",)),
        ([("latency", "noise"), ("range", "dropout", "occlusion")], ("latency", "noise")),
        ([("ghosts", "own_bias"), ("shuffled", "range")], ("ghosts", "own_bias")),
        ([ALL.imperfections], ALL.imperfections),
    ],
)
def test_only_imperfections_that_cannot_be_spared_are_needed(enough, expected):
    found, runs = needed(ALL, *enough)
    assert found == expected
    assert runs <= 1 + len(ALL.imperfections)


def no_collision(run):
    assert not run.collision


@pytest.mark.parametrize(
    ("planner", "seed", "imperfections", "sentence"),
    [
        (Careful, 15, {"latency": 1.5, "occlusion": True}, "only with 1.5 s of latency"),
        (Debouncing, 1, {"noise": {"position": 2.0}}, "only with noise of 2 m"),
        oracle(GhostFiltering, 13, {"occlusion": True}, "only with occlusion"),
        (Oblivious, 0, {"latency": 0.3, "occlusion": True}, "fails also with perfect sight"),
    ],
)
def test_search_names_the_imperfections_a_failure_needs(planner, seed, imperfections, sentence, tmp_path):
    """These seeds find it within five runs."""
    world = pafot.Highway(duration=30.0)
    common = {
        "holds": no_collision,
        "world": world,
        "blame": "ego",
        "seed": seed,
        "runs": 5,
        "shrink_rollouts": 4,
        "vehicles": "car",
    }
    factory = pafot.Perception(planner, **imperfections)
    found = pafot.explore(factory, **common, stop_after=1, corpus=str(tmp_path))
    (finding,) = found.findings
    assert finding.perception.sentence == sentence
    assert found.summary.finds[0].headline.endswith(f", {sentence}")
    (file,) = tmp_path.rglob("*.yaml")
    assert load(file) == finding
    now = pafot.Run(world.rollout(finding.scenario, factory))
    perfect = pafot.Run(world.rollout(finding.scenario, planner))
    assert now.collision
    assert bool(perfect.collision) is ("perfect" in sentence)


@pytest.mark.parametrize(
    ("sight", "are_reused"),
    [
        ({"range": 90.0}, True),
        ({"noise": {"position": 2.0}}, False),
        ({"dropout": 0.1}, False),
        ({"shuffled": True}, False),
    ],
)
def test_run_is_reused_unless_perception_is_random(sight, are_reused):
    common = {"holds": no_collision, "world": pafot.Highway(duration=3.0), "algorithm": "pafot", "npcs": 1, "genes": 1}
    found = pafot.explore(pafot.Perception(Careful, **sight), **common, seed=9, runs=60 if are_reused else 30)
    assert bool(found.summary.known_runs) is are_reused
