"""The reference of a search: a policy beside the one that is tested, such as the one before a change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pytest_pafot.campaign.request import RequestError
from pytest_pafot.searching.references import referred_to
from pytest_pafot.world.driving.ads import hint_at_object


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """A policy that failures are held against."""

    ads: Callable[..., Any]  # its factory
    name: str  # by which files call it; empty for a factory that no text can refer to

    @property
    def shown(self) -> str:
        """What the summary calls it."""
        return self.name or "the reference"


def reference_of(given: object, fixture: Callable[[str], Callable[..., Any]]) -> Reference | None:
    """The reference that the option ``against`` gives: a factory, its ``module:factory``, or a fixture by its name.

    Raises:
        RequestError: for anything else, or a module or a name that there is not.
    """
    if given is None:
        return None
    if isinstance(given, str) and ":" not in given:
        return Reference(ads=fixture(given), name=given)
    try:
        ads = referred_to(given) if isinstance(given, str) else given
    except ValueError as error:
        raise RequestError(f"against: {error}") from error
    if not callable(ads):
        raise RequestError(
            "against: expected a factory such as `lambda: OldPlanner()`, its module:factory, or the name of a fixture "
            f"that gives it, received {ads!r:.100}. {hint_at_object(ads)}".removesuffix(". ")
        )
    return Reference(ads=ads, name=given if isinstance(given, str) else _name_of(ads))


def _name_of(factory: Callable[..., Any]) -> str:
    name = f"{getattr(factory, '__module__', '')}:{getattr(factory, '__qualname__', '')}"
    try:
        return name if referred_to(name) is factory else ""
    except ValueError:
        return ""
