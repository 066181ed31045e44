"""Policies that draw random numbers: their findings have a rate, by which they are shrunk and replayed."""

import random
from dataclasses import replace
from itertools import count

import pytest

import pytest_pafot as pafot
from pytest_pafot.campaign.explore import replays_of, request_of
from pytest_pafot.campaign.later_shrinking import shrink_saved
from pytest_pafot.campaign.refine import confirming, simplest, steps
from pytest_pafot.campaign.refine.simplest import Simplest
from pytest_pafot.campaign.search_session import prepared
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.saved import saved_in
from pytest_pafot.corpus.writer import rewrite
from pytest_pafot.findings.failure_rate import FEW_RUNS, ODDS, FailureRate
from pytest_pafot.findings.shrink import OutOfBudget, Shrunk

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


OWN = random.Random(3)  # which nothing seeds, so it stands for os.urandom, but fails in the same way in each session


class Unrepeatable(Brakes):
    draw = OWN.random


def found(ads, folder, **settings):
    OWN.seed(3)
    options = SHORT | {"shrink_rollouts": 12, "stop_after": 1, "runs": 40} | settings
    result = pafot.explore(ads, holds=never_brakes, node_id=NODE_ID, corpus=str(folder), **options)
    (told,) = result.sightings
    assert load(told.file) == replace(told.finding, trace=None)
    return told


def saved_with(ads, folder, **settings):
    """Return the replays and the only saved scenario of a test with a policy."""
    request = request_of({"ads": ads, "runs": 1, "corpus": str(folder), **SHORT, **settings})
    replays = replays_of(request, never_brakes, NODE_ID, folder)
    (saved,) = saved_in(replays.harness.folder)
    return replays, saved


def replayed(ads, folder, **settings):
    replays, saved = saved_with(ads, folder, **settings)
    return replays.labelled(saved, "owner")


def test_a_finding_that_draws_repeats_at_its_seed_and_says_in_how_many_others_it_fails(tmp_path):
    told = found(Brakes, tmp_path)
    finding = told.finding
    assert finding.flaky is None
    assert finding.rate.runs == 20
    assert 8 <= finding.rate.failing <= 16
    assert told.finding.on_rate == f"fails in {finding.rate} other seeds ({finding.rate.in_general})"
    assert told.finding.on_rate in told.summary
    assert len(finding.scenario.npcs) == 1


def test_a_policy_that_draws_nothing_has_no_rate(tmp_path):
    class Always(Brakes):
        draw = staticmethod(lambda: 0.0)

    assert found(Always, tmp_path).finding.rate is None


def test_a_finding_that_does_not_repeat_has_a_rate_too_and_is_shrunk_by_it(tmp_path):
    told = found(Unrepeatable, tmp_path)
    assert told.finding.flaky == told.difference
    assert told.finding.on_rate.startswith(f"fails in {told.finding.rate} runs (95 %: ")
    assert 8 <= told.finding.rate.failing <= 18
    assert len(told.finding.scenario.npcs) == 1
    assert told.finding.original is not None


def test_a_finding_that_does_not_repeat_stays_as_it_was_found_if_it_is_too_rare_to_compare(tmp_path, monkeypatch):
    def seldom(*given):
        return FailureRate(failing=1, runs=60)
        yield

    monkeypatch.setattr(steps, "failure_rate", seldom)
    monkeypatch.setattr(simplest, "fails", lambda *given: False)  # in the runs that are to be compared
    told = found(Unrepeatable, tmp_path)
    assert told.finding.flaky
    assert told.finding.original is None
    assert told.finding.rate == FailureRate(failing=1, runs=60)


def test_a_finding_that_only_highway_envs_own_environment_does_not_show_has_no_rate(tmp_path, monkeypatch):
    monkeypatch.setattr("pytest_pafot.campaign.bench._difference_in_gym", lambda run, bench: "safe for 4.0 s")
    told = found(Brakes, tmp_path)
    assert told.difference == "in highway-env's own environment: safe for 4.0 s"
    assert told.finding.rate is None


class BrakesForTwo:
    """A policy that brakes in most runs if it sees two others, and seldom if it sees one."""

    draw = staticmethod(random.random)

    def __init__(self):
        self.drawn = self.draw()

    def __call__(self, seen):
        return (-3.0 if self.drawn < (0.6 if len(seen.others) > 1 else 0.05) else 0.0), 0.0


def test_what_few_lucky_runs_have_kept_is_taken_back_but_no_more(tmp_path, monkeypatch):
    is_as_often = FailureRate.is_as_often

    def lucky(rate, outcomes, *of_the_result):
        is_step = of_the_result == (FEW_RUNS, ODDS)
        return any(outcomes) or None if is_step else is_as_often(rate, outcomes, *of_the_result)

    monkeypatch.setattr(FailureRate, "is_as_often", lucky)
    finding = found(BrakesForTwo, tmp_path).finding
    assert len(finding.scenario.npcs) == 2
    assert finding.original is not None
    assert finding.rate.failing >= 10


def first_npc(sighting, scenario, *, is_cut, rollouts=1):
    shrunk = Shrunk(rollouts=rollouts)
    return Simplest(scenario=scenario, shrunk=shrunk, as_found=sighting.finding.rate, attempts=1, is_cut=is_cut)


