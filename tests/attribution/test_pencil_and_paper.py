"""The rules against a second program, written without a look at the first."""

from collections import Counter

import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from tests.helpers.pencil_and_paper import judge
from tests.helpers.random_collisions import collision
from tests.helpers.stages import mostly_oracle

SAMPLE = {
    "constant-speed": (8, 8),
    "idm-mobil": (3, 6),
    "careful-human": (3, 6),
    "erratic": (50, 50),
    "stop-and-go": (30, 30),
    "looks-only-ahead": (1, 10),
    "sees-cut-ins-late": (0, 8),
    "erratic, other roads": (0, 10),
    "by hand, junctions": (70, 170),
    "constant-speed, junctions": (1, 20),
    "idm, junctions": (0, 10),
    "erratic, junctions": (2, 25),
}
"""The number of collisions of each policy in every session, and with ``-m oracle``; those found soon come first."""


def drawn(policy, numbers):
    return {(policy, number): collision(policy, number) for number in numbers}


@pytest.fixture(scope="module")
def soon_found():
    """Return collisions by policy and number."""
    return {key: trace for policy, (some, _) in SAMPLE.items() for key, trace in drawn(policy, range(some)).items()}


@pytest.fixture(scope="module", params=mostly_oracle(["soon found", "others"]))
def collisions(request):
    """Return collisions by policy and number."""
    if request.param == "soon found":
        return request.getfixturevalue("soon_found")
    return {
        key: trace for policy, (some, all_) in SAMPLE.items() for key, trace in drawn(policy, range(some, all_)).items()
    }


def test_second_program_gives_same_verdicts(collisions):
    differ = {}
    for name, trace in collisions.items():
        package, second = rss_rule(trace), judge(trace)
        verdicts = [(each.responsibility, each.fault, each.tick) for each in (package, second)]
        if verdicts[0] != verdicts[1]:
            differ[name] = (*verdicts, package.reason)
    assert differ == {}


def test_the_collisions_are_of_every_kind(soon_found):
    kinds = Counter((verdict.responsibility, verdict.fault) for verdict in map(rss_rule, soon_found.values()))
    assert kinds.keys() >= {
        ("npc", None),
        ("ego", "entered-lane"),
        ("both", "entered-lane"),
        ("ego", "leader-unanswered"),
        ("ego", "cut-in-unanswered"),
        ("both", "cut-in-unanswered"),
        ("both", "braked-for-nothing"),
        ("both", "stopped-for-nothing"),
        ("ego", "did-not-give-way"),
        ("both", "did-not-give-way"),
        ("both", "entered-taken-zone"),
        ("none", None),
    }
