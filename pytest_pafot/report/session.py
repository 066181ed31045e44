"""The record of a pytest session, from which all reports are written.

Every session has a record, so this module imports little and defines no dataclass. The functions that add events of
items to it are in ``report.terminal``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_pafot.findings.sighting import Seen
    from pytest_pafot.searches.events import Search

# The results of items, the worst last. An item that did not end has an empty result.
RESULTS = ("", "passed", "skipped", "xfailed", "failed", "error")
# What to do about saved scenarios that the session did not replay.
ADVICE = (
    "expected a test that replays each saved scenario. Was the test skipped, renamed, moved or deleted, or do "
    "testpaths, python_files, norecursedirs or a hook exclude it? "
    "If the test was renamed or moved, move the saved files to its folder MODULE/TEST in the corpus, and correct the "
    "node id in the `test:` line of each file. If the test was deleted, delete the files"
)
UNNAMED_ADVICE = (
    "Rename the test, its class or its file so that pytest collects it, or set "
    "__test__ to False in the test or class"
)


class Session:
    """The record of a session."""

    def __init__(self, **known: Any) -> None:
        self.exit: int | None = None  # pytest's exit code; None while the session runs
        self.options: list[str] = []  # options that a replay of this session's files needs, too
        # For each node id of a new or replayed finding: the finding, the item that reported it, and its data for the
        # page, as compressed JSON because each takes half a megabyte.
        self.seen: dict[str, Seen] = {}
        self.items: dict[str, str] = {}
        self.new_files: set[str] = set()  # paths of the files of new findings
        self.views: dict[str, bytes] = {}
        # saved scenarios that could not be read or run
        self.unread: dict[str, Mapping[str, str]] = {}
        # For each node id of an item: the search, in the order in which searches started or ended, the result, and the
        # first line of its failure. For each node id and phase: pytest's full text of the failure.
        self.searches: dict[str, Search] = {}
        self.results: dict[str, str] = {}
        self.reasons: dict[str, str] = {}
        self.failures: dict[tuple[str, str], str] = {}
        # items with a policy that could not be compared with its reference
        self.incomparable: dict[str, None] = {}
        self.unnamed: list[str] = []  # marked tests that pytest did not collect
        # Saved scenarios that the session did not replay, and those for which it fails.
        self.left: list[str] = []
        self.fails: list[str] = []
        self.warnings: list[str] = []  # such as about skipped tests and expired acceptances
        self.notes: list[str] = []
        self.problems: list[str] = []  # errors outside the tests
        self.written: list[str] = []  # about the files that were written
        vars(self).update(known)

    @property
    def ended(self) -> list[Search]:
        """The searches that have reported their end, in the order in which they reported it."""
        return [each for each in self.searches.values() if each.reason]

    @property
    def running(self) -> list[str]:
        """The node ids of searches that have not reported their end."""
        started = (each for each in self.searches.values() if each.seed is not None)
        return [each.node_id for each in started if not each.reason]

    @property
    def is_driven(self) -> bool:
        """True if a search started, or a saved scenario was replayed."""
        return bool(self.ended or self.running or self.seen)

    @property
    def finds(self) -> list[Seen]:
        """The new findings of all searches that ended."""
        return [find for search in self.ended for find in search.finds]

    @contextmanager
    def faults(self, work: str) -> Iterator[None]:
        """Record an error in this context as a problem. If raised, it would make pytest lose all failures."""
        try:
            yield
        # An interrupt ends only the work in this context, since the session is ending anyway.
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the summary reports any of them)
            self.problems.append(f"{work}: {type(error).__name__}: {error}")
