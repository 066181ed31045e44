"""The data about a finding for the report page, taken from its file and a run's trace."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from pytest_pafot.attribution import takeovers
from pytest_pafot.attribution.sentences import ALSO
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.criticality import gap, passages, time_advantage, ttc
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

Numbers = list[float | None]
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
        _, across = trace.road.drawn(starts[:, 0], starts[:, 1])
        road["lanes"] = [round(float(value), 2) for value in across]
        return road
    reach = float(trace.track_of(0)[:, ALONG].max()) + BEYOND
    road["shapes"] = [_shape(lane, reach) for lane in trace.lanes]
    return road


def places(style: DrivingStyle) -> tuple[Place, Place]:
    """Return the gaps from the ego to the cells ahead and behind, as in :meth:`Director._target`."""
    if not style.is_attentive:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    standing = following_gap(0.0)
    behind = (0.0, standing, round(following_gap(1.0) - standing, 3))
    return (style.least_gap + AMPLE, AMPLE, style.time_gap), behind


def _shape(lane: Lane, reach: float) -> View:
    # The lane up to this distance [m] from its start.
    end_x = lane.x + lane.length * np.cos(lane.heading)
    end_y = lane.y + lane.length * np.sin(lane.heading)
    points = np.array(lane.points or [(lane.x, lane.y), (end_x, end_y)])
    # A line needs two points.
    count = max(int(np.searchsorted(_lengths(points), reach)) + 1, 2)
    line = [(round(x, 2), round(y, 2)) for x, y in points[:count].tolist()]
    return {"points": line, "width": float(lane.width)}


def _lengths(line: FloatArray) -> FloatArray:
    # The distance [m] of each point from the start of the line, along the line.
    steps = np.hypot(*np.diff(line, axis=0).T)
    return np.concatenate(([0.0], np.cumsum(steps)))


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
    hz = trace.physics_hz
    tick = check_tick(trace, check)
    time = None if tick is None else round(tick / hz, 3)
    view: View = {
        "name": check.name,
        "unit": check.unit,
        "value": check.value if math.isfinite(check.value) else None,
        **check.bounds,
        "time": time,
        "begin": time,
        "values": (),
        "broken": (),
        "low": 0.0,
        "high": 1.0,
        "is_cut": (False, False),
    }
    if check.values is None or len(check.values) != trace.ticks + 1:
        return view
    values = check.values
    excess = _excess(check, values)
    # A frame shows the worst value since the frame before it.
    worst = []
    for before, tick in pairwise([-1, *ticks]):
        span = slice(before + 1, tick + 1)
        worst.append(values[span][excess[span].argmax()])
    low, high = _axis(check, values)
    # Small values need more digits, because the curve fills the height of the axis.
    magnitude = math.floor(math.log10(high - low))
    digits = max(4, 4 - magnitude)
    broken = []
    for first, end in stretches(excess > 0):
        last = end - 1
        broken.append((round(first / hz, 3), round(last / hz, 3)))
    if broken:
        view["begin"] = broken[0][0]
    shown = np.clip(worst, low, high).tolist()
    return view | {
        "values": [None if math.isnan(each) else round(each, digits) for each in shown],
        "low": low,
        "high": high,
        "is_cut": (bool((values < low).any()), bool((values > high).any())),
        "broken": broken,
    }


def _excess(check: Check, values: FloatArray) -> FloatArray:
    # How far each value is beyond a bound, which is infinite for NaN.
    excess = np.full(len(values), -np.inf)
    if check.at_most is not None:
        excess = np.maximum(excess, values - check.at_most)
    if check.at_least is not None:
        excess = np.maximum(excess, check.at_least - values)
    return np.where(np.isnan(excess), np.inf, excess)


def _axis(check: Check, values: FloatArray) -> tuple[float, float]:
    # Show all values that break a bound, and the passing side up to REACH.
    bounds = [bound for bound in (check.at_most, check.at_least) if bound is not None]
    shown = [*values[np.isfinite(values)], *bounds]
    low, high = float(min(shown)), float(max(shown))
    sizes = [abs(bound) for bound in bounds]
    if math.isfinite(check.value):
        sizes += [abs(check.value - bound) for bound in bounds]
    reach = REACH * (max(sizes) or 1.0)
    if check.at_least is None:
        low = max(low, bounds[0] - reach)
    if check.at_most is None:
        high = min(high, bounds[0] + reach)
    step = 10.0 ** math.floor(math.log10(high - low or 1.0) - 0.5)
    most = max(math.ceil(high / step) * step, low + step)
    return round(math.floor(low / step) * step, 12), round(most, 12)


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
    expect = finding.expect
    headline = "; ".join(filter(None, [sighting.headline, note]))
    clearance = finding.world.get("clearance")
    if not isinstance(clearance, (int, float)):
        clearance = CLEARANCE
    view: View = {
        "times": (),
        "vehicles": (),
        "road": {
            "lanes": (),
            "lane_width": 0.0,
            "speed_limit": 0.0,
            "clearance": float(clearance),
            "shapes": (),
        },
        "instructions": [],
        "decisions": (),
        "ghost": None,
        "event": {"kind": str(expect.outcome), "time": expect.time, "npc": None, "side": ""},
        "check": None,
        "sentences": (),
        "besides": "",
        "deed": "",
        "moment": _moment(sighting),
        "assertion": _assertion(expect),
        "yaml": text_of(finding),
    }
    if run is None:
        view["instructions"] = _instructions(None, finding.scenario)
        lines = [] if check is None else [""]
        return view | _in_words(headline, lines, "", finding)
    trace = run.trace
    sentences = sentences_of(run, expect)
    first, *lines = _explained(run, (*sentences, *run.sentences[:1]))
    view["deed"] = deed_of(run, sentences)
    collision = ""
    ticks = frame_ticks(trace)
    if check is not None:
        written = str(check)
        check = _with_curve(check, trace)
        tick = check_tick(trace, check)
        if tick is not None:  # a frame shows the worst value
            ticks = sorted({*ticks, tick})
        view["check"] = check_view(check, trace, ticks)
        short = _check_in_short(check, view["check"])
        told = _check_sentences(view["check"])
        # The headline states the check with its full text, which the picture shows, too.
        if written not in headline:
            told.insert(0, f"{capitalised(short)}.")
        elif headline.startswith(written):
            short = capitalised(short)
        headline = headline.replace(written, short)
        if sentences:  # They are about the collision, but would seem to be about the check.
            view["besides"] = f"{ALSO} {collision_in_short(run)}."
            collision = _prose([first, *sentences])
        else:
            lines.insert(0, first)
        sentences = tuple(told)
    if run.ads_error is not None and headline.startswith(run.ads_error.kind):
        who = "policy" if run.ads_error.is_of_ads else "environment"
        headline = f"The {who} failed after {run.event_time:.1f} s: {headline}"
    side = ""
    if run.collision is not None:
        side = run.collision.side
    return view | {
        **_in_words(headline or first, lines, collision, finding),
        "sentences": sentences,
        "instructions": _instructions(trace, trace.scenario),
        "road": road_view(trace, float(clearance)),
        "vehicles": _vehicles(trace, ticks),
        "times": [round(tick / trace.physics_hz, 3) for tick in ticks],
        "decisions": _decisions(trace, finding.world),
        "ghost": _ghost(sighting, ticks),
        "event": {
            "kind": str(run.outcome),
            "time": round(min(run.event_time, run.duration), 3),
            "npc": run.event_npc,
            "side": side,
        },
    }


def _in_words(headline: str, lines: Sequence[str], collision: str, finding: Finding) -> View:
    expect = finding.expect
    told = _prose(lines or [expect.message])
    shown = [("The collision", collision), ("", told)]
    size = shrunk_lines(finding)
    if size and finding.shrunk is not None:
        size[0] += f" in {plural(finding.shrunk.rollouts, 'run')}"
    shown.append(("Simplified", _prose(size)))
    if finding.perception is not None:
        shown.append(("Perception", _prose([f"found with {finding.perception.described}"])))
    return {
        "headline": headline or expect.message or expect.failure,
        "happened": [(title, text, ()) for title, text in shown if text],
    }


def _with_curve(check: Check, trace: Trace) -> Check:
    measure = {"s": ttc, "m": gap}.get(check.unit)
    if measure is None or check.time is not None:
        return check
    # If the value is the smallest gap or time to contact of the run, the page can show the curve of that measure.
    # the smallest value over all NPCs, in each tick
    values = np.fmin.reduce(measure(trace), axis=1, initial=np.inf)
    if values.min() != check.value:
        return check
    time = float(values.argmin()) / trace.physics_hz
    return replace(check, values=values, time=time)


def _check_in_short(check: Check, view: View) -> str:
    when = ""
    if view["broken"]:
        when = f" from {view['begin']:.1f} s"
    elif view["begin"] is not None:
        when = f" at {view['begin']:.1f} s"
    return f"the check fails{when}: {replace(check, time=None)}"


def _check_sentences(check: View) -> list[str]:
    # The headline has only the first time at which the bound is broken.
    broken, time = check["broken"], check["time"]
    if not broken or time is None:
        return []
    first, last = broken[0][0], broken[-1][1]
    told = []
    if time - first >= LITTLE:
        told.append(f"the value is worst at {time:.1f} s")
    if len(broken) > 1:
        told.append(f"the bound is broken {len(broken)} times, until {last:.1f} s")
    elif last - time >= LITTLE:
        told.append(f"the bound is broken until {last:.1f} s")
    return [f"{capitalised(' and '.join(told))}."] if told else []


def _explained(run: Run, sentences: Sequence[str]) -> list[str]:
    # Omit the sentences above the picture, and the instructions, which the picture and the file show.
    lines = map(str.strip, run.explain(instructions=False).splitlines())
    return [line for line in lines if line and line not in sentences]


def _prose(lines: Iterable[str]) -> str:
    sentences = []
    for line in filter(None, lines):
        end = "" if line.endswith((".", ":")) else "."
        sentences.append(capitalised(line) + end)
    return " ".join(sentences)


def _moment(sighting: Seen) -> list[Paragraph]:
    moment, raised = sighting.moment, sighting.finding.expect.traceback
    if moment is not None:
        listed = [str(moment)]
        if moment.conditions:
            listed.append("it evaluated these conditions, with these values:")
        return [("The moment", _prose(listed), moment.conditions)]
    if raised:
        lines = tuple(raised.splitlines()[1:])
        return [("The traceback", "", (("", lines),))]
    return []


def _decisions(trace: Trace, world: Mapping[str, Any]) -> list[Stretch]:
    names = action_names(world)
    times = [tick / trace.physics_hz for tick in trace.decision_ticks]
    words = [_decided(each, names) for each in trace.actions]
    starts = []
    # the last decision may have raised
    for told, group in groupby(zip(times, words, strict=False), key=itemgetter(1)):
        starts.append((round(next(group)[0], 3), told))
    ends = [*starts, (round(trace.duration, 3), "")]
    return [(start, end, told) for (start, told), (end, _) in pairwise(ends)]


def _decided(action: Any, names: Sequence[str]) -> str:
    plain = action.item() if isinstance(action, np.generic) else action
    if isinstance(plain, int) and 0 <= plain < len(names):
        return names[plain]
    if not is_si(plain):
        return text_of_action(plain)
    # -0.0 becomes 0.0.
    acceleration, steering = (round(each, 2) + 0.0 for each in plain)
    decided = f"{acceleration:.1f} m/s^2"
    if steering:
        decided += f", {steering:.2f} rad"
    return decided


def _assertion(expect: Expect) -> str:
    if expect.check is not None:
        return f"check {expect.assertion}"
    if expect.assertion and expect.failure == AssertionError.__name__:
        return f"assert {expect.assertion.removeprefix('assert ')}"
    return ": ".join(filter(None, [expect.failure, expect.message]))


def frame_ticks(trace: Trace) -> list[int]:
    """Return the ticks of a run's frames: about seven per second, the last tick, and the tick of the collision."""
    stride = max(1, round(trace.physics_hz / FRAMES_PER_SECOND))
    ticks = {*range(0, trace.ticks + 1, stride), trace.ticks}
    if trace.collision is not None:
        ticks.add(trace.collision.tick)
    return sorted(ticks)


