"""Instructions, chromosomes and scenarios, which a search evolves and a corpus file stores.

Position-Instructions place an NPC around the ego, Lane-Instructions make it change lanes wherever the ego is, a
Crossing-Instruction sends it across or into the ego's way, and a Manoeuvre does what is asked for at a distance from
the ego. All genes of a chain are of one kind, and the NPCs of a scenario may have different kinds.

Source: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, sections 2 and 3.2.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import pairwise, zip_longest
from typing import Any, Literal, cast, get_args

from pytest_pafot.model.driving_style import PAPERS, Traffic
from pytest_pafot.model.grid import Cell, are_valid, is_adjacent, repair_chains
from pytest_pafot.model.vehicle_type import CAR, VehicleType, without_last_cars
from pytest_pafot.support.errors import FieldError, checked_whole, plain_whole
from pytest_pafot.support.shown import Pasteable

SLOTS = {"well before": -1.0, "just before": 0.0, "together": 0.0, "just after": 1.0, "well after": math.inf}
"""The five named intervals of slots, each with its end [s]. They divide the time at a zone as the nine cells divide the
grid."""
SPEED_STEPS_PER_MPS = 10
"""Target speeds are multiples of 0.1 m/s, so that a scenario reads the same in a file and in memory."""

SLOT_STEPS_PER_SECOND = 10
"""Slots are multiples of 0.1 s."""

PAPER_SPEED_LIMIT = 26.8
"""The speed limit on the paper's motorway, 60 mph [m/s]."""
EGO_LANE, EGO_SPEED, GENE_SECONDS = 1, 22.0, 10.0
"""The defaults of a scenario: the ego's first lane, counted from 0 at the left; the first speed of all vehicles [m/s];
the duration of an instruction, as in the paper [s]."""

LONGEST_GENE = 86400.0
"""The longest duration of a gene [s], a day. It is longer than any run, and its ticks still fit a C integer."""

MAX_SPEED = 1000.0
"""The largest speed that a scenario can give to a vehicle [m/s]; each world has a much lower limit."""

CODES_PER_TARGET = 10_000
"""The distance between the codes of two targets, which is more than any speed."""

MAX_SEED = 2**63 - 1

REPAIR = "Scenario.repaired(...) makes such chains valid"
"""The way out that messages give for a chain with a cell that is no ring neighbour of the previous cell."""


class ScenarioError(FieldError):
    """Error for a scenario that breaks a rule; the message says where, what was expected and what to do."""


class _PreparedGene(Pasteable):
    """A gene with values that a search needs of dozens of genes in each run, computed once for each gene."""

    __slots__ = ("code", "target", "text")

    speed: float
    target: int | Shift
    """The cell's number or the target lane, as files and canonical texts contain it."""
    code: float
    """A number that only equal genes have; it is much faster to hash and to compare than a gene."""
    text: str
    """The gene in canonical texts."""

    def _prepare(self, target: int | Shift, number: int) -> None:
        object.__setattr__(self, "target", target)
        object.__setattr__(self, "code", CODES_PER_TARGET * number + self.speed)
        object.__setattr__(self, "text", _encoded([self.target, self.speed]))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as a cached constructor call, because runs travel between processes with dozens of equal genes."""
        return known_gene, (self.target, self.speed)


@dataclass(frozen=True, slots=True, repr=False)
class PositionInstruction(_PreparedGene):
    """A gene that makes an NPC drive into a cell of the grid and then keep a speed.

    Attributes:
        cell: target cell, 1 to 8.
        speed: target speed [m/s], >= 0, in steps of 0.1.
    """

    cell: Cell
    speed: float

    def __post_init__(self) -> None:
        if type(self.cell) is not Cell:
            number = plain_whole(self.cell)
            if number is None or not 1 <= number <= 8:
                expected = "a whole number from 1 (front-left) clockwise to 8 (left)"
                raise ScenarioError(field="cell", expected=expected, received=repr(self.cell))
            object.__setattr__(self, "cell", Cell(number))
        object.__setattr__(self, "speed", _checked_speed(self.speed))
        self._prepare(int(self.cell), int(self.cell))

    @property
    def goal(self) -> str:
        """The target in words: ``2 front``."""
        return f"{int(self.cell)} {self.cell.label}"


Shift = Literal["keep", "left", "right"]
"""The lane to drive in: the NPC's lane at the gene's beginning, or the lane to the left or right of it."""

SHIFTS: tuple[Shift, ...] = get_args(Shift)

LANE_STARTS = tuple(map(Cell, (1, 2, 3, 8, 4, 6, 7, 5)))
"""The cells in which NPCs with Lane-Instructions start: each NPC in the first cell that exists and is free. The first
two are the starts of the NPCs in the released AV-Fuzzer: ahead to the left of the ego, and ahead in the ego's lane."""


