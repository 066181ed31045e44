from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot import properties
from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.criticality import RssRules
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, AdsError, Outcome
from pytest_pafot.oracle.run import Recording, recorded
from tests.helpers.crossing_traces import CROSSES, MERGES, junction_trace
from tests.helpers.drives import HZ, bent
from tests.helpers.situations import FAR, LEFT, OWN, SITUATIONS, at_ramp, driven, in_bend
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH, straight_lanes, trace_of, vehicle

FARTHER = 500.0
"""The place of an NPC that is in no vehicle's way [m]."""
COLLISIONS = [each for group in SITUATIONS.values() for each in group]


def judged(holds, trace, **arguments):
    """Return the checks that a property made in a run, in order."""
    recording = Recording(hz=trace.physics_hz, ticks=trace.ticks)
    with recorded(recording), suppress(AssertionError):
        holds(pafot.Run(trace), **arguments)
    return recording.checks


def only(holds, trace, **arguments):
    """Return the only check that a property made in a run."""
    (made,) = judged(holds, trace, **arguments)
    return made


def following(gap, *, speed=20.0, leader=20.0):
    """Return a run of one tick with the ego behind another vehicle in its lane."""
    return trace_of(vehicle(0.0, OWN, speed=speed), vehicle(gap + LENGTH, OWN, speed=leader))


def test_every_property_is_listed_as_public():
    assert "properties" in pafot.__all__
    own = {
        name
        for name, each in vars(properties).items()
        if getattr(each, "__module__", "") == properties.__name__
    }
    assert set(properties.__all__) == {name for name in own if not name.startswith("_")}


# No fault.


@table("situation", COLLISIONS[::9])
def test_no_fault_fails_if_the_ego_is_responsible(situation):
    run = pafot.Run(situation.trace())
    if situation.responsibility in ("npc", "none"):
        properties.no_fault(run)
    else:
        with pytest.raises(AssertionError, match="responsible"):
            properties.no_fault(run)


# The distance of RSS.


@table(("speed", "leader", "safe"), [(20.0, 20.0, 85 / 3), (20.0, 10.0, 565 / 12), (0.0, 8.0, 0.0)])
@table("beyond", [-0.5, 0.5])
def test_rss_margin_is_gap_minus_safe_distance(speed, leader, safe, beyond):
    # v + v^2 / 12 - u^2 / 16
    if safe + beyond > 0:
        made = only(properties.rss_distance, following(safe + beyond, speed=speed, leader=leader))
        assert made.value == pytest.approx(beyond)
        assert (made.holds, made.npc, made.margin) == (beyond > 0, 0, pytest.approx(beyond / 10))


def test_exactly_the_safe_distance_is_enough():
    assert (
        only(properties.rss_distance, following(12.0 + 12.0 - 9.0, speed=12.0, leader=12.0)).value
        == 0.0
    )
    assert only(properties.rss_distance, following(15.0, speed=12.0, leader=12.0)).holds


def test_side_by_side_it_is_the_gap_across():
    # 2 m, less 0.1 m, and twice the way of a second of 0.2 m/s^2 and of braking with 0.8 m/s^2
    abreast = trace_of(vehicle(0.0, OWN, speed=20.0), vehicle(1.0, LEFT, speed=20.0))
    assert only(properties.rss_distance, abreast).value == pytest.approx(
        2.0 - 0.1 - 2 * (0.1 + 0.04 / 1.6)
    )
    nearer = trace_of(vehicle(0.0, OWN, speed=20.0), vehicle(-1.0, 1.7, speed=20.0))
    assert only(properties.rss_distance, nearer).value == pytest.approx(0.3 - 0.35)


