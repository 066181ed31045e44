"""Drivers of free NPCs by the policy of a revision, which decides in the process of that revision."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any

from pytest_pafot import Perception
from pytest_pafot.extending import ProcessLostError
from pytest_pafot.extras.revisions.revision_policy import RevisionPolicy
from pytest_pafot.extras.revisions.revision_process import Served
from pytest_pafot.support.errors import AdsFactoryError, RevisionError


@dataclass(frozen=True, slots=True)
class RevisionDriver:
    """The factory of the drivers of NPCs that are driven by the policy of a revision.

    The policy must decide from observations. Each driver has random generators of its own there, whose seed is drawn
    here, so that it drives alike in each run of a scenario.
    """

    policy: RevisionPolicy

    @property
    def commit(self) -> str:
        """The hash of the commit."""
        return self.policy.commit

    def __call__(self) -> Any:
        """Make a driver in the process of the revision, for one run.

        Raises:
            AdsFactoryError: if the policy does not decide from observations, or cannot be made there.
        """
        try:
            number, sight = self.policy.call(Served.made, random.getrandbits(63))
        except (ProcessLostError, RevisionError) as error:
            why = error.how if isinstance(error, ProcessLostError) else str(error)
            raise AdsFactoryError(f"{self.policy.label}: expected a driver of an NPC, received {why}") from None
        driver = _Driver(self.policy, number)
        return driver if sight is None else Perception(lambda: driver).seeing(sight)()


@dataclass(eq=False, slots=True)
class _Driver:
    """A driver of an NPC, which decides in the process of a revision."""

    policy: RevisionPolicy
    number: int
    is_lost: bool = False

    def __call__(self, observation: Any) -> Any:
        try:
            return self.policy.call(Served.decided, self.number, observation)
        except ProcessLostError as lost:
            self.is_lost = True
            raise RevisionError(
                f"{self.policy.label}: expected a policy that decides, received one whose process {lost.how}"
            ) from None

    def close(self) -> None:
        """Close the policy there, unless its process has ended."""
        if not self.is_lost:
            self.policy.call(Served.ended, self.number)
