"""An ADS with a method ``close`` is closed once when its run is over, whatever the ending, also in ``env.step``."""

import functools
import itertools

import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import Outcome
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


DRIVES = ["rollout", "rollout_in_gym"]
ENDS = {
    "safe": (BESIDE, lambda: (0.0, 0.0), Outcome.COMPLETED),
    "collision": (BRAKED, lambda: (0.0, 0.0), Outcome.COLLISION),
    "raises": (BESIDE, raises, Outcome.ADS_ERROR),
    "bad action": (BESIDE, lambda: "left", Outcome.ADS_ERROR),
    "hangs": (BESIDE, None, Outcome.HANG),
}


@pytest.mark.parametrize(("scenario", "then", "outcome"), ENDS.values(), ids=ENDS)
@pytest.mark.parametrize("drive", DRIVES)
def test_it_is_closed_once_however_its_run_ends(scenario, then, outcome, drive, monkeypatch):
    run, log = getattr(Highway(), drive), []
    then = then or functools.partial(StoppedClock(monkeypatch).sleep, 1000.0)
    assert (run(scenario, lambda: Program(log, then)).outcome, log) == (outcome, ["closed"])


def test_interrupt_in_a_decision_closes_the_ads_and_one_in_closing_is_the_users():
    log = []
    with pytest.raises(KeyboardInterrupt):
        Highway().rollout(BESIDE, lambda: Program(log, lambda: raises(KeyboardInterrupt)))
    assert log == ["closed"]
    closing = Program([], end=lambda: raises(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        Highway(duration=1.0).rollout(BESIDE, lambda: closing)


ROUTES = [*itertools.product(["highway-v0", "roundabout-v0"], DRIVES, [False, True])]


@pytest.mark.parametrize(
    ("env_id", "drive", "inside"), mostly_oracle(ROUTES, *ROUTES[:3], ROUTES[4], ROUTES[7])
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
    scenario = Scenario(npcs=[[PositionInstruction(2, 20.0)]], gene_seconds=1.0)
    getattr(World(env_id, duration=1.0), drive)(scenario, factory)
    assert [each.log for each in made] == [["closed"]]


@pytest.mark.parametrize("end", [raises, None], ids=["raises", "hangs"])
def test_error_in_closing_is_only_a_warning(end, monkeypatch):
    end = end or functools.partial(StoppedClock(monkeypatch).sleep, 1000.0)
    with pytest.warns(RuntimeWarning):
        trace = Highway().rollout(BRAKED, lambda: Program([], end=end))
    assert trace.outcome is Outcome.COLLISION


def test_a_vehicle_class_is_not_closed():
    class Closing(IDMVehicle):
        def close(self):
            raise AssertionError("a class is no ADS of its own")

    assert Highway(duration=1.0).rollout(BESIDE, Closing).error is None
