"""Searches whose findings were saved by an earlier version, one for each kind of world and of label."""

import pytest

import pytest_pafot as pafot


def cruise(seen):
    """Brake for a vehicle ahead only 1.5 s before reaching it."""
    ahead = [o for o in seen.others if o.lane == seen.ego.lane and o.x > seen.ego.x]
    late = any(o.x - seen.ego.x < 1.5 * (seen.ego.speed - o.speed) for o in ahead)
    return (-6.0 if late else min(28.0 - seen.ego.speed, 2.0)), 0.0


def keep(seen):
    return 0.0, 0.0


def stand_still(seen):
    return -5.0, 0.0


class Alternates:
    """Keep the speed in every other run, and brake in the others."""

    runs = 0

    def __init__(self):
        type(self).runs += 1
        self.brakes = type(self).runs % 2 == 0

    def __call__(self, seen):
        return (-4.0 if self.brakes else 0.0), 0.0


def breaks(seen):
    if seen.time > 3:
        raise KeyError("lane")
    return 0.0, 0.0


@pafot.search(ads=lambda: cruise, blame="ego", runs=40)
def test_road(run):
    assert not run.collision, run.explain()


@pafot.search(
    ads=lambda: keep, blame="ego", runs=20, world=pafot.World("intersection-v0", planner_hz=5)
)
def test_junction(run):
    assert not run.collision, run.explain()


@pafot.search(ads=lambda: keep, blame="ego", runs=20, world=pafot.sumo(duration=10.0))
def test_sumo(run):
    assert not run.collision, run.explain()


@pafot.search(ads=lambda: keep, blame="ego", runs=20)
def test_accepted(run):
    assert not run.collision, run.explain()


@pafot.search(ads=Alternates, blame="ego", runs=20)
def test_flaky(run):
    assert not run.collision, run.explain()


@pytest.mark.xfail(reason="the policy cannot brake yet")
@pafot.search(ads=lambda: keep, blame="ego", runs=20)
def test_expected(run):
    assert not run.collision, run.explain()


@pafot.search(ads=lambda: breaks, blame="ego", runs=20)
def test_error(run):
    assert not run.collision, run.explain()


@pafot.search(ads=lambda: keep, blame="ego", runs=20)
def test_check(run):
    pafot.check(run.min_distance, name="distance", at_least=2.0, unit="m")


def careful(seen):
    """Keep a distance of three seconds to any vehicle ahead, at 20 m/s."""
    ahead = [o for o in seen.others if abs(o.y - seen.ego.y) < 2.5 and o.x > seen.ego.x]
    gap = min(
        (o.x - seen.ego.x - 5.0 - 3.0 * (seen.ego.speed - o.speed) for o in ahead), default=99.0
    )
    return (-8.0 if gap < 2.0 * seen.ego.speed else min(20.0 - seen.ego.speed, 2.0)), 0.0


@pafot.search(ads=lambda: careful, blame="ego", runs=20)
def test_fixed(run):
    assert not run.collision, run.explain()


@pafot.search(ads=lambda: stand_still, blame="ego", runs=20)
def test_drifted(run):
    assert not run.collision, run.explain()
