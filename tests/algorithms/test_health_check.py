"""A search that tested nothing says so."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms import Health
from pytest_pafot.algorithms.evaluation import LEAVING
from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.model.instructions import (
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
)
from pytest_pafot.model.trace import Outcome
from tests.helpers.tables import table

LANES, CELLS = (LaneInstruction("left", 8.0),), (PositionInstruction(2, 8.0),)
CROSSES = (CrossingInstruction("o1>o3", 0.0, 8.0),)
WELL = {"genes_started": 12, "genes_reached": 9}

spaces = st.builds(
    SearchSpace, npcs=st.integers(1, 3), instructions=st.sampled_from(["cells", "lanes", "both"])
)


def health_of(make_evaluation, *groups):
    """Return the health of groups of evaluations, given as (count, fields)."""
    runs = [make_evaluation(**(WELL | fields)) for number, fields in groups for _ in range(number)]
    return Health.of_runs(len(runs), runs)


def test_a_search_that_went_well_warns_of_nothing(make_evaluation):
    health = health_of(make_evaluation, (9, {}), (1, {"outcome": Outcome.INVALID}))
    assert health.warnings() == []
    assert not health.vacuous
    assert health.reached_share == 0.75


def test_a_search_without_a_run_is_vacuous():
    assert (Health().vacuous, len(Health().warnings())) == (True, 1)


@pytest.mark.parametrize("fields", [{"outcome": Outcome.INVALID}, {"discarded": True}])
def test_a_search_without_a_valid_run_is_vacuous(make_evaluation, fields):
    health = health_of(make_evaluation, (4, fields))
    assert health.vacuous
    assert health.warnings()
    assert health_of(make_evaluation, (2, {}), (3, fields)).vacuous
    assert not health_of(make_evaluation, (3, {}), (3, fields)).vacuous


GOAL = {"ended": "GoalEnv._is_terminated", "duration": 8.0, "gap": 3.2}


@table(
    ("runs", "close", "says", "warns"),
    [(1, 0, False, False), (2, 0, True, False), (1, 1, True, False), (5, 1, True, False), (6, 0, True, True),
     (2, 2, True, True)],
)  # fmt: skip
def test_early_ends_are_said_from_a_tenth_and_warn_from_half_of_the_runs(
    make_evaluation, runs, close, says, warns
):
    groups = (
        (close, GOAL | {"is_close": True}),
        (runs - close, GOAL | {"gap": 4.0} if close else GOAL),
        (10 - runs, {}),
    )
    health = health_of(make_evaluation, *groups)
    assert health.early_ends.startswith(f"{runs} of 10 runs ") is says
    assert health.warnings() == ([health.early_ends] if warns else [])
    assert not health.vacuous


@pytest.mark.parametrize(
    "fields", [{"failing": True}, {"outcome": Outcome.INVALID}, {"outcome": Outcome.HANG}]
)
def test_runs_that_fail_or_are_invalid_hide_nothing_by_ending_early(make_evaluation, fields):
    assert health_of(make_evaluation, (9, GOAL | fields)).ended == {}


def test_early_ends_of_rejected_runs_count(make_evaluation):
    assert health_of(make_evaluation, (9, GOAL | {"discarded": True})).early_ends


def test_leaving_the_road_is_an_early_end(make_evaluation):
    off_road = LEAVING[Outcome.OFF_ROAD]
    health = health_of(make_evaluation, (3, GOAL), (6, GOAL | {"ended": off_road}))
    assert health.ended == {GOAL["ended"]: 3, off_road: 6}
    assert len(health.warnings()) == 1


@table("seconds", [0.3, 1.0, 1.1])
def test_a_search_whose_runs_mostly_end_at_once_is_vacuous(make_evaluation, seconds):
    over = GOAL | {"duration": seconds}
    assert health_of(
        make_evaluation, (4, GOAL), (3, over), (2, {"outcome": Outcome.INVALID})
    ).vacuous is (seconds <= 1)
    assert not health_of(make_evaluation, (6, GOAL), (6, over)).vacuous


def test_more_than_a_quarter_of_runs_that_a_simulator_made_invalid_tested_too_little(
    make_evaluation,
):
    jumps = [
        (1, {"outcome": Outcome.INVALID, "ended": f"Jumps.states, tick {n}"}) for n in (60, 61)
    ]
    for others, tested_too_little in ((6, False), (5, True)):
        health = health_of(make_evaluation, (others, {}), *jumps)
        assert (len(health.warnings()), health.vacuous) == (1, tested_too_little)


def test_more_than_a_quarter_invalid_runs_warns(make_evaluation):
    invalid = (1, {"outcome": Outcome.INVALID})
    warned = [len(health_of(make_evaluation, (n, {}), invalid).warnings()) for n in (3, 2)]
    assert warned == [0, 1]


@table("fields", [{"interaction": False}, {"barely_moved": True}])
def test_runs_that_test_nothing_warn_when_most_common(make_evaluation, fields):
    warned = [len(health_of(make_evaluation, (1, {}), (n, fields)).warnings()) for n in (1, 2)]
    assert warned == [0, 1]


def test_invalid_runs_do_not_count_as_without_interaction(make_evaluation):
    invalid = {"outcome": Outcome.INVALID, "interaction": False}
    health = health_of(make_evaluation, (1, invalid))
    assert (health.no_interaction, health.valid) == (0, 0)


@pytest.mark.parametrize("outcome", [Outcome.ADS_ERROR, Outcome.HANG])
def test_runs_cut_by_ads_fault_give_no_warning(make_evaluation, outcome):
    fields = {"outcome": outcome, "failing": True, "interaction": False, "barely_moved": True}
    health = health_of(make_evaluation, (4, fields | {"genes_reached": 0}))
    assert health.warnings() == []
    assert (health.valid, health.failing) == (4, 4)
    assert (health.no_interaction, health.genes_started) == (0, 0)


@given(data=st.data())
def test_the_health_of_the_parts_of_a_search_is_together_that_of_the_whole(make_evaluation, data):
    fields = st.fixed_dictionaries(
        {
            "scenario": st.builds(
                sample, spaces, st.builds(np.random.default_rng, st.integers(0, 99))
            ),
            "outcome": st.sampled_from(Outcome),
            "duration": st.sampled_from([0.5, 60.0]),
            "ended": st.sampled_from(["", "Goal._is_terminated"]),
            "gap": st.sampled_from([1.0, math.inf]),
            **dict.fromkeys(("failing", "discarded", "interaction", "barely_moved"), st.booleans()),
        }
    )
    runs = data.draw(st.lists(st.tuples(fields, st.booleans()), max_size=12))
    evaluated = [(make_evaluation(**each), reused) for each, reused in runs]
    cuts = sorted(data.draw(st.lists(st.integers(0, len(runs)), max_size=3)))
    parts = [
        evaluated[start:end] for start, end in zip([0, *cuts], [*cuts, len(runs)], strict=True)
    ]

    def counted(part):
        return Health.of_runs(len(part), [each for each, reused in part if not reused])

    whole = counted(evaluated)
    assert sum(map(counted, parts), Health()) == whole
    simulated = [each for each, reused in runs if not reused]
    assert (whole.evaluated, whole.simulated) == (len(runs), len(simulated))
    assert whole.invalid == sum(each["outcome"] is Outcome.INVALID for each in simulated)
    assert whole.reused == len(runs) - len(simulated)
