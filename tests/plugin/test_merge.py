"""The option ``--pafot-merge``: the findings of other machines are added to the corpus."""

import hashlib
import shutil
from itertools import permutations

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.findings.shrink import sort_key

pytestmark = pytest.mark.processes

SEVERAL_KINDS = """
@pafot.search(SHORT)
def test_fails(run):
    slow = run.scenario.npcs[0][0].speed < 15
    assert not slow or run.duration < 1
    assert run.outcome == "nothing"
"""
UNSHRUNK = "--pafot-shrink-rollouts=0"


def machine(project, name, *args, **options):
    """Return the corpus of a second machine, with its findings, in a folder of that name."""
    project.run(UNSHRUNK, *args, **options)
    shutil.move(project.path / "pafot_corpus", project.path / name)
    return project.path / name


def merge(project, *folders, args=()):
    return project.run(*(f"--pafot-merge={folder}" for folder in folders), *args, generations=None)


def corpus(project):
    folder = project.path / "pafot_corpus"
    files = sorted(folder.rglob("*")) if folder.is_dir() else []
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files if path.is_file()}


@pytest.fixture
def machines(project):
    project.write(SEVERAL_KINDS)
    return [machine(project, f"machine-{seed}", seed=seed) for seed in (2, 1, 11)]


@pytest.fixture
def other(failing):
    """Return a project without a corpus, next to a second machine's corpus with one finding."""
    return machine(failing, "other")


def the_file(folder):
    (file,) = folder.rglob("*.pafot.yaml")
    return file


def test_merge_result_does_not_depend_on_folder_order(project, machines):
    digests = set()
    for order in permutations(machines):
        for steps in ([order], [[each] for each in order]):
            for folders in steps:
                merge(project, *folders).assert_outcomes(passed=1)
            digests.add(hashlib.sha256(repr(corpus(project)).encode()).hexdigest())
            merged = corpus(project)
            shutil.rmtree(project.path / "pafot_corpus")
    assert len(digests) == 1
    there = [len(list(folder.rglob("*.pafot.yaml"))) for folder in machines]
    assert (there, len(merged)) == ([3, 2, 3], 4)


def test_what_was_merged_replays_as_still_failing(failing, other):
    result = merge(failing, other)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(
        ["merged: test_it.py::test_fails", "  1 saved scenario from other folders added, 0 of this corpus replaced"]
    )
    failing.run(generations=0).stdout.fnmatch_lines(["*1 saved scenario: 1 still failing"])


def test_merging_again_changes_nothing_not_even_a_comment(failing, other):
    merge(failing, other)
    file = the_file(failing.path / "pafot_corpus")
    file.write_text(file.read_text() + "# ours\n")
    merge(failing, other).stdout.fnmatch_lines(["  0 saved scenarios from other folders added, 0 of this corpus *"])
    assert file.read_text().endswith("# ours\n")


def test_simpler_scenario_replaces_own_but_retains_xfail_reason(failing, other):
    failing.run(seed=1)
    simple = shutil.move(failing.path / "pafot_corpus", failing.path / "simple")
    merge(failing, other)
    own = the_file(failing.path / "pafot_corpus")
    own.write_text(own.read_text().replace('# xfail: "reason"', 'xfail: "issue 12"'))
    before = load(own)
    merge(failing, simple).stdout.fnmatch_lines(
        ["  1 saved scenario from other folders added, 1 of this corpus replaced"]
    )
    after = load(the_file(failing.path / "pafot_corpus"))
    assert (after.scenario, after.xfail) == (load(the_file(simple)).scenario, "issue 12")
    assert sort_key(after.scenario) < sort_key(before.scenario)
    merge(failing, other).stdout.fnmatch_lines(["  0 saved scenarios from other folders added, 0 of this corpus *"])


def test_conflicting_xfail_reasons_fail_and_change_nothing(failing, other):
    merge(failing, other)
    for folder, reason in ((failing.path / "pafot_corpus", "issue 12"), (other, "issue 13")):
        file = the_file(folder)
        file.write_text(file.read_text().replace('# xfail: "reason"', f'xfail: "{reason}"'))
    before = corpus(failing)
    result = merge(failing, other)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["xfail: expected the same reason and day for a kind of failure, received 2 different ones (*12*13*"]
    )
    assert corpus(failing) == before


def test_xfail_day_is_merged_and_may_conflict(failing, other):
    file = the_file(other)
    file.write_text(file.read_text().replace('# xfail: "reason"', "xfail: {reason: issue 12, until: 2027-01-31}"))
    merge(failing, other)
    own = the_file(failing.path / "pafot_corpus")
    assert load(own).accepted == "issue 12, until 2027-01-31"
    own.write_text(own.read_text().replace("2027-01-31", "2027-02-28"))
    result = merge(failing, other)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        ["*received 2 different ones (*issue 12, until 2027-02-28*issue 12, until 2027-01-31); write the same *"]
    )
    assert load(own).accepted == "issue 12, until 2027-02-28"


