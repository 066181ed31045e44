"""The table of ``python -m pytest_pafot corpus list``: its columns, states, order and filters."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest

from pytest_pafot.__main__ import main
from pytest_pafot.commands import corpus_command
from pytest_pafot.commands.corpus_table import BELOW, COLUMNS, text_of_table
from pytest_pafot.corpus.writer import write
from pytest_pafot.findings.finding import Bounded
from pytest_pafot.model.trace import Outcome
from pytest_pafot.report.session_record import SessionRecord, finding_entry, markdown
from pytest_pafot.report.terminal import annotation_lines
from pytest_pafot.support.errors import RequestError
from tests.findings.builders import plain_finding, sighting
from tests.helpers.sessions import Copy

AHEAD = {"outcome": Outcome.SAFE, "time": 5.9, "cell": None, "side": None, "responsibility": "none"}


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    """Let lines be long, so that tests can compare them."""
    monkeypatch.setenv("COLUMNS", "999")


def finding(id_, test="test_it.py::test_x", xfail=None, **expect):
    """Return a finding; ``xfail`` has the fields of its acceptance."""
    return plain_finding(id=id_, test=test, expect=replace(plain_finding().expect, **expect), **(xfail or {}))


def save(root, *findings, test="test_x"):
    for each in findings:
        write(root / "pafot_corpus" / "test_it" / test / f"{each.id}.pafot.yaml", each)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(subprocess, "Popen", Copy)
    return tmp_path


def listed(capsys, *arguments, tests=False, code=0):
    """Return the rows of a list, each as its cells by column."""
    assert main(["corpus", "list", *([] if tests else ["--no-tests"]), *arguments]) == code
    head, *lines = capsys.readouterr().out.splitlines()
    starts = [found.start() for found in re.finditer(r"\S+", head)]
    ends = [*starts[1:], None]
    names = head.split()
    assert names == [name for name in COLUMNS if name in names]
    return [
        dict.fromkeys(COLUMNS, "")
        | {name: line[start:end].strip() for name, start, end in zip(names, starts, ends, strict=True)}
        for line in lines
    ]


def ids(rows):
    return [row["id"] for row in rows]


@pytest.mark.parametrize(
    ("changes", "what", "severity"),
    [
        ({}, "collision after 12.4 s: NPC 0 in cell 2 (front)", ""),  # an older file
        ({"closing_speed": 7.533}, "collision after 12.4 s: NPC 0 in cell 2 (front)", "hits at 7.5 m/s"),
        (
            {"failure": "CheckFailed", "assertion": "gap", "check": Bounded(value=0.64, at_least=10.0, unit="m")}
            | AHEAD,
            "gap 0.64 < 10 m at 5.9 s (NPC 0)",
            "breaks gap by 9.36 m",
        ),
        (
            {"failure": "CheckFailed", "assertion": "gap", "check": Bounded(value=None, at_most=2.0)} | AHEAD,
            "gap nan is not within 2 at 5.9 s (NPC 0)",
            "breaks gap by no finite number",
        ),
        ({"assertion": "run.min_ttc > N"} | AHEAD, "run.min_ttc > N fails", ""),
        ({"assertion": "run.min_ttc > N", "closing_speed": 3.0}, "run.min_ttc > N fails", ""),
        ({"failure": "KeyError", "assertion": "speeds[0]"} | AHEAD, "speeds[0] raises KeyError", ""),
        (
            {"failure": "ValueError", "outcome": Outcome.ADS_ERROR, "message": "no\x1b[31m"},
            "ValueError: no\\x1b[31m",
            "",
        ),
        ({"outcome": Outcome.OFF_ROAD, "npc": None, "cell": None, "side": None}, "off_road after 12.4 s", ""),
    ],
)
def test_a_row_says_what_failed_and_how_bad(here, capsys, changes, what, severity):
    save(here, finding("a", **changes))
    (row,) = listed(capsys)
    assert (row["what"], row["severity"]) == (what, severity)


def test_the_worst_rows_are_first(here, capsys):
    check = {"failure": "CheckFailed", "assertion": "gap", **AHEAD}
    save(
        here,
        finding("a-unknown"),
        finding("b-slow", closing_speed=3.0),
        finding("c-worst", closing_speed=8.0),
        finding("e-npc", closing_speed=20.0, responsibility="npc"),
        finding("f-check", check=Bounded(value=1.0, at_least=10.0, unit="m"), **check),
        finding("g-worse", check=Bounded(value=9.0, at_most=2.0, unit="m"), **check),
    )
    (here / "pafot_corpus" / "test_it" / "test_x" / "0-broken.pafot.yaml").write_text("pafot: 99\n")
    rows = listed(capsys, code=1)
    assert ids(rows) == ["c-worst", "b-slow", "e-npc", "g-worse", "f-check", "a-unknown", "0-broken"]
    assert (rows[-1]["state"], rows[0]["state"]) == ("broken", "open")
    assert "expected the format version 2, received 99" in rows[-1]["what"]
    assert ids(json.loads(_printed(capsys, "--json", code=1))) == ids(rows)


def _printed(capsys, *arguments, code=0):
    assert main(["corpus", "list", "--no-tests", *arguments]) == code
    return capsys.readouterr().out


DAY = date(2027, 1, 31)


@pytest.mark.parametrize(
    ("xfail", "today", "state"),
    [
        ({}, "2027-01-31", "open"),
        ({"xfail": "issue 12"}, "2027-01-31", "accepted"),
        ({"xfail": "issue 12", "xfail_until": DAY}, "2027-01-31", "accepted until 2027-01-31"),
        ({"xfail": "issue 12", "xfail_until": DAY}, "2027-02-01", "expired 2027-01-31"),
        (
            {"xfail": "issue 12", "xfail_until": DAY, "xfail_flaky": True},
            "2027-01-31",
            "accepted until 2027-01-31, flaky",
        ),
        ({"flaky": "another end"}, "2027-01-31", "flaky"),
    ],
)
def test_the_state_is_what_the_file_says_on_a_day(here, capsys, xfail, today, state):
    save(here, finding("a", xfail=xfail))
    assert [row["state"] for row in listed(capsys, f"--today={today}")] == [state]


def results(path, **labels):
    """Write the results of a session with the labels of files, and return the option that names them."""
    entries = [
        {"node_id": "a", "file": f"pafot_corpus/test_it/test_x/{id_}.pafot.yaml", "status": labels[id_]}
        for id_ in labels
    ]
    path.write_text(
        json.dumps({"pafot_json": 1, "findings": [{"node_id": "a", "file": None, "status": "new"}, *entries]})
    )
    return f"--results={path}"


def test_the_last_given_results_tell_the_state(here, capsys):
    save(here, finding("a"), finding("b", xfail={"xfail": "issue 12"}), finding("c"))
    save(here, finding("a", test="test_it.py::test_y"), test="test_y")
    first = results(here / "1.json", a="fixed", b="drifted")
    last = results(here / "2.json", a="still failing")
    rows = listed(capsys, first, last)
    told = [("a", "still failing"), ("a", "open"), ("b", "drifted, accepted"), ("c", "open")]
    assert [(row["id"], row["state"]) for row in rows] == told
    assert ids(listed(capsys, last, first, "--where=state=FIXED")) == ["a"]


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"[]", b"[" * 100_000, b'{"findings": 1}', b'{"findings": [1]}', b"\xff", None]
)
def test_files_that_are_no_results_are_refused(here, capsys, content):
    path = here / "a\n.json"
    if content is not None:
        path.write_bytes(content)
    assert main(["corpus", "list", "--no-tests", f"--results={path}"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "a\\n.json: expected the results of a session, from --pafot-json, received " in told


def test_rows_are_filtered_by_texts_in_cells(here, capsys):
    save(here, finding("aa", closing_speed=8.0), finding("ab"), finding("bb", responsibility="npc"))
    assert ids(listed(capsys, "--where=id=A")) == ["aa", "ab"]
    assert ids(listed(capsys, "--where", "severity=")) == ["ab", "bb"]
    assert ids(listed(capsys, "--where=severity=", "--where=who=EGO")) == ["ab"]
    assert _printed(capsys, "--where=since=May") == "no saved scenarios\n"


@pytest.mark.parametrize(
    ("argument", "told"),
    [
        ("--where=sinc=May", "received 'sinc'; did you mean since?"),
        ("--where==red", "received ''"),
        ("--where=colour=red", "received 'colour'"),
        ("--where=who", "expected COLUMN=TEXT, such as who=ego, received 'who'"),
        ("--today=soon", "expected a day such as 2027-01-31, received 'soon'"),
    ],
)
def test_a_wrong_column_or_condition_is_told_with_the_right_ones(here, capsys, argument, told):
    with pytest.raises(SystemExit, match="2"):
        main(["corpus", "list", argument])
    said = capsys.readouterr().err
    assert said.endswith(f"{told}\n")
    assert f"expected one of {', '.join(COLUMNS)}" in said or "=" in told or "day" in told


OPEN = """
import pytest_pafot as pafot