@dataclass(frozen=True, slots=True, repr=False)
class LaneInstruction(_PreparedGene):
    """A gene that makes an NPC keep its lane or change it by one, at a speed, wherever the ego is.

    It is the manoeuvre of AV-Fuzzer (Li et al., ISSRE 2020). If the target lane does not exist, the NPC keeps its lane.

    Attributes:
        lane: ``"keep"``, ``"left"`` or ``"right"``, as seen from the NPC's lane at the gene's beginning.
        speed: target speed from the gene's first tick on [m/s], >= 0, in steps of 0.1.
    """

    lane: Shift
    speed: float

    def __post_init__(self) -> None:
        if self.lane not in SHIFTS:
            raise ScenarioError(field="lane", expected=f"one of {', '.join(SHIFTS)}", received=repr(self.lane))
        object.__setattr__(self, "lane", str(self.lane))
        object.__setattr__(self, "speed", _checked_speed(self.speed))
        self._prepare(self.lane, 9 + SHIFTS.index(self.lane))

    @property
    def column(self) -> int:
        """The target lane as a number of lanes to the right of the NPC's own lane: -1, 0 or +1."""
        return (0, -1, 1)[SHIFTS.index(self.lane)]

    @property
    def goal(self) -> str:
        """The target in words: ``one lane left``."""
        return "keep lane" if self.lane == "keep" else f"one lane {self.lane}"


Act = Literal["pass", "hold", "stop", "late"]
"""What an NPC does at its zone; see :class:`CrossingInstruction`."""

ACTS: tuple[Act, ...] = get_args(Act)

LARGEST_SLOT = 5.0
"""The largest slot [s]: an NPC that enters the zone this long after the ego, or leaves it this long before the ego, no
longer affects the ego."""

ZONE_NAME = re.compile(r"[A-Za-z0-9_.-]{1,30}>[A-Za-z0-9_.-]{1,30}")
"""The pattern of a zone's name: the names of an entry node and an exit node of the road network."""


@dataclass(frozen=True, slots=True, repr=False)
class CrossingInstruction(Pasteable):
    """The only gene of an NPC whose way meets the ego's way: the zone, the time relative to the ego, and the act there.

    It transfers the grid to a zone, where the time matters as well as the place. The NPC starts so that it meets an ego
    with constant speed as the slot says. As long as there is time, the NPC adapts to the ego's arrival.

    Attributes:
        zone: entry and exit of the NPC's way, such as ``"o1>o3"``; the zone is where that way first meets the ego's.
        slot: time between the two vehicles at the zone [s], from -5 to 5 in steps of 0.1. Positive: from the ego's exit
            until the NPC's entry. Negative: from the NPC's exit until the ego's entry. 0: both are there together.
        speed: speed of the NPC up to the zone and in it, lower if a bend requires it [m/s], more than 0, in steps of
            0.1.
        act: what the NPC does at the zone. ``"pass"``: drive through it. ``"hold"``: wait at the line before it until
            the ego has passed. ``"stop"``: stop in it. ``"late"``: wait at the line, and drive in at the time that the
            slot says.
    """

    zone: str
    slot: float
    speed: float
    act: Act = "pass"

    def __post_init__(self) -> None:
        if not isinstance(self.zone, str) or not ZONE_NAME.fullmatch(self.zone):
            expected = 'the entry and the exit of a way, such as "o1>o3"'
            raise ScenarioError(field="zone", expected=expected, received=f"{self.zone!r:.100}")
        if self.act not in ACTS:
            raise ScenarioError(field="act", expected=f"one of {', '.join(ACTS)}", received=f"{self.act!r:.100}")
        object.__setattr__(self, "zone", str(self.zone))
        object.__setattr__(self, "act", str(self.act))
        object.__setattr__(self, "slot", _checked_slot(self.slot))
        object.__setattr__(self, "speed", _checked_speed(self.speed, least_steps=1))
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
    def code(self) -> CrossingInstruction:
        """The gene itself, in the place of the number of other genes."""
        return self

    @property
    def text(self) -> str:
        """The gene in canonical texts."""
        return _encoded(_plain(self))

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


FARTHEST = 500.0
"""The largest distance of a manoeuvre's start, and of its triggers [m]."""

MOST_BESIDE = 8
"""The largest number of lanes between the ego and the start of a manoeuvre."""

LONGEST_HEADWAY = 20.0
"""The largest headway that begins a step [s]."""

LATEST = 600.0
"""The longest time between two steps [s]."""

