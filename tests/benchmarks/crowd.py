"""A scenario with more NPCs than allowed, only for the kernel's loop."""

from __future__ import annotations

from array import array

from pytest_pafot import LaneInstruction, Scenario
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.loop import Loop, PlannerDriver
from pytest_pafot.world.kernel.observation import COLUMNS, Observer
from pytest_pafot.world.kernel.places import Places
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.straight import StraightRoad

SECONDS, HZ, SPACING = 60, 15, 30.0


class Crowd(Scenario):
    """A scenario with any number of NPCs, whose genes never begin."""

    positions = ()
    genes = 0

    def __post_init__(self) -> None:
        """Check nothing."""


def crowd(count: int) -> tuple[Loop, PlannerDriver, int]:
    """Return a loop with NPCs that keep lane and speed around an ego, four side by side every 30 m.

    They follow each other, are recorded and are tested for contact as in every run.
    """
    road = StraightRoad.uniform(4, 10_000.0, 4.0, 26.8)
    director = road.director(
        Crowd(npcs=((LaneInstruction("keep", 22.0),),) * count),
        NpcLimits(),
        frozenset(),
        clearance=3.0,
        ego_length=5.0,
        physics_hz=HZ,
    )
    ego = Body(5.0, 2.0)
    ego.place(500.0, 4.0, 0.0, 22.0)
    for index, npc in enumerate(director.npcs, start=1):
        npc.place(500.0 + SPACING * (index // 4), 4.0 * ((index + 1) % 4), 0.0, 22.0)
        npc.lane = (index + 1) % 4
        npc.kept_lane, npc.kept_speed, npc.heading_for = npc.lane, npc.speed, npc.lane
    ticks = SECONDS * HZ
    rows = array("d", bytes(8 * (ticks + 1) * (count + 1) * COLUMNS))
    observer = Observer(rows, [(5.0, 2.0)] * (count + 1), road.grid, road.speed_limit, HZ, 3)
    common = {"lanes": 4, "lane_width": 4.0, "every": 3, "dt": 1 / HZ}
    driver = PlannerDriver(lambda observation: (0.0, 0.0), HangGuard(30.0), (), ego, ego, observer, **common)
    vehicles = [ego, *director.npcs]
    return Loop(director, Places(vehicles, vehicles, road.grid), rows, 1 / HZ), driver, ticks
