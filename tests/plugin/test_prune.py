"""``corpus prune``: what it removes, what it must never touch; nothing in a corpus is collected."""

import errno
import os
import shlex
import shutil
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

import pytest

from pytest_pafot.commands.corpus_command import session_of
from tests.plugin.conftest import FAILING

links = pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")

BOTH = FAILING + FAILING.replace("test_fails", "test_gone")


@pytest.fixture
def orphaned(project):
    """Return a project with the saved scenarios of two tests, one of which is gone."""
    project.write(BOTH)
    project.run_once()
    project.write(FAILING)
    assert len(project.files) == 2
    return project


def gone(project):
    (file,) = [project.path / name for name in project.files if "test_gone" in name]
    return file


def prune(project, *args, write=True):
    """Run the session of the command in this process."""
    command = session_of(Namespace(what="prune", write=write, arguments=[str(each) for each in args]))
    return project.run(*command[3:], generations=None)


def left_alone(result):
    result.stdout.fnmatch_lines(
        ["orphaned: 1 saved scenario without a test in *", "  only files whose line `test:` *", "left as it is: *"]
    )
    result.stdout.no_fnmatch_line("removed: *")


def test_without_write_the_files_are_only_listed(orphaned):
    name = gone(orphaned).relative_to(orphaned.path).as_posix()
    result = prune(orphaned, write=False)
    result.stdout.fnmatch_lines(
        ["orphaned: 1 saved scenario without a test in *", "*corpus prune --write", f"would remove: {name}"]
    )
    assert result.ret == 0
    assert len(orphaned.files) == 2


def test_removed_files_are_listed_and_empty_folders_deleted(orphaned):
    file = gone(orphaned)
    result = prune(orphaned)
    result.stdout.fnmatch_lines([f"removed: {file.relative_to(orphaned.path).as_posix()}"])
    result.stdout.no_fnmatch_line("orphaned: *")
    assert result.ret == 0
    assert not file.parent.exists()
    assert len(orphaned.files) == 1
    prune(orphaned).stdout.fnmatch_lines(["nothing to remove"])


def test_nothing_is_removed_if_the_collection_failed(orphaned):
    orphaned.write("import nothing_of_this_name\n", name="test_broken")
    result = prune(orphaned)
    assert result.ret == pytest.ExitCode.INTERRUPTED
    result.stdout.no_fnmatch_line("removed: *")
    assert gone(orphaned).exists()


