from dataclasses import replace

import pytest

from pytest_pafot.findings.finding import (
    Finding,
    Found,
    handles,
    has_time,
    is_same_event,
    is_same_failure,
    signature_of_failure,
)
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.oracle.run import Check, Run
from tests.findings.test_finding import run_of
from tests.helpers import situations
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, trace_of, vehicle

VERSIONS = {"pytest-pafot": "0.1.0", "numpy": "2.4.6"}
FAILS = Failure(kind="AssertionError", assertion="assert not run.collision")


def crash(tick=30, **where):
    return run_of(outcome=Outcome.COLLISION, collision=collision_at(tick, **where))


def saved(run=None, failure=FAILS):
    found = Found(seed=1, generation=0, algorithm="pafot", versions=VERSIONS)
    return Finding.from_run(run or crash(), failure, test="t.py::test_it", world={}, found=found)


FRONT = signature_of_failure(crash(), FAILS)
HIT_STANDING = trace_of(
    vehicle(0.0, 4.0, ticks=30),
    vehicle(-26.0, 4.0, speed=10.0, ticks=30),
    outcome=Outcome.COLLISION,
    collision=collision_at(30, cell=Cell.REAR, side="rear", ego_speed=0.0),
)
BESIDE = (
    situations.driven(0.0, shifts=[(2.0, situations.LEFT, 3.0)]),
    situations.driven(1.0, situations.LEFT),
)
"""An ego that moves into the vehicle alongside."""
REAR = signature_of_failure(Run(HIT_STANDING), FAILS)
"""The ego stands, so the NPC is responsible."""


def lane_change(gap, *, faster):
    """Return a collision for which the ego is responsible: it changes lanes ahead of another at a gap [m]."""
    trace = situations.lane_change(gap, faster=faster)
    assert (trace.collision is not None, Run(trace).attribution.fault) == (True, "entered-lane")
    return Run(trace)


def shown(run, failure=FAILS, *, finding=None):
    """Return what a run says by itself."""
    finding = finding or saved()
    if failure is None:
        return "handled" if handles(finding, run) else "drifted"
    return "still failing" if is_same_event(finding.expect, run, failure) else "drifted"


ERROR = AdsError(kind="ValueError", message="", traceback="", tick=6)


@table(("run", "failure", "expected"), [
    *((crash(tick), FAILS, "still failing") for tick in (10, 26, 30, 34)),  # at any time
    (crash(), Failure(kind="AssertionError", assertion="assert run.collision is None"), "still failing"),
    (crash(cell=Cell.LEFT), FAILS, "still failing"),
    (crash(npc=1), FAILS, "drifted"),
    (crash(side="left"), FAILS, "drifted"),
    (run_of(), FAILS, "drifted"),
    (crash(), Failure(kind="TypeError", message="no"), "drifted"),
    (run_of(), None, "handled"),
    (crash(), None, "handled"),
    *((crash(tick), None, "drifted") for tick in (26, 34)),
    (crash(10, cell=Cell.REAR, side="rear"), None, "drifted"),
    (run_of(outcome=Outcome.INVALID), None, "drifted"),
    (run_of(outcome=Outcome.ADS_ERROR, error=ERROR), None, "drifted"),
])  # fmt: skip
def test_the_same_vehicle_on_the_same_side_still_fails_and_a_pass_must_handle_the_situation(
    run, failure, expected
):
    assert shown(run, failure) == expected


def jerk(time=1.0, name="jerk"):
    check = Check(name=name, value=35.1, margin=-0.7, at_most=20.0, time=time)
    return Failure(kind="CheckFailed", message=str(check), assertion=name, check=check)


@table("run", [run_of(), crash()])
@table(("now", "expected"), [
    (jerk(1.2), "still failing"),
    (jerk(1.3), "drifted"),
    (jerk(time=None), "still failing"),
    (jerk(name="headway"), "drifted"),
    (FAILS, "drifted"),
])  # fmt: skip
def test_check_is_identified_by_name_and_its_time(run, now, expected):
    assert shown(run, now, finding=saved(run_of(), jerk())) == expected


@pytest.mark.parametrize(("time", "expected"), [(1.9, "handled"), (2.1, "drifted")])
def test_passing_check_is_handled_once_its_time_passed(time, expected):
    assert shown(crash(tick=30), None, finding=saved(run_of(), jerk(time))) == expected


def test_other_property_is_compared_at_its_worst_moment():
    finding = saved(run_of(), Failure(kind="AssertionError", assertion="assert run.min_ttc > 1"))
    assert shown(run_of(), finding=finding) == "still failing"
    assert shown(run_of(), None, finding=finding) == "handled"
    assert shown(crash(), finding=finding) == "drifted"


@table(("finding", "run", "failure", "expected"), [
    (saved(), crash(20), FAILS, True),  # at another time
    (saved(), crash(20, npc=0, cell=Cell.FRONT), Failure(kind="TypeError", message="no"), False),
    (saved(), run_of(outcome=Outcome.OFF_ROAD), FAILS, False),
    (saved(), Run(HIT_STANDING), FAILS, False),  # by the NPC's fault
    (saved(lane_change(2.0, faster=4.0)), lane_change(10.0, faster=8.0), FAILS, True),
    (saved(lane_change(2.0, faster=4.0)), crash(), FAILS, False),
    (saved(run_of(), jerk()), run_of(), jerk(2.0), True),
    (saved(run_of(), jerk()), run_of(), jerk(name="headway"), False),
])  # fmt: skip
def test_same_failure_is_known_at_any_time(finding, run, failure, expected):
    assert is_same_failure(finding, run, failure) is expected


def test_lane_change_behind_another_is_its_own_failure():
    behind = next(
        Run(each.trace())
        for group in situations.SITUATIONS.values()
        for each in group
        if each.name == "ego-enters-behind-a-slower-one"
    )
    ahead = lane_change(2.0, faster=4.0)
    assert behind.attribution.fault == ahead.attribution.fault == "entered-lane"
    for one, other, expected in (
        (behind, behind, True),
        (behind, ahead, False),
        (ahead, behind, False),
    ):
        assert is_same_failure(saved(one), other, FAILS) is expected


def test_file_of_another_name_has_the_same_failure():
    beside, ahead = Run(situations.hit(*BESIDE)), lane_change(2.0, faster=4.0)
    for finding in (
        saved(ahead),
        replace(saved(ahead), id="old-bug"),
        replace(saved(ahead), id="entered-behind-1"),
    ):
        assert finding.expect.mistake == "moved-in-front"
        assert is_same_failure(finding, ahead, FAILS)
        assert not is_same_failure(finding, beside, FAILS)


@table(("failure", "expected"), [
    (FAILS, True),
    (jerk(2.0), True),
    (replace(jerk(), check=replace(jerk().check, time=None)), False),
    (Failure(kind="AssertionError", assertion="assert run.ego.speed.sum() < 100"), False),
    (Failure(kind="KeyError", message="'lane'"), True),
])  # fmt: skip
def test_value_of_a_whole_run_has_no_time(failure, expected):
    assert has_time(crash(), failure) is expected
