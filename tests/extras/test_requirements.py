"""``python -m pytest_pafot requirements``: the state of each requirement, from tests, files and results of sessions."""

import json
import os
from argparse import Namespace
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.commands.inventory import Inventory
from pytest_pafot.commands.results import Session
from pytest_pafot.corpus.layout import SEARCH_PART, name_without
from pytest_pafot.extras import requirements
from pytest_pafot.extras.requirements import (
    Table,
    csv_lines,
    listed_in,
    markdown_lines,
    run,
    text_lines,
)
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.traced import Traced

TODAY = date(2026, 11, 25)
TEST = "test_it.py::test_x"
HIT = {"kind": "collision", "value": 9.8, "unit": "m/s", "margin": None, "name": ""}


PASSED = ("passes", "fixed", "still failing elsewhere", "drifted", "flaky")


def inventory(**tests):
    told = {f"test_it.py::{name}": Traced(requirements=ids, owner="planning") for name, ids in tests.items()}
    return Inventory(root=Path("/nowhere"), tests=told)


def finding(id_="a-1", status="still failing", test=TEST, **more):
    result = "passed" if status in PASSED else "failed"
    return {"node_id": f"{test}[saved-{id_}]", "test": test, "id": id_, "status": status, "result": result, **more}


def search(runs=10, test=TEST, **more):
    return {
        "node_id": f"{test}[search]",
        "result": "passed",
        "runs": runs,
        "random_runs": 5,
        "random_failing": 1,
        **more,
    }


def night(day, *findings, searches=None, tests=()):
    searched = (search(),) if searches is None else tuple(searches)
    return Session(day=f"2026-11-{day}", commit="abc", searches=searched, findings=findings, tests=tuple(tests))


def table_of(*sessions, tests=None, listed=None):
    return Table.of(inventory(**(tests or {"test_x": ("R1",)})), Session.grouped(sessions), listed or {}, today=TODAY)


def states(table):
    return {each.traced.ids: each.state for each in table.requirements}


def test_requirement_with_the_worst_open_failure_comes_first():
    milder = {**HIT, "value": 2.0}
    table = table_of(
        night(20, finding(severity=milder), finding(test="test_it.py::test_b", severity=HIT)),
        tests={"test_x": ("R1",), "test_b": ("R2",), "test_c": ("R3",)},
    )
    assert states(table) == {"R2": "open", "R1": "open", "R3": "not tested"}
    assert list(states(table)) == ["R2", "R1", "R3"]


def test_failure_is_open_since_the_first_session_after_a_pass():
    course = [night(20, finding()), night(21, finding(status="fixed")), night(22, finding()), night(23, finding())]
    (requirement,) = table_of(*course).requirements
    (failure,) = requirement.failures("open")
    assert failure.since == "2026-11-22 abc"
    assert [(day.new, day.open, day.fixed) for day in requirement.days] == [(1, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 0)]


def test_failure_without_a_file_is_gone_when_its_test_runs_without_it():
    table = table_of(night(20, finding()), night(21))
    assert states(table) == {"R1": "no failure known"}
    assert [(day.open, day.fixed) for day in table.requirements[0].days] == [(1, 0), (0, 0)]


def test_failing_test_without_findings_is_open_until_it_passes():
    failed = {"node_id": "test_it.py::test_x", "result": "failed", "requirements": ["R1"]}
    assert states(table_of(night(20, searches=(), tests=[failed]))) == {"R1": "open"}
    passed = {**failed, "result": "passed"}
    after = table_of(night(20, searches=(), tests=[failed]), night(21, searches=(), tests=[passed]))
    assert states(after) == {"R1": "no failure known"}


def test_search_that_fails_for_its_findings_is_no_failure_of_its_own():
    failed = search(result="failed", finds=["a-1"])
    (requirement,) = table_of(night(20, finding(status="new"), searches=[failed])).requirements
    assert [each.id for each in requirement.failures("open")] == ["a-1"]


