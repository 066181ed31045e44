"""Saved scenarios whose test is gone fail a CI session, once and with the way out; nothing else does."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.helpers.hostile import unlisted
from tests.helpers.tables import table
from tests.plugin.conftest import FAILING

ERROR = "pafot::saved_scenarios_without_a_test"

RENAMED = FAILING.replace("test_fails", "test_fails_fast").replace("run.duration < 1", "run")
FOLDER = "pafot_corpus/test_it/test_fails"


@pytest.fixture
def ci(monkeypatch):
    monkeypatch.setenv("CI", "true")


links = pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")


def replay(project, *args):
    return project.run(*args, generations=0)


def is_red(result):
    """Return whether a session fails by exactly one error, about tests that are gone."""
    errors = [line for line in result.stdout.lines if line.startswith(f"ERROR {ERROR} - ")]
    assert len(errors) <= 1
    return result.ret == 1 and len(errors) == 1


ADVICE = (
    "if the test has another name or place now, move the files to its folder MODULE/TEST in the corpus, and name it in "
    "their line `test:`; else delete them"
)


def test_a_file_without_any_test_fails_a_ci_session(saved, ci):
    saved.write("")
    saved.path.joinpath("test_other.py").write_text("def test_other():\n    pass\n")
    result = saved.run(generations=None, seed=None)  # without an option, it reports only what it has collected
    assert is_red(result)
    result.stdout.re_match_lines([r"test_other\.py \.E +\[100%\]"])  # on the line of results
    saved.write("raise OSError")
    result = replay(saved)
    assert (result.ret, "orphaned" in result.stdout.str()) == (2, False)


def test_a_renamed_test_fails_only_a_strict_session(saved, monkeypatch, tmp_path_factory):
    name = saved.only_file.name
    saved.write(RENAMED)
    result = replay(saved)
    assert result.ret == 0
    result.stdout.fnmatch_lines(
        [
            f"orphaned: 1 saved scenario without a test in {FOLDER}",
            f"  {name}: expected the test *",
            "*; else delete them",
        ]
    )
    assert is_red(replay(saved, "--pafot-strict-health"))
    summary = tmp_path_factory.mktemp("job") / "summary.md"
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    monkeypatch.setenv("CI", "true")
    result = replay(saved, "--pafot-json=p.json", "--junitxml=j.xml", "-p", "junitxml")
    assert is_red(result)
    expected = (
        "expected the test test_it.py::test_fails, received test_it.py without this search: it was renamed, moved or "
        "deleted"
    )
    result.stdout.fnmatch_lines(
        [
            f"*ERROR at setup of {ERROR.partition('::')[2]} *",
            "the test of 1 saved scenario is gone (CI is set; --pafot-allow-orphans lets it pass):",
            f"{FOLDER}/{name}",
            f"  {expected}",
            f"  {ADVICE}",
        ]
    )
    told = json.loads((saved.path / "p.json").read_text())
    orphan = {"folder": FOLDER, "files": 1, "expected": expected, "way_out": ADVICE, "is_gone": True}
    assert (told["exit"], told["orphans"]) == (1, [orphan])
    assert "**Saved scenarios whose test is gone**" in summary.read_text()
    assert '<error message="failed on setup with &quot;the test of 1 saved' in (saved.path / "j.xml").read_text()
    shutil.move(saved.path / FOLDER, saved.path / f"{FOLDER}_fast")
    replay(saved).assert_outcomes(passed=1, skipped=1)


@pytest.mark.parametrize("depth", [0, 2])
def test_a_corpus_that_cannot_be_listed_is_not_taken_for_an_empty_one(saved, ci, monkeypatch, depth):
    place = Path(FOLDER).parts[: depth + 1]
    unlisted(monkeypatch, saved.path.joinpath(*place))
    result = replay(saved)
    assert is_red(result)
    result.stdout.fnmatch_lines(
        [f"not run: {'/'.join(place)}: expected a folder that can be listed, received Permission denied; let*"]
    )


def test_what_lets_a_session_pass_all_the_same(saved, ci, monkeypatch):
    saved.write(RENAMED)
    for args in (["--pafot-allow-orphans"], ["-o", "pafot_allow_orphans=true"], ["--collect-only"]):
        assert replay(saved, *args).ret == 0, args
    for value in ("false", ""):
        with monkeypatch.context() as patch:
            patch.setenv("CI", value)
            assert replay(saved).ret == 0


def test_deselected_tests_do_not_count_as_gone(saved, ci):
    saved.write(FAILING + "\n\ndef test_ordinary():\n    pass\n")
    for args in (["-k", "ordinary"], ["-m", "not pafot"], ["--deselect", "test_it.py::test_fails"], ["test_it.py"]):
        result = replay(saved, *args)
        assert not is_red(result), args
        assert "orphaned:" not in result.stdout.str(), args
    saved.write("def test_ordinary():\n    pass\n")
    for args in (["test_it.py"], ["test_it.py::test_ordinary"]):
        result = replay(saved, *args)
        assert result.ret == 0, args
    for args in (["-k", "ordinary"], ["-m", "not slow"], ["."]):
        assert is_red(replay(saved, *args)), args
    (saved.path / "other").mkdir()
    saved.write("def test_ordinary():\n    pass\n", name="other/test_other")
    assert replay(saved, "other").ret == 0


def test_search_that_a_hook_leaves_out_is_named_unless_pytest_counts_it(saved, ci):
    conftest = saved.path / "conftest.py"
    hook = "def pytest_collection_modifyitems(config, items):\n    {}items.clear()\n"
    conftest.write_text(hook.format("config.hook.pytest_deselected(items=list(items)); "))
    replay(saved).stdout.no_fnmatch_line("not run: *")
    conftest.write_text(hook.format(""))
    replay(saved).stdout.fnmatch_lines(["not run: test_it.py::test_fails: a hook pytest_collection_modifyitems *"])


def test_missing_module_fails_the_session_without_any_test(saved, ci):
    (saved.path / "test_it.py").unlink()
    result = replay(saved)
    assert is_red(result)
    result.stdout.fnmatch_lines(["  expected the test test_it.py::test_fails, received no file test_it.py: *"])
    result.stdout.fnmatch_lines([f"orphaned: 1 saved scenario without a test in {FOLDER}"])
    (saved.path / "tests").mkdir()
    shutil.move(saved.path / "pafot_corpus", saved.path / "tests" / "pafot_corpus")
    assert is_red(replay(saved, "tests"))
    shutil.move(saved.path / "tests" / "pafot_corpus", saved.path / "all")
    assert is_red(replay(saved, "--pafot-corpus", saved.path / "all"))


def test_moved_and_renamed_file_replays_as_its_new_test(saved, ci):
    new = FAILING.replace("test_fails", "test_new_name")
    (saved.path / "test_it.py").unlink()
    saved.write(new, name="low/test_new")
    file = saved.only_file
    assert is_red(replay(saved))
    home = saved.path / "low" / "pafot_corpus" / "test_new" / "test_new_name"
    home.mkdir(parents=True)
    text = file.read_text().replace("test: test_it.py::test_fails", "test: low/test_new.py::test_new_name")
    (home / file.name).write_text(text)
    file.unlink()
    result = replay(saved)
    result.assert_outcomes(failed=1, skipped=1)
    assert not is_red(result)
    result.stdout.no_fnmatch_line("orphaned: *")


def test_every_orphan_is_named_and_the_advice_once(saved, ci):
    name = saved.only_file.name
    other = saved.only_file.parents[1] / "test_old"
    other.mkdir()
    text = saved.only_file.read_text().replace("test_it.py::test_fails", "test_it.py::test_old")
    for each in ("a", "b"):
        (other / f"{each}.pafot.yaml").write_text(text)
    saved.write(RENAMED)
    result = replay(saved)
    assert is_red(result)
    gone = "received test_it.py without this search: it was renamed, moved or deleted"
    lines = [
        f"{FOLDER}/{name}",
        f"  expected the test test_it.py::test_fails, {gone}",
        "pafot_corpus/test_it/test_old/a.pafot.yaml",
        "pafot_corpus/test_it/test_old/b.pafot.yaml",
        f"  expected the test test_it.py::test_old, {gone}",
        f"  {ADVICE}",
    ]
    result.stdout.fnmatch_lines(lines, consecutive=True)
    (number,) = [n for n, line in enumerate(result.stdout.lines) if line.endswith("in pafot_corpus/test_it/test_old")]
    told = " ".join(line.strip() for line in result.stdout.lines[number + 1 :])
    assert told.startswith(f"a.pafot.yaml, b.pafot.yaml: expected the test test_it.py::test_old, {gone} {ADVICE} ")


def test_modules_not_imported_and_lost_parameters_are_excused(project, ci):
    source = """
