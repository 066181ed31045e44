"""The lines that tell failing neighbours from passing ones."""

import math
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.lines import Line, Ranked, TellingLine, ranked

RUNS = st.lists(
    st.dictionaries(st.integers(1, 6).map(lambda number: Line("a.py", 10 * number, f"f{number}")), st.integers(1, 31)),
    max_size=6,
)


def line(number, function="f", file="a.py"):
    return Line(file, number, function)


def ran(*lines):
    """Return a run in which some lines ran, each in one decision."""
    return dict.fromkeys(lines, 1)


def test_a_line_that_ran_only_in_failing_neighbours_is_first():
    always, bad, rare = line(1), line(5, "g"), line(9, "h")
    failing, passing = [ran(always, bad), ran(always, bad, rare)], [ran(always), ran(always)]
    assert ranked(failing, passing) == [Ranked(bad, 2, 0), Ranked(rare, 1, 0)]


def test_without_failing_or_passing_neighbours_no_line_tells_anything():
    assert ranked([], [ran(line(1))]) == ranked([ran(line(1))], []) == []


def test_of_lines_that_tell_as_much_the_one_of_fewer_decisions_is_first():
    often, seldom = line(1), line(5, "g")
    assert [each.line for each in ranked([{often: 9, seldom: 2}], [{}])] == [seldom, often]


def test_a_line_that_ran_in_nearly_as_many_passing_runs_tells_nothing():
    runs = [ran(line(1))] * 20
    assert ranked(runs, [*runs[:17], *[ran()] * 3]) == []
    assert ranked(runs, [*runs[:16], *[ran()] * 4]) == [Ranked(line(1), 20, 16)]


def test_lines_that_ran_together_are_one_place_unless_others_are_between():
    block, other, after = [line(3), line(4)], line(5), line(6)
    failing, passing = [ran(*block, other, after)], [ran(other)]
    assert [each.line for each in ranked(failing, passing)] == [line(3), line(6)]
    elsewhere = line(4, "g")
    assert [each.line for each in ranked([ran(line(3), elsewhere)], [ran()])] == [line(3), elsewhere]


def share(line, runs):
    return sum(line in run for run in runs) / len(runs)


@given(RUNS, RUNS)
def test_ranks_are_ochiais_and_each_line_fails_more_often_than_it_passes(failing, passing):
    found = ranked(failing, passing)

    def ochiai(each):
        bad, good = (sum(each in ran for ran in runs) for runs in (failing, passing))
        return bad / math.sqrt(len(failing) * (bad + good))

    ranks = [ochiai(each.line) for each in found]
    assert all(first >= second - 1e-12 for first, second in pairwise(ranks))
    expected = {
        each
        for each in set().union(*failing)
        if passing
        and ochiai(each)
        and sum(each in r for r in failing) / len(failing) - sum(each in r for r in passing) / len(passing)
        >= 0.2 - 1e-9
    }
    assert {each.line for each in found} == expected
    for each in found:
        assert (each.failing, each.passing) == tuple(
            sum(each.line in ran for ran in runs) for runs in (failing, passing)
        )


def test_a_telling_line_in_words():
    told = TellingLine(
        file="planner.py",
        number=48,
        function="gap",
        text="return max(a, 0.0)",
        failing=19,
        of_failing=20,
        passing=0,
        of_passing=40,
    )
    assert str(told) == (
        "planner.py:48 in gap: `return max(a, 0.0)` ran in 19 of 20 neighbours that fail, in 0 of 40 that pass"
    )
