"""What every world can do with reference drivers, whatever its own ADSs are."""

from __future__ import annotations

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace


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

    def preventable_by(self, scenario: Scenario) -> tuple[str, ...]:
        """Names of the reference drivers that get through a scenario without a collision."""
        from pytest_pafot.world.reference_drivers import preventable_by  # noqa: PLC0415

        return preventable_by(self, scenario)
