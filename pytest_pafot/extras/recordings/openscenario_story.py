"""OpenSCENARIO 1.x: manoeuvres around an ego as a scenario, and trajectories as tracks.

A scenario has all that its author could say, from weather to pedestrians. Read is what a :class:`pafot.Manoeuvre` can
do; the rest is refused with its name and place, because a scenario without it would be another one.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from pytest_pafot import Manoeuvre, Scenario, ScenarioError, Step
from pytest_pafot.extending import FloatArray
from pytest_pafot.extras.recordings.openscenario_cast import Cast, Entity, Options, inner_names, refused, removed
from pytest_pafot.extras.recordings.openscenario_parameters import resolved
from pytest_pafot.extras.recordings.openscenario_trajectories import followed, vertices
from pytest_pafot.extras.recordings.recording import Recording
from pytest_pafot.extras.recordings.tables import Between
from pytest_pafot.extras.recordings.xml_data import Element

ROOT = "OpenSCENARIO"
PARTS = ("FileHeader", "ParameterDeclarations", "CatalogLocations", "RoadNetwork", "Entities", "Storyboard", "Catalog")
"""The parts of a file that are read, or like the road network not needed: places in lanes say enough."""
LANE_CHANGED = 4.0
"""The width of the lanes in which NPCs change lanes [m]."""
SPEEDING_UP, BRAKING = 5.0, 8.0
"""What NPCs can do [m/s^2]."""
AT_ONCE = 0.11
"""Up to this time a condition holds from the beginning [s]; authors write 0, 0.01 or 0.1."""
MOST_STEPS = 16
"""The most steps that a manoeuvre can have."""
MOST_OVERLAP = 1.0
"""The largest distance by which a start beside the ego may be moved, because NPCs start level with it or clear [m]."""


def read(root: Element, between: Between, options: Options) -> Recording | Scenario:
    """Return the scenario of a file, or the tracks if its vehicles follow trajectories.

    Raises:
        RecordingError: for all that neither says, with its place.
    """
    for child in root.children:
        if child.tag not in PARTS:
            expected, fix = f"a scenario of {', '.join(PARTS)} alone", "give the file of such a scenario"
            raise child.error(expected, child.tag, fix)
    header = root.get("FileHeader")
    if header.values.get("revMajor") != "1":
        raise header.error("version 1", header.values.get("revMajor", "none"), "convert the file", "revMajor")
    removed(root, frozenset(options.without))
    resolved(root, ChainMap())
    return _Reader(root, options).read(between)


@dataclass(slots=True, kw_only=True)
class _Npc:
    """An NPC whose steps are being read.

    Attributes:
        column: its lane now, as a number of lanes to the right of the ego's first one.
        gap: its distance to the ego at the start, between bumpers [m].
        speed: its speed after the steps so far [m/s].
        side: 1 if it is ahead of the ego as far as is known, else -1.
        clock: the time at which its last step ends as far as is known [s]; None after a step by distance.
        began: the time at which its last step began [s]; None if a distance began it.
        newest: the number of the first step of the last event.
        last: the last event.
    """

    entity: Entity
    first: Manoeuvre
    column: int
    gap: float
    room: float
    speed: float
    side: int
    clock: float | None = 0.0
    began: float | None = None
    trigger: dict[str, float] = field(default_factory=dict)
    newest: int = 0
    last: Element | None = None
    steps: list[Step] = field(default_factory=list)
    acts: set[int] = field(default_factory=set)


class _When(NamedTuple):
    """The condition under which something begins: a time, a distance or an event of the same NPC, and a delay.

    The time is that of the simulation, or ``is_from_act``.
    """

    place: Element
    time: float | None = None
    trigger: Mapping[str, float] = {}
    after: Element | None = None
    delay: float = 0.0
    is_from_act: bool = False

    @property
    def is_at_once(self) -> bool:
        return self.time is not None and self.time <= AT_ONCE


class _Event(NamedTuple):
    """An event of one actor, with the elements around it, from the story inwards."""

    actor: str
    around: tuple[Element, ...]
    event: Element

    @property
    def act(self) -> Element:
        return self.around[1]


class _Reader:
    def __init__(self, root: Element, options: Options) -> None:
        self.root, self.options = root, options
        self.cast = Cast(root, options)
        self.board = root.get("Storyboard")
        self.spans: dict[int, tuple[float | None, float | None]] = {}  # of events that have been read

    def read(self, between: Between) -> Recording | Scenario:
        events = [*self._events()]
        followed = [each for each in events if any(_deeds(each.event, "FollowTrajectoryAction"))]
        ego = self.cast.named_ego(is_needed=not followed)
        if [each for each in followed if each.actor != ego]:
            return self._tracks(events, ego, between)
        assert ego is not None  # noqa: S101
        return self._scenario([each for each in events if each.actor != ego], ego)

    # Events and triggers

    def _events(self) -> Iterator[_Event]:
        """Yield the events of all vehicles in the order of the file, and refuse actions that are nobody's."""
        for child in self.board.get("Init/Actions").children:
            if child.tag != "Private":
                raise refused(child, inner_names(child))
        acts = ((story, act) for story in self.board.all("Story") for act in story.all("Act"))
        for story, act, group in ((*above, group) for above in acts for group in above[1].all("ManeuverGroup")):
            names = self._actors(group)
            events = ((each, event) for each in group.all("Maneuver") for event in each.all("Event"))
            for manoeuvre, event in events:
                for deed in (deed for action in event.all("Action") for deed in action.children):
                    if deed.tag != "PrivateAction":
                        raise refused(deed, inner_names(deed))
                yield from (_Event(name, (story, act, group, manoeuvre), event) for name in names)

    def _actors(self, group: Element) -> list[str]:
        """Return the names of the vehicles that do what a group says, which must be said by name and once."""
        for reference in group.all("CatalogReference"):
            raise refused(reference)
        actors, many = group.get("Actors"), group.number("maximumExecutionCount", 1)
        if actors.values.get("selectTriggeringEntities") == "true":
            raise actors.error("actors by name", "selectTriggeringEntities", "name them")
        if many != 1:
            raise group.error("to be done once", f"{many:g}", "write 1", "maximumExecutionCount")
        names = [each.values.get("entityRef", "") for each in actors.all("EntityRef")]
        for name in names:
            if name not in self.cast.entities:
                expected = f"one of {', '.join(self.cast.entities)}"
                raise actors.error(expected, f"{name!r:.60}", "correct the name")
        return names

    def _begins(self, event: _Event, npc: _Npc | None, ego: str | None) -> tuple[_When, _When] | None:
        """Return when the act of an event and when the event itself begins; None if it waits for one not yet read."""
        found = []
        for part in (event.act, event.event):
            trigger = part.find("StartTrigger")
            when = _When(part, time=0.0) if trigger is None else self._when(trigger, event, npc, ego)
            if when is None:
                return None
            found.append(when)
        act, own = found
        if own.is_from_act and act.time is not None:
            own = own._replace(time=act.time + (own.time or 0.0))
        elif own.is_from_act and not own.is_at_once:
            raise refused(own.place, " with a delay after the beginning of an act by distance")
        return act, own

    def _when(self, trigger: Element, event: _Event, npc: _Npc | None, ego: str | None) -> _When | None:
        groups = [*trigger.all("ConditionGroup")]
        if not groups:
            return _When(trigger, time=0.0)
        if len(groups) > 1:
            raise trigger.error("one ConditionGroup", f"{len(groups)}", "leave the one that comes first")
        found: list[_When] = []
        for condition in groups[0].all("Condition"):
            when = self._condition(condition, event, npc, ego)
            if when is None:
                return None
            found.append(when)
        later = [each for each in found if not each.is_at_once] or found[:1]
        if len(later) != 1:
            names = ", ".join(inner_names(each.place).strip(" ()") or each.place.tag for each in later)
            raise groups[0].error("one condition that does not hold at once", names, "leave one of them")
        return later[0]

    def _condition(self, condition: Element, event: _Event, npc: _Npc | None, ego: str | None) -> _When | None:
        delay, edge = condition.number("delay", 0.0), condition.values.get("conditionEdge", "none")
        if edge == "falling":
            raise condition.error("a condition that begins to hold", "falling", "turn its rule", "conditionEdge")
        value = condition.find("ByValueCondition")
        if value is not None:
            inner = value.only()
            if inner.tag == "SimulationTimeCondition":
                if inner.values.get("rule") == "lessThan":
                    raise inner.error("greaterThan or greaterOrEqual", "lessThan", "turn the rule", "rule")
                return _When(condition, time=max(inner.number("value"), 0.0) + delay)
            if inner.tag == "StoryboardElementStateCondition":
                return self._state(condition, inner, event, npc, delay)
            raise refused(inner)
        entities = condition.get("ByEntityCondition")
        inner = entities.get("EntityCondition").only()
        if inner.tag not in ("RelativeDistanceCondition", "TimeHeadwayCondition"):
            raise refused(inner)
        triggering = [each.values.get("entityRef", "") for each in entities.all("TriggeringEntities/EntityRef")]
        if npc is None or {*triggering, inner.values.get("entityRef")} != {ego, event.actor}:
            between = f"between {' and '.join(triggering)} and {inner.values.get('entityRef')}"
            raise refused(inner, f" {between}, not between the ego and {event.actor}")
        return self._distance(condition, inner, npc, is_by_ego=triggering == [ego], delay=delay)

    def _distance(self, condition: Element, inner: Element, npc: _Npc, *, is_by_ego: bool, delay: float) -> _When:
        value, rule = inner.number("value"), inner.values.get("rule", "")
        is_less = rule in ("lessThan", "lessOrEqual")
        if not is_less and rule not in ("greaterThan", "greaterOrEqual"):
            raise inner.error("a rule with less or greater", f"{rule!r:.40}", "correct the rule", "rule")
        is_free = inner.values.get("freespace") == "true"
        if inner.tag == "TimeHeadwayCondition":
            # The triggering vehicle is the one behind, and its speed counts.
            rear = self.ego_speed if is_by_ego else npc.speed
            seconds = value if is_free or rear <= 0 else max(value - npc.room / rear, 0.0)
            side = 1 if is_by_ego else -1
            now = npc.gap * side / max(rear, 0.1) if npc.gap * side >= 0 else -math.inf
            trigger = {"headway": round(side * seconds, 1)}
            holds = 0 <= now < seconds if is_less else now > seconds
        else:
            kind = inner.values.get("relativeDistanceType", "longitudinal")
            if kind == "lateral":
                raise refused(inner, " across the road")
            if kind != "longitudinal":
                value = math.sqrt(max(value**2 - (npc.column * self.options.lane_width) ** 2, 0.0))
            metres = value if is_free else max(value - npc.room, 0.0)
            faster = 1 if npc.speed > self.ego_speed else -1 if npc.speed < self.ego_speed else npc.side
            side = npc.side if is_less else faster
            trigger = {"gap": round(side * metres, 1)}
            holds = abs(npc.gap) < metres if is_less else abs(npc.gap) > metres
        if not npc.steps and npc.clock == 0.0 and holds:
            if condition.values.get("conditionEdge", "none") != "none":
                raise condition.error(
                    "a distance that is not there from the beginning", inner.tag, "write none", "conditionEdge"
                )
            return _When(condition, time=delay)
        return _When(condition, trigger=trigger, delay=delay)

    def _state(self, condition: Element, inner: Element, event: _Event, npc: _Npc | None, delay: float) -> _When | None:
        """Return when an element of the storyboard begins or ends; None if what it has was not read yet."""
        name = inner.values.get("storyboardElementRef", "").rpartition("::")[2]
        kind, state = inner.values.get("storyboardElementType", "").lower(), inner.values.get("state", "")
        if state not in STATES:
            raise inner.error("a state of beginning or ending", f"{state!r:.40}", "name another state", "state")
        around = [each for each in event.around if each.values.get("name") == name]
        if STATES[state] == "begin" and around and kind != "event":
            return _When(condition, time=delay, is_from_act=True)  # the act has begun before its events
        of = [each for each in self.known if _is_named(each, kind, name)]
        if not of:
            raise refused(inner, f" for the {kind} {name!r:.60}, which is none of what others than the ego do")
        if any(id(each.event) not in self.spans for each in of):
            return None
        times = [self.spans[id(each.event)][STATES[state] == "end"] for each in of]
        if npc is not None and npc.last is not None and STATES[state] == "end" and of[-1].event is npc.last:
            return _When(condition, after=npc.last, delay=delay)
        if None not in times:
            known = [time for time in times if time is not None]
            return _When(condition, time=(min if STATES[state] == "begin" else max)(known) + delay)
        if npc is not None and npc.last is not None and STATES[state] == "begin" and of[0].event is npc.last:
            return _When(condition, trigger=npc.trigger, delay=delay)
        raise refused(inner, f" for {name}, whose time depends on a distance")

    # The scenario

    def _scenario(self, events: list[_Event], ego: str) -> Scenario:
        self.known, self.ego_speed = events, round(self.cast.speed_of(ego, ego), 6)
        npcs = {name: self._npc(name, ego) for name in self.cast.entities if name != ego}
        if not npcs:
            raise self.root.get("Entities").error("vehicles beside the ego", "none", "add one")
        waiting = [*events]
        while waiting:
            ready = {}
            for event in waiting:
                begins = self._begins(event, npcs[event.actor], ego)
                if begins is not None:
                    ready[event] = begins
            if not ready:
                raise refused(waiting[0].event, ", which waits for an event that never begins")
            event = _next(ready)
            waiting.remove(event)
            self._perform(npcs[event.actor], event, ready[event], npcs, ego)
        for act in {id(each.act): each.act for each in events}.values():
            self._check_stop(act)
        least = min(
            0, *(int(np.cumsum([npc.first.beside, *(s.column for s in npc.steps)]).min()) for npc in npcs.values())
        )
        try:
            chains = [(replace(npc.first, steps=tuple(npc.steps)),) for npc in npcs.values()]
            return Scenario(npcs=tuple(chains), ego_lane=max(1, -least), ego_speed=self.ego_speed)
        except ScenarioError as error:
            raise self.board.error(error.expected, error.received, error.fix or "take some of it out") from None

    def _npc(self, name: str, ego: str) -> _Npc:
        entity = self.cast.entities[name]
        distance, column = self.cast.relative(name, ego)
        room = (entity.length + self.cast.entities[ego].length) / 2
        gap = max(round(abs(distance) - room, 1), 0.1)
        if not column and abs(distance) < room:
            received = f"{distance:.1f} m ahead in its lane"
            raise entity.place.error("a start clear of the ego", received, "move it ahead or behind")
        if abs(distance) < room:
            moved = min(abs(distance), room - abs(distance))
            if moved > MOST_OVERLAP:
                fix = "move it ahead or behind, or level with the ego"
                raise entity.place.error("a start level with the ego, or clear of it", f"{distance:.1f} m ahead", fix)
            gap = 0.0 if abs(distance) < room / 2 else gap
        for deed in self.cast.initial(name):
            if deed.tag != "TeleportAction" and deed.find("SpeedAction") is None:
                raise refused(deed, inner_names(deed))
        speed = round(max(self.cast.speed_of(name, ego), 0.0), 1)
        try:
            first = Manoeuvre(beside=column, ahead=math.copysign(gap, distance), speed=speed)
        except ScenarioError as error:
            raise entity.place.error(error.expected, f"{error.field} {error.received}", "move it nearer") from None
        side = 1 if distance >= 0 else -1
        signed = math.copysign(abs(distance) - room, distance)
        return _Npc(entity=entity, first=first, column=column, gap=signed, room=room, speed=speed, side=side)

    def _perform(
        self, npc: _Npc, event: _Event, begins: tuple[_When, _When], npcs: Mapping[str, _Npc], ego: str
    ) -> None:
        """Add the steps of an event to an NPC."""
        act, own = begins
        given = event.event
        if given.values.get("priority") == "skip":
            raise given.error("override or parallel", "skip", "write parallel", "priority")
        if (count := given.number("maximumExecutionCount", 1)) != 1:
            raise given.error("to be done once", f"{count:g}", "write 1", "maximumExecutionCount")
        if id(event.act) in npc.acts:
            act = act._replace(time=0.0, trigger={}, after=None, delay=0.0)
        npc.acts.add(id(event.act))
        if own.is_at_once or act.is_at_once:
            whens = [act if own.is_at_once else own]
        elif act.time is not None and own.time is not None:
            whens = [own._replace(time=max(act.time, own.time))]
        else:
            whens = [act, own]
        steps: list[Step] = []
        try:
            for deed in _deeds(given):
                steps = _merged(steps, self._steps(deed, npc, npcs, ego), deed)
            steps = steps or [Step()]
            for when in whens[:-1]:
                self._append(npc, when, [Step()])
            speed = steps[0].speed
            if speed is not None and steps == [_at_once(speed)] and whens[-1].is_at_once and not npc.steps:
                npc.first = replace(npc.first, speed=speed)
                begun: float | None = 0.0
            else:
                begun = self._append(npc, whens[-1], steps)
        except ScenarioError as error:
            raise given.error(error.expected, f"{error.field} {error.received}", error.fix or "change it") from None
        self.spans[id(given)] = (begun, npc.clock)
        npc.last = given
        for step in steps:
            npc.column += step.column
            npc.speed = npc.speed if step.speed is None else step.speed

    def _append(self, npc: _Npc, when: _When, steps: Sequence[Step]) -> float | None:
        """Add steps, the first of which begins at a time, a distance or after the step before; return the time."""
        first, *rest = steps
        trigger: dict[str, Any] = dict(when.trigger)
        if trigger and trigger == npc.trigger and npc.steps:  # begins with the step before
            if when.delay:
                raise refused(when.place, " with a delay after a distance that has begun a step already")
            npc.steps[npc.newest :] = _merged(npc.steps[npc.newest :], steps, when.place)
            return None
        if trigger:
            if when.delay:
                npc.steps.append(replace(Step(), **trigger))
                first = replace(first, after=round(when.delay, 1))
            else:
                first = replace(first, **trigger)
            npc.side = 1 if min(trigger.values()) >= 0 else -1
            npc.clock = npc.began = None
        elif when.after is not None:
            first = replace(first, after=round(when.delay, 1))
            npc.began = None if npc.clock is None else npc.clock + when.delay
        else:
            time = 0.0 if when.time is None or when.time <= AT_ONCE else when.time
            if npc.clock is None:
                fix = "let it begin at a distance, or after the event before it"
                raise when.place.error("a time before all distances of the vehicle", f"{time:g} s", fix)
            if npc.steps and npc.began is not None and abs(time - npc.began) < AT_ONCE:
                npc.steps[npc.newest :] = _merged(npc.steps[npc.newest :], steps, when.place)
                npc.clock = max(npc.clock, npc.began + self._seconds(npc, steps))
                return npc.began
            if time < npc.clock - AT_ONCE:
                fix = "let it begin later"
                raise when.place.error(
                    f"a time after the step before, which ends at about {npc.clock:.1f} s", f"{time:g} s", fix
                )
            first = replace(first, after=round(max(time - npc.clock, 0.0), 1))
            npc.began = time
        npc.trigger, npc.newest = trigger, len(npc.steps)
        npc.steps += [first, *rest]
        if npc.began is not None:
            npc.clock = npc.began + self._seconds(npc, steps)
        return npc.began

    def _seconds(self, npc: _Npc, steps: Sequence[Step]) -> float:
        """Return how long steps take, nearly [s]."""
        total, speed = 0.0, npc.speed
        for step in steps:
            change = 0.0 if step.speed is None else step.speed - speed
            most = BRAKING if change < 0 else SPEEDING_UP
            aside = 0.3 + LANE_CHANGED / step.lateral_speed if step.column else 0.0
            total += max(abs(change) / min(step.acceleration, most), aside)
            speed += change
        return total

    def _steps(self, deed: Element, npc: _Npc, npcs: Mapping[str, _Npc], ego: str) -> list[Step]:
        """Return the steps of an action; none if there is nothing to do."""
        action = deed.children[0] if deed.tag in ("LongitudinalAction", "LateralAction") and deed.children else deed
        if action.tag == "SpeedAction":
            speed = round(max(self.cast.speed_asked(action, ego, self.ego_speed), 0.0), 1)
            change, taken = abs(speed - npc.speed), action.get("SpeedActionDynamics")
            value, dimension = abs(taken.number("value", 0.0)), taken.values.get("dynamicsDimension")
            if taken.values.get("dynamicsShape") == "step" or value == 0:
                return [_at_once(speed)]
            if dimension == "distance":
                rate = abs(speed**2 - npc.speed**2) / (2 * value)
            else:
                rate = value if dimension == "rate" else change / value
            return [Step(speed=speed, acceleration=min(max(round(rate, 1), 0.1), 20.0))]
        if action.tag == "LaneChangeAction":
            target = action.get("LaneChangeTarget").only()
            other = target.values.get("entityRef")
            if target.tag == "AbsoluteTargetLane":
                own = self.cast.start(ego, target)
                if own.frame[0] != "lane":
                    raise refused(target, ", while the ego's place does not name a lane")
                number = target.number("value")
                if number > -1:  # as with places: where those with positive numbers lead depends on the road
                    raise target.error("a lane with a negative number", f"{number:g}", "take it out", "value")
                column = -number - own.column
            elif other != ego and other not in npcs:
                raise target.error("a vehicle of the file", f"{other!r:.60}", "correct the name", "entityRef")
            else:
                column = (0 if other == ego else npcs[str(other)].column) - target.number("value")
            shift, taken = round(column) - npc.column, action.get("LaneChangeActionDynamics")
            if abs(shift) > MOST_STEPS:
                raise target.error(f"at most {MOST_STEPS} lanes to cross", f"{abs(shift)}", "correct the lane", "value")
            seconds = self._aside(taken, npc) / max(abs(shift), 1)
            lateral = min(max(round(LANE_CHANGED / max(seconds - 0.3, 0.1), 1), 0.1), 5.0)
            offset = -round(action.number("targetLaneOffset", 0.0), 1)
            lane: Any = "right" if shift > 0 else "left"
            lanes = [Step(lane=lane, lateral_speed=lateral)] * abs(shift)
            return [*lanes[:-1], *(replace(each, offset=offset) for each in lanes[-1:])]
        if action.tag == "LaneOffsetAction":
            target = action.get("LaneOffsetTarget").only()
            if target.tag != "AbsoluteTargetLaneOffset":
                raise refused(target)
            return [Step(offset=-round(target.number("value"), 1))]
        raise refused(action)

    def _aside(self, taken: Element, npc: _Npc) -> float:
        """Return how long a change of lanes takes [s]."""
        value, dimension = abs(taken.number("value", 0.0)), taken.values.get("dynamicsDimension")
        if taken.values.get("dynamicsShape") == "step" or value == 0:
            return 0.0
        if dimension == "rate":
            return self.options.lane_width / value
        if dimension == "distance":
            return value / max(npc.speed, 0.1)
        return value

    def _check_stop(self, act: Element) -> None:
        """Refuse an act that something else than a time ends; a run ends by itself."""
        for condition in act.all("StopTrigger/ConditionGroup/Condition"):
            if condition.find("ByValueCondition/SimulationTimeCondition") is None:
                raise refused(condition, inner_names(condition))

    # Tracks

    def _tracks(self, events: list[_Event], ego: str | None, between: Between) -> Recording:
        self.known, (first, last) = [], between or (-math.inf, math.inf)
        driven: dict[str, FloatArray] = {}
        for event in events:
            for deed in _deeds(event.event):
                if not any(_deeds(event.event, "FollowTrajectoryAction")):
                    raise refused(deed, f"{inner_names(deed)} of {event.actor} in a file with trajectories")
                begins = self._begins(event, None, ego)
                if begins is None or any(each.time is None for each in begins) or event.actor in driven:
                    raise refused(event.event, ", one of several of the vehicle, or not at a time")
                start = max(each.time or 0.0 for each in begins)
                rows = vertices(deed, 0.0 if start <= AT_ONCE else start)
                driven[event.actor] = rows[(rows[:, 0] >= first) & (rows[:, 0] <= last)]
        for name, entity in self.cast.entities.items():
            if name not in driven:
                raise entity.place.error("a trajectory of each vehicle", f"none of {name}", "take it out")
        boxes = [
            (name, entity.kind, entity.length, entity.width, entity.centre)
            for name, entity in self.cast.entities.items()
        ]
        vehicles, rate = followed(driven, boxes, self.board)
        notes = ("the data have no lanes", "speeds are those between places")
        return Recording(vehicles=vehicles, rate=rate, ego=ego, source=str(self.root.path), notes=notes)


