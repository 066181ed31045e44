"""Measures of the runs in a comparison, and statistical tests between the algorithms."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import scipy  # it imports its parts on first use, which takes a second

from pytest_pafot.algorithms.evaluation import IMMEDIATE
from pytest_pafot.comparison.plan import Plan
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.support.proportions import holm

SECONDS_PER_HOUR = 3600.0
FAULTS = ("ads_error", "hang")

# The measures for which algorithms are tested against each other, with their columns in `measure_runs`.
TESTED = {
    "collisions per unique scenario": "share",
    "unique collisions": "collisions",
    "distinct ego-responsible failures": "distinct",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """The data for a comparison's report."""

    plan: Plan  # plan of the comparison
    frame: pd.DataFrame  # a row for each scenario that was simulated and ended before the horizon
    horizon: float  # simulated time that every run reached [s]; nothing after it counts
    runs: pd.DataFrame  # measures of the runs

    @classmethod
    def read(cls, plan: Plan, path: Path) -> Results:
        """Read the results of a comparison from a file with one row per scenario, and measure all runs."""
        frame = read_rows(path)
        end = horizon(frame)
        counted = frame[~frame["reused"] & (frame["clock"] <= end)]
        return cls(plan=plan, frame=counted, horizon=end, runs=measure_runs(frame, end))


def read_rows(path: Path) -> pd.DataFrame:
    """Read the rows of a comparison, and add a column ``is_ego_failure``."""
    frame = pd.read_csv(
        path, dtype={"scenario": str, "signature": str}, keep_default_na=False, na_values=[""]
    )
    by_ego = (frame["outcome"] == "collision") & frame["responsibility"].isin(["ego", "both"])
    frame["is_ego_failure"] = by_ego | frame["outcome"].isin(FAULTS)
    return frame


def undriven_errors(rows: pd.DataFrame) -> Iterator[str]:
    """Yield an error for each algorithm for which the ego did not drive in most scenarios."""
    is_short = (rows["duration"] <= IMMEDIATE) & rows["outcome"].isin(["safe", "off_road"])
    ended = rows["ended"].astype(object)
    is_wrong = is_short | (rows["outcome"] == "invalid")
    lacks = ended.where(ended.notna(), rows["outcome"]).where(is_wrong)
    for name, each in lacks.groupby(rows["algorithm"], sort=False):
        if 2 * each.count() > len(each):
            yield (
                f"expected the ego to drive in most of the {len(each)} scenarios of {name}, but {each.count()} were "
                f"invalid or over within the first second (most often: {each.mode()[0]}). Correct the policy or the "
                "world, and choose another folder for --out."
            )


def horizon(frame: pd.DataFrame) -> float:
    """Return the simulated time [s] of the shortest run. All runs are compared up to this time."""
    clocks = frame.groupby(["algorithm", "run"])["clock"]
    return float(clocks.max().min())


def measure_runs(frame: pd.DataFrame, seconds: float) -> pd.DataFrame:
    """Return a row of measures for each run, computed from the scenarios that end within a simulated time [s]."""
    counted = ~frame["reused"] & (frame["clock"] <= seconds)
    hits = counted & (frame["outcome"] == "collision")
    failures = counted & frame["is_ego_failure"]
    columns = frame[["algorithm", "run"]].assign(
        scenarios=counted,
        collisions=hits,
        by_npc=hits & (frame["responsibility"] == "npc"),
        by_ego=hits & frame["is_ego_failure"],
        distinct=frame["signature"].where(failures),
        first_failure=frame["clock"].where(failures, math.inf),
    )
    by_run = columns.groupby(["algorithm", "run"], sort=False)
    measures = {
        "scenarios": "sum",  # unique ones, which are those that were simulated
        "collisions": "sum",
        "by_npc": "sum",  # collisions with only the NPC responsible
        "by_ego": "sum",  # collisions with the ego responsible, maybe with the NPC
        "distinct": "nunique",  # failures of the ego, including ADS errors
        # Simulated time until the first failure of the ego [s]; infinite without one.
        "first_failure": "min",
    }
    runs = by_run.agg(measures).reset_index()
    runs["share"] = (runs["collisions"] / runs["scenarios"]).fillna(0.0)
    return runs


