"""The reference drivers: their separate behaviour, and that they see no more than an ADS does."""

import math

import pytest

from pytest_pafot.model.crossings import CrossingVehicle, Zone
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import ACCELERATION, SPEED, Y
from pytest_pafot.world import Highway, Observation, VehicleState
from pytest_pafot.world.reference_drivers import (
    CRITICAL,
    HARD_BRAKING,
    REFERENCES,
    CarefulHuman,
    Leader,
)
from tests.helpers.refusals import refused
from tests.helpers.tables import table

HZ = 30
NAMES = tuple(REFERENCES)


def car(x, y=4.0, speed=20.0, heading=0.0):
    return VehicleState(x, y, heading, speed, round(y / 4), 5.0, 2.0)


def drive(driver, *others, seconds=10.0, speed=20.0, hz=HZ):
    """Return time [s], gap to the first vehicle [m], speed [m/s] and acceleration [m/s^2] of a driver behind vehicles.

    Each vehicle is a function from a time to its state.
    """
    rows, x = [], 0.0
    for tick in range(round(seconds * hz)):
        time = tick / hz
        states = tuple(other(time) for other in others)
        seen = Observation(time, car(x, speed=speed), states, 4, 4.0, 26.8)
        acceleration, steering = driver(seen)
        assert steering == 0.0
        rows.append((time, states[0].x - x - 5.0, speed, acceleration))
        x += speed / hz
        speed = max(speed + acceleration / hz, 0.0)
    return rows


def leader(gap, speed, brakes_at=math.inf, braking=0.0, most=math.inf):
    """Return the state, by time, of a vehicle in the ego's lane that may brake, for at most some seconds."""

    def state(time):
        since = max(time - brakes_at, 0.0)
        braked = min(since, speed / braking, most) if braking else 0.0
        x = 5.0 + gap + speed * time - braking * braked * (since - braked / 2)
        return car(x, speed=speed - braking * braked)

    return state


def cut_in(gap, speed, begins, seconds=2.0):
    """Return the state, by time, of a vehicle that moves from the left lane into the ego's, at a gap."""
    ahead = 5.0 + gap + (20.0 - speed) * begins

    def state(time):
        share = min(max((time - begins) / seconds, 0.0), 1.0)
        heading = math.atan2(4.0 / seconds, speed) if 0 < share < 1 else 0.0
        return car(ahead + speed * time, 4.0 * share, speed / math.cos(heading), heading)

    return state


def first(rows, condition):
    """Return the first time at which a condition of the acceleration holds."""
    return next(time for time, *_, acceleration in rows if condition(acceleration))


def brakes(acceleration):
    return acceleration < 0


def brakes_hard(acceleration):
    return acceleration < -4.1


LEAVES = 1.0 + 0.375 / 2.0
"""When a vehicle that begins to cut in after a second has left its lane [s]."""


