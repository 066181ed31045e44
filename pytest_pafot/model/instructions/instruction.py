"""What every kind of instruction says of itself, and the checks of their numbers.

A kind is a frozen dataclass derived from :class:`Instruction`, in a file of its own. It has a field ``speed``, and
overrides what differs from the defaults here. :data:`~pytest_pafot.model.instructions.KINDS` lists all kinds.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self, cast

from pytest_pafot.model.grid import Cell
from pytest_pafot.support.errors import FieldError, plain_whole
from pytest_pafot.support.text import Pasteable

if TYPE_CHECKING:
    from numpy.random import Generator

SPEED_STEPS_PER_MPS = 10
"""Target speeds are multiples of 0.1 m/s, so that a scenario reads the same in a file and in memory."""

MAX_SPEED = 1000.0
"""The largest speed that a scenario can give to a vehicle [m/s]; each world has a much lower limit."""

CODES_PER_TARGET = 10_000
"""The distance between the codes of two targets, which is more than any speed."""


class ScenarioError(FieldError):
    """Error for a scenario that breaks a rule; the message says where, what was expected and what to do."""


class Choices(NamedTuple):
    """The values that a search may choose for an instruction.

    Attributes:
        low, top: the lowest and the highest target speed, in steps of 0.1 m/s.
    """

    low: int
    top: int

    def any_speed(self, rng: Generator) -> float:
        """Sample a target speed, uniform over the steps of 0.1 m/s [m/s]."""
        return int(rng.integers(self.low, self.top + 1)) / SPEED_STEPS_PER_MPS


class Instruction(Pasteable, ABC):
    """A gene: what an NPC is told, for the duration of a gene or for the whole run.

    The defaults are those of most kinds.
    """

    __slots__ = ()

    on_grid: ClassVar[bool] = False
    """True if it has a ``cell``, for which the rules of the ring hold, and in which the NPC starts."""
    crosses: ClassVar[bool] = False
    """True if it has a ``zone`` in which the NPC's way meets the ego's. It is then the only instruction of its NPC, and
    has no duration."""
    least_speed: ClassVar[float] = 0.0
    """The lowest target speed [m/s]."""
    goal_kind: ClassVar[str]
    """The kind of places that its instructions name: ``cell``, ``lane`` or ``zone``."""

    speed: float
    cell: Cell
    """The target cell, only if the kind is :attr:`on_grid`."""

    # Text and files.

    @property
    @abstractmethod
    def target(self) -> int | str:
        """The cell, the lane or the zone, as canonical texts and tables contain it."""

    @property
    def code(self) -> Hashable:
        """A value that only equal instructions have, which is fast to hash and to compare."""
        return self

    @property
    def text(self) -> str:
        """The instruction in canonical texts."""
        return encoded(self.plain())

    @property
    @abstractmethod
    def goal(self) -> str:
        """The instruction in words, without its speed: ``one lane left``."""

    @property
    def short(self) -> str:
        """The instruction in the text of a scenario: ``left@20``."""
        return f"{self.target}@{self.speed:g}"

    @abstractmethod
    def plain(self) -> list[Any]:
        """Return the instruction as a list of texts and numbers, which :meth:`read` reads."""

    @classmethod
    @abstractmethod
    def read(cls, plain: Sequence[Any]) -> Self:
        """Return the instruction with a plain form."""

    def in_file(self) -> dict[str, Any]:
        """Return the fields that a file contains: all but those that have their defaults."""
        given = [(each, getattr(self, each.name)) for each in fields(cast("Any", self))]
        return {each.name: value for each, value in given if each.default is MISSING or value != each.default}

    @property
    def remark(self) -> str:
        """A comment in a file; empty for none."""
        return ""

    # Chains.

    def with_speed(self, speed: float) -> Self:
        """Return the instruction with another speed [m/s]."""
        return cast("Self", replace(cast("Any", self), speed=speed))

    def aimed(self, target: Any) -> Instruction:
        """Return the instruction with another target, if the kind has several."""
        return self

    @property
    def afterwards(self) -> Instruction:
        """The instruction that goes on with what this one has begun, and asks for nothing new."""
        return self

    # Search.

    def varied(self, choices: Choices, rng: Generator) -> Instruction:
        """Return an instruction of the same kind that a mutation puts in the place of this one."""
        return self.with_speed(choices.any_speed(rng))

    def mixed(self, other: Instruction, rng: Generator) -> tuple[Instruction, Instruction] | None:
        """Return the children of a crossover with an instruction; None if the NPCs are swapped as a whole."""
        return None

    # Shrinking.

    def moves(self, before: Any) -> int:
        """Return the number of moves after the instruction ``before`` in the chain; staying is simpler."""
        return 0

    @property
    def roughness(self) -> int:
        """A number that is larger if fewer of its numbers, other than the speed, are round or usual."""
        return 0

    @property
    def weight(self) -> int:
        """The number that is to become small when all else is equal: the speed in tenths."""
        return round(self.speed * SPEED_STEPS_PER_MPS)

    def staying(self, before: Any) -> Instruction | None:
        """Return the instruction whose NPC stays as ``before`` it, at its own speed; None if it has no such form."""
        return None

    def on_ring(self, cell: Cell) -> Any:
        """Return the Position-Instruction that makes the same move from a cell; None if there is none."""
        return None

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[Instruction]:
        """Return the instructions of small scenarios for a finding with instructions ``found`` of this kind."""
        return ()

    # What it asks for, and reports.

    def words(self, apart: float) -> str:
        """Return the instruction as driven in words.

        ``apart`` says how many lanes to the right of the ego the NPC is when it begins; NaN if it is unknown.
        """
        return self.goal

    def row(self, apart: float, end: str, *, names_side: bool) -> str:
        """Return the words for a table; ``end`` says when the target was reached."""
        return f"{self.words(apart)} {self.speed:.1f} m/s {end}"

    def lasting(self, later: Any) -> int | None:
        """Return how many lanes to the right a change goes that a later instruction lets go on; None if none does."""
        return None

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        """Return the fields of the page's view of this instruction, which was driven instead of ``requested``.

        ``apart`` is that of :meth:`words`; ``whence`` says where an NPC that crosses comes from.
        """
        return {"words": self.words(apart)}


encoded = json.JSONEncoder(separators=(",", ":")).encode


class TimedInstruction(Instruction):
    """A gene that lasts as long as the others of its chain, and has one target and a speed.

    A search needs some values of dozens of them in each run, so these are computed once for each gene.
    """

    __slots__ = ("code", "target", "text")

    target: int | str
    code: float
    text: str

    def _prepare(self, target: int | str, number: int) -> None:
        object.__setattr__(self, "target", target)
        object.__setattr__(self, "code", CODES_PER_TARGET * number + self.speed)
        object.__setattr__(self, "text", encoded(self.plain()))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as a cached constructor call, because runs travel between processes with dozens of equal genes."""
        return known, (type(self), self.target, self.speed)

    def plain(self) -> list[Any]:
        """Return the target and the speed."""
        return [self.target, self.speed]

    @classmethod
    def read(cls, plain: Sequence[Any]) -> Self:
        """Return the instruction with a target and a speed."""
        return cast("Self", known(cls, *plain))

    def aimed(self, target: Any) -> Self:
        """Return the instruction with another target."""
        return cast("Self", known(type(self), target, self.speed))


