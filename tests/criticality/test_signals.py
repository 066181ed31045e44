"""Signals against independent oracles: motions whose formulas are known, and loops over ticks and NPCs."""

import math
import pickle
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Highway, Run, criticality
from pytest_pafot.criticality.signals import MEASURES, EgoSignals, NpcSignals
from pytest_pafot.model.trace import LANE, SPEED, Outcome, X
from tests.helpers.traces import LENGTH, random_states, scenario_of, trace_of, vehicle


def run_of(*vehicles, **fields):
    return Run(trace_of(*vehicles, **fields))


def random_run(seed, *, rows=12, vehicles=4):
    states = random_states(np.random.default_rng(seed), rows, vehicles)
    return run_of(*states.transpose(1, 0, 2))


class TestVehicles:
    def test_every_vehicle_measure_is_an_annotated_attribute(self):
        names = {measure.name for measure in MEASURES}
        of_the_ego, of_npcs = EgoSignals.__annotations__, NpcSignals.__annotations__
        assert names == {
            "headway",
            *(f"ego.{name}" for name in of_the_ego),
            *(f"npcs.{name}" for name in of_npcs),
        }

    def test_they_are_what_the_trace_has(self):
        run = random_run(1)
        assert run.ego.speed.tolist() == run.trace.ego[:, SPEED].tolist()
        assert run.npcs[2].lane.tolist() == run.trace.npcs[:, 2, LANE].tolist()
        assert run.npcs[1].gap.tolist() == criticality.gap(run.trace)[:, 1].tolist()
        assert run.npcs[1].ttc.tolist() == criticality.ttc(run.trace)[:, 1].tolist()
        assert len(run.npcs) == 3
        with pytest.raises(AttributeError):
            run.ego.sped  # noqa: B018


class TestJerkAndLateralAcceleration:
    def test_jerk_is_third_derivative_of_the_position(self):
        t = np.arange(31) / 15
        run = run_of(vehicle(t**3 / 6 * 2.5, speed=t**2 / 2 * 2.5, acceleration=t * 2.5))
        np.testing.assert_allclose(run.ego.jerk[1:], 2.5)

    def test_the_jerk_of_the_first_tick_is_zero(self):
        run = run_of(vehicle(np.zeros(3), acceleration=np.array([-4.0, -4.0, -1.0])))
        assert run.ego.jerk.tolist() == [0, 0, 45]

    def test_lateral_acceleration_in_circle_follows_speed_and_radius(self):
        speed, radius = 12.0, 40.0
        angle = np.arange(90) / 15 * speed / radius + 2.0
        wrapped = (angle + math.pi) % (2 * math.pi) - math.pi
        for side in (1, -1):
            run = run_of(vehicle(np.zeros(90), heading=side * wrapped, speed=speed))
            pull = run.ego.lateral_acceleration
            np.testing.assert_allclose(pull[1:], side * speed**2 / radius)
            assert pull[0] == 0

    def test_acceleration_matches_change_of_speed_in_kernel(self, braking_run):
        changes = np.diff(braking_run.ego.speed) * 15
        np.testing.assert_allclose(braking_run.ego.acceleration[1:], changes, atol=1e-9)
        np.testing.assert_allclose(braking_run.ego.jerk[2:], np.diff(changes) * 15, atol=1e-7)
        assert braking_run.ego.acceleration.min() < -3


@pytest.fixture(scope="module")
def braking_run():
    def brakes_after_a_second(seen):
        return (2.0, 0.0) if seen.time < 1 else (-4.0, 0.01)

    return Run(Highway(duration=4.0).rollout(scenario_of(1), lambda: brakes_after_a_second))


def nearest_ahead(run, tick):
    """Return the leader and the distance to its rear, by a loop over the NPCs."""
    ego = run.trace.ego[tick]
    best, leader = math.inf, -1
    for index, npc in enumerate(run.trace.npcs[tick]):
        way = npc[X] - ego[X]
        if npc[LANE] == ego[LANE] >= 0 and 0 <= way < best:
            best, leader = way, index
    return leader, best


