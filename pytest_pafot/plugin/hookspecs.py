"""Hooks that other plugins implement to follow searches; both are called in the controller, also with pytest-xdist."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pytest


def pytest_pafot_event(config: pytest.Config, node_id: str, kind: str, data: Mapping[str, Any]) -> None:
    """Take what an item tells while it runs, as plain values.

    Args:
        config: the session's.
        node_id: the item that tells it.
        kind: ``start`` and ``search`` for the begin and the end of a search, ``progress``, ``finding`` for a failure
            that was found or replayed, and again each time that more is known of it, ``note``, ``warning``,
            ``compared``.
        data: what it tells; docs/reference/extending.md lists the keys of each kind.
    """


def pytest_pafot_record(config: pytest.Config, record: Mapping[str, Any]) -> None:
    """Take the record of the session when it ends: what ``--pafot-json`` writes, as read from JSON."""
