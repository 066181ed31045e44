"""Measures of runs, computed by hand."""

import math

import pandas as pd
import pytest

from pytest_pafot.comparison import run_measures
from pytest_pafot.comparison.algorithm_run import text_of

SAFE = {"outcome": "safe", "duration": 60.0, "responsibility": "none", "position_responsibility": "none"}


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
        counted = {"seed": 1, "generation": 0, "local_generation": 0, "index": index, "scenario": "abcdef"}
        rest = {"reused": False, "failing": False, "genes_started": 2, "genes_reached": 1, "executed": "[]"}
        made.append(counted | rest | fields | {"algorithm": algorithm, "run": run, "clock": clock})
    return made


@pytest.fixture
def frame(tmp_path):
    def read(*parts):
        path = tmp_path / "results.csv"
        path.write_text(text_of([row for part in parts for row in part]))
        return run_measures.read(path)

    return read


def measured(frame, seconds=None):
    return list(run_measures.measured(frame, seconds).itertuples())


def test_a_run_by_hand(frame):
    (measures,) = measured(
        frame(
            rows(
                {},
                hit(10.0),
                hit(10.0, reused=True),
                hit(20.0, "ego", "front-2-bbbbbb", position_responsibility="ego", local_generation=1, generation=3),
                hit(5.0, "both", "front-2-bbbbbb", local_generation=2, generation=3),
                {"outcome": "invalid", "duration": 7.0},
                {"outcome": "ads_error", "duration": 3.0, "signature": "ads-error-cccccc", "failing": True},
            )
        )
    )
    assert (measures.scenarios, measures.unique, measures.collisions, measures.unique_collisions) == (7, 6, 4, 3)
    assert measures.share == 3 / 6
    assert measures.seconds == 60 + 10 + 20 + 5 + 7 + 3 == 105
    assert measures.seconds_per_scenario == 105 / 6
    assert measures.seconds_per_collision == 105 / 3
    assert measures.collision_time == pytest.approx(35 / 3)
    assert (measures.by_npc, measures.by_position_npc, measures.by_ego, measures.invalid) == (1, 2, 2, 1)
    assert measures.local_searches == 1
    assert measures.distinct == 2
    assert measures.distinct_per_hour == pytest.approx(2 / (105 / 3600))
    assert measures.first_failure == 60 + 10 + 20


def test_measures_up_to_a_time_ignore_later_runs(frame):
    (measures,) = measured(frame(rows({}, hit(10.0), hit(20.0, "ego"))), 75.0)
    assert (measures.unique, measures.unique_collisions, measures.distinct, measures.seconds) == (2, 1, 0, 75.0)
    assert measures.first_failure == math.inf


def test_horizon_is_the_time_of_shortest_run(frame):
    assert (
        run_measures.horizon(frame(rows({}, {}), rows({}, hit(9.0), run=1), rows({}, {}, {}, algorithm="random")))
        == 69.0
    )


def test_run_without_collision_has_no_collision_time(frame):
    (measures,) = measured(frame(rows({}, {})))
    assert math.isnan(measures.collision_time)
    assert (measures.seconds_per_collision, measures.share, measures.distinct) == (math.inf, 0.0, 0)


def test_missing_first_failure_is_censored_at_run_end(frame):
    runs = run_measures.measured(frame(rows({}, hit(8.0, "ego")), rows({}, {}, run=1)))
    assert run_measures.first_failures(runs) == ([68.0, 120.0], [False, True])
    assert run_measures.survival(*run_measures.first_failures(runs)).median == 68.0


def test_distinct_failures_of_all_runs_are_counted_once(frame):
    data = frame(
        rows(hit(5.0, "ego", "a"), hit(6.0, "ego", "b")), rows(hit(5.0, "ego", "b"), hit(5.0, "npc", "c"), run=1)
    )
    assert run_measures.distinct_in_all(data, "pafot") == 2


