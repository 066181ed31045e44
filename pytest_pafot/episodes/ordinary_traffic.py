"""Episodes of an unchanged environment: its own start, its own random traffic, and its own flag for crashes.

The start of an episode is the result of ``env.reset`` with its seed. Compiled code then drives the traffic if possible;
otherwise the environment takes its own steps. Both give the same outcome at the same tick, and positions that differ by
less than 1e-9 m.
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

# An episode by the environment's own steps, which works for any environment and any ADS.


def stepped(start: Start, seed: int, reason: str, *, is_recorded: bool) -> Episode:
    """Drive an episode by the environment's own steps.

    ``reason`` says why its traffic is not compiled, and is stored in the result.
    """
    steps = _Steps(start, is_recorded=is_recorded)
    try:
        steps.run()
    finally:
        for name in ("_reward", "_info"):  # the environment may be used for more episodes
            vars(start.env).pop(name, None)
    tick = steps.tick if steps.crashed_at is None else steps.crashed_at
    if steps.error is not None:
        tick = steps.error.tick
    return start.ended(seed, tick, steps.error, steps=reason, recording=steps.recording() if is_recorded else None)


class _Steps:
    """The environment's own steps in an episode; the ``step`` of its road is replaced to notice each tick.

    Attributes:
        tick: current tick of the episode.
        crashed_at: tick at which the ego was flagged as crashed, else None; the environment continues to the end of its
            step.
        error: error of the ADS, if it did not decide, else None.
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

        # Plain functions, because a copy of a vehicle with its road shares them. It would copy a method with its
        # object.
        road.step = step_and_note
        if start.eyes is not None:
            note = start.eyes.note

            def note_and_act() -> None:
                note()
                act()

            road.act = note_and_act
        if not is_policy:
            road.act = lambda: self._guarded(act)
            env.observation_type.observe = env._reward = lambda *_: 0.0  # nothing reads them
            env._info = lambda *_, **__: {}
        if start.kind == "planner":
            env.vehicle.act = self._planner()

    def run(self) -> None:
        """Take steps until the episode is over."""
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
                    "wrappers: expected their step to step the environment, received a step that did not, at "
                    f"{before / start.physics_hz:.1f} s of an episode"
                )

    def _guarded(self, call: Callable[..., None], *arguments: float) -> None:
        """Let all vehicles act or move under guard, because the ego's class is the user's; nothing after an error."""
        if self.error is None:
            try:
                self._start.guarded(call, *arguments)
            except UNFIT as error:
                self.error = error_of(error, self.tick, self._start.guard)

    def _planner(self) -> Callable[..., None]:
        """Return the ``act`` of an ego that a planner drives."""
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
        """Return the recording of the ticks so far."""
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
    """Drive one episode with a new ADS.

    Args:
        environment: environment, which is reset with the seed.
        factory: factory of an ADS of any kind.
        seed: seed of the episode.
        hang_limit: time after which a decision of the ADS is interrupted and counts as a hang [s].
        is_planner: whether the ADS receives an :class:`pytest_pafot.Observation` and returns acceleration and steering.
        may_compile: whether compiled code may drive the traffic; otherwise the environment takes its own steps.
        is_recorded: whether to record the episode.

    Raises:
        AdsFactoryError: if the factory returns an object that cannot drive.
        WorldError: if the environment cannot be used, or its road is not straight and the ADS is a planner.
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
            reason = why_not(start) if may_compile else "that was requested"
            if reason:
                return stepped(start, seed, reason, is_recorded=is_recorded)
            return compiled(start, seed, is_recorded=is_recorded)
