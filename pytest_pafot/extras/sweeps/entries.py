"""The catalogue of named scenarios, which ``@pafot.catalogue``, ``pafot.sweep`` and the command ``map`` take by name.

The figures of ``r157/`` are those of ASAM's OSC-ALKS scenarios (2024), which follow UN Regulation No. 157. Those of
``euro-ncap/`` are from its published rating tool (vehicle assistance, 2026), and for the braking leader from AEB
car-to-car scenarios that others published after its protocol of 2023; the protocols themselves were not read. A policy
that avoids a collision here has passed none of them: there are only cars of one size on one straight road. Left out is
what they have beyond that: pedestrians, motorcycles and lorries, curves, partial overlap, a leader beside the centre of
the lane, a second stationary vehicle, an offset along the road of a vehicle beside the ego, and the range of sensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from types import MappingProxyType
from typing import Any

from pytest_pafot import (
    CAR,
    Cell,
    CrossingInstruction,
    Highway,
    Manoeuvre,
    PositionInstruction,
    Scenario,
    ScenarioError,
    Step,
    Traffic,
)
from pytest_pafot.extending import base_world
from pytest_pafot.support.errors import RequestError, plain_number
from pytest_pafot.support.text import meant

KMH = 1 / 3.6
"""One kilometre per hour [m/s]."""
FASTEST = 36.3
"""The speed limit of the highway on which entries are driven by default [m/s]; 130 km/h is below it."""
LEAD, LATER = 1.0, 4.0
"""The time before a gap is reached, in which a policy can begin to drive; for a second vehicle, longer [s]."""
LANE = 4.0
"""The width of the lane that a vehicle crosses when it changes lanes [m]."""
EGO_LANE = 1
"""The lane in which the ego starts in a world that does not say."""
NEAR = 0.05
"""The difference up to which a value is that of a range, since scenarios have numbers in steps of 0.1."""
ALKS = "UN R157, after ASAM OSC-ALKS"
NCAP = "Euro NCAP, vehicle assistance"
SIDE = "the side from which it comes: 1 the right, -1 the left"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of a catalogue entry.

    Attributes:
        default: its default.
        low, high: the range that the entry's source gives.
        unit: its unit.
        about: what it is.
    """

    default: float
    low: float
    high: float
    unit: str
    about: str

    @property
    def span(self) -> str:
        """The range in words; a number without a unit is a side, which has nothing between its two values."""
        return f"{self.low:.4g} {'to' if self.unit else 'or'} {self.high:.4g}" if self.low < self.high else "fixed"


class NoPlaceError(ScenarioError):
    """Error for an entry whose kind of road a world does not have."""


Make = Callable[[Mapping[str, float], Any], Scenario]
"""A function from the values of all parameters and a world to the scenario."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A named scenario with its parameters.

    Attributes:
        name: its name, such as ``r157/cut-in``.
        about: what happens, in a sentence.
        source: where it comes from.
        parameters: its parameters by name.
        seconds: the duration of a run [s].
    """

    name: str
    about: str
    source: str
    parameters: Mapping[str, Parameter]
    make: Make
    seconds: float = 20.0

    def scenario(self, world: Any = None, /, **values: float) -> Scenario:
        """Return the scenario for a world, with some parameters changed.

        Raises:
            RequestError: for a parameter that the entry does not have, or a value that is no number.
            ScenarioError: if there is no such scenario, such as for a negative speed.
        """
        self.check(values)
        defaults = {name: each.default for name, each in self.parameters.items()}
        return self.make(defaults | values, self.world() if world is None else world)

    def check(self, values: Mapping[str, float]) -> None:
        """Refuse values that are no numbers, and parameters that the entry does not have.

        Raises:
            RequestError: for one of these.
        """
        for name, value in values.items():
            if name not in self.parameters:
                known = f"one of the parameters {', '.join(self.parameters)}"
                hint = meant(name, self.parameters)
                raise RequestError(f"{self.name}: expected {known}, received {name!r}{hint}")
            if plain_number(value) is None:
                many = "; pafot.sweep drives several values" if isinstance(value, list | tuple) else ""
                raise RequestError(f"{self.name}: {name}: expected a number, received {value!r:.60}{many}")
            if name == "side" and value not in (-1, 1):
                raise RequestError(f"{self.name}: side: expected 1 (right) or -1 (left), received {value!r:.60}")

    def beyond(self, values: Mapping[str, Sequence[float]]) -> tuple[str, ...]:
        """Return a sentence for each parameter that has values outside of its range."""
        found = []
        for name, given in values.items():
            each = self.parameters.get(name)
            ends = () if each is None else dict.fromkeys((min(given), max(given)))
            out = [f"{end:.4g}" for end in ends if each and not each.low - NEAR <= end <= each.high + NEAR]
            if each is not None and out:
                found.append(f"{name} {' and '.join(out)} {each.unit}: outside of its range ({each.span})")
        return tuple(found)

    def world(self, world: Any = None) -> Any:
        """Return a world, by default a highway, with runs that last as long as this scenario takes."""
        if world is None:
            return Highway(speed_limit=FASTEST, duration=self.seconds)
        seconds = min(self.seconds, float(world.longest_run))
        return world.lasting(seconds) if base_world(world).can_last else world


