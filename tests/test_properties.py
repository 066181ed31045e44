from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot import properties
from pytest_pafot.attribution.manoeuvres import braking, reasons
from pytest_pafot.attribution.responses import DISTANCES
from pytest_pafot.criticality import Encounters, RoadFrame, RssRules
from pytest_pafot.model.trace import ACCELERATION, ALONG, HEADING, LANE, SPEED, AdsError, Outcome, X
from pytest_pafot.oracle.checks import Recording, recorded
from pytest_pafot.searching.space import SearchSpace, sample
from tests.helpers.crossing_traces import CROSSES, MERGES, ZONES, junction_trace
from tests.helpers.drives import HZ, bent
from tests.helpers.situations import FAR, LEFT, OWN, RIGHT, SITUATIONS, at_ramp, driven, hit, in_bend
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
    assert set(properties.__all__) == {name for name, each in vars(properties).items() if is_property(name, each)}


def is_property(name, each):
    return callable(each) and each.__module__ == properties.__name__ and not name.startswith("_")


# No fault.


@table("situation", COLLISIONS[::9])
def test_no_fault_fails_if_the_ego_is_responsible(situation):
    run = pafot.Run(situation.trace())
    if situation.responsibility in ("npc", "none"):
        properties.no_fault(run)
    else:
        with pytest.raises(AssertionError, match=r"The ego is responsible|Both are responsible"):
            properties.no_fault(run)


def test_no_fault_has_no_margin_without_collision():
    assert judged(properties.no_fault, following(1.0)) == []


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
    assert only(properties.rss_distance, following(12.0 + 12.0 - 9.0, speed=12.0, leader=12.0)).value == 0.0
    assert only(properties.rss_distance, following(15.0, speed=12.0, leader=12.0)).holds


def test_side_by_side_it_is_the_gap_across():
    # 2 m, less 0.1 m, and twice the way of a second of 0.2 m/s^2 and of braking with 0.8 m/s^2
    abreast = trace_of(vehicle(0.0, OWN, speed=20.0), vehicle(1.0, LEFT, speed=20.0))
    assert only(properties.rss_distance, abreast).value == pytest.approx(2.0 - 0.1 - 2 * (0.1 + 0.04 / 1.6))
    nearer = trace_of(vehicle(0.0, OWN, speed=20.0), vehicle(-1.0, 1.7, speed=20.0))
    assert only(properties.rss_distance, nearer).value == pytest.approx(0.3 - 0.35)


def test_who_is_behind_owes_the_distance_itself():
    assert (
        judged(properties.rss_distance, trace_of(vehicle(0.0, OWN, speed=20.0), vehicle(-6.0, OWN, speed=30.0))) == []
    )


def test_the_worst_npc_at_its_tick_is_named():
    ego, near = driven(0.0, seconds=4.0), driven(60.0, speed=15.0, seconds=4.0)
    made = only(properties.rss_distance, trace_of(ego, driven(200.0, seconds=4.0), near))
    assert (made.npc, made.time) == (1, 4.0)
    assert made.value == pytest.approx(60.0 - 5.0 * 4 - LENGTH - (20 + 400 / 12 - 225 / 16))


def test_other_rules_ask_for_other_distances():
    intel = RssRules()
    # 1 s of speeding up with 3.5 m/s^2, then braking with 4 m/s^2; the leader brakes with 8 m/s^2
    safe = 20 + 3.5 / 2 + 23.5**2 / 8 - 400 / 16
    assert only(properties.rss_distance, following(60.0), rules=intel).value == pytest.approx(60.0 - safe)


def test_every_collision_is_below_it_when_it_happens():
    for situation in COLLISIONS:
        trace = situation.trace()
        frame = RoadFrame(trace)
        if frame.ahead[trace.collision.npc, -1] >= 0:
            assert not only(properties.rss_distance, trace).holds, situation.name


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
    assert only(properties.comfort, trace_of(ego, driven(FARTHER)), braking=None, **STRAIGHT_ON).value == pytest.approx(
        2.0
    )
    names = [made.name for made in judged(properties.comfort, trace_of(ego, driven(FARTHER)))]
    assert names == ["jerk", "braking", "lateral acceleration", "lateral jerk"]
    assert judged(properties.comfort, trace_of(ego, driven(FARTHER)), jerk=None, braking=None, **STRAIGHT_ON) == []


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
    made = only(properties.comfort, turning(np.full(200, 20.0 / 100.0)), lateral_jerk=None, **ONLY_SIDEWAYS)
    assert made.value == pytest.approx(400.0 / 100.0)


