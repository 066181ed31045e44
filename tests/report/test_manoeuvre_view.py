"""Manoeuvres are displayed by their start and their steps, with what was not as asked."""

from pytest_pafot import Highway
from pytest_pafot.model.instructions import Manoeuvre, PositionInstruction, Step
from pytest_pafot.model.scenario import Scenario
from tests.helpers.world_cases import constant_speed
from tests.report.builders import view_of

CUT_IN = Manoeuvre(
    beside=1,
    ahead=30.0,
    speed=15.0,
    steps=(Step(gap=20.0, lane="right", speed=5.0, acceleration=12.0), Step(gap=-400.0)),
)
TRACE = Highway(duration=12.0).rollout(
    Scenario(npcs=((PositionInstruction(8, 20.0),), (CUT_IN,)), ego_speed=20.0), constant_speed
)


def test_start_and_steps_are_rows_with_their_times():
    start, first, never = (row for row in view_of(TRACE).instructions if row.npc == 1)
    begun = round(TRACE.begun[1][0] / TRACE.physics_hz, 3)
    assert [(row.gene, row.start, row.end) for row in (start, first)] == [(0, 0.0, begun), (1, begun, TRACE.duration)]
    assert [(row.lane, row.speed, row.started) for row in (start, first, never)] == [
        ("keep", 15.0, True), ("right", 5.0, True), ("keep", 5.0, False),
    ]  # fmt: skip


def test_rows_say_in_words_what_was_not_as_asked():
    start, first, never = (row.words for row in view_of(TRACE).instructions if row.npc == 1)
    assert start == "30 m ahead, 1 lane right"
    assert first.endswith("at 12 m/s^2; acceleration asked 12 m/s^2, was 8.0 m/s^2")
    assert never == "at a gap of 400 m behind hold; step 1 did not come up"
