"""The rules that all runs in a world share, the checks of scenarios, and the start positions of vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NoReturn

from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.instructions import (
    LARGEST_SLOT,
    SLOT_STEPS_PER_SECOND,
    Cell,
    CrossingInstruction,
    ScenarioError,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.vehicle_type import CAR, TIGHTEST, VehicleType
from pytest_pafot.world.kernel.crossing import JunctionDirector
from pytest_pafot.world.kernel.director import Director
from pytest_pafot.world.kernel.lanes import Box, overlap
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.road import Pose, Road


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """The settings that all runs in a world share."""

    road: Road
    # Ticks and decisions per second.
    physics_hz: float
    ads_hz: float
    # The longest duration of a run [s].
    duration: float
    # The gap between the ego and the cells ahead of and behind it [m].
    clearance: float
    # The time gap at which NPCs start ahead of or behind the ego [s].
    headway: float
    limits: NpcLimits
    # The wall-clock time after which a decision is interrupted [s].
    hang_limit: float
    ego: VehicleType = CAR
    # The duration of each run [s], or None if the scenario and `duration` determine it.
    lasts: float | None = None
    # Fixed objects: x [m], y [m], heading [rad], length and width [m].
    obstacles: tuple[tuple[float, float, float, float, float], ...] = ()
    # Decisions of the policy per second, if a reference driver changes `ads_hz`.
    policy_hz: float | None = None
    # Methods of the environment that may end a run (`OwnEnds`); None if only the duration ends it.
    ends: tuple[str, ...] | None = None
    # True if a step of the environment or a wrapper may also end a run (`EpisodeEnds`).
    ends_in_steps: bool = False
    # The number of ticks after which the environment's step limit ends a run.
    step_limit: int | None = None

    @property
    def step_ticks(self) -> int:
        # A step of the environment lasts as long as a decision of the policy, even if a reference driver drives.
        return round(self.physics_hz / (self.policy_hz or self.ads_hz))

    @property
    def every(self) -> int:
        return round(self.physics_hz / self.ads_hz)

    @property
    def crossings(self) -> Crossings | None:
        """The zones and paths for Crossing-Instructions, or None if no other path conflicts with the ego's path."""
        return self.road.crossings

    @property
    def ego_start(self) -> float:
        """The ego's position [m] along the road at the start."""
        return self.road.ego_start(self.headway, self.clearance)

    def ego_position(self, scenario: Scenario) -> Pose:
        """Return the ego's world x [m], y [m] and heading [rad] at tick 0."""
        return self.road.position(self.ego_start, scenario.ego_lane, self.ego)

    def ego_speed(self, scenario: Scenario) -> float:
        # NPCs that start as fast as the ego use this speed, too. It is at most the ego's top speed [m/s].
        return min(scenario.ego_speed, self.ego.top_speed)

    def start_distance(self, scenario: Scenario, ego_length: float) -> float:
        # The distance between the centres of the ego and of cars that start ahead of or behind it [m].
        return float(ego_length + CAR.length) / 2 + max(
            self.headway * scenario.ego_speed, self.clearance
        )

    def start_cells(self, scenario: Scenario, ego_length: float) -> frozenset[Cell]:
        return self.road.start_cells(scenario.ego_lane, self.start_distance(scenario, ego_length))

    def director(self, scenario: Scenario, ego_length: float) -> Director | JunctionDirector:
        """Return the director that controls the NPCs of one run, for an ego of the given length [m]."""
        return self.road.director(
            scenario,
            self.limits,
            self.start_cells(scenario, ego_length),
            clearance=self.clearance,
            ego_length=ego_length,
            physics_hz=self.physics_hz,
        )

    def check_fits(self, scenario: Scenario) -> None:
        """Reject a scenario that does not fit this world.

        Raises:
            ScenarioError: if it does not fit. The error names the field.
        """
        if not isinstance(scenario, Scenario):
            raise ScenarioError(field="scenario", expected="a Scenario", received=repr(scenario))
        if scenario.ego_lane not in self.road.start_lanes:
            expected, fix = self.road.said_of_start_lanes
            raise ScenarioError(
                field="ego_lane", expected=expected, received=str(scenario.ego_lane), fix=fix
            )
        cells, crossings = self.start_cells(scenario, self.ego.length), scenario.crossings
        on_grid = sum(not chain[0].crosses for chain in scenario.npcs)
        if on_grid > len(cells):
            kind = " that do not cross" if crossings else ""
            expected = f"at most {len(cells)} NPCs{kind}, one for each cell around lane {scenario.ego_lane}"
            raise ScenarioError(field="npcs", expected=expected, received=str(on_grid))
        self._check_speeds(scenario)
        if near := self._at_start(scenario.ego_lane, scenario.ego_speed):
            self.refuse_start(scenario, near)
        for npc, instruction in enumerate(crossings):
            if instruction is not None:
                self._check_crossing(f"npcs[{npc}][0]", instruction)
        self._check_vehicles(scenario)
        ticks = scenario.gene_seconds * self.physics_hz
        if abs(ticks - round(ticks)) > 1e-6 or round(ticks) < 1:
            expected = f"a whole number of ticks of 1/{self.physics_hz:.6g} s"
            fix = f"the nearest valid duration is {round(max(round(ticks), 1) / self.physics_hz, 13)!r} s"
            received = f"{scenario.gene_seconds:g}"
            raise ScenarioError(field="gene_seconds", expected=expected, received=received, fix=fix)

    def _check_vehicles(self, scenario: Scenario) -> None:
        for npc, vehicle in enumerate(scenario.vehicles):
            crossing = scenario.crossings[npc] if scenario.crossings else None
            zone = None if crossing is None else crossing.zone
            if not self.road.can_drive(vehicle, zone):
                expected = f"a vehicle that can follow the bends of {zone or 'the road'}"
                least = vehicle.length / (TIGHTEST * CAR.length)
                fix = f"it needs bend radii of at least {least:.1f} m. Give the NPC a shorter vehicle or another path"
                raise ScenarioError(
                    field=f"vehicles[{npc}]", expected=expected, received=vehicle.described, fix=fix
                )

    def _at_start(self, lane: int, speed: float) -> tuple[float, ...] | None:
        """Return a fixed object at the ego's start, or within the headway if the ego can start anywhere."""
        gap = max(self.headway * speed, self.clearance) if self.road.prescribed is None else 0.0
        x, y, heading = self.road.position(self.ego_start, lane)
        x, y = x + gap / 2 * math.cos(heading), y + gap / 2 * math.sin(heading)
        place = Box(x, y, heading, self.ego.length + gap, self.ego.width)
        return next((each for each in self.obstacles if overlap(place, Box(*each))), None)

    def refuse_start(self, scenario: Scenario, near: tuple[float, ...]) -> NoReturn:
        """Raise an error for a scenario in which the ego starts at a fixed object, or too close to it to stop."""
        road, speed = self.road, scenario.ego_speed
        x, y, _ = road.position(self.ego_start, scenario.ego_lane)
        where, free = f"the ego's start at ({x:.0f}, {y:.0f}) m", list[int]()
        expected = f"a lane without a fixed object at {where}"
        if road.prescribed is None:
            expected = (
                f"a lane without fixed objects for {self.headway:g} s at {speed:g} m/s from {where}"
            )
            others = [lane for lane in road.start_lanes if lane != scenario.ego_lane]
            free = [lane for lane in others if self._at_start(lane, speed) is None]
        received = (
            f"lane {scenario.ego_lane}, which has an object at ({near[0]:.1f}, {near[1]:.1f}) m"
        )
        fix = f"write ego_lane={free[0]}" if free else "move the environment's objects"
        raise ScenarioError(field="ego_lane", expected=expected, received=received, fix=fix)

    def _check_crossing(self, place: str, instruction: CrossingInstruction) -> None:
        crossings = self.crossings
        if crossings is None:
            expected = "no crossing NPC, because no other path crosses the ego's path on this road"
            fix = 'use PositionInstruction(cell, speed), or a world with crossings, such as "intersection-v0"'
            raise ScenarioError(
                field=place, expected=expected, received=f"zone {instruction.zone}", fix=fix
            )
        if instruction.zone not in crossings.ways:
            expected = f"one of {', '.join(zone.way for zone in crossings.zones)}"
            fix = "a path that starts with the ego's path, or does not meet it, has no zone"
            raise ScenarioError(
                field=f"{place}.zone", expected=expected, received=instruction.zone, fix=fix
            )
        if crossings.fits(instruction):
            return
        most = round(LARGEST_SLOT * SLOT_STEPS_PER_SECOND)
        slots = [slot / SLOT_STEPS_PER_SECOND for slot in range(-most, most + 1)]
        slots = [slot for slot in slots if crossings.fits(replace(instruction, slot=slot))]
        given = f"{instruction.zone} and {instruction.speed:g} m/s"
        fits = (
            f"a slot from {min(slots):g} to {max(slots):g} s at"
            if slots
            else "a zone or speed other than"
        )
        expected = f"{fits} {given}, so that the NPC starts on its path before the zone"
        along = crossings.start(instruction)
        received = (
            f"{instruction.slot:g} s, with which the NPC would start {along:.0f} m along its path"
        )
        raise ScenarioError(field=f"{place}.slot", expected=expected, received=received)

    def _check_speeds(self, scenario: Scenario) -> None:
        limit = self.road.speed_limit
        top = self.limits.top_speed(limit)
        if scenario.ego_speed > top:
            reached = math.floor(100 * top) / 100
            expected = f"at most {reached:.2f} m/s, the NPCs' top speed, because NPCs start at the ego's speed"
            raise ScenarioError(
                field="ego_speed", expected=expected, received=f"{scenario.ego_speed:g}"
            )
        for npc, chain in enumerate(scenario.npcs):
            for gene, instruction in enumerate(chain):
                if instruction.speed > limit + 1e-9:
                    expected = f"at most the speed limit of {limit:g} m/s"
                    field, received = f"npcs[{npc}][{gene}].speed", f"{instruction.speed:g}"
                    raise ScenarioError(field=field, expected=expected, received=received)

    def ticks(self, scenario: Scenario) -> int:
        """Return the number of ticks of a run that does not end early."""
        seconds = min(self.duration, scenario.seconds) if self.lasts is None else self.lasts
        ticks = int(seconds * self.physics_hz + 1e-9)  # rounding must not lose a tick
        return ticks if self.step_limit is None else min(ticks, self.step_limit)


