"""The format of corpus files, and their reading: a strictly checked finding, or an error with line, field and remedy.

Version 2 stores the whole world, so a later change of a default does not change a saved scenario. Keys that are added
later are optional, and a file without them keeps its meaning. docs/reference/corpus-files.md describes the format.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING
from dataclasses import fields as fields_of
from datetime import date
from functools import cache
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pytest_pafot.attribution.mistakes import LANE_CHANGES
from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.corpus.yaml_document import MAX_BYTES, Field, Keys, one_of, parse
from pytest_pafot.findings.failure_rate import FailureRate
from pytest_pafot.findings.finding import (
    MAX_NUMBER,
    Expect,
    Finding,
    Found,
    check_plain,
    is_id,
)
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.findings.signature import ZONES
from pytest_pafot.findings.situation import ZoneSituation
from pytest_pafot.model.driving_style import PAPERS, STYLES
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions import CrossingInstruction, Instruction, LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import REPAIR, Chromosome, Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome
from pytest_pafot.model.vehicle_type import READY, VehicleType
from pytest_pafot.support.errors import CorpusError, FieldError
from pytest_pafot.support.files import open_regular

DEFAULT_GENE_SECONDS = 10.0
"""The duration of a gene in a file that does not give it [s]. It stays, whatever the default of a scenario becomes."""

FILE = Keys(
    ("pafot", "test", "world", "scenario", "expect", "found"),
    ("perception", "original", "shrunk", "rate", "flaky", "xfail"),
)

_BUILT_IN = ("clearance", "headway", "limits", "hang_limit")
WORLDS: Mapping[str, Keys] = MappingProxyType(
    {
        "highway": Keys(("kind", "lanes", "speed_limit", "physics_hz", "ads_hz", "duration", *_BUILT_IN), ("ego",)),
        "gym": Keys(("kind", "env_id", "config", "duration", *_BUILT_IN), ("wrappers", "planner_hz", "ego", "ends")),
        "own": Keys(("kind",), ("class", "data")),
    }
)
"""The keys of ``world``, by its kind. Of the user's own world, ``data`` holds what its ``to_dict`` returns."""

LIMITS = Keys(("acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"))
"""The keys of ``limits`` in a world."""

SCENARIO = Keys(("seed", "ego", "npcs"), ("gene_seconds", "traffic", "vehicles"))
"""The keys of ``scenario`` and ``original``. ``npcs`` holds a list of genes for each NPC."""

TARGETS: Mapping[str, type[Instruction]] = MappingProxyType(
    {"cell": PositionInstruction, "lane": LaneInstruction, "zone": CrossingInstruction}
)
"""The kinds of instructions by the key of their target."""

EGO = Keys(("lane", "speed"))
REQUIRED: Mapping[type, tuple[str, ...]] = MappingProxyType(
    {Expect: ("responsibility",), Found: ("versions",), Shrunk: ("is_minimal",)}
)
"""The fields of dataclasses that a file must have, although they have a default in code. A field without a default is
required, too, and any other field may be left out."""

SIGNED = frozenset({
    "slot", "value", "at_most", "at_least", "ahead", "lane", "npc_enters", "ego_enters", "ego_speed", "npc_speed",
})  # fmt: skip
"""The fields of dataclasses whose numbers may be negative."""

MARKS: Mapping[str, type] = MappingProxyType({"npc_enters": ZoneSituation})
"""The keys that tell the dataclasses of a union apart. Without any, it is the union's first dataclass."""

Read = Callable[[Field], Any]
"""A function that reads a value; it raises a CorpusError for a value that does not fit."""

T = TypeVar("T")

types_of = cache(get_type_hints)
_OUTCOMES = tuple(str(outcome) for outcome in Outcome if outcome is not Outcome.INVALID)
_SIMPLE: Mapping[Any, Read] = MappingProxyType(
    {
        str: Field.text,
        bool: Field.truth,
        Cell: lambda field: Cell(field.whole(1, 8)),
        Outcome: lambda field: Outcome(field.choice(_OUTCOMES)),
    }
)

MAX_RECEIVED = 300
_SCENARIO_FIELDS = {"seed": ("seed",), "ego_lane": ("ego", "lane"), "ego_speed": ("ego", "speed")}


