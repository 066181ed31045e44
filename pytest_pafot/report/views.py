"""The data about a finding for the report page, taken from its file and a run's trace."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import groupby, pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from pytest_pafot.attribution import takeovers
from pytest_pafot.attribution.sentences import ALSO
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.criticality import Encounters, gap, passages, time_advantage, ttc
from pytest_pafot.criticality.measures import stretches
from pytest_pafot.findings.decisions import deed_of, is_si, sentences_of
from pytest_pafot.findings.finding import Expect, Finding
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ACCELERATION, ALONG, SPEED, FloatArray, Lane, Trace, X, Y
from pytest_pafot.model.vehicle_type import AMPLE, CAR, STYLES, DrivingStyle
from pytest_pafot.oracle.run import Check, Run, arrival, lanes_apart
from pytest_pafot.report.terminal import shrunk_lines
from pytest_pafot.searches.harness import collision_in_short
from pytest_pafot.searches.refine.moment import text_of as text_of_action
from pytest_pafot.support.errors import DriverError
from pytest_pafot.support.text import capitalised, plural
from pytest_pafot.world.gym_world import action_names
from pytest_pafot.world.kernel.driver import following_gap
from pytest_pafot.world.limits import CLEARANCE

Numbers = tuple[float | None, ...]
Place = tuple[float, float, float]
"""A gap that increases with the ego's speed: minimum [m], value at a standstill [m], increase [m per m/s]."""
Stretch = tuple[float, float, str]
"""A sequence of equal decisions: time of the first [s], time of the next different decision [s], and a description."""
Paragraph = tuple[str, str, tuple[tuple[str, tuple[str, ...]], ...]]
"""A title, sentences, and groups of code lines, each with the vehicle that its lines are about."""
View = dict[str, Any]
"""JSON-compatible data for the page.

Positions are *along* the road, and *across* it to the right from the centre of lane 0. Headings are relative to the
road, positive to the right. Units are m, s since the start of the run, m/s, m/s^2 and rad. None means that there is no
number.
"""

# The road in the picture of a run.

# The length of road that is drawn ahead of the last position of the ego [m].
BEYOND = 150.0


def road_view(trace: Trace, clearance: float) -> View:
    """Return the data of the road in a run.

    A straight road has ``lanes``, positions across the road. A curved road has ``shapes`` in world coordinates.
    """
    ahead, behind = places(STYLES[trace.scenario.traffic])
    road: View = {
        "lanes": (),
        "lane_width": float(trace.lanes[0].width),
        "speed_limit": round(float(trace.speed_limit), 2),
        "clearance": clearance,
        "ahead": ahead,
        "behind": behind,
        "shapes": (),
    }
    if trace.road.is_straight:
        starts = np.array([(lane.x, lane.y) for lane in trace.lanes])
        across = trace.road.drawn(starts[:, 0], starts[:, 1])[1]
        return road | {"lanes": tuple(round(float(value), 2) for value in across)}
    reach = float(trace.track_of(0)[:, ALONG].max()) + BEYOND
    shapes = []
    for lane in trace.lanes:
        points, length = _measured(lane)
        shown = points[: max(int(np.searchsorted(length, reach)) + 1, 2)]
        line = tuple((round(float(x), 2), round(float(y), 2)) for x, y in shown)
        shapes.append({"points": line, "width": float(lane.width)})
    return road | {"shapes": tuple(shapes)}


def places(style: DrivingStyle) -> tuple[Place, Place]:
    """Return the gaps from the ego to the cells ahead and behind, as in :meth:`Director._target`."""
    if not style.is_attentive:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    standing = following_gap(0.0)
    behind = (0.0, standing, round(following_gap(1.0) - standing, 3))
    return (style.least_gap + AMPLE, AMPLE, style.time_gap), behind


def _measured(lane: Lane) -> tuple[FloatArray, FloatArray]:
    end = lane.x + lane.length * np.cos(lane.heading), lane.y + lane.length * np.sin(lane.heading)
    points = np.array(lane.points or [(lane.x, lane.y), end])
    return points, np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))


# The data of a failed check for the page: its numbers, and the curve of its values with the bounds.

# On the passing side, the curve of a check ends at this multiple of the bound or of the worst violation.
REACH = 3


def check_tick(trace: Trace, check: Check | None) -> int | None:
    """Return the tick of a check's worst value, or None if it is unknown or outside the run."""
    if check is None or check.time is None or not 0 <= check.time <= trace.duration:
        return None
    return round(check.time * trace.physics_hz)


