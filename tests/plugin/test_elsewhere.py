"""A replay that passes, and the search of its test in the same session: is the failure fixed, or only elsewhere?"""

import pytest

from tests.plugin.conftest import labels
from tests.plugin.test_driving_on import POLICIES, filed

CAREFUL = """
def careful():
    def decide(seen):
        ahead = [other for other in seen.others if other.lane == seen.ego.lane and other.x > seen.ego.x]
        return (-7.0 if ahead else -4.0) if seen.ego.speed > 0.5 else 0.0, 0.0
    return decide
"""
TEST = """
import policies

@pafot.search(world=pafot.Highway(lanes=3), blame="ego", npcs=1, ads=policies.POLICY)
def test_gap(run):
    assert not run.collision
"""
SEARCHED = ("--pafot-json=pafot.json", "--pafot-shrink-runs=0")


def fixed(project, policy, **more):
    project.write(TEST.replace("POLICY", policy))
    filed(project, **more)
    project.pytester.makepyfile(policies=POLICIES + CAREFUL)
    project.pytester.makeini("[pytest]\n")
    return project


def searched(project, *args, runs="30", **options):
    """Return a session that replays and searches: its result, its replays, and the new findings of their failures."""
    result = project.run(*SEARCHED, f"--pafot-runs={runs}", *args, runs=None, seed=1, **options)
    findings = project.record.findings
    replayed = [each for each in findings if each.status != "new"]
    kinds = [each.signature for each in replayed]
    new = [each.id for each in findings if each.status == "new" and each.signature in kinds]
    return result, replayed, new


def test_a_search_without_such_a_failure_makes_a_pass_a_fix(project):
    fixed(project, "careful")
    result, (replayed,), _ = searched(project)
    assert (replayed.status, replayed.elsewhere) == ("fixed", "")
    assert 0 < replayed.searched <= 30
    assert labels(result) == "1 passed (not found again)"


@pytest.mark.processes
@pytest.mark.parametrize("args", [(), ("-n2",)], ids=["serial", "xdist"])
def test_a_search_that_finds_the_failure_says_where(project, monkeypatch, args):
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(project.path / "summary.md"))
    fixed(project, "braking")
    result, (replayed,), (new,) = searched(project, "--pafot-report=page.html", *args)
    assert (replayed.status, replayed.searched) == ("still failing", 0)
    assert (replayed.result, replayed.elsewhere) == ("passed", new)
    label = "1 passed (found in another scenario)"
    assert labels(result) == label
    for name in ("page.html", "summary.md"):
        text = (project.path / name).read_text(encoding="utf-8").replace("<wbr>", "")
        assert label in text
        assert new in text


def test_a_saved_scenario_that_fails_in_the_same_way_is_elsewhere_as_well(project):
    fixed(project, "braking")
    _, (first,), (new,) = searched(project)
    _, replayed, _ = searched(project)
    told = {each.id: (each.status, each.elsewhere) for each in replayed}
    assert told[new][0] == "still failing"
    assert told[first.id] == ("still failing", new)
