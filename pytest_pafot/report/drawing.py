"""Pictures of a finding, drawn with Pillow. This module is imported only if a picture is requested."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

from PIL import Image as Images
from PIL import ImageColor, ImageDraw, ImageFont
from PIL.Image import Image

from pytest_pafot.report.page_data import FindingView
from pytest_pafot.report.picture import DrawnCell, DrawnVehicle, Picture, Point, instruction_at

WIDTH = 720
SCALE = 8.0
"""Scale of the picture [px/m]."""

SMOOTH = 2
"""Factor by which a frame is drawn larger than needed. Reducing it afterwards makes the edges smooth."""

HEAD, FOOT, LINE = 26, 26, 16
"""Height of the line of text above the road, of the first line below it, and of each further line [px]."""
SPEEDS, COLUMN = 4, 163
"""Number of vehicles in each line below the road, and the width of their columns [px]."""
SHOULDER = 1.4
"""Width of the shoulders, the strips of road outside the outer lanes [m]."""
HALF_HEIGHT = 18.0
"""Length of road that the picture of a bent road shows above the ego, and also below it [m]."""
EGO_AT = 0.42
"""Position of the ego from the left edge of the picture, as a share of the picture's width."""
CROSSED_SCALE, CROSSED_HALF_HEIGHT, CROSSED_EGO_AT = 5.0, 45.0, 0.5
"""``SCALE``, ``HALF_HEIGHT`` and ``EGO_AT`` for runs in which a vehicle crosses the ego's way.

They show more of the road: with the usual values, the crossing vehicle would be visible only 2 s before contact.
"""

PAPER, ROAD, EDGE, DASH = "#fbfbfa", "#e6e8e9", "#8b939b", "#ffffff"
INK, SOFT, EGO_INK, DANGER = "#171b20", "#535c66", "#ffffff", "#b3261e"
NPC_INKS = ("#b4480a", "#00695c", "#6a3fa0", "#8a6100", "#0b5cad", "#a3195b", "#3d6b1f", "#5b4a42")
NPC_TINTS = ("#f0d2c0", "#bcd9d5", "#d8cbe6", "#e0d6bd", "#c0d5ea", "#e7c4d5", "#cddac5", "#d5d1cf")

OUTLINE = (-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)
WINDSCREEN = (0.2, -0.36), (0.34, -0.28), (0.34, 0.28), (0.2, 0.36)
"""Corners of the windscreen, which marks a vehicle's front; like ``OUTLINE`` in shares of its length and width."""


def draw_animation(finding: FindingView, pictures: Sequence[Picture], durations: Sequence[int]) -> bytes:
    """Draw the pictures of a finding as an APNG file that plays in a loop, and return the file's content.

    Each picture is shown for the duration at its place in ``durations`` [ms].
    """
    # One palette for all frames, so that colours do not flicker and the file stays small.
    palette = Images.new("P", (1, 1))
    palette.putpalette(_palette(len(finding.vehicles) - 1))
    frames = (Sheet(finding, picture).draw() for picture in pictures)
    first, *others = (frame.quantize(palette=palette, dither=Images.Dither.NONE) for frame in frames)
    content = io.BytesIO()
    first.save(content, "PNG", save_all=True, append_images=others, duration=list(durations), loop=0, optimize=True)
    return content.getvalue()


def draw_strip(finding: FindingView, pictures: Sequence[Picture]) -> bytes:
    """Draw pictures of a finding one below the other under one headline, as the content of a PNG file."""
    first, *others = (Sheet(finding, picture).draw() for picture in pictures)
    frames = [first, *(frame.crop((0, HEAD, WIDTH, frame.height)) for frame in others)]
    whole = Images.new("RGB", (WIDTH, sum(frame.height for frame in frames)))
    top = 0
    for frame in frames:
        whole.paste(frame, (0, top))
        top += frame.height
    content = io.BytesIO()
    whole.save(content, "PNG", optimize=True)
    return content.getvalue()


