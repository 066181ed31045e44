"""The request for one search: its checked arguments and options."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, TypedDict, get_args

from pytest_pafot.algorithms.catalogue import AlgorithmClass, resolve_algorithm
from pytest_pafot.algorithms.fitness import Fitness, FitnessName
from pytest_pafot.algorithms.plan import Algorithm
from pytest_pafot.algorithms.space import MOST_ON_GRID, Instructions, SearchSpace, sample
from pytest_pafot.model.scenario import EGO_LANE, EGO_SPEED, rng_of
from pytest_pafot.model.vehicle_type import (
    CAR,
    HOSTILE,
    READY,
    STYLES,
    Style,
    VehicleName,
    VehicleType,
    named_vehicles,
)
from pytest_pafot.searches.options import BUDGETS, BY_NAME, AlgorithmName, Settings
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.references import described, factory_named, imported
from pytest_pafot.support.text import capitalised, safe_repr, suggest
from pytest_pafot.world import Highway, Simulator, SimulatorWorld, World, WorldError
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.codec import checked_world
from pytest_pafot.world.driving.policy import AdsFactory, hint_at_object
from pytest_pafot.world.limits import PLANNER_HZ

# The default number of NPCs in a scenario. Four NPCs fit around the ego in any lane of a Highway.
NPCS = 4
# The largest number of NPCs in a random scenario. It is lower if the ego is in an outer lane, where one cell must stay
# free.
MOST_NPCS = 6
# The smallest number of NPCs in a random scenario on a straight road, unless all NPCs are on the grid.
LEAST_NPCS = 3
# The largest number of NPCs in a random scenario on a road where they cross the ego's path. Three are enough to hide
# one NPC behind another. With more of them, the ego would wait for the first NPC and meet the others at times other
# than their slots, so the scenarios would show less.
MOST_CROSSING = 3
# The durations from which the gene duration of a scenario is sampled if all NPCs are on the grid [s].
GENE_DURATIONS = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)
# The durations for scenarios with Lane-Instructions [s]: a lane change takes about 3 s, a move to a cell 5 to 10 s.
SLICES = (2.0, 3.0, 4.0)
# the duration of a gene on roads that are not straight, if NPCs may have Lane-Instructions [s]
SLICE = 3.0
# The lowest start speed of the ego in a random scenario [m/s], or half of the speed limit if that is lower.
SLOWEST_START = 12.0
Blame = Literal["any", "ego"]
BLAMES: tuple[Blame, ...] = get_args(Blame)


class AgainstError(RequestError):
    """An error in the reference that prevents failures from being counted correctly."""


class SpaceArguments(TypedDict, total=False):
    """The types of the arguments that define a search's SearchSpace."""

    npcs: int
    genes: int
    gene_seconds: float
    ego_lane: int
    ego_speed: float
    traffic: Style
    instructions: Instructions
    vehicles: VehicleName | VehicleType | Sequence[VehicleName | VehicleType]


class CommonArguments(SpaceArguments, total=False):
    """The types of the arguments that ``@pafot.search`` and ``pafot.explore`` share."""

    fitness: FitnessName | Fitness
    blame: Blame
    algorithm: AlgorithmName | type[Algorithm[Any]]
    against: str | AdsFactory
    shrink_runs: int
    isolate: bool


