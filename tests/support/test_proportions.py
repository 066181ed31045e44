"""Exact intervals and tests of shares, against the sums of binomial chances that define them."""

import re
from itertools import product
from math import comb

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.support.proportions import (
    FEWEST,
    difference,
    hits_more,
    holm,
    interval,
    interval_text,
    mcnemar,
    none_text,
    percent,
    upper_bound,
)
from tests.helpers.tables import table


def at_most(hits, trials, share):
    """Return the chance of so many hits or fewer, if each trial hits by this share."""
    return sum(comb(trials, k) * share**k * (1 - share) ** (trials - k) for k in range(hits + 1))


@table(
    ("hits", "trials"), [(0, 378), (2, 100), (38, 1000), (95, 100), (100, 100), (0, 1), (7, 5_000)]
)
def test_an_interval_is_that_of_clopper_and_pearson(hits, trials):
    low, high = interval(hits, trials)
    below = 0.025 if hits == 0 else 1 - at_most(hits - 1, trials, low)
    above = 0.025 if hits == trials else at_most(hits, trials, high)
    assert (below, above) == pytest.approx((0.025, 0.025), rel=1e-9)
    assert (low == 0.0, high == 1.0) == (hits == 0, hits == trials)


def test_trials_without_hits_have_the_upper_end_of_the_interval():
    for trials in (1, 20, 150, 5_000):  # never rounded down
        most = float(re.search("at most (.*?) %", none_text(trials))[1]) / 100
        assert interval(0, trials)[1] - 1e-9 <= most < 1.05 * interval(0, trials)[1] + 0.001
    assert at_most(3, 300, upper_bound(3, 300, 0.99)) == pytest.approx(0.01, rel=1e-9)


@table(("first", "second"), [(0, 0), (3, 12), (12, 3), (5, 5), (0, 40)])
def test_paired_shares_are_compared_by_mcnemar_test(first, second):
    exact = min(1.0, 2 * at_most(min(first, second), first + second, 0.5))
    assert mcnemar(first, second) == pytest.approx(exact, rel=1e-9)


def chances(share, trials, *, is_last=False):
    """Return the chances that ``hits_more`` ends with True and with False, if the first hits this share of trials."""
    open_, ended = {(0, 0): 1.0}, {True: 0.0, False: 0.0, None: 0.0}
    for _ in range(trials):
        after = {}
        for (first, second), chance in open_.items():
            for counts, part in (((first + 1, second), share), ((first, second + 1), 1 - share)):
                answer = hits_more(*counts)
                if answer is None:
                    after[counts] = after.get(counts, 0.0) + chance * part
                else:
                    ended[answer] += chance * part
        open_ = after
    for counts, chance in open_.items():
        ended[hits_more(*counts, is_last=is_last)] += chance
    return ended


def test_sequential_test_is_wrong_as_seldom_as_it_promises():
    alike, worse = chances(0.5, 400), chances(0.7, 400)
    assert alike[True] < 0.01
    assert alike[False] > 0.98
    assert worse[False] < 0.05
    assert worse[True] > 0.95
    assert max(chances(0.5, trials, is_last=True)[True] for trials in range(60)) < 0.02


def test_sequential_test_ends_early_and_after_its_last_trial():
    assert FEWEST == 7
    last = {
        (7, 0): True,
        (6, 0): None,
        (5, 1): None,
        (26, 10): True,
        (31, 15): False,
        (3, 4): False,
    }
    assert {counts: hits_more(*counts, is_last=True) for counts in last} == last
    assert [hits_more(first, 0) for first in (0, 13, 14)] == [None, None, True]
    assert [hits_more(0, second) for second in (5, 6)] == [None, False]
    open_ = {(16, 1): True, (15, 1): None, (10, 10): None, (40, 40): False}
    assert {counts: hits_more(*counts) for counts in open_} == open_


def test_share_is_printed_with_interval_or_upper_bound():
    assert interval_text(38, 1000) == "3.8 % (95 %: 2.7 to 5.2 %)"
    assert interval_text(0, 378) == "0 % (95 %: at most 0.98 %)"
    shares = [percent(share) for share in (0.0, 0.0012, 0.5, 1.0)]
    assert shares == ["0 %", "0.12 %", "50.0 %", "100 %"]


def test_difference_of_shares_spans_ends_of_their_intervals():
    # of 8 and 31 of 200, with 97.5 %
    one, other = (0.015288277, 0.083160941), (0.102068673, 0.221237474)
    for hits, (low, high) in ((8, one), (31, other)):
        assert (1 - at_most(hits - 1, 200, low), at_most(hits, 200, high)) == pytest.approx(
            (0.0125, 0.0125), rel=1e-6
        )
    assert difference(8, 31, 200) == pytest.approx((one[0] - other[1], one[1] - other[0]), abs=1e-8)


def test_p_values_are_adjusted_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=10))
def test_adjusted_p_values_preserve_order_up_to_one(values):
    adjusted = holm(values)
    assert all(p <= q <= 1 for p, q in zip(values, adjusted, strict=True))
    for (p, q), (r, s) in product(zip(values, adjusted, strict=True), repeat=2):
        assert q <= s or p >= r
