"""Kaplan-Meier's estimate and its figures for the times until searches find something; some end without."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

CONFIDENCE = 0.95
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sample:
    """One time per search: until it found something or, if it did not, until it ended."""

    times: Floats
    found: NDArray[np.bool_]

    @classmethod
    def of(cls, times: Sequence[float], found: Sequence[bool]) -> Sample:
        return cls(np.asarray(times, dtype=float), np.asarray(found, dtype=bool))

    @cached_property
    def curve(self) -> Curve:
        """Return Kaplan-Meier's estimate (JASA 53, 1958)."""
        data = scipy.stats.CensoredData.right_censored(self.times, ~self.found)
        estimate = scipy.stats.ecdf(data).sf
        return Curve(
            estimate,
            np.asarray(estimate.quantiles, float),
            np.asarray(estimate.probabilities, float),
        )


@dataclass(frozen=True)
class Curve:
    """The share of searches that have not found it yet, from each of the times on."""

    estimate: Any
    times: Floats
    shares: Floats

    @cached_property
    def band(self) -> tuple[Floats, Floats]:
        """Return lower and upper limits of the shares, pointwise, by Greenwood's variance of log(-log(share))."""
        with warnings.catch_warnings():  # there is no such variance if the share is 1 or 0
            warnings.simplefilter("ignore", RuntimeWarning)
            band = self.estimate.confidence_interval(CONFIDENCE, method="log-log")
        low, high = band.low.probabilities, band.high.probabilities
        # A share of 0 keeps the previous upper limit: a few searches that all found it do not prove a share of 0.
        return np.where(np.isnan(low), self.shares, low), np.minimum.accumulate(
            np.nan_to_num(high, nan=1.0)
        )

    @property
    def median(self) -> float:
        """Return the first time at which half have found it, or infinity."""
        return self._reaches_half(self.shares)

    @property
    def median_interval(self) -> tuple[float, float]:
        """Return the times at which the band contains one half (Brookmeyer, Crowley, Biometrics 38, 1982)."""
        low, high = self.band
        return self._reaches_half(low), self._reaches_half(high)

    def mean(self, limit: float) -> float:
        """Return the mean time until it is found or the limit is reached: the area below the curve."""
        inside = self.times < limit
        edges = np.array([0.0, *self.times[inside], limit])
        return float(np.sum(np.diff(edges) * np.array([1.0, *self.shares[inside]])))

    def _reaches_half(self, shares: Floats) -> float:
        reached = np.flatnonzero(shares <= 0.5 + 1e-12)
        return float(self.times[reached[0]]) if reached.size else math.inf


def common_limit(curves: Sequence[Curve]) -> float:
    """Return the last time up to which all curves are known; the overall last one if every search found it."""
    unfinished = [float(each.times[-1]) for each in curves if each.shares[-1] > 1e-12]
    return min(unfinished, default=max(float(each.times[-1]) for each in curves))


def ratio(first: float, second: float) -> float:
    """Return the ratio of two figures; not a number if both are infinite."""
    return math.nan if math.isinf(first) and math.isinf(second) else first / second


def ratio_interval(
    figure: Callable[[Curve], float],
    first: Sample,
    second: Sample,
    strata: Sequence[Hashable],
    *,
    draws: int = 1000,
) -> tuple[float, float]:
    """Return the bootstrap interval of the ratio of a figure of two samples whose searches are paired by their seeds.

    Args:
        figure: A function such as the median.
        first: The first sample, with its searches in the order of the strata.
        second: The second sample, in the same order and with the same seeds as the first.
        strata: The group of each search, such as its defect; groups are resampled separately.
        draws: The number of resamples. Each takes pairs with replacement, as many from each stratum as it has.
    """
    rng = np.random.default_rng(0)
    places = np.arange(len(strata))
    groups = [places[[each == stratum for each in strata]] for stratum in dict.fromkeys(strata)]
    ratios = []
    for _ in range(draws):
        drawn = np.concatenate([rng.choice(group, len(group)) for group in groups])
        one, other = (
            figure(Sample(each.times[drawn], each.found[drawn]).curve) for each in (first, second)
        )
        ratios.append(ratio(one, other))
    # If both are infinite, the ratio may be anything, so it widens the interval at both ends.
    ends = (
        np.nan_to_num(ratios, nan=0.0, posinf=math.inf),
        np.nan_to_num(ratios, nan=math.inf, posinf=math.inf),
    )
    tail = (1 - CONFIDENCE) / 2
    low, high = (
        float(np.quantile(end, at, method="inverted_cdf"))
        for end, at in zip(ends, (tail, 1 - tail), strict=True)
    )
    return low, high