class SearchArguments(CommonArguments, total=False):
    """The types of the arguments of :func:`pytest_pafot.search`."""

    world: BaseWorld | str
    ads: AdsFactory | str
    runs: int
    generations: int
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A checked request for a search or a replay."""

    settings: Settings
    algorithm: AlgorithmClass
    ads: str | AdsFactory  # the name of the fixture that returns the factory, or the factory itself
    # The test function is called for all runs (``any``), or for all but collisions for which only an NPC is responsible
    # (``ego``).
    blame: str = "any"
    fitness: str | Fitness = "default"
    world: Any = None  # the world of the mark, or None for the fixture's
    # arguments of the mark for a SearchSpace
    space: Mapping[str, Any] = field(default_factory=dict)
    place: str = "@pafot.search"  # where the arguments are, for messages

    def option(self, name: str, value: object = None) -> str:
        if self.place.startswith("@"):
            return flag(name, value)
        if value is None:
            return f"{name}=..."
        return f"{name}={value!r}"

    def error(self, arguments: str, problem: object) -> RequestError:
        return RequestError(f"{self.place}({arguments}): {problem}")


def checked_request(
    arguments: Mapping[str, Any], settings: Settings, *, place: str = "@pafot.search"
) -> Request:
    """Build and check the request for some arguments and settings, or raise a RequestError."""
    try:
        algorithm = resolve_algorithm(
            settings.algorithm or ("pafot" if settings.generations else "random")
        )
    except ValueError as error:
        raise RequestError(str(error)) from error
    # Otherwise, such a search would silently ignore the option.
    if algorithm.draws_by_number and settings.generations:
        raise RequestError(
            f"generations: expected no generations for {algorithm.name!r}, received {settings.generations}. Only "
            "algorithms that breed have generations. Give a number of runs, or omit the algorithm: with generations, "
            "the default is the paper's algorithm, pafot."
        )
    names = ("ads", "blame", "world")
    own = {name: arguments[name] for name in names if name in arguments}
    # A name without a colon is a fixture, which only pytest can resolve.
    if isinstance(own.get("ads"), str) and ":" in own["ads"]:
        try:
            own["ads"] = factory_named(own["ads"])
        except ValueError as error:
            raise RequestError(f"{place}(ads=...): {error}") from error
    if isinstance(own.get("world"), str):
        own["world"] = named_world(own["world"], f"{place}(world=...)")
    request = Request(
        settings=settings,
        algorithm=algorithm,
        fitness=algorithm.fitness if arguments.get("fitness") is None else arguments["fitness"],
        space={
            name: arguments[name]
            for name in SpaceArguments.__annotations__
            if arguments.get(name) is not None
        },
        place=place,
        **own,
    )
    goal = request.fitness
    if request.world is not None:
        _refuse_other_worlds(request.world, f"{place}(world=...): expected")
    problem_of_ads = _problem_of_ads(request.ads)
    if problem_of_ads:
        raise request.error("ads=...", problem_of_ads)
    if request.blame not in BLAMES:
        raise request.error(
            "blame=...",
            f"expected {' or '.join(BLAMES)}, received {request.blame!r}. blame='ego' counts all "
            "failures except collisions for which only an NPC is at fault",
        )
    for name in BUDGETS:
        # or "0"; the search would always pass
        if arguments.get(name) is not None and int(arguments[name]) == 0:
            problem = f"expected at least 1, because 0 {name} test nothing. To only replay, use {flag('runs', 0)}"
            raise request.error(f"{name}=0", problem)
    if not (isinstance(goal, str) or callable(goal)):
        raise request.error(
            "fitness=...",
            "expected default, paper, av-fuzzer, a measure such as headway, or a function of a Trace that returns a "
            f"float, received {goal!r}",
        )
    return request


def check_names(arguments: Iterable[str], *, place: str = "@pafot.search") -> None:
    """Raise a RequestError for an unknown argument, and suggest a similar one."""
    known = SearchArguments.__annotations__
    unknown = next((name for name in arguments if name not in known), None)
    if unknown is None:
        return
    # The option exists, but in another place, so say where.
    if unknown in BY_NAME:
        raise RequestError(
            f"{place}({unknown}=...): this option applies to the whole session. Use {BY_NAME[unknown].flag} on the "
            "command line."
        )
    if unknown in {each.name for each in fields(Highway)}:
        raise RequestError(
            f"{place}({unknown}=...): expected an argument of a search, received one of a world. Write "
            f"world=pafot.Highway({unknown}=...)"
        )
    expected = (
        f"expected one of {', '.join(sorted(known))}, received {unknown!r}{suggest(unknown, known)}"
    )
    raise RequestError(f"{place}({unknown}=...): {expected}")


def build_world(request: Request, fixture_world: Any) -> BaseWorld:
    """Return the world of a search: the mark's world or, without one, the fixture's.

    Raises:
        RequestError: if the chains do not fit the world, or if the fixture returns no world.
    """
    if request.world is not None:
        return request.world  # type: ignore[no-any-return]  # it is already checked
    # If the mark specifies the length of the chains, runs on the fixture's Highway have the same length.
    if isinstance(fixture_world, Highway) and not {"genes", "gene_seconds"}.isdisjoint(
        request.space
    ):
        try:
            space = SearchSpace(**request.space)
            fixture_world = replace(fixture_world, duration=space.genes * space.gene_seconds)
        except (TypeError, ValueError) as error:
            raise request.error(", ".join(request.space), error) from None
    return _refuse_other_worlds(fixture_world, "expected the fixture pafot_world to return")


def build_space(request: Request, world: BaseWorld) -> SearchSpace:
    """Return the space from which a search samples scenarios.

    Raises:
        RequestError: if an argument is out of range, if no scenario is possible, or if the world cannot be built.
    """
    given = ", ".join(request.space)
    try:
        # Check this first, because an error of the space would not mention the algorithm.
        kinds = request.algorithm.instructions
        if request.space.get("instructions", kinds[0]) not in kinds:
            raise request.error(
                "instructions=...",
                f"expected {' or '.join(map(repr, kinds))} for the algorithm {request.algorithm.name}, received "
                f"{request.space['instructions']!r:.100}",
            )
        SearchSpace(**request.space)
        # A truck that cannot follow a bend would make every scenario invalid.
        vehicles = named_vehicles(request.space.get("vehicles", (CAR,)))
        if odd := next((each for each in vehicles if not world.can_drive(each)), None):
            raise request.error(
                "vehicles=...",
                f"expected vehicles that fit the roads of {world!r:.100}, received {odd.described}. A long vehicle "
                "cannot follow tight curves",
            )
        # The paper's algorithms use the paper's space. The others have their own defaults.
        drawn: dict[str, Any] = {}
        if not request.algorithm.is_papers:
            drawn = drawn_space(world, {"instructions": kinds[-1], **request.space})
        if request.algorithm.draws_vehicles:
            drawn["vehicles"] = tuple(filter(world.can_drive, READY.values()))
        # The user's arguments override the defaults. The world adds the rest, such as crossings and the length of the
        # chains.
        space = world.space({**drawn, **request.space})
        # From here on, an error concerns the values together, so the message shows them.
        given = ", ".join(f"{name}={value!r}" for name, value in request.space.items())
        # so that a wrong argument raises one clear error before the search starts
        sample(space, rng_of(0))
    except WorldError as error:
        raise request.error("world=...", error) from None
    except (TypeError, ValueError) as error:
        raise request.error(given, error) from None
    return space


def drawn_space(world: BaseWorld, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the space's default arguments for algorithms that do not use the paper's space."""
    drawn: dict[str, Any] = {"traffic": given.get("traffic", HOSTILE)}
    in_lanes = given.get("instructions") != "cells"
    if in_lanes:
        drawn["instructions"] = given.get("instructions", "both")
    draws_genes = "genes" not in given and "gene_seconds" not in given
    road = world.straight_road
    if road is None:
        if draws_genes and in_lanes:
            drawn |= {
                "gene_seconds": SLICE,
                "genes": max(1, math.ceil(world.longest_run / SLICE - 1e-9)),
            }
        return drawn | _crossing_space(world, given)
    # On a straight road, add patterns of traffic, and sample the number of NPCs, the durations and the start if they
    # are not given. An environment defines the start of its ego, so the start is sampled only for other worlds.
    drawn["patterns"] = True
    # Only lanes with enough cells for all NPCs can be the ego's.
    npcs, lane = given.get("npcs", NPCS), given.get("ego_lane", EGO_LANE)
    if "ego_lane" not in given and road.lane_count <= EGO_LANE:  # a road of one lane
        drawn["ego_lane"] = lane = 0
        npcs = given.get("npcs", len(road.cells(0)) - 1)
    draws_lane = isinstance(world, (Highway, SimulatorWorld)) and "ego_lane" not in given
    lanes = tuple(each for each in range(road.lane_count) if len(road.cells(each)) > npcs)
    if lane in lanes:
        drawn["npcs"] = npcs
        if "npcs" not in given:
            starts = lanes if draws_lane else [each for each in lanes if each == lane]
            drawn["most_npcs"] = tuple(min(MOST_NPCS, len(road.cells(each)) - 1) for each in starts)
            drawn["least_npcs"] = min(LEAST_NPCS, *drawn["most_npcs"]) if in_lanes else 1
    if draws_genes:
        drawn["gene_durations"] = SLICES if in_lanes else GENE_DURATIONS
    # With one lane for all scenarios, a policy that fails only in an outer lane would pass.
    if draws_lane:
        drawn["ego_lanes"] = lanes
    if isinstance(world, (Highway, SimulatorWorld)) and "ego_speed" not in given:
        limit = world.speed_limit
        # Hostile traffic may be slow, but an ego at walking speed tests little.
        slowest = max(min(SLOWEST_START, limit / 2), STYLES[drawn["traffic"]].least_speed(limit))
        drawn |= {"ego_speed": min(EGO_SPEED, limit), "ego_speeds": (slowest, limit)}
    return drawn