def _next(ready: Mapping[_Event, tuple[_When, _When]]) -> _Event:
    """Return the event of those that can begin that is first: after another one, at once, or by the order of the file.

    The file's order is also that of an NPC's distances. Up to the first of them, times have their own order.
    """
    times = []
    for event, begins in ready.items():
        known = [each.time for each in begins if each.time is not None]
        if any(each.after is not None for each in begins) or (len(known) == len(begins) and max(known) <= AT_ONCE):
            return event
        times.append(max(known) if len(known) == len(begins) else math.inf)
    first, *_ = ready
    until = next((number for number, time in enumerate(times) if math.isinf(time)), len(times))
    own = [(time, number) for number, time in enumerate(times[:until])]
    return [*ready][min(own)[1]] if own else first


STATES = {
    "startTransition": "begin", "runningState": "begin",
    "endTransition": "end", "completeState": "end", "stopTransition": "end",
}  # fmt: skip
"""The states of elements of a storyboard by what has happened."""


def _at_once(speed: float | None) -> Step:
    """Return the step that reaches a speed as soon as an NPC can; at the beginning, it is the first speed."""
    return Step(speed=speed, acceleration=20.0)


def _is_named(event: _Event, kind: str, name: str) -> bool:
    """Return whether an event is, or is within, the element of the storyboard with a kind and a name."""
    elements: Mapping[str, Sequence[Element]] = {
        "story": event.around[:1],
        "act": event.around[1:2],
        "maneuvergroup": event.around[2:3],
        "maneuver": event.around[3:],
        "event": (event.event,),
        "action": [*event.event.all("Action")],
    }
    return any(each.values.get("name") == name for each in elements.get(kind, ()))


def _deeds(event: Element, name: str = "") -> Iterator[Element]:
    """Yield what the actions of an event do; with a name only what has it."""
    for deed in (deed for action in event.all("Action/PrivateAction") for deed in action.children):
        if not name:
            yield deed
        else:
            yield from deed.all(name) if deed.tag != name else (deed,)


def _merged(steps: Sequence[Step], more: Sequence[Step], place: Element) -> list[Step]:
    """Return steps that begin together as one: one may change the speed, and the other the lane or the offset."""
    if not steps or not more:
        return [*(steps or more)]
    one, other = (steps[0], more[0]) if more[0].speed is None else (more[0], steps[0])
    if other.speed is not None or one.column or one.offset:
        raise place.error("one action along and one across the road at a time", "two of a kind", "take one out")
    across = other if other.column or other.offset else one
    begun = steps[0]
    step = replace(
        begun,
        speed=one.speed,
        acceleration=one.acceleration,
        lane=across.lane,
        lateral_speed=across.lateral_speed,
        offset=across.offset,
    )
    return [step, *steps[1:], *more[1:]]
