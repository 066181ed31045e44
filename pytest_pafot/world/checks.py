"""Checks that both worlds share: numbers, frequencies, and whether a scenario fits a world."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from pytest_pafot.scenario import Scenario, ScenarioError
from pytest_pafot.world.errors import WorldError
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.network_road import NetworkRoad
from pytest_pafot.world.road import StraightRoad

if TYPE_CHECKING:
    from pytest_pafot.world.rules import Rules

TOP_SPEED = 40.0
"""highway-env vehicles do not get faster [m/s]."""


def number(name: str, value: object, low: float, high: float) -> float:
    """A finite number within bounds, as float.

    Raises:
        WorldError: naming the field, the bounds and what was received.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise WorldError(f"{name}: expected a number from {low:g} to {high:g}, received {value!r}")
    return float(value)


def whole(name: str, value: object, low: int, high: int) -> int:
    """A whole number within bounds.

    Raises:
        WorldError: naming the field, the bounds and what was received.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise WorldError(f"{name}: expected a whole number from {low} to {high}, received {value!r}")
    return value


def one_of(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Check for one of some names.

    Raises:
        WorldError: with the names.
    """
    if not isinstance(value, str) or value not in choices:
        raise WorldError(f"{name}: expected one of {', '.join(choices)}, received {value!r}")


def plain(name: str, value: Any) -> Any:
    """A copy of plain data, as a corpus file can hold it: tuples and numpy arrays become lists.

    Raises:
        WorldError: naming what cannot be written down.
    """
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise WorldError(f"{name}: expected text as keys, received {key!r}")
        return {key: plain(f"{name}.{key}", item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(f"{name}[{index}]", item) for index, item in enumerate(value)]
    if type(value).__module__ == "numpy" and hasattr(value, "tolist"):
        return plain(name, value.tolist())
    if value is None or (isinstance(value, (bool, int, float, str)) and not _is_nan(value)):
        return value
    raise WorldError(
        f"{name}: expected plain data (numbers, text, lists, mappings), which a corpus file can hold, received "
        f"{value!r}"
    )


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def divides(physics: tuple[str, int], ads: tuple[str, int]) -> None:
    """Check that a decision takes a whole number of physics ticks.

    Raises:
        WorldError: with the pairs that would do.
    """
    (physics_name, physics_hz), (ads_name, ads_hz) = physics, ads
    if physics_hz % ads_hz == 0:
        return
    divisors = [n for n in range(1, physics_hz + 1) if physics_hz % n == 0]
    up = math.ceil(physics_hz / ads_hz) * ads_hz
    raise WorldError(
        f"{ads_name}: expected a divisor of {physics_name}={physics_hz}, so that every decision lasts a whole number "
        f"of ticks, received {ads_hz}; use one of {', '.join(map(str, divisors))}, or {physics_name}={up}"
    )


def top_speed(limits: NpcLimits, road: StraightRoad | NetworkRoad) -> float:
    """The NPCs' top speed [m/s].

    Raises:
        WorldError: when highway-env's vehicles cannot drive it.
    """
    speed = limits.overspeed * road.speed_limit
    if speed > TOP_SPEED:
        raise WorldError(
            f"speed_limit: expected at most {TOP_SPEED / limits.overspeed:.1f} m/s, because NPCs may drive "
            f"{limits.overspeed:g} times the limit and highway-env's vehicles reach {TOP_SPEED:g} m/s, received "
            f"{road.speed_limit:g}"
        )
    return speed


def ego_start(headway: float, clearance: float) -> float:
    """Where along the road the ego starts [m]: with room behind it for NPCs at any speed, and as much ahead again."""
    return max(200.0, 50.0 + headway * TOP_SPEED + clearance)


def road_is_long_enough(road: StraightRoad, start: float, duration: float) -> None:
    """Check that nobody who starts so far along the road reaches its end.

    Raises:
        WorldError: with the longest possible duration.
    """
    room = road.lanes[0].length - start
    if duration * TOP_SPEED > room:
        raise WorldError(
            f"duration: expected at most {room / TOP_SPEED:g} s on a road of {road.lanes[0].length:g} m, received "
            f"{duration:g}"
        )


def fits(scenario: Scenario, rules: Rules) -> None:
    """Check a scenario against a world.

    Raises:
        ScenarioError: naming the field that does not fit.
        WorldError: for Lane-Instructions on a road that is not straight.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError(f"scenario: expected a Scenario, received {scenario!r}")
    if not isinstance(rules.road, StraightRoad) and not scenario.positions:
        raise WorldError(
            "scenario: expected Position-Instructions on a road that is not straight, received Lane-Instructions, "
            "which know no lanes that begin and end; give NPCs PositionInstruction(cell, speed), or take a straight "
            "road such as pafot.Highway()"
        )
    _check_lane(scenario, rules.road)
    cells = rules.start_cells(scenario)
    if len(scenario.npcs) > len(cells):
        raise ScenarioError(
            f"npcs: expected at most {len(cells)} NPCs, one per cell that exists beside lane {scenario.ego_lane}, "
            f"received {len(scenario.npcs)}"
        )
    _check_speeds(scenario, rules)
    ticks = scenario.gene_seconds * rules.physics_hz
    if abs(ticks - round(ticks)) > 1e-6 or round(ticks) < 1:
        raise ScenarioError(
            f"gene_seconds: expected a whole number of ticks of 1/{rules.physics_hz} s, received "
            f"{scenario.gene_seconds:g}; the nearest is {max(round(ticks), 1) / rules.physics_hz!r}"
        )


def _check_lane(scenario: Scenario, road: StraightRoad | NetworkRoad) -> None:
    if isinstance(road, StraightRoad):
        count = road.lane_count
        if scenario.ego_lane >= count:
            raise ScenarioError(
                f"ego_lane: expected a lane from 0 to {count - 1}, received {scenario.ego_lane}; the road has {count} "
                "lanes"
            )
        return
    lanes = road.start_lanes
    if scenario.ego_lane not in lanes:
        raise ScenarioError(
            f"ego_lane: expected a lane that exists where the ego starts, {' or '.join(map(str, lanes))}, received "
            f"{scenario.ego_lane}; lanes are counted from 0 at the left over all of the ego's way"
        )


def _check_speeds(scenario: Scenario, rules: Rules) -> None:
    road, top = rules.road, top_speed(rules.limits, rules.road)
    if scenario.ego_speed > top:
        raise ScenarioError(
            f"ego_speed: expected at most {top:.2f} m/s, the NPCs' top speed, because all start at the ego's speed; "
            f"received {scenario.ego_speed:g}"
        )
    for npc, chain in enumerate(scenario.npcs):
        for gene, instruction in enumerate(chain):
            if instruction.speed > road.speed_limit + 1e-9:
                raise ScenarioError(
                    f"npcs[{npc}][{gene}].speed: expected at most the speed limit of {road.speed_limit:g} m/s, "
                    f"received {instruction.speed:g}"
                )
