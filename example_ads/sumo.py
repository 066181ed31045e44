"""SUMO's drivers: any of its car-following and lane-change models, by libsumo (``pip install "pytest-pafot[sumo]"``).

Kind (a), for ``pafot.Highway``. At each decision all vehicles are placed in a SUMO simulation, which makes one step;
the ego's motion in it is the decision. SUMO changes lanes at once, and a change takes seconds here. So each other
vehicle is in the lane that it is moving to. The ego is in the lane of its body, and until it has arrived, SUMO is asked
again in each step for the lane that it moves to: if SUMO finds the gaps too small by now, the ego turns back. Until
then it also follows whoever is ahead of its body, by SUMO's rule.

SUMO counts lanes from the right, and the position of a vehicle is its front bumper. libsumo allows one simulation per
process, which ``close`` ends with the run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import libsumo
from libsumo import vehicle

from pytest_pafot import Drive, Observation
from pytest_pafot.world import VehicleState

from . import lane_ahead

WORLD = """<net version="1.20"><edge id="road" from="a" to="b">{lanes}</edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
<junction id="b" type="dead_end" x="{seen.road_length}" y="0" incLanes="" intLanes="" shape=""/>
<route id="road" edges="road"/>
<vType id="ego" length="5" speedDev="0" carFollowModel="{self.following}" laneChangeModel="{self.changing}"/>
<vType id="other" length="5" accel="1e-3" decel="{braking}" speedFactor="9" speedDev="0" lcSpeedGain="0"
lcKeepRight="0"/></net>"""
LANE = """<lane id="road_{0}" index="{0}" speed="{seen.speed_limit}" length="{seen.road_length}"
shape="0,{0} {seen.road_length},{0}"/>"""
OPTIONS = ["--collision.action=none", "--xml-validation=never", "--no-step-log", "--no-warnings"]


MARGIN = 0.5  # room across the road beside the ego's body [m]
BRAKING = 8.0  # how hard others may brake, by which SUMO chooses its gaps; its default is 4.5 [m/s^2]
MIN_GAP = 2.5  # SUMO's default of minGap [m]
BY_ITSELF, AS_ASKED = 1621, 1877  # SUMO's lane change modes: its default, and one in which it only does what is asked


@dataclass
class SumoDriver:
    """A driver that acts as a SUMO vehicle with some of SUMO's models.

    Attributes:
        following, changing: SUMO's names of the car-following model and of the lane-change model.
        lane: target lane; -1 before the first decision.
    """

    following: str = "Krauss"
    changing: str = "LC2013"
    lane: int = -1

    def __call__(self, seen: Observation) -> Drive:
        """Return what SUMO's ego does in one step from the current places of all vehicles."""
        self.lane = self.started(seen) if self.lane < 0 else self.lane
        ego, names = seen.ego, ("ego", *map(str, seen.ids))
        is_changing = self.lane != ego.lane
        ahead: list[tuple[float, float, str]] = []
        for name, car, lateral in zip(names, (ego, *seen.others), seen.lateral_velocities, strict=True):
            moves_to = None if name == "ego" else lane_ahead(seen.lane_centres, car.y, lateral)
            lane = car.lane if moves_to is None else moves_to
            vehicle.moveTo(name, f"road_{seen.lanes - 1 - lane}", car.x + car.length / 2)
            vehicle.setPreviousSpeed(name, car.speed)
            gap = car.x - ego.x - (car.length + ego.length) / 2
            if name != "ego" and gap > 0 and abs(car.y - ego.y) < (_across(car) + _across(ego)) / 2 + MARGIN:
                ahead.append((gap, car.speed, name))
        acceleration = math.inf
        if ahead:
            gap, speed, name = min(ahead)
            braking = vehicle.getDecel(name)
            wanted = vehicle.getFollowSpeed("ego", ego.speed, max(gap - MIN_GAP, 0.01), speed, braking, name)
            acceleration = max((wanted - ego.speed) / seen.decision_period, -vehicle.getEmergencyDecel("ego"))
        vehicle.setLaneChangeMode("ego", AS_ASKED if is_changing else BY_ITSELF)
        if is_changing:
            vehicle.changeLane("ego", seen.lanes - 1 - self.lane, 0)
        libsumo.simulationStep()
        self.lane = seen.lanes - 1 - vehicle.getLaneIndex("ego")
        return Drive(lane=self.lane, acceleration=min(acceleration, vehicle.getAcceleration("ego")))

    def started(self, seen: Observation) -> int:
        """Start a simulation with this road and these vehicles, and return the ego's lane."""
        with TemporaryDirectory() as folder:
            Path(folder, "world.xml").write_text(
                WORLD.format(
                    lanes="".join(LANE.format(i, seen=seen) for i in range(seen.lanes)),
                    seen=seen,
                    self=self,
                    braking=BRAKING,
                ),
                encoding="utf-8",
            )
            libsumo.start(["sumo", f"--net-file={folder}/world.xml", f"--step-length={seen.decision_period}", *OPTIONS])
        for name in ("ego", *map(str, seen.ids)):
            vehicle.add(name, "road", typeID="ego" if name == "ego" else "other")
        return seen.ego.lane

    def close(self) -> None:
        """End the simulation."""
        libsumo.close()


def _across(car: VehicleState) -> float:
    """Return the width of a car across the road, which is larger if it is turned [m]."""
    return car.width * abs(math.cos(car.heading)) + car.length * abs(math.sin(car.heading))


make = SumoDriver
