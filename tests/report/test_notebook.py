"""Runs, findings and searches in a notebook."""

import html
import re
from dataclasses import replace

import pytest

import pytest_pafot as pafot
from pytest_pafot.corpus.writer import write
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
    assert [each.finding.id for each in found.sightings] == re.findall(r'data-key="([^"]*)"', shown)
    assert "There is no run to draw." not in shown
    assert page(found.findings[0]).startswith("<!doctype html>")
