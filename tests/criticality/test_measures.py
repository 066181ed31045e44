"""Every measure against an independent oracle by hand in SI units, and under symmetries."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pytest_pafot import criticality
from pytest_pafot.criticality import Encounters, RoadFrame, RssRules
from pytest_pafot.criticality.measures import safety_shortfall
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, X, Y
from tests.helpers.polygons import corners, distance_after, polygon_distance
from tests.helpers.tables import table
from tests.helpers.traces import random_states, straight_lanes, trace_of, vehicle


def ego_follows(trace):
    return Encounters(trace).ego_follows.T


def gap_across(trace):
    return RoadFrame(trace).gap_across


def safe_along(trace, rules=RssRules()):  # noqa: B008  (a frozen value)
    return RoadFrame(trace).safe_along(rules)


def safe_across(trace):
    return RoadFrame(trace).safe_across(RssRules())


ARRAYS = [
    criticality.ettc, criticality.ttc, criticality.centre_distance, criticality.gap, criticality.safety_distance,
    safety_shortfall, criticality.longitudinal_gap, gap_across, safe_along, safe_across,
]  # fmt: skip
ONE_SIDED = (criticality.ettc, safe_along, safe_across)
SYMMETRIC = [measure for measure in ARRAYS if measure not in ONE_SIDED]

seeds = st.integers(0, 2**32 - 1)
angles = st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi / 2, 0.3, -2.5, 1e-4]) | st.floats(
    -math.pi, math.pi
)
coordinates = st.floats(-20, 20)
speeds = st.sampled_from([0.0, 10.0]) | st.floats(-5, 30)


@st.composite
def movers(draw):
    """Return one vehicle at one tick; it may be parallel or standing."""
    return vehicle(
        draw(coordinates), draw(coordinates), heading=draw(angles), speed=draw(speeds), lane=1
    )


def of_one_npc(measure, ego, npc, **fields):
    """Return the value of a measure for one ego and one NPC at one tick."""
    return measure(trace_of(ego, npc, **fields))[0, 0]


def random_trace(seed, *, rows=12, vehicles=3, lanes=None):
    rng = np.random.default_rng(seed)
    return with_states(
        random_states(rng, rows, vehicles), rng.uniform([4, 1.6], [12, 2.6], (vehicles, 2)), lanes
    )


def with_states(states, sizes, lanes=None):
    return trace_of(*states.transpose(1, 0, 2), sizes=sizes, lanes=lanes)


def assert_same(actual, expected):
    """Assert equality up to rounding; infinite and astronomically large times are the same."""
    np.testing.assert_allclose(np.tanh(actual / 100), np.tanh(expected / 100), rtol=1e-6, atol=1e-9)


class TestDistances:
    @given(movers(), movers())
    def test_gap_is_the_distance_of_the_two_polygons(self, ego, npc):
        expected = polygon_distance(corners(ego[0]), corners(npc[0]))
        assert of_one_npc(criticality.gap, ego, npc) == pytest.approx(expected, abs=1e-6)

    def test_gap_uses_each_vehicles_own_size_and_centre_distance_is_euclidean(self):
        sizes = [(5, 2), (12, 2.5)]
        gap = of_one_npc(criticality.gap, vehicle(0), vehicle(20), sizes=sizes)
        assert gap == pytest.approx(20 - 2.5 - 6)
        ego, npc = vehicle(1, 2, heading=0.4), vehicle(4, 6)
        assert of_one_npc(criticality.centre_distance, ego, npc) == pytest.approx(5)


class TestTtc:
    @given(movers(), movers())
    def test_is_the_first_contact_when_time_is_stepped(self, ego, npc):
        ttc = of_one_npc(criticality.ttc, ego, npc)
        before = np.linspace(0, min(ttc, 20.0), 60, endpoint=False)
        assert all(distance_after(ego, npc, seconds) > 0 for seconds in before[before < ttc - 1e-6])
        if ttc < 1000:
            assert distance_after(ego, npc, ttc) == pytest.approx(0, abs=1e-6)

    def test_is_zero_at_overlap_even_when_parting(self):
        assert of_one_npc(criticality.ttc, vehicle(0, speed=10), vehicle(4, speed=30)) == 0


class TestEttc:
    @given(movers(), movers())
    # the time to the crossing point is infinite
    @example(vehicle(0, 1, speed=1e-308), vehicle(0, heading=1.0))
    @example(vehicle(0, 1, heading=0.5, speed=1e-308), vehicle(50))
    def test_is_the_solution_of_the_two_lines(self, ego, npc):
        one, other = (
            math.copysign(1, state[SPEED] + 0.0)
            * np.array([math.cos(state[HEADING]), math.sin(state[HEADING])])
            for state in (ego[0], npc[0])
        )
        matrix, expected = np.column_stack([one, -other]), math.inf
        if abs(np.linalg.det(matrix)) > 1e-9 and ego[0, SPEED] != 0:
            ways = np.linalg.solve(matrix, npc[0, :2] - ego[0, :2])
            # the crossing point is under a vehicle's centre: ahead or behind is a matter of rounding
            if abs(ways).min() < 1e-9:
                return
            expected = ways[0] / abs(ego[0, SPEED]) if (ways > 0).all() else math.inf
        assert_same(of_one_npc(criticality.ettc, ego, npc), expected)


class TestSafetyDistance:
    @table(("ego", "npc", "expected"), [
        (vehicle(0, speed=20, acceleration=1), vehicle(50, speed=15, acceleration=-2), 5 * 3 + 3 * 9 / 2),
        # the NPC follows
        (vehicle(0, speed=20, acceleration=-2), vehicle(-50, speed=26), 6 * 3 + 2 * 9 / 2),
        (vehicle(0, speed=20), vehicle(50, speed=25), -15),  # it pulls away
    ])  # fmt: skip
    def test_is_what_the_follower_gains_in_three_seconds(self, ego, npc, expected):
        assert of_one_npc(criticality.safety_distance, ego, npc) == pytest.approx(expected)

    def test_follower_is_decided_along_road_and_not_heading_and_follows_lane_of_the_ego(self):
        ego, npc = vehicle(0, 0, heading=0.3, speed=20), vehicle(1, -4, speed=20)
        assert ego_follows(trace_of(ego, npc))[0, 0]
        lanes, npc = (
            (*straight_lanes(1), *straight_lanes(1, heading=math.pi)),
            vehicle(10, speed=20),
        )
        for lane, follows in ((0, True), (1, False)):
            trace = trace_of(vehicle(0, lane=lane), npc, lanes=lanes)
            assert ego_follows(trace)[0, 0] == follows


class TestSafetyShortfall:
    @table(("npc", "expected"), [
        (vehicle(25, speed=10), 1 / 3),  # of the safety distance of 30 m, 20 m are there
        (vehicle(36, speed=10), 0),
        (vehicle(6, speed=25), 0),  # none is needed
        (vehicle(7, 4, speed=10), 0),  # in another lane
        (vehicle(4, speed=10), 1),  # at contact
    ])  # fmt: skip
    def test_is_the_missing_share_of_the_safety_distance(self, npc, expected):
        assert of_one_npc(safety_shortfall, vehicle(0, speed=20), npc) == pytest.approx(expected)

    def test_is_zero_off_the_road_and_beside_a_distance_of_nearly_zero(self):
        ego, npc = vehicle(0, speed=20, lane=-1), vehicle(7, speed=10, lane=-1)
        assert of_one_npc(safety_shortfall, ego, npc) == 0
        assert of_one_npc(safety_shortfall, vehicle(0, speed=1e-308), vehicle(36)) == 0


@table(("extreme", "vehicles", "expected"), [
    (criticality.min_gap, (vehicle([0, 0, 0]), vehicle([30, 20, 25]), vehicle([-40, -12, -40])), 7),
    (criticality.min_centre_distance, (vehicle([0, 0]), vehicle([30, 20]), vehicle([-11, -40])), 11),
    (criticality.min_ttc, (vehicle([0, 0], speed=20), vehicle([25, 15], speed=10), vehicle([-90, -80])), 1),
    (criticality.mettc, (vehicle([0, 0], speed=10), vehicle([9, 9], 4, speed=10),
                         vehicle([30, 25], -20, heading=math.pi / 2, speed=10)), 2.5),
    (criticality.min_safety_distance, (vehicle([0, 0], speed=20), vehicle([50, 50], speed=[15, 25])), -15),
    (criticality.max_safety_shortfall, (vehicle([0, 0], speed=20), vehicle([25, 35], speed=10), vehicle([90, 90])),
     1 / 3),
])  # fmt: skip
def test_extremes_are_those_of_all_ticks_and_npcs(extreme, vehicles, expected):
    assert extreme(trace_of(*vehicles)) == pytest.approx(expected)


def test_hardest_brake_is_the_largest_deceleration_of_the_ego_alone():
    ego = vehicle([0, 1, 2], speed=20, acceleration=[0, -3.5, 2])
    npc = vehicle([50, 51, 52], speed=20, acceleration=[0, -8, 0])
    assert criticality.hardest_brake(trace_of(ego, npc)) == 3.5
    never = trace_of(vehicle(0, acceleration=2), vehicle(50))
    assert criticality.hardest_brake(never) == 0, "it never brakes"


WRONG_RULES = [
    ("least_braking", 0),
    ("hardest_braking", 0),
    ("lateral_braking", 0),
    ("ego_response", -1),
]


def stopping_way(speed, response, acceleration, braking, *, step=1e-3):
    """Return the distance in which a vehicle accelerates for its response time and then stops, in small steps."""
    way, time = 0.0, 0.0
    while time < response - step / 2 or speed > 0:
        change = acceleration if time < response - step / 2 else -braking
        way += speed * step + change * step**2 / 2
        speed += change * step
        time += step
    return way


class TestRss:
    rules = RssRules(
        ego_response=0.5, npc_response=1.5, acceleration=3, least_braking=4, hardest_braking=9
    )

    @table(("follower", "leader"), [(20, 15), (26.8, 0), (5, 8), (0, 0), (5, 30)])
    def test_rss_longitudinal_distance_suffices_exactly_in_worst_case(self, follower, leader):
        expected = stopping_way(follower, 0.5, 3, 4) - stopping_way(leader, 0, 0, 9)
        trace = trace_of(vehicle(0, speed=follower), vehicle(99, speed=leader))
        assert safe_along(trace, self.rules)[0, 0] == pytest.approx(max(expected, 0), abs=0.05)

    def test_a_following_npc_has_its_own_response_time(self):
        trace = trace_of(vehicle(99, speed=15), vehicle(0, speed=20))
        expected = stopping_way(20, 1.5, 3, 4) - stopping_way(15, 0, 0, 9)
        assert safe_along(trace, self.rules)[0, 0] == pytest.approx(expected, abs=0.05)

    def test_oncoming_leader_needs_more_distance_than_standing_leader(self):
        standing, oncoming = (
            of_one_npc(safe_along, vehicle(0, speed=20), vehicle(80, heading=math.pi, speed=speed))
            for speed in (0, 10)
        )
        assert oncoming == pytest.approx(standing + 100 / 16)

    def test_rss_lateral_distance_matches_calculation_by_hand(self):
        # Ego: 0.2 / 2 + 0.2^2 / 1.6; NPC: 0.2 * 4 / 2 + 0.4^2 / 1.6; and the margin of 0.1, alone if the NPC leaves.
        for heading, expected in ((0.0, 0.125 + 0.5 + 0.1), (0.1, 0.1)):
            npc = vehicle(0, 4, heading=heading, speed=20)
            assert of_one_npc(safe_across, vehicle(0, speed=20), npc) == pytest.approx(expected)

    @table("side", [-1, 1])
    def test_rss_lateral_distance_suffices_exactly_in_worst_case(self, side):
        npc = vehicle(0, side * 4, heading=-side * 0.05, speed=20)  # towards the ego
        way = stopping_way(0, 1, 0.2, 0.8) + stopping_way(20 * math.sin(0.05), 2, 0.2, 0.8)
        found = of_one_npc(safe_across, vehicle(0, speed=20), npc)
        assert found == pytest.approx(0.1 + way, abs=0.01)

    def test_gaps_are_measured_along_and_across_the_road(self):
        ego, npc = vehicle(0), vehicle(20, 6, heading=math.pi / 2)
        assert of_one_npc(criticality.longitudinal_gap, ego, npc) == pytest.approx(20 - 2.5 - 1)
        assert of_one_npc(gap_across, ego, npc) == pytest.approx(6 - 1 - 2.5)
        # the projections overlap
        assert of_one_npc(criticality.longitudinal_gap, vehicle(0), vehicle(3, 4)) == 0
        assert of_one_npc(gap_across, vehicle(0), vehicle(30, 1)) == 0

    @table(("name", "value"), WRONG_RULES)
    def test_rules_refuse_brakes_that_never_stop_a_car_and_negative_times(self, name, value):
        with pytest.raises(ValueError, match=f"^{name}:"):
            RssRules(**{name: value})


def test_a_run_has_a_duration_and_a_planned_one():
    trace = trace_of(vehicle(0, ticks=45), vehicle(50, ticks=45))
    assert trace.duration == pytest.approx(3)
    assert criticality.planned_duration(trace_of(vehicle(0), vehicle(50))) == 60


def differing(measures, one, other):
    """Return the measures that differ between two traces; infinite and huge times are the same."""
    pairs = {
        measure.__name__: (np.tanh(measure(one) / 100), np.tanh(measure(other) / 100))
        for measure in measures
    }
    return [name for name, pair in pairs.items() if not np.allclose(*pair, rtol=1e-6, atol=1e-9)]


class TestEveryArray:
    @given(seed=seeds, angle=angles, x=coordinates, y=coordinates)
    def test_does_not_depend_on_where_the_road_lies(self, seed, angle, x, y):
        trace = random_trace(seed)
        cos, sin = math.cos(angle), math.sin(angle)
        states = trace.states.copy()
        states[..., X] = x + cos * trace.states[..., X] - sin * trace.states[..., Y]
        states[..., Y] = y + sin * trace.states[..., X] + cos * trace.states[..., Y]
        states[..., HEADING] += angle
        turned = with_states(states, trace.sizes, straight_lanes(heading=angle))
        assert differing(ARRAYS, turned, trace) == []

    @given(seed=seeds)
    def test_is_the_same_in_a_mirror(self, seed):
        trace = random_trace(seed)
        states = trace.states.copy()
        states[..., [Y, HEADING]] *= -1
        assert differing(ARRAYS, with_states(states, trace.sizes), trace) == []

    @given(seed=seeds)
    def test_array_for_one_npc_does_not_need_others(self, seed):
        trace = random_trace(seed)
        alone = with_states(trace.states[:, [0, 2]], trace.sizes[[0, 2]])
        for measure in ARRAYS:
            np.testing.assert_array_equal(
                measure(alone)[:, 0], measure(trace)[:, 1], err_msg=measure.__name__
            )

    def test_has_one_value_per_tick_and_npc(self):
        trace = random_trace(0, rows=12, vehicles=4)
        assert {measure(trace).shape for measure in ARRAYS} == {(12, 3)}

    @table("measure", ARRAYS)
    def test_never_hides_a_nan(self, measure):
        states = random_trace(0, rows=1).states.copy()
        states[..., LANE] = 1
        states[:, 0, [X, HEADING, SPEED, ACCELERATION]] = np.nan
        assert np.isnan(measure(with_states(states, np.full((3, 2), (5, 2))))).all()


@given(seed=seeds)
def test_swapping_ego_and_npc_changes_nothing(seed):
    trace = random_trace(seed, vehicles=2)
    assert differing(SYMMETRIC, with_states(trace.states[:, ::-1], trace.sizes[::-1]), trace) == []
