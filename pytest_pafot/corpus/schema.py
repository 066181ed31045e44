"""Which keys a corpus file may have, and the version of the format.

Version 2 holds the world complete, so that no default that changes later changes what a saved scenario is. A key that
comes to it later is optional, and a file without it means what it meant before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

VERSION = 2
"""The one that is written and read."""


@dataclass(frozen=True, slots=True)
class Keys:
    """Of a mapping in a file."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()


FILE = Keys(
    ("pafot", "test", "world", "scenario", "expect", "found"), ("perception", "original", "shrunk", "flaky", "xfail")
)

_BUILT_IN = ("clearance", "headway", "limits", "hang_limit")
WORLDS: Mapping[str, Keys] = MappingProxyType(
    {
        "highway": Keys(("kind", "lanes", "speed_limit", "physics_hz", "ads_hz", "duration", *_BUILT_IN)),
        "gym": Keys(("kind", "env_id", "config", "duration", *_BUILT_IN), ("wrappers",)),
        "own": Keys(("kind",), ("class", "data")),
    }
)
"""Of worlds, by kind; what ``data`` is, the user's own world says by its ``to_dict``."""

LIMITS = Keys(("acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"))
"""Of the key ``limits`` of a world."""

SCENARIO = Keys(("seed", "ego", "npcs"), ("gene_seconds",))
"""Of ``scenario`` and ``original``; ``npcs`` is a list of lists of genes, in one of the next two forms."""

EGO = Keys(("lane", "speed"))
POSITION_INSTRUCTION = Keys(("cell", "speed"))
LANE_INSTRUCTION = Keys(("lane", "speed"))

XFAIL = Keys(("reason",), ("until",))
"""Of ``xfail`` where it is no plain text."""

EXPECT = Keys(
    ("failure", "outcome", "time", "responsibility"),
    (
        *("assertion", "check", "message", "npc", "cell", "side", "fault", "npc_manoeuvre", "ego_manoeuvre"),
        *("reference_drivers", "last_chance", "against", "traceback"),
    ),
)
EXPECT_OF_COLLISION = Keys((*EXPECT.required, "npc", "cell", "side"), EXPECT.optional)
CHECK = Keys((), ("value", "at_most", "at_least", "unit"))
"""Of ``expect.check``."""
LAST_CHANCE = Keys(("time", "driver", "action", "ego_action"))
"""Of ``expect.last_chance``."""

FOUND = Keys(("seed", "generation", "algorithm", "versions"), ("weights",))
PERCEPTION = Keys((), ("range", "latency", "noise", "dropout", "occlusion", "needed"))
SHRUNK = Keys(("rollouts", "is_minimal", "speeds"))
SPEEDS = Keys(("npc", "gene", "low", "high"))
"""Of each entry of the list ``shrunk.speeds``."""
