"""What a vehicle should have done and did: the story that the sentences tell, against plans."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.attribution.responses import FINEST, MOST, NEAR, What, answer, due_by, phases_of, sentences
from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.model.trace import Outcome
from tests.helpers import junctions
from tests.helpers.drives import crash, driven
from tests.helpers.junctions import plan
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle

STORIES = {
    "nothing": ([], (40.0, 10.0), "hard by 2.6 s but did not."),
    "braked weakly, then sped up": (
        [(3.0, 1.9, 16.0), (5.2, -2.0, 25.0)],
        (60.0, 10.0),
        "hard by 5.7 s. It drove 20.0 m/s at 0.0 s; from 3.0 s it braked at up to 1.9 m/s^2, to 16.0 m/s. "
        "From 5.1 s it sped up to 18.1 m/s.",
    ),
    "softly, hard too late": (
        [(0.3, 0.8, 17.0), (2.3, 8.5, 0.0)],
        (29.0, 10.0),
        "harder by 1.8 s. It drove 20.0 m/s at 0.0 s and braked at up to 0.8 m/s^2, to 18.4 m/s. "
        "From 2.3 s it braked at up to 8.5 m/s^2, to 14.4 m/s.",
    ),
    "on and off": (
        [(2.0, 4.0, 16.0), (3.5, -3.0, 20.0), (5.0, 4.0, 16.0)],
        (50.0, 10.0),
        "From 3.0 s it kept 16.0 m/s; from 3.5 s it sped up to 20.0 m/s. "
        "From 4.8 s it kept 20.0 m/s; from 5.0 s it braked at up to 4.0 m/s^2, to 19.2 m/s.",
    ),
    "braked just before the danger": (
        [(1.0, 4.0, 16.0)],
        (56.0, 10.0),
        "It drove 20.0 m/s at 0.3 s; from 1.0 s it braked at up to 4.0 m/s^2, to 16.0 m/s. "
        "From 2.0 s it kept 16.0 m/s.",
    ),
    "eased off, then braked harder too late": (
        [(0.6, 3.0, 16.0), (1.9, 0.8, 15.0), (3.2, 4.0, 0.0)],
        (46.0, 6.0),
        "harder by 2.8 s. It drove 20.0 m/s at 0.0 s; from 0.6 s it braked at up to 3.0 m/s^2, to 16.2 m/s. "
        "From 1.9 s it braked at up to 0.8 m/s^2, to 15.1 m/s. From 3.2 s it braked at up to 4.0 m/s^2, to 13.0 m/s.",
    ),
    "sped up when braking was due": (
        [(1.0, -2.0, 30.0)],
        (60.0, 10.0),
        "hard by 3.2 s but did not. It drove 20.0 m/s at 0.0 s; from 1.0 s it sped up to 26.8 m/s.",
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


def test_driver_that_had_just_stood_should_have_waited():
    waits_then_goes = plan("west straight", 4, 8, (2.0, -3.5, 0.0), (8.0, 2.5, 8.0))
    trace = junctions.hit(waits_then_goes, plan("north straight", 10.5, 8))
    told = rss_rule(trace).sentences
    assert told[1] == "The ego should have waited but set off at 8.0 s."


@table(("helps", "due"), [
    (range(5, 20), 19),  # until this tick
    (range(40, 45), 44),  # which may be the last one before the impact
    ((*range(5, 20), *range(25, 27)), 19),  # and for a moment later on
    ((*range(5, 20), *range(30, 40)), 39),
    ((*range(20, 22), *range(23, 25), *range(26, 28)), None),  # never for long
    ((), None),
])  # fmt: skip
def test_braking_is_due_at_the_end_of_the_last_time_in_which_it_helps(helps, due):
    speeds = np.append(np.full(45, 20.0), 19.9)
    trace = trace_of(vehicle(np.arange(46.0), speed=speeds), vehicle(60.0), outcome=Outcome.COLLISION)
    fact = answer(trace, 0, 0, lambda tick, rate: tick in helps).in_full
    wanted = (What.DROVE, None) if due is None else (What.SHOULD_HAVE_BRAKED, due / 15)
    assert (fact.what, fact.due_s) == wanted


@given(
    steps=st.lists(st.tuples(st.integers(2, 30), st.sampled_from([-8.0, -3.0, -1.0, 0.0, 1.5, 3.0])), min_size=1),
    hz=st.sampled_from([5, 15, 100]),
)
def test_phases_join_to_nearly_the_recorded_speed(steps, hz):
    gains = np.concatenate([np.full(count, rate / hz) for count, rate in steps])
    speeds = np.maximum(np.concatenate(([20.0], 20.0 + np.cumsum(gains))), 0.0)
    phases = phases_of(speeds, hz, 0)
    assert [each.until_s for each in phases[:-1]] == [each.time_s for each in phases[1:]]
    assert (phases[0].time_s, phases[-1].until_s) == (0.0, (len(speeds) - 1) / hz)
    assert len(phases) <= MOST
    times = [phases[0].time_s, *(each.until_s for each in phases)]
    told = [phases[0].first_m_per_s, *(each.last_m_per_s for each in phases)]
    far = np.abs(np.interp(np.arange(len(speeds)) / hz, times, told) - speeds).max()
    if len(phases) < MOST and len(speeds) < FINEST:
        assert far <= NEAR + 1e-6


def test_both_vehicles_that_failed_at_a_crossing_are_told():
    trace = junctions.random_collision(154)
    found = rss_rule(trace)
    assert (found.responsibility, found.fault) == ("both", "did-not-give-way")
    assert [each.vehicle for each in found.facts] == [0, 0, 1]
    assert [each.in_full.what for each in found.facts[1:]] == [What.SHOULD_HAVE_BRAKED, What.SHOULD_HAVE_WAITED]


def test_braking_of_the_ego_does_not_move_what_the_npc_owed():
    facts = rss_rule(junctions.random_collision(71)).facts
    assert [f"{each.in_full.due_s:.1f}" for each in facts[1:]] == ["3.6", "5.1"]
    assert [f"{each.due_s:.1f}" for each in due_by(facts, 3.5)[1:]] == ["3.5", "5.1"]


def test_braking_that_answered_a_cut_in_is_told():
    named = {each.name: each for group in SITUATIONS.values() for each in group}
    found = rss_rule(named["sped-up-after-it-had-survived-a-cut-in"].trace())
    assert found.sentences[1:] == (
        "The ego should have braked hard by 5.9 s.",
        "It drove 20.0 m/s at 0.9 s; from 2.6 s it braked at up to 8.0 m/s^2, to 15.2 m/s.",
        "From 3.2 s it kept 15.0 m/s; from 4.4 s it sped up to 20.6 m/s.",
    )


@table("latest, says", [
    (6.0, "The ego should have braked hard by 5.7 s."),
    (1.2, "The ego should have braked hard by 1.2 s."),
    (0.5, "The ego drove 20.0 m/s at 0.0 s; from 3.0 s it braked at up to 1.9 m/s^2, to 16.0 m/s."),
])  # fmt: skip
def test_no_text_requires_braking_that_comes_too_late(latest, says):
    brakes, (ahead, speed), _ = STORIES["braked weakly, then sped up"]
    found = rss_rule(crash(driven(0.0, brakes=brakes), driven(ahead, speed=speed)))
    first, *others = sentences(due_by(found.facts, latest))
    assert first == found.sentences[0]
    assert others[0] == says
