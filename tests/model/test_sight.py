"""The sight of other vehicles, against rays in small steps, and against statistics of many samples."""

import math
from collections import Counter
from fractions import Fraction
from itertools import permutations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pytest_pafot.model.sight import GHOST_AHEAD, GHOST_ASIDE, Sight, hidden
from pytest_pafot.support.errors import FieldError
from tests.helpers.polygons import corners
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table

LENGTH, WIDTH = 5.0, 2.0


def states(*places):
    """Return the vehicles' states from x, y [m] and heading [rad], the ego first."""
    return np.array([(x, y, heading, 20.0, 0.0, LENGTH, WIDTH) for x, y, heading in places])


def seen(sight, *places, seed=1, tick=0):
    return [glimpse.other for glimpse in sight.glimpses(states(*places), seed, tick)]


def hidden_by_rays(everybody, wider):
    """Follow each ray in steps of 2 cm to points of the target's box, past boxes that are wider by a margin [m]."""
    eye, found = everybody[0, :2], []
    boxes = [(row[:2], row[2], row[5] / 2 + wider, row[6] / 2 + wider) for row in everybody[1:]]
    for index, row in enumerate(everybody[1:]):
        blocked = []
        for end in [row[:2], *map(np.array, corners(row, row[5], row[6]))]:
            steps = np.linspace(0.0, 1.0, math.ceil(np.hypot(*(end - eye)) / 0.02) + 2)[:, None]
            points, inside = eye + steps * (end - eye), np.zeros(len(steps), dtype=bool)
            for other, (centre, heading, half_length, half_width) in enumerate(boxes):
                along = (points - centre) @ (math.cos(heading), math.sin(heading))
                across = (points - centre) @ (-math.sin(heading), math.cos(heading))
                inside |= (other != index) & (np.abs(along) < half_length) & (np.abs(across) < half_width)
            blocked.append(inside.any())
        found.append(all(blocked))
    return np.array(found)


PLACES = st.tuples(st.floats(-25.0, 25.0), st.floats(-9.0, 9.0), st.floats(-math.pi, math.pi))


@given(st.lists(PLACES, min_size=2, max_size=5))
@example([(0.0, 0.0, 0.0), (0.0, 5e-324, 0.0)])
def test_hidden_vehicles_match_rays_followed_step_by_step(places):
    everybody, margin = states((0.0, 0.0, 0.3), *places), 0.05
    found = hidden(everybody)
    assert (found <= hidden_by_rays(everybody, margin)).all()
    assert (found >= hidden_by_rays(everybody, -margin)).all()


def test_vehicle_ahead_of_the_leader_is_hidden():
    sight, ego, leader = Sight(occlusion=True), (0.0, 0.0, 0.0), (20.0, 0.0, 0.0)
    assert seen(sight, ego, leader, (40.0, 0.0, 0.0), (40.0, 4.0, 0.0)) == [0, 2]


def test_two_vehicles_together_hide_what_neither_hides_alone():
    behind, left, right = (30.0, 0.0, math.pi / 2), (10.0, -0.8, 0.0), (10.0, 1.0, 0.0)
    assert hidden(states((0.0, 0.0, 0.0), left, right, behind)).tolist() == [False, False, True]
    assert not hidden(states((0.0, 0.0, 0.0), left, behind)).any()


def test_vehicles_are_seen_up_to_the_range():
    assert seen(Sight(range=5.0), (0.0, 0.0, 0.0), (3.0, 4.0, 0.0), (3.0, 4.01, 0.0), (-5.0, 0.0, 0.0)) == [0, 2]


@pytest.mark.parametrize("seed", mostly_oracle([0, 7, 2**63 - 1], 2**63 - 1))
def test_noise_has_requested_deviation_and_no_bias(seed):
    sight, two = Sight(noise={"position": 0.5, "speed": 2.0}), states((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 4.0, 0.0))
    errors = np.array([[each[1:] for each in sight.glimpses(two, seed, tick)] for tick in range(2000)])
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
    added = {"shuffled": True, "ghosts": ALL.ghosts, "own_bias": ALL.own_bias}
    for others in ({"dropout": 0.5}, {"range": 9.5}, {"latency": 1.0}, added):
        assert set(Sight(noise={"position": 1.0}, **others).glimpses(places, 5, 3)) <= set(alone)


