"""Chains into valid scenarios, the step after every draw and every variation (section 2.1 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol

from pytest_pafot.grid import Cell, is_adjacent, repair_chains
from pytest_pafot.scenario import Chromosome, Gene, PositionInstruction, Scenario, positions_of


class Start(Protocol):
    """How a scenario begins; a scenario and a search space both say it."""

    @property
    def ego_lane(self) -> int:
        """From 0 at the left."""
        ...

    @property
    def ego_speed(self) -> float:
        """[m/s]."""
        ...

    @property
    def gene_seconds(self) -> float:
        """[s]."""
        ...


def repaired(chains: Sequence[Sequence[Gene]], seed: int, start: Start) -> Scenario:
    """The same scenario as from :meth:`Scenario.repaired`, at a fraction of its cost.

    A search makes one for every child. Valid chains come back from a repair unchanged, so they skip it, and
    genes that keep their cell are kept as they are.
    """
    positions = positions_of(chains)
    cells = [[gene.cell for gene in chain] for chain in positions]
    make = Scenario.trusted if isinstance(start, Scenario) else Scenario  # a space is what somebody asked for
    return make(
        npcs=tuple(map(tuple, chains)) if _valid(cells) else _with_cells(positions, repair_chains(cells, seed)),
        seed=seed,
        ego_lane=start.ego_lane,
        ego_speed=start.ego_speed,
        gene_seconds=start.gene_seconds,
    )


def _valid(cells: Sequence[Sequence[Cell]]) -> bool:
    for row in cells:
        for before, cell in pairwise(row):
            if not is_adjacent(before, cell):
                return False
    held = [cell + 8 * gene for row in cells for gene, cell in enumerate(row)]
    return len(held) == len(set(held))


def _with_cells(
    chains: Sequence[Sequence[PositionInstruction]], cells: Sequence[Sequence[Cell]]
) -> tuple[Chromosome, ...]:
    return tuple(
        tuple(
            gene if gene.cell == cell else PositionInstruction(cell, gene.speed)
            for gene, cell in zip(chain, row, strict=True)
        )
        for chain, row in zip(chains, cells, strict=True)
    )