def _vehicles(trace: Trace, ticks: Sequence[int]) -> list[View]:
    # The ego first. Most values have one entry per frame. In `cells`, 0 is the ego's own cell, and None means that the
    # NPC is not on the ego's path. `advantage` is the expected time between the NPC and the ego at their conflict zone.
    states = trace.states[ticks]
    along, across = trace.road.drawn(states[:, :, X], states[:, :, Y])
    heading = trace.road.drawn_headings[ticks]
    road = trace.road
    ego_length = float(trace.sizes[0, 0])
    gaps = gap(trace)[ticks]
    times = ttc(trace)[ticks]
    advantages = time_advantage(trace)[ticks]
    passed = passages(trace)
    views = []
    for vehicle in range(trace.states.shape[1]):
        npc = vehicle - 1
        name = "ego" if vehicle == 0 else f"NPC {npc}"
        kind = trace.vehicle_type(vehicle)
        if kind != CAR:
            name += f", {kind.name}"
        view: View = {
            "name": name,
            "length": float(trace.sizes[vehicle, 0]),
            "width": float(trace.sizes[vehicle, 1]),
            "along": _numbers(along[:, vehicle], 2),
            "across": _numbers(across[:, vehicle], 2),
            "heading": _numbers(heading[:, vehicle], 3),
            "speed": _numbers(states[:, vehicle, SPEED], 2),
            "acceleration": _numbers(states[:, vehicle, ACCELERATION], 1),
            **dict.fromkeys(("gap", "ttc", "cells", "advantage"), ()),
            "zone": None,
        }
        views.append(view)
        if vehicle == 0:
            continue
        is_on_way = road.is_on_way[npc]
        view["cells"] = [
            int(road.cell(npc, tick, ego_length) or 0) if is_on_way[tick] else None
            for tick in ticks
        ]
        view["gap"] = _numbers(gaps[:, npc], 2)
        view["ttc"] = _numbers(times[:, npc], 2)
        passage = passed[npc]
        if passage is not None:
            view["zone"] = zone_view(passage.zone, view["length"], trace.lanes[0].width)
            view["advantage"] = _numbers(advantages[:, npc], 2)
    return views


