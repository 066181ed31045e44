"""The end of a run as a moving picture (APNG), for places that cannot show a page: the road, the vehicles, the time.

It uses the frames of the page's player as they are, and the ego's plan. Cells, targets, trails and zones are only in
the page.
"""

from __future__ import annotations

import io
import math
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from pytest_pafot.report.page_data import EventView, LaneView, RoadView, RunView, VehicleView
from pytest_pafot.support.errors import RequestError, flag, install

if TYPE_CHECKING:
    from PIL.Image import Image

    from pytest_pafot.world.engines.episode import Episode, EpisodeRecording

MAX_SECONDS = 8.0
"""The length of the longest animation [s]. A longer run is cut at its start."""

AFTER = 2.0
"""Time shown after the moment of a failed check [s]. After a collision nothing is shown, because it ends the run."""

HOLD_MILLISECONDS = 2500
"""Time for which the last frame stays before the animation starts again [ms]."""

WIDTH, BAR, SHOULDER = 720, 26, 12
"""Width of the picture, and height of its line of text and of the strips beside a straight road [px]."""
SCALE, HALF_HEIGHT = 8.0, 18.0
"""Scale [px/m], and length of road that is shown on each side of the ego on a bent road [m]."""
CROSSED_SCALE, CROSSED_HALF_HEIGHT = 5.0, 45.0
"""The same if a vehicle crosses the ego's way. Otherwise it would be visible only 2 s before contact."""

PAPER, ROAD, EDGE, DASH, INK, DANGER = "#fbfbfa", "#e6e8e9", "#8b939b", "#ffffff", "#171b20", "#b3261e"
BLENDS = ("#505358", "#898b8e", "#c2c3c4")
"""The colours at the edges of letters, between ``INK`` and ``PAPER``."""
NPC_INKS = ("#b4480a", "#00695c", "#6a3fa0", "#8a6100", "#0b5cad", "#a3195b", "#3d6b1f", "#5b4a42")


class AnimationError(RequestError):
    """An animation that cannot be made; the message says why and what to do."""


def animate(finding: RunView) -> bytes:
    """Draw the end of a finding's run, as the content of an APNG file.

    The first frame is the finding's moment, because previews and viewers without animations show only that one. With
    the same version of Pillow, equal views give equal bytes.

    Raises:
        AnimationError: without Pillow, or for a finding without frames.
    """
    if not finding.times:
        raise AnimationError(
            f"finding: expected frames to draw, received none for {finding.id}; no run of it was recorded"
        )
    indices = shown_frames(finding)
    images = [frame(finding, index) for index in indices]
    from PIL import Image, ImageColor  # noqa: PLC0415  (an optional library, which the first frame has needed)

    # One palette for all frames, so that colours do not flicker and the file stays small.
    palette = Image.new("P", (1, 1))
    colors = (PAPER, ROAD, EDGE, DASH, INK, DANGER, *BLENDS, *NPC_INKS)
    palette.putpalette([part for color in colors for part in ImageColor.getrgb(color)])
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    times = [finding.times[index] for index in indices]
    durations = [*(round(1000 * (after - before)) for before, after in pairwise(times)), HOLD_MILLISECONDS]
    # It plays in a loop, so it may begin anywhere.
    first = min(range(len(times)), key=lambda number: abs(times[number] - finding.moment))
    start, *others = frames[first:] + frames[:first]
    content = io.BytesIO()
    rotated = durations[first:] + durations[:first]
    start.save(content, "PNG", save_all=True, append_images=others, duration=rotated, loop=0, optimize=True)
    return content.getvalue()


def shown_frames(finding: RunView) -> range:
    """Return the indices of an animation's frames.

    They cover ``MAX_SECONDS`` of the run, which end ``AFTER`` after the finding's moment, and not before
    ``MAX_SECONDS``.
    """
    end = min(finding.duration, max(finding.moment + AFTER, MAX_SECONDS))
    inside = [index for index, time in enumerate(finding.times) if end - MAX_SECONDS <= time <= end + 1e-6]
    return range(inside[0], inside[-1] + 1)


