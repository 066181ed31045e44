"""The kinds of instructions that an NPC can have: Position-, Lane- and Crossing-Instructions.

A kind is a frozen dataclass derived from :class:`Instruction`. It has a field ``speed``, and overrides what differs
from the defaults there. :data:`KINDS` lists all kinds.

Source of Position-Instructions: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, sections 2 and 3.2.
"""

from __future__ import annotations

import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from enum import IntEnum
from functools import cache, lru_cache
from itertools import pairwise, repeat
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Self, cast, get_args

from pytest_pafot.support.errors import FieldError, checked_number, plain_whole
from pytest_pafot.support.text import Pasteable

if TYPE_CHECKING:
    from numpy.random import Generator


_ROWS = (1, 1, 1, 0, -1, -1, -1, 0)
_COLUMNS = (-1, 0, 1, 1, 1, 0, -1, -1)


class Cell(IntEnum):
    """A target cell, numbered clockwise from the front left as in the paper's figure 2.

    Attributes:
        row: +1 ahead of the ego, 0 next to the ego, -1 behind the ego.
        column: the number of lanes to the right of the ego's lane: -1, 0 or +1.
    """

    row: int
    column: int

    FRONT_LEFT = 1
    FRONT = 2
    FRONT_RIGHT = 3
    RIGHT = 4
    REAR_RIGHT = 5
    REAR = 6
    REAR_LEFT = 7
    LEFT = 8

    def __init__(self, number: int) -> None:
        self.row, self.column = _ROWS[number - 1], _COLUMNS[number - 1]

    def __repr__(self) -> str:
        return f"Cell.{self.name}"  # an expression that makes it, unlike an enumeration's own

    __hash__ = int.__hash__  # the hash of the equal number; an enumeration's is several times as slow

    @property
    def neighbours(self) -> tuple[Cell, Cell]:
        """The two neighbouring cells on the ring, first the anticlockwise and then the clockwise one."""
        return _NEIGHBOURS[self - 1]

    @property
    def label(self) -> str:
        """The cell's name in files and reports, such as ``front-left``."""
        return self.name.lower().replace("_", "-")


_NEIGHBOURS = tuple((Cell((number - 2) % 8 + 1), Cell(number % 8 + 1)) for number in range(1, 9))
_CELLS = dict(zip(zip(_ROWS, _COLUMNS, strict=True), Cell, strict=True))

ALL_CELLS = frozenset(Cell)


def is_adjacent(a: Cell, b: Cell) -> bool:
    """Return whether ``b`` may follow ``a`` directly in a chain: it is the same cell or a ring neighbour."""
    return (b - a + 1) % 8 <= 2


_STEPS = frozenset((a, b) for a in Cell for b in Cell if is_adjacent(a, b))
"""All pairs of cells of which the second may follow the first; a set checks a hundred genes faster than calls do."""


def longitudinal_target(cell: Cell, ego_length: float, clearance: float) -> float:
    """Return the distance from the ego's centre to the centre of a cell along the ego's lane [m], negative behind.

    The paper's cell is one ego length long (section 2.1). Taken literally, a vehicle in cell 2 or 6
    is then bumper to bumper with the ego, so reaching the cell is always a collision. ``clearance`` [m] is a gap that
    is added between the ego and the cells ahead and behind. ``clearance=0`` is the paper's literal grid.
    """
    return cell.row * (ego_length + clearance)


def cell_at(longitudinal: float, lateral: float, ego_length: float, lane_width: float) -> Cell | None:
    """Return the cell that contains a point relative to the ego's centre, or None for the ego's own cell.

    Args:
        longitudinal: distance ahead along the ego's lane [m].
        lateral: distance to the right of the ego [m].
        ego_length: length of the ego, which is the length of a row [m].
        lane_width: width of a column [m].

    The outer rows and columns are unbounded: a vehicle 80 m ahead in the ego's lane is in cell 2.
    """
    return _CELLS.get((_third(longitudinal, ego_length / 2), _third(lateral, lane_width / 2)))


def _third(value: float, half: float) -> int:
    return 1 if value > half else -1 if value < -half else 0


def toss(seed: int, npc: int, gene: int) -> bool:
    """Toss a fair coin that depends only on its three arguments (splitmix64's finaliser)."""
    mask = 0xFFFFFFFFFFFFFFFF
    z = (seed * 0x9E3779B97F4A7C15 + npc * 0xBF58476D1CE4E5B9 + (gene + 1) * 0x94D049BB133111EB) & mask
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
    return bool((z ^ (z >> 31)) & 1)


