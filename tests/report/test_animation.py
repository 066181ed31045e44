"""Findings as animated pictures."""

import io
import sys
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.report.animation import HOLD_MILLISECONDS, MAX_BYTES, AnimationError, animate, moments
from tests.report.builders import HOSTILE, cut_in_trace, rear_trace, scenario, view_of
from tests.support.traces import trace_of, vehicle

images = pytest.importorskip("PIL.Image", reason="Pillow draws the animations")


@pytest.fixture(scope="module")
def brief():
    """The last second and a half of the cut-in, so that drawing it is quick."""
    view = view_of(cut_in_trace())
    ticks = 22
    rows = cut_in_trace().states[-ticks - 1 :]
    trace = trace_of(*(rows[:, index] for index in range(3)), scenario=cut_in_trace().scenario, outcome="collision")
    return replace(view_of(trace), headline=view.headline)


def test_an_animation_has_all_moments_and_holds_the_last(brief):
    picture = images.open(io.BytesIO(animate(brief)))
    assert picture.format == "PNG"
    assert picture.is_animated
    shown = 0
    for frame in range(picture.n_frames):
        picture.seek(frame)
        shown += picture.info["duration"]
    expected = (len(moments(brief, 8)) - 1) * 125 + HOLD_MILLISECONDS
    assert shown == expected
    assert picture.info["duration"] >= HOLD_MILLISECONDS


def test_the_same_finding_gives_the_same_bytes(brief):
    assert animate(brief) == animate(brief)


def test_vehicles_and_impact_keep_their_colours(brief):
    picture = images.open(io.BytesIO(animate(brief)))
    picture.seek(picture.n_frames - 1)
    colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 16)}
    assert {(0x17, 0x1B, 0x20), (0xF0, 0xD2, 0xC0), (0xB4, 0x48, 0x0A), (0xB3, 0x26, 0x1E)} <= colours


def test_only_the_end_of_a_long_run_is_shown():
    view = view_of(rear_trace())
    times = moments(view, 8)
    assert times[-1] == view.duration
    assert times[-1] - times[0] <= 8.0


def test_the_busiest_picture_stays_below_the_limit():
    rng = np.random.default_rng(1)
    ticks = 150
    steady = 20 * np.arange(ticks + 1) / 15
    along, across = rng.uniform(-40, 40, (8, ticks + 1)), rng.uniform(-2, 14, (8, ticks + 1))
    wild = [vehicle(steady + along[npc], across[npc], heading=rng.uniform(-3, 3)) for npc in range(8)]
    chains = scenario(*([(cell, 20.0)] for cell in range(1, 9)))
    view = view_of(trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=ticks), *wild, scenario=chains))
    assert len(animate(view)) <= MAX_BYTES


def test_real_findings_stay_below_the_limit():
    assert len(animate(view_of(cut_in_trace()))) < MAX_BYTES


@pytest.mark.parametrize("text", HOSTILE)
def test_any_headline_can_be_drawn(brief, text):
    still = replace(brief, headline=text * 9, times=brief.times[:1])
    assert animate(still)


def test_without_pillow_the_error_says_what_to_install(brief, monkeypatch):
    monkeypatch.delitem(sys.modules, "pytest_pafot.report.drawing", raising=False)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(AnimationError, match=r'pip install "pytest-pafot\[report\]"'):
        animate(brief)


def test_a_finding_that_nobody_saw_is_refused(brief):
    with pytest.raises(AnimationError, match="received none"):
        animate(replace(brief, times=()))