def test_order_of_two_vehicles_is_the_same_with_and_without_a_third():
    sight = Sight(shuffled=True)
    for tick in range(50):
        everybody = [(0, 1, 2, 3, 9)[place] for place in sight.order((0, 1, 2, 3, 9), 5, tick)]
        some = [(0, 2, 9)[place] for place in sight.order((0, 2, 9), 5, tick)]
        assert some == [each for each in everybody if each in (0, 2, 9)]


def test_every_order_is_as_likely():
    counts = Counter(tuple(Sight(shuffled=True).order((0, 1, 2), 5, tick)) for tick in range(6000))
    assert set(counts) == set(permutations(range(3)))
    assert max(abs(count - 1000) for count in counts.values()) < 4.5 * math.sqrt(1000 * 5 / 6)
    assert Sight().order((4, 2), 5, 1) == [0, 1]


GHOSTS = Sight(ghosts={"rate": 0.5, "lifetime": 2.0})


def test_ghosts_appear_at_the_rate_and_last_for_the_lifetime():
    """The mean number of ghosts is rate times lifetime (Little's law), and a few more are where the ego is."""
    ghosts = [{each.number for each in GHOSTS.ghosts_at(seed, 30.0)} for seed in range(3000)]
    assert np.mean([len(each) for each in ghosts]) == pytest.approx(1.0, abs=4 / math.sqrt(3000))
    later = [{each.number for each in GHOSTS.ghosts_at(seed, 32.0)} for seed in range(3000)]
    kept = sum(len(now & then) for now, then in zip(ghosts, later, strict=True)) / sum(map(len, ghosts))
    assert kept == pytest.approx(math.exp(-1), abs=0.04)


def test_a_ghost_keeps_its_speed_relative_to_the_ego_until_it_is_gone():
    seen = {}
    for tick in range(300):
        for ghost in GHOSTS.ghosts_at(3, tick / 10):
            seen.setdefault(ghost.number, []).append((tick, ghost))
    assert len(seen) > 8
    for looks in seen.values():
        (first, ghost), (last, later) = looks[0], looks[-1]
        assert later.ahead == pytest.approx(ghost.ahead + ghost.faster * (last - first) / 10)
        assert (later.right, later.faster) == (ghost.right, ghost.faster)
        assert abs(ghost.ahead) <= GHOST_AHEAD + abs(ghost.faster) / 10
        assert abs(ghost.right) <= GHOST_ASIDE


def test_no_ghost_is_beyond_the_range_or_in_the_ego():
    many = {"rate": 100.0, "lifetime": 5.0}
    near = list(Sight(range=20.0, ghosts=many).ghosts_at(1, 9.0))
    assert near == [each for each in Sight(ghosts=many).ghosts_at(1, 9.0) if math.hypot(each.ahead, each.right) <= 20]
    assert len(near) > 20
    assert all(abs(each.ahead) >= LENGTH or abs(each.right) >= WIDTH for each in near)


def test_own_errors_are_normal_and_last_a_run():
    errors = np.array([ALL.own_errors(seed) for seed in range(4000)]) / (0.3, 0.3, 0.01, 1.0)
    assert abs(errors.mean(axis=0)).max() < 4.5 / math.sqrt(4000)
    assert abs(errors.std(axis=0) - 1).max() < 4.5 / math.sqrt(8000)
    assert abs(np.corrcoef(errors.T) - np.eye(4)).max() < 4.5 / math.sqrt(4000)


def test_each_kind_of_chance_has_random_numbers_of_its_own(monkeypatch):
    """The ghosts, the order and the own errors of a seed are those that they are without anything else."""
    alone = [Sight(ghosts=ALL.ghosts, range=60.0), Sight(shuffled=True), Sight(own_bias=ALL.own_bias)]
    assert list(alone[0].ghosts_at(5, 8.0)) == list(ALL.ghosts_at(5, 8.0)) != []
    assert alone[1].order((0, 1, 2, 3), 5, 8) == ALL.order((0, 1, 2, 3), 5, 8)
    assert alone[2].own_errors(5) == ALL.own_errors(5)

    make, firsts = np.random.default_rng, []
    monkeypatch.setattr(np.random, "default_rng", lambda seeds: firsts.append(make(seeds).random()) or make(seeds))
    for tick in range(4):  # the numbers of the other kinds are small, as the first ticks are
        list(ALL.glimpses(states((0.0, 0.0, 0.0), (9.0, 0.0, 0.0)), 5, tick))
        ALL.order((0, 1), 5, tick)
    list(ALL.ghosts_at(5, 8.0))
    ALL.own_errors(5)
    assert len(set(firsts)) == len(firsts) == 10


