"""A finding as an animated picture, for places that show no pages: APNG or GIF. The only module that knows Pillow."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

from pytest_pafot.report.page_data import FindingView
from pytest_pafot.report.picture import DrawnCell, DrawnVehicle, Picture, Point, instruction_at, picture_at

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

Format = Literal["apng", "gif"]

WIDTH = 720
SCALE = 8.0
"""Pixels per metre."""

MAX_SECONDS = 8.0
"""Only the end of a longer run is shown."""

HOLD_MILLISECONDS = 2500
"""How long the last frame stays."""

MAX_BYTES = 300_000
"""Of a file; mail and code review refuse or shrink larger pictures."""

RATES = (8, 6, 4, 2, 1)
"""Frames per second; the first with which the file is small enough is taken."""

SMOOTH = 2
"""Everything is drawn so many times larger, then reduced."""

HEAD, FOOT, SHOULDER = 26, 26, 1.4
HALF_HEIGHT = 18.0
"""What a picture of a road that is not straight shows above and below the ego [m]."""
EGO_AT = 0.42
"""Share of the width at which the ego is drawn."""

PAPER, ROAD, EDGE, DASH = "#fbfbfa", "#e6e8e9", "#8b939b", "#ffffff"
INK, SOFT, EGO_INK, DANGER = "#171b20", "#535c66", "#ffffff", "#b3261e"
NPC_INKS = ("#b4480a", "#00695c", "#6a3fa0", "#8a6100", "#0b5cad", "#a3195b", "#3d6b1f", "#5b4a42")
NPC_TINTS = ("#f0d2c0", "#bcd9d5", "#d8cbe6", "#e0d6bd", "#c0d5ea", "#e7c4d5", "#cddac5", "#d5d1cf")


class AnimationError(RuntimeError):
    """An animation that cannot be made; the message says why and what to do."""


def animate(finding: FindingView, kind: Format = "apng") -> bytes:
    """The end of a finding's run as a file's content; the same view gives the same bytes with the same Pillow.

    Raises:
        AnimationError: without Pillow, or for a finding without frames.
    """
    if kind not in ("apng", "gif"):
        raise AnimationError(f"kind: expected apng or gif, received {kind!r}")
    if not finding.times:
        raise AnimationError(
            f"finding: expected frames to draw, received none for {finding.id}; nobody saw a run of it"
        )
    pillow = _pillow()
    content = b""
    for rate in RATES:
        content = _encoded(pillow, finding, kind, rate)
        if len(content) <= MAX_BYTES:
            return content
    raise AnimationError(
        f"finding: expected a picture of at most {MAX_BYTES} bytes, received {len(content)} at one frame a second for "
        f"{finding.id} with {len(finding.vehicles)} vehicles; look at it in a page"
    )


def still(finding: FindingView, time: float) -> bytes:
    """One moment of a finding's run [s] as a PNG file's content.

    Raises:
        AnimationError: without Pillow, or for a finding without frames.
    """
    if not finding.times:
        raise AnimationError(
            f"finding: expected frames to draw, received none for {finding.id}; nobody saw a run of it"
        )
    content = io.BytesIO()
    _frame(_pillow(), finding, picture_at(finding, time)).save(content, format="PNG", optimize=True)
    return content.getvalue()


def moments(finding: FindingView, rate: int) -> tuple[float, ...]:
    """The times that are shown [s], so many a second: the last eight seconds, the very end among them."""
    end = finding.duration
    count = int(min(MAX_SECONDS, end) * rate + 1e-9)
    return tuple(round(end - step / rate, 6) for step in range(count, -1, -1))


def _encoded(pillow: Any, finding: FindingView, kind: Format, rate: int) -> bytes:
    frames = [_frame(pillow, finding, picture_at(finding, time)) for time in moments(finding, rate)]
    palette = pillow.Image.new("P", (1, 1))
    palette.putpalette(_palette(pillow, len(finding.vehicles) - 1))
    reduced = [frame.quantize(palette=palette, dither=pillow.Image.Dither.NONE) for frame in frames]
    content = io.BytesIO()
    reduced[0].save(
        content,
        format="PNG" if kind == "apng" else "GIF",
        save_all=True,
        append_images=reduced[1:],
        duration=[*[round(1000 / rate)] * (len(reduced) - 1), HOLD_MILLISECONDS],
        loop=0,
        optimize=True,
    )
    return content.getvalue()


def _palette(pillow: Any, npcs: int) -> list[int]:
    """Red, green and blue of every colour in a picture, one after the other: those drawn, and their smooth edges."""
    grounds = [PAPER, ROAD]
    inks = [INK, SOFT, EDGE, DANGER, *(NPC_INKS[npc % 8] for npc in range(npcs))]
    tints = [DASH, *(NPC_TINTS[npc % 8] for npc in range(npcs))]
    plain = [pillow.ImageColor.getrgb(colour) for colour in (*grounds, *inks, *tints)]
    edges = [
        tuple(round(a + (b - a) * share) for a, b in zip(plain[ground], ink, strict=True))
        for ground in range(len(grounds))
        for ink in plain[len(grounds) : len(grounds) + len(inks)]
        for share in (0.33, 0.67)
    ]
    return [part for colour in dict.fromkeys([*plain, *edges]) for part in colour]


def _pillow() -> Any:
    try:
        import PIL  # noqa: PLC0415
        import PIL.Image  # noqa: PLC0415
        import PIL.ImageColor  # noqa: PLC0415
        import PIL.ImageDraw  # noqa: PLC0415
        import PIL.ImageFont  # noqa: PLC0415
    except ImportError as error:
        raise AnimationError(
            "expected Pillow to draw animations, received an environment without it; "
            'install it with pip install "pytest-pafot[report]", or ask for a page: --pafot-report=report.html'
        ) from error
    return PIL


def _frame(pillow: Any, finding: FindingView, picture: Picture) -> Image:
    sheet = _Sheet(pillow, finding, picture)
    sheet.road()
    sheet.cells()
    sheet.trails()
    sheet.targets()
    for vehicle, box in enumerate(picture.vehicles):
        if box is not None:
            sheet.vehicle(vehicle, box)
    sheet.impact()
    sheet.words()
    return sheet.finished()


class _Sheet:
    """One frame in the making; lengths in metres become pixels here."""

    def __init__(self, pillow: Any, finding: FindingView, picture: Picture) -> None:
        self._pillow = pillow
        self._finding = finding
        self._picture = picture
        ego = picture.vehicles[0]
        self._origin = 0.0 if ego is None else ego.along
        half = finding.road.lane_width / 2
        if finding.road.shapes and ego is not None:
            self._left, self._right = ego.across - HALF_HEIGHT, ego.across + HALF_HEIGHT
        else:
            self._left, self._right = min(finding.road.lanes) - half, max(finding.road.lanes) + half
        self._road_height = (self._right - self._left + 2 * SHOULDER) * SCALE
        self._size = (WIDTH, math.ceil(HEAD + self._road_height + FOOT))
        large = (self._size[0] * SMOOTH, self._size[1] * SMOOTH)
        self._taken: list[tuple[bool, float]] = []
        self._image: Image = pillow.Image.new("RGB", large, PAPER)
        self._draw: ImageDraw = pillow.ImageDraw.Draw(self._image)

    def finished(self) -> Image:
        return self._image.reduce(SMOOTH)

    def road(self) -> None:
        if self._finding.road.shapes:
            self._shapes()
            return
        top, bottom = self._y(self._left), self._y(self._right)
        self._draw.rectangle((0, top, WIDTH * SMOOTH, bottom), fill=ROAD)
        for y in (top, bottom):
            self._line([(0, y), (WIDTH * SMOOTH, y)], EDGE, 2)
        for lane in self._finding.road.lanes[1:]:
            y = self._y(lane - self._finding.road.lane_width / 2)
            first = math.floor((self._origin - WIDTH * EGO_AT / SCALE) / 12) * 12
            for start in range(first, first + math.ceil(WIDTH / SCALE) + 24, 12):
                self._line([(self._x(start), y), (self._x(start + 3), y)], DASH, 2)

    def _shapes(self) -> None:
        """All lanes, with an edge around them and a line between neighbours."""
        for more, ink in ((0.5, EDGE), (0.0, DASH), (-0.3, ROAD)):
            for lane in self._finding.road.shapes:
                width = (lane.width + more) * SCALE * SMOOTH
                points = [self._place(point) for point in lane.points]
                self._draw.line(points, fill=ink, width=round(width), joint="curve")

    def _frame_around(self) -> None:
        """Cover what of a road that is not straight lies under the words."""
        large = (WIDTH * SMOOTH, self._size[1] * SMOOTH)
        self._draw.rectangle((0, 0, large[0], HEAD * SMOOTH), fill=PAPER)
        self._draw.rectangle((0, (HEAD + self._road_height) * SMOOTH, *large), fill=PAPER)

    def cells(self) -> None:
        for cell in self._picture.cells:
            if cell.exists:
                self._cell(cell, EDGE, 1, shrink=3)
                length = self._finding.vehicles[0].length
                corner = (self._x(cell.along - length / 2) + 7 * SMOOTH, self._y(cell.across) - 6 * SMOOTH)
                if self._finding.road.shapes:
                    corner = self._place((cell.along, cell.across))
                self._text(corner, str(cell.cell), SOFT, 10, "mm")

    def trails(self) -> None:
        for vehicle, trail in enumerate(self._picture.trails):
            points = [self._place(point) for point in trail]
            if vehicle == 0 and len(points) > 1:
                self._line(points, EDGE, 2)
            for x, y in points[:-1:2] if vehicle else ():
                self._dot(x, y, 1.2, NPC_INKS[(vehicle - 1) % 8])

    def targets(self) -> None:
        for npc, target in enumerate(self._picture.targets):
            box = self._picture.vehicles[npc + 1]
            if target is None or box is None:
                continue
            ink = NPC_INKS[npc % 8]
            self._cell(target, ink, 2, shrink=1)
            self._dashed(self._place((box.along, box.across)), self._place((target.along, target.across)), ink)

    def vehicle(self, vehicle: int, box: DrawnVehicle) -> None:
        x, y = self._place((box.along, box.across))
        is_high = self._finding.road.shapes and not HEAD * SMOOTH < y < (HEAD + self._road_height) * SMOOTH
        if is_high or not -60 * SMOOTH < x < (WIDTH + 60) * SMOOTH:
            self._pointer(vehicle, box, min(max(y, (HEAD + 12) * SMOOTH), (HEAD + self._road_height - 12) * SMOOTH))
            return
        corners = self._corners(box, (-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
        ink = INK if vehicle == 0 else NPC_INKS[(vehicle - 1) % 8]
        self._draw.polygon(corners, fill=INK if vehicle == 0 else NPC_TINTS[(vehicle - 1) % 8])
        self._line([*corners, corners[0]], ink, 2)
        self._draw.polygon(self._corners(box, (0.2, -0.36), (0.34, -0.28), (0.34, 0.28), (0.2, 0.36)), fill=PAPER)
        self._text((x, y), "E" if vehicle == 0 else str(vehicle - 1), EGO_INK if vehicle == 0 else INK, 12, "mm")

    def impact(self) -> None:
        if self._picture.impact is None:
            return
        x, y = self._place(self._picture.impact)
        radii = [(13 if spike % 2 == 0 else 6) * SMOOTH for spike in range(16)]
        star = [
            (x + radius * math.cos(spike * math.pi / 8), y + radius * math.sin(spike * math.pi / 8))
            for spike, radius in enumerate(radii)
        ]
        self._draw.polygon(star, fill=DANGER)

    def words(self) -> None:
        if self._finding.road.shapes:
            self._frame_around()
        self._text((10 * SMOOTH, HEAD * SMOOTH / 2), _cut(self._finding.headline, 88), INK, 13, "lm")
        foot = (HEAD + self._road_height + FOOT / 2) * SMOOTH
        self._text((10 * SMOOTH, foot), f"{self._picture.time:.1f} s", INK, 12, "lm")
        self._text((64 * SMOOTH, foot), _cut(_state(self._finding, self._picture), 110), SOFT, 12, "lm")

    def _pointer(self, vehicle: int, box: DrawnVehicle, y: float) -> None:
        ink = NPC_INKS[(vehicle - 1) % 8]
        is_behind = box.along < self._origin
        while any(side == is_behind and abs(other - y) < 16 * SMOOTH for side, other in self._taken):
            y += SMOOTH
        self._taken.append((is_behind, y))
        edge, inward = (4 * SMOOTH, SMOOTH) if is_behind else ((WIDTH - 4) * SMOOTH, -SMOOTH)
        tip = [(edge, y), (edge + 9 * inward, y - 7 * SMOOTH), (edge + 9 * inward, y + 7 * SMOOTH)]
        self._draw.polygon(tip, fill=ink)
        away = f"NPC {vehicle - 1}, {abs(box.along - self._origin):.0f} m {'behind' if is_behind else 'ahead'}"
        ego = self._picture.vehicles[0]
        if self._finding.road.shapes and ego is not None:
            away = f"NPC {vehicle - 1}, {math.dist((box.along, box.across), (ego.along, ego.across)):.0f} m away"
        self._text((edge + 14 * inward, y), away, INK, 12, "lm" if is_behind else "rm", has_halo=True)

    def _cell(self, cell: DrawnCell, ink: str, width: int, *, shrink: float) -> None:
        half = self._finding.vehicles[0].length / 2
        side = self._finding.road.lane_width / 2 * SCALE * SMOOTH - shrink * SMOOTH
        if self._finding.road.shapes:
            length, across = self._finding.vehicles[0].length, 2 * side / (SCALE * SMOOTH)
            box_of = DrawnVehicle(
                along=cell.along, across=cell.across, heading=cell.heading, length=length, width=across, speed=0.0
            )
            corners = self._corners(box_of, (-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
            self._line([*corners, corners[0]], ink, width)
            return
        y = self._y(cell.across)
        box = (self._x(cell.along - half), y - side, self._x(cell.along + half), y + side)
        self._draw.rounded_rectangle(box, 3 * SMOOTH, outline=ink, width=width * SMOOTH)

    def _corners(self, box: DrawnVehicle, *shares: Point) -> list[Point]:
        cos, sin = math.cos(box.heading), math.sin(box.heading)
        offsets = [(a * box.length, b * box.width) for a, b in shares]
        return [self._place((box.along + a * cos - b * sin, box.across + a * sin + b * cos)) for a, b in offsets]

    def _dashed(self, start: Point, end: Point, ink: str) -> None:
        length = math.dist(start, end)
        for at in range(0, int(length), 10 * SMOOTH):
            a, b = at / length, min(1.0, (at + 6 * SMOOTH) / length)
            piece = [(start[0] + (end[0] - start[0]) * t, start[1] + (end[1] - start[1]) * t) for t in (a, b)]
            self._line(piece, ink, 2)

    def _line(self, points: Sequence[Point], ink: str, width: int) -> None:
        self._draw.line(points, fill=ink, width=width * SMOOTH, joint="curve")

    def _dot(self, x: float, y: float, radius: float, ink: str) -> None:
        radius *= SMOOTH
        self._draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=ink)

    def _text(self, place: Point, words: str, ink: str, size: int, anchor: str, *, has_halo: bool = False) -> None:
        font = self._pillow.ImageFont.load_default(size * SMOOTH)
        halo = 2 * SMOOTH if has_halo else 0
        self._draw.text(place, words, fill=ink, font=font, anchor=anchor, stroke_width=halo, stroke_fill=ROAD)

    def _place(self, point: Point) -> Point:
        return self._x(point[0]), self._y(point[1])

    def _x(self, along: float) -> float:
        return (WIDTH * EGO_AT + (along - self._origin) * SCALE) * SMOOTH

    def _y(self, across: float) -> float:
        return (HEAD + (across - self._left + SHOULDER) * SCALE) * SMOOTH


def _state(finding: FindingView, picture: Picture) -> str:
    parts = [f"ego {picture.vehicles[0].speed:.1f} m/s"] if picture.vehicles and picture.vehicles[0] is not None else []
    for npc, box in enumerate(picture.vehicles[1:]):
        told = instruction_at(finding, npc, picture.time)
        goal = f" to cell {told[0].cell}" if told is not None and told[0].cell and told[1] == "approach" else ""
        parts.append(f"NPC {npc} " + ("unknown" if box is None else f"{box.speed:.1f} m/s{goal}"))
    return "   ".join(parts)


def _cut(words: str, length: int) -> str:
    """A line that fits, without characters that fonts lack."""
    line = "".join(character if character.isprintable() and ord(character) < 0x250 else "?" for character in words)
    return line if len(line) <= length else line[: length - 3] + "..."
