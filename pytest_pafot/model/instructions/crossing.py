"""Crossing-Instructions, which send an NPC across or into the ego's way."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from pytest_pafot.model.instructions.instruction import (
    Instruction,
    ScenarioError,
    checked_number,
    checked_speed,
    roughness,
)

if TYPE_CHECKING:
    from numpy.random import Generator

SLOTS = {"well before": -1.0, "just before": 0.0, "together": 0.0, "just after": 1.0, "well after": math.inf}
"""The five named intervals of slots, each with its end [s]. They divide the time at a zone as the nine cells divide the
grid."""

SLOT_STEPS_PER_SECOND = 10
"""Slots are multiples of 0.1 s."""

Act = Literal["pass", "hold", "stop", "late"]
"""What an NPC does at its zone; see :class:`CrossingInstruction`."""

ACTS: tuple[Act, ...] = get_args(Act)

LARGEST_SLOT = 5.0
"""The largest slot [s]: an NPC that enters the zone this long after the ego, or leaves it this long before the ego, no
longer affects the ego."""

ZONE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,30}>[A-Za-z0-9_.-]{1,30}")
"""The pattern of a zone's name: the names of an entry node and an exit node of the road network."""

SECOND, HALF = SLOT_STEPS_PER_SECOND, SLOT_STEPS_PER_SECOND // 2
"""Steps of a slot in shrinking, in tenths of a second."""

SMALL_SLOTS = (0.0, 0.5, -0.5, 1.0, -1.0, 2.0)
"""Slots of NPCs that cross in small scenarios [s]."""


