"""Lane-Instructions, which make an NPC change lanes wherever the ego is."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args

from pytest_pafot.model.grid import Cell, cell_at
from pytest_pafot.model.instructions.cell import PositionInstruction
from pytest_pafot.model.instructions.instruction import (
    SPEED_STEPS_PER_MPS,
    Choices,
    ScenarioError,
    TimedInstruction,
    checked_speed,
    known,
)

if TYPE_CHECKING:
    from numpy.random import Generator

Shift = Literal["keep", "left", "right"]
"""The lane to drive in: the NPC's lane at the gene's beginning, or the lane to the left or right of it."""

SHIFTS: tuple[Shift, ...] = get_args(Shift)

LANE_STARTS = tuple(map(Cell, (1, 2, 3, 8, 4, 6, 7, 5)))
"""The cells in which NPCs with Lane-Instructions start: each NPC in the first cell that exists and is free. The first
two are the starts of the NPCs in the released AV-Fuzzer: ahead to the left of the ego, and ahead in the ego's lane."""


@dataclass(frozen=True, slots=True, repr=False)
class LaneInstruction(TimedInstruction):
    """A gene that makes an NPC keep its lane or change it by one, at a speed, wherever the ego is.

    It is the manoeuvre of AV-Fuzzer (Li et al., ISSRE 2020). If the target lane does not exist, the NPC keeps its lane.

    Attributes:
        lane: ``"keep"``, ``"left"`` or ``"right"``, as seen from the NPC's lane at the gene's beginning.
        speed: target speed from the gene's first tick on [m/s], >= 0, in steps of 0.1.
    """

    lane: Shift
    speed: float

    goal_kind = "lane"

    def __post_init__(self) -> None:
        if self.lane not in SHIFTS:
            raise ScenarioError(field="lane", expected=f"one of {', '.join(SHIFTS)}", received=repr(self.lane))
        object.__setattr__(self, "lane", str(self.lane))
        object.__setattr__(self, "speed", checked_speed(self.speed))
        self._prepare(self.lane, 9 + SHIFTS.index(self.lane))

    @property
    def column(self) -> int:
        """The target lane as a number of lanes to the right of the NPC's own lane: -1, 0 or +1."""
        return (0, -1, 1)[SHIFTS.index(self.lane)]

    @property
    def goal(self) -> str:
        """The target in words: ``one lane left``."""
        return "keep lane" if self.lane == "keep" else f"one lane {self.lane}"

    @property
    def afterwards(self) -> LaneInstruction:
        """The instruction to keep the lane that this one leads to."""
        return replace(self, lane="keep")

    def varied(self, choices: Choices, rng: Generator) -> LaneInstruction:
        """Return an instruction that is uniform over the lanes and the speeds."""
        return random_lanes(choices, 1, 1, rng)[0][0]

    def moves(self, before: Any) -> int:
        """Return 1 for a change of lanes."""
        return int(self.lane != "keep")

    def staying(self, before: Any) -> LaneInstruction:
        """Return the instruction to keep the lane."""
        return LaneInstruction("keep", self.speed)

    def on_ring(self, cell: Cell) -> PositionInstruction:
        """Return the instruction for the cell beside; for the same cell, if there is none in that direction."""
        there = cell_at(cell.row, cell.column + self.column, 1.0, 1.0)  # a grid of 1 m by 1 m
        return PositionInstruction(there or cell, self.speed)

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[LaneInstruction]:
        """Return all lanes at all speeds."""
        return [LaneInstruction(lane, speed) for lane in SHIFTS for speed in speeds]

    def words(self, apart: float) -> str:
        """Return the change of lanes as seen from the ego: ``from the left into the ego's lane``."""
        before = apart
        if math.isnan(before):
            return self.goal
        after = before + self.column
        if before == 0 != after:
            return f"out of the ego's lane to the {self.lane}"
        if after == 0 != before:
            return f"from the {'left' if before < 0 else 'right'} into the ego's lane"
        number = {0: "", 1: "", 2: "2nd ", 3: "3rd "}.get(far := round(abs(after)), f"{far}th ")
        place = f"the {number}lane {'left' if after < 0 else 'right'} of the ego" if after else "the ego's lane"
        return f"{'keep' if before == after else 'into'} {place}"

    def row(self, apart: float, end: str, *, names_side: bool) -> str:
        """Return the words, without the side if there is no room for it, and the end of a change of lanes."""
        words = self.words(apart)
        words = words if names_side else re.sub("^from the [a-z]+ | to the [a-z]+$", "", words)
        return f"{words} {self.speed:.1f} m/s{'' if self.lane == 'keep' else f' {end}'}"

    def lasting(self, later: Any) -> int | None:
        """Return the change of lanes, which goes on under later instructions that keep the lane."""
        return self.column if later.lane == "keep" else None

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        """Return the lane that was driven, and the requested one if it was a different one."""
        words = self.words(apart) + ("" if self == requested else f" (requested {requested.goal})")
        return {"lane": self.lane, "words": words}


def random_lanes(choices: Choices, npcs: int, genes: int, rng: Generator) -> list[list[LaneInstruction]]:
    """Sample chains of Lane-Instructions, uniform over keep, left and right, and the speeds up to the limit."""
    shifts = rng.integers(len(SHIFTS), size=(npcs, genes)).tolist()
    speeds = rng.integers(choices.low, choices.top + 1, size=(npcs, genes)).tolist()
    return [
        [
            known(LaneInstruction, SHIFTS[shift], speed / SPEED_STEPS_PER_MPS)
            for shift, speed in zip(*chain, strict=True)
        ]
        for chain in zip(shifts, speeds, strict=True)
    ]
