"""ADSs and their factories: calls of factories, and what they are told about what a factory returns."""

from __future__ import annotations

import copy
import functools
import inspect
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from types import FunctionType
from typing import Any

from pytest_pafot.model.sight import Sight
from pytest_pafot.support.errors import AdsFactoryError, WorldError, refused_policy
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.conditions import Conditions, Evaluated
from pytest_pafot.world.guard.hang_guard import Around, one_process, unending
from pytest_pafot.world.kernel.observation import Observation, Observer, Sensor

PREDICTING = "`lambda: lambda observation: model.predict(observation, deterministic=True)[0]`"
"""An example of a factory whose ADS calls a trained model, for messages."""

AdsFactory = Callable[..., Any]
"""A callable that returns a fresh ADS; it is called once per scenario.

It may have these optional members: a method ``check_world(world)``, which raises if its ADSs cannot drive there; a
method ``preload()``, which the session calls so that forked processes share what it loads; and a text
``loading_hint``, which a search reports as a note.
"""


def is_vehicle_class(candidate: object) -> bool:
    """Return whether an object is a highway-env vehicle class, or a ``functools.partial`` of one."""
    inner = candidate.func if isinstance(candidate, functools.partial) else candidate
    kinematics = sys.modules.get("highway_env.vehicle.kinematics")  # imported wherever a vehicle class exists
    return kinematics is not None and isinstance(inner, type) and issubclass(inner, kinematics.Vehicle)


def make_ads(factory: AdsFactory, **arguments: Any) -> Any:
    """Make a fresh ADS; a vehicle class is returned as it is.

    Raises:
        AdsFactoryError: if the factory cannot be called with these arguments, or returns nothing that drives.
    """
    if is_vehicle_class(factory):
        return _checked_vehicle_class(factory)
    if not callable(factory):
        hint = hint_at_object(factory) or "Return one from the fixture, such as `return lambda: MyPlanner()`"
        raise AdsFactoryError(
            "ads: expected a factory, a callable that returns a fresh ADS for each scenario, received "
            f"{shown(factory)}. {hint}"
        )
    _check_call(factory, arguments)
    try:
        with unending(), one_process():
            ads = factory(**arguments)
    except SystemExit as error:
        raise AdsFactoryError(
            f"ads: expected the factory to return an ADS, received SystemExit: {error}. It calls sys.exit: let it "
            "raise an error instead"
        ) from error
    except TypeError as error:
        if re.search(r"__init__\(\) missing .*'position'", str(error)):
            error.add_note(
                "To let a highway-env vehicle drive, give its class itself, as in `ads=MyVehicle`, without calling it: "
                "each run makes its own vehicle."
            )
        raise
    if isinstance(getattr(ads, "sight", None), Sight):
        _check_sight_is_told(factory, ads.sight)
    if is_vehicle_class(ads):
        return _checked_vehicle_class(ads)
    if callable(ads):
        return ads
    hint = hint_at_object(ads) or (
        "An action is what the ADS returns: write `lambda: lambda observation: ...`, or `lambda: MyPlanner()`"
    )
    raise AdsFactoryError(
        "ads: expected the factory to return an ADS, a callable `observation -> action` or a highway-env vehicle "
        f"class, received {shown(ads)}. {'Is a `return` missing in it?' if ads is None else hint}"
    )


@functools.lru_cache(maxsize=1)  # a run of the kernel takes little longer than the signature of its vehicle class
def _checked_vehicle_class(vehicle_class: Any) -> Any:
    """Return a vehicle class that each run can call with a road, a position, a heading and a speed."""
    signature = inspect.signature(vehicle_class)
    try:
        signature.bind(None, [0.0, 0.0], 0.0, 0.0)
    except TypeError as error:
        name = getattr(vehicle_class, "func", vehicle_class).__name__
        raise AdsFactoryError(
            "ads: expected a highway-env vehicle class that can be called with (road, position, heading, speed), "
            f"received {name} with the signature {signature} ({error}). Give its other arguments by name, as in "
            f"`ads=functools.partial({name}, <name>=<value>)`, or write a subclass without them"
        ) from None
    return vehicle_class


