"""Versions of the corpus format: what the world of a file holds, and how a file of an earlier version is read.

Version 2 holds the world complete, so that no default that changes later changes what a saved scenario is. A key that
comes to it later is optional, and a file without it means what it meant before. Version 1 let fields of the world be
left out, and held of an environment's configuration only what the test had given.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

VERSION = 2
"""That is written."""

VERSIONS = (1, 2)
"""That are read."""


@dataclass(frozen=True, slots=True)
class Keys:
    """Of a mapping in a file."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()


LIMITS = Keys(("acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"))

WORLDS: Mapping[str, Keys] = MappingProxyType(
    {
        "highway": Keys(
            (
                *("kind", "lanes", "speed_limit", "physics_hz", "ads_hz", "duration"),
                *("clearance", "headway", "limits", "hang_limit"),
            )
        ),
        "gym": Keys(
            ("kind", "env_id", "config", "duration", "clearance", "headway", "limits", "hang_limit"), ("wrappers",)
        ),
        "own": Keys(("kind",), ("class", "data")),
    }
)
"""Of worlds, by kind; what ``data`` is, the user's own world says by its ``to_dict``."""

_LIMITS_1 = MappingProxyType(
    {
        "acceleration": 5.0,
        "braking": 8.0,
        "jerk": 10.0,
        "lateral_acceleration": 4.0,
        "overspeed": 1.1,
        "heading": 0.5,
    }
)
_COMMON_1 = MappingProxyType({"clearance": 3.0, "headway": 2.0, "limits": {}, "hang_limit": 30.0})
_WORLDS_1: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "highway": {"lanes": 4, "speed_limit": 26.8, "physics_hz": 15, "ads_hz": 5, "duration": 60.0, **_COMMON_1},
        "gym": {"config": None, "duration": None, **_COMMON_1},
    }
)
"""What a world of version 1 was without a field. These are its defaults for ever, whatever those of today are."""

_LONGEST_RUN_1 = 60.0
_STRAIGHT_1 = ("highway-v0", "highway-fast-v0")
"""Environments whose runs lasted as long as their configuration says; on all others, not longer than 60 s."""


def upgraded(document: Any) -> Any:
    """A document of version 1 as one of version 2, which means the same.

    What is wrong with it stays as it is, for the checks of version 2.
    """
    if not isinstance(document, dict):
        return document
    changes = {"pafot": VERSION, "world": _world_of_1(document["world"])} if "world" in document else {"pafot": VERSION}
    return {**document, **changes}


def _world_of_1(world: Any) -> Any:
    kind = world.get("kind") if isinstance(world, dict) else None
    if not isinstance(world, dict) or kind == "own":
        return world
    if not isinstance(kind, str) or kind not in _WORLDS_1:  # of the user's own, and any data at all
        return {"kind": "own"} if kind == "unknown" else {"kind": "own", "data": world}
    values = {**_WORLDS_1[kind], **world}
    complete = {key: values[key] for key in dict.fromkeys([*WORLDS[kind].required, *values]) if key in values}
    if isinstance(complete["limits"], dict):
        complete["limits"] = {**_LIMITS_1, **complete["limits"]}
    return _with_config_of_1(complete) if kind == "gym" else complete


def _with_config_of_1(world: dict[str, Any]) -> dict[str, Any]:
    """With the options that highway-env's environments had then, and the duration that came of them."""
    given, env_id = world["config"], world.get("env_id")
    defaults = _configs_of_1().get(env_id) if isinstance(env_id, str) else None
    if not isinstance(given, (dict, type(None))) or defaults is None:
        return {**world, "config": {} if given is None else given}
    config = {**defaults, **(given or {})}
    own, duration = config.get("duration", _LONGEST_RUN_1), world["duration"]
    if duration is None and isinstance(own, (int, float)):
        duration = float(own if env_id in _STRAIGHT_1 else min(own, _LONGEST_RUN_1))
    return {**world, "config": config, "duration": duration}


def _configs_of_1() -> dict[str, dict[str, Any]]:
    """Defaults of highway-env 1.12, by environment: those of the one that it is like, and its own."""
    configs: dict[str, dict[str, Any]] = {}
    entries = json.loads(Path(__file__).with_name("format_1.json").read_text(encoding="utf-8"))
    for env_id, entry in entries.items():
        own = {key: value for key, value in entry.items() if key != "like"}
        configs[env_id] = {**configs.get(entry.get("like", ""), {}), **own}
    return configs