def check_view(check: Check, trace: Trace, ticks: Sequence[int]) -> View:
    """Return the data of a check that failed in a run. ``ticks`` are the ticks of the frames."""
    tick, hz = check_tick(trace, check), trace.physics_hz
    time = None if tick is None else round(tick / hz, 3)
    view: View = {
        "name": check.name,
        "unit": check.unit,
        "value": check.value if math.isfinite(check.value) else None,
        "at_most": check.at_most,
        "at_least": check.at_least,
        "time": time,
        "begin": time,
        **dict.fromkeys(("values", "broken"), ()),
        "low": 0.0,
        "high": 1.0,
        "is_cut": (False, False),
    }
    if check.values is None or len(check.values) != trace.ticks + 1:
        return view
    values, (low, high) = check.values, _axis(check, check.values)
    digits = max(4, 4 - math.floor(math.log10(high - low)))
    excess = _excess(check, values)
    spans = [range(before + 1, tick + 1) for before, tick in pairwise([-1, *ticks])]
    worst = [values[span[int(excess[span].argmax())]] for span in spans]
    broken = tuple(
        (round(first / hz, 3), round((end - 1) / hz, 3)) for first, end in stretches(excess > 0)
    )
    return view | {
        "begin": broken[0][0] if broken else time,
        "values": tuple(
            None if np.isnan(each) else round(float(each), digits)
            for each in np.clip(worst, low, high)
        ),
        "low": low,
        "high": high,
        "is_cut": (bool((values < low).any()), bool((values > high).any())),
        "broken": broken,
    }


def _excess(check: Check, values: FloatArray) -> FloatArray:
    over = [values - check.at_most] if check.at_most is not None else []
    under = [check.at_least - values] if check.at_least is not None else []
    excess: FloatArray = np.max([*over, *under], axis=0)
    return np.where(np.isnan(excess), np.inf, excess)


def _axis(check: Check, values: FloatArray) -> tuple[float, float]:
    # Show all values that break a bound, and the passing side up to REACH.
    bounds = [bound for bound in (check.at_most, check.at_least) if bound is not None]
    shown = [*values[np.isfinite(values)], *bounds]
    low, high = float(min(shown)), float(max(shown))
    broken_by = (
        max(abs(check.value - bound) for bound in bounds) if math.isfinite(check.value) else 0.0
    )
    reach = REACH * (max(broken_by, *map(abs, bounds)) or 1.0)
    if check.at_least is None:
        low = max(low, bounds[0] - reach)
    if check.at_most is None:
        high = min(high, bounds[0] + reach)
    step = 10.0 ** math.floor(math.log10(high - low or 1.0) - 0.5)
    return round(math.floor(low / step) * step, 12), round(
        max(math.ceil(high / step) * step, low + step), 12
    )


# Times that differ by less than this [s] count as equal in sentences about a check.
LITTLE = 0.05
# This number is approximate, because the page interpolates between frames.
FRAMES_PER_SECOND = 7


