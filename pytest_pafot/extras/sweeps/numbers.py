"""The numbers of a scenario that a sweep changes, by their names: ``ego.speed``, ``npcs.0.0.speed``, ``npcs.0.gap``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from pytest_pafot import Scenario
from pytest_pafot.support.errors import RequestError, plain_number
from pytest_pafot.support.text import capitalised, meant

UNITS = {
    "speed": "m/s", "ego_speed": "m/s", "lateral_speed": "m/s", "acceleration": "m/s^2", "gap": "m", "ahead": "m",
    "offset": "m", "headway": "s", "after": "s", "slot": "s", "gene_seconds": "s",
}  # fmt: skip
"""The units of the numbers."""

LEVELS = 200
"""The largest number of values on an axis."""

LEAST_STEP = 0.1
"""The smallest difference of two values on an axis."""

PAIR = re.compile(r"([^=\s]+)=(\S+)")


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of a map.

    Attributes:
        name: the number that changes.
        values: its values, in order.
        unit: its unit.
        about: what it is, in words; empty if its name has to do.
    """

    name: str
    values: tuple[float, ...]
    unit: str
    about: str = ""

    @property
    def title(self) -> str:
        """The name and the unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def words(self) -> str:
        """The meaning and the unit, for a picture; without words the :attr:`title`."""
        words = capitalised(self.about.removeprefix("the "))
        return (f"{words} [{self.unit}]" if self.unit else words) if words else self.title


def words_of(name: str) -> str:
    """Return in words what a number of a scenario is, such as ``speed of NPC 0 in instruction 2``."""
    first, *path = name.split(".")
    if first != "npcs":
        return {"ego.speed": "first speed of the ego", "gene_seconds": "duration of an instruction"}.get(name, "")
    npc, *path, last = path
    step = f", step {path[path.index('steps') + 1]}" if "steps" in path else ""
    gene = f" in instruction {path[0]}" if path and path[0] != "steps" else ""
    known = {
        "after": "wait",
        "ahead": "distance ahead",
        "headway": "distance in time",
        "lateral_speed": "speed across the road",
    }
    return f"{known.get(last, last)} of NPC {npc}{gene}{step}"


def values_of(name: str, given: object) -> tuple[float, ...]:
    """Return the values that a text such as ``0:60:7`` (first, last, count) or a sequence of numbers stands for.

    Raises:
        RequestError: for anything else, or too many values.
    """
    expected = f"over: {name}: expected first:last:count, such as 0:60:7, or different numbers, 2 to {LEVELS} of them"
    if isinstance(given, str):
        try:
            first, last, count = (float(part) for part in given.split(":"))
        except ValueError:
            raise RequestError(f"{expected}, received {given!r:.60}") from None
        if not (math.isfinite(first + last) and 2 <= count <= LEVELS and count == int(count)):
            raise RequestError(f"{expected}, received {given!r:.60}")
        steps = int(count) - 1
        given = [first + (last - first) * step / steps for step in range(steps + 1)]
    numbers = [plain_number(value) for value in given] if isinstance(given, Sequence | np.ndarray) else []
    values = {round(value, 4) + 0.0 for value in numbers if value is not None}
    if not 2 <= len(values) == len(numbers) <= LEVELS:
        raise RequestError(f"{expected}, received {given!r:.60}")
    ordered = tuple(sorted(values))
    if any(high - low < LEAST_STEP - 1e-6 for low, high in pairwise(ordered)):
        fix = "scenarios have numbers in steps of 0.1"
        raise RequestError(f"over: {name}: expected values at least {LEAST_STEP} apart, received {given!r:.60}; {fix}")
    return ordered


def over_of(texts: Sequence[str]) -> dict[str, str]:
    """Return the axes that the arguments ``--over name=first:last:count`` name."""
    over: dict[str, str] = {}
    for text in texts:
        found = PAIR.fullmatch(text)
        if found is None or found[1] in over:
            raise RequestError(
                f"--over: expected different NAME=FIRST:LAST:COUNT, such as gap=0:60:7, received {text!r}"
            )
        over[found[1]] = found[2]
    return over


def names_in(scenario: Scenario) -> list[str]:
    """Return the names of all numbers of a scenario that a sweep can change."""
    names = ["ego.speed", *(["gene_seconds"] if math.isfinite(scenario.seconds) else [])]
    for npc, chain in enumerate(scenario.npcs):
        for number, gene in enumerate(chain):
            place = f"npcs.{npc}" if gene.is_alone else f"npcs.{npc}.{number}"
            names += [f"{place}.{name}" for name in ("speed", "slot", "ahead") if hasattr(gene, name)]
            for index, step in enumerate(gene.steps):
                numbers = ("gap", "headway", "after", "lateral_speed", "offset", "speed", "acceleration")
                told = [name for name in numbers if isinstance(getattr(step, name), float)]
                names += [f"{place}.steps.{index}.{name}" for name in told]
    return names


def unit_of(name: str) -> str:
    """Return the unit of a number of a scenario."""
    return UNITS.get(name.rpartition(".")[2], "")


def with_number(scenario: Scenario, name: str, value: float) -> Scenario:
    """Return a scenario with another number; it is rounded to the 0.1 that scenarios have.

    Raises:
        RequestError: if the scenario has no number of this name.
        ScenarioError: if the scenario cannot have the value.
    """
    value = round(value, 1) + 0.0
    if name not in names_in(scenario):
        known = names_in(scenario)
        raise RequestError(f"over: expected one of {', '.join(known)}, received {name!r:.60}{meant(name, known)}")
    if not name.startswith("npcs."):
        return replace(scenario, ego_speed=value) if name == "ego.speed" else replace(scenario, gene_seconds=value)
    _, npc, *path = name.split(".")
    chain = scenario.npcs[int(npc)]
    if chain[0].is_alone:
        path = ["0", *path]
    npcs = [*scenario.npcs]
    npcs[int(npc)] = _replaced(chain, path, value)
    return replace(scenario, npcs=tuple(npcs))


def _replaced(value: Any, path: Sequence[str], new: float) -> Any:
    """Return nested tuples and dataclasses with the number at a path replaced."""
    if not path:
        return new
    first, *rest = path
    if is_dataclass(value) and not isinstance(value, type):
        if first not in {each.name for each in fields(value)}:
            raise RequestError(f"over: expected the name of a number, received {first!r}")
        return replace(value, **{first: _replaced(getattr(value, first), rest, new)})
    index = int(first)
    return (*value[:index], _replaced(value[index], rest, new), *value[index + 1 :])
