"""Links from a pull request: nothing behind them is displayed, written or removed."""

import os
import shutil

import pytest

from tests.plugin.conftest import labels

pytestmark = pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")

SECRET = "machine github.com login bot password HUSH\n"


@pytest.fixture
def elsewhere(tmp_path_factory):
    """Return a folder outside the project, with a secret and files that a search would clean up."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / ".netrc").write_text(SECRET)
    (folder / ".pafot-1-00.tmp").write_text("not a file of a search")
    return folder


def all_in(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def test_links_out_of_corpus_fail_and_show_nothing(failing, elsewhere):
    (failing.path / ".env").write_text("TOKEN=HUSH\n")
    failing.run_once()
    folder = failing.only_file.parent
    os.mkfifo(elsewhere / "pipe")
    inside = (elsewhere / name for name in (".netrc", "pipe", "none"))
    targets = [*inside, failing.path / ".env", "/dev/zero", "/proc"]
    for number, target in enumerate([*targets, "l-6.pafot.yaml"]):
        (folder / f"l-{number}.pafot.yaml").symlink_to(target)
    (failing.path / "stray.pafot.yaml").symlink_to(elsewhere / ".netrc")
    (folder.parent / "test_gone").symlink_to(elsewhere)
    (folder.parent / "test_gone~0").symlink_to("/root")
    before = all_in(elsewhere)
    result = failing.run("-rA", "--junitxml=junit.xml", "--pafot-json=out.json", "--showlocals")
    result.assert_outcomes(failed=8, passed=1)
    shown = (
        result.stdout.str()
        + (failing.path / "junit.xml").read_text()
        + (failing.path / "out.json").read_text()
    )
    assert "HUSH" not in shown
    for number in range(6):
        result.stdout.fnmatch_lines([f"{folder / f'l-{number}.pafot.yaml'}: *"])
    assert all_in(elsewhere) == before
    assert (folder / "l-0.pafot.yaml").is_symlink()
    failing.run(folder / "l-0.pafot.yaml").assert_outcomes(failed=1)
    # it leads to itself
    assert failing.run(folder / "l-6.pafot.yaml").ret == pytest.ExitCode.USAGE_ERROR
    (failing.path / "round").symlink_to("round")
    assert failing.run("round").ret == pytest.ExitCode.USAGE_ERROR


def test_overlong_links_and_names_do_not_end_session(failing):
    failing.run()
    file = failing.only_file
    folder, module, corpus = file.parents[:3]
    # too long for a file's name with .py
    for gone in (module / "test_gone", corpus / ("m" * 254) / "test_gone"):
        gone.mkdir(parents=True)
        shutil.copy(file, gone)
    for link in (
        folder / "a.pafot.yaml",
        module / "test_gone" / "folder",
        module / "test_linked",
        corpus / "linked",
    ):
        link.symlink_to("x" * 300)
    result = failing.run(runs=0)
    result.assert_outcomes(failed=2, skipped=1)
    result.stdout.fnmatch_lines([f"{folder / 'a.pafot.yaml'}: *"])


@pytest.mark.parametrize("level", [0, 1, 2])
def test_search_changes_nothing_behind_a_linked_folder(failing, elsewhere, level):
    """The link replaces the test's folder, the module's or the corpus."""
    failing.run_once()
    file = failing.only_file
    folder = file.parents[level]
    shutil.move(folder, elsewhere / folder.name)
    shutil.copy(elsewhere / ".pafot-1-00.tmp", elsewhere / file.parent.relative_to(folder.parent))
    folder.symlink_to(elsewhere / folder.name)
    before = all_in(elsewhere)
    result = failing.run(seed=2)
    result.assert_outcomes(failed=2)
    assert str(folder) in result.stdout.str()
    failing.run("--pafot-save=none", seed=2)
    failing.run(runs=0)
    assert all_in(elsewhere) == before


def test_link_within_project_is_read_but_not_written(failing):
    failing.run_once()
    id_, corpus = failing.only_id, failing.path / "pafot_corpus"
    corpus.rename(failing.path / "shared")
    corpus.symlink_to("shared")
    before = all_in(failing.path / "shared")
    result = failing.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    assert f"saved-{id_}" in result.stdout.str()
    assert labels(result) == "1 still failing"
    assert str(corpus) in failing.run(seed=2).stdout.str()
    assert all_in(failing.path / "shared") == before


def test_corpus_given_by_absolute_path_may_be_link(failing, elsewhere):
    (failing.path / "link").symlink_to(elsewhere)
    failing.run("--pafot-corpus", failing.path / "link")
    assert len(list(elsewhere.glob("test_it/test_fails/*.pafot.yaml"))) == 1
    failing.run("--pafot-corpus", failing.path / "link", runs=0).assert_outcomes(
        failed=1, skipped=1
    )


def test_relative_output_is_not_written_through_linked_folder(failing, elsewhere):
    (elsewhere / "o.json").write_text("KEEP")
    (failing.path / "out").symlink_to(elsewhere)
    before = all_in(elsewhere)
    result = failing.run("--pafot-report=out/page.html", "--pafot-json=out/o.json")
    for output in ("--pafot-report=out/page.html", "--pafot-json=out/o.json"):
        result.stdout.fnmatch_lines_random([f"*problem: {output}: *{failing.path / 'out'}*"])
    assert all_in(elsewhere) == before
    failing.run(f"--pafot-json={failing.path / 'out' / 'o.json'}")
    assert all_in(elsewhere) != before


def test_corpus_link_out_of_project_is_not_listed(project, elsewhere):
    project.write("@pafot.search(SHORT)\ndef test_lives(run):\n    pass\n")
    (elsewhere / "secret_name").mkdir()
    (elsewhere / "secret_name" / "a.pafot.yaml").write_text("")
    corpus = project.path / "pafot_corpus"
    corpus.symlink_to(elsewhere.parent)
    result = project.run(runs=0)
    result.stdout.fnmatch_lines([f"*problem: *{corpus}*"])
    assert "secret_name" not in result.stdout.str()
