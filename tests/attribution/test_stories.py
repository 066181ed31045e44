"""What a vehicle should have done and did: the story that the sentences tell, against plans and against the trace."""

import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.attribution.sentences import What, due_by, sentences
from tests.helpers import junctions
from tests.helpers.drives import crash, driven
from tests.helpers.junctions import plan
from tests.helpers.random_collisions import collision
from tests.helpers.situations import SITUATIONS
from tests.helpers.stories import Story, entry_of, stories_of
from tests.helpers.tables import table

WEAKLY_THEN_UP = [(3.0, 1.9, 16.0), (5.2, -2.0, 25.0)]
WAITS_THEN_GOES = plan("west straight", 4, 8, (2.0, -3.5, 0.0), (8.0, 2.5, 8.0))

STORIES = {
    "nothing": ([], (40.0, 10.0), "from 0.9 s but did not."),
    "braked weakly, then sped up": (
        WEAKLY_THEN_UP,
        (60.0, 10.0),
        "It braked with up to 1.9 m/s^2 only from 3.0 s on, but sped up from 5.2 s on, to 18.1 m/s.",
    ),
    "let go": (
        [(2.0, 4.0, 14.0)],
        (40.0, 10.0),
        "It braked with up to 4.0 m/s^2 only from 2.0 s on, but released the brakes at 3.5 s.",
    ),
    "softly, hard too late": (
        [(0.3, 0.8, 17.0), (2.3, 8.5, 0.0)],
        (29.0, 10.0),
        "should have braked harder from 0.9 s. It braked with up to 0.8 m/s^2 from 0.3 s on. "
        "Then it braked harder, with up to 8.5 m/s^2, only from 2.3 s on.",
    ),
    "on and off": (
        [(2.0, 4.0, 16.0), (3.5, -3.0, 20.0), (5.0, 4.0, 16.0)],
        (50.0, 10.0),
        "It braked with up to 4.0 m/s^2 only from 2.0 s on, but sped up from 3.5 s on, to 20.0 m/s. "
        "Then it braked again with up to 4.0 m/s^2 from 5.0 s on.",
    ),
    "braked hard enough when it was due, then let go": (
        [(0.5, 4.0, 14.0)],
        (40.0, 10.0),
        "The ego braked with up to 4.0 m/s^2 from 0.5 s on. It should have kept braking but released the brakes at "
        "2.1 s.",
    ),
    "braked just before the danger": (
        [(1.0, 4.0, 16.0)],
        (56.0, 10.0),
        "The ego braked with up to 4.0 m/s^2 from 1.0 s on, but released the brakes at 2.0 s. "
        "It should have braked again from 3.2 s but did not.",
    ),
    "coasted between two brakings": (
        [(2.0, 4.0, 16.0), (4.5, 4.0, 14.0)],
        (55.0, 8.0),
        "It braked with up to 4.0 m/s^2 only from 2.0 s on, but released the brakes at 3.0 s. "
        "Then it braked again with up to 4.0 m/s^2 from 4.5 s on.",
    ),
    "eased off, then braked harder too late": (
        [(0.6, 3.0, 16.0), (1.9, 0.8, 15.0), (3.2, 4.0, 0.0)],
        (46.0, 6.0),
        "but eased off from 1.9 s on, to 0.8 m/s^2. Then it braked harder, with up to 4.0 m/s^2, from 3.2 s on.",
    ),
    "hard only at last": (
        [(0.5, 2.0, 16.0), (2.5, 3.6, 0.0)],
        (38.0, 8.0),
        "It braked from 0.5 s on, with up to 3.6 m/s^2 at 2.5 s.",
    ),
    "sped up before it braked too weakly": (
        [(0.0, -2.0, 21.0), (0.6, 1.0, 0.0)],
        (40.0, 10.0),
        "It sped up from 0.0 s on, to 21.0 m/s, and braked with up to 1.0 m/s^2 from 0.6 s on.",
    ),
    "sped up when braking was due": (
        [(1.0, -2.0, 30.0)],
        (60.0, 10.0),
        "Instead it sped up from 1.0 s on, to 26.8 m/s.",
    ),
}
"""The plan of an ego that drives 20 m/s, the distance [m] and speed [m/s] of the NPC ahead, and the end of the text."""


@table("name", list(STORIES))
def test_deeds_are_told_in_their_order(name):
    brakes, (ahead, speed), says = STORIES[name]
    trace = crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed))
    found = rss_rule(trace)
    assert found.responsibility == "ego"
    assert found.reason.endswith(says)
    assert [each.wrong() for each in stories_of(trace, found.sentences)] == [[]]


