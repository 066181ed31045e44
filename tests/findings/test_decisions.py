"""What decisions rest on, and the last decision that could have avoided a failure."""

import re
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.findings.decisions import (
    Moment,
    deciding,
    deed_of,
    differ,
    placed,
    seen_of,
    sentences_of,
    vehicle_of,
)
from pytest_pafot.findings.finding import Bounded, Expect
from pytest_pafot.searches.refine.moment import _moment_of, _nudged, text_of
from pytest_pafot.world.driving.policy import Aside, Question, beside, changed, without
from pytest_pafot.world.engines.simulation import OwnUnits
from pytest_pafot.world.kernel.action import checked_si_action
from tests.helpers.situations import lane_change
from tests.helpers.tables import table

KEEPS, BRAKES = (0.0, 0.0), (-4.0, 0.0)
SI = partial(checked_si_action, lanes=9)
SCENARIO = pafot.Scenario(
    npcs=[[pafot.PositionInstruction(2, 5.0)], [pafot.PositionInstruction(6, 20.0)]],
    gene_seconds=10.0,
)
WORLD = pafot.Highway()


class Listing:
    """Brakes for the nearest vehicle ahead that is nearer than 25 m, and lists which vehicles it saw."""

    seen: ClassVar[set] = set()

    def __call__(self, observation):
        self.seen.update(observation.ids)
        ahead = [
            other.x - observation.ego.x
            for other in observation.others
            if other.x > observation.ego.x
        ]
        return (-3.0 if min(ahead, default=99.0) < 25.0 else 0.0), 0.0


def asked(factory, trace, npc=None, question=None, world=WORLD, check=SI):
    aside = Aside()
    ads = beside(factory, trace.actions, check, aside, question)
    again = world.rollout(trace.scenario, ads if npc is None else without(ads, npc))
    assert np.array_equal(again.states, trace.states)  # the run is driven by the recorded actions
    return aside


@pytest.mark.parametrize(("action", "other", "expected"), [
    (KEEPS, (0.19, 0.019), False),
    (KEEPS, BRAKES, True),
    (3, 1, True),
    (KEEPS, None, True),
    (np.array([0.5]), np.array([0.54]), False),
    (np.array([0.5]), np.array([0.6]), True),
    (pafot.LaneCommand(lane=1, speed=2.0), pafot.LaneCommand(lane=1, speed=2.19), False),
    (pafot.LaneCommand(lane=1, speed=2.0), pafot.LaneCommand(lane=0, speed=2.0), True),
])  # fmt: skip
def test_decisions_that_hardly_differ_are_the_same(action, other, expected):
    assert differ(action, other) is differ(other, action) is expected


@dataclass
class Pedals:
    steering: float
    throttle: float


class Wish:
    """An object without a text of its own, as actions of simulators may be."""

    def __init__(self, lane, pedals):
        self.lane, self.pedals = lane, pedals


@table(("action", "text", "alike", "other"), {
    "a tuple": (OwnUnits((0.25, -1.0)), "(0.25, -1)", OwnUnits((0.26, -1.0)), OwnUnits((0.35, -1.0))),
    "a list": ([0.1, "left", None], "[0.1, 'left', None]", [0.11, "left", None], [0.1, "right", None]),
    "floats of 32 bits": (np.array([0.1, 0.7], np.float32), "[0.1, 0.7]", np.array([0.1, 0.71], np.float32),
                          np.array([0.1], np.float32)),
    "a mapping": ({"gas": 0.123456}, "{'gas': 0.123}", {"gas": 0.12}, {"brake": 0.123456}),
    "a dataclass": (Pedals(0.3, 0.5), "Pedals(steering=0.3, throttle=0.5)", Pedals(0.3, 0.52), Pedals(0.3, 0.9)),
    "an object": (Wish("left", [0.5]), "Wish(lane='left', pedals=[0.5])", Wish("left", [0.51]), Wish("right", [0.5])),
    "a text": ("brake", "'brake'", "brake", "go"),
}.values())  # fmt: skip
def test_actions_of_a_simulator_are_told_and_compared_by_their_parts(action, text, alike, other):
    assert text_of(action) == text
    assert not differ(action, alike)
    assert differ(action, other)