def rows_of(algorithm: str, runs: pd.DataFrame) -> pd.DataFrame:
    """Select the rows of one algorithm."""
    return runs[runs["algorithm"] == algorithm]


def first_failures(runs: pd.DataFrame, seconds: float) -> tuple[list[float], list[bool]]:
    """Return each run's time [s] until the ego's first failure, and whether it is censored for lack of a failure."""
    is_censored = np.isinf(runs["first_failure"])
    return runs["first_failure"].where(~is_censored, seconds).tolist(), is_censored.tolist()


# Statistics for comparing randomised algorithms: effect sizes with intervals, tests, and censored times.
#
# Sources: Arcuri, Briand, "A hitchhiker's guide to statistical tests for assessing randomized algorithms in software
# engineering", STVR 24(3), 2014; each function names its own source.

CONFIDENCE = 0.95


class Effect(NamedTuple):
    """The effect size between two samples, with its confidence interval and a test."""

    # probability that a value of the first sample is greater, counting ties as half (Vargha-Delaney)
    a12: float
    low: float  # lower end of the 95 % confidence interval of A12
    high: float  # upper end of the interval
    p: float  # p-value of the two-sided Mann-Whitney U test


@dataclass(frozen=True, slots=True, kw_only=True)
class Survival:
    """The Kaplan-Meier estimate of the fraction of runs without an event at each time."""

    times: FloatArray  # times at which the estimated fraction decreases
    shares: FloatArray  # the fraction after each of these times
    # the first time at which the fraction is at most one half; infinite if there is none
    median: float


def effect_size(first: Sequence[float], second: Sequence[float]) -> Effect:
    """Return the effect size between two samples, with its interval and test. Infinite values count as equal."""
    estimate = a12(first, second)
    low, high = a12_interval(estimate, len(first), len(second))
    p = 1.0
    if len({*first, *second}) > 1:
        p = float(scipy.stats.mannwhitneyu(first, second, alternative="two-sided").pvalue)
    return Effect(estimate, low, high, p)


def a12(first: Sequence[float], second: Sequence[float]) -> float:
    """Return A12, the probability that a value from the first sample is greater, counting ties as half.

    Source: Vargha, Delaney, "A critique and improvement of the CL common language effect size", 2000.
    """
    x = np.asarray(first, dtype=float)[:, None]
    y = np.asarray(second, dtype=float)
    return float(np.mean((x > y) + 0.5 * (x == y)))


def a12_interval(estimate: float, first: int, second: int) -> tuple[float, float]:
    """Return the confidence interval of an estimate of A12 from samples of two sizes.

    Source: Newcombe, "Confidence intervals for an effect size measure based on the Mann-Whitney statistic. Part 2",
    Statistics in Medicine 25(4), 2006, method 5.
    """
    # A value is in the interval if the estimate is within z standard errors of it. The formula for the standard error
    # is by Hanley and McNeil, with the mean of the two sizes.
    z = float(scipy.stats.norm.ppf((1 + CONFIDENCE) / 2))
    others = (first + second) / 2 - 1

    def excess(value: float) -> float:
        spread = 1 + others * (1 - value) / (2 - value) + others * value / (1 + value)
        # not split further, because another order of the factors changes the last digit of the root
        return float(
            (value - estimate) ** 2 - z**2 * value * (1 - value) * spread / (first * second)
        )

    low = 0.0
    high = 1.0
    # If the estimate is 0 or 1, it is itself a root, so only the other end is computed.
    if estimate > 0:
        low = float(scipy.optimize.brentq(excess, 0.0, min(estimate, 1 - 1e-9)))
    if estimate < 1:
        high = float(scipy.optimize.brentq(excess, max(estimate, 1e-9), 1.0))
    return low, high


