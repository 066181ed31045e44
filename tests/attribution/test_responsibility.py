"""The five rules of docs/explanation/verdicts.md against collisions made by hand."""

import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pytest_pafot import Cell, Run
from pytest_pafot.attribution.responsibility import DISTANCES, Conflict, position_rule, rss_rule
from pytest_pafot.criticality import RoadFrame
from pytest_pafot.model.trace import HEADING, SPEED, STEERING, Outcome, X, Y
from tests.helpers.drives import HZ, crash, driven
from tests.helpers.situations import cut_in, lane_change
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, random_states, straight_lanes, trace_of, vehicle
from tests.helpers.work import calls_in

LEFT, OWN = 0.0, 4.0


def who(trace):
    return rss_rule(trace).responsibility


# Rule 2: who moves into the other's way without leaving room is responsible.


def test_lane_change_leaves_the_room_of_the_page():
    """At the tick over the line, and when the tracks meet: by the formula of the page alone, from the trace."""
    page = (Path(__file__).parents[2] / "docs/explanation/verdicts.md").read_text(encoding="utf-8")
    formula = re.search(r"\|room\|`g≥(.*)` \(", page)[1].replace("·", "*").replace("²", "**2")
    rng, found = np.random.default_rng(6), []
    for _ in range(40):
        faster = rng.uniform(3, 12)
        trace = lane_change(rng.uniform(20, 60), faster=faster, npc_brakes=[(4.0, -3.0, 99.0)])
        own, npc, (length, width) = *trace.states.swapaxes(0, 1)[:2], trace.sizes[0]
        cos, sin = np.cos(own[:, HEADING]), np.abs(np.sin(own[:, HEADING]))
        edge = own[:, Y] + width / 2 * cos + length / 2 * sin
        has_room = []
        for tick in (int(np.argmax(edge > OWN / 2)), int(np.argmax(edge > OWN - width / 2))):
            v, u = (each[tick, SPEED] * np.cos(each[tick, HEADING]) for each in (own, npc))
            half = (width * sin[tick] + length * cos[tick] + length) / 2
            gap = own[tick, X] - npc[tick, X] - half
            has_room.append(gap >= eval(formula, {"u": v, "d": max(u - v, 0)}))
        # within 3 s, the NPC is not yet the one that has to answer
        if all(has_room) or trace.duration < 5.4:
            found.append(all(has_room))
            assert (who(trace) == "npc") == all(has_room)
    assert 5 <= sum(found) <= len(found) - 5


@pytest.mark.parametrize(("gap", "expected"), [(1.0, "ego"), (12.0, "both")])
def test_npc_that_could_have_avoided_a_close_lane_change_shares(gap, expected):
    """The NPC drives 4 m/s faster and never brakes; up to 2.0 m ahead, the ego is next to it."""
    assert who(lane_change(gap, faster=4.0)) == expected


def test_swaying_slightly_in_lane_is_no_lane_change():
    ego, npc = driven(0.0, shifts=[(1.0, 3.8, 2.0)]), driven(1.0, LEFT, shifts=[(1.0, OWN, 2.0)])
    assert who(crash(ego, npc, side="left", cell=Cell.LEFT)) == "npc"


def swerved():
    """Return a run in which an NPC cuts in, over the other line of the ego's lane and back."""
    shifts = [(2.0, 2.06, 0.8), (2.8, 1.95, 0.4), (3.2, 2.06, 0.2), (3.6, 1.8, 1.2)]
    shifts = [(start, OWN + place, duration) for start, place, duration in shifts]
    ego = driven(0.0, brakes=[(3.4, 7.0, 0.0)])
    return crash(ego, driven(8.0, LEFT, brakes=[(3.0, 8.0, 0.0)], shifts=shifts))


def test_swerve_over_the_other_line_hides_no_cut_in():
    cut_in, *_ = rss_rule(swerved()).sentences
    assert "lane 1 at 2.1 s, 2.8 m ahead" in cut_in


# Rule 3: who is behind and could have avoided it by an ordinary response is responsible.


