from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.finding import signature_of_failure
from pytest_pafot.findings.verdict import Failure, Signature, normalised
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.oracle.run import Check, Run
from tests.helpers.hostile import CHARACTERS
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, trace_of, vehicle

COLLIDES = Failure(kind="AssertionError", assertion="assert not run.collision, run.explain()")


def approaching(ego_speed=20.0, **fields):
    return trace_of(
        vehicle(0.0, 4.0, speed=ego_speed, ticks=30),
        vehicle(40.0, 4.0, speed=10.0, ticks=30),
        **fields,
    )


def crash(**where):
    collision = collision_at(30, **where)
    return Run(approaching(collision.ego_speed, outcome=Outcome.COLLISION, collision=collision))


STANDING = {"cell": Cell.LEFT, "side": "left", "ego_speed": 0.0}
"""A collision for which the ego is not responsible."""

SITUATIONS_BY_SLUG = {
    "lane-change-10-m-ahead": "entered-lane",
    "ego-swipes": "entered-lane",
    "ego-enters-behind-a-slower-one": "entered-behind",
}


def test_collision_caused_by_ego_is_identified_by_mistake():
    assert signature_of_failure(crash(), COLLIDES) == Signature(
        failure="AssertionError",
        assertion="not run.collision",
        outcome=Outcome.COLLISION,
        responsibility="ego",
        mistake="kept-no-distance",
    )


def test_side_hit_does_not_matter_for_ego_fault():
    assert signature_of_failure(
        crash(cell=Cell.FRONT_LEFT, side="left"), COLLIDES
    ) == signature_of_failure(crash(), COLLIDES)
    fields = {"failure": "", "assertion": "", "outcome": Outcome.COLLISION, "fault": "entered-lane"}
    alone = Signature.from_facts(
        **fields, responsibility="ego", cell=Cell.LEFT, ego_manoeuvre="lane-change"
    )
    assert alone == Signature.from_facts(
        **fields, responsibility="both", side="rear", npc_manoeuvre="lane-keeping"
    )


def test_other_collisions_are_identified_by_side_and_cell():
    assert signature_of_failure(crash(**STANDING), COLLIDES) == Signature(
        failure="AssertionError",
        assertion="not run.collision",
        outcome=Outcome.COLLISION,
        responsibility="npc",
        side="left",
        cell=Cell.LEFT,
        npc_manoeuvre="lane-keeping",
        ego_manoeuvre="lane-keeping",
    )


def test_assertion_without_collision_is_identified_by_its_text():
    failure = Failure(kind="AssertionError", assertion="assert run.min_ttc > 1.0")
    expected = Signature(
        failure="AssertionError",
        assertion="run.min_ttc > N",
        outcome=Outcome.COMPLETED,
        responsibility="none",
    )
    assert (
        signature_of_failure(Run(approaching()), failure)
        == signature_of_failure(crash(), failure)
        == expected
    )


def test_failed_check_is_identified_by_its_name():
    def jerk(value):
        check = Check(name="jerk", value=value, margin=20.0 - value, at_most=20.0)
        return Failure(kind="CheckFailed", message=str(check), assertion="jerk", check=check)

    signature = signature_of_failure(Run(approaching()), jerk(35.1))
    assert (
        signature
        == signature_of_failure(crash(), jerk(21.0))
        == signature_of_failure(crash(**STANDING), jerk(99.0))
    )
    assert (signature.assertion, signature.slug) == ("jerk", "jerk")


@table("source", [
    "is_fine(run)",
    "helpers.is_fine(run)",
    "run.outcome == 'safe'",
    "run.trace.collision is None",
    "run.explain() == ''",
    "not run.collision or run.min_ttc > 1.0",
])  # fmt: skip
def test_assertion_about_the_collision_is_identified_by_outcome(source):
    failure = Failure(kind="AssertionError", assertion=f"assert {source}")
    assert signature_of_failure(crash(), failure).fault == "leader-unanswered"
    assert signature_of_failure(Run(approaching()), failure).cell is None


def test_the_time_and_the_speeds_do_not_matter():
    assert signature_of_failure(crash(ego_speed=18.0), COLLIDES) == signature_of_failure(
        crash(npc_speed=3.0), COLLIDES
    )


def test_fault_names_a_failure_without_distinguishing_it():
    told = {"failure": "", "assertion": "", "outcome": Outcome.COLLISION, "responsibility": "ego"}
    followed = Signature.from_facts(**told, fault="leader-unanswered")
    entered = Signature.from_facts(**told, fault="entered-lane", mistake="kept-no-distance")
    cut_in = Signature.from_facts(**told, fault="cut-in-unanswered")
    assert followed == entered == cut_in != Signature.from_facts(**told, fault="braked-for-nothing")
    assert [each.slug for each in (followed, entered, cut_in)] == [
        "leader-unanswered", "entered-behind", "cut-in-unanswered"
    ]  # fmt: skip


