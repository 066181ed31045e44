"""Write the table of explanation/gallery.md, its pictures, and the reasons of all verdicts, from the tests' situations.

Run it after a change of the situations or the rules: ``python docs/tools/gallery.py``. It needs only the plugin. The
page shows the first situation below each heading with each verdict. The reasons of all situations are in
tests/attribution/gallery.txt, where a change of the rules shows what it changes.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

DOCS = Path(__file__).parents[1]
sys.path.insert(0, str(DOCS.parent))

from pytest_pafot.attribution.responsibility import rss_rule  # noqa: E402
from pytest_pafot.model.trace import ACROSS, ANGLE, HEADING, LANE, SPEED, FloatArray, Lane, Trace, X, Y  # noqa: E402
from tests.helpers.situations import SITUATIONS, Situation  # noqa: E402

PAGE = DOCS / "explanation" / "gallery.md"
PICTURES = PAGE.with_suffix("")
REASONS = DOCS.parent / "tests" / "attribution" / "gallery.txt"

WIDTH, LINE, MARGIN = 460, 15, 4
"""Width of a picture, height of a line of text in it, and margin around both [px]."""
LEAST_WAY, MOST_WAY, FARTHEST = 90.0, 170.0, 140.0
"""Least and greatest length of road in a picture, and greatest distance of a drawn vehicle from the ego [m]."""
AROUND = 27.0
"""Distance around an impact that is drawn if ways meet [m]."""
MOST_ACROSS = 40.0
"""Greatest distance of a drawn lane from the ego's way [m]. It is needed because a circle returns to its start."""
LANES_BESIDE = 0.8
"""Space that is drawn next to the lanes in use [m]."""
LITTLE = 0.1
"""Moments that are less than this apart are one [s]. Smaller changes of place [m] or speed [m/s] are ignored."""
COLOURS = ("#5aa9ff", "#ffa64d", "#c9ced6")
"""Colours of the ego, of the vehicle that it touches, and of all others."""

STROKES = (
    'stroke="#59616b" stroke-width="4.2"',
    'stroke="#e8eaed" stroke-width="4.2" stroke-dasharray="3 5"',
    'stroke="#59616b" stroke-width="3.8"',
)
"""Strokes of a lane. It is drawn three times along its centre line: its border, its dashed lines, its inside."""

_TABLE = re.compile(r"(<!-- generated: gallery -->\n).*?(<!-- end of generated -->)", re.DOTALL)


class Box(NamedTuple):
    """A vehicle as it is drawn: its place along and across the road from the ego's [m] and its angle [deg]."""

    along: float
    across: float
    angle: float
    speed: float


def written(page: str) -> str:
    """Return a page with the present table in it."""
    return _TABLE.sub(lambda found: f"{found[1]}{''.join(_rows())}{found[2]}", page)


def pictures() -> dict[str, str]:
    """Return the text of every picture, by the name of its file."""
    return {f"{each.name}.svg": picture(each.trace()) for group in shown().values() for each in group}


def shown() -> dict[str, list[Situation]]:
    """Return the situations on the page by heading: the first with each verdict."""
    on_page: dict[str, dict[str, Situation]] = {}
    for heading, group in SITUATIONS.items():
        first = on_page.setdefault(heading, {})
        for each in group:
            first.setdefault(each.responsibility, each)
    return {heading: [*first.values()] for heading, first in on_page.items()}


def _rows() -> Iterator[str]:
    for heading, group in shown().items():
        yield f"\n## {heading}\n\n| What happens | Verdict |\n| --- | --- |\n"
        for situation in group:
            image = f"![{situation.name}](gallery/{situation.name}.svg)"
            yield f"| {image}<br>{situation.text} | {_verdict(situation)} |\n"
    yield "\n"


def _verdict(situation: Situation) -> str:
    found = rss_rule(situation.trace())
    fault = f"<br>`{found.fault}`" if found.fault else ""
    return f"**{found.responsibility}**{fault}<br>rule {situation.rule}"


def reasons() -> str:
    """Return the verdict and the whole reason of every situation, one per line."""
    every = ((each, rss_rule(each.trace())) for group in SITUATIONS.values() for each in group)
    return "".join(
        f"{each.name}: {it.responsibility}, {it.fault or 'no fault'}: {' '.join(it.sentences)}\n" for each, it in every
    )


def picture(trace: Trace) -> str:
    """Draw the road at three moments: when it begins, when it is decided, and at the impact."""
    return _junction(trace) if trace.zones else _road_picture(trace)


