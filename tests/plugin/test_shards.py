"""Sessions that divide the tests of a project replay each saved scenario once, and none of them misses a test."""

import pytest

SEARCHES = """
@pafot.search(SHORT)  # stop_after=3
def test_checks(run):
    pafot.check(1.0, name=f"cell {run.event_cell}", at_most=0.0)

@pytest.mark.parametrize("limit", [1, 2])
@pafot.search(SHORT)
def test_ends(run, limit):
    assert run.duration < limit
"""
MENDED = SEARCHES.replace('f"cell {run.event_cell}", at_most=0.0', '"one", at_most=1.0').replace(
    "< limit", "> limit"
)
FILES = ("test_it", "test_other")


@pytest.fixture
def suite(project, monkeypatch):
    """Return a project of two test files whose saved scenarios pass, as it is in CI, which is strict about orphans."""
    for name in FILES:
        project.write(SEARCHES, name=name)
    project.run_once(runs=80)
    for name in FILES:
        project.write(MENDED, name=name)
    monkeypatch.setenv("CI", "1")
    assert len(project.files) == 10
    return project


def replayed(project, *sessions, plugins=("pytest-split",)):
    """Return the files that the sessions have replayed, each with its number of replays. All sessions must pass."""
    counts = {}
    for args in sessions:
        result = project.run("--pafot-json=pafot.json", *args, runs=0, plugins=plugins)
        record = project.record
        files = [finding.file for finding in record.findings]
        assert (result.ret, record.problems) == (0, [])
        assert not any(orphan.is_gone for orphan in record.orphans)
        assert result.parseoutcomes()["passed"] == len(files) > 0  # The searches are skipped.
        counts |= {file: counts.get(file, 0) + 1 for file in files}
    return counts


def groups(*args, splits=3):
    return [[f"--splits={splits}", f"--group={group}", *args] for group in range(1, splits + 1)]


@pytest.mark.parametrize("algorithm", ["duration_based_chunks", "least_duration"])
def test_groups_of_pytest_split_replay_each_file_once(suite, algorithm):
    pytest.importorskip("pytest_split")
    assert replayed(suite, *groups(f"--splitting-algorithm={algorithm}")) == dict.fromkeys(
        suite.files, 1
    )


def test_shuffled_groups_with_one_seed_replay_each_file_once(suite):
    pytest.importorskip("pytest_split")
    pytest.importorskip("pytest_randomly")
    plugins = ("pytest-split", "randomly")
    assert replayed(suite, *groups("--randomly-seed=3"), plugins=plugins) == dict.fromkeys(
        suite.files, 1
    )


@pytest.mark.processes
def test_groups_in_several_processes_replay_each_file_once(suite):
    pytest.importorskip("pytest_split")
    pytest.importorskip("xdist")
    assert replayed(suite, *groups("-n2", splits=2)) == dict.fromkeys(suite.files, 1)


@pytest.mark.parametrize(
    "sessions", [[["test_it.py"], ["test_other.py"]], [["-k", "checks"], ["-k", "not checks"]]]
)
def test_sessions_of_some_tests_replay_each_file_once(suite, sessions):
    assert replayed(suite, *sessions, plugins=()) == dict.fromkeys(suite.files, 1)


def test_empty_group_ends_with_the_code_of_no_tests(suite):
    pytest.importorskip("pytest_split")
    result = suite.run("--splits=30", "--group=30", runs=0, plugins=("pytest-split",))
    assert result.ret == pytest.ExitCode.NO_TESTS_COLLECTED
