"""Exact intervals and tests of shares, against scipy's."""

from itertools import product

import pytest
import scipy
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
    percent,
    upper_bound,
)
from tests.helpers.tables import table


@pytest.mark.parametrize(
    ("hits", "trials"), [(0, 378), (2, 100), (38, 1000), (95, 100), (100, 100), (0, 1), (7, 5_000)]
)
def test_an_interval_is_that_of_clopper_and_pearson(hits, trials):
    exact = scipy.stats.binomtest(hits, trials).proportion_ci(0.95, method="exact")
    assert interval(hits, trials) == pytest.approx((exact.low, exact.high), abs=1e-12)


def test_upper_bound_puts_all_error_at_one_end():
    exact = scipy.stats.binomtest(3, 300, alternative="less").proportion_ci(0.99, method="exact")
    assert upper_bound(3, 300, 0.99) == pytest.approx(exact.high, abs=1e-12)


@table(("first", "second"), [(0, 0), (3, 12), (12, 3), (5, 5), (0, 40)])
def test_paired_shares_are_compared_by_mcnemar_test(first, second):
    exact = scipy.stats.binomtest(first, first + second).pvalue if first + second else 1.0
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
    last = ((7, 0), (6, 0), (5, 1), (26, 10), (31, 15), (3, 4))
    assert [hits_more(*counts, is_last=True) for counts in last] == [True, None, None, True, False, False]
    assert [hits_more(first, 0) for first in (0, 13, 14)] == [None, None, True]
    assert [hits_more(0, second) for second in (5, 6)] == [None, False]
    assert [hits_more(*counts) for counts in ((16, 1), (15, 1), (10, 10), (40, 40))] == [True, None, None, False]


def test_share_is_printed_with_interval_or_upper_bound():
    assert interval_text(38, 1000) == "3.8 % (95 %: 2.7 to 5.2 %)"
    assert interval_text(0, 378) == "0 % (95 %: at most 0.97 %)"
    assert [percent(share) for share in (0.0, 0.0012, 0.5, 1.0)] == ["0 %", "0.12 %", "50.0 %", "100 %"]


def test_difference_of_shares_spans_ends_of_their_intervals():
    one, other = (scipy.stats.binomtest(hits, 200).proportion_ci(0.975, method="exact") for hits in (8, 31))
    assert difference(8, 31, 200) == pytest.approx((one.low - other.high, one.high - other.low), abs=1e-12)


def test_p_values_are_adjusted_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=10))
def test_adjusted_p_values_preserve_order_up_to_one(values):
    adjusted = holm(values)
    assert all(p <= q <= 1 for p, q in zip(values, adjusted, strict=True))
    for (p, q), (r, s) in product(zip(values, adjusted, strict=True), repeat=2):
        assert q <= s or p >= r
