"""What is run: scenarios in a world, with an ADS, and on whose behalf."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Everything that a run of any scenario needs, in this process or in another one.

    Attributes:
        world: with ``rollout``.
        ads: the factory, called once for each run.
        records: folder of the crash records.
        owner: of the crash records, the node id of a test.
        world_data: the world as plain data, for the crash records.
    """

    world: Any
    ads: Callable[..., Any]
    records: Path
    owner: str
    world_data: Mapping[str, Any] | None = None

    def rollout(
        self, scenario: Scenario, ads: Callable[..., Any] | None = None, decisions: Sequence[Any] = ()
    ) -> Trace:
        """Run a scenario in this process, now.

        Args:
            scenario: to run.
            ads: a factory in the place of the job's.
            decisions: the first ones of the run, which the ADS is not asked for.

        Raises:
            Exception: what the world or the factory raises; what the ADS raises is in the trace.
        """
        __tracebackhide__ = True
        given = {"decisions": decisions} if decisions else {}  # a world of the user's own need not know of them
        trace: Trace = self.world.rollout(scenario, ads or self.ads, **given)
        return trace

    def crash_record(self) -> CrashRecord:
        """The record of what the calling process runs; nothing is on disk before its first scenario."""
        return CrashRecord(self.records, self.owner, world=self.world_data)
