import itertools
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pytest_pafot.attribution.manoeuvres import Stop, hard_braking
from pytest_pafot.attribution.responses import (
    ANSWERS,
    DISTANCES,
    Doing,
    Fact,
    Phase,
    What,
    avoidance_sentence,
    responsible_sentence,
    sentences,
)
from pytest_pafot.attribution.responsibility import Conflict, position_rule, rss_rule
from pytest_pafot.criticality import RoadFrame
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import HEADING, SPEED, STEERING, Outcome, X, Y
from pytest_pafot.oracle.run import LINE_LENGTH, Run
from tests.helpers.drives import HZ, crash, driven
from tests.helpers.situations import cut_in, lane_change
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, random_states, straight_lanes, trace_of, vehicle
from tests.helpers.work import calls_in

LEFT, OWN = 0.0, 4.0


class TestInOneLane:
    """A follower must keep its distance and, if that is too short, brake with 6 m/s^2 after 1 s."""

    @given(gap=st.floats(2, 25), own=st.floats(15, 30), speeds=st.lists(st.floats(0, 25), min_size=4, max_size=4))
    def test_ego_driving_like_the_reference_is_not_responsible(self, gap, own, speeds):
        """Not for a second chance either, however often the one ahead brakes and speeds up again."""
        brakes = [(2.0 * each, 8.0 if speed < 12 else -4.0, speed) for each, speed in enumerate(speeds)]
        npc, ego = driven(5.0 + gap, brakes=brakes), driven(0.0, speed=own)
        for tick in range(HZ, len(ego)):
            slower = ego[tick - 1, SPEED] - 6.0 / HZ * (ego[tick - 1, SPEED] > npc[tick - 1, SPEED])
            ego[tick, SPEED] = max(slower, 0.0)
        ego[1:, X] = np.cumsum(ego[:-1, SPEED]) / HZ
        assume((npc[:, X] - ego[:, X] <= 5.0).any())
        assert rss_rule(crash(ego, npc)).responsibility == "npc"

    @table("speed", [1.0, 10.0, 22.0, 26.8, 36.0])
    def test_two_seconds_behind_equally_fast_leader_are_safe(self, speed):
        trace = trace_of(vehicle(0.0, speed=speed, ticks=2), vehicle(2 * speed + 5.0, speed=speed, ticks=2))
        assert (RoadFrame(trace).safe_along(DISTANCES) < 2 * speed).all()


@pytest.mark.parametrize(("gap", "responsible"), [(4.0, "npc"), (14.0, "both")])
def test_stop_close_behind_standing_vehicle_has_a_reason(gap, responsible):
    """The ego creeps at 0.6 m/s and stops with 0.2 m/s^2, so nothing else is a reason to stop."""
    ego = driven(0.0, speed=0.6, brakes=[(1.0, 0.2, 0.0)], seconds=30.0)
    ahead, behind = driven(5.0 + 1.5 + gap, speed=0.0, seconds=30.0), driven(-100.0, speed=5.0, seconds=30.0)
    found = rss_rule(crash(ego, behind, ahead, side="rear", cell=Cell.REAR))
    assert found.responsibility == responsible