def test_shards_of_a_day_count_together():
    shards = [night(20, finding(), searches=[search(runs=10)]), night(20, searches=[search(runs=5, test="t.py::y")])]
    (requirement,) = table_of(*shards, tests={"test_x": ("R1",)}).requirements
    assert [(day.runs, day.open) for day in requirement.days] == [(10, 1)]
    assert len(Session.grouped(shards)) == 1
    assert len(Session.grouped([Session(), Session()])) == 2


def test_shards_are_joined_also_if_another_commit_lies_between_them():
    one, other = night(20, finding()), replace(night(20), commit="def")
    two = night(20, searches=[search(runs=5)])
    assert [(each.commit, len(each.searches)) for each in Session.grouped([one, other, two, two])] == [
        ("abc", 2),
        ("def", 1),
    ]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_shards_that_differ_the_worst_counts(order):
    shards = [night(20, finding(status="fixed")), night(20, finding())]
    assert states(table_of(*(shards[number] for number in order))) == {"R1": "open"}


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_pass_is_no_fix_if_the_search_of_another_shard_shows_the_failure(order):
    shards = [
        night(20, finding(status="passes", signature="hit"), searches=[]),
        night(20, searches=[search(failures={"hit": "b-2"})]),
    ]
    assert states(table_of(*(shards[number] for number in order))) == {"R1": "open"}


@pytest.mark.parametrize(
    ("status", "state"),
    [("passes", "no failure known"), ("fixed", "no failure known"), ("still failing elsewhere", "open")],
)
def test_only_a_failure_that_a_search_does_not_show_elsewhere_is_fixed(status, state):
    table = table_of(night(20, finding()), night(21, finding(status=status, elsewhere="b-2")))
    assert states(table) == {"R1": state}


def test_session_that_skips_the_search_says_nothing_of_it():
    replay_only = night(21, searches=[search(runs=0, result="skipped")])
    table = table_of(night(20, finding()), replay_only)
    assert states(table) == {"R1": "open"}
    assert len(table.requirements[0].days) == 1
    assert states(table_of(replay_only)) == {"R1": "not tested"}


def test_failure_that_pytest_expects_is_accepted():
    assert states(table_of(night(20, finding() | {"result": "xfailed"}))) == {"R1": "accepted"}
    failed = {"node_id": TEST, "result": "failed", "requirements": ["R1"]}
    course = [night(20, searches=(), tests=[failed]), night(21, searches=(), tests=[failed | {"result": "xfailed"}])]
    assert states(table_of(*course)) == {"R1": "accepted"}


@pytest.mark.parametrize(
    ("course", "since"),
    [(["drifted", "new"], 21), (["new", "drifted", "new"], 22), (["new", None, "new"], 22), (["new", "error"], 20)],
)
def test_failure_is_open_since_the_day_on_which_the_course_calls_it_new(course, since):
    nights = [night(20 + n, *([] if told is None else [finding(status=told)])) for n, told in enumerate(course)]
    (requirement,) = table_of(*nights).requirements
    assert requirement.failures("open")[0].since == f"2026-11-{since} abc"
    assert [day.session.day for day in requirement.days if day.new][-1] == f"2026-11-{since}"


def test_random_failures_are_collisions_and_failed_checks():
    (requirement,) = table_of(
        night(20, searches=[search(random_runs=20, random_failing=3, random_otherwise=2)])
    ).requirements
    assert (requirement.searched.random_failing, requirement.searched.random_runs) == (5, 20)


def test_requirements_without_a_test_and_tests_without_one_are_named(tmp_path):
    file = tmp_path / "all.csv"
    file.write_text("id,title,owner\nR1,One,\nR9,Nine,law\n")
    table = table_of(tests={"test_x": ("R1",), "test_y": ()}, listed=listed_in(file))
    lines = "\n".join(text_lines(table, course=False))
    assert "R9: Nine (owner law)" in lines
    assert "requirements without a test: R9" in lines
    assert "tests without a requirement: test_it.py::test_y" in lines
    assert "R1: One (owner planning)" in lines


