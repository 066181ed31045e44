"""The page of a rate, as Markdown."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence

from pytest_pafot.proportions import interval, percent
from pytest_pafot.rating.rate import Pair, Rate, number, shown
from pytest_pafot.rating.rate_plan import RatePlan
from pytest_pafot.text import markdown_table
from pytest_pafot.versions import installed_versions

HOW_TO_READ = """
## How to read this

- An episode begins as `env.reset(seed=...)` of the environment makes it and goes on in its own random traffic; no
  search has chosen it. It crashed where highway-env flagged the ego, up to a tick before boxes touch, and is cut there.
- The interval is Clopper and Pearson's: it covers the true share of episodes with at least 95 %, whatever that is.
  Where nothing crashed, its upper end is what can be said. Half as wide takes four times as many episodes.
- Episodes in which the policy raised, hung or returned no action are no crashes, and no rate counts them.
- This says how often a policy crashes in such traffic, not who is to blame, and nothing of traffic that is rarer.
- `results.csv` has a row for each episode. Equal arguments and versions give equal rows on any number of workers.
"""


def page(plan: RatePlan, rates: Sequence[Rate], command: Sequence[str], pictures: Mapping[str, str]) -> str:
    """The whole text, with the command that made it, and the file name of the picture of a crash of a policy."""
    packages = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    config = "" if plan.config is None else f" with `{json.dumps(dict(plan.config))}`"
    parts = [
        f"# How often {' and '.join(rate.ads for rate in rates)} crash{'es' if len(rates) == 1 else ''}",
        f"```sh\n{shlex.join(command)}\n```",
        f"{plan.episodes} episodes of {plan.env_id}{config}, seeds {plan.seed} to {plan.seed + plan.episodes - 1}. "
        f"{packages}.",
        _table(rates),
    ]
    if len(rates) == 2:
        pair = Pair.of(*rates)
        sentence = f"{pair.sentence[0].upper()}{pair.sentence[1:]}."
        alone = ((pair.first, pair.first_only), (pair.second, pair.second_only))
        parts.append(
            " ".join([sentence, *(f"Seeds of {name} alone: {shown(seeds)}." for name, seeds in alone if seeds)])
        )
    for rate in rates:
        parts.append("\n".join([f"## {rate.ads}\n", *(f"- {note}" for note in rate.notes or ["no crash"])]))
        if rate.ads in pictures:
            parts.append(f"![The first crash]({pictures[rate.ads]})")
    return "\n\n".join(part.strip() for part in [*parts, HOW_TO_READ]) + "\n"


def _table(rates: Sequence[Rate]) -> str:
    rows = []
    for rate in rates:
        low, high = interval(len(rate.crashed), rate.episodes)
        share = percent(rate.share) if rate.episodes else ""
        bounds = f"{percent(low)} to {percent(high)}" if rate.crashed else f"at most {percent(high)}"
        hours = number(rate.per_hour), number(rate.hours)
        rows.append([rate.ads, rate.episodes, len(rate.crashed), share, bounds, *hours])
    return markdown_table(["", "episodes", "crashes", "per episode", "95 %", "per hour", "hours"], rows)
