"""Make roads.png, the sheet in explanation.md: one finding on each kind of road that highway-env has.

Random scenarios run against a vehicle that keeps its lane and its speed; the first collision for which it is
responsible is pictured, half a second before the impact. It needs Pillow besides the plugin:
``python -m pip install ".[report]" && python docs/road_pictures.py``.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
from highway_env.vehicle.controller import ControlledVehicle
from PIL import Image, ImageDraw, ImageFont

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent))

from pytest_pafot import Run, World  # noqa: E402
from pytest_pafot.findings.finding import Finding, Found  # noqa: E402
from pytest_pafot.findings.signature import Failure  # noqa: E402
from pytest_pafot.report.animation import WIDTH, still  # noqa: E402
from pytest_pafot.report.finding_views import finding_view  # noqa: E402
from pytest_pafot.searching import sample  # noqa: E402
from pytest_pafot.trace import Trace  # noqa: E402
from tests.support.road_cases import space_of  # noqa: E402

ENVIRONMENTS = (
    "merge-v1", "merge-generic-v1", "exit-v1", "two-way-v0", "racetrack-v1", "racetrack-oval-v1",
    "racetrack-large-v1", "u-turn-v1", "roundabout-v1", "roundabout-generic-v1", "intersection-v0", "lane-keeping-v0",
)  # fmt: skip
COLUMNS = 2
TITLE = 30
RUNS = 25
"""Random scenarios of an environment, at most."""
BEFORE_IMPACT = 0.5
"""How long before the impact the picture is taken [s]."""
EARLIEST = 3.0
"""Impacts before this time show little of a manoeuvre [s]."""


def found(world: World) -> Trace:
    """A run in which the ego is responsible for a collision, with a cut-in if there is one among the first."""
    rng, space = np.random.default_rng(1), space_of(world)
    best: tuple[int, Trace] | None = None
    for _ in range(RUNS):
        trace = world.rollout(sample(space, rng), lambda: ControlledVehicle)
        if trace.collision is None or trace.collision.time < EARLIEST:
            continue
        is_egos = Run(trace).responsibility in ("ego", "both")
        rank = 2 * is_egos + (np.ptp(trace.npcs[:, trace.collision.npc, 6]) > 0)
        if best is None or rank > best[0]:
            best = rank, trace
        if rank == 2 + (world.lanes > 1):
            break
    if best is None:
        raise SystemExit(f"{world.env_id}: expected a collision in {RUNS} runs, received none")
    return best[1]


def picture(env_id: str) -> Image.Image:
    """The picture of one environment."""
    world = World(env_id, duration=15.0)
    trace = found(world)
    failure = Failure(kind="AssertionError", assertion="assert not run.collision")
    origin = Found(seed=1, generation=0, algorithm="random", versions={})
    finding = Finding.of(Run(trace), failure, test="test", world=world.to_dict(), found=origin)
    view = finding_view(trace, finding, node_id="", yaml="")
    print(f"{env_id}: {view.headline}, responsible: {view.responsibility}")
    return Image.open(io.BytesIO(still(view, trace.duration - BEFORE_IMPACT))).convert("RGB")


def main() -> None:
    """Write the sheet."""
    pictures = [picture(env_id) for env_id in ENVIRONMENTS]
    height = TITLE + max(each.height for each in pictures)
    rows = -(-len(pictures) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * WIDTH, rows * height), "#fbfbfa")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(18)
    for number, (env_id, each) in enumerate(zip(ENVIRONMENTS, pictures, strict=True)):
        x, y = number % COLUMNS * WIDTH, number // COLUMNS * height
        draw.text((x + 10, y + TITLE / 2), env_id, fill="#171b20", font=font, anchor="lm")
        sheet.paste(each, (x, y + TITLE))
        draw.rectangle((x, y, x + WIDTH - 1, y + height - 1), outline="#8b939b")
    path = DOCS / "roads.png"
    sheet.quantize(48, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"{path.name}: {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
