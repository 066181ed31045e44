"""Texts for the terminal: plain ASCII, 80 columns, and plain data on the way."""

from collections import Counter
from dataclasses import replace

import pytest

from pytest_pafot.findings.sighting import Alike
from pytest_pafot.findings.verdict import Severity
from pytest_pafot.report import terminal
from pytest_pafot.searches.events import Ending, Progress, Search, concluded
from pytest_pafot.support.text import wrapped_to
from tests.findings.builders import sighting
from tests.helpers.tables import table
from tests.report.builders import session_of

FIND = sighting(
    node_id="tests/test_safety.py::test_it[saved-front-2-1f3a9c]",
    headline="collision after 12.4 s: NPC 0 in cell 2 (front) against the ego's front",
    path="tests/pafot_corpus/test_safety/test_it/front-2-1f3a9c.pafot.yaml",
    repeats=17,
)


def named(id_, **seen):
    """Return the same finding by another id, and with more that was seen of it."""
    finding = replace(FIND.finding, id=id_, flaky=seen.pop("flaky", None))
    return replace(
        FIND,
        **{"finding": finding, "node_id": f"tests/test_safety.py::test_it[saved-{id_}]"} | seen,
    )


SEARCH = Search(
    algorithm="pafot",
    node_id="tests/test_safety.py::test_it[search]",
    base_seed=3,
    seed=4154884243,
    generations=10,
    asked={"generations": 10},
    reason=Ending.GENERATIONS,
    seconds=12.34,
    kinds=Counter(passed=17, failed=18, npc=9, invalid=2, rejected=1, skipped=1),
    more_runs=Counter(known=3),
    reached=0.634,
    no_interaction=5,
    finds=(FIND,),
    known={"rear-6-abcdef": 4},
    warnings=(
        "NPCs reached the cell of only 12 % (1) of 8 Position-Instructions that they started. Give them more time",
    ),
    notes=("--pafot-max-time ended the search, so the same seed may find other failures",),
)


def test_annotations_tell_the_worst_five():
    finds = [
        sighting(f"at-{speed}", severity=Severity(kind="collision", value=float(speed), unit="m/s"))
        for speed in (3, 8, 1, 9, 5, 7, 2)
    ]
    lines = terminal.annotation_lines(finds)
    worst = [line.split("::")[1].partition("title=")[2] for line in lines[:5]]
    assert worst == [f"at-{speed}" for speed in (9, 8, 7, 5, 3)]
    assert [line.split("::")[1] for line in lines[5:]] == ["notice title=pafot"]
    assert len(terminal.annotation_lines(finds[:5])) == 5
    assert terminal.annotation_lines([]) == []


@table(("failing", "otherwise", "runs", "numbers"), [
    (1, 15, 20, ["18 of 48", "16 of 20", "80.0 % (95 %: 56.3 to 94.3 %)"]),
    (0, 0, 20, ["18 of 48", "None of 20", "0 % (95 %: at most 17 %)"]),
    (3, 15, 44, ["18 of 44", "40.9 % (95 %: "]),  # of 48 runs, 4 evaluated nothing
    (0, 0, 0, ["18 of 48"]),
])  # fmt: skip
def test_the_share_of_random_scenarios_that_fail_is_told_once(failing, otherwise, runs, numbers):
    random = Counter(at_fault=failing, otherwise=otherwise, runs=runs)
    told = "\n".join(terminal.search_lines(replace(SEARCH, random=random), width=200))
    assert all(number in told for number in numbers)
    assert told.count("random scenario") == bool(runs)


def test_a_search_that_finds_nothing_has_one_line():
    drawn = "3 to 6 NPCs"
    quiet = replace(
        SEARCH, kinds=Counter(passed=48), finds=(), known={}, warnings=(), notes=(), drawn=drawn,
        random=Counter(runs=48), more_runs=Counter(), no_interaction=0,
    )  # fmt: skip
    lines, whole = (terminal.search_lines(quiet, is_whole=is_whole) for is_whole in (False, True))
    assert len(lines) == 2  # of which the second one is its end, wrapped
    assert max(map(len, whole)) <= 80
    assert whole[:2] == lines
    many = [replace(quiet, node_id=f"t.py::test_{number}[search]") for number in range(500)]
    assert len(terminal.session_lines(session_of(searches=many))) == 1000
    text = "\n".join(terminal.session_lines(session_of(searches=many), is_whole=True))
    assert text.count(drawn) == 1


