"""Tidy results: one row a scenario, as text that is the same for the same run."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One scenario that an algorithm asked for.

    Attributes:
        algorithm: its name.
        run: of the algorithm, from 0.
        seed: of the run.
        generation: of the main search, from 0.
        local_generation: of a local search, from 1; 0 in the main search.
        index: in the generation, from 0.
        scenario: its id.
        duplicate: whether an earlier run of the same search showed what it does, so that it was not simulated.
        outcome: how the run ended.
        duration: of the run [s].
        clock: simulated time of the search until the end of the run [s]; duplicates take none.
        failing: whether it counts as a failure, by the blame of the comparison.
        collision_time: [s]; empty without a collision, and so are the next four.
        npc: that collided.
        cell: in which it was.
        side: of the ego that was hit.
        closing_speed: at the impact [m/s].
        responsibility: by :func:`~pytest_pafot.attribution.responsibility.rss_rule`; ``none`` without a collision.
        position_responsibility: by the rule of the authors' code.
        signature: of a collision or a fault of the ADS: which runs show the same failure; else empty.
        fitness: that the search maximised; empty where there is none.
        genes_started, genes_reached: over all NPCs.
        executed: the scenario as driven, in canonical text.
    """

    algorithm: str
    run: int
    seed: int
    generation: int
    local_generation: int
    index: int
    scenario: str
    duplicate: bool
    outcome: str
    duration: float
    clock: float
    failing: bool
    collision_time: float | None
    npc: int | None
    cell: int | None
    side: str | None
    closing_speed: float | None
    responsibility: str
    position_responsibility: str
    signature: str | None
    fitness: float | None
    genes_started: int
    genes_reached: int
    executed: str


COLUMNS = tuple(field.name for field in fields(Row))


def text_of(rows: Iterable[Row]) -> str:
    """As CSV with a header; numbers as Python writes them, which is exact."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow(["" if value is None else value for value in astuple(row)])
    return buffer.getvalue()
