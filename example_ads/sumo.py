"""SUMO's drivers: any of its car-following and lane-change models, by libsumo (``pip install "pytest-pafot[sumo]"``).

Kind (a), for ``pafot.Highway``. At each decision all vehicles are placed in a SUMO simulation, which makes one step;
the ego's motion in it is the decision. SUMO changes lanes at once, so its ego is in the lane that the real one is
moving to. The others are in the lane nearest to them and keep their speeds.

SUMO counts lanes from the right, and the position of a vehicle is its front bumper. libsumo allows one simulation per
process, which ``close`` ends with the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import libsumo
from libsumo import vehicle

from pytest_pafot import Drive, Observation

WORLD = """<net version="1.20"><edge id="road" from="a" to="b">{lanes}</edge>
<junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape=""/>
<junction id="b" type="dead_end" x="{seen.road_length}" y="0" incLanes="" intLanes="" shape=""/>
<route id="road" edges="road"/>
<vType id="ego" length="5" speedDev="0" carFollowModel="{self.following}" laneChangeModel="{self.changing}"/>
<vType id="other" length="5" accel="1e-3" speedFactor="9" speedDev="0" lcSpeedGain="0" lcKeepRight="0"/></net>"""
LANE = """<lane id="road_{0}" index="{0}" speed="{seen.speed_limit}" length="{seen.road_length}"
shape="0,{0} {seen.road_length},{0}"/>"""
OPTIONS = ["--collision.action=none", "--xml-validation=never", "--no-step-log", "--no-warnings"]


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
        for name, car in zip(("ego", *map(str, seen.ids)), (seen.ego, *seen.others), strict=True):
            lane = self.lane if name == "ego" else car.lane
            vehicle.moveTo(name, f"road_{seen.lanes - 1 - lane}", car.x + car.length / 2)
            vehicle.setPreviousSpeed(name, car.speed)
        libsumo.simulationStep()
        self.lane = seen.lanes - 1 - vehicle.getLaneIndex("ego")
        return Drive(lane=self.lane, acceleration=vehicle.getAcceleration("ego"))

    def started(self, seen: Observation) -> int:
        """Start a simulation with this road and these vehicles, and return the ego's lane."""
        with TemporaryDirectory() as folder:
            Path(folder, "world.xml").write_text(
                WORLD.format(lanes="".join(LANE.format(i, seen=seen) for i in range(seen.lanes)), seen=seen, self=self),
                encoding="utf-8",
            )
            libsumo.start(["sumo", f"--net-file={folder}/world.xml", f"--step-length={seen.decision_period}", *OPTIONS])
        for name in ("ego", *map(str, seen.ids)):
            vehicle.add(name, "road", typeID="ego" if name == "ego" else "other")
        return seen.ego.lane

    def close(self) -> None:
        """End the simulation."""
        libsumo.close()


make = SumoDriver
