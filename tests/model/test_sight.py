"""The sight of other vehicles, against statistics of many samples."""

import math
from fractions import Fraction

import numpy as np
import pytest

from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import FieldError
from tests.helpers.refusals import refused
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table

LENGTH, WIDTH = 5.0, 2.0


def states(*places):
    """Return the vehicles' states from x, y [m] and heading [rad], the ego first."""
    return np.array([(x, y, heading, 20.0, 0.0, LENGTH, WIDTH) for x, y, heading in places])


def seen(sight, *places, seed=1, tick=0):
    return [glimpse[0] for glimpse in sight.glimpses(states(*places), seed, tick)]


def test_vehicles_are_seen_up_to_the_range():
    places = (3.0, 4.0, 0.0), (3.0, 4.01, 0.0), (-5.0, 0.0, 0.0)
    assert seen(Sight(range=5.0), (0.0, 0.0, 0.0), *places) == [0, 2]


@pytest.mark.parametrize("seed", mostly_oracle([0, 7, 2**63 - 1], 2**63 - 1))
def test_noise_has_requested_deviation_and_no_bias(seed):
    sight = Sight(noise={"position": 0.5, "speed": 2.0})
    two = states((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 4.0, 0.0))
    looks = [sight.glimpses(two, seed, tick) for tick in range(2000)]
    errors = np.array([[each[1:] for each in look] for look in looks])
    count = errors[..., 0].size
    for column, deviation in enumerate((0.5, 0.5, 2.0)):
        values = errors[..., column].ravel()
        assert abs(values.mean()) < 4 * deviation / math.sqrt(count)
        assert abs(values.std() / deviation - 1) < 4 / math.sqrt(2 * count)
    assert abs(np.corrcoef(errors.reshape(2000, 6).T) - np.eye(6)).max() < 4.5 / math.sqrt(2000)


def test_each_vehicle_drops_out_independently_at_given_rate():
    sight, places = Sight(dropout=0.3), [(0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 4.0, 0.0)]
    looks = [seen(sight, *places, tick=tick) for tick in range(2000)]
    assert sum(0 in look for look in looks) / 2000 == pytest.approx(0.7, abs=0.04)
    assert sum(look == [0, 1] for look in looks) / 2000 == pytest.approx(0.49, abs=0.045)


def test_random_errors_depend_only_on_seed_and_tick():
    sight, places = Sight(noise={"speed": 1.0}), states((0.0, 0.0, 0.0), (9.0, 0.0, 0.0))
    forwards = [list(sight.glimpses(places, 5, tick)) for tick in range(4)]
    backwards = [list(sight.glimpses(places, 5, tick)) for tick in reversed(range(4))]
    assert forwards == backwards[::-1]
    assert forwards != [list(sight.glimpses(places, 6, tick)) for tick in range(4)]


def test_another_imperfection_leaves_the_noise_as_it_is():
    places = states((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 4.0, 0.0))
    alone = list(Sight(noise={"position": 1.0}).glimpses(places, 5, 3))
    for others in ({"dropout": 0.5}, {"range": 9.5}, {"latency": 1.0}):
        assert set(Sight(noise={"position": 1.0}, **others).glimpses(places, 5, 3)) <= set(alone)


@table(("latency", "ticks"), [(0.0, 0), (0.2, 3), (0.3, 5), (1 / 15, 1), (0.01, 1), (1.4, 21)])
def test_a_latency_lasts_to_the_next_whole_tick(latency, ticks):
    assert Sight(latency=latency).delay(15) == ticks


SIGHTS = {
    "perfect": Sight(),
    "late": Sight(latency=0.3),
    "short and with gaps": Sight(range=60.0, dropout=0.025),
    "noise of the speed": Sight(noise={"speed": 1.0, "position": 0.0}),
    "perfect in numbers": Sight(latency=0.0, noise={"speed": 0.0}),
    "all": Sight(range=60.0, latency=0.3, noise={"position": 0.5, "speed": 1.0}, dropout=0.1),
}


def test_numbers_of_any_kind_become_pythons_own():
    given = {"range": np.int64(50), "latency": np.float64(0.5), "dropout": Fraction(1, 4)}
    sight = Sight(noise={"speed": np.float32(1)}, **given)
    assert sight == Sight(range=50, latency=0.5, noise={"speed": 1.0}, dropout=0.25)
    told = [sight.range, sight.latency, sight.noise["speed"], sight.dropout]
    assert [type(each) for each in told] == [int, float, float, float]


INVALID = {
    "a negative latency": ({"latency": -0.1}, "latency"),
    "an endless latency": ({"latency": math.inf}, "latency"),
    "a negative range": ({"range": -1.0}, "range"),
    "a number as noise": ({"noise": 0.5}, "noise"),
    "noise of another kind": ({"noise": {"heading": 0.1}}, "noise"),
    "negative noise": ({"noise": {"position": -0.5}}, "noise.position"),
    "no number as noise": ({"noise": {"speed": math.nan}}, "noise.speed"),
    "more dropouts than looks": ({"dropout": 1.1}, "dropout"),
}


@table(("values", "field"), INVALID.values())
def test_invalid_sight_value_is_refused_by_name(values, field):
    with refused(field, FieldError):
        Sight(**values)