def on_empty_road(ads, *, speed, seconds):
    """Return the run of an ego with an NPC that falls behind."""
    npcs = [[pafot.PositionInstruction(6, 0.0)]]
    scenario = pafot.Scenario(npcs=npcs, ego_lane=1, ego_speed=speed, gene_seconds=seconds)
    return pafot.Highway(duration=seconds).rollout(scenario, lambda: ads)


@given(st.lists(st.tuples(st.integers(0, 3), st.sampled_from([0.0, 10.0, 27.0])), min_size=9, max_size=9))
def test_lane_changes_by_drive_are_laterally_comfortable(goals):
    """However hard it brakes and speeds up while it does, at whatever speed."""

    def decide(now):
        lane, speed = goals[int(now.time / 2.1) % 9]
        return pafot.Drive(lane=lane, speed=speed)

    trace = on_empty_road(decide, speed=27.0, seconds=40)
    assert [made.holds for made in judged(properties.comfort, trace, **ONLY_SIDEWAYS)] == [True, True]


@table("left_out", ["lateral_acceleration", "lateral_jerk"])
def test_policy_that_jerks_the_wheel_is_uncomfortable(left_out):
    trace = on_empty_road(lambda now: (0.0, 0.03 if int(now.time) % 2 else -0.03), speed=25.0, seconds=3)
    assert not only(properties.comfort, trace, **ONLY_SIDEWAYS, **{left_out: None}).holds


# The road.


@table("heading", [0.0, 0.7])
@table(("y", "to_edge"), [(4.0, 6.0), (0.0, 2.0), (-1.9, 0.1), (-2.5, -0.5), (13.0, 1.0), (15.0, -1.0)])
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


# Keeping up.


def test_keeps_up_measures_best_ten_seconds_against_limit():
    trace = trace_of(driven(0.0, speed=20.0, brakes=[(2.0, 1.0, 15.0)]), driven(-FARTHER))
    made = only(properties.keeps_up, trace)
    assert made.value == pytest.approx(15.0 / 26.8)
    assert made.margin == pytest.approx((15.0 / 26.8 - 0.7) / 0.7)
    assert made.time == pytest.approx(17.0)  # 5 s to slow down, and ten at 15 m/s


@pytest.mark.parametrize(("speed", "holds"), [(0.7 * 26.8 - 0.1, False), (0.7 * 26.8 + 0.1, True)])
def test_keeps_up_holds_from_its_share_on(speed, holds):
    assert only(properties.keeps_up, trace_of(driven(0.0, speed=speed), driven(-FARTHER))).holds == holds


def test_keeps_up_excuses_short_waits_and_short_runs():
    waits = driven(0.0, speed=24.0, brakes=[(1.0, 8.0, 0.0), (6.0, -4.0, 24.0)], seconds=20.0)
    assert only(properties.keeps_up, trace_of(waits, driven(-FARTHER))).holds
    assert (
        judged(properties.keeps_up, trace_of(driven(0.0, speed=1.0, seconds=9.9), driven(-FARTHER, seconds=9.9))) == []
    )


def test_keeps_up_excuses_an_ego_behind_slow_traffic():
    near, far = 3.0 * 0.7 * 26.8 + LENGTH - 0.1, 3.0 * 0.7 * 26.8 + LENGTH + 0.1
    assert judged(properties.keeps_up, trace_of(driven(0.0, speed=5.0), driven(near, speed=5.0))) == []
    assert not only(properties.keeps_up, trace_of(driven(0.0, speed=5.0), driven(far, speed=5.0))).holds
    assert not only(properties.keeps_up, trace_of(driven(0.0, speed=0.0), driven(far, speed=0.0))).holds
    assert not only(properties.keeps_up, trace_of(driven(0.0, speed=5.0), driven(near, LEFT, speed=5.0))).holds


