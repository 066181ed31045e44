"""The kit that checks a world accepts this package's worlds, and names the promise that a world breaks."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from pytest_pafot import Highway, NpcLimits, Outcome, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import ACCELERATION, LANE, SPEED, X
from pytest_pafot.testing import check_world
from tests.helpers.stopped_clock import StoppedClock
from tests.helpers.tables import table

pytestmark = pytest.mark.filterwarnings("ignore:check_world. no collision:RuntimeWarning")  # in runs of 4 s

SHORT = {"npcs": 2, "genes": 2, "gene_seconds": 2.0}
ROAD = Highway(duration=4.0, hang_limit=0.3)


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """Replace the clock: it advances only when the check has an ADS wait for its end, and then at once."""
    clock = StoppedClock(monkeypatch)
    monkeypatch.setattr("pytest_pafot.testing.time", SimpleNamespace(sleep=clock.sleep))


class Own:
    """A user's own world that keeps all promises; broken worlds derive from it."""

    speed_limit, longest_run, hang_limit = 26.8, 4.0, 0.3
    limits = NpcLimits()

    def __init__(self, number=1):
        self.number = number

    def rollout(self, scenario, ads_factory):
        return self.changed(ROAD.rollout(scenario, ads_factory))

    def changed(self, trace):
        return trace

    def to_dict(self):
        return {"number": self.number}

    @classmethod
    def from_dict(cls, data):
        return cls(**data)


def with_states(trace, change):
    states = trace.states.copy()
    change(states)
    return replace(trace, states=states)


@pytest.mark.parametrize(
    ("world", "given"),
    [
        (ROAD, {}),
        (Highway(duration=4.0, engine="highway-env"), {}),
        (World("highway-v0", duration=4.0, hang_limit=0.3), {"ads": lambda: lambda seen: 1}),
        (Own(), {}),
    ],
    ids=["Highway", "by highway-env's objects", "World", "of one's own"],
)
def test_a_world_that_keeps_its_promises_passes(world, given):
    check_world(world, runs=3, **SHORT, **given)


@pytest.mark.oracle
def test_environment_with_predefined_ego_start_passes():
    check_world(World("roundabout-v0", duration=4.0), runs=2, ads=lambda: lambda seen: 1, npcs=2)


class Recorded:
    """An environment whose traces are changed."""

    def __init__(self, world, change):
        self.world, self.change = world, change

    def __getattr__(self, name):
        return getattr(self.world, name)

    def rollout(self, scenario, ads_factory):
        return self.change(self.world.rollout(scenario, ads_factory))


@cache
def environment(env_id):
    return World(env_id, duration=3.0, hang_limit=0.3)


def constant_action():
    return lambda seen: 1


@pytest.mark.oracle
def test_an_environment_in_which_npcs_cross_passes():
    check_world(environment("intersection-v0"), runs=2, ads=constant_action, npcs=2)


@table(
    ("env_id", "change", "promise"),
    [
        ("intersection-v0", {"zones": ()}, "zones are those of the instructions"),
        ("intersection-v0", {"on_way": None}, "on_way has the places of crossing NPCs"),
        ("intersection-v0", {"track": None}, "track is recorded if an NPC crosses"),
        ("merge-v0", {"track": np.full((46, 3, 5), np.nan)}, "track has NaN only for crossing NPCs"),
    ],
)
def test_only_crossing_npcs_must_be_recorded_as_crossing(env_id, change, promise):
    def changed(trace):
        return replace(trace, **change) if any(trace.zones) or env_id == "merge-v0" else trace

    with pytest.raises(AssertionError, match=promise):
        check_world(Recorded(environment(env_id), changed), runs=2, ads=constant_action, npcs=2)


class Random(Own):
    runs = 0

    def changed(self, trace):
        self.runs += 1
        return with_states(trace, lambda states: np.add.at(states, (-1, 0, X), 1e-9 * self.runs))


class Forgets(Own):
    def changed(self, trace):
        return replace(trace, executed=replace(trace.executed, ego_speed=trace.executed.ego_speed - 1.0))


class Throws(Own):
    def rollout(self, scenario, ads_factory):
        trace = super().rollout(scenario, ads_factory)
        if trace.error is not None:
            raise ValueError(trace.error.message)
        return trace


class Swallows(Own):
    def changed(self, trace):
        return replace(trace, outcome=Outcome.SAFE, error=None) if trace.error else trace


class Harmed(Own):
    is_harmed = False

    def changed(self, trace):
        if self.is_harmed:
            trace = with_states(trace, lambda states: np.add.at(states, (-1, 0, X), 1.0))
        self.is_harmed |= trace.error is not None
        return trace


class Hangs(Own):
    guards_ads = True  # as it says, but its decisions may take 30 s

    def rollout(self, scenario, ads_factory):
        return Highway(duration=4.0).rollout(scenario, ads_factory)


class NoTrace(Own):
    def rollout(self, scenario, ads_factory):
        return super().rollout(scenario, ads_factory).states


