"""A finding as an animated picture (APNG), for places that cannot show an HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

from pytest_pafot.report.page_data import FindingView
from pytest_pafot.report.picture import picture_at
from pytest_pafot.support.ways_out import flag, install

MAX_SECONDS = 8.0
"""The length of the longest animation [s]. A longer run is cut at its start."""

AFTER = 2.0
"""Time shown after the moment of a failed check [s]. After a collision nothing is shown, because it ends the run."""

HOLD_MILLISECONDS = 2500
"""Time for which the last frame stays before the animation starts again [ms]."""

MAX_BYTES = 300_000
"""The largest allowed file [bytes]. Mail and code review refuse or shrink larger pictures."""

RATES = (8, 6, 4, 2, 1)
"""Frames per second, tried in this order until the file has at most ``MAX_BYTES``."""


class AnimationError(RuntimeError):
    """An animation that cannot be made; the message says why and what to do."""


def animate(finding: FindingView) -> bytes:
    """Draw the end of a finding's run, as the content of an APNG file.

    The first frame is the finding's moment, because previews and viewers without animations show only that one. With
    the same version of Pillow, equal views give equal bytes.

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
        times = moments(finding, rate)
        durations = [*[round(1000 / rate)] * (len(times) - 1), HOLD_MILLISECONDS]
        first = times.index(round(finding.moment, 6))  # It plays in a loop, so it may begin anywhere.
        pictures = [picture_at(finding, time) for time in times[first:] + times[:first]]
        content = drawing.draw_animation(finding, pictures, durations[first:] + durations[:first])
        if len(content) <= MAX_BYTES:
            return content
    raise AnimationError(
        f"finding: expected a picture of at most {MAX_BYTES} bytes, received {len(content)} at one frame a second for "
        f"{finding.id} with {len(finding.vehicles)} vehicles; look at it in a page"
    )


def strip(finding: FindingView, times: Sequence[float]) -> bytes:
    """Draw a finding's run at some times [s], one picture below the other, as the content of a PNG file.

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
            "expected Pillow to draw pictures, received a Python environment in which it is not installed; "
            f"install it with {install('report')}, or write a page with pytest instead: {flag('report', 'report.html')}"
        ) from error


def moments(finding: FindingView, rate: int) -> tuple[float, ...]:
    """Return the times of an animation's frames [s], at a rate [1/s]; the finding's moment is one of them.

    They cover ``MAX_SECONDS`` of the run, which end ``AFTER`` after the finding's moment, and not before
    ``MAX_SECONDS``.
    """
    end = min(finding.duration, max(finding.moment + AFTER, MAX_SECONDS))
    after = max(0, int((end - finding.moment) * rate + 1e-9))
    count = int(min(MAX_SECONDS, end) * rate + 1e-9)
    times = (round(finding.moment + step / rate, 6) for step in range(after - count, after + 1))
    return tuple(time for time in times if time >= 0)
