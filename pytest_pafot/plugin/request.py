"""What one item asks for: the arguments of its mark, checked, beside its settings."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.plugin.arguments import SearchArguments
from pytest_pafot.plugin.marks import DEFAULT_ADS, DEFAULT_ARG, POSITIONAL
from pytest_pafot.plugin.options import BY_NAME, OptionError
from pytest_pafot.plugin.settings import Settings, resolve

if TYPE_CHECKING:
    from pytest_pafot.searching.space import SearchSpace
    from pytest_pafot.trace import Trace

ROAD_ARGUMENTS = ("lanes", "speed_limit", "clearance")
SPACE_ARGUMENTS = ("npcs", "genes", "gene_seconds", "ego_lane", "ego_speed")
BLAMES = ("any", "ego")


class RequestError(Exception):
    """An item that cannot be run as it is marked; the message is complete for the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A checked request for a search or a replay.

    Attributes:
        settings: the options.
        ads: name of the fixture that gives the factory, or the factory itself.
        arg: the parameter of the test function that receives the run.
        blame: ``any``, or ``ego`` to call the function only where the ego is responsible, or nobody.
        decision_limit: slowest decision of the ADS that is no finding [s].
        fitness: a name, or a function of a trace.
        world: given by the mark, or None for the fixture's.
        road: arguments of :class:`~pytest_pafot.world.Highway` that the mark gives.
        space: arguments of :class:`~pytest_pafot.searching.space.SearchSpace` that the mark gives.
    """

    settings: Settings
    ads: str | Callable[[], Any]
    arg: str = DEFAULT_ARG
    blame: str = "any"
    decision_limit: float | None = None
    fitness: str | Callable[[Trace], float] = "default"
    world: Any = None
    road: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    space: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def read_request(config: pytest.Config, arguments: Mapping[str, Any], fresh_seed: int) -> Request:
    """Check the arguments of a mark.

    Raises:
        RequestError: on the first wrong argument or option.
    """
    _check_names(arguments)
    try:
        settings = resolve(config, arguments, fresh_seed)
    except OptionError as error:
        raise RequestError(str(error)) from None
    if arguments.get("world") is not None:
        _check_world(arguments)
    return Request(
        settings=settings,
        ads=_ads(arguments.get("ads", DEFAULT_ADS)),
        arg=_identifier("arg", arguments.get("arg", DEFAULT_ARG)),
        blame=_blame(arguments.get("blame", "any")),
        decision_limit=_positive("decision_limit", arguments.get("decision_limit")),
        fitness=_fitness(arguments.get("fitness"), settings.algorithm),
        world=arguments.get("world"),
        road={name: arguments[name] for name in ROAD_ARGUMENTS if arguments.get(name) is not None},
        space={name: arguments[name] for name in SPACE_ARGUMENTS if arguments.get(name) is not None},
    )


def build_world(request: Request, fixture_world: Any) -> Any:
    """The world of a search: the mark's, else the fixture's with the mark's road arguments.

    Where the mark says how long the chains are, runs on a Highway that it does not give itself last as long.

    Raises:
        RequestError: when the road arguments do not fit the world.
    """
    if request.world is not None:
        return request.world
    changes = dict(request.road)
    is_timed = bool({"genes", "gene_seconds"} & set(request.space))
    if not changes and not is_timed:
        return fixture_world
    from pytest_pafot.world import Highway  # noqa: PLC0415

    if not isinstance(fixture_world, Highway):
        if changes:
            raise RequestError(
                f"@pafot.search({next(iter(changes))}=...): expected the fixture pafot_world to give a pafot.Highway, "
                f"received {fixture_world!r}; describe the whole road with world= instead"
            )
        return fixture_world
    if is_timed:
        space = _space(request, speed_limit=26.8)
        changes["duration"] = space.genes * space.gene_seconds
    try:
        return dataclasses.replace(fixture_world, **changes)
    except (TypeError, ValueError) as error:
        raise RequestError(f"@pafot.search({', '.join(request.road) or 'genes'}=...): {error}") from None


def build_space(request: Request, world: Any) -> SearchSpace:
    """The space of scenarios on a world, with as many genes as a run of it comes to unless the mark says how many.

    Raises:
        RequestError: when an argument is out of range, or the world cannot be built.
    """
    from pytest_pafot.searching.space import space_on  # noqa: PLC0415
    from pytest_pafot.world import WorldError  # noqa: PLC0415

    try:
        return space_on(world, request.space)
    except WorldError as error:
        raise RequestError(f"@pafot.search(world=...): {error}") from None
    except (TypeError, ValueError) as error:
        raise RequestError(f"@pafot.search({', '.join(request.space)}): {error}") from None


def _space(request: Request, speed_limit: float) -> SearchSpace:
    from pytest_pafot.searching.space import SearchSpace  # noqa: PLC0415

    try:
        return SearchSpace(**request.space, speed_limit=speed_limit)
    except (TypeError, ValueError) as error:
        raise RequestError(f"@pafot.search({', '.join(request.space)}): {error}") from None


def _check_names(arguments: Mapping[str, Any]) -> None:
    if arguments.get(POSITIONAL):
        given = arguments[POSITIONAL][0]
        name = getattr(given, "__name__", "")
        example = "generations=20" if not callable(given) else f"ads={name if name.isidentifier() else '...'}"
        raise RequestError(
            f"@pafot.search: expected keyword arguments only, received {arguments[POSITIONAL]!r:.200}; "
            f"write the argument's name, as in @pafot.search({example})"
        )
    known = SearchArguments.__annotations__
    unknown = [name for name in arguments if name not in known and name != POSITIONAL]
    if unknown and unknown[0] in BY_NAME:
        raise RequestError(
            f"@pafot.search({unknown[0]}=...): this concerns the whole session; give {BY_NAME[unknown[0]].flag} "
            "on the command line"
        )
    if unknown:
        near = difflib.get_close_matches(unknown[0], known, n=1)
        expected = f"did you mean {near[0]!r}? Expected" if near else "expected"
        raise RequestError(
            f"@pafot.search({unknown[0]}=...): {expected} one of {', '.join(sorted(known))}, received {unknown[0]!r}"
        )


def _check_world(arguments: Mapping[str, Any]) -> None:
    double = [name for name in ROAD_ARGUMENTS if arguments.get(name) is not None]
    if double:
        raise RequestError(
            f"@pafot.search(world=..., {double[0]}=...): expected either a whole world or its parts, received both; "
            f"give {double[0]} to the world"
        )
    world = arguments["world"]
    if isinstance(world, type) or not callable(getattr(world, "rollout", None)):
        raise RequestError(
            f"@pafot.search(world=...): expected pafot.Highway(...) or pafot.World(...), received {world!r}"
            f"{hint_at_world(world)}"
        )


def hint_at_world(given: Any) -> str:
    """The world that is meant by the id of an environment, or by an environment; empty for anything else."""
    spec = getattr(given, "spec", None)  # of an environment that gymnasium made
    env_id = given if isinstance(given, str) else getattr(spec, "id", None)
    config = ", config=..." if getattr(spec, "kwargs", {}).get("config") else ""
    return f'; did you mean pafot.World("{env_id}"{config})?' if isinstance(env_id, str) else ""


def _ads(value: object) -> str | Callable[[], Any]:
    if callable(value) or (isinstance(value, str) and value.isidentifier()):
        return value
    from pytest_pafot.world.driving.ads import hint_at_object  # noqa: PLC0415
    from pytest_pafot.world.kernel.action import shown  # noqa: PLC0415

    hint = hint_at_object(value)
    if isinstance(value, str):
        hint = f"Load a model in the factory, as in `ads=lambda: MyPlanner({value!r})`"
    raise RequestError(
        "@pafot.search(ads=...): expected the name of a fixture or a factory such as `lambda: MyPlanner()`, "
        f"received {shown(value)}{f'. {hint}' if hint else ''}"
    )


def _identifier(name: str, value: object) -> str:
    if not isinstance(value, str) or not value.isidentifier():
        raise RequestError(f"@pafot.search({name}=...): expected a name, received {value!r}")
    return value


def _blame(value: object) -> str:
    if value not in BLAMES:
        raise RequestError(f"@pafot.search(blame=...): expected {' or '.join(BLAMES)}, received {value!r}")
    return str(value)


def _positive(name: str, value: object) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not (math.isfinite(value) and value > 0):
        raise RequestError(f"@pafot.search({name}=...): expected seconds, more than 0, received {value!r}")
    return float(value)


def _fitness(value: object, algorithm: str) -> Any:
    from pytest_pafot.searching.algorithms import fitness_of  # noqa: PLC0415
    from pytest_pafot.searching.fitness import Weights  # noqa: PLC0415

    if value is None:
        return fitness_of(algorithm)
    if not isinstance(value, (str, Weights)) and not callable(value):
        raise RequestError(
            "@pafot.search(fitness=...): expected default, paper, av-fuzzer, pafot.Weights(...) or a function of a "
            f"Trace that returns a float, received {value!r}"
        )
    return value