def _tenths(value: float) -> float:
    return round(value, 1) + 0.0


def _highway(world: Any, ego_speed: float, *npcs: Any) -> Scenario:
    lane = (getattr(world, "start", None) or (EGO_LANE,))[0]
    chains = tuple(npc if isinstance(npc, tuple) else (npc,) for npc in npcs)
    return Scenario(npcs=chains, ego_lane=lane, ego_speed=_tenths(ego_speed))


def _cutting_in(v: Mapping[str, float], side: float, gap: float, lead: float = LEAD) -> Manoeuvre:
    speed, gap = v["ego_speed"] + v["relative_speed"], _tenths(gap)
    inwards: Any = "left" if side > 0 else "right"
    steps = (Step(gap=gap, lane=inwards, lateral_speed=_tenths(v["lateral_speed"])),)
    ahead = _tenths(gap - lead * v["relative_speed"])
    return Manoeuvre(beside=1 if side > 0 else -1, ahead=ahead, speed=_tenths(speed), steps=steps)


def _cut_in(v: Mapping[str, float], world: Any) -> Scenario:
    return _highway(world, v["ego_speed"], _cutting_in(v, v["side"], v["gap"]))


def _cut_in_at_ttc(v: Mapping[str, float], world: Any) -> Scenario:
    closing, changing = v["ego_speed"] - v["target_speed"], LANE / max(v["lateral_speed"], 0.1)
    values = {**v, "relative_speed": -closing}
    return _highway(world, v["ego_speed"], _cutting_in(values, v["side"], (v["ttc"] + changing) * closing))


def _second_cut_in(v: Mapping[str, float], world: Any) -> Scenario:
    """Let a vehicle cut in from one side, and a second one from the other side into the gap that is left."""
    first = _cutting_in(v, 1, v["gap"])
    return _highway(world, v["ego_speed"], first, _cutting_in(v, -1, v["second_gap"], LATER))


def _leading(v: Mapping[str, float], *steps: Step) -> Manoeuvre:
    """Return a leader at the headway of the ego, whose first step begins at once."""
    ahead = _tenths(v["headway"] * v["ego_speed"])
    first, *others = steps
    return Manoeuvre(beside=0, ahead=ahead, speed=_tenths(v["ego_speed"]), steps=(replace(first, gap=ahead), *others))


def _cut_out(v: Mapping[str, float], world: Any) -> Scenario:
    aside: Any = "right" if v["side"] > 0 else "left"
    leader = _leading(v, Step(lane=aside, lateral_speed=_tenths(v["lateral_speed"])))
    distance = v["front_distance"] if "front_distance" in v else v["ttc"] * v["ego_speed"]
    standing = _tenths(leader.ahead + CAR.length + distance)
    return _highway(world, v["ego_speed"], leader, Manoeuvre(beside=0, ahead=standing, speed=0.0))


def _braking(v: Mapping[str, float], world: Any) -> Scenario:
    step = Step(speed=0.0, acceleration=_tenths(v["deceleration"]))
    return _highway(world, v["ego_speed"], _leading(v, step))


def _braking_at(v: Mapping[str, float], world: Any) -> Scenario:
    ahead = _tenths(v["gap"])
    step = Step(gap=ahead, speed=0.0, acceleration=_tenths(v["deceleration"]))
    leader = Manoeuvre(beside=0, ahead=ahead, speed=_tenths(v["ego_speed"]), steps=(step,))
    return _highway(world, v["ego_speed"], leader)