def finding_view(sighting: Seen, *, note: str = "", check: Check | None = None) -> View:
    """Return the data about a finding for the page, including its run, if any.

    Args:
        sighting: the finding.
        note: text to add after the headline.
        check: check that failed in the run; None if something else failed.

    Keys:
        headline, times, vehicles, road, instructions, decisions, ghost, event, check: data that the scripts draw.
        sentences: what happened, in words.
        besides: the collision of a run in which a check failed; otherwise empty.
        deed: a sentence about the ego's error; empty if the ego is not at fault.
        moment: the decision that could have avoided the failure, or the traceback of an exception.
        happened: all other known details.
        assertion: the line that failed, or the exception.
        yaml: content of the finding's file.
    """
    finding, run = sighting.finding, sighting.run
    trace = None if run is None else run.trace
    expect, headline = finding.expect, "; ".join(filter(None, [sighting.headline, note]))
    clearance = finding.world.get("clearance", CLEARANCE)
    clearance = float(clearance) if isinstance(clearance, (int, float)) else CLEARANCE
    sentences = () if run is None else sentences_of(run, expect)
    first, *others = [""] if run is None else _explained(run, (*sentences, *run.sentences[:1]))
    besides, collision = "", ""
    deed = "" if run is None else deed_of(run, sentences)
    if check is not None and run is not None:
        written, check = str(check), _with_curve(check, run.trace)
        short = _check_in_short(check, run.trace)
        said = () if written in headline else (f"{capitalised(short)}.",)
        headline = headline.replace(
            written, capitalised(short) if headline.startswith(written) else short
        )
        if sentences:  # they are about the collision, but would seem to be about the check
            besides, collision = f"{ALSO} {collision_in_short(run)}.", _prose([first, *sentences])
        sentences = (*said, *_check_sentences(check_view(check, run.trace, ())))
    if run is not None and run.ads_error is not None and headline.startswith(run.ads_error.kind):
        who = "policy" if run.ads_error.is_of_ads else "environment"
        headline = f"The {who} failed after {run.event_time:.1f} s: {headline}"
    lines = (others if check is None or besides else [first, *others]) or [expect.message]
    view = {
        "headline": headline or first or expect.message or expect.failure,
        "sentences": sentences,
        "besides": besides,
        "deed": deed,
        "moment": _moment(sighting),
        "happened": (
            *((("The collision", collision, ()),) if collision else ()),
            *_happened(lines, sighting.finding),
        ),
        "assertion": _assertion(expect),
        "road": {
            "lanes": (),
            "lane_width": 0.0,
            "speed_limit": 0.0,
            "clearance": clearance,
            "shapes": (),
        },
        **dict.fromkeys(("vehicles", "times", "decisions"), ()),
        "instructions": _instructions(trace, finding.scenario),
        "event": {"kind": str(expect.outcome), "time": expect.time, "npc": None, "side": ""},
        **dict.fromkeys(("ghost", "check")),
        "yaml": text_of(finding),
    }
    if run is None or trace is None:
        return view
    tick = check_tick(trace, check)
    ticks = frame_ticks(trace) if tick is None else sorted({*frame_ticks(trace), tick})
    return view | {
        "road": road_view(trace, clearance),
        "vehicles": _vehicles(trace, ticks),
        "times": tuple(round(tick / trace.physics_hz, 3) for tick in ticks),
        "decisions": _decisions(trace, finding.world),
        "ghost": _ghost(sighting, ticks),
        "event": {
            "kind": str(run.outcome),
            "time": round(min(run.event_time, run.duration), 3),
            "npc": run.event_npc,
            "side": "" if run.collision is None else run.collision.side,
        },
        "check": None if check is None else check_view(check, trace, ticks),
    }


def _with_curve(check: Check, trace: Trace) -> Check:
    measure = {"s": ttc, "m": gap}.get(check.unit)
    if measure is None or check.time is not None:
        return check
    # If the value is the smallest gap or time to contact of the run, the page can show the curve of that measure.
    values = np.fmin.reduce(measure(trace), axis=1, initial=np.inf)
    is_it = values.min() == check.value
    return (
        replace(check, values=values, time=float(values.argmin()) / trace.physics_hz)
        if is_it
        else check
    )


def _check_in_short(check: Check, trace: Trace) -> str:
    view = check_view(check, trace, ())
    when = (
        ""
        if view["begin"] is None
        else f" {'from' if view['broken'] else 'at'} {view['begin']:.1f} s"
    )
    return f"the check fails{when}: {replace(check, time=None)}"


def _check_sentences(check: View) -> tuple[str, ...]:
    # The headline has only the first time at which the bound is broken.
    broken, time = check["broken"], check["time"]
    if not broken or time is None:
        return ()
    first, last, times = broken[0][0], broken[-1][1], len(broken)
    worst = f"the value is worst at {time:.1f} s" if time - first >= LITTLE else ""
    often = f" {times} times," if times > 1 else ""
    until = (
        f"the bound is broken{often} until {last:.1f} s" if last - time >= LITTLE or often else ""
    )
    told = " and ".join(filter(None, [worst, until]))
    return (f"{capitalised(told)}.",) if told else ()


def _explained(run: Run, sentences: Sequence[str]) -> list[str]:
    # Omit the sentences above the picture, and the instructions, which the picture and the file show.
    lines = map(str.strip, run.explain(instructions=False).splitlines())
    return [line for line in lines if line and line not in sentences]


def _prose(lines: Sequence[str]) -> str:
    return " ".join(
        f"{capitalised(line)}{'' if line.endswith(('.', ':')) else '.'}" for line in lines
    )