def test_driver_that_stood_should_have_waited():
    trace = junctions.hit(WAITS_THEN_GOES, plan("north straight", 10.5, 8))
    told = rss_rule(trace).sentences
    assert told[1] == "The ego should have waited but set off at 8.0 s."
    assert [each.wrong(entry_of(trace, told, 0)) for each in stories_of(trace, told)] == [[]]


def test_braking_is_due_only_while_it_avoids_the_collision():
    """An ego that speeds up after the danger has begun has less time than one that keeps its speed."""
    npc = driven(40.0, speed=12.0)
    faster = crash(driven(0.0, speed=20.0, brakes=[(0.5, -6.0, 32.0)]), npc)
    fact = rss_rule(faster).facts[-1].in_full
    assert (fact.what, fact.time_s) == (What.SHOULD_HAVE_BRAKED, rss_rule(crash(driven(0.0), npc)).facts[-1].time_s)
    (story,) = stories_of(faster, rss_rule(faster).sentences)
    free = [tick for tick in range(story.end) if story.is_free(tick)]
    assert fact.due_s * 15 == pytest.approx(min(max(free), (fact.time_s + 1.0) * 15 - 1), abs=1)


FALSE = [
    ("The ego should have braked from 1.7 s but did not.", ["braking is told"]),
    ("The ego should have braked from 6.0 s. It braked with up to 1.9 m/s^2 from 3.0 s on.", ["due in time"]),
    ("The ego should have braked from 1.7 s. Instead it sped up from 5.2 s on, to 18.1 m/s.", ["braking is told"]),
    ("The ego should have braked from 1.7 s. It braked with up to 1.9 m/s^2 from 4.0 s on.", ["braked from"]),
    ("The ego should have braked from 1.7 s. It braked with up to 2.9 m/s^2 from 3.0 s on.", ["braked up to"]),
    ("The ego should have braked from 1.7 s. It braked with up to 1.9 m/s^2 from 3.0 s on.", ["speeding up is told"]),
    ("The ego should have braked harder from 1.7 s but did not.", ["braking when it was due"]),
    ("The ego should have braked from 1.7 s. It eased off from 4.0 s on, to 1.9 m/s^2.", ["harder than before"]),
    ("The ego should have kept braking hard from 4.0 s on.", ["braking so hard when due"]),
    ("The ego should have waited but set off at 5.2 s.", ["set off"]),
    ("The ego should not have sped up from 3.0 s on, to 18.1 m/s.", ["braking is told"]),
    ("The ego should not have sped up from 5.2 s on, to 19.1 m/s.", ["to"]),
    (
        "The ego should have braked from 1.7 s. It braked with up to 1.9 m/s^2 from 3.0 s on, but released the brakes "
        "at 4.0 s.",
        ["released"],
    ),
    (
        "The ego should have braked from 1.7 s. It sped up from 5.2 s on, to 18.1 m/s, and braked with up to 1.9 m/s^2 "
        "from 3.0 s on.",
        ["order"],
    ),
]


OF_LULL = [
    ("The ego should have braked harder from 0.9 s. It braked with up to 4.0 m/s^2 from 0.6 s on.", "easing is told"),
    (
        "The ego should have braked from 0.9 s. It braked with up to 3.0 m/s^2 from 0.6 s on, but eased off from 1.9 s "
        "on, to 0.8 m/s^2.",
        "braking after the lull is told",
    ),
    (
        "The ego should have braked from 0.9 s. It braked from 0.6 s on, with up to 4.0 m/s^2 at 2.5 s.",
        "place of the peak",
    ),
    ("The ego should have braked from 0.9 s. Instead it sped up from 0.5 s on, to 20.0 m/s.", "instead"),
]


@table("told, wrong", OF_LULL)
def test_the_oracle_misses_no_lull_and_no_peak(told, wrong):
    brakes, (ahead, speed), _ = STORIES["eased off, then braked harder too late"]
    trace = crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed))
    assert wrong in Story(trace, told, rss_rule(trace).sentences[0]).wrong()


def test_the_oracle_misses_no_late_peak_without_its_time():
    brakes, (ahead, speed), _ = STORIES["hard only at last"]
    trace = crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed))
    told = "The ego should have braked harder from 0.9 s. It braked with up to 3.6 m/s^2 from 0.5 s on."
    assert Story(trace, told).wrong() == ["place of the peak"]


