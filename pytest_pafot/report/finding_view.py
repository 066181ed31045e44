"""The view of a finding, built from the record of its run."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from pytest_pafot.criticality import Encounters
from pytest_pafot.findings.finding import Finding
from pytest_pafot.report.page_data import (
    EventView,
    FindingView,
    InstructionView,
    Numbers,
    RoadView,
    ShrinkView,
    VehicleView,
)
from pytest_pafot.report.road_view import grid_views, lane_views
from pytest_pafot.run import Run
from pytest_pafot.scenario import Chromosome, Gene, LaneInstruction, PositionInstruction, Scenario
from pytest_pafot.trace import ACCELERATION, HEADING, SPEED, FloatArray, Trace, X, Y
from pytest_pafot.world.limits import CLEARANCE

FRAMES_PER_SECOND = 7
"""Frames of a view, about: enough for an eye that sees them interpolated."""


def finding_view(
    trace: Trace | None,
    finding: Finding,
    *,
    node_id: str,
    yaml: str,
    headline: str = "",
    explanation: str = "",
    preventable_tried: Sequence[str] = (),
    shrink: ShrinkView | None = None,
) -> FindingView:
    """The view of a finding.

    What is known only later, such as the number of runs that failed in this way, the label or the path of the file,
    is set with :func:`dataclasses.replace`.

    Args:
        trace: of the run that shows it, of the scenario in its file; None where nobody saw how it ended.
        finding: as it is kept.
        node_id: of the item that replays it.
        yaml: the text of its file.
        headline, explanation: unless given, those of the run.
        preventable_tried: reference drivers that were tried, beside those in the finding that survived.
        shrink: see :func:`shrink_view`.
    """
    first, _, rest = ("", "", "") if trace is None else Run(trace).explain().partition("\n")
    survivors = tuple(finding.expect.preventable_by)
    ticks = [] if trace is None else frame_ticks(trace)
    road = _road(trace, finding)
    return FindingView(
        id=finding.id,
        node_id=node_id,
        test=finding.test,
        headline=headline or first or finding.expect.message or finding.expect.failure,
        explanation=explanation or rest or finding.expect.message,
        assertion=_assertion(finding),
        responsibility=finding.expect.responsibility,
        generation=finding.found.generation,
        road=road,
        vehicles=() if trace is None else _vehicles(trace, ticks),
        times=() if trace is None else tuple(round(float(tick) / trace.physics_hz, 3) for tick in ticks),
        instructions=_instructions(trace, finding),
        event=_event(trace, finding),
        yaml=yaml,
        command=f"pytest {shlex.quote(node_id)}",
        preventable_by=survivors,
        preventable_tried=(*survivors, *(name for name in preventable_tried if name not in survivors)),
        shrink=shrink,
        grid=() if trace is None or trace.track is None else grid_views(trace, ticks, road.clearance),
    )


def shrink_view(original: Scenario, shrunk: Scenario, *, rollouts: int, notes: Iterable[str] = ()) -> ShrinkView:
    """What shrinking came to, in lines of text.

    Args:
        original: the scenario as found.
        shrunk: what it came to.
        rollouts: runs that it took.
        notes: sentences on intervals of speeds that still fail.
    """
    return ShrinkView(
        original=tuple(map(_chain_text, original.npcs)),
        shrunk=tuple(map(_chain_text, shrunk.npcs)),
        original_npcs=len(original.npcs),
        shrunk_npcs=len(shrunk.npcs),
        original_instructions=sum(map(_distinct, original.npcs)),
        shrunk_instructions=sum(map(_distinct, shrunk.npcs)),
        rollouts=rollouts,
        notes=tuple(notes),
    )


def frame_ticks(trace: Trace) -> list[int]:
    """The ticks that a view shows: about seven a second, the last one, and that of the collision among them."""
    stride = max(1, round(trace.physics_hz / FRAMES_PER_SECOND))
    ticks = {*range(0, trace.ticks + 1, stride), trace.ticks}
    if trace.collision is not None:
        ticks.add(trace.collision.tick)
    return sorted(ticks)


def _road(trace: Trace | None, finding: Finding) -> RoadView:
    clearance = finding.world.get("clearance", CLEARANCE)
    clearance = float(clearance) if isinstance(clearance, (int, float)) else CLEARANCE
    if trace is None:
        return RoadView(lanes=(), lane_width=0.0, speed_limit=0.0, clearance=clearance)
    if trace.track is not None:
        return RoadView(
            lanes=(),
            lane_width=float(trace.lanes[0].width),
            speed_limit=round(float(trace.speed_limit), 2),
            clearance=clearance,
            shapes=lane_views(trace),
        )
    across = [_projected(trace, np.array([lane.x]), np.array([lane.y]))[1][0] for lane in trace.lanes]
    return RoadView(
        lanes=tuple(round(float(value), 2) for value in across),
        lane_width=float(trace.lanes[0].width),
        speed_limit=round(float(trace.speed_limit), 2),
        clearance=clearance,
    )


def _vehicles(trace: Trace, ticks: Sequence[int]) -> tuple[VehicleView, ...]:
    encounters = Encounters(trace)
    along, across, heading = _in_the_picture(trace)
    views = []
    for vehicle in range(trace.states.shape[1]):
        npc = vehicle - 1
        is_ego = vehicle == 0
        views.append(
            VehicleView(
                name="ego" if is_ego else f"NPC {npc}",
                length=float(trace.sizes[vehicle, 0]),
                width=float(trace.sizes[vehicle, 1]),
                along=_numbers(along[ticks, vehicle], 2),
                across=_numbers(across[ticks, vehicle], 2),
                heading=_numbers(heading[ticks, vehicle], 3),
                speed=_numbers(trace.states[ticks, vehicle, SPEED], 2),
                acceleration=_numbers(trace.states[ticks, vehicle, ACCELERATION], 1),
                jerk=_numbers(_jerk(trace, ticks, vehicle), 1),
                gap=() if is_ego else _numbers(encounters.gap[npc, ticks], 2),
                ttc=() if is_ego else _numbers(encounters.ttc[npc, ticks], 2),
                cells=() if is_ego else tuple(int(encounters.cell(npc, tick) or 0) for tick in ticks),
            )
        )
    return tuple(views)


def _jerk(trace: Trace, ticks: Sequence[int], vehicle: int) -> FloatArray:
    """The largest change of acceleration per second since the frame before [m/s^3]; a peak lasts but a tick."""
    changes = np.diff(trace.states[:, vehicle, ACCELERATION], prepend=trace.states[0, vehicle, ACCELERATION])
    spans = [changes[before + 1 : tick + 1] for before, tick in pairwise([-1, *ticks])]
    return np.array([span[np.argmax(np.abs(span))] for span in spans]) * trace.physics_hz


def _in_the_picture(trace: Trace) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Along [m], across [m], heading [rad], shape [ticks + 1, vehicles]: of the road, or of the world if it bends."""
    x, y, heading = (trace.states[:, :, column] for column in (X, Y, HEADING))
    if trace.track is not None:
        return x, y, np.unwrap(heading, axis=0)
    return *_projected(trace, x, y), heading - trace.lanes[0].heading


