"""The run that a test function receives, and the checks in the function."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import numpy.typing as npt

from pytest_pafot import criticality
from pytest_pafot.attribution import takeovers
from pytest_pafot.attribution.responsibility import (
    Attribution,
    Responsibility,
    attribute_collision,
    decide_contested,
    position_rule,
)
from pytest_pafot.attribution.sentences import impact, responsible_sentence
from pytest_pafot.criticality import Passage, passages
from pytest_pafot.criticality.signals import (
    EgoLaneChange,
    EgoSignals,
    NpcSignals,
    Signals,
    ego_lane_changes,
    headway,
    leader,
)
from pytest_pafot.model.crossings import Zone
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import Chromosome, Scenario, continues
from pytest_pafot.model.trace import (
    ACCELERATION,
    HEADING,
    SPEED,
    AdsError,
    Collision,
    FloatArray,
    Outcome,
    Trace,
    vehicle_name,
)
from pytest_pafot.model.vehicle_type import CAR, STYLES
from pytest_pafot.support import import_late
from pytest_pafot.support.errors import POSITIVE, DriverError, checked_number, install
from pytest_pafot.support.text import ascii_text, capitalised, wrapped_to

if TYPE_CHECKING:
    from pandas import DataFrame


# Discarding a scenario in a test function.


class Rejected(BaseException):
    """The exception that :func:`reject` raises. Handlers for ``Exception`` in a test do not catch it."""


def reject() -> NoReturn:
    """Discard the current scenario, which then counts as neither passed nor failed."""
    raise Rejected(
        "pafot.reject() discards a scenario in a @pafot.search test. Do not call it anywhere else"
    )


LONGEST_NAME = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A checked value of one run, with its bounds."""

    name: str
    value: float  # the worst value of the run [unit]; NaN fails
    # distance of the value from the bound, divided by the scale; negative if the bound is broken
    margin: float
    at_most: float | None = None
    at_least: float | None = None
    unit: str = ""
    time: float | None = None  # time of the worst value [s]
    npc: int | None = None
    # All values, if there is one per tick.
    values: FloatArray | None = field(default=None, compare=False, repr=False)

    @property
    def bounds(self) -> dict[str, float | None]:
        """The two bounds, by their argument names."""
        return {"at_most": self.at_most, "at_least": self.at_least}

    @property
    def holds(self) -> bool:
        """True if the value is within its bounds."""
        return self.margin >= 0

    def __str__(self) -> str:
        """Return the check in words, such as ``jerk = 35.1 > 20 m/s^3 at 4.2 s``."""
        bound = self.at_most
        signs = ("<=", ">")
        if self.at_least is not None and (bound is None or self.value < self.at_least):
            bound = self.at_least
            signs = (">=", "<")
        text = f"{self.name} = {_short(self.value, bound)}"
        if bound is not None:
            sign = signs[0] if self.holds else signs[1]
            if math.isnan(self.value):
                sign = "is not within"
            text = f"{text} {sign} {bound:g}"
        if self.unit:
            text = f"{text} {self.unit}"
        if self.time is not None:
            text = f"{text} at {self.time:.1f} s"
        if self.npc is not None:
            text = f"{text} (NPC {self.npc})"
        return text


class CheckFailed(AssertionError):  # noqa: N818  (it reads as what happened)
    """The error of a check whose value is out of bounds. The attribute ``check`` has the details."""

    __module__ = "pytest_pafot"  # users import it from there, and tracebacks show this name

    def __init__(self, check: Check) -> None:
        if not isinstance(check, Check):
            raise TypeError(
                f"CheckFailed: expected a Check, received {check!r:.80}. Call pafot.check(...) instead"
            )
        super().__init__(str(check))
        self.check = check

    def __reduce__(self) -> tuple[type[CheckFailed], tuple[Check]]:
        return type(self), (self.check,)


@dataclass(slots=True)
class Recording:
    """The checks of one run."""

    hz: float  # ticks per second of the run
    ticks: int
    npcs: int | None = None  # None if unknown
    checks: list[Check] = field(default_factory=list)


