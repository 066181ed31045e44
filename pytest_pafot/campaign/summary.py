"""What is told of a search: where it is, each find that is new, and how it went.

Values that travel between processes as plain data. How they read on a terminal is in ``report.terminal``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

from pytest_pafot.text import ascii_text


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Where a search is.

    Attributes:
        generation: that is in progress, from 1.
        generations: that were asked for.
        failing: runs that the test rejected.
        finds: distinct ones that are new.
        seconds: since the search began.
        phase: what goes on after the generations, such as shrinking; empty while they run.
    """

    node_id: str
    generation: int
    generations: int
    runs: int
    failing: int
    finds: int
    seconds: float
    phase: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Find:
    """A distinct find that is new.

    Attributes:
        node_id: under which it is reported.
        path: of its file, or empty.
        problem: why there is no file, or empty.
        difference: what differed when it was run again, or empty.
        is_timed: it depends on wall-clock time.
        repeats: further runs that failed in the same way.
    """

    id: str
    node_id: str
    headline: str
    path: str = ""
    problem: str = ""
    difference: str = ""
    is_timed: bool = False
    repeats: int = 0

    @property
    def is_flaky(self) -> bool:
        """Whether running it again gave another run."""
        return bool(self.difference)

    @property
    def remark(self) -> str:
        """What a reader must know besides, or nothing."""
        flaky = f"flaky: {self.difference}" if self.is_flaky else ""
        timed = "depends on wall-clock time" if self.is_timed else ""
        return "; ".join(filter(None, [flaky, timed]))

    @property
    def summary(self) -> str:
        """One line on it, with what a reader must know besides."""
        return ascii_text(f"{self.headline} ({self.remark})" if self.remark else self.headline)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSummary:
    """How a search went.

    Attributes:
        profile: that the defaults came from.
        base_seed: that was given, or fresh.
        seed: of this search, derived from the base seed and the node id.
        generations: finished, of ``asked``.
        asked: generations that were asked for.
        reason: why it ended.
        runs: simulated scenarios.
        known_runs: scenarios that were not simulated, since an earlier run showed what they do.
        invalid, npc, rejected, skipped: runs without a judgement, by kind.
        reached: share of Position-Instructions whose cell was reached; None where no run tells.
        no_interaction: runs in which no NPC came near the ego.
        failing: runs that the test rejected.
        finds: distinct ones that are new.
        unsaved: further ones that the limit of saved scenarios left out, with their runs.
        shrink_runs: taken to simplify the finds, beside ``runs``.
        known: failing runs by the id of the saved scenario that covers them.
        notes: anything else to be told once.
        coverage: one line on the Position-Instructions that the runs came to.
    """

    node_id: str
    algorithm: str = "pafot"
    profile: str = ""
    base_seed: int = 0
    seed: int = 0
    generations: int = 0
    asked: int = 0
    reason: str = ""
    seconds: float = 0.0
    runs: int = 0
    known_runs: int = 0
    invalid: int = 0
    npc: int = 0
    rejected: int = 0
    skipped: int = 0
    reached: float | None = None
    no_interaction: int = 0
    failing: int = 0
    finds: tuple[Find, ...] = ()
    unsaved: Mapping[str, int] = field(default_factory=dict)
    shrink_runs: int = 0
    known: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    coverage: str = ""

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of ``dataclasses.asdict``, also where JSON has made lists of tuples."""
        finds = tuple(Find(**find) for find in plain["finds"])
        texts = {name: tuple(plain[name]) for name in ("warnings", "notes")}
        return cls(**{**plain, **texts, "finds": finds})
