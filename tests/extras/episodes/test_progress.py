"""The verdict on two versions of a policy, from their results in the same situations."""

import json
from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.campaign.verdict import judge
from pytest_pafot.extras.episodes.progress_command import (
    LEVEL,
    PairRow,
    Result,
    lines_of,
    sentence_of,
    text_of,
    verdict_of,
)
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.proportions import mcnemar
from tests.helpers.traces import trace_of, vehicle


def rows(part, *counts):
    """Return rows of one part from `(count, old failed, new failed)`."""
    pairs = [(old, new) for count, old, new in counts for _ in range(count)]
    return [
        PairRow(part=part, name=str(number), old=Result(failed=old), new=Result(failed=new))
        for number, (old, new) in enumerate(pairs)
    ]


def measured(*pairs):
    """Return rows of scenarios in which both fail at these speeds [m/s], or with these margins of a check."""
    return [
        PairRow(
            part="scenarios",
            name=str(number),
            old=Result(failed=True, impact=old["impact"], margins=old["margins"]),
            new=Result(failed=True, impact=new["impact"], margins=new["margins"]),
        )
        for number, (old, new) in enumerate(pairs)
    ]


def said(rows):
    return sentence_of("before:make", "now:make", lines_of(rows))


BETTER = rows("scenarios", (23, True, True), (31, True, False), (8, False, True), (138, False, False))
ALIKE = rows("episodes", (2, True, True), (1, True, False), (2, False, True), (295, False, False))


def test_fewer_failures_are_claimed_with_adjusted_p():
    failures, crashes = lines_of([*BETTER, *ALIKE])
    assert (failures.old, failures.new, failures.better, failures.worse, failures.pairs) == (54, 31, 31, 8, 200)
    assert failures.p == pytest.approx(2 * mcnemar(31, 8))
    assert crashes.p == 1.0
    assert said([*BETTER, *ALIKE]) == (
        "now:make is better than before:make: fewer failures of its own: 31 instead of 54 of 200 (p = 0.00059); "
        "not told apart: crashes in ordinary traffic (4 against 3 of 300, 95 %: -2.1 to +2.7 points)"
    )


def test_worse_line_does_not_cancel_a_better_one():
    harder = rows("episodes", (12, False, True), (288, False, False))
    assert verdict_of(lines_of([*BETTER, *harder])) == "better and worse"
    assert "; more crashes in ordinary traffic: 12 instead of 0 of 300 (p = 0.00059)" in said([*BETTER, *harder])


def test_saved_or_one_sided_rows_compare_nothing():
    chosen = [*rows("saved", (40, True, False)), *rows("alone", (40, True, False))]
    silent = rows("scenarios", (40, True, None), (40, None, True))
    assert lines_of([*chosen, *silent]) == []
    assert said(chosen) == "now:make is not told apart from before:make: no run says anything of both"


def test_impacts_are_compared_only_where_both_fail():
    pairs = [({"impact": 9.0, "margins": {"gap": 0.1}}, {"impact": 4.0, "margins": {"gap": 0.3}})] * 20
    nearly = [({"impact": 9.0, "margins": {"gap": 0.1}}, {"impact": 9.05, "margins": {"gap": 0.105}})] * 9
    alone = [({"impact": 9.0, "margins": {"gap": 0.1}}, {"impact": None, "margins": {}})]
    lines = lines_of(measured(*pairs, *nearly, *alone))
    assert [(line.what, line.better, line.worse, line.pairs) for line in lines[1:]] == [
        ("impacts where both fail", 20, 0, 29),
        ("margins of gap", 20, 0, 29),
    ]
    assert sentence_of("a", "b", lines).startswith(
        "b is better than a: milder impacts where both fail: 4 instead of 9 m/s in the median of 29 (p < 0.0001); "
        "larger margins of gap: 0.3 instead of 0.1 in the median of 29 (p < 0.0001); not told apart: failures of its"
    )
    assert "margins of gap (0.105 against 0.1 in the median of 9, better in 0, worse in 0)" in said(measured(*nearly))


