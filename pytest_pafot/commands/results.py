"""The results of earlier sessions, as ``--pafot-json`` has written them: data of anybody, so each value is checked."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pytest_pafot.corpus.layout import SEARCH_PART, name_without
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.text import day_of, visible

VERSION = 1
"""The version of the results that are read, ``pafot_json``."""

MOST_BYTES = 100 * 2**20
"""The largest size of a file of results [bytes]."""

MOST_RUNS = 10**12
"""The largest number of runs that a search can have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """The results of one session, or of the shards of one.

    Attributes:
        day, commit: as the session was told by ``--pafot-today`` and ``--pafot-commit``; empty if it was not.
        searches, findings, tests: the entries of its JSON.
        broke_off: True if the session, or a shard of it, did not come to its end: it was killed, interrupted, or ended
            with an exit code of pytest other than 0 and 1.
    """

    day: str = ""
    commit: str = ""
    searches: tuple[Mapping[str, Any], ...] = ()
    findings: tuple[Mapping[str, Any], ...] = ()
    tests: tuple[Mapping[str, Any], ...] = ()
    broke_off: bool = False

    @property
    def name(self) -> str:
        """Day and commit in short."""
        return " ".join(filter(None, [self.day, self.commit[:10]]))

    @property
    def searched(self) -> list[tuple[str, Mapping[str, Any]]]:
        """The searches, each with the node id of its test."""
        return [(name_without(SEARCH_PART, entry["node_id"]), entry) for entry in self.searches]

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the results of a session.

        Raises:
            RequestError: if the file cannot be read or has no results.
        """
        expected = f"{visible(str(path))}: expected the results of a session, from {flag('json')}"
        try:
            if path.exists() and not path.is_file():  # a pipe or a device could go on for ever
                raise RequestError(f"{expected}, received no regular file")
            with path.open("rb") as file:
                content = file.read(MOST_BYTES + 1)
            if len(content) > MOST_BYTES:
                raise RequestError(f"{expected}, received more than {MOST_BYTES // 2**20} MiB")
            data = json.loads(content)
        except (OSError, ValueError, RecursionError) as error:
            why = getattr(error, "strerror", None) or f"{type(error).__name__}"
            raise RequestError(f"{expected}, received {why}") from None
        lists = ("searches", "findings", "tests")
        is_right = isinstance(data, dict) and data.get("pafot_json") == VERSION
        if not is_right or not all(_are_entries(data.get(name, [])) for name in lists):
            raise RequestError(f"{expected}, received other JSON; give a file that this version has written")
        day, commit = (data.get(name) or "" for name in ("day", "commit"))
        if not isinstance(commit, str) or (day and day_of(str(day)) is None):
            raise RequestError(f"{expected}, received day {day!r:.50} and commit {commit!r:.50}")
        broke_off = data.get("exit") not in (0, 1)
        return cls(day=day, commit=commit, broke_off=broke_off, **{name: tuple(data.get(name, ())) for name in lists})

    @classmethod
    def grouped(cls, sessions: Iterable[Self]) -> list[Self]:
        """Sort sessions by day, and join those of the same day and commit, which are shards of one.

        Sessions without a day come first and are not joined. Those of one day keep the order of their commits in what
        is given. A session that is given twice counts once.
        """
        parts: dict[tuple[str, str, int], list[Self]] = {}
        for number, session in enumerate(sessions):
            same = parts.setdefault((session.day, session.commit, 0 if session.day else number), [])
            if session not in same:
                same.append(session)
        joined = [
            cls(
                day=day,
                commit=commit,
                searches=tuple(each for session in same for each in session.searches),
                findings=tuple(each for session in same for each in session.findings),
                tests=tuple(each for session in same for each in session.tests),
                broke_off=any(session.broke_off for session in same),
            )
            for (day, commit, _), same in parts.items()
        ]
        return sorted(joined, key=lambda each: each.day)


def _are_entries(entries: object) -> bool:
    """Return whether the entries of results have the types that are read of them, and numbers that can be counts."""
    counts = ("runs", "random_failing", "random_otherwise", "random_runs")
    types: dict[str, tuple[type, ...]] = {
        **dict.fromkeys(("node_id", "test", "id", "status", "result", "message"), (str,)),
        **dict.fromkeys(("title", "owner", "responsible"), (str,)),
        "requirements": (list,),
        "severity": (dict, type(None)),
        "file": (str, type(None)),
        "finds": (list,),
    }
    return isinstance(entries, list) and all(
        isinstance(entry, dict)
        and isinstance(entry.get("node_id"), str)
        and all(isinstance(entry[name], kinds) for name, kinds in types.items() if name in entry)
        and all(isinstance(id_, str) for id_ in entry.get("requirements", ()))
        and all(type(entry.get(name, 0)) is int and 0 <= entry.get(name, 0) <= MOST_RUNS for name in counts)
        and entry.get("random_failing", 0) + entry.get("random_otherwise", 0) <= entry.get("random_runs", 0)
        for entry in entries
    )
