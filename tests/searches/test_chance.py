"""Policies that draw random numbers: their findings have a rate."""

import random
import re
from dataclasses import replace
from pathlib import Path

import pytest

import pytest_pafot as pafot
from pytest_pafot.corpus.reader import load, saved_in
from pytest_pafot.corpus.writer import rewrite
from pytest_pafot.findings.finding import FailureRate
from pytest_pafot.findings.sighting import label
from pytest_pafot.searches.explore import replays_of, request_of
from pytest_pafot.searches.replays import note_on

SHORT = {"genes": 2, "gene_seconds": 2, "npcs": 2, "ego_lane": 1, "ego_speed": 22}
NODE_ID = "test_it.py::test_brakes"


def never_brakes(run):
    assert run.hardest_brake < 1


class Brakes:
    """A policy that brakes in some runs, by numbers from ``draw``."""

    draw = staticmethod(random.random)
    share = 0.6

    def __init__(self):
        self.acceleration = -3.0 if self.draw() < self.share else 0.0

    def __call__(self, seen):
        return self.acceleration, 0.0


# which nothing seeds, so it stands for os.urandom, but fails in the same way in each session
OWN = random.Random(3)


class Unrepeatable(Brakes):
    draw = OWN.random


def found(ads, folder, **settings):
    OWN.seed(3)
    options = SHORT | {"shrink_runs": 12, "stop_after": 1, "runs": 40} | settings
    result = pafot.explore(ads, holds=never_brakes, node_id=NODE_ID, corpus=str(folder), **options)
    (told,) = result.sightings
    assert load(Path(told.path)) == replace(told.finding, trace=None)
    return told


def saved_with(ads, folder, **settings):
    """Return the replays and the only saved scenario of a test with a policy."""
    request = request_of({"ads": ads, "runs": 1, "corpus": str(folder), **SHORT, **settings})
    replays = replays_of(request, never_brakes, NODE_ID, folder)
    (saved,) = saved_in(replays.harness.folder)
    return replays, saved


def replayed(ads, folder, **settings):
    replays, saved = saved_with(ads, folder, **settings)
    return replays.observed(saved, "owner")


def test_a_finding_that_draws_repeats_at_its_seed_and_says_in_how_many_others_it_fails(tmp_path):
    told = found(Brakes, tmp_path)
    finding = told.finding
    assert finding.flaky is None
    assert finding.rate.runs == 10
    assert 3 <= finding.rate.failing <= 9
    assert told.finding.on_rate == f"it fails with {finding.rate.failing} of 10 other seeds"
    assert told.finding.on_rate in told.remark
    assert len(finding.scenario.npcs) == 1


def test_a_policy_that_draws_nothing_has_no_rate(tmp_path):
    class Always(Brakes):
        draw = staticmethod(lambda: 0.0)

    assert found(Always, tmp_path).finding.rate is None


def test_a_finding_that_does_not_repeat_has_a_rate_too_but_is_not_shrunk(tmp_path):
    told = found(Unrepeatable, tmp_path)
    assert told.finding.on_rate == f"it fails in {told.finding.rate.failing} of 10 runs"
    assert 3 <= told.finding.rate.failing <= 9
    assert told.finding.shrunk is None


def test_a_finding_that_only_highway_envs_own_environment_does_not_show_has_no_rate(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(
        "pytest_pafot.searches.bench._difference_in_gym", lambda run, bench: "safe for 4.0 s"
    )
    told = found(Brakes, tmp_path)
    assert told.finding.flaky == "in highway-env's own environment: safe for 4.0 s"
    assert told.finding.rate is None


@pytest.mark.parametrize("ads", [Brakes, Unrepeatable])
@pytest.mark.parametrize(
    ("then", "share", "expected", "failing"),
    [(6, 0.6, "still failing", "[2-9]"), (6, 0.0, "passes", "none"), (2, 0.0, "drifted", "none")],
)
def test_a_replay_counts_failures(tmp_path, ads, then, share, expected, failing):
    told = found(ads, tmp_path, shrink_runs=0)
    rewrite(Path(told.path), replace(load(Path(told.path)), rate=FailureRate(failing=then)))
    replays, saved = saved_with(type("Changed", (ads,), {"share": share}), tmp_path)
    now = replays.observed(saved, "owner")
    assert label(now) == expected
    bound = r"(, so it occurs in at most 31 % of such seeds \(95 % confidence\))?"
    before = rf"failed (with|in) {then} of 10 (seeds|runs) when it was found"
    assert re.fullmatch(
        rf"{before}, and now fails (with|in) {failing} of 10 (seeds|runs){bound}",
        note_on(saved.finding, now),
    )
    assert now.ran.verdict.failed == (expected == "still failing")


@pytest.mark.processes
def test_isolation_and_workers_do_not_change_what_is_found(tmp_path):
    contents = set()
    for number, options in enumerate(
        ({}, {"isolate": True}, {"workers": 2}, {"workers": 2, "isolate": True})
    ):
        told = found(Brakes, tmp_path / str(number), shrink_runs=3, **options)
        contents.add(Path(told.path).read_text())
        assert label(replayed(Brakes, tmp_path / str(number), **options)) == "still failing"
    assert len(contents) == 1
