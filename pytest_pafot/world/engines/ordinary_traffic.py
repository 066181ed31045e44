"""Episodes of an environment as it is: its own start, its own random traffic, and its own flag for crashes.

The start is what ``env.reset`` makes of the seed. From there the traffic is compiled where it can be, else the
environment takes its own steps. The two agree on the tick and the outcome, and on positions within 1e-9 m.
"""

from __future__ import annotations

from contextlib import ExitStack

from pytest_pafot.errors import AdsFactoryError, WorldError
from pytest_pafot.trace import Outcome
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads, wants_env
from pytest_pafot.world.driving.closing import closing
from pytest_pafot.world.driving.failure import UNFIT, error_of
from pytest_pafot.world.driving.hang_guard import HangGuard
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.driving.policy import View
from pytest_pafot.world.engines.compiled_traffic import compiled, why_not
from pytest_pafot.world.engines.episode import Episode, Kind, Start
from pytest_pafot.world.engines.stepped_episode import stepped
from pytest_pafot.world.gym_environment import GymEnvironment, vehicle_classes_kept


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