def load(path: str | os.PathLike[str]) -> Finding:
    """Read a corpus file and return its finding. The finding's id is the file's name.

    Raises:
        CorpusError: if anything in the file is wrong. The message names the place and what to do.
    """
    path = Path(path)
    return parsed(path, content_of(path))


def parsed(path: Path, content: bytes, loader: type[Any] | None = None) -> Finding:
    """Return the finding in the content of a file, like :func:`load`.

    ``loader`` is passed to :func:`~pytest_pafot.corpus.yaml_document.parse`.
    """
    __tracebackhide__ = True  # pytest's --showlocals would print the content
    top = parse(path, content, loader)
    name = path.name.removesuffix(SUFFIX)
    if not path.name.endswith(SUFFIX) or not is_id(name):
        expected = f"a name of letters, digits, '.', '_' and '-' before {SUFFIX}"
        raise CorpusError(path, expected, path.name, "rename the file")
    fields = top.mapping(FILE)
    scenario = _scenario(fields["scenario"])

    def npc(field: Field) -> int:
        return field.whole(0, len(scenario.npcs) - 1)

    reason, until = _given(fields, "xfail", _xfail, (None, None))
    return Finding(
        id=name,
        test=fields["test"].some_text("name the test's node id, such as tests/test_safety.py::test_it"),
        world=_world(fields["world"]),
        scenario=scenario,
        expect=_expect(fields["expect"], npc),
        found=_record(fields["found"], Found),
        perception=_given(fields, "perception", _perceived),
        original=_given(fields, "original", _scenario),
        shrunk=_given(fields, "shrunk", lambda field: _record(field, Shrunk)),
        rate=_given(fields, "rate", _rate),
        flaky=_given(fields, "flaky", lambda field: field.some_text("say what differed, or remove the line")),
        xfail=reason,
        xfail_until=until,
    )


def located(path: Path, part: str, error: Exception) -> CorpusError:
    """Return an error about a part of a valid file, with the line of the part.

    ``error`` was raised when the part, which is ``world`` or ``scenario``, was built or run.
    """
    try:
        return _rule_broken(parse(path, content_of(path)).at(part), error)
    except CorpusError as changed:  # the file was changed since it was read
        return changed


def content_of(path: Path) -> bytes:
    """Return the content of a corpus file. A file that is too large is cut to one byte more than the limit.

    Raises:
        CorpusError: if the file cannot be read, or is a link that leads out of its corpus.
    """
    try:
        with open_regular(_at_the_end_of_links(path)) as file:
            return file.read(MAX_BYTES + 1)
    except OSError as error:
        received = error.strerror or str(error)
    raise CorpusError(path, "a file that can be read", received)


def _at_the_end_of_links(path: Path) -> Path:
    """Return the path from which a corpus file is read, after links are followed.

    A link may lead to another saved scenario in the same corpus, which is the folder above those of module and test.
    Some tools put every file behind a link that leads elsewhere. Two kinds of such links are accepted, because a pull
    request cannot place files behind them: git-annex links to its store, which no commit can change, and build systems
    such as Bazel link to the same place in another tree.

    Raises:
        CorpusError: if any other link leads out of its corpus.
    """
    path = path.absolute()
    real, folder = Path(os.path.realpath(path)), Path(os.path.realpath(path.parent))
    if real == folder / path.name or real.name.endswith(SUFFIX):
        if real.is_relative_to(os.path.realpath(path.parents[:3][-1])):
            return real
        if path.is_symlink() and real.parts[-4:] == path.parts[-4:]:
            return real
    if any(real.is_relative_to(os.path.realpath(above / ".git" / "annex" / "objects")) for above in path.parents):
        return real
    fix = "replace the link by the file itself, or delete the link"
    raise CorpusError(path, "a file of its corpus", "a link that leads out of it", fix)


def _given(fields: Mapping[str, Field], key: str, get: Callable[[Field], Any], default: Any = None) -> Any:
    """Return the value of an optional key, read by ``get``; the default if the key is missing."""
    return get(fields[key]) if key in fields else default