@table(("holds", "trace"), [
    (properties.no_fault, following(1.0)),  # without a collision
    # by the NPC
    (properties.rss_distance, trace_of(vehicle(0.0, OWN, speed=20.0), vehicle(-6.0, OWN, speed=30.0))),
    # which is not on the ego's path
    (properties.rss_distance, junction_trace((CROSSES, 10.0), seconds=4.5)),
])  # fmt: skip
def test_property_that_does_not_apply_has_no_margin(holds, trace):
    assert judged(holds, trace) == []


def test_the_worst_npc_at_its_tick_is_named():
    ego, near = driven(0.0, seconds=4.0), driven(60.0, speed=15.0, seconds=4.0)
    made = only(properties.rss_distance, trace_of(ego, driven(200.0, seconds=4.0), near))
    assert (made.npc, made.time) == (1, 4.0)
    assert made.value == pytest.approx(60.0 - 5.0 * 4 - LENGTH - (20 + 400 / 12 - 225 / 16))


def test_other_rules_ask_for_other_distances():
    intel = RssRules()
    # 1 s of speeding up with 3.5 m/s^2, then braking with 4 m/s^2; the leader brakes with 8 m/s^2
    safe = 20 + 3.5 / 2 + 23.5**2 / 8 - 400 / 16
    assert only(properties.rss_distance, following(60.0), rules=intel).value == pytest.approx(
        60.0 - safe
    )


# Comfort.

ONLY_SIDEWAYS = {"jerk": None, "braking": None}
STRAIGHT_ON = {"lateral_acceleration": None, "lateral_jerk": None}


@table(("seconds", "mean"), [(1.0, 2.0), (1.6, 3.2), (2.0, 4.0), (3.0, 4.0)])
def test_braking_is_the_mean_of_two_seconds(seconds, mean):
    trace = trace_of(driven(0.0, brakes=[(5.0, 4.0, 20.0 - 4.0 * seconds)]), driven(FARTHER))
    made = only(properties.comfort, trace, jerk=None, **STRAIGHT_ON)
    assert made.value == pytest.approx(mean)
    assert made.margin == pytest.approx((3.5 - mean) / 3.5)
    assert made.holds == (mean <= 3.5)


@table(("step", "holds"), [(-2.4, True), (-2.5, True), (-2.6, False), (2.6, False)])
def test_jerk_is_the_mean_of_one_second(step, holds):
    ego = driven(0.0)
    ego[60:90, ACCELERATION] = step
    made = only(properties.comfort, trace_of(ego, driven(FARTHER)), braking=None, **STRAIGHT_ON)
    assert (made.value, made.holds) == (pytest.approx(abs(step)), holds)
    assert (made.name, made.unit, made.time) == ("jerk", "m/s^3", 4.0)


def test_brief_jerk_does_not_count_in_full():
    ego = driven(0.0)
    ego[60, ACCELERATION], ego[61:, ACCELERATION] = -2.0, 0.0
    assert only(
        properties.comfort, trace_of(ego, driven(FARTHER)), braking=None, **STRAIGHT_ON
    ).value == pytest.approx(2.0)
    names = [made.name for made in judged(properties.comfort, trace_of(ego, driven(FARTHER)))]
    assert names == ["jerk", "braking", "lateral acceleration", "lateral jerk"]
    assert (
        judged(
            properties.comfort,
            trace_of(ego, driven(FARTHER)),
            jerk=None,
            braking=None,
            **STRAIGHT_ON,
        )
        == []
    )


def turning(rates, speed=20.0):
    """Return an ego that drives with a turning rate [rad/s] in each tick, at 15 ticks a second."""
    ego = driven(0.0, speed=speed)[: len(rates) + 1]
    ego[1:, HEADING] = np.cumsum(rates) / 15
    return trace_of(ego, driven(FARTHER)[: len(ego)])


