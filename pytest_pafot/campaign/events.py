"""The events of a search that its algorithm does not emit; its own are in :mod:`pytest_pafot.searching.evaluation`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal, NamedTuple, TypeVar

from pytest_pafot.corpus.layout import SEARCH_PART, name_without
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import Signature
from pytest_pafot.searching.evaluation import Event
from pytest_pafot.support.errors import flag
from pytest_pafot.support.proportions import hits_more
from pytest_pafot.support.text import plural

# Reports of a search: its progress, each new finding, and its summary.
#
# These values are sent between processes as plain data. ``report.terminal`` turns them into text.


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """The progress of a search, for a line on the terminal."""

    node_id: str
    generation: int  # the generation in progress, from 1
    generations: int | None  # requested generations; None if the number of runs decides
    runs: int
    failing: int  # runs in which the test failed
    finds: int  # distinct new findings
    seconds: float  # since the search began
    budget: int | None = None  # requested runs
    left: float = 0.0  # the time that the runs take that are left, without what confirms findings [s]; 0 if unknown
    decision_seconds: float = 0.0  # the mean time of a decision in these runs; 0 if unknown
    is_limited: bool = False  # whether a limit of time ends the search
    phase: str = ""  # the work after the generations, such as shrinking; empty while they run
    of: str = ""  # the id of the finding that this work is about


UNTESTED = ("invalid", "rejected", "skipped")
"""The kinds of verdicts on runs that say nothing about the policy."""
KINDS = ("passed", "failed", "npc", "common", *UNTESTED)
"""All kinds of verdicts."""


class Ending(StrEnum):
    """The reason why a search ended, as summaries and results name it."""

    UNKNOWN = ""  # it did not begin, its process died, or a decision of the ADS could not be interrupted
    GENERATIONS = "all generations done"
    RUNS = "all runs done"
    MAX_TIME = flag("max_time")
    FINDINGS = "enough findings"
    REPLAYS = "replay only"
    INTERRUPTED = "interrupted"
    ERROR = "error"

    @property
    def is_complete(self) -> bool:
        """True if the search made all runs for which it was asked."""
        return self in (Ending.GENERATIONS, Ending.RUNS)

    @property
    def is_broken_off(self) -> bool:
        """True if something other than a limit ended the search."""
        return self in (Ending.INTERRUPTED, Ending.ERROR)

    @property
    def after_ended(self) -> str:
        """The words that follow "ended" on a page."""
        return "early" if self is Ending.UNKNOWN else "with an error" if self is Ending.ERROR else str(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Paired:
    """The random scenarios that a policy and its reference both drove.

    Attributes:
        runs: the number of these scenarios.
        only_new: the number of those in which only the new policy failed.
        only_reference: the number of those in which only the reference failed.
        most: the number that was to be driven if it did not become clear before.
    """

    runs: int = 0
    only_new: int = 0
    only_reference: int = 0
    most: int

    @property
    def is_worse(self) -> bool | None:
        """True if the new policy fails more often; None if these scenarios do not tell."""
        return hits_more(self.only_new, self.only_reference, is_last=self.runs >= self.most)

    @property
    def is_cut(self) -> bool:
        """True if the time was over before it was clear."""
        return self.is_worse is None and self.runs < self.most

    def with_run(self, *, new: bool, old: bool) -> Paired:
        """Return the counts with one more scenario, in which only the new policy failed, or only the old one."""
        only_new, only_reference = self.only_new + new, self.only_reference + old
        return replace(self, runs=self.runs + 1, only_new=only_new, only_reference=only_reference)

    def __str__(self) -> str:
        cut = ", where the time was over" if self.is_cut else ""
        counts = f"{self.only_new} fail only now, {self.only_reference} only before"
        return f"of {plural(self.runs, 'random scenario')}{cut}, {counts}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """A search. Without a reason for its end it has only started, or could not start because its item failed.

    Programs read what is described here, and `result`, `message`, `runs` and `failing`; the terminal also the last two
    fields.

    Attributes:
        node_id: of its item, as for a finding.
        reason: [Why it ended](items.md#why-a-search-ends); empty if it did not begin, or ended early.
        algorithm: its name.
        base_seed, seed: the value of `--pafot-seed` that repeats it, and its own seed.
        generations: their number; one that a limit of time or findings cut is not counted.
        asked: `generations` and `runs` after which it ends, if they were requested.
        kinds, outcomes, responsibilities: runs by the verdict, by how they ended, and by who was responsible; each adds
            up to all runs. Verdicts are as in [the summary](items.md#the-summary-and-the-health-of-a-search): `failed`,
            `npc` if only an NPC is responsible, `common` if the reference fails, too, `invalid`, `rejected`, `skipped`,
            or `passed`.
        more_runs: further runs: to `shrink` findings, to find the `moment`, and `known` scenarios not run again.
        decisions: of the policy: in the `search`, to `confirm` findings, to `shrink` them, and for the `moment`.
        random: random scenarios at the beginning: `at_fault`, failing in a collision by the ego's fault; failing
            `otherwise`; of the latter by `checks`; and all `runs` that are valid and not rejected. Empty if the search
            broke off before they were done.
        no_interaction, reached: runs without interaction; share of instructions that were reached, null if unknown.
        finds: ids of its new findings.
        known: failing runs by id of the saved scenario with their failure.
        failures: the failures that it showed, each with the `id` of a finding, saved or new, and its `signature`.
        drawn: a line on the range of scenarios.
        against: the reference; empty without one.
        paired: `runs`, the number of random scenarios that both drove, at most `most`; `only_new` and `only_reference`,
            in how many only one failed. Null if there was nothing to decide.
        no_worse: headlines by id of new findings that do not count, because the reference fails as often.
        warnings, notes: on its health, and other remarks.
    """

    node_id: str
    reason: Ending = Ending.UNKNOWN
    algorithm: str = ""
    base_seed: int | None = None
    seed: int | None = None
    generations: int = 0
    asked: Mapping[str, int] = field(default_factory=dict)
    kinds: Counter[str] = field(default_factory=Counter)
    outcomes: Counter[str] = field(default_factory=Counter)
    responsibilities: Counter[str] = field(default_factory=Counter)
    more_runs: Counter[str] = field(default_factory=Counter)
    decisions: Counter[str] = field(default_factory=Counter)
    random: Counter[str] = field(default_factory=Counter)
    no_interaction: int = 0
    reached: float | None = None
    finds: tuple[Seen, ...] = ()
    known: Mapping[str, int] = field(default_factory=dict)
    failures: tuple[tuple[str, Signature], ...] = ()
    drawn: str = ""
    against: str = ""
    paired: Paired | None = None
    no_worse: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    # for the terminal alone, because they differ between machines and numbers of workers
    seconds: float = 0.0
    process_notes: tuple[str, ...] = ()  # how many processes were used, and which died

    @property
    def runs(self) -> int:
        """The number of scenarios that were simulated to search."""
        return self.kinds.total()

    @property
    def failing(self) -> int:
        """The number of these runs in which the test failed."""
        return self.kinds["failed"]

    @property
    def options(self) -> str:
        """The command-line options that request the same search."""
        seed = {} if self.base_seed is None else {"seed": self.base_seed}
        return " ".join(flag(name, value) for name, value in {**self.asked, **seed}.items())

    @property
    def compared(self) -> str:
        """The line on what random scenarios say of the policy and its reference; empty if nothing was to be decided."""
        if self.paired is None:
            return ""
        if self.paired.is_worse:
            how = f"worse than {self.against}"
        elif self.finds:
            how = f"random scenarios do not tell {self.against} and the new policy apart"
        else:
            how = f"no worse than {self.against}"
        return f"{how}: {self.paired}"

    @property
    def tested(self) -> int:
        """The number of runs that were judged, if the search ran to its end; otherwise 0."""
        untested = sum(self.kinds[kind] for kind in UNTESTED)
        return self.runs - untested if self.reason.is_complete else 0


def by_test(searches: Iterable[Search]) -> dict[str, Search]:
    """Return searches by the node ids of their tests."""
    return {name_without(SEARCH_PART, search.node_id): search for search in searches}


def concluded(replay: Seen, searches: Mapping[str, Search]) -> Seen:
    """Return a replay with what the search of its test says about it, which another process may have run.

    ``searches`` are the searches of this session by node id of their tests.
    """
    search, now = searches.get(replay.test), replay.observed
    if search is None or replay.label != "passes":
        return replay
    if elsewhere := next((id_ for id_, shown in search.failures if shown == replay.finding.signature), ""):
        return replace(replay, observed=replace(now, elsewhere=elsewhere))
    drawn = min(search.random["runs"], search.tested)
    return replace(replay, observed=replace(now, searched=search.tested, drawn=drawn))


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchStarted:
    """The beginning of a search.

    Attributes:
        node_id: the node id of its item.
        seed: the seed of the search.
    """

    node_id: str
    seed: int


SearchEvent = SearchStarted | Seen | Progress | Search | Event

Listener = Callable[[SearchEvent], None]
"""A function that receives the events of a search, one by one in their order."""


class Phase(NamedTuple):
    """The work that goes on after the runs of a search, and the id of the finding that it is about."""

    text: str
    of: str = ""


@dataclass(frozen=True, slots=True)
class Note:
    """A text for the end of the session; of an item whose policy cannot be compared, its node id."""

    text: str
    kind: Literal["note", "warning", "incomparable"] = "note"


ResultT = TypeVar("ResultT")

Refining = Generator[SearchEvent | Phase | Note, None, ResultT]
"""A part of the work after the runs of a search: it yields what becomes of the findings, and returns a result."""
