"""Verdicts on cut-ins against the formula of UN R157, 5.2.5.2, for collisions that a system must avoid."""

import itertools

import numpy as np
import pytest

from pytest_pafot.model.trace import SPEED, X, Y
from pytest_pafot.oracle.run import Run
from tests.helpers.drives import HZ
from tests.helpers.situations import LEFT, OWN, driven, hit
from tests.helpers.traces import LENGTH

INTRUSION = 0.3
"""The distance over the line of the ego's lane at which an NPC has cut in [m]."""
LINE = (LEFT + OWN) / 2


def must_be_avoided(trace):
    """Return whether the time to collision at the cut-in from the left is more than v / (2 * 6 m/s^2) + 0.35 s."""
    ego, npc = trace.ego, trace.npcs[:, 0]
    at = int(np.argmax(npc[:, Y] + trace.sizes[1, 1] / 2 - LINE >= INTRUSION))
    slower = ego[at, SPEED] - npc[at, SPEED]
    return npc[at, X] - ego[at, X] - LENGTH > slower * (slower / (2 * 6.0) + 0.35)


def cut_in(gap, *, slower, lasts):
    """Return a collision with an NPC from the left that is over the line by 0.3 m at a gap ahead [m]."""
    when = 2.0 + np.ceil(lasts * 1.3 / 4.0 * HZ) / HZ
    npc = driven(LENGTH + gap + slower * when, LEFT, speed=20 - slower, shifts=[(2.0, OWN, lasts)])
    return hit(driven(0.0), npc)


@pytest.mark.parametrize("slower", [4.0, 8.0, 12.0, 16.0])
def test_ego_alone_is_blamed_only_for_cut_ins_that_it_must_answer(slower):
    required, least = [], slower * (slower / 12 + 0.35)
    for beyond, lasts in itertools.product((-3.0, -1.0, -0.4, 0.4, 1.0, 3.0, 6.0, 40.0), (2.5, 3.0, 4.0)):
        trace = cut_in(least + beyond, slower=slower, lasts=lasts)
        required.append(must_be_avoided(trace))
        responsibility = Run(trace).responsibility
        assert required[-1] or responsibility in ("npc", "both"), (beyond, lasts)
        assert beyond < 40.0 or responsibility == "ego"
    assert set(required) == {False, True}
