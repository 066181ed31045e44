"""Joining the saved scenarios of several corpora: which remain, and under which name. Nothing is run here."""

from dataclasses import replace
from datetime import date
from itertools import permutations
from pathlib import Path

from pytest_pafot.campaign.merging import Candidate, join
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.model.scenario import PositionInstruction, Scenario
from tests.findings.builders import plain_finding

DAY = date(2027, 1, 31)
REAR = replace(plain_finding().signature, side="rear")


def candidate(id_="front-2-1f3a9c", speed=20.0, kind=None, folder="there", **changes):
    scenario = Scenario(npcs=[[PositionInstruction(6, speed)]])
    finding = plain_finding(id=id_, scenario=scenario, **changes)
    path = Path(folder, f"{id_}.pafot.yaml")
    return Candidate(saved=Saved(path, finding), finding=finding, kind=kind or finding.signature)


def kept(*candidates, taken=()):
    """Return the remaining ids, each with the speed of its scenario."""
    return {id_: each.finding.scenario.npcs[0][0].speed for id_, each in join(candidates, taken).kept.items()}


def test_the_simplest_of_each_kind_is_kept():
    one, simpler = candidate("a-111111", speed=20.0), candidate("b-222222", speed=10.0)
    assert kept(one, simpler, candidate("c-333333", kind=REAR)) == {"b-222222": 10.0, "c-333333": 20.0}


def test_equally_simple_findings_are_decided_by_id():
    assert kept(candidate("b-222222"), candidate("a-111111")) == {"a-111111": 20.0}


def test_flaky_finding_never_replaces_a_stable_one():
    assert kept(candidate("a-111111", speed=0.0, flaky="differs"), candidate("b-222222")) == {"b-222222": 20.0}


def test_findings_sharing_an_id_are_numbered_simplest_first():
    one, other = candidate("a-111111-2", speed=10.0), candidate("a-111111", kind=REAR)
    assert kept(one, other) == {"a-111111": 10.0, "a-111111-2": 20.0}
    assert kept(one, other, taken=["a-111111"]) == {"a-111111-2": 10.0, "a-111111-3": 20.0}


def test_accepting_reason_moves_to_the_remaining_finding():
    (best,) = join([candidate(xfail="issue 12"), candidate("b-222222", speed=10.0)]).kept.values()
    assert (best.finding.id, best.finding.xfail) == ("b-222222", "issue 12")


def test_several_reasons_for_one_kind_are_a_conflict():
    two = [candidate("a-111111", xfail="issue 12"), candidate("b-222222", xfail="never mind")]
    joined = join([*two, candidate("a-111111", kind=REAR)])
    assert joined.conflicts == [two]
    assert list(joined.kept) == ["a-111111-2"]


def test_one_reason_with_two_dates_is_conflict():
    two = [candidate(f"{name}-111111", xfail="issue 12", xfail_until=day) for name, day in (("a", DAY), ("b", None))]
    assert join(two).conflicts == [two]


def test_a_last_day_goes_with_its_reason():
    accepting = candidate(xfail="issue 12", xfail_until=DAY)
    (best,) = join([accepting, candidate("b-222222", speed=10.0)]).kept.values()
    assert (best.finding.id, best.finding.xfail, best.finding.xfail_until) == ("b-222222", "issue 12", DAY)


def test_accepted_as_flaky_or_not_is_a_difference():
    flaky = {"xfail": "issue 12", "xfail_until": DAY, "xfail_flaky": True}
    two = [candidate(**flaky), candidate("b-222222", xfail="issue 12", xfail_until=DAY)]
    assert join(two).conflicts == [two]
    (best,) = join([two[0], candidate("b-222222", speed=10.0)]).kept.values()
    assert best.finding.acceptance == ("issue 12", DAY, True)


def test_any_order_and_any_grouping_gives_the_same():
    all_four = [
        candidate("a-111111", speed=20.0),
        candidate("a-111111", speed=10.0, kind=REAR),
        candidate("b-222222", speed=10.0, xfail="issue 12", xfail_until=DAY),
        candidate("b-222222", speed=15.0, kind=REAR),
    ]
    expected = kept(*all_four)
    assert expected == {"a-111111": 10.0, "b-222222": 10.0}
    for first, *others in permutations(all_four):
        merged = [first]
        for other in others:
            merged = [
                replace(each, finding=replace(each.finding, id=id_))
                for id_, each in join([*merged, other]).kept.items()
            ]
        assert kept(*merged) == kept(first, *others) == expected