def _slower(v: Mapping[str, float], world: Any) -> Scenario:
    speed = v.get("target_speed", v["ego_speed"] + v.get("relative_speed", 0.0))
    leader = Manoeuvre(beside=0, ahead=_tenths(v["distance"]), speed=_tenths(speed))
    return _highway(world, v["ego_speed"], leader)


def _following(v: Mapping[str, float], world: Any) -> Scenario:
    fastest = min(v["ego_speed"] + v["change"], float(world.speed_limit))
    slowest = max(v["ego_speed"] - v["change"], 0.0)
    gently = _tenths(v["acceleration"])
    faster = Step(speed=_tenths(fastest - 0.05), acceleration=gently)
    slower = Step(after=10.0, speed=_tenths(slowest), acceleration=gently)
    return _highway(world, v["ego_speed"], _leading(v, faster, slower))


def _swerving(v: Mapping[str, float], world: Any) -> Scenario:
    offset, aside = _tenths(v["offset"]), _tenths(v["lateral_speed"])
    steps = [Step(offset=offset, lateral_speed=aside), Step(after=5.0, lateral_speed=aside)]
    return _highway(world, v["ego_speed"], _leading(v, *steps, Step(offset=-offset, lateral_speed=aside)))


def _beside(v: Mapping[str, float], world: Any) -> Scenario:
    side = 1 if v["side"] > 0 else -1
    closer = Step(offset=_tenths(-side * v["offset"]), lateral_speed=0.5)
    return _highway(
        world, v["ego_speed"], Manoeuvre(beside=side, ahead=0.0, speed=_tenths(v["ego_speed"]), steps=(closer,))
    )


def _boxed_in(v: Mapping[str, float], world: Any) -> Scenario:
    leader = _leading(v, Step(speed=0.0, acceleration=_tenths(v["deceleration"])))
    level = [Manoeuvre(beside=side, ahead=0.0, speed=_tenths(v["ego_speed"])) for side in (-1, 1)]
    return _highway(world, v["ego_speed"], leader, *level)


def _pulls_away(v: Mapping[str, float], world: Any) -> Scenario:
    going = Step(gap=_tenths(v["gap"]), speed=_tenths(v["pull_speed"]), acceleration=2.0)
    stopping = Step(after=1.0, speed=0.0, acceleration=_tenths(v["deceleration"]))
    leader = Manoeuvre(beside=0, ahead=_tenths(v["distance"]), speed=0.0, steps=(going, stopping))
    return _highway(world, v["ego_speed"], leader)


def _tail(v: Mapping[str, float], world: Any) -> Scenario:
    braking = Step(speed=0.0, acceleration=_tenths(v["deceleration"]))
    leader = _leading(v, braking, Step(after=3.0, speed=_tenths(v["pull_speed"]), acceleration=2.0))
    fastest = math.floor(10 * world.speed_limit + 1e-9) / 10
    tail = (PositionInstruction(Cell.REAR, min(_tenths(v["ego_speed"]), fastest)),)
    return replace(_highway(world, v["ego_speed"], leader, tail), traffic=Traffic())  # in which a follower brakes, too


def _at_zone(kind: str) -> Make:
    def make(v: Mapping[str, float], world: Any) -> Scenario:
        known = getattr(world, "crossings", None)
        zones = () if known is None else tuple(zone for zone in known.zones if zone.kind == kind)
        if known is None or not zones:
            fix = 'drive it in a world that has one, such as pafot.World("intersection-v0", planner_hz=5)'
            fix += "; the command map takes --world intersection-v0, for a planner with @planner after its name"
            expected = f"a road on which another way is {kind} with the ego's"
            raise NoPlaceError(field="world", expected=expected, received="one without", fix=fix)
        fastest, zone = max(((known.ways[zone.way].speed_at(zone.npc[0]), zone) for zone in zones), key=itemgetter(0))
        if v["speed"] > fastest:  # it would slow down for its bend, and be the same situation as a slower one
            expected = f"at most {fastest:.1f} m/s, which the bends of {zone.way} allow at the zone"
            raise ScenarioError(field="speed", expected=expected, received=f"{v['speed']:g}")
        lane, speed = getattr(world, "start", None) or (EGO_LANE, v["speed"])
        told = CrossingInstruction(zone.way, _tenths(v["slot"]), _tenths(v["speed"]))
        return Scenario(npcs=((told,),), ego_lane=lane, ego_speed=float(speed))

    return make


