"""The kinds of instructions that an NPC can have."""
# A kind is a frozen dataclass with a field `speed`. It is derived from Instruction and overrides the defaults that do
# not suit it. Source of Position-Instructions: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, sections 2 and
# 3.2.

from __future__ import annotations

import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from enum import IntEnum
from functools import cache, lru_cache
from itertools import compress, pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Self, TypeVar, cast, get_args

from pytest_pafot.support.errors import FieldError, checked_number, plain_whole
from pytest_pafot.support.text import Pasteable

if TYPE_CHECKING:
    from numpy.random import Generator


_ROWS = (1, 1, 1, 0, -1, -1, -1, 0)
_COLUMNS = (-1, 0, 1, 1, 1, 0, -1, -1)


class Cell(IntEnum):
    """A target cell, numbered clockwise from the front left as in the paper's figure 2.

    Attributes:
        row: +1 ahead of the ego, 0 next to it, -1 behind it.
        column: number of lanes to the right of the ego: -1, 0 or +1.
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
        self.row = _ROWS[number - 1]
        self.column = _COLUMNS[number - 1]

    def __repr__(self) -> str:
        return f"Cell.{self.name}"  # can be pasted into code, unlike the repr of other enumerations

    __hash__ = int.__hash__  # several times as fast as the hash of other enumerations

    @property
    def neighbours(self) -> tuple[Cell, Cell]:
        # The anticlockwise neighbour is first.
        return _NEIGHBOURS[self - 1]

    @property
    def label(self) -> str:
        """The name in files and reports, such as ``front-left``."""
        return self.name.lower().replace("_", "-")


_NEIGHBOURS = tuple((Cell((number - 2) % 8 + 1), Cell(number % 8 + 1)) for number in range(1, 9))
_CELLS = dict(zip(zip(_ROWS, _COLUMNS, strict=True), Cell, strict=True))

ALL_CELLS = frozenset(Cell)


def is_adjacent(a: Cell, b: Cell) -> bool:
    """Return whether ``b`` can directly follow ``a`` in a chain."""
    return (b - a + 1) % 8 <= 2


# All pairs of cells in which the second may follow the first. With a set, checking a hundred genes is faster.
_STEPS = frozenset((a, b) for a in Cell for b in Cell if is_adjacent(a, b))


def longitudinal_target(cell: Cell, ego_length: float, clearance: float) -> float:
    """Return the target distance [m] ahead of the ego for an NPC in a cell."""
    # The paper's cell is as long as the ego (section 2.1). A vehicle in cell 2 or 6 would then be bumper to bumper with
    # the ego, so reaching the cell would always be a collision. Therefore `clearance` [m] is added ahead and behind; 0
    # gives the paper's grid.
    return cell.row * (ego_length + clearance)


def cell_at(
    longitudinal: float,
    lateral: float,
    ego_length: float,
    lane_width: float,
) -> Cell | None:
    """Return the cell that contains a point, or None for the ego's own cell."""
    # The outer rows and columns have no outer limits: a vehicle 80 m ahead in the ego's lane is in cell 2.
    row = _third(longitudinal, ego_length / 2)
    column = _third(lateral, lane_width / 2)
    return _CELLS.get((row, column))


def _third(value: float, half: float) -> int:
    if value > half:
        return 1
    if value < -half:
        return -1
    return 0


