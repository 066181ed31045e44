"""Runs in worlds that do not guard the ADS themselves: each decision has a time limit, as in the built-in worlds."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial, wraps
from typing import Any

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import AdsError, Outcome, Trace
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.driving.ads import is_vehicle_class
from pytest_pafot.world.driving.seeing import SeeingAds
from pytest_pafot.world.guard.chance import GENERATORS, is_unseeded
from pytest_pafot.world.guard.failure import error_of
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard, unending
from pytest_pafot.world.protocol import hang_limit

WORLD_SHARE, LEAST_FOR_WORLD = 10.0, 60.0
"""The time that a world may take between two decisions, before the first and after the last, before a process that can
be spared is ended: a multiple of the world's ``hang_limit``, and at least this time [s]. A simulator may need long to
start, but hardly as long as ten decisions that are too slow."""


class Hang(Exception):  # noqa: N818  (a world that records the name of the exception then names what happened)
    """The end of a decision that exceeds the hang limit, as the code of a user's world sees it."""


def rollout_of(world: Any, method: str = "rollout") -> Callable[..., Any]:
    """Return the ``rollout`` of any world, with seeded global generators, or another method of it that makes runs.

    Decisions that hang are ended: by the world, or else here. ``rollout_batch`` makes several runs at once.
    """
    if method == "rollout_batch":
        return partial(simulate_batch, world)
    is_guarded = method != "rollout" or guards_ads(world)
    return partial(GENERATORS.run, getattr(world, method) if is_guarded else partial(simulate, world))


def simulate(world: Any, scenario: Scenario, ads_factory: Callable[..., Any], **given: Any) -> Trace:
    """Simulate a scenario in a world that does not guard the ADS; ``given`` are further arguments of its ``rollout``.

    Each decision is interrupted after the world's ``hang_limit``. The world sees a :class:`Hang` then, and again at
    each further call of this ADS. However the world records that, the outcome of the run is ``hang``.

    Raises:
        Hang: if the world does not catch exceptions of the ADS.
        Exception: any exception of the world or of the factory.
    """
    __tracebackhide__ = True
    with _Watch(hang_limit(world), len(given.get("decisions", ()))) as watch:
        return watch.told(world.rollout(scenario, watch.guarded(ads_factory), **given))


def simulate_batch(world: Any, scenarios: Sequence[Scenario], ads_factory: Callable[..., Any]) -> list[Trace]:
    """Simulate scenarios by any world's ``rollout_batch``, with the guard of :func:`simulate` if the world has none.

    If a decision for many runs hangs, ``hang`` is the outcome of the runs that the world ended for it. If they draw
    from a global generator, they are made one by one instead, so that each has the numbers of its own seed.
    """
    __tracebackhide__ = True
    is_seeded = not is_unseeded(ads_factory)
    with GENERATORS.held():
        if is_seeded:
            GENERATORS.share()
        if guards_ads(world):
            made: list[Trace] = world.rollout_batch(scenarios, ads_factory)
        else:
            with _Watch(hang_limit(world), 0) as watch:
                made = world.rollout_batch(scenarios, watch.guarded(ads_factory))
                if watch.is_cut:
                    raise OutOfTime
                made = [watch.told(trace) if trace.outcome is Outcome.ADS_ERROR else trace for trace in made]
        if is_seeded and not GENERATORS.is_shared():
            made = [rollout_of(world)(each, ads_factory) for each in scenarios]
        return made


def guards_ads(world: Any) -> bool:
    """Return whether the class of a world itself states that it ends decisions that hang.

    An inherited statement is not used, because a derived class may call the ADS in a ``rollout`` of its own.
    """
    return vars(type(world)).get("guards_ads", False) is True


class _WorldGuard(HangGuard):
    """A guard that also knows how long the world has not asked the ADS."""

    def __init__(self, limit: float) -> None:
        super().__init__(limit)
        self.turned = self.clock()
        self._patience = max(WORLD_SHARE * limit, LEAST_FOR_WORLD)

    def is_stuck(self) -> bool:
        """Return whether the world has neither asked the ADS nor ended its run for too long."""
        return self.started is None and self.clock() - self.turned > self._patience


