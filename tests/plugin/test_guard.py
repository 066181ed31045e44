"""A saved scenario or a marked test that a session leaves out fails it on CI, whatever left it out."""

import os
import shutil
import subprocess

import pytest

from tests.helpers.hostile import unlisted
from tests.helpers.tables import table
from tests.plugin.conftest import FAILING

ERROR = "pafot::saved_scenarios_without_a_test"
NOT_COLLECTED = "pafot::marked_tests_that_are_not_collected"
RENAMED = FAILING.replace("test_fails", "test_fails_fast").replace("run.duration < 1", "run")
FOLDER = "pafot_corpus/test_it/test_fails"

links = pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")


@pytest.fixture
def ci(monkeypatch):
    monkeypatch.setenv("CI", "true")


@pytest.fixture
def passing(saved, ci):
    """Return a project on CI whose saved scenario passes, in a folder of its own next to an ordinary test."""
    saved.write(FAILING.replace("< 1", "> 1"))
    saved.write("def test_other():\n    pass\n", name="other/test_other")
    (saved.path / "driving").mkdir()
    for name in ("test_it.py", "pafot_corpus"):
        (saved.path / name).rename(saved.path / "driving" / name)
    file = saved.only_file
    file.write_text(file.read_text().replace("test: test_it.py", "test: driving/test_it.py"))
    return saved


def replay(project, *args, **options):
    return project.run(*args, runs=0, **options)


def told(result):
    return [
        line.removeprefix("not run: ")
        for line in result.stdout.lines
        if line.startswith("not run: ")
    ]


def is_red(result):
    """Return whether a session fails by exactly one error, about saved scenarios that it left out."""
    errors = [line for line in result.stdout.lines if line.startswith(f"ERROR {ERROR} - ")]
    assert len(errors) <= 1
    return result.ret == 1 and len(errors) == 1


def is_only_told(result):
    """Return whether a session is not red for what it left out, but names it in one line."""
    return not is_red(result) and len(told(result)) == 1


DROPS = "items[:] = [item for item in items if 'fails' not in item.nodeid]"
HOOK = "\ndef pytest_collection_modifyitems(config, items):\n    "
DESELECTS = (
    "config.hook.pytest_deselected(items=[item for item in items if 'fails' in item.nodeid]); "
)
PARAMETER = "metafunc.fixturenames.append('again'); metafunc.parametrize('again', [1, 2])"
SKIPS = "if 'saved' in item.nodeid: pytest.skip('no')"


LEAVE_OUT = (
    ("testpaths", "testpaths = other", "", {}),
    ("addopts with a path", "addopts = other", "", {}),
    ("addopts with -k", "addopts = -k other", "", {}),
    ("norecursedirs", "norecursedirs = driving", "", {}),
    ("python_files", "python_files = test_other.py", "", {}),
    ("collect_ignore", "", "collect_ignore = ['driving']", {}),
    ("a hook that drops", "", HOOK + DROPS, {}),
    ("a hook that deselects", "", HOOK + DESELECTS + DROPS, {}),
    ("a hook that gives a parameter", "", f"def pytest_generate_tests(metafunc):\n    {PARAMETER}", {}),
    ("a hook that skips", "", f"def pytest_runtest_setup(item):\n    {SKIPS}", {}),
    ("a hook that skips the call", "", f"def pytest_runtest_call(item):\n    {SKIPS}", {}),
    ("a hook that runs nothing", "", "@pytest.hookimpl(tryfirst=True)\ndef pytest_runtestloop():\n    return True", {}),
    ("a skipped test", "", "", {"@pafot": "@pytest.mark.skip\n@pafot"}),
    ("a skipped module", "", "", {"import pytest\n": "import pytest\npytest.importorskip('no_such_package')\n"}),
    ("an expected failure that is not run", "", "", {"@pafot": "@pytest.mark.xfail(run=False)\n@pafot"}),
    ("a test without the mark", "", "", {"@pafot.search": "# ", "(run)": "()", "run.": "1 or "}),
    ("a renamed test", "", "", {"test_fails": "test_new"}),
    ("new parameters", "", "", {"@pafot": "@pytest.mark.parametrize('a', [1])\n@pafot", "(run)": "(run, a)"}),
    ("a class around the test", "", "", {"@pafot": "class TestIt:\n  @pafot", "def": "  def", "(run)": "(self, run)"}),
    ("a module that is gone", "", "", None),
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "settings", "conftest", "test"), LEAVE_OUT, ids=[row[0] for row in LEAVE_OUT]
)
def test_whatever_leaves_out_a_saved_scenario_fails_a_ci_session(
    passing, name, settings, conftest, test
):
    passing.pytester.makeini(f"[pytest]\n{settings}\n")
    with (passing.path / "conftest.py").open("a") as file:
        file.write(f"\n{conftest}\n")
    module, source = passing.path / "driving" / "test_it.py", ""
    if test is None:
        module.unlink()
    else:
        source = module.read_text()
        for old, new in test.items():
            source = source.replace(old, new)
        module.write_text(source)
    result = replay(passing)
    assert is_red(result) or (name == "a hook that runs nothing" and result.ret == 1)
    assert told(result) == [f"1 saved scenario: driving/{FOLDER}/{passing.only_file.name}"]
    assert not is_red(replay(passing, "--pafot-allow-orphans"))


