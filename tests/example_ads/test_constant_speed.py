"""The constant-speed policy does nothing, whatever it sees."""

from example_ads import constant_speed
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from tests.helpers.tables import table


@table("gap", [0.5, 20.0, 200.0])
def test_it_neither_accelerates_nor_steers_whatever_is_ahead(gap):
    ego = VehicleState(x=100.0, y=4.0, heading=0.0, speed=22.0, lane=1, length=5.0, width=2.0)
    parked = ego._replace(x=ego.x + 5.0 + gap, speed=0.0)
    seen = Observation(time=3.0, ego=ego, others=(parked,), lanes=4, lane_width=4.0, speed_limit=26.8)
    assert constant_speed.make()(seen) == (0.0, 0.0)