@lru_cache(maxsize=1 << 15, typed=True)
def known(kind: Callable[[Any, Any], TimedInstruction], target: Any, speed: Any) -> Any:
    """Return an instruction from a cache, because a search needs few of them many times."""
    return kind(target, speed)


# Checks of numbers.


def checked_speed(value: object, least_steps: int = 0) -> float:
    """Return a speed in steps of 0.1 m/s; ``least_steps`` is the lowest that an error advises."""
    speed = checked_number("speed", value)
    if speed > MAX_SPEED:
        raise ScenarioError(field="speed", expected=f"m/s, at most {MAX_SPEED:g}", received=repr(value))
    steps = round(max(speed, 0.0) * SPEED_STEPS_PER_MPS)  # a value far below 0 would overflow when multiplied by 10
    if speed < 0 or abs(speed * SPEED_STEPS_PER_MPS - steps) > 1e-6:
        expected = "m/s, at least 0 and in steps of 0.1"
        fix = f"the nearest valid speed is {max(steps, least_steps) / SPEED_STEPS_PER_MPS:g}"
        raise ScenarioError(field="speed", expected=expected, received=repr(value), fix=fix)
    return steps / SPEED_STEPS_PER_MPS


def checked_number(name: str, value: object) -> float:
    """Return a finite number."""
    whole = plain_whole(value)
    try:
        number = float(value if isinstance(value, float) else math.nan if whole is None else whole)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ScenarioError(field=name, expected="a finite number", received=repr(value))
    return number + 0.0  # -0.0 becomes 0.0, so that equal scenarios have equal texts


def roughness(tenths: int, coarse: int = 5 * SPEED_STEPS_PER_MPS, fine: int = SPEED_STEPS_PER_MPS) -> int:
    """Return how far a number in tenths is from being round: 0 for multiples of ``coarse``, 1 of ``fine``, else 2."""
    return (tenths % coarse > 0) + (tenths % fine > 0)