def repair_gene(
    previous: Sequence[Cell] | None,
    requested: Sequence[Cell],
    existing: Collection[Cell],
    coins: Iterable[bool],
    *,
    skipping: bool = False,
) -> tuple[Cell, ...]:
    """Return the cells that all NPCs execute in one gene, from their previous cells and their requested cells.

    A requested cell is executed if it is the previous cell or its ring neighbour, its lane exists and no NPC with a
    smaller index occupies it. Otherwise the NPC gets one of the two neighbours of its previous cell, each with a
    probability of 50 %, by its coin. If only one neighbour is free, the NPC gets that neighbour. If neither is
    free, the NPC stays in its previous cell (section 2.1). The first gene has no previous cells: there the NPC gets the
    free cell that is nearest to the requested one on the ring.

    The cells of the result are distinct, and the result is a fixed point: if it is requested, it is returned. Both
    follow from using the first complete assignment in order of preference. One always exists: all NPCs stay.

    Args:
        previous: the executed cells of the previous gene, distinct, one per NPC; None in the first gene.
        requested: the requested cells, one per NPC.
        existing: the cells whose lane exists now.
        coins: for each NPC False (try the anticlockwise neighbour first) or True (clockwise first); read if needed.
        skipping: whether a step to a cell that does not exist goes on to the next cell on the ring that exists. For
            roads on which few cells exist, such as a single lane with cells 2 and 6.

    Raises:
        ValueError: if there are more NPCs than existing cells in the first gene.
    """
    # Most genes can be driven as requested: this is the fixed point, and saves the search for an assignment.
    wanted = set(requested)
    are_free = len(wanted) == len(requested) and wanted.issubset(existing)
    if are_free and (previous is None or _STEPS.issuperset(zip(previous, requested, strict=True))):
        return tuple(requested)
    if previous is None:
        preferences = [_first_cells(cell, existing, coin) for cell, coin in zip(requested, coins, strict=True)]
    else:
        next_cells = _next_existing_cells if skipping else _next_cells
        preferences = [
            next_cells(before, cell, existing, coin)
            for before, cell, coin in zip(previous, requested, coins, strict=True)
        ]
    # The first complete assignment in order of preference, in which an NPC with a smaller index chooses first.
    assignment = _assigned(preferences, ())
    if assignment is None:
        raise ValueError(
            f"expected a free cell for each NPC, received {len(requested)} NPCs for {len(existing)} existing cells; "
            "use fewer NPCs or more lanes"
        )
    return assignment


def repair_chains(chains: Sequence[Sequence[Cell]], seed: int) -> tuple[tuple[Cell, ...], ...]:
    """Return the NPCs' chains of cells, made valid gene by gene for a road on which every cell exists.

    Each returned chain is as long as the given one. Each of its cells is the previous cell or a ring neighbour of it,
    and no two NPCs occupy the same cell in the same gene. Valid chains are unchanged. Random choices depend only on
    (seed, NPC, gene).
    """
    repaired: list[list[Cell]] = [[] for _ in chains]
    for gene in range(max(map(len, chains), default=0)):
        active = [npc for npc, chain in enumerate(chains) if gene < len(chain)]
        executed = repair_gene(
            [repaired[npc][-1] for npc in active] if gene else None,
            [chains[npc][gene] for npc in active],
            ALL_CELLS,
            map(toss, repeat(seed), active, repeat(gene)),
        )
        for npc, cell in zip(active, executed, strict=True):
            repaired[npc].append(cell)
    return tuple(map(tuple, repaired))


def are_valid(chains: Sequence[Sequence[Cell]]) -> bool:
    """Return whether each cell may follow the one before it, and no two NPCs occupy a cell in the same gene."""
    if not all(_STEPS.issuperset(pairwise(row)) for row in chains):
        return False
    held = [cell + 8 * gene for row in chains for gene, cell in enumerate(row)]
    return len(held) == len(set(held))


def _first_cells(requested: Cell, existing: Collection[Cell], clockwise_first: bool) -> list[Cell]:
    step = 1 if clockwise_first else -1
    by_distance = [Cell((requested - 1 + step * sign * k) % 8 + 1) for k in range(5) for sign in (1, -1)]
    return [cell for cell in dict.fromkeys(by_distance) if cell in existing]


def _next_cells(previous: Cell, requested: Cell, existing: Collection[Cell], clockwise_first: bool) -> list[Cell]:
    """Return the cells that an NPC may execute after its previous cell, the best first."""
    moves = [cell for cell in _wanted_next(previous, requested, clockwise_first) if cell in existing]
    return moves if previous in moves else [*moves, previous]


