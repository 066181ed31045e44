"""Factories of ADSs, with checks of the factories' calls and of the ADSs that they return."""

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
from pytest_pafot.support.text import safe_repr
from pytest_pafot.world.driving.conditions import Conditions, Evaluated
from pytest_pafot.world.guard.hang_guard import Around, one_process, unending
from pytest_pafot.world.kernel.observation import Observation, Observer, Sensor

# an example of a factory for a trained model, used in messages
PREDICTING = "`lambda: lambda observation: model.predict(observation, deterministic=True)[0]`"

AdsFactory = Callable[..., Any]
"""A callable that returns a fresh ADS. It is called once per scenario.

The callable can have these members: ``check_world(world)`` raises an error if its ADSs cannot drive in the world.
``preload()`` loads data that forked processes share. ``loading_hint`` is a string that the search reports as a note.
"""


def is_vehicle_class(candidate: object) -> bool:
    """Return whether an object is a highway-env vehicle class or a ``functools.partial`` of a vehicle class."""
    inner = candidate
    if isinstance(candidate, functools.partial):
        inner = candidate.func
    # imported wherever a vehicle class exists
    kinematics = sys.modules.get("highway_env.vehicle.kinematics")
    return (
        kinematics is not None and isinstance(inner, type) and issubclass(inner, kinematics.Vehicle)
    )


def make_ads(factory: AdsFactory, **arguments: Any) -> Any:
    """Create a fresh ADS, or return a vehicle class unchanged.

    Raises:
        AdsFactoryError: if the factory cannot be called with these arguments, or returns no ADS.
    """
    if is_vehicle_class(factory):
        return _checked_vehicle_class(factory)
    if not callable(factory):
        hint = (
            hint_at_object(factory)
            or "Return a factory from the fixture, for example `return lambda: MyPlanner()`"
        )
        raise AdsFactoryError(
            "ads: expected a factory, a callable that returns a new ADS for each scenario, received "
            f"{safe_repr(factory)}. {hint}"
        )
    _check_call(factory, arguments)
    try:
        with unending(), one_process():
            ads = factory(**arguments)
    except SystemExit as error:
        raise AdsFactoryError(
            f"ads: expected the factory to return an ADS, received SystemExit: {error}. The factory called "
            "sys.exit. Raise another exception instead"
        ) from error
    except TypeError as error:
        if re.search(r"__init__\(\) missing .*'position'", str(error)):
            error.add_note(
                "To use a highway-env vehicle, pass its class without calling it, as in `ads=MyVehicle`. Each run "
                "makes its own vehicle."
            )
        raise
    if isinstance(getattr(ads, "sight", None), Sight):
        _check_sight_is_told(factory, ads.sight)
    if is_vehicle_class(ads):
        return _checked_vehicle_class(ads)
    if callable(ads):
        return ads
    hint = hint_at_object(ads) or (
        "A factory returns an ADS, not an action. Write `lambda: lambda observation: ...`, or `lambda: MyPlanner()`"
    )
    if ads is None:
        hint = "Is a `return` missing?"
    raise AdsFactoryError(
        "ads: expected the factory to return a callable `observation -> action` or a highway-env vehicle class, "
        f"received {safe_repr(ads)}. {hint}"
    )


@functools.lru_cache(maxsize=1)  # a run in the kernel takes little longer than reading a signature
def _checked_vehicle_class(vehicle_class: Any) -> Any:
    signature = inspect.signature(vehicle_class)
    try:
        signature.bind(None, [0.0, 0.0], 0.0, 0.0)
    except TypeError as error:
        name = getattr(vehicle_class, "func", vehicle_class).__name__
        raise AdsFactoryError(
            "ads: expected a highway-env vehicle class that can be called with (road, position, heading, speed), "
            f"received {name} with the signature {signature} ({error}). Pass its other arguments by name, as in "
            f"`ads=functools.partial({name}, <name>=<value>)`, or write a subclass without them"
        ) from None
    return vehicle_class