def test_faults_of_the_ads_are_counted_among_them(frame):
    raised = {"outcome": "ads_error", "duration": 3.0, "signature": "ads-error-cccccc", "failing": True}
    data = frame(rows(hit(5.0, "ego", "a"), raised, raised), rows(raised, algorithm="random"))
    faults = data[data["outcome"].isin(run_measures.FAULTS)]
    assert [run_measures.distinct_in_all(each, "pafot") for each in (data, faults)] == [2, 1]


def test_signature_like_null_or_number_stays_text(frame):
    data = frame(rows(hit(5.0, "ego", "null"), hit(5.0, "ego", "1"), {"scenario": "000012"}))
    assert data["signature"].tolist()[:2] == ["null", "1"]
    assert data["scenario"].tolist()[2] == "000012"
    assert pd.isna(data["signature"].tolist()[2])


def test_first_algorithm_is_compared_with_each_other_one(frame):
    def runs(name, times):
        return [row for run, time in enumerate(times) for row in rows({}, hit(time, "ego"), algorithm=name, run=run)]

    data = frame(
        runs("pafot", [5.0, 6.0, 7.0]), runs("random", [25.0, 26.0, 27.0]), runs("av-fuzzer", [5.0, 26.0, 7.5])
    )
    whole, equal = run_measures.measured(data), run_measures.measured(data, run_measures.horizon(data))
    found = run_measures.comparisons(whole, equal, ["pafot", "random", "av-fuzzer"])
    assert {(each.first, each.second) for each in found} == {("pafot", "random"), ("pafot", "av-fuzzer")}
    assert {each.test for each in found} == {"Mann-Whitney U", "Fisher exact", "log-rank"}
    assert {each.at for each in found} == {"generations", "seconds"}
    asked = ("random", "simulated s per scenario", "generations")
    (speed,) = [each for each in found if (each.second, each.measure, each.at) == asked]
    assert (speed.values, speed.effect.a12) == ((33.0, 43.0), 0.0)
    assert speed.p == pytest.approx(0.1)
    at_equal_seconds = run_measures.comparisons(None, equal, ["pafot", "random", "av-fuzzer"])
    assert at_equal_seconds == [each for each in found if each.at == "seconds"]


def test_inverted_distance_is_mean_distance_to_nearest_impact(frame):
    """There are three impacts: the front hits an NPC ahead at 5 and 25 m/s, and one that was behind at 5 m/s."""
    ahead, fast, behind = hit(10.0), hit(10.0, closing_speed=25.0), hit(10.0, cell=6)
    data = frame(
        rows(ahead, fast, behind),
        rows(ahead, ahead, hit(40.0, closing_speed=5.4), run=1),
        rows({}, hit(9.0, cell=4, failing=False), run=2),
        rows({}, behind, algorithm="random"),
    )
    distances = [each.inverted_distance for each in measured(data)]
    assert distances == pytest.approx([0, (0 + 1 + 1) / 3, math.inf, (1 + math.sqrt(2) + 0) / 3])
    assert [each.inverted_distance for each in measured(data, 15.0)] == pytest.approx(
        [(0 + 1 + 1) / 3, (0 + 1 + 1) / 3, math.inf, math.inf]
    )


def test_impact_in_a_zone_uses_origin_of_npc(frame):
    left = hit(10.0, cell=None, zone="crossing from the left")
    data = frame(
        rows(left, hit(10.0)),
        rows(hit(10.0, cell=8), run=1),
        rows(hit(10.0, cell=None, zone="merging from ahead"), run=2),
    )
    assert [each.inverted_distance for each in measured(data)] == pytest.approx([0, math.sqrt(2) / 2, math.sqrt(2) / 2])


def test_one_algorithm_alone_is_compared_with_nothing(frame):
    data = frame(rows({}))
    assert run_measures.comparisons(run_measures.measured(data), run_measures.measured(data), ["pafot"]) == []
