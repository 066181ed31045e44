"""Statistics for comparing randomised algorithms: effect sizes with intervals, tests, and censored times.

Sources: Arcuri, Briand, "A hitchhiker's guide to statistical tests for assessing randomized algorithms in software
engineering", STVR 24(3), 2014; each function names its own source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # it imports its parts on first use, which takes a second

from pytest_pafot.model.trace import FloatArray

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """The effect size of two samples, with its confidence interval and a test."""

    a12: float  # probability that a value of the first sample is greater, counting ties as half (Vargha-Delaney)
    low: float  # lower end of the 95 % confidence interval of A12
    high: float  # upper end of the interval
    p: float  # p-value of the two-sided Mann-Whitney U test


@dataclass(frozen=True, slots=True, kw_only=True)
class Survival:
    """Kaplan-Meier's estimate of the share of runs that are without an event at each time."""

    times: FloatArray  # times at which the estimated share decreases
    shares: FloatArray  # the share from each of these times on
    median: float  # the first time at which the share is at most one half; infinite if there is none


def compared(first: Sequence[float], second: Sequence[float]) -> Effect:
    """Return the effect size of two samples, its interval and the test; infinite values are equal, and the largest."""
    low, high = a12_interval(a12(first, second), len(first), len(second))
    is_one_value = len({*first, *second}) == 1
    p = 1.0 if is_one_value else float(scipy.stats.mannwhitneyu(first, second, alternative="two-sided").pvalue)
    return Effect(a12=a12(first, second), low=low, high=high, p=p)


def a12(first: Sequence[float], second: Sequence[float]) -> float:
    """Return A12, the probability that a value of the first sample is greater than one of the second, ties as half.

    Source: Vargha, Delaney, "A critique and improvement of the CL common language effect size", 2000.
    """
    x, y = np.asarray(first, dtype=float)[:, None], np.asarray(second, dtype=float)[None, :]
    return float(np.mean((x > y) + 0.5 * (x == y)))


def a12_interval(estimate: float, first: int, second: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the confidence interval of an estimate of A12, which is not a point even if the estimate is 0 or 1.

    Source: Newcombe, "Confidence intervals for an effect size measure based on the Mann-Whitney statistic. Part 2",
    Statistics in Medicine 25(4), 2006, method 5. A value is in the interval if the estimate is within ``z`` standard
    errors of it; the standard error is that of Hanley and McNeil, with the mean of the two sizes of the samples.
    ``first`` and ``second`` are these sizes.
    """
    z = float(scipy.stats.norm.ppf((1 + confidence) / 2))
    others = (first + second) / 2 - 1

    def excess(value: float) -> float:
        spread = 1 + others * (1 - value) / (2 - value) + others * value / (1 + value)
        return float((value - estimate) ** 2 - z**2 * value * (1 - value) * spread / (first * second))

    # At an estimate of 0 or 1, that value itself is a root, so only the other end is computed.
    low = 0.0 if estimate <= 0 else float(scipy.optimize.brentq(excess, 0.0, min(estimate, 1 - 1e-9)))
    high = 1.0 if estimate >= 1 else float(scipy.optimize.brentq(excess, max(estimate, 1e-9), 1.0))
    return low, high


def found_in(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Return p of Fisher's two-sided exact test for two pairs: the number of runs with a failure, and of all runs."""
    table = np.array([[found, runs - found] for found, runs in (first, second)])
    return float(scipy.stats.fisher_exact(table).pvalue)


def survival(times: Sequence[float], is_censored: Sequence[bool]) -> Survival:
    """Estimate the share without an event from times to an event, or without an event if censored.

    Source: Kaplan, Meier, JASA 53, 1958.
    """
    estimate = scipy.stats.ecdf(_censored(times, is_censored)).sf
    at = np.asarray(estimate.quantiles, dtype=np.float64)
    shares = np.asarray(estimate.probabilities, dtype=np.float64)
    half = np.flatnonzero(shares <= 0.5 + 1e-12)
    return Survival(times=at, shares=shares, median=float(at[half[0]]) if half.size else float("inf"))


def log_rank(
    first: Sequence[float], first_censored: Sequence[bool], second: Sequence[float], second_censored: Sequence[bool]
) -> float:
    """Return p of the two-sided log-rank test on times that may be censored; 1 if no event tells the samples apart."""
    if all(first_censored) and all(second_censored):
        return 1.0
    with np.errstate(invalid="ignore"):  # If all events are at one time, it divides 0 by a variance of 0.
        result = scipy.stats.logrank(_censored(first, first_censored), _censored(second, second_censored))
    return 1.0 if np.isnan(result.pvalue) else float(result.pvalue)


def _censored(times: Sequence[float], is_censored: Sequence[bool]) -> scipy.stats.CensoredData:
    return scipy.stats.CensoredData.right_censored(np.asarray(times, dtype=float), np.asarray(is_censored, dtype=bool))