def toss(seed: int, npc: int, gene: int) -> bool:
    """Toss a fair coin that depends only on the arguments (splitmix64)."""
    mask = 0xFFFFFFFFFFFFFFFF
    z = seed * 0x9E3779B97F4A7C15 + npc * 0xBF58476D1CE4E5B9 + (gene + 1) * 0x94D049BB133111EB
    z &= mask
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
    """Return the cells that all NPCs execute in one gene."""
    # See section 2.1 of the paper. `existing` are the cells with a lane that exists now, and `previous` is None in the
    # first gene. If an NPC's coin is True, its clockwise neighbour is tried first. With `skipping`, for roads with few
    # cells, a step skips cells that do not exist.
    #
    # A requested cell is executed if it is the previous cell or its ring neighbour, its lane exists, and no NPC with a
    # smaller index occupies it. Otherwise, the NPC gets the neighbour of its previous cell that its coin selects, or
    # the one that is free. If neither is free, it stays. In the first gene, it gets the free cell nearest to the
    # requested one. The first complete assignment in order of preference is used, so the cells are distinct and the
    # result is a fixed point. An assignment always exists, because all NPCs can stay.
    #
    # Most genes can be executed as requested. This check saves the search for an assignment.
    wanted = set(requested)
    are_free = len(wanted) == len(requested) and wanted.issubset(existing)
    if are_free and (previous is None or _STEPS.issuperset(zip(previous, requested, strict=True))):
        return tuple(requested)
    next_cells = _next_existing_cells if skipping else _next_cells
    preferences = []
    for npc, (cell, coin) in enumerate(zip(requested, coins, strict=True)):
        if previous is None:
            preferences.append(_first_cells(cell, existing, coin))
        else:
            preferences.append(next_cells(previous[npc], cell, existing, coin))
    # NPCs with a smaller index choose first.
    assignment = _assigned(preferences, ())
    if assignment is None:
        raise ValueError(
            f"expected a free cell for each NPC, received {len(requested)} NPCs for {len(existing)} existing cells. "
            "Use fewer NPCs or more lanes"
        )
    return assignment


def repair_chains(chains: Sequence[Sequence[Cell]], seed: int) -> tuple[tuple[Cell, ...], ...]:
    """Return the chains, repaired for a road on which all cells exist."""
    # Valid chains are unchanged. Random choices depend only on (seed, NPC, gene).
    repaired: list[list[Cell]] = [[] for _ in chains]
    for gene in range(max(map(len, chains), default=0)):
        active = [npc for npc, chain in enumerate(chains) if gene < len(chain)]
        previous = None
        if gene:
            previous = [repaired[npc][-1] for npc in active]
        requested = [chains[npc][gene] for npc in active]
        coins = [toss(seed, npc, gene) for npc in active]
        executed = repair_gene(previous, requested, ALL_CELLS, coins)
        for npc, cell in zip(active, executed, strict=True):
            repaired[npc].append(cell)
    return tuple(map(tuple, repaired))


def are_valid(chains: Sequence[Sequence[Cell]]) -> bool:
    """Return whether chains are valid without any repair."""
    if not all(_STEPS.issuperset(pairwise(row)) for row in chains):
        return False
    held = [cell + 8 * gene for row in chains for gene, cell in enumerate(row)]
    return len(held) == len(set(held))


def _first_cells(requested: Cell, existing: Collection[Cell], clockwise_first: bool) -> list[Cell]:
    signs = (1, -1) if clockwise_first else (-1, 1)
    by_distance = [_around(requested, sign * k) for k in range(5) for sign in signs]
    return [cell for cell in dict.fromkeys(by_distance) if cell in existing]


def _around(cell: Cell, steps: int) -> Cell:
    # The cell that is this number of steps clockwise on the ring.
    return Cell((cell - 1 + steps) % 8 + 1)


def _next_cells(
    previous: Cell,
    requested: Cell,
    existing: Collection[Cell],
    clockwise_first: bool,
) -> list[Cell]:
    wanted = _wanted_next(previous, requested, clockwise_first)
    moves = [cell for cell in wanted if cell in existing]
    if previous not in moves:
        moves.append(previous)
    return moves


@cache
def _wanted_next(previous: Cell, requested: Cell, clockwise_first: bool) -> tuple[Cell, ...]:
    wanted = list(previous.neighbours)
    if clockwise_first:
        wanted.reverse()
    if is_adjacent(previous, requested):
        wanted.insert(0, requested)
    return tuple(dict.fromkeys(wanted))


def _next_existing_cells(
    previous: Cell,
    requested: Cell,
    existing: Collection[Cell],
    clockwise_first: bool,
) -> list[Cell]:
    # Separate from _next_cells, which must be fast: a search on a straight road calls it for each gene that it repairs.
    steps = (1, -1) if clockwise_first else (-1, 1)
    moves: list[Cell] = []
    for step in steps:
        beyond = [_around(previous, step * k) for k in range(1, 8)]
        near = next((cell for cell in beyond if cell in existing), previous)
        # a missing neighbour stands for the next cell that exists in its direction
        if requested == near or (requested == beyond[0] and requested not in existing):
            moves.insert(0, near)
        else:
            moves.append(near)
    if requested == previous:
        moves.insert(0, previous)
    moves = [cell for cell in moves if cell in existing]
    return list(dict.fromkeys([*moves, previous]))