def test_keeps_up_accepts_another_speed_per_tick():
    trace = trace_of(driven(0.0, speed=10.0), driven(-FARTHER, speed=12.0))
    assert only(properties.keeps_up, trace, speed=pafot.Run(trace).npcs[0].speed).value == pytest.approx(10 / 12)
    assert only(properties.keeps_up, trace, speed=20.0, share=0.5).margin == 0.0


# Lane changes.


@table(
    ("npc", "side", "seconds"),
    [
        (driven(60.0), "ahead", 55.0 / 20),
        (driven(24.9), "ahead", 19.9 / 20),
        (driven(2.0), "ahead", 0.0),
        (driven(-24.9), "behind", 19.9 / 20),
        (driven(-125.0, speed=40.0), "behind", (125.0 - 20 * 3.0 - LENGTH) / 40),
        (driven(-25.1, speed=0.0), "behind", np.inf),
    ],
)
def test_lane_change_gap_is_in_seconds_of_follower(npc, side, seconds):
    trace = trace_of(driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)], seconds=10.0), npc[: 10 * HZ + 1])
    made = only(properties.lane_change_gaps, trace)
    assert (made.name, made.npc, made.unit) == (f"lane change gap {side}", 0, "s")
    assert made.time == pytest.approx(3.0, abs=0.1)
    assert made.value == pytest.approx(seconds, abs=0.05)
    assert made.margin == pytest.approx(made.value - 1.0)


def test_lane_changes_count_only_next_to_traffic():
    beside = driven(0.0, RIGHT)
    assert judged(properties.lane_change_gaps, trace_of(driven(0.0), beside)) == []
    assert judged(properties.lane_change_gaps, trace_of(driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), beside)) == []


def test_lane_change_gaps_check_npcs_with_given_bounds():
    ego = driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)])
    made = judged(properties.lane_change_gaps, trace_of(ego, driven(16.0), driven(-46.0)), ahead=0.5, behind=2.0)
    assert [(each.npc, each.at_least, each.holds) for each in made] == [(0, 0.5, True), (1, 2.0, True)]


# Braking for a reason.


def braked(deceleration, seconds, *npcs):
    return trace_of(driven(0.0, brakes=[(5.0, deceleration, 20.0 - deceleration * seconds)]), *npcs)


@table(("deceleration", "seconds", "value"), [(6.0, 1.0, 6.0), (4.9, 2.0, 4.9), (7.5, 0.4, 7.5), (8.0, 0.2, 0.0)])
def test_braking_without_reason_is_the_lasting_deceleration(deceleration, seconds, value):
    made = only(properties.brakes_for_a_reason, braked(deceleration, seconds, driven(FARTHER)))
    assert made.value == pytest.approx(value)
    assert made.margin == pytest.approx((5.0 - value) / 5.0)
    assert (made.time >= 5.0) == (value > 0)


def test_near_leader_in_own_lane_justifies_braking():
    assert only(properties.brakes_for_a_reason, braked(6.0, 1.5, driven(85.0, speed=10.0))).value == 0.0
    assert not only(properties.brakes_for_a_reason, braked(6.0, 1.5, driven(85.0, LEFT, speed=10.0))).holds


def test_reason_that_vanishes_during_braking_still_counts():
    ego = driven(0.0, speed=35.0, brakes=[(5.0, 6.0, 5.0)])
    leaves = driven(120.0, speed=20.0, shifts=[(5.4, LEFT, 1.0)])
    assert only(properties.brakes_for_a_reason, trace_of(ego, leaves)).holds
    never_there = driven(120.0, LEFT, speed=20.0)
    assert not only(properties.brakes_for_a_reason, trace_of(ego, never_there)).holds


