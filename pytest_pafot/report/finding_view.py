"""What the page shows of a finding, taken from its file and from the record of a run of it."""

from __future__ import annotations

import base64
import shlex
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pytest_pafot.checks import Check
from pytest_pafot.corpus.yaml_text import text_of
from pytest_pafot.criticality import Encounters
from pytest_pafot.criticality.signals import jerk
from pytest_pafot.findings.finding import Expect, Finding
from pytest_pafot.findings.shrink import blocks, instructions
from pytest_pafot.report.check_view import check_tick, check_view
from pytest_pafot.report.page_data import (
    ChanceView,
    DriveView,
    EventView,
    FindingView,
    InstructionView,
    Numbers,
    RoadView,
    ShrinkView,
    VehicleView,
)
from pytest_pafot.report.road_view import along_and_across, grid_poses, road_view
from pytest_pafot.report.terminal import prevention_text, speed_sentences
from pytest_pafot.run import Run
from pytest_pafot.scenario import Chromosome, LaneInstruction, PositionInstruction, Scenario
from pytest_pafot.trace import ACCELERATION, HEADING, SPEED, FloatArray, Trace, X, Y
from pytest_pafot.world.limits import CLEARANCE

FRAMES_PER_SECOND = 7
"""Frames of a view, about: enough for an eye that sees them interpolated."""


def finding_view(
    trace: Trace | None, finding: Finding, *, node_id: str, headline: str = "", check: Check | None = None
) -> FindingView:
    """The view of a finding, with the node id of the item that replays it.

    What is known only later, such as the number of runs that failed in this way, the label or the path of the file,
    is set with :func:`dataclasses.replace`.

    Args:
        trace: of the run that shows it, of the scenario in its file; None where nobody saw how it ended.
        headline: unless given, that of the run.
        check: that failed in the run; None where something else did.
    """
    expect = finding.expect
    clearance = finding.world.get("clearance", CLEARANCE)
    clearance = float(clearance) if isinstance(clearance, (int, float)) else CLEARANCE
    explanation = "" if trace is None else Run(trace).explain()
    first, _, rest = explanation.partition("\n")
    chance, rest = expect.last_chance, (rest if check is None else explanation) or expect.message
    view = FindingView(
        id=finding.id,
        node_id=node_id,
        test=finding.test,
        headline=headline or first or expect.message or expect.failure,
        explanation=rest if chance is None else f"{rest}\n  {chance.sentence}",
        assertion=_assertion(expect),
        responsibility=expect.responsibility,
        generation=finding.found.generation,
        road=RoadView(lanes=(), lane_width=0.0, speed_limit=0.0, clearance=clearance),
        vehicles=(),
        times=(),
        instructions=_instructions(trace, finding.scenario),
        event=EventView(kind=str(expect.outcome), time=expect.time),
        yaml=text_of(finding),
        command=f"pytest {shlex.quote(node_id)}",
        last_chance=None if chance is None else ChanceView(time=chance.time, sentence=chance.sentence),
        prevention=prevention_text(expect),
        perception="" if finding.perception is None else finding.perception.sentence,
    )
    if finding.shrunk is not None:
        original, rollouts = finding.original or finding.scenario, finding.shrunk.rollouts
        shrink = shrink_view(original, finding.scenario, rollouts=rollouts, notes=speed_sentences(finding))
        view = replace(view, shrink=shrink)
    return view if trace is None else replace(_with_run(view, trace, clearance, check), drive=drive_view(trace))


def drive_view(trace: Trace) -> DriveView:
    """All states of a run to the last digit, in half of the room that the compressed table itself takes.

    In the order of the packing: a series of float64 for each column of each vehicle; of their bits, as whole numbers,
    the differences of the second order, which are small where something moves evenly; first the lowest bytes of all,
    then the next ones, so that those that are alike lie together; compressed by zlib; in base64.
    """
    changes = trace.states.transpose(1, 2, 0).astype("<f8", order="C").view("<i8")
    for _ in range(2):
        changes = np.diff(changes, axis=-1, prepend=0)  # wraps around, as the sums do that undo it
    planes = changes.astype("<i8", order="C").reshape(-1, 1).view(np.uint8).T
    packed = zlib.compress(planes.tobytes(), zlib.Z_BEST_COMPRESSION)
    return DriveView(physics_hz=trace.physics_hz, states=base64.b64encode(packed).decode())


def run_view(trace: Trace, clearance: float = CLEARANCE) -> FindingView:
    """The view of a run that no test has judged, with the gap to the cells ahead and behind [m]; it is in no file."""
    run = Run(trace)
    headline, _, explanation = run.explain().partition("\n")
    view = FindingView(
        id=f"scenario {run.scenario.id}",
        node_id="",
        test="",
        headline=headline,
        explanation=explanation,
        responsibility=run.responsibility or "none",
        road=RoadView(lanes=(), lane_width=0.0, speed_limit=0.0, clearance=clearance),
        vehicles=(),
        times=(),
        instructions=_instructions(trace, run.scenario),
        event=EventView(kind=str(run.outcome), time=run.event_time),
        yaml="",
        command="",
        runs=0,
    )
    return _with_run(view, trace, clearance, None)


def _assertion(expect: Expect) -> str:
    if expect.check is not None:
        return f"check {expect.assertion}"
    if expect.assertion:
        return f"assert {expect.assertion.removeprefix('assert ')}"
    return f"{expect.failure}: {expect.message}" if expect.message else expect.failure


