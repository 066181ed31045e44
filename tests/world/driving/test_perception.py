"""An ADS with imperfect sight: its observations, in runs of each kind, against the true states in the trace."""

import functools
from collections import deque

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot
from pytest_pafot import PositionInstruction, Scenario
from pytest_pafot.model.trace import HEADING, SPEED, X, Y
from pytest_pafot.support.errors import AdsFactoryError, FieldError, WorldError
from pytest_pafot.world.driving.policy import sight_of
from tests.helpers.c_library import c_library
from tests.helpers.refusals import refused
from tests.helpers.tables import table
from tests.helpers.world_cases import changing_lanes

CHAINS = (
    ((5, 17.4), (4, 26.6), (4, 13.7)),
    ((4, 26.4), (3, 13.3), (2, 23.6)),
    ((3, 17.5), (2, 21.0), (3, 25.5)),
)
NPCS = [[PositionInstruction(*gene) for gene in chain] for chain in CHAINS]
SCENARIO = Scenario(npcs=NPCS, seed=11, ego_lane=1, ego_speed=22.0, gene_seconds=3.0)
NOISE = {"position": 0.5, "speed": 1.0}
EVERYTHING = {"range": 40.0, "latency": 0.5, "noise": NOISE, "dropout": 0.2}


class Watching:
    def __init__(self):
        self.shown = []
        self._drive = changing_lanes()

    def __call__(self, observation):
        self.shown.append(observation)
        return self._drive(observation)


def run(rollout, kind, **imperfections):
    """Return the trace of a run, and the ADS that drove it."""
    made = []

    def factory():
        made.append(kind())
        return made[-1]

    return rollout(SCENARIO, pafot.Perception(factory, **imperfections)), made[-1]


def delayed(rows, ticks):
    """Yield rows as a delay line releases them: the first one until it is full."""
    line = deque([rows[0]] * (ticks + 1), maxlen=ticks + 1)
    for row in rows:
        line.append(row)
        yield line[0]


PLANNERS = {
    "loop": pafot.Highway(duration=9.0).rollout,
    "gymnasium": pafot.Highway(duration=9.0).rollout_in_gym,
}


@table("way", PLANNERS)
def test_planner_sees_others_delayed_and_itself_exactly(way):
    trace, ads = run(PLANNERS[way], Watching, latency=0.5)  # 8 ticks, and decisions are 3 apart
    lines, columns = list(delayed(trace.npcs, 8)), [X, Y, HEADING, SPEED]
    assert len(ads.shown) > 20
    for decision, seen in enumerate(ads.shown):
        tick = 3 * decision
        assert seen.time == tick / 15
        assert seen.ego[:4] == tuple(trace.ego[tick, columns])
        assert [each[:4] for each in seen.others] == [*map(tuple, lines[tick][:, columns])]


@pytest.mark.parametrize("name", EVERYTHING)
def test_env_step_shows_a_planner_the_same(name):
    with c_library():
        (trace, first), (stock, again) = (
            run(way, Watching, **{name: EVERYTHING[name]}) for way in PLANNERS.values()
        )
    assert again.shown == first.shown != run(PLANNERS["loop"], Watching)[1].shown
    assert stock.states.tobytes() == trace.states.tobytes()


def test_range_applies_at_the_seen_moment():
    trace, ads = run(PLANNERS["loop"], Watching, latency=1.0, range=30.0)
    counts = set()
    for decision, seen in enumerate(ads.shown):
        then = trace.states[max(0, 3 * decision - 15)]
        near = np.hypot(*(then[1:, :2] - then[0, :2]).T) <= 30.0
        expected = [tuple(row[:2]) for row in then[1:][near]]
        assert [each[:2] for each in seen.others] == expected
        assert seen.ids == tuple(np.flatnonzero(near))
        counts.add(len(expected))
    assert len(counts) > 1


def test_vehicle_lane_is_that_of_its_seen_position():
    _, ads = run(PLANNERS["loop"], Watching, noise={"position": 3.0})
    for each in (other for seen in ads.shown for other in seen.others):
        assert each.lane == min(range(4), key=lambda lane, y=each.y: abs(y - 4.0 * lane))


class OfItsOwn:
    def __init__(self):
        self.closed = []

    def __call__(self, observation):
        return -1.0 if len(observation.others) % 2 else 0.5, 0.0

    def close(self):
        self.closed.append(True)


def test_perception_passes_questions_to_the_policy_factory():
    class Loading:
        def check_world(self, world):
            raise WorldError("lanes", "others", str(world.lanes))

        def __call__(self):
            return Watching()

    with refused("lanes") as caught:
        pafot.Highway().rollout(SCENARIO, pafot.Perception(Loading(), latency=0.2))
    assert caught.value.received == "4"


def test_ads_is_closed_and_gains_no_methods():
    _, ads = run(PLANNERS["loop"], OfItsOwn, latency=0.2)
    assert ads.closed == [True]
    assert not hasattr(pafot.Perception(Watching)(), "close")


REFUSED = {
    "a vehicle class": (lambda: pafot.Perception(IDMVehicle), AdsFactoryError),
    "another one": (lambda: pafot.Perception(pafot.Perception(Watching)), AdsFactoryError),
    "a number": (lambda: pafot.Perception(42), AdsFactoryError),
    "a negative latency": (lambda: pafot.Perception(Watching, latency=-1.0), FieldError),
    "a factory of a class": (pafot.Perception(lambda: IDMVehicle), AdsFactoryError),
    "a call with an observation": (lambda: pafot.Perception(Watching)("what is seen"), AdsFactoryError),
    "another world": (lambda: pafot.Perception(Watching)()("what is seen"), WorldError),
}  # fmt: skip


@table(("make", "error"), REFUSED.values())
def test_what_cannot_be_is_refused(make, error):
    with pytest.raises(error):
        make()


def hidden():
    return pafot.Perception(Watching, noise={"speed": 1.0})()


GYM = pafot.World("highway-v0", {"action": {"type": "DiscreteMetaAction"}})
POLICY = pafot.Perception(lambda: lambda observation: 1, latency=0.2)


@table("world", [pafot.Highway(), GYM, pafot.World("merge-v0")])
def test_hidden_perception_and_one_for_the_observations_of_an_environment_are_refused(world):
    runs = [(world.rollout, hidden), (world.rollout, pafot.Perception(hidden, latency=0.2))]
    for rollout, factory in (*runs, (GYM.rollout, POLICY), (GYM.rollout_in_gym, POLICY)):
        with pytest.raises(AdsFactoryError):
            rollout(SCENARIO, factory)


def test_functools_wrapper_reveals_the_perception_it_wraps():
    seeing = pafot.Perception(Watching, latency=0.2)

    @functools.wraps(seeing)
    def wrapper():
        return seeing()

    assert sight_of(wrapper) == seeing.sight
    assert PLANNERS["loop"](SCENARIO, wrapper).error is None
