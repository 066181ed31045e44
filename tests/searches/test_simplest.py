"""When a simpler scenario shows the failure of a finding."""

from types import SimpleNamespace

from pytest_pafot.findings.verdict import Signature
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searches.refine.simplest import shows
from tests.findings.builders import sighting
from tests.helpers.tables import table

FACTS = {
    "failure": "AssertionError",
    "assertion": "not run.collision",
    "responsibility": "ego",
    "outcome": Outcome.COLLISION,
    "mistake": "kept-no-distance",
    "fault": "leader-unanswered",
}
PROPERTY = {
    "failure": "CheckFailed",
    "assertion": "jerk",
    "responsibility": "none",
    "outcome": Outcome.COMPLETED,
}


def is_shown(shown, found, responsibility):
    """Return whether a run with a signature and a responsible side shows a finding for which the ego is responsible."""
    seen = sighting(responsible="ego")
    bench = SimpleNamespace(examiner=SimpleNamespace(signature_of=lambda run, verdict: shown))
    run = SimpleNamespace(attribution=SimpleNamespace(responsibility=responsibility))
    return shows(seen, run, None, SimpleNamespace(finds={found: seen.id}), bench)


@table(("changes", "responsibility", "expected"), [
    ({}, "ego", True),
    ({}, "both", False),  # the signature tells the ego from the NPC, and not from both
    ({"fault": "cut-in-unanswered"}, "ego", False),
    ({"mistake": "moved-in-front", "fault": "entered-lane"}, "ego", False),
])  # fmt: skip
def test_a_simpler_collision_has_the_same_fault_and_the_same_responsible_side(
    changes, responsibility, expected
):
    assert is_shown(Signature(**FACTS | changes), Signature(**FACTS), responsibility) is expected


def test_a_failed_check_may_have_any_collision_after_it():
    assert is_shown(Signature(**PROPERTY), Signature(**PROPERTY), "npc")


def test_a_run_that_does_not_fail_shows_nothing():
    assert not is_shown(None, Signature(**FACTS), "ego")
