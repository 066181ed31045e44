"""Worlds with their roads, and most of the code that uses highway-env.

A world checks a scenario and sets up a run (``engines/``). The kernel's loop (``kernel/loop.py``) then simulates the
run tick by tick. The ego's driver depends on the policy:

- a planner in SI units: the kernel's ``PlannerDriver``;
- highway-env's IDM on lanes that the kernel supports: the kernel's ``ModelDriver``;
- any other vehicle class: ``ObjectDriver`` (``driving/environment.py``);
- a policy that returns an environment's actions: ``ModelPolicyDriver``, or ``PolicyDriver`` if the kernel does not
  support the lanes or the vehicle.

In a :class:`pytest_pafot.SimulatorWorld`, a simulator determines the states after each tick
(``engines/simulation.py``). Environments with wrappers or a custom ``step`` are run with ``env.step``
(``engines/gym_replay.py``). This engine also confirms findings.
"""

from pytest_pafot.model.crossings import CrossingVehicle
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.base_world import Highway
from pytest_pafot.world.codec import from_dict
from pytest_pafot.world.driving.policy import Perception
from pytest_pafot.world.engines.simulation import Control, Simulator, Vehicle
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.kernel.action import LaneCommand
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.simulator_world import SimulatorWorld

__all__ = [
    "AdsFactoryError", "Control", "CrossingVehicle", "Highway", "LaneCommand", "NpcLimits", "Observation",
    "Perception", "Simulator", "SimulatorWorld", "Vehicle", "VehicleState", "World", "WorldError", "from_dict",
]  # fmt: skip