def _ghost(sighting: Seen, ticks: Sequence[int]) -> View | None:
    # The careful driver from the takeover to the impact; `first` is the index of the first frame.
    run, expect = sighting.run, sighting.finding.expect
    if run is None or run.take_over is None or not expect.takeover or not expect.is_of(run):
        return None
    try:
        taken = takeovers.drive(run.trace, expect.takeover, run.take_over)
    except DriverError:  # the user's world may no longer support the driver
        return None
    if taken is None:
        return None
    tick = round((expect.time - expect.takeover) * run.trace.physics_hz)
    shown = [each for each in ticks if tick <= each <= taken.ticks]
    ego = taken.states[shown, 0]
    along, across = taken.road.drawn(ego[:, X], ego[:, Y])
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
    along = _lengths(line)
    first = zone.npc[0] + length / 2
    last = zone.npc[1] - length / 2
    count = max(round(last - first), 1) + 1
    places = np.linspace(first, max(last, first), count)
    area = np.stack([np.interp(places, along, column) for column in line.T], axis=-1)
    return {
        "name": zone.way,
        "way": _points(line),
        "area": _points(area),
        "width": float(width),
    }


def _points(line: FloatArray) -> list[tuple[float, float]]:
    return [(round(x, 2) + 0.0, round(y, 2) + 0.0) for x, y in line.tolist()]


