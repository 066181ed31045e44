"""Checks that both worlds share: numbers, frequencies, and whether a scenario fits a world."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pytest_pafot.scenario import Scenario, ScenarioError
from pytest_pafot.world.errors import WorldError
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.straight import StraightRoad

if TYPE_CHECKING:
    from pytest_pafot.world.run_config import Rules

TOP_SPEED = 40.0
"""highway-env vehicles do not get faster [m/s]."""

MOST_TICKS = 400_000
"""Of a run; its record takes about 0.5 KB for each tick with all NPCs."""

LARGEST: Mapping[str, float] = MappingProxyType(
    {
        "lanes_count": 20,
        "roundabout_lanes": 20,
        "no_lanes": 10,
        "length": 2000,
        "roundabout_radius": 1000,
        **{f"{part}_merge_length": 5000 for part in ("before", "converge", "parallel", "after")},
        "vehicles_count": 1000,
        "cells": 10_000,
        "horizon": 1000,
        "stack_size": 100,
        "observation_shape": 2000,
        "actions_per_axis": 100,
    }
)
"""Options of highway-env's environments whose size is the size of the work, with the largest that takes seconds."""
NESTED = ("observation_config", "observation_configs", "action_config")
"""Options that are observations and actions themselves."""
MOST_CELLS = 250_000
"""Of an occupancy grid."""


def number(name: str, value: object, low: float, high: float) -> float:
    """A finite number within bounds, as float.

    Raises:
        WorldError: naming the field, the bounds and what was received.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise WorldError(field=name, expected=f"a number from {low:g} to {high:g}", received=repr(value))
    return float(value)


def whole(name: str, value: object, low: int, high: int) -> int:
    """A whole number within bounds.

    Raises:
        WorldError: naming the field, the bounds and what was received.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise WorldError(field=name, expected=f"a whole number from {low} to {high}", received=repr(value))
    return value