@table("args", [
    ["other"], ["other/test_other.py::test_other"], ["--ignore=driving"], ["--ignore-glob=*ing"],
    ["--splits=3", "--group=3"],
])  # fmt: skip
def test_what_this_call_did_not_choose_is_no_failure_and_only_what_a_part_leaves_out_is_told(
    passing, args
):
    pytest.importorskip("pytest_split")
    result = replay(passing, *args, plugins=("pytest-split",))
    assert is_only_told(result) if args[0].startswith("--splits") else told(result) == []
    assert result.ret in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)


@table("args", [
    [], ["driving"], ["-k", "other"], ["-m", "not pafot"], ["--deselect", "driving/test_it.py::test_fails"],
    ["--collect-only"], ["--setup-plan"],
])  # fmt: skip
def test_saved_scenario_that_is_run_or_deselected_by_name_is_not_told(passing, args):
    result = replay(passing, *args)
    assert (result.ret, told(result)) == (0, [])


def test_a_session_that_ends_early_only_tells(passing):
    passing.write("def test_a():\n    assert 0\n", name="a/test_a")
    for args in (["-x"], ["--maxfail=1"]):
        assert is_only_told(replay(passing, *args))
    passing.write("def test_a():\n    assert 1\n", name="a/test_a")
    result = replay(passing, "--lf")
    assert is_only_told(result)
    assert result.ret == 0
    passing.write("def test_a():\n    raise KeyboardInterrupt\n", name="a/test_a")
    assert is_only_told(replay(passing, no_reraise_ctrlc=True))


def test_line_names_five_files_and_the_number_of_the_others(saved, ci):
    file = saved.only_file
    for number in range(6):
        file = file.rename(file.with_name("a-0.pafot.yaml")) if not number else file
        file.with_name(f"a-{number}.pafot.yaml").write_text(file.read_text())
    saved.write(RENAMED)
    five = ", ".join(f"{FOLDER}/a-{number}.pafot.yaml" for number in range(5))
    result = replay(saved)
    assert is_red(result)
    assert told(result) == [f"6 saved scenarios: {five} and 1 more"]


def test_every_output_has_what_a_session_left_out(saved, monkeypatch, tmp_path_factory):
    saved.write(RENAMED)
    assert is_only_told(replay(saved))
    assert is_red(replay(saved, "--pafot-strict-health"))
    summary = tmp_path_factory.mktemp("job") / "summary.md"
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(summary))
    monkeypatch.setenv("CI", "true")
    assert is_red(replay(saved, "--pafot-json=pafot.json", "--junitxml=j.xml", "-p", "junitxml"))
    (orphan,) = saved.record.orphans
    assert (orphan.folder, orphan.files, orphan.is_gone) == (FOLDER, 1, True)
    assert saved.record.exit == 1
    assert f"- `{FOLDER}`: " in summary.read_text()
    assert "<error " in (saved.path / "j.xml").read_text()
    shutil.move(saved.path / FOLDER, saved.path / f"{FOLDER}_fast")
    replay(saved).assert_outcomes(passed=1, skipped=1)


@pytest.mark.processes
def test_workers_fail_the_session_by_one_error(saved, ci):
    pytest.importorskip("xdist")
    saved.write(RENAMED)
    result = replay(saved, "-n2")
    assert is_red(result)
    assert len(told(result)) == 1
    saved.write(FAILING.replace("< 1", "> 1"))
    for args in ([], ["-k", "other"]):
        saved.write("def test_other():\n    pass\n", name="test_other")
        result = replay(saved, "-n2", *args)
        assert (result.ret, told(result)) == (0, [])


