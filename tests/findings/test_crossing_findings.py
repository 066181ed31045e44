"""Failures with NPCs that cross: their distinction, their situation, and the meaning of a replay."""

import pytest

from pytest_pafot.findings.finding import (
    Expect,
    Finding,
    Found,
    handles,
    is_same_event,
    signature_of_failure,
)
from pytest_pafot.findings.situation import ZoneSituation, missed, seconds_after
from pytest_pafot.findings.verdict import ZONES, Failure, Signature
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Check, Run
from tests.findings.builders import VERSIONS, plain_finding
from tests.helpers.junctions import driven, hit, plan
from tests.helpers.tables import table

FAILS = Failure(kind="AssertionError", assertion="assert not run.collision")
STRAIGHT, LEFT = "west straight", "west left"


def crash(npc="north straight", *, enters=8.0, speed=9.0, ego=STRAIGHT, changes=(), **road):
    """Return a collision of an ego at 10 m/s, unless changed, with an NPC that enters the zone at a time [s]."""
    return Run(hit(plan(ego, 8.0, 10.0, *changes), plan(npc, enters, speed), **road))


def passes(npc="north straight", *, enters=8.0, speed=9.0, changes=((4.0, 3.0, 0.0),)):
    """Return the same run with an ego that brakes from 4 s and so gives way."""
    return Run(driven(plan(STRAIGHT, 8.0, 10.0, *changes), plan(npc, enters, speed)))


def saved(run, failure=FAILS):
    found = Found(seed=1, generation=0, algorithm="distinct", versions=VERSIONS)
    return Finding.from_run(
        run, failure, test="test_it.py::test_it", world={"kind": "own"}, found=found
    )


def test_zone_failure_is_identified_by_fault_and_origin():
    runs = [crash(), crash("south straight"), crash("east left", enters=8.5)]
    expected = [Expect.from_run(run, FAILS) for run in runs]
    assert [each.zone for each in expected] == [
        "crossing from the left", "crossing from the right", "oncoming from ahead"
    ]  # fmt: skip
    assert len({signature_of_failure(run, FAILS) for run in runs}) == 3
    assert signature_of_failure(crash(), FAILS) == signature_of_failure(
        crash(enters=8.2, speed=7.0), FAILS
    )
    assert {each.npc_manoeuvre for each in expected} == {None}


@table(
    ("zone", "slug"),
    [
        ("crossing from the left", "rear-crossing-left"),
        ("merging from behind", "rear-merging-behind"),
    ],
)
def test_collision_caused_by_npc_names_side_and_zone(zone, slug):
    fields = {
        "failure": "AssertionError",
        "assertion": "not run.collision",
        "outcome": Outcome.COLLISION,
    }
    signature = Signature.from_facts(**fields, responsibility="npc", side="rear", zone=zone)
    assert signature.slug == slug
    assert signature != Signature.from_facts(
        **fields, responsibility="npc", side="rear", zone="oncoming from ahead"
    )
    assert signature != Signature.from_facts(
        **fields, responsibility="npc", side="rear", cell=Cell.REAR
    )


@table("fault", ["leader-unanswered", "cut-in-unanswered", "braked-for-nothing"])
def test_fault_without_zone_is_same_in_all_zones(fault):
    fields = {
        "failure": "AssertionError",
        "assertion": "not run.collision",
        "outcome": Outcome.COLLISION,
    }
    signatures = {
        Signature.from_facts(**fields, responsibility="ego", fault=fault, zone=zone)
        for zone in (None, *ZONES)
    }
    assert len(signatures) == 1


def test_a_property_is_the_same_in_every_zone():
    fields = {
        "failure": "AssertionError",
        "assertion": "run.min_ttc > N",
        "outcome": Outcome.COLLISION,
    }
    assert (
        len(
            {
                Signature.from_facts(**fields, responsibility="npc", zone=zone)
                for zone in (None, *ZONES)
            }
        )
        == 1
    )


def test_zone_situation_says_when_both_reach_the_zone():
    run = crash()
    then = Expect.from_run(run, FAILS).situation
    assert isinstance(then, ZoneSituation)
    assert then.time == pytest.approx(run.attribution.tick / 15 - 2, abs=0.001)
    assert then.time + then.ego_enters == pytest.approx(8.0, abs=0.1)
    assert then.time + then.npc_enters == pytest.approx(8.0, abs=0.1)
    assert (then.ego_speed, then.npc_speed) == (10.0, 9.0)
    assert str(then) == (
        f"{then.npc_enters:.1f} s from its zone at 9.0 m/s, with the ego {then.ego_enters:.1f} s from it at 10.0 m/s"
    )


def test_situation_of_a_check_is_two_seconds_before_also_past_the_beginning_of_the_zone():
    def before(time):
        check = Check(name="gives way", value=0.1, margin=-0.9, at_least=1.0, time=time, npc=0)
        return Expect.from_run(
            passes(), Failure(kind="CheckFailed", assertion="gives way", check=check)
        ).situation

    assert (before(7.0).npc, before(7.0).time) == (0, 5.0)
    assert before(7.0).npc_enters == pytest.approx(3.0, abs=0.1)
    assert str(before(11.0)).startswith(
        "1.0 s past the start of its zone at 9.0 m/s, with the ego "
    )


@table(("run", "comes_up"), [
    (crash(), True),
    (passes(), True),
    (passes(changes=((2.0, 1.0, 4.0),)), True),
    (passes(changes=((5.5, 6.0, 0.0),)), True),
    (passes(enters=8.3, speed=9.5), True),
    (passes(enters=12.0), False),  # it comes long after the ego
    (passes(enters=4.0), False),
    (passes(speed=4.0), False),  # the original NPC would have come at that speed
    (passes(changes=((0.0, 6.0, 0.0),)), False),  # the ego never comes near the zone
])  # fmt: skip
def test_situation_comes_up_if_both_reach_zone_alike(run, comes_up):
    situation = Expect.from_run(crash(), FAILS).situation
    assert (not missed(situation, run)) == comes_up
    assert (seconds_after(situation, run) is not None) == comes_up


def test_giving_way_is_fixed_but_not_meeting_drifted():
    finding = saved(crash())
    assert handles(finding, passes())
    assert not handles(finding, passes(enters=12.0))
    assert is_same_event(finding.expect, crash(), FAILS)


def test_missed_situation_names_both_moments():
    text = missed(Expect.from_run(crash(), FAILS).situation, passes(enters=12.0))
    assert text.startswith("the situation did not occur: before the saved run failed, NPC 0 was ")
    assert "s from its zone at 9.0 m/s, with the ego" in text
    assert text.count("zone") == 2


def test_situation_is_unknown_if_npc_does_not_cross():
    situation, others = (
        Expect.from_run(crash(), FAILS).situation,
        (plan("north straight", 12.0, 9.0),),
    )
    on_grid = Run(driven(plan(STRAIGHT, 8.0, 10.0), plan("grid", 6.0, 9.0), others=others))
    assert missed(situation, on_grid) == ""
    assert seconds_after(situation, on_grid) is None


def test_zone_finding_is_saved_with_zone_and_situation():
    finding = saved(crash())
    assert finding.expect.fault == "did-not-give-way"
    assert finding.id.startswith("did-not-give-way-left-")
    expect = finding.expect
    assert (expect.npc, expect.cell, expect.zone) == (0, None, "crossing from the left")
    assert plain_finding(expect=expect).signature == finding.signature
