"""Scenarios, and the chains of instructions in them."""
# All genes of a chain are of one kind, and the NPCs of a scenario may have different kinds. Source: Crespo-Rodriguez,
# Neelofar, Aleti, "PAFOT", AST 2024, sections 2 and 3.2.

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import pairwise, zip_longest
from typing import TYPE_CHECKING, Any, cast

from pytest_pafot.model.instructions import (
    KINDS,
    Cell,
    CrossingInstruction,
    Instruction,
    PositionInstruction,
    ScenarioError,
    are_valid,
    encoded,
    instruction_of,
    is_adjacent,
    repair_chains,
    set_fields,
)
from pytest_pafot.model.vehicle_type import (
    CAR,
    PAPERS,
    STYLES,
    Style,
    VehicleName,
    VehicleType,
    without_last_cars,
)
from pytest_pafot.support.errors import POSITIVE, FieldError, checked_number, checked_whole
from pytest_pafot.support.text import Pasteable, listed

PAPER_SPEED_LIMIT = 26.8  # the speed limit on the paper's motorway, 60 mph [m/s]
# The defaults of a scenario.
EGO_LANE = 1  # the ego's initial lane, counted from 0 at the left
EGO_SPEED = 22.0  # the initial speed of all vehicles [m/s]
GENE_SECONDS = 10.0  # the duration of an instruction, as in the paper [s]

# The longest duration of a gene [s], a day. It is longer than any run, and its ticks still fit in a C integer.
LONGEST_GENE = 86400.0

MAX_SEED = 2**63 - 1

# The fix that messages suggest for chains with invalid cells.
REPAIR = "use Scenario.repaired(...) to make the chains valid"

if TYPE_CHECKING:
    from numpy.random import Generator


# The chain of one NPC: its instructions in the order in which it executes them.
Chromosome = tuple[Instruction, ...]
# The chains of all NPCs.
Chains = Sequence[Sequence[Instruction]]