# The recording of the run that is being evaluated. Checks in a test function can find it here, without the run.
_RECORDING: ContextVar[Recording | None] = ContextVar("pafot_checks", default=None)


@contextmanager
def recorded(recording: Recording) -> Iterator[None]:
    """Record the checks that are made inside the ``with`` block."""
    token = _RECORDING.set(recording)
    try:
        yield
    finally:
        _RECORDING.reset(token)


def check(
    value: Any,
    *,
    name: str,
    at_most: float | None = None,
    at_least: float | None = None,
    unit: str = "",
    at: float | None = None,
    npc: int | None = None,
    scale: float | None = None,
) -> None:
    """Assert that a value is within its bounds, and report the margin to the search.

    Args:
        value: a number, or an array with one value per tick, such as ``run.ego.jerk``. The worst value counts. NaN
            fails.
        name: name of the check. Failures with the same name count as one finding.
        at_most, at_least: bounds [unit]. At least one is required.
        unit: unit of the value, such as ``"m/s^3"``.
        at: time [s] of the event; by default, the time of an array's worst value.
        npc: index of the NPC that the check is about. -1, as in ``run.leader``, means none.
        scale: divisor [unit] that makes margins comparable; by default, the bound, or 1 if the bound is 0.

    Raises:
        CheckFailed: if a bound is broken.
        ValueError: if an argument is invalid.
    """
    __tracebackhide__ = True  # pytest then shows the line of the test function as the last one
    what = f"check {name!r}"
    if at_most is None and at_least is None:
        raise ValueError(f"{what}: expected at_most=, at_least= or both, received neither")
    values = _values(value, name)
    # All bounds become margins in the same direction. The smallest margin counts.
    bounds = {}
    for given, sign in ((at_most, -1.0), (at_least, 1.0)):
        if given is not None:
            bounds[sign] = checked_number(given, what, "a finite number as the bound")
    margins = np.full(values.shape, np.inf)
    with np.errstate(invalid="ignore"):
        for sign, bound in bounds.items():
            margin = sign * (values - bound) / _scale(name, bound, scale)
            margins = np.minimum(margins, margin)
    # NaN must never pass: it is worse than any number.
    margins = np.where(np.isnan(margins), -np.inf, margins)
    tick = int(margins.argmin())
    recording = _RECORDING.get()
    time = None
    all_values = None
    # Only an array with one value per tick of the evaluated run has times.
    if recording is not None and values.size == recording.ticks + 1 != 1:
        time = tick / recording.hz
        all_values = values
    if at is not None:
        time = checked_number(
            at,
            what,
            "at= to be at least 0 seconds after the start of the run",
            least=0.0,
        )
    made = Check(
        name=_named(name),
        value=float(values[tick]),
        margin=float(margins[tick]),
        at_most=bounds.get(-1.0),
        at_least=bounds.get(1.0),
        unit=_unit(name, unit),
        time=time,
        npc=_npc(name, npc),
        values=all_values,
    )
    # A check that passes is also recorded, because the user's own algorithm may learn from its margin.
    if recording is not None:
        recording.checks.append(made)
    if not made.holds:
        raise CheckFailed(made)


def _values(value: Any, name: str) -> FloatArray:
    try:
        values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"check {name!r}: expected a number or an array of numbers, received {value!r:.80}"
        ) from error
    if values.ndim != 1 or not values.size:
        hint = ". Check each NPC separately" if values.ndim > 1 else ""
        raise ValueError(
            f"check {name!r}: expected a number, or an array with one value per tick, received an array of shape "
            f"{values.shape}{hint}"
        )
    return values


def require(holds: bool, assertion: str, explain: Callable[[], str]) -> None:
    """Assert a condition, even under ``python -O``.

    ``assertion`` is the source of the condition, which identifies the failure. ``explain`` returns the message.
    """
    __tracebackhide__ = True
    if not holds:
        error = AssertionError(explain())
        error.assertion = assertion  # type: ignore[attr-defined]
        raise error


