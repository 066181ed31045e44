"""``python -m pytest_pafot rate``: how often policies crash in ordinary traffic."""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from pytest_pafot.commands.policy_reference import (
    add_world_arguments,
    ads_factory,
    chosen_world,
    worker_count,
)
from pytest_pafot.commands.tasks import run_tasks
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.proportions import holm, interval, interval_text, mcnemar
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import first_of, one_line, plural, visible, wrapped_to
from pytest_pafot.world import World
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.engines.episode import Episode, drive_episode

# The maximum number of seeds in a line.
SHOWN = 10
# The number of episodes that a process runs at a time. A policy is rejected if it fails in all episodes of the first
# chunk.
CHUNK = 5


@dataclass(frozen=True, slots=True)
class Rate:
    """A policy's crash rate, computed from its episodes in the order of their seeds.

    Episodes that did not start or that ended with an error are ``failed`` and do not count.
    """

    ads: str
    episodes: tuple[Episode, ...]

    @property
    def failed(self) -> dict[int, str]:
        """The reasons why episodes were not completed, by the episodes' seeds."""
        reasons = {}
        for each in self.episodes:
            if each.error:
                reasons[each.seed] = each.error.text
            elif each.undriven:
                reasons[each.seed] = each.undriven
        return reasons

    @property
    def driven(self) -> int:
        """The number of completed episodes."""
        return len(self.episodes) - len(self.failed)

    @property
    def crashed(self) -> list[int]:
        """The seeds of the episodes in which the policy crashed."""
        return [each.seed for each in self.episodes if each.crashed]

    @property
    def lines(self) -> list[str]:
        """The lines to print about the rate, the seeds of the crashes, and the errors."""
        crashes = f"none of {plural(len(self.episodes), 'episode')} was completed"
        if self.driven:
            share = interval_text(len(self.crashed), self.driven)
            crashes = f"{len(self.crashed)} of {plural(self.driven, 'episode')} crashed, {share}"
        lines = [crashes]
        if self.crashed:
            lines.append(f"  seeds of the crashes: {first_of(self.crashed, SHOWN)}")
        if self.failed:
            lines.append(
                f"  not counted: {plural(len(self.failed), 'episode')} that did not start or ended with an error. "
                f"Seeds: {first_of([*self.failed], SHOWN)}. First reason: {next(iter(self.failed.values()))}"
            )
        return lines


def compare_rates(first: Rate, others: Sequence[Rate]) -> list[str]:
    """Compare a policy with each of the others by McNemar's test, on the seeds that both completed."""
    counts = []
    for other in others:
        seeds = {each.seed for each in first.episodes}
        seeds &= {each.seed for each in other.episodes}
        # An episode that one policy did not complete cannot be compared.
        seeds -= first.failed.keys() | other.failed.keys()
        one = seeds.intersection(first.crashed)
        two = seeds.intersection(other.crashed)
        kinds = (one - two, two - one, one & two, seeds - one - two)
        counts.append([len(kind) for kind in kinds])
    test = "McNemar, exact, two-sided"
    if len(others) > 1:  # Holm's method adjusts the p-values of several comparisons.
        test += f", Holm for {len(others)}"
    chances = holm([mcnemar(only, only_other) for only, only_other, _, _ in counts])
    lines = []
    for other, chance, numbers in zip(others, chances, counts, strict=True):
        only, only_other, both, neither = numbers
        p = "< 0.0001" if chance < 1e-4 else f"= {chance:.2g}"
        lines.append(
            f"on the same seeds, {plural(only, 'episode')} crashed only with {first.ads}, {only_other} only with "
            f"{other.ads}, {both} with both and {neither} with neither: p {p} ({test})"
        )
    return lines


def environment_of(given: argparse.Namespace) -> World:
    """Return the environment that ``--world`` and ``--config`` describe.

    Raises:
        RequestError: if they do not describe an environment.
    """
    world = chosen_world(given.world, given.config, (given.ads, *given.against))
    if isinstance(world, World):
        return world
    raise RequestError(
        f"--world: expected an environment with ordinary traffic, by its id or from a factory of a pafot.World, "
        f"received {one_line(repr(world))}. A search arranges the traffic in that world, so use it with `search` "
        "or `compare`"
    )