@table(("ticks", "share"), [(4, 0.5), (8, 1.0), (60, 1.0)])
@table("sign", [1.0, -1.0])
def test_lateral_acceleration_is_mean_of_half_a_second(ticks, share, sign):
    """On a circle, a turning rate w at a speed v means w v sideways; half a second is eight ticks."""
    rates = np.zeros(200)
    rates[100 : 100 + ticks] = sign * 0.2
    made = only(properties.comfort, turning(rates), lateral_jerk=None, **ONLY_SIDEWAYS)
    assert made.value == pytest.approx(20.0 * 0.2 * share)
    assert (made.name, made.unit, made.holds) == ("lateral acceleration", "m/s^2", share < 1.0)


@table(("seconds", "holds"), [(0.2, False), (0.6, False), (0.9, True), (2.0, True)])
def test_gradual_lateral_acceleration_is_no_jerk(seconds, holds):
    """In a spiral, the sideways acceleration goes from 0 to 4 m/s^2 in these seconds, evenly."""
    rates = np.interp(np.arange(200) / 15, [5.0, 5.0 + seconds], [0.0, 4.0 / 20.0])
    made = only(properties.comfort, turning(rates), lateral_acceleration=None, **ONLY_SIDEWAYS)
    assert made.value == pytest.approx(4.0 / max(seconds, 8 / 15), rel=0.02)
    assert (made.name, made.unit, made.holds) == ("lateral jerk", "m/s^3", holds)


def test_what_a_bend_of_the_road_takes_counts():
    """On a circle of 100 m, at 20 m/s, every vehicle has 4 m/s^2 sideways."""
    made = only(
        properties.comfort, turning(np.full(200, 20.0 / 100.0)), lateral_jerk=None, **ONLY_SIDEWAYS
    )
    assert made.value == pytest.approx(400.0 / 100.0)


def on_empty_road(ads, *, speed, seconds):
    """Return the run of an ego with an NPC that falls behind."""
    npcs = [[pafot.PositionInstruction(6, 0.0)]]
    scenario = pafot.Scenario(npcs=npcs, ego_lane=1, ego_speed=speed, gene_seconds=seconds)
    return pafot.Highway(duration=seconds).rollout(scenario, lambda: ads)


@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.sampled_from([0.0, 10.0, 27.0])), min_size=9, max_size=9
    )
)
def test_lane_changes_by_drive_are_laterally_comfortable(goals):
    """However hard it brakes and speeds up while it does, at whatever speed."""

    def decide(now):
        lane, speed = goals[int(now.time / 2.1) % 9]
        return pafot.LaneCommand(lane=lane, speed=speed)

    trace = on_empty_road(decide, speed=27.0, seconds=40)
    assert [made.holds for made in judged(properties.comfort, trace, **ONLY_SIDEWAYS)] == [
        True,
        True,
    ]


@table("left_out", ["lateral_acceleration", "lateral_jerk"])
def test_policy_that_jerks_the_wheel_is_uncomfortable(left_out):
    trace = on_empty_road(
        lambda now: (0.0, 0.03 if int(now.time) % 2 else -0.03), speed=25.0, seconds=3
    )
    assert not only(properties.comfort, trace, **ONLY_SIDEWAYS, **{left_out: None}).holds


# The road.


@table("heading", [0.0, 0.7])
@table(
    ("y", "to_edge"), [(4.0, 6.0), (0.0, 2.0), (-1.9, 0.1), (-2.5, -0.5), (13.0, 1.0), (15.0, -1.0)]
)
def test_stays_on_road_measures_distance_to_nearer_edge(y, to_edge, heading):
    x, across = -y * np.sin(heading), y * np.cos(heading)
    ego = vehicle(x, across, heading=heading, speed=20.0, lane=1)
    made = only(properties.stays_on_road, trace_of(ego, ego, lanes=straight_lanes(heading=heading)))
    assert made.value == pytest.approx(to_edge)
    assert made.holds == (to_edge > 0)


def test_stays_on_road_holds_in_a_bend():
    vehicles, road = bent(driven(0.0), driven(60.0, LEFT))
    assert only(properties.stays_on_road, trace_of(*vehicles, **road)).value == 2.0
    vehicles[0][-1, LANE] = -1
    road["track"][-1, 0, 3] = 2.4
    made = only(properties.stays_on_road, trace_of(*vehicles, **road))
    assert (made.value, made.holds) == (pytest.approx(-0.4), False)


