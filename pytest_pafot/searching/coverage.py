"""Which instructions a search asked for, had driven, and saw reached: cells, steps on the ring, target speeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from pytest_pafot.grid import Cell
from pytest_pafot.scenario import Gene, PositionInstruction
from pytest_pafot.searching.evaluation import Evaluation

SPEED_BIN = 5.0
"""Width of a bin of target speeds [m/s]."""

Key = tuple[str, int] | tuple[str, int, int]
"""``("cell", 2)``, ``("step", 1, 2)`` from cell to cell, or ``("bin", 4)`` of target speeds, from 0."""

CELLS: tuple[Key, ...] = tuple(("cell", int(cell)) for cell in Cell)
"""The eight, cell 1 first."""

STEPS: tuple[Key, ...] = tuple(
    ("step", int(cell), int(target)) for cell in Cell for target in (cell, *reversed(cell.neighbours))
)
"""The twenty-four that a valid chain can take; from each cell: holding it, one step clockwise, one anticlockwise."""


def speed_bins(speed_limit: float) -> tuple[Key, ...]:
    """The bins up to a speed limit [m/s], from the slowest."""
    return tuple(("bin", number) for number in range(int(speed_limit // SPEED_BIN) + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How often simulated runs did what. Lane-Instructions have speeds, and neither cells nor steps.

    Attributes:
        requested: asked for by the scenarios.
        driven: by the genes that the runs came to, after the repair inside the run.
        reached: those driven whose cell, or lane, was reached.
    """

    requested: Counter[Key] = field(default_factory=Counter)
    driven: Counter[Key] = field(default_factory=Counter)
    reached: Counter[Key] = field(default_factory=Counter)

    @classmethod
    def of(cls, simulated: Iterable[Evaluation]) -> Coverage:
        """Counted over simulated runs."""
        coverage = cls()
        for evaluation in simulated:
            coverage = coverage.counted(evaluation)
        return coverage

    def counted(self, evaluation: Evaluation) -> Coverage:
        """With one more run."""
        requested, driven, reached = Counter(self.requested), Counter(self.driven), Counter(self.reached)
        depth = evaluation.depth if evaluation.genes_started else 0
        for chain in evaluation.scenario.npcs:
            requested.update(_keys(chain, [True] * len(chain)))
        for npc, chain in enumerate(evaluation.executed.npcs):
            arrived = evaluation.arrived[npc] if npc < len(evaluation.arrived) else ()
            driven.update(_keys(chain, [gene < depth for gene in range(len(chain))]))
            reached.update(_keys(chain, [gene < len(arrived) and arrived[gene] for gene in range(len(chain))]))
        return Coverage(requested=requested, driven=driven, reached=reached)

    def describe(self, speed_limit: float) -> str:
        """One line for a summary: what was reached, and what was asked for; the limit [m/s] says which bins exist."""
        groups = (("cells", CELLS), ("ring steps", STEPS), ("speed bins", speed_bins(speed_limit)))
        requested, reached = (
            [f"{sum(count[key] > 0 for key in keys)}/{len(keys)}" for _, keys in groups]
            for count in (self.requested, self.reached)
        )
        named = ", ".join(f"{share} {name}" for share, (name, _) in zip(reached, groups, strict=True))
        return f"reached {named}; requested {', '.join(requested)}"


def _keys(chain: Sequence[Gene], counts: Sequence[bool]) -> Iterable[Key]:
    """Of the genes of a chain that count; a step belongs to the gene that it leads to."""
    for gene, does_count in zip(chain, counts, strict=True):
        if does_count:
            yield "bin", int(gene.speed // SPEED_BIN)
            if isinstance(gene, PositionInstruction):
                yield "cell", int(gene.cell)
    for (before, after), does_count in zip(pairwise(chain), counts[1:], strict=True):
        if does_count and isinstance(before, PositionInstruction) and isinstance(after, PositionInstruction):
            yield "step", int(before.cell), int(after.cell)