FASTEST_ASIDE = 5.0
"""The largest lateral speed that a step can ask for [m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Step(Pasteable):
    """A step of a :class:`Manoeuvre`: when it begins, and what the NPC does then.

    It begins when ``gap`` or ``headway`` is reached, from either side, or else ``after`` the end of the step before. A
    step ends when the NPC is in its lane, at its offset and at its speed. A step whose distance comes earlier begins
    while the one before it still goes on: the NPC then has the lane of the first and the speed of the second.

    Attributes:
        gap: distance between the ego and the NPC, from bumper to bumper [m]; negative if the NPC is behind the ego.
        headway: the same distance in the time that the rear vehicle takes for it [s]; negative if the NPC is behind.
        after: time since the end of the step before, or since the beginning of the run [s].
        lane: ``"keep"``, ``"left"`` or ``"right"`` of the lane of the step before. If there is no such lane, the NPC
            keeps its own, and the step is not as asked.
        lateral_speed: highest speed across the road [m/s]. A change to a lane of 4 m at 1.5 m/s takes about 4 s.
        offset: offset from the centre of that lane, positive to the right [m].
        speed: target speed [m/s]; None keeps the speed of the step before.
        acceleration: acceleration or deceleration towards that speed, as a positive number [m/s^2].
    """

    gap: float | None = None
    headway: float | None = None
    after: float = 0.0
    lane: Shift = "keep"
    lateral_speed: float = 1.5
    offset: float = 0.0
    speed: float | None = None
    acceleration: float = 3.0

    def __post_init__(self) -> None:
        given = [name for name in ("gap", "headway") if getattr(self, name) is not None]
        given += ["after"] if self.after else []
        if len(given) > 1:
            expected, received = "one of gap, headway and after", " and ".join(given)
            raise ScenarioError(field="step", expected=expected, received=received, fix="the others begin steps, too")
        for name, least, most in STEP_BOUNDS:
            if getattr(self, name) is not None or name not in ("gap", "headway", "speed"):
                object.__setattr__(self, name, _tenths_within(name, getattr(self, name), least, most))
        if self.lane not in SHIFTS:
            raise ScenarioError(field="lane", expected=f"one of {', '.join(SHIFTS)}", received=repr(self.lane))

    @property
    def column(self) -> int:
        """The target lane as a number of lanes to the right of that of the step before: -1, 0 or +1."""
        return (0, -1, 1)[SHIFTS.index(self.lane)]

    @property
    def is_by_distance(self) -> bool:
        """True if a distance to the ego begins the step."""
        return self.gap is not None or self.headway is not None

    @property
    def trigger(self) -> str:
        """The trigger in words: ``at a gap of 20 m``; empty if it begins as the step before ends."""
        for value, what, unit in ((self.gap, "gap", "m"), (self.headway, "headway", "s")):
            if value is not None:
                return f"at a {what} of {abs(value):g} {unit}{' behind' if value < 0 else ''}"
        return f"{self.after:g} s later" if self.after else ""

    @property
    def act(self) -> str:
        """The act in words: ``left at 1.5 m/s, to 5 m/s at 3 m/s^2``."""
        aside = "" if self.lane == "keep" else f"{self.lane} at {self.lateral_speed:g} m/s"
        offset = f"{abs(self.offset):g} m {'left' if self.offset < 0 else 'right'} of the centre" if self.offset else ""
        speed = "" if self.speed is None else f"to {self.speed:g} m/s at {self.acceleration:g} m/s^2"
        return ", ".join(filter(None, (aside, offset, speed))) or "hold"

    @property
    def words(self) -> str:
        """The trigger and the act in words."""
        return f"{self.trigger} {self.act}".lstrip()


STEP_BOUNDS = (
    ("gap", -FARTHEST, FARTHEST),
    ("headway", -LONGEST_HEADWAY, LONGEST_HEADWAY),
    ("after", 0.0, LATEST),
    ("lateral_speed", 0.1, FASTEST_ASIDE),
    ("offset", -1.9, 1.9),
    ("speed", 0.0, MAX_SPEED),
    ("acceleration", 0.1, 20.0),
)
"""The smallest and largest number that each field of a step may have."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Manoeuvre(Pasteable):
    """The only gene of an NPC that does what is asked for: a start relative to the ego, and steps.

    In the traffic of the paper's style, the NPC does it whatever is in its way, except vehicles that cross its way; in
    hostile or everyday traffic it gives way as the others there. Physical limits hold in both. ``run.asked`` tells what
    became of it.

    Attributes:
        beside: lane at the start: the number of lanes to the right of the ego's, 0 for the ego's lane.
        ahead: distance at the start from the ego's front to the NPC's rear [m]. Negative: from the ego's rear to the
            NPC's front. 0: level with the ego, in another lane.
        speed: speed at the start [m/s].
        steps: what it does then; without a step, and after the last one, it keeps lane and speed.
    """

    beside: int
    ahead: float
    speed: float
    steps: tuple[Step, ...] = ()

    def __post_init__(self) -> None:
        beside = plain_whole(self.beside)
        if beside is None or abs(beside) > MOST_BESIDE:
            expected = f"a whole number of lanes from {-MOST_BESIDE} to {MOST_BESIDE}, positive to the right"
            raise ScenarioError(field="beside", expected=expected, received=repr(self.beside))
        object.__setattr__(self, "beside", beside)
        object.__setattr__(self, "ahead", _tenths_within("ahead", self.ahead, -FARTHEST, FARTHEST))
        object.__setattr__(self, "speed", _checked_speed(self.speed))
        if self.ahead == 0 and self.beside == 0:
            expected, fix = "a distance other than 0 in the ego's lane", "0 is level with the ego"
            raise ScenarioError(field="ahead", expected=expected, received="0", fix=fix)
        steps = tuple(self.steps) if isinstance(self.steps, (list, tuple)) else (self.steps,)
        if not all(isinstance(step, Step) for step in steps) or len(steps) > MOST_STEPS:
            expected = f"at most {MOST_STEPS} of pafot.Step(...)"
            raise ScenarioError(field="steps", expected=expected, received=repr(self.steps))
        object.__setattr__(self, "steps", steps)

    @property
    def target(self) -> str:
        """The gene's name in canonical texts and tables."""
        return "manoeuvre"

    @property
    def code(self) -> Manoeuvre:
        """The gene itself, in the place of the number of other genes."""
        return self

    @property
    def text(self) -> str:
        """The gene in canonical texts."""
        return _encoded(_plain(self))

    @property
    def place(self) -> str:
        """The start in words: ``30 m ahead, 1 lane right``."""
        along = f"{abs(self.ahead):g} m {'ahead' if self.ahead > 0 else 'behind'}" if self.ahead else "level"
        lanes = f"{abs(self.beside)} lane{'s' * (abs(self.beside) > 1)} {'left' if self.beside < 0 else 'right'}"
        return f"{along}, {lanes if self.beside else 'in lane'}"

    @property
    def goal(self) -> str:
        """The start and the steps in words."""
        told = (step.words for step in self.steps)
        return "; ".join([self.place, *told])


