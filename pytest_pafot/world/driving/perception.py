"""A factory of ADSs with imperfect sight, which wraps any factory of a planner."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, fields
from typing import Any

from pytest_pafot.model.sight import Sight, SightWithout
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads
from pytest_pafot.world.driving.seeing import SeeingAds

DRIVES_ITSELF = "a highway-env vehicle class drives itself and reads the road, so nothing can be hidden from it"


@dataclass(frozen=True)
class Perception:
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
    _: KW_ONLY
    range: float | None = None
    latency: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict, hash=False)
    dropout: float = 0.0

    def __post_init__(self) -> None:
        _ = self.sight
        fix = ""
        if isinstance(self.ads, Perception):
            fix = "give all imperfections to one Perception"
        elif is_vehicle_class(self.ads):
            fix = DRIVES_ITSELF
        elif not callable(self.ads):
            fix = "give a function or class that makes one, such as `pafot.Perception(MyPlanner, latency=0.3)`"
        if fix:
            expected = "the factory of an ADS, called for each scenario"
            raise AdsFactoryError(f"ads: expected {expected}, received {shown(self.ads)}; {fix}")

    @property
    def sight(self) -> Sight:
        """The imperfections of the ADS's sight."""
        return Sight(**{each.name: getattr(self, each.name) for each in fields(Sight)})

    @property
    def __wrapped__(self) -> AdsFactory:
        """The wrapped factory, from which :mod:`inspect` takes the signature."""
        return self.ads

    def __call__(self, *observations: Any, **arguments: Any) -> Any:
        """Make a fresh ADS with this sight.

        Raises:
            AdsFactoryError: if it is called with an observation, like an ADS; if the factory cannot be called; or if
                the factory returns a vehicle class or nothing that drives.
        """
        if observations:
            raise AdsFactoryError(
                "ads: expected a pafot.Perception that is used as the factory, received a call of it with an "
                "observation, as if it were the ADS; write `ads=pafot.Perception(MyPlanner, ...)`, or return this "
                "object from the fixture"
            )
        ads = make_ads(self.ads, **arguments)
        if is_vehicle_class(ads):
            raise AdsFactoryError(f"ads: expected a callable in a Perception, received {shown(ads)}; {DRIVES_ITSELF}")
        return SeeingAds(ads, self.sight)


def without(factory: AdsFactory, npc: int) -> AdsFactory:
    """Return a factory of the same ADSs, from which one NPC of the scenario is hidden.

    Raises:
        AdsFactoryError: when it makes an ADS, if that is a vehicle class.
    """
    seen = sight_of(factory)
    sight = SightWithout(npc=npc, **({} if seen is None else seen.imperfections))

    def make(*observations: Any, **arguments: Any) -> Any:
        ads, _ = deciding(factory(*observations, **arguments))
        return SeeingAds(ads, sight)

    make = functools.wraps(factory, updated=())(make)
    make.sight = sight  # type: ignore[attr-defined]  # a factory must say how its ADSs see
    return make


def sight_of(factory: Any) -> Sight | None:
    """Return the sight of a factory's ADSs; None for perfect sight."""
    factory = inspect.unwrap(factory, stop=lambda each: isinstance(each, Perception))
    sight = factory.sight if isinstance(factory, Perception) else None
    return sight if sight is not None and sight.imperfections else None


def deciding(ads: Any) -> tuple[Any, Sight | None]:
    """Return the same as :func:`ads_and_sight`; refuse a vehicle class, which receives no observations."""
    if is_vehicle_class(ads):
        raise AdsFactoryError(f"ads: {DRIVES_ITSELF}")
    return ads_and_sight(ads)


def ads_and_sight(ads: Any) -> tuple[Any, Sight | None]:
    """Return the ADS that receives observations, and its sight, which is None for perfect sight."""
    return (ads.ads, ads.sight) if isinstance(ads, SeeingAds) else (ads, None)
