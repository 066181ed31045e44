"""Exact intervals and tests of shares, against scipy's."""

import pytest
import scipy

from pytest_pafot.support.proportions import interval, interval_text, mcnemar, percent, upper_bound
from tests.helpers.tables import table


@pytest.mark.parametrize(
    ("hits", "trials"), [(0, 378), (2, 100), (38, 1000), (95, 100), (100, 100), (0, 1), (7, 5_000)]
)
def test_an_interval_is_that_of_clopper_and_pearson(hits, trials):
    exact = scipy.stats.binomtest(hits, trials).proportion_ci(0.95, method="exact")
    assert interval(hits, trials) == pytest.approx((exact.low, exact.high), abs=1e-12)


def test_an_upper_bound_is_one_end_with_all_of_the_error_there():
    exact = scipy.stats.binomtest(3, 300, alternative="less").proportion_ci(0.99, method="exact")
    assert upper_bound(3, 300, 0.99) == pytest.approx(exact.high, abs=1e-12)


@table(("first", "second"), [(0, 0), (3, 12), (12, 3), (5, 5), (0, 40)])
def test_the_test_of_two_shares_on_the_same_trials_is_mcnemars(first, second):
    exact = scipy.stats.binomtest(first, first + second).pvalue if first + second else 1.0
    assert mcnemar(first, second) == pytest.approx(exact, rel=1e-9)


def test_a_share_is_told_with_its_interval_and_none_with_an_upper_bound():
    assert interval_text(38, 1000) == "3.8 % (95 %: 2.7 to 5.2 %)"
    assert interval_text(0, 378) == "0 % (95 %: at most 0.97 %)"
    assert [percent(share) for share in (0.0, 0.0012, 0.5, 1.0)] == ["0 %", "0.12 %", "50.0 %", "100 %"]
