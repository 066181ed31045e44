"""Dangerous patterns: phrases of one or two Position-Instructions, and chains made of them.

A pattern says what an NPC does around the ego. A scenario never starts in a dangerous state: NPCs start as in any
scenario, and drive into it. A pattern is defined for the ego's left side, front or rear, and mirrored half of the time.

Sources: Najm, Smith, Yanagisawa, "Pre-Crash Scenario Typology for Crash Avoidance Research", NHTSA, DOT HS 810 767,
2007; UN Regulation No. 157, annex 4, appendix 3 (critical disturbances: cut-in, cut-out, deceleration) and annex 5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from numpy.random import Generator

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions import SPEED_STEPS_PER_MPS, PositionInstruction, known

Bound = tuple[float, float]
"""A limit of a target speed: a share of the ego's first speed, plus an offset [m/s]; from 0 to the speed limit."""

LIMIT = (0.0, math.inf)
"""The bound that is always clipped to the speed limit."""


class Step(NamedTuple):
    """One gene of a pattern: a target cell, and the lowest and highest target speed."""

    cell: Cell
    low: Bound
    high: Bound


class Pattern(NamedTuple):
    """The steps of an NPC, with a name and the source that lists it as dangerous."""

    name: str
    steps: tuple[Step, ...]
    source: str


PATTERNS = (
    Pattern(
        "cut-in and brake",
        (Step(Cell.FRONT_LEFT, (1, -2), (1, 3)), Step(Cell.FRONT, (0, 0), (0.6, 0))),
        "UN R157, annex 4, appendix 3: cut-in; NHTSA: vehicle changing lanes, same direction",
    ),
    Pattern(
        "leader that brakes or stands",
        (Step(Cell.FRONT, (0, 0), (0, 5)),),
        "UN R157, annex 4, appendix 3: deceleration; NHTSA: lead vehicle decelerating, lead vehicle stopped",
    ),
    Pattern(
        "slow leader",
        (Step(Cell.FRONT, (0.3, 0), (0.8, 0)),),
        "NHTSA: lead vehicle moving at lower constant speed; UN R157, annex 5: following a lead vehicle",
    ),
    Pattern(
        "vehicle beside",
        (Step(Cell.LEFT, (1, -2), (1, 2)),),
        "NHTSA: vehicle changing lanes, same direction (the ego changes)",
    ),
    Pattern(
        "fast one from behind in the next lane",
        (Step(Cell.REAR_LEFT, (1, 0), LIMIT), Step(Cell.REAR_LEFT, (1, 0), LIMIT)),
        "NHTSA: vehicle changing lanes, same direction (the ego changes)",
    ),
    Pattern(
        "cut-out",
        (Step(Cell.FRONT, (1, -4), (1, 0)), Step(Cell.FRONT_LEFT, (0, 0), LIMIT)),
        "UN R157, annex 4, appendix 3: cut-out",
    ),
    Pattern(
        "slow one ahead in the next lane",
        (Step(Cell.FRONT_LEFT, (0, 0), (0.5, 0)),),
        "NHTSA: following vehicle making a maneuver (the ego follows)",
    ),
    Pattern(
        "tailgater",
        (Step(Cell.REAR, (1, 0), LIMIT),),
        "NHTSA: lead vehicle decelerating (the ego leads)",
    ),
)
"""All patterns; each is sampled with equal probability."""
MIRRORED = {
    pattern.name: tuple(step._replace(cell=Cell((3 - step.cell) % 8 + 1)) for step in pattern.steps)
    for pattern in PATTERNS
}
"""The steps of each pattern with left and right exchanged, by its name; half of the samples have these."""

WALKING = ((1.0, -2.0), (1.0, 3.0))
"""The lowest and highest target speed on the way from one pattern to the next."""


def chain_of_patterns(
    genes: int, ego_speed: float, bounds: tuple[int, int], rng: Generator
) -> list[PositionInstruction]:
    """Return a chain with ``genes`` genes: random patterns, one after the other, joined by steps on the ring.

    Speeds depend on the ego's first speed [m/s], and are within ``bounds``, given in steps of 0.1 m/s.
    """
    chain: list[PositionInstruction] = []
    while len(chain) < genes:
        chain = followed_by_pattern(chain, ego_speed, bounds, rng)
    return chain[:genes]


def followed_by_pattern(
    chain: Sequence[PositionInstruction], ego_speed: float, bounds: tuple[int, int], rng: Generator
) -> list[PositionInstruction]:
    """Append a random pattern to a chain, with the steps on the ring to its first cell; the chain may be empty."""
    pattern = PATTERNS[int(rng.integers(len(PATTERNS)))]
    steps = MIRRORED[pattern.name] if rng.integers(2) else pattern.steps
    way = [Step(cell, *WALKING) for cell in _between(chain[-1].cell, steps[0].cell, rng)] if chain else []
    return [*chain, *(_drawn(step, ego_speed, bounds, rng) for step in (*way, *steps))]


def _drawn(step: Step, ego_speed: float, bounds: tuple[int, int], rng: Generator) -> PositionInstruction:
    least, most = bounds
    low, high = (
        min(max((share * ego_speed + more) * SPEED_STEPS_PER_MPS, least), most) for share, more in (step.low, step.high)
    )
    speed = int(rng.integers(int(low), int(high) + 1)) / SPEED_STEPS_PER_MPS
    gene: PositionInstruction = known(PositionInstruction, step.cell, speed)
    return gene


def _between(first: Cell, last: Cell, rng: Generator) -> list[Cell]:
    """Return the cells between two cells on the shorter side of the ring, or on a random side if they are opposite."""
    clockwise = (last - first) % 8
    is_clockwise = clockwise < 4 or (clockwise == 4 and bool(rng.integers(2)))
    steps = range(1, clockwise) if is_clockwise else range(-1, clockwise - 8, -1)
    return [Cell((first - 1 + step) % 8 + 1) for step in steps]
