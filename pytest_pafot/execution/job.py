"""What is run: scenarios in a world, with an ADS, and on whose behalf."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pytest_pafot.execution.crash_records import CrashRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Everything that a run of any scenario needs, in this process or in another one.

    The folder ``records``, the ``owner``, a node id, and ``world_data``, the world as plain data, are for the crash
    records.
    """

    world: Any
    ads: Callable[..., Any]
    """The factory, called once for each run."""
    records: Path
    owner: str
    world_data: Mapping[str, Any] | None = None

    def crash_record(self) -> CrashRecord:
        """The record of what the calling process runs; nothing is on disk before its first scenario."""
        return CrashRecord(self.records, self.owner, world=self.world_data)
