"""The plan of a comparison, in which each run is a search by one algorithm."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

from pytest_pafot.algorithms.catalogue import ALGORITHMS, AlgorithmClass, resolve_algorithm
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.commands.policy_reference import ads_factory, chosen_world
from pytest_pafot.oracle.run import Run, require
from pytest_pafot.searches.explore import AlgorithmRun
from pytest_pafot.searches.harness import SetupFaultError
from pytest_pafot.searches.request import drawn_space
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import plural
from pytest_pafot.world import Highway, World
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import Policy

# The warning if the algorithms have different scenarios.
DIFFERENT = (
    "the algorithms have different scenarios, which may be the reason for differences between these groups. "
    "Use NAME@paper to give an algorithm the paper's scenarios"
)
PAPER = "paper"  # after the `@` of an algorithm with the paper's scenarios

# The columns of the results: the algorithm, its run, and the columns of a search.
COLUMNS: Mapping[str, str] = {
    "algorithm": "name of the algorithm",
    "run": "number of the run of the algorithm, from 0",
    **AlgorithmRun.COLUMNS,
}

Row = Mapping[str, Any]


def never_collides(blame: str, run: Run) -> None:
    """Assert that there is no collision. This is the test function of a comparison."""
    # Unless the blame is `any`, a collision for which neither vehicle is responsible is not a failure.
    if blame == "any" or run.responsibility is not None:
        require(not run.collision, "not run.collision", lambda: "assert not run.collision")


class Entrant(NamedTuple):
    """A participant in a comparison: an algorithm, with the duration and the kind of its scenarios."""

    algorithm: AlgorithmClass
    seconds: float | None = None  # duration of its runs [s]; None for the world's duration
    # whether it has the paper's scenarios instead of the scenarios of a test
    is_papers: bool = False

    @classmethod
    def parse(cls, given: str) -> Entrant:
        """Make an entrant from a name or ``module:Class``, optionally followed by ``@paper`` or by ``@`` and seconds.

        Raises:
            ValueError: if there is no such algorithm.
            RequestError: if ``@`` is followed by anything else.
        """
        reference, at, text = given.partition("@")
        if text == PAPER:
            return cls(resolve_algorithm(reference), is_papers=True)
        if not at:
            return cls(resolve_algorithm(reference))
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not 0 < seconds < math.inf:
            raise RequestError(
                f"--algorithms: expected a time [s] or {PAPER} after the @, as in av-fuzzer@15, but received {given!r}"
            )
        return cls(resolve_algorithm(reference), seconds)

    @property
    def name(self) -> str:
        if self.is_papers:
            return f"{self.algorithm.name}@{PAPER}"
        if self.seconds is not None:
            return f"{self.algorithm.name}@{self.seconds:g}"
        return self.algorithm.name


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The arguments of a comparison, which determine the result of every run of every algorithm."""

    # the policy: the name of a module of example_ads, `module:factory` or `module:factory:argument`
    ads: str
    algorithms: tuple[str, ...]  # names or `module:Class`, see `Entrant.parse`
    runs: int = 10  # number of runs of each algorithm
    seconds: float = 3600.0  # simulated time of a run, after which no scenario starts [s]
    seed: int = 0  # the base seed, from which the seeds of all runs are derived
    # `any` counts all collisions as failures, as the paper does; for `ego` see `pafot.search`
    blame: str = "any"
    # the fitness of all algorithms; None for the fitness of each algorithm
    fitness: str | None = None
    world: str | None = None  # as on the command line
    config: str | None = None  # as on the command line
    duration: float | None = None  # duration of a scenario [s]; None for the duration of the world
    clearance: float | None = None  # clearance of the grid [m]; None for the clearance of the world

    @property
    def tasks(self) -> tuple[tuple[str, int], ...]:
        """All pairs (algorithm, run) in their starting order: run 0 of each algorithm, then run 1."""
        return tuple((name, run) for run in range(self.runs) for name in self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the algorithms in files, tables and figures."""
        return tuple(Entrant.parse(each).name for each in self.algorithms)

    def made_world(self) -> BaseWorld:
        """Return the world for all algorithms that have no duration of their own.

        Raises:
            RequestError: if an option has a value that the world does not accept.
        """
        road = {"duration": self.duration, "clearance": self.clearance}
        given: Any = {name: value for name, value in road.items() if value is not None}
        is_planner = self.ads.endswith(PLANNER)
        world = chosen_world(self.world, self.config, [self.ads], is_planner=is_planner)
        if world is None:
            return Highway(**given)
        if isinstance(world, World):
            changed = replace(world, **given)
            changed.check()
            return changed
        if given:
            name, value = next(iter(given.items()))
            raise RequestError(
                f"--{name}: expected no such option with --world {self.world}, but received {value!r}. Omit it, "
                "because that world sets its own value."
            )
        return world  # type: ignore[no-any-return]

    def setting(self, name: str) -> tuple[BaseWorld, SearchSpace]:
        """Return the world and the search space for one of the :attr:`names`."""
        entrant = self._entrant(name)
        seconds = entrant.seconds
        own = self.made_world()
        space = own.space({})
        if not (entrant.is_papers or entrant.algorithm.is_papers):
            space = replace(space, **drawn_space(own, {}))
        if seconds is None:
            return own, space
        if not isinstance(own, Highway | World):
            raise RequestError(
                f"--algorithms: expected no seconds after the @ with a simulator of your own, but received {name}. Set "
                "the duration in the factory of the world instead."
            )
        world = replace(own, duration=seconds)
        # All genes are equally long, in whole ticks, and not longer than the genes of the plan. Sampled
        # durations stay as they are.
        ticks = round(seconds * world.physics_hz)
        least = math.ceil(seconds / space.gene_seconds - 1e-9)
        genes = next(number for number in range(least, ticks + 1) if ticks % number == 0)
        return world, replace(space, genes=genes, gene_seconds=ticks / genes / world.physics_hz)

    def _entrant(self, name: str) -> Entrant:
        given = dict(zip(self.names, self.algorithms, strict=True))
        return Entrant.parse(given.get(name, name))

    @property
    def scenarios(self) -> dict[str, list[str]]:
        """The names of the algorithms, grouped by the description of their scenarios."""
        found: dict[str, list[str]] = {}
        for name in self.names:
            _, space = self.setting(name)
            genes = f"{plural(space.genes, 'gene')} of {round(space.gene_seconds, 1):g} s"
            drawn = space.gene_durations
            if drawn:
                whole = round(space.genes * space.gene_seconds, 1)
                genes = f"genes of {min(drawn):g} to {max(drawn):g} s, together {whole:g} s"
            if space.patterns:
                genes += "; half of them have dangerous patterns"
            found.setdefault(f"{space.described}; {genes}", []).append(name)
        return found

    def run(self, name: str, number: int) -> AlgorithmRun:
        """Return a run of one of the algorithms in :attr:`names`.

        Raises:
            ValueError: if the algorithm or the fitness cannot be used.
        """
        world, space = self.setting(name)
        return AlgorithmRun(
            algorithm=self._entrant(name).algorithm,
            ads=ads_factory(self.ads),
            holds=partial(never_collides, self.blame),
            world=world,
            space=space,
            seed=self.run_seed(name, number),
            blame=self.blame,
            fitness=self.fitness,
            seconds=self.seconds,
            # runs of an ADS that fails immediately take no simulated time
            generations=math.ceil(self.seconds),
        )

    def run_seed(self, algorithm: str, run: int) -> int:
        """Return the seed of one run. Seeds differ between algorithms, so all runs are independent samples."""
        text = f"{self.seed}/{algorithm}/{run}"
        digest = hashlib.sha256(text.encode()).digest()
        return int.from_bytes(digest[:6], "big")

    def check(self) -> None:
        """Check that the plan can be run.

        Raises:
            RequestError: for the first invalid option, with its name.
        """
        if not self.algorithms:
            raise RequestError(
                f"--algorithms: expected one or more of {', '.join(ALGORITHMS)}, but received none"
            )
        if self.runs < 1:
            raise RequestError(
                f"--runs: expected a whole number, at least 1, but received {self.runs}"
            )
        if not 0 < self.seconds < math.inf:
            raise RequestError(
                f"--seconds: expected a simulated time greater than 0 s, but received {self.seconds:g}"
            )
        if self.seed < 0:
            raise RequestError(
                f"--seed: expected a whole number, at least 0, but received {self.seed}"
            )
        try:
            repeated = sorted({name for name in self.names if self.names.count(name) > 1})
            if repeated:
                raise RequestError(
                    f"--algorithms: expected each name once, but received {', '.join(repeated)} again"
                )
            for name in self.names:
                self.run(name, 0)
        except ValueError as error:
            raise RequestError(str(error)) from None


def run_rows(plan: Plan, task: tuple[str, int]) -> list[Row]:
    """Run one search of an algorithm, and return a row for each requested scenario.

    Raises:
        RequestError: if the ADS fails at its first decision in every run of the first generation.
    """
    algorithm, run = task
    made = plan.run(algorithm, run)
    try:
        return [{**row, "algorithm": algorithm, "run": run} for row in made.rows()]
    except SetupFaultError as fault:
        shown = fault.shown(made.world, Policy(made.ads))
        raise RequestError(
            f"--ads: expected a policy that drives, but its search ended: {shown} On the command line, "
            "world= is --world, config= is --config, and planner_hz= is @planner after the policy's name."
        ) from None