def _projected(trace: Trace, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """World coordinates to (along, across) in the frame of the first lane [m]."""
    lane = trace.lanes[0]
    dx, dy = x - lane.x, y - lane.y
    cos, sin = np.cos(lane.heading), np.sin(lane.heading)
    return dx * cos + dy * sin, dy * cos - dx * sin


def _instructions(trace: Trace | None, finding: Finding) -> tuple[InstructionView, ...]:
    asked = finding.scenario if trace is None else trace.scenario
    driven = asked.npcs if trace is None else trace.chains
    return tuple(
        _instruction(trace, npc, gene, request, driven[npc][gene], asked.gene_seconds)
        for npc, chain in enumerate(asked.npcs)
        for gene, request in enumerate(chain)
    )


def _instruction(
    trace: Trace | None, npc: int, gene: int, requested: Gene, driven: Gene, seconds: float
) -> InstructionView:
    arrivals = trace.arrivals[npc] if trace is not None and npc < len(trace.arrivals) else ()
    arrival = arrivals[gene] if gene < len(arrivals) else None
    return InstructionView(
        npc=npc,
        gene=gene,
        start=round(gene * seconds, 3),
        end=round((gene + 1) * seconds, 3),
        requested=_cell_of(requested),
        cell=_cell_of(driven),
        speed=driven.speed,
        started=gene < len(arrivals),
        arrived=None if arrival is None or trace is None else round(arrival / trace.physics_hz, 3),
        lane=driven.lane if isinstance(driven, LaneInstruction) else "",
    )


def _cell_of(instruction: Gene) -> int:
    return int(instruction.cell) if isinstance(instruction, PositionInstruction) else 0


def _assertion(finding: Finding) -> str:
    """What failed, as the test has it."""
    expect = finding.expect
    if expect.assertion:
        return f"assert {expect.assertion.removeprefix('assert ')}"
    return f"{expect.failure}: {expect.message}" if expect.message else expect.failure


def _event(trace: Trace | None, finding: Finding) -> EventView:
    if trace is None:
        return EventView(kind=str(finding.expect.outcome), time=finding.expect.time)
    run = Run(trace)
    return EventView(
        kind=str(run.outcome),
        time=round(min(run.event_time, run.duration), 3),
        npc=run.event_npc,
        side="" if run.collision is None else run.collision.side,
        cell=None if run.event_cell is None else int(run.event_cell),
    )


def _numbers(values: FloatArray, digits: int) -> Numbers:
    """Rounded, with None for what is no finite number; never -0.0."""
    rounded = np.round(values, digits) + 0.0
    return tuple(float(value) if np.isfinite(value) else None for value in rounded)


def _chain_text(chain: Chromosome) -> str:
    """One NPC's instructions in a line, with equal ones told once: ``1 front-left 25.0 m/s x2, 2 front 8.0 m/s``."""
    starts = [gene for gene in range(len(chain)) if gene == 0 or chain[gene] != chain[gene - 1]]
    spans = pairwise([*starts, len(chain)])
    return ", ".join(
        f"{chain[start].goal} {chain[start].speed:.1f} m/s" + (f" x{end - start}" if end - start > 1 else "")
        for start, end in spans
    )


def _distinct(chain: Chromosome) -> int:
    return 1 + sum(a != b for a, b in pairwise(chain))
