"""The statistics of the benchmark of planted defects, on data worked out by hand."""

import math

import numpy as np
import pytest

from tests.benchmarks.survival import Sample, common_limit, ratio_interval


def curve(times, found=None):
    return Sample.of(times, [True] * len(times) if found is None else found).curve


def median(each):
    return each.median


def test_censored_search_leaves_curve_without_a_step():
    each = curve([1, 2, 3, 4], [True, False, True, False])
    assert each.times.tolist() == [1, 2, 3, 4]
    assert each.shares == pytest.approx([3 / 4, 3 / 4, 3 / 8, 3 / 8])
    assert each.median == 3


def test_a_median_that_is_not_reached_is_infinite():
    each = curve([10, 50, 50], [True, False, False])
    assert each.median == math.inf
    assert each.median_interval == (10, math.inf)
    assert curve([50, 50], [False, False]).median_interval == (math.inf, math.inf)


def test_median_interval_is_where_band_contains_one_half():
    """Freireich's remission times of 6-MP have the median 23 weeks, 95 % from 13 on (R's survfit, log-log)."""
    found = [6, 6, 6, 7, 10, 13, 16, 22, 23]
    censored = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
    each = curve([*found, *censored], [True] * len(found) + [False] * len(censored))
    assert each.median == 23
    assert each.median_interval == (13, math.inf)


def test_the_interval_of_uncensored_times():
    """Freireich's controls have the median 8 weeks, 95 % from 4 to 11 (R's survfit, log-log)."""
    each = curve([1, 1, 2, 2, 3, 4, 4, 5, 5, 8, 8, 8, 8, 11, 11, 12, 12, 15, 17, 22, 23])
    assert each.median == 8
    assert each.median_interval == (4, 11)
    low, high = each.band
    assert (low <= each.shares).all()
    assert (each.shares <= high).all()


def test_mean_is_the_area_up_to_the_limit():
    assert curve([2, 4]).mean(10) == 3
    assert curve([2, 10], [True, False]).mean(10) == 0.5 * 2 + 0.5 * 10
    assert curve([2, 4]).mean(3) == 0.5 * 2 + 0.5 * 3
    assert curve([10, 10], [False, False]).mean(10) == 10


def test_means_end_where_the_first_unfinished_curve_does():
    done, open_ = curve([5, 30]), curve([5, 20], [True, False])
    assert common_limit([done, open_]) == 20
    assert common_limit([done, curve([7])]) == 30


class TestRatio:
    def test_constant_factor_gives_exact_ratio_of_paired_samples(self):
        times = np.random.default_rng(1).integers(1, 100, 40).astype(float)
        found = [True] * 40
        each = ratio_interval(
            median, Sample.of(3 * times, found), Sample.of(times, found), [0] * 40, draws=50
        )
        assert each == (3, 3)

    def test_strata_keep_their_sizes(self):
        """Two defects have one time each: the mean stays the same however seeds are resampled."""
        first = Sample.of([1, 1, 1, 9, 9, 9], [True] * 6)
        second = Sample.of([2] * 6, [True] * 6)
        strata = ["soon"] * 3 + ["late"] * 3
        assert ratio_interval(
            lambda each: each.mean(10), first, second, strata, draws=50
        ) == pytest.approx((2.5, 2.5))
        low, high = ratio_interval(lambda each: each.mean(10), first, second, [0] * 6, draws=50)
        assert low < 2.5 < high
