"""What every kind of instruction says of itself, and the checks of their numbers.

A kind is a frozen dataclass derived from :class:`Instruction`, in a file of its own. It has a field ``speed``, and
overrides what differs from the defaults here. :data:`~pytest_pafot.model.instructions.KINDS` lists it, and
``world/kernel/director.py:DRIVES`` names how it drives; what moves a kind that drives itself is in
``world/engines/npc_drivers.py:MOVERS``. ``world/engines/npc_drivers.py:register`` adds the kind of a package of
somebody else to all three.
"""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, fields, replace
from functools import lru_cache
from itertools import count
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self, cast

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.support.errors import FieldError, plain_whole
from pytest_pafot.support.shown import Pasteable

if TYPE_CHECKING:
    from numpy.random import Generator

SPEED_STEPS_PER_MPS = 10
"""Target speeds are multiples of 0.1 m/s, so that a scenario reads the same in a file and in memory."""

MAX_SPEED = 1000.0
"""The largest speed that a scenario can give to a vehicle [m/s]; each world has a much lower limit."""

FARTHEST = 500.0
"""The largest distance of a start from the ego, and of the triggers of a manoeuvre [m]."""

MOST_BESIDE = 8
"""The largest number of lanes between the ego and a start."""

CODES_PER_TARGET = 10_000
"""The distance between the codes of two targets, which is more than any speed."""

# The starts that a search samples where no other NPC starts.

MARGIN = 5.0
"""The room that stays between two starts [m]."""
NEAR, LARGEST_SPREAD = 8.0, 15.0
"""The smallest gap to the ego, and the part of it that is sampled [m]."""
FASTER, BRAKING = 8.0, 2.0
"""The largest difference to the ego's first speed [m/s], and the braking with which it may be lost before contact
[m/s^2], so that there is no danger at the start."""


class ScenarioError(FieldError):
    """Error for a scenario that breaks a rule; the message says where, what was expected and what to do."""


class Choices(NamedTuple):
    """The values that a search may choose for an instruction.

    Attributes:
        low, top: the lowest and the highest target speed, in steps of 0.1 m/s.
        ego_lane, ego_speed: the ego's first lane, and the first speed of all vehicles [m/s].
        lanes: the number of lanes of a straight road; 0 if it is unknown.
        room: the largest gap between the ego and the start of an NPC, behind and ahead [m].
        drivers: the names of the drivers of free NPCs.
        row: the headway [s] and the least gap [m] with which NPCs with cells start ahead of the ego or behind it.
        longest: the length of the longest vehicle that an NPC can be [m].
    """

    low: int
    top: int
    ego_lane: int
    ego_speed: float
    lanes: int
    room: tuple[float, float]
    drivers: tuple[str, ...] = ()
    row: tuple[float, float] = (0.0, 0.0)
    longest: float = CAR.length

    def any_speed(self, rng: Generator) -> float:
        """Sample a target speed, uniform over the steps of 0.1 m/s [m/s]."""
        return int(rng.integers(self.low, self.top + 1)) / SPEED_STEPS_PER_MPS

    def safe_speed(self, gap: float, rng: Generator) -> float:
        """Sample a speed that is no danger to an ego at a gap [m], nor the ego to the NPC [m/s]."""
        most = min(FASTER, math.sqrt(2 * BRAKING * max(gap - CAR.length / 2, 0.0)))
        speed = round(SPEED_STEPS_PER_MPS * (self.ego_speed + most * (2 * rng.random() - 1)))
        return min(max(speed, self.low), self.top) / SPEED_STEPS_PER_MPS

    @property
    def nearest_row(self) -> float:
        """The gap between the ego and the NPCs with cells that start ahead of it or behind it [m]."""
        headway, clearance = self.row
        return max(headway * self.ego_speed, clearance)


class Space(Protocol):
    """The part of the space of a search that an instruction reads."""

    @property
    def instructions(self) -> str:
        """The kinds of instructions of NPCs that do not cross."""

    @property
    def crossings(self) -> Any:
        """The ways that meet the ego's; None if there is none."""

    @property
    def drivers(self) -> tuple[str, ...]:
        """The names of the drivers of free NPCs."""

    @property
    def around(self) -> Any:
        """The scenario of recorded NPCs that all scenarios are changes of; None if there is none."""


