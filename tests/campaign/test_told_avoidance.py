"""All texts about a finding agree on the time from which braking avoids its collision."""

import re
from dataclasses import replace

import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.attribution.mistakes import Avoidance
from pytest_pafot.campaign.harness import Harness
from pytest_pafot.world import Highway

WORLD = Highway(duration=20.0)


def first(calls=None):
    """Return the first finding of a search that braking avoids; ``calls`` receives what each judged run knew of it."""

    def is_not_hit(run):
        if calls is not None:
            calls.append(run.avoided_by)
        assert not run.collision, run.explain()

    found = pafot.explore(
        constant_speed.make, holds=is_not_hit, world=WORLD, seed=5, runs=30, genes=2, blame="ego", shrink_rollouts=0
    )
    return next(told for told in found.sightings if told.finding.expect.avoided_by is not None)


def due(text):
    """Return the time by which the ego should have braked by a text; None if it says none."""
    found = re.search(r"should have braked (?:hard|harder) by ([\d.]+) s", " ".join(text.split()))
    return None if found is None else float(found[1])


@pytest.mark.parametrize("earlier", [0.0, 0.4, 30.0])
def test_message_of_finding_requires_no_later_braking(monkeypatch, earlier):
    """Here the simulation finds that braking avoids the collision only until a while before the rules require it."""
    by_rules = due(pafot.Run(first().run.trace).explain())
    latest = Avoidance(time=max(by_rules - earlier, 0.0), braking=6.0)
    monkeypatch.setattr(Harness, "avoidance", lambda *_: latest)
    told = first()
    texts = [str(told.raised), told.run.explain(), " ".join(told.run.sentences)]
    expected = None if earlier > 1.0 else pytest.approx(latest.time, abs=0.051)
    assert [due(text) for text in texts] == [expected] * 3
    assert told.finding.expect.sentences_on(replace(told.run, avoided_by=None))[1] == latest.sentence


def test_search_judges_again_only_if_simulation_is_earlier():
    calls = []
    told = first(calls)
    latest = told.finding.expect.avoided_by.time
    is_later = due(pafot.Run(told.run.trace).explain()) > latest + 0.051
    assert any(each is not None and each.time == latest for each in calls) == is_later
    assert due(told.run.explain()) <= latest + 0.051
