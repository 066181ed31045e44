"""Measures of the runs of a comparison, and tests of the algorithms against each other, from the rows of results."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import pandas as pd
import scipy  # it imports its parts on first use, which takes a second

from pytest_pafot import Cell
from pytest_pafot.comparison.plan import Plan, world_of
from pytest_pafot.model.trace import FloatArray
from pytest_pafot.searching.evaluation import IMMEDIATE

# The coverage inverted distance: how much of all failures a run of a search has shown, rather than how often.
#
# Source: Sorokin, Safin, Nejati, "Can search-based testing with Pareto optimization effectively cover failure-
# revealing test inputs?", Empirical Software Engineering 2024, arXiv:2410.11769: the mean distance of the points of a
# reference set to the nearest one that was found. Their points are inputs, and the reference set is a grid of inputs.
# Here the searches have different inputs, Position- and Lane-Instructions, so the points are impacts. A grid of 24
# dimensions cannot be run, so the reference set is what all searches of a comparison have shown together.

SPEED_STEP = 5.0
"""Width of the steps by which closing speeds of impacts are distinguished [m/s]."""
SIDES = {"front": (1, 0), "right": (0, 1), "rear": (-1, 0), "left": (0, -1)}
"""The direction of each side of the ego, as a row and a column of the grid."""
ORIGINS = {"ahead": (1, 0), "right": (0, 1), "behind": (-1, 0), "left": (0, -1)}
"""The direction from which a crossing NPC comes, by its origin, as a row and a column of the grid."""


def inverted_distances(frame: pd.DataFrame, is_counted: pd.Series[bool]) -> pd.Series[float]:
    """Return the inverted distance of each run of a comparison, by algorithm and number; infinite without a failure.

    0 means that the run shows all impacts that the runs of the comparison show together. 1 means that these are as far
    from the impacts of the run as the whole range of one feature. Equal impacts are used once, so it is no advantage to
    show an impact often. Rows of ``frame`` that are not in ``is_counted``, such as rows after a time limit, still
    belong to the impacts that have to be shown.
    """
    hits = frame[frame["failing"] & (frame["outcome"] == "collision") & ~frame["reused"]]
    places = starmap(_place, zip(hits["cell"], hits["zone"], strict=True))
    impacts = zip(places, hits["side"], hits["closing_speed"], strict=True)
    # The time of an impact is left out, because it would be a disadvantage for algorithms with short runs.
    rows = [(*place, *SIDES[side], round(speed / SPEED_STEP)) for place, side, speed in impacts]
    points = np.array(rows, dtype=np.float64)
    distances = dict.fromkeys(zip(frame["algorithm"], frame["run"], strict=True), math.inf)
    if len(points):
        points = points / np.maximum(np.ptp(points, axis=0), 1.0)
        reference, is_shown = np.unique(points, axis=0), is_counted[hits.index].to_numpy()
        for key, at in hits.groupby(["algorithm", "run"]).indices.items():
            shown = np.unique(points[at[is_shown[at]]], axis=0)
            apart = np.linalg.norm(reference[:, None] - shown[None, :], axis=-1)
            distances[cast("tuple[str, int]", key)] = float(apart.min(axis=1, initial=math.inf).mean())
    return pd.Series(distances, dtype=float)


def _place(cell: float, zone: object) -> tuple[int, int]:
    """Return an NPC's row and column in the grid; an NPC that crossed is next to the ego, on the side of its origin."""
    if isinstance(zone, str):
        return ORIGINS[zone.rpartition(" ")[2]]
    return Cell(int(cell)).row, Cell(int(cell)).column


SECONDS_PER_HOUR = 3600.0
FAULTS = ("ads_error", "hang")

TESTED = {
    "collisions per unique scenario": "share",
    "unique collisions": "unique_collisions",
    "simulated s per scenario": "seconds_per_scenario",
    "simulated s per collision": "seconds_per_collision",
    "distinct ego-responsible failures": "distinct",
    "distinct ego-responsible failures per simulated hour": "distinct_per_hour",
    "inverted distance to all failing impacts": "inverted_distance",
}
"""The measures for which algorithms are tested against each other, with their columns in :func:`measured`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """The data of a comparison's report."""

    plan: Plan  # plan of the comparison
    frame: pd.DataFrame  # a row for each scenario
    horizon: float  # simulated time that every run reached, for comparisons at equal times [s]
    whole: pd.DataFrame  # measures of the complete runs
    equal: pd.DataFrame  # measures of the runs up to the horizon

    @classmethod
    def of(cls, plan: Plan, path: Path) -> Results:
        """Read the results of a comparison from the file with its rows, and measure its runs."""
        frame = read(path)
        end = horizon(frame)
        return cls(plan=plan, frame=frame, horizon=end, whole=measured(frame), equal=measured(frame, end))

    @property
    def longest(self) -> float:
        """The duration of a run that does not end early [s]."""
        return float(world_of(self.plan).longest_run)


