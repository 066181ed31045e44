"""``python -m pytest_pafot corpus``: which saved scenarios there are, without running them."""

import json
import os
import sys
from datetime import date
from pathlib import Path

import pytest

from pytest_pafot.__main__ import main
from pytest_pafot.corpus.writer import write
from tests.findings.builders import plain_finding


@pytest.fixture
def folder(tmp_path):
    for name, changes in (("a-111111", {}), ("b-222222", {"xfail": "issue 12", "xfail_until": date(2027, 1, 31)})):
        write(tmp_path / "test_it" / "test_x" / f"{name}.pafot.yaml", plain_finding(id=name, **changes))
    return tmp_path


def test_the_list_has_a_line_for_each_file(folder, capsys):
    assert main(["corpus", "list", str(folder)]) == 0
    one, other = capsys.readouterr().out.splitlines()
    assert "a-111111.pafot.yaml: collision at " in one
    assert other.endswith(", xfail: issue 12, xfail until: 2027-01-31")


def test_the_list_for_programs_says_the_same_and_each_file_once(folder, capsys):
    assert main(["corpus", "list", "--json", str(folder), str(folder / "test_it")]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["id"], row["xfail"]) for row in rows] == [("a-111111", None), ("b-222222", "issue 12")]


def test_a_file_that_cannot_be_read_is_told_and_counted_and_the_exit_code_is_1(folder, capsys):
    (folder / "test_it" / "test_x" / "c.pafot.yaml").write_text("pafot: 99\n")
    assert main(["corpus", "stats", "--json", str(folder)]) == 1
    counts = json.loads(capsys.readouterr().out)
    assert (counts["files"], counts["broken"], counts["xfail"]) == (3, 1, 1)
    assert counts["kind"] == {plain_finding().signature.slug: 2}
    assert main(["corpus", "stats", str(folder)]) == 1
    assert capsys.readouterr().out.startswith("3 saved scenarios, 1 broken, 1 xfail\n")


def test_a_folder_that_does_not_exist_is_refused(tmp_path, capsys):
    assert main(["corpus", "list", str(tmp_path / "none")]) == 2
    assert "corpus: expected a folder, received" in capsys.readouterr().err


def test_an_output_that_cannot_be_written_is_a_line_and_one_that_has_read_enough_is_none(folder, monkeypatch, capsys):
    end, start = os.pipe()
    os.close(end)
    with os.fdopen(start, "w") as head, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", head)
        assert main(["corpus", "list", str(folder)]) == 141  # as of a program that SIGPIPE has ended
    assert capsys.readouterr().err == ""
    if Path("/dev/full").exists():
        with Path("/dev/full").open("w") as full, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", full)
            assert main(["corpus", "list", str(folder)]) == 2
        assert capsys.readouterr().err == (
            "corpus: expected a standard output that can be written, received No space left on device; "
            "free some space on the disk, or send it to another place\n"
        )