def _check_sight_is_told(factory: AdsFactory, sight: Sight) -> None:
    # Code that sees only the factory, for example to save a finding, would assume perfect perception.
    seeing = inspect.unwrap(factory, stop=lambda each: getattr(each, "sight", None) == sight)
    if getattr(seeing, "sight", None) != sight:
        raise AdsFactoryError(
            f"ads: expected a pafot.Perception as the factory itself, received {safe_repr(factory)}, "
            f"which uses a pafot.Perception inside. Findings would not record the imperfect perception. Write "
            "`ads=pafot.Perception(lambda: MyPlanner(), ...)`, or return this object from the fixture"
        )


def hint_at_object(given: Any) -> str:
    """Return a hint for a vehicle or a model that is not an ADS, or an empty string."""
    if is_vehicle_class(type(given)):
        name = type(given).__name__
        return (
            f"Pass the class itself, `{name}`, without calling it. Each run makes its own vehicle"
        )
    for method in ("predict", "act", "decide", "step"):
        if callable(getattr(given, method, None)):
            hint = (
                f"It has a method {method!r}. Return a function that calls it with the observation"
            )
            if method == "predict":
                hint = f"{hint}, {PREDICTING}"
            return hint
    return ""


def takes_nothing(factory: AdsFactory) -> bool:
    """Return whether a factory is an ordinary function without parameters."""
    if type(factory) is not FunctionType or factory.__dict__:  # much faster than the signature
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
        given = "without arguments"
        if arguments:
            given = "with env=<environment>"
        inner = inspect.unwrap(factory)
        if isinstance(inner, type):
            hint = f"Wrap the call in a function that passes the arguments, such as `lambda: {inner.__name__}(...)`"
        elif getattr(inner, "__name__", "") == "predict":
            hint = f"For a model, write {PREDICTING}"
        elif inspect.isfunction(inner) and inner.__name__ != "<lambda>":
            name = inner.__name__
            hint = f"If {name} is an ADS, write `lambda: {name}`. If it makes one, write `lambda: {name}(...)`"
        else:
            hint = (
                "An ADS itself is not a factory. Wrap it so that each scenario gets a fresh ADS: "
                "`lambda: MyPlanner()`, or `return lambda: MyPlanner()` in the fixture"
            )
        raise AdsFactoryError(
            f"ads: expected a factory that can be called {given}, received one with the signature {signature} "
            f"({error}). {hint}"
        ) from None


def give_route(vehicle: Any, route: Sequence[Any] | None) -> None:
    """Give a vehicle a copy of the environment's route, if both have one."""
    # a copy, because highway-env shortens it during the run
    if route is not None and hasattr(vehicle, "route"):
        vehicle.route = list(route)


DRIVES_ITSELF = (
    "use a planner, because a vehicle class reads the road itself, so nothing can be hidden from it"
)


@dataclass(frozen=True)
class Perception(Sight):
    """A factory that wraps an ADS factory, so that the ADS sees the other vehicles imperfectly.

    The ADS sees the road and fixed objects exactly. All random values follow from the scenario's seed, so repeated runs
    of a scenario are identical, in any process.

    Attributes:
        ads: factory of the planner.
        range: largest distance [m] at which the planner sees another vehicle, measured between the centres.
        latency: age [s] of the observed states of other vehicles, rounded up to physics ticks. The ego's state is
            current.
        noise: standard deviations of the normally distributed errors in ``"position"``, for x and y [m], and in
            ``"speed"`` [m/s]. The errors of each vehicle are drawn anew for each decision.
        dropout: probability that the planner fails to see a particular vehicle at a decision.

    Raises:
        FieldError: for an impossible value, such as a negative latency.
        AdsFactoryError: if ``ads`` is a vehicle class, which drives itself, or is already a Perception.
    """

    ads: AdsFactory

    def __post_init__(self) -> None:
        super().__post_init__()
        # inspect then returns the signature of this factory
        object.__setattr__(self, "__wrapped__", self.ads)
        fix = ""
        if isinstance(self.ads, Perception):
            fix = "set all imperfections in one pafot.Perception"
        elif is_vehicle_class(self.ads):
            fix = DRIVES_ITSELF
        elif not callable(self.ads):
            fix = "pass a function or class that returns an ADS, as in `pafot.Perception(MyPlanner, latency=0.3)`"
        if fix:
            raise refused_policy(
                "a factory that returns a new ADS for each scenario",
                safe_repr(self.ads),
                fix,
            )

    @property
    def sight(self) -> Sight:
        return Sight(**{each.name: getattr(self, each.name) for each in fields(Sight)})

    def __call__(self, *observations: Any, **arguments: Any) -> Any:
        """Create a fresh ADS with this perception."""
        if observations:
            received = "a call with an observation, as if the Perception were the ADS"
            fix = "write `ads=pafot.Perception(MyPlanner, ...)`, or return this object from the fixture"
            raise refused_policy("a pafot.Perception to be used as the factory", received, fix)
        ads = make_ads(self.ads, **arguments)
        if is_vehicle_class(ads):
            raise refused_policy(
                "the factory in a pafot.Perception to return a planner",
                safe_repr(ads),
                DRIVES_ITSELF,
            )
        return SeeingAds(ads, self.sight)