def _check_sight_is_told(factory: AdsFactory, sight: Sight) -> None:
    """Refuse an imperfect sight that only the ADS has, because a reader of the factory would assume perfect sight."""
    seeing = inspect.unwrap(factory, stop=lambda each: getattr(each, "sight", None) == sight)
    if getattr(seeing, "sight", None) != sight:
        raise AdsFactoryError(
            f"ads: expected a pafot.Perception as the factory itself, received a pafot.Perception that "
            f"{shown(factory)} makes, so findings would not state the imperfect sight; write "
            "`ads=pafot.Perception(lambda: MyPlanner(), ...)`, or return that from the fixture"
        )


def hint_at_object(given: Any) -> str:
    """Return a hint for a vehicle or a model with a method such as ``predict``, which is no ADS; otherwise empty."""
    if is_vehicle_class(type(given)):
        name = type(given).__name__
        return f"Give the class itself, `{name}`, without calling it: each run makes its own vehicle"
    method = next((name for name in ("predict", "act", "decide", "step") if callable(getattr(given, name, None))), "")
    if not method:
        return ""
    example = f", {PREDICTING}" if method == "predict" else ""
    return f"It has a method {method!r}: let the factory return a function of the observation that calls it{example}"


def takes_nothing(factory: AdsFactory) -> bool:
    """Return whether a factory is a plain function without parameters; this is much faster than its signature."""
    if type(factory) is not FunctionType or factory.__dict__:
        return False
    code = factory.__code__
    takes_any_number = code.co_flags & (inspect.CO_VARARGS | inspect.CO_VARKEYWORDS)
    return not (code.co_argcount or code.co_kwonlyargcount or takes_any_number)


def _check_call(factory: AdsFactory, arguments: dict[str, Any]) -> None:
    if not arguments and takes_nothing(factory):
        return
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):  # builtins without a signature
        return
    try:
        signature.bind(**arguments)
    except TypeError as error:
        given = "with env=<environment>" if arguments else "without arguments"
        inner = inspect.unwrap(factory)
        if isinstance(inner, type):
            hint = f"Give the arguments in a function, `lambda: {inner.__name__}(...)`"
        elif getattr(inner, "__name__", "") == "predict":
            hint = f"For a model, write {PREDICTING}"
        elif inspect.isfunction(inner) and inner.__name__ != "<lambda>":
            name = inner.__name__
            hint = f"If {name} is the ADS itself, write `lambda: {name}`; if it makes one, `lambda: {name}(...)`"
        else:
            hint = (
                "An ADS itself is not a factory. Wrap it so that each scenario gets a fresh one: "
                "`lambda: MyPlanner()`, or `return lambda: MyPlanner()` in the fixture"
            )
        raise AdsFactoryError(
            f"ads: expected a factory that can be called {given}, received one with the signature {signature} "
            f"({error}). {hint}"
        ) from None


def give_route(vehicle: Any, route: Sequence[Any] | None) -> None:
    """Give a vehicle a copy of the environment's route, if both have one; highway-env shortens it while driving."""
    if route is not None and hasattr(vehicle, "route"):
        vehicle.route = list(route)


DRIVES_ITSELF = "a highway-env vehicle class drives itself and reads the road, so nothing can be hidden from it"


@dataclass(frozen=True)
class Perception(Sight):
    """A factory that wraps an ADS factory, so that the ADS sees the other vehicles imperfectly.

    The ADS sees the road and fixed objects exactly. All random values follow from the scenario's seed,
    so a scenario gives the same run each time and in any process.

    Attributes:
        ads: the wrapped factory, of planners in SI units.
        range: largest distance between centres at which it sees a vehicle [m].
        latency: age of what it sees of others [s], rounded up to whole physics ticks; before, it sees the start. Its
            own state is current.
        noise: standard deviations of normal errors of the others' ``"position"``, along x and along y [m], and
            ``"speed"`` [m/s]. Sampled for each vehicle at each decision.
        dropout: probability that it does not see a vehicle at a decision.

    Raises:
        FieldError: for an impossible value, such as a negative latency.
        AdsFactoryError: if ``ads`` is a vehicle class, which drives itself, or already a Perception.
    """

    ads: AdsFactory

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "__wrapped__", self.ads)  # inspect takes the signature from there
        fix = ""
        if isinstance(self.ads, Perception):
            fix = "give all imperfections to one Perception"
        elif is_vehicle_class(self.ads):
            fix = DRIVES_ITSELF
        elif not callable(self.ads):
            fix = "give a function or class that makes one, such as `pafot.Perception(MyPlanner, latency=0.3)`"
        if fix:
            raise refused_policy("the factory of an ADS, called for each scenario", shown(self.ads), fix)

    @property
    def sight(self) -> Sight:
        """The imperfections of the ADS's sight."""
        return Sight(**{each.name: getattr(self, each.name) for each in fields(Sight)})

    def __call__(self, *observations: Any, **arguments: Any) -> Any:
        """Make a fresh ADS with this sight.

        Raises:
            AdsFactoryError: if it is called with an observation, like an ADS; if the factory cannot be called; or if
                the factory returns a vehicle class or nothing that drives.
        """
        if observations:
            received = "a call of it with an observation, as if it were the ADS"
            fix = "write `ads=pafot.Perception(MyPlanner, ...)`, or return this object from the fixture"
            raise refused_policy("a pafot.Perception that is used as the factory", received, fix)
        ads = make_ads(self.ads, **arguments)
        if is_vehicle_class(ads):
            raise refused_policy("a callable in a Perception", shown(ads), DRIVES_ITSELF)
        return SeeingAds(ads, self.sight)


