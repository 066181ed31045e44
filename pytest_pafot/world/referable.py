"""What every world can do with reference drivers, whatever its own ADSs are."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace

if TYPE_CHECKING:
    from pytest_pafot.world.protocol import FirstDecision


class References:
    """A world in which reference drivers can take the ego's place."""

    def rollout_reference(self, scenario: Scenario, name: str) -> Trace:
        """Simulate a scenario with a reference driver (:mod:`pytest_pafot.world.reference_drivers`) in the ego's place.

        It drives in SI units on this road, decides at every physics tick, and has no foresight.

        Args:
            scenario: to run; checked against this world.
            name: ``"careful-human"``, ``"fuzzy-safety"`` or ``"idm-aeb"``.
        """
        from pytest_pafot.world.reference_drivers import rollout_reference  # noqa: PLC0415

        return rollout_reference(self, scenario, name)

    @property
    def reference_drivers(self) -> tuple[str, ...]:
        """Names of all reference drivers."""
        from pytest_pafot.world.reference_drivers import REFERENCES  # noqa: PLC0415

        return tuple(REFERENCES)

    def preventable_by(self, scenario: Scenario) -> tuple[str, ...]:
        """Names of the reference drivers that get through a scenario without a collision."""
        from pytest_pafot.world.reference_drivers import preventable_by  # noqa: PLC0415

        return preventable_by(self, scenario)

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        """What an ADS is given at its first decision in a scenario; None where the run does not come so far."""
        from pytest_pafot.world.first_decision import first_decision  # noqa: PLC0415

        return first_decision(self, scenario)
