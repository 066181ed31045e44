"""Measures of runs and of techniques, from tidy results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from pytest_pafot.comparison import statistics
from pytest_pafot.comparison.statistics import Effect, Survival

SECONDS_PER_HOUR = 3600.0
FAULTS = ("ads_error", "hang")


@dataclass(frozen=True, slots=True, kw_only=True)
class Measures:
    """One run of one algorithm, up to a simulated time.

    Attributes:
        algorithm, run: which one.
        scenarios: asked for; unique ones were simulated.
        unique: simulated.
        collisions, unique_collisions: among either.
        invalid: crashes between NPCs, among the unique ones.
        local_searches: that were started.
        seconds: simulated [s].
        collision_seconds: mean time to a collision where there is one [s]; NaN without any.
        by_npc, by_position_npc: unique collisions that an NPC alone is responsible for, by RSS and by position.
        by_ego: unique collisions that the ego is responsible for, alone or with the NPC.
        distinct: signatures of failures that the ego is responsible for, faults of the ADS among them.
        first_failure: simulated time until the first of them [s]; infinite if there was none.
    """

    algorithm: str
    run: int
    scenarios: int
    unique: int
    collisions: int
    unique_collisions: int
    invalid: int
    local_searches: int
    seconds: float
    collision_seconds: float
    by_npc: int
    by_position_npc: int
    by_ego: int
    distinct: int
    first_failure: float

    @property
    def share(self) -> float:
        """Of the unique scenarios that collide."""
        return self.unique_collisions / self.unique if self.unique else 0.0

    @property
    def share_of_all(self) -> float:
        """Of all scenarios that collide."""
        return self.collisions / self.scenarios if self.scenarios else 0.0

    @property
    def seconds_per_scenario(self) -> float:
        """Simulated, over the unique scenarios [s]."""
        return self.seconds / self.unique if self.unique else float("nan")

    @property
    def seconds_per_collision(self) -> float:
        """Simulated for each unique collision, safe runs included [s]; infinite without a collision."""
        return self.seconds / self.unique_collisions if self.unique_collisions else float("inf")

    @property
    def distinct_per_hour(self) -> float:
        """Distinct failures of the ego per simulated hour."""
        return self.distinct / (self.seconds / SECONDS_PER_HOUR) if self.seconds else 0.0


def read(path: Path) -> pd.DataFrame:
    """The rows of a comparison, with a column ``is_ego_failure``."""
    frame = pd.read_csv(path, dtype={"scenario": str, "signature": str}, keep_default_na=False, na_values=[""])
    collides = frame["outcome"] == "collision"
    by_ego = collides & frame["responsibility"].isin(["ego", "both"])
    frame["is_ego_failure"] = by_ego | frame["outcome"].isin(FAULTS)
    return frame


def horizon(frame: pd.DataFrame) -> float:
    """The simulated time that every run of a comparison has [s]: what equal times can be compared up to."""
    return float(frame.groupby(["algorithm", "run"])["clock"].max().min())


def measured(frame: pd.DataFrame, seconds: float | None = None) -> list[Measures]:
    """Every run, whole or up to a simulated time [s]; what had not ended by then does not count."""
    groups = frame.groupby(["algorithm", "run"], sort=False)
    return [_measures(str(name), int(str(run)), group, seconds) for (name, run), group in groups]


def _measures(algorithm: str, run: int, frame: pd.DataFrame, seconds: float | None) -> Measures:
    rows = frame if seconds is None else frame[frame["clock"] <= seconds]
    simulated = rows[~rows["duplicate"]]
    hits = simulated[simulated["outcome"] == "collision"]
    failures = simulated[simulated["is_ego_failure"]]
    local = rows[rows["local_generation"] > 0]
    return Measures(
        algorithm=algorithm,
        run=run,
        scenarios=len(rows),
        unique=len(simulated),
        collisions=int((rows["outcome"] == "collision").sum()),
        unique_collisions=len(hits),
        invalid=int((simulated["outcome"] == "invalid").sum()),
        local_searches=int(local["generation"].nunique()),
        seconds=float(frame["clock"].max()) if seconds is None else seconds,
        collision_seconds=float(hits["collision_time"].mean()) if len(hits) else float("nan"),
        by_npc=int((hits["responsibility"] == "npc").sum()),
        by_position_npc=int((hits["position_responsibility"] == "npc").sum()),
        by_ego=int(hits["is_ego_failure"].sum()),
        distinct=int(failures["signature"].nunique()),
        first_failure=float(failures["clock"].min()) if len(failures) else float("inf"),
    )


def of(algorithm: str, runs: Sequence[Measures]) -> list[Measures]:
    """The runs of one algorithm."""
    return [each for each in runs if each.algorithm == algorithm]


def distinct_in_all(frame: pd.DataFrame, algorithm: str) -> int:
    """Distinct failures of the ego over all runs of an algorithm."""
    rows = frame[(frame["algorithm"] == algorithm) & frame["is_ego_failure"]]
    return int(rows["signature"].nunique())


def faults_in_all(frame: pd.DataFrame, algorithm: str) -> int:
    """How many of them are faults of the ADS: exceptions and hangs."""
    return distinct_in_all(frame[frame["outcome"].isin(FAULTS)], algorithm)


def first_failures(runs: Sequence[Measures]) -> tuple[list[float], list[bool]]:
    """Times to the first failure of the ego [s], and whether they are only the end of a run without one."""
    is_censored = [not np.isfinite(each.first_failure) for each in runs]
    times = [each.seconds if censored else each.first_failure for each, censored in zip(runs, is_censored, strict=True)]
    return times, is_censored


def survival_of(runs: Sequence[Measures]) -> Survival:
    """How many runs have no failure of the ego yet."""
    return statistics.survival(*first_failures(runs))


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """One test of one algorithm against another.

    Attributes:
        measure: what is compared.
        at: ``generations`` or ``seconds``, the budget at which it is equal for both.
        first, second: algorithms.
        first_value, second_value: medians, or counts of runs.
        effect: None for tests of counts and of censored times.
        p: of the test.
        test: its name.
    """

    measure: str
    at: str
    first: str
    second: str
    first_value: float
    second_value: float
    effect: Effect | None
    p: float
    test: str


MEASURES = (
    ("collisions per unique scenario", "share"),
    ("unique collisions", "unique_collisions"),
    ("simulated s per scenario", "seconds_per_scenario"),
    ("simulated s per collision", "seconds_per_collision"),
    ("distinct ego-responsible failures", "distinct"),
    ("distinct ego-responsible failures per simulated hour", "distinct_per_hour"),
)
"""What is tested, and the attribute of a run that it is."""


def comparisons(whole: Sequence[Measures], equal: Sequence[Measures], algorithms: Sequence[str]) -> list[Comparison]:
    """The first algorithm against each other one, at equal generations and at equal simulated seconds.

    Args:
        whole: runs to their ends.
        equal: the same up to the time that all of them have.
        algorithms: names, the one of interest first.
    """
    first = algorithms[0]
    found: list[Comparison] = []
    for second in algorithms[1:]:
        for at, runs in (("generations", whole), ("seconds", equal)):
            pair = of(first, runs), of(second, runs)
            found += [_by_value(measure, attribute, at, *pair) for measure, attribute in MEASURES]
            found += [_by_count(at, *pair)]
        found.append(_by_time(of(first, equal), of(second, equal)))
    return found


def _by_value(measure: str, attribute: str, at: str, first: list[Measures], second: list[Measures]) -> Comparison:
    values = [[float(getattr(each, attribute)) for each in runs] for runs in (first, second)]
    effect = statistics.compared(*values)
    return Comparison(
        measure=measure,
        at=at,
        first=first[0].algorithm,
        second=second[0].algorithm,
        first_value=float(np.median(values[0])),
        second_value=float(np.median(values[1])),
        effect=effect,
        p=effect.p,
        test="Mann-Whitney U",
    )


def _by_count(at: str, first: list[Measures], second: list[Measures]) -> Comparison:
    counts = [sum(each.distinct > 0 for each in runs) for runs in (first, second)]
    return Comparison(
        measure="runs that found an ego-responsible failure",
        at=at,
        first=first[0].algorithm,
        second=second[0].algorithm,
        first_value=counts[0],
        second_value=counts[1],
        effect=None,
        p=statistics.found_in((counts[0], len(first)), (counts[1], len(second))),
        test="Fisher exact",
    )


def _by_time(first: list[Measures], second: list[Measures]) -> Comparison:
    return Comparison(
        measure="simulated s to the first ego-responsible failure",
        at="seconds",
        first=first[0].algorithm,
        second=second[0].algorithm,
        first_value=survival_of(first).median,
        second_value=survival_of(second).median,
        effect=None,
        p=statistics.log_rank(*first_failures(first), *first_failures(second)),
        test="log-rank",
    )