class TestCarefulHuman:
    def test_brakes_after_perceiving_vehicle_leaving_lane_and_builds_up_full_braking(self):
        rows = drive(CarefulHuman(), cut_in(20.0, 8.0, begins=1.0))
        begins, full = first(rows, brakes), first(rows, lambda a: a <= -HARD_BRAKING)
        assert begins == pytest.approx(LEAVES + 0.4 + 0.75, abs=2.5 / HZ)
        assert min(a for *_, a in rows) == pytest.approx(-7.593, abs=0.001)
        assert full - begins == pytest.approx(0.6, abs=1.5 / HZ)

    @table(("gap", "speed", "delay", "ticks"), [(38.0, 22.0, 1.15, 3), (36.0, 20.0, 0.4, 4)])
    def test_answers_braking_leader_after_delay_and_sooner_if_it_already_braked(
        self, gap, speed, delay, ticks
    ):
        rows = drive(CarefulHuman(), leader(gap, speed, brakes_at=0.2, braking=8.0))
        assert first(rows, brakes_hard) == pytest.approx(0.2 + delay, abs=ticks / HZ)

    @table(("ticks", "is_answered"), [(5, False), (6, True)])
    def test_answers_hard_braking_that_lasts_for_the_time_of_perception(self, ticks, is_answered):
        """As the rules count, 6 ticks of hard braking at 15 Hz are 0.4 s, whatever the leader does afterwards."""
        rows = drive(CarefulHuman(), leader(38.0, 20.0, 1.0, 10.0, most=ticks / 15), hz=15)
        assert (min(a for *_, a in rows) < -4.1) == is_answered

    def test_avoids_leader_braking_to_standstill(self):
        assert min(gap for _, gap, *_ in drive(CarefulHuman(), leader(43.0, 20.0, 2.0, 8.0))) > 2.0

    def test_follows_two_seconds_behind_without_ever_braking_hard(self):
        rows = drive(CarefulHuman(), leader(60.0, 15.0), seconds=60.0)
        assert rows[-1][1] == pytest.approx(3.0 + 2 * 15.0, abs=1.0)
        assert min(a for *_, a in rows) >= -4.0

    def test_brakes_gently_for_equally_fast_vehicle(self):
        rows = drive(CarefulHuman(), cut_in(10.0, 20.0, begins=1.0))
        assert -4.0 <= min(a for *_, a in rows) < -2.0

    def test_answers_second_cut_in_once_perceived_if_it_brakes(self):
        """Its foot is on the brake, so it does not need the 0.75 s in which it would move there."""
        both = cut_in(10.0, 20.0, begins=1.0), cut_in(12.0, 10.0, begins=3.0)
        perceived = 3.0 + 0.375 / 2.0 + 0.4
        rows = drive(CarefulHuman(), *both)
        assert perceived < first(rows, lambda a: a < -4.0) < perceived + 0.2
        assert first(drive(CarefulHuman(), both[1]), brakes) > perceived + 0.7

    def test_brakes_hard_at_once_for_vehicle_for_which_it_already_moved_its_foot(self):
        """The vehicle becomes a danger 0.8 s after it has come in, while the foot is on its way."""
        rows = drive(CarefulHuman(), cut_in(45.0, 5.0, begins=1.0))
        assert first(rows, brakes) == pytest.approx(LEAVES + 0.4 + 0.75, abs=2.5 / HZ)
        assert first(rows, brakes_hard) < first(rows, brakes) + 0.6

    def test_does_not_speed_up_until_foot_is_off_the_brake(self):
        ahead = leader(10.0, 19.0)
        rows = drive(CarefulHuman(), lambda time: ahead(time) if time < 3.0 else car(1000.0))
        last = max(time for time, *_, a in rows if a <= -0.5)
        assert last < 3.0
        assert first(rows, lambda a: a > 0) == pytest.approx(last + 0.75, abs=2.5 / HZ)

    def test_cannot_avoid_what_comes_within_the_reaction_time(self):
        rows = drive(CarefulHuman(), cut_in(5.0, 8.0, begins=1.0, seconds=0.5))
        assert min(gap for _, gap, *_ in rows) < 0

    def test_leader_is_critical_if_near_and_braking_harder_than_5(self):
        """At 20 m/s it is near below two seconds and three metres, which are 43 m."""
        cases = {(42.9, 5.01): True, (43.1, 5.01): False, (42.9, 5.0): False}
        for (gap, braking), expected in cases.items():
            assert Leader(gap=gap, speed=20.0, closing=0.0, braking=braking).is_critical == expected

    @table(("y", "sideways"), [(0.3, 0.0), (0.8, 0.004), (0.0, 0.29)])
    def test_ignores_vehicle_that_stays_in_next_lane(self, y, sideways):
        ahead = lambda time: car(40.0 + 8 * time, y + sideways * time, 8.0)  # noqa: E731
        assert all(a == 0.0 for *_, a in drive(CarefulHuman(), ahead, seconds=4.0))


def scenario(*speeds):
    """Return a scenario with one NPC that stays ahead."""
    chain = [PositionInstruction(2, speed) for speed in speeds]
    return Scenario(npcs=[chain], ego_lane=1, ego_speed=22.0)


BRAKES = scenario(22.0, 4.0, 4.0)
"""An NPC that falls back to 3 m ahead of the ego, drives 22 m/s, falls back again and drives 4 m/s."""


@pytest.mark.parametrize("name", NAMES)
class TestInTheWorld:
    def test_keeps_its_lane_and_decides_at_every_tick(self, name):
        trace = Highway(duration=20.0).rollout_reference(scenario(22.0, 10.0), name)
        assert (trace.ego[:, Y] == trace.ego[0, Y]).all()
        assert (trace.ads_hz, len(trace.actions)) == (15, trace.ticks)

    def test_keeps_the_limits_of_the_vehicle(self, name):
        trace = Highway().rollout_reference(BRAKES, name)
        assert trace.ego[:, ACCELERATION].min() >= -9.81
        assert trace.ego[:, SPEED].min() >= 0.0
        assert trace.ego[:, SPEED].max() <= 22.0 + 0.1

    def test_can_be_the_ads_of_a_search(self, name):
        trace = Highway(ads_hz=15, duration=20.0).rollout(BRAKES, REFERENCES[name])
        reference = Highway(duration=20.0).rollout_reference(BRAKES, name)
        assert trace.states.tobytes() == reference.states.tobytes()