@pytest.mark.parametrize(("action", "other", "text"), [
    ((0.0, 0.0), None, "acceleration 0.0 m/s^2"),
    ((26.68, 0.9), None, "acceleration 26.7 m/s^2, limited to 6.0, steering 0.90 rad, limited to 0.79"),
    (pafot.LaneCommand(lane=0, acceleration=-12.0), None, "lane 0, acceleration -12.0 m/s^2, limited to -9.8"),
    (3, 1, "3"),
    (pafot.LaneCommand(lane=0, speed=5.0), pafot.LaneCommand(lane=1, acceleration=-4.0), "lane 0, speed 5.0 m/s"),
    (pafot.LaneCommand(lane=0, speed=5.0), None, "lane 0, speed 5.0 m/s"),
    (pafot.LaneCommand(lane=0, speed=5.0, lateral_jerk=2.0), None, "lane 0, speed 5.0 m/s, lateral jerk 2.0 m/s^3"),
    (pafot.LaneCommand(lane=0, speed=5.0), pafot.LaneCommand(lane=0, speed=5.0, lateral_jerk=2.0),
     "lateral jerk 3.0 m/s^3"),
    (np.array([0.5]), np.array([0.1]), "[0.5]"),
    (None, KEEPS, "no decision"),
])  # fmt: skip
def test_each_kind_of_action_has_its_words(action, other, text):
    assert text_of(action, other) == text


CAR = (0.0, 5.0, 2.0)


@pytest.mark.parametrize(("offset", "heading", "place"), [
    ((5.2, 0.0), 0.0, "0.2 m ahead, equally fast"),
    ((-9.4, 4.0), 0.0, "4.4 m behind, 4.0 m to the right, equally fast"),
    ((3.0, -4.0), 0.0, "next to the ego, 4.0 m to the left, equally fast"),
    ((10.0, 0.3), np.pi / 2, "6.5 m ahead, 0.3 m to the right, equally fast"),
])  # fmt: skip
def test_a_place_is_told_with_the_gap_between_the_boxes_along_the_road(offset, heading, place):
    assert placed(*offset, 0.0, CAR, (heading, 5.0, 2.0)) == place


def test_a_verdict_and_a_moment_tell_the_same_gap():
    run = pafot.Run(lane_change(10.0, faster=8.0, speed=20.0))
    number = run.trace.decision_ticks.index(run.attribution.tick)
    gap = seen_of(run.trace, 0, number).partition(" m behind")[0]
    assert f", {gap} m ahead of NPC 0." in run.attribution.sentences[0]


def test_a_moment_is_told_in_one_line():
    moment = Moment(
        time=4.9, npc=0, seen=placed(17.3, -0.2, -6.1, CAR, CAR), action="acceleration 0.0 m/s^2"
    )
    saw = "NPC 0 (12.3 m ahead, 0.2 m to the left, 6.1 m/s slower)"
    start = f"At 4.9 s, the policy saw {saw} and chose acceleration 0.0 m/s^2"
    assert str(moment) == moment.brief == f"{start}."
    probed = replace(moment, hidden="", otherwise="2 m nearer: acceleration -4.0 m/s^2")
    other = "with NPC 0 2 m nearer: acceleration -4.0 m/s^2"
    assert probed.brief == f"{start}; {other}."
    hidden = "with NPC 0 hidden, it chose the same"
    assert sorted(str(probed).removesuffix(".").split("; ")) == sorted([start, hidden, other])
    none = replace(moment, otherwise="")
    assert (str(none), none.brief) == (
        f"{start}; none of the changes tried for NPC 0 had an effect.",
        f"{start}.",
    )
    other = Moment(time=3.0, npc=None, action="1", reference="0")
    assert str(other) == other.brief
    assert re.fullmatch(
        r"At 3\.0 s, .* the policy chose 1, and the reference chose 0\.", other.brief
    )