class TestCutIn:
    """A vehicle that moves into the other's way owes an answer; the other must still do what it can."""

    @pytest.mark.parametrize(
        "swerves", [[], [(3.2, OWN - 1.8, 0.7), (3.9, OWN - 1.0, 0.7)]], ids=["straight", "swerves"]
    )
    def test_swerve_of_a_motorcycle_in_the_lane_hides_no_cut_in(self, swerves):
        """It is 0.9 m wide, so its box and the ego's do not overlap across the lane for a while."""
        npc = driven(9.0, LEFT, brakes=[(3.0, 8.0, 0.0)], shifts=[(2.0, OWN, 1.2), *swerves])
        found = rss_rule(crash(driven(0.0, brakes=[(3.4, 7.0, 0.0)]), npc, sizes=[(5.0, 2.0), (2.2, 0.9)]))
        assert found.responsibility == "npc"
        assert found.sentences[0].startswith("NPC 0 crossed into lane 1 at 2.")

    @pytest.mark.parametrize("swerves", [[], [(2.8, 1.95, 0.4), (3.2, 2.06, 0.2)]], ids=["once", "twice"])
    @pytest.mark.parametrize("side", [1.0, -1.0], ids=["from the left", "from the right"])
    def test_swerve_over_the_other_line_hides_no_cut_in(self, side, swerves):
        """It is out of the ego's track for some ticks, and its slow return from over the line is no lane change."""
        plan = [(2.0, 2.06, 0.8), *swerves, (3.6, 1.8, 1.2)]
        shifts = [(start, OWN + side * place, duration) for start, place, duration in plan]
        npc = driven(8.0, OWN - 4.0 * side, brakes=[(3.0, 8.0, 0.0)], shifts=shifts)
        trace = crash(driven(0.0, brakes=[(3.4, 7.0, 0.0)]), npc)
        found = rss_rule(trace)
        assert (found.responsibility, found.fault) == ("npc", None)
        assert found.sentences[0].startswith("NPC 0 crossed into lane 1 at 2.1 s, 2.8 m ahead of the ego.")

    def test_cut_in_before_the_danger_does_not_excuse_the_ego(self):
        """The NPC drives next to the ego's track for some seconds, a little ahead, before it comes back slowly."""
        shifts = [(2.0, OWN + 3.0, 2.0), (8.0, OWN + 1.8, 6.0)]
        trace = crash(driven(0.0), driven(8.0, LEFT, shifts=shifts, brakes=[(13.0, 2.0, 0.0)]))
        found = rss_rule(trace)
        assert (found.responsibility, found.fault, found.tick) == ("ego", "leader-unanswered", 147)

    def test_the_gap_that_is_asked_is_that_of_the_page(self):
        """By its formula alone, from the boxes and speeds of the trace: of vehicles that brake while they come in."""
        page = (Path(__file__).parents[2] / "docs/explanation/verdicts.md").read_text(encoding="utf-8")
        formula = re.search(r"faster by \*dv\*: (.*), with \*v\* the mover's speed;", page)[1]
        formula = re.sub(r" m/s\^2| s\b", "", formula).replace("·", "*").replace("²", "**2")
        rng, asked = np.random.default_rng(6), 0
        for _ in range(40):
            brakes = [(float(rng.uniform(1.5, 3.5)), float(rng.uniform(1, 8)), 5.0)]
            speed, behind = rng.uniform(15, 25), -float(rng.uniform(25, 60))
            ego = driven(0.0, LEFT, speed=float(speed), brakes=brakes, shifts=[(2.0, OWN, 2.0)])
            trace = crash(ego, driven(behind, speed=float(speed + rng.uniform(4, 8))), side="rear", cell=Cell.REAR)
            said = re.search(r"a gap of ([\d.]+) m\.|the required ([\d.]+) m\.", rss_rule(trace).reason)
            if said is None:
                continue
            own, npc, (length, width) = *trace.states.swapaxes(0, 1)[:2], trace.sizes[0]
            edge = own[:, Y] + width / 2 * np.cos(own[:, HEADING]) + length / 2 * np.abs(np.sin(own[:, HEADING]))
            line, met = int(np.argmax(edge > OWN / 2)), int(np.argmax(edge > OWN - width / 2))
            v, u = (each[:, SPEED] * np.cos(each[:, HEADING]) for each in (own, npc))
            lowest = v[line : met + HZ + 1].min()
            rooms = [eval(formula, {"v": v, "dv": max(u - v, 0)}) for v, u in ((lowest, u[line]), (v[met], u[met]))]
            enough = own[line, X] - npc[line, X] - length >= rooms[0]
            assert (said[1] or said[2]) == f"{rooms[bool(said[1] and enough)]:.1f}", rss_rule(trace).reason
            asked += 1
        assert asked >= 20

    def test_driver_that_paused_on_the_line_moved_on(self):
        ego = driven(0.0, LEFT, shifts=[(1.0, 1.5, 0.5), (4.0, OWN, 2.0)])
        found = rss_rule(crash(ego, driven(-35.0, speed=24.0), side="rear", cell=Cell.REAR))
        assert found.sentences[0].startswith("The ego moved on into lane 1 at 4.")

    @pytest.mark.parametrize(("gap", "leader_brakes", "brakes_at", "responsible"), [
        (8.75, [(2.6, 2.0, 10.0)], 3.0, "npc"),
        (7.5, [], 3.1, "both"),
    ])  # fmt: skip
    def test_braking_hard_can_make_up_for_a_gain(self, gap, leader_brakes, brakes_at, responsible):
        """It sped up until it braked; by the impact, only the first is no further than the required response."""
        brakes = [(1.0, -1.0, 19.0 + brakes_at), (brakes_at, 8.0, 0.0)]
        found = rss_rule(cut_in(gap, slower=4.0, brakes=leader_brakes, ego_brakes=brakes))
        assert found.responsibility == responsible
        assert ("The ego sped up to" in found.reason) == (responsible == "both")

    @pytest.mark.parametrize(("gap", "slower", "brakes_at", "responsible"), [
        (28.0, 0.0, 2.8, "both"),
        (28.0, 0.0, 5.0, "ego"),
        (20.0, -2.0, 3.2, "both"),
    ])  # fmt: skip
    def test_npc_braking_while_cutting_in_shares_the_responsibility(self, gap, slower, brakes_at, responsible):
        """At 20 m/s, 20 m are enough at the moment. The last NPC is too close to the ego only by its speed then."""
        found = rss_rule(cut_in(gap, slower=slower, brakes=[(brakes_at, 6.0 if slower else 8.0, 2.0)]))
        assert found.responsibility == responsible

    @pytest.mark.parametrize(("slower", "responsible"), [(8.0, "both"), (10.0, "npc")])
    def test_easing_counts_if_kept_braking_was_enough(self, slower, responsible):
        """The ego brakes with 2 m/s^2 and eases when the NPC moves in 8 m ahead; 6 m/s^2 after 0.4 s avoid both."""
        found = rss_rule(cut_in(8.0, slower=slower, ego_brakes=[(1.5, 2.0, 18.2)]))
        assert found.responsibility == responsible
        assert ("should have kept braking" in found.reason) == (responsible == "both")


