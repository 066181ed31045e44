"""The table of ``python -m pytest_pafot corpus list``: a row for each saved scenario, and what failed below it."""

import os
import shlex
import subprocess
from dataclasses import replace
from itertools import pairwise

import pytest

from pytest_pafot.__main__ import main
from pytest_pafot.commands.corpus_command import COLUMNS
from pytest_pafot.corpus.writer import write
from pytest_pafot.report.session_record import markdown
from pytest_pafot.report.terminal import annotation_lines
from tests.findings.builders import plain_finding, sighting
from tests.report.builders import session_of


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    """Let lines be long, so that tests can compare them."""
    monkeypatch.setenv("COLUMNS", "999")


def finding(id_, test="test_it.py::test_x", more=None, **expect):
    """Return a finding; ``more`` are fields that it has itself."""
    return plain_finding(
        id=id_, test=test, expect=replace(plain_finding().expect, **expect), **(more or {})
    )


def save(root, *findings):
    for each in findings:
        write(root / "pafot_corpus" / "test_it" / "test_x" / f"{each.id}.pafot.yaml", each)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def printed(capsys, *arguments, code=0):
    assert main(["corpus", "list", *arguments]) == code
    return capsys.readouterr().out


def listed(capsys, *arguments, code=0):
    """Return the rows of a list, each as its cells by column, with what failed as ``what``."""
    head, *lines = printed(capsys, *arguments, code=code).splitlines()
    assert head.split() == list(COLUMNS)
    starts = [*map(head.index, COLUMNS), None]
    cells = [[line[start:end].strip() for start, end in pairwise(starts)] for line in lines[::2]]
    rows = [dict(zip(COLUMNS, each, strict=True)) for each in cells]
    return [row | {"what": what.strip()} for row, what in zip(rows, lines[1::2], strict=True)]


def ids(rows):
    return [row["id"] for row in rows]


def test_a_row_has_the_id_and_the_test_of_its_file(here, capsys):
    save(here, finding("a", test="test_it.py::test_x[planner-b]", assertion="run.min_ttc"))
    (row,) = listed(capsys)
    assert (row["id"], row["test"], row["since"]) == ("a", "test_x[planner-b]", "")


def git(root, *arguments):
    names = [
        "-c",
        "user.name=Ann",
        "-c",
        "user.email=ann@example.org",
        "-c",
        "init.defaultBranch=main",
    ]
    done = subprocess.run(
        ["git", "-C", root, *names, *arguments], check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


@pytest.fixture
def repository(here, monkeypatch):
    """Return a repository in which a scenario was added on one day, and another one on the next day."""
    git(here, "init", "-q")
    for day, id_ in (("2026-10-01", "a"), ("2026-10-02", "b")):
        monkeypatch.setenv("GIT_COMMITTER_DATE", f"{day}T12:00:00Z")
        save(here, finding(id_))
        git(here, "add", ".")
        git(here, "commit", "-qm", id_)
    return here


def days(rows):
    return {row["id"]: row["since"].partition(" ")[2] for row in rows}


def test_since_is_the_commit_that_added_the_file(repository, capsys, monkeypatch):
    save(repository, finding("c"))
    rows = listed(capsys)
    assert ids(rows) == ["a", "b", "c"]
    assert rows[0]["since"] == f"{git(repository, 'rev-parse', '--short', 'HEAD~1')} 2026-10-01"
    assert days(rows) == {"a": "2026-10-01", "b": "2026-10-02", "c": ""}
    git(repository, "config", "log.showSignature", "true")
    git(repository, "config", "log.showRoot", "false")
    git(repository, "config", "diff.renames", "false")
    monkeypatch.chdir("pafot_corpus")
    assert listed(capsys) == rows
    monkeypatch.chdir(repository.parent)
    assert listed(capsys, str(repository)) == rows
    assert ids(listed(capsys, str(repository), str(repository / "pafot_corpus"))) == ["a", "b", "c"]


def test_a_file_counts_from_its_renaming_and_may_have_an_odd_name(repository, capsys, monkeypatch):
    monkeypatch.setenv("GIT_COMMITTER_DATE", "2026-10-03T12:00:00Z")
    folder = repository / "pafot_corpus" / "test_it" / "test_x"
    folder.joinpath("a.pafot.yaml").rename(folder / "renamed.pafot.yaml")
    folder.joinpath("o\nd\x01.pafot.yaml").write_text("pafot: 99\n")
    git(repository, "add", ".")
    git(repository, "commit", "-qm", "rename")
    told = {"renamed": "2026-10-03", "b": "2026-10-02", "o\\nd\\x01": "2026-10-03"}
    assert days(listed(capsys, code=1)) == told


def test_since_is_empty_where_git_does_not_know_it(repository, capsys, monkeypatch, tmp_path):
    shallow = tmp_path / "shallow"
    git(repository, "clone", "-q", "--depth=1", f"file://{repository}", str(shallow))
    assert days(listed(capsys, "shallow")) == {"a": "", "b": ""}
    git(shallow, "fetch", "-q", "--unshallow")
    assert days(listed(capsys, "shallow")) == {"a": "2026-10-01", "b": "2026-10-02"}
    monkeypatch.setenv("PATH", str(tmp_path))
    assert days(listed(capsys, "pafot_corpus")) == {"a": "", "b": ""}


def test_each_repository_is_asked_for_its_own_files(repository, capsys, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    save(outside, finding("c"))
    expected = {"a": "2026-10-01", "b": "2026-10-02", "c": ""}
    assert days(listed(capsys, str(outside), ".")) == expected


def test_the_list_that_a_ci_job_names_has_the_findings(here, capsys):
    finds = [sighting(f"f{number}") for number in range(6)]
    save(here, *(each.finding for each in finds))
    said = annotation_lines(finds)[-1].partition("`")[2].removesuffix("`")
    assert f"see `{said}`\n" in markdown(session_of(seen=finds))
    assert main(shlex.split(said.removeprefix("python -m pytest_pafot"))) == 0
    told = capsys.readouterr().out
    assert all(f"\n{each.id} " in told for each in finds)


def test_texts_of_strangers_change_no_table(here, capsys):
    nasty = "=1+1|\x1b[31m\n<b>@x `y` ##[error]"
    save(here, finding("a", more={"flaky": nasty}, assertion=nasty, failure="KeyError"))
    name = "-1+1|\n\x1b[2J.pafot.yaml"
    (here / "pafot_corpus" / "test_it" / "test_x" / name).write_text("pafot: 99\n")
    assert "\x1b" not in printed(capsys, code=1)
    assert sorted(ids(listed(capsys, code=1))) == ["-1+1|\\n\\x1b[2J", "a"]


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_a_link_that_leads_out_is_broken(here, capsys, tmp_path_factory):
    secret = tmp_path_factory.mktemp("secret") / "key"
    secret.write_text("password: 1\n")
    save(here, finding("a"))
    (here / "pafot_corpus" / "test_it" / "test_x" / "b.pafot.yaml").symlink_to(secret)
    rows = listed(capsys, code=1)
    assert ids(rows) == ["a", "b"]
    assert "password" not in str(rows)


def test_the_terminal_decides_the_width(here, capsys, monkeypatch):
    save(here, finding("a"))
    monkeypatch.setenv("COLUMNS", "40")
    lines = printed(capsys).splitlines()
    assert len(lines) > 3
    assert max(map(len, lines)) <= 40
