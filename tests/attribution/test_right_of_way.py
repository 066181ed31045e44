"""Right of way in cases without a stored situation: places without priority, and sentences."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.attribution.responsibility import (
    NOT_GIVEN_WAY,
    attribute_collision,
    position_rule,
    rss_rule,
)
from pytest_pafot.model.trace import ALONG, Y
from tests.helpers.junctions import hit, plan
from tests.helpers.tables import table


def judged(trace):
    """Return the verdict and the ego's fault."""
    found = rss_rule(trace)
    return found.responsibility, found.fault


FROM = {"left": "north straight", "right": "south straight", "ahead": "east left"}


def ignored(way="north straight", priority="npc", others=()):
    return hit(plan("west straight", 6, 8), plan(way, 6.3, 8), priority=priority, others=others)


def longer(trace, ticks):
    """Return the same run after a number of extra ticks at its first one."""
    rows = {}
    for name in ("states", "track", "on_way"):
        array = getattr(trace, name)
        rows[name] = np.concatenate([array[:1].repeat(ticks, axis=0), array])
    return replace(trace, **rows)


@table("origin", list(FROM))
def test_where_the_other_comes_from_tells_the_mistake(origin):
    trace = ignored(FROM[origin])
    assert rss_rule(trace).fault == "did-not-give-way"
    assert attribute_collision(trace).mistake == NOT_GIVEN_WAY[origin]


def outside():
    """Return a run in which the NPC is further along its way than the zone."""
    return replace(ignored(), on_way=ignored().on_way + 100.0)


def test_contact_outside_zone_and_ways_blames_neither_vehicle():
    found = rss_rule(outside())
    assert (found.responsibility, found.fault, found.tick) == ("none", None, outside().ticks)


def test_npc_off_the_way_does_not_change_verdict():
    ego, on_grid = plan("west straight", 6, 12, (4.8, -7.0, 2.0)), plan("grid", 7.2, 12)
    alone = hit(ego, on_grid, others=[plan("south straight", 1, 8)])
    assert np.isnan(alone.track[:, 2, ALONG]).any()
    assert rss_rule(alone) == rss_rule(replace(alone, zones=(None, None)))


def test_lane_rules_apply_from_where_npc_merged():
    trace = hit(plan("join", 8, 8), plan("circle", 6.0, 8, (8.0, -3.0, 0.0)))
    off = np.isnan(trace.track[:, 1, ALONG])
    assert off[0]
    assert not off[-1]
    verdict, later = rss_rule(trace), rss_rule(longer(trace, 15))
    assert verdict.tick > np.flatnonzero(off)[-1]
    for found, tick in ((verdict, verdict.tick), (later, verdict.tick + 15)):
        expected = ("ego", "leader-unanswered", tick)
        assert (found.responsibility, found.fault, found.tick) == expected
    assert later.time == pytest.approx(verdict.time + 1.0)


def test_verdict_without_priority_is_same_from_either_side():
    trace = ignored(priority="none")
    zone = trace.zones[0]
    swapped = replace(
        trace,
        states=trace.states[:, ::-1],
        track=np.where([[[True], [False]]], trace.on_way[:, :, None].repeat(5, axis=2), np.nan),
        on_way=trace.track[:, :1, ALONG],
        zones=(replace(zone, ego=zone.npc, npc=zone.ego, origin="right"),),
    )
    assert rss_rule(trace).responsibility == rss_rule(swapped).responsibility == "both"


def test_ego_setting_off_into_merging_npc_is_responsible():
    """The NPC has been in the zone for 4.7 s, but is on the ego's way only in the last 0.2 s before the impact."""
    ego = plan("west straight", 8, 4, (7.0, -4.0, 0.5), (11.8, 4.0, 6.0))
    trace = hit(ego, plan("south right", 7, 0.8))
    assert np.isnan(trace.track[:-4, 1, ALONG]).all()
    assert judged(trace) == ("ego", "entered-taken-zone")


def test_npc_hitting_ego_standing_in_zone_shares_responsibility():
    trace = hit(plan("west straight", 6, 6, (5.6, -6.0, 0.0)), plan("north straight", 7, 1))
    assert judged(trace) == ("both", "did-not-give-way")


@table(("enters", "speed"), [(4.5, 2.0), (5.0, 1.5)])
def test_ego_behind_an_npc_that_merged_slowly_could_slow_down(enters, speed):
    trace = hit(plan("west straight", 7, 9), plan("south right", enters, speed), priority="ego")
    assert judged(trace) == ("ego", "entered-taken-zone")


@table(("enters", "expected"), [(3.2, ("ego", "did-not-give-way")), (4.2, ("none", None))])
def test_ego_must_stop_short_of_an_npc_that_has_visibly_stopped_in_the_zone(enters, expected):
    """Up to its last chance to stop, 1.2 s before the impact, the ego takes it that the second one drives on."""
    npc = plan("north straight", enters, 6, (enters + 0.6, -6.0, 0.0))
    assert judged(hit(plan("west straight", 6, 3), npc)) == expected


@table(("side", "expected"), [("front", "ego"), ("left", "npc"), ("right", "npc"), ("rear", "npc")])
def test_position_rule_without_cell_uses_the_side_hit(side, expected):
    trace = ignored()
    assert trace.collision.cell is None
    assert position_rule(replace(trace, collision=replace(trace.collision, side=side))) == expected
    standing = replace(trace.collision, side=side, ego_speed=0.05)
    assert position_rule(replace(trace, collision=standing)) == "npc"


def test_mirrored_crossing_gets_the_same_verdict():
    trace = ignored()
    states = trace.states.copy()
    states[..., [Y, 2]] *= -1
    mirrored = replace(trace, states=states, zones=(replace(trace.zones[0], origin="right"),))
    one, other = rss_rule(trace), rss_rule(mirrored)
    assert judged(trace) == judged(mirrored)
    assert one.tick == other.tick