@dataclass(frozen=True, eq=False)
class SeeingAds:
    """An ADS with imperfect perception. A run passes imperfect observations to ``ads``."""

    ads: Any
    sight: Sight

    def __call__(self, *_: Any) -> Any:
        expected = "pafot.Highway or pafot.World for an ADS in a pafot.Perception"
        received = "a world that calls the ADS directly"
        fix = "implement the imperfect perception in that world"
        raise WorldError(field="world", expected=expected, received=received, fix=fix)

    @property
    def close(self) -> Any:
        return self.ads.close


def rewrap_ads(ads: Any, wrap: Callable[[Any], Any]) -> Any:
    """Wrap an ADS, and keep its perception."""
    if is_vehicle_class(ads):
        raise AdsFactoryError(f"ads: {DRIVES_ITSELF}")
    if isinstance(ads, SeeingAds):
        return replace(ads, ads=wrap(ads.ads))
    return wrap(ads)


def ads_and_sight(ads: Any) -> tuple[Any, Sight | None]:
    """Return the ADS that receives observations, and its perception, or None if its perception is perfect."""
    if isinstance(ads, SeeingAds):
        return ads.ads, ads.sight
    return ads, None


def sight_of(factory: Any) -> Sight | None:
    """Return the perception of a factory's ADSs, or None if their perception is perfect."""
    factory = inspect.unwrap(factory, stop=lambda each: isinstance(each, Perception))
    if isinstance(factory, Perception) and factory.imperfections:
        return factory.sight
    return None


class ImperfectSensor(Sensor):
    """A source of imperfect observations on a straight road."""

    def __init__(self, sensor: Observer, sight: Sight, seed: int) -> None:
        super().__init__()
        self._sensor = sensor
        self._sight = sight
        self._seed = seed

    def observation(self, tick: int) -> Observation:
        exact = self._sensor
        # The state of the ego is current, but the states of other vehicles are as old as the latency.
        now = exact.observation(tick)
        then = exact.observation(max(0, tick - self._sight.delay(exact.physics_hz)))
        others = []
        ids = []
        lateral = [now.lateral_velocities[0]]
        glimpses = self._sight.glimpses(then.array, self._seed, tick)
        for npc, error_x, error_y, error_speed in glimpses:
            was = then.others[npc]
            x = was.x + error_x
            y = was.y + error_y
            lane = exact.lanes.closest(x, y, was.heading)
            others.append(was._replace(x=x, y=y, speed=was.speed + error_speed, lane=lane))
            ids.append(npc)
            lateral.append(then.lateral_velocities[npc + 1] + error_speed * math.sin(was.heading))
        return now.replace(others=tuple(others), ids=tuple(ids), lateral_velocities=tuple(lateral))


