"""The excuse "too little time" is tested by a driver that takes over: when it does, what counts, and what is said."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.attribution.takeovers import Escape, escape
from pytest_pafot.model.trace import SPEED, Outcome
from tests.helpers.situations import cut_in

LATE = cut_in(16.0, slower=8.0, ego_brakes=[(3.7, 6.0, 0.0)])
"""An NPC crosses the line at 2.3 s; it can be seen from 2.2 s on. The ego brakes when it must, and hits it at 5.1 s."""


def driven(since, braking, ticks=300, **changes):
    """Return a run in which a driver brakes from a tick on at a rate [m/s^2], and the end of the run is changed."""
    states = np.concatenate([LATE.states, LATE.states[-1:].repeat(ticks - LATE.ticks, axis=0)])
    speeds = np.maximum(states[since, 0, SPEED] - braking * np.arange(len(states) - since) / LATE.physics_hz, 0.0)
    states[since:, 0, SPEED] = speeds
    return replace(LATE, states=states, **{"outcome": Outcome.SAFE, "collision": None, **changes})


def escaped(taken, trace=LATE, drivers=("careful-human",)):
    """Return the escape if a driver's run is this one, and when which driver took over."""
    asked = []

    def take_over(given, tick, name):
        assert given is trace
        asked.append((tick, name))
        return taken

    take_over.drivers = drivers
    return escape(trace, take_over), asked


def test_driver_takes_over_at_the_time_that_the_verdict_names():
    assert rss_rule(LATE).sentences[1] == "The ego had too little time to respond, by the rules."
    found, asked = escaped(driven(36, 7.5))
    moment = rss_rule(LATE).tick
    every = LATE.physics_hz // LATE.ads_hz
    assert asked == [(moment // every * every, "careful-human")]
    assert found.time == pytest.approx(asked[0][0] / LATE.physics_hz, abs=1e-3)


def test_escape_has_the_braking_and_when_the_rules_require_it():
    found, _ = escaped(driven(45, 7.5))
    assert found.braking == pytest.approx(7.5)
    assert found.braking_from == 3.0
    assert found.required == 3.0
    seen = min(tick for tick in range(len(LATE.states)) if abs(LATE.states[tick, 1, 1]) > 0.375) / LATE.physics_hz
    assert found.due == pytest.approx(seen + 1.4, abs=1e-3)
    assert found.sentences == (
        f"careful-human, taking over at {found.time:.1f} s, avoids it: it brakes at up to 7.5 m/s^2 from 3.0 s on.",
        f"The rules require braking only from {found.due:.1f} s on, and no harder than 6.0 m/s^2.",
    )


@pytest.mark.parametrize(
    ("braking", "since", "said"),
    [
        (3.0, 3.0, "The rules require braking only from 3.6 s on."),
        (7.5, 3.6, "The rules require braking no harder than 6.0 m/s^2."),
        (5.0, 3.6, "The rules require braking no harder than 3.0 m/s^2 unless in an emergency."),
        (3.0, 3.6, "It needs no more than the rules require."),
    ],
)
def test_only_what_exceeds_the_rules_is_told(braking, since, said):
    found = Escape(time=2.2, driver="idm-aeb", braking=braking, braking_from=since, due=3.6, required=3.0)
    assert found.sentences[1] == said


def test_driver_that_need_not_brake_has_one_sentence():
    found = Escape(time=2.2, driver="idm-aeb", braking=0.0, braking_from=2.2, due=3.6, required=3.0)
    assert found.sentences == ("idm-aeb, taking over at 2.2 s, avoids it without braking.",)


@pytest.mark.parametrize("ending", [{"outcome": Outcome.INVALID}, {"outcome": Outcome.COLLISION}])
def test_driver_that_collides_does_not_escape(ending):
    assert escaped(driven(36, 7.5, ticks=100, **ending))[0] is None


@pytest.mark.parametrize(
    ("longer", "is_free"),
    [(driven(36, 7.5), True), (driven(36, 7.5, ticks=150, outcome=Outcome.COLLISION), False), (None, False)],
)
def test_driver_escapes_only_if_it_is_driven_for_twelve_seconds(longer, is_free):
    asked = []

    def take_over(trace, tick, name):
        return driven(36, 7.5, ticks=100)

    def lasting(seconds):
        asked.append(seconds)
        return None if longer is None else lambda *_: longer

    take_over.lasting = lasting
    found = escape(LATE, take_over)
    assert (found is not None) == is_free
    assert asked == [pytest.approx(rss_rule(LATE).tick / LATE.physics_hz + 12.0, abs=0.4)]


def test_run_that_does_not_repeat_shows_nothing():
    assert escaped(driven(10, 7.5))[0] is None


def test_other_verdicts_are_not_simulated():
    blamed = cut_in(16.0, slower=8.0)
    assert rss_rule(blamed).responsibility == "ego"
    assert escaped(driven(36, 7.5), blamed) == (None, [])


@pytest.mark.parametrize(
    ("drivers", "chosen"),
    [(("idm-aeb", "careful-human"), ["careful-human"]), (("mine", "yours"), ["mine"]), (("steady-braking",), [])],
)
def test_careful_human_comes_before_a_worlds_first_driver(drivers, chosen):
    assert [name for _, name in escaped(driven(36, 7.5), drivers=drivers)[1]] == chosen
