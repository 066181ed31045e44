"""``python -m pytest_pafot rate``: the crash rate of a policy in ordinary traffic, and its page."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from pytest_pafot.extending import Policy, add_world_arguments
from pytest_pafot.extras.episodes.rate import (
    CHUNK,
    Rate,
    RatePlan,
    checked,
    factory_of,
    number,
    pairs_of,
    rows_of,
    shown,
)
from pytest_pafot.extras.resumable import AGAIN, printing_elsewhere, run_job, worker_count, written_into
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.files import write_whole
from pytest_pafot.support.proportions import CONFIDENCE, interval, percent
from pytest_pafot.support.text import capitalised, markdown_table, plural, quiet_json, wrapped_to
from pytest_pafot.support.versions import installed_versions, versions_text

HOW_TO_READ = """
## How to read this

- An episode starts with `env.reset(seed=...)` of the environment and continues in its own random traffic; no search has
  chosen it. It crashed if highway-env flagged the ego, up to a tick before boxes touch, and ends there.
- The interval is Clopper and Pearson's: it covers the true share of episodes with at least 95 %, whatever that is.
  If nothing crashed, only its upper end is known. An interval half as wide needs four times as many episodes.
- Episodes in which the policy raised, hung or returned no action are no crashes, and the rate ignores them.
- This says how often a policy crashes in such traffic. It does not say who is to blame, nor anything about rarer
  traffic.
- `results.csv` has a row for each episode. Equal arguments and versions give equal rows on any number of workers.
"""


def page(plan: RatePlan, rates: Sequence[Rate], command: Sequence[str]) -> str:
    """Return the page of a rate as Markdown; ``command`` is the command that made it."""
    packages = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    config = "" if plan.config is None else f" with `{plan.config}`"
    rows = []
    for rate in sorted(rates, key=lambda each: -each.share if each.episodes else 1.0):  # the worst first
        low, high = interval(len(rate.crashed), rate.episodes)
        share = percent(rate.share) if rate.episodes else ""
        bounds = f"{percent(low)} to {percent(high)}" if rate.crashed else f"at most {percent(high)}"
        hours = number(rate.per_hour), number(rate.hours)
        rows.append([rate.ads, rate.episodes, len(rate.crashed), share, bounds, *hours])
    parts = [
        f"# How often {' and '.join(rate.ads for rate in rates)} crash{'es' if len(rates) == 1 else ''}",
        f"```sh\n{shlex.join(command)}\n```",
        f"{plan.episodes} episodes of {plan.world_name}{config}, seeds {plan.seed} to {plan.seed + plan.episodes - 1}. "
        f"{packages}.",
        markdown_table(["", "episodes", "crashes", "per episode", "95 %", "per hour", "hours"], rows),
    ]
    pairs = pairs_of(rates)
    for pair, adjusted in pairs:
        sentence = f"{capitalised(pair.told(adjusted, len(pairs)))}."
        alone = ((pair.first, pair.first_only), (pair.second, pair.second_only))
        only = [f"Seeds of crashes only with {name}: {shown(seeds)}." for name, seeds in alone if seeds]
        parts.append(" ".join([sentence, *only]))
    parts += ["\n".join([f"## {rate.ads}\n", *(f"- {note}" for note in rate.notes or ["no crash"])]) for rate in rates]
    return "\n\n".join(part.strip() for part in [*parts, HOW_TO_READ]) + "\n"


NOTHING_DRIVEN = 1  # exit code if the ADS failed in every episode, so that there is no rate
ABOVE = 1  # exit code if --fail-above found that a policy crashes too often, or that it failed in an episode


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
    of_out = "folder for rows and page (default: none)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=of_out)
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one for each core)")
    parser.add_argument("--json", action="store_true", help="print JSON, for programs")
    parser.add_argument(
        "--fail-above",
        metavar="SHARE",
        help="exit with 1 if the 95 %% interval of the crashes of the policy (that of --ads) begins above this share "
        "of the episodes, such as 2%% or 0.02, or if the policy failed in an episode",
    )


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Rate the policies, write the page if there is a folder for it, and return the exit code."""
    try:
        with ExitStack() as stack:
            if arguments.json:
                stack.enter_context(printing_elsewhere())  # also what modules and a factory of the world print
            same = {name: getattr(arguments, name) for name in ("ads", "episodes", "seed")}
            same["against"] = tuple(arguments.against)
            plan = checked(RatePlan(world_name=arguments.world, config=arguments.config, **same))
            workers = worker_count(arguments.workers)
            limit = _share_of(arguments.fail_above, plan.episodes)
            folder = arguments.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            job = plan.job
            workers = min(workers, len(job.tasks))
            results = run_job(job, folder, workers=workers, stream=sys.stderr, clock=time.monotonic)
            rows = rows_of(results.read_text(encoding="utf-8"))
        rates = [Rate(ads=name, rows=tuple(row for row in rows if row.ads == name)) for name in plan.policies.values()]
        objection = "" if limit is None else _objection(rates[0], limit)
        if arguments.json:
            sys.stdout.write(f"{quiet_json(json.dumps(_data(plan, rates, limit, objection), indent=2))}\n")
        else:
            sys.stdout.write(_text(plan, rates))
        if arguments.out is not None:
            with written_into(arguments.out, AGAIN):
                write_whole(arguments.out / "report.md", page(plan, rates, command))
                write_whole(arguments.out / "versions.txt", versions_text(["gymnasium"]))
            (sys.stderr if arguments.json else sys.stdout).write(f"{arguments.out / 'report.md'}\n")
        if objection:
            sys.stderr.write(f"rate: {objection}\n")
            return ABOVE
    except KeyboardInterrupt as interrupt:
        kept = f"finished tasks of up to {CHUNK} episodes are saved, and the same command continues with the rest"
        interrupt.add_note("nothing is saved without --out" if arguments.out is None else kept)
        raise
    return 0 if all(rate.episodes for rate in rates) else NOTHING_DRIVEN