def _instructions(trace: Trace | None, scenario: Scenario) -> list[View]:
    # The instructions as executed, if there is a run. The repair may have changed a cell, so both `requested` and
    # `cell` are stored.
    views: list[View] = []
    for npc, chain in enumerate(scenario.npcs):
        followed = chain if trace is None else trace.chains[npc]
        for gene, (requested, executed) in enumerate(zip(chain, followed, strict=False)):
            end = (gene + 1) * scenario.gene_seconds
            view: View = {
                "npc": npc,
                "start": round(gene * scenario.gene_seconds, 3),
                "end": round(end, 3),
                "speed": executed.speed,
                "started": False,
                "arrived": None,
                "requested": 0,
                "cell": 0,
                "lane": "",
                "zone": "",
                "words": "",
            }
            views.append(view)
            if trace is None:
                view |= executed.shown(requested, math.nan, "")
                continue
            if executed.crosses:  # it continues until the end of the run
                view["end"] = round(max(end, trace.duration), 3)
            if npc < len(trace.arrivals):
                view["started"] = gene < len(trace.arrivals[npc])
            tick = arrival(trace, npc, gene)
            if tick is not None:
                view["arrived"] = round(tick / trace.physics_hz, 3)
            zone = trace.zones[npc] if trace.zones else None
            whence = ""
            if zone is not None:
                whence = zone.whence
            view |= executed.shown(requested, lanes_apart(trace, npc, gene), whence)
    return views


def _numbers(values: FloatArray, digits: int) -> Numbers:
    rounded = np.round(values, digits) + 0.0  # -0.0 becomes 0.0
    return [float(value) if np.isfinite(value) else None for value in rounded]