def test_conditions_are_listed_below_whom_they_are_about():
    groups = (
        ("NPC 0", ("line 1", "line 2")),
        ("no NPC", ("line 3",)),
        ("NPC 1", ("line 1", "line 4")),
    )
    moment = Moment(time=4.9, npc=0, conditions=groups)
    whole = [
        "NPC 0:",
        "  line 1",
        "  line 2",
        "no NPC:",
        "  line 3",
        "NPC 1:",
        "  line 1",
        "  line 4",
    ]
    assert moment.condition_lines() == whole
    assert replace(moment, conditions=(("", ("line 1", "line 2")),)).condition_lines() == [
        "line 1",
        "line 2",
    ]


def test_a_planner_sees_a_vehicle_that_crosses_where_it_is():
    """Its ``crossing`` has it, and not its ``others``."""
    world = pafot.World("intersection-v0", planner_hz=5)
    scenario = pafot.Scenario(
        npcs=[[pafot.CrossingInstruction("o1>o3", 0.5, 8.0)]], ego_lane=0, ego_speed=9.0
    )

    def factory():
        return lambda seen: KEEPS

    trace = world.rollout(scenario, factory)
    whole, without_it = (asked(factory, trace, npc, Question(number=5), world) for npc in (None, 0))
    (there,) = whole.at.crossing
    assert whole.at.ids == without_it.at.crossing == ()
    moment = returned(_moment_of(trace, 0, 5, whole, without_it, asking(lambda _: None)))
    ego, other = trace.states[trace.decision_ticks[5], :2]
    assert moment.seen == seen_of(trace, 0, 5)
    assert f"{abs(other[3] - ego[3]):.1f} m/s " in moment.seen
    (nudged,) = _nudged(whole.at, 0).crossing
    moved = {
        name: round(a - b, 6)
        for name, a, b in zip(there._fields, nudged, there, strict=True)
        if a != b
    }
    assert moved == dict.fromkeys(["distance", "ego_distance", "ahead", "right", "speed"], 0.01)
    assert _nudged(whole.at, 1) == whole.at


def returned(steps):
    """Return the result of a generator of which nothing else is of interest."""
    try:
        while True:
            next(steps)
    except StopIteration as done:
        return done.value


def asking(ask):
    """Return what asks a policy by a function of a question."""

    def asks(npc, question):
        return ask(question)
        yield

    return asks


@pytest.mark.parametrize(
    "factory", [Listing, pafot.Perception(Listing, latency=0.2)], ids=["perfect", "late"]
)
def test_a_policy_decides_beside_its_run_with_a_vehicle_hidden(factory):
    trace = WORLD.rollout(SCENARIO, factory)
    whole = asked(factory, trace)
    assert whole.answers == list(trace.actions)
    Listing.seen.clear()
    hidden = asked(factory, trace, npc=0)
    assert Listing.seen == {1}
    assert any(map(differ, whole.answers, hidden.answers))
    other = asked(factory, trace, npc=1)  # it is behind
    assert not any(map(differ, whole.answers, other.answers))


def test_hiding_a_vehicle_changes_no_other_vehicle_of_an_imperfect_sight():
    factory = pafot.Perception(
        lambda: lambda seen: shown.append(seen) or KEEPS, noise={"position": 1.0}, dropout=0.2
    )
    scenario = replace(SCENARIO, npcs=(*SCENARIO.npcs, [pafot.PositionInstruction(8, 22.0)]))
    shown = []
    trace = WORLD.rollout(scenario, factory)
    whole = shown[:]
    for npc in range(3):
        shown.clear()
        asked(factory, trace, npc=npc)
        for there, here in zip(whole, shown, strict=True):
            assert here == (changed(there, npc, None) if npc in there.ids else there)


@pytest.mark.parametrize("wrappers", [None, []], ids=["kernel", "env.step"])
def test_an_environments_observation_is_without_the_vehicle(wrappers):
    world, seen = pafot.World("highway-v0", wrappers=wrappers), []

    def make():
        return lambda observation: seen.append(int(observation[1:, 0].sum())) or 1

    trace = world.rollout(SCENARIO, make)
    assert seen[0] == 1  # the other one is behind
    seen.clear()
    aside = asked(make, trace, npc=0, world=world, check=int, question=Question(number=0))
    assert set(seen) == {0}
    assert aside.at[1, 0] == 0


