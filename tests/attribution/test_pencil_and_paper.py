"""The rules against a second program that was written from their page alone, and reasons against their traces.

The page is docs/explanation/verdicts.md.
"""

from collections import Counter

import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from tests.support.pencil_and_paper import judge
from tests.support.random_collisions import collision
from tests.support.reasons import numbers

SAMPLE = {
    "constant-speed": 8,
    "idm-mobil": 6,
    "careful-human": 6,
    "fuzzy-safety": 4,
    "idm-aeb": 6,
    "sound-lane-changer": 6,
    "erratic": 50,
    "stop-and-go": 30,
    "looks-only-ahead": 10,
    "sees-cut-ins-late": 8,
    "erratic, other roads": 16,
}
"""How many collisions of each policy; those of which a collision is soon found."""


@pytest.fixture(scope="module")
def collisions():
    """By policy and number."""
    return {(policy, number): collision(policy, number).trace for policy in SAMPLE for number in range(SAMPLE[policy])}


def test_a_program_written_from_the_page_alone_comes_to_the_same_verdicts(collisions):
    differ = {}
    for name, trace in collisions.items():
        package, page = rss_rule(trace), judge(trace)
        verdicts = [(each.responsibility, each.fault, each.tick) for each in (package, page)]
        if verdicts[0] != verdicts[1]:
            differ[name] = (*verdicts, package.reason)
    assert differ == {}


def test_every_number_of_a_reason_holds_at_the_time_that_it_names(collisions):
    differ = {}
    for name, trace in collisions.items():
        verdict = rss_rule(trace)
        said, true = numbers(trace, verdict)
        if said != true:
            differ[name] = (verdict.reason, true)
    assert differ == {}


def test_the_collisions_are_of_every_kind(collisions):
    kinds = Counter((verdict.responsibility, verdict.fault) for verdict in map(rss_rule, collisions.values()))
    assert kinds.keys() >= {
        ("npc", None),
        ("ego", "entered-lane"),
        ("both", "entered-lane"),
        ("ego", "leader-unanswered"),
        ("ego", "cut-in-unanswered"),
        ("both", "cut-in-unanswered"),
        ("both", "braked-for-nothing"),
        ("both", "stopped-for-nothing"),
    }
