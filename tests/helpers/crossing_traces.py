"""Runs at a junction, made by hand: an ego that drives straight on, and NPCs that cross, merge or follow.

The ego's way is the x axis. A second way comes from the left at x = 50 m and leads across. A third comes from the right
and turns by a quarter circle into the ego's lane, which it reaches at x = 75 m.
"""

from __future__ import annotations

import numpy as np

from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.instructions import Cell, CrossingInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Lane, Outcome, Trace
from tests.helpers.traces import LANE_WIDTH, collision_at, trace_of

HZ, SPEED = 15, 10.0
CROSSED_AT, RADIUS, ENTERS_AT = 50.0, 15.0, 75.0
BEFORE_TURN = 25.0
"""The distance that the merging NPC drives straight on before it turns [m]."""
TURN = RADIUS * np.pi / 2
CROSSES, MERGES = "o3>o1", "o2>o4"


def across(places):
    """Return world x, y and heading of places on the way that leads across, whose middle is at 60 m."""
    return np.full_like(places, CROSSED_AT), places - 60.0, np.full_like(places, np.pi / 2)


def into(places):
    """Return world x, y and heading of places on the way that merges."""
    turned = np.clip((places - BEFORE_TURN) / RADIUS, 0.0, np.pi / 2)
    before, after = (
        np.maximum(BEFORE_TURN - places, 0.0),
        np.maximum(places - BEFORE_TURN - TURN, 0.0),
    )
    x = ENTERS_AT - RADIUS * np.cos(turned) + after
    return x, RADIUS * (1 - np.sin(turned)) + before, turned - np.pi / 2


def line_of(way, length):
    x, y, _ = way(np.arange(0.0, length + 1, 2.0))
    return tuple(zip(x.tolist(), y.tolist(), strict=True))


ZONES = {
    CROSSES: Zone(
        way=CROSSES, kind="crossing", origin="left", ego=(45.5, 54.5), npc=(55.5, 64.5), priority="npc",
        line=line_of(across, 120.0),
    ),
    MERGES: Zone(
        way=MERGES, kind="merging", origin="right", ego=(60.0, 80.0), npc=(30.0, 53.6), priority="ego",
        line=line_of(into, 120.0),
    ),
}  # fmt: skip
WAYS = {CROSSES: across, MERGES: into}


def lanes():
    """Yield the ego's lane, the crossing lane, and the merging lane up to the ego's lane."""
    ways = (
        (lambda places: (places, 0 * places, 0 * places), 200.0),
        (across, 120.0),
        (into, BEFORE_TURN + TURN),
    )
    for way, length in ways:
        x, y, heading = way(np.append(np.arange(0.0, length, 1.0), length))
        points = tuple(zip(x.tolist(), y.tolist(), strict=True))
        first = {"x": points[0][0], "y": points[0][1], "heading": float(heading[0])}
        yield Lane(**first, length=length, width=LANE_WIDTH, speed_limit=15.0, points=points)


def junction_trace(*npcs, seconds=8.0, ego_speed=SPEED, hits=None, **fields) -> Trace:
    """Return the run of an ego that starts at x = 0 and of NPCs.

    Each NPC is (zone, start along its way) or (None, distance ahead of the ego) [m]; its speed is 10 m/s or the third
    entry. ``hits`` is the NPC with which the ego collides at the end.
    """
    times = np.arange(round(seconds * HZ) + 1) / HZ
    rows, tracks, on_way, chains = [], [], [], []
    for zone, start, speed in [(None, 0.0, ego_speed), *((*npc, SPEED)[:3] for npc in npcs)]:
        places = start + speed * times
        x, y, heading = (places, 0 * times, 0 * times) if zone is None else WAYS[zone](places)
        is_on_way = (np.abs(y) < LANE_WIDTH / 2) & (np.abs(heading) < 0.5)
        lane = np.where(is_on_way, 0, {None: 0, CROSSES: 1, MERGES: 2}[zone])
        rows.append(np.stack(np.broadcast_arrays(x, y, heading, speed, 0.0, 0.0, lane), axis=-1))
        track = np.stack(np.broadcast_arrays(x, y, heading, y, 1.0), axis=-1)
        tracks.append(np.where(is_on_way[:, None], track, np.nan))
        on_way.append(np.full_like(times, np.nan) if zone is None else places)
        is_grid = zone is None
        chains.append(
            [
                PositionInstruction(Cell.FRONT, speed)
                if is_grid
                else CrossingInstruction(zone, 0.5, speed)
            ]
        )
    scenario = Scenario(npcs=chains[1:], ego_lane=0, ego_speed=ego_speed)
    zones = tuple(None if zone is None else ZONES[zone] for zone, *_ in npcs)
    entered = [
        None if zone is None else next(iter(np.flatnonzero(places >= zone.npc[0]).tolist()), None)
        for zone, places in zip(zones, on_way[1:], strict=True)
    ]
    if hits is not None:
        hit = collision_at(len(times) - 1, npc=hits, cell=None, ego_speed=ego_speed)
        fields = {"outcome": Outcome.COLLISION, "collision": hit} | fields
    given = {
        "scenario": scenario,
        "lanes": tuple(lanes()),
        "track": np.stack(tracks, axis=1),
        "zones": zones if any(zones) else (),
        "on_way": np.stack(on_way[1:], axis=-1) if any(zones) else None,
        "arrivals": tuple((tick,) for tick in entered),
    }
    return trace_of(*rows, **given | fields)
