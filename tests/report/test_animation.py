"""Findings as animated pictures."""

import io
import sys
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot.report import animation
from pytest_pafot.report.animation import HOLD_MILLISECONDS, MAX_BYTES, AnimationError, animate, moments
from pytest_pafot.report.page_data import CheckView
from pytest_pafot.report.picture import picture_at
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import HOSTILE, bend_trace, cut_in_trace, rear_trace, scenario, view_of
from tests.report.test_crossing_view import crash, mixed

images = pytest.importorskip("PIL.Image", reason="Pillow draws the animations")
drawing = pytest.importorskip("pytest_pafot.report.drawing")


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


def test_animation_has_all_moments_and_holds_the_impact(brief, drawn):
    picture = images.open(io.BytesIO(drawn))
    assert picture.format == "PNG"
    assert picture.is_animated
    durations = frames(drawn)
    assert sum(durations) == (len(moments(brief, 8)) - 1) * 125 + HOLD_MILLISECONDS
    assert durations[0] >= HOLD_MILLISECONDS


def test_the_same_finding_gives_the_same_bytes(brief, drawn):
    assert animate(brief) == drawn


def test_vehicles_and_impact_keep_their_colours(drawn):
    picture = images.open(io.BytesIO(drawn))
    colours = {colour for _, colour in picture.convert("RGB").getcolors(1 << 16)}  # of the first frame
    assert {(0x17, 0x1B, 0x20), (0xF0, 0xD2, 0xC0), (0xB4, 0x48, 0x0A), (0xB3, 0x26, 0x1E)} <= colours


def test_first_frame_is_the_moment_of_a_failed_check(monkeypatch):
    drawn = []
    monkeypatch.setattr(drawing, "draw_animation", lambda _, *frames: drawn.extend(zip(*frames, strict=True)) or b"")
    view = replace(view_of(rear_trace()), check=CheckView(name="gap", unit="m", value=2.0, time=1.3))
    animate(view)
    times = [picture.time for picture, _ in drawn]
    assert times[0] == 1.3
    assert sorted(times) == list(moments(view, 8))
    assert dict(zip(times, [duration for _, duration in drawn], strict=True))[max(times)] == HOLD_MILLISECONDS


def test_every_text_is_whole_inside_the_picture(monkeypatch):
    texts, draw = [], drawing.Sheet._text

    def recorded(sheet, place, words, ink, size, anchor, **more):
        texts.append((sheet, place[0], words, size, anchor))
        draw(sheet, place, words, ink, size, anchor, **more)

    monkeypatch.setattr(drawing.Sheet, "_text", recorded)
    long = "check 'a long name of a check that is sixty characters in all, so' 12.34 > 5 m/s^2 at 12.3 s (NPC 3)"
    for view in (crash(), mixed(), view_of(bend_trace()), replace(view_of(cut_in_trace()), headline=long)):
        drawing.draw_strip(view, [picture_at(view, time) for time in moments(view, 2)])
    for sheet, x, words, size, anchor in texts:
        width = sheet._width(words, size)
        left = x - {"l": 0, "m": width / 2, "r": width}[anchor[0]]
        assert 0 <= left <= left + width <= drawing.WIDTH, words
        assert not words.endswith("..."), words


def test_vehicle_that_would_be_cut_at_the_border_is_an_arrow():
    def colours(ahead):
        view = view_of(trace_of(vehicle(0.0, 4.0), vehicle(ahead, 4.0), scenario=scenario([(2, 20.0)])))
        content = drawing.draw_strip(view, [picture_at(view, 0.0)])
        return {colour for _, colour in images.open(io.BytesIO(content)).convert("RGB").getcolors(1 << 16)}

    tint = (0xF0, 0xD2, 0xC0)
    assert tint in colours(49.0)
    assert tint not in colours(51.0)  # 52.2 m are ahead of the ego's centre in the picture, and half a car is 2.5 m


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
