"""What the report shows, as plain frozen values: no arrays, no scenarios, nothing that computes.

Positions are in the frame of the road: *along* it, and *across* it from the centre of lane 0, to the right. Headings
are relative to it, positive to the right. Lengths are in m, times in s since the start of the run, speeds in m/s,
accelerations in m/s^2, jerks in m/s^3, angles in rad. Where a number is None there is none, such as a time to contact
of vehicles that never touch; so it is with a text that is empty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from pytest_pafot.findings.severity import Severity
from pytest_pafot.model.grid import Cell

Numbers = tuple[float | None, ...]
Pose = tuple[float, float, float]
"""Along [m], across [m], heading [rad]."""
Errors = tuple[tuple[str, str], ...]
"""Of tests that failed by no finding: node id and what pytest shows of it."""

NEW = "new"
"""How the label of a finding begins that was not known before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneView:
    """A lane of a road that is not straight: its centre line in world coordinates, and its width [m]."""

    points: tuple[tuple[float, float], ...]
    width: float


Place = tuple[float, float, float]
"""Of a gap that grows with a speed: at least, at a standstill, and per m/s."""


def gap_to(road: RoadView, cell: Cell, speed: float) -> float:
    """Return the gap between an ego of a speed and a cell ahead or behind [m]."""
    if cell.column:
        return road.clearance
    least, start, seconds = road.ahead if cell.row > 0 else road.behind
    return max(road.clearance, least, start + seconds * speed)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadView:
    """The world as far as a picture needs it.

    Attributes:
        lanes: how far across the road the centre of each lane is, from the left.
        clearance: gap between the ego and the cells ahead and behind.
        ahead, behind: of the gap to those in the ego's lane, in attentive traffic: at least the first number; the
            second, and the third for each m/s of the ego's speed.
        shapes: the lanes of a road that is not straight. There *along* is the world's x, *across* its y, headings are
            those of the world, and ``lanes`` is empty.
    """

    lanes: tuple[float, ...]
    lane_width: float
    speed_limit: float
    clearance: float
    ahead: Place = (0.0, 0.0, 0.0)
    behind: Place = (0.0, 0.0, 0.0)
    shapes: tuple[LaneView, ...] = ()


