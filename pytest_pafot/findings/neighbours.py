"""Neighbours of a scenario: scenarios that differ from it a little. How many of them fail says how broad a failure is.

The neighbours follow from the scenario, their number and the world that they must fit. So they are the same in every
session, on every machine.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

from pytest_pafot.model.scenario import (
    LARGEST_SLOT,
    LONGEST_GENE,
    SHIFTS,
    Chromosome,
    CrossingInstruction,
    Gene,
    LaneInstruction,
    Scenario,
)

SHARES: Mapping[float, str] = MappingProxyType({1.0: "all", 0.5: "half", 0.25: "a quarter of", 0.125: "an eighth of"})
"""The shares of the steps below with which neighbours are made, in words. A smaller share is used if no neighbour fails
before."""
SPEED = 1.5
"""The largest step of a single speed [m/s]."""
ALL_SPEEDS, DURATION = 0.1, 0.1
"""The largest steps of all speeds together, and of the duration of a gene, as shares of the values."""
WHOLE_TICKS = 0.2
"""Other durations of a gene are multiples of this [s], because a world needs whole ticks, of 1/15 s by default."""
SLOT = 0.5
"""The largest step of a slot [s]."""
LEAST_SPEED = 0.1
"""The lowest speed of an NPC that crosses [m/s]."""
STAYING = ("seed", "ego_lane", "ego_speed", "gene_seconds", "traffic")
"""The fields of a scenario beside its chains. They stay, unless a neighbour differs in one of them."""
DRAWS = 20
"""The largest number of draws for each neighbour, of which some are equal or do not fit the world."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Breadth:
    """How many neighbours of a scenario fail as it does.

    Attributes:
        failing: the number of neighbours that fail the same way.
        of: the number of neighbours.
        share: the share of the full steps with which the neighbours were made. It is below 1 if none of the neighbours
            with larger steps failed.
    """

    failing: int
    of: int
    share: float = 1.0

    @property
    def rank(self) -> float:
        """A number that is larger for a broader failure: the share of neighbours that fail at full steps."""
        return self.failing / self.of if self.share == 1 else 0.0

    def __str__(self) -> str:
        if self.share == 1 and self.failing:
            return f"{self.failing} of {self.of} neighbours fail the same way"
        text = f"a knife edge: 0 of {self.of} neighbours fail the same way"
        if self.share == 1:
            return text
        smaller = f"with steps of {SHARES[self.share]} the size"
        return f"{text}, {self.failing} of {self.of} {smaller}" if self.failing else f"{text}, nor any {smaller}"


def breadth_of(
    scenario: Scenario,
    number: int,
    *,
    fails: Callable[[Scenario], bool],
    fits: Callable[[Scenario], bool],
    top_speed: float,
) -> Breadth | None:
    """Return how many of a number of neighbours fail; None if there are not as many different ones.

    Args:
        scenario: the scenario of a finding.
        number: the number of neighbours.
        fails: runs a scenario, and returns whether it fails in the same way.
        fits: returns whether a scenario fits the world.
        top_speed: the highest speed of a vehicle [m/s].
    """
    known: Breadth | None = None
    for share in SHARES:
        several = neighbours(scenario, number, share=share, fits=fits, top_speed=top_speed)
        if len(several) < number:
            return known
        known = Breadth(failing=sum(map(fails, several)), of=number, share=share)
        if known.failing:
            return known
    return known