class TestClass:
    @pytest.mark.parametrize("limit", ["a b", 2])
    @pafot.search(SHORT)  # stop_after=1
    def test_it(self, run, limit):
        assert not limit
"""
    project.write(source)
    project.run_once()
    assert len(project.files) == 2
    project.write(source.replace('"a b", ', ""))
    result = replay(project)
    assert not is_red(result)
    result.stdout.fnmatch_lines(["orphaned: 1 saved scenario without a test in *"])
    project.write("pytest.importorskip('nothing_of_this_name')\n" + source)
    assert replay(project).ret in (0, 5)
    project.write("import nothing_of_this_name\n" + source)
    assert not is_red(replay(project, "--continue-on-collection-errors"))
    for old in ("TestClass", "test_it"):
        project.write(source.replace(old, f"{old}_of_another_name"))
        result = replay(project)
        assert is_red(result)
        result.stdout.fnmatch_lines(["  expected the test test_it.py::TestClass::test_it[[]a b], received *"])


@links
def test_links_and_broken_files_are_reported_and_preserved(saved, ci, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "gone"
    folder = saved.only_file.parent
    shutil.move(folder, elsewhere)
    (folder.parent / "test_gone").symlink_to(elsewhere, target_is_directory=True)
    result = replay(saved)
    assert is_red(result)
    assert list(elsewhere.iterdir())
    (folder.parent / "test_gone").unlink()
    huge = f"test_{'x' * 5000}"
    for name in (f"{'y' * 200}", "a [b] c\n::error::d"):
        (folder.parent / name).mkdir()
        (folder.parent / name / "a.pafot.yaml").write_text(f"pafot: 99\ntest: test_it.py::{huge}\n")
        (folder.parent / name / "b.pafot.yaml").write_bytes(b"\xff\x00")
    result = replay(saved)
    assert is_red(result)
    output = result.stdout.str()
    assert "the test of 4 saved scenarios is gone" in output
    assert huge not in output
    assert "\n::error::" not in output
    assert len(saved.files) == 4


def test_rerunning_failures_still_reports_the_missing_test(saved, ci):
    saved.write("def test_ordinary():\n    pass\n")
    shutil.rmtree(saved.path / ".pytest_cache")
    assert is_red(replay(saved))
    result = replay(saved, "--lf")
    assert is_red(result)
    result.stdout.no_fnmatch_line("*known failure*")


def test_rerunning_failures_passes_by_tests_that_are_there(saved, ci):
    saved.write("def test_red():\n    assert 0\n", name="test_a")
    saved.write(f"{FAILING}\n\ndef test_red():\n    assert 0\n", name="test_b")
    shutil.rmtree(saved.path / ".pytest_cache")
    replay(saved, "-k", "red")
    for each in ("test_a", "test_b"):
        saved.path.joinpath(f"{each}.py").write_text(saved.path.joinpath(f"{each}.py").read_text().replace("0", "1"))
    result = replay(saved, "--lf")
    result.assert_outcomes(passed=2)
    assert result.ret == 0


@pytest.mark.processes
def test_workers_fail_the_session_by_one_error(saved, ci):
    saved.write(RENAMED)
    result = replay(saved, "-n2")
    assert is_red(result)
    assert result.stdout.str().count(f"without a test in {FOLDER}") == 1
    (saved.path / "test_it.py").unlink()
    assert is_red(replay(saved, "-n2"))


def test_two_files_of_one_failure_both_replay(saved):
    first = saved.only_file
    shutil.copy(first, first.with_name("a-000000.pafot.yaml"))
    replay(saved).assert_outcomes(failed=2, skipped=1)
    saved.write(FAILING.replace("< 1", "> 1"))
    replay(saved).assert_outcomes(passed=2, skipped=1)


PLACES = (
    "pafot_corpus/test_it/test_fails/deeper/still/a.pafot.yaml",
    "pafot_corpus/test_it/a.pafot.yaml",
    "pafot_corpus/a.pafot.yaml",
    "a.pafot.yaml",
    "pafot_corpus/pafot_corpus/test_it/test_fails/a.pafot.yaml",
    *(f"{FOLDER}/a{suffix}" for suffix in (".pafot.yml", ".yml", ".yaml", ".PAFOT.YAML", ".pafot.Yml")),
    "A.Pafot.Yaml",
)


@pytest.mark.parametrize("place", PLACES)
def test_a_file_that_no_test_can_replay_fails_a_ci_session(saved, ci, place):
    target = saved.path / place
    target.parent.mkdir(parents=True, exist_ok=True)
    saved.only_file.rename(target)
    result = replay(saved)
    assert is_red(result)
    assert sum(line.startswith(f"not run: {place}: it") for line in result.stdout.lines) == 1
    assert result.stdout.lines.count(place) == 1
    for args in (["--pafot-allow-orphans"], ["test_it.py"], ["test_it.py::test_fails"]):
        assert replay(saved, *args).ret == 0, args


LEFT_OUT = (
    ("python_files", ["-o", "python_files=test_other.py"], "", True),
    ("collect_ignore", [], "collect_ignore = ['test_it.py']", True),
    ("--ignore", ["--ignore=test_it.py"], "", False),
    ("--ignore-glob", ["--ignore-glob=*_it.py"], "", False),
)


@pytest.mark.parametrize(("why", "args", "conftest", "fails"), LEFT_OUT, ids=[row[0] for row in LEFT_OUT])
def test_saved_scenario_of_a_test_file_that_is_not_collected_is_named(saved, ci, why, args, conftest, fails):
    saved.write("def test_other():\n    pass\n", name="test_other")
    with (saved.path / "conftest.py").open("a") as file:
        file.write(f"\n{conftest}\n")
    result = replay(saved, *args)
    assert is_red(result) == fails
    assert result.ret == fails
    (line,) = [line for line in result.stdout.lines if line.startswith("not run: ")]
    assert line.startswith(f"not run: {FOLDER}/{saved.only_file.name}: ")
    assert why in result.stdout.str()
    for others in ["test_other.py"], ["--pafot-allow-orphans"], ["--collect-only"]:
        assert replay(saved, *args, *others).ret == 0, others


def test_saved_scenario_of_a_test_file_that_is_skipped_is_only_named(saved, ci):
    saved.write("def test_other():\n    pass\n", name="test_other")
    (saved.path / "test_it.py").write_text("import pytest\npytest.importorskip('no_such_package')\n")
    result = replay(saved)
    assert result.ret == 0
    result.stdout.fnmatch_lines([f"not run: {FOLDER}/*: test_it.py was skipped at import"])


def test_corpus_that_the_option_does_not_name_fails_a_ci_session(saved, ci):
    why = "the option corpus names another folder, findings; move it there, or correct the option"
    result = replay(saved, "--pafot-corpus=findings")
    assert is_red(result)
    result.stdout.fnmatch_lines([f"{FOLDER}/{saved.only_file.name}", f"  {why}"], consecutive=True)
    for args in (["test_it.py"], ["--pafot-allow-orphans"], [f"--ignore={saved.path / 'pafot_corpus'}"]):
        assert replay(saved, "--pafot-corpus=findings", *args).ret == 0, args


@pytest.mark.parametrize("name", ["corpus", "saved/old"])
def test_corpus_with_another_name_fails_a_ci_session(saved, ci, name):
    file = saved.only_file.relative_to(saved.path / "pafot_corpus")
    (saved.path / name).parent.mkdir(exist_ok=True)
    shutil.copytree(saved.path / "pafot_corpus", saved.path / name)
    assert not is_red(replay(saved)), "a copy"
    shutil.rmtree(saved.path / "pafot_corpus")
    result = replay(saved)
    assert is_red(result)
    result.stdout.fnmatch_lines([f"{name}/{file}", f"  it is in no corpus; move it to {FOLDER}, or delete it"])
    assert replay(saved, f"--ignore={name.split('/')[0]}").ret == 0
    moved = saved.path / name / file
    text = moved.read_text()
    for other in ("test_example.py", "a\0b.py", f"{'x' * 5000}.py"):
        moved.write_text(text.replace("test: test_it.py", f"test: {other}"))
        assert replay(saved).ret == 0, "not of this project"


@table(("name", "is_lost"), [
    ("a.pafot.yaml.txt", True), ("a.pafot.yaml.orig", True), (".a.pafot.yaml.swp", True), ("a.txt", False),
])  # fmt: skip
def test_longer_suffix_is_named_unless_it_is_a_backup(saved, ci, name, is_lost):
    original, text = saved.only_file, saved.only_file.read_text()
    original.unlink()
    file = original.with_name(name)
    file.write_text(text)
    result = replay(saved)
    assert is_red(result) == is_lost
    assert (f"{FOLDER}/{name}" in result.stdout.lines) == is_lost
    original.with_name("a.pafot.yaml").write_text(text)
    assert not is_red(replay(saved))
    file.unlink()
    original.with_name("a.pafot.yaml").rename(original)


UNNAMED = """
@pafot.search(SHORT)
def never_at_fault(run):
    pass