@dataclass(frozen=True, eq=False)
class SeeingAds:
    """An ADS with an imperfect sight; a run passes to ``ads`` only what this sight lets it see."""

    ads: Any
    sight: Sight

    def __call__(self, *_: Any) -> Any:
        """Refuse a call, which only a world without support for sights makes."""
        expected = "pafot.Highway or pafot.World for an ADS in a pafot.Perception"
        received, fix = "a world that calls the ADS directly", "apply the imperfect sight in that world itself"
        raise WorldError(field="world", expected=expected, received=received, fix=fix)

    @property
    def close(self) -> Any:
        """The ADS's own ``close``."""
        return self.ads.close


def rewrapped(ads: Any, wrap: Callable[[Any], Any]) -> Any:
    """Return what ``wrap`` makes of an ADS, with the sight that the ADS has.

    Raises:
        AdsFactoryError: for a vehicle class, which receives no observations.
    """
    if is_vehicle_class(ads):
        raise AdsFactoryError(f"ads: {DRIVES_ITSELF}")
    return replace(ads, ads=wrap(ads.ads)) if isinstance(ads, SeeingAds) else wrap(ads)


def ads_and_sight(ads: Any) -> tuple[Any, Sight | None]:
    """Return the ADS that receives observations, and its sight, which is None for perfect sight."""
    return (ads.ads, ads.sight) if isinstance(ads, SeeingAds) else (ads, None)


def sight_of(factory: Any) -> Sight | None:
    """Return the sight of a factory's ADSs; None for perfect sight."""
    factory = inspect.unwrap(factory, stop=lambda each: isinstance(each, Perception))
    return factory.sight if isinstance(factory, Perception) and factory.imperfections else None


class ImperfectSensor(Sensor):
    """The maker of imperfect observations on a straight road.

    Args:
        sensor: the maker of the exact observations, also of earlier ticks.
        sight: the imperfections.
        seed: the scenario's seed, from which all errors follow.
    """

    def __init__(self, sensor: Observer, sight: Sight, seed: int) -> None:
        super().__init__()
        self._sensor, self._sight, self._seed = sensor, sight, seed

    def observation(self, tick: int) -> Observation:
        """Make an imperfect observation from the exact observations now and at the time of measurement."""
        exact = self._sensor
        now, then = (exact.observation(each) for each in (tick, max(0, tick - self._sight.delay(exact.physics_hz))))
        others, ids, lateral = [], [], [now.lateral_velocities[0]]
        for npc, error_x, error_y, error_speed in self._sight.glimpses(then.array, self._seed, tick):
            was = then.others[npc]
            x, y = was.x + error_x, was.y + error_y
            lane = exact.lanes.closest(x, y, was.heading)
            others.append(was._replace(x=x, y=y, speed=was.speed + error_speed, lane=lane))
            ids.append(npc)
            lateral.append(then.lateral_velocities[npc + 1] + error_speed * math.sin(was.heading))
        return now.replace(others=tuple(others), ids=tuple(ids), lateral_velocities=tuple(lateral))


