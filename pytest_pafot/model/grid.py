"""The nine-cell grid around the ego vehicle and the ring of its eight target cells.

Geometry is in road coordinates: *longitudinal* runs along the ego's lane (positive ahead), *columns* count
lanes (negative to the left). The ego occupies the middle cell, which is not a target.

Source: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 2.1 (Modelling Target Positions).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from enum import IntEnum
from functools import cache
from itertools import pairwise, repeat

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