@given(
    gap=st.floats(2, 25),
    own=st.floats(15, 30),
    speeds=st.lists(st.floats(0, 25), min_size=4, max_size=4),
)
def test_ego_that_brakes_as_a_response_requires_is_not_responsible(gap, own, speeds):
    """However often the one ahead brakes and speeds up again."""
    brakes = [(2.0 * each, 8.0 if speed < 12 else -4.0, speed) for each, speed in enumerate(speeds)]
    npc, ego = driven(5.0 + gap, brakes=brakes), driven(0.0, speed=own)
    for tick in range(HZ, len(ego)):
        slower = ego[tick - 1, SPEED] - 6.0 / HZ * (ego[tick - 1, SPEED] > npc[tick - 1, SPEED])
        ego[tick, SPEED] = max(slower, 0.0)
    ego[1:, X] = np.cumsum(ego[:-1, SPEED]) / HZ
    assume((npc[:, X] - ego[:, X] <= 5.0).any())
    assert who(crash(ego, npc)) == "npc"


@table("speed", [1.0, 10.0, 22.0, 26.8, 36.0])
def test_two_seconds_behind_equally_fast_leader_are_safe(speed):
    ego, npc = (vehicle(x, speed=speed, ticks=2) for x in (0.0, 2 * speed + 5.0))
    assert (RoadFrame(trace_of(ego, npc)).safe_along(DISTANCES) < 2 * speed).all()


@table(("seconds", "expected"), [(2.4, "npc"), (2.9, "ego")])
def test_a_leader_that_stops_dead_must_be_answered_if_6_m_per_s2_after_a_second_avoid_it(
    seconds, expected
):
    """From 20 m/s, that takes 53 m, and the leader stops in 2 m."""
    npc = driven(5.0 + 20.0 * seconds, brakes=[(2.0, 100.0, 0.0)])
    assert who(crash(driven(0.0), npc)) == expected


@table(("gap", "slower", "brakes", "expected"), [
    (40.0, 8.0, [], "ego"),
    (10.0, 10.0, [(3.7, 8.0, 0.0)], "npc"),
    (20.0, 10.0, [], "both"),  # nobody can avoid it, but there are 2.1 s
    (6.0, 12.0, [], "npc"),
    (10.0, 0.0, [(2.5, -2.0, 26.0)], "both"),  # it survived the cut-in, and sped up
])  # fmt: skip
def test_cut_in_is_answered_by_6_m_per_s2_after_1_4_s(gap, slower, brakes, expected):
    assert who(cut_in(gap, slower=slower, ego_brakes=brakes)) == expected


# Rule 4: who braked or stopped with nothing in its way is responsible.


@table(("rate", "seconds", "expected"), [(4.5, 0.5, "both"), (4.5, 0.3, "npc"), (3.9, 3.0, "npc")])
def test_braking_is_hard_above_4_m_per_s2_for_0_4_s(rate, seconds, expected):
    ego = driven(0.0, brakes=[(4.0, rate, 20.0 - rate * seconds)], seconds=60.0)
    assert who(crash(ego, driven(-30.0, seconds=60.0), side="rear", cell=Cell.REAR)) == expected


@table(("gap", "expected"), [(4.0, "npc"), (14.0, "both")])
def test_stop_close_behind_standing_vehicle_has_a_reason(gap, expected):
    """The ego creeps at 0.6 m/s and stops with 0.2 m/s^2, so nothing else is a reason to stop."""
    ego = driven(0.0, speed=0.6, brakes=[(1.0, 0.2, 0.0)], seconds=30.0)
    ahead = driven(5.0 + 1.5 + gap, speed=0.0, seconds=30.0)
    behind = driven(-100.0, speed=5.0, seconds=30.0)
    assert who(crash(ego, behind, ahead, side="rear", cell=Cell.REAR)) == expected


# Any run.


def test_without_a_collision_nobody_is_responsible():
    trace = trace_of(vehicle(0.0, ticks=10), vehicle(50.0, ticks=10))
    found = rss_rule(trace)
    assert (found.responsibility, found.tick, found.time) == ("none", None, None)
    assert (position_rule(trace), found.sentences) == ("none", ())


def test_equal_verdicts_are_equal_in_any_process():
    found = rss_rule(crash(driven(0.0, speed=25.0), driven(60.0, speed=15.0)))
    assert found == pickle.loads(pickle.dumps(found))
    assert found != replace(found, sentences=found.sentences[1:])


def mirrored(trace):
    """Return the same run with left and right swapped, on the same four lanes."""
    states = trace.states.copy()
    states[..., Y] = 12.0 - states[..., Y]
    states[..., HEADING] *= -1
    states[..., STEERING] *= -1
    states[..., 6] = np.where(states[..., 6] < 0, -1, 3 - states[..., 6])
    swapped = {"left": "right", "right": "left"}.get(trace.collision.side, trace.collision.side)
    return replace(trace, states=states, collision=replace(trace.collision, side=swapped))


