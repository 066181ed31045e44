from dataclasses import replace

import pytest

from pytest_pafot.findings.finding import Finding, Found, has_time, is_same_failure, of_failure, replay_label
from pytest_pafot.findings.signature import Failure
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.oracle.checks import Check
from pytest_pafot.oracle.run import Run
from tests.helpers import situations
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, trace_of, vehicle

VERSIONS = {"pytest-pafot": "0.1.0", "numpy": "2.4.6"}
FAILS = Failure(kind="AssertionError", assertion="assert not run.collision")


def run_of(**fields):
    ego, npc = vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(26.0, 4.0, speed=10.0, ticks=30)
    return Run(trace_of(ego, npc, **fields))


def crash(tick=30, **where):
    return run_of(outcome=Outcome.COLLISION, collision=collision_at(tick, **where))


def saved(run=None, failure=FAILS):
    found = Found(seed=1, generation=0, algorithm="pafot", versions=VERSIONS)
    return Finding.of(run or crash(), failure, test="t.py::test_it", world={}, found=found)


FRONT = of_failure(crash(), FAILS)
HIT_STANDING = trace_of(
    vehicle(0.0, 4.0, ticks=30),
    vehicle(-26.0, 4.0, speed=10.0, ticks=30),
    outcome=Outcome.COLLISION,
    collision=collision_at(30, cell=Cell.REAR, side="rear", ego_speed=0.0),
)
BESIDE = (situations.driven(0.0, shifts=[(2.0, situations.LEFT, 3.0)]), situations.driven(1.0, situations.LEFT))
"""An ego that moves into the vehicle alongside."""
REAR = of_failure(Run(HIT_STANDING), FAILS)
"""The ego stands, so the NPC is responsible."""


def lane_change(gap, *, faster):
    """Return a collision for which the ego is responsible: it changes lanes ahead of another at a gap [m]."""
    trace = situations.lane_change(gap, faster=faster)
    assert (trace.collision is not None, Run(trace).attribution.fault) == (True, "entered-lane")
    return Run(trace)


def label(run, failure=FAILS, *, finding=None, versions=VERSIONS):
    return replay_label(finding or saved(), run, failure, versions)


ERROR = AdsError(kind="ValueError", message="", traceback="", tick=6)
OTHER = VERSIONS | {"numpy": "9.0"}


@table(
    ("run", "failure", "versions", "expected"),
    [
        *((crash(tick), FAILS, VERSIONS, "still failing") for tick in (27, 30, 33)),  # within 0.2 s
        (crash(), FAILS, OTHER, "still failing"),
        (crash(), Failure(kind="AssertionError", assertion="assert run.collision is None"), VERSIONS, "still failing"),
        *((crash(tick), FAILS, VERSIONS, "drifted") for tick in (26, 34)),
        (crash(npc=1), FAILS, VERSIONS, "drifted"),
        (crash(cell=Cell.LEFT), FAILS, VERSIONS, "drifted"),
        (crash(side="left"), FAILS, VERSIONS, "drifted"),
        (run_of(), FAILS, VERSIONS, "drifted"),
        (crash(), Failure(kind="TypeError", message="no"), VERSIONS, "drifted"),
        (run_of(), None, VERSIONS, "fixed"),
        (crash(), None, VERSIONS, "fixed"),
        (run_of(), None, VERSIONS | {"another": "1"}, "fixed"),
        (run_of(), None, {}, "drifted"),
        (run_of(), None, OTHER, "drifted"),
        (crash(10, cell=Cell.REAR, side="rear"), None, VERSIONS, "drifted"),
        (run_of(outcome=Outcome.INVALID), None, VERSIONS, "drifted"),
        (run_of(outcome=Outcome.ADS_ERROR, error=ERROR), None, VERSIONS, "drifted"),
    ],
)
def test_the_same_event_still_fails_a_pass_is_fixed_and_all_else_is_a_drift(run, failure, versions, expected):
    assert label(run, failure, versions=versions) == expected


def jerk(time=1.0, name="jerk"):
    check = Check(name=name, value=35.1, margin=-0.7, at_most=20.0, time=time)
    return Failure(kind="CheckFailed", message=str(check), assertion=name, check=check)


@table("run", [run_of(), crash()])
@table(
    ("now", "expected"),
    [
        (jerk(1.2), "still failing"),
        (jerk(1.3), "drifted"),
        (jerk(time=None), "still failing"),
        (jerk(name="headway"), "drifted"),
        (FAILS, "drifted"),
    ],
)
def test_check_is_identified_by_name_and_its_time(run, now, expected):
    assert label(run, now, finding=saved(run_of(), jerk())) == expected


@pytest.mark.parametrize(("time", "expected"), [(1.9, "fixed"), (2.1, "drifted")])
def test_passing_check_is_fixed_once_its_time_passed(time, expected):
    assert label(crash(tick=30), None, finding=saved(run_of(), jerk(time))) == expected


def test_other_property_is_compared_at_its_worst_moment():
    finding = saved(run_of(), Failure(kind="AssertionError", assertion="assert run.min_ttc > 1"))
    assert label(run_of(), finding=finding) == "still failing"
    assert label(run_of(), None, finding=finding) == "fixed"
    assert label(crash(), finding=finding) == "drifted"


@table(
    ("finding", "run", "failure", "expected"),
    [
        (saved(), crash(20), FAILS, True),  # at another time
        (saved(), crash(20, npc=0, cell=Cell.FRONT), Failure(kind="TypeError", message="no"), False),
        (saved(), run_of(outcome=Outcome.OFF_ROAD), FAILS, False),
        (saved(), Run(HIT_STANDING), FAILS, False),  # by the NPC's fault
        (saved(lane_change(2.0, faster=4.0)), lane_change(10.0, faster=8.0), FAILS, True),
        (saved(lane_change(2.0, faster=4.0)), crash(), FAILS, False),
        (saved(run_of(), jerk()), run_of(), jerk(2.0), True),
        (saved(run_of(), jerk()), run_of(), jerk(name="headway"), False),
    ],
)
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
    for one, other, expected in ((behind, behind, True), (behind, ahead, False), (ahead, behind, False)):
        assert is_same_failure(saved(one), other, FAILS) is expected


def test_file_of_another_name_has_the_same_failure():
    beside, ahead = Run(situations.hit(*BESIDE)), lane_change(2.0, faster=4.0)
    for finding in (saved(ahead), replace(saved(ahead), id="old-bug"), replace(saved(ahead), id="entered-behind-1")):
        assert finding.expect.mistake == "moved-in-front"
        assert is_same_failure(finding, ahead, FAILS)
        assert not is_same_failure(finding, beside, FAILS)


def test_older_file_without_mistake_knows_only_the_fault():
    beside, ahead = Run(situations.hit(*BESIDE)), lane_change(2.0, faster=4.0)
    older = replace(saved(ahead), expect=replace(saved(ahead).expect, mistake=None))
    assert [is_same_failure(older, run, FAILS) for run in (ahead, beside, crash())] == [True, True, False]
    assert saved().expect.mistake is None, "the fault says it"


@table(
    ("failure", "expected"),
    [
        (FAILS, True),
        (jerk(2.0), True),
        (replace(jerk(), check=replace(jerk().check, time=None)), False),
        (Failure(kind="AssertionError", assertion="assert run.ego.speed.sum() < 100"), False),
        (Failure(kind="KeyError", message="'lane'"), True),
    ],
)
def test_value_of_a_whole_run_has_no_time(failure, expected):
    assert has_time(crash(), failure) is expected