def _palette(npcs: int) -> list[int]:
    """Return the palette of a picture: red, green and blue of one colour after the other.

    It holds the pure colours and the blends of two colours that occur at smooth edges.
    """
    grounds, inks, tints = (
        [ImageColor.getrgb(colour) for colour in colours]
        for colours in ((PAPER, ROAD), (INK, SOFT, EDGE, DANGER, *NPC_INKS[:npcs]), (DASH, *NPC_TINTS[:npcs]))
    )
    edges = [
        tuple(round(a + (b - a) * share) for a, b in zip(ground, ink, strict=True))
        for ground in grounds
        for ink in inks
        for share in (0.33, 0.67)
    ]
    return [part for colour in dict.fromkeys([*grounds, *inks, *tints, *edges]) for part in colour]


class Sheet:
    """One frame of a picture while it is being drawn. Its methods convert metres to pixels of the finished frame."""

    def __init__(self, finding: FindingView, picture: Picture) -> None:
        self.finding = finding
        self.picture = picture
        self.is_bent = bool(finding.road.shapes)
        is_crossed = self.is_bent and finding.is_crossed
        self.scale, reach, self.ego_at = (
            (CROSSED_SCALE, CROSSED_HALF_HEIGHT, CROSSED_EGO_AT) if is_crossed else (SCALE, HALF_HEIGHT, EGO_AT)
        )
        across, half = picture.ego.across, finding.road.lane_width / 2
        lanes = finding.road.lanes
        self.left = across - reach if self.is_bent else min(lanes) - half
        self.right = across + reach if self.is_bent else max(lanes) + half
        self.bottom = HEAD + (self.right - self.left + 2 * SHOULDER) * self.scale
        self.height = math.ceil(self.bottom + FOOT + LINE * ((len(finding.vehicles) - 1) // SPEEDS))
        self.pointers: list[tuple[bool, float]] = []
        self.image = Images.new("RGB", (WIDTH * SMOOTH, self.height * SMOOTH), PAPER)
        self.pen = ImageDraw.Draw(self.image)

    def draw(self) -> Image:
        """Draw the frame in layers: the road first, the words last."""
        self._road()
        self._zones()
        self._cells()
        self._trails()
        self._targets()
        for vehicle, box in enumerate(self.picture.vehicles):
            if box is not None:
                self._vehicle(vehicle, box)
        if self.picture.impact is not None:
            x, y = self._at(*self.picture.impact)
            spikes = [(13 if spike % 2 == 0 else 6, spike * math.pi / 8) for spike in range(16)]
            star = [(x + radius * math.cos(angle), y + radius * math.sin(angle)) for radius, angle in spikes]
            self.pen.polygon(_large(star), fill=DANGER)
        self._words()
        return self.image.reduce(SMOOTH)

    def _road(self) -> None:
        if self.is_bent:
            # Every lane is painted three times, ever narrower: this leaves an outer edge and a line between two lanes.
            for more, ink in ((0.5, EDGE), (0.0, DASH), (-0.3, ROAD)):
                for shape in self.finding.road.shapes:
                    self._line([self._at(*point) for point in shape.points], ink, (shape.width + more) * self.scale)
            return
        top, bottom = self._y(self.left), self._y(self.right)
        self.pen.rectangle(_large([(0, top), (WIDTH, bottom)]), fill=ROAD)
        for y in (top, bottom):
            self._line([(0, y), (WIDTH, y)], EDGE, 2)
        first = math.floor((self.picture.ego.along - WIDTH * self.ego_at / self.scale) / 12) * 12
        for lane in self.finding.road.lanes[1:]:
            y = self._y(lane - self.finding.road.lane_width / 2)
            for start in range(first, first + math.ceil(WIDTH / self.scale) + 24, 12):
                self._line([(self._x(start), y), (self._x(start + 3), y)], DASH, 2)

    def _zones(self) -> None:
        """Draw the ways of crossing NPCs, and mark the part of each way that is in the ego's way."""
        zones = [(npc, each.zone) for npc, each in enumerate(self.finding.vehicles[1:]) if each.zone is not None]
        for npc, zone in zones if self.is_bent else ():
            area = [self._at(*point) for point in zone.area]
            self._line(area, NPC_TINTS[npc % 8], zone.width * self.scale)
        for npc, zone in zones if self.is_bent else ():
            for x, y in (self._at(*point) for point in zone.way):
                self.pen.ellipse(_large([(x - 1, y - 1), (x + 1, y + 1)]), fill=NPC_INKS[npc % 8])

    def _cells(self) -> None:
        for cell in self.picture.cells:
            if cell.exists and self.finding.instructions:  # ordinary traffic has no cells
                self._cell(cell, EDGE, 1, shrink=3)
                x, y = self._at(cell.along, cell.across)
                corner = self._x(cell.along - self.finding.vehicles[0].length / 2) + 7, y - 6
                self._text((x, y) if self.is_bent else corner, str(cell.cell), SOFT, 10, "mm")

    def _trails(self) -> None:
        for vehicle, trail in enumerate(self.picture.trails):
            points = [self._at(*point) for point in trail]
            if vehicle == 0 and len(points) > 1:
                self._line(points, EDGE, 2)
            for x, y in points[:-1:2] if vehicle else ():
                self.pen.ellipse(_large([(x - 1.2, y - 1.2), (x + 1.2, y + 1.2)]), fill=NPC_INKS[(vehicle - 1) % 8])

    def _targets(self) -> None:
        for npc, target in enumerate(self.picture.targets):
            box = self.picture.vehicles[npc + 1]
            if target is not None and box is not None:
                ink = NPC_INKS[npc % 8]
                self._cell(target, ink, 2, shrink=1)
                self._dashed(self._at(box.along, box.across), self._at(target.along, target.across), ink)

    def _vehicle(self, vehicle: int, box: DrawnVehicle) -> None:
        x, y = self._at(box.along, box.across)
        corners = self._corners(box, OUTLINE)
        if not all(0 <= x <= WIDTH and (not self.is_bent or HEAD <= y <= self.bottom) for x, y in corners):
            self._pointer(vehicle - 1, box, min(max(y, HEAD + 12), self.bottom - 12))
            return
        ink, tint = (INK, INK) if vehicle == 0 else (NPC_INKS[(vehicle - 1) % 8], NPC_TINTS[(vehicle - 1) % 8])
        self.pen.polygon(_large(corners), fill=tint)
        self._outline(box, ink, 2)
        self.pen.polygon(_large(self._corners(box, WINDSCREEN)), fill=PAPER)
        self._text((x, y), "E" if vehicle == 0 else str(vehicle - 1), EGO_INK if vehicle == 0 else INK, 12, "mm")
        told = instruction_at(self.finding, vehicle - 1, self.picture.time) if vehicle else None
        if told is not None and told[0].zone:
            words, away = f"{told[0].zone} {told[0].slot}", box.length * self.scale / 2 + 8
            half = self._width(words, 10) / 2 + 4
            y += away if y - away < HEAD + 8 else -away
            self._text((min(max(x, half), WIDTH - half), y), words, INK, 10, "mm", halo=2)

    def _words(self) -> None:
        if self.is_bent:  # A bent road would continue under the words.
            self.pen.rectangle(_large([(0, 0), (WIDTH, HEAD)]), fill=PAPER)
            self.pen.rectangle(_large([(0, self.bottom), (WIDTH, self.height)]), fill=PAPER)
        head = _cut(self.finding.headline, 150)
        size = next((size for size in (13, 12, 11, 10) if self._width(head, size) <= WIDTH - 20), 9)
        self._text((10, HEAD / 2), head, INK, size, "lm")
        foot = self.bottom + FOOT / 2
        self._text((10, foot), f"{self.picture.time:.1f} s", INK, 12, "lm")
        for vehicle, words in enumerate(speed_texts(self.finding, self.picture)):
            line, column = divmod(vehicle, SPEEDS)
            self._text((64 + COLUMN * column, foot + LINE * line), _cut(words, 27), SOFT, 12, "lm")

    def _pointer(self, npc: int, box: DrawnVehicle, y: float) -> None:
        """Draw an arrow at the edge for an NPC outside the picture, below earlier arrows at the same place."""
        ego = self.picture.ego
        is_behind = box.along < ego.along
        while any(side == is_behind and abs(other - y) < 16 for side, other in self.pointers):
            y += 1
        self.pointers.append((is_behind, y))
        edge, inward = (4, 1) if is_behind else (WIDTH - 4, -1)
        arrow = [(edge, y), (edge + 9 * inward, y - 7), (edge + 9 * inward, y + 7)]
        self.pen.polygon(_large(arrow), fill=NPC_INKS[npc % 8])
        away = f"{abs(box.along - ego.along):.0f} m {'behind' if is_behind else 'ahead'}"
        if self.is_bent:
            away = f"{math.dist((box.along, box.across), (ego.along, ego.across)):.0f} m away"
        label = f"NPC {npc}, {away}"
        self._text((edge + 14 * inward, y), label, INK, 12, "lm" if is_behind else "rm", halo=2)

    def _cell(self, cell: DrawnCell, ink: str, width: int, *, shrink: float) -> None:
        length = self.finding.vehicles[0].length
        side = self.finding.road.lane_width / 2 * self.scale - shrink
        if self.is_bent:
            self._outline(
                DrawnVehicle(cell.along, cell.across, cell.heading, length, 2 * side / self.scale), ink, width
            )
        else:
            y = self._y(cell.across)
            ends = [(self._x(cell.along - length / 2), y - side), (self._x(cell.along + length / 2), y + side)]
            self.pen.rounded_rectangle(_large(ends), 3 * SMOOTH, outline=ink, width=width * SMOOTH)

    def _outline(self, box: DrawnVehicle, ink: str, width: float) -> None:
        corners = self._corners(box, OUTLINE)
        self._line([*corners, corners[0]], ink, width)

    def _corners(self, box: DrawnVehicle, shares: Sequence[Point]) -> list[Point]:
        cos, sin = math.cos(box.heading), math.sin(box.heading)
        offsets = [(a * box.length, b * box.width) for a, b in shares]
        return [self._at(box.along + a * cos - b * sin, box.across + a * sin + b * cos) for a, b in offsets]

    def _dashed(self, start: Point, end: Point, ink: str) -> None:
        length, (x, y) = math.dist(start, end), start
        for first in range(0, int(length * SMOOTH), 10 * SMOOTH):
            shares = first / SMOOTH / length, min(1.0, (first / SMOOTH + 6) / length)
            self._line([(x + (end[0] - x) * share, y + (end[1] - y) * share) for share in shares], ink, 2)

    def _line(self, points: Sequence[Point], ink: str, width: float) -> None:
        self.pen.line(_large(points), fill=ink, width=round(width * SMOOTH), joint="curve")

    def _text(self, place: Point, words: str, ink: str, size: int, anchor: str, *, halo: int = 0) -> None:
        font = ImageFont.load_default(size * SMOOTH)
        at = place[0] * SMOOTH, place[1] * SMOOTH
        self.pen.text(at, words, fill=ink, font=font, anchor=anchor, stroke_width=halo * SMOOTH, stroke_fill=ROAD)

    def _width(self, words: str, size: int) -> float:
        return ImageFont.load_default(size * SMOOTH).getlength(words) / SMOOTH

    def _at(self, along: float, across: float) -> Point:
        return self._x(along), self._y(across)

    def _x(self, along: float) -> float:
        return WIDTH * self.ego_at + (along - self.picture.ego.along) * self.scale

    def _y(self, across: float) -> float:
        return HEAD + (across - self.left + SHOULDER) * self.scale


def _large(points: Sequence[Point]) -> list[Point]:
    """Convert points of the finished frame [px] to points of the enlarged drawing [px]; ``SMOOTH`` is the factor."""
    return [(x * SMOOTH, y * SMOOTH) for x, y in points]


def speed_texts(finding: FindingView, picture: Picture) -> list[str]:
    """Return a text with the speed [m/s] of each vehicle, and with where an NPC is driving to."""
    parts = [f"ego {picture.ego.speed:.1f} m/s"]
    for npc, box in enumerate(picture.vehicles[1:]):
        told = instruction_at(finding, npc, picture.time)
        row = told[0] if told is not None and told[1] == "approach" else None
        goal = "" if row is None else f" to cell {row.cell}" if row.cell else f" to {row.zone}" if row.zone else ""
        goal = f" to the {row.lane}" if row is not None and row.lane in ("left", "right") else goal
        parts.append(f"NPC {npc} " + ("unknown" if box is None else f"{box.speed:.1f} m/s{goal}"))
    return parts


def _cut(words: str, length: int) -> str:
    """Cut a line to a number of characters, and replace characters that the font lacks."""
    line = "".join(character if character.isprintable() and ord(character) < 0x250 else "?" for character in words)
    return line if len(line) <= length else line[: length - 3] + "..."
