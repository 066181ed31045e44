"""The results of earlier sessions, as ``--pafot-json`` has written them: data of anybody, so each value is checked."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
        searches, findings, tests: the entries of its JSON.
    """

    day: str = ""
    commit: str = ""
    searches: tuple[Mapping[str, Any], ...] = ()
    findings: tuple[Mapping[str, Any], ...] = ()
    tests: tuple[Mapping[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """Day and commit in short."""
        return " ".join(filter(None, [self.day, self.commit[:10]]))


def session_of(path: Path) -> Session:
    """Read the results of a session.

    Raises:
        RequestError: if the file cannot be read or has no results.
    """
    expected = f"{visible(str(path))}: expected the results of a session, from {flag('json')}"
    try:
        if path.stat().st_size > MOST_BYTES:
            raise RequestError(f"{expected}, received more than {MOST_BYTES // 2**20} MiB")
        data = json.loads(path.read_text(encoding="utf-8"))
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
    return Session(day=day, commit=commit, **{name: tuple(data.get(name, ())) for name in lists})


def _are_entries(entries: object) -> bool:
    """Return whether the entries of results have the types that are read of them."""
    types: dict[str, tuple[type, ...]] = {
        **dict.fromkeys(("node_id", "test", "id", "status", "result", "message"), (str,)),
        **dict.fromkeys(("title", "owner", "responsible"), (str,)),
        **dict.fromkeys(("runs", "random_failing", "random_runs", "given"), (int,)),
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
        for entry in entries
    )
