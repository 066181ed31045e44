"""What all runs of a world have in common, and where everybody starts."""

from __future__ import annotations

from dataclasses import dataclass

from pytest_pafot.grid import Cell
from pytest_pafot.scenario import Scenario
from pytest_pafot.world import checks
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.road import StraightRoad

NPC_LENGTH, NPC_WIDTH = 5.0, 2.0
"""highway-env's vehicles [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """What all runs of a world have in common.

    Attributes:
        road: on which all drive.
        physics_hz, ads_hz: ticks and decisions per second.
        duration: of a run, at most [s].
        clearance: gap between the ego and the cells ahead and behind [m].
        headway: of NPCs that start ahead or behind [s].
        limits: of the NPCs.
        hang_limit: longest decision of the ADS in wall-clock time [s].
    """

    road: StraightRoad
    physics_hz: int
    ads_hz: int
    duration: float
    clearance: float
    headway: float
    limits: NpcLimits
    hang_limit: float

    @property
    def ego_start(self) -> float:
        """Where along the road the ego starts [m]."""
        return checks.ego_start(self.headway, self.clearance)

    def director(
        self, scenario: Scenario, ego_length: float, length: float = NPC_LENGTH, width: float = NPC_WIDTH
    ) -> Director:
        """Who drives the NPCs of one run, of a length and width [m], around an ego of a length [m]."""
        return Director(
            scenario,
            self.road,
            self.limits,
            clearance=self.clearance,
            ego_length=ego_length,
            length=length,
            width=width,
            physics_hz=self.physics_hz,
        )

    def ticks(self, scenario: Scenario) -> int:
        """Physics steps of a run that nothing ends early."""
        return int(min(self.duration, scenario.genes * scenario.gene_seconds) * self.physics_hz + 1e-9)


def start_positions(
    rules: Rules, scenario: Scenario, cells: tuple[Cell, ...], ego_length: float = NPC_LENGTH
) -> list[tuple[float, float, float]]:
    """World x [m], y [m], heading [rad] of the ego and of each NPC at tick 0.

    NPCs of cells 4 and 8 start beside the ego, all others in their cell's lane at the headway ahead or behind,
    so that danger is created by driving and never present at the start.
    """
    lane, speed = scenario.ego_lane, scenario.ego_speed
    far = (ego_length + NPC_LENGTH) / 2 + max(rules.headway * speed, rules.clearance)
    beside = [rules.road.position(rules.ego_start + cell.row * far, lane + cell.column) for cell in cells]
    return [rules.road.position(rules.ego_start, lane), *beside]
