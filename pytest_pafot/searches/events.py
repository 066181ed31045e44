"""The events of a search, other than those of its algorithm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Literal, NamedTuple, TypeVar

from pytest_pafot.algorithms.evaluation import Event
from pytest_pafot.corpus.layout import SEARCH_PART, name_without
from pytest_pafot.findings.sighting import FoundElsewhere, NotFound, Seen
from pytest_pafot.findings.verdict import Signature
from pytest_pafot.support.errors import flag
from pytest_pafot.support.proportions import hits_more
from pytest_pafot.support.text import plural

# Reports of a search: its progress, each new finding, and its summary. They are sent between processes as
# JSON-compatible data, and printed by `report.terminal`.


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """The progress of a search, for a line in the terminal."""

    node_id: str
    generation: int  # the generation in progress, from 1
    generations: int | None  # requested generations; None if only the number of runs is limited
    runs: int
    failing: int  # runs in which the test failed
    finds: int  # distinct new findings
    seconds: float  # since the search started
    budget: int | None = None  # requested runs
    # the estimated time of the remaining runs, without confirmations [s]; 0 if unknown
    left: float = 0.0
    decision_seconds: float = 0.0  # the mean time of a decision [s]; 0 if unknown
    is_limited: bool = False  # whether the search has a time limit
    phase: str = ""  # the work after the runs, such as shrinking; empty before it
    of: str = ""  # the id of the finding to which this work applies


# The kinds of verdicts on runs that say nothing about the policy.
UNTESTED = ("invalid", "rejected", "skipped")
KINDS = ("passed", "failed", "npc", "common", *UNTESTED)  # all kinds of verdicts


class Ending(StrEnum):
    """The reason why a search ended."""

    # the search did not start, its process died, or a decision of the ADS could not be interrupted
    UNKNOWN = ""
    GENERATIONS = "all generations done"
    RUNS = "all runs done"
    MAX_TIME = flag("max_time")
    FINDINGS = "enough findings"
    REPLAYS = "replay only"
    INTERRUPTED = "interrupted"
    ERROR = "error"

    @property
    def is_complete(self) -> bool:
        """True if the search completed all requested runs."""
        return self in (Ending.GENERATIONS, Ending.RUNS)

    @property
    def is_broken_off(self) -> bool:
        """True if an interrupt or an error ended the search."""
        return self in (Ending.INTERRUPTED, Ending.ERROR)

    @property
    def after_ended(self) -> str:
        if self is Ending.UNKNOWN:
            return "early"
        if self is Ending.ERROR:
            return "with an error"
        return str(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Paired:
    """The counts of random scenarios that both the policy and its reference ran."""

    runs: int = 0  # number of these scenarios
    only_new: int = 0  # number of scenarios in which only the new policy failed
    only_reference: int = 0  # number of scenarios in which only the reference failed
    most: int  # number of scenarios to run unless the result is clear earlier

    @property
    def is_worse(self) -> bool | None:
        """True if the new policy fails more often than the reference, or None if that is unclear."""
        return hits_more(self.only_new, self.only_reference, is_last=self.runs >= self.most)

    @property
    def is_cut(self) -> bool:
        """True if the time ran out before the result was clear."""
        return self.is_worse is None and self.runs < self.most

    def with_run(self, *, new: bool, old: bool) -> Paired:
        only_new, only_reference = self.only_new + new, self.only_reference + old
        return replace(self, runs=self.runs + 1, only_new=only_new, only_reference=only_reference)

    def __str__(self) -> str:
        # Without it, few scenarios would look like a choice.
        cut = " before the time ran out" if self.is_cut else ""
        new, old = self.only_new or "none", self.only_reference or "none"
        counts = f"{new} failed only with this policy, and {old} only with the reference"
        return f"of {plural(self.runs, 'random scenario')}{cut}, {counts}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """The summary of a search. Without a ``reason``, the search has only started, or could not start.

    Programs read these fields, and `result`, `message`, `runs` and `failing`.

    Attributes:
        node_id: node id of the item, as for a finding.
        reason: why the search ended; empty if it did not start, or if the reason is unknown.
        algorithm: name of the algorithm.
        base_seed, seed: the value of `--pafot-seed` that repeats the search, and the seed of the search.
        generations: number of completed generations.
        asked: the requested numbers of `generations` and `runs`, if any.
        kinds, outcomes, responsibilities: runs by verdict, by how they ended, and by who was responsible. Each adds
            up to all runs. Verdicts are `failed`, `npc` if only an NPC is responsible, `common` if the reference fails,
            too, `invalid`, `rejected`, `skipped`, or `passed`.
        more_runs: additional runs to `shrink` findings and to find the `moment`, and `known` scenarios, which were
            not run again.
        decisions: decisions of the policy in the `search`, to `confirm` findings, to `shrink` them, and for the
            `moment`.
        random: the runs of a random search: all `runs` that are valid and not rejected; `at_fault`, in which the ego
            caused a collision; `otherwise`, other failures; and `checks`, the failed checks among these. Empty for
            other algorithms, after an error, or if the number of findings ended the search.
        no_interaction, reached: number of runs without interaction; fraction of instructions whose target was
            reached, null if unknown.
        finds: ids of the new findings.
        known: number of failing runs with the failure of a saved scenario, by its id.
        failures: the failures that occurred, each with the `id` of a finding, saved or new, and the `signature`.
        drawn: a line about the range of scenarios.
        against: the reference; empty without one.
        paired: `runs`, the number of random scenarios that both policies ran, at most `most`; `only_new` and
            `only_reference`, the numbers of those in which only one policy failed. Null if no comparison was needed.
        no_worse: headlines, by id, of new findings that do not count, because the reference fails as often.
        warnings, notes: warnings about the health of the search, and other notes.
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
    # Only for the terminal, because these values depend on the machine and the number of workers.
    seconds: float = 0.0
    process_notes: tuple[str, ...] = ()  # notes on the processes that were used or died

    @property
    def runs(self) -> int:
        """The number of scenarios that the search simulated."""
        return self.kinds.total()

    @property
    def failing(self) -> int:
        """The number of runs in which the test failed."""
        return self.kinds["failed"]

    @property
    def options(self) -> str:
        """The command-line options that request the same search."""
        seed = {} if self.base_seed is None else {"seed": self.base_seed}
        return " ".join(flag(name, value) for name, value in {**self.asked, **seed}.items())

    @property
    def compared(self) -> str:
        """A line that compares the policy with the reference, or an empty string."""
        if self.paired is None:
            return ""
        if self.paired.is_worse:
            how = f"this policy is worse than {self.against}"
        elif self.finds:
            how = (
                f"random scenarios do not show whether the new policy is worse than {self.against}"
            )
        else:
            how = f"this policy is no worse than {self.against}"
        return f"{how}: {self.paired}"

    @property
    def tested(self) -> int:
        """The number of evaluated runs of a complete search, otherwise 0."""
        untested = sum(self.kinds[kind] for kind in UNTESTED)
        return self.runs - untested if self.reason.is_complete else 0