@pytest.mark.parametrize("status", ["drifted", "flaky", "still failing", "error"])
def test_a_replay_that_fails_is_open_whatever_its_label(status):
    table = table_of(night(20, finding(status=status) | {"result": "failed", "headline": "collision after 3.9 s"}))
    assert states(table) == {"R1": "open"}


def test_an_error_of_one_night_is_closed_by_the_next_good_one():
    table = table_of(night(20, finding(status="error")), night(21, finding(status="fixed")))
    assert states(table) == {"R1": "no failure known"}
    assert [(day.open, day.fixed) for day in table.requirements[0].days] == [(1, 0), (0, 1)]


def fails_on_open(monkeypatch, *sessions):
    """Return the exit code of ``requirements --fail-on open`` for some sessions."""
    given = {Path(f"{number}.json"): session for number, session in enumerate(sessions)}
    monkeypatch.setattr(requirements.Inventory, "collected", lambda _: inventory(test_x=("R1",), test_y=("R1",)))
    monkeypatch.setattr(requirements.Session, "read", given.__getitem__)
    arguments = Namespace(
        results=list(given), list=None, pytest=[], today=TODAY, format="text", course=False, fail_on="open"
    )
    return run(arguments, [])


BOTH = (search(), search(test="test_it.py::test_y"))


def test_a_session_that_broke_off_has_not_tested_what_it_did_not_end(monkeypatch, capsys):
    broken = replace(night(21), broke_off=True)  # of its two tests it ended one
    assert fails_on_open(monkeypatch, night(20, searches=BOTH), broken) == 1
    assert "1 requirement: 1 not tested, the session broke off" in capsys.readouterr().out
    assert fails_on_open(monkeypatch, night(20, searches=BOTH), broken, night(22, searches=BOTH)) == 0
    assert fails_on_open(monkeypatch, replace(night(20, searches=BOTH), broke_off=True)) == 0


def test_an_item_whose_worker_died_has_not_tested_its_requirement(monkeypatch):
    for node_id in ("test_it.py::test_x", f"{TEST}[search]", f"{TEST}[saved-a-1]"):
        died = {"node_id": node_id, "result": "", "message": "worker 'gw0' crashed", "requirements": []}
        assert fails_on_open(monkeypatch, night(20, tests=[died])) == 1
    assert fails_on_open(monkeypatch, night(20, tests=[died]), night(21, searches=BOTH)) == 0


def test_a_test_that_did_not_end_stays_so_when_only_another_test_of_its_requirement_runs():
    other, two = "test_it.py::test_y", {"test_x": ("R1",), "test_y": ("R1",)}
    died = night(20, tests=[{"node_id": other, "result": "", "requirements": ["R1"], "message": "the worker died"}])
    assert states(table_of(died, night(21), tests=two)) == {"R1": "not tested, the session broke off"}
    both = night(22, searches=[search(), search(test=other)])
    assert states(table_of(died, night(21), both, tests=two)) == {"R1": "no failure known"}


def test_a_search_that_was_refused_is_no_failure_and_is_not_fixed_later(monkeypatch, capsys):
    refused = night(21, searches=[search(result="failed", runs=0, message="expected the state of this search")])
    assert fails_on_open(monkeypatch, night(20, searches=BOTH), refused) == 1
    assert "broke off 2026-11-21 abc: expected the state of this search" in capsys.readouterr().out
    after = table_of(night(20), refused, night(22))
    assert states(after) == {"R1": "no failure known"}
    assert [(day.new, day.open, day.fixed) for day in after.requirements[0].days] == [(0, 0, 0)] * 2


@pytest.mark.parametrize(("code", "broke_off"), [(0, False), (1, False), (2, True), (3, True), (5, True), (None, True)])
def test_the_exit_code_says_whether_a_session_came_to_its_end(tmp_path, code, broke_off):
    path = tmp_path / "n.json"
    path.write_text(json.dumps({"pafot_json": 1, "exit": code}))
    assert Session.read(path).broke_off is broke_off