def _assigned(
    preferences: Sequence[Sequence[Cell]], taken: tuple[Cell, ...]
) -> tuple[Cell, ...] | None:
    # The first assignment of distinct cells, in lexicographic order of the NPCs' preferences; None if none continues
    # `taken`.
    if len(taken) == len(preferences):
        return taken
    for cell in preferences[len(taken)]:
        if cell in taken:
            continue
        found = _assigned(preferences, (*taken, cell))
        if found is not None:
            return found
    return None


# Target speeds are multiples of 0.1 m/s, so that a scenario reads the same in a file and in memory.
SPEED_STEPS_PER_MPS = 10

# The highest speed that a scenario can give to a vehicle [m/s]. Each world has a much lower limit.
MAX_SPEED = 1000.0

# the distance between the codes of two targets, which is more than any speed
CODES_PER_TARGET = 10_000


class ScenarioError(FieldError):
    """An error for a scenario that breaks a rule."""


def set_fields(frozen: object, **values: Any) -> None:
    """Set fields of a frozen dataclass, which is allowed only in its ``__post_init__``."""
    for name, value in values.items():
        object.__setattr__(frozen, name, value)


class Choices(NamedTuple):
    """The range of target speeds in a search, in tenths of m/s."""

    low: int
    top: int

    def any_speed(self, rng: Generator) -> float:
        return int(rng.integers(self.low, self.top + 1)) / SPEED_STEPS_PER_MPS


T = TypeVar("T")


def pick(options: Sequence[T], rng: Generator) -> T:
    """Return one of several options at random, all with the same probability."""
    return options[int(rng.integers(len(options)))]


class Instruction(Pasteable, ABC):
    """An instruction for an NPC."""

    # The defaults suit most kinds.

    __slots__ = ()

    on_grid: ClassVar[bool] = False
    # True if it has a `cell`, in which the NPC starts and to which the rules of the ring apply.
    crosses: ClassVar[bool] = False
    # True if it has a `zone`. It is then the only instruction of its NPC, and has no duration.
    least_speed: ClassVar[float] = 0.0
    goal_kind: ClassVar[str]
    speed: float
    cell: Cell

    # Strings and files.

    @property
    @abstractmethod
    def target(self) -> int | str:
        """The target cell, lane or zone, as in a scenario's canonical string."""

    @property
    def code(self) -> Hashable:
        # Unique for each instruction, and fast to hash and to compare.
        return self

    @property
    def text(self) -> str:
        return encoded(self.plain())

    @property
    @abstractmethod
    def goal(self) -> str:
        """The instruction in words, without the speed."""

    @property
    def short(self) -> str:
        # As in the string of a scenario, for example `left@20`.
        return f"{self.target}@{self.speed:g}"

    @abstractmethod
    def plain(self) -> list[Any]:
        """Return the instruction as a list of strings and numbers for :meth:`read`."""

    @classmethod
    @abstractmethod
    def read(cls, plain: Sequence[Any]) -> Self:
        """Return the instruction from the output of :meth:`plain`."""

    def in_file(self) -> dict[str, Any]:
        told = {}
        for each in fields(cast("Any", self)):
            value = getattr(self, each.name)
            if each.default is MISSING or value != each.default:
                told[each.name] = value.label if isinstance(value, Cell) else value
        return told

    # Chains.

    def with_speed(self, speed: float) -> Self:
        return cast("Self", replace(cast("Any", self), speed=speed))

    def aimed(self, target: Any) -> Instruction:
        return self

    @property
    def afterwards(self) -> Instruction:
        # The instruction that only continues this one.
        return self

    # Search.

    def varied(self, choices: Choices, rng: Generator) -> Instruction:
        # The instruction that a mutation inserts instead of this one.
        return self.with_speed(choices.any_speed(rng))

    def mixed(self, other: Instruction, rng: Generator) -> tuple[Instruction, Instruction] | None:
        # The children of a crossover; None to swap the complete chains.
        return None

    # Shrinking.

    def moves(self, before: Any) -> int:
        # The number of moves that this instruction adds after `before`. Fewer are simpler.
        return 0

    @property
    def roughness(self) -> int:
        # The number that shrinking reduces by rounding values other than the speed.
        return 0

    @property
    def weight(self) -> int:
        # The number that shrinking reduces if all else is equal: the speed in tenths of m/s.
        return round(self.speed * SPEED_STEPS_PER_MPS)

    def staying(self, before: Any) -> Instruction | None:
        # The instruction to stay where `before` ended; None if this kind has none.
        return None

    def on_ring(self, cell: Cell) -> Any:
        # The Position-Instruction for the same move; None if there is none.
        return None

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[Instruction]:
        # The instructions for small scenarios, if the finding has the instructions `found`.
        return ()

    # Reports.

    def words(self, apart: float) -> str:
        # `apart` is the number of lanes from the ego to the NPC at the start, positive to the right; NaN if unknown.
        return self.goal

    def row(self, apart: float, end: str, *, names_side: bool) -> str:
        return f"{self.words(apart)} {self.speed:.1f} m/s {end}"

    def lasting(self, later: Any) -> int | None:
        # The number of lanes by which this lane change leads to the right, or None if `later` does not continue it.
        return None

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        # The fields in the data of the report page, for this instruction as executed and `requested`.
        return {"words": self.words(apart)}