@dataclass(frozen=True, slots=True, eq=False)
class Ads:
    """The ADS that a policy has made for one run.

    Attributes:
        given: the ADS itself; it is closed after the run.
        decides: what receives the observations that its sight lets through; or a vehicle class, which needs none.
        sight: its sight; None for perfect sight.
        drives_itself: True if it is a vehicle class, which a factory may also return.
    """

    given: Any
    decides: Any
    sight: Sight | None
    drives_itself: bool

    @property
    def policy(self) -> Any:
        """What decides, if it receives the observations of an environment.

        Raises:
            AdsFactoryError: for an imperfect sight, which only planners in SI units can have.
        """
        if self.sight is not None and self.sight.imperfections:
            received = "a policy for the observations of an environment"
            fix = "give it a wrapper of your own that changes these observations"
            raise refused_policy("a planner in SI units in a pafot.Perception", received, fix)
        return self.decides


@dataclass(frozen=True, eq=False)
class Policy:
    """A policy: the factory of its ADSs, or a vehicle class, and what only these can say about it.

    What they say is asked once, when it is needed.
    """

    factory: AdsFactory

    @cached_property
    def drives_itself(self) -> bool:
        """True for a vehicle class of highway-env, which is no factory: it reads the road and returns no decisions."""
        return is_vehicle_class(self.factory)

    @cached_property
    def simulates(self) -> bool:
        """True if the factory has a parameter ``env``: its ADSs simulate inside the environment."""
        if self.drives_itself or takes_nothing(self.factory):
            return False
        try:
            return "env" in inspect.signature(self.factory).parameters
        except (TypeError, ValueError):  # builtins without a signature
            return False

    @property
    def only_observes(self) -> bool:
        """True if its ADSs decide from observations alone, so that these can be made for any world and at any time."""
        return not (self.drives_itself or self.simulates)

    @cached_property
    def sight(self) -> Sight | None:
        """The sight of its ADSs; None for perfect sight."""
        return sight_of(self.factory)

    @property
    def loading_hint(self) -> str:
        """The factory's note that its policy may need other options for loading; empty if it has none."""
        stated = self._own("loading_hint")
        return stated if isinstance(stated, str) else ""

    def preload(self) -> None:
        """Call the factory's ``preload``, if it has one, so that forked processes share what it loads."""
        load = self._own("preload")
        if load is not None:
            load()

    def check_drives_in(self, world: Any) -> None:
        """Call the factory's ``check_world``, if it has one; its error reports what does not fit the world."""
        check = self._own("check_world")
        if check is not None:
            check(world)

    def make(self, **arguments: Any) -> Ads:
        """Make a fresh ADS, see :func:`make_ads`."""
        given = make_ads(self.factory, **arguments)
        decides, sight = ads_and_sight(given)
        return Ads(given, decides, sight, drives_itself=is_vehicle_class(given))

    def _own(self, name: str) -> Any:
        """Return an attribute of the factory or of the factory that it wraps; None if there is none.

        A class has none, because its attributes belong to its instances, the ADSs.
        """
        inner = inspect.unwrap(self.factory)
        return None if isinstance(inner, type) else getattr(inner, name, None)