def test_a_finding_that_is_again_as_it_was_found_has_the_rate_of_that_scenario(tmp_path, monkeypatch):
    """Its first turn ended with a simpler scenario in the file, which fails more rarely."""

    def simplest_of(sighting, original, state, *rest):
        saved.append(sighting.finding)
        state.answers[sighting.id] = []
        scenario = replace(original, npcs=original.npcs[:1], seed=len(saved))
        return first_npc(sighting, scenario, is_cut=sighting.finding.original is None)
        yield

    def compared(sighting, as_found, simplest, *rest):
        return simplest if sighting.finding.original is None else None
        yield

    saved = []
    monkeypatch.setattr(steps, "simplest_of", simplest_of)
    monkeypatch.setattr(confirming, "_failing_as_often", compared)
    finding = found(type("Unrepeatable", (BrakesForTwo,), {"draw": OWN.random}), tmp_path).finding
    assert saved[-1].original == finding.scenario
    assert saved[-1].rate.failing <= 6
    assert finding.rate.failing >= 10


def test_a_finding_whose_time_ended_at_nothing_that_fails_as_often_is_not_done(tmp_path, monkeypatch):
    def simplest_of(sighting, original, state, *rest):
        turns.append(1)
        state.answers[sighting.id] = []
        scenario = replace(original, npcs=original.npcs[:1])
        return first_npc(sighting, scenario, is_cut=len(turns) == 1, rollouts=len(turns))
        yield

    def compared(sighting, as_found, simplest, *rest):
        return None if len(turns) == 1 else simplest
        yield

    turns = []
    monkeypatch.setattr(steps, "simplest_of", simplest_of)
    monkeypatch.setattr(confirming, "_failing_as_often", compared)
    finding = found(Brakes, tmp_path).finding
    assert (len(finding.scenario.npcs), finding.shrunk.rollouts) == (1, 2)


def test_a_later_session_goes_on_measuring_how_often_a_finding_fails(tmp_path, monkeypatch):
    def session(name):
        options = SHORT | {"shrink_rollouts": 5, "stop_after": 1, "runs": 40}
        resume, corpus = str(tmp_path / f"{name} states"), str(tmp_path / name)
        result = pafot.explore(Brakes, holds=never_brakes, node_id=NODE_ID, corpus=corpus, resume=resume, **options)
        return result.summary.shrink_runs, result.sightings[0].file.read_text()

    def cut(turn, now):
        turn.is_over = next(attempts) >= 150
        if turn.is_over:
            raise OutOfBudget

    attempts = count()
    runs, text = session("whole")
    with monkeypatch.context() as patch:
        patch.setattr("pytest_pafot.campaign.refine.simplest.Turn.check", cut)
        assert session("parts")[0] == 20 + 150
    assert session("parts") == (runs - 150, text)


def test_a_file_whose_rate_is_of_many_runs_is_shrunk(tmp_path):
    told = found(Brakes, tmp_path, shrink_rollouts=0)
    rewrite(told.file, replace(load(told.file), rate=FailureRate(failing=60, runs=100)))
    replays, saved = saved_with(Brakes, tmp_path, shrink_rollouts=12)
    with prepared(replays.harness) as parts:
        *_, later = shrink_saved(parts, saved, path="")
    assert len(later.finding.scenario.npcs) == 1


@pytest.mark.parametrize("ads", [Brakes, Unrepeatable])
@pytest.mark.parametrize(
    ("then", "share", "label", "note"),
    [
        (12, 0.6, "still failing", ": as before, "),
        (12, 0.0, "fixed", ": here in less than 5.0 % of all, 95 % sure"),
        (18, 0.3, "still failing", ": better, "),
        (4, 0.95, "still failing", ": worse, "),
    ],
)
def test_a_replay_compares_rates(tmp_path, ads, then, share, label, note):
    told = found(ads, tmp_path, shrink_rollouts=0)
    rewrite(told.file, replace(load(told.file), rate=FailureRate(failing=then, runs=20)))
    now = replayed(type("Changed", (ads,), {"share": share}), tmp_path)
    assert now.label == label
    assert note in now.note
    assert now.verdict.failed == (label != "fixed")
    assert now.rate.runs == (59 if label == "fixed" else 20)


def test_other_draws_are_no_fix(tmp_path):
    class DrawsMore(Brakes):
        def __init__(self):
            while random.random() < 0.5:
                pass
            super().__init__()

    found(Brakes, tmp_path, shrink_rollouts=0)
    now = replayed(DrawsMore, tmp_path)
    assert (now.label, now.verdict.failed) == ("still failing", True)
    assert ": as before, " in now.note


def test_what_fails_too_rarely_is_not_called_fixed(tmp_path):
    told = found(Brakes, tmp_path, shrink_rollouts=0)
    rewrite(told.file, replace(load(told.file), rate=FailureRate(failing=0, runs=60)))
    now = replayed(type("Quiet", (Brakes,), {"share": 0.0}), tmp_path)
    assert (now.label, now.verdict.failed) == ("drifted", False)
    assert "fails in none of 60 seeds, none of 60 when it was found: as before" in now.note


@pytest.mark.processes
def test_isolation_and_workers_do_not_change_what_is_found(tmp_path):
    contents = set()
    for number, options in enumerate(({}, {"isolate": True}, {"workers": 2}, {"workers": 2, "isolate": True})):
        told = found(Brakes, tmp_path / str(number), shrink_rollouts=3, **options)
        contents.add(told.file.read_text())
        assert replayed(Brakes, tmp_path / str(number), **options).label == "still failing"
    assert len(contents) == 1