@pytest.mark.processes
@pytest.mark.parametrize("corpus", ["", "finds of [all]"])
def test_the_command_that_a_summary_names_removes_the_files(project, corpus):
    given = [f"--pafot-corpus={corpus}"] if corpus else []
    project.write(BOTH)
    project.run_once(*given)
    project.write(FAILING)
    told = project.run(*given, generations=0).stdout.str()
    text = " ".join(line.strip() for line in told.partition("else remove")[2].partition("with ")[2].split("\n"))
    words = shlex.split(text.split(" === ")[0].split(" = ")[0].split(" ==")[0])
    assert words[:6] == ["python", "-m", "pytest_pafot", "corpus", "prune", "--write"]
    words = words[: 6 + 2 * len(given)]
    done = subprocess.run([sys.executable, *words[1:]], cwd=project.path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "removed: " in done.stdout
    assert [name.split("/")[-2] for name in project.files] == ["test_fails"]


def test_undeletable_file_is_a_problem_with_advice(orphaned, monkeypatch):
    unlink = Path.unlink

    def refuse(path, missing_ok=False):
        if path.name.endswith(".pafot.yaml"):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", refuse)
    told = "not removed: *; the file system is read-only: mount it so that it can be written, then prune again"
    result = prune(orphaned)
    result.stdout.fnmatch_lines([f"  problem: {gone(orphaned).relative_to(orphaned.path).as_posix()}: {told}"])
    assert result.ret == pytest.ExitCode.TESTS_FAILED


@pytest.mark.processes
def test_a_session_that_asks_for_workers_removes_the_same(orphaned):
    file = gone(orphaned)
    prune(orphaned, "-n2").stdout.fnmatch_lines(["removed: *test_gone*"])
    assert not file.parent.exists()


def test_notes_beside_orphans_stay(orphaned):
    file = gone(orphaned)
    notes = file.with_name("NOTES.md")
    notes.write_text("why this happens")
    prune(orphaned).stdout.fnmatch_lines(["removed: *test_gone*"])
    assert list(file.parent.iterdir()) == [notes]
    again = prune(orphaned)
    assert "orphaned" not in again.stdout.str()
    assert notes.exists()


def test_files_naming_a_test_elsewhere_stay(orphaned):
    file = gone(orphaned)
    text = file.read_text()
    lines = ["test: test_it.py::test_other", "test: sub/test_it.py::test_gone", "", "test: 3"]
    for number, line in enumerate(lines):
        file.with_name(f"copy-{number}.pafot.yaml").write_text(text.replace("test: test_it.py::test_gone", line))
    file.unlink()
    before = orphaned.contents
    result = prune(orphaned)
    result.stdout.fnmatch_lines(
        ["orphaned: 4 saved scenarios without a test in *", "  only files whose line `test:` *", "left as it is: *"]
    )
    result.stdout.no_fnmatch_line("removed: *")
    assert orphaned.contents == before


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
def test_a_name_with_a_line_break_begins_no_line_of_its_own(orphaned):
    file = gone(orphaned)
    file.rename(file.with_name("a\nremoved: all.pafot.yaml"))
    result = prune(orphaned, write=False)
    result.stdout.fnmatch_lines(["would remove: *a\\nremoved: all.pafot.yaml"])
    result.stdout.no_fnmatch_line("removed: *")


def test_a_broken_file_that_names_the_test_goes(orphaned):
    file = gone(orphaned)
    file.write_text("pafot: 99\ntest: test_it.py::test_gone\n")
    prune(orphaned)
    assert not file.exists()


@links
@pytest.mark.parametrize("level", [0, 1, 2])
def test_nothing_behind_a_link_is_touched(orphaned, level, tmp_path_factory):
    """The link replaces the test's folder, the module's or the corpus."""
    folder = gone(orphaned).parents[level]
    elsewhere = tmp_path_factory.mktemp("elsewhere") / folder.name
    shutil.move(folder, elsewhere)
    folder.symlink_to(elsewhere, target_is_directory=True)
    before = sorted(elsewhere.rglob("*"))
    result = prune(orphaned)
    if level == 2:
        result.stdout.fnmatch_lines([f"*problem: expected a folder, received the link {folder}, *"])
    else:
        left_alone(result)
    assert sorted(elsewhere.rglob("*")) == before
    assert folder.is_symlink()


@links
def test_link_in_place_of_a_file_stays(orphaned, tmp_path_factory):
    file = gone(orphaned)
    target = tmp_path_factory.mktemp("elsewhere") / file.name
    shutil.move(file, target)
    file.symlink_to(target)
    left_alone(prune(orphaned))
    assert file.is_symlink()
    assert target.exists()


def test_files_of_another_project_in_shared_corpus_stay(orphaned, tmp_path_factory):
    """The other project's test files are not in this rootdir; scenarios of this project's removed tests go."""
    shared = tmp_path_factory.mktemp("shared")
    shutil.copytree(orphaned.path / "pafot_corpus" / "test_it", shared / "test_it")
    others = [shared / "test_b" / "test_gone", shared / "tests" / "test_it" / "test_gone"]
    file = gone(orphaned)
    for folder in others:
        module = folder.parent.relative_to(shared).as_posix()
        folder.mkdir(parents=True)
        text = file.read_text().replace("test: test_it.py", f"test: {module}.py")
        (folder / file.name).write_text(text)
    orphaned.write("def test_other():\n    pass\n", name="tests/test_other")
    result = prune(orphaned, f"--pafot-corpus={shared}")
    result.stdout.fnmatch_lines(
        ["orphaned: *", "  only files whose line `test:` *", "left as it is: *", "removed: *test_it/test_gone/*"]
    )
    assert all(any(folder.iterdir()) for folder in others)
    assert not (shared / "test_it" / "test_gone").exists()
    assert any((shared / "test_it" / "test_fails").iterdir())


def test_file_of_a_nested_project_stays(orphaned):
    """The nested project's file names its test by its own rootdir, even if collected from above."""
    nested = orphaned.path / "nested"
    nested.mkdir()
    for name in ("pafot_corpus", "test_it.py", "conftest.py"):
        shutil.move(orphaned.path / name, nested / name)
    (nested / "conftest.py").rename(orphaned.path / "conftest.py")
    left_alone(prune(orphaned))
    assert len(orphaned.files) == 2


TEST_FILE = "def test_in_the_corpus():\n    raise AssertionError\n"


@pytest.mark.parametrize("name", ["pafot_corpus", "finds", "data/finds"])
def test_test_files_in_a_corpus_are_not_collected(failing, name):
    failing.run_once("--pafot-corpus", name)
    for place in ("", "test_it", "test_it/test_fails"):
        (failing.path / name / place / "test_extra.py").write_text(TEST_FILE)
    failing.run("--pafot-corpus", name, generations=0).assert_outcomes(failed=1, skipped=1)


def test_files_in_an_absolute_corpus_are_not_collected(failing):
    corpus = failing.path / "all"
    failing.run("--pafot-corpus", corpus)
    (corpus / "test_extra.py").write_text(TEST_FILE)
    failing.run("--pafot-corpus", corpus, generations=0).assert_outcomes(failed=1, skipped=1)


@pytest.mark.parametrize("args", [(), ("pafot_corpus",), pytest.param(("-n2",), marks=pytest.mark.processes)])
def test_files_in_default_corpus_are_never_collected(project, args):
    project.write("def test_ordinary():\n    pass\n")
    project.pytester.makeini("[pytest]")
    (project.path / "pafot_corpus").mkdir()
    (project.path / "pafot_corpus" / "test_extra.py").write_text(TEST_FILE)
    assert "test_in_the_corpus" not in project.run("-v", *args).stdout.str()


@pytest.mark.parametrize("corpus", ["tests", "."])
def test_folders_of_tests_are_collected_despite_corpus_name(project, corpus):
    project.write(FAILING, name="tests/test_low")
    args = ("--pafot-corpus", corpus if corpus == "tests" else project.path)
    project.run(*args, "tests", "--pafot-shrink-rollouts=0").assert_outcomes(failed=2)
    project.run(*args, "tests", generations=0).assert_outcomes(failed=1, skipped=1)


def test_project_inside_folder_named_like_corpus_is_collected(project):
    inner = project.path / "pafot_corpus" / "planner"
    inner.mkdir(parents=True)
    (inner / "pytest.ini").write_text("[pytest]\n")
    (inner / "test_ordinary.py").write_text("def test_ordinary():\n    pass\n")
    project.run("--rootdir", inner, inner).assert_outcomes(passed=1)