def read(path: Path) -> pd.DataFrame:
    """Read the rows of a comparison, and add a column ``is_ego_failure``."""
    frame = pd.read_csv(path, dtype={"scenario": str, "signature": str}, keep_default_na=False, na_values=[""])
    by_ego = (frame["outcome"] == "collision") & frame["responsibility"].isin(["ego", "both"])
    frame["is_ego_failure"] = by_ego | frame["outcome"].isin(FAULTS)
    return frame


def undriven(frame: pd.DataFrame) -> Iterator[str]:
    """Yield an error for each algorithm in most of whose runs the ego did not drive."""
    rows = frame[~frame["reused"]]
    is_short = (rows["duration"] <= IMMEDIATE) & rows["outcome"].isin(["safe", "off_road"])
    ended = rows["ended"].astype(object)
    lacks = ended.where(ended.notna(), rows["outcome"]).where(is_short | (rows["outcome"] == "invalid"))
    for name, each in lacks.groupby(rows["algorithm"], sort=False):
        if 2 * each.count() > len(each):
            yield (
                f"expected that the ego drives in most of {len(each)} scenarios of {name}, received "
                f"{each.count()} that were invalid or over within the first second, most often by {each.mode()[0]}; "
                "correct the policy or the world, and give an empty folder to --out"
            )


def horizon(frame: pd.DataFrame) -> float:
    """Return the simulated time of the shortest run of a comparison [s], the limit for comparisons at equal times."""
    return float(frame.groupby(["algorithm", "run"])["clock"].max().min())


def measured(frame: pd.DataFrame, seconds: float | None = None) -> pd.DataFrame:
    """Return the measures of every run, a row each; with ``seconds`` only of scenarios that end before this time [s].

    Columns:
        algorithm, run: name of the algorithm and number of the run.
        scenarios: number of requested scenarios; of these ``unique`` were simulated, and ``collisions`` collided.
        unique_collisions, invalid: number of unique scenarios in which the ego collided, and in which NPCs crashed.
        by_npc, by_position_npc: unique collisions that only an NPC is responsible for, by RSS and by the position rule.
        by_ego: unique collisions that the ego is responsible for, alone or with the NPC.
        local_searches: number of started local searches.
        distinct: number of signatures of failures that the ego is responsible for, including ADS errors.
        first_failure: simulated time until the first failure that the ego is responsible for [s]; infinite without one.
        collision_time: mean time to the collision, over all unique collisions [s]; NaN without a collision.
        seconds: simulated time of the run [s].
        share: share of the unique scenarios that collide.
        seconds_per_scenario, seconds_per_collision: simulated time per unique scenario and collision [s]; infinite
            without a collision.
        distinct_per_hour: distinct failures per simulated hour.
        inverted_distance: distance to all failing impacts of the comparison, see :func:`inverted_distances`.
    """
    within = frame["clock"] <= (math.inf if seconds is None else seconds)
    collides, unique = within & (frame["outcome"] == "collision"), within & ~frame["reused"]
    hits, failures = unique & collides, unique & frame["is_ego_failure"]
    counts = {
        "scenarios": within,
        "unique": unique,
        "collisions": collides,
        "unique_collisions": hits,
        "invalid": unique & (frame["outcome"] == "invalid"),
        "by_npc": hits & (frame["responsibility"] == "npc"),
        "by_position_npc": hits & (frame["position_responsibility"] == "npc"),
        "by_ego": hits & frame["is_ego_failure"],
    }
    others = {
        "local_searches": (frame["generation"].where(within & (frame["local_generation"] > 0)), "nunique"),
        "distinct": (frame["signature"].where(failures), "nunique"),
        "first_failure": (frame["clock"].where(failures, math.inf), "min"),
        "collision_time": (frame["collision_time"].where(hits), "mean"),
        "seconds": (frame["clock"], "max"),
    }
    columns = {**{name: (column, "sum") for name, column in counts.items()}, **others}
    all_rows = frame[["algorithm", "run"]].assign(**{name: column for name, (column, _) in columns.items()})
    by_run = all_rows.groupby(["algorithm", "run"], sort=False)
    runs = by_run.agg({name: how for name, (_, how) in columns.items()}).reset_index()
    if seconds is not None:
        runs["seconds"] = seconds
    runs["share"] = (runs["unique_collisions"] / runs["unique"]).fillna(0.0)
    runs["seconds_per_scenario"] = (runs["seconds"] / runs["unique"]).where(runs["unique"] > 0)
    runs["seconds_per_collision"] = (runs["seconds"] / runs["unique_collisions"]).fillna(math.inf)
    runs["distinct_per_hour"] = (runs["distinct"] / (runs["seconds"] / SECONDS_PER_HOUR)).where(
        runs["seconds"] > 0, 0.0
    )
    return runs.join(inverted_distances(frame, within).rename("inverted_distance"), on=["algorithm", "run"])


