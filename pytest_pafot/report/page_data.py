"""The content of the report as plain frozen values: no arrays, no scenarios, nothing that computes.

Positions are in the frame of the road: *along* the road, and *across* it from the centre of lane 0 to the right.
Headings are relative to the road, positive to the right. Lengths are in m, times in s since the start of the run,
speeds in m/s, accelerations in m/s^2, angles in rad. None stands for a number that does not exist, such
as the time to contact of vehicles that never touch. An empty text stands for a text that does not exist.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from pytest_pafot.campaign.events import SearchSummary
from pytest_pafot.findings.finding import IN_MEMORY
from pytest_pafot.findings.sighting import Sighting

Numbers = tuple[float | None, ...]
Errors = tuple[tuple[str, str], ...]
"""Tests that failed without a finding: the node id of each, and the text that pytest shows for the failure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneView:
    """A lane of a bent road: its centre line in world coordinates, and its width [m]."""

    points: tuple[tuple[float, float], ...]
    width: float


Place = tuple[float, float, float]
"""A gap that grows with the ego's speed: its minimum [m], its value at a standstill [m], its growth [m per m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadView:
    """The road and the grid, as far as a picture needs them.

    Attributes:
        lanes: position of each lane's centre across the road, from the left.
        clearance: gap between the ego and the cells ahead and behind.
        ahead, behind: gaps to the cells ahead of and behind the ego in attentive traffic: the minimum, the gap at a
            standstill, and the growth for each m/s of the ego's speed.
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


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneView:
    """The zone, where the way of a crossing NPC meets the ego's way.

    Attributes:
        name: entry and exit of the NPC's way.
        way: points of the NPC's way; empty if they are unknown.
        area: the points of the NPC's way at which the NPC would be in the ego's way.
        width: width of that area.
    """

    name: str
    way: tuple[tuple[float, float], ...] = ()
    area: tuple[tuple[float, float], ...] = ()
    width: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleView:
    """One vehicle of a run. Most attributes have one value per frame.

    Attributes:
        name: ``ego``, or ``NPC 0`` and so on.
        along, across: position of the vehicle's centre.
        acceleration: acceleration along the vehicle's way.
        gap: distance between the vehicle's box and the ego's box; empty for the ego.
        ttc: time to contact with the ego at constant velocities; empty for the ego.
        cells: grid cell that contains the vehicle's centre: 0 for the ego's place, None while the vehicle is not on the
            ego's way; empty for the ego.
        zone: the zone of an NPC that crosses; None for other vehicles.
        advantage: expected time between the ego and a crossing NPC at the zone; empty for other vehicles.
    """

    name: str
    length: float
    width: float
    along: Numbers
    across: Numbers
    heading: Numbers
    speed: Numbers
    acceleration: Numbers = ()
    gap: Numbers = ()
    ttc: Numbers = ()
    cells: tuple[int | None, ...] = ()
    zone: ZoneView | None = None
    advantage: Numbers = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionView:
    """One instruction to one NPC: for a cell, for a lane, or for crossing the ego's way.

    Attributes:
        npc: number of the NPC, from 0.
        start, end: time at which the instruction begins and ends.
        requested: the cell in the scenario; 0 if the instruction is not for a cell.
        cell: the cell that the NPC drove to; it differs from ``requested`` if the repair during the run changed it.
        speed: target speed.
        started: True if the run got as far as this instruction.
        arrived: time at which the NPC reached the cell, the lane or the zone; None if it did not.
        lane: ``keep``, ``left`` or ``right`` if the NPC drove to a lane; otherwise empty.
        zone: entry and exit of the NPC's way if it crosses the ego's way; otherwise empty.
        words: the instruction for a lane or for crossing in words.
    """

    npc: int
    start: float
    end: float
    requested: int
    cell: int
    speed: float
    started: bool
    arrived: float | None
    lane: str = ""
    zone: str = ""
    words: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventView:
    """The event of a run, such as a collision, which the page shows first. A failed check may have another moment.

    ``kind`` is the outcome of the run, such as ``collision``. The other fields are the time of the event, the NPC
    involved, and the side of the ego that was hit.
    """

    kind: str
    time: float
    npc: int | None = None
    side: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckView:
    """A failed check: the measured value, its unit and its bounds.

    Attributes:
        value: the worst value; None if it was not a finite number.
        at_most, at_least: the bounds; None for a bound that the check does not have.
        time: time of the worst value; None if unknown.
        values: one value per frame, the worst since the previous frame, cut at ``low`` and ``high``; empty if the
            check measured a single number.
        low, high: the range that a picture shows, including the bounds.
        is_cut: two booleans: True if there are values below ``low``, and if there are values above ``high``.
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

    @property
    def begin(self) -> float | None:
        """The time from which the bound is broken [s]; without a curve the time of the worst value, if it is known."""
        return self.broken[0][0] if self.broken else self.time


Stretch = tuple[float, float, str]
"""Decisions that are the same: the time of the first one, the time of the next other one [s], and their words."""
Paragraph = tuple[str, str, tuple[tuple[str, tuple[str, ...]], ...]]
"""A title, which may be empty, sentences, and lines of the user's code by whom they are about."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunView:
    """A finding with one of its runs, as the report page shows it.

    Attributes:
        sentences: who did what, what was due or what avoids it, and who is responsible unless the headline says it; of
            a failed check, what the headline does not say of it; otherwise empty.
        besides: the collision of a run in which a check failed, with who is at fault; otherwise empty.
        deadline: what the ego should have done by when to avoid the collision, in a few words; empty if unknown, or if
            it is not at fault.
        happened: what else is known of the run and of the finding, in prose.
        decisions: decisions of the ego's ADS, in order; equal ones in succession are one stretch.
        assertion: the line of the test that failed, or the exception that was raised.
        responsibility: ``ego``, ``npc``, ``both`` or ``none``.
        runs: number of runs of the search that failed in this way.
        label: ``new``, ``still failing``, ``flaky`` and so on.
        vehicles: the ego, then the NPCs.
        times: times of the frames; empty if no run was recorded.
        instructions: instructions to all NPCs, ordered by NPC and gene.
        yaml: text of its file.
        check: the check that failed; None if something else failed.
        traffic: how the NPCs drive; empty for the paper's traffic.
        sighting: the finding, as the session saw it. It has its own message.
    """

    headline: str
    responsibility: str
    road: RoadView
    vehicles: tuple[VehicleView, ...]
    times: tuple[float, ...]
    instructions: tuple[InstructionView, ...]
    event: EventView
    yaml: str
    command: str
    runs: int = 1
    label: str = ""
    sentences: tuple[str, ...] = ()
    besides: str = ""
    assertion: str = ""
    check: CheckView | None = None
    traffic: str = ""
    deadline: str = ""
    happened: tuple[Paragraph, ...] = ()
    decisions: tuple[Stretch, ...] = ()
    sighting: Sighting | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)

    @property
    def seen(self) -> Sighting:
        """The finding, as the session saw it.

        Raises:
            ValueError: if it is not known yet.
        """
        if self.sighting is None:
            raise ValueError("sighting: expected the finding of the view, received None; set it with replace")
        return self.sighting

    @property
    def test(self) -> str:
        """The name of its test, with its parameters."""
        return self.seen.finding.test.rpartition("::")[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """The content of a page.

    Attributes:
        facts: names and values to show of the session, such as versions and seeds.
        command: command that started the session.
        findings, searches: in the order in which they are listed.
        further: findings that the page only lists, the worst first.
        is_interrupted: whether the session was interrupted.
    """

    title: str
    facts: tuple[tuple[str, str], ...] = ()
    command: str = ""
    findings: tuple[RunView, ...] = ()
    searches: tuple[SearchSummary, ...] = ()
    further: tuple[Sighting, ...] = ()
    errors: Errors = ()
    is_interrupted: bool = False