def _parameters(**given: tuple[float, float, float, str, str]) -> Mapping[str, Parameter]:
    return MappingProxyType({name: Parameter(*each) for name, each in given.items()})


_EGO = (60 * KMH, 5 * KMH, 60 * KMH, "m/s", "the ego's first speed")
_HEADWAY = (2.0, 1.0, 2.0, "s", "the leader's distance in time")
_LATERAL = (2.0, 0.5, 3.0, "m/s", "the speed across the road")
_ZONE = {
    "slot": (0.0, -5.0, 5.0, "s", "the time between the ego and the other vehicle in the zone"),
    "speed": (6.0, 1.0, 15.0, "m/s", "the other vehicle's speed"),  # which bends of intersections allow
}

ENTRIES = (
    Entry(
        name="r157/cut-in",
        about="A slower vehicle changes into the ego's lane, ahead of it.",
        source=f"{ALKS} 4.4",
        parameters=_parameters(
            ego_speed=(60 * KMH, 20 * KMH, 60 * KMH, "m/s", _EGO[4]),
            relative_speed=(-20 * KMH, -50 * KMH, -10 * KMH, "m/s", "its speed minus the ego's"),
            gap=(30.0, 0.0, 60.0, "m", "the gap at which it begins to change lanes"),
            lateral_speed=_LATERAL,
            side=(1.0, -1.0, 1.0, "", SIDE),
        ),
        make=_cut_in,
    ),
    Entry(
        name="r157/cut-out",
        about="The leader changes lanes shortly before a stationary vehicle.",
        source=f"{ALKS} 4.5",
        parameters=_parameters(
            ego_speed=_EGO,
            headway=_HEADWAY,
            front_distance=(50.0, 10.0, 100.0, "m", "the leader's distance to the stationary vehicle when it leaves"),
            lateral_speed=_LATERAL,
            side=(-1.0, -1.0, 1.0, "", "the side to which the leader leaves: 1 the right, -1 the left"),
        ),
        make=_cut_out,
    ),
    Entry(
        name="r157/braking-leader",
        about="The leader brakes to a stop.",
        source=f"{ALKS} 4.3 (10 m/s^2 there at most; NPCs brake at up to 8)",
        parameters=_parameters(
            ego_speed=_EGO,
            headway=_HEADWAY,
            deceleration=(6.0, 1.0, 8.0, "m/s^2", "its braking"),
        ),
        make=_braking,
    ),
    Entry(
        name="r157/stationary-leader",
        about="A stationary vehicle blocks the ego's lane.",
        source=f"{ALKS} 4.2, from a shorter distance",
        parameters=_parameters(
            ego_speed=_EGO,
            distance=(200.0, 50.0, 480.0, "m", "the distance to it at the start"),
            target_speed=(0.0, 0.0, 0.0, "m/s", "its speed"),
        ),
        make=_slower,
        seconds=40.0,
    ),
    Entry(
        name="r157/slow-leader",
        about="The ego comes up behind a slower vehicle.",
        source="UN R157, 5.2.3; the figures are the project's own",
        parameters=_parameters(
            ego_speed=_EGO,
            relative_speed=(-20 * KMH, -50 * KMH, -10 * KMH, "m/s", "its speed minus the ego's"),
            distance=(60.0, 20.0, 200.0, "m", "the distance to it at the start"),
        ),
        make=_slower,
        seconds=30.0,
    ),
    Entry(
        name="r157/following",
        about="The leader speeds up gently, and slows down gently ten seconds later.",
        source=f"{ALKS} 4.3, comfortable",
        parameters=_parameters(
            ego_speed=_EGO,
            headway=(1.6, 1.0, 2.0, "s", _HEADWAY[4]),
            change=(5.0, 0.0, 5.0, "m/s", "the change of its speed"),
            acceleration=(1.0, 0.5, 2.0, "m/s^2", "its acceleration"),
        ),
        make=_following,
        seconds=40.0,
    ),
    Entry(
        name="r157/swerving-leader",
        about="The leader swerves to one side of its lane and then to the other.",
        source=f"{ALKS} 4.1, with a lateral speed in the place of its acceleration",
        parameters=_parameters(
            ego_speed=_EGO,
            headway=_HEADWAY,
            offset=(1.5, 0.0, 1.5, "m", "the offset from the centre of the lane"),
            lateral_speed=(0.7, 0.1, 2.0, "m/s", _LATERAL[4]),
        ),
        make=_swerving,
        seconds=30.0,
    ),
    Entry(
        name="r157/side-vehicle",
        about="A vehicle drives beside the ego, near the line between them.",
        source=f"{ALKS} 4.1, level with the ego",
        parameters=_parameters(
            ego_speed=_EGO,
            offset=(0.5, 0.0, 0.5, "m", "its offset towards the ego"),
            side=(1.0, -1.0, 1.0, "", SIDE),
        ),
        make=_beside,
    ),
    Entry(
        name="euro-ncap/ccrs",
        about="A stationary vehicle blocks the ego's lane.",
        source=f"{NCAP}: CCRs; the distance is the project's own",
        parameters=_parameters(
            ego_speed=(60 * KMH, 60 * KMH, 130 * KMH, "m/s", _EGO[4]),
            distance=(200.0, 50.0, 480.0, "m", "the distance to it at the start"),
            target_speed=(0.0, 0.0, 0.0, "m/s", "its speed"),
        ),
        make=_slower,
        seconds=40.0,
    ),
    Entry(
        name="euro-ncap/ccrm",
        about="The ego comes up behind a slow vehicle.",
        source=f"{NCAP}: CCRm; the distance is the project's own",
        parameters=_parameters(
            ego_speed=(60 * KMH, 60 * KMH, 130 * KMH, "m/s", _EGO[4]),
            distance=(200.0, 50.0, 480.0, "m", "the distance to it at the start"),
            target_speed=(20 * KMH, 20 * KMH, 60 * KMH, "m/s", "its speed"),
        ),
        make=_slower,
        seconds=40.0,
    ),
    Entry(
        name="euro-ncap/ccrb",
        about="The leader, at the ego's speed, brakes to a stop.",
        source="Euro NCAP, AEB car-to-car 2023, after Vector's OSC-NCAP: CCRb",
        parameters=_parameters(
            ego_speed=(50 * KMH, 50 * KMH, 50 * KMH, "m/s", _EGO[4]),
            gap=(12.0, 12.0, 40.0, "m", "the gap between the two"),
            deceleration=(2.0, 2.0, 6.0, "m/s^2", "its braking"),
        ),
        make=_braking_at,
    ),
    Entry(
        name="euro-ncap/cut-in",
        about="A slower vehicle changes into the ego's lane.",
        source=f"{NCAP}: cut-in at 50 and 120 km/h; when the time to contact counts was not found",
        parameters=_parameters(
            ego_speed=(120 * KMH, 50 * KMH, 120 * KMH, "m/s", _EGO[4]),
            target_speed=(70 * KMH, 10 * KMH, 70 * KMH, "m/s", "its speed"),
            ttc=(1.5, 0.0, 1.5, "s", "the time to contact once it has had the time to cross a lane at that speed"),
            lateral_speed=_LATERAL,
            side=(1.0, -1.0, 1.0, "", SIDE),
        ),
        make=_cut_in_at_ttc,
    ),
    Entry(
        name="euro-ncap/cut-out",
        about="The leader changes lanes shortly before a stationary vehicle.",
        source=f"{NCAP}: cut-out of leaders at 50 and 70 km/h, at first as fast as the ego",
        parameters=_parameters(
            ego_speed=(50 * KMH, 50 * KMH, 70 * KMH, "m/s", _EGO[4]),
            headway=_HEADWAY,
            ttc=(3.0, 3.0, 3.0, "s", "the leader's time to contact with the stationary vehicle when it leaves"),
            lateral_speed=_LATERAL,
            side=(-1.0, -1.0, 1.0, "", "the side to which the leader leaves: 1 the right, -1 the left"),
        ),
        make=_cut_out,
    ),
    Entry(
        name="classic/boxed-in",
        about="The leader brakes to a stop while a vehicle drives on each side of the ego.",
        source="the project",
        parameters=_parameters(
            ego_speed=(20.0, 5.0, 30.0, "m/s", _EGO[4]),
            headway=(1.5, 0.5, 3.0, "s", _HEADWAY[4]),
            deceleration=(4.0, 1.0, 8.0, "m/s^2", "its braking"),
        ),
        make=_boxed_in,
    ),
    Entry(
        name="classic/pulls-away",
        about="A stationary leader pulls away as the ego comes near, and stops again.",
        source="the project",
        parameters=_parameters(
            ego_speed=(15.0, 5.0, 25.0, "m/s", _EGO[4]),
            distance=(90.0, 30.0, 200.0, "m", "the distance to it at the start"),
            gap=(60.0, 10.0, 100.0, "m", "the gap at which it pulls away"),
            pull_speed=(6.0, 2.0, 15.0, "m/s", "the speed to which it pulls away"),
            deceleration=(6.0, 1.0, 8.0, "m/s^2", "its braking"),
        ),
        make=_pulls_away,
        seconds=30.0,
    ),
    Entry(
        name="classic/second-cut-in",
        about="A vehicle cuts in from the right, and another one from the left into the gap that is left.",
        source="the project",
        parameters=_parameters(
            ego_speed=(22.0, 10.0, 30.0, "m/s", _EGO[4]),
            relative_speed=(-5.0, -12.0, -1.0, "m/s", "their speed minus the ego's"),
            gap=(50.0, 20.0, 100.0, "m", "the gap at which the first one begins to change lanes"),
            second_gap=(15.0, 5.0, 50.0, "m", "the gap at which the second one does"),
            lateral_speed=_LATERAL,
        ),
        make=_second_cut_in,
    ),
    Entry(
        name="classic/tail-after-stop",
        about="The leader stops, waits and drives off, while a vehicle follows close behind the ego.",
        source="the project",
        parameters=_parameters(
            ego_speed=(20.0, 5.0, 30.0, "m/s", _EGO[4]),
            headway=(2.0, 1.0, 3.0, "s", _HEADWAY[4]),
            deceleration=(4.0, 1.0, 8.0, "m/s^2", "its braking"),
            pull_speed=(10.0, 2.0, 20.0, "m/s", "the speed to which it drives off"),
        ),
        make=_tail,
        seconds=30.0,
    ),
    Entry(
        name="junction/crossing",
        about="A vehicle crosses the ego's way.",
        source="the project",
        parameters=_parameters(**_ZONE),
        make=_at_zone("crossing"),
    ),
    Entry(
        name="junction/oncoming-turn",
        about="An oncoming vehicle turns across the ego's way, or the ego across that of an oncoming one.",
        source="the project",
        parameters=_parameters(**_ZONE),
        make=_at_zone("oncoming"),
    ),
    Entry(
        name="junction/merge",
        about="A vehicle merges into the ego's lane.",
        source="the project",
        parameters=_parameters(**_ZONE),
        make=_at_zone("merging"),
    ),
)
"""All entries, in the order in which they are listed."""

