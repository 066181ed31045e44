"""The failures that saved scenarios make known; nothing is run here."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from pytest_pafot.campaign.replays import Replays
from pytest_pafot.campaign.request import RequestError
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.findings.finding import of_failure
from pytest_pafot.findings.signature import Failure
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from tests.findings.builders import plain_finding
from tests.helpers.traces import collision_at, trace_of, vehicle

FAILS = Failure(kind="AssertionError", assertion="assert not run.collision")
FAILED, PASSED = Verdict(kind="failed", failure=FAILS), Verdict(kind="passed")
CARS = (vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(26.0, 4.0, speed=10.0, ticks=30))
QUIET = Run(trace_of(*CARS))
CRASH = Run(trace_of(*CARS, outcome=Outcome.COLLISION, collision=collision_at(30)))
OTHER = Run(trace_of(*CARS, outcome=Outcome.OFF_ROAD))
HIT, LEFT = of_failure(CRASH, FAILS), of_failure(OTHER, FAILS)


class Told(Replays):
    """Replays with given results by id: a run with its verdict, and whether the reference passes."""

    def world_of(self, saved):
        return None

    def tried(self, saved, world, owner):
        if saved.finding is None:
            raise RequestError(saved.error)
        return self.harness.ends[saved.id][:2]

    def passes_reference(self, saved, world, owner):
        return (*self.harness.ends[saved.id], None)[2]


def shown(xfail=None, **ends):
    """Return what saved scenarios with these results show, next to an unreadable file."""
    told = Told(harness=SimpleNamespace(saved_node_id=str, ends=ends), in_own_session=None)
    files = [Saved(Path(f"{id_}.pafot.yaml"), plain_finding(id=id_, xfail=xfail)) for id_ in ends]
    return told.shown_by([Saved(Path("unreadable.pafot.yaml"), error="no file"), *files])


@pytest.mark.parametrize("xfail", [None, "issue 12"])
def test_replay_covers_what_it_shows_now(xfail):
    assert shown(xfail, a=(CRASH, FAILED), b=(OTHER, FAILED)) == {HIT: "a", LEFT: "b"}


def test_first_of_several_replays_covers_a_failure():
    assert shown(a=(QUIET, PASSED), b=(CRASH, FAILED), c=(CRASH, FAILED)) == {HIT: "b"}


def test_failure_is_new_when_all_its_files_pass():
    assert shown(a=(QUIET, PASSED), b=(QUIET, Verdict(kind="npc"))) == {}


@pytest.mark.parametrize(("passes", "known"), [(True, {HIT: "a"}), (False, {})])
def test_failure_shared_with_reference_hides_nothing_new(passes, known):
    assert shown(a=(CRASH, FAILED, passes)) == known