def test_a_policy_that_raises_without_a_vehicle_has_no_decision_there():
    def make():
        return lambda observation: (-1.0, {2: 0.0}[len(observation.others)])

    trace = WORLD.rollout(SCENARIO, make)
    assert set(asked(make, trace, npc=0).answers) == {None}


def test_the_smallest_change_that_flips_an_answer_is_found():
    trace = WORLD.rollout(SCENARIO, Listing)
    number = trace.actions.index((-3.0, 0.0)) - 1
    moment = moment_at(number, Listing, trace)
    assert moment.time == trace.decision_ticks[number] / trace.physics_hz
    assert moment.action == "acceleration 0.0 m/s^2"
    assert moment.hidden == ""
    assert moment.otherwise.endswith("m nearer: acceleration -3.0 m/s^2")
    gap = float(moment.seen.partition(" m ahead")[0])
    assert gap >= 20.0 >= gap - float(moment.otherwise.partition(" m nearer")[0])


@pytest.mark.parametrize(
    ("far", "near", "is_told"),
    [(0.0, -3.0, True), (0.0, -0.9, False), (20.0, 9.0, False), (9.0, 5.5, False)],
)
def test_a_change_is_told_only_if_a_car_drives_otherwise_by_one_unit(far, near, is_told):
    def ads(seen):
        gap = min(
            (each.x - seen.ego.x for each in seen.others if each.x > seen.ego.x), default=99.0
        )
        return pafot.LaneCommand(lane=1, acceleration=near if gap < 25.0 else far)

    trace = WORLD.rollout(
        SCENARIO, lambda: lambda seen: pafot.LaneCommand(lane=1, acceleration=far)
    )
    number = 5
    moment = moment_at(number, lambda: ads, trace)
    assert bool(moment.otherwise) is is_told


def test_a_changed_observation_differs_in_that_vehicle_alone():
    seen = []
    WORLD.rollout(SCENARIO, lambda: lambda observation: seen.append(observation) or KEEPS)
    one = seen[3]
    moved = changed(one, 1, (1.0, -4.0, 2.0))
    assert moved.others[0] == one.others[0]
    assert (moved.others[1].x, moved.others[1].speed) == (
        one.others[1].x + 1.0,
        one.others[1].speed + 2.0,
    )
    assert moved.others[1].lane == one.others[1].lane - 1
    gone = changed(one, 0, None)
    assert (gone.ids, gone.others, gone.ego) == ((1,), one.others[1:], one.ego)
    assert gone.lateral_velocities == (one.lateral_velocities[0], one.lateral_velocities[2])


def moment_at(number, factory, trace):
    whole, without_it = (
        asked(factory, trace, npc=npc, question=Question(number=number)) for npc in (None, 0)
    )

    ask = asking(lambda question: asked(factory, trace, question=question))
    return returned(_moment_of(trace, 0, number, whole, without_it, ask))


def on_the_last_but_one(seen, observation):
    """Brake if there was a vehicle ahead in the last observation but one, and note this one."""
    seen.append(any(other.x > observation.ego.x for other in observation.others))
    return (-3.0 if len(seen) > 2 and seen[-3] else 0.0), 0.0


def with_a_closure():
    seen = []
    return lambda observation: on_the_last_but_one(seen, observation)


class Late:
    def __init__(self):
        self.seen = []

    def act(self, observation):
        return on_the_last_but_one(self.seen, observation)


def test_a_policy_that_keeps_state_is_asked_otherwise_in_the_state_of_the_run():
    """What it sees at one decision changes nothing before the next but one, wherever it keeps its state."""
    trace = WORLD.rollout(SCENARIO, with_a_closure)
    for factory in (with_a_closure, lambda: Late().act):
        moment = moment_at(8, factory, trace)
        assert (moment.action, moment.hidden, moment.otherwise) == (
            "acceleration -3.0 m/s^2",
            "",
            "",
        )


