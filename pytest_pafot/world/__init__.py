"""Worlds: the roads on which scenarios run against an ADS. Most code that uses highway-env is in this package.

A world (``highway.py``, ``gym_world.py``) checks a scenario and begins a run of it (``engines/``): the vehicles at
their starts, and a driver of the ego. The kernel's loop (``kernel/loop.py``) then drives it, tick by tick. Which driver
an ego has depends on the ADS:

- a planner, which returns acceleration and steering: ``PlannerDriver`` of the kernel;
- highway-env's IDM, on lanes that the kernel knows: ``ModelDriver`` of the kernel;
- any other vehicle class: ``ObjectDriver`` (``driving/environment.py``), which calls the class's own code;
- a policy with an environment's actions: ``ModelPolicyDriver`` of the same file, and where the kernel does not know the
  lanes or the environment's vehicle, ``PolicyDriver``, which calls highway-env's code.

In a :class:`pytest_pafot.SimulatorWorld`, a simulator of the user's moves all vehicles of the same loop
(``engines/simulation.py``). Only environments with wrappers, or with a step function of their own, are driven by
``env.step`` (``engines/gym_replay.py``), as is the check of each finding.
"""

from pytest_pafot.model.crossings import CrossingVehicle
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.base_world import Highway
from pytest_pafot.world.codec import from_dict
from pytest_pafot.world.driving.policy import Perception
from pytest_pafot.world.engines.simulation import Control, Simulator, Vehicle
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.kernel.action import Drive
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.simulator_world import SimulatorWorld

__all__ = [
    "AdsFactoryError", "Control", "CrossingVehicle", "Drive", "Highway", "NpcLimits", "Observation", "Perception",
    "Simulator", "SimulatorWorld", "Vehicle", "VehicleState", "World", "WorldError",
    "from_dict",
]  # fmt: skip