def _with_run(view: FindingView, trace: Trace, clearance: float, check: Check | None) -> FindingView:
    """The view with all that only a run shows: the road, who was where when, and the moment that it is about."""
    run, tick = Run(trace), check_tick(trace, check)
    ticks = frame_ticks(trace) if tick is None else sorted({*frame_ticks(trace), tick})
    return replace(
        view,
        road=road_view(trace, clearance),
        vehicles=_vehicles(trace, ticks),
        times=tuple(round(tick / trace.physics_hz, 3) for tick in ticks),
        event=EventView(
            kind=str(run.outcome),
            time=round(min(run.event_time, run.duration), 3),
            npc=run.event_npc,
            side="" if run.collision is None else run.collision.side,
            cell=None if run.event_cell is None else int(run.event_cell),
        ),
        check=None if check is None else check_view(check, trace, ticks),
        grid=() if trace.track is None else grid_poses(trace, ticks, clearance),
    )


def shrink_view(original: Scenario, shrunk: Scenario, *, rollouts: int, notes: Iterable[str] = ()) -> ShrinkView:
    """What shrinking the scenario as found came to in so many runs; notes are sentences on speeds that still fail."""
    return ShrinkView(
        original=tuple(map(_chain_text, original.npcs)),
        shrunk=tuple(map(_chain_text, shrunk.npcs)),
        original_npcs=len(original.npcs),
        shrunk_npcs=len(shrunk.npcs),
        original_instructions=instructions(original),
        shrunk_instructions=instructions(shrunk),
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


def _vehicles(trace: Trace, ticks: Sequence[int]) -> tuple[VehicleView, ...]:
    encounters, changes = Encounters(trace), jerk(trace)
    along, across, heading = (trace.states[:, :, column] for column in (X, Y, HEADING))
    if trace.track is None:
        (along, across), heading = along_and_across(trace, along, across), heading - trace.lanes[0].heading
    else:  # A road that bends is drawn as the world has it.
        heading = np.unwrap(heading, axis=0)
    views = []
    for vehicle in range(trace.states.shape[1]):
        view = VehicleView(
            name=f"NPC {vehicle - 1}" if vehicle else "ego",
            length=float(trace.sizes[vehicle, 0]),
            width=float(trace.sizes[vehicle, 1]),
            along=_numbers(along[ticks, vehicle], 2),
            across=_numbers(across[ticks, vehicle], 2),
            heading=_numbers(heading[ticks, vehicle], 3),
            speed=_numbers(trace.states[ticks, vehicle, SPEED], 2),
            acceleration=_numbers(trace.states[ticks, vehicle, ACCELERATION], 1),
            jerk=_numbers(_peaks(changes[vehicle], ticks), 1),
        )
        if vehicle:
            npc = vehicle - 1
            cells = tuple(int(encounters.cell(npc, tick) or 0) for tick in ticks)
            gap, ttc = _numbers(encounters.gap[npc, ticks], 2), _numbers(encounters.ttc[npc, ticks], 2)
            view = replace(view, gap=gap, ttc=ttc, cells=cells)
        views.append(view)
    return tuple(views)


def _peaks(values: FloatArray, ticks: Sequence[int]) -> FloatArray:
    """The value farthest from 0 since the frame before; a peak of jerk lasts but a tick."""
    spans = [values[before + 1 : tick + 1] for before, tick in pairwise([-1, *ticks])]
    return np.array([span[np.argmax(np.abs(span))] for span in spans])


def _instructions(trace: Trace | None, scenario: Scenario) -> tuple[InstructionView, ...]:
    """Without a run, as asked for in the scenario; none of them begun."""
    asked = scenario if trace is None else trace.scenario
    driven, arrivals, hz = (asked.npcs, (), 1) if trace is None else (trace.chains, trace.arrivals, trace.physics_hz)
    views = []
    for npc, chain in enumerate(asked.npcs):
        begun = arrivals[npc] if npc < len(arrivals) else ()
        for gene, (requested, told) in enumerate(zip(chain, driven[npc], strict=False)):
            tick = begun[gene] if gene < len(begun) else None
            view = InstructionView(
                npc=npc,
                gene=gene,
                start=round(gene * asked.gene_seconds, 3),
                end=round((gene + 1) * asked.gene_seconds, 3),
                requested=int(requested.cell) if isinstance(requested, PositionInstruction) else 0,
                cell=int(told.cell) if isinstance(told, PositionInstruction) else 0,
                speed=told.speed,
                started=gene < len(begun),
                arrived=None if tick is None else round(tick / hz, 3),
                lane=told.lane if isinstance(told, LaneInstruction) else "",
            )
            views.append(view)
    return tuple(views)


def _numbers(values: FloatArray, digits: int) -> Numbers:
    """Rounded, with None for what is no finite number; never -0.0."""
    rounded = np.round(values, digits) + 0.0
    return tuple(float(value) if np.isfinite(value) else None for value in rounded)


def _chain_text(chain: Chromosome) -> str:
    """One NPC's instructions in a line, with equal ones told once: ``1 front-left 25.0 m/s x2, 2 front 8.0 m/s``."""
    return ", ".join(
        f"{chain[start].goal} {chain[start].speed:.1f} m/s" + (f" x{end - start}" if end - start > 1 else "")
        for start, end in blocks(chain)
    )
