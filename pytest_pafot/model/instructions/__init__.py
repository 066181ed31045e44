"""The kinds of instructions that an NPC can have, each in a file of its own, and the table of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pytest_pafot.model.instructions.cell import (
    PositionInstruction,
    known_position,
    random_position,
)
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
    SPEED,
    SPEED_BIN,
    SPEED_STEPS_PER_MPS,
    Choices,
    Instruction,
    Key,
    Nudge,
    ScenarioError,
    roughness,
)
from pytest_pafot.model.instructions.lane import (
    LANE_STARTS,
    SHIFTS,
    LaneInstruction,
    Shift,
    known_lane,
    random_lanes,
)
from pytest_pafot.model.instructions.manoeuvre import (
    DEFAULT_STEP,
    MOST_STEPS,
    Manoeuvre,
    Step,
    places,
    random_manoeuvre,
)

__all__ = [
    "ACTS",
    "DEFAULT_STEP",
    "KINDS",
    "LANE_STARTS",
    "LARGEST_SLOT",
    "MAX_SPEED",
    "MOST_STEPS",
    "SHIFTS",
    "SLOTS",
    "SLOT_STEPS_PER_SECOND",
    "SPEED",
    "SPEED_BIN",
    "SPEED_STEPS_PER_MPS",
    "Act",
    "Choices",
    "CrossingInstruction",
    "Instruction",
    "Key",
    "LaneInstruction",
    "Manoeuvre",
    "Nudge",
    "PositionInstruction",
    "ScenarioError",
    "Shift",
    "Step",
    "instruction_of",
    "known_lane",
    "known_position",
    "places",
    "random_lanes",
    "random_manoeuvre",
    "random_position",
    "roughness",
]

KINDS: list[type[Instruction]] = [PositionInstruction, LaneInstruction, CrossingInstruction, Manoeuvre]
"""All kinds. A plain form is read by the last of them that has it."""


def instruction_of(plain: Sequence[Any]) -> Instruction:
    """Return the instruction with a plain form.

    Raises:
        ScenarioError, TypeError, ValueError: if there is no such instruction.
    """
    first, *others = plain
    return next(kind for kind in reversed(KINDS) if kind.reads(first, others)).read(plain)