class Counting:
    """Brakes from its 40th call on, counted over all of its objects."""

    calls: ClassVar[list] = []

    def __call__(self, observation):
        self.calls.append(observation.time)
        return (-3.0 if len(self.calls) > 40 else 0.0), 0.0


SHARED = Late()


@pytest.mark.parametrize(("factory", "clear"), [
    (Counting, Counting.calls.clear), (lambda: SHARED.act, lambda: setattr(SHARED, "seen", [])),
], ids=["in the class", "in a shared object"])  # fmt: skip
def test_a_policy_that_decides_otherwise_before_the_moment_is_not_asked(factory, clear):
    number, asides = 8, []
    clear()
    trace = WORLD.rollout(SCENARIO, factory)
    for _ in range(2):
        clear()
        asides.append(asked(factory, trace, question=Question(number=number)))
    moment = returned(
        _moment_of(trace, 0, number, *asides, asking(lambda _: asked(factory, trace)))
    )
    assert moment.action
    assert (moment.hidden, moment.otherwise) == (None, None)


def crash(ads):
    scenario = pafot.Scenario(
        npcs=[[pafot.PositionInstruction(2, 0.0)]], gene_seconds=20.0, ego_speed=22
    )
    trace = WORLD.rollout(scenario, ads)
    return pafot.Run(trace)


def expecting(run, **options):
    return Expect(
        failure="AssertionError", outcome=run.outcome, time=run.event_time, npc=0, **options
    )


@pytest.mark.parametrize(("instead", "asked"), [(None, 5), ("other", 3)])
def test_a_policy_is_asked_no_more_than_a_question_needs(instead, asked):
    seen = []

    class Ads:
        def __call__(self, observation):
            seen.append(observation)
            return 0.0, 0.0

    aside = Aside()
    drive = beside(
        Ads, [(1.0, 0.0)] * 5, lambda action: action, aside, Question(number=2, instead=instead)
    )()
    assert [drive(number) for number in range(5)] == [(1.0, 0.0)] * 5
    assert len(seen) == asked
    assert aside.action_at(2) == (0.0, 0.0)
    assert (instead in seen) == (instead is not None)
    assert aside.at == 2


def test_the_deciding_moment_of_a_missing_response_is_the_last_that_avoids_it():
    run = crash(lambda: lambda seen: KEEPS)
    hz = run.trace.ads_hz
    # by the rules, when danger began
    assert deciding(run, expecting(run)) == int(run.attribution.time * hz + 1e-6)
    assert (
        told_of(run)
        == f"The ego drove at 22.0 m/s and did not brake from {run.attribution.time:.1f} s on."
    )
    assert deciding(run, expecting(run, takeover=1.25)) == int(
        (run.collision.time - 1.25) * hz + 1e-6
    )
    # none avoids it
    assert deciding(run, expecting(run, takeover=0.0)) == deciding(run, expecting(run))
    assert vehicle_of(run, expecting(run)) == 0


def told_of(run):
    """Return the sentence that says what the ego did wrong."""
    return deed_of(run, sentences_of(run, expecting(run)))


def test_an_ego_that_is_not_at_fault_did_nothing_wrong():
    scenario = pafot.Scenario(
        npcs=[[pafot.PositionInstruction(7, 22.0), pafot.PositionInstruction(6, 26.0)]],
        gene_seconds=6.0,
        ego_speed=20,
    )
    run = pafot.Run(WORLD.rollout(scenario, lambda: lambda seen: KEEPS))
    assert run.responsibility == "npc"
    assert told_of(run) == ""


def test_an_ego_that_brakes_too_softly_has_the_last_decision_that_avoids_it_too():
    run = crash(lambda: lambda seen: (-2.0 if seen.time >= 3.0 else 0.0, 0.0))
    number = deciding(run, expecting(run, takeover=run.collision.time - 4.0))
    assert number / run.trace.ads_hz == 4.0
    assert text_of(run.trace.actions[number]) == "acceleration -2.0 m/s^2"


def to_lanes(*plan):
    """Return a planner that answers lanes, each from a time on."""
    return lambda: lambda seen: pafot.LaneCommand(lane=lane_at(seen.time, plan), acceleration=0.0)


