"""The vehicles of an OpenSCENARIO file: their sizes, the ego among them, and what Init says of their starts."""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from pytest_pafot.extras.recordings.openscenario_parameters import resolved
from pytest_pafot.extras.recordings.recording import EGO_NAMES
from pytest_pafot.extras.recordings.xml_data import Element, read_xml

OF_VEHICLES = ("ParameterDeclarations", "BoundingBox", "Performance", "Axles", "Properties", "TrailerHitch")
BESIDE_MIDDLE = 0.15
"""The largest distance from the middle of a lane, as a share of the lane, at which a vehicle is placed there."""


class Options(NamedTuple):
    """The arguments with which a user reads a scenario; see :func:`pytest_pafot.recorded`."""

    ego: str | None
    vehicles: Sequence[str | Path]
    without: Sequence[str]
    lane_width: float


def refused(element: Element, what: str = "") -> Exception:
    """Return the error for an element that no manoeuvre can express."""
    if element.tag in WRAPPINGS and element.children:
        element, what = element.children[0], ""
    fix = f"take it out, or say without=[{element.tag!r}] if the scenario is the same without it"
    return element.error(CAN, f"{element.tag}{what}", fix)


CAN = (
    "what a manoeuvre can do: change speed, lane or offset, at a time or a distance to the ego, or follow a trajectory"
)
WRAPPINGS = ("GlobalAction", "PrivateAction", "LongitudinalAction", "LateralAction", "EntityCondition")
"""The elements that only say of what kind their content is."""


def removed(element: Element, names: frozenset[str]) -> None:
    """Remove all elements with some names, and what is empty without them."""
    for child in [*element.children]:
        had = bool(child.children)
        removed(child, names)
        if child.tag in names or (had and not child.children):
            element.children.remove(child)


@dataclass(frozen=True, slots=True, kw_only=True)
class Entity:
    """A vehicle: its size [m], and how far its centre is ahead of its place, which is that of the rear axle [m]."""

    name: str
    kind: str
    length: float
    width: float
    centre: float
    place: Element


class Place(NamedTuple):
    """A place along a road, or on the plane with its heading; places with other frames cannot be compared."""

    frame: tuple[str, ...]
    along: float
    column: float
    heading: float = 0.0