encoded = json.JSONEncoder(separators=(",", ":")).encode


class TimedInstruction(Instruction):
    """A gene with a duration."""

    # A search needs these values for dozens of genes in each run, so they are computed only once per gene.

    __slots__ = ("code", "target", "text")

    # All targets that a gene of this kind can have.
    targets: ClassVar[Sequence[Any]]
    target: int | str
    code: float
    text: str

    def _prepare(self, target: int | str, number: int) -> None:
        set_fields(self, target=target, code=CODES_PER_TARGET * number + self.speed)
        set_fields(self, text=encoded(self.plain()))  # needs the target

    def __reduce__(self) -> tuple[Any, ...]:
        # A cached constructor call, because runs travel between processes with dozens of equal genes.
        return known, (type(self), self.target, self.speed)

    def plain(self) -> list[Any]:
        return [self.target, self.speed]

    @classmethod
    def read(cls, plain: Sequence[Any]) -> Self:
        return cast("Self", known(cls, *plain))

    def aimed(self, target: Any) -> Self:
        return cast("Self", known(type(self), target, self.speed))

    def varied(self, choices: Choices, rng: Generator) -> Self:
        # Uniform over all targets, whether or not another NPC has the cell.
        target = pick(self.targets, rng)
        return cast("Self", known(type(self), target, choices.any_speed(rng)))

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[Self]:
        return [known(cls, target, speed) for target in cls.targets for speed in speeds]


@lru_cache(maxsize=1 << 15, typed=True)
def known(kind: Callable[[Any, Any], TimedInstruction], target: Any, speed: Any) -> Any:
    """Return an instruction, from a cache if possible."""
    return kind(target, speed)


# Checks of numbers.


def checked_speed(value: object, least_steps: int = 0) -> float:
    """Check a target speed [m/s] and return it, rounded to a step of 0.1."""
    speed = checked_number(value, "speed", "a finite number", error=ScenarioError)
    if speed > MAX_SPEED:
        raise ScenarioError(
            field="speed",
            expected=f"a speed of at most {MAX_SPEED:g} m/s",
            received=repr(value),
        )
    # a value far below 0 would overflow when multiplied by 10
    steps = round(max(speed, 0.0) * SPEED_STEPS_PER_MPS)
    if speed < 0 or abs(speed * SPEED_STEPS_PER_MPS - steps) > 1e-6:
        nearest = max(steps, least_steps) / SPEED_STEPS_PER_MPS  # `least_steps` is valid
        raise ScenarioError(
            field="speed",
            expected="a non-negative multiple of 0.1 m/s",
            received=repr(value),
            fix=f"the nearest valid speed is {nearest:g} m/s",
        )
    return steps / SPEED_STEPS_PER_MPS


def roughness(
    tenths: int,
    coarse: int = 5 * SPEED_STEPS_PER_MPS,
    fine: int = SPEED_STEPS_PER_MPS,
) -> int:
    """Return 0 for a multiple of ``coarse``, 1 for a multiple of ``fine``, otherwise 2."""
    return (tenths % coarse > 0) + (tenths % fine > 0)