def _named(name: str) -> str:
    if not _is_short(name) or not name.strip():
        raise ValueError(
            f"name: expected 1 to {LONGEST_NAME} printable characters, received {name!r:.100}"
        )
    return name.strip()


def _is_short(text: object) -> bool:
    return isinstance(text, str) and len(text) <= LONGEST_NAME and text.isprintable()


def _scale(name: str, bound: float, scale: float | None) -> float:
    if scale is None:
        return abs(bound) or 1.0
    return checked_number(
        scale,
        f"check {name!r}",
        "scale= to be a positive number",
        least=POSITIVE,
    )


def _unit(name: str, unit: str) -> str:
    if not _is_short(unit):
        raise ValueError(
            f"check {name!r}: expected a short printable unit=, such as 'm/s^3', received {unit!r:.100}"
        )
    return unit


def _npc(name: str, npc: Any) -> int | None:
    recording = _RECORDING.get()
    if npc is None:
        return None
    most = math.inf
    there = ""
    if recording is not None and recording.npcs is not None:
        most = recording.npcs
        there = f" (at most {most - 1})"
    is_index = isinstance(npc, (int, np.integer)) and not isinstance(npc, bool)
    if not is_index or not -1 <= npc < most:
        raise ValueError(
            f"check {name!r}: expected npc= to be the index of an NPC{there}, received {npc!r:.100}"
        )
    if npc < 0:
        return None
    return int(npc)


def _short(value: float, bound: float | None) -> str:
    # As few digits as possible, but enough to show on which side of its bound the value is.
    texts = [f"{value:.{digits}g}" for digits in range(3, 17)]
    if 1 <= abs(value) < 1e4:
        texts.insert(0, f"{value:.1f}")
    if bound is None or math.isnan(value):
        return texts[0]
    if value == bound:
        return f"{value:g}"
    for text in texts:
        if float(text) != bound and (float(text) > bound) == (value > bound):
            return text
    return texts[-1]


