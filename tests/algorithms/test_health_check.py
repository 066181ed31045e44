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
    assert Health().vacuous
    assert Health().warnings() == [
        "no scenario was simulated, so nothing was tested. Give the search more time or more generations."
    ]


@pytest.mark.parametrize("fields", [{"outcome": Outcome.INVALID}, {"discarded": True}])
def test_a_search_without_a_valid_run_is_vacuous(make_evaluation, fields):
    health = health_of(make_evaluation, (4, fields))
    assert health.vacuous
    assert any(
        warning.startswith("4 of 4 runs (100 %) tested nothing (") for warning in health.warnings()
    )
    assert health_of(make_evaluation, (2, {}), (3, fields)).vacuous
    assert not health_of(make_evaluation, (3, {}), (3, fields)).vacuous


GOAL = {"ended": "GoalEnv._is_terminated", "duration": 8.0, "gap": 3.2}
ENDED = (
    "ended early without a collision, because of GoalEnv._is_terminated. In {} of them, a vehicle was within two "
    "seconds of the ego. The smallest gap to a vehicle was 3.2 m. Correct the cause, or let the runs continue with "
    'ends="duration" in a pafot.World.'
)


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
    sentence = f"{runs} of 10 runs ({runs}0 %) {ENDED.format(close)}" if says else ""
    assert (health.early_ends, health.warnings()) == (sentence, [sentence] if warns else [])
    assert not health.vacuous


@pytest.mark.parametrize(
    "fields", [{"failing": True}, {"outcome": Outcome.INVALID}, {"outcome": Outcome.HANG}]
)
def test_runs_that_fail_or_are_invalid_hide_nothing_by_ending_early(make_evaluation, fields):
    assert health_of(make_evaluation, (9, GOAL | fields)).ended == {}


def test_early_ends_of_rejected_runs_count(make_evaluation):
    assert (
        "because of GoalEnv"
        in health_of(make_evaluation, (9, GOAL | {"discarded": True})).early_ends
    )


def test_leaving_the_road_is_an_early_end_with_its_own_advice(make_evaluation):
    health = health_of(make_evaluation, (3, GOAL), (6, GOAL | {"ended": LEAVING[Outcome.OFF_ROAD]}))
    (warning,) = health.warnings()
    assert "9 of 9 runs (100 %)" in warning
    assert (
        "because the ego left the road (6) and because of GoalEnv._is_terminated (3). In 0 of them"
        in warning
    )
    assert warning.endswith("Check the units and axes of the world and of the ADS's actions.")


@table("seconds", [0.3, 1.0, 1.1])
def test_a_search_whose_runs_mostly_end_at_once_is_vacuous(make_evaluation, seconds):
    over = GOAL | {"duration": seconds}
    assert health_of(
        make_evaluation, (4, GOAL), (3, over), (2, {"outcome": Outcome.INVALID})
    ).vacuous is (seconds <= 1)
    assert not health_of(make_evaluation, (6, GOAL), (6, over)).vacuous


def test_an_error_in_what_ends_episodes_is_named_with_what_to_do(make_evaluation):
    failed = {
        "outcome": Outcome.INVALID,
        "ended": "GoalEnv._is_terminated failed: KeyError: 'goal'",
    }
    (first, *_) = health_of(make_evaluation, (4, failed)).warnings()
    assert first == (
        "4 of 4 simulated scenarios (100 %) tested nothing. The most frequent error: GoalEnv._is_terminated failed: "
        "KeyError: 'goal'. "
        'Correct it, or write ends="duration" in the world.'
    )


def test_more_than_a_quarter_of_runs_that_a_simulator_made_invalid_tested_too_little(
    make_evaluation,
):
    jumps = [
        {
            "outcome": Outcome.INVALID,
            "ended": f"Jumps.states, tick {tick}: NPC 0 moved 50.5 m in a tick",
        }
        for tick in (60, 61)
    ]
    told_of = "tested nothing. One of the errors: Jumps.states, tick 60: NPC 0 moved 50.5 m in a"
    for others, share, tested_too_little in ((6, "25 %", False), (5, "29 %", True)):
        health = health_of(make_evaluation, (others, {}), *[(1, each) for each in jumps])
        (told,) = health.warnings()
        assert told.startswith(f"2 of {others + 2} simulated scenarios ({share}) {told_of}")
        assert told.endswith(" in a tick. Correct it.")
        assert health.vacuous is tested_too_little


def test_more_than_a_quarter_invalid_runs_warns(make_evaluation):
    invalid = {"outcome": Outcome.INVALID}
    assert health_of(make_evaluation, (3, {}), (1, invalid)).warnings() == []
    assert health_of(make_evaluation, (2, {}), (1, invalid)).warnings() == [
        "1 of 3 simulated scenarios (33 %) tested nothing, because an NPC touched another NPC or a fixed object. "
        "Use fewer NPCs, more lanes or shorter runs."
    ]


@table(("fields", "expected"), [
    ({"interaction": False}, "in 2 of 3 valid runs (67 %), no NPC came near the ego in the ego's lane"),
    ({"barely_moved": True}, "in 2 of 3 valid runs (67 %), the ego's mean speed was below 2 m/s"),
])  # fmt: skip
def test_runs_that_test_nothing_warn_when_most_common(make_evaluation, fields, expected):
    assert health_of(make_evaluation, (1, {}), (1, fields)).warnings() == []
    (warning,) = health_of(make_evaluation, (1, {}), (2, fields)).warnings()
    assert warning.startswith(expected)
    assert ". " in warning  # and the way out


def test_invalid_runs_do_not_count_as_without_interaction(make_evaluation):
    health = health_of(make_evaluation, (1, {"outcome": Outcome.INVALID, "interaction": False}))
    assert (health.no_interaction, health.valid) == (0, 0)


@pytest.mark.parametrize("outcome", [Outcome.ADS_ERROR, Outcome.HANG])
def test_runs_cut_by_ads_fault_give_no_warning(make_evaluation, outcome):
    fields = {"outcome": outcome, "failing": True, "interaction": False, "barely_moved": True}
    health = health_of(make_evaluation, (4, fields | {"genes_reached": 0}))
    assert health.warnings() == []
    assert (health.valid, health.failing, health.no_interaction, health.genes_started) == (
        4,
        4,
        0,
        0,
    )


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
