"""Imperfect perception: the factory of ADSs that have it, and what a planner then observes on a straight road."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import AdsFactoryError, WorldError, refused_policy
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads
from pytest_pafot.world.kernel.observation import Observation, Observer, Sensor

DRIVES_ITSELF = "a highway-env vehicle class drives itself and reads the road, so nothing can be hidden from it"


@dataclass(frozen=True)
class Perception(Sight):
    """A factory that wraps an ADS factory, so that the ADS sees the other vehicles imperfectly.

    The ADS sees the road and fixed objects exactly. All random values follow from the scenario's seed,
    so a scenario gives the same run each time and in any process.

    Attributes:
        ads: the wrapped factory, of planners in SI units.
        range: largest distance between centres at which it sees a vehicle [m].
        latency: age of what it sees of others [s], rounded up to whole physics ticks; before, it sees the start. Its
            own state is current.
        noise: standard deviations of normal errors of the others' ``"position"``, along x and along y [m], and
            ``"speed"`` [m/s]. Sampled for each vehicle at each decision.
        dropout: probability that it does not see a vehicle at a decision.

    Raises:
        FieldError: for an impossible value, such as a negative latency.
        AdsFactoryError: if ``ads`` is a vehicle class, which drives itself, or already a Perception.
    """

    ads: AdsFactory

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "__wrapped__", self.ads)  # inspect takes the signature from there
        fix = ""
        if isinstance(self.ads, Perception):
            fix = "give all imperfections to one Perception"
        elif is_vehicle_class(self.ads):
            fix = DRIVES_ITSELF
        elif not callable(self.ads):
            fix = "give a function or class that makes one, such as `pafot.Perception(MyPlanner, latency=0.3)`"
        if fix:
            raise refused_policy("the factory of an ADS, called for each scenario", shown(self.ads), fix)

    @property
    def sight(self) -> Sight:
        """The imperfections of the ADS's sight."""
        return Sight(**{each.name: getattr(self, each.name) for each in fields(Sight)})

    def __call__(self, *observations: Any, **arguments: Any) -> Any:
        """Make a fresh ADS with this sight.

        Raises:
            AdsFactoryError: if it is called with an observation, like an ADS; if the factory cannot be called; or if
                the factory returns a vehicle class or nothing that drives.
        """
        if observations:
            received = "a call of it with an observation, as if it were the ADS"
            fix = "write `ads=pafot.Perception(MyPlanner, ...)`, or return this object from the fixture"
            raise refused_policy("a pafot.Perception that is used as the factory", received, fix)
        ads = make_ads(self.ads, **arguments)
        if is_vehicle_class(ads):
            raise refused_policy("a callable in a Perception", shown(ads), DRIVES_ITSELF)
        return SeeingAds(ads, self.sight)


@dataclass(frozen=True, eq=False)
class SeeingAds:
    """An ADS with an imperfect sight; a run passes to ``ads`` only what this sight lets it see."""

    ads: Any
    sight: Sight

    def __call__(self, *_: Any) -> Any:
        """Refuse a call, which only a world without support for sights makes."""
        expected = "pafot.Highway or pafot.World for an ADS in a pafot.Perception"
        received, fix = "a world that calls the ADS directly", "apply the imperfect sight in that world itself"
        raise WorldError(field="world", expected=expected, received=received, fix=fix)

    @property
    def close(self) -> Any:
        """The ADS's own ``close``."""
        return self.ads.close


def rewrapped(ads: Any, wrap: Callable[[Any], Any]) -> Any:
    """Return what ``wrap`` makes of an ADS, with the sight that the ADS has.

    Raises:
        AdsFactoryError: for a vehicle class, which receives no observations.
    """
    if is_vehicle_class(ads):
        raise AdsFactoryError(f"ads: {DRIVES_ITSELF}")
    return replace(ads, ads=wrap(ads.ads)) if isinstance(ads, SeeingAds) else wrap(ads)


def ads_and_sight(ads: Any) -> tuple[Any, Sight | None]:
    """Return the ADS that receives observations, and its sight, which is None for perfect sight."""
    return (ads.ads, ads.sight) if isinstance(ads, SeeingAds) else (ads, None)


def sight_of(factory: Any) -> Sight | None:
    """Return the sight of a factory's ADSs; None for perfect sight."""
    factory = inspect.unwrap(factory, stop=lambda each: isinstance(each, Perception))
    return factory.sight if isinstance(factory, Perception) and factory.imperfections else None


class ImperfectSensor(Sensor):
    """The maker of imperfect observations on a straight road.

    Args:
        sensor: the maker of the exact observations, also of earlier ticks.
        sight: the imperfections.
        seed: the scenario's seed, from which all errors follow.
    """

    def __init__(self, sensor: Observer, sight: Sight, seed: int) -> None:
        super().__init__()
        self._sensor, self._sight, self._seed = sensor, sight, seed

    def observation(self, tick: int) -> Observation:
        """Make an imperfect observation from the exact observations now and at the time of measurement."""
        exact = self._sensor
        now, then = (exact.observation(each) for each in (tick, max(0, tick - self._sight.delay(exact.physics_hz))))
        others, ids, lateral = [], [], [now.lateral_velocities[0]]
        for npc, error_x, error_y, error_speed in self._sight.glimpses(then.array, self._seed, tick):
            was = then.others[npc]
            x, y = was.x + error_x, was.y + error_y
            lane = exact.lanes.closest(x, y, was.heading)
            others.append(was._replace(x=x, y=y, speed=was.speed + error_speed, lane=lane))
            ids.append(npc)
            lateral.append(then.lateral_velocities[npc + 1] + error_speed * math.sin(was.heading))
        return now.replace(others=tuple(others), ids=tuple(ids), lateral_velocities=tuple(lateral))