def _junction(trace: Trace) -> str:
    """Draw a place where ways meet at three moments, side by side, from above. The ego comes from the left."""
    pixels = (WIDTH - 4 * MARGIN) // 3
    middle, direction = trace.states[-1, 0, [X, Y]], float(trace.states[0, 0, HEADING])
    lines = (_turned(*(np.array(lane.points) - middle).T, direction) for lane in dict.fromkeys(trace.lanes))
    road = "".join(map(_around, lines))
    parts = [f'<defs><path id="r" d="{road}"/></defs>']
    for number, tick in enumerate(_moments_at_junction(trace)):
        states = trace.states[tick]
        along, across = _turned(*(states[:, [X, Y]] - middle).T, direction)
        angles = np.degrees(np.remainder(states[:, HEADING] - direction + np.pi, 2 * np.pi) - np.pi)
        strip = [Box(*map(float, each)) for each in zip(along, across, angles, states[:, SPEED], strict=True)]
        left = MARGIN + number * (pixels + MARGIN)
        speeds = (f"{box.speed:.1f} m/s" for box in strip[:2])
        written = "".join(
            f'<tspan dx="7" fill="{colour}">{text}</tspan>' for text, colour in zip(speeds, COLOURS, strict=False)
        )
        parts.append(f'<text x="{left}" y="{MARGIN + LINE - 4}">{tick / trace.physics_hz:.1f} s{written}</text>')
        roads = "".join(f'<use href="#r" {stroke}/>' for stroke in STROKES)
        cars = "".join(_car(box, COLOURS[min(each, 2)]) for each, box in enumerate(strip) if _is_seen(box))
        hit = _impact(strip) if tick == trace.ticks else ""
        size = f'x="{left}" y="{MARGIN + LINE}" width="{pixels}" height="{pixels}"'
        view = f'viewBox="{-AROUND:.0f} {-AROUND:.0f} {2 * AROUND:.0f} {2 * AROUND:.0f}"'
        parts.append(f'<svg {size} {view} fill="none">{roads}{cars}{hit}</svg>')
    return _svg(parts, pixels + LINE + 2 * MARGIN)


