"""Worlds and files: which world a file can describe, and which one a test has to name for a replay.

A ``pafot.Highway`` or ``pafot.World`` is data, and a replay makes it from the file. A world of the user's own is code,
as are the wrappers around an environment. No file may say which code runs, so a replay takes the world that the test
names, provided that it is of the class, or has the environment, that the file tells.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pytest_pafot.findings.finding import check_plain

OWN = "own"
"""The kind of a world of the user's own."""

NAMED_BY = ("kind", "class", "env_id")
"""What must be as in the file. All else may have changed since, and is told."""

MAX_TOLD = 3


def described(world: Any) -> dict[str, Any]:
    """A world as a file has it."""
    from pytest_pafot.world import Highway, World, WorldError  # noqa: PLC0415
    from pytest_pafot.world import validation as checks  # noqa: PLC0415

    if type(world) in (Highway, World):
        data: dict[str, Any] = world.to_dict()
        return data
    own = {"kind": OWN, "class": type(world).__name__}
    try:
        given = checks.plain("world", world.to_dict())
        check_plain("world", given)
    except (WorldError, ValueError):  # What a file cannot hold cannot be compared; the scenario is worth keeping.
        return own
    return {**own, "data": given}


def is_code(data: Mapping[str, Any]) -> bool:
    """Whether the world of a file is one that the test has to name."""
    return data.get("kind") == OWN or "wrappers" in data


def named(data: Mapping[str, Any], world: Any) -> Any:
    """The world that the test names, for a file whose world is code.

    Raises:
        WorldError: where it is another one.
    """
    from pytest_pafot.world import WorldError  # noqa: PLC0415

    now = described(world)
    if all(data[key] == now.get(key) for key in NAMED_BY if key in data):
        return world
    raise WorldError(
        f"expected that the test names the world that the scenario was saved in, {_title(data)}, because a file holds "
        f"no code, received {_title(now)}; give it by @pafot.search(world=...) or the fixture pafot_world; if only its "
        "name is new, write that into the file"
    )


def changes(data: Mapping[str, Any], world: Any) -> list[str]:
    """What differs between the world of a file, where it is code, and the one that the test names."""
    if not is_code(data):
        return []
    then, now = dict(_leaves("world", data)), dict(_leaves("world", described(world)))
    if "class" not in data:  # version 1 of the format did not tell it
        now.pop("world.class", None)
    differ = [key for key in {**then, **now} if key not in then or key not in now or then[key] != now[key]]
    told = [f"{key} {_shown(then, key)} in the file, {_shown(now, key)} now" for key in differ[:MAX_TOLD]]
    return told + ([f"{len(differ) - MAX_TOLD} more"] if len(differ) > MAX_TOLD else [])


def _title(data: Mapping[str, Any]) -> str:
    if data.get("kind") == OWN:
        return f"one of the class {data['class']}" if "class" in data else "one of its own"
    wrappers = f" with {', '.join(data['wrappers']) or 'what it is registered with'}" if "wrappers" in data else ""
    return f"pafot.World({data['env_id']!r}){wrappers}" if "env_id" in data else "a pafot.Highway"


def _leaves(place: str, data: Any) -> Iterator[tuple[str, Any]]:
    """Every value of nested mappings, by its place."""
    if not isinstance(data, Mapping) or not data:
        yield place, data
        return
    for key, inner in data.items():
        yield from _leaves(f"{place}.{key}", inner)


def _shown(leaves: Mapping[str, Any], key: str) -> str:
    return f"{leaves[key]!r:.60}" if key in leaves else "missing"
