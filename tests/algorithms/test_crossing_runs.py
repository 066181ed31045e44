"""A search's view of runs with crossing NPCs: fitness, the nearest NPC, and whether anything happened."""

import math

import numpy as np
import pytest

from pytest_pafot.algorithms.evaluation import Evaluation, has_interaction
from pytest_pafot.algorithms.fitness import (
    FITNESSES,
    Steered,
    before_impact,
    default_fitness,
    resolve,
)
from pytest_pafot.model.trace import Outcome
from tests.helpers.junctions import driven, hit, plan
from tests.helpers.tables import table
from tests.helpers.traces import blamed_on

EGO = plan("west straight", 8.0, 10.0)


def run_of(*enters, npc="north straight", ego=EGO, **road):
    """Return a run with an ego that enters its zone after 8 s, and NPCs at 9 m/s that would drive through it."""
    first, *others = (plan(npc, each, 9.0) for each in enters)
    return driven(ego, first, others=tuple(others), **road)


def collision():
    return hit(EGO, plan("north straight", 8.0, 9.0))


def test_smaller_time_between_entries_is_always_worse():
    fitness = [default_fitness(run_of(enters)) for enters in (20.0, 13.0, 11.0, 10.3, 9.8)]
    assert fitness == sorted(fitness)
    assert len(set(fitness)) == 5
    assert all(0 <= each <= 1 for each in fitness)
    assert default_fitness(collision()) > 1


def test_npc_that_enters_first_counts_as_much():
    after, before = (
        [default_fitness(run_of(8.0 + sign * gap)) for gap in (2.5, 3.5)] for sign in (1, -1)
    )
    assert after[0] > after[1]
    assert before[0] > before[1]


def test_npc_on_grid_is_measured_alongside_distant_crossing():
    alone = driven(EGO, plan("grid", 6.0, 9.0), others=(plan("north straight", 60.0, 9.0),))
    assert default_fitness(alone) > default_fitness(run_of(60.0))


@table("name", [name for name in FITNESSES if name not in ("paper", "default")])
def test_no_named_fitness_is_nan_with_crossing_npcs(name):
    for trace in (run_of(8.5, 12.0), collision()):
        assert not math.isnan(resolve(name)(trace))


def test_run_before_impact_includes_all_crossing_ways():
    trace = collision()
    before = before_impact(trace)
    assert (before.outcome, before.collision) == (Outcome.COMPLETED, None)
    assert before.on_way.shape == (before.ticks + 1, 1)
    assert before.ticks == trace.collision.tick - 45
    np.testing.assert_array_equal(before.on_way, trace.on_way[: before.ticks + 1])


def test_npc_caused_collision_is_rated_by_earlier_run():
    trace, fitness = collision(), resolve("default")
    assert Steered(fitness)(blamed_on("ego", trace)) > 2
    assert -1 <= Steered(fitness)(blamed_on("npc", trace)) <= 1


@pytest.mark.parametrize(
    ("enters", "expected"), [(8.5, True), (10.0, True), (13.0, False), (3.0, False)]
)
def test_who_is_about_to_share_a_zone_interacts(enters, expected):
    for run in (run_of(enters), run_of(20.0, enters)):
        assert has_interaction(run) is expected
        assert Evaluation.from_trace(run, fitness=0.5, failing=False).interaction is expected