numbers = st.tuples(st.none() | st.floats(0, 30), st.dictionaries(st.sampled_from("ab"), st.floats(-2, 2)))
results = st.tuples(st.sampled_from([None, True, False]), numbers).map(
    lambda drawn: Result(failed=drawn[0], impact=drawn[1][0], margins=drawn[1][1])
)
parts = st.sampled_from(["scenarios", "episodes", "saved"])


@given(st.lists(st.builds(PairRow, part=parts, name=st.just(""), old=results, new=results), max_size=30))
def test_reversed_comparison_reverses_the_verdict(rows):
    there = lines_of(rows)
    back = lines_of([PairRow(part=row.part, name=row.name, old=row.new, new=row.old) for row in rows])
    same = [(line.what, line.p, line.old, line.better) for line in there]
    assert sorted(same) == sorted((line.what, line.p, line.new, line.worse) for line in back)
    itself = lines_of([PairRow(part=row.part, name=row.name, old=row.new, new=row.new) for row in rows])
    assert verdict_of(itself) == "not told apart"
    assert all(line.p == 1.0 for line in itself)


def test_row_is_the_same_after_saving_it():
    row = PairRow(
        part="saved", name="x", old=Result(failed=None), new=Result(failed=True, impact=3.5, margins={"gap": 0.1})
    )
    assert PairRow.of_data(json.loads(json.dumps(asdict(row)))) == row


def holds(run):
    pafot.target(run.duration, name="duration")
    pafot.check(run.ego.speed, name="speed", at_most=40.0)
    assert not run.collision


def test_margins_come_from_bounded_checks_in_whole_runs():
    ego, npc = vehicle(0.0, speed=20.0, ticks=9), vehicle(30.0, speed=10.0, ticks=9)
    whole, hit = Run(trace_of(ego, npc)), Run(trace_of(ego, npc, outcome=Outcome.COLLISION))
    kept, crashed = (Result.of(run, judge(run, holds, blame="any", test_file=__file__)) for run in (whole, hit))
    assert (kept.failed, kept.impact, kept.margins) == (False, None, {"speed": 0.5})
    assert (crashed.failed, crashed.impact, crashed.margins) == (True, hit.collision.closing_speed, {})


def test_text_names_introduced_worsened_and_new_failures():
    nothing, fails, passes = Result(), Result(failed=True), Result(failed=False)
    known = [
        PairRow(part="saved", name="a", old=nothing, new=nothing, told="introduced"),
        PairRow(part="saved", name="b", old=nothing, new=nothing, told="common", worse="hits at 12.1 m/s, 8.0 before"),
        PairRow(part="saved", name="c", old=nothing, new=nothing, told="common"),
        PairRow(part="alone", name="d", old=passes, new=fails, told="collision after 5.4 s"),
        PairRow(part="episodes", name="7", old=passes, new=fails, told="BadAction: 9"),
    ]
    text = text_of("before:make", "now:make", [*BETTER, *known], 200)
    assert text.startswith("now:make is better than before:make: ")
    lines = text_of("before:make", "now:make", [*BETTER, *known], 60).splitlines()
    assert max(map(len, lines)) <= 60
    assert lines[lines.index("") + 1].startswith("failures of its own: old 54, new 31; new better in 31,")
    told = "worse in 8 of 200; new - old -20.6 to -1.9 points (95 %); p 0.00059 (Holm); better"
    assert told in " ".join(text.split())
    assert text.endswith(
        "- 3 saved scenarios: 2 common (both fail), 1 introduced (only the new fails)\n"
        "  - introduced: a\n  - worse: b hits at 12.1 m/s, 8.0 before\n"
        "- a search found 1 kind of failure that only now:make has\n  - d: collision after 5.4 s\n"
        "- a search found 0 kinds of failure that only before:make has\n"
        "- errors in 1 episode count as crashes; seed 7: BadAction: 9\n"
    )


def test_equal_policies_are_rarely_claimed_to_differ():
    by_chance = [
        verdict_of(lines_of(rows("scenarios", (better, True, False), (20 - better, False, True), (180, False, False))))
        for better in range(21)
    ]
    told = [better for better, verdict in enumerate(by_chance) if verdict != "not told apart"]
    assert told == [*range(4), *range(17, 21)]  # binomial(20, 1/2): 2 * 0.0013
    assert LEVEL == 0.01
