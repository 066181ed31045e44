"""The record of a session of pytest, which its items fill by events. All that a session says is written from it.

This module imports little and makes no dataclass, because every session has a record.
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
    from pytest_pafot.campaign.events import Note, Progress, Search
    from pytest_pafot.findings.sighting import Seen

    Event = Progress | Search | Seen | Note

RESULTS = ("", "passed", "skipped", "xfailed", "failed", "error")
"""The results that an item can have, the worst last. The empty result is for an item that never ended."""
ADVICE = (
    "expected an item that replays each of them; was its test skipped, renamed, moved or deleted, or left out by "
    "testpaths, python_files, norecursedirs or a hook? "
    "If the test has another name or place now, move the files to its folder MODULE/TEST in the corpus, and name it in "
    "their line `test:`; else delete them"
)
"""What the user can do about saved scenarios that were left out."""
WHY_UNNAMED = (
    "pytest collects no test of it; give it the name of a test, in a file and a class that pytest collects, or set its "
    "__test__ to False"
)


class Session:
    """The record of a session.

    Attributes:
        exit: pytest's exit code; None while the session runs.
        seen: what is known now of each finding, new or replayed, by node id.
        items: the node id of the item that reported it, likewise.
        views: the view of it for the page as JSON, likewise; compressed, as each takes half a megabyte.
        unread: the entries of saved scenarios that could not be read or run, by node id.
        searches: by the node ids of their items, in the order in which they started or ended.
        results: of items that have one.
        reasons: why items failed: the line of the short summary, or the first line of the text.
        failures: the texts that pytest shows for failed items, by node id and phase.
        incomparable: node ids of items whose policy could not be compared with its reference.
        unnamed: marked tests that pytest did not collect.
        left, fails: the saved scenarios of the project that the session left out, as reports name them, and those of
            them by which it fails.
        warnings, notes, problems: on saved scenarios; remarks; and what went wrong outside the tests.
        written: the files that were written.
    """

    def __init__(self, **known: Any) -> None:
        self.exit: int | None = None
        self.seen: dict[str, Seen] = {}
        self.items: dict[str, str] = {}
        self.views: dict[str, bytes] = {}
        self.unread: dict[str, Mapping[str, str]] = {}
        self.searches: dict[str, Search] = {}
        self.results: dict[str, str] = {}
        self.reasons: dict[str, str] = {}
        self.failures: dict[tuple[str, str], str] = {}
        self.incomparable: dict[str, None] = {}
        self.unnamed: list[str] = []
        self.left: list[str] = []
        self.fails: list[str] = []
        self.warnings: list[str] = []
        self.notes: list[str] = []
        self.problems: list[str] = []
        self.written: list[str] = []
        vars(self).update(known)

    def add(self, event: Event, item: str = "", view: str = "") -> None:
        """Take an event of an item; ``view`` is that of a finding for the page, as JSON."""
        from pytest_pafot.campaign.events import Note, Search  # noqa: PLC0415
        from pytest_pafot.findings.sighting import Seen  # noqa: PLC0415

        match event:
            case Search():
                self.searches.pop(event.node_id, None)
                self.searches[event.node_id] = replace(event, finds=tuple(map(self._with_alike, event.finds)))
            case Seen():
                earlier = self.seen.pop(event.node_id, None)
                # A search whose new file this session replays as well may have left it unshrunk.
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
        """Return a finding of a search that has ended, which has counted the runs that failed like it."""
        known = self.seen.get(find.node_id)
        if known is not None and known.observed.new:
            find = self.seen[find.node_id] = replace(known, alike=find.alike)
        return find

    def add_failure(self, node_id: str, phase: str, text: str, reason: str, *, saved: Mapping[str, str] | None) -> None:
        """Take the failure of an item, of which a search or a replay says nothing if it could not begin.

        ``saved`` are the id, the file and the test of the saved scenario that the item replays; None for a search.
        """
        from pytest_pafot.campaign.events import Search  # noqa: PLC0415

        self.failures[node_id, phase] = text
        self.reasons.setdefault(node_id, reason)
        if saved is not None and node_id not in self.seen:
            again = rerun(["python", "-m", "pytest", saved["file"]], os.environ, saved=saved["id"])
            self.unread.setdefault(node_id, {**saved, "replay": again})
        elif saved is None and node_id not in self.seen:
            self.searches.setdefault(node_id, Search(node_id=node_id))

    @property
    def ended(self) -> list[Search]:
        """The searches that ended and reported their end, in that order."""
        return [each for each in self.searches.values() if each.reason]

    @property
    def running(self) -> list[str]:
        """The node ids of searches that started and have not reported their end."""
        return [node_id for node_id, each in self.searches.items() if not each.reason and each.seed is not None]

    @property
    def is_driven(self) -> bool:
        """True if a search has started, or a saved scenario was replayed."""
        return bool(self.ended or self.running or self.seen)

    @property
    def findings(self) -> dict[str, Seen]:
        """The findings by node id, replays with what the searches of their tests say about them."""
        from pytest_pafot.campaign.events import by_test, concluded  # noqa: PLC0415

        searches = by_test(self.ended)
        return {node_id: concluded(each, searches) for node_id, each in self.seen.items()}

    @property
    def replays(self) -> list[Seen]:
        """The replays among these, in the order in which they ended."""
        return [each for each in self.findings.values() if not each.observed.new]

    @property
    def finds(self) -> list[Seen]:
        """The new findings of all searches that have ended."""
        return [find for search in self.ended for find in search.finds]

    @property
    def red(self) -> list[Seen]:
        """The failures that make a session fail: new findings, and replays whose failure is not accepted."""
        return [*self.finds, *(each for each in self.replays if each.headline and each.label != "accepted")]

    def command(self, seen: Seen, *words: str, name: str = "") -> str:
        """Return the command ``words`` with which a finding is run again: its file, or the item ``name`` of it.

        A finding without a file can only be found again by its search.
        """
        if seen.path:
            return rerun([*words, name or seen.path], os.environ, saved=seen.id)
        item = self.items.get(seen.node_id, "")
        search = self.searches.get(item)
        return rerun([*words, item], os.environ, *("" if search is None else search.options).split())

    @contextmanager
    def faults(self, work: str) -> Iterator[None]:
        """Report an error in this context as a problem; at the end of a session, pytest would lose all failures by it.

        ``work`` names in a few words what is done in the context. An interrupt ends only that, since the session is
        ending anyway.
        """
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (whatever it is, the summary says so)
            self.problems.append(f"{work}: {type(error).__name__}: {error}")
