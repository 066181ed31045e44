"""The checked arguments of ``@pafot.rate``, the drives that they request, and the decision on the crash rate."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Required, TypedDict

from pytest_pafot.episodes.rate import EpisodeRow, Rate
from pytest_pafot.episodes.rate_plan import driven
from pytest_pafot.execution.pool import GRACE, WorkerPool
from pytest_pafot.execution.scenario_pool import METHOD, ExecutionError, check_can_be_given
from pytest_pafot.support.errors import RequestError, plain_number, plain_whole
from pytest_pafot.support.proportions import percent
from pytest_pafot.support.references import factory_named
from pytest_pafot.support.ways_out import flag
from pytest_pafot.world import World
from pytest_pafot.world.driving.ads import preload

EPISODES = 300
"""The default number of episodes."""


class RateArguments(TypedDict, total=False):
    """The arguments of :func:`pytest_pafot.rate`, for type checkers and to find misspelled names."""

    at_most: Required[float]
    world: Required[World | str]
    ads: Any
    episodes: int
    seed: int
    confidence: float | None
    planner: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RateRequest:
    """The checked arguments of a test that limits a crash rate.

    Attributes:
        at_most: largest allowed number of crashes per episode.
        world: environment in whose own traffic the policy drives.
        ads: factory of the policy, or the name of the fixture that returns the factory.
        episodes: number of episodes; their seeds are ``seed``, ``seed + 1`` and so on.
        seed: seed of the first episode.
        confidence: confidence with which the true rate must be at most ``at_most``; None to compare only the counted
            crashes per episode with ``at_most``.
        planner: whether the ADS is a planner in SI units.
    """

    at_most: float
    world: World
    ads: str | Callable[..., Any]
    episodes: int = EPISODES
    seed: int = 0
    confidence: float | None = None
    planner: bool = False

    def measured(self, factory: Callable[..., Any], workers: int = 1, *, isolate: bool = False) -> Rate:
        """Drive the episodes and return the rate; use several processes if they can be forked.

        With ``isolate``, no episode is driven in this process.

        Raises:
            ProcessLostError: if a process dies or hangs.
            RequestError: if ``isolate`` is set, processes cannot be forked, and the factory cannot be pickled.
        """
        name = self.ads if isinstance(self.ads, str) else getattr(factory, "__name__", repr(factory))
        seeds, work = range(self.seed, self.seed + self.episodes), partial(_row, self, name, factory)
        if not isolate and (workers == 1 or METHOD != "fork"):
            return Rate(ads=name, rows=tuple(map(work, seeds)))
        try:
            check_can_be_given(work)
        except ExecutionError as error:
            raise RequestError(f"{flag('isolate')}: {error}") from None
        preload(factory)
        patience = self.world.hang_limit + GRACE
        with WorkerPool[int, EpisodeRow](work, min(workers, len(seeds)), method=METHOD, patience=patience) as pool:
            pool.expect(seeds)
            rows = []
            for seed in seeds:
                answer = pool.fetch(seed)
                if isinstance(answer, Exception):
                    raise answer
                rows.append(answer)
        return Rate(ads=name, rows=tuple(rows))

    def objection(self, rate: Rate) -> str:
        """Return the message that the rate is too high or that the ADS failed; empty if the rate is accepted."""
        told = "\n".join([rate.sentence, *rate.notes])
        if rate.failed:
            speaks = "" if rate.episodes or self.planner else "; planner=True says that it is a planner in SI units"
            return f"expected an ADS that drives all episodes, received one that failed{speaks}:\n{told}"
        if self.confidence is not None:
            bound = rate.upper_bound(self.confidence)
            shown = f"shown with a confidence of {100 * self.confidence:g} %"
            received = f"the episodes show at most {percent(bound)}"
            return "" if bound <= self.at_most else self._lines(shown, received, told)
        return "" if rate.share <= self.at_most else self._lines("", percent(rate.share), told)

    def _lines(self, how: str, received: str, told: str) -> str:
        expected = f"crashes in at most {percent(self.at_most)} of the episodes"
        return f"expected {expected}{f', {how}' if how else ''}, received: {received}\n{told}"


def _row(request: RateRequest, name: str, factory: Callable[..., Any], seed: int, *_: object) -> EpisodeRow:
    """Drive one episode and return its row; further arguments of the pool are ignored."""
    return driven(request.world, name, factory, seed, is_planner=request.planner)


def checked_rate(arguments: Mapping[str, Any], positional: Sequence[object] = ()) -> RateRequest:
    """Return the request from the arguments of ``@pafot.rate``, which must all be keyword arguments.

    Raises:
        RequestError: for the first argument that is not valid.
        WorldError: if the environment cannot be used.
    """
    _check_names(arguments, positional)
    for name, example in (("at_most", "at_most=0.02"), ("world", 'world="highway-fast-v0"')):
        if name not in arguments:
            raise _error(f"{name}=...", f"expected it to be given, as in {example}, received none")
    given = dict(arguments)
    if isinstance(given["world"], str):
        given["world"] = World(given["world"])
    for name, problem in _problems(given).items():
        if problem:
            raise _error(f"{name}=...", f"{problem}, received {given[name]!r:.200}")
    if isinstance(given.get("ads"), str) and ":" in given["ads"]:
        try:
            given["ads"] = factory_named(given["ads"])
        except ValueError as error:
            raise _error("ads=...", str(error)) from error
    request = RateRequest(**given)
    if request.confidence is not None:
        needed = math.ceil(math.log(1 - request.confidence) / math.log1p(-request.at_most)) if request.at_most else None
        if needed is None or request.episodes < needed:
            fewer = f"{needed} or more: even without a crash, fewer episodes do not show"
            least = "at_most= above 0: no number of episodes shows" if needed is None else fewer
            raise _error(
                "episodes=...",
                f"expected {least} with a confidence of {100 * request.confidence:g} % that at most "
                f"{percent(request.at_most)} of episodes crash, received {request.episodes}",
            )
    request.world.environment.with_traffic()
    return request


def _check_names(arguments: Mapping[str, Any], positional: Sequence[object]) -> None:
    if positional:
        raise RequestError(
            f"@pafot.rate: expected keyword arguments only, received {tuple(positional)!r:.200}; write their names, as "
            'in @pafot.rate(at_most=0.02, world="highway-fast-v0")'
        )
    known = RateArguments.__annotations__
    for name in arguments:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            meant = f"did you mean {near[0]!r}? Expected" if near else "expected"
            raise _error(f"{name}=...", f"{meant} one of {', '.join(sorted(known))}, received {name!r}")


def _problems(given: Mapping[str, Any]) -> Mapping[str, str]:
    """Return the problem of each argument by its name; a text is empty if the argument is valid."""
    ads, confidence = given.get("ads"), given.get("confidence")
    share, likely = plain_number(given["at_most"]), plain_number(confidence)
    episodes, seed = plain_whole(given.get("episodes", 1)), plain_whole(given.get("seed", 0))
    return {
        "at_most": ""
        if share is not None and 0 <= share < 1
        else "expected a share of the episodes, from 0 to less than 1",
        "world": ""
        if isinstance(given["world"], World)
        else "expected an environment with its own traffic, pafot.World(...) or its id",
        "ads": "" if isinstance(ads, str) or callable(ads) else "expected a factory, or the name of a fixture",
        "episodes": "" if episodes is not None and episodes >= 1 else "expected a whole number, at least 1",
        "seed": "" if seed is not None and seed >= 0 else "expected a whole number, at least 0",
        "planner": "" if isinstance(given.get("planner", False), bool) else "expected True or False",
        "confidence": ""
        if confidence is None or (likely is not None and 0 < likely < 1)
        else "expected a number between 0 and 1, such as 0.95",
    }


def _error(arguments: str, problem: str) -> RequestError:
    return RequestError(f"@pafot.rate({arguments}): {problem}")