# pytest indents an explanation, so its sentences are wrapped at this width.
SENTENCE_WIDTH = 72
# The longest line of an explanation.
LINE_LENGTH = 99
# Explanations mention driving backwards only above this speed [m/s]. A lower speed is the overshoot of a stopping car.
BACKWARDS = 0.5
# An NPC has reached the speed of an instruction if the difference is at most this [m/s].
NEAR_SPEED = 0.5
# The largest number of rows in an explanation's table of genes.
MAX_GENE_ROWS = 5
# The wordings of that table, the longest first. Each has the text before an arrival time, which is empty if there is no
# room for the time, and whether to name the side from which an NPC enters the ego's lane.
_WORDINGS = (("reached at ", True), ("reached ", True), ("reached ", False), ("", False))
_DEPARTURES = {
    Outcome.END_OF_ROAD: ", after which a vehicle reached the end of the road",
    Outcome.LEFT_ROUTE: ", after which the ego left its route",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """An NPC at one tick of a run.

    Attributes:
        npc: index of the NPC in the scenario.
        tick, time: physics tick and its time [s].
        cell: last cell of the NPC's centre, other than the ego's own cell, or None.
    """

    npc: int
    tick: int
    time: float
    cell: Cell | None


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """One simulated run with its outcome, measures and verdict.

    Attributes:
        trace: record of the run, tick by tick.
        take_over: function that repeats the run with a careful driver who takes over, or None.
    """

    trace: Trace
    take_over: takeovers.TakeOver | None = field(default=None, kw_only=True)

    if not TYPE_CHECKING:  # type checkers know every name

        def __getattr__(self, name: str) -> Any:
            # pytest then shows the line of the test function as the last one
            __tracebackhide__ = True
            if hasattr(type(self), name):
                # raises the AttributeError from inside a property again
                return object.__getattribute__(self, name)
            known = [each for each in dir(self) if not each.startswith("_")]
            hint = f"It has {', '.join(known)}"
            for near in difflib.get_close_matches(name, known, n=1, cutoff=0.5):
                hint = f"Did you mean `run.{near}`?"
            raise AttributeError(f"a run has no attribute {name!r}. {hint}")

    # How it ended.

    @property
    def scenario(self) -> Scenario:
        """The scenario as executed, after repairs."""
        return self.trace.executed

    @property
    def outcome(self) -> Outcome:
        """The way the run ended, such as ``"collision"``, ``"off_road"`` or ``"safe"``."""
        return self.trace.outcome

    @property
    def collision(self) -> Collision | None:
        """The ego's collision, or None."""
        return self.trace.collision

    @property
    def ads_error(self) -> AdsError | None:
        """The policy's error, or None."""
        return self.trace.error

    @property
    def off_road(self) -> bool:
        """True if the ego's centre was ever off the road."""
        return self.trace.off_road_tick is not None

    @property
    def duration(self) -> float:
        """The simulated duration [s]."""
        return self.trace.duration

    @property
    def max_decision_time(self) -> float:
        """The longest wall-clock time [s] of a valid decision. It is not reproducible."""
        return self.trace.max_decision_seconds

    # How dangerous it was for the ego: over all ticks and NPCs.

    @cached_property
    def mettc(self) -> float:
        """The paper's minimum estimated time to collision [s] (equations 1 to 3). Lower is worse; inf if none."""
        return criticality.mettc(self.trace)

    @cached_property
    def min_ttc(self) -> float:
        """The smallest time to contact [s] between the boxes of the ego and an NPC. Lower is worse; inf if none.

        It assumes constant velocities (Hayward, 1972).
        """
        return criticality.min_ttc(self.trace)

    @cached_property
    def min_distance(self) -> float:
        """The smallest distance [m] between the boxes of the ego and an NPC. Lower is worse; 0 at contact."""
        return criticality.min_gap(self.trace)

    @cached_property
    def min_centre_distance(self) -> float:
        """The smallest distance [m] between the centres of the ego and an NPC (equation 4 of the paper)."""
        return criticality.min_centre_distance(self.trace)

    @cached_property
    def hardest_brake(self) -> float:
        """The ego's largest deceleration [m/s^2]; 0 if it never slowed down."""
        return criticality.hardest_brake(self.trace)

    # What happened at each tick.

    @property
    def ego(self) -> EgoSignals:
        """The ego's signals, such as ``run.ego.speed``."""
        return self._signals.ego

    @property
    def npcs(self) -> tuple[NpcSignals, ...]:
        """Each NPC's signals, such as ``run.npcs[0].gap``."""
        return self._signals.npcs

    @property
    def headway(self) -> FloatArray:
        """The time gap [s] to the leader at each tick, at the ego's speed."""
        return self.signal(headway)

    @cached_property
    def leader(self) -> npt.NDArray[np.intp]:
        """The index of the nearest NPC ahead in the ego's lane at each tick, or -1."""
        return leader(self.trace)

    @cached_property
    def lane_changes(self) -> tuple[EgoLaneChange, ...]:
        """The ego's lane changes, in order."""
        return ego_lane_changes(self.trace)

    @cached_property
    def passages(self) -> tuple[Passage, ...]:
        """The times at which the ego and each crossing NPC were in their conflict zone.

        ``min((each.post_encroachment_time for each in run.passages), default=math.inf)`` is the smallest gap [s].
        """
        return tuple(filter(None, passages(self.trace)))

    def signal(
        self,
        function: Callable[[Trace], npt.ArrayLike],
        npc: int | None = None,
    ) -> FloatArray:
        """Return the signal that a function computes from the trace, or its row for one NPC."""
        return self._signals.values_of(function, npc)

    def to_pandas(self) -> DataFrame:
        """Return all signals as a data frame with a row per tick and columns such as ``npcs[0].gap``."""
        try:
            pd = import_late("pandas")
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                f"run.to_pandas() requires the package pandas, which is not installed. Run `{install('compare')}`"
            ) from error
        columns = dict(self._signals.all()) | {"leader": self.leader}
        times = pd.Index(self.trace.times, name="time")
        return pd.DataFrame(columns, index=times)  # type: ignore[no-any-return]

    # Who caused the collision.

    @cached_property
    def attribution(self) -> Attribution:
        """The responsible side, with the decisive time and the reasons."""
        found = attribute_collision(self.trace)
        if found.contested is not None:
            with suppress(DriverError):  # `run.takeover` raises it
                return decide_contested(found, self.takeover)
        return found

    @cached_property
    def takeover(self) -> float | None:
        """The latest takeover by a careful driver that avoids the collision [s before the impact]; 0 if none does.

        None if the world cannot simulate that driver.
        """
        if self.take_over is None:
            return None
        return takeovers.latest(self.trace, self.take_over)

    @property
    def responsibility(self) -> Responsibility | None:
        """The side responsible for the collision: ``"ego"``, ``"npc"``, ``"both"`` or None."""
        verdict = self.attribution.responsibility
        if verdict == "none":
            return None
        return verdict

    @property
    def second_opinion(self) -> Responsibility | None:
        """The side that the paper authors' simpler rule blames: ``"ego"``, ``"npc"`` or None."""
        verdict = position_rule(self.trace)
        if verdict == "none":
            return None
        return verdict

    # The most important moment of the run.

    @cached_property
    def worst_ttc(self) -> Moment | None:
        """The tick and NPC with the smallest time to contact, or None."""
        return self._at_minimum(criticality.ttc(self.trace))

    @cached_property
    def closest_approach(self) -> Moment | None:
        """The tick and NPC with the smallest distance between the boxes, or None."""
        return self._at_minimum(criticality.gap(self.trace))

    @property
    def closest_time(self) -> float:
        """The time [s] at which the distance between the boxes is smallest."""
        closest = self.closest_approach
        if closest is None:
            return self.duration
        return closest.time

    @cached_property
    def event_time(self) -> float:
        """The time [s] of the run's most important event.

        This is the collision, the error or the departure from the road, or else the smallest time to contact.
        """
        if self.collision is not None:
            return self.collision.time
        tick = self.trace.off_road_tick
        if self.ads_error is not None:
            tick = self.ads_error.tick
        if tick is not None:
            return tick / self.trace.physics_hz
        if self.worst_ttc is not None:
            return self.worst_ttc.time
        return self.closest_time

    @property
    def event_npc(self) -> int | None:
        """The NPC that collided, or else the one with the smallest time to contact, or None."""
        event = self.collision or self.worst_ttc
        if event is None:
            return None
        return event.npc

    @property
    def event_cell(self) -> Cell | None:
        """The cell of ``event_npc`` at the event, if it was on the ego's path."""
        event = self.collision or self.worst_ttc
        if event is None:
            return None
        return event.cell

    def zone_of(self, event: Collision | Moment) -> Zone | None:
        """Return the conflict zone of an event's NPC, or None once the NPC has merged."""
        on_way = self.trace.on_way
        if event.npc is None or on_way is None:
            return None
        zone = self.trace.zone_of(event.npc)
        if zone is None or event.cell is None:
            return zone
        # After an NPC has merged and left the zone, it is on the ego's path like any other.
        if on_way[event.tick, event.npc] <= zone.npc[1]:
            return zone
        return None

    def place_of(self, event: Collision | Moment) -> str:
        """Return the position of an event's NPC, such as ``in cell 2 (front)``, or an empty string."""
        zone = self.zone_of(event)
        if zone is None or event.npc is None:
            if event.cell is None:
                return ""
            return f"in cell {int(event.cell)} ({event.cell.label})"
        along = self.trace.way_of(event.npc)[event.tick]
        enters, leaves = zone.npc
        where = "in"
        if along < enters:
            where = "before"
        elif along > leaves:
            where = "past"
        return f"{zone.whence} {where} the zone {zone.way}"

    @property
    def sentences(self) -> tuple[str, ...]:
        """The sentences of the verdict: what happened, and who is responsible."""
        if self.collision is None:
            return ()
        verdict = self.attribution
        who = responsible_sentence(verdict.responsibility, self.collision.npc, verdict.takeover)
        return *verdict.sentences, who

    @property
    def impact(self) -> str:
        """The collision in words (who hit whom, when and how fast), or an empty string."""
        hit = self.collision
        if hit is None:
            return ""
        zone = self.zone_of(hit)
        whence = "" if zone is None else zone.whence
        way = "along"
        if hit.npc is not None:
            headings = self.trace.states[hit.tick, :, HEADING]
            if hit.ego_speed < -BACKWARDS:
                way = "backwards"
            elif not np.cos(headings[hit.npc + 1] - headings[0]) >= 0:
                way = "towards"
        return capitalised(
            impact(hit.time, hit.npc, hit.side, hit.cell, whence, hit.closing_speed, way)
        )

    def explain(self, *, instructions: bool = True) -> str:
        """Explain the run in about twenty lines of ASCII.

        Without ``instructions``, each sentence is one line.
        """
        # What happened: the headline, the sentences of the verdict, and a few measures.
        lines = [self._headline()]
        lines += [f"  {each}" for each in self.sentences]
        if instructions and self.collision is not None:
            lines = [part for each in lines for part in wrapped_to(each, SENTENCE_WIDTH)]
        lines += self._measures()
        if instructions:
            lines += self._requested()
        # Strings of users and exceptions must neither break lines nor make them too long.
        lines = [ascii_text(" ".join(line.splitlines())) for line in lines]
        if instructions or self.collision is None:
            lines = [
                line if len(line) <= LINE_LENGTH else f"{line[: LINE_LENGTH - 3]}..."
                for line in lines
            ]
        return "\n".join(lines)

    def _requested(self) -> list[str]:
        # What was requested: vehicles other than cars, the instructions, and how to identify the scenario.
        lines = []
        others = []
        for number, vehicle in enumerate((self.trace.ego_vehicle, *self.scenario.vehicles)):
            if vehicle != CAR:
                others.append(f"{vehicle_name(number)} is a {vehicle.described}")
        if others:
            lines.append(f"  {'; '.join(others)}")
        crossing = _crossing_lines(self.trace)
        lines += crossing
        lines += _gene_table(self.trace, MAX_GENE_ROWS - len(crossing))
        names = [f"scenario {self.scenario.id}", f"scenario seed {self.scenario.seed}"]
        if self.second_opinion != self.responsibility:
            names.append(f"position rule: {self.second_opinion}")
        if STYLES[self.scenario.traffic].described:
            names.append(STYLES[self.scenario.traffic].described)
        return [*lines, f"  {', '.join(names)}"]

    def __repr__(self) -> str:
        return f"<Run {self.outcome} after {self.duration:.1f} s, scenario {self.scenario.id}>"

    @cached_property
    def _signals(self) -> Signals:
        return Signals(self.trace)

    def _at_minimum(self, measure: FloatArray) -> Moment | None:
        values = np.where(np.isnan(measure), np.inf, measure)
        if values.size == 0 or not np.isfinite(values.min()):
            return None
        # of equal values, the first tick and NPC
        tick, npc = divmod(int(values.argmin()), values.shape[1])
        length = float(self.trace.sizes[0, 0])
        cell = self.trace.road.last_cell(npc, tick, length)
        return Moment(npc=npc, tick=tick, time=tick / self.trace.physics_hz, cell=cell)

    def _headline(self) -> str:
        hit = self.collision
        if hit is not None and hit.npc is None:
            return self.impact
        if hit is not None:
            return f"{self.impact} (ego {hit.ego_speed:.1f} m/s, NPC {hit.npc_speed:.1f} m/s)"
        error = self.ads_error
        if error is not None:
            what = "ADS error"
            if self.outcome is Outcome.HANG:
                what = "ADS hangs" if error.is_of_ads else "environment hangs"
            return f"{what} after {self.event_time:.1f} s: {error.kind}: {error.message}"
        if self.outcome is Outcome.INVALID:
            why = "two NPCs touched"
            if self.trace.obstacles:
                why = "two NPCs touched, or one touched a fixed object"
            why = self.trace.users_error_text or why
            return f"invalid after {self.duration:.1f} s: {why}"
        over = ""
        if self.trace.ended:
            over = f", after which {self.trace.ended} ended the run"
        if self.off_road:
            return f"the ego left the road after {self.event_time:.1f} s; no collision in {self.duration:.1f} s{over}"
        return f"no collision in {self.duration:.1f} s{_DEPARTURES.get(self.outcome, over)}"

    def _measures(self) -> list[str]:
        hz = self.trace.physics_hz
        ego = self.trace.ego
        brake = f"hardest braking by the ego: {self.hardest_brake:.1f} m/s^2"
        if self.hardest_brake >= 0.05:
            brake = f"{brake} at {int(np.nanargmin(ego[:, ACCELERATION])) / hz:.1f} s"
        lines = []
        worst = self.worst_ttc
        if self.collision is None and worst is not None:
            place = f"NPC {worst.npc} {self.place_of(worst)}".rstrip()
            lines.append(
                f"  smallest time to contact: {self.min_ttc:.2f} s, {place} at {worst.time:.1f} s"
            )
        if self.collision is None:
            distance = f"{self.min_distance:.2f} m at {self.closest_time:.1f} s"
            brake = f"smallest distance: {distance}; {brake}"
        lines.append(f"  {brake}")
        speeds = ego[:, SPEED]
        tick = int(np.nanargmin(speeds))  # no other measure shows that the ego drove backwards
        if speeds[tick] <= -BACKWARDS:
            lines.append(
                f"  the ego drove backwards, at {-speeds[tick]:.1f} m/s after {tick / hz:.1f} s"
            )
        return lines