@dataclass(frozen=True, slots=True, repr=False)
class PositionInstruction(TimedInstruction):
    """A gene that makes an NPC drive into a cell of the grid and then keep a speed.

    Attributes:
        cell: target cell, from 1 to 8.
        speed: target speed [m/s], >= 0, in steps of 0.1.
    """

    cell: Cell
    speed: float

    if TYPE_CHECKING:

        def __init__(self, cell: int, speed: float) -> None: ...

    on_grid = True
    goal_kind = "cell"
    targets = tuple(Cell)

    def __post_init__(self) -> None:
        if type(self.cell) is not Cell:
            number = plain_whole(self.cell)
            if number is None or not 1 <= number <= 8:
                expected = (
                    "a whole number from 1 (front-left) to 8 (left), clockwise around the ego"
                )
                raise ScenarioError(field="cell", expected=expected, received=repr(self.cell))
            set_fields(self, cell=Cell(number))
        set_fields(self, speed=checked_speed(self.speed))
        self._prepare(int(self.cell), int(self.cell))

    @property
    def goal(self) -> str:
        return f"{int(self.cell)} {self.cell.label}"

    def moves(self, before: Any) -> int:
        return int(before is not None and before.cell != self.cell)

    def staying(self, before: Any) -> PositionInstruction | None:
        if before is None:
            return None
        return PositionInstruction(before.cell, self.speed)

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        return {"requested": int(requested.cell), "cell": int(self.cell)}


# The lane to drive in: the NPC's lane at the start of the gene, or the lane to the left or right of it.
Shift = Literal["keep", "left", "right"]

SHIFTS: tuple[Shift, ...] = get_args(Shift)

# The cells in which NPCs with Lane-Instructions start: each NPC in the first cell that exists and is free. The first
# two are the starts of the NPCs in the released AV-Fuzzer: ahead to the left of the ego, and ahead in the ego's lane.
LANE_STARTS = tuple(map(Cell, (1, 2, 3, 8, 4, 6, 7, 5)))


@dataclass(frozen=True, slots=True, repr=False)
class LaneInstruction(TimedInstruction):
    """A gene that makes an NPC keep its lane or move by one lane, wherever the ego is.

    AV-Fuzzer has the same manoeuvres (Li et al., ISSRE 2020). If the lane does not exist, the NPC keeps its lane.

    Attributes:
        lane: ``"keep"``, ``"left"`` or ``"right"``, relative to the NPC's lane at the start of the gene.
        speed: target speed [m/s] from the first tick of the gene, >= 0, in steps of 0.1.
    """

    lane: Shift
    speed: float

    goal_kind = "lane"
    targets = SHIFTS

    def __post_init__(self) -> None:
        if self.lane not in SHIFTS:
            raise ScenarioError(
                field="lane",
                expected=f"one of {', '.join(SHIFTS)}",
                received=repr(self.lane),
            )
        set_fields(self, lane=str(self.lane), speed=checked_speed(self.speed))
        self._prepare(self.lane, 9 + SHIFTS.index(self.lane))

    @property
    def column(self) -> int:
        return {"keep": 0, "left": -1, "right": 1}[self.lane]

    @property
    def goal(self) -> str:
        if self.lane == "keep":
            return "keep lane"
        return f"one lane {self.lane}"

    @property
    def afterwards(self) -> LaneInstruction:
        return replace(self, lane="keep")

    def moves(self, before: Any) -> int:
        return int(self.lane != "keep")

    def staying(self, before: Any) -> LaneInstruction:
        return LaneInstruction("keep", self.speed)

    def on_ring(self, cell: Cell) -> PositionInstruction:
        # If there is no cell in that direction, the NPC stays in the same cell.
        there = cell_at(cell.row, cell.column + self.column, 1.0, 1.0)  # a grid of 1 m by 1 m
        return PositionInstruction(there or cell, self.speed)

    def words(self, apart: float) -> str:
        if math.isnan(apart):
            return self.goal
        after = apart + self.column
        if apart == 0 != after:
            return f"out of the ego's lane to the {self.lane}"
        if after == 0 != apart:
            return f"from the {_side(apart)} into the ego's lane"
        verb = "keep" if apart == after else "into"
        if after == 0:
            return f"{verb} the ego's lane"
        far = round(abs(after))
        number = {0: "", 1: "", 2: "2nd ", 3: "3rd "}.get(far, f"{far}th ")
        return f"{verb} the {number}lane {_side(after)} of the ego"

    def row(self, apart: float, end: str, *, names_side: bool) -> str:
        # A narrow table has no room for the side.
        words = self.words(apart)
        if not names_side:
            words = re.sub("^from the [a-z]+ | to the [a-z]+$", "", words)
        if self.lane == "keep":
            end = ""
        return f"{words} {self.speed:.1f} m/s {end}".rstrip()

    def lasting(self, later: Any) -> int | None:
        if later.lane == "keep":
            return self.column
        return None

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        words = self.words(apart)
        if self != requested:
            words = f"{words} (requested {requested.goal})"
        return {"lane": self.lane, "words": words}


