"""What randomised algorithms are compared by: effect sizes with intervals, tests, and times that may be censored.

Sources: Arcuri, Briand, "A hitchhiker's guide to statistical tests for assessing randomized algorithms in software
engineering", STVR 24(3), 2014; each function names its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # which imports its parts when they are first used, for that takes a second

from pytest_pafot.model.trace import FloatArray

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """How two samples compare."""

    a12: float  # probability that a value of the first exceeds one of the second, ties by half (Vargha-Delaney)
    low: float  # end of its 95 % confidence interval
    high: float
    p: float  # two-sided Mann-Whitney U test


@dataclass(frozen=True, slots=True, kw_only=True)
class Survival:
    """Kaplan-Meier's estimate of the share that is without an event yet."""

    times: FloatArray  # at which the estimate steps down
    shares: FloatArray  # from each of these times on
    median: float  # the first time at which it is at most one half; infinite if it never is


def compared(first: Sequence[float], second: Sequence[float]) -> Effect:
    """Effect size, its interval and the test of two samples; infinite values are the largest, and equal."""
    low, high = a12_interval(a12(first, second), len(first), len(second))
    is_one_value = len({*first, *second}) == 1
    p = 1.0 if is_one_value else float(scipy.stats.mannwhitneyu(first, second, alternative="two-sided").pvalue)
    return Effect(a12=a12(first, second), low=low, high=high, p=p)


def a12(first: Sequence[float], second: Sequence[float]) -> float:
    """Vargha, Delaney, "A critique and improvement of the CL common language effect size statistics", 2000."""
    x, y = np.asarray(first, dtype=float)[:, None], np.asarray(second, dtype=float)[None, :]
    return float(np.mean((x > y) + 0.5 * (x == y)))


def a12_interval(estimate: float, first: int, second: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Confidence interval of A12, which keeps its width where one sample exceeds the other entirely.

    Newcombe, "Confidence intervals for an effect size measure based on the Mann-Whitney statistic. Part 2", Statistics
    in Medicine 25(4), 2006, method 5: the values whose own standard error, by Hanley and McNeil with the mean of the
    two sizes, allows the estimate. ``first`` and ``second`` are the sizes of the samples.
    """
    z = float(scipy.stats.norm.ppf((1 + confidence) / 2))
    others = (first + second) / 2 - 1

    def excess(value: float) -> float:
        spread = 1 + others * (1 - value) / (2 - value) + others * value / (1 + value)
        return float((value - estimate) ** 2 - z**2 * value * (1 - value) * spread / (first * second))

    # At an estimate of 0 or 1 that value itself is a root, and the other one is the limit.
    low = 0.0 if estimate <= 0 else float(scipy.optimize.brentq(excess, 0.0, min(estimate, 1 - 1e-9)))
    high = 1.0 if estimate >= 1 else float(scipy.optimize.brentq(excess, max(estimate, 1e-9), 1.0))
    return low, high


def found_in(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Fisher's exact test, two-sided, of (runs that found something, all runs) of two algorithms: p."""
    table = np.array([[found, runs - found] for found, runs in (first, second)])
    return float(scipy.stats.fisher_exact(table).pvalue)


def survival(times: Sequence[float], is_censored: Sequence[bool]) -> Survival:
    """Of times to an event, or, where censored, times until which there was none (Kaplan, Meier, JASA 53, 1958)."""
    estimate = scipy.stats.ecdf(_censored(times, is_censored)).sf
    at = np.asarray(estimate.quantiles, dtype=np.float64)
    shares = np.asarray(estimate.probabilities, dtype=np.float64)
    half = np.flatnonzero(shares <= 0.5 + 1e-12)
    return Survival(times=at, shares=shares, median=float(at[half[0]]) if half.size else float("inf"))


def log_rank(
    first: Sequence[float], first_censored: Sequence[bool], second: Sequence[float], second_censored: Sequence[bool]
) -> float:
    """The log-rank test, two-sided, of times that may be censored: p; 1 where no event tells the samples apart."""
    if all(first_censored) and all(second_censored):
        return 1.0
    with np.errstate(invalid="ignore"):  # Where all have their events at once, it is 0 over a variance of 0.
        result = scipy.stats.logrank(_censored(first, first_censored), _censored(second, second_censored))
    return 1.0 if np.isnan(result.pvalue) else float(result.pvalue)


def _censored(times: Sequence[float], is_censored: Sequence[bool]) -> scipy.stats.CensoredData:
    return scipy.stats.CensoredData.right_censored(np.asarray(times, dtype=float), np.asarray(is_censored, dtype=bool))