def test_unknown_driver_is_refused():
    with refused(""):
        Highway().rollout_reference(BRAKES, "me")


def crossing(
    time, ego, *, kind="crossing", priority="npc", distance, speed, ego_distance=40.0, ahead=5.0
):
    """Return a vehicle at a constant speed before its zone; ``ego`` is how far the ego has driven until then [m]."""
    ways = {"ego": (0.0, 10.0), "npc": (0.0, 10.0)}
    zone = Zone(way="a>b", kind=kind, origin="left", priority=priority, **ways)
    return CrossingVehicle(
        id=0, zone=zone, distance=distance - speed * time, ego_distance=ego_distance - ego, ahead=ahead, right=-5.0,
        heading=math.pi / 2, speed=speed, length=5.0, width=2.0,
    )  # fmt: skip


def drive_up(driver, *, seconds=20.0, hz=HZ, second=None, **other):
    """Return (time, distance to the zone [m], speed [m/s], acceleration [m/s^2]) of a driver with a zone 40 m ahead.

    ``second`` describes a second vehicle before a zone, if there is one.
    """
    rows, x, speed = [], 0.0, 10.0
    for tick in range(round(seconds * hz)):
        time = tick / hz
        met = crossing(time, x, **other)
        both = (met,) if second is None else (met, crossing(time, x, **second)._replace(id=1))
        seen = Observation(time, car(x, speed=speed), (), 1, 4.0, 10.0, crossing=both)
        acceleration, _ = driver(seen)
        rows.append((time, met.ego_distance, speed, acceleration))
        x += speed / hz
        speed = max(speed + acceleration / hz, 0.0)
    return rows


@pytest.mark.parametrize("name", NAMES)
class TestAtAZone:
    def test_driver_waits_before_zone_for_vehicle_with_priority(self, name):
        rows = drive_up(REFERENCES[name](), distance=40.0, speed=8.0)
        entered = next(time for time, left, *_ in rows if left <= 0)
        assert entered > 50.0 / 8.0
        assert min(a for *_, a in rows) >= -4.0

    def test_driver_waits_at_line_until_the_zone_is_left_completely(self, name):
        rows = drive_up(REFERENCES[name](), distance=-5.0, speed=0.0)
        assert rows[-1][2] == pytest.approx(0.0, abs=0.05)
        assert 0.2 < rows[-1][1] < 2.0
        nearly = drive_up(REFERENCES[name](), distance=-9.5, speed=0.0)
        assert 0.2 < nearly[-1][1] < 2.0, "half a metre of the way through the zone is left"

    def test_driver_stops_for_one_vehicle_although_none_is_needed_for_another(self, name):
        """The second one is a kilometre away from its zone, in which the first one stands."""
        stands, far = {"distance": -5.0, "speed": 0.0}, {"distance": 1000.0, "speed": 1.0}
        alone = drive_up(REFERENCES[name](), **stands)
        assert drive_up(REFERENCES[name](), **stands, second=far) == alone
        assert drive_up(REFERENCES[name](), **far, second=stands) == alone

    def test_driver_does_not_wait_for_a_late_vehicle(self, name):
        for kind, seconds in CRITICAL.items():
            later, sooner = (
                drive_up(REFERENCES[name](), kind=kind, distance=10.0 * (4.0 + each), speed=10.0)
                for each in (seconds + 0.5, seconds - 1.5)
            )
            assert min(speed for _, left, speed, _ in later if left > 0) == 10.0
            assert min(speed for _, left, speed, _ in sooner if left > 0) < 9.0

    def test_driver_goes_before_vehicle_that_has_waited(self, name):
        rows = drive_up(REFERENCES[name](), distance=2.0, speed=0.0)
        assert all(a >= 0.0 for time, *_, a in rows if time > 2.1)
        assert rows[-1][1] < 0

    def test_driver_with_priority_brakes_for_unstoppable_vehicle_only(self, name):
        stops, cannot = (
            drive_up(REFERENCES[name](), priority="ego", distance=far, speed=speed, seconds=4.0)
            for far, speed in ((20.0, 2.0), (10.0, 4.0))
        )
        assert all(a == 0.0 for *_, a in stops)
        assert min(a for *_, a in cannot) < -2.0

    def test_follows_one_that_joins_ahead_of_it(self, name):
        joins = {"kind": "merging", "priority": "ego", "distance": -1.0, "speed": 4.0}
        rows = drive_up(REFERENCES[name](), **joins, seconds=3.0)
        assert 4.0 <= min(speed for _, _, speed, _ in rows) < 9.0
