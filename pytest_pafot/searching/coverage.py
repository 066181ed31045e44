"""Which instructions a search asked for, had driven, and saw reached: cells, steps on the ring, target speeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain, compress, pairwise

from pytest_pafot.grid import Cell
from pytest_pafot.scenario import Chromosome, PositionInstruction
from pytest_pafot.searching.evaluation import Evaluation

SPEED_BIN = 5.0  # width of a bin of target speeds [m/s]

Key = tuple[str, int] | tuple[str, int, int]
"""``("cell", 2)``, ``("step", 1, 2)`` from cell to cell, or ``("bin", 4)`` of target speeds, from 0."""

CELLS: tuple[Key, ...] = tuple(("cell", int(cell)) for cell in Cell)  # the eight, cell 1 first

STEPS: tuple[Key, ...] = tuple(
    ("step", int(cell), int(target)) for cell in Cell for target in (cell, *reversed(cell.neighbours))
)
"""The twenty-four that a valid chain can take; from each cell: holding it, one step clockwise, one anticlockwise."""


def speed_bins(speed_limit: float) -> tuple[Key, ...]:
    """The bins up to a speed limit [m/s], from the slowest."""
    return tuple(("bin", number) for number in range(int(speed_limit // SPEED_BIN) + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How often simulated runs did what. Lane-Instructions have speeds, and neither cells nor steps."""

    requested: Counter[Key] = field(default_factory=Counter)  # asked for by the scenarios
    # by the genes that the runs came to, after the repair inside the run
    driven: Counter[Key] = field(default_factory=Counter)
    reached: Counter[Key] = field(default_factory=Counter)  # those driven whose cell, or lane, was reached

    def counted(self, evaluation: Evaluation) -> Coverage:
        """With one more run."""
        depth = evaluation.depth if evaluation.genes_started else 0
        asked = driven = [_keys(chain) for chain in evaluation.scenario.npcs]
        if evaluation.executed is not evaluation.scenario or evaluation.driven:
            driven = [_keys(chain) for chain in evaluation.chains]
        arrived = zip(driven, evaluation.arrived, strict=False)
        return Coverage(
            requested=_added(self.requested, chain.from_iterable(asked)),
            driven=_added(self.driven, chain.from_iterable([keys[:depth] for keys in driven])),
            reached=_added(self.reached, chain.from_iterable([compress(*each) for each in arrived])),
        )

    def describe(self, speed_limit: float) -> str:
        """One line for a summary: what was reached, and what was asked for; the limit [m/s] says which bins exist."""
        groups = (("cells", CELLS), ("ring steps", STEPS), ("speed bins", speed_bins(speed_limit)))
        requested, reached = (
            [f"{sum(count[key] > 0 for key in keys)}/{len(keys)}" for _, keys in groups]
            for count in (self.requested, self.reached)
        )
        named = ", ".join(f"{share} {name}" for share, (name, _) in zip(reached, groups, strict=True))
        return f"reached {named}; requested {', '.join(requested)}"


def _added(counts: Counter[Key], genes: Iterable[Iterable[Key]]) -> Counter[Key]:
    counts = counts.copy()
    counts.update(chain.from_iterable(genes))
    return counts


@lru_cache(maxsize=64)  # the sums of a campaign and its health count the same chains
def _keys(genes: Chromosome) -> list[tuple[Key, ...]]:
    """Of each gene of a chain; a step belongs to the gene that it leads to."""
    bins: list[Key] = [("bin", int(gene.speed // SPEED_BIN)) for gene in genes]
    cells = [gene.target for gene in genes if isinstance(gene, PositionInstruction)]
    if not cells:
        return [(each,) for each in bins]
    steps = [(("step", *step),) for step in pairwise(cells)]
    return [(speed, ("cell", cell), *step) for speed, cell, step in zip(bins, cells, [(), *steps], strict=True)]