class _Hashed(Pasteable):
    # A slot for the hash of a scenario, which is computed when it is first needed.

    __slots__ = ("_hash",)

    _hash: int


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Scenario(_Hashed):
    """The input of a simulated run: one chain of instructions per NPC, the start, and a seed.

    Attributes:
        npcs: one chain for each of one to eight NPCs. After its last gene, an NPC keeps its lane and speed (paper,
            section 2). The NPC with the longest chain continues its last gene instead.
        seed: seed of the package's random choices in the run, from 0 to 2**63 - 1.
        ego_lane: the ego's initial lane, from 0 at the left.
        ego_speed: initial speed [m/s] of the ego and of NPCs that do not cross. It is lower if a curve requires it.
        gene_seconds: duration [s] of a gene.
        traffic: driving style of the NPCs: ``paper``, ``hostile``, ``assertive`` or ``everyday``.
        vehicles: vehicles of the NPCs, in order, each a ``VehicleType`` or the name of a built-in one. The remaining
            NPCs are cars.

    Raises:
        ScenarioError: if a rule is broken.
    """

    npcs: tuple[Chromosome, ...]
    seed: int = 0
    ego_lane: int = EGO_LANE
    ego_speed: float = EGO_SPEED
    gene_seconds: float = GENE_SECONDS
    traffic: Style = PAPERS
    vehicles: tuple[VehicleType, ...] = ()

    if TYPE_CHECKING:  # the arguments have wider types than the fields

        def __init__(
            self, *, npcs: Chains, seed: int = 0, ego_lane: int = 1, ego_speed: float = 22.0,
            gene_seconds: float = 10.0, traffic: Style = PAPERS, vehicles: Sequence[VehicleType | VehicleName] = (),
        ) -> None: ...  # fmt: skip

    def __post_init__(self) -> None:
        npcs = _checked_chains(self.npcs)
        vehicles = self.vehicles
        if vehicles != ():
            vehicles = _checked_vehicles(vehicles, len(npcs))
        seed = _checked_whole("seed", self.seed, MAX_SEED)
        ego_lane = _checked_whole("ego_lane", self.ego_lane, 1000)
        ego_speed = checked_number(
            self.ego_speed,
            "ego_speed",
            "a speed of at least 0 m/s",
            least=0.0,
            error=ScenarioError,
        )
        gene_seconds = checked_number(
            self.gene_seconds,
            "gene_seconds",
            f"a duration of more than 0 s and at most {LONGEST_GENE:g} s",
            least=POSITIVE,
            most=LONGEST_GENE,
            error=ScenarioError,
        )
        if not isinstance(self.traffic, str) or self.traffic not in STYLES:
            expected = f"one of {', '.join(STYLES)}"
            raise ScenarioError(
                field="traffic",
                expected=expected,
                received=f"{self.traffic!r:.100}",
            )
        set_fields(
            self,
            npcs=npcs,
            seed=seed,
            ego_lane=ego_lane,
            # -0.0 becomes 0.0, so that equal scenarios have equal texts
            ego_speed=ego_speed + 0.0,
            gene_seconds=gene_seconds,
            traffic=str(self.traffic),
            vehicles=vehicles,
        )
        if not are_valid([[gene.cell for gene in chain] for chain in self.positions]):
            _check_adjacency(npcs)
            _check_distinct(npcs)

    @classmethod
    def repaired(
        cls,
        npcs: Chains,
        *,
        seed: int = 0,
        ego_lane: int = EGO_LANE,
        ego_speed: float = EGO_SPEED,
        gene_seconds: float = GENE_SECONDS,
        traffic: Style = PAPERS,
        vehicles: Sequence[VehicleType | VehicleName] = (),
    ) -> Scenario:
        """Make a scenario from chains, and repair invalid cells."""
        return cls(
            # A cell is invalid if the NPC cannot reach it from the previous cell in one step, or if two NPCs occupy it.
            npcs=repaired_chains(_checked_chains(npcs), _checked_whole("seed", seed, MAX_SEED)),
            seed=seed,
            ego_lane=ego_lane,
            ego_speed=ego_speed,
            gene_seconds=gene_seconds,
            traffic=traffic,
            vehicles=vehicles,
        )

    @classmethod
    def trusted(cls, **fields: Any) -> Scenario:
        # Without checks, for a search in which children consist of checked genes.
        scenario = object.__new__(cls)
        set_fields(scenario, **fields)
        return scenario

    def __hash__(self) -> int:
        # A search hashes a scenario a dozen times per run, and hashing all genes takes as long as breeding a child.
        try:
            return self._hash
        except AttributeError:
            speeds = [gene.speed for chain in self.npcs for gene in chain]
            set_fields(self, _hash=hash((self.seed, *speeds)))
            return self._hash

    @property
    def positions(self) -> tuple[tuple[PositionInstruction, ...], ...]:
        """The chains of ``PositionInstruction``."""
        return positions_of(self.npcs)

    @property
    def crossings(self) -> tuple[CrossingInstruction | None, ...]:
        """Each NPC's ``CrossingInstruction`` or None; empty if no NPC crosses."""
        first = [chain[0] for chain in self.npcs]
        found: list[Any] = [gene if gene.crosses else None for gene in first]
        if any(found):
            return tuple(found)
        return ()

    @property
    def genes(self) -> int:
        """The length of the longest chain."""
        return max(map(len, self.npcs))

    @property
    def seconds(self) -> float:
        """The duration [s] of the longest chain, or infinity if an NPC crosses."""
        if self.crossings:
            return math.inf
        return self.genes * self.gene_seconds

    @property
    def id(self) -> str:
        """An id of six hexadecimal digits, which equal scenarios share."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()[:6]

    def canonical(self) -> str:
        """Return a string that is the same for equal scenarios on any machine."""
        return _canonical(self)

    def plain(self) -> list[Any]:
        return [[[gene.plain() for gene in chain] for chain in self.npcs], *self._beside_chains]

    @property
    def _beside_chains(self) -> list[Any]:
        found: list[Any] = [self.seed, self.ego_lane, self.ego_speed, self.gene_seconds]
        if self.traffic != PAPERS:
            found.append(self.traffic)
        if self.vehicles:
            found.append([each.plain() for each in self.vehicles])  # the only list here
        return found

    @property
    def chains_text(self) -> str:
        chains = [",".join([gene.text for gene in chain]) for chain in self.npcs]
        return f"[[{'],['.join(chains)}]]"

    @classmethod
    def from_canonical(cls, fields: Any) -> Scenario:
        # The inverse of `plain`. Any other value raises a ScenarioError, TypeError or ValueError.
        npcs, seed, ego_lane, ego_speed, gene_seconds, *others = fields
        vehicles: Sequence[Any] = ()
        if others and isinstance(others[-1], list):
            vehicles = others.pop()
        return cls(
            npcs=tuple(tuple(map(instruction_of, chain)) for chain in npcs),
            seed=seed,
            ego_lane=ego_lane,
            ego_speed=ego_speed,
            gene_seconds=gene_seconds,
            traffic=others[0] if others else PAPERS,
            vehicles=vehicles,
        )

    def rechained(
        self,
        npcs: Chains,
        gene_seconds: float | None = None,
    ) -> Scenario:
        chains = repaired_chains(_checked_chains(npcs), self.seed)
        if gene_seconds is not None:
            return replace(self, npcs=chains, gene_seconds=gene_seconds)
        same = {each.name: getattr(self, each.name) for each in fields(self)}
        return Scenario.trusted(**same | {"npcs": chains})

    def vehicle_of(self, npc: int) -> VehicleType:
        if npc < len(self.vehicles):
            return self.vehicles[npc]
        return CAR

    @property
    def all_vehicles(self) -> tuple[VehicleType, ...]:
        return tuple(map(self.vehicle_of, range(len(self.npcs))))

    def of_npcs(self, npcs: Iterable[int], **changes: Any) -> Scenario:
        kept = tuple(npcs)
        vehicles = tuple(map(self.vehicle_of, kept))
        chains = tuple(self.npcs[npc] for npc in kept)
        return replace(self, npcs=chains, vehicles=vehicles, **changes)

    def with_vehicle(self, npc: int, vehicle: VehicleType) -> Scenario:
        vehicles = list(self.all_vehicles)
        vehicles[npc] = vehicle
        return replace(self, vehicles=tuple(vehicles))

    def truncated(self, genes: int) -> Scenario:
        return replace(self, npcs=tuple(chain[:genes] for chain in self.npcs))

    def __str__(self) -> str:
        texts = []
        for vehicle, chain in zip(self.all_vehicles, self.npcs, strict=True):
            genes = [gene.short for gene in chain]
            if vehicle != CAR:
                genes.insert(0, vehicle.name)
            texts.append(" ".join(genes))
        return f"<Scenario {self.id}: {'; '.join(texts)}>"


def rng_of(seed: int | Sequence[int], *part: int) -> Generator:
    """Return a random generator that depends only on a seed and a part number."""
    # Built without `default_rng`, which a test may have replaced.
    from numpy.random import PCG64, Generator, SeedSequence  # noqa: PLC0415  (slow to import)

    return Generator(PCG64(SeedSequence(seed, spawn_key=part)))


@lru_cache(maxsize=64)
def _canonical(scenario: Scenario) -> str:
    # A search needs this string four times per run, for the crash record, the id and the row.
    return f"[{scenario.chains_text},{encoded(scenario._beside_chains)[1:]}"


def _checked_whole(name: str, value: object, top: int) -> int:
    return checked_whole(
        value,
        name,
        f"a whole number from 0 to {top}",
        least=0,
        most=top,
        error=ScenarioError,
    )


def _checked_chains(npcs: object) -> tuple[Chromosome, ...]:
    try:
        chains = tuple(tuple(chain) for chain in npcs)  # type: ignore[attr-defined]
    except TypeError:
        expected = "a list with one chain of instructions per NPC"
        fix = "write npcs=[[PositionInstruction(cell, speed), ...], ...]"
        raise ScenarioError(field="npcs", expected=expected, received=repr(npcs), fix=fix) from None
    if not 1 <= len(chains) <= 8:
        raise ScenarioError(
            field="npcs",
            expected="1 to 8 NPCs, at most one per cell",
            received=str(len(chains)),
        )
    for npc, chain in enumerate(chains):
        is_one_kind = len(set(map(type, chain))) == 1 and isinstance(chain[0], Instruction)
        if is_one_kind and (len(chain) == 1 or not chain[0].crosses):
            continue  # skips the slower checks for the usual chains
        if not chain:
            expected = "at least one instruction"
            raise ScenarioError(field=f"npcs[{npc}]", expected=expected, received="an empty chain")
        for gene, each in enumerate(chain):
            kind = type(chain[0])
            if not isinstance(each, Instruction):
                expected = listed([f"a {kind.__name__}" for kind in KINDS], "or")
                fix = "write, for example, PositionInstruction(cell, speed)"
            elif type(each) is not kind:
                expected = f"a {kind.__name__}, as in npcs[{npc}][0]"
                fix = "give each NPC only one kind of instruction"
            elif gene and each.crosses:
                expected = f"no second {kind.__name__} for the same NPC"
                fix = "give it to another NPC"
            else:
                continue
            raise ScenarioError(
                field=f"npcs[{npc}][{gene}]",
                expected=expected,
                received=repr(each),
                fix=fix,
            )
    return chains


def _checked_vehicles(vehicles: object, npcs: int) -> tuple[VehicleType, ...]:
    if isinstance(vehicles, (str, Mapping)) or not isinstance(vehicles, Iterable):
        fix = 'write, for example, vehicles=("truck",)'
        raise ScenarioError(
            field="vehicles",
            expected="a list of vehicles",
            received=f"{vehicles!r:.100}",
            fix=fix,
        )
    found = []
    for npc, each in enumerate(vehicles):
        try:
            found.append(VehicleType.parse(each))
        except FieldError as error:
            place = f"vehicles[{npc}]"
            if error.field != "vehicle":
                place = f"{place}.{error.field}"
            raise ScenarioError(
                field=place,
                expected=error.expected,
                received=error.received,
                fix=error.fix,
            ) from None
    if len(found) > npcs:
        expected = f"no more vehicles than NPCs ({npcs})"
        raise ScenarioError(field="vehicles", expected=expected, received=str(len(found)))
    return without_last_cars(found)


def repaired_chains(npcs: Chains, seed: int) -> tuple[Chromosome, ...]:
    """Return chains with valid cells. Valid chains are unchanged."""
    # Random choices of the repair depend only on the seed, the NPC and the gene.
    chains = tuple(map(tuple, npcs))
    wanted = [[gene.cell for gene in chain] for chain in positions_of(chains)]
    if are_valid(wanted):
        return chains
    return with_targets(chains, on_grid(chains, repair_chains(wanted, seed)))


def positions_of(
    npcs: Chains,
) -> tuple[tuple[PositionInstruction, ...], ...]:
    """Return the chains of ``PositionInstruction``."""
    return cast(
        "tuple[tuple[PositionInstruction, ...], ...]",
        tuple(tuple(each) for each in npcs if each[0].on_grid),
    )


def on_grid(npcs: Chains, rows: Sequence[Sequence[Cell]]) -> list[Sequence[Cell]]:
    """Return a row of cells for each NPC, empty for NPCs that are not on the grid."""
    each = iter(rows)
    return [next(each) if chain[0].on_grid else () for chain in npcs]


def with_targets(
    npcs: Sequence[Chromosome], targets: Sequence[Sequence[Any]]
) -> tuple[Chromosome, ...]:
    """Return the chains with their first genes aimed at new targets."""
    found = []
    for chain, row in zip_longest(npcs, targets, fillvalue=()):
        # Most targets are unchanged. Checking a new gene for each of them would take a tenth of a short run.
        first = [
            gene if gene.target == target else gene.aimed(target)
            for target, gene in zip(row, chain, strict=False)
        ]
        found.append((*first, *chain[len(row) :]))
    return tuple(found)


def continues(before: Instruction, gene: Instruction) -> bool:
    """Return whether an instruction only continues the previous one."""
    # An NPC that keeps its lane at the same speed after a lane change continues the change.
    return gene == before.afterwards


def retimed(chain: Chromosome, seconds: float, wanted: float) -> Chromosome:
    """Return a chain whose genes have the duration ``wanted`` [s]."""
    # Each new gene is the old gene that was active at its middle. Longer genes may skip a cell, and the chain then
    # needs repair. If a Lane-Instruction becomes several genes, only the first one changes lanes.
    if chain[0].crosses:
        return chain
    count = max(1, math.ceil(len(chain) * seconds / wanted - 1e-9))
    genes: list[Instruction] = []
    before = -1
    for number in range(count):
        old = min(int((number + 0.5) * wanted / seconds), len(chain) - 1)
        gene = chain[old]
        genes.append(gene.afterwards if old == before else gene)
        before = old
    return tuple(genes)


def _check_adjacency(npcs: Sequence[Chromosome]) -> None:
    for npc, chain in enumerate(npcs):
        cells = [each.cell for each in chain if each.on_grid]
        for gene, (before, cell) in enumerate(pairwise(cells), 1):
            if not is_adjacent(before, cell):
                low, high = sorted(before.neighbours)
                raise ScenarioError(
                    field=f"npcs[{npc}][{gene}]",
                    expected=f"cell {int(before)} again, or one of the adjacent cells {int(low)} and {int(high)}",
                    received=f"cell {int(cell)}",
                    fix=REPAIR,
                )


def _check_distinct(npcs: Sequence[Chromosome]) -> None:
    for gene, row in enumerate(zip_longest(*npcs)):
        holders: dict[Cell, int] = {}
        for npc, held in enumerate(row):
            if held is None or not held.on_grid:
                continue
            other = holders.setdefault(held.cell, npc)
            if other != npc:
                raise ScenarioError(
                    field=f"npcs[{npc}][{gene}]",
                    expected=f"a cell that no other NPC occupies in gene {gene}",
                    received=f"cell {int(held.cell)}, which npcs[{other}] occupies",
                    fix=REPAIR,
                )