def _crossing_space(world: BaseWorld, given: Mapping[str, Any]) -> dict[str, Any]:
    crossings = world.crossings
    if crossings is None:
        return {}
    drawn: dict[str, Any] = {
        "crossings": crossings,
        "most_on_grid": min(MOST_ON_GRID, world.most_on_grid),
    }
    return drawn if "npcs" in given else drawn | {"most_npcs": (MOST_CROSSING,)}


def _refuse_other_worlds(given: Any, start: str) -> BaseWorld:
    # Return a world of this package, or raise an error that starts with `start`.
    try:
        return checked_world(given)
    except WorldError as error:
        hint = hint_at_world(given) or f". {capitalised(error.fix)}"
        raise RequestError(f"{start} {error.expected}, received {error.received}{hint}") from None


def named_world(
    reference: str, place: str, *, config: dict[str, Any] | None = None, is_planner: bool = False
) -> Any:
    """Return the world that a string such as ``module:factory`` names.

    Args:
        reference: the id of an environment, ``module:id``, or ``module:factory``. The module is imported,
            because it can register the environment.
        place: the argument or option that contains the string, for error messages.
        config: the options of an environment.
        is_planner: whether the ADS in that environment is a planner in SI units.

    Raises:
        RequestError: if the string does not name a world.
    """
    module, colon, name = reference.partition(":")
    is_factory = name.partition(":")[0].isidentifier()
    try:
        if colon:
            imported(reference)
        if not is_factory:
            return World(name or module, config, planner_hz=PLANNER_HZ if is_planner else None)
        factory = factory_named(reference, "a factory that returns a world")
    except ValueError as error:
        raise RequestError(f"{place}: {error}") from error
    if config is not None:
        fix = "Set the options in the factory, as in pafot.World(..., config=...)"
        raise RequestError(
            f"{place}: expected the id of an environment for --config, received {reference!r}. {fix}"
        )
    try:
        made = factory()
    except (Exception, SystemExit) as error:
        # If the code of the factory has not started, it was called with too few or too many arguments.
        begun = (
            not isinstance(error, TypeError)
            or error.__traceback__ is None
            or error.__traceback__.tb_next
        )
        fix = "Correct it"
        if not begun:
            fix = "Add its argument to the string, as in module:factory:argument"
        received = f"{reference!r}, which raises {described(error)}"
        raise RequestError(
            f"{place}: expected a factory that returns a world, received {received}. {fix}"
        ) from error
    _refuse_other_worlds(made, f"{place}: expected the factory {reference!r} to return")
    # The world would pass the planner's numbers to the environment as if they were its own actions.
    if is_planner and getattr(made, "planner_hz", PLANNER_HZ) is None:
        fix = "Return pafot.World(..., planner_hz=5) from the factory"
        raise RequestError(
            f"{place}: expected a world for a planner, received {reference!r}, which is not one. {fix}"
        )
    return made