def lanes_apart(trace: Trace, npc: int, gene: int) -> float:
    """Return how many lanes an NPC is to the right of the ego when a gene starts, or NaN."""
    return _lane_at(trace, npc + 1, gene) - _lane_at(trace, 0, gene)


def arrival(trace: Trace, npc: int, gene: int) -> int | None:
    """Return the tick at which an NPC reached a gene's target, or None."""
    if npc >= len(trace.arrivals):
        return None
    chain = trace.executed.npcs[npc]
    for later, tick in enumerate(trace.arrivals[npc][gene:], gene):
        # A lane change can take longer than a short gene. It also counts if the NPC arrives in its new lane during the
        # next genes, as long as these keep that lane.
        if later > gene:
            moved = _lane_at(trace, npc + 1, later) - _lane_at(trace, npc + 1, gene)
            if moved != chain[gene].lasting(chain[later]):
                return None
        if tick is not None:
            return tick
    return None


def _lane_at(trace: Trace, vehicle: int, gene: int) -> float:
    # Lanes are counted to the right.
    tick = gene * round(trace.scenario.gene_seconds * trace.physics_hz)
    if tick > trace.ticks:
        return math.nan
    return trace.road.counted(tick, vehicle)


def _crossing_lines(trace: Trace) -> list[str]:
    # One line for each crossing NPC: its path, its instruction, and its time in the conflict zone.
    crossings = trace.executed.crossings
    told = [(npc, each) for npc, each in enumerate(crossings) if each is not None]
    room = MAX_GENE_ROWS
    if None in crossings:
        room -= 2  # for the table of the other NPCs
    passed = passages(trace)
    lines = []
    for npc, each in told[:room]:
        zone = trace.zone_of(npc)
        words = each.words_from("" if zone is None else zone.whence)
        line = f"  NPC {npc}: {each.zone} {words}, {each.speed:.1f} m/s"
        lines.append(f"{line}{_passed(passed[npc])}")
    if len(told) > room:
        lines.append(f"  ... and {len(told) - room} more crossing NPCs")
    return lines


