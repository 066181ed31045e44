"""Make the sheets in guide/environments.md: a finding on each kind of road that highway-env has, and its junctions.

roads.png has random scenarios with an ego that keeps its lane and its speed: the first collision for which it is
responsible, half a second before the impact. junctions.png has the ways of other traffic, with the zones in which they
meet the ego's way. ``--junctions`` makes only this sheet, for the environments that are named after it, or for
highway-env's. It needs Pillow in addition to the plugin:
``python -m pip install . pillow && python docs/tools/road_pictures.py``.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from highway_env.vehicle.controller import ControlledVehicle
from PIL import Image, ImageColor, ImageDraw, ImageFont

DOCS = Path(__file__).parents[1]
sys.path.insert(0, str(DOCS.parent))

from pytest_pafot import Run, World  # noqa: E402
from pytest_pafot.algorithms import sample  # noqa: E402
from pytest_pafot.attribution.responsibility import rss_rule  # noqa: E402
from pytest_pafot.findings.finding import Finding, Found  # noqa: E402
from pytest_pafot.findings.sighting import Discovery, Finished, Seen  # noqa: E402
from pytest_pafot.findings.verdict import Failure, Verdict  # noqa: E402
from pytest_pafot.model.trace import Trace  # noqa: E402
from pytest_pafot.report.views import finding_view  # noqa: E402
from tests.helpers.road_cases import space_of  # noqa: E402

ENVIRONMENTS = (
    "merge-v1", "merge-generic-v1", "exit-v1", "two-way-v0", "u-turn-v1", "racetrack-large-v1",
    "racetrack-v1", "racetrack-oval-v1", "roundabout-v1", "roundabout-generic-v1", "intersection-v0", "lane-keeping-v0",
)  # fmt: skip
COLUMNS = 2
TITLE = 30
MARGIN = 10
"""Space above and below the lanes of pictures that are side by side [pixels]."""
RUNS = 25
"""The largest number of random scenarios for an environment."""
BEFORE_IMPACT = 0.5
"""The time of the picture before the impact [s]."""
EARLIEST = 3.0
"""Earlier impacts are not used, because they show little of a manoeuvre [s]."""

WIDTH, BAR, SHOULDER = 720, 26, 12
"""Width of the picture, and height of its line of text and of the strips beside a straight road [px]."""
SCALE, HALF_HEIGHT = 8.0, 18.0
"""Scale [px/m], and length of road that is shown on each side of the ego on a bent road [m]."""
CROSSED_SCALE, CROSSED_HALF_HEIGHT = 5.0, 45.0
"""The same if a vehicle crosses the ego's way. Otherwise it would be visible only 2 s before contact."""

PAPER, ROAD, EDGE, DASH, INK, DANGER = (
    "#fbfbfa",
    "#e6e8e9",
    "#8b939b",
    "#ffffff",
    "#171b20",
    "#b3261e",
)
NPC_INKS = ("#b4480a", "#00695c", "#6a3fa0", "#8a6100", "#0b5cad", "#a3195b", "#3d6b1f", "#5b4a42")


def found(world: World) -> Trace:
    """Return a run in which the ego is responsible for a collision, with a cut-in if one is found early."""
    rng, space = np.random.default_rng(1), space_of(world)
    best: tuple[int, Trace] | None = None
    for _ in range(RUNS):
        trace = world.rollout(sample(space, rng), lambda: ControlledVehicle)
        if trace.collision is None or trace.collision.time < EARLIEST:
            continue
        rank = 2 * rss_rule(trace).blames_ego + (np.ptp(trace.npcs[:, trace.collision.npc, 6]) > 0)
        if best is None or rank > best[0]:
            best = rank, trace
        if rank == 2 + (world.lanes > 1):
            break
    if best is None:
        raise SystemExit(f"{world.env_id}: expected a collision in {RUNS} runs, received none")
    return best[1]


def picture(env_id: str) -> Image.Image:
    """Draw the picture of one environment."""
    world = World(env_id, duration=15.0)
    trace = found(world)
    failure = Failure(kind="AssertionError", assertion="assert not run.collision")
    origin = Found(seed=1, generation=0, algorithm="random", versions={})
    finding = Finding.from_run(
        Run(trace), failure, test="test", world=world.to_dict(), found=origin
    )
    shown = Discovery(ended=Finished(run=Run(trace), verdict=Verdict(kind="failed")))
    view = finding_view(Seen(finding=finding, node_id="", observed=shown))
    print(f"{env_id}: {view['headline']}, responsible: {finding.expect.responsibility}")
    moment = trace.duration - BEFORE_IMPACT
    named = json.loads(json.dumps(view), object_hook=lambda part: SimpleNamespace(**part))
    return frame(
        named, min(range(len(named.times)), key=lambda index: abs(named.times[index] - moment))
    )