@dataclass(frozen=True, slots=True, repr=False)
class CrossingInstruction(Instruction):
    """The only gene of an NPC whose way meets the ego's way: the zone, the time relative to the ego, and the act there.

    It transfers the grid to a zone, where the time matters as well as the place. The NPC starts so that it meets an ego
    with constant speed as the slot says. As long as there is time, the NPC adapts to the ego's arrival.

    Attributes:
        zone: entry and exit of the NPC's way, such as ``"o1>o3"``, which first meets the ego's there.
        slot: time between the two vehicles at the zone [s], -5 to 5 in steps of 0.1. Positive: from the ego's exit to
            the NPC's entry. Negative: from the NPC's exit to the ego's entry. 0: both are there together.
        speed: up to the zone and in it, lower if a bend requires it [m/s], more than 0, in steps of 0.1.
        act: ``"pass"``: drive through. ``"hold"``: wait at the line before it until the ego has passed. ``"stop"``:
            stop in it. ``"late"``: wait at the line, and drive in as the slot says.
    """

    zone: str
    slot: float
    speed: float
    act: Act = "pass"

    goal_kind = "zone"
    crosses = True
    least_speed: ClassVar[float] = 0.1

    def __post_init__(self) -> None:
        if not isinstance(self.zone, str) or not ZONE_NAME.fullmatch(self.zone):
            expected = 'the entry and the exit of a way, such as "o1>o3"'
            raise ScenarioError(field="zone", expected=expected, received=f"{self.zone!r:.100}")
        if self.act not in ACTS:
            raise ScenarioError(field="act", expected=f"one of {', '.join(ACTS)}", received=f"{self.act!r:.100}")
        object.__setattr__(self, "zone", str(self.zone))
        object.__setattr__(self, "act", str(self.act))
        object.__setattr__(self, "slot", _checked_slot(self.slot))
        object.__setattr__(self, "speed", checked_speed(self.speed, least_steps=1))
        if self.speed <= 0:
            expected, fix = "m/s, more than 0, because it has to arrive", 'act "stop" stops it in the zone'
            raise ScenarioError(field="speed", expected=expected, received=repr(self.speed), fix=fix)

    @property
    def target(self) -> str:
        """The zone's name, as files and canonical texts contain it."""
        return self.zone

    @property
    def interval(self) -> str:
        """The name of the interval that the slot belongs to, such as ``just after``."""
        if self.slot == 0:
            return "together"
        if self.slot < 0:
            return "well before" if self.slot <= SLOTS["well before"] else "just before"
        return "just after" if self.slot < SLOTS["just after"] else "well after"

    @property
    def goal(self) -> str:
        """The zone, the slot and the act in words: ``o1>o3 0.5 s after the ego leaves, stops there``."""
        return ", ".join(filter(None, (f"{self.zone} {self.when}", self.deed)))

    @property
    def when(self) -> str:
        """The slot in words: ``0.5 s after the ego leaves``."""
        if self.slot == 0:
            return "together with the ego"
        return f"{abs(self.slot):g} s {'after the ego leaves' if self.slot > 0 else 'before the ego enters'}"

    @property
    def deed(self) -> str:
        """The act in words; empty if the NPC passes."""
        return {"pass": "", "hold": "holds at the line", "stop": "stops there", "late": "starts late"}[self.act]

    def words_from(self, whence: str) -> str:
        """Return the instruction in words, such as ``from the left, 0.5 s after the ego leaves``."""
        return ", ".join(filter(None, (whence, self.when, self.deed)))

    @property
    def short(self) -> str:
        """The instruction in the text of a scenario: ``o1>o3@8 +0.5 s``."""
        return f"{self.zone}@{self.speed:g} {self.slot:+g} s{'' if self.act == 'pass' else f' {self.act}'}"

    def plain(self) -> list[Any]:
        """Return the zone, the speed, the slot and the act."""
        return [self.zone, self.speed, self.slot, self.act]

    @classmethod
    def read(cls, plain: Sequence[Any]) -> CrossingInstruction:
        """Return the instruction with a zone, a speed, a slot and an act."""
        zone, speed, slot, act = plain
        return cls(zone, slot, speed, act)

    def mixed(self, other: Instruction, rng: Generator) -> tuple[Instruction, Instruction] | None:
        """Return two children if the zone is the same; slot, speed and act are each swapped or not at random."""
        if not isinstance(other, CrossingInstruction) or other.zone != self.zone:
            return None
        slot, speed, act = (bool(each) for each in rng.integers(2, size=3))

        def child(own: CrossingInstruction, other: CrossingInstruction) -> CrossingInstruction:
            return replace(
                own,
                slot=other.slot if slot else own.slot,
                speed=other.speed if speed else own.speed,
                act=other.act if act else own.act,
            )

        return child(self, other), child(other, self)

    def moves(self, before: Any) -> int:
        """Return 1 for an NPC that does not just pass."""
        return int(self.act != "pass")

    @property
    def _tenths(self) -> int:
        return round(self.slot * SLOT_STEPS_PER_SECOND)

    @property
    def roughness(self) -> int:
        """0 for a slot of whole seconds, 1 for halves, 2 for tenths."""
        return roughness(abs(self._tenths), SECOND, HALF)

    @property
    def weight(self) -> int:
        """The distance of the slot from 0, in tenths of a second."""
        return abs(self._tenths)

    def plainer(self) -> Iterator[CrossingInstruction]:
        """Yield a slot of 0, whole and half seconds next to it, and slots nearer to 0 by a second, half or tenth."""
        slot = self._tenths
        rounded = [below for unit in (SECOND, HALF) for below in (slot // unit * unit, -(-slot // unit) * unit)]
        nearer = [slot - math.copysign(step, slot) for step in (SECOND, HALF, 1) if step <= abs(slot)]
        for tenths in dict.fromkeys((0, *rounded, *nearer)):
            yield replace(self, slot=tenths / SLOT_STEPS_PER_SECOND)

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[CrossingInstruction]:
        """Return few slots in the zones of the finding, at round speeds next to those there."""
        places = dict.fromkeys((each.zone, round(each.speed / unit) * unit) for unit in (5.0, 1.0) for each in found)
        return [cls(zone, slot, speed) for slot in SMALL_SLOTS for zone, speed in places if speed > 0]

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        """Return the zone and the slot."""
        return {"zone": self.zone, "words": self.words_from(whence)}


def _checked_slot(value: object) -> float:
    slot = checked_number("slot", value)
    if abs(slot) > LARGEST_SLOT + 1e-9:
        expected = f"seconds, at most {LARGEST_SLOT:g} before or after the ego"
        raise ScenarioError(field="slot", expected=expected, received=repr(value))
    steps = round(slot * SLOT_STEPS_PER_SECOND)
    if abs(slot * SLOT_STEPS_PER_SECOND - steps) > 1e-6:
        fix = f"the nearest valid slot is {steps / SLOT_STEPS_PER_SECOND:g}"
        raise ScenarioError(field="slot", expected="seconds in steps of 0.1", received=repr(value), fix=fix)
    return steps / SLOT_STEPS_PER_SECOND + 0.0