def _world(field: Field) -> dict[str, Any]:
    fields = field.any_mapping()
    world = {key: inner.value for key, inner in fields.items()}
    for key, value in world.items():
        try:
            check_plain(field.name, {key: value})
        except ValueError as error:
            raise field.at(key).error("plain data", "correct it", str(error)) from None
    kind = world.get("kind")
    if isinstance(kind, str) and kind in WORLDS:
        field.mapping(WORLDS[kind])
        if "limits" in fields:
            fields["limits"].mapping(LIMITS)
        if "ego" in fields:
            _vehicle(fields["ego"])
    return world


# Reading by the types of the dataclasses' fields.


@cache
def _keys_of(kind: Any) -> Keys:
    """Return the keys of the mapping that holds a dataclass, in the order in which errors list them."""
    needed = {*REQUIRED.get(kind, ())}
    needed |= {each.name for each in fields_of(kind) if each.default is MISSING and each.default_factory is MISSING}
    names = [each.name for each in fields_of(kind)]
    return Keys(tuple(name for name in names if name in needed), tuple(name for name in names if name not in needed))


def _record(field: Field, kind: Callable[..., T], **own: Read) -> T:
    """Return the dataclass that a mapping holds.

    A value is read by the function in ``own`` with the name of its key, which also applies to dataclasses inside. Any
    other value is read as the type of its field says.
    """
    keys, types = _keys_of(kind), types_of(kind)
    fields = field.mapping(keys)
    values = {  # in the order of the keys, so that a function in ``own`` can rely on the values before its own
        key: own[key](fields[key]) if key in own else _value(fields[key], types[key], own)
        for key in keys.all
        if key in fields
    }
    return _made(field, kind, values)


def _made(field: Field, kind: Callable[..., T], values: Mapping[str, Any]) -> T:
    """Return the dataclass with the values; if they break one of its rules, the error names the place in the file."""
    try:
        return kind(**values)
    except FieldError as error:
        raise _rule_broken(field, error) from None


