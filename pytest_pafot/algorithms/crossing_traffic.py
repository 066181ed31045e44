"""The sampling of crossing NPCs that do not conflict with each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

from numpy.random import Generator

from pytest_pafot.model.crossings import STEP, Crossings
from pytest_pafot.model.instructions import (
    LARGEST_SLOT,
    SLOT_STEPS_PER_SECOND,
    SPEED_STEPS_PER_MPS,
    Act,
    CrossingInstruction,
    pick,
)
from pytest_pafot.model.scenario import Chromosome

# Acts that are sampled. ``late`` is not, because it often leaves unclear which vehicle had to wait.
ACTS: tuple[Act, ...] = ("pass", "hold", "stop")
PASSES = 0.7  # fraction of the crossing NPCs that drive through their zone without stopping
# Probability of each kind of slot: well before the ego, just before it, together with it, just after it and well after
# it. "Just after" is most likely, because it tests an ego that hesitates.
SLOT_SHARES = (0.1, 0.2, 0.2, 0.3, 0.2)
# lowest target speed of a crossing NPC [m/s]; slower NPCs rarely arrive at their zone
SLOWEST = 3.0
# Probabilities that a variation moves the slot, changes the speed, or changes the act. Otherwise, a new instruction is
# sampled.
SLOT_CHANGE = 0.5
SPEED_CHANGE = 0.25
ACT_CHANGE = 0.1
SHIFT = 0.8  # standard deviation of the time by which a variation moves a slot [s]
ATTEMPTS = 30  # attempts to sample an instruction that does not conflict with other NPCs
# attempts to sample an instruction that fits its path, before an error is raised
MOST_ATTEMPTS = 1000


@dataclass(frozen=True, slots=True)
class CrossingTraffic:
    """The distribution from which the instructions of crossing NPCs are sampled.

    Other NPCs are not checked for conflicts, because their paths depend on the ego.
    """

    crossings: Crossings  # the paths of the world
    low: float  # lowest target speed [m/s]
    high: float  # highest target speed [m/s], unless the bends of a path require a lower one
    most_on_grid: int  # largest number of other NPCs in a scenario; each needs a cell to start in

    def sample(self, rng: Generator) -> CrossingInstruction:
        """Sample an instruction with which an NPC can start on its path.

        Raises:
            ValueError: if almost no instruction fits.
        """
        for _ in range(MOST_ATTEMPTS):
            zone = pick(self.crossings.zones, rng).way
            instruction = CrossingInstruction(
                zone,
                sample_slot(rng),
                self._speed(zone, rng),
                self._act(rng),
            )
            if self.crossings.fits(instruction):
                return instruction
        raise ValueError(
            f"crossings: expected paths on which an NPC can start and arrive, but none of {MOST_ATTEMPTS} samples "
            f"fits (number of paths: {len(self.crossings.ways)}). Start the ego earlier, or use crossings=None."
        )

    def vary(self, instruction: CrossingInstruction, rng: Generator) -> CrossingInstruction:
        """Change the slot, speed or act, or sample a new instruction. The result may not fit its path."""
        share = rng.random()
        if share < SLOT_CHANGE:
            step = max(1, round(abs(rng.normal(0, SHIFT)) * SLOT_STEPS_PER_SECOND))
            if not rng.integers(2):
                step = -step
            slot = instruction.slot + step / SLOT_STEPS_PER_SECOND
            slot = min(max(slot, -LARGEST_SLOT), LARGEST_SLOT)
            return replace(instruction, slot=_tenths(slot))
        if share < SLOT_CHANGE + SPEED_CHANGE:
            return replace(instruction, speed=self._speed(instruction.zone, rng))
        if share < SLOT_CHANGE + SPEED_CHANGE + ACT_CHANGE:
            others = [act for act in ACTS if act != instruction.act]
            return replace(instruction, act=pick(others, rng))
        return self.sample(rng)

    def first_with_room(
        self,
        others: Sequence[CrossingInstruction],
        propose: Callable[[], CrossingInstruction],
    ) -> CrossingInstruction | None:
        """Return the first of 30 proposals for which :meth:`has_room` is True, or None."""
        for _ in range(ATTEMPTS):
            proposal = propose()
            if self.has_room(proposal, others):
                return proposal
        return None

    def has_room(
        self,
        instruction: CrossingInstruction,
        others: Sequence[CrossingInstruction],
    ) -> bool:
        """Return whether an instruction fits its path and does not conflict with ``others``."""
        return self.crossings.fits(instruction) and not any(
            self.crossings.clash(instruction, each) for each in others
        )

    def without_conflicts(
        self,
        npcs: Sequence[Chromosome],
        rng: Generator,
    ) -> dict[int, Chromosome]:
        """Return the chains after resolving conflicts between crossing NPCs, by their indices in ``npcs``.

        NPCs that fit nowhere are omitted. If there is no conflict, no random number is used.
        """
        kept: dict[int, Chromosome] = {}
        told: list[CrossingInstruction] = []
        for npc, chain in enumerate(npcs):
            first = chain[0]
            if not first.crosses and len(kept) - len(told) < self.most_on_grid:
                kept[npc] = chain
                continue
            # If no start cell is left for an NPC, it crosses instead.
            wanted = cast("CrossingInstruction", first) if first.crosses else self.sample(rng)
            found = self._room_for(wanted, told, rng)
            if found is not None:
                told.append(found)
                kept[npc] = (found,)
        return kept

    def _room_for(
        self,
        instruction: CrossingInstruction,
        others: Sequence[CrossingInstruction],
        rng: Generator,
    ) -> CrossingInstruction | None:
        if self.has_room(instruction, others):
            return instruction
        # Try the same path, speed and act with other slots, then other instructions, and finally the latest possible
        # slot.
        another = self.first_with_room(others, lambda: replace(instruction, slot=sample_slot(rng)))
        if another is None:
            another = self.first_with_room(others, lambda: self.sample(rng))
        if another is not None:
            return another
        last = replace(instruction, slot=LARGEST_SLOT, act="pass")
        if self.has_room(last, others):
            return last
        return None

    def _speed(self, zone: str, rng: Generator) -> float:
        low, high = self._bounds(zone)
        return max(int(rng.integers(low, high + 1)), 1) / SPEED_STEPS_PER_MPS

    def _bounds(self, zone: str) -> tuple[int, int]:
        """Return the limits on the target speed on a path, in steps of 0.1 m/s."""
        way = self.crossings.ways[zone]
        # The speed of the fastest section before the exit of the zone limits the target speed.
        points = math.ceil(way.zone.npc[1] / STEP) + 1
        allowed = min(self.high, float(way.speeds[:points].max()))
        high = math.floor(allowed * SPEED_STEPS_PER_MPS + 1e-6)
        low = round(max(self.low, SLOWEST) * SPEED_STEPS_PER_MPS)
        return min(low, high), high

    def _act(self, rng: Generator) -> Act:
        if rng.random() < PASSES:
            return "pass"
        return pick(ACTS[1:], rng)


def sample_slot(rng: Generator) -> float:
    """Sample a slot [s]."""
    kind = rng.choice(len(SLOT_SHARES), p=SLOT_SHARES)
    # The square makes longer times rarer.
    far = 1 + (LARGEST_SLOT - 1) * rng.random() ** 2
    near = int(rng.integers(1, SLOT_STEPS_PER_SECOND)) / SLOT_STEPS_PER_SECOND
    return _tenths([-far, -near, 0.0, near, far][kind])


def _tenths(slot: float) -> float:
    return round(slot * SLOT_STEPS_PER_SECOND) / SLOT_STEPS_PER_SECOND