@table(("latency", "ticks"), [(0.0, 0), (0.2, 3), (0.3, 5), (1 / 15, 1), (0.01, 1), (1.4, 21)])
def test_a_latency_lasts_to_the_next_whole_tick(latency, ticks):
    assert Sight(latency=latency).delay(15) == ticks


ALL = Sight(
    range=60.0,
    latency=0.3,
    noise={"position": 0.5, "speed": 1.0},
    dropout=0.1,
    occlusion=True,
    shuffled=True,
    ghosts={"rate": 0.5, "lifetime": 2},
    own_bias={"position": 0.3, "heading": 0.01, "speed": 1.0},
)


@table(
    ("sight", "text"),
    [
        (Sight(), "perfect sight"),
        (Sight(latency=0.3), "0.3 s of latency"),
        (Sight(range=60.0, dropout=0.025), "a range of 60 m and 2.5 % dropout"),
        (Sight(noise={"speed": 1.0, "position": 0.0}), "noise of 1 m/s"),
        (Sight(ghosts={"rate": 0.5, "lifetime": 0.0}, own_bias={"speed": 0.0}), "perfect sight"),
        (
            ALL,
            "a range of 60 m, 0.3 s of latency, noise of 0.5 m and 1 m/s, 10 % dropout, occlusion, a shuffled order, "
            "0.5 ghosts per second that last 2 s and an own bias of 0.3 m, 0.01 rad and 1 m/s",
        ),
    ],
)
def test_sight_is_described_by_its_imperfections(sight, text):
    assert sight.described() == text


def test_sight_can_be_restricted_to_some_imperfections():
    assert ALL.only(("latency", "occlusion")) == Sight(latency=0.3, occlusion=True)
    assert ALL.only(()) == Sight()
    assert ALL.described(("latency", "occlusion")) == "0.3 s of latency and occlusion"


def test_numbers_of_any_kind_become_pythons_own():
    sight = Sight(range=np.int64(50), latency=np.float64(0.5), noise={"speed": np.float32(1)}, dropout=Fraction(1, 4))
    assert sight == Sight(range=50, latency=0.5, noise={"speed": 1.0}, dropout=0.25)
    told = [sight.range, sight.latency, sight.noise["speed"], sight.dropout]
    assert [type(each) for each in told] == [int, float, float, float]


@table(
    ("values", "message"),
    [
        ({"latency": -0.1}, r"^latency: expected a finite number from 0 \[s\], received -0.1$"),
        ({"latency": math.inf}, "latency: expected a finite number"),
        ({"latency": True}, "latency"),
        ({"range": -1.0}, r"range: .* \[m\]"),
        ({"range": "far"}, "received 'far'"),
        ({"noise": 0.5}, 'noise: expected a mapping of "position" .m. and "speed" .m/s., one of them or both'),
        ({"noise": {"heading": 0.1}}, "received {'heading': 0.1}"),
        ({"noise": {"position": -0.5}}, r"noise.position: expected a finite number from 0 \[m\], received -0.5"),
        ({"noise": {"speed": math.nan}}, "noise.speed"),
        ({"dropout": 1.1}, "dropout: expected a number from 0 to 1, received 1.1"),
        ({"dropout": -0.1}, "dropout"),
        ({"occlusion": 1}, "occlusion: expected True or False, received 1"),
        ({"shuffled": "yes"}, "shuffled: expected True or False, received 'yes'"),
        ({"ghosts": 0.5}, 'ghosts: expected a mapping of "rate" .1/s. and "lifetime" .s., both of them, received 0.5'),
        ({"ghosts": {"rate": 0.5}}, "ghosts: expected .* both of them, received {'rate': 0.5}"),
        (
            {"ghosts": {"rate": 101, "lifetime": 1}},
            r"ghosts.rate: expected a number from 0 to 100 \[1/s\], received 101",
        ),
        ({"ghosts": {"rate": 1, "lifetime": -1}}, r"ghosts.lifetime: expected a finite number from 0 \[s\]"),
        ({"own_bias": {"lane": 1}}, 'own_bias: expected .*"heading" .rad.*, one of them or more'),
        ({"own_bias": {"heading": math.inf}}, r"own_bias.heading: .* \[rad\]"),
    ],
)
def test_invalid_sight_value_is_refused_by_name(values, message):
    with pytest.raises(FieldError, match=message):
        Sight(**values)