def by_test(searches: Iterable[Search]) -> dict[str, Search]:
    """Map the node ids of tests to their searches."""
    return {name_without(SEARCH_PART, search.node_id): search for search in searches}


def concluded(replay: Seen, searches: Mapping[str, Search]) -> Seen:
    """Return a replay. If it passes, add the conclusion from its test's search."""
    search = searches.get(replay.test)
    # Only for a replay that passes, the search decides whether the failure is gone.
    if search is None or replay.label != "passes":
        return replay
    for id_, shown in search.failures:
        if shown == replay.finding.signature:
            return replay.with_observed(search=FoundElsewhere(id=id_))
    # A search that ended early says nothing about a failure that it did not find.
    if not search.tested:
        return replay
    drawn = min(search.random["runs"], search.tested)
    return replay.with_observed(search=NotFound(runs=search.tested, drawn=drawn))


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchStarted:
    """The start of a search."""

    node_id: str  # node id of the item
    seed: int  # seed of the search


SearchEvent = SearchStarted | Seen | Progress | Search | Event

# A function that receives the events of a search, one by one in order.
Listener = Callable[[SearchEvent], None]


class Phase(NamedTuple):
    """A step in the work that follows a search's runs."""

    text: str
    of: str = ""  # the id of the finding to which the work applies


@dataclass(frozen=True, slots=True)
class Note:
    """A note for the end of the session."""

    text: str  # if `incomparable`, the node id of an item with a policy that cannot be compared
    kind: Literal["note", "warning", "incomparable"] = "note"


ResultT = TypeVar("ResultT")

# A step of the work after the runs of a search. It yields updated findings and reports, and returns a result.
Refining = Generator[SearchEvent | Phase | Note, None, ResultT]
