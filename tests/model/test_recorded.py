"""Recorded tracks as values: which are valid, where a vehicle is between their lines, and what changes of them do."""

import json
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Recorded, Scenario, ScenarioError, Step, Track
from pytest_pafot.model.instructions import Instruction, instruction_of
from pytest_pafot.strategies import tracks
from tests.helpers.tables import table

BRAKING = Track("30 4 0 20\n32 4 0 18\n33.7 4 0.01 16.5")


def test_text_is_canonical():
    assert Track("\n 30.00 4.0  0 20.000\n 32 -0.001 0 18.004 \n").text == "30 4 0 20\n32 0 0 18"
    assert Track.of(BRAKING.states) == BRAKING
    assert repr(BRAKING) == "Track('30 4 0 20\\n32 4 0 18\\n33.7 4 0.01 16.5')"


def test_first_line_says_another_rate():
    track = Track("rate 15\n" + BRAKING.text)
    assert (track.rate, track.seconds, BRAKING.rate) == (15, pytest.approx(2 / 15), 10)
    assert track == Track.of(BRAKING.states, 15) != BRAKING
    assert track.at(np.array([1 / 15]))[0].tolist() == pytest.approx([32.0, 4.0, 0.0, 18.0])
    with pytest.raises(ScenarioError, match="received 'rate 16' in line 1"):
        Track("rate 16\n" + BRAKING.text)


@given(tracks())
def test_track_is_what_its_text_says(track):
    again = pickle.loads(pickle.dumps(Track(track.text)))
    assert again == track
    assert again.states.tolist() == track.states.tolist() == Track.of(track.states).states.tolist()


@table(
    "text, message",
    [
        ("", r"track: expected a text of 2 to 401 lines, received '', 1; a track has 10 lines for each second"),
        ("30 4 0 20", r"of 2 to 401 lines, received '30 4 0 20', 1"),
        ("30 4 0 20\n" * 402, r"of 2 to 401 lines, received .* 402"),
        (None, r"of 2 to 401 lines, received None"),
        ("30 4 0 20\n30 4 0", r"expected x, y, heading and speed, within 5000, 5000, 1, 1000, .* '30 4 0' in line 2"),
        ("30 4 0 20\n30 4 nan 20", r"received '30 4 nan 20' in line 2"),
        ("30 4 2 20\n30 4 0 20", r"received '30 4 2 20' in line 1"),
        ("30 4 0 fast\n30 4 0 20", r"received '30 4 0 fast' in line 1"),
    ],
)  # fmt: skip
def test_text_that_is_no_track_is_refused(text, message):
    with pytest.raises(ScenarioError, match=message):
        Track(text)


def test_vehicle_drives_on_straight_lines_between_lines_and_outside():
    x, y, heading, speed = BRAKING.at([0.05, 0.15, 0.3, -1.0]).T
    assert x == pytest.approx([31.0, 32.85, 33.7 + 1.65, 10.0], abs=1e-3)
    assert y == pytest.approx([4.0, 4.0, 4.0 + 0.0165, 4.0], abs=1e-4)
    assert heading == pytest.approx([0.0, 0.005, 0.01, 0.0])
    assert speed == pytest.approx([19.0, 17.25, 16.5, 20.0])


def test_changes_move_the_track_in_time_and_place():
    assert Recorded(track=BRAKING, later=0.1).at(np.array([0.2]))[0, 0] == pytest.approx(32.0)
    assert Recorded(track=BRAKING, shift=-5.0).at(np.array([0.1]))[0, 0] == pytest.approx(27.0)
    faster = Recorded(track=BRAKING, pace=1.2)
    assert faster.at(np.array([0.1 / 1.2]))[0].tolist() == pytest.approx([32.0, 4.0, 0.0, 1.2 * 18])
    assert faster.end == pytest.approx(0.2 / 1.2)
    assert [each.is_as_recorded for each in (Recorded(track=BRAKING), faster)] == [True, False]


def test_words_say_what_differs_from_the_recording():
    assert Recorded(track=BRAKING).goal == "as recorded, from 30 m ahead, 1 lane right"
    changed = Recorded(track=BRAKING, later=-0.5, pace=0.9, shift=3.0, steps=(Step(after=1.0, lane="left"),))
    assert changed.place.endswith("lane right; but 0.5 s earlier, 10 % slower, 3 m farther ahead")
    assert changed.goal.endswith("; 1 s later left at 1.5 m/s")


@table(
    "changes, message",
    [
        ({"track": BRAKING.text}, r"track: expected a Track, received '30 4"),
        ({"pace": 1.3}, r"pace: expected a factor from 0.8 to 1.2 in steps of 0.01, received 1.3"),
        ({"pace": 1.001}, r"pace: expected a factor"),
        ({"later": 6.0}, r"later: expected a number from -5 to 5 in steps of 0.1"),
        ({"shift": -31.0}, r"shift: expected a number from -30 to 30 in steps of 0.1"),
        ({"steps": (3,)}, r"steps: expected at most 16 of pafot.Step"),
    ],
)
def test_change_that_is_too_large_is_refused(changes, message):
    with pytest.raises(ScenarioError, match=message):
        Recorded(**({"track": BRAKING} | changes))


@given(st.from_type(Recorded), st.none() | tracks())
def test_canonical_text_and_id_have_all_of_it(recorded, ego_track):
    assert isinstance(recorded, Instruction)
    assert instruction_of(json.loads(json.dumps(recorded.plain()))) == recorded
    scenario = Scenario(npcs=[[recorded]], ego_track=ego_track)
    assert Scenario.from_canonical(json.loads(scenario.canonical())) == pickle.loads(pickle.dumps(scenario)) == scenario
    assert (
        scenario.id != Scenario(npcs=[[Recorded(track=BRAKING)]], ego_track=ego_track).id or recorded.track == BRAKING
    )
    assert recorded.with_speed(recorded.speed) is recorded


def test_ego_track_is_checked_and_part_of_the_id():
    with pytest.raises(ScenarioError, match="ego_track: expected a Track, received '30"):
        Scenario(npcs=[[Recorded(track=BRAKING)]], ego_track=BRAKING.text)
    assert (
        Scenario(npcs=[[Recorded(track=BRAKING)]]).id
        != Scenario(npcs=[[Recorded(track=BRAKING)]], ego_track=BRAKING).id
    )


def test_start_speed_is_that_of_the_first_line():
    assert (Recorded(track=BRAKING).speed, Recorded(track=BRAKING, pace=1.1).speed) == (20.0, 22.0)
    assert Recorded(track=BRAKING).with_speed(22.0) == Recorded(track=BRAKING, pace=1.1)
    assert np.array_equal(Recorded(track=BRAKING).with_speed(50.0).pace, 1.2)