@dataclass(frozen=True, slots=True, eq=False)
class Ads:
    """The ADS that a policy has created for one run."""

    given: Any  # the return value of the factory, which is closed after the run
    # the callable that receives the observations, or a vehicle class, which needs none
    decides: Any
    sight: Sight | None
    drives_itself: bool  # true for a vehicle class, which a factory may also return

    @property
    def policy(self) -> Any:
        """The ADS, for a world in which it receives an environment's observations.

        Raises:
            AdsFactoryError: for imperfect perception, which only planners in SI units can have.
        """
        if self.sight is not None and self.sight.imperfections:
            received = "a policy that uses an environment's observations"
            fix = "to make these imperfect, write a wrapper"
            raise refused_policy(
                "the ADS in a pafot.Perception to be a planner in SI units",
                received,
                fix,
            )
        return self.decides


@dataclass(frozen=True, eq=False)
class Policy:
    """The factory of a test's ADSs, or a vehicle class, with cached properties."""

    factory: AdsFactory

    @cached_property
    def drives_itself(self) -> bool:
        """True if the policy is a highway-env vehicle class, which reads the road and returns no decisions."""
        return is_vehicle_class(self.factory)

    @cached_property
    def simulates(self) -> bool:
        """True if the factory has a parameter ``env``, so that its ADSs can simulate in the environment."""
        if self.drives_itself or takes_nothing(self.factory):
            return False
        try:
            return "env" in inspect.signature(self.factory).parameters
        except (TypeError, ValueError):  # builtins without a signature
            return False

    @property
    def only_observes(self) -> bool:
        """True if the ADSs decide based on observations alone."""
        return not (self.drives_itself or self.simulates)

    @cached_property
    def sight(self) -> Sight | None:
        return sight_of(self.factory)

    @property
    def loading_hint(self) -> str:
        """The factory's note on loading the policy, or an empty string."""
        stated = self._own("loading_hint")
        if isinstance(stated, str):
            return stated
        return ""

    def preload(self) -> None:
        load = self._own("preload")
        if load is not None:
            load()

    def check_drives_in(self, world: Any) -> None:
        check = self._own("check_world")
        if check is not None:
            check(world)

    def make(self, **arguments: Any) -> Ads:
        given = make_ads(self.factory, **arguments)
        decides, sight = ads_and_sight(given)
        return Ads(given, decides, sight, drives_itself=is_vehicle_class(given))

    def _own(self, name: str) -> Any:
        # a class is a factory, but its attributes belong to its ADSs
        inner = inspect.unwrap(self.factory)
        if isinstance(inner, type):
            return None
        return getattr(inner, name, None)


# the constants of IDMVehicle that a subclass may set
CONSTANTS = (
    "LENGTH", "WIDTH", "ACC_MAX", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN", "DISTANCE_WANTED", "TIME_WANTED", "DELTA",
    "POLITENESS", "LANE_CHANGE_MIN_ACC_GAIN", "LANE_CHANGE_MAX_BRAKING_IMPOSED", "LANE_CHANGE_DELAY", "KP_HEADING",
    "KP_LATERAL", "MAX_STEERING_ANGLE", "KP_A",
)  # fmt: skip
# the constants that must be positive for the model; with other values, highway-env's own code runs
POSITIVE = ("LENGTH", "WIDTH", "COMFORT_ACC_MAX", "DELTA", "LANE_CHANGE_DELAY")
PURSUIT = 0.1  # the time constant of highway-env's steering [s], which is also the kernel's
OF_UTILS = ("not_zero", "wrap_to_pi")  # the functions of highway_env.utils that the model calls
# the attributes that Python itself adds to a class
ORDINARY = frozenset({
    "__module__", "__qualname__", "__doc__", "__annotations__", "__annotate__", "__annotate_func__",
    "__firstlineno__", "__static_attributes__", "__abstractmethods__", "_abc_impl",
})  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class IdmModel:
    """The constants of a vehicle class that drives with IDM and MOBIL, and whether the class changes lanes."""

    constants: Mapping[str, float]
    changes_lanes: bool


def is_patched(cls: type) -> bool:
    """Return whether functions of a highway-env class have been replaced or added, for example by a test."""
    module = cls.__module__
    qualname = cls.__qualname__
    # simple comparisons, because every run of a vehicle class makes them
    for name, each in vars(cls).items():
        if type(each) is not FunctionType:
            continue
        if each.__qualname__ != f"{qualname}.{name}" or each.__module__ != module:
            return True
    return False


