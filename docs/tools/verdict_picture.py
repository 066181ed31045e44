"""Draw the picture of explanation/verdicts.md from a situation of the tests, at three moments.

Run it after a change of the situation or the rules: ``python docs/tools/verdict_picture.py``. It needs only the plugin.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[1]
sys.path.insert(0, str(DOCS.parent))

from pytest_pafot.attribution.responsibility import rss_rule  # noqa: E402
from pytest_pafot.model.trace import HEADING, LANE, SPEED, FloatArray, Trace, X, Y  # noqa: E402
from tests.helpers.situations import SITUATIONS  # noqa: E402

NAME = "cut-in-3-m-and-brakes"
PICTURE = DOCS / "explanation" / "verdicts" / f"{NAME}.svg"

WIDTH, LINE, MARGIN = 460, 15, 4
"""Width of the picture, height of a line of text in it, and margin around both [px]."""
ROAD, LANE_WIDTH, BORDER = 90.0, 4.0, 0.8
"""Length of the road that is drawn, width of a lane, and space next to the lanes [m]."""
CHANGE = 0.1
"""A vehicle moves sideways [m] or changes its speed [m/s] if the change exceeds this."""
COLOURS = ("#5aa9ff", "#ffa64d")
"""Colours of the ego and of the NPC."""
STROKES = (
    'stroke="#59616b" stroke-width="4.2"',
    'stroke="#e8eaed" stroke-width="4.2" stroke-dasharray="3 5"',
    'stroke="#59616b" stroke-width="3.8"',
)
"""Strokes of a lane. It is drawn three times along its centre line: its border, its dashed lines, its inside."""


def picture() -> str:
    """Return the picture as SVG: the first change, the moment that decides, and the impact."""
    (situation,) = (each for group in SITUATIONS.values() for each in group if each.name == NAME)
    trace = situation.trace()
    changes = (
        np.abs(trace.states[:, :, [Y, SPEED]] - trace.states[0, :, [Y, SPEED]].T).max(axis=(1, 2))
        > CHANGE
    )
    ticks = [int(changes.argmax()), rss_rule(trace).tick or 0, trace.ticks]
    lanes = sorted(
        {trace.lanes[int(lane)].y for tick in ticks for lane in trace.states[tick, :, LANE]}
    )
    top, height = lanes[0] - LANE_WIDTH / 2 - BORDER, lanes[-1] - lanes[0] + LANE_WIDTH + 2 * BORDER
    left = -(ROAD - float(np.ptp(trace.states[ticks][:, :, X] - trace.states[ticks][:, :1, X]))) / 2
    pixels, parts, y = round(height * WIDTH / ROAD), [], MARGIN
    road = "".join(f"M{left:.1f} {lane:.1f}H{left + ROAD:.1f}" for lane in lanes)
    for tick in ticks:
        parts.append(f'<text x="{MARGIN}" y="{y + LINE - 4}">{_caption(trace, tick)}</text>')
        y += LINE
        view = f'viewBox="{left:.1f} {top:.1f} {ROAD:.1f} {height:.1f}"'
        lines = "".join(f'<path d="{road}" {stroke}/>' for stroke in STROKES)
        states = trace.states[tick]
        cars = "".join(
            _car(each, states[0, X], colour) for each, colour in zip(states, COLOURS, strict=True)
        )
        hit = _impact(states) if tick == trace.ticks else ""
        parts.append(
            f'<svg y="{y}" width="{WIDTH}" height="{pixels}" {view} fill="none">{lines}{cars}{hit}</svg>'
        )
        y += pixels + MARGIN
    size = f'viewBox="0 0 {WIDTH} {y}" width="{WIDTH}" height="{y}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="11" fill="#e8eaed">\n'
        f'<rect width="{WIDTH}" height="{y}" rx="5" fill="#2b3037"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _car(state: FloatArray, ego_x: float, colour: str) -> str:
    turn = f"rotate({np.degrees(state[HEADING]):.1f})"
    place = f"translate({state[X] - ego_x:.1f} {state[Y]:.1f}) {turn}"
    return f'<path d="M-2.5-1h4.2l.8.5v1l-.8.5h-4.2z" fill="{colour}" transform="{place}"/>'


def _impact(states: FloatArray) -> str:
    """Draw a ring around the ego's front, which hits the NPC."""
    return f'<circle cx="2.5" cy="{states[0, Y]:.1f}" r="1.7" stroke="#ff5c5c" stroke-width=".6"/>'


def _caption(trace: Trace, tick: int) -> str:
    named = zip(("ego", "NPC"), COLOURS, trace.states[tick, :, SPEED], strict=True)
    spans = (
        f'<tspan dx="9" fill="{colour}">{name} {speed:.1f} m/s</tspan>'
        for name, colour, speed in named
    )
    return f"{tick / trace.physics_hz:.1f} s{''.join(spans)}"


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8", newline="\n")
