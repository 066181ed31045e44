"""A finding as an animated picture (APNG), for places that show no pages. ``drawing`` draws it with Pillow."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

from pytest_pafot.report.page_data import FindingView
from pytest_pafot.report.picture import picture_at

MAX_SECONDS = 8.0
"""The longest part of a run that is shown [s]."""

AFTER = 2.0
"""Time that is shown after the moment that a finding is about [s]. A collision ends its run, so nothing follows it."""

HOLD_MILLISECONDS = 2500
"""Time for which the last frame stays [ms]."""

MAX_BYTES = 300_000
"""The largest allowed file; mail and code review refuse or shrink larger pictures."""

RATES = (8, 6, 4, 2, 1)
"""Frames per second, tried in this order; the first rate with a small enough file is used."""


class AnimationError(RuntimeError):
    """An animation that cannot be made; the message says why and what to do."""


def animate(finding: FindingView) -> bytes:
    """Return the end of a finding's run as the content of a file; equal views give equal bytes with the same Pillow.

    Raises:
        AnimationError: without Pillow, for a finding without frames, or with too many vehicles for a small file.
    """
    if not finding.times:
        raise AnimationError(
            f"finding: expected frames to draw, received none for {finding.id}; no run of it was recorded"
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
    """Draw the moments of a finding's run at these times [s] one below the other, as the content of a PNG file.

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
            'install it with pip install "pytest-pafot[report]", or write a page instead: --pafot-report=report.html'
        ) from error


def moments(finding: FindingView, rate: int) -> tuple[float, ...]:
    """Return the times of the frames [s] at a rate [1/s]: 8 s up to the end, or to shortly after the moment."""
    end = min(finding.duration, max(finding.moment + AFTER, MAX_SECONDS))
    count = int(min(MAX_SECONDS, end) * rate + 1e-9)
    return tuple(round(end - step / rate, 6) for step in range(count, -1, -1))
