"""Search for traffic that makes a driving policy crash, as a pytest plugin.

All public names can be imported from this package. The module of a name is loaded when the name is first used, so
importing the package is fast (PEP 562).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_pafot import properties as properties
    from pytest_pafot import strategies as strategies
    from pytest_pafot.campaign.explore import Exploration as Exploration
    from pytest_pafot.campaign.explore import explore as explore
    from pytest_pafot.campaign.saved_scenario import SavedScenario as SavedScenario
    from pytest_pafot.campaign.saved_scenario import load as load
    from pytest_pafot.criticality.signals import Measure as Measure
    from pytest_pafot.criticality.signals import Signal as Signal
    from pytest_pafot.criticality.temporal import above as above
    from pytest_pafot.criticality.temporal import always as always
    from pytest_pafot.criticality.temporal import below as below
    from pytest_pafot.criticality.temporal import eventually as eventually
    from pytest_pafot.criticality.temporal import until as until
    from pytest_pafot.model.crossings import CrossingVehicle as CrossingVehicle
    from pytest_pafot.model.crossings import Zone as Zone
    from pytest_pafot.model.driving_style import Traffic as Traffic
    from pytest_pafot.model.grid import Cell as Cell
    from pytest_pafot.model.instructions import CrossingInstruction as CrossingInstruction
    from pytest_pafot.model.instructions import Free as Free
    from pytest_pafot.model.instructions import LaneInstruction as LaneInstruction
    from pytest_pafot.model.instructions import Manoeuvre as Manoeuvre
    from pytest_pafot.model.instructions import PositionInstruction as PositionInstruction
    from pytest_pafot.model.instructions import Recorded as Recorded
    from pytest_pafot.model.instructions import ScenarioError as ScenarioError
    from pytest_pafot.model.instructions import Step as Step
    from pytest_pafot.model.instructions import Track as Track
    from pytest_pafot.model.scenario import Chromosome as Chromosome
    from pytest_pafot.model.scenario import Scenario as Scenario
    from pytest_pafot.model.trace import Collision as Collision
    from pytest_pafot.model.trace import Outcome as Outcome
    from pytest_pafot.model.trace import Trace as Trace
    from pytest_pafot.model.vehicle_type import CAR as CAR
    from pytest_pafot.model.vehicle_type import MOTORCYCLE as MOTORCYCLE
    from pytest_pafot.model.vehicle_type import TRUCK as TRUCK
    from pytest_pafot.model.vehicle_type import VAN as VAN
    from pytest_pafot.model.vehicle_type import VehicleType as VehicleType
    from pytest_pafot.oracle.checks import CheckFailed as CheckFailed
    from pytest_pafot.oracle.checks import check as check
    from pytest_pafot.oracle.checks import reject as reject
    from pytest_pafot.oracle.checks import target as target
    from pytest_pafot.oracle.run import Run as Run
    from pytest_pafot.plugin.marks import catalogue as catalogue
    from pytest_pafot.plugin.marks import search as search
    from pytest_pafot.searching.fitness import Weights as Weights
    from pytest_pafot.world import Drive as Drive
    from pytest_pafot.world import Highway as Highway
    from pytest_pafot.world import NpcLimits as NpcLimits
    from pytest_pafot.world import Observation as Observation
    from pytest_pafot.world import Perception as Perception
    from pytest_pafot.world import Planned as Planned
    from pytest_pafot.world import Simulator as Simulator
    from pytest_pafot.world import SimulatorWorld as SimulatorWorld
    from pytest_pafot.world import VehicleState as VehicleState
    from pytest_pafot.world import World as World
    from pytest_pafot.world import WorldError as WorldError
    from pytest_pafot.world import WorldLike as WorldLike

__version__ = "0.1.0"

_HOMES = {
    "CAR": "model.vehicle_type",
    "Cell": "model.grid",
    "CheckFailed": "oracle.checks",
    "Chromosome": "model.scenario",
    "Collision": "model.trace",
    "CrossingInstruction": "model.instructions",
    "CrossingVehicle": "model.crossings",
    "Drive": "world",
    "Exploration": "campaign.explore",
    "Free": "model.instructions",
    "Highway": "world",
    "LaneInstruction": "model.instructions",
    "MOTORCYCLE": "model.vehicle_type",
    "Manoeuvre": "model.instructions",
    "Measure": "criticality.signals",
    "NpcLimits": "world",
    "Observation": "world",
    "Outcome": "model.trace",
    "Perception": "world",
    "Planned": "world",
    "PositionInstruction": "model.instructions",
    "Recorded": "model.instructions",
    "Run": "oracle.run",
    "SavedScenario": "campaign.saved_scenario",
    "Scenario": "model.scenario",
    "ScenarioError": "model.instructions",
    "Signal": "criticality.signals",
    "Simulator": "world",
    "SimulatorWorld": "world",
    "Step": "model.instructions",
    "TRUCK": "model.vehicle_type",
    "Trace": "model.trace",
    "Track": "model.instructions",
    "Traffic": "model.driving_style",
    "VAN": "model.vehicle_type",
    "VehicleState": "world",
    "VehicleType": "model.vehicle_type",
    "Weights": "searching.fitness",
    "World": "world",
    "WorldError": "world",
    "WorldLike": "world",
    "Zone": "model.crossings",
    "above": "criticality.temporal",
    "always": "criticality.temporal",
    "below": "criticality.temporal",
    "eventually": "criticality.temporal",
    "catalogue": "plugin.marks",
    "check": "oracle.checks",
    "explore": "campaign.explore",
    "load": "campaign.saved_scenario",
    "reject": "oracle.checks",
    "search": "plugin.marks",
    "target": "oracle.checks",
    "until": "criticality.temporal",
}

_OF_EXTRAS = ("Recording", "Sweep", "policies", "recorded", "sumo", "sweep", "training_env")  # see door.NAMES
_MODULES = ("properties", "strategies")

__all__ = sorted([*_HOMES, *_MODULES, *_OF_EXTRAS])  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"pytest_pafot.{name}")
    if name in _OF_EXTRAS:
        door = import_module("pytest_pafot.door")
        return door.opened(door.NAMES[name])
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pytest_pafot.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