def fisher_p(first: tuple[int, int], second: tuple[int, int]) -> float:
    """Return the two-sided p-value of Fisher's exact test.

    Each pair contains the number of runs with a failure and the number of all runs.
    """
    table = [[found, runs - found] for found, runs in (first, second)]
    return float(scipy.stats.fisher_exact(np.array(table)).pvalue)


def survival(times: Sequence[float], is_censored: Sequence[bool]) -> Survival:
    """Estimate the fraction of runs without an event at each time, from event times that may be censored.

    Source: Kaplan, Meier, JASA 53, 1958.
    """
    estimate = scipy.stats.ecdf(_censored(times, is_censored)).sf
    at = np.asarray(estimate.quantiles, dtype=np.float64)
    shares = np.asarray(estimate.probabilities, dtype=np.float64)
    half = at[shares <= 0.5 + 1e-12]
    median = float(half[0]) if half.size else math.inf
    return Survival(times=at, shares=shares, median=median)


def log_rank(
    first: Sequence[float],
    first_censored: Sequence[bool],
    second: Sequence[float],
    second_censored: Sequence[bool],
) -> float:
    """Return the two-sided p-value of the log-rank test on times that may be censored, or 1 if it is undefined."""
    if all(first_censored) and all(second_censored):
        return 1.0
    one = _censored(first, first_censored)
    other = _censored(second, second_censored)
    # if all events are at the same time, scipy divides 0 by a variance of 0
    with np.errstate(invalid="ignore"):
        p = scipy.stats.logrank(one, other).pvalue
    if np.isnan(p):
        return 1.0
    return float(p)


def _censored(times: Sequence[float], is_censored: Sequence[bool]) -> scipy.stats.CensoredData:
    return scipy.stats.CensoredData.right_censored(
        np.asarray(times, dtype=float), np.asarray(is_censored, dtype=bool)
    )


class Comparison(NamedTuple):
    """The result of a statistical test of one algorithm against another."""

    measure: str  # name of the measure
    first: str  # name of the first algorithm
    second: str  # name of the second algorithm
    value_first: float  # value of the first algorithm: a median, or a count of runs
    value_second: float  # value of the second algorithm
    a12: float | None  # effect size; None for tests of counts and of censored times
    a12_low: float | None  # its 95 % interval
    a12_high: float | None
    p: float  # p-value of the test
    test: str  # name of the test
    p_holm: float = math.nan  # p-value adjusted for all tests of the comparison


def comparisons(results: Results) -> list[Comparison]:
    """Compare the first algorithm with each of the other algorithms."""
    first, *others = results.plan.names
    found: list[Comparison] = []
    for second in others:
        a = rows_of(first, results.runs)
        b = rows_of(second, results.runs)
        for measure, column in TESTED.items():
            effect = effect_size(a[column].tolist(), b[column].tolist())
            values = float(np.median(a[column])), float(np.median(b[column]))
            found.append(Comparison(measure, first, second, *values, *effect, "Mann-Whitney U"))
        counts = int((a["distinct"] > 0).sum()), int((b["distinct"] > 0).sum())
        p = fisher_p((counts[0], len(a)), (counts[1], len(b)))
        measure = "runs that found an ego-responsible failure"
        no_effect = (None, None, None)
        found.append(Comparison(measure, first, second, *counts, *no_effect, p, "Fisher exact"))
        times = [first_failures(each, results.horizon) for each in (a, b)]
        medians = survival(*times[0]).median, survival(*times[1]).median
        p = log_rank(*times[0], *times[1])
        measure = "simulated s to the first ego-responsible failure"
        found.append(Comparison(measure, first, second, *medians, *no_effect, p, "log-rank"))
    adjusted = holm([each.p for each in found])
    return [each._replace(p_holm=p) for each, p in zip(found, adjusted, strict=True)]
