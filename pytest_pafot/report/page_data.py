"""The content of the report as plain frozen values: no arrays, no scenarios, nothing that computes.

Positions are in the frame of the road: *along* it, and *across* it from the centre of lane 0, to the right. Headings
are relative to it, positive to the right. Lengths are in m, times in s since the start of the run, speeds in m/s,
accelerations in m/s^2, jerks in m/s^3, angles in rad. None stands for a number that does not exist, such as a time to
contact of vehicles that never touch; an empty text means the same.
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
"""Tests that failed without a finding: node id and the text that pytest shows for it."""

NEW = "new"
"""The first word of the label of a finding that was not known before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneView:
    """A lane of a bent road: its centre line in world coordinates, and its width [m]."""

    points: tuple[tuple[float, float], ...]
    width: float


Place = tuple[float, float, float]
"""A gap that grows with the ego's speed: its minimum [m], its value at a standstill [m], and its growth [s]."""


def gap_to(road: RoadView, cell: Cell, speed: float) -> float:
    """Return the gap between an ego of this speed and a cell ahead or behind [m]."""
    if cell.column:
        return road.clearance
    least, start, seconds = road.ahead if cell.row > 0 else road.behind
    return max(road.clearance, least, start + seconds * speed)


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadView:
    """The parts of the world that a picture needs.

    Attributes:
        lanes: position of each lane's centre across the road, from the left.
        clearance: gap between the ego and the cells ahead and behind.
        ahead, behind: gaps to the cells in the ego's lane, in attentive traffic: the minimum, the gap at a standstill,
            and the growth for each m/s of the ego's speed.
        shapes: the lanes of a bent road. For such a road *along* is the world's x, *across* its y, headings are
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
"""Start and end of a stay; the end is None if the run ended first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneView:
    """The zone in which the way of an NPC that crosses meets the ego's.

    Attributes:
        name: entry and exit of the NPC's way.
        whence: where the NPC comes from, in words.
        stretch: start and end of the zone along that way.
        way: points of that way; empty if they are unknown.
        area: the points at which the NPC would be in the ego's way.
        width: width of that area.
        of_ego, of_npc: when each was in the zone; None if it never was.
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
        along, across: position of its centre.
        acceleration: acceleration along its way.
        jerk: the largest change of its acceleration per second since the previous frame.
        gap: distance between its box and the ego's; empty for the ego.
        ttc: constant-velocity time to contact with the ego; empty for the ego.
        cells: grid cell that contains its centre, 0 for the ego's own, None while it is not on the ego's way; empty for
            the ego.
        zone: the zone of an NPC that crosses.
        on_way: position of such an NPC along its way; empty for others.
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
    """One instruction to one NPC, the gene at one place of its chain, from its start to its end.

    Attributes:
        requested: requested cell; it differs from ``cell`` if the repair inside the run changed it.
        cell: cell as driven; 0 in a Lane-Instruction, as is ``requested``.
        started: whether the run got as far as this instruction.
        arrived: time at which the NPC reached the cell, the lane or the zone.
        lane: ``keep``, ``left`` or ``right`` in a Lane-Instruction; otherwise empty.
        zone: entry and exit of the way in a Crossing-Instruction; otherwise empty.
        slot: short text of a Crossing-Instruction's slot, such as ``+0.5 s`` or ``together``.
        words: the request of a Crossing-Instruction in words.
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
    """The moment that a run, and its finding, is about, unless a check has a different one.

    ``kind`` is the outcome of the run, such as ``collision``. The other fields are the NPC involved, the side of the
    ego that was hit, and the cell that the NPC was in.
    """

    kind: str
    time: float
    npc: int | None = None
    side: str = ""
    cell: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckView:
    """A failed check: the measured value, its unit and its bounds.

    Attributes:
        value: the worst value; None if it was not a finite number.
        at_most, at_least: the bounds; None for one that does not exist.
        time: time of the worst value; None if unknown.
        values: one per frame, the worst since the previous frame, cut at ``low`` and ``high``; empty if the check
            measured a single number.
        low, high: the range that a picture shows, including the bounds.
        is_cut: whether there are values below ``low``, and above ``high``.
        broken: start and end of each time span in which a bound was broken, in order.
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
    """All states of all vehicles at each tick, without loss.

    Attributes:
        physics_hz: ticks per second.
        states: the states as packed by :func:`~pytest_pafot.report.finding_view.drive_view`.
    """

    physics_hz: int
    states: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ChanceView:
    """The last time at which a reference driver in the ego's place stays free of fault, and a sentence on it."""

    time: float
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ShrinkView:
    """The result of shrinking: the chains before and after, a line per NPC, their sizes, and the number of runs.

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
        node_id: node id of the item that replays it.
        sentences: who did what, what was due or what avoids it, and who is responsible; empty without a collision.
        assertion: the line of the test that failed, or the exception that was raised.
        responsibility: ``ego``, ``npc``, ``both`` or ``none``.
        runs: number of runs of the search that failed in this way; 0 for a run without a verdict.
        generation: generation of its first run, from 0; None if no search found it.
        label: ``new``, ``still failing``, ``flaky`` and so on.
        severity: severity of the run on the page; None if it has no measure.
        vehicles: the ego, then the NPCs.
        times: times of the frames; empty if no run was recorded.
        instructions: instructions to all NPCs, ordered by NPC and gene.
        yaml, path: text and path of its file; empty for a run without a file.
        check: the check that failed; None if something else failed.
        prevention: which reference drivers would have prevented it, and which not; empty if none was tried.
        perception: which imperfections of its sight the failure needs; empty for perfect sight.
        traffic: how the NPCs drive; empty for the paper's traffic.
        last_chance: the last chance to avoid it; None if there is none.
        drive: the data from which the page writes its run as a table; None without a recorded run or without a file.
        grid: poses of the eight cells at each frame of a bent road, None for a cell without a lane. Empty if all NPCs
            cross, because these use no cells.
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
        """True if an NPC crosses."""
        return any(vehicle.zone is not None for vehicle in self.vehicles)

    @property
    def duration(self) -> float:
        """Time of the last frame [s]; 0 without frames."""
        return self.times[-1] if self.times else 0.0

    @property
    def moment(self) -> float:
        """Time of the moment that the finding is about [s]: the check's if it is known, otherwise the event's."""
        return self.event.time if self.check is None or self.check.time is None else self.check.time


@dataclass(frozen=True, slots=True, kw_only=True)
class GenerationView:
    """One generation of the main search.

    Attributes:
        best, mean: fitness over the population's eligible runs.
        failing: number of the population's runs that the test rejected.
        restarted: whether its population was randomly sampled after a restart.
        local_best: fitness of the best scenario of a local search that followed it.
        local_replaced: whether that scenario replaced the incumbent.
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
    """Counts of how often something occurred in the simulated scenarios of a search.

    Requested counts the scenarios as the search made them. Driven counts what was driven after repair, as far as the
    runs got. Reached counts those of the driven instructions whose cell was reached.
    """

    label: str
    requested: int
    driven: int
    reached: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignView:
    """The course and the figures of a search.

    Attributes:
        generations, asked: the finished generations in order, and how many were requested, or None.
        reason: why it ended, including ``error`` and ``interrupted``.
        simulated, reused: number of scenarios that were run, and that were known from an earlier run.
        outcomes, responsibilities: counts of simulated runs by name.
        cells: eight rows, cell 1 first.
        steps: twenty-four rows: from each cell, holding it, then one step clockwise, then one anticlockwise.
        speeds: a row per bin of target speeds, slowest first.
        warnings: warnings about the search's health.
        zones: five rows for each zone that NPCs were sent to, one per slot; empty if no NPC crosses.
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
    """The content of a page.

    Attributes:
        facts: name and value of facts on the session, such as versions and seeds.
        command: command that started the session.
        findings, campaigns: in the order in which they are listed.
        is_interrupted: whether the session was interrupted.
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
        """Make a report on a single finding, without facts on a session."""
        return cls(title=finding.headline, findings=(finding,))
