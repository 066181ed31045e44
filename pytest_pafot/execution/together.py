"""An ADS with a method ``batch``: the runs of a generation take place at once, in lock step.

As in :mod:`pytest_pafot.execution.prefetch`, the search asks for one run after the other, as it always does, and
gets each from here. Whether the ADS has that method shows in the first run: a factory is called for runs and for
nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any

from pytest_pafot.execution.prefetch import Ahead

if TYPE_CHECKING:
    from pytest_pafot.scenario import Scenario
    from pytest_pafot.trace import Trace


@dataclass(slots=True, kw_only=True)
class LockStep:
    """Gives the runs of one search. To be used in a ``with`` statement.

    Attributes:
        apart: gives them where the ADS decides for one run at a time.
        together: simulates scenarios in lock step.
        is_wanted: whether runs may take place together; None until an ADS was seen.
    """

    apart: Ahead
    together: Callable[[Sequence[Scenario]], list[Trace]]
    is_wanted: bool | None = None
    _coming: list[Scenario] = field(default_factory=list, init=False)
    _made: dict[Scenario, Trace] = field(default_factory=dict, init=False)
    _given: Trace | None = field(default=None, init=False)

    @property
    def notes(self) -> list[str]:
        """To be told once."""
        if not self.is_wanted or self.apart.size == 1:
            return self.apart.notes
        why = "since the ADS decides for many runs at once, by its `batch`"
        return [*self.apart.notes, f"--pafot-workers={self.apart.size}: not in use, {why}"]

    def __enter__(self) -> LockStep:
        self.apart.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.foresee(())
        self.apart.__exit__(kind, value, traceback)

    def foresee(self, scenarios: Sequence[Scenario]) -> None:
        """Know what will be asked for; of what was made before, nothing is kept."""
        self._coming, self._made = list(scenarios), {}
        if not self.is_wanted:
            self.apart.foresee(scenarios)

    def saw(self, ads: Any) -> None:
        """Learn whether the ADS decides for many runs at once."""
        if self.is_wanted is None:
            self.is_wanted = callable(getattr(ads, "batch", None))
            if self.is_wanted:
                self.apart.foresee(())

    def run(self, scenario: Scenario, here: Callable[[Scenario], Trace]) -> Trace:
        """A run, made with those to come at the first call for one of them, or by itself.

        Raises:
            ProcessLostError: where another process made it, and did not come back.
            Exception: whatever ``here`` or ``together`` raises.
        """
        __tracebackhide__ = True
        if self.is_wanted and scenario in self._coming and len(self._coming) > 1:
            coming, self._coming = self._coming, []
            self._made = dict(zip(coming, self.together(coming), strict=True))
        self._given = self._made.pop(scenario, None)
        if self._given is not None:
            return self._given
        if scenario in self._coming:
            self._coming.remove(scenario)
        return self.apart.run(scenario, here)

    def was_together(self, trace: Trace) -> bool:
        """Whether the last run took place together with others."""
        return trace is self._given


def noted(factory: Callable[..., Any], see: Callable[[Any], None]) -> Callable[..., Any]:
    """The same factory, whose ADSs are shown to somebody.

    A vehicle class is told by itself and makes no ADS: it stays as it is.
    """
    from pytest_pafot.world.driving.ads import is_vehicle_class  # noqa: PLC0415

    if is_vehicle_class(factory):
        return factory

    def make(*arguments: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        ads = factory(*arguments, **named)
        see(ads)
        return ads

    make.__wrapped__ = factory  # type: ignore[attr-defined]  # signatures are looked up there
    return make
