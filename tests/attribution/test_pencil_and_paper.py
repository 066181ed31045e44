"""The rules against a second program, written without a look at the first."""

import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from tests.helpers.pencil_and_paper import judge
from tests.helpers.random_collisions import collision
from tests.helpers.situations import SITUATIONS
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


def collisions(which):
    """Yield the name of each collision and its trace."""
    if which == "situations":
        for situation in (each for group in SITUATIONS.values() for each in group):
            yield situation.name, situation.trace()
        return
    for policy, (some, every) in SAMPLE.items():
        for number in range(some) if which == "soon found" else range(some, every):
            yield (policy, number), collision(policy, number)


@pytest.mark.parametrize("which", mostly_oracle(["situations", "soon found", "others"], "situations", "soon found"))
def test_second_program_gives_same_verdicts(which):
    differ = {}
    for name, trace in collisions(which):
        package, second = rss_rule(trace), judge(trace)
        verdicts = [(each.responsibility, each.fault, each.tick) for each in (package, second)]
        if verdicts[0] != verdicts[1]:
            differ[name] = (*verdicts, package.reason)
    assert differ == {}
