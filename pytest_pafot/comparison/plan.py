"""The plan of a comparison: algorithms, a budget, a policy and the world in which it drives."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from pytest_pafot import Highway, Run, World, WorldLike
from pytest_pafot.campaign.explore import AlgorithmRun
from pytest_pafot.commands.policy_reference import ads_factory, chosen_world, identity
from pytest_pafot.oracle.checks import require
from pytest_pafot.searching.algorithms.catalogue import ALGORITHMS, AlgorithmClass, resolve_algorithm
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.process import installed_versions
from pytest_pafot.support.references import referred_to, source_digests
from pytest_pafot.support.text import plural
from pytest_pafot.world.codec import WorldData, code_of

DIFFERENT = (
    "the algorithms have different scenarios, so differences between these groups may be due to the scenarios; "
    "NAME@paper is an algorithm with the paper's scenarios"
)
"""The warning if :attr:`Plan.scenarios` has more than one entry."""
PAPER = "paper"
"""The text after the ``@`` for the paper's scenarios."""


def never_collides(blame: str, run: Run) -> None:
    """Assert that there is no collision; the test function of a comparison.

    Unless the blame is ``any``, a collision for which neither vehicle is responsible is no failure.
    """
    if blame == "any" or run.responsibility is not None:
        require(not run.collision, "not run.collision", lambda: "assert not run.collision")