def test_a_summary_has_eight_lines_and_the_whole_one_all_kinds_and_counts():
    finds = tuple(named(f"front-2-{number}", alike=Alike(runs=number)) for number in range(6))
    random = Counter(runs=20, at_fault=3)
    search = replace(
        SEARCH, finds=finds, warnings=(), notes=(), random=random, no_worse={"a": "hit"}
    )
    short, whole = (terminal.search_lines(search, is_whole=is_whole) for is_whole in (False, True))
    assert len(short) <= 8 + 2  # the first line and that on failures elsewhere are wrapped
    for lines, listed in ((short, 2), (whole, 6)):
        assert sum(line.startswith("  front-2-") for line in lines) == listed
    for value in ("63 %", "4154884243", "--pafot-seed=3"):
        assert [value in "\n".join(lines) for lines in (short, whole)] == [False, True]


def test_the_summary_has_the_numbers_of_runs_and_decisions():
    search = replace(
        SEARCH, decisions=Counter(search=3923, shrink=8357), more_runs=Counter(shrink=3, moment=4)
    )
    text = " ".join(map(str.strip, terminal.search_lines(search)))
    assert all(f" {count}" in text for count in ("48 runs", "7 more", "12,280 ", "12.3 s"))


@pytest.mark.parametrize("reason", [each for each in Ending if not each.is_complete])
def test_the_summary_says_why_a_search_ended_early_if_that_is_known(reason):
    text = "\n".join(terminal.search_lines(replace(SEARCH, reason=reason), width=200))
    assert (", because " in text) == (reason is not Ending.UNKNOWN)


def test_the_summary_of_a_session_is_ascii_and_a_failing_replay_has_no_other_label():
    session = session_of(
        searches=[SEARCH], seen=[sighting("saved-c", label="drifted", detail="\xe9")]
    )
    assert all(line.isascii() for line in terminal.session_lines(session))
    failing = replace(sighting("saved-a", label="still failing"), test="t")
    other = replace(SEARCH, node_id="t[search]", failures=(("hit-2", failing.finding.signature),))
    assert concluded(failing, {"t": other}) is failing


def test_progress_is_one_line_with_the_name_cut():
    progress = Progress(
        node_id="x" * 200, generation=3, generations=100, runs=9, failing=2, finds=1, seconds=3.0
    )
    line = terminal.progress_line(progress)
    assert len(line) <= 80
    assert line.startswith("pafot: ...xxx")
    assert "3/100 generations" in line
    assert line.endswith(" 3 runs/s")
    assert terminal.progress_line(replace(progress, seconds=120.0)).endswith(" 13 s per run")
    narrow = terminal.progress_line(progress, 39)
    assert (len(narrow), narrow.endswith("xxx 3/100 generations, ")) == (39, True)


@table("width", [60, 80, 120])
def test_lines_are_wrapped_to_the_terminal_width(width):
    lines = terminal.session_lines(session_of(searches=[SEARCH]), width=width)
    assert max(map(len, lines)) <= width
    assert " ".join(" ".join(lines).split()) == " ".join(
        " ".join(terminal.session_lines(session_of(searches=[SEARCH]), width=999)).split()
    )


@table(("line", "width", "prefix", "lines"), [
    ("  one two three", 10, "", ["  one two", "    three"]),
    ("E       one two three", 15, "E   ", ["E       one two", "E         three"]),
    # No line ends between a number and its unit.
    *((f"  one two {kept} andsoon", 13, "", ["  one two", f"    {kept}", "    andsoon"])
      for kept in ("37.9 %)", "7.5 m/s,", "6 m/s^2", "1.9 s", "NPC 0,")),
])  # fmt: skip
def test_lines_are_wrapped_between_words_and_keep_their_mark_and_indentation(
    line, width, prefix, lines
):
    assert wrapped_to(line, width, prefix) == lines
