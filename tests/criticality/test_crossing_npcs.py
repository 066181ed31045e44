"""Measures of an NPC that crosses the ego's way, or merges: normal in the plane, undefined along the way.

Each public measure is in one of the lists below, so that the author of a new one must decide.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import Cell, Run, criticality
from pytest_pafot.criticality import Encounters, RoadFrame, RssRules, passages, time_advantage
from pytest_pafot.criticality.measures import safety_shortfall
from pytest_pafot.criticality.signals import MEASURES, Signals, ego_lane_changes, leader
from pytest_pafot.model.trace import LANE, SPEED, Y
from tests.helpers.crossing_traces import CROSSES, HZ, MERGES, ZONES, junction_trace
from tests.helpers.tables import table
from tests.helpers.traces import trace_of

IN_THE_PLANE = ("centre_distance", "ettc", "gap", "ttc")
EXTREMES_IN_THE_PLANE = ("mettc", "min_centre_distance", "min_gap", "min_ttc")
ALONG_THE_WAY = {
    "gap_across": lambda trace: RoadFrame(trace).gap_across,
    "longitudinal_gap": criticality.longitudinal_gap,
    "safe_across": lambda trace: RoadFrame(trace).safe_across(RssRules()),
    "safe_along": lambda trace: RoadFrame(trace).safe_along(RssRules()),
    "safety_distance": criticality.safety_distance,
}
IN_ONE_LANE = {
    "ego_follows": lambda trace: Encounters(trace).ego_follows.T,
    "safety_shortfall": safety_shortfall,
}
"""Measures that are False or 0 for a vehicle outside the ego's lane."""
OTHERS = {
    "Encounters", "Passage", "RoadFrame", "RssRules", "hardest_brake",
    "max_safety_shortfall", "min_safety_distance", "passages", "planned_duration",
    "time_advantage",
}  # fmt: skip

MERGED = 62
"""The tick at which the second NPC reaches the ego's way."""


def mixed(**more):
    """Return an NPC that crosses the whole time, one that merges 22 m ahead of the ego, and one on the grid."""
    return junction_trace((CROSSES, 0.0), (MERGES, 0.0), (None, 20.0), **more)


def off_way(trace):
    return np.isnan(trace.track[:, 1:, 0])


def test_every_public_measure_is_in_one_list():
    of_classes = {"gap_across", "safe_across", "safe_along", *IN_ONE_LANE}
    listed = {*IN_THE_PLANE, *EXTREMES_IN_THE_PLANE, *ALONG_THE_WAY} - of_classes
    assert listed | OTHERS == set(criticality.__all__)
    assert not listed & OTHERS


@table("name", [*IN_THE_PLANE, *EXTREMES_IN_THE_PLANE])
def test_measures_in_the_plane_need_only_the_states(name):
    trace, measure = mixed(), getattr(criticality, name)
    alone = replace(trace, track=None, zones=(), on_way=None)
    assert np.isfinite(trace.states).all()
    np.testing.assert_array_equal(measure(trace), measure(alone))
    assert not np.isnan(measure(trace)).any()


@table("name", ALONG_THE_WAY)
def test_measures_along_way_are_nan_off_the_way(name):
    trace = mixed()
    assert off_way(trace)[:, 0].all()
    assert off_way(trace)[:, 1].sum() == MERGED
    np.testing.assert_array_equal(np.isnan(ALONG_THE_WAY[name](trace)), off_way(trace))


@table("name", IN_ONE_LANE)
def test_npc_off_the_way_is_in_no_lane(name):
    trace = mixed()
    states = trace.states.copy()
    states[:, :, LANE] = 0
    values = IN_ONE_LANE[name](replace(trace, states=states))
    assert not values[off_way(trace)].any()
    assert name != "ego_follows" or values[MERGED:, 1].all()


@table("name", [*ALONG_THE_WAY, *IN_ONE_LANE])
def test_merged_npc_is_measured_like_any_other(name):
    trace, measure = mixed(), (ALONG_THE_WAY | IN_ONE_LANE)[name]
    rows = {each: getattr(trace, each)[MERGED:] for each in ("states", "track")}
    after = replace(trace, **rows, on_way=None, zones=(), arrivals=())
    np.testing.assert_array_equal(measure(trace)[MERGED:, 1:], measure(after)[:, 1:])


