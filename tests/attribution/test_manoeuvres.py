"""The manoeuvre of a vehicle before an event: it changed lanes, or it did not."""

import numpy as np

from pytest_pafot import Highway, PositionInstruction, Scenario
from pytest_pafot.attribution.responsibility import manoeuvre_before
from pytest_pafot.findings.finding import Expect
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.oracle.run import Run
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle

COLLIDES = Failure(kind="AssertionError", assertion="assert not run.collision")
STILL = vehicle(0.0, 4.0, speed=20.0, ticks=150)


def sideways(displacement, *, until, ticks=150):
    """Return a vehicle that moves to the right at an even pace for two seconds and then keeps its lane."""
    states = vehicle(30.0, 4.0, speed=20.0, ticks=ticks)
    states[:, 1] += displacement * np.clip((np.arange(ticks + 1) - until + 30) / 30, 0, 1)
    return states


@table(("until", "expected"), [(150, "lane-change"), (100, "lane-change"), (80, "lane-keeping")])
def test_lane_change_counts_for_less_than_four_seconds(until, expected):
    trace = trace_of(STILL, sideways(4.0, until=until))
    assert manoeuvre_before(trace, 1, 150) == expected
    assert manoeuvre_before(trace, 0, 150) == "lane-keeping"


@table(
    ("displacement", "expected"),
    [(0.9, "lane-keeping"), (-0.9, "lane-keeping"), (1.1, "lane-change")],
)
def test_swaying_inside_the_lane_is_no_lane_change(displacement, expected):
    assert manoeuvre_before(trace_of(STILL, sideways(displacement, until=150)), 1, 150) == expected


def test_at_the_start_nobody_has_changed_lanes():
    assert manoeuvre_before(trace_of(STILL, STILL), 1, 0) == "lane-keeping"


def collision(*instructions):
    scenario = Scenario(npcs=(tuple(PositionInstruction(*each) for each in instructions),))
    run = Run(Highway().rollout(scenario, lambda: lambda observation: (0.0, 0.0)))
    assert run.collision is not None
    return run


def test_cut_in_and_braking_leader_are_distinguished():
    leader, cut_in = (
        Expect.from_run(collision(*chain), COLLIDES)
        for chain in (((2, 5.0),), ((1, 22.0), (2, 5.0)))
    )
    assert (leader.npc_manoeuvre, cut_in.npc_manoeuvre) == ("lane-keeping", "lane-change")
    assert leader.ego_manoeuvre == cut_in.ego_manoeuvre == "lane-keeping"
    assert (leader.side, leader.cell) == (cut_in.side, cut_in.cell)
