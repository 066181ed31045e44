"""The order of evaluations, and the values that they take from a trace."""

import math
import pickle

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms.evaluation import Evaluation, has_interaction
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import HEADING, LANE, SPEED, Collision, Outcome, X, Y
from tests.helpers.tables import table
from tests.helpers.traces import random_states, trace_of, vehicle

NAN = math.nan


def test_what_fails_outranks_what_is_fitter(make_evaluation):
    failing = make_evaluation(failing=True, fitness=-5.0)
    assert failing.rank > make_evaluation(fitness=math.inf).rank


def test_among_equals_the_fitter_ranks_higher(make_evaluation):
    for failing in (False, True):
        assert (
            make_evaluation(failing=failing, fitness=0.2).rank
            > make_evaluation(failing=failing, fitness=0.1).rank
        )


@table("fields", [{"outcome": Outcome.INVALID}, {"discarded": True}, {"fitness": NAN}])
def test_invalid_discarded_and_unmeasured_runs_rank_last(make_evaluation, fields):
    worst = make_evaluation(**({"failing": True, "fitness": 9.0} | fields))
    assert not worst.eligible
    assert worst.rank < make_evaluation(fitness=-1e300).rank


@given(st.lists(st.tuples(st.booleans(), st.floats(), st.booleans()), min_size=2))
def test_the_order_is_total_whatever_the_fitness(make_evaluation, fields):
    ranks = [make_evaluation(failing=f, fitness=x, discarded=d).rank for f, x, d in fields]
    assert all((a < b) + (a == b) + (a > b) == 1 for a in ranks for b in ranks)


def test_missing_fitness_compares_equal_and_numpy_becomes_float(make_evaluation):
    assert make_evaluation(fitness=np.float64("nan")) == make_evaluation(fitness=float("nan"))
    assert type(make_evaluation(fitness=np.float64(1.5)).fitness) is float


@table("fitness", [float("nan"), -math.inf, 1.5])
def test_evaluation_from_another_process_equals_the_original(make_evaluation, fitness):
    here = make_evaluation(fitness=fitness)
    there = pickle.loads(pickle.dumps(here))
    assert (here, hash(here)) == (there, hash(there))
    assert here != make_evaluation(fitness=0.0)


def test_depth_counts_the_started_genes_per_npc(make_evaluation):
    stay = PositionInstruction(4, 1.0)
    uneven = Scenario(npcs=((stay,) * 2, (PositionInstruction(8, 1.0),) * 5))
    for depth, started in enumerate((2, 4, 5, 6, 7), start=1):
        assert make_evaluation(uneven, genes_started=started).depth == depth


def test_all_genes_count_when_none_was_started(make_evaluation):
    three = Scenario(npcs=((PositionInstruction(4, 1.0),) * 3,))
    assert make_evaluation(three, genes_started=0).depth == 3


def trace(ego_speed=20.0, **fields):
    """Return 10 s of an ego and an NPC 60 m ahead of it, which drives 20 m/s, both at constant speeds."""
    vehicles = (
        vehicle(x, speed=speed, ticks=150) for x, speed in ((1000.0, ego_speed), (1060.0, 20.0))
    )
    scenario = Scenario(npcs=((PositionInstruction(2, 20.0), PositionInstruction(2, 5.0)),))
    return trace_of(*vehicles, scenario=scenario, arrivals=((3, None),), **fields)


def test_an_evaluation_is_read_from_a_trace():
    evaluation = Evaluation.from_trace(trace(), fitness=0.5, failing=True)
    assert (evaluation.genes_started, evaluation.genes_reached, evaluation.duration) == (2, 1, 10.0)
    assert (evaluation.outcome, evaluation.failing, evaluation.fitness) == (
        Outcome.COMPLETED,
        True,
        0.5,
    )