class Instruction(Pasteable, ABC):
    """A gene: what an NPC is told, for the duration of a gene or for the whole run.

    The defaults are those of a kind that has nothing but its fields, and is the only gene of its NPC.
    """

    __slots__ = ()

    name: ClassVar[str]
    """The kind in canonical texts."""
    marks: ClassVar[frozenset[str]]
    """The keys by which a file's mapping shows that it holds this kind."""
    is_alone: ClassVar[bool] = True
    """True if the instruction is the only one of its NPC, and has no duration."""
    on_grid: ClassVar[bool] = False
    """True if it has a ``cell``, for which the rules of the ring hold, and in which the NPC starts."""
    in_free_cell: ClassVar[bool] = False
    """True if the NPC starts in a cell that no other NPC takes, so that its start depends on the other NPCs."""
    crosses: ClassVar[bool] = False
    """True if it has a ``zone`` in which the NPC's way meets the ego's."""
    drives_itself: ClassVar[bool] = False
    """True if a driver of its own moves the NPC, which is then no part of what this instruction says."""
    keeps_start: ClassVar[bool] = False
    """True if it says where the NPC starts: how many lanes ``beside`` the ego, and how far ``ahead``. An NPC of a
    different scenario may not take its place, because the two starts need not fit together."""
    follows_track: ClassVar[bool] = False
    """True if the NPC is where ``at`` says until it leaves its track; ``ahead`` is from centre to centre then."""
    holds_speed: ClassVar[bool] = True
    """True if an NPC that is alone drives its ``speed`` until the first of its steps."""
    least_speed: ClassVar[float] = 0.0
    """The lowest target speed [m/s]."""
    goal_kind: ClassVar[str] = ""
    """The kind of places that its instructions name: ``cell``, ``lane`` or ``zone``; empty if they name none."""

    speed: float
    cell: Cell
    """The target cell, only if the kind is :attr:`on_grid`."""
    beside: int
    """The lane at the start, as a number of lanes to the right of the ego's, only if the kind :attr:`keeps_start`."""
    ahead: float
    """The distance at the start [m], only if the kind :attr:`keeps_start`."""

    # Text and files.

    @property
    def target(self) -> int | str:
        """The cell, the lane, the zone or else the name, as canonical texts and tables contain it."""
        return self.name

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

    def plain(self) -> list[Any]:
        """Return the instruction as a list of texts and numbers, which :meth:`read` reads."""
        return [self.name, self.speed, *(getattr(self, name) for name in _others(type(self)))]

    @classmethod
    def reads(cls, first: Any, others: Sequence[Any]) -> bool:
        """Return whether a list of plain values, the ``first`` and the others, has the form of this kind."""
        return bool(first == cls.name)

    @classmethod
    def read(cls, plain: Sequence[Any]) -> Self:
        """Return the instruction with a plain form."""
        _, speed, *others = plain
        return cls(speed=speed, **dict(zip(_others(cls), others, strict=True)))  # type: ignore[call-arg]

    def in_file(self) -> dict[str, Any]:
        """Return the fields that a file contains: all but those that have their defaults."""
        given = [(each, getattr(self, each.name)) for each in _fields(type(self))]
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

    @classmethod
    def drawn(cls, choices: Choices, others: Sequence[Sequence[Instruction]], rng: Generator) -> Instruction | None:
        """Sample an instruction for an NPC beside ``others``; None if a search draws none of a registered kind."""
        return None

    @abstractmethod
    def is_drawn_in(self, space: Space) -> bool:
        """Return whether a search in a space may have this instruction. A world need not check that it fits."""

    def varied(self, choices: Choices, rng: Generator) -> Instruction:
        """Return an instruction of the same kind that a mutation puts in the place of this one."""
        return self.with_speed(choices.any_speed(rng))

    def mixed(self, other: Instruction, rng: Generator) -> tuple[Instruction, Instruction] | None:
        """Return the children of a crossover with an instruction; None if the NPCs are swapped as a whole."""
        return None

    def beside_others(self, choices: Choices, others: Sequence[Sequence[Instruction]], rng: Generator) -> Instruction:
        """Return an instruction, as sampled for an NPC alone, that leaves room for the starts of other NPCs."""
        return self.drawn(choices, others, rng) or self

    def for_lane(self, before: int, now: int) -> Instruction:
        """Return the instruction whose NPC starts in the same lane if the ego's first lane is another one."""
        return self

    # Shrinking.

    @property
    def size(self) -> int:
        """The number of instructions that a person reads in it."""
        return 1

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

    def passing(self) -> Iterator[Instruction]:
        """Yield instructions that do less, which may shorten the run."""
        yield from ()

    def plainer(self) -> Iterator[Instruction]:
        """Yield instructions with simpler numbers."""
        yield from ()

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[Instruction]:
        """Return the instructions of small scenarios for a finding with instructions ``found`` of this kind."""
        return ()

    # What it asks for, and reports.

    @property
    def place(self) -> str:
        """The start in words, which reports show above the steps; empty for genes of a table, and NPCs that cross."""
        return self.goal if self.is_alone and not self.crosses else ""

    @property
    def steps(self) -> Sequence[Any]:
        """The steps, as those of a manoeuvre."""
        return ()

    @property
    def slot_asked(self) -> float | None:
        """The slot that the NPC is to keep until it has passed [s]; None if it is to keep none."""
        return None

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

    is_alone = False

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


def _fields(kind: Any) -> tuple[Field[Any], ...]:
    return fields(kind)


def _others(kind: Any) -> list[str]:
    return [each.name for each in _fields(kind) if each.name != "speed"]


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