@given(
    ahead=st.floats(-40, 40), lane=st.sampled_from([LEFT, OWN, 8.0]), braking=st.floats(0, 9.8),
    speeds=st.tuples(st.floats(1, 30), st.floats(1, 30)), begin=st.floats(0.5, 3), seconds=st.floats(1, 4),
    side=st.sampled_from(["front", "rear", "left", "right"]),
)  # fmt: skip
def test_left_and_right_make_no_difference(ahead, lane, speeds, braking, begin, seconds, side):
    ego = driven(0.0, speed=speeds[0], brakes=[(begin, braking, 0.5)], seconds=8.0)
    npc = driven(ahead, lane, speed=speeds[1], shifts=[(begin, OWN, seconds)], seconds=8.0)
    trace = trace_of(ego, npc, outcome=Outcome.COLLISION, collision=collision_at(120, side=side))
    found, swapped = rss_rule(trace), rss_rule(mirrored(trace))
    other_lane = lambda it: f"lane {3 - int(it[1])}"  # noqa: E731
    told = [re.sub(r"lane (\d)", other_lane, text) for text in swapped.sentences]
    assert replace(swapped, sentences=tuple(told)) == found


@given(seed=st.integers(0, 10_000), ticks=st.integers(1, 60), vehicles=st.integers(2, 4))
def test_any_collision_gets_verdict_with_reason_and_time(seed, ticks, vehicles):
    states = random_states(np.random.default_rng(seed), ticks + 1, vehicles).swapaxes(0, 1)
    hit = collision_at(ticks, npc=vehicles - 2)
    found = rss_rule(trace_of(*states, outcome=Outcome.COLLISION, collision=hit))
    assert found.responsibility in ("ego", "npc", "both")
    assert 0 <= found.tick <= ticks
    assert found.time == found.tick / 15
    assert len(found.sentences) in (2, 3)
    assert "".join(found.sentences).isascii()


@table("angle", [0.7, np.pi / 2, np.pi])
def test_the_direction_of_the_road_makes_no_difference(angle):
    npc = driven(8.0, LEFT, brakes=[(3.5, 8.0, 0.0)], shifts=[(2.0, OWN, 2.0)])
    trace = crash(driven(0.0), npc)
    states, x, y = trace.states.copy(), trace.states[..., 0], trace.states[..., 1]
    states[..., 0] = x * np.cos(angle) - y * np.sin(angle)
    states[..., 1] = x * np.sin(angle) + y * np.cos(angle)
    states[..., HEADING] += angle
    found = rss_rule(trace)
    turned = rss_rule(replace(trace, states=states, lanes=straight_lanes(heading=angle)))
    assert (turned.responsibility, turned.tick) == (found.responsibility, found.tick)


def test_verdict_costs_no_more_for_a_longer_run():
    def calls(seconds):
        late = driven(4.7 * seconds, speed=14.8, seconds=seconds)
        trace = crash(driven(0.0, seconds=seconds), late, driven(50.0, 8.0, seconds=seconds))
        return trace.ticks, calls_in(rss_rule, trace)

    (short, few), (long, many) = calls(10.0), calls(60.0)
    assert long > 6 * short
    assert many < 1.1 * few


@table("cell", list(Cell))
def test_position_rule_blames_only_an_ego_that_drives_into_a_vehicle_ahead(cell):
    """The authors' rule is a second opinion."""
    ego, npc = vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(20.0, 4.0, speed=10.0, ticks=30)
    is_ahead = cell in (Cell.FRONT_LEFT, Cell.FRONT, Cell.FRONT_RIGHT)
    for speed in (20.0, 0.11, 0.1, 0.0):
        collision = collision_at(30, cell=cell, ego_speed=speed)
        found = position_rule(trace_of(ego, npc, outcome=Outcome.COLLISION, collision=collision))
        assert found == ("ego" if is_ahead and speed > 0.1 else "npc")


def test_the_collision_of_a_run_is_judged_once(monkeypatch):
    trace = crash(driven(0.0), driven(-60.0, speed=26.0), side="rear", cell=Cell.REAR)
    judged, needless = [], Conflict._npc_followed
    followed = lambda it, *told: judged.append(it) or needless(it, *told)  # noqa: E731
    monkeypatch.setattr(Conflict, "_npc_followed", followed)
    run = Run(trace)
    assert run.sentences
    assert (run.responsibility, run.attribution.fault) == ("npc", None)
    assert len(judged) == 1
