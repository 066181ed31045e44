"""An ADS with a method ``close`` is closed once when its run is over, whatever the ending, also in ``env.step``."""

import functools
import itertools

import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.world import Highway, World
from tests.helpers.stages import mostly_oracle
from tests.helpers.stopped_clock import StoppedClock

BRAKED = Scenario(npcs=[[PositionInstruction(2, 0.0)]], gene_seconds=8.0)
BESIDE = Scenario(npcs=[[PositionInstruction(4, 22.0)]], gene_seconds=2.0)


class Program:
    """An ADS that drives as given, for a second; it writes into a list when it is closed."""

    def __init__(self, log, then=lambda: (0.0, 0.0), end=lambda: None):
        self.log, self.then, self.end, self.asked = log, then, end, 0

    def __call__(self, observation):
        self.asked += 1
        assert not self.log, "asked after it was closed"
        return self.then() if self.asked > 5 else (0.0, 0.0)

    def close(self):
        self.log.append("closed")
        self.end()


def raises(error=LookupError):
    raise error("lost")


@pytest.mark.parametrize(
    ("scenario", "then", "outcome"),
    [
        (BESIDE, lambda: (0.0, 0.0), Outcome.COMPLETED),
        (BRAKED, lambda: (0.0, 0.0), Outcome.COLLISION),
        (BESIDE, raises, Outcome.ADS_ERROR),
        (BESIDE, lambda: "left", Outcome.ADS_ERROR),
        (BESIDE, None, Outcome.HANG),
    ],
    ids=["safe", "collision", "raises", "bad action", "hangs"],
)
@pytest.mark.parametrize("drive", ["rollout", "rollout_in_gym"])
def test_it_is_closed_once_however_its_run_ends(scenario, then, outcome, drive, monkeypatch):
    run, log = getattr(Highway(), drive), []
    then = then or functools.partial(StoppedClock(monkeypatch).sleep, 1000.0)
    assert (run(scenario, lambda: Program(log, then)).outcome, log) == (outcome, ["closed"])


def test_ads_is_closed_when_the_session_ends_inside():
    log = []
    with pytest.raises(KeyboardInterrupt):
        Highway().rollout(BESIDE, lambda: Program(log, lambda: raises(KeyboardInterrupt)))
    assert log == ["closed"]


@pytest.mark.parametrize(
    ("env_id", "drive", "inside"),
    mostly_oracle(
        itertools.product(
            ["highway-v0", "roundabout-v0"], ["rollout", "rollout_in_gym"], [False, True]
        ),
        ("highway-v0", "rollout", False),
        ("highway-v0", "rollout", True),
        ("highway-v0", "rollout_in_gym", False),
        ("roundabout-v0", "rollout", False),
        ("roundabout-v0", "rollout_in_gym", True),
    ),
)
def test_policies_and_planners_in_environment_are_closed(env_id, drive, inside):
    made = []

    class Policy(Program):
        def __call__(self, observation):
            super().__call__(observation)
            return 1

    def policy(**_):
        made.append(Policy([]))
        return made[-1]

    factory = (lambda env: policy(env=env)) if inside else policy
    getattr(World(env_id, duration=1.0), drive)(
        Scenario(npcs=[[PositionInstruction(2, 20.0)]], gene_seconds=1.0), factory
    )
    assert [each.log for each in made] == [["closed"]]


@pytest.mark.parametrize(
    ("end", "said"),
    [
        (raises, "no exception, received LookupError: lost"),
        (None, "a call that returns within 30 s"),
    ],
    ids=["raises", "hangs"],
)
def test_error_in_closing_is_only_a_warning(end, said, monkeypatch):
    world, end = Highway(), end or functools.partial(StoppedClock(monkeypatch).sleep, 1000.0)
    with pytest.warns(
        RuntimeWarning,
        match=rf"^ads\.close: expected .*{said}.*\. This does not change the result of the run",
    ):
        trace = world.rollout(BRAKED, lambda: Program([], end=end))
    assert trace.outcome is Outcome.COLLISION


def test_an_interrupt_in_closing_is_the_users():
    with pytest.raises(KeyboardInterrupt):
        Highway(duration=1.0).rollout(
            BESIDE, lambda: Program([], end=lambda: raises(KeyboardInterrupt))
        )


def test_a_vehicle_class_is_not_closed():
    class Closing(IDMVehicle):
        def close(self):
            raise AssertionError("a class is no ADS of its own")

    assert Highway(duration=1.0).rollout(BESIDE, Closing).error is None
