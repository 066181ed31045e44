"""NPCs on ways that cross the ego's: their instructions are sampled and varied so that these NPCs do not conflict.

NPCs that do not cross are not checked for conflicts, because where they drive depends on the ego.
"""

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
)
from pytest_pafot.model.scenario import Chromosome

ACTS: tuple[Act, ...] = ("pass", "hold", "stop")
"""Acts that are sampled. ``late`` is left out, because after it one can often dispute who had to wait."""
PASSES = 0.7
"""Share of the crossing NPCs that drive through their zone without stopping."""
SLOT_SHARES = {"well before": 0.1, "just before": 0.2, "together": 0.2, "just after": 0.3, "well after": 0.2}
"""Probability of each of the five kinds of slots. "Just after" is most likely: it meets an ego that hesitates."""
SLOWEST = 3.0
"""Lowest target speed of an NPC that crosses [m/s]; slower NPCs rarely arrive at their zone."""
SLOT_CHANGE, SPEED_CHANGE, ACT_CHANGE = 0.5, 0.25, 0.1
"""Probabilities that a variation of an instruction moves its slot, changes its speed, or changes its act; otherwise a
new instruction is sampled."""
SHIFT = 0.8
"""Standard deviation of the time by which a variation moves a slot [s]."""
ATTEMPTS = 30
"""Number of attempts to sample an instruction that does not conflict with other NPCs."""
MOST_ATTEMPTS = 1000
"""Number of attempts to sample an instruction with which an NPC can start on its way, before an error is raised."""


