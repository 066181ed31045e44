"""A search against a reference: what counts, what is counted separately, and what is refused."""

import functools
import importlib
import os

import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.searches import made_worse
from pytest_pafot.searches.harness import Harness, same_policy
from pytest_pafot.support.errors import OutOfTime, RequestError
from pytest_pafot.world.reference_drivers import REFERENCES
from tests.helpers.tables import table

SHORT = {"generations": 4, "genes": 2, "gene_seconds": 5, "npcs": 1, "shrink_runs": 20, "seed": 2}
ROAD = pafot.Highway(duration=10.0)
CAREFUL = REFERENCES["careful-human"]


def never_collides(run):
    assert not run.collision


class Counted:
    """Make careful drivers and count them."""

    runs = 0

    def __call__(self):
        self.runs += 1
        return CAREFUL()


class Dies:
    def __call__(self, observation):
        os._exit(3)


class Breaks:
    def __call__(self, observation):
        raise KeyError("lanes")


def returns_nothing():
    """Return nothing, though a factory should."""


def collides(ads, scenario):
    return pafot.Run(ROAD.rollout(scenario, ads)).collision is not None


def made_again():
    return constant_speed.make()


def test_between_equal_policies_there_is_nothing():
    exploration = pafot.explore(
        constant_speed.make, against=made_again, holds=never_collides, **SHORT
    )
    assert exploration.findings == ()
    assert exploration.summary.kinds["common"] > exploration.summary.failing == 0


def test_copy_of_a_package_is_the_same_policy_unless_its_data_differ(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    modules = {
        "__init__.py": "from .net import Planner\n",
        "net.py": "from pathlib import Path\nfrom . import limits\n\nWEIGHTS = Path(__file__).parent / 'w.npz'\n\n"
        "class Planner:\n    pass\n",
        "limits.py": "LIMIT = 1\n",
    }
    for package in ("now_policy", "old_policy", "other_limits", "other_weights"):
        (tmp_path / package).mkdir()
        for name, text in modules.items():
            (tmp_path / package / name).write_text(text)
        (tmp_path / package / "w.npz").write_text(str(package == "other_weights"))
    (tmp_path / "other_limits/limits.py").write_text("LIMIT = 2\n")
    now, *others = (
        importlib.import_module(name).Planner
        for name in ("now_policy", "old_policy", "other_limits", "other_weights")
    )
    assert [bool(same_policy(now, other)) for other in others] == [True, False, False]
    assert not same_policy(
        functools.partial(now, "old.zip"), functools.partial(others[0], "new.zip")
    )
    assert same_policy(functools.partial(now, "old.zip"), functools.partial(others[0], "old.zip"))


def test_same_policy_with_another_sight_is_another():
    late, later = (functools.partial(pafot.Perception, latency=latency) for latency in (0.3, 0.4))
    others = (late(Breaks), later(Breaks), Breaks, late(CAREFUL))
    assert [bool(same_policy(late(Breaks), other)) for other in others] == [
        True,
        False,
        False,
        False,
    ]
    assert same_policy(pafot.Perception(Breaks), Breaks)


def made_with(text):
    """Make a policy that crashes, unless the text says that it is careful."""
    return CAREFUL() if text == "with: care" else constant_speed.make()


def test_reference_may_have_an_argument():
    named = f"{__name__}:made_with:with: care"
    exploration = pafot.explore(constant_speed.make, against=named, holds=never_collides, **SHORT)
    assert exploration.findings
    assert {finding.expect.against for finding in exploration.findings} == {named}


def test_finding_fails_with_policy_and_passes_with_reference():
    exploration = pafot.explore(constant_speed.make, against=CAREFUL, holds=never_collides, **SHORT)
    assert exploration.findings
    for finding in exploration.findings:
        assert finding.shrunk.before
        assert [collides(ads, finding.scenario) for ads in (constant_speed.make, CAREFUL)] == [
            True,
            False,
        ]
        assert finding.expect.against == "pytest_pafot.world.reference_drivers:CarefulHuman"


def test_reference_runs_only_where_the_policy_fails(monkeypatch):
    monkeypatch.setattr(made_worse, "PAIRS", 1)
    reference = Counted()
    given = {**SHORT, "shrink_runs": 0}
    summary = pafot.explore(
        constant_speed.make, against=reference, holds=never_collides, **given
    ).summary
    # each finding is run once more at the end, and once for its moment
    again = 2 * len(summary.finds)
    compared = summary.paired.runs
    assert reference.runs == summary.failing + summary.kinds["common"] + again + compared
    assert summary.failing + summary.kinds["common"] < summary.runs
    assert summary.against == "the reference"


def test_reference_failing_on_repeat_makes_finding_flaky(monkeypatch):
    monkeypatch.setattr(made_worse, "PAIRS", 1)
    told = []
    summary = pafot.explore(
        constant_speed.make,
        against=lambda: Breaks() if any(isinstance(event, Seen) for event in told) else CAREFUL(),
        holds=never_collides,
        on_event=told.append,
        **SHORT | {"stop_after": 1, "shrink_runs": 0},
    ).summary
    assert [find.finding.flaky for find in summary.finds] == [
        "the reference failed when it ran again"
    ]


@table("kind", ["passed", "npc", "failed", "rejected", "skipped", "invalid"])
def test_failure_is_common_if_the_reference_does_not_pass_and_invalid_if_its_run_says_nothing(kind):
    verdict = Verdict(kind="failed", failure=Failure(kind="E")).beside(Verdict(kind=kind))
    expected = {"passed": "failed", "npc": "failed", "invalid": "invalid"}.get(kind, "common")
    assert (verdict.kind, verdict.failed) == (expected, expected == "failed")


@table(("against", "message"), [
    ("no_module:make", r"against: expected a module that can be imported, received 'no_module:make'"),
    ("example_ads.constant_speed:mak", r"against: expected a factory in the module.*Did you mean"),
    ("example_ads.constant_speed:__doc__", r"against: expected a factory, .* has the type str. Name a function"),
    ("old_ads", r"pafot\.explore\(against\): expected a factory, or its name as module:factory, received 'old_ads'"),
    (3, r"against: expected a factory such as .*, received 3"),
    (lambda model: model, r"^against \(the reference\): expected a factory that can be called without arguments"),
    (lambda: pytest.skip("old"), r"^against \(.*\): the factory of the reference raised Skipped.*, but a skip there"),
    (returns_nothing, r"^against \(tests\.searches\.test_against:returns_nothing\): expected the factory to"),
])  # fmt: skip
def test_what_is_no_factory_is_one_clear_error(against, message):
    with pytest.raises(RequestError, match=message):
        pafot.explore(constant_speed.make, against=against, holds=never_collides, **SHORT)


@pytest.mark.processes
def test_a_death_counts_if_the_reference_has_no_time_to_drive_its_scenario(monkeypatch):
    def run_out(harness, reference, scenario):
        raise OutOfTime

    monkeypatch.setattr(Harness, "judge_reference", run_out)
    found = pafot.explore(
        Dies, against=made_again, holds=never_collides, isolate=True, runs=2, npcs=1, world=ROAD
    )
    assert found.summary.failing == 2
    assert [each.expect.failure for each in found.findings] == ["ProcessCrash"]