Window = tuple[float, float | None]
"""From when to when, None where the run was over before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneView:
    """The zone in which the way of an NPC that crosses meets the ego's.

    Attributes:
        name: entry and exit of that way.
        whence: from where the NPC comes, in words.
        stretch: from where to where along that way the zone is.
        way: points of that way; none where nobody knows them.
        area: those of them in which the NPC would be in the ego's way.
        width: of that area.
        of_ego, of_npc: when each was in the zone; None where it never was.
    """

    name: str
    whence: str
    stretch: tuple[float, float]
    way: tuple[tuple[float, float], ...] = ()
    area: tuple[tuple[float, float], ...] = ()
    width: float = 0.0
    of_ego: Window | None = None
    of_npc: Window | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleView:
    """One vehicle, a value per frame.

    Attributes:
        name: ``ego``, or ``NPC 0`` and so on.
        along, across: of its centre.
        acceleration: along its way.
        jerk: the change of its acceleration per second that was largest since the frame before.
        gap: between its box and the ego's; empty for the ego.
        ttc: constant-velocity time to contact with the ego; empty for the ego.
        cells: of the grid that its centre is in, 0 for the ego's own, None while it is not on the ego's way; empty for
            the ego.
        zone: of an NPC that crosses.
        on_way: how far along its own way that is; empty for others.
        advantage: expected time between its passing its zone and the ego's; empty for others.
    """

    name: str
    length: float
    width: float
    along: Numbers
    across: Numbers
    heading: Numbers
    speed: Numbers
    acceleration: Numbers = ()
    jerk: Numbers = ()
    gap: Numbers = ()
    ttc: Numbers = ()
    cells: tuple[int | None, ...] = ()
    zone: ZoneView | None = None
    on_way: Numbers = ()
    advantage: Numbers = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionView:
    """One instruction of one NPC, the gene at one place of its chain, with the time from its start to its end.

    Attributes:
        requested: cell asked for; another one than ``cell`` where the repair inside the run changed it.
        cell: as driven; 0 in a Lane-Instruction, and so is ``requested``.
        started: whether the run came to it.
        arrived: when the cell, the lane or the zone was reached.
        lane: of a Lane-Instruction, ``keep``, ``left`` or ``right``; else empty.
        zone: of a Crossing-Instruction, the entry and the exit of its way; else empty.
        slot: of a Crossing-Instruction, as short as ``+0.5 s``, or ``together``.
        words: what a Crossing-Instruction asks for.
    """

    npc: int
    gene: int
    start: float
    end: float
    requested: int
    cell: int
    speed: float
    started: bool
    arrived: float | None
    lane: str = ""
    zone: str = ""
    slot: str = ""
    words: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventView:
    """The moment that a run is about, and with it a finding, unless a check says another one.

    ``kind`` is the outcome of the run, such as ``collision``. Then follow the NPC that takes part, the side of the ego
    that was hit, and the cell that the NPC was in.
    """

    kind: str
    time: float
    npc: int | None = None
    side: str = ""
    cell: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckView:
    """A check that failed: what it measured, in its unit, against which bounds.

    Attributes:
        value: the worst one; None where it was no finite number.
        at_most, at_least: its bounds; None without.
        time: when it was worst; None where nobody knows.
        values: of the frames, each the worst since the frame before, cut at ``low`` and ``high``; empty where the check
            was of a single number.
        low, high: between which a picture shows them, the bounds among it.
        is_cut: whether there are values below ``low``, and above ``high``.
        broken: from when to when a bound was broken, in order.
    """

    name: str
    unit: str
    value: float | None
    at_most: float | None = None
    at_least: float | None = None
    time: float | None = None
    values: Numbers = ()
    low: float = 0.0
    high: float = 1.0
    is_cut: tuple[bool, bool] = (False, False)
    broken: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveView:
    """Where all vehicles were at each tick, with all digits.

    Attributes:
        physics_hz: ticks per second.
        states: as :func:`~pytest_pafot.report.finding_view.drive_view` packs them.
    """

    physics_hz: int
    states: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ChanceView:
    """When a reference driver in the ego's place would last have stayed free of fault, with the sentence on it."""

    time: float
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ShrinkView:
    """What shrinking came to: the chains before and after, a line per NPC, their numbers, and how many runs it took.

    ``notes`` are sentences such as "any speed from 3 to 11 m/s still collides".
    """

    original: tuple[str, ...]
    shrunk: tuple[str, ...]
    original_npcs: int
    shrunk_npcs: int
    original_instructions: int
    shrunk_instructions: int
    rollouts: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingView:
    """One finding.

    Attributes:
        id: unique within a report together with the node id.
        node_id: of the item that replays it.
        sentences: who did what, what was due or what avoids it, and who is responsible; none without a collision.
        assertion: the line of the test that failed, or what was raised.
        responsibility: ``ego``, ``npc``, ``both`` or ``none``.
        runs: of the search that failed in this way; 0 for a run that no test has judged.
        generation: in which it was first found, from 0; None where no search found it.
        label: ``new``, ``still failing``, ``flaky`` and so on.
        severity: of the run that is shown; None where nothing measures it.
        vehicles: the ego, then the NPCs.
        times: of the frames; none where nobody saw a run.
        instructions: of all NPCs, ordered by NPC and gene.
        yaml, path: the text of its file and where that is; empty for a run that is in none.
        check: that failed; None where something else did.
        prevention: which reference drivers would have prevented it, and which not; empty where none was tried.
        perception: which imperfections of its sight it needs; empty where that is perfect.
        traffic: in which the NPCs drive; empty for the paper's.
        last_chance: None where there is no such moment.
        drive: from which the page writes its run as a table; None where nobody saw one, or it is in no file.
        grid: of a road that is not straight, where the eight cells are at each frame; None for one without a lane.
            Empty where all NPCs cross, which know no cells.
    """

    id: str
    node_id: str
    test: str
    headline: str
    explanation: str
    responsibility: str
    road: RoadView
    vehicles: tuple[VehicleView, ...]
    times: tuple[float, ...]
    instructions: tuple[InstructionView, ...]
    event: EventView
    yaml: str
    command: str
    runs: int = 1
    generation: int | None = None
    label: str = ""
    severity: Severity | None = None
    path: str = ""
    sentences: tuple[str, ...] = ()
    assertion: str = ""
    check: CheckView | None = None
    prevention: str = ""
    perception: str = ""
    traffic: str = ""
    last_chance: ChanceView | None = None
    shrink: ShrinkView | None = None
    drive: DriveView | None = None
    grid: tuple[tuple[Pose | None, ...], ...] = ()

    @property
    def is_crossed(self) -> bool:
        """Whether an NPC crosses."""
        return any(vehicle.zone is not None for vehicle in self.vehicles)

    @property
    def duration(self) -> float:
        """Time of the last frame [s]; 0 without frames."""
        return self.times[-1] if self.times else 0.0

    @property
    def moment(self) -> float:
        """When that happened which the finding is about [s]: of the check where it knows, else of the event."""
        return self.event.time if self.check is None or self.check.time is None else self.check.time


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationView:
    """One generation of the main search.

    Attributes:
        best, mean: fitness over the population's eligible runs.
        failing: runs of the population that the test rejected.
        restarted: whether its population was random again.
        local_best: fitness of the best of a local search after it.
        local_replaced: whether that took the incumbent's place.
    """

    generation: int
    best: float | None
    mean: float | None
    failing: int
    population: int
    restarted: bool = False
    local_best: float | None = None
    local_replaced: bool = False


