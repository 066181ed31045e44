"""The runs of a replay, and the label that follows from them."""

from dataclasses import replace
from typing import get_args

from pytest_pafot.findings.finding import FailureRate
from pytest_pafot.findings.sighting import (
    GROUPS,
    UNREAD,
    Beyond,
    Died,
    Discovery,
    FoundElsewhere,
    Label,
    New,
    NotFound,
    NotMade,
    Replay,
    Shows,
    Which,
    label,
)
from pytest_pafot.findings.verdict import Severity
from tests.findings.builders import REPLAYS, judged, measured, sighting, tried
from tests.helpers.tables import table

PASS, MISSED = tried(Shows.HANDLED), tried(Shows.NOTHING)
SAME, OTHER = tried(Shows.SAME), tried(Shows.OTHER)
LOST = Died(end="was ended by SIGSEGV", pid=7)
LATER, AGAIN = Which.CONTINUED, Which.AS_SAVED_AGAIN
GOES_ON, CONFIRMED = tried(Shows.NOTHING, LATER), tried(Shows.NOTHING, Which.CONTINUED_AGAIN)
NOT_CONFIRMED = tried(Shows.NOTHING, Which.CONTINUED_AGAIN, repeats=False)
DIED_LATER = tried(Shows.ONLY_NOTED, LATER, ended=LOST)
NOT_MADE = tried(Shows.ONLY_NOTED, LATER, ended=NotMade())
SAME_LATER, NOTED = tried(Shows.SAME, LATER), tried(Shows.ONLY_NOTED, LATER)
OTHERWISE, SAME_OTHERWISE = (
    tried(each, LATER, repeats=False) for each in (Shows.NOTHING, Shows.SAME)
)
REPEATED = {each: tried(each, Which.REPEATED) for each in Shows}
NEVER, TWICE = measured(FailureRate(failing=0)), measured(FailureRate(failing=2))
NO_SITUATION = (REPEATED[Shows.NOTHING],) * 10

ACCEPTED, BEYOND = {"acceptance": "accepted"}, {"acceptance": Beyond(why="NPC 1 hits the ego")}
NOT_FOUND, FOUND = {"search": NotFound(runs=40, drawn=40)}, {"search": FoundElsewhere(id="hit-2")}
FAILS_TOO, BOTH_PASS = {"reference": (OTHER,)}, {"reference": (PASS,)}
ELSEWHERE, RARE, FLAKY = {"is_elsewhere": True}, {"is_rare": True}, {"is_flaky": True}


