"""The kinds of instructions that an NPC can have, each in a file of its own, and the table of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pytest_pafot.model.instructions.cell import PositionInstruction as PositionInstruction
from pytest_pafot.model.instructions.cell import random_position as random_position
from pytest_pafot.model.instructions.crossing import ACTS as ACTS
from pytest_pafot.model.instructions.crossing import LARGEST_SLOT as LARGEST_SLOT
from pytest_pafot.model.instructions.crossing import SLOT_STEPS_PER_SECOND as SLOT_STEPS_PER_SECOND
from pytest_pafot.model.instructions.crossing import SLOTS as SLOTS
from pytest_pafot.model.instructions.crossing import Act as Act
from pytest_pafot.model.instructions.crossing import CrossingInstruction as CrossingInstruction
from pytest_pafot.model.instructions.free import BUILT_IN_DRIVERS as BUILT_IN_DRIVERS
from pytest_pafot.model.instructions.free import Free as Free
from pytest_pafot.model.instructions.free import checked_driver as checked_driver
from pytest_pafot.model.instructions.free import random_free as random_free
from pytest_pafot.model.instructions.instruction import LARGEST_SPEED_STEP as LARGEST_SPEED_STEP
from pytest_pafot.model.instructions.instruction import MAX_SPEED as MAX_SPEED
from pytest_pafot.model.instructions.instruction import SPEED_BIN as SPEED_BIN
from pytest_pafot.model.instructions.instruction import SPEED_STEPS_PER_MPS as SPEED_STEPS_PER_MPS
from pytest_pafot.model.instructions.instruction import Choices as Choices
from pytest_pafot.model.instructions.instruction import Instruction as Instruction
from pytest_pafot.model.instructions.instruction import Key as Key
from pytest_pafot.model.instructions.instruction import Nudge as Nudge
from pytest_pafot.model.instructions.instruction import ScenarioError as ScenarioError
from pytest_pafot.model.instructions.instruction import known as known
from pytest_pafot.model.instructions.instruction import roughness as roughness
from pytest_pafot.model.instructions.lane import LANE_STARTS as LANE_STARTS
from pytest_pafot.model.instructions.lane import SHIFTS as SHIFTS
from pytest_pafot.model.instructions.lane import LaneInstruction as LaneInstruction
from pytest_pafot.model.instructions.lane import random_lanes as random_lanes
from pytest_pafot.model.instructions.manoeuvre import MOST_STEPS as MOST_STEPS
from pytest_pafot.model.instructions.manoeuvre import Manoeuvre as Manoeuvre
from pytest_pafot.model.instructions.manoeuvre import Step as Step
from pytest_pafot.model.instructions.manoeuvre import random_manoeuvre as random_manoeuvre
from pytest_pafot.model.instructions.recorded import Recorded as Recorded
from pytest_pafot.model.instructions.recorded import Track as Track

KINDS: list[type[Instruction]] = [
    PositionInstruction,
    LaneInstruction,
    CrossingInstruction,
    Manoeuvre,
    Free,
    Recorded,
]
"""All kinds. A plain form is read by the last of them that has it."""


def instruction_of(plain: Sequence[Any]) -> Instruction:
    """Return the instruction with a plain form.

    Raises:
        ScenarioError, TypeError, ValueError: if there is no such instruction.
    """
    first, *others = plain
    return next(kind for kind in reversed(KINDS) if kind.reads(first, others)).read(plain)
