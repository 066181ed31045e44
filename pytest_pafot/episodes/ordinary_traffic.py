"""Episodes of an environment as it is: its own start, its own random traffic, and its own flag for crashes.

The start is what ``env.reset`` makes of the seed. From there the traffic is compiled where it can be, else the
environment takes its own steps. The two agree on the tick and the outcome, and on positions within 1e-9 m.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from pytest_pafot.episodes.compiled_traffic import compiled, why_not
from pytest_pafot.episodes.episode import Episode, EpisodeRecording, Kind, Start
from pytest_pafot.model.trace import AdsError, Outcome
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads, wants_env
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import View
from pytest_pafot.world.guard.failure import UNFIT, closing, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.gym_environment import GymEnvironment, vehicle_classes_kept
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.observation import COLUMNS

# An episode by the steps of the environment itself, which any environment and any ADS can take.


def stepped(start: Start, seed: int, reason: str, *, is_recorded: bool) -> Episode:
    """The episode that begins so; for a reason that the episode tells."""
    steps = _Steps(start, is_recorded=is_recorded)
    try:
        steps.run()
    finally:
        for name in ("_reward", "_info"):  # the environment may have further episodes
            vars(start.env).pop(name, None)
    tick = steps.tick if steps.crashed_at is None else steps.crashed_at
    if steps.error is not None:
        tick = steps.error.tick
    return start.ended(seed, tick, steps.error, steps=reason, recording=steps.recording() if is_recorded else None)


class _Steps:
    """The steps of an environment, whose road tells of each tick.

    Attributes:
        tick: how far the episode has come.
        crashed_at: the tick at which the ego was flagged; the environment goes on to the end of its step.
        error: what the ADS did instead of deciding.
    """

    def __init__(self, start: Start, *, is_recorded: bool) -> None:
        self.tick = 0
        self.crashed_at: int | None = None
        self.error: AdsError | None = None
        self._start = start
        self._frames: list[dict[Any, tuple[float, ...]]] | None = [] if is_recorded else None
        self._note()
        env, road = start.env, start.env.road
        act, step, is_policy = road.act, road.step, start.kind == "policy"

        def step_and_note(dt: float) -> None:
            step(dt) if is_policy else self._guarded(step, dt)
            self.tick += 1
            if env.vehicle.crashed and self.crashed_at is None:
                self.crashed_at = self.tick
            self._note()

        # Plain functions, which a copy of a vehicle with its road shares, and does not copy with what they hold.
        road.step = step_and_note
        if start.eyes is not None:
            note = start.eyes.note

            def note_and_act() -> None:
                note()
                act()

            road.act = note_and_act
        if not is_policy:
            road.act = lambda: self._guarded(act)
            env.observation_type.observe = env._reward = lambda *_: 0.0  # nobody looks at them
            env._info = lambda *_, **__: {}
        if start.kind == "planner":
            env.vehicle.act = self._planner()

    def run(self) -> None:
        """Go on until the episode is over."""
        start, seen, is_over = self._start, self._start.seen, False
        outer, ask = (start.outer, start.action) if start.kind == "policy" else (start.env, lambda *_: None)
        while not (is_over or self.error or self.crashed_at or self.tick >= start.ticks):
            before = self.tick
            try:
                action = ask(seen, before)
            except UNFIT as error:
                self.error = error_of(error, before, start.guard)
                return
            try:
                seen, _, is_terminated, is_truncated, _ = outer.step(action)
            except Exception as error:
                raise start.unfit(error) from error
            is_over = bool(is_terminated or is_truncated)
            if self.tick == before:
                raise WorldError(
                    "wrappers: expected that a step through them steps the environment, received one that did not, at "
                    f"{before / start.physics_hz:.1f} s of an episode"
                )

    def _guarded(self, call: Callable[..., None], *arguments: float) -> None:
        """Let everybody act or move where the ego's class is the user's; nobody once that has failed."""
        if self.error is None:
            try:
                self._start.guarded(call, *arguments)
            except UNFIT as error:
                self.error = error_of(error, self.tick, self._start.guard)

    def _planner(self) -> Callable[..., None]:
        """The ``act`` of an ego with a planner at its wheel."""
        start, ego, count = self._start, self._start.env.vehicle, len(self._start.vehicles)
        record, body = start.record(), Body(ego.LENGTH, ego.WIDTH)
        pilot = start.pilot(body, record)

        def act(action: Any = None) -> None:
            for row, each in enumerate(start.vehicles):
                at = (self.tick * count + row) * COLUMNS
                pose = start.straight.project(float(each.position[0]), float(each.position[1]), float(each.heading))
                held = each.action["acceleration"], each.action["steering"]
                record[at : at + 6] = array("d", (*pose, each.speed, *held))
            body.place(*start.straight.project(ego.x, ego.y, ego.heading), ego.speed)
            error = pilot.decide(self.tick) if self.tick % pilot.every == 0 else None
            self.error = self.error or error
            pilot.actuate()
            ego.control(body.acceleration, body.steering)

        return act

    def _note(self) -> None:
        if self._frames is not None and self.crashed_at in (None, self.tick):
            poses = {each: (*each.position, each.heading, each.speed) for each in self._start.vehicles}
            self._frames.append(poses)

    def recording(self) -> EpisodeRecording:
        """What was recorded."""
        frames = self._frames or []
        vehicles, gone = list(dict.fromkeys(each for frame in frames for each in frame)), (math.nan,) * 4
        return EpisodeRecording(
            states=np.array([[frame.get(each, gone) for each in vehicles] for frame in frames], dtype=float),
            sizes=np.array([[each.LENGTH, each.WIDTH] for each in vehicles]),
            lanes=self._start.lanes,
            physics_hz=self._start.physics_hz,
        )


def drive(
    environment: GymEnvironment,
    factory: AdsFactory,
    seed: int,
    *,
    hang_limit: float,
    is_planner: bool = False,
    may_compile: bool = True,
    is_recorded: bool = False,
) -> Episode:
    """One episode with a fresh ADS.

    Args:
        environment: is reset with the seed.
        factory: of the ADS, of any kind.
        seed: of the episode.
        hang_limit: longest decision [s].
        is_planner: whether the ADS sees an :class:`pytest_pafot.Observation` and returns acceleration and steering.
        may_compile: whether the traffic may be compiled; else the environment takes its own steps.
        is_recorded: whether the episode comes with a recording.

    Raises:
        AdsFactoryError: when the factory gives nothing that drives.
        WorldError: when the environment cannot be used, or has no road for a planner.
    """
    with vehicle_classes_kept(), HangGuard(hang_limit) as guard:
        outer = environment.with_traffic()
        seen, _ = outer.reset(seed=seed)
        view = None
        try:
            if wants_env(factory) and not is_vehicle_class(factory):
                view = View(environment.make().unwrapped, outer.unwrapped)
                ads = make_ads(factory, env=view.env)
            else:
                ads = make_ads(factory)
        except (AdsFactoryError, WorldError):
            raise
        except UNFIT as error:
            return Episode(seed=seed, outcome=Outcome.ADS_ERROR, seconds=0.0, error=error_of(error, 0, guard))
        with closing(ads, hang_limit), ExitStack() as at_the_end:
            kind: Kind = "vehicle" if is_vehicle_class(ads) else "planner" if is_planner else "policy"
            ads, sight = ads_and_sight(ads)
            start = Start(outer=outer, seen=seen, ads=ads, kind=kind, guard=guard, view=view, seed=seed, sight=sight)
            if start.eyes is not None:
                at_the_end.callback(start.eyes.close)
            reason = why_not(start) if may_compile else "that was asked for"
            if reason:
                return stepped(start, seed, reason, is_recorded=is_recorded)
            return compiled(start, seed, is_recorded=is_recorded)