CONSTANTS = (
    "LENGTH", "WIDTH", "ACC_MAX", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED", "DELTA",
    "POLITENESS", "LANE_CHANGE_MIN_ACC_GAIN", "LANE_CHANGE_MAX_BRAKING_IMPOSED", "LANE_CHANGE_DELAY", "KP_HEADING",
    "KP_LATERAL", "MAX_STEERING_ANGLE", "KP_A",
)  # fmt: skip
"""The constants of ``IDMVehicle`` that a subclass may set."""
POSITIVE = ("LENGTH", "WIDTH", "COMFORT_ACC_MAX", "DELTA", "LANE_CHANGE_DELAY")
"""Those that must be positive for the model; with others, highway-env's code runs and gets NaN or worse."""
PURSUIT = 0.1
"""The time constant of highway-env's steering [s], which is also the kernel's."""
OF_UTILS = ("not_zero", "wrap_to_pi")
"""The functions of ``highway_env.utils`` that the model calls."""
ORDINARY = frozenset({
    "__module__", "__qualname__", "__doc__", "__annotations__", "__annotate__", "__annotate_func__",
    "__firstlineno__", "__static_attributes__", "__abstractmethods__", "_abc_impl",
})  # fmt: skip
"""The attributes that Python itself adds to a class."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdmModel:
    """The constants of a vehicle class that drives by IDM and MOBIL, and whether it changes lanes."""

    constants: Mapping[str, float]
    changes_lanes: bool


def is_patched(cls: type) -> bool:
    """Return whether a class of highway-env has functions that were put into it later, such as by a test."""
    module, qualname = cls.__module__, cls.__qualname__
    for name, each in vars(cls).items():  # plain comparisons, because every run of a vehicle class asks
        if type(each) is FunctionType and (each.__qualname__ != f"{qualname}.{name}" or each.__module__ != module):
            return True
    return False


def takes(constants: Mapping[str, Any]) -> bool:
    """Return whether the model has an answer with these constants, of a class or of one vehicle."""
    if not all(isinstance(value, (int, float)) and math.isfinite(value) for value in constants.values()):
        return False
    return constants["COMFORT_ACC_MIN"] < 0 and all(constants[name] > 0 for name in POSITIVE)


def idm_model(ads: Any) -> IdmModel | None:
    """Return the model of a vehicle class or a ``functools.partial`` of one; None if the class has its own code."""
    whole = ads if isinstance(ads, functools.partial) else functools.partial(ads)
    cls, options = whole.func, whole.keywords
    stock = getattr(sys.modules.get("highway_env.vehicle.behavior"), "IDMVehicle", None)
    if stock is None or not isinstance(cls, type) or not issubclass(cls, stock):
        return None
    own = [base for base in cls.__mro__ if base not in stock.__mro__]  # a base may also stand behind the stock class
    only_sets_constants = all(set(vars(base)) <= ORDINARY | set(CONSTANTS) for base in own)
    if whole.args or set(options) - {"enable_lane_change"} or not only_sets_constants:
        return None
    utils, roads = sys.modules["highway_env.utils"], sys.modules["highway_env.road.road"]
    other_code = any(map(is_patched, [*stock.__mro__, roads.Road, roads.RoadNetwork])) or any(
        (each.__module__, each.__qualname__) != (utils.__name__, name)
        for name, each in ((name, getattr(utils, name)) for name in OF_UTILS)
    )
    if type(cls).__call__ is not type.__call__ or other_code or stock.TAU_PURSUIT != PURSUIT:
        return None
    named = {name: value for base in reversed(cls.__mro__) for name, value in vars(base).items()}
    constants = {name: named[name] for name in CONSTANTS}  # without getattr, because a descriptor is no constant
    if not takes(constants):
        return None
    return IdmModel(constants=constants, changes_lanes=bool(options.get("enable_lane_change", True)))


Check = Callable[[Any], Any]
"""A function that returns an action as a run stores it, and raises an error for anything else."""


@dataclass(slots=True, kw_only=True)
class Aside:
    """The decisions of an ADS beside a run.

    Attributes:
        asked: the number of decisions that it was asked for.
        answers: its actions, one per decision; None where it raised an error.
        at: what it would have seen at the decision of a question, had nothing been changed; None without one.
        conditions: those that it evaluated in this decision, with their values, if the question is about them.
    """

    asked: int = 0
    answers: list[Any] = field(default_factory=list)
    at: Any = None
    conditions: list[Evaluated] = field(default_factory=list)

    def of(self, number: int) -> Any:
        """Return the action of a decision; None without one."""
        return self.answers[number] if number < len(self.answers) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """A decision at which what an ADS sees is noted, or changed.

    Attributes:
        number: the number of the decision.
        instead: what it sees there instead; None for what there is to see.
        is_noted: False if what it sees need not be noted, which may be anything of a simulator.
        conditions: what records the conditions that it evaluates there; None if nothing does.
    """

    number: int
    instead: Any = None
    is_noted: bool = True
    conditions: Conditions | None = None


class Shadow(Around):
    """An ADS of whose decisions a run is told nothing: the run gets the recorded actions."""

    def __init__(self, ads: Any, actions: Sequence[Any], check: Check, aside: Aside, question: Question | None) -> None:
        super().__init__(ads)
        self._actions, self._check, self._aside, self._question = actions, check, aside, question

    def __call__(self, observation: Any) -> Any:
        """Decide, note the decision, and return the recorded one."""
        aside, number = self._aside, len(self._aside.answers)
        question = self._question
        recording: AbstractContextManager[None] = nullcontext()
        if question is not None and question.instead is not None and question.number < number < len(self._actions):
            # What it would decide here says nothing about the question.
            aside.answers.append(self._actions[number])
            return self._actions[number]
        if question is not None and number == question.number:
            aside.at = copy.deepcopy(observation) if question.is_noted else None  # the ADS may write into it
            observation = observation if question.instead is None else question.instead
            if question.conditions is not None:
                recording = question.conditions.recorded(self._ads, aside.conditions)
        aside.asked += 1
        try:
            with recording:
                answer = self._check(self._ads(observation))
        except Exception:  # noqa: BLE001  (an ADS may raise anything about an observation that it never had)
            answer = None
        aside.answers.append(answer)
        return self._actions[number] if number < len(self._actions) else answer


def beside(
    factory: AdsFactory, actions: Sequence[Any], check: Check, aside: Aside, question: Question | None = None
) -> AdsFactory:
    """Return a factory of ADSs that decide beside a run, which gets the recorded actions.

    Raises:
        AdsFactoryError: when it makes an ADS, if that is a vehicle class.
    """
    return wrapped(factory, lambda ads: Shadow(ads, actions, check, aside, question))


class _Ending(Around):
    """An ADS that raises an error instead of its next decision when it has made all that are of interest."""

    def __init__(self, ads: Any, decisions: int) -> None:
        super().__init__(ads)
        self._left = decisions

    def __call__(self, observation: Any) -> Any:
        if self._left <= 0:
            raise RuntimeError("no more decisions are of interest")
        self._left -= 1
        return self._ads(observation)


class Unseeing(Around):
    """An ADS that does not see one NPC of a scenario.

    It takes the NPC from a planner's observations. Those of an environment are made without it, see :func:`hide`.
    """

    def __init__(self, ads: Any, npc: int) -> None:
        super().__init__(ads)
        self.npc = npc

    def __call__(self, seen: Any) -> Any:
        """Decide without the NPC."""
        if isinstance(seen, Observation):
            seen = changed(seen, self.npc, None) if self.npc in seen.ids else seen
            seen = seen.replace(crossing=tuple([each for each in seen.crossing if each.id != self.npc]))
        return self._ads(seen)


def check_by(ads: Any, check: Check) -> None:
    """Give the check of a run's actions to an ADS that decides beside the run, if it is one."""
    shadow = ads._ads if isinstance(ads, Unseeing) else ads
    if isinstance(shadow, Shadow):
        shadow._check = check


