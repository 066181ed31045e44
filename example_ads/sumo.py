"""SUMO's drivers: any of its car-following and lane-change models, by libsumo (``pip install "pytest-pafot[sumo]"``).

Kind (a), for ``pafot.Highway``. At each decision everybody is put into a simulation of SUMO's where they are, and that
makes one step: what the ego does in it is the decision. SUMO changes lanes at once, so that its ego is in the lane that
the real one is on its way to. The others are seen in the lane that is nearest to them, and hold their speeds.

SUMO counts lanes from the right, and has the position of a vehicle at its front bumper. libsumo has one simulation in a
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
    """Drives as a vehicle of SUMO's with these models, the names of which are SUMO's.

    Attributes:
        following, changing: how it follows others, and how it changes lanes.
        lane: that it is on its way to; none before the first decision.
    """

    following: str = "Krauss"
    changing: str = "LC2013"
    lane: int = -1

    def __call__(self, seen: Observation) -> Drive:
        """What SUMO's ego does in one step from where everybody is."""
        self.lane = self.started(seen) if self.lane < 0 else self.lane
        for name, car in zip(("ego", *map(str, seen.ids)), (seen.ego, *seen.others), strict=True):
            lane = self.lane if name == "ego" else car.lane
            vehicle.moveTo(name, f"road_{seen.lanes - 1 - lane}", car.x + car.length / 2)
            vehicle.setPreviousSpeed(name, car.speed)
        libsumo.simulationStep()
        self.lane = seen.lanes - 1 - vehicle.getLaneIndex("ego")
        return Drive(lane=self.lane, acceleration=vehicle.getAcceleration("ego"))

    def started(self, seen: Observation) -> int:
        """The lane of the ego, once a simulation with this road and these vehicles runs."""
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