@table(("expected", "tries", "facts"), [
    # The first run fails, as the file states or otherwise, whatever a search finds.
    ("still failing", [SAME], {}),
    ("still failing", [SAME], ELSEWHERE | BOTH_PASS),
    ("still failing", [SAME], FAILS_TOO),
    ("still failing", [SAME], NOT_FOUND),
    ("still failing", [SAME], FLAKY),
    ("still failing", [tried(Shows.SAME, ended=LOST)], {}),
    ("drifted", [OTHER], {}),
    ("drifted", [OTHER], FOUND),
    ("drifted", [tried(Shows.OTHER, ended=LOST)], {}),
    # It fails past the end of the file, and does so again.
    ("still failing", [PASS, SAME_LATER, CONFIRMED], {}),
    ("still failing", [MISSED, SAME_LATER, CONFIRMED], {}),
    ("still failing", [PASS, tried(Shows.SAME, LATER, ended=LOST)], {}),
    # A process dies up to the end of the file, although the first one did not.
    ("still failing", [PASS, DIED_LATER, tried(Shows.SAME, AGAIN, ended=LOST)], {}),
    ("drifted", [PASS, NOT_MADE, tried(Shows.OTHER, AGAIN, ended=LOST)], {}),
    # The runs differ by chance, so nothing else counts.
    ("flaky", [PASS, SAME_LATER, NOT_CONFIRMED], {}),
    ("flaky", [PASS, OTHERWISE], NOT_FOUND),
    ("flaky", [PASS, SAME_OTHERWISE], {}),
    ("flaky", [PASS, SAME_OTHERWISE], FAILS_TOO),
    ("flaky", [PASS, DIED_LATER, tried(Shows.NOTHING, AGAIN, repeats=False)], {}),
    ("flaky", [PASS, DIED_LATER, tried(Shows.SAME, AGAIN, repeats=False)], {}),
    ("flaky", [PASS, GOES_ON], FLAKY),
    ("flaky", [PASS, SAME_LATER], FLAKY),
    ("flaky", [PASS, SAME_LATER, NOT_CONFIRMED], BEYOND),
    # The file accepts its failure, or one that passes by chance.
    ("accepted", [SAME], ACCEPTED),
    ("accepted", [OTHER], ACCEPTED),
    ("accepted", [PASS, GOES_ON], ACCEPTED | FLAKY),
    ("accepted", [PASS, SAME_LATER, NOT_CONFIRMED], ACCEPTED),
    ("passes", [PASS, GOES_ON], ACCEPTED),
    ("still failing", [SAME], BEYOND),
    ("drifted", [OTHER], BEYOND),
    # Of ten runs, some fail: as the file states, which counts more than any other failure.
    ("still failing", [PASS, GOES_ON, *NEVER[1:], REPEATED[Shows.SAME]], RARE),
    ("still failing", [SAME, *NEVER], {}),
    ("still failing", [OTHER, *NEVER[1:], REPEATED[Shows.SAME]], {}),
    ("still failing", [PASS, OTHERWISE, *NEVER[1:], REPEATED[Shows.SAME]], {}),
    ("drifted", [PASS, *TWICE], FLAKY),
    ("drifted", [PASS, OTHERWISE, *TWICE], {}),
    ("drifted", [SAME, *NEVER[1:], tried(Shows.OTHER, Which.REPEATED, ended=LOST)], {}),
    ("flaky", [PASS, OTHERWISE, *NEVER], {}),
    ("flaky", [PASS, OTHERWISE, tried(Shows.SAME, Which.REPEATED, ended=LOST)], {}),
    ("passes", [PASS, *NEVER], FLAKY),
    ("passes", [MISSED, *NEVER], {}),
    ("passes", [PASS, *NO_SITUATION], {}),
    ("drifted", [MISSED, *NO_SITUATION], {}),
    # The failure was rare before, so ten passes do not show a fix.
    ("drifted", [PASS, *NEVER], RARE | NOT_FOUND),
    ("drifted", [PASS, *NEVER], RARE | BOTH_PASS),
    ("passes", [PASS, *NEVER], RARE | FAILS_TOO),
    # It passes, but in other conditions, unless the reference fails in the same ones.
    ("drifted", [PASS, GOES_ON], ELSEWHERE),
    ("drifted", [PASS, GOES_ON], ELSEWHERE | NOT_FOUND),
    ("drifted", [PASS, GOES_ON], ELSEWHERE | BOTH_PASS),
    ("passes", [PASS, GOES_ON], ELSEWHERE | FAILS_TOO),
    ("fixed", [PASS, GOES_ON], ELSEWHERE | FAILS_TOO | NOT_FOUND),
    # It passes, but the saved situation did not occur, or its collision only occurs later.
    ("drifted", [MISSED, GOES_ON], {}),
    ("drifted", [MISSED, GOES_ON], NOT_FOUND),
    ("drifted", [MISSED, GOES_ON], FOUND),
    ("drifted", [MISSED, GOES_ON], FAILS_TOO),
    ("drifted", [PASS, tried(Shows.STILL_COLLIDES, LATER)], NOT_FOUND),
    ("drifted", [PASS, tried(Shows.STILL_COLLIDES, LATER), *NO_SITUATION], {}),
    ("passes", [PASS, tried(Shows.STILL_COLLIDES, LATER), *NEVER], {}),
    # It passes. What happens past the end, and is not the file's failure, does not matter.
    ("passes", [PASS], {}),
    ("passes", [PASS, NOTED], {}),
    ("passes", [PASS, DIED_LATER, tried(Shows.NOTHING, AGAIN)], {}),
    ("passes", [PASS, NOT_MADE, tried(Shows.NOTHING, AGAIN)], {}),
    ("passes", [PASS, GOES_ON], BOTH_PASS),
    ("passes", [PASS, GOES_ON], FAILS_TOO),
    ("fixed", [PASS, GOES_ON], NOT_FOUND),
    ("fixed", [PASS, GOES_ON], NOT_FOUND | BOTH_PASS),
    ("still failing", [PASS, GOES_ON], FOUND),
])  # fmt: skip
def test_each_label_follows_from_the_runs(expected, tries, facts):
    assert label(Replay(tries=tuple(tries), **facts)) == expected


