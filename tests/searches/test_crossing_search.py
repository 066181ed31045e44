"""Whole searches where ways cross: what they find, save, shrink and replay."""

import pytest

import pytest_pafot as pafot
from pytest_pafot.algorithms.space import MOST_ON_GRID
from pytest_pafot.findings.finding import handles
from pytest_pafot.oracle.run import Run
from tests.helpers.crossings import clashes
from tests.helpers.road_cases import world_of

RUNS = {"runs": 16, "seed": 0, "blame": "ego", "shrink_runs": 8}


class Steady:
    """A policy that drives through every crossing at 9 m/s."""

    def __call__(self, observation):
        return 1


def holds(run):
    assert not run.collision


def driven(world, finding, policy):
    run = Run(world.rollout(finding.scenario, policy))
    failed = run.collision is not None and run.responsibility in ("ego", "both")
    return run, failed


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return tmp_path_factory.mktemp("corpus")


@pytest.fixture(scope="module")
def found(corpus):
    return pafot.explore(
        Steady, holds=holds, world=world_of("intersection-v0"), corpus=str(corpus), **RUNS
    )


def test_search_finds_collisions_from_several_sides(found):
    ids = [each.id for each in found.findings]
    assert len({each.expect.zone for each in found.findings} - {None}) > 1
    assert any(each.startswith("did-not-give-way-left-") for each in ids)
    assert found.summary.drawn.startswith(
        "1 to 3 NPCs with PositionInstructions or LaneInstructions in hostile traffic (NPCs"
    )
    assert found.summary.notes == ()


def test_every_found_scenario_fits_the_world(found):
    world = world_of("intersection-v0")
    for each in found.findings:
        world.check_fits(each.scenario)
        assert not clashes(world.crossings, each.scenario)
        assert len(each.scenario.positions) <= MOST_ON_GRID


def test_findings_shrink_to_one_npc_with_plain_slot(found):
    at_zones = [each.scenario for each in found.findings if each.expect.zone]
    assert all(len(each.npcs) == 1 for each in at_zones)
    assert any(each.crossings[0].slot == 0 for each in at_zones)


def test_saved_file_loads_unchanged_and_fails_again(found, corpus):
    files = {path.name.partition(".")[0]: path for path in corpus.rglob("*.pafot.yaml")}
    assert set(files) == {each.id for each in found.findings}
    for each in found.findings:
        saved = pafot.load(files[each.id])
        assert saved.finding == each
        run, failed = driven(saved.world, saved.finding, Steady)
        assert failed
        assert run.collision.tick / 15 == pytest.approx(each.expect.time, abs=0.001)


def test_waiting_before_the_situation_counts_as_drifted(found):
    for each in found.findings:
        if each.expect.zone:
            run, failed = driven(world_of("intersection-v0"), each, lambda: lambda observation: 0)
            assert not failed
            assert not handles(each, run)


def test_paper_search_stays_on_the_grid():
    kinds = set()

    def holds(run):
        kinds.add(bool(run.scenario.crossings))

    found = pafot.explore(
        Steady, holds=holds, world=world_of("intersection-v0"), runs=6, seed=1, algorithm="pafot"
    )
    assert kinds == {False}
    assert "shows nothing about such traffic" in " ".join(found.summary.notes)
