"""Maps in a terminal, on a page, in a notebook, and as a picture."""

from __future__ import annotations

import io
import json
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from pytest_pafot import Trace
from pytest_pafot.extending import HEADING, SPEED, X, Y
from pytest_pafot.extras.sweeps.maps import KINDS, MARKS, MEANINGS, Kind, Sweep, short
from pytest_pafot.support.errors import RequestError, install
from pytest_pafot.support.markup import content_hash, json_in_script
from pytest_pafot.support.text import wrapped_to

COLOURS: dict[Kind, str] = {
    "avoided": "#8cc5a2",
    "preventable": "#c0392b",
    "unavoidable": "#5d6770",
    "ADS error": "#1d1f21",
    "not as asked": "#ffffff",
}
"""The colours of a picture, which differ in lightness, too."""

LEGEND: dict[Kind, str] = MEANINGS | {
    "preventable": "failed, though a reference driver avoids it",
    "unavoidable": "failed, and no reference driver avoids it",
    "not as asked": "not as asked: it says nothing about the policy",
}
"""The meanings of the colours, in words that need no manual."""
HATCH = "///"
"""The pattern of points that were not as asked: they are white, as is what is no point."""

FRAMES_PER_SECOND = 10
"""The largest number of frames of a run on a page [1/s]."""
MOST_PLAYED = 400
"""The largest number of points of a page that can be played, those that fail first: each takes some kilobytes."""