NAMES = tuple(entry.name for entry in ENTRIES)


def entry_of(name: object) -> Entry:
    """Return the entry of a name.

    Raises:
        RequestError: if there is none.
    """
    for entry in ENTRIES:
        if entry.name == name:
            return entry
    raise RequestError(f"catalogue: expected one of {', '.join(NAMES)}, received {name!r:.60}{meant(name, NAMES)}")


def chosen(names: tuple[Any, ...]) -> tuple[Entry, ...]:
    """Return the entries with some names; a name such as ``r157`` stands for all that begin with it; none for all.

    A ``pafot.Recording`` in the place of a name stands for its own entries.
    """
    if not names:
        return ENTRIES
    found: list[Entry] = []
    for name in names:
        if hasattr(name, "entries"):
            found += name.entries
            continue
        group = [entry for entry in ENTRIES if isinstance(name, str) and entry.name.startswith(f"{name}/")]
        found += group or [entry_of(name)]
    return tuple({entry.name: entry for entry in found}.values())


def fits(scenario: Scenario, world: Any) -> str:
    """Return why a scenario cannot be driven in a world; empty if it can."""
    if not base_world(world).has_manoeuvres and any(chain[0].place for chain in scenario.npcs):
        return f"expected a world whose NPCs can have manoeuvres, received {world!r:.80}"
    try:
        base_world(world).check_fits(scenario)
    except ScenarioError as error:
        return str(error)
    return ""
