"""Texts for the terminal: plain ASCII, 80 columns, and plain data on the way.

Long texts are in ``__snapshots__``. ``--snapshot-update`` rewrites them; read the differences before you commit them.
"""

from collections import Counter
from dataclasses import replace

import pytest

from pytest_pafot.findings.shrink import Shrunk, described
from pytest_pafot.findings.sighting import NOT_REPEATED, Alike
from pytest_pafot.findings.verdict import Severity
from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.report import terminal
from pytest_pafot.searches.events import Ending, Progress, Search, concluded
from pytest_pafot.support.text import wrapped_to
from tests.findings.builders import plain_finding, sighting
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


CUT_IN, AHEAD = PositionInstruction(Cell.FRONT_LEFT, 20.0), PositionInstruction(Cell.FRONT, 0.0)


@table(("found", "simplest", "is_minimal", "line"), [
    ([[CUT_IN, AHEAD], [AHEAD]], [[AHEAD]], True, "from 2 NPCs, 3 instructions, 20 s to 1 NPC, 1 instruction, 10 s"),
    ([[CUT_IN, AHEAD]], [[AHEAD]], True, "from 2 instructions, 20 s to 1 instruction, 10 s"),
    ([[CUT_IN, AHEAD]], [[AHEAD]], False,
     "from 2 instructions, 20 s to 1 instruction, 10 s; a simpler scenario may exist"),
    ([[CUT_IN]], [[AHEAD]], True, "to a simpler scenario of the same size"),
    (None, [[AHEAD]], False, None),
    (None, [[AHEAD]], True, None),
])  # fmt: skip
def test_only_what_shrinking_changed_is_reported(found, simplest, is_minimal, line):
    before = "" if found is None else described(Scenario.repaired(found))
    shrunk = Shrunk(rollouts=5, is_minimal=is_minimal, before=before)
    finding = plain_finding(scenario=Scenario.repaired(simplest), shrunk=shrunk)
    assert terminal.shrunk_lines(finding) == ([] if line is None else [line])


def test_another_traffic_is_reported():
    original, scenario = (
        Scenario.repaired([[AHEAD]], traffic=each) for each in ("hostile", "paper")
    )
    finding = plain_finding(
        scenario=scenario, shrunk=Shrunk(rollouts=5, before=described(original))
    )
    assert terminal.shrunk_lines(finding) == ["from hostile traffic to paper traffic"]


def test_annotations_tell_the_worst_five_and_where_the_others_are():
    hits = [
        Severity(kind="collision", value=float(speed), unit="m/s")
        for speed in (3, 8, 1, 9, 5, 7, 2)
    ]
    finds = [
        sighting(
            f"at-{each.value:.0f}",
            node_id="a.py::t[x]",
            severity=each,
            headline="50 % hit",
            sentences=("Who.",),
        )
        for each in hits
    ]
    lines = terminal.annotation_lines(finds)
    assert lines[0] == "::error file=a.py,title=at-9::50 %25 hit.%0AWho."
    assert [line.split("::")[1].partition("title=")[2] for line in lines[:5]] == [
        f"at-{n}" for n in (9, 8, 7, 5, 3)
    ]
    assert lines[5:] == [
        "::notice title=pafot::2 more findings: see `python -m pytest_pafot corpus list`"
    ]
    assert "see r%25.html among" in terminal.annotation_lines(finds, "r%.html")[-1]
    assert len(terminal.annotation_lines(finds[:5])) == 5
    assert terminal.annotation_lines([]) == []


@table(("failing", "otherwise", "runs", "lines"), [
    (1, 15, 20, ["18 of 48 runs failed", "16 of 20 random scenarios failed: 80.0 % (95 %: 56.3 to 94.3 %)."]),
    (0, 0, 20, ["18 of 48 runs failed", "None of 20 random scenarios failed: 0 % (95 %: at most 17 %)."]),
    # of 48 runs, 4 evaluated nothing
    (3, 15, 44, ["18 of 44 random scenarios failed: 40.9 % (95 %: "]),
    (0, 0, 0, ["18 of 48 runs failed"]),
])  # fmt: skip
def test_the_share_of_random_scenarios_that_fail_is_told_once(failing, otherwise, runs, lines):
    random = Counter(at_fault=failing, otherwise=otherwise, runs=runs)
    told = "\n".join(terminal.search_lines(replace(SEARCH, random=random), width=200))
    assert all(line in told for line in lines)
    assert told.count("random scenario") == len([line for line in lines if "random" in line])


