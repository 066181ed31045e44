"""Position-Instructions, which place an NPC around the ego.

Source: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, sections 2 and 3.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions.instruction import Choices, ScenarioError, TimedInstruction, checked_speed, known
from pytest_pafot.support.errors import plain_whole

if TYPE_CHECKING:
    from numpy.random import Generator


@dataclass(frozen=True, slots=True, repr=False)
class PositionInstruction(TimedInstruction):
    """A gene that makes an NPC drive into a cell of the grid and then keep a speed.

    Attributes:
        cell: target cell, 1 to 8.
        speed: target speed [m/s], >= 0, in steps of 0.1.
    """

    cell: Cell
    speed: float

    if TYPE_CHECKING:

        def __init__(self, cell: int, speed: float) -> None: ...

    on_grid = True
    goal_kind = "cell"

    def __post_init__(self) -> None:
        if type(self.cell) is not Cell:
            number = plain_whole(self.cell)
            if number is None or not 1 <= number <= 8:
                expected = "a whole number from 1 (front-left) clockwise to 8 (left)"
                raise ScenarioError(field="cell", expected=expected, received=repr(self.cell))
            object.__setattr__(self, "cell", Cell(number))
        object.__setattr__(self, "speed", checked_speed(self.speed))
        self._prepare(int(self.cell), int(self.cell))

    @property
    def goal(self) -> str:
        """The target in words: ``2 front``."""
        return f"{int(self.cell)} {self.cell.label}"

    @property
    def remark(self) -> str:
        """The name of the cell."""
        return self.cell.label

    def varied(self, choices: Choices, rng: Generator) -> PositionInstruction:
        """Return an instruction that is uniform over the eight cells and the speeds; others may hold the cell."""
        return random_position(choices, rng)

    def moves(self, before: Any) -> int:
        """Return 1 for a move to a different cell."""
        return int(before is not None and before.cell != self.cell)

    def staying(self, before: Any) -> PositionInstruction | None:
        """Return the instruction for the cell before."""
        return None if before is None else PositionInstruction(before.cell, self.speed)

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[PositionInstruction]:
        """Return all cells at all speeds."""
        return [PositionInstruction(cell, speed) for cell in Cell for speed in speeds]

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        """Return the requested cell and the one that was driven."""
        return {"requested": int(requested.cell), "cell": int(self.cell)}


def random_position(choices: Choices, rng: Generator) -> PositionInstruction:
    """Sample a Position-Instruction, uniform over the eight cells and the speeds up to the limit."""
    cell = int(rng.integers(1, 9))
    gene: PositionInstruction = known(PositionInstruction, cell, choices.any_speed(rng))
    return gene
