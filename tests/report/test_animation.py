"""Findings as animated pictures."""

import io
import sys
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.report import animation
from pytest_pafot.report.animation import HOLD_MILLISECONDS, MAX_BYTES, AnimationError, animate, moments
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import HOSTILE, cut_in_trace, rear_trace, scenario, view_of

images = pytest.importorskip("PIL.Image", reason="Pillow draws the animations")


@pytest.fixture(scope="module")
def brief():
    """Return the last 0.8 s of the cut-in, which is quick to draw."""
    view = view_of(cut_in_trace())
    ticks = 12
    rows = cut_in_trace().states[-ticks - 1 :]
    trace = trace_of(*(rows[:, index] for index in range(3)), scenario=cut_in_trace().scenario, outcome="collision")
    return replace(view_of(trace), headline=view.headline)


@pytest.fixture(scope="module")
def drawn(brief):
    """Return the animation of the cut-in."""
    return animate(brief)


def frames(content):
    """Return the number of pictures in an animation, and how long each is displayed [ms]."""
    picture = images.open(io.BytesIO(content))
    durations = []
    for frame in range(getattr(picture, "n_frames", 1)):
        picture.seek(frame)
        durations.append(picture.info.get("duration", 0.0))
    return durations


def test_animation_has_all_moments_and_holds_the_last(brief, drawn):
    picture = images.open(io.BytesIO(drawn))
    assert picture.format == "PNG"
    assert picture.is_animated
    durations = frames(drawn)
    assert sum(durations) == (len(moments(brief, 8)) - 1) * 125 + HOLD_MILLISECONDS
    assert durations[-1] >= HOLD_MILLISECONDS


def test_the_same_finding_gives_the_same_bytes(brief, drawn):
    assert animate(brief) == drawn


def test_vehicles_and_impact_keep_their_colours(drawn):
    picture = images.open(io.BytesIO(drawn))
    picture.seek(picture.n_frames - 1)
    colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 16)}
    assert {(0x17, 0x1B, 0x20), (0xF0, 0xD2, 0xC0), (0xB4, 0x48, 0x0A), (0xB3, 0x26, 0x1E)} <= colours


def test_animation_contains_only_end_of_a_long_run():
    view = view_of(rear_trace())
    times = moments(view, 8)
    assert times[-1] == view.duration
    assert times[-1] - times[0] <= 8.0


def test_too_large_animation_has_fewer_frames_per_second(brief, monkeypatch):
    short = replace(brief, times=brief.times[:3])
    size = len(animate(short))
    for most, rate in ((size, 8), (size - 1, 6)):
        monkeypatch.setattr(animation, "MAX_BYTES", most)
        assert len(frames(animate(short))) == len(moments(short, rate))
    monkeypatch.setattr(animation, "MAX_BYTES", 1)
    with pytest.raises(AnimationError, match=r"at most 1 bytes, received \d+ at one frame a second for .* vehicles"):
        animate(short)


def test_busiest_picture_stays_below_limit_at_lowest_rate(monkeypatch):
    monkeypatch.setattr(animation, "RATES", animation.RATES[-1:])
    rng = np.random.default_rng(1)
    ticks = 150
    steady = 20 * np.arange(ticks + 1) / 15
    along, across = rng.uniform(-40, 40, (8, ticks + 1)), rng.uniform(-2, 14, (8, ticks + 1))
    wild = [vehicle(steady + along[npc], across[npc], heading=rng.uniform(-3, 3)) for npc in range(8)]
    chains = scenario(*([(cell, 20.0)] for cell in range(1, 9)))
    view = view_of(trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=ticks), *wild, scenario=chains))
    assert len(animate(view)) <= MAX_BYTES


def test_real_findings_stay_below_size_limit(monkeypatch):
    monkeypatch.setattr(animation, "RATES", (animation.RATES[0] // 8,))
    assert 8 * len(animate(view_of(cut_in_trace()))) < MAX_BYTES


def test_any_headline_can_be_drawn(brief):
    still = replace(brief, times=brief.times[:1])
    for text in HOSTILE:
        assert animate(replace(still, headline=text * 9)), text


def test_without_pillow_the_error_says_what_to_install(brief, monkeypatch):
    monkeypatch.delitem(sys.modules, "pytest_pafot.report.drawing", raising=False)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(AnimationError, match=r"pip install 'pytest-pafot\[report\]'"):
        animate(brief)


def test_a_finding_that_nobody_saw_is_refused(brief):
    with pytest.raises(AnimationError, match="received none"):
        animate(replace(brief, times=()))
