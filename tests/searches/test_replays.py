"""The failures that saved scenarios make known; nothing is run here."""

from dataclasses import replace
from datetime import date
from pathlib import Path
from types import SimpleNamespace

import pytest

from pytest_pafot.corpus.reader import Saved
from pytest_pafot.findings.finding import Expect, signature_of_failure
from pytest_pafot.findings.sighting import Died, Finished, Shows
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.replays import Replays, note_on
from pytest_pafot.support.errors import RequestError
from pytest_pafot.world import Highway
from tests.findings.builders import plain_finding, tried
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, trace_of, vehicle

FAILS = Failure(kind="AssertionError", assertion="assert not run.collision")
FAILED, PASSED = Verdict(kind="failed", failure=FAILS), Verdict(kind="passed")
CARS = (vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(26.0, 4.0, speed=10.0, ticks=30))
QUIET = Run(trace_of(*CARS))
CRASH = Run(trace_of(*CARS, outcome=Outcome.COLLISION, collision=collision_at(30)))
OTHER = Run(trace_of(*CARS, outcome=Outcome.OFF_ROAD))
HIT, LEFT = signature_of_failure(CRASH, FAILS), signature_of_failure(OTHER, FAILS)
ON = (vehicle(0.0, 4.0, speed=20.0, ticks=35), vehicle(26.0, 4.0, speed=10.0, ticks=35))
LATER = Run(trace_of(*ON, outcome=Outcome.COLLISION, collision=collision_at(35)))
OTHER_LATER = Run(trace_of(*ON, outcome=Outcome.OFF_ROAD))


class Told(Replays):
    """Replays with given results by id: a run with its verdict, and whether the reference passes.

    Runs that are driven on have the results with the id and a plus; without any, they end as those that are not.
    """

    def world_of(self, saved):
        return Highway()

    def tried(self, saved, world, owner):
        if saved.finding is None:
            raise RequestError(saved.error)
        longer = f"{saved.id}+"
        end = self.harness.ends[longer if world.lasts and longer in self.harness.ends else saved.id]
        if isinstance(end, Died):
            return end
        run, verdict, *_ = end
        return Finished(run=run, verdict=verdict)

    def _compared(self, saved, world, owner, now, sought):
        assert bool(sought) != self.harness.ends[saved.id][1].failed, (
            "the reference is driven on if the ADS was"
        )
        (_, _, *passes) = self.harness.ends[saved.id]
        theirs = [tried(Shows.HANDLED if each else Shows.OTHER) for each in passes]
        return replace(now, reference=tuple(theirs))


def harness_of(ends):
    request, own = (
        SimpleNamespace(settings=SimpleNamespace(isolate=True)),
        SimpleNamespace(sight=None),
    )
    same = {
        "saved_node_id": str,
        "judge": lambda run: PASSED,
        "versions": {},
        "policy": own,
        "against_name": "",
    }
    return SimpleNamespace(ends=ends, request=request, world=plain_finding().world, **same)


def shown(xfail=None, **ends):
    """Return what saved scenarios with these results show, next to an unreadable file."""
    told = Told(harness=harness_of(ends))
    expect = Expect.from_run(CRASH, FAILS)
    files = [
        Saved(
            Path(f"{id_}.pafot.yaml"),
            plain_finding(
                id=id_, xfail=xfail, xfail_until=xfail and date(2027, 1, 31), expect=expect
            ),
        )
        for id_ in ends
        if not id_.endswith("+")
    ]
    return told.shown_by([Saved(Path("unreadable.pafot.yaml"), error="no file"), *files])[0]


@pytest.mark.parametrize("xfail", [None, "issue 12"])
def test_replay_covers_what_it_shows_now(xfail):
    assert shown(xfail, a=(CRASH, FAILED), b=(OTHER, FAILED)) == {HIT: "a", LEFT: "b"}


def test_first_of_several_replays_covers_a_failure():
    assert shown(a=(QUIET, PASSED), b=(CRASH, FAILED), c=(CRASH, FAILED)) == {HIT: "b"}


def test_failure_is_new_when_all_its_files_pass():
    assert shown(a=(QUIET, PASSED), b=(QUIET, Verdict(kind="npc"))) == {}


@pytest.mark.parametrize(
    ("later", "known"),
    [((LATER, FAILED), {HIT: "a"}), ((OTHER_LATER, FAILED), {}), ((QUIET, PASSED), {})],
)
def test_pass_covers_its_own_failure_that_comes_later(later, known):
    assert shown(a=(QUIET, PASSED), **{"a+": later}) == known


@pytest.mark.parametrize("verdict", [Verdict(kind="rejected"), Verdict(kind="skipped")])
def test_run_that_was_not_judged_is_not_driven_on(verdict):
    assert shown(a=(QUIET, verdict), **{"a+": (CRASH, FAILED)}) == {}


@pytest.mark.parametrize(("passes", "known"), [(True, {HIT: "a"}), (False, {})])
def test_failure_shared_with_reference_hides_nothing_new(passes, known):
    assert shown(a=(CRASH, FAILED, passes)) == known
    assert shown(a=(QUIET, PASSED, passes), **{"a+": (LATER, FAILED)}) == known


LOST = Died(end="was ended by SIGSEGV", pid=7)
SOON = "after the end of the saved scenario"
SAW = {"a": (QUIET, PASSED)}
REJECTED = Verdict(kind="rejected")


@table(("ends", "runs", "note"), [
    ({"a": (CRASH, FAILED)}, ["as saved: SAME"], ""),
    ({"a": (OTHER, FAILED)}, ["as saved: OTHER"], ""),
    ({"a": (QUIET, REJECTED)}, ["as saved: NOTHING"], ""),
    ({"a": LOST}, ["as saved: OTHER"], ""),
    (SAW, ["as saved: HANDLED", "continued: NOTHING"], ""),
    (SAW | {"a+": (OTHER, PASSED)}, ["as saved: HANDLED", "continued: NOTHING, differs"], ""),
    (SAW | {"a+": (CRASH, FAILED)}, ["as saved: HANDLED", "continued: SAME, differs"], ""),
    (
        SAW | {"a+": (LATER, FAILED)},
        ["as saved: HANDLED", "continued: SAME", "continued again: NOTHING"],
        f"the same failure occurs {SOON}: collision at 2.3 s",
    ),
    (
        SAW | {"a+": (OTHER_LATER, FAILED)},
        ["as saved: HANDLED", "continued: ONLY_NOTED"],
        f"a different failure occurs {SOON}: off_road at 2.1 s",
    ),
    (
        SAW | {"a+": (LATER, PASSED)},
        ["as saved: HANDLED", "continued: STILL_COLLIDES"],
        f"the same NPC still collides with the ego {SOON} (The ego hit NPC 0 from behind after 2.3 s, closing at "
        "10.0 m/s; ego at fault)",
    ),
    (
        SAW | {"a+": LOST},
        ["as saved: HANDLED", "continued: ONLY_NOTED", "as saved again: NOTHING"],
        f"the process was ended by SIGSEGV {SOON}",
    ),
])  # fmt: skip
def test_pass_is_continued_past_the_end_and_only_the_saved_failure_is_confirmed(ends, runs, note):
    told = Told(harness=harness_of(ends))
    finding = plain_finding(id="a", expect=Expect.from_run(CRASH, FAILS))
    now = told._driven(Saved(Path("a.pafot.yaml"), finding), Highway(), "owner")
    made = []
    for each in now.tries:
        differs = "" if each.repeats else ", differs"
        made.append(f"{each.which}: {each.shows.name}{differs}")
    assert made == runs
    assert note_on(finding, now) == note
