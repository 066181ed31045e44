"""Measures of runs and comparisons of algorithms, from tidy results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import starmap
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import pandas as pd

from pytest_pafot.comparison import statistics
from pytest_pafot.comparison.plan import Plan, world_of
from pytest_pafot.comparison.statistics import Effect
from pytest_pafot.model.grid import Cell

# How much of all that fails a run of a search has shown, rather than how often: the coverage inverted distance.
#
# Source: Sorokin, Safin, Nejati, "Can search-based testing with Pareto optimization effectively cover failure-
# revealing test inputs?", Empirical Software Engineering 2024, arXiv:2410.11769: the mean distance of the points of a
# reference set to the nearest one that was found. Their points are inputs, and the reference set a grid of them. Here
# the inputs of searches differ, Position- and Lane-Instructions, so that points are impacts; and no grid of 24
# dimensions can be run, so that the reference set is what all searches of a comparison have shown together.

SPEED_STEP = 5.0
"""In which the closing speeds of impacts are told apart [m/s]."""
SIDES = {"front": (1, 0), "right": (0, 1), "rear": (-1, 0), "left": (0, -1)}
"""Where a side of the ego is, as rows and columns of the grid are."""
ORIGINS = {"ahead": (1, 0), "right": (0, 1), "behind": (-1, 0), "left": (0, -1)}
"""The same, of what an NPC comes from that crosses."""


def inverted_distances(frame: pd.DataFrame, is_counted: pd.Series[bool]) -> pd.Series[float]:
    """The distance of each run of a comparison, by its algorithm and number; infinite where a run shows nothing.

    0 says that the run shows all that any run shows; 1 that what is shown lies as far off as the whole range of a
    feature. Equal points count once, so that it is no advantage to show one of them often. Rows of ``frame`` that are
    not counted, such as those after a time, are part of the reference set all the same.
    """
    hits = frame[frame["failing"] & (frame["outcome"] == "collision") & ~frame["duplicate"]]
    places = starmap(_place, zip(hits["cell"], hits["zone"], strict=True))
    impacts = zip(places, hits["side"], hits["closing_speed"], strict=True)
    # Not when an impact was: that would tell against algorithms with short runs.
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
    """Row and column of the grid in which an NPC was; of one that crossed, those next to the ego where it came from."""
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
"""What is tested, and the column of :func:`measured` that it is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Results:
    """What a report is made of."""

    plan: Plan  # of the comparison
    frame: pd.DataFrame  # the rows
    horizon: float  # the simulated time that all runs have [s]: what equal times can be compared up to
    whole: pd.DataFrame  # measures of the runs to their ends
    equal: pd.DataFrame  # the same up to the horizon

    @classmethod
    def of(cls, plan: Plan, path: Path) -> Results:
        """From the file with the rows of a comparison."""
        frame = read(path)
        end = horizon(frame)
        return cls(plan=plan, frame=frame, horizon=end, whole=measured(frame), equal=measured(frame, end))

    @property
    def longest(self) -> float:
        """How long a scenario lasts that nothing ends early [s]."""
        return float(world_of(self.plan).longest_run)


def read(path: Path) -> pd.DataFrame:
    """The rows of a comparison, with a column ``is_ego_failure``."""
    frame = pd.read_csv(path, dtype={"scenario": str, "signature": str}, keep_default_na=False, na_values=[""])
    by_ego = (frame["outcome"] == "collision") & frame["responsibility"].isin(["ego", "both"])
    frame["is_ego_failure"] = by_ego | frame["outcome"].isin(FAULTS)
    return frame


def horizon(frame: pd.DataFrame) -> float:
    """The simulated time that every run of a comparison has [s]: what equal times can be compared up to."""
    return float(frame.groupby(["algorithm", "run"])["clock"].max().min())