MOST_STEPS = 16
"""The largest number of steps of a manoeuvre."""

Gene = PositionInstruction | LaneInstruction | CrossingInstruction | Manoeuvre

ALONE = (CrossingInstruction, Manoeuvre)
"""The kinds of genes that are the only one of their NPC, and have no duration."""


def gene_of(target: Any, speed: Any, *crossing: Any) -> Gene:
    """Return the gene with a target, a speed and, for a crossing NPC, a slot and an act.

    With a slot and an act the target is a zone. Without them a word is a lane, and anything else is a cell.

    Raises:
        ScenarioError: if there is no such gene.
    """
    if crossing:
        slot, act = crossing
        return CrossingInstruction(target, slot, speed, act)
    kind = LaneInstruction if isinstance(target, str) else PositionInstruction
    return kind(target, speed)


@lru_cache(maxsize=1 << 14, typed=True)
def known_gene(target: Any, speed: Any, *crossing: Any) -> Any:
    """Return the gene that :func:`gene_of` returns, from a cache, because a search needs few genes many times."""
    return gene_of(target, speed, *crossing)


Chromosome = tuple[Gene, ...]
"""The chain of one NPC: its instructions in the order in which it executes them."""


class _Hashed(Pasteable):
    """The place for the hash of a scenario, which is computed when it is first needed."""

    __slots__ = ("_hash",)

    _hash: int


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Scenario(_Hashed):
    """The input of a simulated run: one chain of instructions per NPC, the start, and the seed of the repair.

    Attributes:
        npcs: chains of one to eight NPCs, one non-empty chain per NPC; lengths may differ. An NPC with a shorter
            chain than the longest keeps its lane and speed after its last gene (paper, section 2). In a run that goes
            on after the longest chain, an NPC with that chain goes on with its last gene. Each NPC has
            Position-Instructions, Lane-Instructions, one Crossing-Instruction or one Manoeuvre.
        seed: seed of all random choices in the run, 0 to 2**63 - 1.
        ego_lane: the ego's first lane, counted from 0 at the left.
        ego_speed: first speed of the ego, and of all NPCs that neither cross nor have a Manoeuvre, unless a bend makes
            them slower [m/s].
        gene_seconds: duration of one gene [s].
        traffic: driving style of the NPCs; the paper's by default.
        vehicles: what vehicle each NPC is, in the order of the NPCs: a ``VehicleType``, or the name of a ready one. All
            NPCs after the last one are cars.

    Raises:
        ScenarioError: if a rule is broken. For example, a cell is no ring neighbour of the previous cell, or two NPCs
            occupy the same cell in the same gene. :meth:`repaired` makes such chains valid.
    """

    npcs: tuple[Chromosome, ...]
    seed: int = 0
    ego_lane: int = EGO_LANE
    ego_speed: float = EGO_SPEED
    gene_seconds: float = GENE_SECONDS
    traffic: Traffic = PAPERS
    vehicles: tuple[VehicleType, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "npcs", _checked_chains(self.npcs))
        if self.vehicles != ():
            object.__setattr__(self, "vehicles", _checked_vehicles(self.vehicles, len(self.npcs)))
        object.__setattr__(self, "seed", _checked_whole("seed", self.seed, MAX_SEED))
        object.__setattr__(self, "ego_lane", _checked_whole("ego_lane", self.ego_lane, 1000))
        object.__setattr__(self, "ego_speed", _number("ego_speed", self.ego_speed))
        object.__setattr__(self, "gene_seconds", _number("gene_seconds", self.gene_seconds))
        if self.ego_speed < 0:
            raise ScenarioError(field="ego_speed", expected="m/s, at least 0", received=repr(self.ego_speed))
        if not 0 < self.gene_seconds <= LONGEST_GENE:
            expected = f"seconds, more than 0 and at most {LONGEST_GENE:g}"
            raise ScenarioError(field="gene_seconds", expected=expected, received=repr(self.gene_seconds))
        if not isinstance(self.traffic, Traffic):
            fix = 'write pafot.Traffic(style="everyday")'
            raise ScenarioError(field="traffic", expected="a Traffic", received=repr(self.traffic), fix=fix)
        if not are_valid([[gene.cell for gene in chain] for chain in self.positions]):
            _check_adjacency(self.npcs)
            _check_distinct(self.npcs)

    @classmethod
    def repaired(
        cls,
        npcs: Sequence[Sequence[Gene]],
        *,
        seed: int = 0,
        ego_lane: int = EGO_LANE,
        ego_speed: float = EGO_SPEED,
        gene_seconds: float = GENE_SECONDS,
        traffic: Traffic = PAPERS,
        vehicles: Sequence[VehicleType | str] = (),
    ) -> Scenario:
        """Make a scenario from chains whose cells may be invalid; cells are repaired, speeds stay.

        A cell is invalid if it is no ring neighbour of the previous cell, or if two NPCs occupy it in the same gene.
        Lane-Instructions need no repair.
        """
        return cls(
            npcs=_repaired(npcs, seed),
            seed=seed,
            ego_lane=ego_lane,
            ego_speed=ego_speed,
            gene_seconds=gene_seconds,
            traffic=traffic,
            vehicles=_checked_vehicles(vehicles, len(npcs)),
        )

    @classmethod
    def trusted(cls, **fields: Any) -> Scenario:
        """Make a scenario without the constructor's checks, for a search whose children consist of checked genes."""
        scenario = object.__new__(cls)
        for name, value in fields.items():
            object.__setattr__(scenario, name, value)
        return scenario

    def __hash__(self) -> int:
        # A search hashes a scenario a dozen times a run, and hashing all genes takes as long as breeding a child.
        try:
            return self._hash
        except AttributeError:
            object.__setattr__(self, "_hash", hash((self.seed, *[gene.speed for chain in self.npcs for gene in chain])))
            return self._hash

    @property
    def positions(self) -> tuple[tuple[PositionInstruction, ...], ...]:
        """The chains of Position-Instructions, in the order of their NPCs; empty if no NPC drives on the grid."""
        return positions_of(self.npcs)

    @property
    def crossings(self) -> tuple[CrossingInstruction | None, ...]:
        """The Crossing-Instruction of each NPC, or None; empty if no NPC has one."""
        found = [chain[0] if type(chain[0]) is CrossingInstruction else None for chain in self.npcs]
        return tuple(found) if any(found) else ()

    @property
    def genes(self) -> int:
        """The number of genes of the longest chain."""
        return max(map(len, self.npcs))

    @property
    def seconds(self) -> float:
        """The duration of the longest chain [s]; infinite if an NPC has a gene without a duration."""
        has_duration = not any(isinstance(chain[0], ALONE) for chain in self.npcs)
        return self.genes * self.gene_seconds if has_duration else math.inf

    @property
    def id(self) -> str:
        """Six hexadecimal digits of a digest of all fields; equal scenarios have equal ids."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()[:6]

    def canonical(self) -> str:
        """Return a text that is the same for equal scenarios on any machine."""
        return _canonical(self)

    def plain(self) -> list[Any]:
        """Return all fields as lists and numbers; :meth:`canonical` is their text."""
        return [[[_plain(gene) for gene in chain] for chain in self.npcs], *self._beside_chains]

    @property
    def _beside_chains(self) -> list[Any]:
        traffic: list[Any] = [] if self.traffic == PAPERS else [self.traffic.plain()]
        vehicles = [[each.plain() for each in self.vehicles]] if self.vehicles else []  # a list, as no traffic is
        return [self.seed, self.ego_lane, self.ego_speed, self.gene_seconds, *traffic, *vehicles]

    @property
    def chains_text(self) -> str:
        """The part of the canonical text that contains the chains."""
        chains = [",".join([gene.text for gene in chain]) for chain in self.npcs]
        return f"[[{'],['.join(chains)}]]"

    @classmethod
    def from_canonical(cls, fields: Any) -> Scenario:
        """Make a scenario from the result of :meth:`plain`, or of ``json.loads`` on the text of :meth:`canonical`.

        Raises:
            ScenarioError, TypeError, ValueError: if ``fields`` is anything else.
        """
        npcs, seed, ego_lane, ego_speed, gene_seconds, *others = fields
        vehicles = others.pop() if others and isinstance(others[-1], list) else ()
        (traffic,) = others or [PAPERS]
        chains = tuple(tuple(map(_gene_from, chain)) for chain in npcs)
        return cls(
            npcs=chains,
            seed=seed,
            ego_lane=ego_lane,
            ego_speed=ego_speed,
            gene_seconds=gene_seconds,
            traffic=Traffic.of(traffic),
            vehicles=tuple(vehicles),
        )

    def rechained(self, npcs: Sequence[Sequence[Gene]], gene_seconds: float | None = None) -> Scenario:
        """Return this scenario with other chains, which are repaired, and if given a new duration of a gene [s]."""
        chains = _repaired(npcs, self.seed)
        if gene_seconds is not None:
            return replace(self, npcs=chains, gene_seconds=gene_seconds)
        return Scenario.trusted(
            npcs=chains,
            seed=self.seed,
            ego_lane=self.ego_lane,
            ego_speed=self.ego_speed,
            gene_seconds=self.gene_seconds,
            traffic=self.traffic,
            vehicles=self.vehicles,
        )

    def vehicle_of(self, npc: int) -> VehicleType:
        """Return what vehicle an NPC is."""
        return self.vehicles[npc] if npc < len(self.vehicles) else CAR

    @property
    def all_vehicles(self) -> tuple[VehicleType, ...]:
        """What vehicle each NPC is, also those after the last one that is no car."""
        return self.vehicles + (CAR,) * (len(self.npcs) - len(self.vehicles))

    def of_npcs(self, npcs: Iterable[int], **changes: Any) -> Scenario:
        """Return this scenario with only the NPCs of these indices, in their order, and with other fields changed."""
        kept = tuple(npcs)
        vehicles = tuple(map(self.vehicle_of, kept)) if self.vehicles else ()
        return replace(self, npcs=tuple(self.npcs[npc] for npc in kept), vehicles=vehicles, **changes)

    def with_vehicle(self, npc: int, vehicle: VehicleType) -> Scenario:
        """Return this scenario with another vehicle for one NPC."""
        others = self.all_vehicles
        return replace(self, vehicles=(*others[:npc], vehicle, *others[npc + 1 :]))

    def truncated(self, genes: int) -> Scenario:
        """Return this scenario with only the first ``genes`` genes of each NPC."""
        return replace(self, npcs=tuple(chain[:genes] for chain in self.npcs))

    def __str__(self) -> str:
        kinds = ["" if kind == CAR else f"{kind.name} " for kind in self.all_vehicles]
        chains = "; ".join(kind + " ".join(map(_short, chain)) for kind, chain in zip(kinds, self.npcs, strict=True))
        return f"<Scenario {self.id}: {chains}>"


@lru_cache(maxsize=64)
def _canonical(scenario: Scenario) -> str:
    # A search asks for the text of the scenario that runs four times: for its crash record, its id and its row.
    return f"[{scenario.chains_text},{_encoded(scenario._beside_chains)[1:]}"


_encoded = json.JSONEncoder(separators=(",", ":")).encode


def _short(gene: Gene) -> str:
    if isinstance(gene, Manoeuvre):
        return f"{gene.speed:g} m/s {gene.goal}"
    if not isinstance(gene, CrossingInstruction):
        return f"{gene.target}@{gene.speed:g}"
    return f"{gene.zone}@{gene.speed:g} {gene.slot:+g} s{'' if gene.act == 'pass' else f' {gene.act}'}"


def _gene_from(fields: Any) -> Gene:
    """Return the gene whose :func:`_plain` form is ``fields``."""
    if fields and fields[0] == "manoeuvre":
        _, speed, beside, ahead, steps = fields
        return Manoeuvre(beside=beside, ahead=ahead, speed=speed, steps=tuple(Step(**each) for each in steps))
    gene: Gene = known_gene(*fields)
    return gene


def _plain(gene: Gene) -> list[Any]:
    if isinstance(gene, Manoeuvre):
        return ["manoeuvre", gene.speed, gene.beside, gene.ahead, [told(step) for step in gene.steps]]
    if isinstance(gene, CrossingInstruction):
        return [gene.zone, gene.speed, gene.slot, gene.act]
    return [gene.target, gene.speed]


def told(step: Step) -> dict[str, Any]:
    """Return the fields of a step that differ from their defaults, as files contain them."""
    values = {each.name: getattr(step, each.name) for each in fields(step)}
    return {name: value for name, value in values.items() if value != getattr(DEFAULT_STEP, name)}


def _tenths_within(name: str, value: object, least: float, most: float) -> float:
    """Return a number in steps of 0.1 within bounds."""
    number = _number(name, value)
    rounded = round(max(min(number, most), least) * 10) / 10 + 0.0
    if not least <= number <= most or abs(number - rounded) > 1e-7:
        expected = f"a number from {least:g} to {most:g} in steps of 0.1"
        raise ScenarioError(field=name, expected=expected, received=repr(value), fix=f"the nearest is {rounded:g}")
    return rounded


def _checked_slot(value: object) -> float:
    slot = _number("slot", value)
    if abs(slot) > LARGEST_SLOT + 1e-9:
        expected = f"seconds, at most {LARGEST_SLOT:g} before or after the ego"
        raise ScenarioError(field="slot", expected=expected, received=repr(value))
    steps = round(slot * SLOT_STEPS_PER_SECOND)
    if abs(slot * SLOT_STEPS_PER_SECOND - steps) > 1e-6:
        fix = f"the nearest valid slot is {steps / SLOT_STEPS_PER_SECOND:g}"
        raise ScenarioError(field="slot", expected="seconds in steps of 0.1", received=repr(value), fix=fix)
    return steps / SLOT_STEPS_PER_SECOND + 0.0


def _checked_speed(value: object, least_steps: int = 0) -> float:
    speed = _number("speed", value)
    if speed > MAX_SPEED:
        raise ScenarioError(field="speed", expected=f"m/s, at most {MAX_SPEED:g}", received=repr(value))
    steps = round(max(speed, 0.0) * SPEED_STEPS_PER_MPS)  # a value far below 0 would overflow when multiplied by 10
    if speed < 0 or abs(speed * SPEED_STEPS_PER_MPS - steps) > 1e-6:
        expected = "m/s, at least 0 and in steps of 0.1"
        fix = f"the nearest valid speed is {max(steps, least_steps) / SPEED_STEPS_PER_MPS:g}"
        raise ScenarioError(field="speed", expected=expected, received=repr(value), fix=fix)
    return steps / SPEED_STEPS_PER_MPS


def _number(name: str, value: object) -> float:
    whole = plain_whole(value)
    try:
        number = float(value if isinstance(value, float) else math.nan if whole is None else whole)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ScenarioError(field=name, expected="a finite number", received=repr(value))
    return number + 0.0  # -0.0 becomes 0.0, so that equal scenarios have equal texts


def _checked_whole(name: str, value: object, top: int) -> int:
    return checked_whole(value, name, f"a whole number from 0 to {top}", least=0, most=top, error=ScenarioError)


def _checked_chains(npcs: object) -> tuple[Chromosome, ...]:
    """Return the chains as tuples; raise for an NPC without genes and for a chain with several kinds of genes."""
    try:
        chains = tuple(tuple(chain) for chain in npcs)  # type: ignore[attr-defined]
    except TypeError:
        expected = "one chain of instructions per NPC"
        fix = "write [[PositionInstruction(cell, speed), ...], ...], or [[Manoeuvre(...)], ...]"
        raise ScenarioError(field="npcs", expected=expected, received=repr(npcs), fix=fix) from None
    if not 1 <= len(chains) <= 8:
        raise ScenarioError(field="npcs", expected="1 to 8 NPCs, one per cell at most", received=str(len(chains)))
    for npc, chain in enumerate(chains):
        if {*map(type, chain)} in ({PositionInstruction}, {LaneInstruction}):
            continue  # the usual chains, in a fraction of the time
        if not chain:
            expected = "at least one instruction"
            raise ScenarioError(field=f"npcs[{npc}]", expected=expected, received="an empty chain")
        for gene, each in enumerate(chain):
            if not isinstance(each, Gene):
                expected = "a PositionInstruction, a LaneInstruction, a CrossingInstruction or a Manoeuvre"
                fix = "write PositionInstruction(cell, speed), or LaneInstruction(lane, speed)"
            elif type(each) is not (kind := type(chain[0])):
                expected = f"a {kind.__name__} like npcs[{npc}][0]"
                fix = "give an NPC instructions of one kind"
            elif gene and isinstance(each, ALONE):
                expected, fix = f"one {kind.__name__}", "it is the only one of its NPC; give the other to another NPC"
            else:
                continue
            raise ScenarioError(field=f"npcs[{npc}][{gene}]", expected=expected, received=repr(each), fix=fix)
    return chains


def _checked_vehicles(vehicles: object, npcs: int) -> tuple[VehicleType, ...]:
    if isinstance(vehicles, (str, Mapping)) or not isinstance(vehicles, Iterable):
        fix = 'write vehicles=("truck",) for NPC 0'
        raise ScenarioError(field="vehicles", expected="a vehicle per NPC", received=f"{vehicles!r:.100}", fix=fix)
    found = []
    for npc, each in enumerate(vehicles):
        try:
            found.append(VehicleType.of(each))
        except FieldError as error:
            name = "" if error.field == "vehicle" else f".{error.field}"
            raise ScenarioError(
                field=f"vehicles[{npc}]{name}", expected=error.expected, received=error.received, fix=error.fix
            ) from None
    if len(found) > npcs:
        expected = f"at most {npcs}, one per NPC"
        raise ScenarioError(field="vehicles", expected=expected, received=str(len(found)))
    return without_last_cars(found)


def _repaired(npcs: Sequence[Sequence[Gene]], seed: int) -> tuple[Chromosome, ...]:
    """Return chains with valid cells. Random choices of the repair depend only on the seed, the NPC and the gene."""
    chains = _checked_chains(npcs)
    wanted = [[gene.cell for gene in chain] for chain in positions_of(chains)]
    if are_valid(wanted):
        return chains
    return with_targets(chains, on_grid(chains, repair_chains(wanted, _checked_whole("seed", seed, MAX_SEED))))


def positions_of(npcs: Sequence[Sequence[Gene]]) -> tuple[tuple[PositionInstruction, ...], ...]:
    """Return the chains that consist of Position-Instructions."""
    positions = tuple(tuple(chain) for chain in npcs if isinstance(chain[0], PositionInstruction))
    return cast("tuple[tuple[PositionInstruction, ...], ...]", positions)


def on_grid(npcs: Sequence[Sequence[Gene]], rows: Sequence[Sequence[Cell]]) -> list[Sequence[Cell]]:
    """Return one row of cells for each NPC: the given rows for NPCs on the grid, an empty row for each other NPC."""
    each = iter(rows)
    return [next(each) if isinstance(chain[0], PositionInstruction) else () for chain in npcs]


def with_targets(npcs: Sequence[Chromosome], targets: Sequence[Sequence[Any]]) -> tuple[Chromosome, ...]:
    """Return the chains with new cells or lanes in their first genes; a chain without new ones is unchanged."""
    return tuple(
        # Most targets are unchanged, and checking a new gene for each of them took a tenth of a short run.
        (
            *(
                gene if gene.target == target else known_gene(target, gene.speed)
                for target, gene in zip(row, chain, strict=False)
            ),
            *chain[len(row) :],
        )
        for chain, row in zip_longest(npcs, targets, fillvalue=())
    )


def continues(before: Gene, gene: Gene) -> bool:
    """Return whether an instruction says nothing new after another one: it is equal, and asks for no change of lanes.

    If an NPC keeps its lane after a change of lanes at the same speed, this is a part of the change.
    """
    if isinstance(before, LaneInstruction):
        before = replace(before, lane="keep")
    return gene == before


def retimed(chain: Chromosome, seconds: float, wanted: float) -> Chromosome:
    """Return a chain of genes that last ``wanted`` instead of ``seconds`` [s], with nearly the same targets in time.

    Each new gene equals the old gene that was active at the middle of the new one. Longer genes may skip a cell, in
    which case the chain needs repair. If several new genes come from one Lane-Instruction, only the first of them
    changes lanes. A Crossing-Instruction and a Manoeuvre have no duration, so their chain is unchanged.
    """
    if isinstance(chain[0], ALONE):
        return chain
    count = max(1, math.ceil(len(chain) * seconds / wanted - 1e-9))
    olds = [min(int((gene + 0.5) * wanted / seconds), len(chain) - 1) for gene in range(count)]
    return tuple(
        replace(gene, lane="keep") if old == before and isinstance(gene := chain[old], LaneInstruction) else chain[old]
        for before, old in zip([-1, *olds], olds, strict=False)
    )


def _check_adjacency(npcs: Sequence[Chromosome]) -> None:
    for npc, chain in enumerate(npcs):
        cells = [each.cell for each in chain if isinstance(each, PositionInstruction)]
        for gene, (before, cell) in enumerate(pairwise(cells), 1):
            if not is_adjacent(before, cell):
                low, high = sorted(before.neighbours)
                place, received = f"npcs[{npc}][{gene}]", f"cell {int(cell)}"
                expected = f"cell {int(before)} again or its ring neighbour {int(low)} or {int(high)}"
                raise ScenarioError(field=place, expected=expected, received=received, fix=REPAIR)


def _check_distinct(npcs: Sequence[Chromosome]) -> None:
    for gene, row in enumerate(zip_longest(*npcs)):
        holders: dict[Cell, int] = {}
        for npc, held in enumerate(row):
            if not isinstance(held, PositionInstruction):
                continue
            other = holders.setdefault(held.cell, npc)
            if other != npc:
                place, expected = f"npcs[{npc}][{gene}]", f"a cell that no other NPC holds in gene {gene}"
                received = f"cell {int(held.cell)} of npcs[{other}]"
                raise ScenarioError(field=place, expected=expected, received=received, fix=REPAIR)


DEFAULT_STEP = Step()
"""A step that holds lane and speed."""
