"""A run of an algorithm as rows, which agree with the world, and figures in which all algorithms differ."""

import json
from functools import partial
from itertools import count

import pytest

from pytest_pafot import Highway
from pytest_pafot.algorithms import ALGORITHMS
from pytest_pafot.attribution.responsibility import position_rule
from pytest_pafot.comparison.figures import STYLES, draw_all
from pytest_pafot.comparison.plan import COLUMNS, Plan, never_collides, run_rows
from pytest_pafot.comparison.run_measures import Results
from pytest_pafot.model.instructions import LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searches.explore import _note_of
from pytest_pafot.searches.harness import judge
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import csv_text
from tests.helpers.stages import mostly_oracle


def again(row):
    """Return the scenario of a row, only from its text."""
    npcs, seed, lane, speed, seconds = json.loads(row["executed"])
    make = {True: LaneInstruction, False: PositionInstruction}
    chains = [
        [make[isinstance(target, str)](target, each) for target, each in chain] for chain in npcs
    ]
    return Scenario(npcs=chains, seed=seed, ego_lane=lane, ego_speed=speed, gene_seconds=seconds)


@pytest.mark.parametrize(
    "algorithm", mostly_oracle(["pafot", "av-fuzzer", "random@paper"], "pafot")
)
def test_each_row_can_be_driven_again_identically(quick, algorithm):
    from example_ads import constant_speed

    rows = run_rows(quick(algorithms=(algorithm,)), (algorithm, 0))
    world = Highway(duration=20.0)
    for row in rows:
        trace = world.rollout(again(row), constant_speed.make)
        run = world.run_of(trace)
        assert (str(trace.outcome), trace.duration) == (row["outcome"], row["duration"])
        assert (trace.collision is None) == (row["collision_time"] is None)
        if row["verdict"] is not None:  # it is, if only a different scenario was simulated
            assert run.responsibility == row["responsibility"]
            assert position_rule(trace) == (row["position_responsibility"] or "none")
            verdict = judge(run, partial(never_collides, "any"), blame="any", test_file="")
            assert _note_of(run, verdict)["signature"] == row["signature"]
    assert any(row["outcome"] == "collision" for row in rows)
    assert COLUMNS.keys() <= row.keys()


def test_the_clock_counts_simulated_scenarios_alone(quick):
    rows = run_rows(quick(), ("av-fuzzer", 1))
    assert any(row["reused"] for row in rows)
    seconds = 0.0
    for row in rows:
        seconds += 0.0 if row["reused"] else row["duration"]
        assert row["clock"] == pytest.approx(seconds)


def test_run_ends_with_scenario_that_spends_its_seconds(quick):
    rows = run_rows(quick(seconds=100.0), ("pafot", 0))
    assert rows[-1]["clock"] >= 100.0
    assert all(row["clock"] < 100.0 for row in rows[:-1])


def test_failure_depends_on_collision_and_blame(quick):
    egos = {"ego", "both"}
    for blame, blamed in (("any", {"npc"} | egos), ("ego", egos)):
        rows = run_rows(quick(blame=blame, seconds=400.0), ("pafot", 0))
        hits = [row for row in rows if row["outcome"] == "collision" and not row["reused"]]
        assert {row["responsibility"] for row in hits} > {"npc"}
        assert all(row["failing"] == (row["responsibility"] in blamed) for row in hits)


def test_blame_changes_default_fitness_but_not_av_fuzzer(quick):
    steered = run_rows(quick(blame="ego", seconds=400.0), ("pafot", 0))
    assert all(row["fitness"] >= 2 for row in steered if row["responsibility"] == "ego")
    assert all(row["fitness"] <= 1 for row in steered if row["responsibility"] == "npc")
    plain = [
        [row["fitness"] for row in run_rows(quick(blame=blame), ("av-fuzzer", 0))]
        for blame in ("any", "ego")
    ]
    assert plain[0] == plain[1]


def test_raising_ads_is_a_failure_with_a_signature(quick):
    rows = run_rows(quick(ads=f"{__name__}:raising", seconds=1.0), ("random", 0))
    assert {row["outcome"] for row in rows} == {"ads_error"}
    assert all(row["failing"] and row["signature"].startswith("ads-error") for row in rows)


def raising():
    def drive(observation):
        if observation.time > 0:
            raise RuntimeError("no plan")
        return 0.0, 0.0

    return drive


@pytest.mark.parametrize("algorithm", mostly_oracle(list(ALGORITHMS), "random", "pafot"))
def test_ads_failing_every_first_decision_ends_the_run(quick, algorithm):
    """It ends although no simulated time passes."""
    with pytest.raises(RequestError, match=r"in all \d+ runs"):
        run_rows(quick(ads=f"{__name__}:failing_at_once"), (algorithm, 0))


def failing_at_once():
    def drive(observation):
        raise RuntimeError("no model")

    return drive


def test_one_driven_run_makes_the_others_failures(quick, monkeypatch):
    monkeypatch.setattr(f"{__name__}.MADE", count())
    rows = run_rows(quick(ads=f"{__name__}:failing_but_once", seconds=1.0), ("random", 0))
    assert [row["outcome"] for row in rows].count("ads_error") == len(rows) - 1


MADE = count()


def failing_but_once():
    return failing_at_once() if next(MADE) else lambda observation: (-5.0, 0.0)


def test_seeds_differ_by_run_and_algorithm_and_base():
    plan, other = (Plan(ads="x", algorithms=("pafot", "random"), seed=seed) for seed in (0, 1))
    seeds = [
        each.run_seed(name, run)
        for each in (plan, other)
        for name in plan.algorithms
        for run in range(10)
    ]
    assert len(set(seeds)) == 40
    assert seeds[0] == 110821487627419, "in every process the same"
    assert plan.run_seed("pafot", 0) == Plan(ads="y", algorithms=("pafot",)).run_seed("pafot", 0)


def test_runs_of_different_length_are_different_scenarios(quick):
    equal = quick(algorithms=("pafot", "random@paper"))
    assert list(equal.scenarios.values()) == [["pafot", "random@paper"]]
    (_, whole), (shorter, short) = quick(
        algorithms=("pafot", "av-fuzzer@15", "random@paper")
    ).scenarios.items()
    assert (whole, short) == (["pafot", "random@paper"], ["av-fuzzer@15"])
    assert shorter.endswith("; 3 genes of 5 s"), "225 ticks make no two genes"


# Figures.


def test_each_algorithm_has_unique_colour_line_and_marker():
    assert len(STYLES) >= len(ALGORITHMS)
    for name in ("colour", "line", "marker"):
        assert len({getattr(style, name) for style in STYLES}) == len(STYLES), name


@pytest.mark.filterwarnings("error")
def test_runs_without_duration_end_and_are_drawn_without_warning(tmp_path, quick):
    """Each run fails at its first decision, and in two ways, so the setup is not at fault."""
    plan = quick(ads=f"{__name__}:failing_in_two_ways", algorithms=("random",), runs=1, seconds=3.0)
    rows = run_rows(plan, ("random", 0))
    (tmp_path / "results.csv").write_text(
        csv_text(tuple(COLUMNS), ([row.get(name) for name in COLUMNS] for row in rows))
    )
    results = Results.read(plan, tmp_path / "results.csv")
    assert (len(rows), results.horizon) == (12, 0.0)
    assert "discoveries" in draw_all(results, tmp_path)


def failing_in_two_ways():
    def drive(observation):
        raise (ValueError if observation.others[0].x > observation.ego.x else KeyError)("no plan")

    return drive