def measured(frame: pd.DataFrame, seconds: float | None = None) -> pd.DataFrame:
    """A row for every run, whole or up to a simulated time [s]; what had not ended by then does not count.

    Columns:
        algorithm, run: which one.
        scenarios: asked for; of these ``unique`` were simulated, and ``collisions`` collided.
        unique_collisions, invalid: collisions of the ego and crashes between NPCs, among the unique ones.
        by_npc, by_position_npc: unique collisions that an NPC alone is responsible for, by RSS and by position.
        by_ego: unique collisions that the ego is responsible for, alone or with the NPC.
        local_searches: that were started.
        distinct: signatures of failures that the ego is responsible for, faults of the ADS among them.
        first_failure: simulated time until the first of them [s]; infinite if there was none.
        collision_time: mean time to a collision where there is one [s]; NaN without any.
        seconds: simulated [s].
        share: of the unique scenarios that collide.
        seconds_per_scenario, seconds_per_collision: simulated [s], over the unique scenarios and collisions; infinite
            without a collision.
        distinct_per_hour: distinct failures per simulated hour.
        inverted_distance: to all failing impacts of the comparison, see :func:`inverted_distances`.
    """
    within = frame["clock"] <= (math.inf if seconds is None else seconds)
    collides, unique = within & (frame["outcome"] == "collision"), within & ~frame["duplicate"]
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
    """The runs, or rows, of one algorithm."""
    return runs[runs["algorithm"] == algorithm]


def distinct_in_all(frame: pd.DataFrame, algorithm: str) -> int:
    """Distinct failures of the ego over all runs of an algorithm."""
    return int(of(algorithm, frame[frame["is_ego_failure"]])["signature"].nunique())


def first_failures(runs: pd.DataFrame) -> tuple[list[float], list[bool]]:
    """Times to the first failure of the ego [s], and whether they are only the end of a run without one."""
    is_censored = np.isinf(runs["first_failure"])
    return runs["first_failure"].where(~is_censored, runs["seconds"]).tolist(), is_censored.tolist()


class Comparison(NamedTuple):
    """One test of one algorithm against another."""

    measure: str  # what is compared
    at: str  # ``generations`` or ``seconds``, the budget at which it is equal for both
    first: str  # algorithm
    second: str
    values: tuple[float, float]  # of the two: medians, or counts of runs
    effect: Effect | None  # None for tests of counts and of censored times
    p: float  # of the test
    test: str  # its name


def comparisons(whole: pd.DataFrame | None, equal: pd.DataFrame, algorithms: Sequence[str]) -> list[Comparison]:
    """The first algorithm against each other one, at equal generations and at equal simulated seconds.

    ``whole`` has the measures of the runs to their ends, where these are equal generations, else it is None; ``equal``
    those up to the time that all of them have.
    """
    first, *others = algorithms
    budgets = {"seconds": equal} if whole is None else {"generations": whole, "seconds": equal}
    found: list[Comparison] = []
    for second in others:
        for at, runs in budgets.items():
            found += _at_one_budget(at, first, second, of(first, runs), of(second, runs))
        times = [first_failures(of(name, equal)) for name in (first, second)]
        medians = statistics.survival(*times[0]).median, statistics.survival(*times[1]).median
        p, measure = statistics.log_rank(*times[0], *times[1]), "simulated s to the first ego-responsible failure"
        found.append(Comparison(measure, "seconds", first, second, medians, None, p, "log-rank"))
    return found


def _at_one_budget(at: str, first: str, second: str, a: pd.DataFrame, b: pd.DataFrame) -> list[Comparison]:
    found = []
    for measure, column in TESTED.items():
        effect = statistics.compared(a[column].tolist(), b[column].tolist())
        medians = float(np.median(a[column])), float(np.median(b[column]))
        found.append(Comparison(measure, at, first, second, medians, effect, effect.p, "Mann-Whitney U"))
    counts = int((a["distinct"] > 0).sum()), int((b["distinct"] > 0).sum())
    p = statistics.found_in((counts[0], len(a)), (counts[1], len(b)))
    measure = "runs that found an ego-responsible failure"
    return [*found, Comparison(measure, at, first, second, counts, None, p, "Fisher exact")]