def test_job_summary_reports_failed_merge_and_no_search(failing, other, monkeypatch):
    the_file(other).write_text("pafot: 99\n")
    summary = failing.path / "summary.md"
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    merge(failing, other).assert_outcomes(failed=1)
    lines = summary.read_text().splitlines()
    assert lines[2:6] == ["No search was requested.", "", "**Merged**", ""]
    assert lines[6].startswith("- failed: test\\_it.py::test\\_fails\\[search\\]: ")
    assert "expected the format version 2, received 99" in lines[6]


def test_crash_scenario_is_merged_via_another_process(failing):
    failing.leave_crash("test_it.py::test_fails")
    failing.run(generations=0)
    there = shutil.move(failing.path / "pafot_corpus", failing.path / "other")
    merge(failing, there).assert_outcomes(passed=1)
    assert load(the_file(failing.path / "pafot_corpus")).expect.is_crash
    assert not list((failing.path / ".pytest_cache" / "d" / "pafot").iterdir())


def test_scenario_fixed_here_is_reported_and_not_merged(failing, other):
    failing.write("@pafot.search(SHORT)\ndef test_fails(run):\n    pass\n")
    result = merge(failing, other)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["*  not merged: other/test_it/test_fails/*.pafot.yaml: fixed here"])
    assert corpus(failing) == {}


def test_files_of_an_uncollected_test_are_not_merged(failing, other):
    (other / "test_it" / "test_fails").rename(other / "test_it" / "test_gone")
    result = merge(failing, other, args=["-n1"])
    result.stdout.fnmatch_lines(["not merged: other/test_it/test_gone: no test was collected"])
    assert corpus(failing) == {}


def test_folder_of_a_machine_that_left_nothing_is_named(failing, other):
    for name in ("nothing", "results"):
        (failing.path / name).mkdir()
    (failing.path / "results" / "pafot.json").write_text("{}")
    result = merge(failing, other, "nothing", "results")
    result.assert_outcomes(passed=1)
    told = [line for line in result.stdout.lines if line.startswith("not merged: ")]
    why = "it has neither saved scenarios nor results, pafot.json; see whether its machine has searched"
    assert told == [f"not merged: nothing: {why}"]


def test_broken_file_fails_while_others_are_merged(failing, other):
    the_file(other).with_name("broken.pafot.yaml").write_text("pafot: 99\n")
    result = merge(failing, other)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*broken.pafot.yaml:1: pafot: expected the format version *"])
    assert len(corpus(failing)) == 1


def test_merge_with_save_none_is_a_dry_run(failing, other):
    result = merge(failing, other, args=["--pafot-save=none"])
    result.stdout.fnmatch_lines(["to merge (--pafot-save=none): *", "  1 saved scenario from other folders added, *"])
    assert corpus(failing) == {}


def test_corpora_of_several_folders_need_their_parent_folder(project):
    fails = "@pafot.search(SHORT, stop_after=1)\ndef test_fails(run):\n    assert run.duration < 1\n"
    for folder in ("a", "b"):
        project.write(fails, name=f"{folder}/test_it")
    project.run("a/test_it.py")
    there = project.path / "there"
    shutil.copytree(project.path / "a" / "pafot_corpus", there / "a" / "pafot_corpus")
    shutil.rmtree(project.path / "a" / "pafot_corpus")
    both = merge(project, there / "a" / "pafot_corpus", args=["--import-mode=importlib"])
    both.stdout.fnmatch_lines(
        ["not merged: *: it matches a/test_it.py::* and b/test_it.py::*; give the folder above it"]
    )
    merge(project, there, args=["--import-mode=importlib"]).assert_outcomes(passed=2)
    assert len(list((project.path / "a").rglob("*.pafot.yaml"))) == 1


def test_a_folder_that_is_none_is_refused(failing):
    result = merge(failing, "nowhere")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*--pafot-merge: expected the folder of a corpus, received *, which is no folder"])


def test_a_finding_without_its_file_fails_the_merge(failing, other):
    """Otherwise a job that keeps only the results of a machine would lose what the machine has found."""
    (failing.path / "results").mkdir()
    failing.run(UNSHRUNK, "--pafot-json=results/pafot.json")
    shutil.rmtree(failing.path / "pafot_corpus")
    result = merge(failing, "results")
    result.assert_outcomes(passed=1, errors=1)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["*pafot_corpus/test_it/*.pafot.yaml: results/pafot.json names it as a new finding;*"])
    assert merge(failing, "results", other).ret == pytest.ExitCode.OK
