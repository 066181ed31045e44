"""Driving styles: how the NPCs of a scenario drive among others while they follow their instructions.

An instruction says where an NPC goes and how fast. The driving style limits what the NPC does on the way there.

In every style except the paper's, NPCs are *attentive*: behind the ego in its lane, an NPC keeps the same distance as
behind other NPCs. The NPC responds at once if it moved in itself or if there is a vehicle ahead of the ego. If the ego
moved in ahead of the NPC, or brakes with nothing ahead, the NPC responds a second later and with at most 6 m/s^2. An
NPC enters the ego's lane only if the ego, or the NPC itself, has room to adapt its speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

AMPLE = 1.0
"""The gap that an NPC adds to the smallest gap of its style when it drives to a place ahead of the ego [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivingStyle:
    """The limits that a style sets to NPCs, whatever their instructions say. By default there are none.

    Attributes:
        described: what a reader of a report needs to know of it.
        is_attentive: True if NPCs respond to what the ego does.
        least_speed_share: lowest speed of an NPC that nothing ahead slows down, as a share of speed limit or ego's
            speed, whichever is lower. Target speeds of a search are at least this share of the limit.
        least_gap: smallest gap to the ego, bumper to bumper, at which an NPC moves in ahead of it [m].
        time_gap: the same, as a time at the ego's speed [s].
        braking: hardest braking of an NPC if nothing ahead requires more [m/s^2].
        lateral_speed: highest speed of an NPC across the road [m/s].
    """

    described: str = ""
    is_attentive: bool = True
    least_speed_share: float = 0.0
    least_gap: float = 0.0
    time_gap: float = 0.0
    braking: float = 100.0
    lateral_speed: float = 100.0

    def least_speed(self, speed_limit: float) -> float:
        """Return the NPCs' lowest target speed for a speed limit [m/s], rounded up to a multiple of 0.1 m/s."""
        return math.ceil(10 * self.least_speed_share * speed_limit - 1e-6) / 10


Style = Literal["paper", "hostile", "assertive", "everyday"]
"""The name of a style."""

STYLES: Mapping[Style, DrivingStyle] = MappingProxyType(
    {
        "paper": DrivingStyle(is_attentive=False),
        "hostile": DrivingStyle(described="hostile traffic (NPCs may stop, brake hard and cut in close)"),
        "assertive": DrivingStyle(
            described="assertive traffic (hard but ordinary driving)",
            least_speed_share=0.5,
            least_gap=6.0,
            time_gap=0.3,
            braking=3.5,
            lateral_speed=1.8,
        ),
        "everyday": DrivingStyle(
            described="everyday traffic (as most drivers drive)",
            least_speed_share=0.75,
            least_gap=11.0,
            time_gap=0.5,
            braking=2.0,
            lateral_speed=1.5,
        ),
    }
)
"""The styles by name; docs/explanation/traffic.md has the sources of the values for everyday driving. The paper's NPCs
run into the rear of an ego that is slower than their instruction; hostile ones do all that the ego can still respond
to."""

PAPERS: Style = "paper"
"""The style of the paper's NPCs, which a scenario has unless it names another one."""
HOSTILE: Style = "hostile"
"""The default of a search."""
