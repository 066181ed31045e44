"""How dangerous a run was for the ego: every measure is a function of a Trace.

Arrays have the shape [ticks + 1, NPCs], one value per physics tick and NPC; scalars take the worst over both.
Minima are over every physics tick (15 a second by default), finer than the paper's six a second. Each
measure keeps its own unit and direction, which its docstring states. NaN in a trace comes out as NaN and is
never turned into a harmless number.

An NPC that crosses is not on the ego's way, but for what follows a merge. What is measured along and across that way
says so meanwhile, as NaN, and extremes leave it out; what is measured in the plane counts it as any other.

Whoever needs several measures of one run asks an :class:`Encounters`, which computes what they share once.
"""

from pytest_pafot.criticality.measures import (
    Encounters,
    centre_distance,
    ego_follows,
    ettc,
    execution_time,
    gap,
    hardest_brake,
    max_safety_shortfall,
    mettc,
    min_centre_distance,
    min_gap,
    min_safety_distance,
    min_ttc,
    planned_duration,
    post_encroachment_time,
    required_deceleration,
    safety_distance,
    safety_shortfall,
    ttc,
)
from pytest_pafot.criticality.relative import RelativePositions
from pytest_pafot.criticality.rss import (
    RoadFrame,
    RssRules,
    lateral_gap,
    longitudinal_gap,
    rss_lateral,
    rss_longitudinal,
)
from pytest_pafot.criticality.zones import Passage, passages, still_to_pass, time_advantage

__all__ = [
    "Encounters", "Passage", "RelativePositions", "RoadFrame", "RssRules", "centre_distance", "ego_follows", "ettc",
    "execution_time", "gap", "hardest_brake", "lateral_gap", "longitudinal_gap", "max_safety_shortfall", "mettc",
    "min_centre_distance", "min_gap", "min_safety_distance", "min_ttc", "passages", "planned_duration",
    "post_encroachment_time", "required_deceleration", "rss_lateral", "rss_longitudinal", "safety_distance",
    "safety_shortfall", "still_to_pass", "time_advantage", "ttc",
]  # fmt: skip