@pafot.search(SHORT)
class Safety:
    def test_it(self, run):
        pass

class TestIt:
    @pafot.search(SHORT)
    def drives(self, run):
        pass
"""
NAMED = """
@pafot.search(SHORT)
def never(run):
    pass

test_never = never

@pafot.search(SHORT)
class Base:
    def test_it(self, run):
        pass

class TestDerived(Base):
    pass

@pafot.search(SHORT)
class Helper:
    __test__ = False

class Meta(type):
    pytestmark = pytest.mark.skip

def drives(run):
    pass
"""


def test_marked_test_without_the_name_of_a_test_fails_a_ci_session(project, monkeypatch):
    project.write(UNNAMED)
    project.write(NAMED, name="test_named")
    project.write("from test_it import never_at_fault, Safety\n\ndef test_other():\n    pass\n", name="test_other")
    told = {"never_at_fault": "test_never_at_fault", "Safety": "TestSafety", "TestIt::drives": "test_drives"}
    lines = [f"test_it.py::{name}: expected a name that pytest collects, such as {why}" for name, why in told.items()]
    for args in ([], ["-k", "other"]):
        result = replay(project, *args)
        assert result.ret == 0
        assert [line for line in result.stdout.lines if line.startswith("not run: ")] == [
            f"not run: {line}" for line in sorted(lines)
        ]
    monkeypatch.setenv("CI", "true")
    result = replay(project, "--pafot-allow-orphans")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["pytest does not collect 3 tests with a mark of pafot (CI is set):"])
    result.stdout.fnmatch_lines(["ERROR pafot::marked_tests_that_are_not_collected - *"])
    result = replay(project, "-o", "python_functions=check")
    result.stdout.fnmatch_lines(["not run: *::never_at_fault: *collects, see python_functions in its settings"])


def test_a_shared_corpus_may_have_fewer_folders_above_it_than_the_tests(saved, ci):
    deep, shared = saved.path / "a" / "b" / "c", saved.path / "all"
    deep.mkdir(parents=True)
    (saved.path / "test_it.py").rename(deep / "test_it.py")
    shutil.copytree(saved.path / "pafot_corpus", shared / "a" / "b" / "c")
    shutil.rmtree(saved.path / "pafot_corpus")
    replay(saved, f"--pafot-corpus={shared}").assert_outcomes(failed=1, skipped=1)


def test_a_shared_corpus_outside_of_the_project_does_not_lose_a_folder_of_tests(saved, ci, tmp_path_factory):
    """Nothing leads there from the tests that are left."""
    shared, tests = tmp_path_factory.mktemp("shared"), saved.path / "tests"
    shutil.copytree(saved.path / "pafot_corpus", shared / "tests" / "old")
    shutil.rmtree(saved.path / "pafot_corpus")
    for name in ("new", "other"):
        (tests / name).mkdir(parents=True)
        (tests / name / f"test_{name}.py").write_text((saved.path / "test_it.py").read_text())
    (saved.path / "test_it.py").unlink()
    option = f"--pafot-corpus={shared}"
    assert is_red(replay(saved, option))
    replay(saved, option, "tests/other").assert_outcomes(skipped=1)  # it asks for no other folder
    (tests / "old").mkdir()
    (tests / "new" / "test_new.py").rename(tests / "old" / "test_it.py")
    replay(saved, option).assert_outcomes(failed=1, skipped=2)


def test_other_files_in_a_corpus_are_no_saved_scenarios(saved, ci):
    folder = saved.only_file.parent
    saved.only_file.unlink()
    for name in ("notes.yaml", "README.md", "a.pafot.yaml.bak"):
        (folder / name).write_text("about: a test\n")
    (saved.path / "settings.yaml").write_text("test: test_it.py::test_fails\n")
    result = replay(saved)
    assert result.ret == 0
    result.stdout.no_fnmatch_line("not run: *")


@pytest.mark.parametrize("values", ['["kind-slow", "kind-fast"]', "[7]"])
def test_a_test_whose_parameters_were_all_renamed_fails_a_ci_session(project, ci, values):
    source = """
