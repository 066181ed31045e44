"""A finding as an animated picture (APNG), for places that show no pages. Drawn by ``drawing``, with Pillow."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

from pytest_pafot.report.page_data import FindingView
from pytest_pafot.report.picture import picture_at

MAX_SECONDS = 8.0
"""Only so much of a longer run is shown."""

AFTER = 2.0
"""What is shown after the moment that a finding is about [s]; a collision ends its run."""

HOLD_MILLISECONDS = 2500
"""How long the last frame stays."""

MAX_BYTES = 300_000
"""Of a file; mail and code review refuse or shrink larger pictures."""

RATES = (8, 6, 4, 2, 1)
"""Frames per second; the first with which the file is small enough is taken."""


class AnimationError(RuntimeError):
    """An animation that cannot be made; the message says why and what to do."""


def animate(finding: FindingView) -> bytes:
    """The end of a finding's run as a file's content; the same view gives the same bytes with the same Pillow.

    Raises:
        AnimationError: without Pillow, for a finding without frames, or with more vehicles than a small file can show.
    """
    if not finding.times:
        raise AnimationError(
            f"finding: expected frames to draw, received none for {finding.id}; nobody saw a run of it"
        )
    drawing = _drawing()
    content: bytes = b""
    for rate in RATES:
        pictures = [picture_at(finding, time) for time in moments(finding, rate)]
        durations = [*[round(1000 / rate)] * (len(pictures) - 1), HOLD_MILLISECONDS]
        content = drawing.draw_animation(finding, pictures, durations)
        if len(content) <= MAX_BYTES:
            return content
    raise AnimationError(
        f"finding: expected a picture of at most {MAX_BYTES} bytes, received {len(content)} at one frame a second for "
        f"{finding.id} with {len(finding.vehicles)} vehicles; look at it in a page"
    )


def strip(finding: FindingView, times: Sequence[float]) -> bytes:
    """The moments of a finding's run at these times [s], one below the other, as a PNG file's content.

    Raises:
        AnimationError: without Pillow.
    """
    content: bytes = _drawing().draw_strip(finding, [picture_at(finding, time) for time in times])
    return content


def _drawing() -> ModuleType:
    try:
        return import_module("pytest_pafot.report.drawing")
    except ImportError as error:
        raise AnimationError(
            "expected Pillow to draw pictures, received an environment without it; "
            'install it with pip install "pytest-pafot[report]", or ask for a page: --pafot-report=report.html'
        ) from error


def moments(finding: FindingView, rate: int) -> tuple[float, ...]:
    """The times that are shown [s], so many a second: eight seconds up to the end, or to shortly after the moment."""
    end = min(finding.duration, max(finding.moment + AFTER, MAX_SECONDS))
    count = int(min(MAX_SECONDS, end) * rate + 1e-9)
    return tuple(round(end - step / rate, 6) for step in range(count, -1, -1))