@dataclass(frozen=True, slots=True)
class CoverageRow:
    """How often something occurred in the simulated scenarios of a search.

    Requested: in the scenarios as asked for. Driven: after repair, as far as the runs came. Reached: of those driven,
    how many had their cell reached.
    """

    label: str
    requested: int
    driven: int
    reached: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignView:
    """How a search went.

    Attributes:
        generations, asked: those that finished, in order, and how many were asked for, or None.
        reason: why it ended, ``error`` and ``interrupted`` among it.
        simulated, reused: scenarios that were run, and that were known from an earlier run.
        outcomes, responsibilities: counts of simulated runs by name.
        cells: eight rows, cell 1 first.
        steps: twenty-four rows: from each cell, holding it, then one step clockwise, then one anticlockwise.
        speeds: a row per bin of target speeds, slowest first.
        warnings: of the search's health.
        zones: five rows of each zone that NPCs were sent to, a row per slot; empty where nobody crosses.
    """

    node_id: str
    algorithm: str
    seed: int
    generations: tuple[GenerationView, ...]
    asked: int | None
    reason: str
    simulated: int
    reused: int
    outcomes: tuple[tuple[str, int], ...]
    responsibilities: tuple[tuple[str, int], ...]
    cells: tuple[CoverageRow, ...]
    steps: tuple[CoverageRow, ...]
    speeds: tuple[CoverageRow, ...]
    warnings: tuple[str, ...] = ()
    zones: tuple[CoverageRow, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Everything on a page.

    Attributes:
        facts: of the session, such as versions and seeds: name and value.
        command: by which the session was started.
        findings, campaigns: in the order in which they are listed.
        is_interrupted: whether the session was.
    """

    title: str
    facts: tuple[tuple[str, str], ...] = ()
    command: str = ""
    findings: tuple[FindingView, ...] = ()
    campaigns: tuple[CampaignView, ...] = ()
    errors: Errors = ()
    is_interrupted: bool = False

    @classmethod
    def of(cls, finding: FindingView) -> Self:
        """With a single finding, and nothing of a session."""
        return cls(title=finding.headline, findings=(finding,))
