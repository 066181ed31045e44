"""The results of earlier sessions, as ``--pafot-json`` has written them: data of anybody, so each value is checked."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.text import day_of, visible

VERSION = 1
"""The version of the results that are read, ``pafot_json``."""

MOST_BYTES = 100 * 2**20
"""The largest size of a file of results [bytes]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """The results of one session, or of the shards of one.

    Attributes:
        day, commit: as the session was told by ``--pafot-today`` and ``--pafot-commit``; empty if it was not.
        findings: the entries of its JSON on findings.
    """

    day: str = ""
    commit: str = ""
    findings: tuple[Mapping[str, Any], ...] = ()

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
        is_right = isinstance(data, dict) and data.get("pafot_json") == VERSION
        if not is_right or not _are_entries(data.get("findings", [])):
            raise RequestError(f"{expected}, received other JSON; give a file that this version has written")
        day, commit = (data.get(name) or "" for name in ("day", "commit"))
        if not isinstance(commit, str) or (day and day_of(str(day)) is None):
            raise RequestError(f"{expected}, received day {day!r:.50} and commit {commit!r:.50}")
        return cls(day=day, commit=commit, findings=tuple(data.get("findings", ())))

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
                findings=tuple(each for session in same for each in session.findings),
            )
            for (day, commit, _), same in parts.items()
        ]
        return sorted(joined, key=lambda each: each.day)


def _are_entries(entries: object) -> bool:
    """Return whether the entries of results have the types that are read of them."""
    types: dict[str, tuple[type, ...]] = {
        **dict.fromkeys(("status", "result", "headline"), (str,)),
        "file": (str, type(None)),
    }
    return isinstance(entries, list) and all(
        isinstance(entry, dict)
        and all(isinstance(entry[name], kinds) for name, kinds in types.items() if name in entry)
        for entry in entries
    )