def _share_of(text: str | None, episodes: int) -> float | None:
    """Return the share that the text of ``--fail-above`` means, such as ``2%`` or ``0.02``; None without a text.

    Raises:
        RequestError: if the text is no share from 0 to less than 1, or if so few episodes cannot show a higher share.
    """
    if text is None:
        return None
    number, percent, rest = text.strip().partition("%")
    try:
        share = float(number) / (100 if percent else 1)
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
    low, _ = rate.interval()
    if low <= limit:
        return ""
    expected = f"crashes in at most {100 * limit:.4g} % of the episodes"
    return f"--fail-above: expected {expected}, received an interval that begins at {100 * low:.4g} %"


def _data(plan: RatePlan, rates: Sequence[Rate], limit: float | None, objection: str) -> dict[str, Any]:
    """Return the rates as plain data, for programs."""
    names = ("first_only", "second_only", "both", "neither")
    return {
        "world": plan.world_name,
        "config": None if plan.config is None else json.loads(plan.config),
        "seed": plan.seed,
        "episodes": plan.episodes,
        "policies": [
            {
                **{name: getattr(rate, name) for name in ("ads", "episodes", "hours", "crashed", "notes")},
                "crashes": len(rate.crashed),
                "share": rate.share if rate.episodes else None,
                "interval": rate.interval(),
                "confidence": CONFIDENCE,
                "failed": [row.seed for row in rate.failed],
            }
            for rate in rates
        ],
        "pairs": [
            {
                "first": pair.first,
                "second": pair.second,
                **{name: len(getattr(pair, name)) for name in names},
                "p": pair.p,
                "p_holm": adjusted,
            }
            for pair, adjusted in pairs_of(rates)
        ],
        "fail_above": limit,
        "objection": objection,
    }


def _text(plan: RatePlan, rates: Sequence[Rate]) -> str:
    lines: list[str] = []
    for rate in rates:
        hint = Policy(factory_of(rate.ads)[0]).loading_hint
        notes = [*rate.notes, *filter(None, [hint])]
        lines += [f"{rate.ads} in {plan.world_name}: {rate.sentence}", *(f"  {note}" for note in notes)]
        if not rate.episodes and "@" not in rate.ads and plan.world.planner_hz is None:
            named = shlex.join(["--ads", f"{rate.ads}@planner"])
            lines.append(f"  for a planner in SI units, as for pafot.Highway, use {named}")
    pairs = pairs_of(rates)
    lines += [pair.told(adjusted, len(pairs)) for pair, adjusted in pairs]
    if len(pairs) > 1:
        worst = sorted((rate for rate in rates if rate.episodes), key=lambda rate: -rate.share)
        lines.append(f"the worst first: {', '.join(f'{rate.ads} {percent(rate.share)}' for rate in worst)}")
    width = shutil.get_terminal_size().columns
    lines = [part for line in lines for part in wrapped_to(line, width, phrases=True)]
    return "\n".join(lines) + "\n"