# All of them.


def broken_ads():
    error = AdsError(kind="ValueError", message="no", traceback="", tick=0)
    return trace_of(vehicle(0.0, OWN), vehicle(30.0, OWN), outcome=Outcome.ADS_ERROR, error=error)


def left_the_road():
    ego = driven(0.0, -30.0, shifts=[(1.0, -60.0, 3.0)])
    ego[:, LANE] = -1
    return trace_of(ego, driven(30.0), off_road_tick=0, outcome=Outcome.OFF_ROAD)


ODD = {
    "one tick": lambda: following(10.0),
    "two ticks": lambda: trace_of(
        vehicle(0.0, OWN, speed=20.0, ticks=1), vehicle(30.0, OWN, ticks=1)
    ),
    "off the road": left_the_road,
    "an error of the ADS": broken_ads,
    "nobody ahead": lambda: trace_of(driven(0.0), driven(-30.0)),
    "a bend": lambda: in_bend(driven(0.0), driven(45.0, brakes=[(2.0, 6.0, 0.0)])),
    "a ramp": lambda: at_ramp(driven(-54.0), driven(0.0, speed=14.0), on_ramp=1),
    "everybody stands": lambda: trace_of(driven(0.0, speed=0.0), driven(8.0, speed=0.0)),
    "one drives backwards": lambda: trace_of(driven(0.0, speed=-3.0), driven(40.0, FAR)),
}


@table("odd", ODD)
def test_odd_runs_are_judged_without_an_error(odd):
    trace = ODD[odd]()
    for name in properties.__all__:
        for made in judged(getattr(properties, name), trace):
            assert not np.isnan(made.value), name


def test_careful_driver_satisfies_all_properties_in_ordinary_traffic():
    """Only comfort and the distances of RSS may fail if a vehicle cuts in or brakes hard, since it must brake then."""
    world, rng = pafot.Highway(duration=20.0), np.random.default_rng(0)
    quiet = 0
    for _ in range(30):
        trace = world.rollout_reference(sample(SearchSpace(genes=2), rng), "careful-human")
        run = world.run_of(trace)
        hard = [
            ((npc.acceleration < -5) & (run.leader == index)).any()
            for index, npc in enumerate(run.npcs)
        ]
        is_quiet = run.min_ttc > 3 and run.headway.min() > 1.4 and not any(hard)
        quiet += is_quiet
        for name in properties.__all__:
            if is_quiet or name not in ("comfort", "rss_distance"):
                getattr(properties, name)(run)
    assert quiet > 5


COMFORT = ("jerk", "braking", "lateral_acceleration", "lateral_jerk")


@table("argument", COMFORT)
def test_comfort_refuses_negative_or_non_finite_arguments(argument):
    for odd in (-1.0, np.nan, np.inf, "2", True):
        with pytest.raises(ValueError, match=rf" {argument} .* {odd!r}"):
            properties.comfort(pafot.Run(following(100.0)), **{argument: odd})


def test_rules_of_another_kind_are_refused():
    with pytest.raises(TypeError, match="rules="):
        properties.rss_distance(pafot.Run(following(100.0)), rules=2.0)


# With NPCs that cross, or merge, at a junction.


def test_rss_distance_counts_only_npcs_on_ego_path():
    made = only(properties.rss_distance, junction_trace((CROSSES, 0.0), (MERGES, 0.0)))
    assert made.npc == 1
    assert made.time >= 62 / HZ
    behind = only(properties.rss_distance, junction_trace((CROSSES, 0.0), (None, 20.0)))
    assert (behind.npc, behind.value) == (1, pytest.approx(15.0 - (10 + 100 / 12 - 100 / 16)))