@table("begin, is_wrong", [("5.2", False), ("6.5", True)])
def test_the_oracle_knows_where_a_rise_began(begin, is_wrong):
    brakes, (ahead, speed), _ = STORIES["braked weakly, then sped up"]
    trace = crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed))
    told = f"The ego should have braked from 1.7 s. Instead it sped up from {begin} s on, to 18.1 m/s."
    assert ("beginning of the rise" in Story(trace, told).wrong()) == is_wrong


def test_both_vehicles_that_failed_at_a_crossing_are_told():
    trace = collision("by hand, junctions", 31, seed=3).trace
    found = rss_rule(trace)
    assert (found.responsibility, found.fault) == ("both", "did-not-give-way")
    assert [each.vehicle for each in found.facts] == [0, 0, 1]
    assert found.sentences[1:] == (
        "The ego should have braked from 1.5 s.",
        "It braked with up to 7.6 m/s^2 only from 1.8 s on, but set off at 4.7 s and sped up to 0.6 m/s.",
        "NPC 0 should have waited but set off at 7.8 s.",
    )
    stories = stories_of(trace, found.sentences)
    assert [each.wrong(entry_of(trace, found.sentences, each.vehicle)) for each in stories] == [[], []]


def test_braking_of_the_ego_does_not_move_what_the_npc_owed():
    facts = rss_rule(collision("by hand, junctions", 45, seed=2).trace).facts
    assert [f"{each.in_full.due_s:.1f}" for each in facts[1:]] == ["3.9", "5.5"]
    assert [f"{each.due_s:.1f}" for each in due_by(facts, 3.8)[1:]] == ["3.8", "5.5"]


OF_KEPT_BRAKING = [
    ("The ego should have braked harder from 0.9 s. It braked with up to 4.0 m/s^2 from 0.5 s on.", "harder is needed"),
    ("The ego should have braked harder from 0.9 s. It braked with up to 4.0 m/s^2 from 0.5 s on.", "release is told"),
    ("The ego should have braked again from 3.2 s but did not.", "braking is told"),
    ("The ego should have kept braking with 5.0 m/s^2 from 0.9 s on.", "braking so hard when due"),
]


@table("told, wrong", OF_KEPT_BRAKING)
def test_the_oracle_misses_no_braking_after_the_danger(told, wrong):
    brakes, (ahead, speed), _ = STORIES["braked hard enough when it was due, then let go"]
    trace = crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed))
    assert wrong in Story(trace, told, rss_rule(trace).sentences[0]).wrong()


def test_braking_that_answered_a_cut_in_is_told_before_the_second_chance():
    named = {each.name: each for group in SITUATIONS.values() for each in group}
    found = rss_rule(named["sped-up-after-it-had-survived-a-cut-in"].trace())
    assert found.sentences[1:] == (
        "The ego braked with up to 8.0 m/s^2 from 2.6 s on, but released the brakes at 3.3 s.",
        "Then it sped up from 4.4 s on, to 20.6 m/s. It should have braked again from 5.9 s but did not.",
    )


@table("told, wrong", FALSE)
def test_the_oracle_finds_claims_that_the_trace_contradicts(told, wrong):
    brakes, (ahead, speed), _ = STORIES["braked weakly, then sped up"]
    trace = crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed))
    assert {*wrong} <= {*Story(trace, told).wrong()}


def test_due_after_the_entry_is_a_wrong_claim():
    trace = junctions.hit(WAITS_THEN_GOES, plan("north straight", 10.5, 8))
    told = rss_rule(trace).sentences[0], "The ego should have braked from 10.4 s."
    assert "due before the deed" in Story(trace, told[1]).wrong(entry_of(trace, told, 0))


@table(
    "latest, says",
    [
        (3.0, "The ego should have braked from 1.7 s."),
        (1.2, "The ego should have braked from 1.2 s."),
        (0.5, "The ego braked with up to 1.9 m/s^2 only from 3.0 s on, but sped up from 5.2 s on, to 18.1 m/s."),
    ],
)
def test_no_text_requires_braking_that_comes_too_late(latest, says):
    brakes, (ahead, speed), _ = STORIES["braked weakly, then sped up"]
    found = rss_rule(crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed)))
    first, *others = sentences(due_by(found.facts, latest))
    assert first == found.sentences[0]
    assert others[0] == says