def without(factory: AdsFactory, npc: int) -> AdsFactory:
    """Return a factory of the same ADSs, from which one NPC is hidden."""
    return wrapped(factory, lambda ads: Unseeing(ads, npc))


def ending_after(factory: AdsFactory, decisions: int) -> AdsFactory:
    """Return a factory of ADSs that raise an error after a number of decisions."""
    return wrapped(factory, lambda ads: _Ending(ads, decisions))


def repeating(action: Any) -> AdsFactory:
    """Return a factory of ADSs that always answer with the same action."""
    return lambda: lambda observation: action


def wrapped(factory: AdsFactory, wrap: Callable[[Any], Any]) -> AdsFactory:
    """Return a factory whose ADSs are wrapped, each in what ``wrap`` makes of it; they see what they see without.

    Raises:
        AdsFactoryError: when it makes an ADS, if that is a vehicle class.
    """

    def make(*observations: Any, **arguments: Any) -> Any:
        return rewrapped(factory(*observations, **arguments), wrap)

    return functools.wraps(factory, updated=())(make)


def changed(observation: Observation, npc: int, by: tuple[float, float, float] | None) -> Observation:
    """Return an observation in which a vehicle is elsewhere, or hidden; it must be among the ``others``.

    ``by`` is what is added to its x and y [m] and to its speed [m/s]; None hides it.
    """
    place, others = observation.ids.index(npc), list(observation.others)
    ids, lateral = list(observation.ids), list(observation.lateral_velocities)
    if by is None:
        del others[place], ids[place], lateral[place + 1]
    else:
        was, (x, y, speed) = others[place], by
        aside = [abs(centre - (was.y + y)) for centre in observation.lane_centres]
        others[place] = was._replace(x=was.x + x, y=was.y + y, speed=was.speed + speed, lane=aside.index(min(aside)))
    return observation.replace(others=tuple(others), ids=tuple(ids), lateral_velocities=tuple(lateral))
