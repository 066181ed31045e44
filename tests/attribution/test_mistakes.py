"""The ego's mistake follows from the other's place when the ego had to take it into account."""

from itertools import chain
from typing import get_args

from pytest_pafot.attribution.responsibility import (
    BY_FAULT,
    NEXT_TO,
    Attribution,
    Fault,
    mistake,
    rss_rule,
)
from pytest_pafot.model.trace import Outcome
from tests.helpers.situations import LEFT, OWN, SITUATIONS
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH, trace_of, vehicle

TRACES = {each.name: each.trace for each in chain(*SITUATIONS.values())}
MADE = {
    "slow-leader-ignored": "kept-no-distance",
    "ramp-npc-merges-35-m-ahead": "kept-no-distance",
    "ego-enters-behind-a-slower-one": "kept-no-distance",
    "ego-overtakes-into-oncoming-traffic": "kept-no-distance",
    "ego-swipes": "moved-into-side",
    "ego-drifts": "moved-into-side",
    "bend-ego-runs-wide": "moved-into-side",
    "both-enter-side-by-side": "moved-into-side",
    "lane-change-1-m-ahead": "moved-in-front",
    "lane-change-28-m-ahead": "moved-in-front",
}


@table("name", MADE)
def test_each_situation_shows_its_mistake(name):
    trace = TRACES[name]()
    assert mistake(trace, rss_rule(trace)) == MADE[name]


def test_mistake_exists_exactly_where_ego_has_fault():
    for make in TRACES.values():
        trace = make()
        verdict = rss_rule(trace)
        assert (mistake(trace, verdict) is None) == (verdict.fault is None)
        assert mistake(trace, verdict) == BY_FAULT.get(verdict.fault, mistake(trace, verdict))


def test_every_fault_except_those_by_position_names_mistake():
    assert {*BY_FAULT, "entered-lane", "did-not-give-way"} == set(get_args(Fault))


@table(("gap", "expected"), [
    (NEXT_TO + 0.1, "kept-no-distance"),
    (NEXT_TO - 0.1, "moved-into-side"),
    (-LENGTH, "moved-into-side"),
    (-2 * LENGTH + 0.1, "moved-into-side"),
    (-2 * LENGTH - 0.1, "moved-in-front"),
])  # fmt: skip
def test_npc_within_two_metres_ahead_counts_as_alongside(gap, expected):
    ego, npc = vehicle(0.0, LEFT, ticks=1), vehicle(LENGTH + gap, OWN, ticks=1)
    verdict = Attribution(responsibility="ego", tick=0, time=0.0, fault="entered-lane")
    assert mistake(trace_of(ego, npc, outcome=Outcome.COLLISION), verdict) == expected