def _side(apart: float) -> str:
    if apart < 0:
        return "left"
    return "right"


def random_lanes(
    choices: Choices,
    npcs: int,
    genes: int,
    rng: Generator,
) -> list[list[LaneInstruction]]:
    """Sample chains of ``LaneInstruction`` uniformly."""
    shifts = rng.integers(len(SHIFTS), size=(npcs, genes)).tolist()
    speeds = rng.integers(choices.low, choices.top + 1, size=(npcs, genes)).tolist()
    targets = [[SHIFTS[shift] for shift in chain] for chain in shifts]
    return chains_of(LaneInstruction, targets, speeds)


def chains_of(
    kind: Callable[[Any, Any], TimedInstruction],
    targets: Sequence[Sequence[Any]],
    speeds: Sequence[Sequence[int]],
) -> list[list[Any]]:
    """Build a chain for each NPC from its targets and its speeds, which are in units of 0.1 m/s."""
    chains = []
    for row, steps in zip(targets, speeds, strict=True):
        pairs = zip(row, steps, strict=True)
        chains.append([known(kind, target, step / SPEED_STEPS_PER_MPS) for target, step in pairs])
    return chains


SLOT_STEPS_PER_SECOND = 10  # slots are multiples of 0.1 s

# The acts of an NPC at its zone; see :class:`CrossingInstruction`.
Act = Literal["pass", "hold", "stop", "late"]

ACTS: tuple[Act, ...] = get_args(Act)

# The largest slot [s]: an NPC that enters the zone this long after the ego, or leaves it this long before the ego, no
# longer affects the ego.
LARGEST_SLOT = 5.0

# The pattern of a zone's name: the names of an entry node and an exit node of the road network.
ZONE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,30}>[A-Za-z0-9_.-]{1,30}")

# The steps to which shrinking rounds a slot, in tenths of a second.
SECOND = SLOT_STEPS_PER_SECOND
HALF = SECOND // 2

SMALL_SLOTS = (0.0, 0.5, -0.5, 1.0, -1.0, 2.0)  # slots of NPCs that cross in small scenarios [s]


