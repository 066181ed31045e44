"""How the NPCs of a scenario drive beside what their instructions ask for: whom they keep their distance to.

An instruction says where an NPC goes and how fast; its traffic says what it does not do on the way there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Literal, get_args

from pytest_pafot.support.errors import FieldError, plain_number

Style = Literal["paper", "hostile", "assertive", "everyday"]
STYLES: tuple[Style, ...] = get_args(Style)

OF_STYLE: Any = None
"""Stands for the value of the style where a part is not given; no number does, so that none is taken for it."""


@dataclass(frozen=True, slots=True, repr=False)
class Traffic:
    """How the NPCs of a scenario drive among others, whatever their instructions ask for.

    In every style but the paper's, NPCs are *attentive*: behind the ego in its lane, an NPC keeps the distance that it
    keeps behind other NPCs. It answers at once where it moved in itself or where the ego has somebody ahead of it. It
    answers a second late where the ego moved in before it, or where the ego brakes with nobody ahead, and that with at
    most 6 m/s^2. It enters the ego's lane only where the ego, or it itself, has the room to adapt its speed.

    Attributes:
        style: ``"paper"``, where NPCs run into the rear of an ego that is slower than their instruction;
            ``"hostile"``, which does all that the ego can still answer; ``"assertive"`` or ``"everyday"``.
        least_speed_share: of the speed limit, or of the ego's speed where that is lower: NPCs drive at least so fast
            where nobody slower is ahead of them. Target speeds are at least that share of the limit.
        least_gap: to the ego, bumper to bumper, at which an NPC moves in ahead of it [m].
        time_gap: the same, as a share of the ego's speed [s].
        braking: hardest braking of an NPC that nobody ahead asks for [m/s^2].
        lateral_speed: highest speed across the road [m/s].

    Parts that are not given are those of the style.

    Raises:
        FieldError: where there is no such style, a part is out of its bounds, or the paper's traffic is given parts.
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
            expected, fix = "no parts beside the style 'paper'", "remove it, or take the style 'hostile'"
            raise FieldError(field=f"traffic.{name}", expected=expected, received=f"{part:g}", fix=fix)

    @property
    def is_attentive(self) -> bool:
        """Whether NPCs answer what the ego does."""
        return self.style != "paper"

    def least_speed(self, speed_limit: float) -> float:
        """Return the lowest target speed on a road with a limit, in the steps of target speeds [m/s]."""
        return math.ceil(10 * self.least_speed_share * speed_limit - 1e-6) / 10

    @property
    def own(self) -> dict[str, float]:
        """The parts that are not those of the style."""
        parts = {name: getattr(self, name) for name in BOUNDS}
        return {name: part for name, part in parts.items() if part != PARTS[self.style][name]}

    def plain(self) -> str | dict[str, Any]:
        """Return the name of the style; where there are parts of its own, a mapping with these."""
        return {"style": self.style, **self.own} if self.own else self.style

    @property
    def described(self) -> str:
        """What a reader is told of it: ``everyday traffic (least_gap 4)``; nothing of the paper's."""
        own = ", ".join(f"{name} {part:g}" for name, part in self.own.items())
        return f"{self.style} traffic{f' ({own})' if own else ''}" if self.is_attentive else ""

    def __repr__(self) -> str:
        return f"Traffic({', '.join([repr(self.style), *(f'{name}={part:g}' for name, part in self.own.items())])})"

    @classmethod
    def of(cls, given: Any) -> Traffic:
        """The inverse of :meth:`plain`; a traffic is taken as it is.

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
"""How much more than its style asks for an NPC leaves that goes to its place ahead of the ego [m]."""

BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "least_speed_share": (0.0, 0.95),
        "least_gap": (0.0, 100.0),
        "time_gap": (0.0, 10.0),
        "braking": (0.5, 100.0),
        "lateral_speed": (0.2, 100.0),
    }
)
"""Smallest and largest value of each part; no NPC can exceed the largest braking and lateral speed."""

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
"""The parts of each style; docs/explanation/traffic.md has the sources of those of everyday driving."""

PAPERS = Traffic("paper")
"""Of a scenario that does not say otherwise."""
