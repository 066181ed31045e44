"""Statistics against examples worked by hand, other implementations and simulated samples."""

import math

import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.comparison.run_measures import (
    a12,
    a12_interval,
    effect_size,
    fisher_p,
    log_rank,
    survival,
)

samples = st.lists(st.integers(0, 9).map(float), min_size=1, max_size=12)


class TestEffect:
    @given(samples, samples)
    def test_a12_is_the_u_statistic_over_the_pairs(self, x, y):
        u = (
            scipy.stats.mannwhitneyu(x, y, method="asymptotic").statistic
            if len({*x, *y}) > 1
            else len(x) * len(y) / 2
        )
        assert a12(x, y) == pytest.approx(u / (len(x) * len(y)))

    @given(samples, samples)
    def test_swapping_samples_mirrors_the_effect_with_same_p(self, x, y):
        there, back = effect_size(x, y), effect_size(y, x)
        assert there.a12 == pytest.approx(1 - back.a12)
        assert (there.low, there.high) == pytest.approx((1 - back.high, 1 - back.low), abs=1e-6)
        assert there.p == pytest.approx(back.p)

    @given(samples, samples)
    def test_interval_contains_the_estimate_and_stays_in_range(self, x, y):
        effect = effect_size(x, y)
        assert 0 <= effect.low <= effect.a12 <= effect.high <= 1

    @pytest.mark.parametrize(
        ("estimate", "sizes"), [(1.0, (10, 10)), (0.7, (10, 20)), (0.3, (5, 8))]
    )
    def test_ends_of_the_interval_follow_its_equation(self, estimate, sizes):
        """An end v has (v - e)^2 m n = z^2 v (1 - v) (1 + N (1 - v) / (2 - v) + N v / (1 + v)), N = (m + n) / 2 - 1."""
        (m, n), others = sizes, sum(sizes) / 2 - 1
        ends = a12_interval(estimate, m, n)
        assert ends[0] < estimate <= ends[1]
        for v in ends:
            spread = 1 + others * (1 - v) / (2 - v) + others * v / (1 + v)
            assert (v - estimate) ** 2 * m * n == pytest.approx(
                1.959964**2 * v * (1 - v) * spread, rel=1e-5
            )

    def test_the_test_is_scipys_two_sided_one(self):
        x, y = [1.0, 4.0, 6.0, 7.0], [2.0, 3.0, 5.0, 0.0]
        assert effect_size(x, y).p == scipy.stats.mannwhitneyu(x, y, alternative="two-sided").pvalue

    def test_samples_of_one_value_show_no_difference(self):
        assert effect_size([3.0] * 5, [3.0] * 5).p == 1.0

    def test_runs_without_any_collision_rank_last(self):
        effect = effect_size([40.0, 50.0, 60.0], [math.inf, math.inf, 70.0])
        assert effect.a12 == 0.0
        assert effect.p == pytest.approx(0.0765, abs=0.03)


def test_ten_of_ten_against_none_has_exact_p():
    assert fisher_p((10, 10), (0, 10)) == pytest.approx(2 / math.comb(20, 10))


class TestSurvival:
    def test_by_hand(self):
        """Events at 2, 5 and 5, one run censored at 3, one at 9: 4/5, then of three left two fall: 4/5 * 1/3."""
        estimate = survival([2, 3, 5, 5, 9], [False, True, False, False, True])
        at = dict(zip(estimate.times.tolist(), estimate.shares.tolist(), strict=True))
        assert (at[2], at[3], at[5], at[9]) == pytest.approx((0.8, 0.8, 0.8 / 3, 0.8 / 3))
        assert estimate.median == 5

    def test_survival_without_event_has_no_median(self):
        estimate = survival([7, 8], [True, True])
        assert estimate.shares.tolist() == [1.0, 1.0]
        assert estimate.median == math.inf

    def test_without_censoring_the_median_is_the_middle(self):
        assert survival([4, 1, 3, 2, 5], [False] * 5).median == 3

    def test_log_rank_test_sums_observed_minus_expected(self):
        x, y = [1.0, 4.0, 5.0], [2.0, 3.0, 6.0, 7.0]
        observed = expected = variance = 0.0
        for time in sorted([*x, *y]):
            at_risk_x, at_risk_y = sum(t >= time for t in x), sum(t >= time for t in y)
            at_risk = at_risk_x + at_risk_y
            observed += time in x
            expected += at_risk_x / at_risk
            variance += at_risk_x * at_risk_y / at_risk**2
        z = (observed - expected) / math.sqrt(variance)
        assert log_rank(x, [False] * 3, y, [False] * 4) == pytest.approx(
            2 * scipy.stats.norm.sf(abs(z))
        )

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize(("x", "x_is_censored", "y", "y_is_censored"), [
        ([6, 6], [False, False], [6, 6], [False, False]),  # all failed at once
        ([1, 1], [True, True], [2, 3, 4], [False] * 3),  # the samples are never at risk together
        ([5, 5], [True, True], [6, 6], [True, True]),  # nobody found anything
    ])  # fmt: skip
    def test_samples_without_a_comparable_event_do_not_differ(
        self, x, x_is_censored, y, y_is_censored
    ):
        assert log_rank(x, x_is_censored, y, y_is_censored) == 1.0
