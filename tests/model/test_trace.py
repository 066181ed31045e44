"""The record of a run: shapes, read-only arrays, and values derived from them."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import Trace
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, STEERING, Outcome, X, Y
from tests.helpers.tables import table
from tests.helpers.traces import scenario_of, straight_lanes, trace_of, vehicle


def made(states, sizes, **fields):
    scenario = scenario_of(1)
    fields |= {"lanes": straight_lanes(), "physics_hz": 15, "ads_hz": 5}
    given = {"outcome": Outcome.COMPLETED, "states": states, "sizes": sizes, **fields}
    return Trace(scenario=scenario, executed=scenario, **given)


def test_columns_follow_the_order_of_the_array_and_outcomes_have_the_names_of_files():
    assert [X, Y, HEADING, SPEED, ACCELERATION, STEERING, LANE] == [0, 1, 2, 3, 4, 5, 6]
    names = "safe off_road left_route end_of_road collision invalid ads_error hang"
    assert [str(outcome) for outcome in Outcome] == names.split()


def test_arrays_are_copies_in_float64_and_read_only():
    states, sizes = np.zeros((3, 2, 7), dtype=np.float32), np.full((2, 2), 5.0)
    trace = made(states, sizes)
    states[:], sizes[:] = 9.0, 9.0
    assert (trace.states.max(), trace.sizes.max()) == (0.0, 5.0)
    for array in (trace.states, trace.sizes, trace.ego, trace.npcs):
        assert array.dtype == np.float64
        assert not array.flags.writeable


@table("copied", [lambda trace: pickle.loads(pickle.dumps(trace)), copy.deepcopy, copy.copy])
def test_copied_or_pickled_trace_is_read_only(copied):
    trace = trace_of(vehicle(0.0, speed=10.0, ticks=4), vehicle(30.0, ticks=4))
    twin = copied(trace)
    assert twin.states.tobytes() == trace.states.tobytes()
    assert not twin.states.flags.writeable
    assert not twin.sizes.flags.writeable
    assert (twin.scenario, twin.outcome, twin.lanes) == (trace.scenario, trace.outcome, trace.lanes)


SHAPES = [(3, 2), (3, 2, 6), (3, 14), (1, 3, 2, 7)]


@table(
    ("states", "sizes", "name"),
    [*((shape, (2, 2), "states") for shape in SHAPES), ((3, 2, 7), (3, 2), "sizes")],
)
def test_arrays_of_wrong_shapes_are_refused(states, sizes, name):
    with pytest.raises(ValueError, match=f"^{name}:"):
        made(np.zeros(states), np.zeros(sizes))


def test_trace_has_one_row_more_than_its_ticks():
    trace = trace_of(vehicle(0.0, speed=10.0, ticks=30), vehicle(50.0, ticks=30))
    assert (trace.ticks, trace.dt, trace.duration) == (30, 1 / 15, 2.0)
    shapes = trace.states.shape, trace.ego.shape, trace.npcs.shape
    assert shapes == ((31, 2, 7), (31, 7), (31, 1, 7))
    assert trace.times.tolist() == [tick / 15 for tick in range(31)]
    rows = trace.rows_until(7)
    assert (len(rows["states"]), rows["track"], rows["on_way"]) == (8, None, None)
    at_once = trace_of(vehicle(0.0), vehicle(50.0))
    assert (at_once.ticks, at_once.duration) == (0, 0.0)


def test_speed_limit_is_that_of_fastest_lane():
    lanes = (*straight_lanes(2, speed_limit=20.0), *straight_lanes(1, speed_limit=30.0))
    assert trace_of(vehicle(0.0), vehicle(50.0), lanes=lanes).speed_limit == 30.0


def test_track_of_vehicle_is_recorded_on_curved_roads_and_follows_on_straight_ones():
    states, sizes = np.zeros((2, 2, 7)), np.full((2, 2), 5.0)
    bent = made(states, sizes, track=np.arange(2 * 2 * 5.0).reshape(2, 2, 5))
    assert bent.track_of(1).tolist() == [[5.0, 6.0, 7.0, 8.0, 9.0], [15.0, 16.0, 17.0, 18.0, 19.0]]
    one = vehicle(3.0, lane=1, y=4.5, heading=0.1, speed=10.0, ticks=2)
    trace = trace_of(one, vehicle(30.0, ticks=2))
    assert trace.track is None
    assert trace.track_of(0)[0].tolist() == [3.0, 4.5, 0.1, 0.5, 1.0]
    assert trace.track_of(1)[0].tolist() == [30.0, 0.0, 0.0, 0.0, 1.0]


def test_both_kinds_of_road_agree_on_a_straight_one():
    ego, npc = vehicle(0.0, speed=10.0, ticks=30), vehicle(30.0, lane=1, y=3.0, ticks=30)
    straight = trace_of(ego, npc, lanes=straight_lanes(2))
    recorded = replace(straight, track=straight.road.track)
    one, other = straight.road, recorded.road
    assert (one.is_straight, other.is_straight) == (True, False)
    for name in ("track", "angles", "is_on_way", "offsets"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    cos, sin = np.cos(one.column(HEADING)), np.sin(one.column(HEADING))
    for its, others in zip(one.turned(cos, sin), other.turned(cos, sin), strict=True):
        np.testing.assert_array_equal(np.broadcast_to(its, others.shape), others)
    for tick in (0, 30):
        assert one.offset(0, tick) == other.offset(0, tick)
        assert one.counted(tick, 1) == other.counted(tick, 1) == 1.0
    assert one.displacement(1, 0, 30) == other.displacement(1, 0, 30)
