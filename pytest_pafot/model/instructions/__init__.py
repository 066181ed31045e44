"""The kinds of instructions that an NPC can have, each in a file of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pytest_pafot.model.instructions.cell import PositionInstruction, random_position
from pytest_pafot.model.instructions.crossing import (
    ACTS,
    LARGEST_SLOT,
    SLOT_STEPS_PER_SECOND,
    SLOTS,
    Act,
    CrossingInstruction,
)
from pytest_pafot.model.instructions.instruction import (
    MAX_SPEED,
    SPEED_STEPS_PER_MPS,
    Choices,
    Instruction,
    ScenarioError,
    known,
    roughness,
)
from pytest_pafot.model.instructions.lane import LANE_STARTS, SHIFTS, LaneInstruction, random_lanes

__all__ = [
    "ACTS", "LANE_STARTS", "LARGEST_SLOT", "MAX_SPEED",
    "SHIFTS", "SLOTS", "SLOT_STEPS_PER_SECOND", "SPEED_STEPS_PER_MPS", "Act", "Choices",
    "CrossingInstruction", "Instruction", "LaneInstruction", "PositionInstruction",
    "ScenarioError", "known", "random_lanes",
    "random_position", "roughness",
]  # fmt: skip

KINDS: tuple[type[Instruction], ...] = (PositionInstruction, LaneInstruction, CrossingInstruction)
"""All kinds."""


def instruction_of(plain: Sequence[Any]) -> Instruction:
    """Return the instruction with a plain form.

    Raises:
        ScenarioError, TypeError, ValueError: if there is no such instruction.
    """
    if len(plain) == 4:
        return CrossingInstruction.read(plain)
    return (LaneInstruction if plain[0] in SHIFTS else PositionInstruction).read(plain)