def frame(finding: SimpleNamespace, index: int) -> Image.Image:
    """Draw a frame of a finding's run from above, with the ego in its middle."""
    ego, road = finding.vehicles[0], finding.road
    scale, reach = (
        (CROSSED_SCALE, CROSSED_HALF_HEIGHT)
        if any(vehicle.zone for vehicle in finding.vehicles)
        else (SCALE, HALF_HEIGHT)
    )
    x, y = ego.along[index] or 0.0, ego.across[index] or 0.0
    top, bottom = y - reach, y + reach
    if road.lanes:
        margin = road.lane_width / 2 + SHOULDER / scale
        top, bottom = min(road.lanes) - margin, max(road.lanes) + margin
    image = Image.new("RGB", (WIDTH, BAR + round((bottom - top) * scale)), PAPER)
    pen = ImageDraw.Draw(image)

    def at(along: float, across: float) -> tuple[float, float]:
        return WIDTH / 2 + (along - x) * scale, BAR + (across - top) * scale

    # Every lane is painted twice, the second time narrower: this leaves an edge of the road, and lanes that touch.
    half = WIDTH / scale
    ends = x - half, x + half
    straight = [
        SimpleNamespace(points=[(end, lane) for end in ends], width=road.lane_width)
        for lane in road.lanes
    ]
    for more, ink in ((0.5, EDGE), (-0.3 if road.shapes else 0.0, ROAD)):
        for shape in straight or road.shapes:
            pen.line(
                [at(*point) for point in shape.points],
                ink,
                round((shape.width + more) * scale),
                joint="curve",
            )
    for lane in road.lanes[1:]:  # dashes, by which one sees that the ego moves
        for start in range(math.floor((x - half) / 12) * 12, math.ceil(x + half), 12):
            across = lane - road.lane_width / 2
            pen.line([at(start, across), at(start + 3, across)], DASH, 2)
    has_collided = (
        finding.event.kind == "collision" and finding.times[index] >= finding.event.time - 1e-6
    )
    for number, vehicle in reversed(list(enumerate(finding.vehicles))):  # the ego last, on top
        along, across_, heading = (
            vehicle.along[index],
            vehicle.across[index],
            vehicle.heading[index] or 0.0,
        )
        if along is None or across_ is None:
            continue
        cos, sin = math.cos(heading), math.sin(heading)
        ink = NPC_INKS[(number - 1) % len(NPC_INKS)] if number else DANGER if has_collided else INK
        # the light strip is the windscreen
        for length, color in ((0.5, ink), (0.3, PAPER), (0.2, ink)):
            corners = [(-0.5, -0.5), (length, -0.5), (length, 0.5), (-0.5, 0.5)]
            turned = [(ahead * vehicle.length, right * vehicle.width) for ahead, right in corners]
            places = [at(along + a * cos - r * sin, across_ + a * sin + r * cos) for a, r in turned]
            pen.polygon(places, fill=color)
        name = str(number - 1) if number else "E"
        pen.text(
            at(along - 0.1 * cos, across_ - 0.1 * sin),
            name,
            PAPER,
            ImageFont.load_default(12),
            "mm",
        )
    # The words: the time, and the headline in the largest size that fits, without characters that the font lacks.
    pen.rectangle((0, 0, WIDTH, BAR - 1), fill=PAPER)
    printable = (
        char if char.isprintable() and ord(char) < 0x250 else "?" for char in finding.headline[:150]
    )
    words = f"{finding.times[index]:.1f} s  {''.join(printable)}"
    fonts = [ImageFont.load_default(size) for size in (13, 12, 11, 10, 9, 8)]
    font = next((font for font in fonts if font.getlength(words) <= WIDTH - 20), fonts[-1])
    pen.text((10, BAR / 2), words, INK, font, "lm")
    return image


def row(names: Sequence[str]) -> Image.Image:
    """Put pictures side by side, and cut the empty space above and below the lanes of all of them."""
    pictures = [picture(name) for name in names]
    wide = Image.new("RGB", (COLUMNS * WIDTH, pictures[0].height), PAPER)
    for number, each in enumerate(pictures):
        wide.paste(each, (number * WIDTH, 0))
    lanes = np.asarray(wide)[BAR:]
    drawn = np.flatnonzero((lanes != np.array(ImageColor.getrgb(PAPER))).any(axis=(1, 2)))
    first, last = max(drawn[0] - MARGIN, 0), min(drawn[-1] + MARGIN, len(lanes))
    parts = (0, BAR), (BAR + first, BAR + last)
    framed = Image.new("RGB", (wide.width, TITLE + sum(end - begin for begin, end in parts)), PAPER)
    y = TITLE
    for begin, end in parts:
        framed.paste(wide.crop((0, int(begin), wide.width, int(end))), (0, int(y)))
        y += end - begin
    draw, font = ImageDraw.Draw(framed), ImageFont.load_default(18)
    for number, name in enumerate(names):
        x = number * WIDTH
        draw.text((x + 10, TITLE / 2), name, fill="#171b20", font=font, anchor="lm")
        draw.rectangle((x, 0, x + WIDTH - 1, framed.height - 1), outline="#8b939b")
    return framed