@table(("fields", "by"), [
    ({}, ""),
    ({"ended": "Goal._is_terminated"}, "Goal._is_terminated"),
    ({"ended": "highway_env.envs.merge_env.MergeEnv._is_terminated"}, ""),
    ({"outcome": Outcome.LEFT_ROUTE}, "the ego left its route"),
    ({"outcome": Outcome.OFF_ROAD, "off_road_tick": 150}, "the ego left the road"),
    ({"outcome": Outcome.OFF_ROAD, "off_road_tick": 20}, ""),  # it drove on, on a straight road
    ({"outcome": Outcome.END_OF_ROAD}, ""),
])  # fmt: skip
def test_an_evaluation_says_what_ended_its_run_early(fields, by):
    evaluation = Evaluation.from_trace(trace(**fields), fitness=0.5, failing=False)
    assert (evaluation.ended, math.isfinite(evaluation.gap)) == (by, bool(by))


@table(("ahead", "is_close"), [(46.0, True), (47.0, False)])
def test_a_vehicle_is_close_if_it_would_be_touched_within_two_seconds(ahead, is_close):
    run = trace_of(
        vehicle(0.0, speed=20.0, ticks=1),
        vehicle(ahead, speed=0.0, ticks=1),
        ended="Goal._is_terminated",
    )
    evaluation = Evaluation.from_trace(run, fitness=0.5, failing=False)
    assert math.isclose(evaluation.gap, ahead - 20 / 15 - 5)
    assert evaluation.is_close is is_close


def test_a_collision_is_an_interaction():
    crash = Collision(
        tick=9,
        time=0.6,
        npc=0,
        side="left",
        cell=8,
        ego_speed=1.0,
        npc_speed=1.0,
        closing_speed=0.1,
    )
    assert has_interaction(trace(outcome=Outcome.COLLISION, collision=crash))


def tick_by_tick(trace):
    """Return the same by a loop over all ticks and vehicles, with the limits of the docstring as numbers."""
    interacted = False
    for ego, *npcs in trace.states.tolist():
        for (x, y, _, speed, _, _, lane), (length, _) in zip(
            npcs, trace.sizes.tolist()[1:], strict=True
        ):
            ahead = (x - ego[X]) * math.cos(ego[HEADING]) + (y - ego[Y]) * math.sin(ego[HEADING])
            gap = abs(ahead) - (trace.sizes[0, 0] + length) / 2
            follower = ego[SPEED] if ahead >= 0 else speed
            interacted |= lane == ego[LANE] and (gap < 1.5 * follower or gap < 2.0)
    return bool(interacted)


@given(seed=st.integers(0, 2**32), spread=st.sampled_from([5.0, 25.0, 500.0]))
def test_interaction_is_that_of_a_loop_in_any_states(seed, spread):
    rng = np.random.default_rng(seed)
    vehicles = int(rng.integers(2, 6))
    states = random_states(rng, int(rng.integers(1, 40)), vehicles, spread=spread)
    run = trace_of(*np.moveaxis(states, 1, 0), sizes=rng.uniform(1, 6, (vehicles, 2)))
    assert has_interaction(run) == tick_by_tick(run)


@table("x", [-35.1, -34.9, 34.9, 35.1])
def test_interaction_is_that_of_a_loop_at_the_bounds(x):
    run = trace_of(vehicle(0, speed=20, ticks=9), vehicle(x, speed=20, ticks=9))
    assert has_interaction(run) == tick_by_tick(run) == (abs(x) < 35)


def test_an_npc_that_is_nowhere_does_not_interact():
    run = trace_of(vehicle(0, speed=20, ticks=9), vehicle(math.nan, speed=20, lane=0))
    assert has_interaction(run) == tick_by_tick(run) == False  # noqa: E712


@table(("speed", "expected"), [(0.0, True), (1.9, True), (2.1, False)])
def test_ego_below_two_metres_per_second_barely_moves(speed, expected):
    assert Evaluation.from_trace(trace(speed), fitness=0.5, failing=False).barely_moved is expected