def _passed(passage: Passage | None) -> str:
    # The time at which the NPC passed the zone. "it" is the ego, which the instruction on the same line mentions.
    if passage is None:
        return ""
    if passage.npc_enters == math.inf:
        return "; never arrived"
    if passage.ego_enters == math.inf:
        return f"; arrived at {passage.npc_enters:.1f} s"
    gap = passage.post_encroachment_time
    if gap and passage.npc_leaves <= passage.ego_enters:
        return f"; left {gap:.1f} s before it ({passage.npc_leaves:.1f} s)"
    if not gap:
        return f"; both in the zone from {max(passage.npc_enters, passage.ego_enters):.1f} s"
    return f"; arrived {gap:.1f} s after it ({passage.npc_enters:.1f} s)"


def _gene_table(trace: Trace, room: int) -> list[str]:
    # A row per gene and a column per NPC, for the last genes that started. A gene in which all NPCs continue shares the
    # row of the previous gene. Times are in seconds.
    scenario = trace.executed
    seconds = scenario.gene_seconds
    npcs = [npc for npc, chain in enumerate(scenario.npcs) if not chain[0].crosses]
    if not npcs:
        return []
    started = min(scenario.genes, int(trace.duration / seconds - 1e-9) + 1)
    starts = [
        gene for gene in range(started) if any(_is_new(trace.chains[npc], gene) for npc in npcs)
    ]
    spans = [range(start, end) for start, end in pairwise([*starts, started])]
    times = []
    for span in spans:
        time = f"{span.start * seconds:10.1f}"
        if len(span) > 1:
            time = f"{time} to {span.stop * seconds:.1f}"
        times.append(time)
    header = ["  from [s]", *(f"NPC {npc}" for npc in npcs)]
    # Shorten the wording until the table fits.
    longest = {1: 0, 2: 1}.get(len(npcs), -1)
    for wording in _WORDINGS[longest:]:
        rows = [
            [time, *(_gene(trace, npc, span, *wording) for npc in npcs)]
            for time, span in zip(times, spans, strict=True)
        ]
        shown = [header, *rows[-max(room, 1) :]]
        widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
        head, *lines = ["  ".join(map(str.ljust, row, widths)) for row in shown]
        if max(len(line.rstrip()) for line in lines) <= LINE_LENGTH:
            break
    earlier = ""
    if len(rows) > len(lines):
        earlier = f"  ({len(rows) - len(lines)} earlier)"
    if len(head + earlier) > LINE_LENGTH:
        head = head.rstrip()
    return [line.rstrip() for line in (head + earlier, *lines)]