class Cast:
    """The vehicles of a scenario in ``entities``, by name."""

    def __init__(self, root: Element, options: Options) -> None:
        self.root, self.options = root, options
        self._sought: list[str] = []  # the vehicles whose places are being found
        self._board = root.get("Storyboard")
        self.entities: dict[str, Entity] = {}
        for each in map(self._entity, self._objects()):
            if each.name in self.entities:
                raise each.place.error("a name that no other vehicle has", f"{each.name!r:.60}", "rename it", "name")
            self.entities[each.name] = each

    def _objects(self) -> Iterator[Element]:
        for each in self.root.get("Entities").children:
            if each.tag != "ScenarioObject":
                raise refused(each)
            yield each

    def _entity(self, given: Element) -> Entity:
        name, found = given.values.get("name", ""), given.find("Vehicle")
        for child in given.children:
            if child.tag not in ("Vehicle", "CatalogReference", "ObjectController"):
                raise refused(child)
            if child.tag == "ObjectController" and child.children and name != self._ego_name:
                raise refused(child, f" of {name}, which is not the ego")
        if found is None:
            found = self._entry(given.get("CatalogReference"))
        for child in found.children:
            reference = child.find("TrailerRef")
            is_none = reference is not None and not reference.values.get("entityRef")  # a default of esmini's cars
            if child.tag not in OF_VEHICLES and not is_none:
                raise refused(child)
        box = found.get("BoundingBox")
        size = box.get("Dimensions")
        length, width = size.number("length"), size.number("width")
        if min(length, width) <= 0:
            raise size.error("sizes above 0", f"{length:g} and {width:g}", "correct them")
        kind, centre = found.values.get("vehicleCategory", ""), box.get("Center").number("x")
        return Entity(name=name, kind=kind, length=length, width=width, centre=centre, place=given)

    def _entry(self, reference: Element) -> Element:
        """Return the vehicle of a catalogue, from this file or from one that the user has given."""
        for child in reference.children:
            raise refused(child)
        wanted, catalogue = reference.values.get("entryName"), reference.values.get("catalogName")
        known = [(each.values.get("name"), one) for each in self._catalogues for one in each.all("Vehicle")]
        for name, each in known:
            if (name, each.values.get("name")) == (catalogue, wanted):
                return each
        raise reference.error(
            f"one of {len(known)} vehicles of known catalogues",
            f"the entry {wanted} of {catalogue}",
            "give the file of that catalogue, such as vehicles=['VehicleCatalog.xosc']; no other file is opened",
        )

    @cached_property
    def _catalogues(self) -> list[Element]:
        """The catalogues in this file, and in those that the user has given."""
        found = [*self.root.all("Catalog")]
        for path in self.options.vehicles:
            file = read_xml(Path(path))
            removed(file, frozenset(self.options.without))
            resolved(file, ChainMap())
            found += file.all("Catalog")
        return found

    @property
    def _ego_name(self) -> str | None:
        """The name of the ego that was given, or the one that everybody gives it."""
        names = [each.values.get("name", "") for each in self.root.get("Entities").children]
        if self.options.ego is not None:
            return self.options.ego
        said = [each for each in self.root.all("Entities/ScenarioObject") if _says_ego(each)]
        usual = [name for name in names if name.lower() in EGO_NAMES]
        return usual[0] if usual else said[0].values.get("name") if said else None

    def named_ego(self, *, is_needed: bool) -> str | None:
        """Return the name of the ego; None if nobody has said and it is not needed.

        Raises:
            RecordingError: if there is no such vehicle.
        """
        name = self._ego_name
        if name not in self.entities and (is_needed or name is not None):
            expected = f"one of the vehicles {', '.join(self.entities)}"
            received, fix = (
                "no name" if name is None else f"{name!r:.60}",
                "give the one that the policy drives as ego=",
            )
            raise self.root.get("Entities").error(expected, f"{received} for the ego", fix)
        return name

    # Places

    def _position(self, position: Element) -> Place:
        given = position.only()
        turned = given.find("Orientation")
        angle = 0.0 if turned is None else math.remainder(turned.number("h", 0.0), math.tau)
        number, wide = given.number, self.options.lane_width
        match given.tag:
            case "LanePosition":
                lane, road = number("laneId"), given.values.get("roadId", "")
                if abs(angle) > 0.4 or lane >= 0:
                    # Where those with positive numbers lead depends on the road, which is not read.
                    expected = "a vehicle in the direction of a lane with a negative number"
                    raise given.error(expected, f"laneId {lane:g} and h={angle:g}", "place it on the other side")
                return Place(("lane", road), number("s"), -lane - number("offset", 0.0) / wide)
            case "RoadPosition":
                if number("t") > 0:
                    raise given.error(
                        "a place on the right side of the road", f"t={number('t'):g}", "place it by lanes"
                    )
                return Place(("road", given.values.get("roadId", "")), number("s"), -number("t") / wide)
            case "WorldPosition":
                return Place(("world",), number("x"), number("y"), number("h", 0.0))
            case "RelativeLanePosition":
                return self._shifted(given, number("ds"), number("dLane") + number("offset", 0.0) / wide)
            case "RelativeRoadPosition":
                return self._shifted(given, number("ds"), number("dt") / wide)
            case "RelativeObjectPosition":
                return self._shifted(given, number("dx"), number("dy") / wide)
        raise refused(given)

    def _shifted(self, given: Element, ahead: float, lanes_left: float) -> Place:
        """Return the place ahead and to the left of another vehicle's start."""
        other = self.start(given.values.get("entityRef", ""), given)
        if other.frame != ("world",):
            return other._replace(along=other.along + ahead, column=other.column - lanes_left)
        cos, sin, left = math.cos(other.heading), math.sin(other.heading), lanes_left * self.options.lane_width
        return other._replace(
            along=other.along + ahead * cos - left * sin, column=other.column + ahead * sin + left * cos
        )

    def start(self, name: str, asks: Element) -> Place:
        """Return where a vehicle starts by its last TeleportAction in Init; ``asks`` is the place of errors."""
        found = [deed for deed in self.initial(name) if deed.tag == "TeleportAction"]
        if not found:
            raise asks.error(f"a TeleportAction of {name} in Init", "none", "say where it starts")
        if name in self._sought:
            raise asks.error("places that do not refer to each other", f"that of {name}", "place one by its lane")
        self._sought.append(name)
        place = self._position(found[-1].get("Position"))
        self._sought.remove(name)
        return place

    def initial(self, name: str) -> Iterator[Element]:
        """Yield what Init has a vehicle do."""
        for private in self._board.all("Init/Actions/Private"):
            if private.values.get("entityRef") == name:
                for action in private.all("PrivateAction"):
                    yield from action.children

    def relative(self, name: str, ego: str) -> tuple[float, int]:
        """Return how far the centre of a vehicle is ahead of the ego's [m], and how many lanes to the right."""
        place = self.entities[name].place
        own, other = self.start(ego, place), self.start(name, place)
        if own.frame != other.frame:
            expected, received = f"places like the ego's ({' '.join(own.frame)})", " ".join(other.frame)
            raise place.error(expected, f"{name} at {received}", "write all places by lanes of one road and direction")
        ahead, column = other.along - own.along, other.column - own.column
        if own.frame == ("world",):
            if math.cos(other.heading - own.heading) < 0.9:
                raise place.error("a vehicle in the ego's direction", f"h={other.heading:g}", "take it out")
            cos, sin = math.cos(own.heading), math.sin(own.heading)
            ahead, column = ahead * cos + column * sin, -(column * cos - ahead * sin) / self.options.lane_width
        if abs(column - round(column)) > BESIDE_MIDDLE:
            fix = "say how wide the lanes are as lane_width=, or move it"
            raise place.error("a start in the middle of a lane", f"{name} {column:.2f} lanes right of the ego", fix)
        return ahead + self.entities[name].centre - self.entities[ego].centre, round(column)

    def speed_of(self, name: str, ego: str) -> float:
        """Return the first speed of a vehicle [m/s]; 0 if Init does not say."""
        for deed in self.initial(name):
            action = deed.find("SpeedAction")
            if action is not None:
                return self.speed_asked(action, ego, None if name == ego else self.speed_of(ego, ego))
        return 0.0

    def speed_asked(self, action: Element, ego: str, ego_speed: float | None) -> float:
        """Return the speed to which a SpeedAction leads, for an ego that keeps its own [m/s]."""
        given = action.get("SpeedActionTarget").only()
        if given.tag == "AbsoluteTargetSpeed":
            return given.number("value")
        if given.values.get("entityRef") != ego or ego_speed is None:
            raise refused(given, f" to {given.values.get('entityRef')}, which is not the ego")
        value = given.number("value")  # the ego is taken to keep its first speed
        return ego_speed * value if given.values.get("speedTargetValueType") == "factor" else ego_speed + value


def inner_names(element: Element) -> str:
    """Return what an element is about, for messages: the names within it."""
    names = []
    while len(element.children) == 1:
        element = element.only()
        names.append(element.tag)
    names += [child.tag for child in element.children[:1]] if not names else []
    return f" ({'/'.join(names)})" if names else ""


def _says_ego(given: Element) -> bool:
    """Return whether a property of a vehicle says that it is the ego, as scenario_runner reads it."""
    return any(
        (each.values.get("name"), each.values.get("value")) == ("type", "ego_vehicle")
        for each in given.all("Vehicle/Properties/Property")
    )