def is_usable(constants: Mapping[str, Any]) -> bool:
    """Return whether the model works with these constants of a class or a vehicle."""
    for value in constants.values():
        if not isinstance(value, (int, float)) or not math.isfinite(value):
            return False
    return constants["COMFORT_ACC_MIN"] < 0 and all(constants[name] > 0 for name in POSITIVE)


def idm_model(ads: Any) -> IdmModel | None:
    """Return the IDM model of a vehicle class, or None if the class has custom code."""
    whole = ads
    if not isinstance(ads, functools.partial):
        whole = functools.partial(ads)
    cls = whole.func
    options = whole.keywords
    stock = getattr(sys.modules.get("highway_env.vehicle.behavior"), "IDMVehicle", None)
    if stock is None or not isinstance(cls, type) or not issubclass(cls, stock):
        return None
    # Only constants may differ from the stock class: other code would drive differently.
    # a base may also follow the stock class
    own = [base for base in cls.__mro__ if base not in stock.__mro__]
    only_sets_constants = all(set(vars(base)) <= ORDINARY | set(CONSTANTS) for base in own)
    if whole.args or set(options) - {"enable_lane_change"} or not only_sets_constants:
        return None
    # the functions that the model replaces must be highway-env's own
    utils = sys.modules["highway_env.utils"]
    roads = sys.modules["highway_env.road.road"]
    if any(map(is_patched, [*stock.__mro__, roads.Road, roads.RoadNetwork])):
        return None
    for name in OF_UTILS:
        function = getattr(utils, name)
        if (function.__module__, function.__qualname__) != (utils.__name__, name):
            return None
    if type(cls).__call__ is not type.__call__ or stock.TAU_PURSUIT != PURSUIT:
        return None
    named = {name: value for base in reversed(cls.__mro__) for name, value in vars(base).items()}
    # without getattr, because a descriptor is no constant
    constants = {name: named[name] for name in CONSTANTS}
    if not is_usable(constants):
        return None
    changes_lanes = bool(options.get("enable_lane_change", True))
    return IdmModel(constants=constants, changes_lanes=changes_lanes)


Check = Callable[[Any], Any]
"""A function that converts an action to the form used in the record, or raises an error if the action is invalid."""


@dataclass(slots=True, kw_only=True)
class Aside:
    """The decisions that an ADS makes during a run without affecting the run."""

    asked: int = 0  # number of decisions that the ADS actually made
    # one action per decision, or None if the ADS raised an error
    answers: list[Any] = field(default_factory=list)
    at: Any = None  # the observation at the decision of a question, before it is replaced
    # evaluated at the decision of a question
    conditions: list[Evaluated] = field(default_factory=list)

    def action_at(self, number: int) -> Any:
        if number < len(self.answers):
            return self.answers[number]
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """A decision for which the observation is stored or replaced."""

    number: int
    instead: Any = None  # replaces the observation, unless None
    # false if the observation, which may be any object of a simulator, need not be stored
    is_noted: bool = True
    # records the conditions that the ADS evaluates in this decision
    conditions: Conditions | None = None


class Shadow(Around):
    """An ADS whose decisions have no effect, because the run uses recorded actions."""

    def __init__(
        self,
        ads: Any,
        actions: Sequence[Any],
        check: Check,
        aside: Aside,
        question: Question | None,
    ) -> None:
        super().__init__(ads)
        self._actions = actions
        self._check = check
        self._aside = aside
        self._question = question

    def __call__(self, observation: Any) -> Any:
        aside = self._aside
        number = len(self._aside.answers)
        question = self._question
        recording: AbstractContextManager[None] = nullcontext()
        if (
            question is not None
            and question.instead is not None
            and question.number < number < len(self._actions)
        ):
            # A decision here would not help to answer the question.
            aside.answers.append(self._actions[number])
            return self._actions[number]
        if question is not None and number == question.number:
            # the ADS may write into it
            aside.at = None
            if question.is_noted:
                aside.at = copy.deepcopy(observation)
            if question.instead is not None:
                observation = question.instead
            if question.conditions is not None:
                recording = question.conditions.recorded(self._ads, aside.conditions)
        aside.asked += 1
        try:
            with recording:
                answer = self._check(self._ads(observation))
        except Exception:  # noqa: BLE001  (an ADS may raise any error for an unusual observation)
            answer = None
        aside.answers.append(answer)
        if number < len(self._actions):
            return self._actions[number]
        return answer