class Unwritable(Own):
    def to_dict(self):
        return {"number": object()}


class Changed(Own):
    @classmethod
    def from_dict(cls, data):
        return cls(data["number"] + 1)


class Takes(Own):
    @classmethod
    def from_dict(cls, data):
        return cls(data["numbers"])


class Different(Own):
    def changed(self, trace):
        return trace if self.is_first else with_states(trace, lambda states: np.add.at(states, (-1, 0, X), 1.0))

    is_first = True

    @classmethod
    def from_dict(cls, data):
        again = cls(**data)
        again.is_first = False
        return again


def changing(name, **fields):
    """Return a class whose traces have other fields."""
    return type(name, (Own,), {"changed": lambda self, trace: replace(trace, **fields)})


def moving(name, change):
    """Return a class whose traces have other states."""
    return type(name, (Own,), {"changed": lambda self, trace: with_states(trace, change)})


def put(*place, value):
    def change(states):
        states[place] = value

    return change


def lost(self, trace):
    return replace(trace, states=trace.states[:, :-1], sizes=trace.sizes[:-1])


BROKEN = [
    (Random, "the same scenario gives the same trace"),
    (Forgets, "the scenario as executed gives the same trace"),
    (Throws, "a run ends in a trace, whatever the ADS does"),
    (Swallows, "an ADS that raises ends its run as ads_error"),
    (Harmed, "an ADS that raises does not affect the next run"),
    (Hangs, "an ADS that hangs ends its run as hang"),
    (NoTrace, "rollout returns a pafot.Trace"),
    (Unwritable, "to_dict returns plain data that a file can store"),
    (Takes, "from_dict accepts the data of to_dict"),
    (Changed, r"from_dict\(to_dict\(\)\) has the same data"),
    (Different, r"from_dict\(to_dict\(\)\) gives the same traces"),
    (type("Lost", (Own,), {"changed": lost}), "states contain the ego and each NPC"),
    (type("Longer", (Own,), {"longest_run": 3.0}), "no run is longer than longest_run"),
    (type("Lazy", (Own,), {"limits": NpcLimits(acceleration=0.1, braking=0.1)}), "the acceleration of NPCs is from"),
    (type("Gentle", (Own,), {"limits": NpcLimits(jerk=0.1)}), "the jerk of NPCs is from"),
    (type("Slow", (Own,), {"limits": NpcLimits(overspeed=1.0), "speed_limit": 15.0}), "the speed of NPCs is from"),
    (type("Straight", (Own,), {"limits": NpcLimits(heading=0.01)}), "the heading of NPCs is from"),
    (type("Stiff", (Own,), {"limits": NpcLimits(lateral_acceleration=0.1)}), "the lateral acceleration of NPCs is"),
    (
        changing("Renamed", scenario=Scenario(npcs=[[PositionInstruction(1, 9.0)]])),
        "trace.scenario is the requested scenario",
    ),
    (changing("Odd", ads_hz=7), "ads_hz divides physics_hz"),
    (changing("Collides", outcome=Outcome.COLLISION), "there is a collision if the outcome says so"),
    (changing("Pointlike", sizes=np.zeros((3, 2))), "vehicles have a length and a width"),
    (changing("Mute", arrivals=5), r"Run\(trace\).explain\(\) describes the run"),
    (moving("Holey", put(-1, 0, X, value=np.nan)), "states are finite"),
    (moving("Laneless", put(-1, 0, LANE, value=9)), "the column lane is an index of lanes, or -1"),
    (moving("Fast", put(0, 0, SPEED, value=9)), "the ego starts as fast as the scenario says"),
    (moving("Pushed", put(0, 0, ACCELERATION, value=1)), "acceleration and steering of the first row are 0"),
    (moving("Crowded", lambda states: np.copyto(states[0], states[0, :1])), "no vehicles touch at the start"),
]


@table(("broken", "promise"), BROKEN)
def test_broken_promise_of_a_world_is_named(broken, promise):
    with pytest.raises(AssertionError, match=f"^expected that {promise}"):
        check_world(broken(), runs=3, **SHORT)


@table("name", ["rollout", "to_dict", "speed_limit", "longest_run"])
def test_incomplete_world_is_refused_by_the_check(name):
    parts = {each: getattr(Own, each) for each in ("rollout", "to_dict", "speed_limit", "longest_run") if each != name}
    with pytest.raises(
        AssertionError, match=f"^expected that a world has all that a search needs, received no {name}$"
    ):
        check_world(type("Lacking", (), parts)())


def test_unsuitable_ads_is_distinguished_from_world_fault():
    with pytest.raises(
        AssertionError, match=r"the ADS of the check drives in this world, received .*; give a different ads="
    ):
        check_world(World("highway-v0", duration=4.0), runs=1, **SHORT)


def test_check_skips_hanging_if_it_takes_long(monkeypatch):
    monkeypatch.setattr("pytest_pafot.testing.time.sleep", lambda seconds: pytest.fail("tried"))
    check_world(Highway(duration=4.0), runs=1, **SHORT)