@pytest.mark.parametrize("kind", ["slow", "fast"])
@pafot.search(SHORT)  # stop_after=1
def test_it(run, kind):
    assert not kind
"""
    project.write(source)
    project.run_once()
    project.write(source.replace('["slow", "fast"]', values))
    result = replay(project)
    assert is_red(result)
    result.stdout.fnmatch_lines(["  expected the test test_it.py::test_it[[]slow], * without these parameters: *"])
    assert not is_red(replay(project, "test_it.py"))


@links
def test_files_behind_links_are_searched_no_deeper_than_tests(saved, ci, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "a" / "b" / "c").mkdir(parents=True)
    (elsewhere / "a" / "b" / "c" / "a.pafot.yml").write_text("")
    saved.only_file.unlink()
    (saved.path / FOLDER / "linked").symlink_to(elsewhere, target_is_directory=True)
    (saved.path / "pafot_corpus" / "linked").symlink_to(elsewhere, target_is_directory=True)
    assert replay(saved).ret == 0


LEFT_OUT = """
class SafetySuite:
    @pafot.search(SHORT)
    def test_it(self, run):
        pass

@pafot.search(SHORT)
class TestEmpty:
    def check_it(self, run):
        pass

class TestConstructed:
    def __init__(self):
        pass

    @pafot.search(SHORT)
    def test_it(self, run):
        pass

