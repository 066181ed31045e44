"""The plan of a crash rate, and its results: crashes per episode and per hour, and two policies on the same seeds."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from pytest_pafot import Outcome, World
from pytest_pafot.extending import CAUTION, AdsFactory, WorldData, ads_factory, chosen_world, code_of, identity
from pytest_pafot.extras.resumable import ResumableJob, Task, Tick
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.proportions import CONFIDENCE, holm, interval, interval_text, mcnemar
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.source_files import source_digests
from pytest_pafot.support.text import csv_text, one_line, plural
from pytest_pafot.support.versions import installed_versions

# Results of episodes: crashes per episode and per hour, and a comparison of two policies on the same seeds.

SECONDS_PER_HOUR = 3600.0
UNDECIDED = (Outcome.ADS_ERROR, Outcome.HANG)
"""The outcomes of episodes in which the ADS did not decide."""
SHOWN = 10
"""The largest number of seeds in a line of text."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRow:
    """The result of one episode, a row of ``results.csv``."""

    ads: str  # the policy, as it was given
    seed: int  # seed of the reset
    outcome: str  # ``collision``, ``safe``, or, if the ADS did not decide, ``ads_error`` or ``hang``
    seconds: float  # time driven until the end
    error: str  # error of the ADS, if it did not decide; else empty
    steps: str  # reason why the environment's own code moved its traffic; empty if compiled code did


COLUMNS = tuple(field.name for field in fields(EpisodeRow))


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """The crash rate of a policy.

    Attributes:
        ads: policy, as it was given.
        rows: results of all episodes, sorted by seed.
    """

    ads: str
    rows: tuple[EpisodeRow, ...]

    def __repr__(self) -> str:
        return f"<Rate of {self.ads}: {self.sentence}>"

    @property
    def episodes(self) -> int:
        """The number of episodes in which the ADS decided until the end; episodes with an error are not included."""
        return len(self.rows) - len(self.failed)

    @property
    def crashed(self) -> tuple[int, ...]:
        """The seeds of the episodes in which the policy crashed."""
        return tuple(row.seed for row in self.rows if row.outcome == Outcome.COLLISION)

    @property
    def failed(self) -> tuple[EpisodeRow, ...]:
        """The episodes in which the ADS raised, hung or returned no action; the rate does not include them."""
        return tuple(row for row in self.rows if row.outcome in UNDECIDED)

    @property
    def share(self) -> float:
        """The crashes per episode; NaN if no episode was driven."""
        return len(self.crashed) / self.episodes if self.episodes else float("nan")

    @property
    def hours(self) -> float:
        """The hours of driving in all episodes without an error of the ADS."""
        return sum(row.seconds for row in self.rows if row.outcome not in UNDECIDED) / SECONDS_PER_HOUR

    @property
    def per_hour(self) -> float:
        """The crashes per hour of driving; NaN if no episode was driven."""
        return len(self.crashed) / self.hours if self.hours else float("nan")

    def interval(self, confidence: float = CONFIDENCE) -> tuple[float, float]:
        """Return the Clopper-Pearson interval of the crashes per episode, as (low, high)."""
        return interval(len(self.crashed), self.episodes, confidence)

    @property
    def sentence(self) -> str:
        """The rate: ``38 of 1000 episodes crashed, 3.8 % (95 %: 2.7 to 5.2 %); 4.9 an hour in 7.8 h of driving``."""
        if not self.episodes:
            return f"no episode of {len(self.rows)} was driven to its end"
        share = interval_text(len(self.crashed), self.episodes)
        per_hour = f"{number(self.per_hour)} an hour in" if self.crashed else "none in"
        return (
            f"{len(self.crashed)} of {plural(self.episodes, 'episode')} crashed, {share}; {per_hour} "
            f"{number(self.hours)} h of driving"
        )

    @property
    def notes(self) -> list[str]:
        """The notes on the rate, one per line: seeds of crashes, errors of the ADS, why traffic was not compiled."""
        lines = []
        if self.crashed:
            lines.append(f"seeds of the crashes: {shown(self.crashed)}")
        if self.failed:
            first = self.failed[0]
            lines.append(
                f"the ADS failed in {plural(len(self.failed), 'episode')}, which the rate ignores; seeds "
                f"{shown([row.seed for row in self.failed])}; the first: {first.error}"
            )
        reasons = sorted({row.steps for row in self.rows if row.steps})
        if reasons:
            lines.append(f"driven by the environment's own steps, which takes longer: {'; '.join(reasons)}")
        return lines


