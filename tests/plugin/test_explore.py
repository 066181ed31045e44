"""A search without pytest, compared with an item's search."""

SOURCE = """
from example_ads import blind_lane_change, constant_speed

ARGUMENTS = dict(blame="ego", genes=3, npcs=3, shrink_runs=10)

def holds(run):
    assert not run.collision, run.explain()

@pafot.search(ads=blind_lane_change.make, **ARGUMENTS)
def test_drive(run):
    holds(run)

def test_explore():
    assert pafot.explore(
        blind_lane_change.make,
        holds=holds,
        runs=12,
        seed=2,
        node_id="test_it.py::test_drive",
        corpus="elsewhere",
        **ARGUMENTS,
    ).findings
"""


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.yaml")}


def test_explore_saves_the_same_files_as_its_test(project):
    project.write(SOURCE)
    project.run(runs=12, seed=2)
    assert contents(project.path / "elsewhere") == contents(project.path / "pafot_corpus") != {}
