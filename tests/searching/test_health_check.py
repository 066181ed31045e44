"""A search that tested nothing says so."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.model.instructions import CrossingInstruction, LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching import Health
from pytest_pafot.searching.evaluation import ended_at_object
from pytest_pafot.searching.events import Evaluated
from pytest_pafot.searching.space import SearchSpace, sample
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle

LANES, CELLS = (LaneInstruction("left", 8.0),), (PositionInstruction(2, 8.0),)
CROSSES = (CrossingInstruction("o1>o3", 0.0, 8.0),)
WELL = {"genes_started": 12, "genes_reached": 9}

spaces = st.builds(SearchSpace, npcs=st.integers(1, 3), instructions=st.sampled_from(["cells", "lanes", "both"]))


def health_of(make_evaluation, *groups):
    """Return the health of groups of evaluations, given as (count, fields)."""
    health = Health()
    for number, fields in groups:
        for _ in range(number):
            health = health.counted(make_evaluation(**(WELL | fields)))
    return health


def test_a_search_that_went_well_warns_of_nothing(make_evaluation):
    health = health_of(make_evaluation, (9, {}), (1, {"outcome": Outcome.INVALID}))
    assert health.warnings() == []
    assert not health.vacuous
    assert health.reached_share == 0.75


def test_a_search_without_a_run_is_vacuous():
    assert Health().vacuous
    assert Health().warnings() == [
        "no scenario was simulated, so nothing was tested; give the search generations and time"
    ]


@pytest.mark.parametrize("fields", [{"outcome": Outcome.INVALID}, {"discarded": True}])
def test_a_search_without_a_valid_run_is_vacuous(make_evaluation, fields):
    health = health_of(make_evaluation, (4, fields))
    assert health.vacuous
    assert any(warning.startswith("most of 4 simulated scenarios tested nothing: 4 ") for warning in health.warnings())
    assert health_of(make_evaluation, (2, {}), (3, fields)).vacuous
    assert not health_of(make_evaluation, (3, {}), (3, fields)).vacuous


def test_a_search_whose_runs_the_environment_ends_at_once_says_so(make_evaluation):
    over, later = ({"ended": "GoalEnv._is_terminated", "duration": seconds} for seconds in (0.8, 8.0))
    assert health_of(make_evaluation, (9, later)).warnings() == []
    (warning,) = health_of(make_evaluation, (3, later), (6, over)).warnings()
    assert "nothing: 6 were ended within the first second by GoalEnv._is_terminated; use fewer" in warning
    assert not health_of(make_evaluation, (6, later), (6, over)).vacuous


def test_a_search_whose_runs_leave_the_road_at_once_says_so(make_evaluation):
    off, later = ({"outcome": Outcome.OFF_ROAD, "duration": seconds} for seconds in (0.3, 8.0))
    assert health_of(make_evaluation, (9, later)).warnings() == []
    health = health_of(make_evaluation, (3, later), (6, off))
    assert health.warnings()[1:] == [
        "67 % (6) of 9 valid runs left the road within the first second, before an NPC can have caused it; check the "
        "units and axes of the world, and that the ADS returns accelerations in m/s^2 and steers in rad"
    ]
    assert health.vacuous
    assert not health_of(make_evaluation, (6, later), (6, off)).vacuous
    assert health_of(make_evaluation, (4, later), (3, off), (2, {"outcome": Outcome.INVALID})).vacuous


def test_an_error_in_what_ends_episodes_is_named_with_what_to_do(make_evaluation):
    failed = {"outcome": Outcome.INVALID, "users_error": "GoalEnv._is_terminated failed: KeyError: 'goal'"}
    (first, *_) = health_of(make_evaluation, (4, failed)).warnings()
    assert first == (
        "4 simulated scenarios tested nothing; most often GoalEnv._is_terminated failed: KeyError: 'goal'; correct it, "
        'or write ends="duration" in the world'
    )


def test_more_than_a_quarter_invalid_runs_warns(make_evaluation):
    invalid = {"outcome": Outcome.INVALID}
    assert health_of(make_evaluation, (3, {}), (1, invalid)).warnings() == []
    assert health_of(make_evaluation, (2, {}), (1, invalid)).warnings() == [
        "33 % (1) of 3 simulated scenarios ended in a crash of NPCs and tested nothing, which should be at most "
        "25 %; use fewer NPCs or more lanes"
    ]


AVOIDED = "NPCs do not avoid objects: use shorter runs (duration= of the world), fewer NPCs or fewer objects"


def test_runs_that_end_at_fixed_objects_warn_of_those(make_evaluation):
    at_object = {"outcome": Outcome.INVALID, "at_object": True}
    assert health_of(make_evaluation, (2, {}), (1, at_object)).warnings() == [
        "33 % (1) of 3 simulated scenarios ended where an NPC touched a fixed object and tested nothing, which should "
        f"be at most 25 %; {AVOIDED}"
    ]
    assert health_of(make_evaluation, (2, {}), (1, at_object), (1, {"outcome": Outcome.INVALID})).warnings() == [
        "50 % (2) of 4 simulated scenarios ended in a crash of NPCs or, 1 of them, where an NPC touched a fixed "
        f"object, and tested nothing, which should be at most 25 %; {AVOIDED}"
    ]
    none = health_of(make_evaluation, (4, at_object)).warnings()
    assert "nothing: 4 ended where an NPC touched a fixed object; use" in none[0]


def test_an_npc_at_a_fixed_object_is_told_from_two_npcs_that_touch():
    def ended(*npcs, outcome=Outcome.INVALID, obstacles=((60.0, 4.0, 0.0, 2.0, 2.0),)):
        return ended_at_object(trace_of(vehicle(0.0), *npcs, outcome=outcome, obstacles=obstacles))

    assert ended(vehicle(57.0), vehicle(20.0))
    assert ended(vehicle(57.0))
    assert not ended(vehicle(57.0), vehicle(54.0))
    assert not ended(vehicle(57.0), obstacles=())
    assert not ended(vehicle(57.0), outcome=Outcome.SAFE)


def test_genes_that_are_hardly_reached_warn(make_evaluation):
    (warning,) = health_of(make_evaluation, (4, {"genes_reached": 2})).warnings()
    assert warning.startswith("NPCs reached the cell of only 17 % (8) of 48 Position-Instructions")


@pytest.mark.parametrize(
    ("chains", "goal"), [([LANES], "lane"), ([LANES, CELLS], "cell or lane"), ([CELLS, CROSSES], "cell or zone")]
)
def test_lanes_and_zones_that_are_hardly_reached_warn(make_evaluation, chains, goal):
    fields = {"scenario": Scenario(npcs=chains), "genes_reached": 2}
    (warning,) = health_of(make_evaluation, (4, fields)).warnings()
    assert warning.startswith(f"NPCs reached the {goal} of only 17 % (8) of 48 instructions that")


@table(
    ("fields", "expected"),
    [
        ({"interaction": False}, "67 % (2) of 3 valid runs never brought an NPC near the ego"),
        ({"outran": True}, "67 % (2) of 3 valid runs left all NPCs more than 100 m behind"),
        ({"barely_moved": True}, "67 % (2) of 3 valid runs had an ego with a mean speed below 2 m/s"),
        (
            {"outcome": Outcome.COLLISION, "duration": 0.2},
            "67 % (2) of 3 valid runs collided within the first second",
        ),
    ],
)
def test_runs_that_test_nothing_warn_when_most_common(make_evaluation, fields, expected):
    assert health_of(make_evaluation, (1, {}), (1, fields)).warnings() == []
    (warning,) = health_of(make_evaluation, (1, {}), (2, fields)).warnings()
    assert warning.startswith(expected)
    assert "; " in warning  # and the way out


def test_advice_is_in_the_units_of_the_actions(make_evaluation):
    health = health_of(make_evaluation, (1, {"outcome": Outcome.COLLISION, "duration": 0.2, "barely_moved": True}))
    in_si, by_choices = (" ".join(health.warnings(acts_in_si=is_si)) for is_si in (True, False))
    assert in_si.count("the ADS returns accelerations in m/s^2 and steers in rad") == 2
    assert by_choices.count("the ADS returns the environment's actions as in its training") == 2
    assert "m/s^2" not in by_choices
    assert "rad" not in by_choices


@pytest.mark.parametrize("fitness", [math.nan, -math.inf, math.inf])
def test_fitness_that_is_never_a_number_warns(make_evaluation, fitness):
    (warning,) = health_of(make_evaluation, (3, {"fitness": fitness})).warnings()
    assert warning.startswith("the fitness was no finite number in any of 3 valid runs, so it could not guide")
    assert health_of(make_evaluation, (3, {"fitness": fitness}), (1, {})).warnings() == []


def test_invalid_runs_do_not_count_as_without_interaction(make_evaluation):
    health = health_of(make_evaluation, (1, {"outcome": Outcome.INVALID, "interaction": False, "outran": True}))
    assert (health.no_interaction, health.outran, health.valid) == (0, 0, 0)


@pytest.mark.parametrize("outcome", [Outcome.ADS_ERROR, Outcome.HANG])
def test_runs_cut_by_ads_fault_give_no_warning(make_evaluation, outcome):
    fields = {"outcome": outcome, "failing": True, "interaction": False, "barely_moved": True, "outran": True}
    health = health_of(make_evaluation, (4, fields | {"genes_reached": 0}))
    assert health.warnings() == []
    assert (health.valid, health.failing, health.no_interaction, health.genes_started) == (4, 4, 0, 0)


def test_reused_evaluations_are_not_runs(make_evaluation):
    health = Health().counted(make_evaluation()).counted(make_evaluation(), reused=True)
    assert (health.evaluated, health.simulated, health.reused) == (2, 1, 1)


@given(data=st.data())
def test_the_health_of_the_parts_of_a_campaign_is_together_that_of_the_whole(make_evaluation, data):
    fields = st.fixed_dictionaries(
        {
            "scenario": st.builds(sample, spaces, st.builds(np.random.default_rng, st.integers(0, 99))),
            "outcome": st.sampled_from(Outcome),
            "duration": st.sampled_from([0.5, 60.0]),
            "fitness": st.sampled_from([1.0, math.nan]),
            **dict.fromkeys(("failing", "discarded", "interaction", "outran", "barely_moved"), st.booleans()),
        }
    )
    runs = data.draw(st.lists(st.tuples(fields, st.booleans()), max_size=12))
    events = [
        Evaluated(generation=0, local_generation=0, index=0, evaluation=make_evaluation(**each), reused=reused)
        for each, reused in runs
    ]
    cuts = sorted(data.draw(st.lists(st.integers(0, len(events)), max_size=3)))
    parts = [events[start:end] for start, end in zip([0, *cuts], [*cuts, len(events)], strict=True)]
    whole = Health.of(events)
    assert sum(map(Health.of, parts), Health()) == whole
    one_by_one = Health()
    for event in events:
        one_by_one = one_by_one.counted(event.evaluation, reused=event.reused)
    assert one_by_one == whole
    simulated = [each for each, reused in runs if not reused]
    assert (whole.evaluated, whole.simulated) == (len(runs), len(simulated))
    assert whole.invalid == sum(each["outcome"] is Outcome.INVALID for each in simulated)
    assert whole.goals.total() == sum(len(each["scenario"].npcs) for each in simulated)
