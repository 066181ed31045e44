"""A driver with two independent defects, which a search has to distinguish."""

from __future__ import annotations

from .lane_change import LooksOnlyAhead
from .perception import IgnoresStandingVehicles


class IgnoresStandingAndLooksOnlyAhead(IgnoresStandingVehicles, LooksOnlyAhead):
    """A driver that ignores vehicles slower than 3 m/s, and the follower in the lane that it enters.

    Why it happens: defects do not come alone. The first fails along the lane, the second across it.
    """