class TestASecondChance:
    """A driver that has mastered an unavoidable cut-in must still not run into the other afterwards."""

    @staticmethod
    def behind_the_ego(*brakes):
        """Return the verdict if an NPC comes 8 m/s faster; the ego crosses the line 10 m ahead of it at tick 36."""
        ego, npc = driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(-34.2, speed=28.0, brakes=brakes)
        return rss_rule(crash(ego, npc, side="rear", cell=Cell.REAR))

    @pytest.mark.parametrize(("ticks", "responsible"), [(10, "ego"), (11, "both")])
    def test_gap_lost_within_a_second_does_not_count(self, ticks, responsible):
        found = self.behind_the_ego((40 / HZ, 8.0, 28.0 - 8.0 * ticks / HZ))
        assert (found.responsibility, found.fault, found.tick) == (responsible, "entered-lane", 36)

    @pytest.mark.parametrize(("ticks", "responsible"), [(5, "ego"), (6, "both")])
    def test_brakes_count_as_released_after_six_idle_ticks(self, ticks, responsible):
        found = self.behind_the_ego((43 / HZ, 8.0, 22.0), ((55 + ticks) / HZ, 0.6, 0.0))
        assert (found.responsibility, found.fault) == (responsible, "entered-lane")

    @pytest.mark.parametrize("rate", [1.5, 8.0])
    @pytest.mark.parametrize(("lost", "responsible"), [(0.25, "both"), (0.19, "ego")])
    def test_twitch_of_an_npc_is_no_braking(self, rate, lost, responsible):
        trace = lane_change(12.0, faster=5.0, npc_brakes=[(3.4, rate, 25.0 - lost)])
        assert rss_rule(trace).responsibility == responsible

    @pytest.mark.parametrize(("lost", "fault"), [(0.25, "leader-unanswered"), (0.19, "cut-in-unanswered")])
    def test_ego_that_twitched_released_no_brakes(self, lost, fault):
        """It still shares the blame, because it did not answer the cut-in."""
        trace = cut_in(25.0, slower=10.0, ego_brakes=[(3.5, 1.5, 20.0 - lost)])
        found = rss_rule(trace)
        assert (found.responsibility, found.fault) == ("both", fault)

    def test_twitch_does_not_make_a_released_brake_a_held_one(self):
        trace = lane_change(10.0, faster=8.0, npc_brakes=[(2.9, 8.0, 22.0), (3.9, 1.5, 21.9)])
        found = rss_rule(trace)
        assert "NPC 0 should have kept braking but released the brakes at 3.7 s." in found.sentences
        assert found.responsibility == "both"


