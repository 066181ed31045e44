"""The label of a replay, which follows from what was observed in its runs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal, Self


class Label(StrEnum):
    """The few words in which a session says what became of a finding: how its replay ended, or that it is new.

    Summaries group findings by it, in this order, the most urgent group first. ``group`` is the title of the group.
    """

    group: str

    NEW = "new", "New"
    INTRODUCED = "introduced", "Introduced by the change"
    NO_WORSE = "no worse", "New, but no worse: the reference fails as often, elsewhere"
    ERROR = "error", "Could not be read or run"
    STILL_FAILING = "still failing", "Known, still failing"
    ELSEWHERE = (
        "still failing elsewhere",
        "Still failing elsewhere: the saved scenario passes, the search found the same failure",
    )
    DRIFTED = "drifted", "Drifted: the run differs from the file, so this is no fix"
    # It has the file's collision, and passes because rules of another version excuse the ego.
    JUDGED_OTHERWISE = "judged otherwise", "Judged otherwise, by other rules than when it was saved: this is no fix"
    FLAKY = "flaky", "Flaky"
    COMMON = "common", "Known, and also failing in the reference"
    # Only a group: the replay has another label, and its failure is accepted with ``xfail``.
    ACCEPTED = "accepted", "Accepted for now"
    # Only a result: the label is ``fixed``, and no search confirms it, see :attr:`.Sighting.result`.
    PASSES = "passes", "Pass, and no search of this session looked for the same failure"
    FIXED = "fixed", "Fixed"
    FIXED_BEFORE = "fixed before", "Fixed before"

    def __new__(cls, value: str, group: str) -> Self:
        """Make a label, which is equal to its text."""
        self = str.__new__(cls, value)
        self._value_, self.group = value, group
        return self


PASSING = (Label.FIXED, Label.FIXED_BEFORE, Label.ELSEWHERE)
"""The labels of replays that pass with the situation of the failure."""

RunLabel = Literal[Label.FIXED, Label.STILL_FAILING, Label.DRIFTED, Label.JUDGED_OTHERWISE]
"""What a run says by itself, see :func:`pytest_pafot.findings.finding.replay_label`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """The observations in a replay.

    Attributes:
        shows: what the saved scenario shows, in its own run, or in that of other runs which fails.
        fails: True if it fails, or if its process dies.
        is_elsewhere: True if it was run in another world than the test's, or with another sight.
        is_unsteady: True if its runs differ, other than by the chance that a rate measures.
        is_rare: True if the failure of the file occurs by chance, and so rarely that ten passing runs show no fix.
        is_hit: True if the NPC of the file's collision hits the ego soon after the end of a run that passes.
        is_handled: True if the situation of the file came up, and the ego handled it.
        reference_passes: whether the reference passes the same scenario; None without a reference.
    """

    shows: RunLabel = Label.DRIFTED
    fails: bool = False
    is_elsewhere: bool = False
    is_unsteady: bool = False
    is_rare: bool = False
    is_hit: bool = False
    is_handled: bool = True
    reference_passes: bool | None = None

    @property
    def label(self) -> Label:
        """The label of the replay."""
        if self.is_unsteady:
            return Label.FLAKY
        if self.fails and self.reference_passes is not None:
            return Label.INTRODUCED if self.reference_passes else Label.COMMON
        if self.fails:
            return self.shows
        if self.reference_passes is False and self.is_handled and not self.is_hit:
            # Also elsewhere, and in a run that does not show it: both policies drove the same scenario.
            return Label.FIXED
        if self.shows is Label.FIXED and (self.is_elsewhere or self.is_rare or self.is_hit):
            return Label.DRIFTED
        return Label.FIXED_BEFORE if self.shows is Label.FIXED and self.reference_passes else self.shows
