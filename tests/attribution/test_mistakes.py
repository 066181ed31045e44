"""The ego's mistake follows from the other's place in time, and the manoeuvre before an event from changed lanes."""

from itertools import chain
from typing import get_args

import numpy as np

from pytest_pafot import Highway, PositionInstruction, Run, Scenario
from pytest_pafot.attribution.responsibility import (
    BY_FAULT,
    NEXT_TO,
    Attribution,
    Fault,
    manoeuvre_before,
    mistake,
    rss_rule,
)  # fmt: skip
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.trace import Outcome
from tests.helpers.situations import LEFT, OWN, SITUATIONS
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH, trace_of, vehicle

TRACES = {each.name: each.trace for each in chain(*SITUATIONS.values())}
MADE = {
    "kept-no-distance": ["slow-leader-ignored", "ramp-npc-merges-35-m-ahead", "ego-enters-behind-a-slower-one",
                         "ego-overtakes-into-oncoming-traffic"],
    "moved-into-side": ["ego-swipes", "ego-drifts", "bend-ego-runs-wide", "both-enter-side-by-side"],
    "moved-in-front": ["lane-change-1-m-ahead", "lane-change-28-m-ahead"],
}  # fmt: skip


@table(("made", "name"), [(made, name) for made, names in MADE.items() for name in names])
def test_each_situation_shows_its_mistake(made, name):
    trace = TRACES[name]()
    assert mistake(trace, rss_rule(trace)) == made


def test_mistake_exists_exactly_where_ego_has_fault():
    for make in TRACES.values():
        trace = make()
        verdict = rss_rule(trace)
        assert (mistake(trace, verdict) is None) == (verdict.fault is None)
        assert mistake(trace, verdict) == BY_FAULT.get(verdict.fault, mistake(trace, verdict))


def test_every_fault_except_those_by_position_names_mistake():
    assert {*BY_FAULT, "entered-lane", "did-not-give-way"} == set(get_args(Fault))


@table(("gap", "expected"), [
    (NEXT_TO + 0.1, "kept-no-distance"),
    (NEXT_TO - 0.1, "moved-into-side"),
    (-LENGTH, "moved-into-side"),
    (-2 * LENGTH + 0.1, "moved-into-side"),
    (-2 * LENGTH - 0.1, "moved-in-front"),
])  # fmt: skip
def test_npc_within_two_metres_ahead_counts_as_alongside(gap, expected):
    ego, npc = vehicle(0.0, LEFT, ticks=1), vehicle(LENGTH + gap, OWN, ticks=1)
    verdict = Attribution(responsibility="ego", tick=0, time=0.0, fault="entered-lane")
    assert mistake(trace_of(ego, npc, outcome=Outcome.COLLISION), verdict) == expected


STILL = vehicle(0.0, 4.0, speed=20.0, ticks=150)


@table(("displacement", "until", "expected"), [
    (4.0, 150, "lane-change"), (4.0, 100, "lane-change"), (4.0, 80, "lane-keeping"),
    (0.9, 150, "lane-keeping"), (-0.9, 150, "lane-keeping"), (1.1, 150, "lane-change"),
])  # fmt: skip
def test_lane_change_counts_for_less_than_four_seconds_and_swaying_is_none(
    displacement, until, expected
):
    """The vehicle moves to the right at an even pace for two seconds and then keeps its lane."""
    states = vehicle(30.0, 4.0, speed=20.0, ticks=150)
    states[:, 1] += displacement * np.clip((np.arange(151) - until + 30) / 30, 0, 1)
    trace = trace_of(STILL, states)
    assert manoeuvre_before(trace, 1, 150) == expected
    assert manoeuvre_before(trace, 0, 150) == manoeuvre_before(trace, 1, 0) == "lane-keeping"


def expected_of(*instructions):
    """Return what is expected of a collision with an NPC that has these instructions."""
    scenario = Scenario(npcs=(tuple(PositionInstruction(*each) for each in instructions),))
    run = Run(Highway().rollout(scenario, lambda: lambda observation: (0.0, 0.0)))
    assert run.collision is not None
    failure = Failure(kind="AssertionError", assertion="assert not run.collision")
    return Expect.from_run(run, failure)


def test_cut_in_and_braking_leader_are_distinguished():
    leader, cut_in = expected_of((2, 5.0)), expected_of((1, 22.0), (2, 5.0))
    assert (leader.npc_manoeuvre, cut_in.npc_manoeuvre) == ("lane-keeping", "lane-change")
    assert leader.ego_manoeuvre == cut_in.ego_manoeuvre == "lane-keeping"
    assert (leader.side, leader.cell) == (cut_in.side, cut_in.cell)
