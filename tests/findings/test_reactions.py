"""What an ADS answers to: its decisions with and without one vehicle."""

from typing import ClassVar

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.findings.reactions import Reaction
from pytest_pafot.world.driving.perception import without

KEEPS, BRAKES = (0.0, 0.0), (-4.0, 0.0)


def reaction(actions, hidden, until=2.0):
    return Reaction.of(1, actions, hidden, times=[number / 5 for number in range(len(actions))], until=until)


def test_the_first_decision_that_differs_is_told_with_both_actions():
    found = reaction([KEEPS, KEEPS, BRAKES, BRAKES], [KEEPS, KEEPS, KEEPS, KEEPS])
    assert (found.time, found.before) == (0.4, 1.6)
    assert str(found) == (
        "reacts to NPC 1, first at 0.4 s, 1.6 s before the event: acceleration -4.0 m/s^2; "
        "with it hidden acceleration 0.0 m/s^2"
    )


@pytest.mark.parametrize(
    ("action", "other"),
    [
        (KEEPS, (0.19, 0.019)),
        (3, 3),
        (np.array([0.5]), np.array([0.54])),
        (pafot.Drive(lane=1, speed=2.0),) * 2,
        (pafot.Drive(lane=1, speed=2.0), pafot.Drive(lane=1, speed=2.19)),
    ],
)
def test_decisions_that_hardly_differ_are_no_reaction(action, other):
    found = reaction([action], [other])
    assert found.time is None
    assert str(found) == "never reacts to NPC 1: with it hidden, all decisions are the same"


@pytest.mark.parametrize(
    ("action", "other", "text"),
    [
        ((0.0, 0.0), (0.0, 0.03), "steering 0.00 rad; with it hidden steering 0.03 rad"),
        (3, 1, "3; with it hidden 1"),
        (
            pafot.Drive(lane=0, acceleration=-1.0312),
            pafot.Drive(lane=0, acceleration=0.5),
            "acceleration -1.0 m/s^2; with it hidden acceleration 0.5 m/s^2",
        ),
        (
            pafot.Drive(lane=0, speed=5.0, lateral_jerk=2.0),
            pafot.Drive(lane=1, acceleration=-4.0, lateral_jerk=2.1),
            "lane 0, speed 5.0 m/s; with it hidden lane 1, acceleration -4.0 m/s^2",
        ),
        (np.array([0.5]), np.array([0.1]), r"[0.5]; with it hidden [0.1]"),
        (KEEPS, None, "acceleration 0.0 m/s^2, steering 0.00 rad; with it hidden no decision"),
    ],
)
def test_each_kind_of_action_has_its_words(action, other, text):
    assert str(reaction([action], [] if other is None else [other])).endswith(f": {text}")


def test_a_vehicle_that_was_in_no_observation_is_told_apart():
    assert str(Reaction(npc=1, unseen=True)) == "never reacts to NPC 1, which is in none of its observations"


def test_decisions_after_the_event_do_not_count():
    assert reaction([KEEPS, KEEPS, BRAKES], [KEEPS, KEEPS, KEEPS], until=0.3).time is None


SCENARIO = pafot.Scenario(
    npcs=[[pafot.PositionInstruction(2, 5.0)], [pafot.PositionInstruction(6, 20.0)]], gene_seconds=10.0
)


class Listing:
    """Brakes for the nearest vehicle ahead, and lists which vehicles it saw."""

    seen: ClassVar[set] = set()

    def __call__(self, observation):
        self.seen.update(observation.ids)
        ahead = [other.x - observation.ego.x for other in observation.others if other.x > observation.ego.x]
        return (-3.0 if min(ahead, default=99.0) < 25.0 else 0.0), 0.0


@pytest.mark.parametrize("factory", [Listing, pafot.Perception(Listing, latency=0.2)], ids=["perfect", "late"])
def test_a_hidden_vehicle_is_seen_in_no_decision_and_the_others_as_before(factory):
    Listing.seen.clear()
    hidden = pafot.Highway().rollout(SCENARIO, without(factory, 0))
    assert Listing.seen == {1}
    whole = pafot.Highway().rollout(SCENARIO, factory)
    asked = {"times": [tick / whole.physics_hz for tick in whole.decision_ticks], "until": whole.duration}
    assert Reaction.of(0, whole.actions, hidden.actions, **asked).time is not None
    other = pafot.Highway().rollout(SCENARIO, without(factory, 1))
    assert Reaction.of(1, whole.actions, other.actions, **asked).time is None


def test_an_environments_observation_is_without_the_vehicle():
    seen = []

    def make():
        return lambda observation: seen.append(int(observation[1:, 0].sum())) or 1

    world = pafot.World("highway-v0")
    world.rollout(SCENARIO, make)
    assert seen[0] == 1  # the other one is behind
    seen.clear()
    world.rollout(SCENARIO, without(make, 0))
    assert set(seen) == {0}
