"""A junction made by hand: the ego drives straight on, other ways cross it, come towards it or join it.

The ego drives from o0 to o2 at 10 m/s. It starts at 20 m of its way and reaches its first zone after 6 s.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from pytest_pafot.model.crossings import STEP, Crossings, Way, Zone


def clashes(crossings, scenario):
    """Return whether any two NPCs of a scenario clash."""
    told = [each for each in scenario.crossings if each is not None]
    return any(crossings.clash(*pair) for pair in combinations(told, 2))


def way_of(
    name,
    kind,
    origin,
    ego,
    npc,
    priority="none",
    *,
    length=160.0,
    top=12.0,
    bend=None,
    bend_top=6.0,
):
    """Return a way with the speed ``top`` everywhere except in a bend, where it is ``bend_top`` [m, m/s]."""
    places = np.arange(round(length / STEP) + 1) * STEP
    first, last = bend or (0.0, -1.0)
    speeds = np.where((places >= first) & (places <= last), bend_top, top)
    return Way(
        zone=Zone(way=name, kind=kind, origin=origin, ego=ego, npc=npc, priority=priority),
        speeds=speeds,
    )


def junction(**changes):
    """Return two ways across the ego's, an oncoming way that turns, and a way that joins it; two start at o1."""
    ways = (
        way_of("o1>o3", "crossing", "left", (88.0, 95.0), (90.0, 98.0), "npc"),
        way_of("o3>o1", "crossing", "right", (80.0, 87.0), (91.0, 99.0), "ego"),
        way_of("o2>o1", "oncoming", "ahead", (86.0, 96.0), (84.0, 95.0), "ego", bend=(80.0, 96.0)),
        way_of("o1>o2", "merging", "left", (90.0, 115.0), (92.0, 121.0), "npc", bend=(86.0, 100.0)),
    )
    fields = {
        "ways": {way.zone.way: way for way in ways},
        "meetings": {
            ("o1>o2", "o1>o3"): (((84.0, 92.0), (84.0, 91.0)),),
            ("o1>o3", "o2>o1"): (((92.0, 99.0), (86.0, 94.0)),),
            ("o2>o1", "o3>o1"): (((90.0, 160.0), (96.0, 160.0)),),
        },
        "ego_start": 20.0,
        "ego_speed": 10.0,
    }
    return Crossings(**(fields | changes))
