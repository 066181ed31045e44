"""Measures of how dangerous a run was for the ego. Every measure is a function of a Trace.

Arrays have the shape [ticks + 1, NPCs], one value per physics tick and NPC. A scalar is the worst value of its array.
Minima are over every physics tick (15 a second by default), which is finer than the paper's six a second. The docstring
of each measure states its unit and whether lower or higher values are worse. NaN in a trace results in NaN, never in a
harmless number.

An NPC that crosses is not on the ego's way until it has merged. Until then, distances along and across the ego's way
are NaN for it, measures within one lane are 0, and extremes ignore it. Measures in the plane treat it like any other
NPC.

The geometry that measures share is computed only once if they are called for one run after the other.
"""

from pytest_pafot.support import compiled

compiled.load(__name__)  # before the modules that import what is compiled

from pytest_pafot.criticality.measures import (
    Encounters,
    RelativePositions,
    RoadFrame,
    RssRules,
    centre_distance,
    ettc,
    execution_time,
    gap,
    hardest_brake,
    longitudinal_gap,
    max_safety_shortfall,
    mettc,
    min_centre_distance,
    min_gap,
    min_safety_distance,
    min_ttc,
    planned_duration,
    safety_distance,
    ttc,
)
from pytest_pafot.criticality.signals import Passage, passages, time_advantage

__all__ = [
    "Encounters", "Passage", "RelativePositions", "RoadFrame", "RssRules", "centre_distance", "ettc", "execution_time",
    "gap", "hardest_brake", "longitudinal_gap", "max_safety_shortfall", "mettc", "min_centre_distance", "min_gap",
    "min_safety_distance", "min_ttc", "passages", "planned_duration", "safety_distance",
    "time_advantage", "ttc",
]  # fmt: skip
