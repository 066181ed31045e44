"""Neighbours of a scenario: scenarios that differ from it a little. How many of them fail says how broad a failure is.

The neighbours follow from the scenario, their number and the world that they must fit. So they are the same in every
session, on every machine.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain as in_turn
from itertools import islice, zip_longest
from typing import Literal

from pytest_pafot.findings.shrink import Ahead
from pytest_pafot.model.instructions import LARGEST_SPEED_STEP, Nudge
from pytest_pafot.model.scenario import LONGEST_GENE, Chromosome, Scenario

ALL_SPEEDS, DURATION = 0.1, 0.1
"""The largest steps of all speeds together, and of the duration of a gene, as shares of the values."""
WHOLE_TICKS = 0.2
"""Other durations of a gene are multiples of this [s], because a world needs whole ticks, of 1/15 s by default."""
STAYING = ("seed", "ego_lane", "ego_speed", "gene_seconds", "traffic", "vehicles", "ego_track")
"""The fields of a scenario beside its chains. They stay, unless a neighbour differs in one of them."""
WIDE = 3.0
"""The share of the steps below for the neighbours of a replay, because a policy that was changed fails elsewhere: with
an ego that starts up to 4.5 m/s slower or faster, with speeds and durations up to 30 % apart."""
FEWEST, MOST = 10, 30
"""The number of neighbours of a replay: of a broad failure, and of one that is a knife edge."""
LEAST_CHANGE = 0.02
"""The share by which an ego must be faster or slower than another one, so that scenarios are re-timed for it."""
MISSES = 200
"""The number of draws in a row without a new neighbour after which there are hardly any more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Breadth:
    """The number of neighbours of a scenario that fail as it does.

    Attributes:
        failing: the number of neighbours that fail the same way.
        of: the number of neighbours.
    """

    failing: int
    of: int

    @property
    def rank(self) -> float:
        """A number that is larger for a broader failure: the share of neighbours that fail."""
        return self.failing / self.of

    @property
    def word(self) -> Literal["broad", "narrow", "knife edge"]:
        """The word that says how broad the failure is.

        It is broad if most of the neighbours fail, narrow if fewer do, and a knife edge if none do.
        """
        if self.rank == 0:
            return "knife edge"
        return "broad" if self.rank > 1 / 2 else "narrow"

    @property
    def needed(self) -> int:
        """The number of neighbours that a replay runs: the more, the fewer of them failed."""
        return round(FEWEST + (MOST - FEWEST) * max(0.0, 1 - 2 * self.rank))

    def __str__(self) -> str:
        # Without numbers, because neighbours with other steps would give other numbers.
        how = {
            "broad": "most similar scenarios fail the same way",
            "narrow": "some similar scenarios fail the same way, but not most",
            "knife edge": "no similar scenarios fail the same way",
        }
        return f"{self.word}: {how[self.word]}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The limits of a world.

    Attributes:
        fits: returns whether a scenario fits the world.
        top_speed: the highest speed of a vehicle [m/s].
        longest_run: the longest duration of a run [s].
    """

    fits: Callable[[Scenario], bool]
    top_speed: float
    longest_run: float


def breadth_of(
    scenario: Scenario, number: int, limits: Limits, ahead: int = 0
) -> Generator[tuple[Scenario, Ahead], bool | None, Breadth | None]:
    """Return how many of a number of neighbours fail, of fewer if there are not as many; None if there are none.

    No more of them are asked for than it takes to know :attr:`Breadth.word`: each is yielded, with what is ahead, and
    whether it fails in the same way is sent; None if its run is that of the finding, so that it is no neighbour.

    Args:
        scenario: the scenario of a finding.
        number: the largest number of neighbours.
        limits: what the world allows.
        ahead: the number of neighbours that are announced before the first of them is asked for.
    """
    drawn, told = list(islice(neighbours(scenario, 1.0, limits), 2 * number)), list[bool]()
    for index, each in enumerate(drawn):
        next_ones = drawn[index + ahead - 1 : index + ahead] if index else drawn[:ahead]
        answer = yield each, Ahead(next_ones, more=index > 0)
        if answer is None:
            continue
        told.append(answer)
        failing, passing = told.count(True), told.count(False)
        if len(told) == number or 2 * failing > number or (failing > 0 and 2 * passing >= number):
            break  # all that are left cannot change the word
    return Breadth(failing=sum(told), of=len(told)) if told else None


def neighbours(scenario: Scenario, share: float, limits: Limits) -> Iterator[Scenario]:
    """Yield different neighbours of a scenario, until hardly any more are drawn.

    ``share`` is the size of the steps as a share of those of this module: 1, or :data:`WIDE`.

    Each neighbour differs in one of four ways: in the speed of each instruction a little; in all speeds by the same
    factor; in one instruction, after which the cells of others are repaired where they no longer fit; or in the start
    and the duration of the genes. If the longest run allows it, the longest chains last one gene longer, because a
    neighbour may fail a little later than the scenario.
    """
    draw = random.Random(f"{scenario.canonical()} {share}").random  # noqa: S311  (the same in each version of Python)
    found, missed = {scenario}, 0
    while missed < MISSES:
        neighbour = _Neighbour.of(scenario, share, limits, draw).drawn()
        missed += 1
        if neighbour not in found:
            found.add(neighbour)
            if limits.fits(longer := _longer(neighbour, limits.longest_run)):
                missed = 0
                yield longer


def around(scenario: Scenario, pace: float, limits: Limits) -> Iterator[Scenario]:
    """Yield neighbours of a scenario for an ego that drives ``pace`` times as fast as the one that the scenario failed.

    They are the scenario re-timed for this ego, in three ways: all speeds are scaled; the duration of the genes is; or
    both. Then they are wide neighbours of these scenarios and of the scenario itself, in turn.
    """
    found, bases = {scenario}, [scenario]
    if abs(pace - 1) >= LEAST_CHANGE:
        scaled, seconds = _scaling(scenario, limits).faster(pace), scenario.gene_seconds / pace
        stretched = [_scaling(each, limits).lasting(seconds) for each in (scenario, scaled)]
        bases = [scaled, *stretched, scenario]
    re_timed = [_longer(each, limits.longest_run) for each in bases[:-1]]
    drawn = in_turn.from_iterable(zip_longest(*(neighbours(each, WIDE, limits) for each in bases)))
    for each in in_turn(filter(limits.fits, re_timed), drawn):
        if each is not None and each not in found:
            found.add(each)
            yield each


def _scaling(scenario: Scenario, limits: Limits) -> _Neighbour:
    return _Neighbour.of(scenario, 1.0, limits, lambda: 0.0)


def _longer(scenario: Scenario, longest_run: float) -> Scenario:
    """Return a scenario whose longest chains last one gene longer, unless the scenario would be too long then."""
    timed = [len(chain) for chain in scenario.npcs if not chain[0].is_alone]
    if not timed or (max(timed) + 1) * scenario.gene_seconds > longest_run + 1e-9:
        return scenario
    is_longest = [len(chain) == max(timed) and not chain[0].is_alone for chain in scenario.npcs]
    chains = [(*chain, chain[-1]) if is_it else chain for chain, is_it in zip(scenario.npcs, is_longest, strict=True)]
    return replace(scenario, npcs=tuple(chains))


@dataclass(frozen=True, slots=True)
class _Neighbour:
    """One neighbour to be drawn."""

    scenario: Scenario
    nudge: Nudge

    @classmethod
    def of(cls, scenario: Scenario, share: float, limits: Limits, draw: Callable[[], float]) -> _Neighbour:
        """Return the neighbour of a scenario; ``draw`` returns a random number from 0 to 1."""
        least = scenario.traffic.least_speed(limits.top_speed)
        return cls(scenario, Nudge(share, limits.top_speed, least, draw))

    def drawn(self) -> Scenario:
        nudge, scenario = self.nudge, self.scenario
        kind = int(4 * nudge.draw())
        if kind == 0:
            return self._with([tuple(gene.moved(nudge) for gene in chain) for chain in scenario.npcs])
        if kind == 1:
            return self.faster(1 + nudge.step(ALL_SPEEDS))
        if kind == 2:
            npc = int(len(scenario.npcs) * nudge.draw())
            chain = scenario.npcs[npc]
            gene = int(len(chain) * nudge.draw())
            new: Chromosome = (*chain[:gene], chain[gene].changed(nudge), *chain[gene + 1 :])
            return self._with([*scenario.npcs[:npc], new, *scenario.npcs[npc + 1 :]])
        largest = scenario.gene_seconds * DURATION * nudge.share
        seconds = scenario.gene_seconds + largest * (2 * nudge.draw() - 1)
        seconds = round(WHOLE_TICKS * round(seconds / WHOLE_TICKS), 1)
        if abs(seconds - scenario.gene_seconds) > largest or not 0 < seconds <= LONGEST_GENE or not self.has_duration:
            seconds = scenario.gene_seconds
        ego_speed = nudge.speed(scenario.ego_speed + nudge.step(LARGEST_SPEED_STEP), 0.0)
        return self._with(scenario.npcs, ego_speed=ego_speed, gene_seconds=seconds)

    def faster(self, factor: float) -> Scenario:
        """Return the scenario with all speeds multiplied by a factor."""
        nudge, scenario = self.nudge, self.scenario
        chains = [tuple(gene.paced(factor * gene.speed, factor, nudge) for gene in chain) for chain in scenario.npcs]
        return self._with(chains, ego_speed=nudge.speed(factor * scenario.ego_speed, 0.0))

    def lasting(self, seconds: float) -> Scenario:
        """Return the scenario with genes of about this duration [s], which fits the ticks of a world."""
        seconds = round(WHOLE_TICKS * round(min(max(seconds, WHOLE_TICKS), LONGEST_GENE) / WHOLE_TICKS), 1)
        return self._with(self.scenario.npcs, gene_seconds=seconds) if self.has_duration else self.scenario

    @property
    def has_duration(self) -> bool:
        """True if the duration of a gene changes anything."""
        timed = self.scenario.ego_track is None and not math.isinf(self.scenario.seconds)
        return timed or any(len(chain) > 1 for chain in self.scenario.npcs)

    def _with(self, chains: Sequence[Chromosome], **fields: float) -> Scenario:
        kept = {name: getattr(self.scenario, name) for name in STAYING}
        return Scenario.repaired(chains, **(kept | fields))