@pafot.search(SHORT)
def test_twice(run):
    assert not run

def test_twice():
    pass

class Never:
    def __call__(self, run):
        pass

    def __repr__(self):
        return "<never>"

shared = pytest.mark.pafot_search(ads=Never)
test_marked = shared(Never())

if pytest:
    @pafot.search(SHORT)
    def test_once(run):
        pass
else:
    def test_once():
        pass
"""
DERIVED = """
from test_left_out import SafetySuite
from shared import test_shared, Shared

class TestDerived(SafetySuite):
    pass

class TestShared(Shared):
    pass
"""
SHARED = """
@pafot.search(SHORT)
def test_shared(run):
    pass

class Shared:
    @pafot.search(SHORT)
    def test_it(self, run):
        pass
"""
IN_CONFTEST = """
import pytest_pafot as pafot

@pafot.search
def test_in_conftest(run):
    assert not run
"""


def test_marked_tests_that_pytest_leaves_out_fail_a_ci_session(project, ci):
    project.write(LEFT_OUT)
    conftest = project.path / "conftest.py"
    conftest.write_text(conftest.read_text() + IN_CONFTEST)
    no_warning = "-Wignore::pytest.PytestCollectionWarning"
    result = replay(project, no_warning)
    assert result.ret == 1
    no_test = "pytest collects no test of this class; expected one without __init__ and __new__, and with test methods"
    assert [line for line in result.stdout.lines if line.startswith("not run: ")] == [
        "not run: conftest.py::test_in_conftest: pytest collects no tests from this file; move it to a test file",
        "not run: test_it.py::SafetySuite::test_it: expected a name that pytest collects, such as TestSafetySuite",
        f"not run: test_it.py::TestConstructed::test_it: {no_test}",
        f"not run: test_it.py::TestEmpty: {no_test}",
        "not run: test_it.py::test_marked: expected a function, received <never>; write a function that calls it",
        "not run: test_it.py::test_twice: line 27 replaces that of line 24",
    ]
    assert replay(project, no_warning, "test_it.py::test_once").ret == 1


def test_tests_that_others_derive_from_or_import_are_collected(project, ci):
    project.write(LEFT_OUT.partition("@pafot.search(SHORT)\nclass")[0], name="test_left_out")
    project.write(SHARED, name="shared")
    project.write(DERIVED, name="test_other")
    result = replay(project)
    result.stdout.no_fnmatch_line("not run: *")
    assert result.ret == 0


@pytest.mark.parametrize(("folder", "settings"), [("build", ""), (".hidden", ""), ("rules", "norecursedirs = rules")])
def test_saved_scenario_in_a_folder_that_pytest_passes_by_fails_a_ci_session(saved, ci, folder, settings):
    (saved.path / folder).mkdir()
    for each in ("test_it.py", "pafot_corpus"):
        (saved.path / each).rename(saved.path / folder / each)
    saved.write("def test_other():\n    pass\n", name="test_other")
    saved.pytester.makeini(f"[pytest]\n{settings}\n")
    for args in ([], ["."]):
        result = replay(saved, *args)
        assert is_red(result)
        result.stdout.fnmatch_lines([f"not run: {folder}/pafot_corpus/*did not collect {folder}/test_it.py*"])


def test_saved_scenario_outside_of_testpaths_is_named(saved, ci):
    (saved.path / "tests").mkdir()
    (saved.path / "tests" / "test_other.py").write_text("def test_other():\n    pass\n")
    saved.pytester.makeini("[pytest]\ntestpaths = tests\n")
    result = replay(saved)
    assert result.ret == 0
    result.stdout.fnmatch_lines(["not run: pafot_corpus/*: the setting testpaths leaves out test_it.py"])
    replay(saved, "tests").stdout.no_fnmatch_line("not run: *")
    (saved.path / "tests" / "a").mkdir()
    for each in ("test_it.py", "pafot_corpus"):
        (saved.path / each).rename(saved.path / "tests" / "a" / each)
    (saved.path / "tests" / "b").mkdir()
    (saved.path / "tests" / "test_other.py").rename(saved.path / "tests" / "b" / "test_other.py")
    saved.pytester.makeini("[pytest]\ntestpaths = tests/b\n")
    result = replay(saved)
    assert result.ret == 0
    result.stdout.fnmatch_lines(
        ["not run: tests/a/pafot_corpus/*: the setting testpaths leaves out tests/a/test_it.py"]
    )


def test_absolute_corpus_that_does_not_exist_is_named_in_a_session_without_a_search(saved, ci):
    corpus = saved.path / "mistyped"
    shutil.rmtree(saved.path / "pafot_corpus")
    result = replay(saved, f"--pafot-corpus={corpus}")
    assert result.ret == 0
    result.stdout.fnmatch_lines([f"not run: {corpus}: expected the folder of the option corpus, which does not exist*"])


@pytest.mark.parametrize("suffix", [".gz", ".dvc"])
def test_packed_saved_scenario_fails_a_ci_session(saved, ci, suffix):
    file = saved.only_file
    file.with_name(file.name + suffix).write_bytes(b"\x1f\x8b")
    file.unlink()
    assert is_red(replay(saved))


@pytest.mark.parametrize("archive", ["pafot_corpus.dvc", "pafot_corpus/test_it.zip", f"{FOLDER}.tar.gz"])
def test_saved_scenarios_that_are_still_in_an_archive_fail_a_ci_session(saved, ci, archive):
    place = archive.partition(".")[0]
    saved.path.joinpath(archive).write_text("")
    assert not is_red(replay(saved))  # The files are there, too.
    shutil.rmtree(saved.path / place)
    for args in ([], ["test_it.py"]):
        result = replay(saved, *args)
        assert is_red(result)
        result.stdout.fnmatch_lines([f"not run: {place}: * received only {Path(archive).name}; unpack*"])
    (saved.path / place).mkdir(parents=True)
    assert is_red(replay(saved))
    assert replay(saved, "--pafot-allow-orphans").ret == 0


@pytest.mark.parametrize("given", ["pafot_corpus", "data"])
def test_submodule_with_saved_scenarios_that_is_not_cloned_fails_a_ci_session(saved, ci, given):
    shutil.rmtree(saved.path / "pafot_corpus")
    (saved.path / given).mkdir()
    args = [f"--pafot-corpus={saved.path / 'data' / 'corpus'}"] if given == "data" else []
    saved.path.joinpath(".gitmodules").write_text('[submodule "docs"]\n\tpath = docs\n')
    assert replay(saved, *args).ret == 0
    saved.path.joinpath(".gitmodules").write_text(f'[submodule "x"]\r\n\tpath = "{given}"\r\n\turl = ../x\r\n')
    result = replay(saved, *args)
    assert is_red(result)
    result.stdout.fnmatch_lines([f"not run: {given}: expected the files of a git submodule, received none; run*"])
    (saved.path / given / "README").write_text("")
    assert replay(saved, *args).ret == 0


def test_saved_scenarios_that_a_checkout_leaves_out_fail_a_ci_session(saved, ci):
    def git(*arguments):
        subprocess.run(["git", *arguments], cwd=saved.path, check=True, capture_output=True)

    git("init", "-q")
    git("add", "-A")
    git("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "x")
    file = saved.only_file.relative_to(saved.path).as_posix()
    git("sparse-checkout", "set", "--no-cone", "/*", "!pafot_corpus")
    result = replay(saved, "test_it.py")
    assert is_red(result)
    result.stdout.fnmatch_lines([f"not run: {file}: git tracks it, but it is not in this checkout; restore it*"])
    git("rm", "-q", "--cached", "--sparse", file)
    assert replay(saved).ret == 0


@pytest.mark.parametrize("place", ["pafot_corpus", "pafot_corpus/test_it", "pafot_corpus/test_it/test_fails"])
def test_file_in_place_of_a_folder_of_saved_scenarios_fails_a_ci_session(saved, ci, place):
    shutil.rmtree(saved.path / place)
    (saved.path / place).write_text("../elsewhere")  # so git writes a link, where it may not make links
    result = replay(saved)
    assert is_red(result)
    told = "expected a folder that can be listed, received Not a directory; *"
    result.stdout.fnmatch_lines([f"not run: {place}: {told}"])


@pytest.mark.parametrize("given", ["pafot_corpus", "pafot_corpus/test_it", "pafot_corpus/test_it/test_fails"])
def test_corpus_on_the_command_line_is_replayed(saved, given):
    saved.write("def test_unit():\n    pass\n", name="test_unit")
    replay(saved, given).assert_outcomes(failed=1)
    replay(saved, given, "test_unit.py").assert_outcomes(failed=1, passed=1)
