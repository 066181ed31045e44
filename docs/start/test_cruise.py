# test_cruise.py
import pytest_pafot as pafot


def cruise(seen):
    ahead = [o for o in seen.others if o.lane == seen.ego.lane and o.x > seen.ego.x]
    late = any(o.x - seen.ego.x < 1.5 * (seen.ego.speed - o.speed) for o in ahead)
    return (-6.0 if late else min(28.0 - seen.ego.speed, 2.0)), 0.0  # m/s^2, rad


@pafot.search(ads=lambda: cruise, blame="ego")
def test_never_at_fault(run):
    assert not run.collision, run.explain()