REPEATS = """
def pytest_generate_tests(metafunc):
    metafunc.fixturenames.append("__number")
    metafunc.parametrize("__number", range(2), ids=lambda number: f"{number + 1}-2")
"""


def test_plugins_that_repeat_tests_repeat_replays_and_searches(saved, ci):
    with (saved.path / "conftest.py").open("a") as file:
        file.write(REPEATS)
    result = replay(saved)
    result.assert_outcomes(failed=2, skipped=2)
    assert told(result) == []
    saved.forget()
    saved.run()
    assert saved.only_file.parent == saved.path / FOLDER


def test_rootdir_may_be_elsewhere(passing, tmp_path_factory):
    rootdir = f"--rootdir={tmp_path_factory.mktemp('elsewhere')}"
    assert (replay(passing, rootdir).ret, told(replay(passing, rootdir))) == (0, [])
    (passing.path / "driving" / "test_it.py").unlink()
    result = replay(passing, rootdir)
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines([f"ERROR *{ERROR} - *"])


@pytest.mark.parametrize(("folder", "file"), [
    ("vendor/planner", None), ("node_modules/planner", None), ("venv", "pyvenv.cfg"), ("planner", ".git"),
    ("planner", "setup.py"),
])  # fmt: skip
def test_saved_scenarios_of_other_projects_are_not_meant(passing, folder, file):
    passing.pytester.makeini("[pytest]\ntestpaths = other\n")
    home = passing.path / folder / "driving"
    home.parent.mkdir(parents=True)
    (passing.path / "driving").rename(home)
    if file:
        (passing.path / folder / file).write_text("")
    result = replay(passing)
    assert (result.ret, told(result)) == (0, [])
    if file == "setup.py":
        home.rename(passing.path / "driving")
        assert is_red(replay(passing))


def test_copies_of_saved_scenarios_that_are_run_are_not_meant(passing):
    shutil.copytree(passing.path / "driving", passing.path / "build" / "lib" / "driving")
    shutil.copytree(passing.path / "driving" / "pafot_corpus", passing.path / "docs")
    result = replay(passing)
    assert (result.ret, told(result)) == (0, [])
    shutil.rmtree(passing.path / "driving" / "pafot_corpus")
    result = replay(passing)
    assert is_red(result)
    assert told(result)[0].startswith("2 saved scenarios: build/lib/driving/pafot_corpus/")


def test_each_of_several_corpora_has_to_be_run(passing):
    other = passing.path / "my other"
    shutil.copytree(passing.path / "driving", other)
    (other / "test_it.py").rename(other / "test_that.py")
    (other / "pafot_corpus/test_it").rename(other / "pafot_corpus/test_that")
    file = next(other.rglob("*.pafot.yaml"))
    text = file.read_text()
    file.write_text(text.replace("test: driving/test_it.py", "test: my other/test_that.py"))
    replay(passing).assert_outcomes(passed=3, skipped=2)
    passing.pytester.makeini("[pytest]\ntestpaths = driving\n")
    result = replay(passing)
    assert is_red(result)
    assert told(result) == [f"1 saved scenario: {file.relative_to(passing.path).as_posix()}"]


def test_given_saved_scenario_is_run_and_the_others_are_not_told(saved, ci):
    saved.write(FAILING.replace("< 1", "> 1"))
    name = f"{FOLDER}/{saved.only_file.name}"
    for copy in (None, saved.path / FOLDER / "a-0.pafot.yaml"):
        if copy is not None:
            shutil.copy(saved.only_file, copy)
        result = replay(saved, name)
        assert (result.ret, told(result)) == (0, [])


def test_rerunning_failures_knows_no_error_of_the_session(saved, ci):
    saved.write("def test_ordinary():\n    pass\n")
    shutil.rmtree(saved.path / ".pytest_cache")
    assert is_red(replay(saved))
    replay(saved, "--lf").stdout.no_fnmatch_line("*known failure*")


SUFFIXES = (
    ".pafot.yml",
    ".yml",
    ".yaml",
    ".PAFOT.YAML",
    ".pafot.Yml",
    ".pafot.yaml.gz",
    ".pafot.yaml.dvc",
)
PLACES = (
    f"{FOLDER}/deeper/still/a.pafot.yaml", "pafot_corpus/test_it/a.pafot.yaml", "pafot_corpus/a.pafot.yaml",
    "a.pafot.yaml", f"pafot_corpus/{FOLDER}/a.pafot.yaml", *(f"{FOLDER}/a{suffix}" for suffix in SUFFIXES),
    "A.Pafot.Yaml",
)  # fmt: skip


