"""Findings as animated pictures."""

import io
import sys
from dataclasses import replace

import pytest

from pytest_pafot.report.animation import AnimationError, animate, frame, shown_frames
from pytest_pafot.report.page_data import CheckView
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import HOSTILE, bend_trace, cut_in_trace, planned_trace, rear_trace, scenario, view_of
from tests.report.test_crossing_view import crash, mixed

images = pytest.importorskip("PIL.Image", reason="Pillow draws the animations")

INK, DANGER, NPC = (0x17, 0x1B, 0x20), (0xB3, 0x26, 0x1E), (0xB4, 0x48, 0x0A)
"""Colours of the ego, of the ego after a collision, and of NPC 0."""


def colours(image):
    """Return the number of pixels of each colour of an image."""
    return {colour: count for count, colour in image.convert("RGB").getcolors(1 << 20)}


def test_animation_has_all_frames_and_holds_the_impact():
    view = view_of(cut_in_trace())
    content = animate(view)
    picture = images.open(io.BytesIO(content))
    assert (picture.format, picture.is_animated) == ("PNG", True)
    durations = []
    for number in range(picture.n_frames):
        picture.seek(number)
        durations.append(picture.info["duration"])
    shown = [view.times[index] for index in shown_frames(view)]
    assert shown[-1] == view.event.time
    assert sum(durations) == pytest.approx(1000 * (shown[-1] - shown[0]) + 2500, abs=len(shown))
    assert durations[0] >= 2500
    assert content == animate(view)


def test_ego_is_red_in_the_first_picture_which_is_the_impact():
    view = view_of(cut_in_trace())
    first = colours(images.open(io.BytesIO(animate(view))))
    assert first[DANGER] > 100 < first[NPC]
    before = colours(frame(view, len(view.times) - 3))
    assert before[INK] > 100 < before[NPC]
    assert DANGER not in before


def test_the_plan_is_drawn_while_it_is_followed():
    view, plain = view_of(planned_trace()), view_of(cut_in_trace())
    with_line, without = (
        [colours(frame(each, index).crop((500, 26, 720, 500))).get(INK, 0) for index in range(20)]
        for each in (view, plain)
    )
    planned = [bool(view.planned(time)) for time in view.times[:20]]
    assert {True, False} == set(planned)
    assert [more > some + 100 for more, some in zip(with_line, without, strict=True)] == planned
    legend, nothing = (colours(frame(each, 3).crop((580, 0, 720, 26))) for each in (view, plain))
    assert len(legend) > 10
    assert len(nothing) == 1


def test_first_frame_is_the_moment_of_a_failed_check():
    view = view_of(rear_trace())

    def ahead(image):  # the road ahead of the vehicles, whose dashes move
        return image.convert("L").crop((450, 26, *image.size)).point(lambda light: 255 * (light > 245)).tobytes()

    for index in (4, 9):
        checked = replace(view, check=CheckView(name="gap", unit="m", value=2.0, time=view.times[index] + 0.01))
        first = ahead(images.open(io.BytesIO(animate(checked))))
        assert first == ahead(frame(view, index))
        assert first != ahead(frame(view, index + 1))


def test_vehicle_that_comes_late_has_its_colour():
    far = vehicle(200.0, 8.0, speed=0.0, ticks=150)
    view = view_of(trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=150), far, scenario=scenario([(2, 20.0)])))
    picture = images.open(io.BytesIO(animate(replace(view, event=replace(view.event, time=0.0)))))
    seen = []
    for number in range(picture.n_frames):
        picture.seek(number)
        seen.append(NPC in colours(picture))
    assert not seen[0]
    assert any(seen)


def test_vehicles_are_drawn_at_their_places():
    """The picture has 8 pixels for each metre, and the ego is in its middle."""
    image = frame(view_of(trace_of(vehicle(0.0, 4.0), vehicle(20.0, 8.0), scenario=scenario([(2, 20.0)]))), 0)
    ground = image.getpixel((360 + 8 * 10, image.height // 2))
    places = [(x, y) for x in range(720) for y in range(26, image.height) if image.getpixel((x, y)) == NPC]
    left, right = min(x for x, _ in places), max(x for x, _ in places)
    high, low = min(y for _, y in places), max(y for _, y in places)
    assert ((left + right) / 2 - 360) / 8 == pytest.approx(20.0, abs=0.2)
    assert (right - left) / 8 == pytest.approx(5.0, abs=0.3)
    assert (low - high) / 8 == pytest.approx(2.0, abs=0.3)
    egos = [y for y in range(26, image.height) if image.getpixel((345, y)) == INK]
    assert ((high + low) / 2 - (min(egos) + max(egos)) / 2) / 8 == pytest.approx(4.0, abs=0.2)
    assert ground not in (INK, NPC)


def test_animation_contains_only_end_of_a_long_run():
    two = [vehicle(x, 4.0, speed=20.0, ticks=300) for x in (0.0, 60.0)]
    view = view_of(trace_of(*two, scenario=scenario([(2, 20.0)])))
    view = replace(view, event=replace(view.event, time=15.0))
    times = [view.times[index] for index in shown_frames(view)]
    assert 9.0 <= times[0] <= 9.2
    assert times[-1] == pytest.approx(17.0, abs=0.2)


def test_bent_roads_and_crossings_are_drawn():
    for view in (view_of(bend_trace()), mixed(), crash()):
        assert len(colours(frame(view, 0))) > 4


def test_unknown_position_of_a_vehicle_is_left_out():
    view = view_of(cut_in_trace())
    lost = replace(view.vehicles[1], along=(None,) * len(view.times))
    assert NPC not in colours(frame(replace(view, vehicles=(view.vehicles[0], lost)), 0))


def test_any_headline_can_be_drawn():
    still = view_of(cut_in_trace())
    for text in HOSTILE:
        assert frame(replace(still, headline=text * 9), 0), text


def test_without_pillow_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(AnimationError, match=r"pip install 'pytest-pafot\[report\]'"):
        animate(view_of(cut_in_trace()))


def test_a_finding_that_nobody_saw_is_refused():
    with pytest.raises(AnimationError, match="received none"):
        animate(replace(view_of(cut_in_trace()), times=()))
