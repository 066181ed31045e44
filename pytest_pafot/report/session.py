"""The record of a pytest session: items add events, and all reports are written from these.

Every session has a record, so this module imports little and defines no dataclass.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pytest_pafot.support.errors import rerun

if TYPE_CHECKING:
    from pytest_pafot.findings.sighting import Seen
    from pytest_pafot.searches.events import Note, Progress, Search

    Event = Progress | Search | Seen | Note

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

    def add(self, event: Event, item: str = "", view: str = "") -> None:
        """Add an event from an item. ``view`` is a finding's data for the page, as JSON."""
        from pytest_pafot.findings.sighting import Seen  # noqa: PLC0415
        from pytest_pafot.searches.events import Note, Search  # noqa: PLC0415

        match event:
            case Search():
                self.searches.pop(event.node_id, None)
                self.searches[event.node_id] = replace(
                    event, finds=tuple(map(self._with_alike, event.finds))
                )
            case Seen():
                earlier = self.seen.pop(event.node_id, None)
                # If the session also replays the new file of a search, the replay must not hide that it is unshrunk.
                left = "" if earlier is None or event.observed.new else earlier.unshrunk
                self.seen[event.node_id] = replace(event, unshrunk=left) if left else event
                self.items[event.node_id] = item
                if view:
                    self.views[event.node_id] = zlib.compress(view.encode(), level=1)
            case Note(kind="incomparable"):
                self.incomparable[event.text] = None
            case Note():
                texts = self.warnings if event.kind == "warning" else self.notes
                texts.extend([event.text] if event.text not in texts else [])

    def _with_alike(self, find: Seen) -> Seen:
        # A search counts the runs that failed like its finding, so the number is known only at its end.
        known = self.seen.get(find.node_id)
        if known is not None and known.observed.new:
            find = self.seen[find.node_id] = replace(known, alike=find.alike)
        return find

    def add_failure(
        self, node_id: str, phase: str, text: str, reason: str, *, saved: Mapping[str, str] | None
    ) -> None:
        """Add an item's failure, even if its search or replay could not start.

        ``saved`` has the id, file and test of a replayed scenario. It is None for a search.
        """
        from pytest_pafot.searches.events import Search  # noqa: PLC0415

        self.failures[node_id, phase] = text
        self.reasons.setdefault(node_id, reason)
        if saved is not None and node_id not in self.seen:
            again = rerun(
                ["python", "-m", "pytest", *self.options, saved["file"]],
                os.environ,
                saved=saved["id"],
            )
            self.unread.setdefault(node_id, {**saved, "replay": again})
        elif saved is None and node_id not in self.seen:
            self.searches.setdefault(node_id, Search(node_id=node_id))

    @property
    def ended(self) -> list[Search]:
        """The searches that have reported their end, in the order in which they reported it."""
        return [each for each in self.searches.values() if each.reason]

    @property
    def running(self) -> list[str]:
        """The node ids of searches that have not reported their end."""
        return [
            node_id
            for node_id, each in self.searches.items()
            if not each.reason and each.seed is not None
        ]

    @property
    def is_driven(self) -> bool:
        """True if a search started, or a saved scenario was replayed."""
        return bool(self.ended or self.running or self.seen)

    @property
    def findings(self) -> dict[str, Seen]:
        """The findings by node id. A replay includes the result of its test's search."""
        from pytest_pafot.searches.events import by_test, concluded  # noqa: PLC0415

        searches = by_test(self.ended)
        return {node_id: concluded(each, searches) for node_id, each in self.seen.items()}

    @property
    def replays(self) -> list[Seen]:
        """The replays, in the order in which they ended."""
        return [each for each in self.findings.values() if not each.observed.new]

    @property
    def finds(self) -> list[Seen]:
        """The new findings of all searches that ended."""
        return [find for search in self.ended for find in search.finds]

    @property
    def red(self) -> list[Seen]:
        """The failures that make a session fail."""
        return [
            *self.finds,
            *(each for each in self.replays if each.headline and each.label != "accepted"),
        ]

    def command(self, seen: Seen, *words: str, name: str = "") -> str:
        """Return the command that runs a finding again, or its search if the finding was not saved."""
        if seen.path:
            return rerun([*words, *self.options, name or seen.path], os.environ, saved=seen.id)
        item = self.items.get(seen.node_id, "")
        search = self.searches.get(item)
        return rerun(
            [*words, item], os.environ, *("" if search is None else search.options).split()
        )

    @contextmanager
    def faults(self, work: str) -> Iterator[None]:
        """Record an error in this context as a problem. If raised, it would make pytest lose all failures."""
        try:
            yield
        # An interrupt ends only the work in this context, since the session is ending anyway.
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the summary reports any of them)
            self.problems.append(f"{work}: {type(error).__name__}: {error}")