def _is_new(chain: Chromosome, gene: int) -> bool:
    if gene == 0 or gene >= len(chain):
        return gene in (0, len(chain))
    return not continues(chain[gene - 1], chain[gene])


def _gene(trace: Trace, npc: int, genes: range, reached: str, names_side: bool) -> str:
    chain = trace.chains[npc]
    gene = genes[0]
    hz = trace.physics_hz
    if gene >= len(chain):
        return "-"
    instruction = chain[gene]
    if not reached:
        return f"{instruction.target} {instruction.speed:.1f}"
    arrivals = [arrival(trace, npc, each) for each in genes if each < len(chain)]
    ticks = [tick for tick in arrivals if tick is not None]
    end = "not reached"
    if ticks:
        at = f"{ticks[0] / hz:.1f} s"
        end = f"{reached}{at}"
        first = min(round(gene * trace.scenario.gene_seconds * hz), trace.ticks)
        last = round(genes.stop * trace.scenario.gene_seconds * hz)
        speeds = trace.states[first : last + 1, npc + 1, SPEED]
        nearest = float(speeds[np.abs(speeds - instruction.speed).argmin()])
        # the NPC reached the position, but not the speed
        if abs(nearest - instruction.speed) > NEAR_SPEED:
            end = f"in place {at}"
            if reached.endswith("at "):
                extreme = "slowest" if nearest > instruction.speed else "fastest"
                end = f"in place from {at}, {extreme} {nearest:.1f} m/s"
    return instruction.row(lanes_apart(trace, npc, gene), end, names_side=names_side)