def test_a_search_that_finds_nothing_has_one_line():
    drawn = "3 to 6 NPCs in hostile traffic; the ego starts at 12 to 26.8 m/s in lanes 0 to 3"
    quiet = replace(
        SEARCH, kinds=Counter(passed=48), finds=(), known={}, warnings=(), notes=(), drawn=drawn,
        random=Counter(runs=48), more_runs=Counter(), no_interaction=0,
    )  # fmt: skip
    lines, whole = (terminal.search_lines(quiet, is_whole=is_whole) for is_whole in (False, True))
    assert len(lines) == 2  # of which the second one is its end, wrapped
    assert max(map(len, whole)) <= 80
    assert whole[:2] == lines
    assert "  3 to 6 NPCs in hostile traffic" in "\n".join(whole)
    many = [replace(quiet, node_id=f"t.py::test_{number}[search]") for number in range(500)]
    assert len(terminal.session_lines(session_of(searches=many))) == 1000
    assert (
        "\n".join(terminal.session_lines(session_of(searches=many), is_whole=True)).count(
            "hostile traffic"
        )
        == 1
    )


def test_a_summary_has_eight_lines_and_the_whole_one_all_kinds_and_counts():
    finds = tuple(named(f"front-2-{number}", alike=Alike(runs=number)) for number in range(6))
    random = Counter(runs=20, at_fault=3)
    search = replace(
        SEARCH, finds=finds, warnings=(), notes=(), random=random, no_worse={"a": "hit"}
    )
    short, whole = (terminal.search_lines(search, is_whole=is_whole) for is_whole in (False, True))
    assert len(short) <= 8 + 2  # the first line and that on failures elsewhere are wrapped
    assert "  5 more kinds of failures." in short
    assert not any("more kinds" in line for line in whole)
    for each in finds:
        assert sum(line.startswith(f"  {each.id}: ") for line in whole) == 1
    assert "48 runs (2 invalid, 1 rejected and 1 skipped)" in " ".join(short)
    assert "  5 of these runs had no interaction." in whole
    assert "  NPCs reached 63 % of their goals." in whole
    assert "  Algorithm: pafot, with seed 4154884243 from --pafot-seed=3." in whole
    assert not {"interaction.", "reached", "Algorithm:"} & {
        word for line in short for word in line.split()
    }


def test_of_a_search_that_ended_early_and_of_its_decisions_the_summary_tells():
    search = replace(
        SEARCH, decisions=Counter(search=3923, shrink=8357), more_runs=Counter(shrink=3, moment=4)
    )
    lines = terminal.search_lines(search)
    assert "1 skipped), 7 more to analyse failures and 12,280 decisions took" in " ".join(
        map(str.strip, lines)
    )
    cut = replace(search, reason=Ending.INTERRUPTED, asked={"runs": 100})
    assert (
        "  The search ended early, after 48 of 100 runs, because it was interrupted."
        in terminal.search_lines(cut)
    )


@pytest.mark.parametrize("reason", [each for each in Ending if not each.is_complete])
def test_the_summary_says_why_a_search_ended_early_if_that_is_known(reason):
    lines = terminal.search_lines(replace(SEARCH, reason=reason))
    (line,) = [each for each in lines if "The search ended early" in each]
    assert (", because " in line) == (reason is not Ending.UNKNOWN)


def test_the_summary_of_a_session_reads_so(snapshot):
    flaky = named("rear-6-222222", flaky=NOT_REPEATED, alike=Alike())
    lost = named("left-8-333333", path="", detail="read-only file system")
    other = replace(
        SEARCH, node_id="tests/test_safety.py::test_other[search]", finds=(flaky, lost),
        more_runs=Counter(known=3, shrink=49), known={}, warnings=(), notes=(),
    )  # fmt: skip
    running = Search(node_id="tests/test_safety.py::test_third[search]", seed=1)
    session = session_of(
        searches=[SEARCH, running, other],
        seen=[
            sighting("saved-a", label="fixed"),
            sighting("saved-b", label="still failing"),
            sighting("saved-c", label="drifted", detail="numpy 2 instead of 1"),
        ],
        left=["corpus/x.pafot.yaml", "corpus/y.pafot.yaml"],
        problems=["a fault in the page"],
        written=["report: report.html (1 finding)"],
        notes=["processes are off"],
    )
    lines = terminal.session_lines(session)
    assert "\n".join(lines) == snapshot
    assert all(line.isascii() for line in lines)
    assert all(len(line) <= 80 for line in lines if line.startswith("  "))


def test_the_failure_of_a_search_reads_so(snapshot):
    flaky = named("rear-6-222222", flaky=NOT_REPEATED)
    search = replace(SEARCH, finds=(FIND, flaky))
    assert terminal.failure_message(search) == snapshot


