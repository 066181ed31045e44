"""Tidy results: one row a scenario, as text that is the same for the same run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields

from pytest_pafot.text import csv_text


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One scenario that an algorithm asked for."""

    algorithm: str  # its name
    run: int  # of the algorithm, from 0
    seed: int  # of the run
    generation: int  # of the main search, from 0
    local_generation: int  # of a local search, from 1; 0 in the main search
    index: int  # in the generation, from 0
    scenario: str  # its id
    duplicate: bool  # whether an earlier run of the same search showed what it does, so that it was not simulated
    outcome: str  # how the run ended
    duration: float  # of the run [s]
    clock: float  # simulated time of the search until the end of the run [s]; duplicates take none
    failing: bool  # whether it counts as a failure, by the blame of the comparison
    collision_time: float | None  # [s]; empty without a collision, and so are the next four
    npc: int | None  # that collided
    cell: int | None  # in which it was
    side: str | None  # of the ego that was hit
    closing_speed: float | None  # at the impact [m/s]
    responsibility: str  # by :func:`~pytest_pafot.attribution.responsibility.rss_rule`; ``none`` without a collision
    position_responsibility: str  # by the rule of the authors' code
    signature: str | None  # of a collision or a fault of the ADS: which runs show the same failure; else empty
    fitness: float | None  # that the search maximised; empty where there is none
    genes_started: int  # over all NPCs
    genes_reached: int  # of these
    executed: str  # the scenario as driven, in canonical text


COLUMNS = tuple(field.name for field in fields(Row))


def text_of(rows: Iterable[Row]) -> str:
    """As CSV."""
    return csv_text(COLUMNS, map(astuple, rows))