@cache
def _wanted_next(previous: Cell, requested: Cell, clockwise_first: bool) -> tuple[Cell, ...]:
    anticlockwise, clockwise = previous.neighbours
    neighbours = (clockwise, anticlockwise) if clockwise_first else (anticlockwise, clockwise)
    wanted = (requested,) if is_adjacent(previous, requested) else ()
    return tuple(dict.fromkeys([*wanted, *neighbours]))


def _next_existing_cells(
    previous: Cell, requested: Cell, existing: Collection[Cell], clockwise_first: bool
) -> list[Cell]:
    """Return the cells that an NPC may execute next, the best first, if steps skip the cells that do not exist."""
    # Separate from _next_cells for speed: every search on a straight road calls that for each gene that it repairs.
    ways = {}
    for step in (-1, 1):
        beyond = (Cell((previous - 1 + step * k) % 8 + 1) for k in range(1, 8))
        ways[step] = next((cell for cell in beyond if cell in existing), previous)
    toward = {Cell((previous - 1 + step) % 8 + 1): cell for step, cell in ways.items()}
    allowed = {cell: cell for cell in (previous, *ways.values()) if cell in existing}
    wanted = allowed.get(requested, None if requested in existing else toward.get(requested))
    neighbours = (ways[1], ways[-1]) if clockwise_first else (ways[-1], ways[1])
    moves = [cell for cell in (wanted, *neighbours) if cell is not None and cell in existing]
    return list(dict.fromkeys([*moves, previous]))


def _assigned(preferences: Sequence[Sequence[Cell]], taken: tuple[Cell, ...]) -> tuple[Cell, ...] | None:
    """Return the first assignment of distinct cells to NPCs, in lexicographic order of the NPCs' preferences.

    ``taken`` are the cells of the first NPCs. The result is None if no assignment begins with them.
    """
    if len(taken) == len(preferences):
        return taken
    for cell in preferences[len(taken)]:
        if cell not in taken and (found := _assigned(preferences, (*taken, cell))) is not None:
            return found
    return None


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
        told = {each.name: value for each, value in given if each.default is MISSING or value != each.default}
        return {name: value.label if isinstance(value, Cell) else value for name, value in told.items()}

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
    speed = checked_number(value, "speed", "a finite number", error=ScenarioError)
    if speed > MAX_SPEED:
        raise ScenarioError(field="speed", expected=f"m/s, at most {MAX_SPEED:g}", received=repr(value))
    steps = round(max(speed, 0.0) * SPEED_STEPS_PER_MPS)  # a value far below 0 would overflow when multiplied by 10
    if speed < 0 or abs(speed * SPEED_STEPS_PER_MPS - steps) > 1e-6:
        expected = "m/s, at least 0 and in steps of 0.1"
        fix = f"the nearest valid speed is {max(steps, least_steps) / SPEED_STEPS_PER_MPS:g}"
        raise ScenarioError(field="speed", expected=expected, received=repr(value), fix=fix)
    return steps / SPEED_STEPS_PER_MPS


def roughness(tenths: int, coarse: int = 5 * SPEED_STEPS_PER_MPS, fine: int = SPEED_STEPS_PER_MPS) -> int:
    """Return how far a number in tenths is from being round: 0 for multiples of ``coarse``, 1 of ``fine``, else 2."""
    return (tenths % coarse > 0) + (tenths % fine > 0)


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

    def varied(self, choices: Choices, rng: Generator) -> PositionInstruction:
        """Return an instruction that is uniform over the eight cells and the speeds; others may hold the cell."""
        cell = int(rng.integers(1, 9))
        gene: PositionInstruction = known(PositionInstruction, cell, choices.any_speed(rng))
        return gene

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
    slot = checked_number(value, "slot", "a finite number", error=ScenarioError)
    if abs(slot) > LARGEST_SLOT + 1e-9:
        expected = f"seconds, at most {LARGEST_SLOT:g} before or after the ego"
        raise ScenarioError(field="slot", expected=expected, received=repr(value))
    steps = round(slot * SLOT_STEPS_PER_SECOND)
    if abs(slot * SLOT_STEPS_PER_SECOND - steps) > 1e-6:
        fix = f"the nearest valid slot is {steps / SLOT_STEPS_PER_SECOND:g}"
        raise ScenarioError(field="slot", expected="seconds in steps of 0.1", received=repr(value), fix=fix)
    return steps / SLOT_STEPS_PER_SECOND + 0.0


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