def test_extremes_skip_npcs_off_the_way():
    trace = mixed(ego_speed=12.0)
    distance = criticality.safety_distance(trace)
    assert criticality.min_safety_distance(trace) == distance[~off_way(trace)].min()
    crossing = junction_trace((CROSSES, 0.0))
    assert criticality.min_safety_distance(crossing) == math.inf
    assert criticality.max_safety_shortfall(crossing) == 0.0


def test_missing_number_is_still_nan_at_a_junction():
    trace = mixed()
    states, track = trace.states.copy(), trace.track.copy()
    states[70, 1, :LANE] = np.nan
    track[70, 1] = np.nan
    broken = replace(trace, states=states, track=track)
    assert math.isnan(criticality.min_safety_distance(broken))
    assert math.isnan(criticality.min_gap(broken))


def test_road_frame_is_nan_off_the_way():
    trace = mixed()
    frame, off = RoadFrame(trace), off_way(trace).T
    np.testing.assert_array_equal(frame.is_on_way, ~off)
    for values in (frame.ahead, frame.right):
        np.testing.assert_array_equal(np.isnan(values), off)
    for name in ("cos", "sin", "speed", "drift", "half_along", "half_across"):
        values = getattr(frame, name)
        np.testing.assert_array_equal(np.isnan(values[1:]), off)
        assert not np.isnan(values[0]).any()


def test_first_drift_on_way_follows_the_heading_and_behind_it_there_is_none():
    trace = mixed()
    frame, track = RoadFrame(trace), trace.track.copy()
    angle = track[MERGED, 2, 2]
    assert frame.drift[2, MERGED] == pytest.approx(10.0 * math.sin(angle))
    moved = (trace.states[MERGED + 1, 2, Y] - trace.states[MERGED, 2, Y]) * HZ
    assert frame.drift[2, MERGED + 1] == pytest.approx(moved, abs=0.05)
    track[80:, 2] = np.nan
    drift = RoadFrame(replace(trace, track=track)).drift[2]
    np.testing.assert_array_equal(np.isnan(drift), np.isnan(track[:, 2, 0]))


def test_npc_off_the_way_is_in_no_cell():
    trace = mixed()
    road, end, length = trace.road, trace.ticks, trace.sizes[0, 0]
    assert {road.cell(0, tick, length) for tick in range(end + 1)} == {None}
    assert road.last_cell(0, end, length) is None
    assert road.cell(1, MERGED - 1, length) is None
    assert road.cell(1, MERGED, length) == road.last_cell(1, end, length) == Cell.FRONT
    into_ego = junction_trace((MERGES, 0.0), ego_speed=16.0, seconds=4.6)
    road, end, length = into_ego.road, into_ego.ticks, into_ego.sizes[0, 0]
    assert abs(road.ahead[0, -1]) < 2.5
    assert road.cell(0, end, length) is road.last_cell(0, end, length) is None


def test_leader_is_always_on_the_ego_way():
    trace = junction_trace((CROSSES, 10.0), (MERGES, -20.0), (None, 60.0))
    states = trace.states.copy()
    states[:, :, LANE] = 0
    ahead = leader(replace(trace, states=states))
    first = int(np.flatnonzero(~off_way(trace)[:, 1])[0])
    assert set(ahead[:first]) == {2}
    assert set(ahead[first:]) == {1}


def test_a_lane_change_knows_nothing_of_who_crosses():
    trace = mixed()
    states = trace.states.copy()
    states[30:, :2, LANE] = 1  # the ego changes into lane 1, which the first NPC crosses
    (change,) = ego_lane_changes(replace(trace, states=states))
    assert (change.gap_ahead, change.gap_behind) == (math.inf, math.inf)


# At the zone.


def test_passage_has_entry_and_exit_times_in_zone():
    """The ego is in the zone from 4.55 to 5.45 s, and the first NPC, 10 m later, from 6.55 to 7.45 s."""
    first, second, third = passages(junction_trace((CROSSES, -10.0), (MERGES, -60.0), (None, 20.0)))
    assert (first.npc, first.zone) == (0, ZONES[CROSSES])
    times = (first.ego_enters, first.ego_leaves, first.npc_enters, first.npc_leaves)
    assert times == tuple(math.ceil(seconds * HZ) / HZ for seconds in (4.55, 5.45, 6.55, 7.45))
    assert first.post_encroachment_time == pytest.approx(6.55 - 5.45, abs=1 / HZ)
    assert (second.ego_enters, second.npc_enters) == (6.0, math.inf)
    assert second.post_encroachment_time == math.inf
    assert third is None