class _Watch:
    """The guard of the ADSs of one run, in any thread in which the world calls them.

    Attributes:
        decisions: the number of decisions so far, including those that were given to the world.
        hang: the error of a decision that was interrupted; None if there was none.
        is_cut: True if the time of the search is over. The run ends with ``OutOfTime`` then, when its world ends it.
    """

    def __init__(self, limit: float, decisions: int) -> None:
        self.decisions = decisions
        self.hang: AdsError | None = None
        self.is_cut = False
        self._limit = limit
        self._guards: dict[int, _WorldGuard] = {}
        self._stack = ExitStack()

    def __enter__(self) -> _Watch:
        # Entered before the run, since a built-in world inside a user's world has a guard of its own, which must end
        # before this one.
        self._guard()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, rest: object) -> None:
        self._stack.__exit__(kind, error, None)
        if isinstance(error, AdsHang):  # in the world's own code, which waits for an ADS in another thread
            raise Hang(str(error)) from None
        if self.is_cut and isinstance(error, Exception):
            raise OutOfTime from None

    def guarded(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """Return a factory of the same ADSs under guard. Vehicle classes drive themselves, inside a built-in world."""
        if is_vehicle_class(factory):
            return factory

        @wraps(factory, updated=())
        def make(*arguments: Any, **named: Any) -> Any:
            __tracebackhide__ = True
            with unending():
                ads = factory(*arguments, **named)
            if is_vehicle_class(ads) or not callable(ads):
                return ads
            return (
                replace(ads, ads=_GuardedAds(ads.ads, self)) if isinstance(ads, SeeingAds) else _GuardedAds(ads, self)
            )

        return make

    def call(self, ads: Callable[..., Any], *seen: Any, **named: Any) -> Any:
        """Call an ADS under guard.

        Raises:
            Hang: if it was interrupted, now or in an earlier call of this run, or if the time of the search is over.
            Exception: any exception of the ADS.
        """
        __tracebackhide__ = True
        if self.hang is not None or self.is_cut:
            raise Hang("the time limit of the search is over" if self.hang is None else self.hang.message)
        guard = self._guard()
        started = guard.clock()
        try:
            guard.decision_starts()
            try:
                action = ads(*seen, **named)
            finally:
                guard.decision_ends()
                guard.turned = guard.clock()
            guard.raise_swallowed()
        except OutOfTime as error:  # for the world an error like others, since it may ask in a thread
            self.is_cut = True
            raise Hang("the time limit of the search is over") from error
        except AdsHang as error:
            if guard.clock() - started <= guard.limit:  # of the guard of a built-in world around this one
                raise
            self.hang = error_of(error, 0, guard)
            raise Hang(self.hang.message) from None
        self.decisions += 1
        return action

    def told(self, trace: Trace) -> Trace:
        """Return the trace of the run, with the outcome ``hang`` if a decision was interrupted.

        Raises:
            OutOfTime: if the time of the search is over, although the world has caught that.
        """
        if self.is_cut:
            raise OutOfTime
        if self.hang is None or not isinstance(trace, Trace):
            return trace
        asked = self.decisions * (trace.physics_hz // trace.ads_hz)
        if self.decisions < len(trace.decided):
            asked = trace.decided[self.decisions]
        tick = min(asked, trace.ticks) if trace.error is None else trace.error.tick
        return replace(trace, outcome=Outcome.HANG, collision=None, error=replace(self.hang, tick=tick))

    def _guard(self) -> _WorldGuard:
        thread = threading.get_ident()
        if thread not in self._guards:
            self._guards[thread] = self._stack.enter_context(_WorldGuard(self._limit))
        return self._guards[thread]


class _GuardedAds:
    """An ADS under guard. All of its attributes are those of the ADS, also those that a world sets."""

    def __init__(self, ads: Callable[..., Any], watch: _Watch) -> None:
        object.__setattr__(self, "_ads", ads)
        object.__setattr__(self, "_watch", watch)

    def __call__(self, *seen: Any, **named: Any) -> Any:
        """Call the ADS."""
        __tracebackhide__ = True
        return self._watch.call(self._ads, *seen, **named)

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute of the ADS."""
        setattr(self._ads, name, value)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the ADS; its ``batch`` decides under guard, too."""
        value = getattr(self._ads, name)
        return partial(self._watch.call, value) if name == "batch" and callable(value) else value
