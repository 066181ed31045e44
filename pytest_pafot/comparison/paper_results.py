"""The numbers that the paper reports (Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True, slots=True, kw_only=True)
class Reported:
    """One technique over ten runs of 100 generations with two NPCs on CARLA."""

    scenarios: int  # in total, and so are the next two
    collisions: int
    local_searches: int
    per_run: tuple[int, int, int]  # collisions of a run: mean, most, least
    time_to_collision: tuple[float, float, float]  # where there is one: mean, longest, shortest [s]
    seconds_per_scenario: float  # simulated, 60 s where safe [s]
    hours: float  # simulated in total


PAPER_GENERATIONS = 100  # of each run

PAPER: Mapping[str, Reported] = MappingProxyType(
    {
        "pafot": Reported(
            scenarios=4945,
            collisions=3981,
            local_searches=185,
            per_run=(398, 509, 342),
            time_to_collision=(20.65, 60, 3),
            seconds_per_scenario=28.16,
            hours=38.68,
        ),
        "av-fuzzer": Reported(
            scenarios=4327,
            collisions=2438,
            local_searches=80,
            per_run=(243, 378, 144),
            time_to_collision=(34.32, 60, 11),
            seconds_per_scenario=45.53,
            hours=54.73,
        ),
        "random-manoeuvre": Reported(  # its Random, see HOW_TO_READ of a report
            scenarios=4000,
            collisions=997,
            local_searches=0,
            per_run=(99, 113, 85),
            time_to_collision=(37.63, 60, 10),
            seconds_per_scenario=54.42,
            hours=60.47,
        ),
    }
)

PEAKS: Mapping[str, str] = MappingProxyType(
    {"pafot": "10 to 20 s", "av-fuzzer": "20 to 30 s, none before 10 s", "random-manoeuvre": "50 to 60 s"}
)
"""The interval of ten seconds in which the paper says that most collisions happen."""
