"""Conversion between worlds and the data in files.

Files may come from untrusted sources, so a file must not decide which code runs. A user's simulator and an
environment's wrappers are code. If a world is defined in code, a replay uses the test's world, if its name matches.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from types import MappingProxyType
from typing import Any

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support.errors import WorldError
from pytest_pafot.support.text import differences, listed, safe_repr
from pytest_pafot.world.base_world import BaseWorld, Highway
from pytest_pafot.world.engines.run import PHYSICS_HZ
from pytest_pafot.world.gym_world import LONGEST_RUN, World
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.simulator_world import SimulatorWorld

# The class names of the package's simulators, by their `kind` in files, which is also the name of their module.
SIMULATORS: Mapping[str, str] = MappingProxyType({"metadrive": "MetaDrive", "sumo": "Sumo"})

# The `kind` of a user's simulator in files. Earlier versions also used it for worlds with a custom `rollout`.
OWN = "own"

BUILT_IN: Mapping[str, type[Highway | World]] = MappingProxyType({"highway": Highway, "gym": World})

# The default class of other vehicles in highway-env's environments.
OTHER_VEHICLES = "highway_env.vehicle.behavior.IDMVehicle"

# If the world is defined in code, these fields must be the same in the file and in the test's world. Other differences
# are only reported.
NAMED_BY = ("kind", "class", "env_id")

# The largest `hang_limit` [s] that a file can set if no test specifies a world.
LONGEST_DECISION = 600.0


def checked_world(given: Any) -> BaseWorld:
    """Return the given world if its class is one of this package's world classes.

    Raises:
        WorldError: for any other object, including an instance of a derived class.
    """
    # An instance of a derived class would be saved as its base class, and replayed without its changes.
    classes = (*BUILT_IN.values(), SimulatorWorld)
    if type(given) in classes:
        world: BaseWorld = given
        return world
    fix = "derive your own simulator from pafot.Simulator, and pass it to pafot.SimulatorWorld"
    for each in classes:
        if isinstance(given, each):
            fix = f"use pafot.{each.__name__} itself, because a file cannot describe what a derived class does"
    raise WorldError(
        field="world",
        expected="pafot.Highway(...), pafot.World(...) or pafot.SimulatorWorld(...)",
        received=safe_repr(given),
        fix=fix,
    )


def from_dict(data: Mapping[str, Any]) -> BaseWorld:
    """Create a world from data that :func:`described`, or ``to_dict`` of a built-in world, has returned.

    Raises:
        WorldError: for an unknown kind or field, a bad value, a configuration that names code outside highway-env, or
            data that the simulator does not accept.
    """
    if not isinstance(data, Mapping):
        raise WorldError(
            field="world",
            expected="a mapping",
            received=repr(data),
        )
    values = dict(data)
    kind = values.pop("kind", None)
    # The kind of an untrusted file need not be hashable.
    if isinstance(kind, str) and kind in BUILT_IN:
        return _built_in(kind, values)
    if isinstance(kind, str) and kind in SIMULATORS:
        return _of_simulator(kind, values)
    fix = ""
    if kind == OWN:
        fix = "a file cannot contain the code of your simulator. Use the world object itself, or --world module:factory"
    raise WorldError(
        field="world.kind",
        expected=f"one of {', '.join(sorted([*BUILT_IN, *SIMULATORS]))}",
        received=repr(kind),
        fix=fix,
    )


def _built_in(kind: str, values: dict[str, Any]) -> Highway | World:
    # Otherwise, the class would raise a TypeError that does not name the file's field.
    _check_names(f"world (kind {kind})", values, BUILT_IN[kind])
    if "limits" in values:
        limits = values["limits"]
        if not isinstance(limits, dict):
            raise WorldError(
                field="world.limits",
                expected="a mapping",
                received=repr(limits),
            )
        _check_names("world.limits", limits, NpcLimits)
        values["limits"] = NpcLimits(**limits)
    if "wrappers" in values:
        raise WorldError(
            field="world.wrappers",
            expected="no wrappers, because a file cannot contain code",
            received=f"{values['wrappers']!r:.200}",
            fix="use pafot.World(..., wrappers=[...]) in the test, or --world module:factory",
        )
    if kind == "gym":
        if "env_id" not in values:
            raise WorldError(
                'world.env_id: expected an environment id, such as "highway-v0", received none'
            )
        config = values.get("config")
        path = OTHER_VEHICLES
        if isinstance(config, dict):
            path = config.get("other_vehicles_type", OTHER_VEHICLES)
        if not _may_name(path):
            raise WorldError(
                field="world.config.other_vehicles_type",
                expected="a class in highway_env.vehicle",
                received=repr(path),
                fix="to use your own vehicle class, first import its module, because a corpus file "
                "cannot import other code",
            )
    return BUILT_IN[kind](**values)


def _may_name(path: Any) -> bool:
    # highway-env imports the class that the file names. So it must be a class of highway-env, or a user's vehicle class
    # that has already been imported, for example by the test.
    if not isinstance(path, str):
        return False
    if path.startswith("highway_env.vehicle."):
        return True
    # Read from `sys.modules`, because an import would already run the code that the file names.
    module, _, name = path.rpartition(".")
    found = vars(sys.modules.get(module, object)).get(name)
    if not isinstance(found, type):
        return False
    return any(each.__module__ == "highway_env.vehicle.kinematics" for each in found.__mro__)


def _check_names(place: str, values: dict[str, Any], cls: type[Any]) -> None:
    # the other fields are not part of a world
    known = {field.name for field in fields(cls) if field.compare}
    unknown = sorted(str(key) for key in values if key not in known)
    if unknown:
        raise WorldError(
            field=place,
            expected=f"no fields other than {listed(sorted(known))}",
            received=", ".join(unknown),
        )


def _of_simulator(kind: str, values: dict[str, Any]) -> SimulatorWorld:
    if set(values) != {"data"}:
        raise WorldError(
            field=f"world (kind {kind})",
            expected="only the field 'data'",
            received=", ".join(values) or "none",
        )
    # Imported only here, because the simulators import this module.
    simulator = getattr(import_module(f"pytest_pafot.simulators.{kind}"), SIMULATORS[kind])
    try:
        return SimulatorWorld.from_dict(simulator, values["data"])
    except WorldError:
        raise
    except Exception as error:
        raise WorldError(
            field="world.data",
            expected=f"data for pafot.{kind}",
            received=safe_repr(values["data"]),
            fix=f"the class raised {type(error).__name__}: {error!s:.200}",
        ) from error


def described(world: BaseWorld) -> dict[str, Any]:
    """Return the description of a world for a file."""
    data = world.to_dict()
    if not isinstance(world, SimulatorWorld):
        return data
    # A built-in simulator is recreated from its kind. The code of a user's class is not in the file.
    name = world.maker.__name__
    kind = world.maker.__module__.rpartition("pytest_pafot.simulators.")[2]
    if SIMULATORS.get(kind) == name:
        return {"kind": kind, "data": data}
    return {"kind": OWN, "class": name, "data": data}


def world_of_file(
    data: Mapping[str, Any], scenario: Scenario, own: BaseWorld | None = None
) -> BaseWorld:
    """Create the world that a file describes, with runs and decisions no longer than in the test's world ``own``.

    Raises:
        WorldError: as for :func:`from_dict`, or if :func:`limit_durations` cannot shorten the runs of a simulator.
    """
    world = from_dict(limit_durations(data, scenario, own))
    # `limit_durations` has already limited built-in worlds. Only the simulator knows its own durations.
    if own is None or data.get("kind") in BUILT_IN:
        return world
    for what, asked, most in (
        ("decisions", world.hang_limit, own.hang_limit),
        ("runs", min(world.longest_run, scenario.seconds), own.longest_run),
    ):
        if asked > most + 1e-9:
            raise WorldError(
                field="world.data",
                expected=f"{what} of at most {most:g} s, as in the test's world",
                received=f"{asked:g} s",
                fix="increase the limit of the test's world",
            )
    return world


def limit_durations(
    data: Mapping[str, Any], scenario: Scenario, own: BaseWorld | None = None
) -> Mapping[str, Any]:
    """Return a world's data, changed so that runs and decisions take no longer than in the test's world ``own``.

    A file from an untrusted source must not decide how long a session takes. If a run is longer, only its start is
    simulated.
    """
    limited = dict(data)
    most_seconds = LONGEST_DECISION
    if own is not None:
        most_seconds = own.hang_limit  # a decision may take as long as in the test's world
    hang_limit = data.get("hang_limit")
    # `from_dict` reports a value of another type.
    if isinstance(hang_limit, (int, float)) and hang_limit > most_seconds:
        limited["hang_limit"] = most_seconds
    if own is None or data.get("kind") not in BUILT_IN:
        return limited
    # A World uses its `duration`, or else the environment's duration, or else the default.
    asked = LONGEST_RUN
    config = data.get("config")
    if isinstance(config, Mapping) and isinstance(config.get("duration"), (int, float)):
        asked = config["duration"]
    if isinstance(data.get("duration"), (int, float)):
        asked = data["duration"]
    # A run may have as many ticks as the longest run in the test's world. A longer run is shortened.
    longest = _longest(data, own)
    if min(asked, scenario.seconds) > longest + 1e-9:
        limited["duration"] = longest
    return limited


def describe_limits(data: Mapping[str, Any], scenario: Scenario, own: BaseWorld) -> list[str]:
    """Describe how :func:`limit_durations` shortens the run in a file."""
    longest = limit_durations(data, scenario, own).get("duration")
    # Also if neither states a duration.
    if longest == data.get("duration"):
        return []
    return differences("world", data, {**data, "duration": longest})


def _longest(data: Mapping[str, Any], own: BaseWorld) -> float:
    # The duration [s] with as many ticks in the file's world as the longest run has in the test's world.
    # An environment states its rate in its configuration.
    rate = data.get("physics_hz")
    config = data.get("config")
    if isinstance(config, Mapping):
        rate = config.get("simulation_frequency")
    try:
        seconds = own.longest_run
        if not isinstance(own, SimulatorWorld):
            # Files contain the requested duration, although runs end earlier on a short road.
            seconds = own.to_dict()["duration"]
        own_rate = getattr(own, "physics_hz", None)
    except WorldError:  # every search of this test reports this error
        return math.inf
    low, high = PHYSICS_HZ
    # `from_dict` rejects a file with another rate.
    if own_rate is None or not isinstance(rate, int) or not low <= rate <= high:
        return float(seconds)
    return float(seconds * own_rate / rate)


def is_code(data: Mapping[str, Any]) -> bool:
    """Return whether a file's world is defined in code, which only the test can provide."""
    return data.get("kind") == OWN or "wrappers" in data


