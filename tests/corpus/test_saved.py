"""Saved scenarios as they are found: with a finding, or with the reason why there is none."""

from dataclasses import replace
from datetime import date

import pytest

from pytest_pafot.corpus.reader import Saved, saved_in
from pytest_pafot.corpus.writer import write
from pytest_pafot.findings.verdict import PROCESS_CRASH
from pytest_pafot.model.trace import Outcome
from tests.findings.builders import plain_finding

NAME = "front-2-1f3a9c.pafot.yaml"


def test_files_of_a_test_include_broken_ones_sorted(tmp_path):
    finding = plain_finding(id="b-2", xfail="planner issue 12", xfail_until=date(2027, 1, 31))
    write(tmp_path / "b-2.pafot.yaml", finding)
    (tmp_path / "a-1.pafot.yaml").write_text("pafot: 4")
    (tmp_path / "notes.txt").write_text("mine")
    broken, whole = saved_in(tmp_path)
    assert (whole.id, whole.finding, whole.error) == ("b-2", finding, "")
    assert whole.xfail == finding.xfail
    assert (broken.id, broken.finding, broken.xfail) == ("a-1", None, None)
    assert (broken.is_crash, broken.needs_own_process) == (False, False)
    assert broken.error.startswith(f"{tmp_path / 'a-1.pafot.yaml'}:1: pafot: ")
    assert saved_in(tmp_path / "none") == []


@pytest.mark.parametrize(("changes", "is_crash", "needs_own_process"), [
    ({}, False, False),
    ({"failure": PROCESS_CRASH, "outcome": Outcome.ADS_ERROR}, True, True),
    ({"outcome": Outcome.HANG}, False, True),
])  # fmt: skip
def test_crashes_and_hangs_need_their_own_process(tmp_path, changes, is_crash, needs_own_process):
    finding = plain_finding(expect=replace(plain_finding().expect, **changes))
    saved = Saved(path=tmp_path / NAME, finding=finding)
    assert (saved.is_crash, saved.needs_own_process) == (is_crash, needs_own_process)
