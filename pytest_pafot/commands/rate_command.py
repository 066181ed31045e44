"""``python -m pytest_pafot rate``: how often policies crash in seeded episodes of an environment's own traffic."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any

from pytest_pafot.commands.policy_reference import (
    add_world_arguments,
    ads_factory,
    chosen_world,
    printing_elsewhere,
    worker_count,
)
from pytest_pafot.execution.pool import ProcessLostError, WorkerPool
from pytest_pafot.model.trace import Outcome
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.proportions import CONFIDENCE, holm, interval, interval_text, mcnemar, percent
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import one_line, plural, quiet_json, wrapped_to
from pytest_pafot.world import World
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.engines.episode import Episode, drive_episode

SHOWN = 10
"""The largest number of seeds in a line of text."""
CHUNK = 25
"""The number of episodes that a process drives before it is given others."""
FIRST = 10
"""The number of first episodes: a policy that raises in each of them is refused, because it does not drive at all."""
TOLD_EVERY = 10.0
"""The interval between reports of progress [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """The crash rate of a policy, from the rows of all episodes in the order of their seeds.

    Episodes in which the ADS raised, hung or returned no action are ``failed``, and nothing else includes them.
    """

    ads: str
    rows: tuple[Episode, ...]

    @property
    def failed(self) -> tuple[Episode, ...]:
        """The episodes in which the ADS did not decide until the end."""
        return tuple(row for row in self.rows if row.error)

    @property
    def episodes(self) -> int:
        """The number of episodes that were driven to their end."""
        return len(self.rows) - len(self.failed)

    @property
    def crashed(self) -> tuple[int, ...]:
        """The seeds of the episodes in which the policy crashed."""
        return tuple(row.seed for row in self.rows if row.outcome == Outcome.COLLISION)

    @property
    def share(self) -> float:
        """The crashes per episode; NaN if no episode was driven."""
        return len(self.crashed) / self.episodes if self.episodes else math.nan

    @property
    def sentence(self) -> str:
        """The rate: ``38 of 1000 episodes crashed, 3.8 % (95 %: 2.7 to 5.2 %)``."""
        if not self.episodes:
            return f"no episode of {len(self.rows)} was driven to its end"
        share = interval_text(len(self.crashed), self.episodes)
        return f"{len(self.crashed)} of {plural(self.episodes, 'episode')} crashed, {share}"

    @property
    def notes(self) -> list[str]:
        """The seeds of the crashes, and the errors of the ADS, a line for each."""
        lines = [f"seeds of the crashes: {_shown(self.crashed)}"] if self.crashed else []
        errors = [row.error.text for row in self.rows if row.error]
        if errors:
            lines.append(
                f"the ADS failed in {plural(len(errors), 'episode')}, which the rate ignores; seeds "
                f"{_shown([row.seed for row in self.failed])}; the first: {errors[0]}"
            )
        return lines


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two policies on the seeds on which neither failed, with how many seeds crashed which of them."""

    first: str
    second: str
    first_only: int
    second_only: int
    both: int
    neither: int

    @classmethod
    def of(cls, first: Rate, second: Rate) -> Pair:
        """Count the seeds of two rates."""
        seeds = {row.seed for row in first.rows} - {row.seed for rate in (first, second) for row in rate.failed}
        a, b = seeds & {*first.crashed}, seeds & {*second.crashed}
        counts = {
            "first_only": len(a - b),
            "second_only": len(b - a),
            "both": len(a & b),
            "neither": len(seeds - a - b),
        }
        return cls(first=first.ads, second=second.ads, **counts)

    @property
    def p(self) -> float:
        """The p-value of McNemar's exact test, two-sided."""
        return mcnemar(self.first_only, self.second_only)

    def told(self, adjusted: float, comparisons: int) -> str:
        """Return the numbers as a sentence, for several comparisons also with the p-value adjusted by Holm's method."""
        holm = f"; p {_p_text(adjusted)} of {comparisons} (Holm)" if comparisons > 1 else ""
        return (
            f"on the same seeds {self.first_only} crashed only with {self.first}, {self.second_only} only "
            f"with {self.second}, {self.both} with both, {self.neither} with neither: p {_p_text(self.p)} "
            f"(McNemar, exact, two-sided){holm}"
        )


def _p_text(p: float) -> str:
    return "< 0.0001" if p < 1e-4 else f"= {p:.2g}"


def _shown(seeds: Sequence[int]) -> str:
    more = f" and {len(seeds) - SHOWN} more" if len(seeds) > SHOWN else ""
    return ", ".join(map(str, seeds[:SHOWN])) + more


@dataclass(frozen=True, slots=True)
class Question:
    """What to drive: the environment by ``--world`` and ``--config``, the names of all policies, and the seeds."""

    world_name: str
    config: str | None
    ads: tuple[str, ...]
    seeds: range

    def world(self) -> World:
        """Make the environment of the episodes, or raise a ``RequestError`` if it is none."""
        world = chosen_world(self.world_name, self.config, self.ads)
        if isinstance(world, World):
            return world
        raise RequestError(
            f"--world: expected for rate an environment, which makes ordinary traffic itself, by its id or from a "
            f"factory of a pafot.World, received {one_line(repr(world))}, whose traffic a search arranges; `search` "
            "and `compare` drive in it"
        )

    def rows(self, world: World, task: tuple[str, int]) -> list[Episode]:
        """Drive the episodes of a task: those of a policy from a seed on, at most :data:`CHUNK`."""
        name, first = task
        factory, is_planner = ads_factory(name), name.endswith(PLANNER) or world.planner_hz is not None
        rows = []
        for seed in range(first, min(first + CHUNK, self.seeds.stop)):
            episode = drive_episode(world, factory, seed, is_planner=is_planner)
            rows.append(episode)
            if seed == self.seeds.start + FIRST - 1 and all(row.outcome == Outcome.ADS_ERROR for row in rows):
                raise self._never_drives(name, rows[0], is_planner=is_planner)
        return rows

    def _never_drives(self, name: str, row: Episode, *, is_planner: bool) -> RequestError:
        assert row.error is not None  # noqa: S101  (for type checkers)
        _, file, place = row.error.traceback.rpartition("  File ")
        where = f"\n{file}{place.rstrip()}\n" if file else ". "
        planner = "" if is_planner else f" A planner in SI units, as for pafot.Highway, needs {PLANNER} after its name."
        return RequestError(
            f"{name}: expected a policy that drives, received one with an error in each of the first {FIRST} episodes, "
            f"from seed {row.seed} on: {row.error.text}{where}Correct it, its factory or the environment.{planner}"
        )

    def rates(self, world: World, workers: int) -> list[Rate]:
        """Drive all episodes in some processes, and return the rates in the order of the policies."""
        tasks = [(name, first) for first in self.seeds[::CHUNK] for name in self.ads]
        found, told = dict[tuple[str, int], list[Episode]](), time.monotonic()
        total = len(self.seeds) * len(self.ads)
        for task, rows in self._driven(world, tasks, min(workers, len(tasks))):
            found[task] = rows
            done = sum(map(len, found.values()))
            if done == total or time.monotonic() - told > TOLD_EVERY:
                told = time.monotonic()
                sys.stderr.write(f"rate: {done} of {total} episodes\n")
        all_rows = {name: [row for first in self.seeds[::CHUNK] for row in found[name, first]] for name in self.ads}
        return [Rate(ads=name, rows=tuple(rows)) for name, rows in all_rows.items()]

    def _driven(
        self, world: World, tasks: Sequence[tuple[str, int]], workers: int
    ) -> Iterator[tuple[tuple[str, int], list[Episode]]]:
        """Yield each task with its rows, here or from processes that are spawned, so that each imports the policy."""
        if workers == 1:
            yield from ((task, self.rows(world, task)) for task in tasks)
            return
        with tempfile.TemporaryDirectory(prefix="pafot-") as scratch:
            work = partial(_rows_in, scratch, self)
            pool = WorkerPool[Any, Any](work, workers, method="spawn", patience=math.inf, grace=math.inf)
            with pool:
                pool.expect(tasks)
                for task, answer in pool.completed(lambda _: None):
                    if pool.failure or isinstance(answer, ProcessLostError):
                        ended = f"its process {answer.end}" if isinstance(answer, ProcessLostError) else pool.failure
                        raise ChildProcessError(
                            f"expected a worker to finish {task!r}, received: {ended}; correct a policy that ends its "
                            "process, or if memory was short, use fewer --workers"
                        )
                    if isinstance(answer, Exception):
                        raise answer
                    yield task, answer


def _rows_in(scratch: str, question: Question, task: tuple[str, int], tick: object) -> list[Episode]:
    """Drive a task in a worker, whose temporary files go with the command: a worker that is killed removes none."""
    before, tempfile.tempdir = tempfile.tempdir, scratch
    try:
        return question.rows(question.world(), task)
    finally:
        tempfile.tempdir = before


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the command."""
    of_whom = "a module of example_ads, module:factory, or module:factory:argument; with @planner after it if it gets "
    of_whom += "pafot.Observation and answers with acceleration and steering"
    parser.add_argument("--ads", required=True, metavar="ADS", help=f"the policy: {of_whom}")
    of_against = "another policy, on the same seeds; may be given several times"
    parser.add_argument("--against", action="append", default=[], metavar="ADS", help=of_against)
    add_world_arguments(parser, "one with an environment", is_needed=True)
    of_episodes = "episodes to drive (default: %(default)s)"
    parser.add_argument("--episodes", type=int, default=1000, metavar="N", help=of_episodes)
    of_seed = "seed of the first episode (default: %(default)s)"
    parser.add_argument("--seed", type=int, default=0, metavar="N", help=of_seed)
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one for each core)")
    parser.add_argument("--json", action="store_true", help="print JSON, for programs")
    parser.add_argument(
        "--fail-above",
        metavar="SHARE",
        help="exit with 1 if the 95 %% interval of the crashes of the policy (that of --ads) begins above this share "
        "of the episodes, such as 2%% or 0.02, or if the policy failed in an episode",
    )


def run(given: argparse.Namespace, command: Sequence[str]) -> int:
    """Rate the policies. Return 1 if a policy was never driven to an end, or if ``--fail-above`` objects, else 0."""
    with ExitStack() as stack:
        if given.json:
            stack.enter_context(printing_elsewhere())  # also what modules and a factory of the world print
        for name, least in (("episodes", 1), ("seed", 0)):
            if (value := getattr(given, name)) < least:
                raise RequestError(f"--{name}: expected a whole number, at least {least}, received {value}")
        names = (given.ads, *given.against)
        if twice := next((name for number, name in enumerate(names) if name in names[:number]), None):
            raise RequestError(f"--against: expected a different policy than --ads, received {twice!r} again")
        question = Question(given.world, given.config, names, range(given.seed, given.seed + given.episodes))
        workers, limit, world = worker_count(given.workers), _limit_of(given), question.world()
        world.environment.with_traffic()
        factories = [ads_factory(name) for name in names]
        rates = question.rates(world, workers)
    pairs = [Pair.of(rates[0], other) for other in rates[1:]]
    compared = [*zip(pairs, holm([pair.p for pair in pairs]), strict=True)]
    objection = "" if limit is None else _objection(rates[0], limit)
    if given.json:
        told = _data(given, rates, compared) | {"fail_above": limit, "objection": objection}
        sys.stdout.write(f"{quiet_json(json.dumps(told, indent=2))}\n")
    else:
        lines = list[str]()
        for rate, factory in zip(rates, factories, strict=True):
            lines.append(f"{rate.ads} in {given.world}: {rate.sentence}")
            lines += [f"  {note}" for note in (*rate.notes, Policy(factory).loading_hint) if note]
            if not rate.episodes and "@" not in rate.ads and world.planner_hz is None:
                named = shlex.join(["--ads", f"{rate.ads}@planner"])
                lines.append(f"  for a planner in SI units, as for pafot.Highway, use {named}")
        lines += [pair.told(adjusted, len(pairs)) for pair, adjusted in compared]
        if len(pairs) > 1:
            worst = sorted((rate for rate in rates if rate.episodes), key=lambda rate: -rate.share)
            lines.append(f"the worst first: {', '.join(f'{rate.ads} {percent(rate.share)}' for rate in worst)}")
        width = shutil.get_terminal_size().columns
        sys.stdout.write("".join(f"{part}\n" for line in lines for part in wrapped_to(line, width, phrases=True)))
    if objection:
        sys.stderr.write(f"rate: {objection}\n")
    return int(bool(objection) or not all(rate.episodes for rate in rates))


def _limit_of(given: argparse.Namespace) -> float | None:
    """Return the share that ``--fail-above`` means, such as ``2%`` or ``0.02``; None without it.

    Raises:
        RequestError: if the text is no share from 0 to less than 1, or if so few episodes cannot show a higher share.
    """
    text, episodes = given.fail_above, given.episodes
    if text is None:
        return None
    number, sign, rest = text.strip().partition("%")
    try:
        share = float(number) / (100 if sign else 1)
    except ValueError:
        share = math.nan
    if rest or not 0 <= share < 1:  # a rate is never above 1
        raise RequestError(
            f"--fail-above: expected a share from 0 to less than 1, such as 2% or 0.02, received {text!r}"
        )
    if interval(episodes, episodes)[0] <= share:
        needed = math.floor(math.log((1 - CONFIDENCE) / 2) / math.log(share)) + 1
        raise RequestError(
            f"--episodes: expected {needed} or more, received {episodes}: even if all crash, fewer do not show a share "
            f"above {text}"
        )
    return share


def _objection(rate: Rate, limit: float) -> str:
    """Return why ``--fail-above`` refuses the rate of a policy; empty if it does not."""
    if rate.failed:
        count = plural(len(rate.failed), "episode")
        return f"--fail-above: expected an ADS that drives all episodes, received one that failed in {count}"
    low, _ = interval(len(rate.crashed), rate.episodes)
    expected = f"--fail-above: expected crashes in at most {100 * limit:.4g} % of the episodes"
    return "" if low <= limit else f"{expected}, received an interval that begins at {100 * low:.4g} %"


def _data(given: argparse.Namespace, rates: Sequence[Rate], pairs: Sequence[tuple[Pair, float]]) -> dict[str, Any]:
    """Return the rates as plain data, for programs."""
    counts = ("first", "second", "first_only", "second_only", "both", "neither", "p")
    return {
        "world": given.world,
        "config": None if given.config is None else json.loads(given.config),
        "seed": given.seed,
        "episodes": given.episodes,
        "policies": [
            {
                **{name: getattr(rate, name) for name in ("ads", "episodes", "crashed", "notes")},
                "crashes": len(rate.crashed),
                "share": rate.share if rate.episodes else None,
                "interval": interval(len(rate.crashed), rate.episodes),
                "confidence": CONFIDENCE,
                "failed": [row.seed for row in rate.failed],
            }
            for rate in rates
        ],
        "pairs": [{name: getattr(pair, name) for name in counts} | {"p_holm": adjusted} for pair, adjusted in pairs],
    }