def _moment(sighting: Seen) -> tuple[Paragraph, ...]:
    moment, raised = sighting.moment, sighting.finding.expect.traceback
    if moment is None:
        return (("The traceback", "", (("", tuple(raised.splitlines()[1:])),)),) if raised else ()
    listed = ["it evaluated these conditions, with these values:"] if moment.conditions else []
    return (("The moment", _prose([str(moment), *listed]), moment.conditions),)


def _happened(lines: Sequence[str], finding: Finding) -> tuple[Paragraph, ...]:
    shown: list[tuple[str, list[str]]] = [("", [*filter(None, lines)])]
    runs = "" if finding.shrunk is None else f" in {plural(finding.shrunk.rollouts, 'run')}"
    size = [f"{how}{'' if number else runs}" for number, how in enumerate(shrunk_lines(finding))]
    shown.append(("Simplified", size))
    perception = finding.perception
    shown.append(
        ("Perception", [] if perception is None else [f"found with {perception.described}"])
    )
    return tuple((title, _prose(sentences), ()) for title, sentences in shown if sentences)


def _decisions(trace: Trace, world: Mapping[str, Any]) -> tuple[Stretch, ...]:
    names = action_names(world)
    times = (tick / trace.physics_hz for tick in trace.decision_ticks)
    decided = zip(
        times, (_decided(each, names) for each in trace.actions), strict=False
    )  # the last decision may have raised
    starts = [
        (round(next(group)[0], 3), words) for words, group in groupby(decided, key=itemgetter(1))
    ]
    ends = [*starts, (round(trace.duration, 3), "")]
    return tuple((start, end, words) for (start, words), (end, _) in pairwise(ends))


def _decided(action: Any, names: Sequence[str]) -> str:
    plain = action.item() if isinstance(action, np.generic) else action
    if isinstance(plain, int) and 0 <= plain < len(names):
        return names[plain]
    if is_si(plain):
        acceleration, steering = (round(each, 2) + 0.0 for each in plain)
        return f"{acceleration:.1f} m/s^2" + (f", {steering:.2f} rad" if steering else "")
    return text_of_action(plain)


def _assertion(expect: Expect) -> str:
    if expect.check is not None:
        return f"check {expect.assertion}"
    if expect.assertion and expect.failure == AssertionError.__name__:
        return f"assert {expect.assertion.removeprefix('assert ')}"
    return f"{expect.failure}: {expect.message}" if expect.message else expect.failure


def frame_ticks(trace: Trace) -> list[int]:
    """Return the ticks of a run's frames: about seven per second, the last tick, and the tick of the collision."""
    stride = max(1, round(trace.physics_hz / FRAMES_PER_SECOND))
    ticks = {*range(0, trace.ticks + 1, stride), trace.ticks}
    if trace.collision is not None:
        ticks.add(trace.collision.tick)
    return sorted(ticks)


def _vehicles(trace: Trace, ticks: Sequence[int]) -> tuple[View, ...]:
    # The ego first. Most values have one entry per frame. In `cells`, 0 is the ego's own cell, and None means that the
    # NPC is not on the ego's path. `advantage` is the expected time between the NPC and the ego at their conflict zone.
    encounters = Encounters(trace)
    gaps, ttcs, passed, advantages = gap(trace), ttc(trace), passages(trace), time_advantage(trace)
    along, across = trace.road.drawn(trace.states[:, :, X], trace.states[:, :, Y])
    heading = trace.road.drawn_headings
    views = []
    for vehicle in range(trace.states.shape[1]):
        name, kind = f"NPC {vehicle - 1}" if vehicle else "ego", trace.vehicle_type(vehicle)
        view: View = {
            "name": name if kind == CAR else f"{name}, {kind.name}",
            "length": float(trace.sizes[vehicle, 0]),
            "width": float(trace.sizes[vehicle, 1]),
            "along": _numbers(along[ticks, vehicle], 2),
            "across": _numbers(across[ticks, vehicle], 2),
            "heading": _numbers(heading[ticks, vehicle], 3),
            "speed": _numbers(trace.states[ticks, vehicle, SPEED], 2),
            "acceleration": _numbers(trace.states[ticks, vehicle, ACCELERATION], 1),
            **dict.fromkeys(("gap", "ttc", "cells", "advantage"), ()),
            "zone": None,
        }
        if vehicle:
            npc = vehicle - 1
            is_on_way = encounters.is_on_way[npc]
            view["cells"] = tuple(
                int(encounters.cell(npc, tick) or 0) if is_on_way[tick] else None for tick in ticks
            )
            view |= {"gap": _numbers(gaps[ticks, npc], 2), "ttc": _numbers(ttcs[ticks, npc], 2)}
            passage = passed[npc]
            if passage is not None:
                view["zone"] = zone_view(passage.zone, view["length"], trace.lanes[0].width)
                view["advantage"] = _numbers(advantages[ticks, npc], 2)
        views.append(view)
    return tuple(views)


