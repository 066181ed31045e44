"""Make crash.svg, the moving picture of a crash in README.md: the last seconds of a saved scenario, from above.

``python docs/tools/crash_picture.py`` searches docs/start/test_cruise.py as the README does, and draws what it finds.
``python docs/tools/crash_picture.py FILE MODULE.py:POLICY`` draws a saved scenario with a function or a class.
It needs only the plugin, and a straight road. report_picture.py makes crash.png, the report page of the same crash.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[1]
sys.path.insert(0, str(DOCS.parent))

import pytest_pafot as pafot  # noqa: E402
from pytest_pafot.criticality import gap  # noqa: E402
from pytest_pafot.model.trace import ACCELERATION, SPEED, FloatArray, Trace, X, Y  # noqa: E402

SAMPLE, POLICY, SEED = DOCS / "start" / "test_cruise.py", "cruise", 1
"""The test of the README, its policy, and the seed of its search."""
PICTURE = DOCS / "crash.svg"

SECONDS, STILL = 5.0, 1.6
"""The time before the impact that the picture shows, and the time for which it stands at the impact [s]."""
STEP = 0.2
"""The time between two figures [s]."""
WIDTH, HEAD, EGO, SCALE, SHOULDER = 700, 44, 190.0, 9.0, 1.2
"""Width, height of the line with the figures, place of the ego's centre [px]; px per m; beside the lanes [m]."""
COLOURS = ("#5aa9ff", "#ffa64d", "#c9ced6")
"""Colours of the ego, of the vehicle that it hits, and of all others, as in all pictures."""
STAR = "M0-15 4-6 12-11 7-2 15 0 7 3 12 11 4 6 0 15-4 6-12 11-7 3-15 0-7-2-12-11-4-6Z"


def moving(trace: Trace) -> str:
    """Draw the end of a run with a collision on a straight road as an animated SVG, in which the ego stands still.

    Without motion, it is the picture of the impact.

    Raises:
        SystemExit: if the road is not straight, or nothing was hit.
    """
    if trace.collision is None or trace.collision.npc is None or not trace.road.is_straight:
        raise SystemExit("expected a run on a straight road in which the ego hits a vehicle")
    hit, hz, end = trace.collision.npc + 1, trace.physics_hz, trace.collision.tick
    begin = max(end - round(SECONDS * hz), 0)
    ticks = np.unique(np.append(np.arange(begin, end, 2), end))
    seconds = (end - begin) / hz + STILL
    along, across = trace.road.drawn(trace.states[:, :, X], trace.states[:, :, Y])
    lanes = sorted(
        float(trace.road.drawn(np.array([lane.x]), np.array([lane.y]))[1][0])
        for lane in trace.lanes
    )
    lane, top = float(trace.lanes[0].width), min(lanes) - trace.lanes[0].width / 2 - SHOULDER
    height = HEAD + round((max(lanes) + lane / 2 + SHOULDER - top) * SCALE)
    names = ["ego", *(f"NPC {npc}" for npc in range(along.shape[1] - 1))]
    colours = [COLOURS[0 if each == 0 else 1 if each == hit else 2] for each in range(len(names))]

    def y(place: FloatArray | float) -> FloatArray | float:
        return HEAD + (place - top) * SCALE

    def moves(name: str, x: FloatArray, y: FloatArray, angle: FloatArray) -> str:
        """Return the rules by which a thing moves, and where it is without motion."""
        places = [
            f"translate({a:.1f}px,{b:.1f}px) rotate({c:.1f}deg)"
            for a, b, c in zip(x, y, angle, strict=True)
        ]
        shares = [100 * (tick - begin) / hz / seconds for tick in ticks]
        frames = "".join(
            f"{share:.2f}%{{transform:{at}}}" for share, at in zip(shares, places, strict=True)
        )
        last = f"transform:{places[-1]}"
        return (
            f".{name}{{{last};animation:{name} {seconds:.2f}s linear infinite}}"
            f"@keyframes {name}{{{frames}100%{{{last}}}}}"
        )

    def shows(name: str, spans: Iterable[tuple[float, bool]]) -> str:
        """Return the rules by which a thing is seen from times on or no longer; without motion as at the end."""
        told = [
            (100 * time / seconds, "visible" if is_seen else "hidden") for time, is_seen in spans
        ]
        frames = "".join(f"{share:.2f}%{{visibility:{seen}}}" for share, seen in told)
        return (
            f".{name}{{visibility:{told[-1][1]};animation:{name} {seconds:.2f}s step-end infinite}}"
            f"@keyframes {name}{{{frames}}}"
        )

    ego, angles = along[ticks, 0], np.degrees(trace.road.drawn_headings[ticks])
    zeros = np.zeros(len(ticks))
    rules = [moves("r", -(ego - ego[-1]) * SCALE, zeros, zeros)]
    cars = []
    for each, (name, colour) in enumerate(zip(names, colours, strict=True)):
        x = EGO + (along[ticks, each] - ego) * SCALE
        rules.append(moves(f"v{each}", x, y(across[ticks, each]), angles[:, each]))
        brakes = trace.states[begin : end + 1, each, ACCELERATION] < -1.0
        changes = [
            (next(group)[0] / hz, is_on)
            for is_on, group in groupby(enumerate(brakes), key=lambda at: bool(at[1]))
        ]
        rules.append(shows(f"b{each}", changes))
        length, width = (float(size) * SCALE for size in trace.sizes[each])
        left, upper = -length / 2, -width / 2
        cars.append(
            f'<g class="v{each}"><rect x="{left:.1f}" y="{upper:.1f}" width="{length:.1f}" height="{width:.1f}" rx="4" '
            f'fill="{colour}"/><text y="4.2" text-anchor="middle" font-size="12" font-weight="700">{name}</text>'
            f'<path class="b{each}" d="M{left:.1f} {upper + 2:.1f}v5m0 {width - 14:.1f}v5" stroke="#ff4438" '
            'stroke-width="5"/></g>'
        )
    rules.append(shows("i", [(0.0, False), (seconds - STILL, True)]))
    # The figures of each step are a text of their own, of which one is seen at a time.
    figures, gaps = [], gap(trace)[:, hit - 1]
    times = [*np.arange(0.0, seconds - STILL - 1e-9, STEP), seconds - STILL]
    for number, time in enumerate(times):
        tick = begin + round(time * hz)
        rules.append(
            shows(
                f"f{number}",
                [(0.0, False), (time, True), ((*times, seconds)[number + 1], time == times[-1])],
            )
        )
        told = [
            (14, "#ffffff", f"{tick / hz:.1f} s"),
            (110, COLOURS[0], f"ego {trace.states[tick, 0, SPEED]:.1f} m/s"),
            (270, COLOURS[1], f"{names[hit]} {trace.states[tick, hit, SPEED]:.1f} m/s"),
            (460, "#ffffff", f"gap {max(gaps[tick], 0.0):.1f} m"),
        ]
        texts = "".join(
            f'<tspan x="{x}" fill="{colour}">{text}</tspan>' for x, colour, text in told
        )
        figures.append(
            f'<text class="f{number}" y="28" font-size="19" font-weight="600">{texts}</text>'
        )
    low, high = y(min(lanes) - lane / 2), y(max(lanes) + lane / 2)
    reach = (ego[-1] - ego[0]) * SCALE + EGO
    edges = "".join(
        f'<path d="M0 {at:.1f}H{WIDTH}" stroke="#8b939b" stroke-width="2"/>' for at in (low, high)
    )
    marks = "".join(
        f'<path d="M{-reach:.0f} {y(centre - lane / 2):.1f}H{WIDTH}" stroke="#d8dbdd" stroke-width="2" '
        f'stroke-dasharray="{3 * SCALE:g} {9 * SCALE:g}"/>'
        for centre in lanes[1:]
    )
    ahead, right = _contact(trace, along[end], across[end], hit)
    return "".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" role="img" '
        'font-family="system-ui,-apple-system,Segoe UI,Roboto,Helvetica,Arial,DejaVu Sans,sans-serif">\n'
        f"<title>The ego hits {names[hit]}, seen from above</title>\n<style>\n" + "\n".join(rules) + "\n"
        "@media (prefers-reduced-motion:reduce){*{animation:none!important}}\n</style>\n"
        f'<rect width="{WIDTH}" height="{height}" rx="8" fill="#1b1f24"/>\n'
        f'<rect y="{low:.1f}" width="{WIDTH}" height="{high - low:.1f}" fill="#3b424a"/>{edges}\n'
        f'<g class="r">{marks}</g>\n',
        "\n".join([*reversed(cars), *figures]),
        f'\n<g class="i"><path transform="translate({EGO + ahead * SCALE:.1f} {y(right):.1f})" d="{STAR}" '
        'fill="#ff4438" stroke="#ffffff" stroke-width="1.5"/></g>\n</svg>\n',
    ])  # fmt: skip