@pafot.search(ads=lambda: lambda observation: (0.0, 0.0))
def test_x(run):
    assert not run.collision
"""


@pytest.mark.processes
def test_files_of_tests_that_are_gone_are_orphaned(here, capsys):
    (here / "test_it.py").write_text(OPEN)
    save(here, finding("a"))
    save(here, finding("b"), test="test_gone")
    (row, gone) = listed(capsys, tests=True)
    assert (row["state"], gone["state"]) == ("open", "orphaned")
    assert main(["corpus", "list", "--json", "--where=id=a"]) == 0
    (data,) = json.loads(capsys.readouterr().out)
    assert (data["severity"], data["since"], data["xfail_flaky"]) == (None, None, False)


@pytest.mark.processes
@pytest.mark.parametrize(
    ("module", "why"),
    [
        ("def broken(:\n", "ERROR test_it.py"),
        ("import nothing_\x1b[31m\n", "ERROR test_it.py"),
    ],
)
def test_a_list_goes_on_without_tests(here, capsys, module, why):
    save(here, finding("a"))
    (here / "test_it.py").write_text(module)
    assert main(["corpus", "list"]) == 0
    told = capsys.readouterr()
    assert told.out.splitlines()[1].split()[0] == "a"
    assert told.err.startswith(f"corpus: some tests are not known: {why}")
    assert told.err.endswith("; --no-tests is quicker\n")
    assert told.err.count("\n") == 1
    assert "\x1b" not in told.err


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_an_interrupted_list_says_only_that(here, capsys, monkeypatch):
    def interrupted():  # as Ctrl-C ends the pytest that collects, too
        os.kill(os.getpid(), signal.SIGINT)
        raise RequestError("expected pytest to collect the tests here, received exit code -2")

    save(here, finding("a"))
    monkeypatch.setattr(corpus_command.Inventory, "collected", interrupted)
    assert main(["corpus", "list"]) == 130
    assert capsys.readouterr() == ("", "\ncorpus: interrupted\n")


def test_no_test_is_collected_if_nothing_is_saved(here, capsys, monkeypatch):
    monkeypatch.setattr(corpus_command.Inventory, "collected", None)
    assert main(["corpus", "list"]) == 0
    assert capsys.readouterr().out == "no saved scenarios\n"


def git(root, *arguments):
    names = ["-c", "user.name=Ann", "-c", "user.email=ann@example.org", "-c", "init.defaultBranch=main"]
    done = subprocess.run(["git", "-C", root, *names, *arguments], check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def repository(here, monkeypatch):
    """Return a repository in which a scenario was added on one day, and another one on the next day."""
    git(here, "init", "-q")
    for day, id_ in (("2026-10-01", "a"), ("2026-10-02", "b")):
        monkeypatch.setenv("GIT_COMMITTER_DATE", f"{day}T12:00:00Z")
        save(here, finding(id_, closing_speed=ord(id_)))
        git(here, "add", ".")
        git(here, "commit", "-qm", id_)
    return here


def days(rows):
    return {row["id"]: row["since"].partition(" ")[2] for row in rows}


def test_since_is_the_commit_that_added_the_file(repository, capsys, monkeypatch):
    save(repository, finding("c"))
    rows = listed(capsys)
    assert ids(rows) == ["b", "a", "c"]  # by severity
    assert rows[1]["since"] == f"{git(repository, 'rev-parse', '--short', 'HEAD~1')} 2026-10-01"
    assert days(rows) == {"a": "2026-10-01", "b": "2026-10-02", "c": ""}
    git(repository, "config", "log.showSignature", "true")
    git(repository, "config", "log.showRoot", "false")
    git(repository, "config", "diff.renames", "false")
    monkeypatch.chdir("pafot_corpus")
    assert listed(capsys) == rows
    monkeypatch.chdir(repository.parent)
    assert listed(capsys, str(repository)) == rows
    assert ids(listed(capsys, str(repository), str(repository / "pafot_corpus"))) == ["b", "a", "c"]


def test_a_file_counts_from_its_renaming_and_may_have_an_odd_name(repository, capsys, monkeypatch):
    monkeypatch.setenv("GIT_COMMITTER_DATE", "2026-10-03T12:00:00Z")
    folder = repository / "pafot_corpus" / "test_it" / "test_x"
    folder.joinpath("a.pafot.yaml").rename(folder / "renamed.pafot.yaml")
    folder.joinpath("o\nd\x01.pafot.yaml").write_text("pafot: 99\n")
    git(repository, "add", ".")
    git(repository, "commit", "-qm", "rename")
    told = {"renamed": "2026-10-03", "b": "2026-10-02", "o\\nd\\x01": "2026-10-03"}
    assert days(listed(capsys, code=1)) == told


def test_a_file_that_was_added_again_counts_since_then(repository, capsys, monkeypatch):
    monkeypatch.setenv("GIT_COMMITTER_DATE", "2026-10-04T12:00:00Z")
    git(repository, "rm", "-q", "pafot_corpus/test_it/test_x/a.pafot.yaml")
    git(repository, "commit", "-qm", "remove")
    save(repository, finding("a"))
    git(repository, "add", ".")
    git(repository, "commit", "-qm", "again")
    assert days(listed(capsys)) == {"a": "2026-10-04", "b": "2026-10-02"}


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
    assert days(listed(capsys, str(outside), ".")) == {"a": "2026-10-01", "b": "2026-10-02", "c": ""}


def rows_for(*cells):
    class Row:
        def __init__(self, cells):
            self.cells = dict(zip(COLUMNS, cells, strict=True))

    return list(map(Row, cells))


LONG = ("leader-unanswered-b7c133", "test_it[a]", "collision after 6.3 s: NPC 0 in cell 2 (front)",
        "hits at 7.5 m/s", "ego", "still failing, accepted until 2027-01-31",
        "1a2b3c4 2026-10-01")  # fmt: skip
SHORT = ("a", "test_x", "gap 1 < 2 m", "", "none", "open", "")


def test_a_wide_text_has_a_line_for_each_row():
    assert [re.split(" {2,}", line) for line in text_of_table(rows_for(LONG), 240).splitlines()] == [
        list(COLUMNS),
        list(LONG),
    ]


@pytest.mark.parametrize("width", [20, 40, 60, 80, 100, 120, 160, 200, 240])
def test_a_text_fits_its_width_and_loses_nothing(width):
    lines = text_of_table(rows_for(LONG, SHORT), width).splitlines()
    assert max(map(len, lines)) <= max(width, len(LONG[0]))  # an id is never cut
    text = " ".join(" ".join(lines).split())
    for cell in (*LONG, *SHORT):
        assert " ".join(cell.split()) in text
    assert any(line.startswith(LONG[0]) for line in lines)
    assert set(BELOW) == set(COLUMNS) - {"id"}


def test_a_column_without_any_text_is_left_out_and_a_phrase_stays_whole():
    cells = dict.fromkeys(COLUMNS, "") | {"id": "a", "test": "test_it[planner-a]", "what": "gap 1 < 2 m", "who": "ego"}
    assert text_of_table(rows_for(cells.values()), 80).splitlines() == [
        "id  test                what         who",
        "a   test_it[planner-a]  gap 1 < 2 m  ego",
    ]
    assert text_of_table(rows_for(cells.values()), 26).splitlines() == [
        "id  what         who",
        "a   gap 1 < 2 m  ego",
        "    test_it[planner-a]",
    ]


def test_rows_are_found_by_the_parameters_of_their_test(here, capsys):
    save(here, finding("a", test="test_it.py::test_x[planner-a]"), finding("b", test="test_it.py::test_x[planner-b]"))
    (row,) = listed(capsys, "--where=test=planner-b")
    assert (row["id"], row["test"]) == ("b", "test_x[planner-b]")


def test_the_list_that_a_ci_job_names_has_the_findings(here, capsys):
    finds = [sighting(f"f{number}") for number in range(6)]
    save(here, *(each.finding for each in finds))
    said = annotation_lines(finds)[-1].partition("`")[2].removesuffix("`")
    record = SessionRecord(findings=[finding_entry(each) for each in finds])
    assert f"see `{said}`\n" in markdown(record)
    assert main([*shlex.split(said.removeprefix("python -m pytest_pafot")), "--no-tests"]) == 0
    printed = capsys.readouterr().out
    assert all(f"\n{each.id} " in printed for each in finds)


def test_texts_of_strangers_change_no_table(here, capsys, monkeypatch):
    nasty = "=1+1|\x1b[31m\n<b>@x `y` ##[error]"
    save(here, finding("a", xfail={"xfail": nasty, "flaky": nasty}, assertion=nasty, failure="KeyError", **AHEAD))
    name = "-1+1|\n\x1b[2J.pafot.yaml"
    (here / "pafot_corpus" / "test_it" / "test_x" / name).write_text("pafot: 99\n")
    printed = _printed(capsys, code=1)
    assert "\x1b" not in printed
    assert printed.count("\n") == 3
    assert "\x1b" not in _printed(capsys, "--json", code=1)
    assert ids(listed(capsys, code=1)) == ["a", "-1+1|\\n\\x1b[2J"]


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_a_link_that_leads_out_is_broken(here, capsys, tmp_path_factory):
    secret = tmp_path_factory.mktemp("secret") / "key"
    secret.write_text("password: 1\n")
    save(here, finding("a"))
    (here / "pafot_corpus" / "test_it" / "test_x" / "b.pafot.yaml").symlink_to(secret)
    rows = listed(capsys, code=1)
    assert [row["state"] for row in rows] == ["open", "broken"]
    assert "a link that leads out of it" in rows[1]["what"]
    assert "password" not in str(rows)


def test_the_terminal_decides_the_width(here, capsys, monkeypatch):
    save(here, finding("a", closing_speed=8.0))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "60")
    lines = _printed(capsys).splitlines()
    assert len(lines) > 2
    assert max(map(len, lines)) <= 60
    assert Path.cwd() == here