@dataclass(frozen=True, slots=True, repr=False)
class CrossingInstruction(Instruction):
    """The only gene of an NPC that crosses the ego's path.

    Attributes:
        zone: entry and exit of the NPC's path, such as ``"o1>o3"``.
        slot: time [s] between the two vehicles at the zone, from -5 to 5 in steps of 0.1. Positive: from the ego's exit
            to the NPC's entry. Negative: from the NPC's exit to the ego's entry. 0: both are there together.
        speed: target speed [m/s] up to and in the zone, above 0 and in steps of 0.1. The NPC is slower if a curve
            requires it.
        act: ``"pass"``: drive through. ``"hold"``: wait at the line before the zone until the ego has passed.
            ``"stop"``: stop in the zone. ``"late"``: wait at the line, then enter as the slot specifies.
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
            expected = 'the entry and exit of a path, such as "o1>o3"'
            raise ScenarioError(field="zone", expected=expected, received=f"{self.zone!r:.100}")
        if self.act not in ACTS:
            raise ScenarioError(
                field="act",
                expected=f"one of {', '.join(ACTS)}",
                received=f"{self.act!r:.100}",
            )
        set_fields(
            self,
            zone=str(self.zone),
            slot=_checked_slot(self.slot),
            speed=checked_speed(self.speed, least_steps=1),
            act=str(self.act),
        )
        if self.speed <= 0:
            raise ScenarioError(
                field="speed",
                expected="a speed above 0 m/s, so that the NPC reaches the zone",
                received=repr(self.speed),
                fix='use act="stop" to stop there',
            )

    @property
    def target(self) -> str:
        return self.zone

    @property
    def goal(self) -> str:
        return self._described(f"{self.zone} {self.when}")

    @property
    def when(self) -> str:
        if self.slot == 0:
            return "together with the ego"
        if self.slot > 0:
            return f"{self.slot:g} s after the ego leaves"
        return f"{-self.slot:g} s before the ego enters"

    def _described(self, *texts: str) -> str:
        deed = {
            "pass": "",
            "hold": "holds at the line",
            "stop": "stops there",
            "late": "starts late",
        }[self.act]
        return ", ".join(filter(None, (*texts, deed)))

    def words_from(self, whence: str) -> str:
        return self._described(whence, self.when)

    @property
    def short(self) -> str:
        text = f"{self.target}@{self.speed:g} {self.slot:+g} s"
        if self.act == "pass":
            return text
        return f"{text} {self.act}"

    def plain(self) -> list[Any]:
        return [self.zone, self.speed, self.slot, self.act]

    @classmethod
    def read(cls, plain: Sequence[Any]) -> CrossingInstruction:
        zone, speed, slot, act = plain
        return cls(zone, slot, speed, act)

    def mixed(self, other: Instruction, rng: Generator) -> tuple[Instruction, Instruction] | None:
        # Slot, speed and act are each swapped or not, at random.
        if not isinstance(other, CrossingInstruction) or other.zone != self.zone:
            return None
        is_swapped = rng.integers(2, size=3).tolist()
        names = list(compress(("slot", "speed", "act"), is_swapped))
        mine: dict[str, Any] = {name: getattr(self, name) for name in names}
        its: dict[str, Any] = {name: getattr(other, name) for name in names}
        return replace(self, **its), replace(other, **mine)

    def moves(self, before: Any) -> int:
        return int(self.act != "pass")

    @property
    def _tenths(self) -> int:
        return round(self.slot * SLOT_STEPS_PER_SECOND)

    @property
    def roughness(self) -> int:
        return roughness(abs(self._tenths), SECOND, HALF)

    @property
    def weight(self) -> int:
        # The distance of the slot from 0 instead of the speed.
        return abs(self._tenths)

    def plainer(self) -> Iterator[CrossingInstruction]:
        # Rounder slots come first, then slots nearer to 0.
        slot = self._tenths
        tried: list[float] = [0]
        for unit in (SECOND, HALF):
            tried += [slot // unit * unit, -(-slot // unit) * unit]
        for step in (SECOND, HALF, 1):
            if step <= abs(slot):
                tried.append(slot - math.copysign(step, slot))
        for tenths in dict.fromkeys(tried):
            yield replace(self, slot=tenths / SLOT_STEPS_PER_SECOND)

    @classmethod
    def small(cls, found: Sequence[Any], speeds: Sequence[float]) -> Sequence[CrossingInstruction]:
        rounded = [
            (each.zone, round(each.speed / unit) * unit) for unit in (5.0, 1.0) for each in found
        ]
        places = [(zone, speed) for zone, speed in dict.fromkeys(rounded) if speed > 0]
        return [cls(zone, slot, speed) for slot in SMALL_SLOTS for zone, speed in places]

    def shown(self, requested: Any, apart: float, whence: str) -> Mapping[str, Any]:
        return {"zone": self.zone, "words": self.words_from(whence)}


def _checked_slot(value: object) -> float:
    slot = checked_number(value, "slot", "a finite number", error=ScenarioError)
    if abs(slot) > LARGEST_SLOT + 1e-9:
        expected = f"a time from -{LARGEST_SLOT:g} to {LARGEST_SLOT:g} s relative to the ego"
        raise ScenarioError(field="slot", expected=expected, received=repr(value))
    steps = round(slot * SLOT_STEPS_PER_SECOND)
    nearest = steps / SLOT_STEPS_PER_SECOND
    if abs(slot * SLOT_STEPS_PER_SECOND - steps) > 1e-6:
        fix = f"the nearest valid slot is {nearest:g} s"
        raise ScenarioError(
            field="slot",
            expected="a multiple of 0.1 s",
            received=repr(value),
            fix=fix,
        )
    return nearest + 0.0


# All kinds.
KINDS: tuple[type[Instruction], ...] = (PositionInstruction, LaneInstruction, CrossingInstruction)


def instruction_of(plain: Sequence[Any]) -> Instruction:
    """Return the instruction from the output of :meth:`Instruction.plain`."""
    if len(plain) == 4:
        return CrossingInstruction.read(plain)
    return (LaneInstruction if plain[0] in SHIFTS else PositionInstruction).read(plain)
