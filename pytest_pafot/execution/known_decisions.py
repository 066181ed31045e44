"""An ADS with ``pure = True``: in runs that begin alike it is asked once for what it decides there.

Physics is stepped as always, so that a trace is the same to the last bit. Whether the ADS is declared so shows in the
first run, as for ``batch``: a factory is called for runs and for nothing else. The declaration is a promise of the
user's; what counts, a confirmation or the last run after shrinking, asks the ADS for everything.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from pytest_pafot.searching.decision_cache import DecisionCache

if TYPE_CHECKING:
    from pytest_pafot.scenario import Scenario
    from pytest_pafot.trace import Trace


@dataclass(slots=True, kw_only=True)
class KnownDecisions:
    """The decisions that one search need not ask for.

    Attributes:
        is_wanted: whether decisions may be taken from earlier runs; None until an ADS was seen.
    """

    is_wanted: bool | None = None
    _prefixes: DecisionCache = field(default_factory=DecisionCache, init=False)

    def saw(self, ads: Any) -> None:
        """Learn whether the ADS is declared pure."""
        if self.is_wanted is None:
            self.is_wanted = getattr(ads, "pure", False) is True

    def decisions(self, scenario: Scenario) -> tuple[Any, ...]:
        """The first ones in a run of the scenario, as far as they are known."""
        return self._prefixes.recall(scenario) if self.is_wanted else ()

    def remember(self, trace: Trace) -> None:
        """Learn from a run."""
        if self.is_wanted:
            self._prefixes.remember(trace)


Resuming = KnownDecisions
