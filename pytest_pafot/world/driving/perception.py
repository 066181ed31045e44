"""The factory of an ADS that sees the others imperfectly, around any factory of a planner or a policy."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from typing import Any

from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads
from pytest_pafot.world.driving.seeing import SeeingAds

DRIVES_ITSELF = "a highway-env vehicle class drives itself and looks at the road, where nothing can be hidden from it"


@dataclass(frozen=True)
class Perception:
    """An ADS factory around another one, whose ADS sees the other vehicles imperfectly.

    Its own vehicle, the road and fixed objects beside it are as they are. What is drawn is drawn by the seed of the
    scenario, so that a scenario gives the same run each time, in any process.

    Attributes:
        ads: the factory: of planners in SI units, or of policies of an environment whose observation is Kinematics, an
            occupancy grid, times to collision or a lidar's, also with a parameter ``env``.
        range: others are not seen when their centre is farther from the ego's [m]; None without.
        latency: others are seen as they were so long ago [s], to the next whole physics tick; before that time has
            passed, as they were at the start. Range and occlusion are those of then, the ego's own state is that of
            now.
        noise: standard deviations of normal errors of the others' ``"position"``, along x and along y [m], and
            ``"speed"`` [m/s], such as ``{"position": 0.5}``; drawn anew for each vehicle at each decision.
        dropout: probability with which another vehicle is not seen, drawn likewise; 0 to 1.
        occlusion: whether vehicles hide others: one is not seen where the straight lines from the ego's centre to its
            centre and to its four corners all run through boxes of others.

    Raises:
        FieldError: for a value that cannot be, such as a negative latency.
        AdsFactoryError: for a vehicle class, which drives itself, and for another Perception.
    """

    ads: AdsFactory
    _: KW_ONLY
    range: float | None = None
    latency: float = 0.0
    noise: Mapping[str, float] = field(default_factory=dict, hash=False)
    dropout: float = 0.0
    occlusion: bool = False

    def __post_init__(self) -> None:
        _ = self.sight
        fix = ""
        if isinstance(self.ads, Perception):
            fix = "give all that is imperfect to one Perception"
        elif is_vehicle_class(self.ads):
            fix = DRIVES_ITSELF
        elif not callable(self.ads):
            fix = "give a function or class that makes one, such as `pafot.Perception(MyPlanner, latency=0.3)`"
        if fix:
            expected = "the factory of an ADS, called for each scenario"
            raise AdsFactoryError(f"ads: expected {expected}, received {shown(self.ads)}; {fix}")

    @property
    def sight(self) -> Sight:
        """How its ADS sees."""
        return Sight(
            range=self.range,
            latency=self.latency,
            noise=self.noise,
            dropout=self.dropout,
            occlusion=self.occlusion,
        )

    def seeing(self, sight: Sight) -> Perception:
        """The same factory with another sight."""
        return replace(self, **{each.name: getattr(sight, each.name) for each in fields(sight)})

    @property
    def __wrapped__(self) -> AdsFactory:
        """Whose signature is the factory's."""
        return self.ads

    def __call__(self, *observations: Any, **arguments: Any) -> Any:
        """A fresh ADS that sees so.

        Raises:
            AdsFactoryError: where it is called with an observation, as an ADS is; where the factory cannot be called,
                or gives nothing that drives, or a vehicle class.
        """
        if observations:
            raise AdsFactoryError(
                "ads: expected pafot.Perception as the factory, received one in the place of an ADS, given an "
                "observation; write `ads=pafot.Perception(MyPlanner, ...)`, or return that from the fixture"
            )
        ads = make_ads(self.ads, **arguments)
        if is_vehicle_class(ads):
            raise AdsFactoryError(f"ads: expected a callable in a Perception, received {shown(ads)}; {DRIVES_ITSELF}")
        return SeeingAds(ads, self.sight)


def sight_of(factory: Any) -> Sight | None:
    """How the ADSs of a factory see; None where that is perfect."""
    factory = inspect.unwrap(factory, stop=lambda each: isinstance(each, Perception))
    sight = factory.sight if isinstance(factory, Perception) else None
    return sight if sight is not None and sight.imperfections else None


def ads_and_sight(ads: Any) -> tuple[Any, Sight | None]:
    """An ADS that is shown observations, and how it sees; None where all is as it is."""
    return (ads.ads, ads.sight) if isinstance(ads, SeeingAds) else (ads, None)