class WithStart(Instruction):
    """An instruction that says where its NPC starts, relative to the ego: ``beside``, ``ahead`` and ``speed``."""

    __slots__ = ()

    keeps_start = True

    def is_drawn_in(self, space: Space) -> bool:
        """Return True: a search that is given such an NPC may vary it."""
        return True

    def check_start(self, **bounds: tuple[float, float]) -> None:
        """Check the start, and more numbers within bounds, in steps of 0.1: ``self.check_start(period=(4.0, 20.0))``.

        Raises:
            ScenarioError: for a number that is wrong.
        """
        beside = plain_whole(self.beside)
        if beside is None or abs(beside) > MOST_BESIDE:
            expected = f"a whole number of lanes from {-MOST_BESIDE} to {MOST_BESIDE}, positive to the right"
            raise ScenarioError(field="beside", expected=expected, received=repr(self.beside))
        object.__setattr__(self, "beside", beside)
        object.__setattr__(self, "ahead", tenths_within("ahead", self.ahead, -FARTHEST, FARTHEST))
        object.__setattr__(self, "speed", checked_speed(self.speed))
        if self.ahead == 0 and self.beside == 0:
            expected, fix = "a distance other than 0 in the ego's lane", "0 is level with the ego"
            raise ScenarioError(field="ahead", expected=expected, received="0", fix=fix)
        for name, (least, most) in bounds.items():
            object.__setattr__(self, name, tenths_within(name, getattr(self, name), least, most))

    @staticmethod
    def random_start(choices: Choices, others: Sequence[Sequence[Instruction]], rng: Generator) -> dict[str, Any]:
        """Sample ``beside``, ``ahead`` and ``speed`` of an NPC beside ``others``.

        NPCs with cells start level with the ego, or in a row ahead of it or behind it. This one starts in a stretch of
        the road that no other NPC has, so that no two of them touch, whatever their lanes are: the first on each side
        between the ego and that row if there is room, the others beyond it.

        Raises:
            ScenarioError: if there is no room.
        """
        row, reach = choices.nearest_row, choices.longest + MARGIN
        free = list[tuple[int, float, float]]()  # side, the least gap and the part of it that is sampled
        taken = [chain[0].ahead for chain in others if chain[0].keeps_start]
        between = row - NEAR - reach
        for place in count():
            for side in (1, -1):
                least, spread = (row + reach + (LARGEST_SPREAD + reach) * (place - 1), LARGEST_SPREAD)
                if place == 0:
                    least, spread = NEAR, min(between, LARGEST_SPREAD)
                if spread < 0 or least + spread > choices.room[side > 0]:
                    continue
                if not any(least - reach < side * each < least + spread + reach for each in taken):
                    free.append((side, least, spread))
            if len(free) > 1 or place > len(others) + 1:
                break
        if not free:
            expected, fix = "room for the start of another NPC", "ask for fewer NPCs"
            raise ScenarioError(field="npcs", expected=expected, received=f"{len(others) + 1} NPCs", fix=fix)
        side, least, spread = free[int(rng.integers(len(free)))]
        ahead = round(least + spread * rng.random(), 1)
        lane = int(rng.integers(choices.lanes)) if choices.lanes else choices.ego_lane
        beside = min(max(lane - choices.ego_lane, -MOST_BESIDE), MOST_BESIDE)
        return {"beside": beside, "ahead": side * ahead, "speed": choices.safe_speed(ahead, rng)}

    @property
    def start(self) -> str:
        """The start in words: ``30 m ahead, 1 lane right``."""
        along = f"{abs(self.ahead):g} m {'ahead' if self.ahead > 0 else 'behind'}" if self.ahead else "level"
        lanes = f"{abs(self.beside)} lane{'s' * (abs(self.beside) > 1)} {'left' if self.beside < 0 else 'right'}"
        return f"{along}, {lanes if self.beside else 'in lane'}"

    @property
    def place(self) -> str:
        """The start in words."""
        return self.start

    @property
    def short(self) -> str:
        """The instruction in the text of a scenario."""
        return f"{self.speed:g} m/s {self.goal}"

    def for_lane(self, before: int, now: int) -> Self:
        """Return the instruction with a start in the same lane; on a road of ten lanes and more, it may be nearer."""
        beside = min(max(self.beside + before - now, -MOST_BESIDE), MOST_BESIDE)
        return cast("Self", replace(cast("Any", self), beside=beside))


def tenths_within(name: str, value: object, least: float, most: float) -> float:
    """Return a number in steps of 0.1 within bounds."""
    number = checked_number(name, value)
    rounded = round(max(min(number, most), least) * 10) / 10 + 0.0
    if not least <= number <= most or abs(number - rounded) > 1e-7:
        expected = f"a number from {least:g} to {most:g} in steps of 0.1"
        raise ScenarioError(field=name, expected=expected, received=repr(value), fix=f"the nearest is {rounded:g}")
    return rounded


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
