"""Measures of runs, computed by hand."""

import math

import pandas as pd
import pytest

from pytest_pafot.comparison import run_measures
from pytest_pafot.comparison.plan import COLUMNS, Plan
from pytest_pafot.support.text import csv_text

SAFE = {
    "outcome": "safe",
    "duration": 60.0,
    "responsibility": "none",
    "position_responsibility": "none",
}


def hit(time, responsibility="npc", signature="front-2-aaaaaa", **more):
    return {
        "outcome": "collision", "duration": time, "collision_time": time, "responsibility": responsibility,
        "position_responsibility": "npc", "signature": signature, "npc": 0, "cell": 2, "side": "front",
        "closing_speed": 5.0, "failing": True,
    } | more  # fmt: skip


def rows(*runs, algorithm="pafot", run=0):
    """Return rows of one run; each argument gives the differences from a safe row of generation 0."""
    clock, made = 0.0, []
    for index, fields in enumerate(SAFE | each for each in runs):
        clock += 0.0 if fields.get("reused") else fields["duration"]
        counted = {
            "seed": 1,
            "generation": 0,
            "local_generation": 0,
            "index": index,
            "scenario": "abcdef",
        }
        rest = {
            "reused": False,
            "failing": False,
            "genes_started": 2,
            "genes_reached": 1,
            "executed": "[]",
        }
        made.append(counted | rest | fields | {"algorithm": algorithm, "run": run, "clock": clock})
    return made


@pytest.fixture
def results(tmp_path):
    def read(*parts, algorithms=("pafot",)):
        path, every = tmp_path / "results.csv", [row for part in parts for row in part]
        path.write_text(
            csv_text(tuple(COLUMNS), ([row.get(name) for name in COLUMNS] for row in every))
        )
        return run_measures.Results.read(Plan(ads="x", algorithms=algorithms), path)

    return read


def test_a_run_by_hand(results):
    found = results(
        rows(
            {},
            hit(10.0),
            hit(10.0, reused=True),
            hit(20.0, "ego", "front-2-bbbbbb"),
            hit(5.0, "both", "front-2-bbbbbb"),
            {"outcome": "invalid", "duration": 7.0},
            {
                "outcome": "ads_error",
                "duration": 3.0,
                "signature": "ads-error-cccccc",
                "failing": True,
            },
        )
    )
    (run,) = found.runs.itertuples()
    assert (found.horizon, len(found.frame)) == (60 + 10 + 20 + 5 + 7 + 3, 6)
    assert (run.scenarios, run.collisions, run.share) == (6, 3, 3 / 6)
    assert (run.by_npc, run.by_ego, run.distinct, run.first_failure) == (1, 2, 2, 60 + 10 + 20)


def test_nothing_counts_after_the_end_of_the_shortest_run(results):
    longer, shorter = rows({}, hit(10.0), hit(20.0, "ego")), rows({}, {"duration": 15.0}, run=1)
    found = results(longer, shorter)
    assert found.horizon == 75.0
    run, _ = found.runs.itertuples()
    assert (run.scenarios, run.collisions, run.distinct, run.first_failure) == (2, 1, 0, math.inf)
    assert found.frame["clock"].max() <= 75.0


def test_missing_first_failure_is_censored_at_the_horizon(results):
    found = results(rows({}, hit(8.0, "ego")), rows({}, {"duration": 9.0}, run=1))
    times = run_measures.first_failures(found.runs, found.horizon)
    assert times == ([68.0, 68.0], [False, True])
    assert run_measures.survival(*times).median == 68.0


def test_signature_like_null_or_number_stays_text(results):
    data = results(
        rows(hit(5.0, "ego", "null"), hit(5.0, "ego", "1"), {"scenario": "000012"})
    ).frame
    assert data["signature"].tolist()[:2] == ["null", "1"]
    assert data["scenario"].tolist()[2] == "000012"
    assert pd.isna(data["signature"].tolist()[2])


def test_first_algorithm_is_compared_with_each_other_one(results):
    def runs(name, times):
        return [
            row
            for run, time in enumerate(times)
            for row in rows(hit(time, "ego"), {}, algorithm=name, run=run)
        ]

    names = ("pafot", "random", "av-fuzzer")
    found = run_measures.comparisons(
        results(
            runs("pafot", [5.0, 6.0, 7.0]),
            runs("random", [25.0, 26.0, 27.0]),
            runs("av-fuzzer", [5.0, 26.0, 7.5]),
            algorithms=names,
        )
    )
    assert {(each.first, each.second) for each in found} == {
        ("pafot", "random"),
        ("pafot", "av-fuzzer"),
    }
    assert {each.test for each in found} == {"Mann-Whitney U", "Fisher exact", "log-rank"}
    first = next(each for each in found if each.test == "log-rank")
    assert (first.second, first.value_first, first.value_second) == ("random", 6.0, 26.0)
    assert 0.01 < first.p < 0.05 < 10 * first.p == pytest.approx(first.p_holm)