def frame(finding: RunView, index: int) -> Image:
    """Draw a frame of a finding's run from above, with the ego in its middle.

    Raises:
        AnimationError: without Pillow.
    """
    try:
        from PIL import Image, ImageDraw, ImageFont  # noqa: PLC0415  (an optional library)
    except ImportError as error:
        raise AnimationError(
            "expected Pillow to draw pictures, received a Python environment in which it is not installed; "
            f"install it with {install('report')}, or write a page with pytest instead: {flag('report', 'report.html')}"
        ) from error
    ego, road = finding.vehicles[0], finding.road
    scale, reach = (CROSSED_SCALE, CROSSED_HALF_HEIGHT) if finding.is_crossed else (SCALE, HALF_HEIGHT)
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
    straight = [LaneView(points=((x - half, lane), (x + half, lane)), width=road.lane_width) for lane in road.lanes]
    for more, ink in ((0.5, EDGE), (-0.3 if road.shapes else 0.0, ROAD)):
        for shape in straight or road.shapes:
            pen.line([at(*point) for point in shape.points], ink, round((shape.width + more) * scale), joint="curve")
    for lane in road.lanes[1:]:  # dashes, by which one sees that the ego moves
        for start in range(math.floor((x - half) / 12) * 12, math.ceil(x + half), 12):
            across = lane - road.lane_width / 2
            pen.line([at(start, across), at(start + 3, across)], DASH, 2)
    if len(plan := [at(*place) for place in finding.planned(finding.times[index])]) > 1:
        pen.line(plan, INK, 2, joint="curve")
    has_collided = finding.event.kind == "collision" and finding.times[index] >= finding.event.time - 1e-6
    for number, vehicle in reversed(list(enumerate(finding.vehicles))):  # the ego last, on top
        along, across_, heading = vehicle.along[index], vehicle.across[index], vehicle.heading[index] or 0.0
        if along is None or across_ is None:
            continue
        cos, sin = math.cos(heading), math.sin(heading)
        ink = NPC_INKS[(number - 1) % len(NPC_INKS)] if number else DANGER if has_collided else INK
        for length, color in ((0.5, ink), (0.3, PAPER), (0.2, ink)):  # the light strip is the windscreen
            corners = [(-0.5, -0.5), (length, -0.5), (length, 0.5), (-0.5, 0.5)]
            turned = [(ahead * vehicle.length, right * vehicle.width) for ahead, right in corners]
            places = [at(along + a * cos - r * sin, across_ + a * sin + r * cos) for a, r in turned]
            pen.polygon(places, fill=color)
        name = str(number - 1) if number else "E"
        pen.text(at(along - 0.1 * cos, across_ - 0.1 * sin), name, PAPER, ImageFont.load_default(12), "mm")
    # The words: the time, and the headline in the largest size that fits, without characters that the font lacks.
    pen.rectangle((0, 0, WIDTH, BAR - 1), fill=PAPER)
    printable = (char if char.isprintable() and ord(char) < 0x250 else "?" for char in finding.headline[:150])
    words = f"{finding.times[index]:.1f} s  {''.join(printable)}"
    legend = "line: the ego's plan" if finding.plans else ""
    fonts = [ImageFont.load_default(size) for size in (13, 12, 11, 10, 9, 8)]
    room = WIDTH - 20 - (fonts[2].getlength(legend) + 20 if legend else 0)
    font = next((font for font in fonts if font.getlength(words) <= room), fonts[-1])
    pen.text((10, BAR / 2), words, INK, font, "lm")
    pen.text((WIDTH - 10, BAR / 2), legend, INK, fonts[2], "rm")
    return image


# The end of an episode of ordinary traffic, in the style of the pictures of findings.

FRAMES_PER_SECOND = 7
"""Approximate number of frames of a picture per second of the episode."""
NEAREST = 7
"""The number of other vehicles in a picture, which are the nearest to the ego at the end of the episode."""


def drawn_episode(episode: Episode, headline: str) -> bytes:
    """Return an APNG of the last seconds of a recorded episode.

    Raises:
        RequestError: if Pillow is not installed.
    """
    if episode.recording is None:
        raise ValueError("episode: expected an episode with a recording; drive it with is_recorded=True")
    recording = episode.recording
    states, hz, lanes = recording.states, recording.physics_hz, recording.lanes
    is_bent = bool(lanes[0].points)
    last = len(states) - 1
    ticks = sorted({*range(0, last + 1, max(1, round(hz / FRAMES_PER_SECOND))), last})
    distance = np.hypot(*(states[-1, 1:, :2] - states[-1, 0, :2]).T)
    shown = [0, *(np.argsort(distance, kind="stable")[:NEAREST] + 1)]  # NaN, a vehicle that has left, is sorted last
    view = RunView(
        name=f"seed-{episode.seed}",
        headline=headline,
        responsibility="none",
        road=RoadView(
            lanes=() if is_bent else tuple(lane.y for lane in lanes),
            lane_width=lanes[0].width,
            speed_limit=max(lane.speed_limit for lane in lanes),
            clearance=0.0,
            shapes=tuple(LaneView(points=lane.points, width=lane.width) for lane in lanes) if is_bent else (),
        ),
        vehicles=tuple(_vehicle(recording, int(index), ticks) for index in shown),
        times=tuple(round(tick / hz, 3) for tick in ticks),
        instructions=(),
        event=EventView(kind=str(episode.outcome), time=episode.seconds, npc=0 if len(shown) > 1 else None),
        yaml="",
        command="",
    )
    return animate(view)


def _vehicle(recording: EpisodeRecording, index: int, ticks: list[int]) -> VehicleView:
    length, width = recording.sizes[index]
    along, across, heading, speed = (
        tuple(round(float(value), 3) if np.isfinite(value) else None for value in column)
        for column in recording.states[ticks, index, :4].T
    )
    return VehicleView(
        name=f"NPC {index - 1}" if index else "ego",
        length=float(length),
        width=float(width),
        along=along,
        across=across,
        heading=heading,
        speed=speed,
    )
