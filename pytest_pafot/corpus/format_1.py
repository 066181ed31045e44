"""Version 1 of the format, read for ever: a file of it as one of version 2, which means the same.

Version 1 let fields of the world be left out, and held of an environment's configuration only what the test had given.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pytest_pafot.corpus.schema import LIMITS, VERSION, WORLDS

_LIMITS = MappingProxyType(dict(zip(LIMITS.required, (5.0, 8.0, 10.0, 4.0, 1.1, 0.5), strict=True)))
_COMMON = MappingProxyType({"clearance": 3.0, "headway": 2.0, "limits": {}, "hang_limit": 30.0})
_WORLDS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "highway": {"lanes": 4, "speed_limit": 26.8, "physics_hz": 15, "ads_hz": 5, "duration": 60.0, **_COMMON},
        "gym": {"config": None, "duration": None, **_COMMON},
    }
)
"""What a world of version 1 was without a field. These are its defaults for ever, whatever those of today are."""

_LONGEST_RUN = 60.0
_STRAIGHT = ("highway-v0", "highway-fast-v0")
"""Environments whose runs lasted as long as their configuration says; on all others, not longer than 60 s."""


def upgraded(document: Any) -> Any:
    """A document of version 1 as one of version 2, which means the same.

    What is wrong with it stays as it is, for the checks of version 2.
    """
    if not isinstance(document, dict):
        return document
    changes = {"pafot": VERSION, "world": _world(document["world"])} if "world" in document else {"pafot": VERSION}
    return {**document, **changes}


def _world(world: Any) -> Any:
    kind = world.get("kind") if isinstance(world, dict) else None
    if not isinstance(world, dict) or kind == "own":
        return world
    if not isinstance(kind, str) or kind not in _WORLDS:  # of the user's own, and any data at all
        return {"kind": "own"} if kind == "unknown" else {"kind": "own", "data": world}
    values = {**_WORLDS[kind], **world}
    complete = {key: values[key] for key in dict.fromkeys([*WORLDS[kind].required, *values]) if key in values}
    if isinstance(complete["limits"], dict):
        complete["limits"] = {**_LIMITS, **complete["limits"]}
    return _with_config(complete) if kind == "gym" else complete


def _with_config(world: dict[str, Any]) -> dict[str, Any]:
    """With the options that highway-env's environments had then, and the duration that came of them."""
    given, env_id = world["config"], world.get("env_id")
    defaults = _configs().get(env_id) if isinstance(env_id, str) else None
    if not isinstance(given, (dict, type(None))) or defaults is None:
        return {**world, "config": {} if given is None else given}
    config = {**defaults, **(given or {})}
    own, duration = config.get("duration", _LONGEST_RUN), world["duration"]
    if duration is None and isinstance(own, (int, float)):
        duration = float(own if env_id in _STRAIGHT else min(own, _LONGEST_RUN))
    return {**world, "config": config, "duration": duration}


def _configs() -> dict[str, dict[str, Any]]:
    """Defaults of highway-env 1.12, by environment: those of the one that it is like, and its own."""
    configs: dict[str, dict[str, Any]] = {}
    entries = json.loads(Path(__file__).with_name("format_1.json").read_text(encoding="utf-8"))
    for env_id, entry in entries.items():
        like = configs.get(entry.pop("like", ""), {})
        configs[env_id] = {**like, **entry}
    return configs