def pairs_of(rates: Sequence[Rate]) -> list[tuple[Pair, float]]:
    """Compare the first policy with each of the others; the p-values are adjusted for their number by Holm's method."""
    pairs = [Pair.of(rates[0], other) for other in rates[1:]]
    return [*zip(pairs, holm([pair.p for pair in pairs]), strict=True)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """A comparison of two policies on the seeds on which neither had an error.

    Attributes:
        first, second: names of the policies.
        both, first_only, second_only, neither: seeds on which both policies, only one of them, or neither crashed.
    """

    first: str
    second: str
    both: tuple[int, ...]
    first_only: tuple[int, ...]
    second_only: tuple[int, ...]
    neither: tuple[int, ...]

    @classmethod
    def of(cls, first: Rate, second: Rate) -> Pair:
        """Make a pair of two rates."""
        left_out = {row.seed for rate in (first, second) for row in rate.failed}
        seeds = [row.seed for row in first.rows if row.seed not in left_out]
        a, b = set(first.crashed), set(second.crashed)
        return cls(
            first=first.ads,
            second=second.ads,
            both=tuple(seed for seed in seeds if seed in a and seed in b),
            first_only=tuple(seed for seed in seeds if seed in a and seed not in b),
            second_only=tuple(seed for seed in seeds if seed not in a and seed in b),
            neither=tuple(seed for seed in seeds if seed not in a and seed not in b),
        )

    @property
    def p(self) -> float:
        """The p-value of McNemar's exact test, two-sided."""
        return mcnemar(len(self.first_only), len(self.second_only))

    def told(self, adjusted: float, comparisons: int) -> str:
        """Return the sentence; of several comparisons also with the p-value that is adjusted for their number."""
        return f"{self.sentence}; p {p_text(adjusted)} of {comparisons} (Holm)" if comparisons > 1 else self.sentence

    @property
    def sentence(self) -> str:
        """A sentence with the numbers of seeds on which only one policy crashed, both or neither, and the p-value."""
        return (
            f"on the same seeds {len(self.first_only)} crashed only with {self.first}, {len(self.second_only)} only "
            f"with {self.second}, {len(self.both)} with both, {len(self.neither)} with neither: p {p_text(self.p)} "
            "(McNemar, exact, two-sided)"
        )


def number(value: float) -> str:
    """Return a number with two significant digits, from 100 on without decimals."""
    return f"{value:.0f}" if value >= 99.5 else f"{value:.2g}"


def p_text(p: float) -> str:
    """Return a p-value with its relation sign, such as ``= 0.03`` or ``< 0.0001``."""
    return "< 0.0001" if p < 1e-4 else f"= {p:.2g}"


def shown(seeds: Sequence[int]) -> str:
    """Return the first seeds as a text, with the number of the others."""
    more = f" and {len(seeds) - SHOWN} more" if len(seeds) > SHOWN else ""
    return ", ".join(map(str, seeds[:SHOWN])) + more


def text_of(rows: Iterable[EpisodeRow]) -> str:
    """Return rows as CSV."""
    return csv_text(COLUMNS, map(astuple, rows))


def rows_of(text: str) -> list[EpisodeRow]:
    """Return the rows of a CSV text, the inverse of :func:`text_of`."""
    return [
        EpisodeRow(**{**row, "seed": int(row["seed"]), "seconds": float(row["seconds"])})  # type: ignore[arg-type]
        for row in csv.DictReader(io.StringIO(text))
    ]


# The plan of a crash rate: one or several policies, an environment, and the seeds of the episodes.

QUESTION = "rate.json"
CHUNK = 25
"""The number of episodes in a task; if the command is interrupted, finished tasks are saved."""
FIRST = 10
"""The number of first episodes: a policy that raises in each of them is refused, because it does not drive at all."""


@dataclass(frozen=True, kw_only=True)
class RatePlan:
    """A plan for the crash rates of one or several policies. Every episode depends only on this plan and its seed.

    Attributes:
        ads: name of the policy, in the form of the command ``compare``; with ``@planner`` at its end for a planner in
            SI units.
        against: names of further policies that drive on the same seeds.
        world_name, config: the arguments ``--world`` and ``--config``.
        episodes: number of episodes; their seeds are ``seed``, ``seed + 1`` and so on.
        seed: seed of the first episode.
    """

    ads: str
    against: tuple[str, ...] = ()
    world_name: str
    config: str | None = None
    episodes: int = 1000
    seed: int = 0

    def __getstate__(self) -> dict[str, Any]:
        """Return the plan without its world, which a process makes itself: it may be code."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def world(self) -> World:
        """The environment of the episodes."""
        return episodic(chosen_world(self.world_name, self.config, self.policies.values()), "rate")

    def episode(self, name: str, seed: int) -> Any:
        """Drive the episode with a seed again, with the policy of a name."""
        from pytest_pafot.extending import drive_episode  # noqa: PLC0415  (imports highway-env)

        factory, is_planner = factory_of(name)
        is_planner |= self.world.planner_hz is not None
        return drive_episode(self.world, factory, seed, is_planner=is_planner)

    @property
    def policies(self) -> dict[str, str]:
        """The names of the policies by side: ``ads``, ``against``, ``against2`` and so on."""
        others = {f"against{number if number > 1 else ''}": name for number, name in enumerate(self.against, 1)}
        return {"ads": self.ads, **others}

    @property
    def job(self) -> ResumableJob:
        """The job with its tasks; each task is a side with a number of episodes, and the seed of the first episode."""
        firsts = range(self.seed, self.seed + self.episodes, CHUNK)
        sizes = {
            (f"{side}-{count}", first): count
            for side in self.policies
            for first in firsts
            for count in (min(CHUNK, self.seed + self.episodes - first),)
        }
        question = {"ads": self.ads, "against": [*self.against], "world": WorldData.of(self.world).data}
        names = [name.removesuffix(PLANNER) for name in self.policies.values()]
        told = {
            "plan": question,
            "policies": {name: identity(name) for name in names},
            "code": source_digests(*code_of(self.world), here=Path.cwd()),
            "versions": installed_versions(),
        }
        return ResumableJob(
            command="rate",
            noun="rate",
            units="episodes",
            tasks=tuple(sorted(sizes, key=lambda task: task[1])),
            in_order=tuple(sizes),
            question=told,
            question_file=QUESTION,
            text=partial(_text, self),
            sizes=sizes,
            caution=CAUTION,
        )


def checked(plan: RatePlan) -> RatePlan:
    """Return the plan, if it can be run.

    Raises:
        RequestError: naming the first thing that is wrong.
        WorldError: if the environment cannot be used.
    """
    if plan.episodes < 1:
        raise RequestError(f"--episodes: expected a whole number, at least 1, received {plan.episodes}")
    if plan.seed < 0:
        raise RequestError(f"--seed: expected a whole number, at least 0, received {plan.seed}")
    twice = next((name for number, name in enumerate(plan.against) if name in (plan.ads, *plan.against[:number])), None)
    if twice is not None:
        raise RequestError(f"--against: expected a different policy than --ads, received {twice!r} again")
    plan.world.environment.with_traffic()
    return plan


def factory_of(name: str) -> tuple[AdsFactory, bool]:
    """Return the factory with a name, and whether its policy is a planner in SI units.

    Raises:
        RequestError: if there is no such factory.
    """
    return ads_factory(name), name.endswith(PLANNER)


def episodic(world: Any, command: str, fix: str = "`search`, `compare` and `progress` drive in it") -> World:
    """Return a world if it has episodes.

    Raises:
        RequestError: with the way out, if it has none.
    """
    if isinstance(world, World):
        return world
    raise RequestError(
        f"--world: expected for {command} an environment, which makes ordinary traffic itself, by its id or from a "
        f"factory of a pafot.World, received {one_line(repr(world))}, whose traffic a search arranges; {fix}"
    )


def driven(world: World, name: str, factory: AdsFactory, seed: int, *, is_planner: bool) -> EpisodeRow:
    """Drive one episode and return its row of the results."""
    from pytest_pafot.extending import drive_episode  # noqa: PLC0415  (imports highway-env)

    episode = drive_episode(world, factory, seed, is_planner=is_planner or world.planner_hz is not None)
    return EpisodeRow(
        ads=name,
        seed=seed,
        outcome=str(episode.outcome),
        seconds=episode.seconds,
        error="" if episode.error is None else episode.error.text,
        steps=episode.steps,
    )


def _text(plan: RatePlan, task: Task, tick: Tick) -> str:
    side, _, count = task[0].partition("-")
    name, rows = plan.policies[side], []
    factory, is_planner = factory_of(name)
    for number in range(int(count)):
        rows.append(driven(plan.world, name, factory, task[1] + number, is_planner=is_planner))
        if number == FIRST - 1 and task[1] == plan.seed and all(row.outcome == Outcome.ADS_ERROR for row in rows):
            raise _never_drives(plan, name, rows[0])
        tick((number + 1) / int(count))
    return text_of(rows)


def _never_drives(plan: RatePlan, name: str, row: EpisodeRow) -> RequestError:
    """Return the error for a policy that raised in each of the first episodes, with the place of the first one."""
    error = plan.episode(name, row.seed).error
    traceback = "" if error is None else error.traceback
    place = traceback.rfind("  File ")
    where = f"\n{traceback[place:].rstrip()}\n" if place >= 0 else ". "
    is_planner = name.endswith(PLANNER) or plan.world.planner_hz is not None
    planner = "" if is_planner else f" A planner in SI units, as for pafot.Highway, needs {PLANNER} after its name."
    return RequestError(
        f"{name}: expected a policy that drives, received one with an error in each of the first {FIRST} episodes, "
        f"from seed {row.seed} on: {row.error}{where}Correct it, its factory or the environment.{planner}"
    )