def test_a_file_that_no_test_can_replay_fails_a_ci_session(saved, ci):
    file = saved.only_file
    for place in PLACES:
        target = saved.path / place
        target.parent.mkdir(parents=True, exist_ok=True)
        file = file.rename(target)
        result = replay(saved)
        assert (is_red(result), told(result)) == (True, [f"1 saved scenario: {place}"])


def test_corpus_that_the_option_does_not_name_fails_a_ci_session(saved, ci):
    assert is_red(replay(saved, "--pafot-corpus=findings"))
    (saved.path / "pafot_corpus").rename(saved.path / "saved")
    assert is_red(replay(saved))
    moved = next(saved.path.rglob("*.pafot.yaml"))
    text = moved.read_text()
    for other in ("test_example.py", "a\0b.py", f"{'x' * 5000}.py"):
        moved.write_text(text.replace("test: test_it.py", f"test: {other}"))
        assert replay(saved).ret == 0, "not of this project"


@pytest.mark.parametrize(("name", "is_lost"), [
    ("a.pafot.yaml.txt", True), ("a.pafot.yaml.orig", True), (".a.pafot.yaml.swp", True), ("a.txt", False),
])  # fmt: skip
def test_longer_suffix_is_named_unless_it_is_a_backup(saved, ci, name, is_lost):
    file = saved.only_file.rename(saved.only_file.with_name(name))
    assert is_red(replay(saved)) == is_lost
    shutil.copy(file, file.with_name("a.pafot.yaml"))
    assert not is_red(replay(saved))


def test_a_shared_corpus_may_have_fewer_folders_above_it_than_the_tests(saved, ci):
    deep, shared = saved.path / "a" / "b" / "c", saved.path / "all"
    deep.mkdir(parents=True)
    (saved.path / "test_it.py").rename(deep / "test_it.py")
    shutil.copytree(saved.path / "pafot_corpus", shared / "a" / "b" / "c")
    shutil.rmtree(saved.path / "pafot_corpus")
    replay(saved, f"--pafot-corpus={shared}").assert_outcomes(failed=1, skipped=1)


def test_a_shared_corpus_outside_of_the_project_does_not_lose_a_folder_of_tests(
    saved, ci, tmp_path_factory
):
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
@pafot.search(SHORT)
def never_at_fault(run): pass

@pafot.search(SHORT)
class Safety:
    def test_it(self, run): pass

class SafetySuite:
    @pafot.search(SHORT)
    def test_it(self, run): pass

class TestIt:
    @pafot.search(SHORT)
    def drives(self, run): pass

@pafot.search(SHORT)
class TestEmpty:
    def check_it(self, run): pass

class TestConstructed:
    def __init__(self): pass

    @pafot.search(SHORT)
    def test_it(self, run): pass

@pafot.search(SHORT)
def test_twice(run):
    assert not run

def test_twice(): pass

if pytest:
    @pafot.search(SHORT)
    def test_once(run): pass
else:
    def test_once(): pass
"""
IN_CONFTEST = """
import pytest_pafot as pafot

@pafot.search
def test_in_conftest(run):
    assert not run
"""
COLLECTED = """
from shared import test_shared, Shared

@pafot.search(SHORT)
def never(run): pass

test_never = never

@pafot.search(SHORT)
class Base:
    def test_it(self, run): pass

class TestDerived(Base): pass

class TestShared(Shared): pass

@pafot.search(SHORT)
class Helper:
    __test__ = False

class Meta(type):
    pytestmark = pytest.mark.skip

def drives(run): pass
"""
SHARED = """
@pafot.search(SHORT)
def test_shared(run): pass

class Shared:
    @pafot.search(SHORT)
    def test_it(self, run): pass
