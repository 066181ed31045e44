"""Free NPCs from the mark to the saved file, its replay and the page."""

from pytest_pafot.corpus.reader import load

SEARCH = """
class Ramming:
    def __call__(self, observation):
        return 3.0, 0.0

@pytest.fixture
def rammer():
    return Ramming

@pafot.search(SHORT, ads=lambda: lambda observation: (0.0, 0.0), drivers=DRIVERS)  # stop_after=1
def test_not_rammed(run):
    assert not run.collision or run.collision.npc is None or not is_free(run)

def is_free(run):
    return run.trace.scenario.npcs[run.collision.npc][0].name == "free"
"""


def test_named_driver_is_a_fixture_and_its_finding_is_replayed(project, in_highway_env):
    project.write(SEARCH.replace("DRIVERS", '{"rams": "rammer"}'))
    result = project.run("--pafot-shrink-rollouts=40", "--pafot-report=page", generations=8)
    (name,) = project.files
    finding = load(project.path / name)
    (free,) = [chain[0] for chain in finding.scenario.npcs if chain[0].name == "free"]
    assert free.driver == "rams"
    assert "half of them free (rams)" in " ".join(result.stdout.str().split())
    assert "driven by rams" in (project.path / "page" / "index.html").read_text("utf-8")
    again = project.run(generations=0)
    again.stdout.fnmatch_lines(["*1 still failing*"])

    project.write(SEARCH.replace("DRIVERS", '"idm"'))
    gone = project.run(generations=0)
    gone.stdout.fnmatch_lines(["*driver: expected one of idm, mobil, policy, received 'rams'; name it*"])


def test_wrong_drivers_fail_the_item(project):
    project.write(SEARCH.replace("DRIVERS", '["fast"]'))
    project.run().stdout.fnmatch_lines(["*drivers=...): expected some of 'idm', 'mobil', 'policy'*"])