JUNCTIONS: Sequence[tuple[str, dict[str, str]]] = (
    ("intersection-v0", {"destination": "o1"}), ("intersection-v0", {"destination": "o2"}),
    ("intersection-v0", {"destination": "o3"}), ("roundabout-v0", {}),
)  # fmt: skip
SIDE, WORDS = 560, 155
"""Side length of the picture of a junction, and height of the text below it [pixels]."""
AROUND = 18.0
"""The distance around its zones up to which a junction is drawn [m]."""
KINDS = {"crossing": "#d9480f", "oncoming": "#2563eb", "merging": "#15803d"}
OWN, LANE, TEXT = "#111418", "#dfe3e7", "#171b20"
SHIFT = 0.35
"""The sideways distance between drawn ways, which would otherwise cover each other [m]."""

Points = np.ndarray[tuple[int, int], np.dtype[np.float64]]


def beside(points: Points, shift: float) -> Points:
    """Shift a line to the right by a distance [m]."""
    along = np.gradient(points, axis=0)
    return (
        points
        + shift * np.stack([-along[:, 1], along[:, 0]], axis=-1) / np.hypot(*along.T)[:, None]
    )


def junction(env_id: str, config: dict[str, str]) -> Image.Image:
    """Draw the ways through a junction, thick in their zones. The ego's way is black."""
    world = World(env_id, config or None)
    crossings, known, road = world.crossings, world.road.junction, world.road
    if crossings is None or known is None:
        raise SystemExit(f"{env_id}: expected ways that meet the ego's, received none")
    own = np.stack([road.line.x, road.line.y], axis=-1)[road.point(crossings.ego_start) :]
    lines = {name: np.stack([way.line.x, way.line.y], axis=-1) for name, way in known.ways.items()}
    stretches = {zone.way: [2 * int(place) for place in zone.npc] for zone in crossings.zones}
    met = np.concatenate([lines[name][first:last] for name, (first, last) in stretches.items()])
    middle, scale = (
        (met.min(axis=0) + met.max(axis=0)) / 2,
        SIDE / (np.ptp(met, axis=0).max() + 2 * AROUND),
    )
    image = Image.new("RGB", (2 * SIDE, 2 * (SIDE + WORDS)), PAPER)
    draw, big, small = ImageDraw.Draw(image), ImageFont.load_default(34), ImageFont.load_default(26)

    def line(points: Points, width: float, fill: str) -> None:
        pixels = [tuple(pair) for pair in (points - middle) * 2 * scale + SIDE]
        draw.line(pixels, width=max(round(width * 2 * scale), 2), fill=fill, joint="curve")

    for lane in world.network.lanes_list():
        places = np.linspace(0.0, lane.length, max(2, int(lane.length)))
        line(np.array([lane.position(place, 0) for place in places]), float(lane.width_at(0)), LANE)
    line(own, 0.5, OWN)
    for number, zone in enumerate(crossings.zones):
        points = beside(lines[zone.way], SHIFT * (number - (len(lines) - 1) / 2))
        first, last = stretches[zone.way]
        line(points, 0.2, KINDS[zone.kind])
        line(points[first : last + 1], 0.55, KINDS[zone.kind])
    draw.rectangle((0, 2 * SIDE, 2 * SIDE, 2 * (SIDE + WORDS)), fill=PAPER)
    title = f"{env_id}, {' '.join(f'{name} {value}' for name, value in config.items())}".rstrip(
        ", "
    )
    draw.text((24, 20), title, fill=TEXT, font=big)
    for number, zone in enumerate(crossings.zones):
        words = f"{zone.way}: {zone.kind}, {zone.whence}, priority: {zone.priority}"
        draw.text((24, 2 * SIDE + 8 + 32 * number), words, fill=KINDS[zone.kind], font=small)
    return image.resize((SIDE, SIDE + WORDS), Image.Resampling.LANCZOS)


def junctions(names: Sequence[str]) -> Image.Image:
    """Draw the sheet of junctions."""
    pictures = [junction(*each) for each in ([(name, {}) for name in names] or JUNCTIONS)]
    height = SIDE + WORDS
    sheet = Image.new("RGB", (2 * SIDE, height * ((len(pictures) + 1) // 2)), PAPER)
    for number, each in enumerate(pictures):
        sheet.paste(each, (SIDE * (number % 2), height * (number // 2)))
    return sheet


def write(sheet: Image.Image, path: Path) -> None:
    """Save a sheet in few colours."""
    sheet.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size} bytes")


def main() -> None:
    """Write the sheets."""
    only, *names = sys.argv[1:] or ("",)
    write(junctions(names), DOCS / "junctions.png")
    if only == "--junctions":
        return
    rows = [
        row(ENVIRONMENTS[first : first + COLUMNS]) for first in range(0, len(ENVIRONMENTS), COLUMNS)
    ]
    sheet = Image.new("RGB", (COLUMNS * WIDTH, sum(each.height for each in rows)), PAPER)
    y = 0
    for each in rows:
        sheet.paste(each, (0, y))
        y += each.height
    write(sheet, DOCS / "roads.png")


if __name__ == "__main__":
    main()
