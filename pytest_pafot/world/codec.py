"""Worlds from plain data, as a corpus file has them. The data may come from strangers: nothing of it is imported."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from pytest_pafot.world.errors import WorldError
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.highway import Highway
from pytest_pafot.world.limits import NpcLimits

_KINDS: dict[str, type[Highway | World]] = {"highway": Highway, "gym": World}


def from_dict(data: dict[str, Any]) -> Highway | World:
    """The world that ``to_dict`` wrote.

    Raises:
        WorldError: on an unknown kind or field, a bad value, or a configuration that names code outside
            highway-env.
    """
    if not isinstance(data, dict):
        raise WorldError(f"world: expected a mapping, received {data!r}")
    kind = data.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        hint = "; a world of your own is code, which no file holds: use itself" if kind == "own" else ""
        raise WorldError(f"world.kind: expected one of {', '.join(sorted(_KINDS))}, received {kind!r}{hint}")
    values = {key: value for key, value in data.items() if key != "kind"}
    _check_names(f"world (kind {kind})", values, _KINDS[kind])
    if "limits" in values:
        if not isinstance(values["limits"], dict):
            raise WorldError(f"world.limits: expected a mapping, received {values['limits']!r}")
        _check_names("world.limits", values["limits"], NpcLimits)
        values["limits"] = NpcLimits(**values["limits"])
    if "wrappers" in values:
        raise WorldError(
            f"world.wrappers: expected none, since a file holds no code, received {values['wrappers']!r:.200}; give "
            "pafot.World(..., wrappers=[...]) in their place"
        )
    if kind == "gym" and "env_id" not in values:
        raise WorldError('world.env_id: expected the id of a registered environment, such as "highway-v0"')
    _check_class_paths(values.get("config"))
    return _KINDS[kind](**values)


def _check_names(place: str, values: dict[str, Any], cls: type[Any]) -> None:
    known = {field.name for field in fields(cls) if field.compare}  # an engine is no part of what a world is
    unknown = sorted(str(key) for key in values if key not in known)
    if unknown:
        raise WorldError(f"{place}: expected the fields {', '.join(sorted(known))}, received {', '.join(unknown)}")


def _check_class_paths(config: Any) -> None:
    """highway-env imports the class that ``other_vehicles_type`` names; only its own are let through."""
    if not isinstance(config, dict):
        return
    path = config.get("other_vehicles_type", "highway_env.vehicle.behavior.IDMVehicle")
    if not isinstance(path, str) or not path.startswith("highway_env.vehicle."):
        raise WorldError(
            f"world.config.other_vehicles_type: expected a class of highway_env.vehicle, received {path!r}; "
            "a corpus file may not name other code"
        )