def drive_task(given: argparse.Namespace, task: tuple[str, int]) -> list[Episode]:
    """Run a task's episodes: at most :data:`CHUNK`, all with one policy.

    Raises:
        RequestError: if these are the policy's first episodes, and each ends with an error.
    """
    name, first = task
    world, factory = environment_of(given), ads_factory(name)
    is_planner = name.endswith(PLANNER) or world.planner_hz is not None
    seeds = range(first, min(first + CHUNK, given.seed + given.episodes))
    episodes = [drive_episode(world, factory, seed, is_planner=is_planner) for seed in seeds]
    errors = [each.error for each in episodes if each.error]
    if first == given.seed and len(errors) == CHUNK:
        # The last frame is in the code of the user.
        _, start, frame = errors[0].traceback.rpartition("  File ")
        place = (start + frame).rstrip()
        way_out = "Correct the policy, its factory or environment"
        if not is_planner:
            way_out += ", or append @planner to its name if it is a planner"
        raise RequestError(
            f"{name}: expected a policy that drives, received one with an error in each of the first {CHUNK} episodes, "
            f"starting with seed {first}: {errors[0].text}\n{place}\n{way_out}."
        )
    return episodes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the command."""
    of_whom = "a module of example_ads, module:factory, or module:factory:argument. Append @planner if it receives a "
    of_whom += "pafot.Observation and returns acceleration and steering"
    parser.add_argument(
        "--ads", required=True, metavar="ADS", help=f"drive with this policy: {of_whom}"
    )
    of_against = "also drive with this policy, on the same seeds; you can repeat this option"
    parser.add_argument("--against", action="append", default=[], metavar="ADS", help=of_against)
    add_world_arguments(parser, "it must be an environment", is_needed=True)
    parser.add_argument(
        "--episodes",
        type=int,
        default=1000,
        metavar="N",
        help="run N episodes (default: %(default)s)",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        metavar="N",
        help="start with the seed N (default: %(default)s)",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="use N processes (default: one per core)"
    )
    parser.add_argument(
        "--fail-above",
        metavar="SHARE",
        help="exit with 1 if the 95 %% confidence interval of the crash rate of --ads is entirely above this "
        "proportion (such as 2%% or 0.02), or if an episode ended with an error",
    )


def run(given: argparse.Namespace, command: Sequence[str]) -> int:
    """Measure crash rates, and return 1 if a policy completed too few episodes or its rate exceeds ``--fail-above``.

    Raises:
        KeyboardInterrupt: if the user interrupts the command, after the results of the completed episodes are printed.
    """
    for name, least in (("episodes", 1), ("seed", 0)):
        value = getattr(given, name)
        if value < least:
            raise RequestError(
                f"--{name}: expected a whole number, at least {least}, received {value}"
            )
    found: dict[str, list[Episode]] = {}
    for name in (given.ads, *given.against):
        if name in found:
            raise RequestError(
                f"--against: expected each policy only once, received {name!r} again"
            )
        found[name] = []
    limit = _limit_of(given)
    environment_of(given)  # errors in the options must come before the first episode
    # All policies drive a chunk before the next one starts, so an interrupted command can compare them.
    seeds = range(given.seed, given.seed + given.episodes, CHUNK)
    tasks = [(name, seed) for seed in seeds for name in found]
    drive = partial(drive_task, given)
    started = told = time.monotonic()
    done, total, interrupt = 0, given.episodes * len(found), None
    try:
        for (name, _), episodes in run_tasks(drive, tasks, worker_count(given.workers)):
            found[name] += episodes
            done += len(episodes)
            now = time.monotonic()
            if done == total or now - told > 10.0:  # a report every ten seconds
                told, left = now, (now - started) * (total - done) / done
                line = f"rate: {done} of {total} episodes"
                if left >= 60.0:
                    line += f", about {left / 60:.0f} min left (Ctrl-C ends early)"
                sys.stderr.write(f"{line}\n")
    except KeyboardInterrupt as interrupted:
        if not done:
            raise
        interrupt = interrupted  # report the completed episodes
    rates, lines = [], []
    for name, episodes in found.items():
        rate = Rate(name, tuple(sorted(episodes, key=lambda each: each.seed)))
        rates.append(rate)
        first, *others = rate.lines
        lines += [f"{name} in {given.world}: {first}", *others]
        hint = Policy(ads_factory(name)).loading_hint
        if hint:
            lines.append(f"  {hint}")
    lines += compare_rates(rates[0], rates[1:])
    width = shutil.get_terminal_size().columns
    for line in lines:
        sys.stdout.writelines(f"{part}\n" for part in wrapped_to(line, width))
    if interrupt is not None:
        sys.stdout.flush()
        raise interrupt
    objections = list(_objections(rates, limit))
    sys.stderr.write("".join(f"rate: {visible(each)}\n" for each in objections))
    return int(bool(objections))


def _limit_of(given: argparse.Namespace) -> float | None:
    if given.fail_above is None:
        return None
    # Parse a proportion such as `2%` or `0.02`. With too few episodes, no crash rate is significantly above it.
    number, sign, rest = given.fail_above.strip().partition("%")
    try:
        share = float(number)
    except ValueError:
        share = math.nan
    if sign:
        share /= 100
    if rest or not 0 <= share < 1:  # a rate is never above 1
        raise RequestError(
            f"--fail-above: expected at least 0 and less than 1, such as 2% or 0.02, received {given.fail_above!r}"
        )
    if interval(given.episodes, given.episodes)[0] <= share:
        raise RequestError(
            f"--episodes: expected more episodes, received {given.episodes}. Even if all of them crash, they cannot "
            f"show a crash rate above {given.fail_above}"
        )
    return share


def _objections(rates: Sequence[Rate], limit: float | None) -> Iterator[str]:
    for rate in rates:
        if 2 * rate.driven < len(rate.episodes):
            (why, times), *_ = Counter(rate.failed.values()).most_common(1)
            yield (
                f"expected {rate.ads} to complete most of {len(rate.episodes)} episodes, but it completed {rate.driven}"
                f". Reason in {times} episodes: {why}. Correct the environment, its configuration or the policy"
            )
    if limit is not None:
        errors = sum(each.error is not None for each in rates[0].episodes)
        crashes = len(rates[0].crashed)
        low, _ = interval(crashes, rates[0].driven)
        if errors:
            yield f"--fail-above: expected episodes without an error, received {errors} with an error"
        elif low > limit:
            at_most = f"crashes in at most {100 * limit:.4g} % of the episodes"
            yield f"--fail-above: expected {at_most}, received a confidence interval that starts at {100 * low:.4g} %"