def expected_needless(trace):
    """Return whether any hard braking has no reason, stretch by stretch in plain loops."""
    hard, frame, found = (braking(trace) > 5.0).tolist(), RoadFrame(trace), False
    first = None
    for tick, is_hard in enumerate([*hard, False]):
        if is_hard and first is None:
            first = tick
        elif not is_hard and first is not None:
            if tick - first >= 0.4 * HZ:
                around = slice(max(first - 1 - 24, 0), min(first - 1 + 7, trace.ticks + 1))
                found |= not reasons(trace, frame, DISTANCES, 0, around).any()
            first = None
    return found


def test_needless_braking_agrees_with_the_fault_rule():
    for situation in COLLISIONS:
        trace = situation.trace()
        made = only(properties.brakes_for_a_reason, trace)
        assert made.holds != expected_needless(trace), situation.name
        # Verdicts also count lasting braking, and braking that goes on when its reason is gone.
        begins_hard = (braking(trace) > 5.0).any() and "kept braking" not in situation.says
        assert made.holds <= (situation.fault != "braked-for-nothing" or not begins_hard), situation.name


# Cut-ins.


def cut_in(gap, *, slower=10.0, lasts=3.0, npc_brakes=(), ego_brakes=()):
    """Return a run with an NPC from the left that begins at 2 s, and crosses the line by 0.3 m at a gap ahead."""
    when = 2.0 + np.ceil(lasts * 1.3 / 4.0 * HZ) / HZ
    npc = driven(LENGTH + gap + slower * when, LEFT, speed=20 - slower, brakes=npc_brakes, shifts=[(2.0, OWN, lasts)])
    return driven(0.0, brakes=ego_brakes), npc


LEAST = 10.0 * (10.0 / 12 + 0.35)
"""The gap that an NPC that is 10 m/s slower must leave [m]."""


def test_avoidable_collision_after_a_cut_in_fails():
    made = only(properties.answers_cut_ins, hit(*cut_in(LEAST + 1.0)))
    assert (made.holds, made.value, made.npc) == (False, 0.0, 0)
    assert made.margin == pytest.approx(-0.1 / 10)


def test_cut_in_margin_is_smallest_gap_while_closing():
    trace = trace_of(*cut_in(30.0, ego_brakes=[(3.0, 6.0, 9.0)]))
    made = only(properties.answers_cut_ins, trace)
    slow = int(np.argmax(trace.ego[:, 3] <= 10.0))
    along = trace.npcs[slow - 1, 0, 0] - trace.ego[slow - 1, 0] - LENGTH
    assert made.value == pytest.approx(along, abs=0.2)
    assert made.holds
    assert made.time == pytest.approx((slow - 1) / HZ)


@table(
    ("why", "vehicles"),
    [
        ("too near", cut_in(LEAST - 1.0)),
        ("a swerve", cut_in(LEAST + 8.0, lasts=1.5)),
        ("it is faster", cut_in(20.0, slower=-2.0)),
        ("no cut-in at all", (driven(0.0), driven(60.0, speed=10.0))),
        (
            "both change lanes",
            (driven(0.0, LEFT, shifts=[(2.0, OWN, 3.0)]), driven(60.0, RIGHT, speed=10.0, shifts=[(2.0, OWN, 3.2)])),
        ),
        ("the ego changes lanes", (driven(0.0, LEFT, shifts=[(2.0, OWN, 3.0)]), driven(60.0, speed=10.0))),
    ],
)
def test_unavoidable_cut_ins_by_regulation_are_not_checked(why, vehicles):
    assert judged(properties.answers_cut_ins, trace_of(*vehicles)) == []


def test_cut_in_seen_under_a_second_is_checked():
    assert not only(properties.answers_cut_ins, hit(*cut_in(LEAST + 1.0, lasts=2.5))).holds


def test_cut_in_of_barely_slower_npc_is_checked():
    assert not only(properties.answers_cut_ins, hit(*cut_in(5.0, slower=0.5))).holds


def test_cut_in_ends_when_npc_leaves_the_lane():
    ego, npc = driven(0.0), driven(80.0, LEFT, speed=10.0, shifts=[(2.0, OWN, 3.0), (5.1, LEFT, 1.0)])
    made = only(properties.answers_cut_ins, trace_of(ego, npc))
    assert made.value == pytest.approx(80.0 - 10.0 * made.time - LENGTH, abs=0.2)
    assert made.value > 15