class Entrant(NamedTuple):
    """A participant of a comparison: an algorithm, the duration of its runs, and its scenarios."""

    algorithm: AlgorithmClass
    seconds: float | None = None  # duration of its runs [s]; None for the world's duration
    is_papers: bool = False  # whether its scenarios are the paper's; otherwise those of a test

    @classmethod
    def of(cls, given: str) -> Entrant:
        """Make an entrant from a name or ``module:Class``, optionally followed by ``@`` and seconds, or ``@paper``.

        Raises:
            ValueError: if there is no such algorithm.
            RequestError: if the text after the ``@`` is not a time.
        """
        reference, at, text = given.partition("@")
        if text == PAPER:
            return cls(resolve_algorithm(reference), is_papers=True)
        try:
            seconds = float(text) if at else None
        except ValueError:
            seconds = math.nan
        if seconds is not None and not 0 < seconds < math.inf:
            raise RequestError(
                f"--algorithms: expected seconds or {PAPER} after the @, as in av-fuzzer@15, received {given!r}"
            )
        return cls(resolve_algorithm(reference), seconds)

    @property
    def has_papers_scenarios(self) -> bool:
        """True if the algorithm runs on the paper's scenarios: two NPCs, one start, no patterns."""
        return self.is_papers or self.algorithm.is_papers

    @property
    def name(self) -> str:
        """The name of the entrant in files, tables and figures."""
        if self.is_papers:
            return f"{self.algorithm.name}@{PAPER}"
        return self.algorithm.name + ("" if self.seconds is None else f"@{self.seconds:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The definition of a comparison. It determines the result of every run of every algorithm."""

    ads: str  # the policy: ``name`` of a module in example_ads, ``module:factory`` or ``module:factory:argument``
    # names, or ``module:Class``; ``@15`` makes its runs last 15 s, ``@paper`` gives it the paper's scenarios
    algorithms: tuple[str, ...]
    runs: int = 10  # number of runs of each algorithm
    generations: int | None = 100  # of the main search; None with a time budget
    seconds: float | None = None  # simulated time after which no scenario begins; None with a budget of generations
    seed: int = 0  # base seed, from which the seeds of all runs are derived
    # ``any`` counts all collisions as failures, as the paper does; ``ego`` only those that the ego is responsible for,
    # and steers the default fitness towards them; ``preventable`` does the same, but counts only those of them in which
    # a reference driver in the ego's place is not at fault
    blame: str = "any"
    fitness: str | None = None  # for all algorithms: a name or ``module:function``; None for each algorithm's own
    world: Mapping[str, Any] = field(default_factory=lambda: Highway().to_dict())  # in the form of a corpus file
    world_name: str = ""  # the argument --world: its module makes or registers the world, which may be code
    space: Mapping[str, Any] = field(default_factory=lambda: SearchSpace().plain)  # fields of a SearchSpace
    drawn: Mapping[str, Any] = field(default_factory=dict)  # fields for algorithms without the paper's scenarios

    @property
    def question(self) -> dict[str, Any]:
        """All but the algorithms and the number of runs: comparisons for which it is equal can share results."""
        own_fitness = referred_to(self.fitness) if self.fitness is not None and ":" in self.fitness else None
        return {
            "plan": asdict(replace(self, algorithms=(), runs=1)),
            "policy": identity(self.ads),
            "code": source_digests(own_fitness, *code_of(world_of(self)), here=Path.cwd()),
            "versions": installed_versions(),
        }

    @property
    def identities(self) -> dict[str, Any]:
        """The identity of each algorithm and its version, by its name in files.

        The code of an algorithm of this package has the version of this package.
        """
        given = dict(zip(self.names, self.algorithms, strict=True))
        return {
            name: {"given": text, "code": source_digests(self.entrant(name).algorithm.made_by, here=Path.cwd())}
            for name, text in given.items()
        }

    @property
    def tasks(self) -> tuple[tuple[str, int], ...]:
        """All pairs (algorithm, run) in their starting order: run by run, so that a partial result is balanced."""
        return tuple((name, run) for run in range(self.runs) for name in self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the algorithms in files, tables and figures."""
        return tuple(Entrant.of(each).name for each in self.algorithms)

    def entrant(self, name: str) -> Entrant:
        """Return the entrant for one of :attr:`names`, or for a name of the catalogue of algorithms."""
        return Entrant.of(dict(zip(self.names, self.algorithms, strict=True)).get(name, name))

    def setting(self, name: str) -> tuple[WorldLike, SearchSpace]:
        """Return the world and the space of scenarios of one of :attr:`names`.

        If the entrant's runs have a different duration, all genes are equally long, in whole ticks, and not longer
        than the genes of the plan. Sampled durations of genes stay sampled.
        """
        entrant, seconds, own = self.entrant(name), self.entrant(name).seconds, world_of(self)
        drawn = {} if entrant.has_papers_scenarios else {**self.drawn, "crossings": getattr(own, "crossings", None)}
        space = SearchSpace(**{**self.space, **drawn})
        if seconds is None:
            return own, space
        if not isinstance(own, Highway | World):
            raise RequestError(
                f"--algorithms: expected no seconds after the @ in a world of your own, received {name}; let its "
                "factory make a world with such runs, and compare there"
            )
        world = replace(own, duration=seconds)
        ticks, least = round(seconds * world.physics_hz), math.ceil(seconds / space.gene_seconds - 1e-9)
        genes = next(number for number in range(least, ticks + 1) if ticks % number == 0)
        return world, replace(space, genes=genes, gene_seconds=ticks / genes / world.physics_hz)

    @property
    def scenarios(self) -> dict[str, list[str]]:
        """The names of the algorithms by the description of their scenarios; each group has the same scenarios."""
        found: dict[str, list[str]] = {}
        for name in self.names:
            _, space = self.setting(name)
            patterns = "; half of them have dangerous patterns" if space.patterns else ""
            drawn, whole = space.gene_durations, round(space.genes * space.gene_seconds, 1)
            genes = f"{plural(space.genes, 'gene')} of {round(space.gene_seconds, 1):g} s"
            if drawn:
                genes = f"genes of {min(drawn):g} to {max(drawn):g} s, together {whole:g} s"
            found.setdefault(f"{space.described}; {genes}{patterns}", []).append(name)
        return found

    def run(self, name: str, number: int) -> AlgorithmRun:
        """Return a run of one of :attr:`names`.

        Raises:
            ValueError: if the algorithm or the fitness cannot be used.
        """
        (world, space), entrant = self.setting(name), self.entrant(name)
        return AlgorithmRun(
            algorithm=entrant.algorithm,
            ads=ads_factory(self.ads),
            holds=partial(never_collides, self.blame),
            world=world,
            space=space,
            seed=self.run_seed(name, number),
            blame=self.blame,
            fitness=self.fitness,
            **{name: value for name in ("generations", "seconds") if (value := getattr(self, name)) is not None},
        )

    def run_seed(self, algorithm: str, run: int) -> int:
        """Return the seed of one run; runs of different algorithms are independent samples."""
        text = f"{self.seed}/{algorithm}/{run}"
        return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")


def checked(plan: Plan) -> Plan:
    """Return the plan if it can be run.

    Raises:
        RequestError: for the first option that is wrong; the message names it.
    """
    if not plan.algorithms:
        raise RequestError(f"--algorithms: expected one or more of {', '.join(ALGORITHMS)}, received none")
    if (plan.generations is None) == (plan.seconds is None):
        raise RequestError("--generations, --seconds: expected one budget, received both or none")
    for name, value in (("--runs", plan.runs), ("--generations", plan.generations)):
        if value is not None and value < 1:
            raise RequestError(f"{name}: expected a whole number, at least 1, received {value}")
    if plan.seconds is not None and not 0 < plan.seconds < math.inf:
        raise RequestError(f"--seconds: expected simulated seconds, more than 0, received {plan.seconds:g}")
    if plan.seed < 0:
        raise RequestError(f"--seed: expected a whole number, at least 0, received {plan.seed}")
    try:
        names = plan.names
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise RequestError(f"--algorithms: expected each name once, received {', '.join(repeated)} again")
        for name in names:
            plan.run(name, 0)
    except ValueError as error:
        raise RequestError(str(error)) from None
    return plan


def world_of(plan: Plan) -> WorldLike:
    """Return the world of a plan. It is made from its data, unless it is code."""
    ads_factory(plan.ads)  # whose module may register the environment
    data = WorldData(plan.world)
    made = _named(plan.world_name) if ":" in plan.world_name else None
    if made is None or data.can_be_made:
        return data.made()
    road = {name: plan.world[name] for name in ("duration", "clearance") if name in plan.world}
    return replace(made, **road) if isinstance(made, World) else made


@cache
def _named(reference: str) -> Any:
    return chosen_world(reference)
