"""The plan of a crash rate: one or two policies, an environment, and the seeds of the episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from pytest_pafot.commands.policy_reference import ads_factory, caution, identity
from pytest_pafot.commands.resumable import ResumableJob, Task, Tick
from pytest_pafot.episodes.rate import EpisodeRow, text_of
from pytest_pafot.model.trace import AdsError
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.source_files import source_digests
from pytest_pafot.support.versions import installed_versions
from pytest_pafot.world import World, codec
from pytest_pafot.world.driving.ads import AdsFactory

QUESTION = "rate.json"
CHUNK = 25
"""The number of episodes in a task; if the command is interrupted, finished tasks are saved."""
PLANNER = "@planner"
"""The suffix that a user adds to the name of a policy that is a planner in SI units."""
SIDES = ("ads", "against")


@dataclass(frozen=True, kw_only=True)
class RatePlan:
    """A plan for the crash rates of one or two policies. Every episode depends only on this plan and its seed.

    Attributes:
        ads: name of the policy, in the form of the command ``compare``; with ``@planner`` at its end for a planner in
            SI units.
        against: name of a second policy that drives on the same seeds, or None.
        env_id, config: environment, as in :class:`pytest_pafot.World`.
        episodes: number of episodes; their seeds are ``seed``, ``seed + 1`` and so on.
        seed: seed of the first episode.
    """

    ads: str
    against: str | None = None
    env_id: str
    config: Mapping[str, Any] | None = None
    episodes: int = 1000
    seed: int = 0

    @cached_property
    def world(self) -> World:
        """The environment of the episodes."""
        return World(self.env_id, None if self.config is None else dict(self.config))

    @property
    def policies(self) -> dict[str, str]:
        """The names of the policies by side, ``ads`` or ``against``."""
        given = (self.ads, self.against)
        return {side: name for side, name in zip(SIDES, given, strict=True) if name is not None}

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
        question = {"ads": self.ads, "against": self.against, "env_id": self.env_id, "config": self.config}
        names = [name.removesuffix(PLANNER) for name in self.policies.values()]
        told = {
            "plan": question,
            "policies": {name: identity(name) for name in names},
            "code": source_digests(*codec.code_of(self.world), here=Path.cwd()),
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
            caution=caution(names),
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
    if plan.against == plan.ads:
        raise RequestError(f"--against: expected a different policy than --ads, received {plan.ads!r} again")
    for name in plan.policies.values():
        factory_of(name)
    plan.world.environment.with_traffic()
    return plan


def factory_of(name: str) -> tuple[AdsFactory, bool]:
    """Return the factory with a name, and whether its policy is a planner in SI units.

    Raises:
        RequestError: if there is no such factory.
    """
    return ads_factory(name.removesuffix(PLANNER)), name.endswith(PLANNER)


def driven(world: World, name: str, factory: AdsFactory, seed: int, *, is_planner: bool) -> EpisodeRow:
    """Drive one episode and return its row of the results."""
    from pytest_pafot.episodes.ordinary_traffic import drive  # noqa: PLC0415  (imports highway-env)

    episode = drive(world.environment, factory, seed, hang_limit=world.hang_limit, is_planner=is_planner)
    return EpisodeRow(
        ads=name,
        seed=seed,
        outcome=str(episode.outcome),
        seconds=episode.seconds,
        error="" if episode.error is None else told(episode.error),
        steps=episode.steps,
    )


def told(error: AdsError) -> str:
    """Return the error of an ADS as one line."""
    prefix = "" if error.message.startswith(error.kind) else f"{error.kind}: "
    return f"{prefix}{error.message}"


def _text(plan: RatePlan, task: Task, tick: Tick) -> str:
    side, _, count = task[0].partition("-")
    name, rows = plan.policies[side], []
    factory, is_planner = factory_of(name)
    for number in range(int(count)):
        rows.append(driven(plan.world, name, factory, task[1] + number, is_planner=is_planner))
        tick((number + 1) / int(count))
    return text_of(rows)
