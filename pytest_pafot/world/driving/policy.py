"""A policy as a value: what the user gives, and all that the package asks about it."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import refused_policy
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads, takes_nothing
from pytest_pafot.world.driving.perception import ads_and_sight, sight_of


@dataclass(frozen=True, slots=True, eq=False)
class Ads:
    """The ADS that a policy has made for one run.

    Attributes:
        given: the ADS itself; it is closed after the run.
        decides: what receives the observations that its sight lets through; or a vehicle class, which needs none.
        sight: its sight; None for perfect sight.
        drives_itself: True if it is a vehicle class, which a factory may also return.
    """

    given: Any
    decides: Any
    sight: Sight | None
    drives_itself: bool

    @property
    def policy(self) -> Any:
        """What decides, if it receives the observations of an environment.

        Raises:
            AdsFactoryError: for an imperfect sight, which only planners in SI units can have.
        """
        if self.sight is not None and self.sight.imperfections:
            received = "a policy for the observations of an environment"
            fix = "give it a wrapper of your own that changes these observations"
            raise refused_policy("a planner in SI units in a pafot.Perception", received, fix)
        return self.decides


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy: the factory of its ADSs, or a vehicle class, and what only these can say about it.

    What they say is asked once, when it is needed.
    """

    factory: AdsFactory

    @cached_property
    def drives_itself(self) -> bool:
        """True for a vehicle class of highway-env, which is no factory: it reads the road and returns no decisions."""
        return is_vehicle_class(self.factory)

    @cached_property
    def simulates(self) -> bool:
        """True if the factory has a parameter ``env``: its ADSs simulate inside the environment."""
        if self.drives_itself or takes_nothing(self.factory):
            return False
        try:
            return "env" in inspect.signature(self.factory).parameters
        except (TypeError, ValueError):  # builtins without a signature
            return False

    @property
    def only_observes(self) -> bool:
        """True if its ADSs decide from observations alone, so that these can be made for any world and at any time."""
        return not (self.drives_itself or self.simulates)

    @cached_property
    def sight(self) -> Sight | None:
        """The sight of its ADSs; None for perfect sight."""
        return sight_of(self.factory)

    @property
    def loading_hint(self) -> str:
        """The factory's note that its policy may need other options for loading; empty if it has none."""
        stated = self._own("loading_hint")
        return stated if isinstance(stated, str) else ""

    def preload(self) -> None:
        """Call the factory's ``preload``, if it has one, so that forked processes share what it loads."""
        load = self._own("preload")
        if load is not None:
            load()

    def check_drives_in(self, world: Any) -> None:
        """Call the factory's ``check_world``, if it has one; its error reports what does not fit the world."""
        check = self._own("check_world")
        if check is not None:
            check(world)

    def make(self, **arguments: Any) -> Ads:
        """Make a fresh ADS, see :func:`make_ads`."""
        given = make_ads(self.factory, **arguments)
        decides, sight = ads_and_sight(given)
        return Ads(given, decides, sight, drives_itself=is_vehicle_class(given))

    def _own(self, name: str) -> Any:
        """Return an attribute of the factory or of the factory that it wraps; None if there is none.

        A class has none, because its attributes belong to its instances, the ADSs.
        """
        inner = inspect.unwrap(self.factory)
        return None if isinstance(inner, type) else getattr(inner, name, None)