def test_collision_from_later_braking_passes_answers_cut_ins():
    trace = hit(*cut_in(30.0, npc_brakes=[(3.5, 8.0, 0.0)]))
    assert only(properties.answers_cut_ins, trace).holds


def test_slowing_npc_counts_while_braking_time_suffices():
    gap = 13.0 * (13.0 / 12 + 0.35)
    for beyond, holds in ((-0.5, True), (0.5, False)):
        trace = hit(*cut_in(gap + beyond, npc_brakes=[(3.3, 6.0, 7.0)]))
        assert only(properties.answers_cut_ins, trace).holds == holds


def test_in_a_bend_it_is_the_same():
    assert not only(properties.answers_cut_ins, in_bend(*cut_in(25.0))).holds


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
    "two ticks": lambda: trace_of(vehicle(0.0, OWN, speed=20.0, ticks=1), vehicle(30.0, OWN, ticks=1)),
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
        run = pafot.Run(trace)
        hard = [((npc.acceleration < -5) & (run.leader == index)).any() for index, npc in enumerate(run.npcs)]
        is_quiet = run.min_ttc > 3 and run.headway.min() > 1.4 and not any(hard)
        quiet += is_quiet
        for name in properties.__all__:
            if is_quiet or name not in ("comfort", "rss_distance"):
                getattr(properties, name)(run)
    assert quiet > 5


def test_keeps_up_requires_nothing_in_standing_traffic():
    trace = trace_of(driven(0.0, speed=0.0), driven(-FARTHER))
    assert judged(properties.keeps_up, trace, speed=0.0) == []
    assert only(properties.keeps_up, trace, speed=10.0).value == 0.0


@table("speed", [[1.0, 2.0], -1.0, np.nan, np.inf, "2", True])
def test_keeps_up_refuses_an_invalid_speed(speed):
    with pytest.raises(
        ValueError, match=r"expected a finite speed of at least 0, as a number or one number per tick, received"
    ):
        properties.keeps_up(pafot.Run(trace_of(driven(0.0), driven(-FARTHER))), speed=speed)


@table(
    ("holds", "argument"),
    [
        (properties.comfort, "jerk"),
        (properties.comfort, "braking"),
        (properties.comfort, "lateral_acceleration"),
        (properties.comfort, "lateral_jerk"),
        (properties.keeps_up, "share"),
        (properties.keeps_up, "headway"),
        (properties.keeps_up, "seconds"),
        (properties.lane_change_gaps, "ahead"),
        (properties.lane_change_gaps, "behind"),
    ],
)
def test_properties_refuse_negative_or_non_finite_arguments(holds, argument):
    for odd in (-1.0, np.nan, np.inf, "2", True):
        told = f"expected {argument}= as a finite number of at least 0, received {odd!r}"
        with pytest.raises(ValueError, match=told):
            holds(pafot.Run(following(100.0)), **{argument: odd})


def test_rules_of_another_kind_are_refused():
    with pytest.raises(TypeError, match=r"expected rules= as criticality.RssRules\(\.\.\.\), received 2\.0"):
        properties.rss_distance(pafot.Run(following(100.0)), rules=2.0)


# With NPCs that cross, or merge, at a junction.


def slowed(trace, deceleration, *, since):
    """Return the run with an ego that brakes with a deceleration [m/s^2] from a time on [s]."""
    states, track = trace.states.copy(), trace.track.copy()
    braking_for = np.maximum(trace.times - since, 0.0)
    speed = np.maximum(states[:, 0, SPEED] - deceleration * braking_for, 0.0)
    driven = np.concatenate(([0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * trace.dt)))
    states[:, 0, SPEED], states[:, 0, X], track[:, 0, ALONG] = speed, driven, driven
    return replace(trace, states=states, track=track)


JUNCTIONS = (
    junction_trace((CROSSES, 0.0)),
    junction_trace((CROSSES, 10.0), seconds=4.5),
    junction_trace((MERGES, 0.0)),
    junction_trace((MERGES, 0.0), ego_speed=14.0),
    junction_trace((CROSSES, 20.0), (MERGES, -20.0), (None, 60.0)),
)