def test_swaying_slightly_in_lane_is_no_lane_change():
    ego = driven(0.0, shifts=[(1.0, 3.8, 2.0)])
    found = rss_rule(crash(ego, driven(1.0, LEFT, shifts=[(1.0, OWN, 2.0)]), side="left", cell=Cell.LEFT))
    assert found.responsibility == "npc"


def test_without_a_collision_nobody_is_responsible():
    trace = trace_of(vehicle(0.0, ticks=10), vehicle(50.0, ticks=10))
    found = rss_rule(trace)
    assert (found.responsibility, found.tick, found.time) == ("none", None, None)
    assert position_rule(trace) == "none"
    assert found.reason == "There was no collision."


def test_equal_verdicts_are_equal_in_any_process():
    found = rss_rule(crash(driven(0.0, speed=25.0), driven(60.0, speed=15.0)))
    (first, *others) = found.facts
    same, other = (replace(found, facts=(first._replace(time_s=first.time_s + s), *others)) for s in (1e-9, 0.1))
    assert found == same == pickle.loads(pickle.dumps(found))
    assert hash(found) == hash(same)
    assert found != other
    assert f"reason={found.reason!r}" in repr(found)


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
    ahead=st.floats(-40, 40),
    lane=st.sampled_from([LEFT, OWN, 8.0]),
    speeds=st.tuples(st.floats(1, 30), st.floats(1, 30)),
    braking=st.floats(0, 9.8),
    begin=st.floats(0.5, 3),
    seconds=st.floats(1, 4),
    side=st.sampled_from(["front", "rear", "left", "right"]),
)
def test_left_and_right_make_no_difference(ahead, lane, speeds, braking, begin, seconds, side):
    ego = driven(0.0, speed=speeds[0], brakes=[(begin, braking, 0.5)], seconds=8.0)
    npc = driven(ahead, lane, speed=speeds[1], shifts=[(begin, OWN, seconds)], seconds=8.0)
    trace = trace_of(ego, npc, outcome=Outcome.COLLISION, collision=collision_at(120, side=side))
    found, swapped = rss_rule(trace), rss_rule(mirrored(trace))
    lanes = [fact.lane for fact in swapped.facts]
    facts = [
        fact._replace(lane=None if lane is None else 3 - lane) for fact, lane in zip(swapped.facts, lanes, strict=True)
    ]
    assert replace(swapped, facts=tuple(facts)) == found


@given(seed=st.integers(0, 10_000), ticks=st.integers(1, 60), vehicles=st.integers(2, 4))
def test_any_collision_gets_verdict_with_reason_and_time(seed, ticks, vehicles):
    states = random_states(np.random.default_rng(seed), ticks + 1, vehicles)
    trace = trace_of(*states.swapaxes(0, 1), outcome=Outcome.COLLISION, collision=collision_at(ticks, npc=vehicles - 2))
    found = rss_rule(trace)
    assert found.responsibility in ("ego", "npc", "both")
    assert 0 <= found.tick <= ticks
    assert found.time == found.tick / 15
    assert 1 <= len(found.sentences) <= 10
    assert found.reason.isascii()


