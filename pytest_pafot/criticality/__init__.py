"""Measures of how dangerous a run was for the ego, as functions of a Trace.

The functions return arrays of shape [ticks + 1, NPCs]. If a trace contains NaN, so do its measures. While a crossing
NPC is not on the ego's path, distances along and across that path are NaN.
"""

from pytest_pafot.support import compiled

compiled.load(__name__)  # before the modules that import compiled code

from pytest_pafot.criticality.measures import (
    Encounters,
    RoadFrame,
    RssRules,
    centre_distance,
    ettc,
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
    "Encounters", "Passage", "RoadFrame", "RssRules", "centre_distance", "ettc",
    "gap", "hardest_brake", "longitudinal_gap", "max_safety_shortfall", "mettc", "min_centre_distance", "min_gap",
    "min_safety_distance", "min_ttc", "passages", "planned_duration", "safety_distance",
    "time_advantage", "ttc",
]  # fmt: skip
