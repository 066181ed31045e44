"""Searches in lock step: when they use it, and that their findings are the same as one by one."""

import re

import pytest

from pytest_pafot.execution import runner

PLANNERS = """
import os

class Planner:
    def __call__(self, observation):
        calls.append("call")
        return self.decided(observation)

    def decided(self, observation):
        return (0.3, 0.0)

class Batched(Planner):
    def batch(self, observations):
        calls.append(len(observations))
        return [self.decided(observation) for observation in observations]

calls = []
"""

SEARCH = """
@pafot.search(SHORT, ads=ADS, shrink_rollouts=0)
def test_collides(run):
    calls.append("judged")
    assert not run.collision

@pafot.search(SHORT, ads=ADS, shrink_rollouts=0)
def test_moves(run):
    assert run.duration < 1

def test_calls():
    print("calls:", *calls)
"""


def searched(project, ads, source=PLANNERS + SEARCH, **more):
    """Return the findings of a search, and the line of calls."""
    project.write(source.replace("ADS", ads))
    output = project.run_once("-s", generations=2, **more).stdout.str()
    finds = {
        name: "".join(line for line in text.splitlines(True) if "slowest" not in line)
        for name, text in project.contents.items()
    }
    calls = next(line for line in output.splitlines() if "calls:" in line).partition("calls:")[2].split()
    project.forget()
    return finds, calls, output


def test_lock_step_search_finds_the_same_files(project, in_highway_env):
    together, calls, output = searched(project, "Batched")
    alone, calls_alone, output_alone = searched(project, "Planner")
    assert together == alone != {}
    assert any(call.isdigit() and int(call) > 1 for call in calls)
    assert set(calls_alone) == {"call", "judged"}
    counts = [re.findall(r"^  (\d+ runs) in", text, re.MULTILINE) for text in (output, output_alone)]
    assert counts[0] == counts[1] != []


@pytest.mark.parametrize(
    ("ads", "workers", "notes"),
    [
        ("Batched", 2, ["not in use, since the ADS decides for many runs at once, by its `batch`"]),
        ("Batched", 1, []),
        ("Planner", 2, ["not in use, since a run took ... ms, and it pays off from 60000 ms on"]),
    ],
)
def test_a_search_tells_once_why_workers_are_idle(project, ads, workers, notes, monkeypatch):
    monkeypatch.setattr(runner, "DEAR", 60.0)  # then every run counts as fast, even on a busy machine
    project.write(PLANNERS + f"@pafot.search(SHORT, ads={ads})\ndef test_drives(run):\n    pass\n")
    text = " ".join(project.run(f"--pafot-workers={workers}", generations=3).stdout.str().split())
    told = [note.partition(" ==")[0] for note in text.split("note: --pafot-workers=2: ")[1:]]
    assert [re.sub(r"took [\d.]+ ms", "took ... ms", note) for note in told] == notes


@pytest.mark.parametrize(
    "search", ["decision_limit=1.0", "world=Own()"], ids=["a limit of time for decisions", "a world of ones own"]
)
def test_runs_are_single_where_lock_step_is_impossible(project, search):
    world = """
class Own(pafot.Highway):
    rollout_batch = property()
"""
    _, calls, _ = searched(project, "Batched", PLANNERS + world + SEARCH.replace("SHORT,", f"SHORT, {search},"))
    assert set(calls) == {"call", "judged"}


def test_findings_of_ads_that_mixes_rows_repeat(project):
    mixing = """
class Mixing(Planner):
    def batch(self, observations):
        calls.append(len(observations))
        return [(0.3 + 0.1 * len(observations), 0.0) for observation in observations]
"""
    project.write((PLANNERS + mixing + SEARCH).replace("ADS", "Mixing"))
    assert " 3 3" in project.run("-s", generations=2).stdout.str(), "some runs should take place together"
    found = len(project.files)
    result = project.run(generations=0)
    result.stdout.fnmatch_lines([f"replayed {found} saved scenarios: {found} still failing"])


@pytest.mark.parametrize(("call", "batch", "is_told"), [("1.0", "1.0", False), ("-9.0", "1.0", True)])
def test_a_batch_that_decides_otherwise_than_a_call_is_told(project, call, batch, is_told):
    project.write(
        f"class Two:\n    def __call__(self, observation):\n        return {call}, 0.0\n\n"
        f"    def batch(self, observations):\n        return [({batch}, 0.0)] * len(observations)\n\n"
        "@pafot.search(SHORT, ads=Two, shrink_rollouts=0)\ndef test_it(run):\n    assert run.ego.speed[-1] < 1\n"
    )
    told = "that failed by the ADS's `batch` passed when the ADS was called for each alone"
    assert (told in " ".join(project.run_once(generations=2).stdout.str().split())) is is_told


def test_the_scenario_in_which_batch_raises_is_named(project):
    raising = """
class Raising(Batched):
    def decided(self, observation):
        if observation.time > 2 and observation.others[0].x > observation.ego.x:
            raise LookupError("ahead")
        return (0.3, 0.0)
"""
    together, calls, _ = searched(project, "Raising", PLANNERS + raising + SEARCH)
    alone, _, _ = searched(project, "Raising", PLANNERS + raising.replace("(Batched)", "(Planner)") + SEARCH)
    assert together == alone
    assert any("LookupError" in text for text in together.values())
    assert any(call.isdigit() and int(call) > 1 for call in calls)


def test_wrong_number_of_actions_is_one_clear_error(project):
    project.write(
        PLANNERS
        + """
class Short(Planner):
    def batch(self, observations):
        return [(0.0, 0.0)]

@pafot.search(SHORT, ads=Short)
def test_short(run):
    pass
"""
    )
    result = project.run(generations=3)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*test_short* - ads.batch: expected ? actions, one for each of ? observations*"])


DYING = """
class Dying(Batched):
    def decided(self, observation):
        if HOW and observation.time > 2:
            os._exit(9)
        return (0.3, 0.0)

@pafot.search(SHORT, ads=Dying, shrink_rollouts=0)
def test_dies(run):
    pass
"""


@pytest.mark.processes
@pytest.mark.parametrize(
    ("alone", "expected"),
    [("len(calls) > 70", ([9, 1], ["crash-"])), ("False", ([0, 0], []))],  # a separate run has 50 calls
    ids=["and the second dies again", "and none dies again"],
)
def test_lock_step_scenarios_are_retried_here_without_forking(project, alone, expected):
    project.pytester.makeconftest(
        "import pytest_pafot.execution.scenario_pool\npytest_pafot.execution.scenario_pool.METHOD = 'spawn'\n"
    )
    project.write((PLANNERS + DYING).replace("HOW", "calls[-1] != 'call'"))
    assert project.run(apart=True, generations=3).ret == 9
    project.write((PLANNERS + DYING).replace("HOW", alone))
    seen = [project.run(apart=True, generations=0).ret for _ in range(2)]
    assert (seen, [name.rpartition("/")[2][:6] for name in project.files]) == expected
