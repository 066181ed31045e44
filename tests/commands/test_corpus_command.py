"""The command ``python -m pytest_pafot corpus``, which lists saved scenarios without running them."""

import errno
import os
import sys
from datetime import date
from pathlib import Path

import pytest

from pytest_pafot.__main__ import main
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import write
from tests.findings.builders import plain_finding
from tests.helpers.hostile import unlisted


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, changes in (
        ("a-111111", {}),
        ("b-222222", {"xfail": "issue 12", "xfail_until": date(2027, 1, 31)}),
    ):
        write(
            tmp_path / "test_it" / "test_x" / f"{name}.pafot.yaml",
            plain_finding(id=name, **changes),
        )
    return tmp_path


@pytest.mark.parametrize("folders", [["none"], []], ids=["not there", "removed"])
def test_a_folder_that_does_not_exist_is_refused(tmp_path, monkeypatch, folders):
    if not folders and sys.platform == "win32":
        pytest.skip("Windows does not remove the current folder of a process")
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    if not folders:
        (tmp_path / "gone").rmdir()
    assert main(["corpus", "list", *folders]) == 2


def test_a_folder_that_cannot_be_listed_is_named(folder, capsys, monkeypatch):
    unlisted(monkeypatch, folder / "test_it")
    assert main(["corpus", "list", str(folder)]) == 1
    assert capsys.readouterr().err.startswith(f"corpus: {folder / 'test_it'}: ")


def test_unwritable_output_is_reported_unlike_a_closed_pipe(folder, monkeypatch, capsys):
    end, start = os.pipe()
    os.close(end)
    with os.fdopen(start, "w") as head, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", head)
        assert main(["corpus", "list", str(folder)]) == 141  # like a program that SIGPIPE has ended
    assert capsys.readouterr().err == ""
    if Path("/dev/full").exists():
        with Path("/dev/full").open("w") as full, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", full)
            assert main(["corpus", "list", str(folder)]) == 2


def accept(*ids, until="2999-01-31"):
    return main(["corpus", "accept", *ids, "--reason", "TICKET-7", "--until", until])


LINE = 'xfail: {reason: "TICKET-7", until: 2999-01-31}'


def test_accepting_a_failure_changes_one_listed_line(folder, capsys):
    file = folder / "test_it" / "test_x" / "a-111111.pafot.yaml"
    before = file.read_text().replace("scenario:", "# ours\nscenario:")
    file.write_text(before)
    assert accept("a-111111", "none", "b-222222") == 1  # despite an id that no file has
    assert file.read_text() == before.replace("# xfail: {reason, until}", LINE)
    assert all(LINE in path.read_text() for path in folder.rglob("*.pafot.yaml"))
    assert capsys.readouterr().err.startswith("corpus: none: ")
    assert accept(str(file), until="2999-02-01") == 0
    assert load(file).xfail_until == date(2999, 2, 1)
    capsys.readouterr()
    assert main(["corpus", "list", str(folder)]) == 0
    told = capsys.readouterr().out
    assert "accepted: TICKET-7, until 2999-02-01" in " ".join(told.partition("b-222222")[0].split())


def test_a_full_disk_leaves_the_file_as_it_was(folder, monkeypatch):
    file = folder / "test_it" / "test_x" / "a-111111.pafot.yaml"
    before = file.read_bytes()

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert accept("a-111111") == 1
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == sorted(file.parent.glob("*.pafot.yaml"))


def test_xfail_is_appended_but_never_replaces_several_lines(folder, capsys):
    file = folder / "test_it" / "test_x" / "a-111111.pafot.yaml"
    bare = file.read_text().replace("# xfail: {reason, until}\n", "")
    file.write_text(bare)
    assert accept("a-111111") == 0
    assert file.read_text() == f"{bare}{LINE}\n"
    over_lines = bare + "xfail:\n  {reason: x}\n"
    file.write_text(over_lines)
    assert accept("a-111111") == 1
    assert f"corpus: {file.relative_to(folder)}:" in capsys.readouterr().err
    assert file.read_text() == over_lines


@pytest.mark.parametrize("day", ["soon", "2026-01-31"])
def test_a_day_that_is_none_or_over_is_refused(folder, day):
    with pytest.raises(SystemExit, match="2"):
        accept("a-111111", until=day)


@pytest.mark.parametrize(
    "form", ["{}", "saved-{}", "test_it.py::test_x[saved-{}]", "{}.pafot.yaml"]
)
def test_an_id_is_that_which_pytest_prints(folder, form):
    assert accept(form.format("a-111111")) == 0
    accepted = [path.name for path in folder.rglob("*.pafot.yaml") if LINE in path.read_text()]
    assert accepted == ["a-111111.pafot.yaml"]


@pytest.mark.parametrize(("wrong", "fix"), [
    ("111111", "a-111111?"), ("b-222", "b-222222?"), ("other", "corpus list`"),
])  # fmt: skip
def test_an_id_that_no_file_has_is_told_with_those_like_it(folder, capsys, wrong, fix):
    # told only once
    write(folder / "test_it" / "test_y" / "a-111111.pafot.yaml", plain_finding(id="a-111111"))
    assert accept(wrong) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"corpus: {wrong}: ")
    assert error.count(fix) == 1


def test_accept_refuses_ambiguous_id_but_takes_file_path(folder):
    write(folder / "test_it" / "test_y" / "a-111111.pafot.yaml", plain_finding(id="a-111111"))
    assert accept("a-111111") == 1
    assert accept("test_it/test_y/a-111111.pafot.yaml") == 0