@table("name", SITUATIONS_BY_SLUG)
def test_lane_change_slug_names_place_of_other_vehicle(name):
    trace = next(each for each in chain(*SITUATIONS.values()) if each.name == name).trace()
    assert Run(trace).attribution.fault == "entered-lane"
    assert signature_of_failure(Run(trace), COLLIDES).slug == SITUATIONS_BY_SLUG[name]


@table("source", [
    "assert run.min_ttc > 1.0",
    "assert run.min_ttc > 2",
    "assert run.min_ttc > -1e-3",
    "assert (run.min_ttc>1.5), f'too close: {run.min_ttc}'",
    "    assert (\n        run.min_ttc  # of the boxes\n        > 1.0\n    )",
    "run.min_ttc > 1.0",
])  # fmt: skip
def test_assertion_does_not_depend_on_layout_or_numbers(source):
    assert normalised(source) == "run.min_ttc > N"


def test_an_assertion_keeps_what_tells_it_from_another():
    sources = [
        "not run.collision",
        "not run.off_road",
        "run.v2 > 1",
        "run.v3 > 1",
        "run.x == True",
        "run.x == 'a1'",
    ]
    assert len({normalised(source) for source in sources}) == len(sources)


@table(("one", "other"), [
    ("gap 0.31 m at <Run 0x7f01>", "gap 12 m at <Run 0xAB99>"),
    ("no file /tmp/a1/b.csv", "no file /home/me/x/c.csv"),
    ("no file C:\\a\\b.csv", "no file D:\\other\\c.csv"),
    ("test_a.py:12 failed", "tests_b.py:9 failed"),
    ("speed nan", "speed -inf"),
    ("slow\nfirst detail", "slow\nother detail"),
    ("  slow", "\n\nslow"),
])  # fmt: skip
def test_message_does_not_depend_on_numbers_or_files(one, other):
    assert normalised("", one) == normalised("", other) != ""


@table(("source", "message", "text"), [
    ("", "lane 3 is closed", "lane N is closed"),
    ("", "float64 has no v2", "float64 has no v2"),
    ("", "assert 0.3 > 1.0\n + where", "assert N > N"),
    # which cannot be parsed
    ("assert run.min_ttc > 1.0 and (", "", "assert run.min_ttc > N and ("),
])  # fmt: skip
def test_text_without_a_source_that_can_be_parsed_keeps_its_words(source, message, text):
    assert normalised(source, message) == text


@given(st.text(CHARACTERS, max_size=400), st.text(CHARACTERS, max_size=400))
def test_any_text_gives_one_short_printable_line(assertion, message):
    text = normalised(assertion, message)
    assert len(text) <= 200
    assert text == text.strip()
    assert "\n" not in text


@given(st.floats(0, 1e6), st.floats(0, 1e6))
def test_numbers_never_make_a_difference(a, b):
    assert normalised(f"run.gap > {a}") == normalised(f"run.gap > {b}")
    assert normalised("", f"gap was {a}") == normalised("", f"gap was {b}")


def slug(assertion="", kind="AssertionError", run=None):
    return signature_of_failure(
        run or Run(approaching()), Failure(kind=kind, assertion=assertion)
    ).slug


def test_a_slug_names_the_subject_of_another_assertion():
    assert slug("assert run.min_ttc > 1.0") == "min-ttc"
    for outcome in (Outcome.COMPLETED, Outcome.OFF_ROAD):
        assert slug("assert not run.off_road", run=Run(approaching(outcome=outcome))) == "off-road"


@pytest.mark.parametrize("outcome", [Outcome.ADS_ERROR, Outcome.HANG])
def test_ads_fault_is_named_and_the_same_for_any_traffic(outcome):
    more = {
        "outcome": outcome,
        "error": AdsError(kind="ValueError", message="no path", traceback="", tick=6),
    }
    ego, other = (vehicle(x, 4.0, speed=20.0, ticks=9) for x in (0.0, 50.0))
    near, alone = Run(approaching(**more)), Run(trace_of(ego, other, **more))
    failure = Failure(kind="ValueError", message="no path")
    assert near.event_cell is Cell.FRONT
    assert signature_of_failure(near, failure) == signature_of_failure(alone, failure)
    assert signature_of_failure(near, failure).slug == outcome.replace("_", "-")


def test_a_slug_has_no_cell_where_nothing_approached():
    run = Run(
        trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=9), vehicle(50.0, 4.0, speed=20.0, ticks=9))
    )
    assert slug("assert run.hardest_brake < 3", run=run) == "hardest-brake"


@given(st.text(CHARACTERS, max_size=80), st.text(CHARACTERS, max_size=80))
def test_slug_is_short_and_safe_in_file_names(assertion, kind):
    text = slug(assertion, kind)
    assert 0 < len(text) <= 40
    assert set(text) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")
    assert text == text.strip("-")


def test_long_assertion_on_measures_is_identified_by_text():
    source = " and ".join(f"run.npcs[{npc}].gap.min() > 1.5" for npc in range(9))
    failure = Failure(kind="AssertionError", assertion=f"assert {source}")
    assert signature_of_failure(crash(), failure) == signature_of_failure(
        Run(approaching()), failure
    )