def _ghost(sighting: Seen, ticks: Sequence[int]) -> View | None:
    # The careful driver from the takeover to the impact; `first` is the index of the first frame.
    run, expect, taken = sighting.run, sighting.finding.expect, None
    if run is not None and run.take_over is not None and expect.takeover and expect.is_of(run):
        with suppress(DriverError):  # the user's world may no longer support the driver
            taken = takeovers.drive(run.trace, expect.takeover, run.take_over)
    if run is None or taken is None or not expect.takeover:
        return None
    tick = round((expect.time - expect.takeover) * run.trace.physics_hz)
    shown = [each for each in ticks if tick <= each <= taken.ticks]
    along, across = (
        each[shown, 0] for each in taken.road.drawn(taken.states[:, :, X], taken.states[:, :, Y])
    )
    return {
        "first": ticks.index(shown[0]),
        "along": _numbers(along, 2),
        "across": _numbers(across, 2),
        "heading": _numbers(taken.road.drawn_headings[shown, 0], 3),
    }


def zone_view(zone: Zone, length: float, width: float) -> View:
    """Return the path of an NPC with this length [m], and the area of its conflict zone, drawn this wide [m]."""
    if not zone.line:
        return {"name": zone.way, "way": (), "area": (), "width": 0.0}
    # An NPC's centre is in the zone while any part of it may touch a vehicle there, so the area is shorter than the
    # zone by the length of the NPC.
    line = np.array(zone.line)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    first, last = zone.npc[0] + length / 2, zone.npc[1] - length / 2
    places = np.linspace(first, max(last, first), max(round(last - first), 1) + 1)
    area = np.stack([np.interp(places, along, line[:, column]) for column in (0, 1)], axis=-1)
    return {"name": zone.way, "way": _points(line), "area": _points(area), "width": float(width)}


def _points(line: FloatArray) -> tuple[tuple[float, float], ...]:
    return tuple((round(x, 2) + 0.0, round(y, 2) + 0.0) for x, y in line.tolist())


def _instructions(trace: Trace | None, scenario: Scenario) -> tuple[View, ...]:
    # The instructions as executed, if there is a run. The repair may have changed a cell, so both `requested` and
    # `cell` are stored.
    wanted = scenario if trace is None else trace.scenario
    driven, arrivals, hz = (
        (wanted.npcs, (), 1) if trace is None else (trace.chains, trace.arrivals, trace.physics_hz)
    )
    zones = (None,) * len(wanted.npcs) if trace is None or not trace.zones else trace.zones
    views: list[View] = []
    for npc, chain in enumerate(wanted.npcs):
        begun = arrivals[npc] if npc < len(arrivals) else ()
        for gene, (requested, followed) in enumerate(zip(chain, driven[npc], strict=False)):
            tick = None if trace is None else arrival(trace, npc, gene)
            end = (gene + 1) * wanted.gene_seconds
            if followed.crosses and trace is not None:  # it continues until the end of the run
                end = max(end, trace.duration)
            apart = math.nan if trace is None else lanes_apart(trace, npc, gene)
            zone = zones[npc]
            view: View = {
                "npc": npc,
                "start": round(gene * wanted.gene_seconds, 3),
                "end": round(end, 3),
                "speed": followed.speed,
                "started": gene < len(begun),
                "arrived": None if tick is None else round(tick / hz, 3),
                **dict.fromkeys(("requested", "cell"), 0),
                **dict.fromkeys(("lane", "zone", "words"), ""),
            }
            views.append(
                {**view, **followed.shown(requested, apart, "" if zone is None else zone.whence)}
            )
    return tuple(views)


def _numbers(values: FloatArray, digits: int) -> Numbers:
    rounded = np.round(values, digits) + 0.0  # -0.0 becomes 0.0
    return tuple(float(value) if np.isfinite(value) else None for value in rounded)
