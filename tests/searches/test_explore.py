"""A search without pytest."""

import math
import shutil
import signal
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from highway_env.envs.highway_env import HighwayEnv
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.algorithms.evaluation import Evaluated
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import CorpusWriteError, write
from pytest_pafot.findings.finding import signature_of_failure
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.searches import explore
from pytest_pafot.searches.events import Search, SearchStarted
from pytest_pafot.searches.refine import simplest
from pytest_pafot.searches.search_session import Events, SearchSession, prepared
from pytest_pafot.support.errors import RequestError
from tests.helpers.tables import table

SHORT = {"runs": 8, "genes": 2, "gene_seconds": 5, "shrink_runs": 10}


def never_collides(run):
    assert not run.collision


@pytest.fixture(scope="module")
def heard():
    """Return the events that a listener to `exploration` receives."""
    return []


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    """Return the folder in which `exploration` saves its findings."""
    return tmp_path_factory.mktemp("saved")


@pytest.fixture(scope="module")
def exploration(heard, corpus):
    return pafot.explore(
        constant_speed.make,
        holds=never_collides,
        seed=5,
        on_event=heard.append,
        corpus=corpus,
        **SHORT,
    )


def test_candidates_that_outlast_the_simplest_failing_run_are_not_driven_to_their_end(monkeypatch):
    """Each decision of some policies takes a tenth of a second."""
    asked = [0]

    def keeps_speed(observation):
        asked[0] += 1
        return 0.0, 0.0

    given = SHORT | {"gene_seconds": 30, "shrink_runs": 40, "seed": 7, "vehicles": "car"}
    cut = pafot.explore(lambda: keeps_speed, holds=never_collides, **given)
    assert cut.summary.decisions.total() == asked[0]
    monkeypatch.setattr(simplest, "LATER", 1000.0)
    whole = pafot.explore(lambda: keeps_speed, holds=never_collides, **given)
    assert [each.scenario for each in cut.findings] == [each.scenario for each in whole.findings]
    assert [each.shrunk for each in cut.findings] == [each.shrunk for each in whole.findings]
    assert cut.summary.decisions["shrink"] < 0.75 * whole.summary.decisions["shrink"]


def test_its_findings_show_what_the_property_forbids(exploration):
    assert exploration.findings
    for finding in exploration.findings:
        run = pafot.Run(pafot.Highway(duration=20.0).rollout(finding.scenario, constant_speed.make))
        assert run.collision
        assert run.outcome == finding.expect.outcome


def test_table_has_a_row_for_each_tried_scenario(exploration):
    assert (
        len(exploration.runs)
        == exploration.summary.runs + exploration.summary.more_runs["known"]
        == 8
    )
    assert (
        sum(row["failing"] for row in exploration.runs if not row["reused"])
        == exploration.summary.failing
    )
    simulated = [row["outcome"] for row in exploration.runs if not row["reused"]]
    assert exploration.summary.outcomes == Counter(simulated)
    assert sum(exploration.summary.responsibilities.values()) == len(simulated)
    for row in exploration.runs:
        assert (row["outcome"] == "collision") == (row["collision_time"] is not None)
        assert math.isfinite(row["fitness"])
        assert row["duration"] <= 20.0


def test_events_equal_those_a_listener_hears(exploration, heard):
    runs = [event for event in heard if isinstance(event, Evaluated) and not event.reused]
    assert len(runs) == exploration.summary.runs
    assert list(exploration.events) == heard
    assert isinstance(heard[0], SearchStarted)
    assert isinstance(heard[-1], Search)
    assert {told.finding.id for told in heard if isinstance(told, Seen)} == {
        finding.id for finding in exploration.findings
    }


def test_a_listener_that_raises_stop_iteration_is_named():
    def listen(event):
        next(iter(()))

    with pytest.raises(RuntimeError, match=r"the listener .* raised StopIteration\(\)") as raised:
        pafot.explore(constant_speed.make, holds=never_collides, seed=5, on_event=listen, **SHORT)
    assert isinstance(raised.value.__cause__, StopIteration)


def test_a_search_whose_listener_raises_reports_what_it_has():
    heard = []

    def listen(event):
        heard.append(event)
        if isinstance(event, Evaluated):
            raise RuntimeError

    with pytest.raises(RuntimeError):
        pafot.explore(constant_speed.make, holds=never_collides, seed=5, on_event=listen, **SHORT)
    kinds = [type(event) for event in heard]
    assert kinds.count(Evaluated) == 1
    assert (kinds[-1], heard[-1].reason, heard[-1].runs) == (Search, "error", 1)