def hint_at_world(given: Any) -> str:
    """Return advice if a value is only part of a world, such as an environment; otherwise, return an empty string."""
    spec = getattr(given, "spec", None)  # set on an environment that gymnasium made
    env_id = given if isinstance(given, str) else getattr(spec, "id", None)
    config = ", config=..." if getattr(spec, "kwargs", {}).get("config") else ""
    if isinstance(given, type) and issubclass(given, BaseWorld):
        return f". Call it: {given.__name__}(...)"
    simulator = given if isinstance(given, type) else type(given)
    if issubclass(simulator, Simulator):
        return f". Write pafot.SimulatorWorld({simulator.__name__})"
    if given is None:
        return '. Return a world, such as pafot.World("highway-v0")'
    try:
        # The only way to learn whether the id is an environment of highway-env.
        World(env_id or "").environment.make()
    except WorldError:
        return ""
    return f'. Did you mean pafot.World("{env_id}"{config})?'


def _problem_of_ads(value: object) -> str:
    if callable(value) or (isinstance(value, str) and value.isidentifier()):
        return ""
    hint = hint_at_object(value)
    if isinstance(value, str):
        hint = f"Load a model in the factory, as in `ads=lambda: MyPlanner({value!r})`"
    return (
        "expected the name of a fixture or a factory such as `lambda: MyPlanner()`, received "
        f"{safe_repr(value)}{f'. {hint}' if hint else ''}"
    )