SEARCHES = st.sampled_from(
    [
        ("test_x[search]", "test_x"),
        ("test_x[1-search]", "test_x[1]"),
        ("test_x[search-1]", "test_x[1]"),
        ("test_x[a-search-b]", "test_x[a-b]"),
        ("test_x[search-fast-search]", "test_x[search-fast]"),
        ("test_x[research]", "test_x[research]"),
        ("test_search", "test_search"),
    ]
)


@pytest.mark.parametrize(
    ("width", "rate"), [(120, "1 of 5, 20.0 % (95 %: 0.51 to 71.6 %)"), (80, "1 of 5, 20.0 %"), (60, None)]
)
def test_days_fit_into_the_width_and_lose_the_interval_before_they_wrap(monkeypatch, width, rate):
    monkeypatch.setenv("COLUMNS", str(width))
    first, second = night(20, finding()), night(21)
    lines = list(text_lines(table_of(replace(first, commit="1a2b3c4d5e"), second), course=True))
    days = lines[next(n for n, line in enumerate(lines) if line.startswith("    day")) :]
    assert max(map(len, days)) <= width
    (day,) = [line for line in days if line.startswith("    2026-11-20")]
    assert rate is None or day.endswith(f"  {rate}")


@given(SEARCHES)
def test_test_of_a_search_is_its_node_id_without_the_part_of_the_search(named):
    node_id, test = named
    assert name_without(SEARCH_PART, f"a.py::{node_id}") == f"a.py::{test}"


STATUSES = st.sampled_from(["new", "still failing", "fixed", "drifted", "flaky", "error", "common"])
NIGHTS = st.lists(st.dictionaries(st.sampled_from(["a-1", "b-2", "c-3"]), STATUSES, max_size=3), max_size=5)


@given(NIGHTS)
def test_each_day_counts_what_fails_then_and_did_not_before(nights):
    course = [night(10 + n, *(finding(*each) for each in told.items())) for n, told in enumerate(nights)]
    (requirement,) = table_of(*course).requirements
    before, unfixed = set(), set()
    for day, told in zip(requirement.days, nights, strict=True):
        failing = {id_ for id_, status in told.items() if status not in ("fixed", "drifted", "flaky")}
        passing = {id_ for id_, status in told.items() if status == "fixed"}
        drifted = {id_ for id_, status in told.items() if status == "drifted"}
        assert (day.new, day.open, day.drifted) == (len(failing - before), len(failing), len(drifted & before))
        assert day.fixed == len(passing & unfixed)
        before, unfixed = failing, (unfixed | failing) - passing


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "No such file or directory"),
        ("{", "JSONDecodeError"),
        ("[" * 100_000, "Recursion|JSONDecode"),
        ("[]", "other JSON"),
        ('{"pafot_json": 2}', "other JSON"),
        ('{"pafot_json": 1, "searches": [{"node_id": 5}]}', "other JSON"),
        ('{"pafot_json": 1, "findings": [{"node_id": "a", "requirements": [1]}]}', "other JSON"),
        ('{"pafot_json": 1, "searches": [{"node_id": "a", "random_runs": -5}]}', "other JSON"),
        ('{"pafot_json": 1, "searches": [{"node_id": "a", "runs": 1e400}]}', "other JSON"),
        ('{"pafot_json": 1, "searches": [{"node_id": "a", "random_runs": 2, "random_failing": 10}]}', "other JSON"),
        ('{"pafot_json": 1, "searches": [{"node_id": "a", "random_runs": 2, "random_otherwise": 3}]}', "other JSON"),
        ('{"pafot_json": 1, "day": "tomorrow"}', "day 'tomorrow'"),
        ("\udcff", "UnicodeDecodeError"),
    ],
)
def test_file_without_results_is_refused(tmp_path, content, why):
    file = tmp_path / "a.json"
    if content is not None:
        file.write_bytes(content.encode("utf-8", "surrogateescape"))
    with pytest.raises(RequestError, match=rf"a\.json: expected the results of a session, .* received .*({why})"):
        Session.read(file)