def test_every_fact_is_one_uncut_sentence():
    large = {name: 19.9 if "m_per_s" in name else 99.9 for name in Fact._fields if "_" in name and name != "due_s"}
    zone = Zone(way="a>b", kind="crossing", origin="left", ego=(0.0, 1.0), npc=(0.0, 1.0), priority="npc")
    far = {What.CAME_TOO_CLOSE: {"gap_m": -99.9, "asked_m": 88.8}, What.ENTERED: {"zone": zone, "later_s": 111.1}}
    simple = [what for what in What if what not in (*ANSWERS, What.ANSWERED)]
    facts = [Fact(what, 9, other=0, lane=9, **large | far.get(what, {"asked_m": 0.0})) for what in simple]
    told = [*sentences(facts)]
    told += [responsible_sentence(who, 9) for who in ("ego", "npc", "both", "none")] + [avoidance_sentence(99.9, 6.0)]
    assert len({*told}) == len(simple) + 5
    assert not any({*text} & {*"{};"} or "because" in text for text in told)
    assert all(text[0].isupper() and text.endswith(".") and len(text) <= LINE_LENGTH - 2 for text in told)


@table("number", range(8))
def test_every_answer_is_in_uncut_lines_of_sentences(number):
    for first, what in itertools.product(range(len(Doing)), ANSWERS):
        doings = [list(Doing)[(first + index) % len(Doing)] for index in range(number)]
        phases = tuple(Phase(doing, 998.8, 999.9, 99.9, 88.8, 19.9) for doing in doings)
        told = sentences((Fact(what, 9, 999.9, due_s=999.9, later_s=999.9, braking_m_per_s2=9.9, phases=phases),))
        assert all(text[0].isupper() and text.endswith(".") and len(text) <= LINE_LENGTH - 2 for text in told)
        assert " ".join(told).count("19.9 m/s^2") == doings.count(Doing.BRAKED)


def test_a_gap_is_never_as_large_as_the_safe_one():
    close = Fact(What.CAME_TOO_CLOSE, 0, 1.0, other=1, gap_m=-1.68, asked_m=1.71)
    assert "only 1.68 m behind NPC 0 at 1.0 s (safe: 1.71 m)" in sentences((close,))[0]
    assert "only 1.6 m behind NPC 0 at 1.0 s (safe: 1.7 m)" in sentences((close._replace(gap_m=-1.6),))[0]


@table("angle", [0.7, np.pi / 2, np.pi])
def test_the_direction_of_the_road_makes_no_difference(angle):
    trace = crash(driven(0.0), driven(8.0, LEFT, brakes=[(3.5, 8.0, 0.0)], shifts=[(2.0, OWN, 2.0)]))
    states = trace.states.copy()
    x, y = trace.states[..., 0], trace.states[..., 1]
    states[..., 0], states[..., 1] = x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)
    states[..., HEADING] += angle
    turned = rss_rule(replace(trace, states=states, lanes=straight_lanes(heading=angle)))
    assert (turned.responsibility, turned.tick) == (rss_rule(trace).responsibility, rss_rule(trace).tick)


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


def test_braking_counts_as_hard_once_it_has_lasted():
    trace = trace_of(driven(0.0, brakes=[(2.0, 9.0, 0.0)]), driven(100.0))
    begin, enough = 2 * HZ, 2 * HZ + 6  # 0.4 s
    assert hard_braking(trace, 0, 0, enough - 1) is None
    assert hard_braking(trace, 0, 0, enough) == Stop(begin=begin, end=enough)


def test_the_collision_of_a_run_is_judged_once(monkeypatch):
    trace = crash(driven(0.0), driven(-60.0, speed=26.0), side="rear", cell=Cell.REAR)
    judged, rule = [], Conflict._in_one_lane
    monkeypatch.setattr(Conflict, "_in_one_lane", lambda conflict: judged.append(conflict) or rule(conflict))
    run = Run(trace)
    assert run.sentences[-1] == "NPC 0 is responsible."
    assert (run.responsibility, run.attribution.blames_ego) == ("npc", False)
    assert len(judged) == 1