def _contact(trace: Trace, along: FloatArray, across: FloatArray, hit: int) -> tuple[float, float]:
    """Return the point of the ego's box that is nearest to the other vehicle: ahead of its centre, and across [m]."""
    length, width = trace.sizes[0]
    ahead = np.clip(along[hit] - along[0], -length / 2, length / 2)
    return float(ahead), float(across[0] + np.clip(across[hit] - across[0], -width / 2, width / 2))


def drawn(path: Path, policy: Callable[..., object]) -> str:
    """Return the picture of a saved scenario with a policy."""
    return moving(
        pafot.load(path).replay(policy if isinstance(policy, type) else lambda: policy).trace
    )


def found(folder: Path) -> Path:
    """Search the sample in an empty folder, and return the file of its first finding."""
    test = folder / SAMPLE.name
    test.write_text(SAMPLE.read_text(encoding="utf-8"), encoding="utf-8")
    environment = {
        name: value for name, value in os.environ.items() if name not in ("CI", "PYTEST_ADDOPTS")
    }
    environment["PYTHONPATH"] = os.pathsep.join(
        filter(None, [str(DOCS.parent), environment.get("PYTHONPATH")])
    )
    command = [
        sys.executable,
        "-m",
        "pytest",
        test.name,
        f"--pafot-seed={SEED}",
        "-p",
        "no:randomly",
        "-q",
    ]
    done = subprocess.run(  # noqa: S603
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    files = sorted(folder.rglob("*.pafot.yaml"))
    if not files:
        raise SystemExit(
            f"{command}: expected a finding, received this:\n{done.stdout}{done.stderr}"
        )
    return files[0]


def main(arguments: Sequence[str]) -> None:
    """Write the picture of a saved scenario and a policy, or of what the sample's search finds."""
    if len(arguments) not in (0, 2):
        raise SystemExit("expected no arguments, or FILE and MODULE.py:POLICY")
    with tempfile.TemporaryDirectory() as folder:
        path, policy = arguments or (found(Path(folder)), f"{SAMPLE}:{POLICY}")
        module, _, name = policy.rpartition(":")
        content = drawn(Path(path), runpy.run_path(module)[name])
    PICTURE.write_text(content, encoding="utf-8", newline="\n")
    print(f"{PICTURE.name}: {len(content)} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