def test_an_interrupt_between_two_events_does_not_cost_the_summary(monkeypatch):
    heard, following = [], Events.__next__

    def next_or_interrupt(events):
        if sum(isinstance(event, Evaluated) for event in heard) == 1:
            monkeypatch.undo()
            raise KeyboardInterrupt
        return following(events)

    monkeypatch.setattr(Events, "__next__", next_or_interrupt)
    with pytest.raises(KeyboardInterrupt):
        pafot.explore(
            constant_speed.make, holds=never_collides, seed=5, on_event=heard.append, **SHORT
        )
    assert (type(heard[-1]), heard[-1].reason, heard[-1].runs) == (Search, "interrupted", 1)


def test_a_search_that_is_closed_keeps_the_findings_it_has(tmp_path):
    given = {"ads": constant_speed.make, "world": None, "seed": 5, "corpus": str(tmp_path), **SHORT}
    replays = explore.replays_of(
        explore.request_of(given), never_collides, "test_it.py::test_it", tmp_path
    )
    with prepared(replays.harness) as parts:
        watch = parts.watch("test_it.py::test_it", math.inf, progress_seconds=math.inf)
        happens = SearchSession(watch=watch, replays=replays).run()
        before = signal.getsignal(signal.SIGINT)
        found = next(event for event in happens if isinstance(event, Seen))
        happens.close()
    assert Path(found.path).is_file()
    assert signal.getsignal(signal.SIGINT) is before


