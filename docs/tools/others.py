"""Draw the pictures of explanation/others.md, by running the reproductions on the page and recording their vehicles.

Give the names of the pictures to draw, such as ``python docs/tools/others.py idm-vehicle fiss-plus``. Run it in an
environment that has the policies, and in a folder with the clones that the page names.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "explanation" / "others.md"
SECTION = re.compile(
    r"^!\[[^]]*\]\(others/(\S+)\.svg\)\n\n(.*?)\n\n```python\n(.*?)^```$", re.DOTALL | re.MULTILINE
)

WIDTH, LINE, ALONG = 460, 19, 100.0
"""Width of a picture and height of a line of text in it [px], and length of road in it [m]."""
EGO, OTHER, ROAD, MARK = "#5aa9ff", "#ffa64d", "#59616b", "#e8eaed"
BEFORE = 1.0
"""The second of three moments is so long before the last one [s]."""

Box = tuple[float, float, float, float, float, float]
"""A vehicle: x and y [m], heading [rad], speed [m/s], length and width [m]. y grows downwards in the picture."""
Frames = list[tuple[float, list[Box]]]
"""Moments [s], each with all vehicles, the ego first."""


def sections() -> dict[str, tuple[str, str]]:
    """Return the sentences and the code of each failure on the page, by the name of its picture."""
    return {
        name: (said, code) for name, said, code in SECTION.findall(PAGE.read_text(encoding="utf-8"))
    }


def wrap(module: str, path: str, note: Callable[..., None]) -> None:
    """Call a function after each call of another one, with its result and its arguments."""
    *owners, name = path.split(".")
    owner = importlib.import_module(module)
    for each in owners:
        owner = getattr(owner, each)
    inner = getattr(owner, name)

    def outer(*args: Any, **named: Any) -> Any:
        result = inner(*args, **named)
        note(result, *args, **named)
        return result

    setattr(owner, name, outer)


def run(code: str) -> tuple[Frames, list[float], float, str]:
    """Run a reproduction; return its moments, the middles of its lanes and their width [m], and what it printed."""
    frames: Frames = []
    lanes, width = [0.0], 4.0
    seen: dict[str, float] = {}

    def highway(_: None, road: Any, dt: float) -> None:
        lanes[:] = [float(lane.position(0, 0)[1]) for lane in road.network.lanes_list()]
        shown = [(*v.position, v.heading, v.speed, v.LENGTH, v.WIDTH) for v in road.vehicles]
        if "crash" not in seen:
            frames.append(((len(frames) + 1) * dt, shown))
        if any(vehicle.crashed for vehicle in road.vehicles):
            seen["crash"] = 1.0

    def metadrive(_: Any, env: Any, action: Any) -> None:
        lanes[:] = [-3.5 * number for number in range(3)]
        cars = [
            env.agent,
            *env.engine.get_objects(lambda each: each.class_name == "DefaultVehicle").values(),
        ]
        shown = [
            (v.position[0], -v.position[1], -v.heading_theta, v.speed, v.LENGTH, v.WIDTH)
            for v in {id(v): v for v in cars}.values()
        ]
        if not env.agent.crash_vehicle:  # the engine has pushed them apart
            frames.append(((len(frames) + 1) / 10, shown))

    def fiss(_: bool, *boxes: Any) -> None:
        x = frames[-1][1][1][0] if frames else boxes[1].cx - 1.5
        speeds = seen["ego"], (boxes[1].cx - x) * 10
        shown = [
            (b.cx, -b.cy, -b.yaw, v, b.length, b.width) for b, v in zip(boxes, speeds, strict=True)
        ]
        frames.append(((len(frames) + 1) / 10, shown))

    def reactive(_: None, planner: Any, *args: Any, **given: Any) -> None:
        state, size = planner.x_0, planner.vehicle_params
        if state is not None:
            x = float(state.position[0]) + size.wb_rear_axle
            frames.append((0.0, [(x, 0.0, 0.0, state.velocity, size.length, size.width)]))

    if "metadrive" in code:
        wrap("metadrive.envs.metadrive_env", "MetaDriveEnv.step", metadrive)
        width = 3.5
    elif "fiss_planner" in code:
        wrap("fiss_planner", "overlaps", fiss)
        wrap("fiss_planner", "EgoState", lambda state, *_: seen.update(ego=state.v))
    elif "commonroad_rp" in code:
        wrap("commonroad_rp.reactive_planner", "ReactivePlanner.reset", reactive)
    else:
        wrap("highway_env.road.road", "Road.step", highway)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, "reproduction", "exec"), {})  # noqa: S102 - the code on the page
    return frames, lanes, width, printed.getvalue().strip().rpartition("\n")[2]


def speed_of(box: Box) -> str:
    """Return the speed of a vehicle as text [m/s]."""
    return f"{box[3]:.1f}" if abs(box[3]) >= 0.1 or not box[3] else f"{box[3]:.2f}"


def picture(frames: Frames, lanes: list[float], width: float, printed: str) -> str:
    """Return an SVG of the first moment, one a little before the last, and the last, with the ego at the same place."""
    end = frames[-1][0]
    middle = min(frames, key=lambda frame: abs(frame[0] - (end - BEFORE)))
    chosen = {frame[0]: frame for frame in (frames[0], middle, frames[-1])}.values()
    top, bottom = min(lanes) - width / 2 - 0.8, max(lanes) + width / 2 + 0.8
    high = round(WIDTH / ALONG * (bottom - top))
    parts, y = [], 0
    for time, boxes in chosen:
        left = boxes[0][0] - 25.0
        names = [
            "ego",
            *(["other"] if len(boxes) == 2 else [f"other {n}" for n in range(1, len(boxes))]),
        ]
        told = [
            f'<tspan dx="9" fill="{OTHER if n else EGO}">{name} {speed_of(boxes[n])} m/s</tspan>'
            for n, name in enumerate(names)
        ]
        parts.append(f'<text x="4" y="{y + 15}">{time:.1f} s{"".join(told)}</text>')
        roads = [
            f'<rect x="0" y="{lane - width / 2}" width="{ALONG}" height="{width}" fill="{ROAD}"/>'
            for lane in lanes
        ]
        roads += [
            f'<path d="M0 {lane + width / 2}h{ALONG}" stroke="{MARK}" stroke-width=".15" stroke-dasharray="3 5"/>'
            for lane in sorted(lanes)[:-1]
        ]
        cars = [
            f'<rect x="{-length / 2:.1f}" y="{-wide / 2:.1f}" width="{length:.1f}" height="{wide:.1f}" rx=".5" '
            f'fill="{OTHER if n else EGO}" transform="translate({x - left:.1f} {across:.1f}) '
            f'rotate({math.degrees(heading):.1f})"/>'
            for n, (x, across, heading, _, length, wide) in enumerate(boxes)
        ]
        parts.append(
            f'<svg y="{y + LINE}" width="{WIDTH}" height="{high}" viewBox="0 {top:.1f} {ALONG} {bottom - top:.1f}">'
            f"{''.join(roads + cars)}</svg>"
        )
        y += LINE + high + 4
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {y}" width="{WIDTH}" height="{y}"'
    style = f'font-family="sans-serif" font-size="11" fill="{MARK}"'
    back = f'<rect width="{WIDTH}" height="{y}" rx="5" fill="#2b3037"/>'
    return "\n".join([f"{head} {style}>", f"<title>{printed}</title>", back, *parts, "</svg>\n"])


if __name__ == "__main__":
    for given in sys.argv[1:]:
        drawn = picture(*run(sections()[given][1]))
        PAGE.with_suffix("").joinpath(f"{given}.svg").write_text(
            drawn, encoding="utf-8", newline="\n"
        )
