"""A scenario's result is known exactly if an earlier run determines it."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms.evaluation import EvaluationCache
from pytest_pafot.algorithms.operators import mutate
from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.model.instructions import SHIFTS, LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from tests.helpers.tables import table

PI = PositionInstruction


def chain(*genes):
    return tuple(PI(cell, speed) for cell, speed in genes)


def remembered(*evaluations):
    memory = EvaluationCache()
    for evaluation in evaluations:
        memory.add(evaluation)
    return memory


@given(st.integers(0, 2**32), st.integers(1, 3), st.integers(1, 4), st.floats(5, 25))
def test_recalled_evaluation_equals_that_of_a_run(cheap_world, seed, npcs, genes, crash_speed):
    world = cheap_world(crash_speed=crash_speed, genes=3)
    rng = np.random.default_rng(seed)
    space = SearchSpace(npcs=npcs, genes=genes)
    memory = EvaluationCache()
    scenario = sample(space, rng)
    for _ in range(30):
        recalled = memory.recall(scenario)
        run = world(scenario)
        assert recalled is None or recalled == run
        if recalled is None:
            memory.add(run)
        scenario = mutate(run.executed if rng.random() < 0.7 else scenario, space, rng)


@given(st.integers(0, 2**32))
def test_driven_scenario_is_known_with_any_seed(cheap_world, seed):
    run = cheap_world()(sample(SearchSpace(), np.random.default_rng(seed)))
    memory = remembered(run)
    assert memory.recall(run.scenario) == run
    other = replace(run.executed, seed=run.scenario.seed + 1)
    assert memory.recall(other) == replace(run, scenario=other, executed=other)


def test_run_of_other_vehicles_is_another_run(cheap_world):
    run = cheap_world()(sample(SearchSpace(), np.random.default_rng(0)))
    memory = remembered(run)
    assert memory.recall(replace(run.scenario, vehicles=("truck",))) is None
    assert memory.recall(replace(run.scenario, vehicles=("car",))) == run


@given(st.integers(0, 2**32))
def test_run_with_relevant_seed_matches_its_own_only(cheap_world, seed):
    run = cheap_world()(sample(SearchSpace(), np.random.default_rng(seed)))
    memory = EvaluationCache([run], seeds_matter=True)
    assert memory.recall(run.scenario) == run
    assert memory.recall(run.executed) == replace(run, scenario=run.executed)
    assert memory.recall(replace(run.executed, seed=run.scenario.seed + 1)) is None


def test_only_a_change_in_a_started_gene_is_a_new_scenario(make_evaluation):
    crashed = Scenario(npcs=(chain((4, 1.0), (4, 2.0), (4, 3.0)),))
    evaluation = make_evaluation(crashed, genes_started=2, fitness=7.0)
    memory, later = remembered(evaluation), Scenario(npcs=(chain((4, 1.0), (4, 2.0), (5, 9.0)),))
    assert memory.recall(later) == replace(evaluation, scenario=later, executed=later)
    assert memory.recall(Scenario(npcs=(chain((4, 1.0), (4, 2.1), (4, 3.0)),))) is None
    assert memory.recall(Scenario(npcs=(chain((4, 1.0), (3, 2.0), (4, 3.0)),))) is None


def test_evaluation_without_started_genes_matches_its_scenario_only(make_evaluation):
    scenario = Scenario(npcs=(chain((4, 1.0), (4, 2.0)),))
    memory = remembered(make_evaluation(scenario, genes_started=0, discarded=True))
    assert memory.recall(scenario) is not None
    assert memory.recall(Scenario(npcs=(chain((4, 1.0), (4, 2.1)),))) is None


def test_ended_chain_differs_from_a_continuing_chain(make_evaluation):
    short = Scenario(npcs=(chain((4, 1.0)), chain((8, 1.0), (8, 2.0), (8, 3.0))))
    memory = remembered(make_evaluation(short, genes_started=3))
    longer = Scenario(npcs=(chain((4, 1.0), (4, 1.0)), chain((8, 1.0), (8, 2.0), (8, 3.0))))
    assert memory.recall(longer) is None


def test_another_start_is_another_scenario(make_evaluation):
    scenario = Scenario(npcs=(chain((4, 1.0)),))
    memory = remembered(make_evaluation(scenario))
    for other in ({"ego_lane": 2}, {"ego_speed": 21.0}, {"gene_seconds": 5.0}):
        assert memory.recall(replace(scenario, **other)) is None


def test_repaired_scenario_is_known_with_its_seed_only(make_evaluation):
    asked = Scenario(npcs=(chain((8, 1.0), (1, 2.0)),), seed=3)
    driven = Scenario(npcs=(chain((4, 1.0), (3, 2.0)),), seed=3)
    memory = remembered(make_evaluation(asked, executed=driven))
    assert memory.recall(asked).executed == driven
    assert memory.recall(replace(asked, seed=4)) is None


def test_genes_after_a_repaired_run_still_fit(make_evaluation):
    asked = Scenario(npcs=(chain((8, 1.0), (8, 2.0)),), seed=3)
    driven = Scenario(npcs=(chain((4, 1.0), (4, 2.0)),), seed=3)
    memory = remembered(make_evaluation(asked, executed=driven, genes_started=1))
    recalled = memory.recall(Scenario(npcs=(chain((8, 1.0), (1, 9.0)),), seed=3))
    first, second = recalled.executed.npcs[0]
    assert first == PI(4, 1.0)
    assert second.speed == 9.0
    assert second.cell in (3, 5)


@table("lane", SHIFTS)
def test_lanes_differ_from_each_other_and_from_cells(make_evaluation, lane):
    known = make_evaluation(Scenario(npcs=((LaneInstruction(lane, 10.0),),)))
    memory = remembered(known)
    assert memory.recall(known.scenario) == known
    others = [LaneInstruction(other, 10.0) for other in SHIFTS if other != lane]
    for gene in (*others, *(PI(cell, 10.0) for cell in range(1, 9))):
        assert memory.recall(Scenario(npcs=((gene,),))) is None


def test_lane_instructions_as_driven_are_known_with_any_seed(make_evaluation):
    """The seed neither places their NPCs nor repairs them; it may repair the cells of another NPC in the scenario."""
    lanes = LaneInstruction("left", 20.0), LaneInstruction("left", 20.0)
    asked = Scenario(npcs=(lanes, chain((8, 1.0), (8, 2.0))), seed=3)
    driven = replace(
        asked, npcs=((lanes[0], LaneInstruction("keep", 20.0)), chain((1, 1.0), (1, 2.0)))
    )
    memory = EvaluationCache([make_evaluation(asked, executed=driven)])
    assert memory.recall(asked) is not None
    assert memory.recall(replace(asked, seed=4)) is None
    assert memory.recall(replace(driven, seed=4)) is not None


def test_oldest_runs_are_forgotten_without_a_trace(cheap_world):
    world, rng, space = (
        cheap_world(crash_speed=12.0),
        np.random.default_rng(0),
        SearchSpace(npcs=2, genes=2),
    )
    runs = [world(sample(space, rng)) for _ in range(30)]
    memory = remembered(*runs)
    memory.forget(10)
    assert [memory.recall(run.scenario) for run in runs] == [*[None] * 20, *runs[20:]]
    memory.forget(0)
    memory.add(runs[0])
    assert [memory.recall(run.scenario) for run in runs] == [runs[0], *[None] * 29]


def test_runs_with_equal_keys_are_forgotten_in_order(cheap_world):
    run = cheap_world()(sample(SearchSpace(), np.random.default_rng(0)))
    memory = remembered(run, replace(run, note="again"))
    memory.forget(1)
    assert memory.recall(run.scenario) is None
    memory.add(run)
    memory.forget(1)
    assert memory.recall(run.scenario) == run