def steering(most):
    """Return what makes a planner that steers to lanes, each from a time on, with at most an angle."""

    def decided(seen, plan):
        course = np.clip(
            0.04 * (seen.lane_centres[lane_at(seen.time, plan)] - seen.ego.y), -0.08, 0.08
        )
        return 0.0, float(np.clip(0.5 * (course - seen.ego.heading), -most, most))

    return lambda *plan: lambda: lambda seen: decided(seen, plan)


DRIFTS = steering(0.002)


def lane_at(time, plan):
    return [lane for since, lane in plan if time > since - 1e-6][-1]


@pytest.mark.parametrize(("planner", "plan", "moment"), [
    (to_lanes, [(0.0, 1), (2.0, 0)], 2.0),
    (to_lanes, [(0.0, 1), (2.0, 2), (3.0, 0)], 3.0),
    (to_lanes, [(0.0, 1), (2.0, 2), (10.0, 0)], 10.0),
    (DRIFTS, [(0.0, 1), (2.0, 0)], 2.0),
    (steering(0.03), [(0.0, 1), (2.0, 2), (3.0, 0)], 3.0),
    (steering(0.03), [(0.0, 1), (2.0, 2), (15.0, 0)], 15.0),
])  # fmt: skip
def test_the_moment_of_a_lane_change_is_the_decision_that_began_its_last_motion(
    planner, plan, moment
):
    """An opposite motion before, turned back or completed, is not part of it."""
    scenario = pafot.Scenario(
        npcs=[[pafot.PositionInstruction(8, 9.0)]], gene_seconds=30.0, ego_speed=9
    )
    run = pafot.Run(WORLD.rollout(scenario, planner(*plan)))
    assert run.attribution.fault == "entered-lane"
    assert run.trace.decision_ticks[deciding(run, expecting(run))] / run.trace.physics_hz == moment
    crossed = run.attribution.time
    deed = "drifted from {}" if planner is DRIFTS else "began to change lanes at {}"
    assert crossed > moment
    moved = f"moved (into lane 0|sideways) at {crossed:.1f} s[, ]"
    assert re.match(f"The ego {moved}", run.sentences[0])
    assert re.match(f"The ego {deed.format(f'{moment:.1f} s')} and {moved}", told_of(run))


@pytest.mark.parametrize(("planner", "plan", "moment", "moved"), [
    (to_lanes, [(0.0, 1), (6.0, 0)], 6.0, "moved into the lane of NPC 0 at {}, next to NPC 0."),
    (steering(0.03), [(0.0, 1), (6.0, 0)], 6.0, "moved sideways at {} into NPC 0, which was next to it."),
    # Its first steering only ends the motion to the other side.
    (steering(0.06), [(0.0, 2), (8.6, 0)], 8.8, "moved into the lane of NPC 0 at {}, next to NPC 0."),
])  # fmt: skip
def test_on_a_bend_too_it_is_the_decision_that_began_the_motion_and_not_the_last_before_the_line(
    planner, plan, moment, moved
):
    world = pafot.World("racetrack-oval-v1", duration=30.0, planner_hz=5)
    scenario = pafot.Scenario(
        npcs=[[pafot.PositionInstruction(8, 9.0)]], gene_seconds=30.0, ego_lane=1, ego_speed=9
    )
    run = pafot.Run(world.rollout(scenario, planner(*plan)))
    assert run.attribution.fault == "entered-lane"
    assert run.attribution.time > moment + 1.0
    assert not run.trace.road.is_straight
    moved = moved.format(f"{run.attribution.time:.1f} s")
    assert told_of(run) == f"The ego began to change lanes at {moment:.1f} s and {moved}"


def test_a_failed_check_has_the_last_decision_up_to_it():
    run = pafot.Run(WORLD.rollout(SCENARIO, Listing))
    expect = Expect(
        failure="CheckFailed",
        outcome=run.outcome,
        time=2.05,
        check=Bounded(value=1.0, unit="m", at_most=0.5),
    )
    assert deciding(run, expect) == int(2.05 * run.trace.ads_hz)
    assert vehicle_of(run, expect) in (0, 1)
