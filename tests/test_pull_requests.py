"""The task ``pull-request`` fails only because of failures that a change introduces."""

import pytest

from tests.helpers.actions import git, inputs_of, run_action
from tests.test_ci_script import begun_repository, commit, copied, record_of, repository, saved  # noqa: F401

pytestmark = pytest.mark.processes

SOUND = "Planner = lambda: lambda seen: (22.0 - seen.ego.speed, 0.0)\n"
FAST = SOUND.replace("22.0", "26.0")
TEST = """
import pytest_pafot as pafot
from planner import Planner


@pafot.search(ads=Planner, npcs=1, genes=1, gene_seconds=5, ego_speed=20)
def test_speed(run):
    assert run.ego.speed.max() < 24
"""


@pytest.fixture
def changed(repository, copied):  # noqa: F811
    """Return a function that commits a base and a change, runs the task, and returns the exit code and the output."""

    def run(before, change, **inputs):
        commit(repository, before, "Before")
        base = git(repository, "rev-parse", "HEAD")
        commit(repository, change, "Change")
        own = {"runs": "4", "seed": "1", "requirements": "", "options": "--pafot-shrink-runs=0"}
        given = inputs_of(
            "pull-request", "pull-request", {"github.event.pull_request.base.sha": base}
        )
        code, printed = run_action(given | own | inputs, repository, **copied)
        assert git(repository, "worktree", "list").count("\n") == 0
        return code, printed

    return run


def test_a_harmful_change_is_red_for_what_is_new(repository, changed):  # noqa: F811
    code, printed = changed({"planner.py": SOUND, "test_safety.py": TEST}, {"planner.py": FAST})
    assert code == 1, printed
    assert "accepted 0 failures already present in BASE=" in printed
    assert [each.status for each in record_of(repository).findings] == ["new"]
    assert saved(repository) == [record_of(repository).findings[0].file]


def test_a_harmless_change_is_green_although_both_fail(repository, changed):  # noqa: F811
    code, printed = changed(
        {"planner.py": FAST, "test_safety.py": TEST}, {"planner.py": f"# Too fast\n{FAST}"}
    )
    assert code == 0, printed
    assert "accepted 1 failure already present in BASE=" in printed
    assert record_of(repository).searches[0].failing > 0
    assert saved(repository) == []


def test_a_change_that_renames_the_test_leaves_no_files_without_a_test(repository, changed):  # noqa: F811
    renamed = TEST.replace("test_speed", "test_top_speed")
    code, printed = changed(
        {"planner.py": FAST, "test_safety.py": TEST}, {"test_safety.py": renamed}
    )
    assert code == 1, printed
    assert [each.test for each in record_of(repository).findings] == [
        "test_safety.py::test_top_speed"
    ]
    assert record_of(repository).orphans == []


def test_a_mended_policy_is_green_and_its_saved_failure_too(repository, changed):  # noqa: F811
    assert (
        changed({"planner.py": FAST, "test_safety.py": TEST}, {"planner.py": f"{FAST}\n"})[0] == 0
    )
    assert changed({"planner.py": FAST}, {"planner.py": SOUND})[0] == 0


@pytest.mark.parametrize(("before", "change", "inputs", "told"), [
    ({"planner.py": SOUND, "test_safety.py": TEST, "needs.txt": "./gone\n"}, {"needs.txt": ""},
     {"requirements": "needs.txt"}, "a commit that can be installed, received the error above"),
    ({"test_safety.py": TEST}, {"planner.py": SOUND}, {}, "a commit whose tests can be run, received the error above"),
])  # fmt: skip
def test_a_base_that_cannot_be_tried_is_an_error_that_says_so(
    repository,  # noqa: F811
    changed,
    before,
    change,
    inputs,
    told,
):
    code, printed = changed(before, change, **inputs)
    assert (code, told in printed) == (2, True), printed
    assert saved(repository) == []


def test_the_first_test_has_nothing_to_be_compared_with(repository, changed):  # noqa: F811
    code, printed = changed({"README.md": "Soon."}, {"planner.py": SOUND, "test_safety.py": TEST})
    assert code == 0, printed
    assert len(record_of(repository).searches) == 1