def check_named_world(data: Mapping[str, Any], world: BaseWorld) -> BaseWorld:
    """Return ``world``, the test's world, if it matches the world in the file.

    Raises:
        WorldError: if a field of ``NAMED_BY`` differs, or if the file's world is no longer supported.
    """
    now = described(world)
    if data.get("kind") == OWN and "simulator" not in data.get("data", ()):
        raise WorldError(
            field="world",
            expected="a file with a pafot.SimulatorWorld, a pafot.Highway or a pafot.World",
            received=f"{_title(data)} with its own rollout, which is no longer supported",
            fix="derive a pafot.Simulator, search again in a pafot.SimulatorWorld, and delete this file",
        )
    # Each kind of world has only some of these keys.
    if all(data[key] == now.get(key) for key in NAMED_BY if key in data):
        return world
    way = "a file cannot contain code, so set the world with @pafot.search(world=...), pafot_world or --world"
    raise WorldError(
        expected=f"{_title(data)}, as in the saved scenario",
        received=_title(now),
        fix=f"{way}. If only the name of the world has changed, write the new name into the file",
    )


def file_or_named_world(data: Mapping[str, Any], world: BaseWorld) -> BaseWorld:
    """Return the file's world, or the user's ``world`` if the file's world is defined in code."""
    check_named_world(data, world)
    if is_code(data):
        return world
    return from_dict(data)


def changes(data: Mapping[str, Any], world: BaseWorld) -> list[str]:
    """Describe how the test's world differs from the file's world, if the latter is defined in code."""
    if not is_code(data):
        return []
    return differences("world", data, described(world))


def describe_world_change(data: Mapping[str, Any], scenario: Scenario, own: BaseWorld) -> list[str]:
    """Describe how the test's world differs from the world of a replay, unless code defines the file's world."""
    if is_code(data):
        return []
    return differences("world", described(world_of_file(data, scenario, own)), described(own))


def _title(data: Mapping[str, Any]) -> str:
    kind = data.get("kind")
    if kind == OWN and "class" in data:
        return f"a simulator of the class {data['class']}"
    if kind == OWN:
        return "a user's simulator"
    if kind == "highway":
        return "a pafot.Highway"
    if kind != "gym":
        return f"a world of the kind {kind}"
    title = f"pafot.World({data['env_id']!r})"
    if "wrappers" in data:
        title += f" with {', '.join(data['wrappers']) or 'its registered wrappers'}"
    return title
