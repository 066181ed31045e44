"""The page of a failed check: its figures, its curve and the moment."""

from dataclasses import replace

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.verdict import CHECK_FAILED, Failure
from pytest_pafot.oracle.run import CheckFailed, Recording, Run, recorded
from pytest_pafot.report.page import finding_article, finding_list
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle
from tests.report.builders import as_seen, cut_in_trace, finding_of, view_of

TICKS = 300
"""The ticks of a run of 20 s, with a frame at every second one."""


def peaks(**values):
    """Return a value of 1 at each tick, except those named ``t17=...``."""
    array = np.ones(TICKS + 1)
    for name, value in values.items():
        array[int(name[1:])] = value
    return array


def checked(value, ticks=TICKS, **arguments):
    """Return the failed check of a run."""
    with recorded(Recording(hz=15, ticks=ticks)), pytest.raises(CheckFailed) as failed:
        pafot.check(value, **{"name": "jerk", "unit": "m/s^3"} | arguments)
    return failed.value.check


def shown(value, **arguments):
    """Return the view of a finding by that check."""
    trace = trace_of(vehicle(0.0, speed=20.0, ticks=TICKS), vehicle(50.0, speed=20.0, ticks=TICKS))
    check = checked(value, **arguments)
    failure = Failure(kind=CHECK_FAILED, message=str(check), assertion=check.name, check=check)
    given = finding_of(trace)
    finding = Finding.from_run(
        Run(trace), failure, test=given.test, world=given.world, found=given.found
    )
    return view_of(trace, finding, check=check, headline=str(check))


def test_worst_tick_has_its_own_frame_and_value():
    view = shown(peaks(t61=35.1, t62=20.0), at_most=20)
    frame = view.times.index(view.check.time)
    assert view.check.time == pytest.approx(61 / 15, abs=0.001)
    assert view.check.values[frame] == view.check.value == 35.1
    assert len(view.check.values) == len(view.times) == len(view.vehicles[0].speed)


def test_curve_has_worst_value_between_two_frames_and_intervals_in_which_bound_is_broken():
    check = shown(peaks(t61=-30, t91=-5, t92=2), at_least=-20).check
    assert sorted(set(check.values)) == [-30, -5, 1]
    view = shown(peaks(t30=21, t31=22, t32=21, t60=25, t300=21), at_most=20)
    assert view.check.broken == ((2.0, 2.133), (4.0, 4.0), (20.0, 20.0))


@table(("values", "bounds", "axis", "is_cut"), [
    (peaks(t9=35), {"at_most": 20}, (0, 40), (False, False)),
    (peaks(t9=0.2, t10=np.inf), {"at_least": 0.5}, (0.2, 1), (False, True)),
    (peaks(t9=35, t10=-500), {"at_most": 20}, (-40, 40), (True, False)),
    (peaks(t9=35, t10=-500), {"at_most": 20, "at_least": -30}, (-500, 100), (False, False)),
    (peaks(t9=np.nan), {"at_most": 20}, (1, 20), (False, False)),
    (np.full_like(peaks(t9=0), np.nan), {"at_most": 0.35}, (0.3, 0.45), (False, False)),
])  # fmt: skip
def test_check_curve_axis_covers_values_that_break_bound(values, bounds, axis, is_cut):
    check = shown(values, **bounds).check
    assert (check.low, check.high) == pytest.approx(axis)
    assert check.is_cut == is_cut
    assert all(value is None or check.low <= value <= check.high for value in check.values)


def test_single_number_and_values_of_unknown_ticks_have_no_curve():
    check = shown(35.1, at_most=20, at=4.2).check
    assert (check.value, check.at_most, check.time, check.values) == (35.1, 20.0, 4.2, ())
    assert shown(peaks(t61=35.1)[1::2], at_most=20).check.values == ()


def test_article_starts_with_check_value_bound_and_moment():
    article = finding_article(shown(peaks(t61=35.1, t62=20.0), at_most=20), 0)
    head, player, rest = article.replace("\u00a0", " ").partition('class="player"')
    assert player
    assert "4.1 s: jerk = 35.1 &gt; 20 m/s^3<" in head
    assert rest.partition('class="yaml"')[0].count("35.1") == 0
    assert "failed check" not in article  # each fact once


def test_a_collision_of_the_run_has_its_own_line_and_its_advice_is_not_the_checks():
    trace = cut_in_trace()
    check, collided = checked(3.0, trace.ticks, at_most=2.5), view_of(trace)
    view = view_of(trace, finding_of(trace), check=check, headline=str(check))
    assert view.deed == collided.deed != ""
    assert view.sentences == ()
    assert view.happened[0][1].endswith(" ".join(collided.sentences))
    article = finding_article(view, 0).replace("\u00a0", " ")
    # red, as a collision's
    assert f'{view.besides} <span class="deed">{collided.deed}</span></p>' in article
    assert article.count("deed") == 1
    places = ("</h2>", view.besides, 'class="player"', view.happened[0][0])
    assert sorted(places, key=article.index) == [*places]
    assert "for the collision" not in article


@pytest.mark.parametrize(("name", "unit"), [("min_ttc", "s"), ("min_distance", "m")])
def test_a_check_of_the_least_value_of_a_run_has_its_curve_and_says_from_when_it_fails(name, unit):
    trace = cut_in_trace()
    run, bound = Run(trace), 1.5
    check = checked(getattr(run, name), trace.ticks, name="room", unit=unit, at_least=bound)
    view = view_of(trace, finding_of(trace), check=check, headline=str(check))
    least = np.nanmin([npc.ttc if name == "min_ttc" else npc.gap for npc in run.npcs], axis=0)
    begin = np.flatnonzero(least < bound)[0] / 15
    assert f" {begin:.1f} s: room = " in view.headline
    assert (view.check.begin, view.check.time) == (round(begin, 3), round(least.argmin() / 15, 3))
    assert len(view.check.values) == len(view.times)
    other = view_of(trace, finding_of(trace), check=replace(check, value=1.2), headline="x")
    assert (other.check.values, other.check.time) == ((), None)
    assert f"room = 1.2 < 1.5 {unit}" in other.sentences[0]  # which its headline does not say


@pytest.mark.parametrize("at", [1.0, None])
def test_a_least_value_whose_time_the_user_gives_keeps_that_time_and_has_no_other_curve(at):
    trace = cut_in_trace()
    check = checked(Run(trace).min_ttc, trace.ticks, name="room", unit="s", at_least=1.5, at=at)
    view = view_of(trace, finding_of(trace), check=check, headline="x")
    assert (view.check.time == at, view.check.values == ()) == (
        (True, True) if at else (False, False)
    )


def test_list_calls_it_failed_check_and_the_article_alone_blames_for_a_collision():
    view = shown(peaks(t61=35.1), at_most=20)
    listed = finding_list([view, as_seen(view, finding={"id": "other"})])
    assert "2 failed checks" in listed
    assert "at fault" not in listed
    view = as_seen(
        view, finding={"expect": replace(view.seen.finding.expect, responsibility="npc")}
    )
    assert "1 failed check<" in finding_list([view])
    assert "<li>NPC " in finding_article(view, 0)