def png(sweep: Sweep) -> bytes:
    """Return a map as a PNG.

    Raises:
        RequestError: if matplotlib is not installed.
    """
    try:
        from matplotlib.colors import ListedColormap  # noqa: PLC0415  (an extra)
        from matplotlib.figure import Figure  # noqa: PLC0415
        from matplotlib.patches import Patch, Rectangle  # noqa: PLC0415
    except ImportError:
        raise RequestError(f"png: expected matplotlib to be installed; {install('compare')}") from None
    rows = sweep.axes[0] if len(sweep.axes) == 2 else None
    columns = sweep.axes[-1]
    grid = np.array([KINDS.index(point.kind) for point in sweep.points]).reshape(-1, len(columns.values))
    title = [
        part
        for line in (": ".join(filter(None, [sweep.name, sweep.about])), sweep.headline, *sweep.on_islands())
        for part in wrapped_to(line, 75, phrases=True)
    ]
    height = 2.2 + 0.15 * len(title) + min(0.32 * len(grid), 12)
    figure = Figure(figsize=(6, height), layout="constrained", dpi=240)
    axes = figure.add_subplot()
    colours = ListedColormap([COLOURS[kind] for kind in KINDS])
    axes.pcolormesh(grid, cmap=colours, vmin=-0.5, vmax=len(KINDS) - 0.5, edgecolors="#d8dbdd", linewidth=0.6)
    for row, column in np.argwhere(grid == KINDS.index("not as asked")):
        axes.add_patch(Rectangle((column, row), 1, 1, fill=False, hatch=HATCH, ec="#5d6770", linewidth=0))
    axes.set_xticks(*_ticks(columns.values), rotation=45)
    axes.set_xlabel(columns.words)
    axes.set_yticks(*(_ticks(rows.values) if rows else ([], [])))
    axes.set_ylabel(rows.words if rows else "")
    axes.set_title("\n".join(title), fontsize="small", parse_math=False)
    hatches = {kind: HATCH if kind == "not as asked" else None for kind in sweep.legend}
    patches = [
        Patch(fc=COLOURS[kind], ec="#5d6770", hatch=hatch, label=LEGEND[kind]) for kind, hatch in hatches.items()
    ]
    figure.legend(handles=patches, loc="outside lower center", fontsize="small")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _ticks(values: tuple[float, ...]) -> tuple[list[float], list[str]]:
    every = max(1, -(-len(values) // 16))
    shown = range(0, len(values), every)
    return [index + 0.5 for index in shown], [short(values[index]) for index in shown]


def page(sweep: Sweep) -> str:
    """Return a map as one page that loads nothing: a grid whose points tell their numbers and play their runs."""
    style = files("pytest_pafot.report.assets").joinpath("page.css").read_text(encoding="utf-8") + _asset("map.css")
    script = _asset("map.js")
    policy = f"default-src 'none'; style-src {content_hash(style)}; script-src {content_hash(script)}"
    notes = "".join(f"<li>{escape(note)}</li>" for note in sweep.notes)
    legend = "".join(
        f'<li><span class="swatch {_name(kind)}">{MARKS[kind]}</span>{LEGEND[kind]}</li>' for kind in sweep.legend
    )
    told = " ".join(filter(None, [sweep.about, sweep.headline]))
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<meta http-equiv=\"Content-Security-Policy\" content=\"{policy}; base-uri 'none'; form-action 'none'\">\n"
        f"<title>{escape(sweep.name)}</title>\n<style>{style}</style>\n</head>\n<body>\n"
        f'<header class="top"><div class="masthead"><p class="kicker">pytest-pafot</p><h1>{escape(sweep.name)}</h1>'
        f'<p>{escape(told)}</p></div></header>\n<main class="map">\n<section>{_table(sweep)}'
        f'<ul class="legend">{legend}</ul><ul class="notes">{notes}</ul></section>\n'
        '<section id="run" hidden><h2 id="where"></h2><p id="words"></p><p id="still" hidden>There is no run here.'
        '</p><div id="player"><svg id="scene" role="img" aria-label="The run from above"></svg><p class="controls">'
        '<button type="button" id="play">Play</button><input type="range" id="time" min="0" value="0" step="1" '
        'aria-label="Time"><output id="clock"></output></p></div></section>\n</main>\n'
        "<noscript><p>Without scripts the runs do not play; each point tells its numbers.</p></noscript>\n"
        f'<script type="application/json" id="data">{json_in_script(_data(sweep))}</script>\n'
        f"<script>{script}</script>\n</body>\n</html>\n"
    )


def frame(sweep: Sweep) -> str:
    """Return a map as a frame in a notebook."""
    height = 560 + 26 * (sweep.shape[0] if len(sweep.axes) == 2 else 1)
    return (
        f'<iframe title="{escape(sweep.name)}" sandbox="allow-scripts" width="100%" height="{height}" '
        f'style="border:0" srcdoc="{escape(page(sweep))}"></iframe>'
    )


def _table(sweep: Sweep) -> str:
    *rows, columns = sweep.axes
    heads = rows[0].values if rows else (None,)
    corner = f"{escape(rows[0].words)} up, " if rows else ""
    head = "".join(f'<th scope="col">{short(value)}</th>' for value in columns.values)
    body = []
    for row, value in reversed([*enumerate(heads)]):
        cells = []
        for column in range(len(columns.values)):
            index = (row, column) if rows else (column,)
            point = sweep.point(*index)
            told = f"{sweep.where(point.at)}: {MEANINGS[point.kind]}; {point.words}"
            number = row * len(columns.values) + column
            cells.append(
                f'<td class="{_name(point.kind)}"><button type="button" data-point="{number}" title="{escape(told)}" '
                f'aria-label="{escape(told)}">{point.mark}</button></td>'
            )
        label = "" if value is None else short(value)
        body.append(f'<tr><th scope="row">{label}</th>{"".join(cells)}</tr>')
    caption = f"{corner}{escape(columns.words)} across"
    return (
        f'<div class="scroll"><table class="points"><caption>{caption}</caption><thead><tr><td></td>{head}</tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _name(kind: Kind) -> str:
    return kind.lower().replace(" ", "-")


def _data(sweep: Sweep) -> str:
    """Return what the page's script needs, as JSON: each point in words, and the runs of those that can be played."""
    first: tuple[Kind, ...] = ("ADS error", "preventable", "unavoidable", "not as asked", "avoided")
    order = sorted(range(len(sweep.points)), key=lambda number: first.index(sweep.points[number].kind))
    played = {number for number in order if sweep.points[number].trace is not None}
    played = set([number for number in order if number in played][:MOST_PLAYED])
    points: list[dict[str, Any]] = []
    for number, point in enumerate(sweep.points):
        told: dict[str, Any] = {"where": sweep.where(point.at), "words": f"{MEANINGS[point.kind]}: {point.words}"}
        if number in played and point.trace is not None:
            told |= _track(point.trace)
        points.append(told)
    return json.dumps({"points": points}, ensure_ascii=True, allow_nan=False, separators=(",", ":"))


def _track(trace: Trace) -> dict[str, Any]:
    """Return the frames of a run: x, y and heading of each vehicle, relative to the ego's start; and the lanes."""
    every = max(1, round(trace.physics_hz / FRAMES_PER_SECOND))
    ticks = sorted({*range(0, trace.ticks + 1, every), trace.ticks})
    start = trace.states[0, 0, [X, Y]]
    rows = np.nan_to_num(trace.states[ticks][:, :, [X, Y, HEADING, SPEED]])
    rows[..., :2] -= start
    frames = (rows.round(3) + 0.0).tolist()
    lanes = [
        [[_number(x - start[0]), _number(y - start[1])] for x, y in _centre(lane)] + [[_number(lane.width), 0]]
        for lane in trace.lanes
    ]
    sizes = [[_number(length), _number(width)] for length, width in trace.sizes]
    return {
        "times": [round(tick / trace.physics_hz, 2) for tick in ticks],
        "frames": frames,
        "lanes": lanes,
        "sizes": sizes,
    }


def _centre(lane: Any) -> list[tuple[float, float]]:
    if lane.points:
        return list(lane.points)
    end = lane.x + lane.length * np.cos(lane.heading), lane.y + lane.length * np.sin(lane.heading)
    return [(lane.x, lane.y), (float(end[0]), float(end[1]))]


def _number(value: float) -> float:
    return round(float(value), 2) + 0.0


def _asset(name: str) -> str:
    return files("pytest_pafot.extras.sweeps.assets").joinpath(name).read_text(encoding="utf-8")