@dataclass(frozen=True, slots=True)
class CrossingTraffic:
    """The distribution from which the instructions of crossing NPCs are sampled.

    Attributes:
        crossings: the ways of the world.
        low, high: lowest and highest target speed [m/s]; bends of a way may limit it further.
        most_on_grid: largest number of NPCs that do not cross in the same scenario; each needs a cell to start in.
    """

    crossings: Crossings
    low: float
    high: float
    most_on_grid: int

    def drawn(self, rng: Generator) -> CrossingInstruction:
        """Sample an instruction with which an NPC can start on its way.

        Raises:
            ValueError: if hardly any instruction fits.
        """
        for _ in range(MOST_ATTEMPTS):
            zones = self.crossings.zones
            zone = zones[int(rng.integers(len(zones)))].way
            instruction = CrossingInstruction(zone, drawn_slot(rng), self._speed(zone, rng), self._act(rng))
            if self.crossings.fits(instruction):
                return instruction
        raise ValueError(
            f"crossings: expected ways on which an NPC can start and keep a slot, received {len(self.crossings.ways)} "
            f"on which none of {MOST_ATTEMPTS} instructions fits; let the ego start earlier, or give crossings=None"
        )

    def varied(self, instruction: CrossingInstruction, rng: Generator) -> CrossingInstruction:
        """Change the slot, speed or act of an instruction, or sample a new one; the result may not fit its way."""
        share = rng.random()
        if share < SLOT_CHANGE:
            step = max(1, round(abs(rng.normal(0, SHIFT)) * SLOT_STEPS_PER_SECOND)) * (1 if rng.integers(2) else -1)
            slot = instruction.slot + step / SLOT_STEPS_PER_SECOND
            return replace(instruction, slot=_tenths(min(max(slot, -LARGEST_SLOT), LARGEST_SLOT)))
        if share < SLOT_CHANGE + SPEED_CHANGE:
            return replace(instruction, speed=self._speed(instruction.zone, rng))
        if share < SLOT_CHANGE + SPEED_CHANGE + ACT_CHANGE:
            others = [act for act in ACTS if act != instruction.act]
            return replace(instruction, act=others[int(rng.integers(len(others)))])
        return self.drawn(rng)

    def beside(
        self, others: Sequence[CrossingInstruction], propose: Callable[[], CrossingInstruction]
    ) -> CrossingInstruction | None:
        """Return the first proposal that fits its way and does not conflict with ``others``; None after 30 attempts."""
        proposals = (propose() for _ in range(ATTEMPTS))
        return next((each for each in proposals if self.has_room(each, others)), None)

    def has_room(self, instruction: CrossingInstruction, others: Sequence[CrossingInstruction]) -> bool:
        """Return whether an instruction fits its way and does not conflict with any of ``others``."""
        return self.crossings.fits(instruction) and not any(self.crossings.clash(instruction, each) for each in others)

    def cleared(self, npcs: Sequence[Chromosome], rng: Generator) -> tuple[Chromosome, ...]:
        """Return the chains without conflicts between crossing NPCs, and with at most ``most_on_grid`` others.

        An instruction that conflicts with an earlier chain is sampled again, at first with the same way, speed and act.
        If that does not help, the NPC arrives as long after the ego as possible. If that conflicts as well, the NPC is
        left out. An NPC without a cell to start in crosses instead. No random number is used if everything fits.
        """
        return tuple(chain for _, chain in self.numbered(npcs, rng))

    def numbered(self, npcs: Sequence[Chromosome], rng: Generator) -> list[tuple[int, Chromosome]]:
        """Return the chains of :meth:`cleared`, each with its index before some were left out."""
        kept: list[tuple[int, Chromosome]] = []
        told: list[CrossingInstruction] = []
        for npc, chain in enumerate(npcs):
            first = chain[0]
            if not first.crosses and len(kept) - len(told) < self.most_on_grid:
                kept.append((npc, chain))
                continue
            wanted = cast("CrossingInstruction", first) if first.crosses else self.drawn(rng)
            found = self._room_for(wanted, told, rng)
            if found is not None:
                told.append(found)
                kept.append((npc, (found,)))
        return kept

    def _room_for(
        self, instruction: CrossingInstruction, others: Sequence[CrossingInstruction], rng: Generator
    ) -> CrossingInstruction | None:
        if self.has_room(instruction, others):
            return instruction
        another = self.beside(others, lambda: replace(instruction, slot=drawn_slot(rng)))
        if another is None:
            another = self.beside(others, lambda: self.drawn(rng))
        if another is None:
            last = replace(instruction, slot=LARGEST_SLOT, act="pass")
            another = last if self.has_room(last, others) else None
        return another

    def speeds(self, zone: str) -> list[float]:
        """Return the target speeds at which an NPC can arrive at a zone together with the ego [m/s]."""
        low, high = self._bounds(zone)
        speeds = (max(step, 1) / SPEED_STEPS_PER_MPS for step in range(low, high + 1))
        return [speed for speed in speeds if self.crossings.fits(CrossingInstruction(zone, 0.0, speed))]

    def _speed(self, zone: str, rng: Generator) -> float:
        low, high = self._bounds(zone)
        return max(int(rng.integers(low, high + 1)), 1) / SPEED_STEPS_PER_MPS

    def _bounds(self, zone: str) -> tuple[int, int]:
        """Return the lowest and highest target speed on the way to a zone, in steps of 0.1 m/s."""
        way = self.crossings.ways[zone]
        allowed = float(way.speeds[: math.ceil(way.zone.npc[1] / STEP) + 1].max())
        high = math.floor(min(self.high, allowed) * SPEED_STEPS_PER_MPS + 1e-6)
        return min(round(max(self.low, SLOWEST) * SPEED_STEPS_PER_MPS), high), high

    def _act(self, rng: Generator) -> Act:
        if rng.random() < PASSES:
            return "pass"
        return ACTS[1 + int(rng.integers(len(ACTS) - 1))]


def drawn_slot(rng: Generator) -> float:
    """Sample a slot [s]: one of the five kinds, then a time in it. Times from 1 s on are rarer the longer they are."""
    name = rng.choice(list(SLOT_SHARES), p=list(SLOT_SHARES.values()))
    far = 1 + (LARGEST_SLOT - 1) * rng.random() ** 2
    near = int(rng.integers(1, SLOT_STEPS_PER_SECOND)) / SLOT_STEPS_PER_SECOND
    slots = {"well before": -far, "just before": -near, "together": 0.0, "just after": near, "well after": far}
    return _tenths(slots[name])


def _tenths(slot: float) -> float:
    return round(slot * SLOT_STEPS_PER_SECOND) / SLOT_STEPS_PER_SECOND
