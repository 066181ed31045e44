"""A row of the table of runs is enough to run its run again, to the last bit."""

import csv
import io
import json
import math

import pytest

import pytest_pafot as pafot
from example_ads import blind_lane_change, constant_speed, idm_mobil
from pytest_pafot.algorithms.fitness import resolve
from pytest_pafot.searches import bench
from pytest_pafot.searches.refine import steps
from pytest_pafot.searches.run_table import COLUMNS
from tests.helpers.stages import mostly_oracle

NUMBERS = (
    "scenario_seed", "ego_lane", "ego_speed", "gene_seconds", "fitness", "duration", "collision_time", "npc",
    "closing_speed", "least_gap", "hardest_braking",
)  # fmt: skip


def never_collides(run):
    assert not run.collision


def scenario_of(row):
    """Make the scenario of a row."""
    start = [row["scenario_seed"], row["ego_lane"], row["ego_speed"], row["gene_seconds"]]
    chains, vehicles = json.loads(row["genes"]), json.loads(row["vehicles"])
    return pafot.Scenario.from_canonical([chains, *start, row["traffic"], vehicles])


def number(text):
    return int(text) if text.isdecimal() else float(text)


def through_csv(rows):
    """Return the rows as a CSV file has them."""
    file = io.StringIO()
    writer = csv.DictWriter(file, COLUMNS)
    writer.writeheader()
    writer.writerows(rows)
    rows = csv.DictReader(io.StringIO(file.getvalue()))
    return [
        {name: number(cell) if name in NUMBERS and cell else cell for name, cell in row.items()}
        for row in rows
    ]


BLURRED = pafot.Perception(
    blind_lane_change.make,
    noise={"position": 1.5, "speed": 1.0},
    dropout=0.2,
    latency=0.2,
    range=60.0,
)


def _as_it_is(sighting):
    return sighting
    yield


SEARCHES = {
    "highway": {"ads": constant_speed.make},
    "highway of the paper": {"ads": constant_speed.make, "algorithm": "pafot"},
    "Lane-Instructions": {"ads": constant_speed.make, "algorithm": "random-manoeuvre"},
    "imperfect sight": {"ads": BLURRED},
    "narrow road": {"ads": idm_mobil.make, "world": pafot.Highway(lanes=3, duration=30)},
    "junction": {"ads": constant_speed.make, "world": pafot.World("intersection-v0", planner_hz=5)},
    "roundabout": {"ads": constant_speed.make, "world": pafot.World("roundabout-v0", planner_hz=5)},
    "merge": {"ads": constant_speed.make, "world": pafot.World("merge-v0", planner_hz=5)},
    "policy of an environment": {
        "ads": lambda: lambda observation: 1,
        "world": pafot.World("highway-fast-v0"),
    },
}


@pytest.mark.parametrize("name", mostly_oracle(SEARCHES, "highway"))
def test_each_row_is_enough_to_run_its_run_again(name, monkeypatch):
    # What a search does with its findings adds no row, and takes longer than its runs.
    monkeypatch.setattr(bench, "_difference_in_gym", lambda run, bench: "")
    monkeypatch.setattr(steps, "_with_takeover", lambda sighting, *given: _as_it_is(sighting))
    search = {"world": pafot.Highway(), **SEARCHES[name]}
    found = pafot.explore(**search, holds=never_collides, runs=16, seed=5, shrink_runs=0)
    assert len(found.runs) >= 16
    fitness = resolve("default")
    for row in through_csv(found.runs):
        scenario = scenario_of(row)
        assert scenario.id == row["scenario"]
        trace = search["world"].rollout(scenario, search["ads"])
        run, hit, value = pafot.Run(trace), trace.collision, fitness(trace)
        again = {
            "outcome": str(trace.outcome),
            "duration": trace.duration,
            "fitness": value if math.isfinite(value) else "",
            "collision_time": "" if hit is None else hit.time,
            "npc": "" if hit is None else hit.npc,
            "side": "" if hit is None else hit.side,
            "closing_speed": "" if hit is None else hit.closing_speed,
        }
        assert {key: row[key] for key in again} == again
        if row["verdict"] != "":
            assert (row["least_gap"], row["hardest_braking"]) == (
                run.min_distance,
                run.hardest_brake,
            )


def test_a_run_whose_scenario_was_repaired_has_its_verdict_too():
    def holds(run):
        assert not run.collision

    found = pafot.explore(
        lambda: lambda observation: (0.0, 0.0),
        holds=holds,
        blame="ego",
        runs=24,
        seed=1,
        shrink_runs=0,
    )
    simulated = [row for row in found.runs if not row["reused"]]
    assert len(simulated) == 24
    assert [row["scenario"] for row in simulated if row["verdict"] is None] == []
    assert all(
        (row["verdict"] == "failed") == row["failing"] == bool(row["fault"]) for row in simulated
    )
