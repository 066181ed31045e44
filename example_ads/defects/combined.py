"""A driver with two independent defects, which a search must distinguish."""

from __future__ import annotations

from .lane_change import LooksOnlyAhead
from .perception import IgnoresStandingVehicles


class IgnoresStandingAndLooksOnlyAhead(IgnoresStandingVehicles, LooksOnlyAhead):
    """A driver that ignores vehicles slower than 3 m/s, and the vehicle behind in a lane that it enters.

    Why it happens: defects rarely come alone. The first causes failures along the lane, and the second across lanes.
    """
