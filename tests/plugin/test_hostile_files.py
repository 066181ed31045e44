"""Texts in a malicious file, its name, its folder or a crash record have no effect on readers of the output."""

import json
import os
import re
import sys
from dataclasses import replace
from datetime import date
from xml.etree import ElementTree

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import text_of
from tests.helpers.hostile import WORST, obeyed

TEST = """
import pathlib

@pafot.search(SHORT)  # stop_after=1
def test_fails(run):
    quoted = pathlib.Path("quoted.txt").read_text(encoding="utf-8")
    if quoted.startswith("skip"):
        pytest.skip(quoted)
    assert run.duration < 1, quoted
"""


def write_hostile(project):
    """Write every kind of file whose texts, keys or names a session may display, next to the file of a search."""
    path, finding = project.only_file, load(project.only_file)
    expect = replace(
        finding.expect, failure=WORST, assertion=WORST, message=WORST, traceback=WORST, against=WORST,
    )  # fmt: skip
    found = replace(finding.found, algorithm=WORST, versions={WORST: WORST, "pytest-pafot": WORST})
    texts = replace(finding, test=WORST, expect=expect, found=found)
    world = dict(finding.world)
    files = {
        "texts": text_of(texts),
        "accepted": text_of(replace(texts, xfail=WORST, xfail_until=date(2027, 1, 31))),
        "over": text_of(replace(texts, xfail=WORST, xfail_until=date(2020, 1, 1))),
        "flaky": text_of(replace(texts, flaky=WORST)),
        "kind": text_of(replace(finding, world=world | {"kind": WORST})),
        "value": text_of(replace(finding, world=world | {"lanes": WORST})),
        "nested": text_of(replace(finding, world=world | {"limits": {WORST[:60]: WORST}})),
        "key": text_of(finding) + f"{json.dumps(WORST)}: 1\n",
        "scalar": json.dumps(WORST),
        f"name {WORST}": text_of(texts),
    }
    for name, text in files.items():
        path.with_name(f"{name}.pafot.yaml").write_text(text, encoding="utf-8")
    # an orphan, and a stray file
    for folder in (path.parent.with_name(f"gone {WORST}"), path.parents[1]):
        folder.mkdir(exist_ok=True)
        (folder / f"other {WORST}.pafot.yaml").write_text(files["texts"], encoding="utf-8")
    project.leave_behind(WORST)
    project.leave_behind("test_it.py::test_fails", world={"kind": WORST})
    return len(files) + 1  # with the saved one; the crash only has a note


def test_hostile_files_put_no_control_codes_into_output(saved, monkeypatch):
    saved.write(TEST)
    (saved.path / "quoted.txt").write_text(WORST, encoding="utf-8", newline="")
    count = write_hostile(saved)
    monkeypatch.setenv("CI", "1")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(saved.path / "summary.md"))
    outputs = ["--junitxml=junit.xml", "--pafot-report=page.html", "--pafot-json=pafot.json"]
    result = saved.run(*outputs, "-rA", "-v", "-l", "--color=no", runs=0)
    assert not result.errlines
    assert obeyed(result.stdout.str()) == []
    assert r"\x1b]0;T\x07" in result.stdout.str()
    for tag in ("xfail", "FAILED", "not run", "warning", "problem: "):
        assert tag in result.stdout.str(), tag
    for name in ("junit.xml", "summary.md", "page.html", "pafot.json"):
        assert obeyed((saved.path / name).read_text(encoding="utf-8")) == [], name
    markup = re.sub(r"(`+).*?\1(?!`)", "", (saved.path / "summary.md").read_text())  # without code
    assert not re.search(r"<(?!br>|/?span>)|(?<!\\)\||@(?!&#8203;)|\$(?!</span>)", markup)
    assert "<img" not in (saved.path / "page.html").read_text()
    ElementTree.parse(saved.path / "junit.xml")
    records = {record.id: record for record in saved.record.findings}
    assert len(records) == count
    assert records[f"name {WORST}"].file.endswith(f"{WORST}.pafot.yaml")
    assert records["accepted"].xfail == {"reason": WORST, "until": "2027-01-31"}
    # files without differences by style
    for name in ("accepted", "over", "flaky", "value", "nested", "key", "scalar"):
        next(saved.path.glob(f"pafot_corpus/*/*/{name}.pafot.yaml")).unlink()
    for style in ("native", "line", "long", "--full-trace"):
        options = ["-vv", style] if style.startswith("-") else [f"--tb={style}"]
        assert obeyed(saved.run(*options, "-l", "--color=no", runs=0).stdout.str()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="names are text on other systems")
@pytest.mark.processes
def test_workers_accept_file_names_that_are_not_text(saved):
    """The names are those of an item's file and of a test that is gone: a worker unable to send them never ended."""
    saved.write("@pafot.search(SHORT)\ndef test_fails(run):\n    pass\n")
    (test,) = saved.path.glob("pafot_corpus/*/*")
    for folder in (test, test.with_name(os.fsdecode(b"\xffgone"))):
        folder.mkdir(exist_ok=True)
        (folder / os.fsdecode(b"\xff.pafot.yaml")).write_text("pafot: 3\n")
    result = saved.run("-n1", "--pafot-json=pafot.json", runs=0, apart=True)
    assert "crashed" not in result.stdout.str()
    result.stdout.fnmatch_lines([r"not run: *\udcffgone/\udcff.pafot.yaml"])
    assert any(each.file.endswith("\udcff.pafot.yaml") for each in saved.record.findings)