@cache
def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the origin of a generic type, and its arguments other than None."""
    return get_origin(kind), tuple(each for each in get_args(kind) if each is not NoneType)


def _value(field: Field, kind: Any, own: Mapping[str, Read]) -> Any:
    """Return a value of a type. A key that is not there stands for None, so no value may be null."""
    origin, inner = _parts(kind)
    if origin in (Union, UnionType):
        marked = [(key, each) for key, each in MARKS.items() if each in inner]
        keys = field.any_mapping() if marked else ()
        return _value(field, next((each for key, each in marked if key in keys), inner[0]), own)
    if origin is Literal:
        return field.choice(inner)
    if origin is Mapping:
        return {key: _value(each, inner[1], own) for key, each in field.any_mapping().items()}
    if kind == tuple[float, float]:
        if len(field.items()) != 2:
            raise field.error("acceleration [m/s^2] and steering [rad]")
        return tuple(each.number(-MAX_NUMBER) for each in field.items())
    if origin is tuple:
        return tuple(_value(each, inner[0], own) for each in field.items())
    is_signed = field.place[-1] in SIGNED
    if kind is int:
        return field.whole(-int(MAX_NUMBER), int(MAX_NUMBER)) if is_signed else field.whole()
    if kind is float:
        return field.number(-MAX_NUMBER if is_signed else 0.0)
    if kind in _SIMPLE:
        return _SIMPLE[kind](field)
    if kind is Instruction:
        kind = _kind_of(field)
    value = _record(field, kind, **own)
    if isinstance(value, Instruction):
        for name in field.value:
            now = getattr(value, name)
            if type(now) is float and now != field.value[name]:  # the gene has rounded the number
                unit = {"slot": "seconds", "speed": "m/s"}.get(name, "a number")
                raise field.at(name).error(f"{unit} in steps of 0.1", f"write {now}")
    return value


def _kind_of(field: Field) -> type[Instruction]:
    """Return the kind of instruction that a mapping holds, by its target."""
    keys = field.any_mapping()
    kind = next((kind for target, kind in TARGETS.items() if target in keys), PositionInstruction)
    if not keys.keys() <= {*_keys_of(kind).all}:
        field.mapping(Keys((), _keys_of(kind).all), f"these are the keys of a {kind.__name__}")
    return kind


def _scenario(field: Field) -> Scenario:
    fields = field.mapping(SCENARIO)
    ego = fields.pop("ego").mapping(EGO)
    values = {
        "npcs": _value(fields["npcs"], tuple[Chromosome, ...], {}),
        "seed": fields["seed"].whole(),
        "ego_lane": ego["lane"].whole(),
        "ego_speed": ego["speed"].number(),
        "gene_seconds": _given(fields, "gene_seconds", Field.number, DEFAULT_GENE_SECONDS),
        "traffic": _given(fields, "traffic", lambda inner: inner.choice(tuple(STYLES)), PAPERS),
        "vehicles": _given(fields, "vehicles", lambda inner: tuple(map(_vehicle, inner.items())), ()),
    }
    return _made(field, Scenario, values)


def _vehicle(field: Field) -> VehicleType:
    if isinstance(field.value, str):
        return READY[field.choice(tuple(READY))]
    if not isinstance(field.value, dict):
        expected = f"{one_of(tuple(READY))}, or a mapping with a name and a size"
        raise field.error(expected, "write such as `truck`, or `{name: bus, length: 12.0, width: 2.5}`")
    return _record(field, VehicleType)


def _rule_broken(field: Field, error: Exception) -> CorpusError:
    """Return an error of a scenario or a world with the place in the file that caused the error."""
    if not isinstance(error, FieldError) or not error.expected:
        return field.error(f"a {field.name} that can run", "correct it, or delete the file", str(error)[:MAX_RECEIVED])
    key, *others = re.findall(r"\w+", error.field.removeprefix(f"{field.place[-1]}.")) or [""]
    inner = [*_SCENARIO_FIELDS.get(key, (key,)), *(int(part) if part.isdigit() else part for part in others)]
    place = field
    for part in inner:
        if not _has(place.value, part):
            break
        place = place.at(part)
    if len(inner) == 3 and _has(place.value, "cell"):
        place = place.at("cell")
    # REPAIR is advice for code, not for a file.
    fix = error.fix if error.fix and error.fix != REPAIR else "correct it, or delete the file"
    return place.error(error.expected, fix, error.received[:MAX_RECEIVED])


def _has(value: object, part: str | int) -> bool:
    if isinstance(part, int):
        return isinstance(value, list) and part < len(value)
    return isinstance(value, dict) and part in value


def _expect(field: Field, npc: Read) -> Expect:
    fields = field.mapping(_keys_of(Expect))
    if fields["outcome"].choice(_OUTCOMES) == Outcome.COLLISION:
        # An NPC that crosses hits the ego in a zone, off the ego's way; every other NPC is in a cell.
        with_npc = ("npc", "zone" if "zone" in fields else "cell", "side")
        is_fixed = not {"npc", "zone", "cell", "situation"} & {*fields}  # it hit a fixed object
        field.mapping(Keys(("side",) if is_fixed else with_npc, tuple(fields)))
    if "mistake" in fields and ("fault" not in fields or fields["fault"].value != "entered-lane"):
        raise fields["mistake"].error("no mistake without the fault entered-lane, because other faults say it")
    return _record(
        field,
        Expect,
        failure=lambda inner: inner.some_text("name the class of the exception, such as AssertionError"),
        npc=npc,
        zone=lambda inner: inner.choice(ZONES),
        mistake=lambda inner: inner.choice(LANE_CHANGES),
    )


def _xfail(field: Field) -> tuple[str, date]:
    """Return why the failure is accepted, and the last day."""
    fields = field.mapping(Keys(("reason", "until")))
    return fields["reason"].some_text('write the reason in quotes, as in reason: "issue 12"'), fields["until"].day()


def _rate(field: Field) -> FailureRate:
    fields = field.mapping(Keys(("failing", "runs")))
    runs = fields["runs"].whole(1)
    return FailureRate(failing=fields["failing"].whole(0, runs), runs=runs)


def _perceived(field: Field) -> Sight:
    fields = field.mapping(Keys((), tuple(types_of(Sight))))
    return _made(field, Sight, {name: inner.value for name, inner in fields.items()})
