"""The label of a replay, which follows from what was observed in its runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FLAKY = "flaky"
"""The label of a replay whose scenario gave different runs."""

COMMON = "common"
"""The label of a replay that fails in the same scenario as the reference."""

NEARBY = "still failing, nearby"
"""The label of a replay that passes while a neighbour of its scenario fails as the file says."""

JUDGED_OTHERWISE: Literal["judged otherwise"] = "judged otherwise"
"""The label of a replay with the file's collision that passes because rules of another version excuse the ego."""

RunLabel = Literal["fixed", "still failing", "drifted", "judged otherwise"]
"""What a run says by itself, see :func:`pytest_pafot.findings.finding.replay_label`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """The observations in a replay.

    Attributes:
        shows: what the saved scenario shows, in its own run, or in that of other runs which fails.
        fails: True if it fails, or if its process dies.
        is_elsewhere: True if it was run in another world than the test's, or with another sight.
        is_unsteady: True if its runs differ, other than by the chance that a rate measures.
        is_as_often: True if a failure that occurs by chance may still occur as often as the file says.
        is_hit: True if the NPC of the file's collision hits the ego soon after the end of a run that passes.
        is_handled: True if the situation of the file came up, and the ego handled it.
        is_nearby: True if it passes, but a neighbour of it fails as the file says.
        reference_passes: whether the reference passes the same scenario; None without a reference.
    """

    shows: RunLabel = "drifted"
    fails: bool = False
    is_elsewhere: bool = False
    is_unsteady: bool = False
    is_as_often: bool = False
    is_hit: bool = False
    is_handled: bool = True
    is_nearby: bool = False
    reference_passes: bool | None = None

    @property
    def label(self) -> str:
        """The label of the replay."""
        if self.is_unsteady:
            return FLAKY
        if self.fails and self.reference_passes is not None:
            return "introduced" if self.reference_passes else COMMON
        if self.fails:
            return self.shows
        if self.is_nearby:
            return NEARBY
        if self.reference_passes is False and self.is_handled and not self.is_hit:
            return "fixed"  # also elsewhere, and in a run that does not show it: both policies drove the same scenario
        if self.shows == "fixed" and (self.is_elsewhere or self.is_as_often or self.is_hit):
            return "drifted"
        return "fixed before" if self.shows == "fixed" and self.reference_passes else self.shows