class TestHeadway:
    @given(st.integers(0, 2**32 - 1))
    def test_leader_is_nearest_npc_ahead_in_ego_lane(self, seed):
        run = random_run(seed, rows=6)
        assert run.leader.tolist() == [nearest_ahead(run, tick)[0] for tick in range(6)]

    def test_headway_is_time_to_rear_of_the_leader_of_a_moving_ego(self):
        run = run_of(vehicle([0.0, 0.0], speed=10.0), vehicle([60.0, 20.0]), vehicle([40.0, 90.0]))
        assert run.leader.tolist() == [1, 0]
        assert run.headway.tolist() == [(40 - LENGTH) / 10, (20 - LENGTH) / 10]
        ego = vehicle([0.0, 0.0, 0.0], [0.0, 4.0, 0.0], speed=np.array([10.0, 10.0, 0.0]))
        run = run_of(ego, vehicle([-20.0, 20.0, 20.0]))
        assert run.leader.tolist() == [-1, -1, 0]
        assert run.headway.tolist() == [math.inf] * 3
        run = run_of(vehicle([0.0, 0.0], speed=10.0), vehicle([np.nan, 30.0], lane=0))
        assert np.isnan(run.headway).tolist() == [True, False]


class TestLaneChanges:
    def test_lane_change_has_time_lanes_and_gaps(self):
        ego = vehicle(np.zeros(31), np.repeat([4.0, 8.0], [15, 16]))
        ahead, behind = vehicle(17.0, 8.0), vehicle(-30.0, 8.0)
        run = run_of(ego, ahead, behind, vehicle(9.0, 4.0), vehicle(60.0, 8.0))
        (change,) = run.lane_changes
        assert (change.tick, change.time, change.from_lane, change.to_lane) == (15, 1.0, 1, 2)
        assert (change.gap_ahead, change.gap_behind) == (17 - LENGTH, 30 - LENGTH)

    def test_lane_change_gaps_are_infinite_without_other_vehicles(self):
        ego = vehicle(np.zeros(3), np.array([4.0, 0.0, 4.0]))
        first, second = run_of(ego, vehicle(-1.0, 4.0)).lane_changes
        assert (first.gap_ahead, first.gap_behind) == (math.inf, math.inf)
        assert (second.gap_ahead, second.gap_behind) == (math.inf, 0)
        returning = vehicle(np.zeros(4), 0.0, lane=np.array([0.0, -1.0, -1.0, 0.0]))
        assert run_of(returning, vehicle(50.0)).lane_changes == (), "it left the road"


def far(trace):
    return trace.npcs[:, :, X].T


def of_other_length(trace):
    return trace.times[1:]


WRONG_SIGNALS = {"no index": far, "another shape": of_other_length}


class TestOwnSignals:
    def test_custom_function_is_a_read_only_signal_of_the_run_that_is_computed_once(self):
        run, asked = run_of(vehicle([0.0, 3.0]), vehicle(30.0)), []

        def room(trace):
            asked.append(trace)
            return 10.0 - trace.ego[:, X]

        for found in (run.signal(room), run.signal(room)):
            assert found.tolist() == [10.0, 7.0]
            assert type(found) is np.ndarray
            assert not found.flags.writeable
        assert len(asked) == 1

    def test_custom_function_for_each_npc_needs_npc_index(self):
        run = run_of(vehicle([0.0, 3.0]), vehicle(30.0), vehicle(50.0))
        assert run.signal(far, npc=1).tolist() == [50.0, 50.0]
        for function in WRONG_SIGNALS.values():
            with pytest.raises(ValueError, match=f"^signal '{function.__name__}':"):
                run.signal(function)


class TestFrame:
    def test_frame_has_row_per_tick_and_all_signals(self):
        pytest.importorskip("pandas")
        run = random_run(7)
        frame = run.to_pandas()
        assert frame.index.tolist() == run.trace.times.tolist()
        assert frame["ego.speed"].tolist() == run.ego.speed.tolist()
        assert frame["npcs[2].gap"].tolist() == run.npcs[2].gap.tolist()
        assert frame["leader"].tolist() == run.leader.tolist()
        assert len(frame.columns) == 6 + 3 * 7 + 1

    def test_without_pandas_there_is_none(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "pandas", None)
        with pytest.raises(ModuleNotFoundError):
            random_run(8).to_pandas()


def test_every_measure_gives_one_number_for_each_tick():
    run = run_of(vehicle([0.0, 3.0], speed=20.0), vehicle([9.0, 7.0]), outcome=Outcome.COLLISION)
    for measure in MEASURES:
        assert measure.function(run.trace).shape[-1] == 2, measure.name
        again = pickle.loads(pickle.dumps(measure)).function(run.trace)
        assert again.tolist() == measure.function(run.trace).tolist()