def of(algorithm: str, runs: pd.DataFrame) -> pd.DataFrame:
    """Select the rows of one algorithm."""
    return runs[runs["algorithm"] == algorithm]


def distinct_in_all(frame: pd.DataFrame, algorithm: str) -> int:
    """Count the distinct failures of the ego over all runs of an algorithm."""
    return int(of(algorithm, frame[frame["is_ego_failure"]])["signature"].nunique())


def first_failures(runs: pd.DataFrame) -> tuple[list[float], list[bool]]:
    """Return the time of each run to the ego's first failure [s], and if it is censored, as no failure occurred."""
    is_censored = np.isinf(runs["first_failure"])
    return runs["first_failure"].where(~is_censored, runs["seconds"]).tolist(), is_censored.tolist()


# Statistics for comparing randomised algorithms: effect sizes with intervals, tests, and censored times.
#
# Sources: Arcuri, Briand, "A hitchhiker's guide to statistical tests for assessing randomized algorithms in software
# engineering", STVR 24(3), 2014; each function names its own source.

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


class Comparison(NamedTuple):
    """The result of a statistical test of one algorithm against a second algorithm."""

    measure: str  # name of the measure
    at: str  # the budget that both algorithms have, ``generations`` or ``seconds``
    first: str  # name of the first algorithm
    second: str  # name of the second algorithm
    values: tuple[float, float]  # values of the two algorithms: medians, or counts of runs
    effect: Effect | None  # None for tests of counts and of censored times
    p: float  # p-value of the test
    test: str  # name of the test


def comparisons(whole: pd.DataFrame | None, equal: pd.DataFrame, algorithms: Sequence[str]) -> list[Comparison]:
    """Compare the first algorithm with each of the others, at equal generations and at equal simulated seconds.

    ``whole`` has the measures of the complete runs if all have the same number of generations; otherwise it is None.
    ``equal`` has the measures up to the simulated time of the shortest run.
    """
    first, *others = algorithms
    budgets = {"seconds": equal} if whole is None else {"generations": whole, "seconds": equal}
    found: list[Comparison] = []
    for second in others:
        for at, runs in budgets.items():
            a, b = of(first, runs), of(second, runs)
            for measure, column in TESTED.items():
                effect = compared(a[column].tolist(), b[column].tolist())
                values = float(np.median(a[column])), float(np.median(b[column]))
                found.append(Comparison(measure, at, first, second, values, effect, effect.p, "Mann-Whitney U"))
            counts = int((a["distinct"] > 0).sum()), int((b["distinct"] > 0).sum())
            p = found_in((counts[0], len(a)), (counts[1], len(b)))
            measure = "runs that found an ego-responsible failure"
            found.append(Comparison(measure, at, first, second, counts, None, p, "Fisher exact"))
        times = [first_failures(of(name, equal)) for name in (first, second)]
        medians = survival(*times[0]).median, survival(*times[1]).median
        p, measure = log_rank(*times[0], *times[1]), "simulated s to the first ego-responsible failure"
        found.append(Comparison(measure, "seconds", first, second, medians, None, p, "log-rank"))
    return found
