"""The report of a rate: its page in Markdown, and pictures of crashes."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pytest_pafot.episodes.rate import Pair, Rate, number, shown
from pytest_pafot.episodes.rate_plan import RatePlan
from pytest_pafot.report.animation import animate
from pytest_pafot.report.finding_view import FRAMES_PER_SECOND
from pytest_pafot.report.page_data import EventView, FindingView, LaneView, RoadView, VehicleView
from pytest_pafot.support.proportions import interval, percent
from pytest_pafot.support.text import capitalised, markdown_table
from pytest_pafot.support.versions import installed_versions

if TYPE_CHECKING:  # it imports highway-env
    from pytest_pafot.episodes.episode import Episode, EpisodeRecording

# The end of an episode as an animated picture, in the style of the pictures of findings.

NEAREST = 7
"""The number of other vehicles in a picture, which are the nearest to the ego at the end of the episode."""


def picture(episode: Episode, headline: str) -> bytes:
    """Return an APNG of the last seconds of a recorded episode.

    Raises:
        AnimationError: if Pillow is not installed.
    """
    if episode.recording is None:
        raise ValueError("episode: expected an episode with a recording; drive it with is_recorded=True")
    recording = episode.recording
    states, hz, lanes = recording.states, recording.physics_hz, recording.lanes
    is_bent = bool(lanes[0].points)
    last = len(states) - 1
    ticks = sorted({*range(0, last + 1, max(1, round(hz / FRAMES_PER_SECOND))), last})
    distance = np.hypot(*(states[-1, 1:, :2] - states[-1, 0, :2]).T)
    shown = [0, *(np.argsort(distance, kind="stable")[:NEAREST] + 1)]  # NaN, a vehicle that has left, is sorted last
    view = FindingView(
        id=f"seed-{episode.seed}",
        node_id="",
        test="",
        headline=headline,
        explanation="",
        responsibility="none",
        road=RoadView(
            lanes=() if is_bent else tuple(lane.y for lane in lanes),
            lane_width=lanes[0].width,
            speed_limit=max(lane.speed_limit for lane in lanes),
            clearance=0.0,
            shapes=tuple(LaneView(points=lane.points, width=lane.width) for lane in lanes) if is_bent else (),
        ),
        vehicles=tuple(_vehicle(recording, int(index), ticks) for index in shown),
        times=tuple(round(tick / hz, 3) for tick in ticks),
        instructions=(),
        event=EventView(kind=str(episode.outcome), time=episode.seconds, npc=0 if len(shown) > 1 else None),
        yaml="",
        command="",
    )
    return animate(view)


def _vehicle(recording: EpisodeRecording, index: int, ticks: list[int]) -> VehicleView:
    length, width = recording.sizes[index]
    along, across, heading, speed = (
        tuple(round(float(value), 3) if np.isfinite(value) else None for value in column)
        for column in recording.states[ticks, index, :4].T
    )
    return VehicleView(
        name=f"NPC {index - 1}" if index else "ego",
        length=float(length),
        width=float(width),
        along=along,
        across=across,
        heading=heading,
        speed=speed,
    )


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


def page(plan: RatePlan, rates: Sequence[Rate], command: Sequence[str], pictures: Mapping[str, str]) -> str:
    """Return the page of a rate as Markdown.

    ``command`` is the command that made it, and ``pictures`` has the file name of the picture of each policy's crash.
    """
    packages = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    config = "" if plan.config is None else f" with `{json.dumps(dict(plan.config))}`"
    rows = []
    for rate in rates:
        low, high = interval(len(rate.crashed), rate.episodes)
        share = percent(rate.share) if rate.episodes else ""
        bounds = f"{percent(low)} to {percent(high)}" if rate.crashed else f"at most {percent(high)}"
        hours = number(rate.per_hour), number(rate.hours)
        rows.append([rate.ads, rate.episodes, len(rate.crashed), share, bounds, *hours])
    parts = [
        f"# How often {' and '.join(rate.ads for rate in rates)} crash{'es' if len(rates) == 1 else ''}",
        f"```sh\n{shlex.join(command)}\n```",
        f"{plan.episodes} episodes of {plan.env_id}{config}, seeds {plan.seed} to {plan.seed + plan.episodes - 1}. "
        f"{packages}.",
        markdown_table(["", "episodes", "crashes", "per episode", "95 %", "per hour", "hours"], rows),
    ]
    if len(rates) == 2:
        pair = Pair.of(*rates)
        sentence = f"{capitalised(pair.sentence)}."
        alone = ((pair.first, pair.first_only), (pair.second, pair.second_only))
        only = [f"Seeds of crashes only with {name}: {shown(seeds)}." for name, seeds in alone if seeds]
        parts.append(" ".join([sentence, *only]))
    for rate in rates:
        parts.append("\n".join([f"## {rate.ads}\n", *(f"- {note}" for note in rate.notes or ["no crash"])]))
        if rate.ads in pictures:
            parts.append(f"![The first crash]({pictures[rate.ads]})")
    return "\n\n".join(part.strip() for part in [*parts, HOW_TO_READ]) + "\n"
