"""An accepted file accepts the one failure that it describes, and no other."""

import re

import pytest

import pytest_pafot as pafot

DRIVES = "def make():\n    def drive(observation):\n        {}\n    return drive\n"
KEEPS = DRIVES.format("return 0.0, 0.0")
TEST = """
import planner

@pafot.search(npcs=2, genes=2, gene_seconds=10, ads=planner.make, shrink_runs=0)  # stop_after=1
def test_never_collides(run):
    assert not run.collision
    assert run.duration > 0
"""


@pytest.fixture
def accepted(project):
    """Return a project with one saved collision, which is accepted."""
    project.write(TEST)
    project.pytester.makepyfile(planner=KEEPS)
    project.run_once(runs=16)
    project.accept()
    return project


def edited(project, old, new):
    text = project.only_file.read_text()
    assert re.search(old, text)
    project.only_file.write_text(re.sub(old, new, text))


def replayed(project, body="return 0.0, 0.0", *args):
    """Replay the file with a policy; return the session's result and what it recorded of the file."""
    project.pytester.makepyfile(planner=DRIVES.format(body))
    result = project.run("--pafot-json=pafot.json", *args, runs=0)
    return result, project.record.findings[0]


@pytest.mark.parametrize("later", ["(1 / 0, 0.0)", "None", "(float('nan'), 0.0)"])
def test_an_error_of_the_policy_is_not_accepted(accepted, later):
    result, finding = replayed(accepted, f"return (0.0, 0.0) if observation.time < 2 else {later}")
    assert (result.ret, finding.result) == (1, "failed")


@pytest.mark.parametrize(("old", "new", "is_accepted"), [
    (r"npc: ([01]),(\s+)cell", lambda found: f"npc: {1 - int(found[1])},{found[2]}cell", False),
    (r"closing_speed: [\d.]+", "closing_speed: 0.5", False),
    (r" closing_speed: [\d.]+", " closing_speed: 0.5", True),  # a worse one was known
    (r"assertion: not run.collision", "assertion: not run.off_road", False),
    (r"outcome: collision", "outcome: off_road", False),
    (r"npc: ", "npc: ", True),
    (r"responsibility: \w+", "responsibility: both", True),
    (r"\btime: [\d.]+, npc", "time: 1.0, npc", True),
])  # fmt: skip
def test_only_the_same_collision_and_assertion_are_accepted_at_any_time_with_any_blame(
    accepted, old, new, is_accepted
):
    edited(accepted, old, new)
    result, finding = replayed(accepted)
    assert (result.ret, finding.result) == ((0, "xfailed") if is_accepted else (1, "failed"))


def test_other_versions_may_move_the_collision_but_not_change_what_fails(accepted):
    edited(accepted, r"closing_speed: [\d.]+", "closing_speed: 0.5")
    edited(accepted, r"numpy: [\d.]+", "numpy: 1.0.0")
    result, finding = replayed(accepted)
    assert (result.ret, finding.result) == (0, "xfailed")
    result, finding = replayed(accepted, "return 0.0, 0.0 if observation.time < 2 else 1 / 0")
    assert (result.ret, finding.result) == (1, "failed")


@pytest.mark.parametrize("known", [", worst_closing_speed: 999.0", ""])
def test_a_search_that_hits_faster_than_all_that_was_known_is_red_until_that_is_accepted_too(
    accepted, known
):
    edited(accepted, r", worst_closing_speed: [\d.]+", known)
    first = accepted.files
    result = accepted.run(runs=16)
    new = [each for each in accepted.files if each not in first]
    assert (result.ret, len(new)) == ((0, 0) if known else (1, 1))
    if new:
        worse = pafot.load(accepted.path / new[0]).finding
        assert (
            worse.expect.closing_speed
            > pafot.load(accepted.path / first[0]).expect.closing_speed + 1.0
        )
        assert worse.worst_known >= worse.expect.closing_speed
        result.stdout.fnmatch_lines([f"  note: {worse.id} * saved-* m/s"])
        text = (accepted.path / new[0]).read_text()
        (accepted.path / new[0]).write_text(
            text.replace("# xfail", "xfail: {reason: ours, until: 9999-12-31} #")
        )
        made = re.search(r" in (\d+) runs: ", result.stdout.str())[1]
        assert accepted.run(runs=made).ret == 0
        assert len(accepted.files) == 2


@pytest.mark.processes
@pytest.mark.parametrize("how", ["-n1", "--pafot-isolate"])
def test_other_processes_accept_the_same(accepted, how):
    assert replayed(accepted, "return 0.0, 0.0", how)[1]["result"] == "xfailed"
    for body in ("return 0.0, 0.0 if observation.time < 2 else 1 / 0", "__import__('os')._exit(0)"):
        if how == "--pafot-isolate" or "_exit" not in body:
            assert replayed(accepted, body, how)[1]["result"] == "failed"