def test_search_without_corpus_writes_nothing_but_finds_same(exploration, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (
        pafot.explore(constant_speed.make, holds=never_collides, seed=5, **SHORT).findings
        == exploration.findings
    )
    assert list(tmp_path.iterdir()) == []


def test_corpus_content_is_known_to_the_next_search(exploration, corpus, tmp_path, monkeypatch):
    files = sorted(corpus.rglob("*.pafot.yaml"))
    assert [pafot.load(file).finding for file in files] == sorted(
        exploration.findings, key=lambda finding: finding.id
    )
    shutil.copytree(corpus, tmp_path / "saved")
    monkeypatch.chdir(tmp_path)  # a corpus is a folder below the search's working directory
    again = pafot.explore(
        constant_speed.make, holds=never_collides, seed=5, corpus="saved", **SHORT
    )
    assert again.findings == ()
    assert sum(again.summary.known.values()) == again.summary.failing


def test_search_notes_once_which_traffic_is_missing():
    fields = {"holds": lambda run: None, "ads": lambda: lambda observation: 1, "runs": 2}

    def notes(world, **more):
        return pafot.explore(world=world, **fields, **more).summary.notes

    assert notes(pafot.World("merge-v0", duration=3.0)) == (
        "at merge-v0, all NPCs drive along the ego's path and none joins it, so the search shows nothing about such "
        "traffic",
    )
    # this algorithm needs the grid
    (note,) = notes(pafot.World("intersection-v0", duration=2.0), algorithm="pafot")
    assert (
        "at intersection-v0, all NPCs drive along the ego's path and none crosses it or joins it, "
        in note
    )
    assert notes(pafot.World("highway-fast-v0", duration=2.0)) == ()
    assert notes(pafot.World("intersection-v0", duration=2.0)) == ()


def test_search_names_once_the_options_that_have_no_effect():
    fields = {"holds": lambda run: None, "runs": 2}
    idle = lambda: lambda observation: 1  # noqa: E731

    def notes(config, ads=idle, planner_hz=None, **more):
        world = pafot.World("highway-fast-v0", config=config, duration=2.0, planner_hz=planner_hz)
        return pafot.explore(world=world, ads=ads, **fields, **more).summary.notes

    given = {
        "initial_lane_id": 0,
        "vehicles_count": 9,
        "vehicles_density": 2,
        "lanes_count": 4,
        "collision_reward": -9,
    }
    start = "these options of config= have no effect in a search: "
    traffic = "vehicles_count, vehicles_density (NPCs replace the environment's own traffic)"
    assert notes(given) == (f"{start}initial_lane_id (write ego_lane=0); {traffic}",)
    assert notes(given, ego_lane=0) == (f"{start}{traffic}",)
    assert notes({"offroad_terminal": False, "initial_lane_id": None, "policy_frequency": 5}) == ()
    why = "(the ego decides without the environment's observations and actions)"
    for ads, planner_hz in ((IDMVehicle, None), (lambda: lambda seen: (0.0, 0.0), 5)):
        assert notes({"policy_frequency": 5}, ads, planner_hz) == (
            f"{start}policy_frequency {why}",
        )


class Burning(HighwayEnv):
    """A straight road on which rewards burn fuel, which the observation shows."""

    def _reset(self):
        super()._reset()
        self.fuel = 1.0

    def define_spaces(self):
        super().define_spaces()
        stock = self.observation_type.observe
        self.observation_type.observe = lambda: np.concatenate([[[self.fuel] * 5], stock()])

    def _reward(self, action):
        self.fuel -= 0.1
        return 0.0


@pytest.fixture
def burning(monkeypatch):
    """Register an environment of a user, of which runs leave something out."""
    spec = gymnasium.envs.registration.EnvSpec("Burning-v0", Burning)
    monkeypatch.setitem(gymnasium.registry, "Burning-v0", spec)


BURNS = (
    "runs do not call the environment's own `_reward`, which may change `fuel`. If runs need this, write wrappers=[] "
    "in the pafot.World"
)


def test_search_names_what_of_an_environment_has_no_effect(burning):
    idle = lambda: lambda observation: 1  # noqa: E731

    def notes(ads=idle, **fields):
        world = pafot.World("Burning-v0", duration=2.0, **fields)
        return pafot.explore(world=world, ads=ads, holds=lambda run: None, runs=2).summary.notes

    assert notes() == (BURNS,)
    assert notes(wrappers=[]) == notes(IDMVehicle) == ()


def test_finding_that_differs_because_of_rewards_names_them(burning):
    def make():
        left = iter(range(20))

        def decide(observation):
            assert next(left) < 4 or observation[0, 0] < 1.0
            return 1

        return decide

    world = pafot.World("Burning-v0", duration=8.0)
    exploration = pafot.explore(
        world=world, ads=make, holds=lambda run: None, stop_after=1, **SHORT
    )
    (finding,) = exploration.findings
    assert finding.flaky.startswith("in highway-env's own environment: ")
    assert finding.flaky.endswith(f"; {BURNS}")


def test_setup_error_is_raised_unchanged():
    def misspelt(run):
        assert not run.colision

    with pytest.raises(AttributeError, match=r"Did you mean `run\.collision`") as raised:
        pafot.explore(constant_speed.make, holds=misspelt, seed=5, **SHORT)
    assert "not a finding" in raised.value.__notes__[0]


def test_takeover_is_told_of_collisions_alone():
    def keeps_apart(run):
        pafot.check(run.min_distance, name="distance", at_least=0.1)

    found = pafot.explore(constant_speed.make, holds=keeps_apart, seed=5, blame="ego", **SHORT)
    assert found.sightings[0].run.collision is not None
    assert found.findings[0].expect.takeover is None


def test_check_whose_failure_is_caught_finds_nothing():
    def holds(run):
        with suppress(AssertionError):
            pafot.check(run.duration, name="shorter", at_most=1.0)
        pafot.check(run.duration, name="longer", at_least=0.0)

    exploration = pafot.explore(constant_speed.make, holds=holds, seed=5, **SHORT)
    passed = exploration.summary.runs - exploration.summary.kinds["invalid"]
    assert exploration.findings == ()
    (warning,) = [each for each in exploration.summary.warnings if each.startswith("check")]
    assert (
        f"check 'shorter' failed in {passed} of {passed} runs that passed, because the test function caught it"
        in warning
    )


def test_a_failing_ads_is_avoided_by_no_takeover():
    class Raises:
        def __call__(self, observation):
            return [(0.0, 0.0)][int(observation.time > 1)]

    (finding,) = pafot.explore(Raises, holds=never_collides, seed=5, **SHORT).findings
    assert finding.expect.failure == "IndexError"
    assert finding.expect.takeover is None


@table(("arguments", "message"), [
    ({"generation": 3}, r"pafot\.explore\(generation=\.\.\.\): expected one of .*. Did you mean 'generations'"),
    ({"generations": "many"}, r"pafot\.explore\(generations=\.\.\.\): expected a whole number"),
    ({"generations": 0},
     r"pafot\.explore\(generations=0\): expected at least 1, because 0 generations test nothing"),
    ({"generations": "00"},
     r"pafot\.explore\(generations=0\): expected at least 1, because 0 generations test nothing"),
    ({"report": "page.html"}, r"pafot\.explore\(report=\.\.\.\): expected an argument of a search"),
    ({"blame": "preventable"}, r"\(blame=\.\.\.\): expected any or ego, received 'preventable'\. blame='ego'"),
    ({"world": 3}, r"pafot\.explore\(world=\.\.\.\): expected pafot\.Highway\(\.\.\.\), .*, received 3\. Derive"),
    ({"npcs": 99}, r"pafot\.explore\(npcs\): npcs: expected 1 to 8"),
    ({"fitness": "none"}, r"pafot\.explore\(fitness=\.\.\.\): fitness: expected 'default'"),
])  # fmt: skip
def test_a_wrong_argument_is_one_clear_error(arguments, message):
    with pytest.raises(RequestError, match=message):
        pafot.explore(constant_speed.make, holds=never_collides, **arguments)


def test_the_name_of_a_fixture_is_no_factory():
    with pytest.raises(RequestError, match=r"pafot\.explore\(ads\): expected a factory"):
        pafot.explore("ads", holds=never_collides)


def test_taken_finding_name_gets_the_next_number(exploration, tmp_path, monkeypatch):
    first = exploration.findings[0]
    other = replace(first, expect=replace(first.expect, failure="Another"))

    def late(path, finding):
        if not path.exists() and not path.stem.endswith("-2.pafot"):
            write(path, other)
        return write(path, finding)

    monkeypatch.setattr("pytest_pafot.searches.store.write", late)
    corpus = tmp_path / "saved"
    found = pafot.explore(
        constant_speed.make, holds=never_collides, seed=5, corpus=corpus, stop_after=1, **SHORT
    ).findings
    saved = {
        path.name.removesuffix(".pafot.yaml"): load(path) for path in corpus.rglob("*.pafot.yaml")
    }
    assert [finding.id for finding in found] == [name for name in saved if name.endswith("-2")]
    assert [saved[finding.id].scenario for finding in found] == [
        finding.scenario for finding in found
    ]


class ChangesLanesBlindly:
    """From 4 s on it alternates between two lanes every 5 s, and ignores all vehicles."""

    def __call__(self, observation):
        ego, to_left = observation.ego, observation.time % 10 < 4
        goal = observation.lane_width * (1 if to_left else 2)
        heading = max(-0.1, min(0.1, 0.03 * (goal - ego.y)))
        return 0.0, max(-0.1, min(0.1, 0.8 * (heading - ego.heading)))


SHORT_ROAD = pafot.Highway(duration=20.0)


@pytest.fixture(scope="module")
def mistakes(tmp_path_factory):
    """Return a search that finds several mistakes, and its corpus."""
    folder = tmp_path_factory.mktemp("mistakes")
    return mistakes_of_one_who_changes_blindly(seed=1, corpus=str(folder)), folder


def mistakes_of_one_who_changes_blindly(**settings):
    return pafot.explore(
        ChangesLanesBlindly, holds=never_collides, world=SHORT_ROAD, blame="ego", instructions="cells", genes=2, npcs=2,
        ego_lane=1, ego_speed=22, runs=32, shrink_runs=20, vehicles="car", **settings,
    )  # fmt: skip


def signature_of(scenario):
    return signature_of_failure(
        pafot.Run(SHORT_ROAD.rollout(scenario, ChangesLanesBlindly)), Failure(kind="AssertionError")
    )


def test_each_ego_mistake_is_one_finding_after_shrinking(mistakes):
    findings = mistakes[0].findings
    signatures = [signature_of(finding.scenario) for finding in findings]
    assert sorted(each.mistake for each in signatures) == [
        "kept-no-distance",
        "moved-in-front",
        "moved-into-side",
    ]
    for finding, signature in zip(findings, signatures, strict=True):
        assert finding.shrunk.before
        assert finding.id.startswith(f"{signature.slug}-")


def test_only_the_saved_mistake_is_known_later(mistakes, tmp_path):
    first, folder = mistakes
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    again = mistakes_of_one_who_changes_blindly(seed=2, corpus=str(tmp_path))
    assert again.findings == ()
    assert again.summary.known
    assert again.summary.known.keys() <= {finding.id for finding in first.findings}
    kept, gone, *_ = sorted(tmp_path.rglob("entered-lane-*.yaml"))
    accepted = kept.read_text().replace(
        "# xfail: {reason, until}", "xfail: {reason: ours, until: 9999-12-31}"
    )
    gone_mistake = signature_of(load(gone).scenario)
    kept.write_text(accepted)
    gone.unlink()
    (found,) = mistakes_of_one_who_changes_blindly(seed=3, corpus=str(tmp_path)).findings
    assert signature_of(found.scenario) == gone_mistake


def test_finding_is_told_as_shrunk_even_if_its_file_cannot_be_written_again(tmp_path, monkeypatch):
    def refuse(path, finding):
        raise CorpusWriteError(path, "to save a finding", "a read-only file system", "Mount it")

    monkeypatch.setattr("pytest_pafot.searches.store.rewrite", refuse)
    found = pafot.explore(
        constant_speed.make, holds=never_collides, seed=5, corpus=tmp_path, **SHORT
    )
    (first, *_) = found.sightings
    as_found = load(Path(first.path))
    assert (as_found.shrunk, bool(first.finding.shrunk.before)) == (None, True)
    assert "Mount it" in first.detail