def one_of(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Check for one of some names.

    Raises:
        WorldError: with the names.
    """
    if not isinstance(value, str) or value not in choices:
        raise WorldError(field=name, expected=f"one of {', '.join(choices)}", received=repr(value))


def plain(name: str, value: Any) -> Any:
    """A copy of plain data, as a corpus file can hold it: tuples and numpy arrays become lists.

    Raises:
        WorldError: naming what cannot be written down.
    """
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise WorldError(field=name, expected="text as keys", received=repr(key))
        return {key: plain(f"{name}.{key}", item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(f"{name}[{index}]", item) for index, item in enumerate(value)]
    if type(value).__module__ == "numpy" and hasattr(value, "tolist"):
        return plain(name, value.tolist())
    if value is None or (isinstance(value, (bool, int, float, str)) and not _is_nan(value)):
        return value
    expected = "plain data (numbers, text, lists, mappings), which a corpus file can hold"
    raise WorldError(field=name, expected=expected, received=repr(value))


def sizes(place: str, config: Any) -> None:
    """Check that an environment of this configuration can be made in seconds.

    Raises:
        WorldError: naming the option, and the largest value of it.
    """
    if isinstance(config, (list, tuple)):
        for index, inner in enumerate(config):
            sizes(f"{place}[{index}]", inner)
    if not isinstance(config, Mapping):
        return
    for name, value in config.items():
        most = LARGEST.get(name, math.inf)
        numbers = [each for each in (value if isinstance(value, list) else [value]) if isinstance(each, (int, float))]
        if any(abs(each) > most for each in numbers):
            expected = f"at most {most:g}, so that an environment is made in seconds"
            raise WorldError(field=f"{place}.{name}", expected=expected, received=repr(value))
        sizes(f"{place}.{name}", value)
    _check_grid(place, config.get("grid_size", ((-27.5, 27.5), (-27.5, 27.5))), config.get("grid_step"))


def known_options(place: str, given: Any, known: Collection[str]) -> None:
    """Check the names of options that highway-env's observations and actions would pass over in silence.

    Args:
        place: of the options.
        given: the options; those of observations and actions inside of others are checked, too.
        known: names.

    Raises:
        WorldError: naming the option, and the one that is near.
    """
    if isinstance(given, list):
        for index, inner in enumerate(given):
            known_options(f"{place}[{index}]", inner, known)
    if not isinstance(given, Mapping):
        return
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            fix = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(sorted(known))}"
            raise WorldError(field=place, expected="options of highway-env's own", received=str(name), fix=fix)
        if name in NESTED:
            known_options(f"{place}.{name}", given[name], known)


def _check_grid(place: str, size: Any, step: Any) -> None:
    try:
        cells = math.prod(abs(high - low) / abs(width) for (low, high), width in zip(size, step, strict=True))
    except (TypeError, ValueError, ZeroDivisionError):
        return  # no grid, or one that the environment refuses
    if cells > MOST_CELLS:
        expected = f"a grid of at most {MOST_CELLS} cells"
        raise WorldError(field=f"{place}.grid_step", expected=expected, received=f"one of {cells:.0f}")


def ticks(duration: float, physics_hz: int) -> None:
    """Check that the record of a run fits into memory.

    Raises:
        WorldError: with the longest run.
    """
    if duration * physics_hz > MOST_TICKS:
        expected = f"at most {MOST_TICKS / physics_hz:g} s at {physics_hz} ticks a second"
        raise WorldError(field="duration", expected=expected, received=f"{duration:g}")


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def callables(name: str, value: Any) -> tuple[Callable[..., Any], ...]:
    """A list of callables.

    Raises:
        WorldError: naming what is none.
    """
    if not isinstance(value, (list, tuple)):
        raise WorldError(field=name, expected="a list of callables", received=f"{value!r:.200}")
    for index, each in enumerate(value):
        if not callable(each):
            raise WorldError(field=f"{name}[{index}]", expected="a callable", received=f"{each!r:.200}")
    return tuple(value)


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
        field=ads_name,
        expected=f"a divisor of {physics_name}={physics_hz}, so that every decision lasts a whole number of ticks",
        received=str(ads_hz),
        fix=f"use one of {', '.join(map(str, divisors))}, or {physics_name}={up}",
    )


def top_speed(limits: NpcLimits, road: StraightRoad | NetworkRoad) -> float:
    """The NPCs' top speed [m/s].

    Raises:
        WorldError: when highway-env's vehicles cannot drive it.
    """
    speed = limits.overspeed * road.speed_limit
    if speed > TOP_SPEED:
        raise WorldError(
            field="speed_limit",
            expected=f"at most {TOP_SPEED / limits.overspeed:.1f} m/s, because NPCs may drive {limits.overspeed:g} "
            f"times the limit and highway-env's vehicles reach {TOP_SPEED:g} m/s",
            received=f"{road.speed_limit:g}",
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
        expected = f"at most {room / TOP_SPEED:g} s on a road of {road.lanes[0].length:g} m"
        raise WorldError(field="duration", expected=expected, received=f"{duration:g}")


def fits(scenario: Scenario, rules: Rules) -> None:
    """Check a scenario against a world.

    Raises:
        ScenarioError: naming the field that does not fit.
        WorldError: for Lane-Instructions on a road that is not straight.
    """
    if not isinstance(scenario, Scenario):
        raise ScenarioError(field="scenario", expected="a Scenario", received=repr(scenario))
    if not isinstance(rules.road, StraightRoad) and not scenario.positions:
        raise WorldError(
            field="scenario",
            expected="Position-Instructions on a road that is not straight",
            received="Lane-Instructions, which know no lanes that begin and end",
            fix="give NPCs PositionInstruction(cell, speed), or take a straight road such as pafot.Highway()",
        )
    _check_lane(scenario, rules.road)
    cells = rules.start_cells(scenario)
    if len(scenario.npcs) > len(cells):
        expected = f"at most {len(cells)} NPCs, one per cell that exists beside lane {scenario.ego_lane}"
        raise ScenarioError(field="npcs", expected=expected, received=str(len(scenario.npcs)))
    _check_speeds(scenario, rules)
    ticks = scenario.gene_seconds * rules.physics_hz
    if abs(ticks - round(ticks)) > 1e-6 or round(ticks) < 1:
        raise ScenarioError(
            field="gene_seconds",
            expected=f"a whole number of ticks of 1/{rules.physics_hz} s",
            received=f"{scenario.gene_seconds:g}",
            fix=f"the nearest is {max(round(ticks), 1) / rules.physics_hz!r}",
        )


def _check_lane(scenario: Scenario, road: StraightRoad | NetworkRoad) -> None:
    if isinstance(road, StraightRoad):
        count = road.lane_count
        if scenario.ego_lane >= count:
            raise ScenarioError(
                field="ego_lane",
                expected=f"a lane from 0 to {count - 1}",
                received=str(scenario.ego_lane),
                fix=f"the road has {count} lanes",
            )
        return
    lanes = road.start_lanes
    if scenario.ego_lane not in lanes:
        raise ScenarioError(
            field="ego_lane",
            expected=f"a lane that exists where the ego starts, {' or '.join(map(str, lanes))}",
            received=str(scenario.ego_lane),
            fix="lanes are counted from 0 at the left over all of the ego's way",
        )


def _check_speeds(scenario: Scenario, rules: Rules) -> None:
    road, top = rules.road, top_speed(rules.limits, rules.road)
    if scenario.ego_speed > top:
        expected = f"at most {top:.2f} m/s, the NPCs' top speed, because all start at the ego's speed"
        raise ScenarioError(field="ego_speed", expected=expected, received=f"{scenario.ego_speed:g}")
    for npc, chain in enumerate(scenario.npcs):
        for gene, instruction in enumerate(chain):
            if instruction.speed > road.speed_limit + 1e-9:
                expected = f"at most the speed limit of {road.speed_limit:g} m/s"
                place = f"npcs[{npc}][{gene}].speed"
                raise ScenarioError(field=place, expected=expected, received=f"{instruction.speed:g}")