def beside(
    factory: AdsFactory,
    actions: Sequence[Any],
    check: Check,
    aside: Aside,
    question: Question | None = None,
) -> AdsFactory:
    """Return a factory of ADSs whose decisions have no effect, because the run uses the recorded actions."""
    return wrap_ads(factory, lambda ads: Shadow(ads, actions, check, aside, question))


class _Ending(Around):
    def __init__(self, ads: Any, decisions: int) -> None:
        super().__init__(ads)
        self._left = decisions

    def __call__(self, observation: Any) -> Any:
        if self._left <= 0:  # all decisions of interest were made
            raise RuntimeError("no more decisions are of interest")
        self._left -= 1
        return self._ads(observation)


class Unseeing(Around):
    """An ADS that cannot see one NPC of a scenario."""

    def __init__(self, ads: Any, npc: int) -> None:
        super().__init__(ads)
        self.npc = npc

    def __call__(self, seen: Any) -> Any:
        # observations of an environment are made without the NPC, see `hide`
        if isinstance(seen, Observation):
            if self.npc in seen.ids:
                seen = changed(seen, self.npc, None)
            crossing = tuple([each for each in seen.crossing if each.id != self.npc])
            seen = seen.replace(crossing=crossing)
        return self._ads(seen)


def check_by(ads: Any, check: Check) -> None:
    """Set the function that checks an ADS's actions, if the ADS was created by :func:`beside`."""
    shadow = ads
    if isinstance(ads, Unseeing):
        shadow = ads._ads
    if isinstance(shadow, Shadow):
        shadow._check = check


def without(factory: AdsFactory, npc: int) -> AdsFactory:
    """Return a factory of ADSs that cannot see one NPC."""
    return wrap_ads(factory, lambda ads: Unseeing(ads, npc))


def end_after(factory: AdsFactory, decisions: int) -> AdsFactory:
    """Return a factory of ADSs that raise an error after a number of decisions."""
    return wrap_ads(factory, lambda ads: _Ending(ads, decisions))


def repeat_action(action: Any) -> AdsFactory:
    """Return a factory of ADSs that always return the same action."""
    return lambda: lambda observation: action


def wrap_ads(factory: AdsFactory, wrap: Callable[[Any], Any]) -> AdsFactory:
    """Return a factory that calls ``wrap`` with each ADS but keeps the ADS's perception."""

    def make(*observations: Any, **arguments: Any) -> Any:
        return rewrap_ads(factory(*observations, **arguments), wrap)

    return functools.wraps(factory, updated=())(make)


def changed(
    observation: Observation, npc: int, by: tuple[float, float, float] | None
) -> Observation:
    """Return a copy of an observation in which one NPC is moved or hidden.

    ``by`` is added to the NPC's x [m], y [m] and speed [m/s]. If it is None, the NPC is hidden.
    """
    place = observation.ids.index(npc)
    others = list(observation.others)
    ids = list(observation.ids)
    lateral = list(observation.lateral_velocities)
    if by is None:
        del others[place], ids[place], lateral[place + 1]
    else:
        was = others[place]
        x, y, speed = by
        # the nearest lane may have changed
        aside = [abs(centre - (was.y + y)) for centre in observation.lane_centres]
        others[place] = was._replace(
            x=was.x + x,
            y=was.y + y,
            speed=was.speed + speed,
            lane=aside.index(min(aside)),
        )
    return observation.replace(
        others=tuple(others),
        ids=tuple(ids),
        lateral_velocities=tuple(lateral),
    )