def _moments_at_junction(trace: Trace) -> list[int]:
    """Return three ticks: two seconds before the one that the reason names, that one, and the impact.

    The first two are not far from the impact.
    """
    end, second = trace.ticks, trace.physics_hz
    named = min(rss_rule(trace).tick or 0, end - 2)
    if rss_rule(trace).tick == end:
        named = end - second
    first = max(named - 2 * second, end - 4 * second, 0)
    return [first, named if named > first else (first + end) // 2, end]


def _around(points: tuple[FloatArray, FloatArray]) -> str:
    """Return the part of a line that is visible around the impact."""
    along, across = points
    near = np.flatnonzero((np.abs(along) < AROUND + 3) & (np.abs(across) < AROUND + 3))
    if not near.size:
        return ""
    steps = sorted({near[0], *near[::3], near[-1]})
    return "M" + "L".join(f"{along[step]:.1f} {across[step]:.1f}" for step in steps)


def _is_seen(box: Box) -> bool:
    return max(abs(box.along), abs(box.across)) < AROUND + 3


def _svg(parts: list[str], height: int) -> str:
    size = f'viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="11" fill="#e8eaed">\n'
        '<defs><path id="c" d="M-2.5-1h4.2l.8.5v1l-.8.5h-4.2z"/></defs>\n'
        f'<rect width="{WIDTH}" height="{height}" rx="5" fill="#2b3037"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


def _road_picture(trace: Trace) -> str:
    shown = moments(trace)
    strips = [boxes(trace, tick) for tick in shown]
    along = [box.along for strip in strips for box in strip if abs(box.along) < FARTHEST]
    along += [end for tick in shown for end in _ends(trace, tick)]
    spare = max(LEAST_WAY - (max(along) - min(along)), 16.0) / 2
    left, way = min(along) - spare, min(max(along) - min(along) + 2 * spare, MOST_WAY)
    across = [lane for tick in shown for lane in _lanes_used(trace, tick)]
    top, height = min(across) - 2 - LANES_BESIDE, max(across) - min(across) + 4 + 2 * LANES_BESIDE
    pixels = round(height * WIDTH / way)
    parts, y = [], MARGIN
    for tick, strip in zip(shown, strips, strict=True):
        parts.append(f'<text x="{MARGIN}" y="{y + LINE - 4}">{_caption(tick / trace.physics_hz, strip)}</text>')
        y += LINE
        view = f'viewBox="{left:.1f} {top:.1f} {way:.1f} {height:.1f}"'
        name = f"r{len(parts)}"
        road = f'<path id="{name}" d="{_road(trace, tick, left, left + way)}"/>'
        lines = "".join(f'<use href="#{name}" {stroke}/>' for stroke in STROKES)
        cars = "".join(_car(box, COLOURS[min(number, 2)]) for number, box in enumerate(strip))
        hit = _impact(strip) if tick == trace.ticks else ""
        size = f'width="{WIDTH}" height="{pixels}"'
        parts.append(f'<svg y="{y}" {size} {view} fill="none"><defs>{road}</defs>{lines}{cars}{hit}</svg>')
        y += pixels + MARGIN
    return _svg(parts, y)


def moments(trace: Trace) -> list[int]:
    """Return three ticks: the first change, the one that the reason names or one halfway, and the impact."""
    end, little = trace.ticks, round(LITTLE * trace.physics_hz)
    named = rss_rule(trace).tick or 0
    changes = np.abs(trace.states[:, :, [Y, SPEED]] - trace.states[0, :, [Y, SPEED]].T).max(axis=(1, 2)) > LITTLE
    begins = int(changes.argmax()) if trace.track is None and changes.any() else named
    first = max(min(begins, named, end - 4 * little), 0)
    return [first, named if first + little <= named <= end - little else (first + end) // 2, end]


def boxes(trace: Trace, tick: int) -> list[Box]:
    """Return all vehicles at a tick."""
    x, y, direction = _place(trace, tick)
    states = trace.states[tick]
    along, across = _turned(states[:, X] - x, states[:, Y] - y, direction)
    angles = np.degrees(states[:, HEADING] - direction)
    return [Box(*map(float, each)) for each in zip(along, across, angles, states[:, SPEED], strict=True)]


def _place(trace: Trace, tick: int) -> tuple[float, float, float]:
    """Return the ego's place along the road: x and y on the first lane or on its way [m], and the direction [rad]."""
    ego = trace.ego[tick]
    if trace.track is None or not trace.lanes[0].points:
        return float(ego[X]), trace.lanes[0].y, trace.lanes[0].heading
    across, angle = trace.track[tick, 0, [ACROSS, ANGLE]]
    direction = ego[HEADING] - angle
    return float(ego[X] + across * np.sin(direction)), float(ego[Y] - across * np.cos(direction)), float(direction)


def _turned(x: FloatArray, y: FloatArray, direction: float) -> tuple[FloatArray, FloatArray]:
    cos, sin = np.cos(direction), np.sin(direction)
    return x * cos + y * sin, y * cos - x * sin


def _lanes_used(trace: Trace, tick: int) -> list[float]:
    """Return the centres of the lanes in use; in bends, fixed limits around the ego's way [m]."""
    if trace.lanes[0].points:
        return [-5.0, 8.0]
    return [trace.lanes[int(lane)].y for lane in trace.states[tick, :, LANE]]


def _ends(trace: Trace, tick: int) -> Iterator[float]:
    """Yield the distances to the ends of lanes ahead on a straight road, if they are visible [m]."""
    ends = (lane.x + lane.length - trace.ego[tick, X] for lane in trace.lanes if not lane.points)
    return (float(end) for end in ends if 0 < end < LEAST_WAY)


def _road(trace: Trace, tick: int, left: float, right: float) -> str:
    """Return the visible parts of the lanes' centre lines."""
    x, y, direction = _place(trace, tick)
    return "".join(_line(_turned(*(_points(lane, left) - (x, y)).T, direction), left, right) for lane in trace.lanes)


def _points(lane: Lane, left: float) -> FloatArray:
    straight = [(min(lane.x, left) - 1e3, lane.y), (lane.x + lane.length, lane.y)]
    return np.array(lane.points or straight)


def _line(points: tuple[FloatArray, FloatArray], left: float, right: float) -> str:
    along, across = points
    near = np.flatnonzero((along[1:] > left) & (along[:-1] < right) & (np.abs(across[1:]) < MOST_ACROSS))
    if not near.size:
        return ""
    along, across = (each[near[0] : near[-1] + 2] for each in points)
    steps = [max(along[0], left), *along[1:-1], min(along[-1], right)]
    return "M" + "L".join(f"{step:.1f} {np.interp(step, along, across):.1f}" for step in steps)


def _car(box: Box, colour: str) -> str:
    turn = f" rotate({box.angle:.1f})" if abs(box.angle) > 0.05 else ""
    return f'<use href="#c" fill="{colour}" transform="translate({box.along:.1f} {box.across:.1f}){turn}"/>'


def _impact(strip: list[Box]) -> str:
    """Draw a ring around the point of the ego that is nearest to the centre of the other."""
    ego, npc = strip[:2]
    angle = np.radians(ego.angle)
    ahead, right = _turned(np.array(npc.along - ego.along), np.array(npc.across - ego.across), angle)
    x, y = _turned(np.clip(ahead, -2.5, 2.5), np.clip(right, -1.0, 1.0), -angle)
    return f'<circle cx="{ego.along + x:.1f}" cy="{ego.across + y:.1f}" r="1.7" stroke="#ff5c5c" stroke-width=".6"/>'


def _caption(time: float, strip: list[Box]) -> str:
    ego, npc = strip[:2]
    far = f", {abs(npc.along):.0f} m {'ahead' if npc.along > 0 else 'behind'}" if abs(npc.along) > FARTHEST else ""
    speeds = (f"ego {ego.speed:.1f} m/s", f"NPC {npc.speed:.1f} m/s{far}")
    written = (f'<tspan dx="9" fill="{colour}">{text}</tspan>' for text, colour in zip(speeds, COLOURS, strict=False))
    return f"{time:.1f} s{''.join(written)}"


def main() -> None:
    """Write the page, the reasons and the pictures, and remove pictures that belong to no situation."""
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8", newline="\n")
    REASONS.write_text(reasons(), encoding="utf-8", newline="\n")
    made = pictures()
    PICTURES.mkdir(exist_ok=True)
    for path in set(PICTURES.iterdir()) - {PICTURES / name for name in made}:
        path.unlink()
    for name, text in made.items():
        (PICTURES / name).write_text(text, encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
