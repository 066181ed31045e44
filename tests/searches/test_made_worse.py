"""A finding counts against a reference only if the policy became worse, and not if both fail as often."""

from zlib import crc32

import pytest

import pytest_pafot as pafot
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.searches import made_worse
from pytest_pafot.searches.events import Paired
from pytest_pafot.support.errors import OutOfTime

SHORT = {"genes": 2, "gene_seconds": 5, "npcs": 2, "generations": 3, "shrink_runs": 5, "seed": 4}
ROAD = pafot.Highway(duration=10.0)


def keeps_its_speed(run):
    assert abs(run.ego.speed - run.ego.speed[0]).max() < 0.3


def fails_in(parts, of=2, how=lambda: (1.0, 0.0)):
    """Make a policy that fails in some parts of all scenarios, which no other similarity of scenarios tells apart."""

    class Policy:
        number = 0

        def __call__(self, seen):
            self.number += 1
            if self.number == 10:
                self.is_failing = (
                    crc32(repr([other.x for other in seen.others]).encode()) % of in parts
                )
            return how() if self.number >= 10 and self.is_failing else (0.0, 0.0)

    return Policy


def raises():
    raise KeyError("lanes")


EVEN, ODD, ALL, NONE = fails_in({0}), fails_in({1}), fails_in({0, 1}), fails_in({})


def compared(new, old, **more):
    told = []
    arguments = {"holds": keeps_its_speed, "world": ROAD, "on_event": told.append, **SHORT, **more}
    found = pafot.explore(new, against=old, **arguments)
    last = {event.id: event for event in told if isinstance(event, Seen)}
    return found, list(last.values())


def test_policy_that_fails_more_often_is_worse():
    found, told = compared(ALL, NONE)
    assert [find.label for find in told] == ["new"] * len(found.findings) != []
    assert found.summary.paired == Paired(runs=14, only_new=14, most=700)
    counts = "14 failed only with this policy, and none only with the reference"
    assert (
        found.summary.compared
        == f"this policy is worse than the reference: of 14 random scenarios, {counts}"
    )


def test_error_of_the_policy_itself_always_counts():
    found, _ = compared(fails_in({0}, how=raises), fails_in({1}, how=raises))
    assert found.summary.paired.is_worse is False
    assert [finding.expect.failure for finding in found.findings] == ["KeyError"]


def test_what_the_random_scenarios_cannot_decide_counts(monkeypatch):
    monkeypatch.setattr(made_worse, "PAIRS", 6)
    found, _ = compared(ALL, NONE)
    assert found.summary.paired.is_worse is None
    assert found.findings


def test_what_no_time_is_left_to_decide_counts(monkeypatch):
    def fail(self, result):
        raise OutOfTime

    monkeypatch.setattr(made_worse.MadeWorse, "_failed_only", fail)
    found, _ = compared(EVEN, ODD)
    assert found.findings
    assert "of 0 random scenarios before the time ran out, " in found.summary.compared


@pytest.mark.processes
def test_number_of_processes_changes_no_decision():
    one, two = (compared(EVEN, ODD, workers=workers)[0].summary for workers in (1, 2))
    assert (one.paired, one.no_worse) == (two.paired, two.no_worse)
