"""Driving styles: how the NPCs of a scenario drive among others while they follow their instructions.

An instruction says where an NPC goes and how fast. The driving style limits what the NPC does on the way there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Literal, get_args

from pytest_pafot.support.errors import FieldError, plain_number
from pytest_pafot.support.shown import Pasteable

Style = Literal["paper", "hostile", "assertive", "everyday"]
STYLES: tuple[Style, ...] = get_args(Style)

_MANNERS: Mapping[str, str] = MappingProxyType(
    {
        "hostile": "NPCs may stop, brake hard and cut in close",
        "assertive": "hard but ordinary driving",
        "everyday": "as most drivers drive",
    }
)
"""What a reader of a report needs to know of each style."""

OF_STYLE: Any = None
"""The default of each numeric field of ``Traffic``: the field then has the value of its style. It is not a number, so
no given number can be mistaken for it."""


@dataclass(frozen=True, slots=True, repr=False)
class Traffic(Pasteable):
    """The driving style of a scenario's NPCs, and the limits that it sets whatever their instructions say.

    In every style except the paper's, NPCs are *attentive*: behind the ego in its lane, an NPC keeps the same distance
    as behind other NPCs. The NPC responds at once if it moved in itself or if there is a vehicle ahead of the ego. If
    the ego moved in ahead of the NPC, or brakes with nothing ahead, the NPC responds a second later and with at most
    6 m/s^2. An NPC enters the ego's lane only if the ego, or the NPC itself, has room to adapt its speed.

    Attributes:
        style: ``"paper"``: NPCs run into the rear of an ego that is slower than their instruction. ``"hostile"``: they
            do all that the ego can still respond to. The others set milder limits.
        least_speed_share: lowest speed of an NPC that nothing ahead slows down, as a share of speed limit or ego's
            speed, whichever is lower. Target speeds of a search are at least this share of the limit.
        least_gap: smallest gap to the ego, bumper to bumper, at which an NPC moves in ahead of it [m].
        time_gap: the same, as a time at the ego's speed [s].
        braking: hardest braking of an NPC if nothing ahead requires more [m/s^2].
        lateral_speed: highest speed of an NPC across the road [m/s].

    A field that is not given has the value of the style.

    Raises:
        FieldError: if the style is unknown, a field is out of its bounds, or another field is given with ``"paper"``.
    """

    style: Style = "hostile"
    least_speed_share: float = OF_STYLE
    least_gap: float = OF_STYLE
    time_gap: float = OF_STYLE
    braking: float = OF_STYLE
    lateral_speed: float = OF_STYLE

    def __post_init__(self) -> None:
        if not isinstance(self.style, str) or self.style not in STYLES:
            expected = f"one of {', '.join(STYLES)}"
            raise FieldError(field="traffic.style", expected=expected, received=f"{self.style!r:.100}")
        object.__setattr__(self, "style", str(self.style))
        for name, (low, high) in BOUNDS.items():
            given = getattr(self, name)
            number = PARTS[self.style][name] if given is OF_STYLE else plain_number(given)
            if number is None or not low <= number <= high:
                expected = f"a number from {low:g} to {high:g}"
                raise FieldError(field=f"traffic.{name}", expected=expected, received=f"{given!r:.100}")
            object.__setattr__(self, name, number + 0.0)
        if self.own and not self.is_attentive:
            name, part = next(iter(self.own.items()))
            expected, fix = "no parts with the style 'paper'", "remove it, or use the style 'hostile'"
            raise FieldError(field=f"traffic.{name}", expected=expected, received=f"{part:g}", fix=fix)

    @property
    def is_attentive(self) -> bool:
        """True if NPCs respond to what the ego does."""
        return self.style != "paper"

    def least_speed(self, speed_limit: float) -> float:
        """Return the NPCs' lowest target speed for a speed limit [m/s], rounded up to a multiple of 0.1 m/s."""
        return math.ceil(10 * self.least_speed_share * speed_limit - 1e-6) / 10

    @property
    def own(self) -> dict[str, float]:
        """The fields whose values differ from those of the style, with their values."""
        parts = {name: getattr(self, name) for name in BOUNDS}
        return {name: part for name, part in parts.items() if part != PARTS[self.style][name]}

    def plain(self) -> str | dict[str, Any]:
        """Return the name of the style, or a mapping with the fields too if some differ from the style's."""
        return {"style": self.style, **self.own} if self.own else self.style

    @property
    def described(self) -> str:
        """A description for a reader, such as ``everyday traffic (as most drivers drive)``; empty for ``"paper"``."""
        own = ", ".join([_MANNERS.get(self.style, ""), *(f"{name} {part:g}" for name, part in self.own.items())])
        return f"{self.style} traffic ({own})" if self.is_attentive else ""

    def __repr__(self) -> str:
        return f"Traffic({', '.join([repr(self.style), *(f'{name}={part!r}' for name, part in self.own.items())])})"

    @classmethod
    def of(cls, given: Any) -> Traffic:
        """Return the ``Traffic`` for a style's name or a mapping of fields; a ``Traffic`` is returned unchanged.

        It is the inverse of :meth:`plain`.

        Raises:
            FieldError: for anything else.
        """
        if isinstance(given, Traffic):
            return given
        if isinstance(given, str):
            return cls(given)  # type: ignore[arg-type]
        if isinstance(given, Mapping) and set(given) <= {each.name for each in fields(cls)}:
            return cls(**given)
        expected = f"one of {', '.join(STYLES)}, or pafot.Traffic(style=..., least_gap=...)"
        raise FieldError(field="traffic", expected=expected, received=f"{given!r:.100}")


AMPLE = 1.0
"""The gap that an NPC adds to the smallest gap of its style when it drives to a place ahead of the ego [m]."""

BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "least_speed_share": (0.0, 0.95),
        "least_gap": (0.0, 100.0),
        "time_gap": (0.0, 10.0),
        "braking": (0.5, 100.0),
        "lateral_speed": (0.2, 100.0),
    }
)
"""Smallest and largest value of each field of ``Traffic``. No NPC can exceed the largest braking and lateral speed, so
these values mean no limit."""

UNBOUND = {"least_speed_share": 0.0, "least_gap": 0.0, "time_gap": 0.0, "braking": 100.0, "lateral_speed": 100.0}

PARTS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "paper": UNBOUND,
        "hostile": UNBOUND,
        "assertive": {
            "least_speed_share": 0.5,
            "least_gap": 6.0,
            "time_gap": 0.3,
            "braking": 3.5,
            "lateral_speed": 1.8,
        },
        "everyday": {
            "least_speed_share": 0.75,
            "least_gap": 11.0,
            "time_gap": 0.5,
            "braking": 2.0,
            "lateral_speed": 1.5,
        },
    }
)
"""The field values of each style; docs/explanation/traffic.md has the sources of the values for everyday driving."""

PAPERS = Traffic("paper")
"""The traffic of the paper's NPCs, which a scenario has unless it specifies a different one."""