@table(("start", "expected"), [
    (-10.0, 6.55 - 5.45),  # after the ego
    (30.0, 4.55 - 3.45),  # before it
    (15.0, 4.55 - 4.95 + 0.4),  # it is still there when the ego comes
])  # fmt: skip
def test_post_encroachment_time_spans_exit_to_next_entry(start, expected):
    (passage,) = passages(junction_trace((CROSSES, start)))
    assert passage.post_encroachment_time == pytest.approx(expected, abs=1 / HZ)


def test_time_advantage_of_steady_vehicles_equals_post_encroachment():
    trace = junction_trace((CROSSES, -10.0), (MERGES, 0.0))
    advantage = time_advantage(trace)
    assert advantage.shape == (trace.ticks + 1, 2)
    assert advantage[:, 0] == pytest.approx(1.1, abs=1 / HZ)
    assert advantage[0, 0] == pytest.approx(1.1, abs=1e-9)
    assert advantage[-1, 0] == pytest.approx(passages(trace)[0].post_encroachment_time, abs=1e-9)


def test_vehicle_standing_before_or_in_zone_stays_there():
    trace = junction_trace((CROSSES, 0.0))
    states, on_way = trace.states.copy(), trace.on_way.copy()
    states[15:, 1, SPEED], on_way[15:] = 0.0, on_way[15]
    assert set(time_advantage(replace(trace, states=states, on_way=on_way))[15:, 0]) == {math.inf}
    on_way[15:] = 60.0
    assert set(time_advantage(replace(trace, states=states, on_way=on_way))[15:, 0]) == {0.0}


def test_on_the_grid_nobody_has_a_zone():
    trace = mixed()
    assert passages(trace)[2] is None
    assert set(time_advantage(trace)[:, 2]) == {math.inf}
    alone = trace_of(trace.states[:, 0], trace.states[:, 3])
    assert passages(alone) == (None,)
    assert set(time_advantage(alone)[:, 0]) == {math.inf}


def test_missing_place_makes_times_at_zone_nan():
    trace = junction_trace((CROSSES, 0.0))
    on_way = trace.on_way.copy()
    on_way[20] = np.nan
    broken = replace(trace, on_way=on_way)
    (passage,) = passages(broken)
    assert math.isnan(passage.post_encroachment_time)
    assert math.isnan(time_advantage(broken)[20, 0])


@table("missing", ["on_way", "track"])
def test_zones_without_places_have_no_passages(missing):
    trace = replace(mixed(), **{missing: None})
    assert passages(trace) == (None, None, None)
    assert np.isnan(time_advantage(trace)[:, :2]).all()
    assert Signals(trace).npcs[0].zone == ZONES[CROSSES]
    assert Run(trace).explain()


# As signals.


def test_signals_of_crossing_npc_are_numbers_except_position():
    first, second, third = Signals(mixed()).npcs
    of_npcs = [each.name for each in MEASURES if each.name.startswith("npcs.")]
    names = [name.removeprefix("npcs.") for name in of_npcs]
    missing = [name for name in names if np.isnan(getattr(first, name)).any()]
    assert missing == ["ahead", "right"]
    assert np.isnan(second.ahead).sum() == np.isnan(second.right).sum() == MERGED
    assert not np.isnan(third.ahead).any()
    assert (first.zone, third.zone, third.passage) == (ZONES[CROSSES], None, None)
    assert first.passage.zone is first.zone
    assert {"zone", "passage", "ttc", "time_advantage"} <= set(dir(first))


def test_only_npcs_with_zone_have_time_advantage_column():
    trace = mixed()
    named = [name for name, _ in Signals(trace).all() if "time_advantage" in name]
    assert named == ["npcs[0].time_advantage", "npcs[1].time_advantage"]
    straight = trace_of(trace.states[:, 0], trace.states[:, 3])
    assert not [name for name, _ in Signals(straight).all() if "time_advantage" in name]