@table("new", get_args(New))
def test_new_finding_has_the_label_that_its_search_gives_it(new):
    assert label(Discovery(label=new, ended=judged(Shows.SAME))) == new


@table(("expected", "tries"), [
    (PASS, [PASS, GOES_ON]),
    (SAME_LATER, [PASS, SAME_LATER, CONFIRMED]),
    (OTHER, [OTHER]),
    (REPEATED[Shows.SAME], [OTHER, REPEATED[Shows.OTHER], REPEATED[Shows.SAME], REPEATED[Shows.OTHER]]),
    (TWICE[1], [PASS, *TWICE]),
    (tried(Shows.SAME, AGAIN, ended=LOST), [PASS, DIED_LATER, tried(Shows.SAME, AGAIN, ended=LOST)]),
    (PASS, [PASS, DIED_LATER, tried(Shows.NOTHING, AGAIN)]),
])  # fmt: skip
def test_replay_shows_the_saved_failure_or_the_last_other_one_or_the_first_pass(expected, tries):
    assert Replay(tries=tuple(tries)).shown is expected or expected.ended is LOST
    assert Replay(tries=tuple(tries)).shown == expected


CONTINUED_DEATH = tried(Shows.NOTHING, LATER, ended=LOST)


@table(("expected", "tries", "reference"), [
    (True, [PASS, DIED_LATER, tried(Shows.NOTHING, AGAIN)], []),
    (True, [PASS, NOT_MADE, tried(Shows.NOTHING, AGAIN)], []),
    (True, [PASS, GOES_ON], [PASS, CONTINUED_DEATH]),
    # The item reports the death.
    (False, [PASS, DIED_LATER, tried(Shows.OTHER, AGAIN, ended=LOST)], []),
    (False, [PASS, tried(Shows.SAME, LATER, ended=LOST)], []),
    (False, [tried(Shows.SAME, ended=LOST)], []),
    # Up to the end of the file, only a separate process runs the reference.
    (False, [PASS], [tried(Shows.OTHER, ended=LOST)]),
    (False, [PASS, GOES_ON], []),
])  # fmt: skip
def test_crash_record_stays_after_a_death_past_the_end(expected, tries, reference):
    assert Replay(tries=tuple(tries), reference=tuple(reference)).keeps_record is expected


HIT = Severity(kind="collision", value=8.2, unit="m/s")
REFERENCE_HITS = tried(Shows.SAME, LATER, severity=HIT)


@table(("tries", "reference", "passes", "before", "compared"), [
    ([SAME], [], None, None, ""),
    ([SAME], [PASS], True, None, "introduced"),
    ([SAME], [tried(Shows.OTHER, severity=HIT)], False, HIT, "common"),
    ([SAME_LATER], [PASS, GOES_ON], True, None, "introduced"),
    ([SAME_LATER], [PASS, REFERENCE_HITS], False, HIT, "common"),
    ([PASS], [PASS, REFERENCE_HITS], False, None, "fixed"),
    ([PASS], [PASS], True, None, ""),
    ([MISSED], [OTHER], False, None, ""),
    ([PASS, OTHERWISE], [OTHER], False, None, ""),
])  # fmt: skip
def test_reference_passes_unless_one_of_its_runs_fails(tries, reference, passes, before, compared):
    now = Replay(tries=tuple(tries), reference=tuple(reference))
    assert (now.reference_passes, now.before) == (passes, before)
    assert replace(sighting(), observed=now).compared == compared


def test_every_label_is_a_group_or_told_as_one():
    assert {*GROUPS} - {*get_args(Label)} == {*get_args(New), *PASSED}
    assert {*get_args(Label)} - {*GROUPS} == {"fixed", "passes"}
    assert UNREAD in get_args(Label)


PASSED = "passed", "passed (found in another scenario)", "passed (not found again)"


@table(("result", "known", "more"), [
    ("still failing", "still failing", {}),
    (PASSED[0], "passes", {}),
    (PASSED[1], "passes", FOUND),
    (PASSED[2], "fixed", {}),
])  # fmt: skip
def test_summaries_call_no_pass_a_fix_and_no_pass_a_failure(result, known, more):
    assert sighting("a", label=known).with_observed(**more).result == result
    assert result in GROUPS


@table("known", sorted(REPLAYS))
def test_builders_of_replays_have_the_labels_that_they_are_named_after(known):
    assert label(REPLAYS[known]) == known.replace("introduced", "still failing")