def neighbours(
    scenario: Scenario, number: int, *, fits: Callable[[Scenario], bool], top_speed: float, share: float = 1.0
) -> tuple[Scenario, ...]:
    """Return up to a number of different neighbours, fewer only if there are hardly more.

    Each neighbour differs in one of four ways: in the speed of each instruction a little; in all speeds by the same
    factor; in one instruction, after which the cells of others are repaired where they no longer fit; or in the start
    and the duration of the genes. The longest chains of instructions last one gene longer, because a neighbour may fail
    a little later than the scenario. For the arguments see :func:`breadth_of`; ``share`` is one of
    :data:`SHARES`.
    """
    draw = random.Random(f"{scenario.canonical()} {share}").random  # noqa: S311  (the same in each version of Python)
    timed = [len(chain) for chain in scenario.npcs if not isinstance(chain[0], CrossingInstruction)]
    is_longest = [len(chain) in timed and len(chain) == max(timed) for chain in scenario.npcs]
    chains = [(*chain, chain[-1]) if is_it else chain for chain, is_it in zip(scenario.npcs, is_longest, strict=True)]
    same = replace(scenario, npcs=tuple(chains))
    found: dict[Scenario, None] = {}
    for _ in range(DRAWS * number):
        if len(found) == number:
            break
        neighbour = _Neighbour(same, share, top_speed, draw).drawn()
        if neighbour != same and neighbour not in found and fits(neighbour):
            found[neighbour] = None
    return tuple(found)


@dataclass(frozen=True, slots=True)
class _Neighbour:
    """One neighbour to be drawn; ``draw`` returns a random number from 0 to 1."""

    scenario: Scenario
    share: float
    top_speed: float
    draw: Callable[[], float]

    def drawn(self) -> Scenario:
        kind, scenario = int(4 * self.draw()), self.scenario
        if kind == 0:
            return self._with([tuple(map(self._moved, chain)) for chain in scenario.npcs])
        if kind == 1:
            factor = 1 + self._step(ALL_SPEEDS)
            chains = [tuple(self._at(gene, factor * gene.speed) for gene in chain) for chain in scenario.npcs]
            return self._with(chains, ego_speed=self._speed(factor * scenario.ego_speed))
        if kind == 2:
            npc = int(len(scenario.npcs) * self.draw())
            chain = scenario.npcs[npc]
            gene = int(len(chain) * self.draw())
            new: Chromosome = (*chain[:gene], self._changed(chain[gene]), *chain[gene + 1 :])
            return self._with([*scenario.npcs[:npc], new, *scenario.npcs[npc + 1 :]])
        steps = round(scenario.gene_seconds * (1 + self._step(DURATION)) / WHOLE_TICKS)
        ego_speed = self._speed(scenario.ego_speed + self._step(SPEED))
        return self._with(
            scenario.npcs, ego_speed=ego_speed, gene_seconds=min(round(max(steps, 1) * WHOLE_TICKS, 1), LONGEST_GENE)
        )

    def _with(self, chains: Sequence[Chromosome], **fields: float) -> Scenario:
        kept = {name: getattr(self.scenario, name) for name in STAYING}
        return Scenario.repaired(chains, **(kept | fields))

    def _step(self, largest: float) -> float:
        return largest * self.share * (2 * self.draw() - 1)

    def _speed(self, speed: float, least: float = 0.0) -> float:
        return round(min(max(speed, least), self.top_speed), 1)

    def _at(self, gene: Gene, speed: float) -> Gene:
        """Return a gene with another speed."""
        return replace(gene, speed=self._speed(speed, LEAST_SPEED if isinstance(gene, CrossingInstruction) else 0.0))

    def _moved(self, gene: Gene) -> Gene:
        """Return a gene with a speed that is a little different, and a slot if it has one."""
        moved = self._at(gene, gene.speed + self._step(SPEED))
        if isinstance(moved, CrossingInstruction):
            slot = round(moved.slot + self._step(SLOT), 1)
            return replace(moved, slot=min(max(slot, -LARGEST_SLOT), LARGEST_SLOT))
        return moved

    def _changed(self, gene: Gene) -> Gene:
        """Return a gene with a cell or a lane beside its own; with smaller steps, or at a zone, only moved."""
        if self.share < 1 or isinstance(gene, CrossingInstruction):
            return self._moved(gene)
        if isinstance(gene, LaneInstruction):
            others = [lane for lane in SHIFTS if lane != gene.lane]
            return replace(gene, lane=others[int(2 * self.draw())])
        return replace(gene, cell=gene.cell.neighbours[int(2 * self.draw())])