"""


def test_marked_tests_that_pytest_leaves_out_fail_a_ci_session(project, monkeypatch):
    project.write(LEFT_OUT)
    project.write(COLLECTED, name="test_collected")
    project.write(SHARED, name="shared")
    project.write(
        "from test_it import never_at_fault, Safety\n\ndef test_other():\n    pass\n",
        name="test_other",
    )
    conftest = project.path / "conftest.py"
    conftest.write_text(conftest.read_text() + IN_CONFTEST)
    no_warning = "-Wignore::pytest.PytestCollectionWarning"
    names = (
        "Safety",
        "SafetySuite::test_it",
        "TestConstructed::test_it",
        "TestEmpty",
        "TestIt::drives",
    )
    names = [f"test_it.py::{name}" for name in (*names, "never_at_fault", "test_twice")]
    for args in ([], ["-k", "other"]):
        result = replay(project, no_warning, *args)
        left_out = [line.partition(": ")[0] for line in told(result)]
        assert (result.ret, left_out) == (0, ["conftest.py::test_in_conftest", *names])
    monkeypatch.setenv("CI", "true")
    result = replay(project, no_warning, "--pafot-allow-orphans")
    assert result.ret == 1
    result.stdout.fnmatch_lines([f"ERROR {NOT_COLLECTED} - * 8 *"])
    assert replay(project, no_warning, "test_it.py::test_once").ret == 0  # a narrower choice


@pytest.mark.parametrize("folder", ["build", ".hidden", "a/b/c/d/e/f"])
def test_saved_scenario_in_a_folder_that_pytest_passes_by_fails_a_ci_session(passing, folder):
    (passing.path / folder).mkdir(parents=True)
    (passing.path / "driving").rename(passing.path / folder / "driving")
    passing.pytester.makeini("[pytest]\nnorecursedirs = .* build d\n")
    for args in ([], ["."]):
        assert is_red(replay(passing, *args))


@pytest.mark.parametrize(
    "archive", ["pafot_corpus.dvc", "pafot_corpus/test_it.zip", f"{FOLDER}.tar.gz"]
)
def test_saved_scenarios_that_are_still_in_an_archive_fail_a_ci_session(saved, ci, archive):
    saved.path.joinpath(archive).write_text("")
    assert not is_red(replay(saved))  # The files are there, too.
    shutil.rmtree(saved.path / archive.partition(".")[0])
    result = replay(saved)
    assert (is_red(result), told(result)) == (True, [f"1 saved scenario: {archive}"])


def test_saved_scenarios_that_a_checkout_leaves_out_fail_a_ci_session(saved, ci):
    def git(*arguments, folder=saved.path):
        subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True)

    git("init", "-q")
    git("add", "-A")
    git("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "x")
    file = saved.only_file.relative_to(saved.path).as_posix()
    git("sparse-checkout", "set", "--no-cone", "/*", "!pafot_corpus")
    result = replay(saved)
    assert (is_red(result), told(result)) == (True, [f"1 saved scenario: {file}"])
    git("rm", "-q", "--cached", "--sparse", file)
    assert replay(saved).ret == 0
    git("update-index", "--add", "--cacheinfo", f"160000,{'1' * 40},pafot_corpus")  # a submodule
    (saved.path / "pafot_corpus").mkdir()
    result = replay(saved)
    assert (is_red(result), told(result)) == (True, ["1 saved scenario: pafot_corpus"])


def test_what_is_no_folder_of_saved_scenarios_fails_a_ci_session(saved, ci, monkeypatch):
    for place in (FOLDER, "pafot_corpus/test_it", "pafot_corpus"):
        with monkeypatch.context() as patch:
            unlisted(patch, saved.path / place)
            assert is_red(replay(saved))
    for place in (FOLDER, "pafot_corpus/test_it", "pafot_corpus"):
        shutil.rmtree(saved.path / place)
        # so git writes a link, where it may not make links
        (saved.path / place).write_text("../elsewhere")
        result = replay(saved)
        assert (is_red(result), told(result)) == (True, [f"1 saved scenario: {place}"])
        (saved.path / place).unlink()
        (saved.path / place).mkdir()


def test_corpus_on_the_command_line_is_replayed(saved):
    saved.write("def test_unit():\n    pass\n", name="test_unit")
    for given in ("pafot_corpus", "pafot_corpus/test_it", FOLDER):
        replay(saved, given).assert_outcomes(failed=1)
        replay(saved, given, "test_unit.py").assert_outcomes(failed=1, passed=1)


def test_walk_ends_after_some_folders_and_says_so(saved, ci, monkeypatch):
    monkeypatch.setattr("pytest_pafot.plugin.guard.MAX_FOLDERS", 1)
    result = replay(saved)
    result.stdout.fnmatch_lines(["*problem: * 1 folders"])
