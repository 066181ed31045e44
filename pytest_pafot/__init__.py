"""Search for traffic that makes a driving policy crash, as a pytest plugin.

All public names can be imported from this package, which loads their modules on first use (PEP 562).
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_pafot import policies, properties, simulators, strategies
    from pytest_pafot.model.crossings import CrossingVehicle, Zone
    from pytest_pafot.model.instructions import (
        Cell,
        CrossingInstruction,
        LaneInstruction,
        PositionInstruction,
        ScenarioError,
    )
    from pytest_pafot.model.scenario import Scenario
    from pytest_pafot.model.trace import Trace
    from pytest_pafot.model.vehicle_type import VehicleType
    from pytest_pafot.oracle.run import CheckFailed, Run, check, reject
    from pytest_pafot.plugin.collection import search
    from pytest_pafot.searches.explore import explore
    from pytest_pafot.searches.saved_scenario import load
    from pytest_pafot.simulators.metadrive import metadrive
    from pytest_pafot.simulators.sumo import sumo
    from pytest_pafot.world import (
        Highway,
        LaneCommand,
        NpcLimits,
        Observation,
        Perception,
        Simulator,
        SimulatorWorld,
        VehicleState,
        World,
    )

__version__ = "0.1.0"

_NAMES = {
    "searches.explore": "explore",
    "searches.saved_scenario": "load",
    "model.crossings": "CrossingVehicle Zone",
    "model.instructions": "Cell CrossingInstruction LaneInstruction PositionInstruction ScenarioError",
    "model.scenario": "Scenario",
    "model.trace": "Trace",
    "model.vehicle_type": "VehicleType",
    "oracle.run": "CheckFailed Run check reject",
    "plugin.collection": "search",
    "simulators.metadrive": "metadrive",
    "simulators.sumo": "sumo",
    "world": "Highway LaneCommand NpcLimits Observation Perception Simulator SimulatorWorld VehicleState World",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}

_MODULES = ("policies", "properties", "simulators", "strategies")

__all__ = [
    "Cell", "CheckFailed", "CrossingInstruction", "CrossingVehicle", "Highway", "LaneCommand", "LaneInstruction",
    "NpcLimits", "Observation", "Perception", "PositionInstruction", "Run", "Scenario", "ScenarioError",
    "Simulator", "SimulatorWorld", "Trace", "VehicleState", "VehicleType", "World", "Zone", "check", "explore",
    "load", "metadrive", "policies", "properties", "reject", "search", "simulators", "strategies", "sumo",
]  # fmt: skip


if not TYPE_CHECKING:  # type checkers know every name

    def __getattr__(name: str) -> Any:
        if name in _MODULES:
            return import_module(f"pytest_pafot.{name}")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"pytest_pafot.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    # All names only in an interactive session. Tools such as freezegun read every listed name, which would import half
    # of the package into any session.
    return [*__all__, "__version__"] if hasattr(sys, "ps1") else list(globals())