@table("name", sorted(set(properties.__all__) - {"rss_distance", "gives_way", "no_fault"}))
@table("trace", JUNCTIONS)
def test_steady_ego_at_a_junction_breaks_no_property(name, trace):
    assert all(made.holds for made in judged(getattr(properties, name), trace))


def test_rss_distance_counts_only_npcs_on_ego_path():
    assert judged(properties.rss_distance, junction_trace((CROSSES, 10.0), seconds=4.5)) == []
    made = only(properties.rss_distance, junction_trace((CROSSES, 0.0), (MERGES, 0.0)))
    assert made.npc == 1
    assert made.time >= 62 / HZ
    behind = only(properties.rss_distance, junction_trace((CROSSES, 0.0), (None, 20.0)))
    assert (behind.npc, behind.value) == (1, pytest.approx(15.0 - (10 + 100 / 12 - 100 / 16)))


def test_ego_waiting_at_junction_still_keeps_up():
    waiting = slowed(junction_trace((CROSSES, -110.0), seconds=12.0), 3.0, since=0.0)
    assert judged(properties.keeps_up, waiting, speed=10.0) == []
    alone = slowed(junction_trace((CROSSES, 110.0), seconds=12.0), 3.0, since=0.0)
    assert not only(properties.keeps_up, alone, speed=10.0).holds


def test_lane_change_gaps_ignore_crossing_npcs():
    trace = junction_trace((CROSSES, 0.0), (None, -8.0))
    states = trace.states.copy()
    states[30:, :, LANE] = 1
    made = only(properties.lane_change_gaps, replace(trace, states=states))
    assert (made.npc, made.name) == (1, "lane change gap behind")


@table(("start", "holds"), [(5.0, True), (-110.0, False), (70.0, False)])
def test_npc_arriving_at_same_zone_soon_justifies_braking(start, holds):
    braked = slowed(junction_trace((CROSSES, start), seconds=5.0), 6.0, since=2.0)
    assert only(properties.brakes_for_a_reason, braked).holds is holds


def test_merging_npc_from_another_way_cuts_in_nowhere():
    """At 20 m/s the ego reaches the NPC, which is in its lane as soon as it is on its way at all."""
    trace = junction_trace((MERGES, 12.0), ego_speed=20.0, seconds=4.0)
    assert (Encounters(trace).gap == 0).any()
    assert judged(properties.answers_cut_ins, trace) == []


# Giving way.


@table(
    ("start", "left", "holds"),
    [
        (-10.0, 1.1, True),  # 10 m later than the ego
        (0.0, 0.1, False),
        (10.0, 0.0, False),  # both come at once
    ],
)
def test_gives_way_measures_time_left_before_the_npc(start, left, holds):
    made = only(properties.gives_way, junction_trace((CROSSES, start)))
    assert made.value == pytest.approx(left, abs=0.1)
    assert (made.holds, made.npc, made.unit) == (holds, 0, "s")
    assert made.time == pytest.approx(4.6)


def test_gives_way_ignores_earlier_unprioritised_or_stopped_npcs():
    for trace in (
        junction_trace((CROSSES, 12.0)),  # 0.2 s before the ego
        junction_trace((MERGES, -20.0)),  # has no priority
        junction_trace((CROSSES, 0.0), seconds=4.0),  # the ego does not come
    ):
        assert judged(properties.gives_way, trace) == []
    trace = junction_trace((CROSSES, 0.0))
    states, on_way = trace.states.copy(), trace.on_way.copy()
    states[45:, 1, SPEED], on_way[45:] = 0.0, on_way[45]  # it never arrives, and is not expected to
    assert only(properties.gives_way, replace(trace, states=states, on_way=on_way)).value == np.inf


def test_other_seconds_can_be_asked_for():
    trace = junction_trace((CROSSES, -10.0))
    assert ZONES[CROSSES].priority == "npc"
    assert not only(properties.gives_way, trace, seconds=1.5).holds
    with pytest.raises(ValueError, match="seconds= as a finite number"):
        properties.gives_way(pafot.Run(trace), seconds=-1.0)