def test_progress_is_one_line_with_the_name_cut():
    progress = Progress(
        node_id="x" * 200, generation=3, generations=100, runs=9, failing=2, finds=1, seconds=3.0
    )
    line = terminal.progress_line(progress)
    assert len(line) <= 80
    assert line.startswith("pafot: ...xxx")
    assert line.endswith("3/100 generations, 9 runs, 2 failed, 1 new, 3 runs/s")
    assert terminal.progress_line(replace(progress, seconds=120.0)).endswith(
        "2 failed, 1 new, 13 s per run"
    )
    narrow = terminal.progress_line(progress, 39)
    assert (len(narrow), narrow.endswith("xxx 3/100 generations, ")) == (39, True)
    after = "shrinking saved-front-2-1f3a9c, run 3 of at most 300"
    assert terminal.progress_line(replace(progress, phase=after), 100).endswith(after)


LIMIT = "limit it with --pafot-max-time=600"


@table(("runs", "seconds", "fields", "end"), [
    (4, 0.5, {"left": 50, "decision_seconds": 0.01}, "8 runs/s"),
    (4, 4.0, {"left": 396, "decision_seconds": 0.01}, "1 run/s, about 7 min left at 10 ms per decision"),
    (4, 80.0, {"left": 7920, "decision_seconds": 0.2}, f"h left at 200 ms per decision; {LIMIT}"),
    (4, 80.0, {"left": 7920, "is_limited": True}, "20 s per run, about 2.2 h left"),
    (400, 8000.0, {"decision_seconds": 0.2}, "20 s per run"),
    (0, 0.0, {}, "0 new, 0 runs/s"),
])  # fmt: skip
def test_progress_says_how_long_the_runs_take_that_are_left(runs, seconds, fields, end):
    progress = Progress(
        node_id="x", generation=1, generations=None, budget=400, runs=runs, seconds=seconds, failing=0, finds=0,
        **fields,
    )  # fmt: skip
    assert terminal.progress_line(progress, 200).endswith(end)


@table(("flags", "remark"), [
    ({}, ""),
    ({"flaky": NOT_REPEATED}, "flaky: running it again gave a different run"),
    ({"expect": replace(FIND.finding.expect, outcome=Outcome.HANG)}, "the result depends on wall-clock time"),
])  # fmt: skip
def test_finding_has_remark_when_reader_needs_it(flags, remark):
    assert sighting(headline="c", finding=flags).remark == remark


def test_a_replay_says_what_was_driven_and_what_the_search_found(snapshot):
    passes = replace(sighting("saved-a", label="passes"), test="t")
    searches = {
        "t": replace(
            SEARCH, node_id="t[search]", reason=Ending.RUNS, kinds=Counter(passed=297, invalid=3)
        )
    }
    other = {"t": replace(searches["t"], failures=(("hit-2", passes.finding.signature),))}
    cut = {"t": replace(searches["t"], reason=Ending.INTERRUPTED)}
    drawn, some = ({"t": replace(searches["t"], random=Counter(runs=runs))} for runs in (297, 20))
    shown = [
        terminal.replay_lines([concluded(passes, each)], 200)
        for each in ({}, searches, other, cut, drawn, some)
    ]
    assert ["\n".join(lines[1:]) for lines in shown] == snapshot
    failing = replace(sighting("saved-a", label="still failing"), test="t")
    assert concluded(failing, other) is failing


@table("width", [60, 80, 120])
def test_lines_are_wrapped_to_the_terminal_width(width):
    lines = terminal.session_lines(session_of(searches=[SEARCH]), width=width)
    assert max(map(len, lines)) <= width
    assert " ".join(" ".join(lines).split()) == " ".join(
        " ".join(terminal.session_lines(session_of(searches=[SEARCH]), width=999)).split()
    )


@table(("line", "width", "prefix", "lines"), [
    ("  20 runs in 0.5 s, 0 failing, 3 npc at fault", 36, "", ["  20 runs in 0.5 s, 0 failing, 3 npc", "    at fault"]),
    ("E       one two three", 15, "E   ", ["E       one two", "E         three"]),
    # No line ends between a number and its unit.
    *((f"  one two {kept} andsoon", 13, "", ["  one two", f"    {kept}", "    andsoon"])
      for kept in ("37.9 %)", "7.5 m/s,", "6 m/s^2", "1.9 s", "NPC 0,")),
])  # fmt: skip
def test_lines_are_wrapped_between_words_and_keep_their_mark_and_indentation(
    line, width, prefix, lines
):
    assert wrapped_to(line, width, prefix) == lines
