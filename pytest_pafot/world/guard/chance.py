"""The seeding of the global random generators for each run, and the restoration of their states afterwards.

A policy that calls ``random.gauss`` or ``numpy.random.rand`` then acts in the same way each time, in any process. torch
is also seeded if other code has imported it.
"""

from __future__ import annotations

import os
import random
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from random import Random
from typing import Any, NamedTuple

from numpy.random import RandomState, get_state, random_sample, set_state
from numpy.random import seed as seed_numpy

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.support.process import REPLACED


class _Generator(NamedTuple):
    """Functions that save, restore, seed and draw from one global random generator."""

    state: Callable[[], Any]
    give_back: Callable[[Any], object]
    seed: Callable[[int], object]
    draw: Callable[[], float]
    seeded: Callable[[int], Callable[[], float]]  # makes a separate generator, and returns its draw


def _words(seed: int) -> list[int]:
    return [seed & 0xFFFFFFFF, seed >> 32]  # numpy's global generator takes 32 bits at a time


# These functions are looked up now, before a test can replace them.
OF_PYTHON = _Generator(
    random.getstate,
    random.setstate,
    random.seed,
    random.random,
    lambda seed: Random(seed).random,  # noqa: S311  (no cryptography)
)
OF_NUMPY = _Generator(
    get_state,
    set_state,
    lambda seed: seed_numpy(_words(seed)),
    random_sample,
    lambda seed: RandomState(_words(seed)).random_sample,
)


@cache
def _of_torch(torch: Any) -> _Generator:
    def state() -> Any:
        return (
            torch.get_rng_state(),
            torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else None,
        )

    def give_back(states: Any) -> None:
        torch.set_rng_state(states[0])
        if states[1] is not None:
            torch.cuda.set_rng_state_all(states[1])

    def seeded(seed: int) -> Callable[[], float]:
        own = torch.Generator().manual_seed(seed)
        return lambda: float(torch.rand((), generator=own))

    return _Generator(
        state,
        give_back,
        partial(_seed_torch, torch),
        lambda: float(torch.rand(())),
        seeded,
    )


# With this value of `sys.tracebacklimit`, `traceback` reads no frames of a stack.
NO_FRAMES = -1


def _seed_torch(torch: Any, seed: int) -> None:
    # This also seeds devices that are initialised later. For each of them, torch stores the seed with the complete
    # stack as a string, which takes a millisecond in pytest. Without frames, it takes a fortieth of that time.
    before = vars(sys).get("tracebacklimit")
    if before == NO_FRAMES:  # another thread is seeding, and will restore the previous value
        torch.manual_seed(seed)
        return
    try:
        sys.tracebacklimit = NO_FRAMES
        torch.manual_seed(seed)
    finally:
        if before is None:
            vars(sys).pop("tracebacklimit", None)
        else:
            sys.tracebacklimit = before


def _uses_gpu() -> bool:
    # Draws on a GPU are not detected, so runs share no seed if a GPU may be in use.
    cuda = getattr(sys.modules.get("torch"), "cuda", None)
    return cuda is not None and cuda.is_initialized()


class _Generators:
    """The global random generators of this process.

    Seeding takes a hundredth of the time of a fast run, and few policies draw random numbers. So if the first run draws
    none, the next runs share a seed. After each run, a comparison with a separate generator that has the same seed
    shows whether the run drew numbers. If so, the run is repeated with its own seed, and each later run also has its
    own seed.
    """

    def __init__(self) -> None:
        self._holders = 0
        self._is_running = False
        self.begin()

    def begin(self) -> None:
        """Forget the saved states and the results of earlier runs."""
        self._saved: list[tuple[_Generator, Any]] = []
        # generators with the shared seed; empty if runs share none
        self._others: list[Callable[[], float]] = []
        self._may_share = True

    @contextmanager
    def held(self, *, may_share: bool = True) -> Iterator[None]:
        """Restore the generators at the end of the outermost ``with`` block.

        If ``may_share`` is false, because other threads draw numbers, runs do not share a seed.
        """
        self._may_share = self._may_share and may_share
        self._holders += 1
        try:
            yield
        finally:
            self._release()

    def _release(self) -> None:
        self._holders -= 1
        if not self._holders:
            for generator, state in self._saved:
                generator.give_back(state)
            self.begin()

    @REPLACED.shown(True)
    def run(
        self,
        rollout: Callable[..., Any],
        scenario: Scenario,
        factory: Callable[..., Any],
        **given: Any,
    ) -> Any:
        """Execute a run with seeded generators, and return a trace that records whether the run drew numbers."""
        __tracebackhide__ = True
        if self._is_running:
            return rollout(scenario, factory, **given)
        self._is_running = True
        self._holders += 1
        try:
            if self._others and not _uses_gpu():
                trace = rollout(scenario, factory, **given)
                if self.is_shared():
                    return trace
            self._save()
            is_seeded = False
            while not is_seeded or self._save():  # again if the first run has imported torch
                is_seeded = True
                self._seed(scenario.seed)
                trace = rollout(scenario, factory, **given)
            if self._drew(self._seeded(scenario.seed)):
                if isinstance(trace, Trace):
                    trace = replace(trace, drew=True)
            elif self._may_share and not _uses_gpu():
                self.share()
            self._may_share = False
            return trace
        finally:
            self._is_running = False
            self._release()

    def share(self) -> None:
        self._save()
        self._seed(0)
        self._others = self._seeded(0)

    def is_shared(self) -> bool:
        """Return whether runs can still share a seed, which is no longer possible once a run has drawn numbers."""
        if self._save() or self._drew(self._others):
            self._others = []
        return bool(self._others)

    def _save(self) -> bool:
        """Save the state of each new generator, and return whether any generator was new."""
        torch = sys.modules.get("torch")  # only if something else has imported it
        known = [
            OF_PYTHON,
            OF_NUMPY,
            *([_of_torch(torch)] if hasattr(torch, "get_rng_state") else []),
        ]
        new = known[len(self._saved) :]
        self._saved += [(each, each.state()) for each in new]
        return bool(new)

    def _seed(self, seed: int) -> None:
        for generator, _ in self._saved:
            generator.seed(seed)

    def _seeded(self, seed: int) -> list[Callable[[], float]]:
        return [generator.seeded(seed) for generator, _ in self._saved]

    def _drew(self, others: list[Callable[[], float]]) -> bool:
        drawn = [
            generator.draw() != other()
            for (generator, _), other in zip(self._saved, others, strict=True)
        ]
        return any(drawn)


GENERATORS = _Generators()

if hasattr(os, "register_at_fork"):  # Python seeds its own generator in a forked process
    os.register_at_fork(after_in_child=GENERATORS.begin)