def test_severities_that_are_no_numbers_are_left_out():
    wrong = [{**HIT, "value": "9"}, {**HIT, "margin": []}, {"kind": 1}, {**HIT, "value": float("nan")}, {"x": 1}]
    wrong += [{**HIT, "value": 10**400}, {**HIT, "margin": 10**400}]
    for severity in wrong:
        (requirement,) = table_of(night(20, finding(severity=severity))).requirements
        assert requirement.failures("open")[0].severity is None


HOSTILE = '=HYPERLINK("http://a.b")|<b>@all\x1b[31m'


@pytest.mark.parametrize("width", [40, 60])
def test_lines_for_people_are_as_wide_as_the_terminal_also_if_piped(width, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    table = table_of(night(21, finding()))
    assert max(map(len, text_lines(table, course=False))) <= width


def test_texts_of_strangers_are_data_in_every_format():
    strange = finding(id_=HOSTILE, requirements=[HOSTILE], title=HOSTILE, owner=HOSTILE, test="t.py::x")
    table = table_of(night(20, strange), tests={})
    text, markdown, csv = ("\n".join(lines(table, course=False)) for lines in (text_lines, markdown_lines, csv_lines))
    assert "\x1b" not in text + markdown + csv
    rows = [line for line in markdown.splitlines() if line.startswith("|")]
    assert "http://" not in "".join(rows)  # of which a page would make a link, unless it is code
    assert "<b>" not in "".join(rows)
    assert all(not line.startswith(("=", '"=')) for line in csv.splitlines())


def test_open_failures_end_with_exit_code_1_only_if_asked(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(requirements.Inventory, "collected", lambda arguments: inventory(test_x=("R1",)))
    file = tmp_path / "a.json"
    file.write_text(json.dumps({"pafot_json": 1, "searches": [search()], "findings": [finding()]}))
    given = {"results": [file], "list": None, "today": TODAY, "format": "csv", "course": False, "pytest": []}
    assert run(Namespace(**given, fail_on=None), []) == 0
    assert run(Namespace(**given, fail_on="open"), []) == 1
    file.write_text(json.dumps({"pafot_json": 1, "searches": [search()], "findings": [finding(status="fixed")]}))
    assert run(Namespace(**given, fail_on="open"), []) == 0
    assert "R1,,planning,open,1,0,0,0,0,a-1," in capsys.readouterr().out


def test_results_without_a_day_among_dated_ones_are_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(requirements.Inventory, "collected", lambda arguments: inventory(test_x=("R1",)))
    files = [tmp_path / f"{name}.json" for name in "abc"]
    for file, day in zip(files, ("2026-11-20", "", ""), strict=True):
        file.write_text(json.dumps({"pafot_json": 1, "day": day, "searches": [search()], "findings": []}))
    given = {"list": None, "today": TODAY, "format": "csv", "course": False, "pytest": [], "fail_on": None}
    run(Namespace(**given, results=files), [])
    why = "requirements: without a day, and so counted as older than all others"
    assert capsys.readouterr().err == f"{why}: {files[1]}, {files[2]}; run their session with --pafot-today\n"
    for same in files[:1], files[1:]:
        run(Namespace(**given, results=same), [])
        assert capsys.readouterr().err == ""


def test_list_of_a_spreadsheet_in_another_country_is_read(tmp_path):
    file = tmp_path / "all.csv"
    file.write_text('\ufeffRequirement ID;Title;Owner\nR1;"Brakes; softly";Ann\n', encoding="utf-8")
    table = table_of(listed=listed_in(file))
    assert [(each.traced.title, each.traced.owner) for each in table.requirements] == [("Brakes; softly", "Ann")]


def test_pipe_is_no_file_of_results(tmp_path):
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        with pytest.raises(RequestError, match="received no regular file"):
            Session.read(tmp_path / "pipe")
