"""Runs, findings and searches in a notebook, and as pictures."""

import html
import io
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.corpus.writer import write
from pytest_pafot.report.animation import AnimationError
from tests.helpers.tables import table
from tests.report.builders import HOSTILE, cut_in_trace, finding_of, rear_trace


def page(value):
    """Return the page inside the frame that is a value's output."""
    frame = re.fullmatch(r'<iframe class="pafot-finding" [^<>]* srcdoc="([^"<>]*)"></iframe>', value._repr_html_())
    assert frame, "one frame and nothing beside it, which two outputs of a notebook might share"
    return html.unescape(frame[1])


def test_run_and_its_trace_display_the_same_page():
    trace = cut_in_trace()
    shown = page(pafot.Run(trace))
    assert shown == page(trace)
    assert pafot.Run(trace).explain().splitlines()[0] in html.unescape(shown)
    assert f"scenario {trace.executed.id}" in shown
    for word in ("Run it again", "Copy the file", 'class="test"', "1 run<"):
        assert word not in shown


@pytest.mark.parametrize("text", HOSTILE)
def test_words_of_an_ads_stay_words(text):
    def broken():
        def ads(observation):
            raise RuntimeError(text)

        return ads

    run = pafot.Run(pafot.Highway(duration=1.0).rollout(cut_in_trace().scenario, broken))
    frame = run._repr_html_()
    frame.encode()
    assert frame.count("<") == 2
    assert page(run).count("</script>") == 2


def test_finding_displays_its_run_or_its_expectation():
    trace = rear_trace()
    finding = finding_of(trace)
    alone, seen = page(finding), page(replace(finding, trace=trace))
    assert "There is no run to draw." in alone
    assert "There is no run to draw." not in seen
    for shown in (alone, seen):
        assert pafot.Run(trace).explain().splitlines()[0] in html.unescape(shown)
        assert "Copy the file" in shown
        assert "Run it again" not in shown


def test_finding_equals_itself_without_its_run(tmp_path):
    finding = finding_of(rear_trace(), world=pafot.Highway().to_dict())
    seen = replace(finding, trace=rear_trace())
    assert seen == finding
    path = tmp_path / f"{finding.id}.pafot.yaml"
    write(path, seen)
    assert pafot.load(path).finding == finding


def test_an_exploration_lists_its_findings_with_their_runs():
    def keeps_away(run):
        assert not run.collision

    settings = {"runs": 8, "population": 8, "genes": 1, "npcs": 4, "traffic": "paper", "shrink_rollouts": 2, "seed": 1}
    found = pafot.explore(lambda: lambda observation: (0.0, 0.0), holds=keeps_away, blame="any", **settings)
    assert len(found.findings) > 1
    assert all(finding.trace.outcome == "collision" for finding in found.findings)
    shown = page(found)
    assert 'class="embedded listed"' in shown
    assert [each.finding.id for each in found.told] == re.findall(r'data-key="([^"]*)"', shown)
    assert "There is no run to draw." not in shown
    assert page(found.findings[0]).startswith("<!doctype html>")


def test_run_pictures_can_be_displayed_and_saved(tmp_path):
    images = pytest.importorskip("PIL.Image", reason="Pillow draws them")
    run = pafot.Run(rear_trace())
    plotted = run.plot(times=[0.0, 1.0, run.duration])
    plotted.save(tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes() == plotted.content
    assert re.fullmatch(r"<PngPicture of \d+ kB>", repr(plotted))
    picture = images.open(io.BytesIO(plotted.content))
    frame = images.open(io.BytesIO(run.trace.plot(times=np.array([0.0]))._repr_png_()))
    assert picture.size == (frame.width, 3 * frame.height - 2 * 26)
    assert images.open(io.BytesIO(run.plot()._repr_png_())).height == 5 * frame.height - 4 * 26


def test_a_moving_picture_is_that_of_a_report(tmp_path):
    images = pytest.importorskip("PIL.Image", reason="Pillow draws them")
    trace = pafot.Highway(duration=1.0).rollout(cut_in_trace().scenario, lambda: lambda observation: (0.0, 0.0))
    moving = images.open(io.BytesIO(trace.animate()._repr_png_()))
    assert moving.is_animated
    assert moving.n_frames == 9


@table(
    ("draw", "said"),
    [
        (lambda run: run.plot(times=[99.0]), r"times: expected seconds from 0 to [\d.]+, received 99.0"),
        (lambda run: run.plot(times=[float("nan")]), "received nan"),
        (lambda run: run.plot(times=[]), "expected at least one time"),
        (lambda run: run.plot(times=[0.0]).save("run.gif"), "expected a name that ends in .png, received 'run.gif'"),
    ],
)
def test_a_picture_that_cannot_be_drawn_says_why(draw, said):
    pytest.importorskip("PIL", reason="Pillow draws them")
    with pytest.raises(ValueError, match=said):
        draw(pafot.Run(rear_trace()))


def test_without_pillow_a_plot_says_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "pytest_pafot.report.drawing", raising=False)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(AnimationError, match=r"pytest-pafot\[report\]"):
        rear_trace().plot()