def starts_of(
    rules: Rules, scenario: Scenario, director: Director | JunctionDirector, ego_length: float
) -> tuple[list[float], list[tuple[float, float, float, float]]]:
    """Return the positions [m] of all vehicles along their paths at tick 0, with the ego first, and each NPC's start.

    A start consists of x [m], y [m], heading [rad] and speed [m/s].
    """
    road, start, apart = rules.road, rules.ego_start, rules.start_distance(scenario, ego_length)
    around = [
        kind
        for chain, kind in zip(scenario.npcs, scenario.all_vehicles, strict=True)
        if not chain[0].crosses
    ]
    starts = []
    for cell, kind in zip(director.first_cells(), around, strict=True):
        lane, far = scenario.ego_lane + cell.column, apart + (kind.length - CAR.length) / 2
        if kind.length > CAR.length and not road.has_lane(lane, start + cell.row * far):
            far = apart  # where the lane ends, there is room only for a car
        along, wanted = start + cell.row * far, min(rules.ego_speed(scenario), kind.top_speed)
        pose, speed = road.position(along, lane, kind), road.start_speed(wanted, lane, along, kind)
        starts.append((along, (*pose, speed)))
    starts = director.started(starts)
    return [start, *(along for along, _ in starts)], [each for _, each in starts]
