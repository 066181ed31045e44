"""Scenarios with recorded NPCs are saved as readable blocks, and read as strictly as others."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Highway, Run, Traffic, VehicleType
from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.signature import Failure
from pytest_pafot.model.instructions import Recorded, Step, Track
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.strategies import free_npcs, manoeuvres, tracks
from pytest_pafot.support.errors import CorpusError
from tests.findings.builders import plain_finding
from tests.helpers.mutations import misread
from tests.helpers.tables import table

PATH = Path("front-2-1f3a9c.pafot.yaml")
TRACK = Track("30 4 0 20\n32 4 0.01 18.25")
CHANGED = Recorded(track=TRACK, later=-0.5, pace=1.05, steps=(Step(after=1.5, lane="left"),))
TEXT = text_of(plain_finding(scenario=Scenario(npcs=[[Recorded(track=TRACK)], [CHANGED]], ego_track=TRACK)))


def test_track_is_a_block():
    assert (
        TEXT[TEXT.index("  ego_track:") : TEXT.index("expect:")]
        == """\
  ego_track: |-
    30 4 0 20
    32 4 0.01 18.25
  npcs:
    - - track: |-
          30 4 0 20
          32 4 0.01 18.25
    - - later: -0.5
        pace: 1.05
        steps: [{after: 1.5, lane: left}]
        track: |-
          30 4 0 20
          32 4 0.01 18.25
"""
    )


@given(
    st.from_type(Recorded),
    manoeuvres() | free_npcs(),
    st.none() | tracks(),
    st.sampled_from(["paper", "everyday"]),
    st.sampled_from([(), ("truck",), ("car", "van"), (VehicleType.recorded(16.5, 2.55, fastest=26.4),)]),
)
def test_what_is_written_is_read(one, other, ego_track, style, vehicles):
    npcs = ((one,), (other,))
    found = Scenario(npcs=npcs, ego_track=ego_track, traffic=Traffic(style), vehicles=vehicles)
    assert Scenario.from_canonical(json.loads(found.canonical())) == found
    finding = plain_finding(scenario=found, original=Scenario(npcs=((one,),)))
    assert parsed(PATH, text_of(finding).encode()) == finding


def test_independent_reader_agrees():
    text = TEXT.replace("pace: 1.05", "pace: 0.9")
    assert misread(text, parsed(PATH, text.encode())) == []


def test_longest_tracks_fit_a_file_twice():
    rows = [[1000 + 3.33 * row, 4.01, 0.0123, 33.33] for row in range(401)]
    most = Scenario(npcs=[[Recorded(track=Track.of(rows))]] * 8, ego_track=Track.of(rows))
    assert len(text_of(plain_finding(scenario=most, original=most))) < 256 * 1024


def test_expectation_says_where_the_recording_was_left():
    behind = Recorded(track=Track.of([[-12.0 + 2.5 * row, 0.0, 0.0, 25.0] for row in range(121)]))
    ego = Track.of([[2.5 * row, 0.0, 0.0, 25.0] for row in range(121)])
    told = Scenario(npcs=[[behind]], ego_track=ego, ego_speed=25.0)
    run = Run(Highway(speed_limit=36.3).rollout(told, lambda: lambda seen: (-6.0, 0.0)))
    expect = Expect.of(run, Failure(kind="AssertionError"))
    assert (run.outcome, expect.departure.npc, expect.departure.recorded_gap) == ("collision", 0, -7.0)
    finding = plain_finding(scenario=told, expect=expect)
    when = f"departure: {{npc: 0, time: {expect.departure.time!r}, gap: {expect.departure.gap!r}, recorded_gap: -7.0}}"
    assert when in text_of(finding)
    assert parsed(PATH, text_of(finding).encode()) == finding
    after = run.collision.time - expect.departure.time
    assert f"fails {after:.1f} s after NPC 0 left the recording, with a gap of 6 m instead of 7 m" in run.explain()


@table(
    ("old", "new", "field", "expected"),
    [
        ("pace: 1.05", "pace: 1.5", "scenario.npcs[1][0].pace", "a factor from 0.8 to 1.2"),
        ("later: -0.5", "later: -0.55", "scenario.npcs[1][0].later", "a number from -5 to 5"),
        ("        pace: 1.05", "        speed: 20.0", "scenario.npcs[1][0].speed", "one of track, later, pace, shift"),
        ("  ego_track: |-\n    30 4 0 20", "  ego_track: |-\n    30 4 0", "scenario.ego_track", "x, y, heading and"),
        (
            "    - - track: |-\n          30",
            "    - - track: |-\n          x",
            "scenario.npcs[0][0].track",
            "x, y, head",
        ),
    ],
)
def test_each_broken_rule_is_reported_at_its_field(old, new, field, expected):
    assert TEXT.count(old) == 1
    with pytest.raises(CorpusError) as caught:
        parsed(PATH, TEXT.replace(old, new).encode())
    assert caught.value.field == field
    assert caught.value.expected.startswith(expected)
