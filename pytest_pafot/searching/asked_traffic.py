"""Manoeuvres of a search: how they are sampled and varied.

The NPCs of a scenario start one behind the other, ahead of the ego or behind it, so that no two of them touch, whatever
their lanes are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count, product
from typing import Any

from numpy.random import Generator

from pytest_pafot.model.scenario import MOST_BESIDE, SHIFTS, Chromosome, Manoeuvre, ScenarioError, Step

FIRST_GAP, SPACING, SPREAD = 12.0, 24.0, 12.0
"""The gap between the ego and the nearest start, from one start to the next, and the part of it that is sampled [m]."""
LONGEST = SPACING - SPREAD - 1.0
"""The length of the longest vehicle for which there is room between two starts [m]."""
MOST_ROOM = 20 * SPACING
"""The farthest start that is looked for [m]."""
AHEAD = 0.65
"""Share of the NPCs that start ahead of the ego."""
FEWEST_SAMPLED, MOST_SAMPLED = 6, 14
"""The smallest and the largest number of steps of a sampled manoeuvre."""
BY_GAP, BEHIND = 0.2, 0.25
"""Share of the steps that begin at a gap, and of these the share with the NPC behind the ego; the others are timed."""
NEAR, FAR, LATER = 4.0, 45.0, 4.0
"""The smallest and the largest gap [m], and the longest time after the step before [s]."""
SIDEWAYS = 0.6
"""Share of the steps that change lanes."""
NEAR_EGO, ANY_SPEED = 8.0, 0.5
"""How far a speed is from the ego's first speed at most [m/s], and the share of the speeds that are any."""


def drawn(space: Any, others: Sequence[Chromosome], rng: Generator) -> Manoeuvre:
    """Sample the manoeuvre of an NPC beside ``others``; ``space`` is a search space with a fixed start."""
    taken = {_slot(chain[0]) for chain in others if isinstance(chain[0], Manoeuvre)}
    slot = next(each for each in count() if not {(-1, each), (1, each)} & taken)
    gap = FIRST_GAP + SPREAD * rng.random()
    lane = int(rng.integers(space.lanes)) if space.lanes else space.ego_lane
    steps = tuple(step(space, rng) for _ in range(int(rng.integers(FEWEST_SAMPLED, MOST_SAMPLED + 1))))
    side = 1 if rng.random() < AHEAD else -1
    if slot >= places(space.room, side):  # the road is too short there: start anywhere else, next to an NPC if need be
        free = [
            (side, slot)
            for slot, side in product(range(max(places(space.room, -1), places(space.room, 1))), (side, -side))
            if slot < places(space.room, side) and (side, slot) not in taken
        ]
        if not free:
            expected, received = f"at most {len(others)} NPCs with manoeuvres", f"{len(others) + 1}"
            fix = "the road has no more room ahead of the ego's start and behind it; ask for fewer NPCs"
            raise ScenarioError(field="npcs", expected=expected, received=received, fix=fix)
        side, slot = free[0]
    ahead = round(side * (gap + SPACING * slot), 1)
    beside = min(max(lane - space.ego_lane, -MOST_BESIDE), MOST_BESIDE)
    return Manoeuvre(beside=beside, ahead=ahead, speed=_speed(space, rng), steps=steps)


def places(room: tuple[float, float], side: int) -> int:
    """Return how many NPCs can start behind the ego (-1) or ahead of it (1) with this room behind and ahead [m]."""
    return int(min(room[side > 0], MOST_ROOM) // SPACING)


def _slot(manoeuvre: Manoeuvre) -> tuple[int, int]:
    side = 1 if manoeuvre.ahead > 0 else -1
    return side, max(0, int((abs(manoeuvre.ahead) - FIRST_GAP + 0.05) // SPACING))


def step(space: Any, rng: Generator) -> Step:
    """Sample a step."""
    trigger: dict[str, float] = {"after": round(LATER * rng.random(), 1)}
    if rng.random() < BY_GAP:
        gap = NEAR + (FAR - NEAR) * rng.random()
        trigger = {"gap": round(-gap if rng.random() < BEHIND else gap, 1)}
    return Step(
        **trigger,
        lane=SHIFTS[int(rng.integers(1, 3))] if space.lanes and rng.random() < SIDEWAYS else "keep",
        lateral_speed=round(1 + 2 * rng.random(), 1),
        speed=_speed(space, rng),
        acceleration=round(1 + 6 * rng.random(), 1),
    )


def _speed(space: Any, rng: Generator) -> float:
    low, high = int(space.low_step), int(space.top_step)
    if rng.random() >= ANY_SPEED:
        near: int = round(10 * (space.ego_speed + NEAR_EGO * (2 * rng.random() - 1)))
        return min(max(near, low), high) / 10
    return int(rng.integers(low, high + 1)) / 10


def varied(manoeuvre: Manoeuvre, space: Any, rng: Generator) -> Manoeuvre:
    """Return a manoeuvre with another step, one step more or less, or another speed at the start."""
    steps, kind = manoeuvre.steps, rng.random()
    place = int(rng.integers(len(steps))) if steps else 0
    if steps and kind < 0.6:
        return replace(manoeuvre, steps=(*steps[:place], step(space, rng), *steps[place + 1 :]))
    if steps and kind < 0.75:
        return replace(manoeuvre, steps=(*steps[:place], *steps[place + 1 :]))
    if len(steps) < MOST_SAMPLED and kind < 0.9:
        return replace(manoeuvre, steps=(*steps[:place], step(space, rng), *steps[place:]))
    return replace(manoeuvre, speed=_speed(space, rng))


def in_lane(npcs: Sequence[Chromosome], before: int, now: int) -> tuple[Chromosome, ...]:
    """Return chains whose manoeuvres start in the same lanes although the ego's first lane is another one.

    On a road of ten lanes and more, those that would start too far aside start nearer.
    """
    return tuple(
        (replace(chain[0], beside=min(max(chain[0].beside + before - now, -MOST_BESIDE), MOST_BESIDE)),)
        if isinstance(chain[0], Manoeuvre)
        else chain
        for chain in npcs
    )
