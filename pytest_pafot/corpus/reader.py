"""The reader of corpus files, which may come from an untrusted source.

A file stores the complete world, so new defaults do not change a saved scenario. The format is described in
docs/reference/files.md.
"""

from __future__ import annotations

import difflib
import math
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import MISSING, dataclass
from dataclasses import fields as fields_of
from datetime import date
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from pytest_pafot.attribution.responsibility import LANE_CHANGES
from pytest_pafot.corpus.layout import SUFFIX, files_below, files_in, refusal
from pytest_pafot.findings.finding import (
    ID_RULE,
    MAX_DEPTH,
    MAX_NUMBER,
    Expect,
    FailureRate,
    Finding,
    Found,
    check_plain,
    is_id,
)
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.findings.situation import ZoneSituation
from pytest_pafot.findings.verdict import ZONES
from pytest_pafot.model.instructions import KINDS, Cell, Instruction, PositionInstruction
from pytest_pafot.model.scenario import REPAIR, Chromosome, Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome
from pytest_pafot.model.vehicle_type import CAR, PAPERS, READY, STYLES, VehicleType
from pytest_pafot.support.errors import (
    RESTORE,
    CorpusError,
    FieldError,
    command,
    plain_number,
    plain_whole,
)
from pytest_pafot.support.files import LFS_POINTER, open_regular
from pytest_pafot.support.text import day_of, listed, visible

VERSION = 3
"""The only version of the format that can be read."""

MAX_BYTES = 256 * 1024
DEPTH = MAX_DEPTH + 4
MOST_VALUES = 40_000
"""The largest number of values that a file can contain."""

Place = tuple[str | int, ...]
"""The keys and indices that lead from the top of a document to a value."""

XFAIL, REASON = "xfail", "reason"
"""The keys of an accepted failure and of its reason, which needs quotes if it looks like a date."""

_PREFIX = "tag:yaml.org,2002:"
_PLAIN_KINDS = {"null", "bool", "int", "float", "str"}
_NUMBER_LIKE = re.compile(
    r"[-+]?(?:\.?[0-9][0-9_]*(?:[.:][0-9_]*)?(?:[eE][-+]?[0-9]+)?|0[xob][0-9a-fA-F_]+)"
)
_NUMBER = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]+(?:e[-+][0-9]+)?)?|-?\.inf|\.nan")
_WORD = re.compile(r"true|false|null|")
_IS_SAVED = re.compile(
    rb"(?:\xef\xbb\xbf)?(?:[ \t]*(?:#[^\n]*)?\r?\n)*pafot:[ \t]+[0-9]+[ \t]*(?:#[^\n]*)?\r?(?:\n|\Z)"
)
"""The start of a saved scenario, which distinguishes a faulty file from an unrelated one."""
NOT_SHOWN = (
    "other content. The content is not shown, because the file does not start like a saved scenario"
)
_FORBIDDEN = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

Lines = dict[Place, int]
"""The line of each value, counted from 1."""


@dataclass(frozen=True, slots=True)
class Keys:
    """The required and optional keys of a mapping."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()

    @property
    def all(self) -> tuple[str, ...]:
        return (*self.required, *self.optional)


@dataclass(frozen=True, slots=True)
class Field:
    """A value in a document, with methods that check its type and return it.

    A method that fails raises a :class:`CorpusError` with the line and the name of the field.
    """

    path: Path
    lines: Lines
    place: Place
    value: Any

    @property
    def name(self) -> str:
        """The name of the value in error messages, such as ``scenario.npcs[0][3].cell``."""
        name = ""
        for part in self.place:
            name += f"[{part}]" if isinstance(part, int) else f".{part}"
        return name.lstrip(".")

    def error(self, expected: str, fix: str = RESTORE, received: str = "") -> CorpusError:
        """Return an error with the line of the value, or of the innermost enclosing value with a known line."""
        place = self.place
        while place not in self.lines:  # the document itself always has a line
            place = place[:-1]
        if not received:
            received = "null" if self.value is None else f"{self.value!r:.80}"
        return CorpusError(
            self.path,
            expected,
            received,
            fix,
            field=self.name,
            line=self.lines[place],
        )

    def at(self, part: str | int) -> Field:
        place = (*self.place, part)
        return Field(self.path, self.lines, place, self.value[part])

    def mapping(self, keys: Keys, owner: str = "") -> dict[str, Field]:
        """Return the values of a mapping that can have only these keys. Errors give ``owner`` as the keys' owner."""
        fields = self.any_mapping()
        known = keys.all
        # Unknown keys are reported before missing ones, because a misspelt key causes both.
        for key, field in fields.items():
            if key not in known:
                expected = f"the key {one_of(known)}{owner}"
                raise field.error(expected, _guess(key, known), repr(key))
        for key in keys.required:
            if key not in fields:
                received = "an empty mapping"
                if fields:
                    received = f"only {listed([*map(repr, fields)])}"
                fix = "add the key, or restore the file from version control"
                raise self.error(f"the key '{key}'", fix, received)
        return fields

    def any_mapping(self) -> dict[str, Field]:
        if not isinstance(self.value, dict):
            raise self.error("a mapping (key: value)")
        return {key: self.at(key) for key in self.value}

    def items(self) -> list[Field]:
        if not isinstance(self.value, list):
            raise self.error("a list")
        return [self.at(index) for index in range(len(self.value))]

    def text(self) -> str:
        if not isinstance(self.value, str):
            raise self.error("a string", "put it in quotes")
        return self.value

    def some_text(self, fix: str) -> str:
        """Return a string that is not blank. ``fix`` is the advice in the error."""
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.error("a non-blank string", fix)
        return self.value

    def choice(self, options: Collection[str]) -> Any:
        if not isinstance(self.value, str) or self.value not in options:
            fix = _guess(str(self.value), options, "correct the value")
            raise self.error(one_of(options), fix)
        return self.value

    def whole(self, low: int = 0, high: float = math.inf) -> int:
        number = plain_whole(self.value)
        if number is None or not low <= number <= high:
            expected = f"a whole number from {low:,} to {high:,}"
            if low == high:
                expected = str(low)
            elif high == math.inf:
                expected = f"a whole number of at least {low}"
            raise self.error(expected, "correct the value")
        return number

    def day(self) -> date:
        day = day_of(str(self.value))
        if day is None:
            raise self.error(
                "a valid date in the form YYYY-MM-DD",
                "write a date such as 2027-01-31",
            )
        return day

    def truth(self) -> bool:
        if not isinstance(self.value, bool):
            raise self.error("true or false", "correct the value")
        return self.value

    def number(self, low: float = 0.0) -> float:
        """Return a finite number that is not below ``low``."""
        number = plain_number(self.value)
        if number is None or not low <= number <= MAX_NUMBER:
            raise self.error(f"a number from {low:,.0f} to {MAX_NUMBER:,.0f}", "correct the value")
        return float(number)


def one_of(options: Collection[str]) -> str:
    """Return a list of choices for an error message."""
    return listed([*map(repr, options)], "or")


def _guess(word: str, options: Collection[str], otherwise: str = "rename or remove the key") -> str:
    close = difflib.get_close_matches(word, list(options), n=1)
    if not close:
        return otherwise
    return f"did you mean {close[0]!r}?"


def parse(path: Path, content: bytes, base: type[Any] | None = None) -> Field:
    """Return the top mapping of the YAML document in a file.

    Args:
        path: the path of the file, for error messages.
        content: the content of the file, in UTF-8.
        base: a safe PyYAML loader; by default the compiled loader, if it is installed.

    Raises:
        CorpusError: for invalid YAML, for tags, aliases and other special features, and for unsupported versions.
    """
    __tracebackhide__ = True  # pytest's --showlocals would print the content
    # Checks from cheap to expensive. An error must not print the content of a file that does not look like a saved
    # scenario, since such a file may contain a secret.
    if not path.name.endswith(SUFFIX) and not _IS_SAVED.match(content):
        received = "a different kind of file, such as one that `export` wrote"
        fix = f"give a file whose name ends with {SUFFIX}"
        raise CorpusError(path, "a saved scenario", received, fix)
    if len(content) > MAX_BYTES:
        expected = f"a file of at most {MAX_BYTES // 1024} KiB"
        raise CorpusError(path, expected, "a larger file", "shorten or delete it")
    if not content.removeprefix(b"\xef\xbb\xbf").strip():
        raise CorpusError(path, "a saved scenario", "an empty file")
    if content.startswith(LFS_POINTER):
        fix = "fetch the file with `git lfs pull`"
        raise CorpusError(path, "a saved scenario", "a Git LFS pointer", fix)
    try:
        value, lines = _parsed(path, content, base)
    except CorpusError as error:
        if _IS_SAVED.match(content):
            raise
        raise CorpusError(path, error.expected, NOT_SHOWN, error.fix, line=error.line) from None
    top = Field(path, lines, (), value)
    if not isinstance(value, dict):
        raise top.error("a mapping (key: value)", received=NOT_SHOWN)
    # checked first: nothing else can be checked in a file of a newer version
    if "pafot" not in value:
        expected = f"the key 'pafot' with the value {VERSION}"
        raise top.error(expected, received="a mapping without this key")
    version = top.at("pafot")
    # Without a version, this may be another kind of file with a secret under that key, so the value is not printed.
    received = "a value of a different type"
    if type(version.value) is int:
        if version.value == VERSION:
            return top
        received = ""
    raise version.error(
        f"format version {VERSION}",
        "install the version of pytest-pafot that wrote this file, or delete the file and search again",
        received,
    )


def _parsed(path: Path, content: bytes, base: type[Any] | None) -> tuple[Any, Lines]:
    __tracebackhide__ = True
    try:
        # The file may start with a byte order mark.
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CorpusError(
            path,
            "text in UTF-8",
            f"the byte 0x{content[error.start]:02x}",
            "save the file as UTF-8",
            line=content.count(b"\n", 0, error.start) + 1,
        ) from None
    bad = _FORBIDDEN.search(text)
    if bad is not None:
        raise CorpusError(
            path,
            "printable text",
            f"the character U+{ord(bad[0]):04X}",
            "remove the unprintable character",
            line=text.count("\n", 0, bad.start()) + 1,
        )
    kind: Any = base
    if kind is None:
        kind = yaml.SafeLoader
        # The compiled loader accepts tabs and "?" where the Python loader does not, but both must give the same result.
        if "\t" not in text and "?" not in text:
            kind = getattr(yaml, "CSafeLoader", kind)
    loader = kind(text)
    try:
        return _Builder(path, loader, {}).document()
    except yaml.YAMLError as error:
        problem = str(error).splitlines()[0]
        line = None
        if isinstance(error, yaml.MarkedYAMLError):
            problem = error.problem or "unknown"
            mark = error.problem_mark or error.context_mark
            if mark is not None:
                line = mark.line + 1
        fix = "correct the syntax, or restore the file from version control"
        received = f"a syntax error ({problem})"
        raise CorpusError(path, "valid YAML", received, fix, line=line) from None
    finally:
        loader.dispose()


@dataclass(repr=False)  # pytest's --showlocals would print the content
class _Builder:
    """A builder of JSON-compatible data from YAML events, which never expands an alias."""

    path: Path
    loader: Any
    lines: Lines
    values: int = 0

    def document(self) -> tuple[Any, Lines]:
        self._next(yaml.StreamStartEvent)
        self._next(yaml.DocumentStartEvent)
        value = self._value((), self.loader.get_event())
        self._next(yaml.DocumentEndEvent)
        self._next(yaml.StreamEndEvent)
        return value, self.lines

    def _error(self, event: Any, expected: str, received: str, fix: str) -> CorpusError:
        return CorpusError(self.path, expected, received, fix, line=_line(event))

    def _next(self, kind: type[yaml.Event]) -> None:
        event = self.loader.get_event()
        if not isinstance(event, kind):
            raise self._error(
                event,
                "exactly one YAML document",
                "none or several",
                "write one document per file",
            )

    def _value(self, place: Place, event: Any) -> Any:
        self.lines[place] = _line(event)
        self.values += 1
        if self.values > MOST_VALUES:
            # Reading a value takes about 10 microseconds. A file of this plugin would reach the size limit first.
            expected = f"at most {MOST_VALUES} values"
            raise self._error(event, expected, "more", "shorten or delete the file")
        if event.anchor is not None:
            # Expanding aliases can use up all memory (a "billion laughs" attack).
            kind = "alias" if isinstance(event, yaml.AliasEvent) else "anchor"
            raise self._error(
                event,
                "a value without aliases or anchors",
                f"the {kind} {event.anchor!r:.40}",
                "write the value in full",
            )
        if event.tag is not None:
            raise self._error(
                event,
                "a value without a tag",
                f"the tag {event.tag!r:.60}",
                "remove the tag",
            )
        if isinstance(event, yaml.ScalarEvent):
            is_day = place[:-1] == (XFAIL,) and place[-1] != REASON
            return self._scalar(event, is_day=is_day)
        if len(place) >= DEPTH:
            expected = f"at most {DEPTH} levels of nesting"
            raise self._error(event, expected, "more", "reduce the nesting")
        if isinstance(event, yaml.MappingStartEvent):
            return self._mapping(place)
        items = enumerate(self._until(yaml.SequenceEndEvent))
        return [self._value((*place, index), each) for index, each in items]

    def _scalar(self, event: Any, *, is_day: bool) -> Any:
        text = event.value
        tag = self.loader.resolve(yaml.ScalarNode, text, event.implicit)
        kind = tag.removeprefix(_PREFIX)
        if is_day and kind == "timestamp":
            return str(text)
        if kind not in _PLAIN_KINDS:
            raise self._error(
                event,
                "a number, a string, true, false or null",
                f"{text!r:.60}, which has the YAML type '{kind}'",
                "put the value in quotes",
            )
        if event.implicit[0]:
            # YAML 1.1, YAML 1.2 and people read these in different ways: 010, 1_0, 0x1F, 1:30, 1e3, yes, ~.
            is_odd_number = kind in ("int", "float") and not _NUMBER.fullmatch(text)
            if is_odd_number or (kind == "str" and _NUMBER_LIKE.fullmatch(text)):
                raise self._error(
                    event,
                    "a number in decimal notation",
                    f"{text!r:.60}",
                    "write a number such as 10, 0.5 or 1.0e-5, or put the value in quotes",
                )
            if kind in ("bool", "null") and not _WORD.fullmatch(text):
                raise self._error(
                    event,
                    "true, false or null",
                    f"{text!r:.60}",
                    "if it is a string, put it in quotes",
                )
        node = yaml.ScalarNode(tag, text, event.start_mark, event.end_mark)
        try:
            return self.loader.construct_object(node)
        except (ValueError, OverflowError):
            raise self._error(
                event,
                "a number that can be read",
                f"one with {len(text):,} digits",
                "shorten it, or put it in quotes",
            ) from None

    def _mapping(self, place: Place) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for event in self._until(yaml.MappingEndEvent):
            key = self._value((*place, "?"), event)
            if not isinstance(key, str):
                received = f"the key {key!r:.60}"
                raise self._error(event, "strings as keys", received, "put the key in quotes")
            if key in mapping:
                received = f"{key!r:.60} a second time"
                raise self._error(event, "each key only once", received, "remove the duplicate")
            # All keys are read at the place "?". After the value is read, its line becomes the line of the key.
            mapping[key] = self._value((*place, key), self.loader.get_event())
            self.lines[(*place, key)] = _line(event)
        self.lines.pop((*place, "?"), None)
        return mapping

    def _until(self, end: type[yaml.Event]) -> Iterator[Any]:
        while not isinstance(event := self.loader.get_event(), end):
            yield event


def _line(event: Any) -> int:
    return int(event.start_mark.line) + 1


DEFAULT_GENE_SECONDS = 10.0
"""The duration [s] of a gene if a file does not state one. This value must never change."""

FILE = Keys(
    ("pafot", "scenario", "expect", "found", "test", "world"),
    ("perception", "shrunk", "rate", "flaky", "xfail"),
)

_BUILT_IN = ("clearance", "headway", "limits", "hang_limit")
WORLDS: Mapping[str, Keys] = {
    "highway": Keys(
        ("kind", "lanes", "speed_limit", "physics_hz", "ads_hz", "duration", *_BUILT_IN),
        ("ego",),
    ),
    "gym": Keys(
        ("kind", "env_id", "config", "duration", *_BUILT_IN),
        ("wrappers", "planner_hz", "ego", "ends"),
    ),
    "own": Keys(("kind",), ("class", "data")),
}
"""The keys of ``world`` by its kind. ``data`` is the dict that the ``to_dict`` method of a custom world returns."""

LIMITS = Keys(("acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"))

SCENARIO = Keys(("seed", "ego", "npcs"), ("gene_seconds", "traffic", "vehicles"))

EGO = Keys(("lane", "speed"))
REQUIRED: Mapping[type, tuple[str, ...]] = {
    Expect: ("responsibility",),
    Found: ("versions",),
    Shrunk: ("is_minimal",),
}
"""Fields that a file must contain even though they have defaults in the code."""

SIGNED = {
    "slot",
    "value",
    "at_most",
    "at_least",
    "gap",
    "lanes_to_right",
    "npc_enters",
    "ego_enters",
    "ego_speed",
    "npc_speed",
}
"""The fields that can be negative."""

MARKS: Mapping[str, type] = {"npc_enters": ZoneSituation}
"""The keys that distinguish the dataclasses in a union."""

Read = Callable[[Field], Any]

T = TypeVar("T")

types_of = cache(get_type_hints)
CELLS = {cell.label: cell for cell in Cell}
_OUTCOMES = tuple(str(outcome) for outcome in Outcome if outcome is not Outcome.INVALID)
_SIMPLE: Mapping[Any, Read] = {
    str: Field.text,
    bool: Field.truth,
    Cell: lambda field: CELLS[field.choice(CELLS)],
    Outcome: lambda field: Outcome(field.choice(_OUTCOMES)),
}

MAX_RECEIVED = 300
_SCENARIO_FIELDS = {"ego_lane": ("ego", "lane"), "ego_speed": ("ego", "speed")}


def load(path: str | os.PathLike[str]) -> Finding:
    """Read a corpus file and return its finding.

    Raises:
        CorpusError: if the file is invalid. The message contains the line, the field and a fix.
    """
    path = Path(path)
    return parsed(path, content_of(path))


def parsed(path: Path, content: bytes, loader: type[Any] | None = None) -> Finding:
    """Parse the content of a corpus file and return its finding."""
    __tracebackhide__ = True  # pytest's --showlocals would print the content
    top = parse(path, content, loader)
    name = path.name.removesuffix(SUFFIX)
    if not path.name.endswith(SUFFIX) or not is_id(name):
        expected = f"a file name that consists of {ID_RULE}, followed by {SUFFIX}"
        raise CorpusError(path, expected, repr(path.name), "rename the file")
    fields = top.mapping(FILE)
    scenario = _scenario(fields["scenario"])

    # The number of an expected NPC is valid only if the scenario has this NPC.
    def npc(field: Field) -> int:
        return field.whole(0, len(scenario.npcs) - 1)

    def flaky(field: Field) -> str:
        return field.some_text("describe what differed, or remove the key")

    reason, until = _optional(fields, "xfail", _xfail, (None, None))
    how_to_name = "write the node id of the test, such as tests/test_safety.py::test_it"
    return Finding(
        id=name,
        test=fields["test"].some_text(how_to_name),
        world=_world(fields["world"]),
        scenario=scenario,
        expect=_expect(fields["expect"], npc),
        found=_record(fields["found"], Found),
        perception=_optional(fields, "perception", _perceived),
        shrunk=_optional(fields, "shrunk", lambda field: _record(field, Shrunk)),
        rate=_optional(fields, "rate", _rate),
        flaky=_optional(fields, "flaky", flaky),
        xfail=reason,
        xfail_until=until,
    )


def located(path: Path, part: str, error: Exception) -> CorpusError:
    """Convert an error caused by the ``world`` or ``scenario`` of a file to an error with its line."""
    try:
        return _rule_broken(parse(path, content_of(path)).at(part), error)
    except CorpusError as changed:  # the file was changed since it was read
        return changed


def content_of(path: Path) -> bytes:
    """Return the content of a file, truncated to one byte more than the size limit.

    Raises:
        CorpusError: if the file cannot be read, or is a link to a file outside its corpus.
    """
    try:
        with open_regular(_at_the_end_of_links(path)) as file:
            return file.read(MAX_BYTES + 1)
    except OSError as error:
        received = f"the error '{error.strerror or error}'"
        raise CorpusError(path, "a regular file that can be read", received) from None


def _at_the_end_of_links(path: Path) -> Path:
    """Return the path to which a path leads when all links are followed.

    Raises:
        CorpusError: if a link leads out of the corpus.
    """
    # A link can lead to another scenario of the same corpus, whose root is three folders above the file. It can also
    # lead to two locations in which a pull request cannot place files: the store of git-annex, and the same path in
    # another tree, to which build systems such as Bazel link.
    path = path.absolute()
    real = Path(os.path.realpath(path))
    own = Path(os.path.realpath(path.parent)) / path.name
    if real == own or real.name.endswith(SUFFIX):
        *_, root = path.parents[:3]
        if real.is_relative_to(os.path.realpath(root)):
            return real
        if path.is_symlink() and real.parts[-4:] == path.parts[-4:]:
            return real
    for above in path.parents:
        store = os.path.realpath(above / ".git" / "annex" / "objects")
        if real.is_relative_to(store):
            return real
    fix = "replace the link with the file itself, or delete the link"
    raise CorpusError(path, "a file inside the corpus", "a link to a file outside it", fix)


def _optional(
    fields: Mapping[str, Field], key: str, get: Callable[[Field], Any], default: Any = None
) -> Any:
    if key not in fields:
        return default
    return get(fields[key])


def _world(field: Field) -> dict[str, Any]:
    fields = field.any_mapping()
    world = {key: inner.value for key, inner in fields.items()}
    try:
        check_plain(field.name, world)
    except FieldError as error:
        raise _rule_broken(field, error) from None
    kind = world.get("kind")
    if isinstance(kind, str) and kind in WORLDS:
        # An unknown kind is rejected when the world is built, with the same error as for a dict in code.
        field.mapping(WORLDS[kind])
        if "limits" in fields:
            fields["limits"].mapping(LIMITS)
        if "ego" in fields:
            _vehicle(fields["ego"])
    return world


# Dataclasses are read according to the types of their fields.


@cache
def _keys_of(kind: Any) -> Keys:
    required = []
    optional = []
    for each in fields_of(kind):
        has_default = each.default is not MISSING or each.default_factory is not MISSING
        if has_default and each.name not in REQUIRED.get(kind, ()):
            optional.append(each.name)
        else:
            required.append(each.name)
    return Keys(tuple(required), tuple(optional))


def _record(field: Field, kind: Callable[..., T], **own: Read) -> T:
    # `own` contains separate readers for some keys.
    keys = _keys_of(kind)
    types = types_of(kind)
    fields = field.mapping(keys)
    values = {}
    # in the order of the keys, so that a function in ``own`` can rely on the values before its own
    for key in keys.all:
        if key in own and key in fields:
            values[key] = own[key](fields[key])
        elif key in fields:
            values[key] = _value(fields[key], types[key], own)
    return _build(field, kind, values)


def _build(field: Field, kind: Callable[..., T], values: Mapping[str, Any]) -> T:
    try:
        return kind(**values)
    except FieldError as error:
        raise _rule_broken(field, error) from None


@cache
def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    inner = [each for each in get_args(kind) if each is not NoneType]
    return get_origin(kind), tuple(inner)


def _value(field: Field, kind: Any, own: Mapping[str, Read]) -> Any:
    origin, inner = _parts(kind)
    # No value can be null, because a missing key means None. So an optional type is read as its first other type.
    if origin in (Union, UnionType):
        for key, each in MARKS.items():
            if each in inner and key in field.any_mapping():
                return _value(field, each, own)
        return _value(field, inner[0], own)
    if origin is Literal:
        return field.choice(inner)
    if origin is Mapping:
        fields = field.any_mapping()
        return {key: _value(each, inner[1], own) for key, each in fields.items()}
    if kind == tuple[float, float]:
        if len(field.items()) != 2:
            raise field.error("acceleration [m/s^2] and steering [rad]")
        return tuple(each.number(-MAX_NUMBER) for each in field.items())
    if origin is tuple:
        return tuple(_value(each, inner[0], own) for each in field.items())
    is_signed = field.place[-1] in SIGNED
    if kind is float:
        return field.number(-MAX_NUMBER if is_signed else 0.0)
    if kind is int and is_signed:
        return field.whole(-int(MAX_NUMBER), int(MAX_NUMBER))
    if kind is int:
        return field.whole()
    if kind in _SIMPLE:
        return _SIMPLE[kind](field)
    if kind is Instruction:
        kind = _kind_of(field)
    value = _record(field, kind, **own)
    if isinstance(value, Instruction):
        for name, given in field.value.items():
            now = getattr(value, name)
            if type(now) is float and now != given:  # the gene has rounded the number
                unit = {"slot": " s", "speed": " m/s"}.get(name, "")
                raise field.at(name).error(f"a multiple of 0.1{unit}", f"write {now}")
    return value


def _kind_of(field: Field) -> type[Instruction]:
    # The kind of instruction that a mapping describes.
    keys = field.any_mapping()
    # If a key belongs to another kind, the error lists the keys of this kind.
    kind = next((kind for kind in KINDS if kind.goal_kind in keys), PositionInstruction)
    if not keys.keys() <= {*_keys_of(kind).all}:
        field.mapping(Keys((), _keys_of(kind).all), f" of a {kind.__name__}")
    return kind


def _scenario(field: Field) -> Scenario:
    fields = field.mapping(SCENARIO)
    ego = fields.pop("ego").mapping(EGO)
    count = len(fields["npcs"].any_mapping())
    names = tuple(f"NPC {npc}" for npc in range(count))
    npcs = fields["npcs"].mapping(Keys(names))
    vehicles = {}
    if "vehicles" in fields:
        vehicles = fields["vehicles"].mapping(Keys((), names))
    values = {
        "npcs": tuple(_value(npcs[name], Chromosome, {}) for name in names),
        "seed": fields["seed"].whole(),
        "ego_lane": ego["lane"].whole(),
        "ego_speed": ego["speed"].number(),
        "gene_seconds": _optional(fields, "gene_seconds", Field.number, DEFAULT_GENE_SECONDS),
        "traffic": _optional(fields, "traffic", lambda inner: inner.choice(STYLES), PAPERS),
        "vehicles": tuple(_optional(vehicles, name, _vehicle, CAR) for name in names),
    }
    return _build(field, Scenario, values)


def _vehicle(field: Field) -> VehicleType:
    if isinstance(field.value, str):
        return READY[field.choice(READY)]
    if not isinstance(field.value, dict):
        raise field.error(
            f"{one_of(READY)}, or a mapping with a name and a size",
            "write `truck` or `{name: bus, length: 12.0, width: 2.5}`, for example",
        )
    return _record(field, VehicleType)


def _rule_broken(field: Field, error: Exception) -> CorpusError:
    # The error for an invalid scenario or world, with the line that causes it.
    if not isinstance(error, FieldError) or not error.expected:
        return field.error(f"a {field.name} that can run", received=str(error)[:MAX_RECEIVED])
    # Translate the field of the error, such as npcs[0][3].cell, into keys of the file, and follow them as far as they
    # exist.
    own_name = error.field.removeprefix(f"{field.place[-1]}.")
    key, *others = re.findall(r"\w+", own_name) or [""]
    if others and key in ("npcs", "vehicles"):
        others[0] = f"NPC {others[0]}"
    inner: list[str | int] = [*_SCENARIO_FIELDS.get(key, (key,))]
    inner += [int(part) if part.isdigit() else part for part in others]
    place = field
    for step in inner:
        if not _has(place.value, step):
            break
        place = place.at(step)
    if len(inner) == 3 and _has(place.value, "cell"):
        place = place.at("cell")
    fix = error.fix
    if fix in ("", REPAIR):  # REPAIR is advice for code, not for a file
        fix = "correct the value, or delete the file"
    return place.error(error.expected, fix, error.received[:MAX_RECEIVED])


def _has(value: object, part: str | int) -> bool:
    if isinstance(value, list):
        return isinstance(part, int) and part < len(value)
    return isinstance(value, dict) and part in value


def _expect(field: Field, npc: Read) -> Expect:
    fields = field.mapping(_keys_of(Expect))
    if fields["outcome"].choice(_OUTCOMES) == Outcome.COLLISION:
        required = ["side"]
        # otherwise, the ego hit a fixed object
        if not fields.keys().isdisjoint({"npc", "zone", "cell", "situation"}):
            # An NPC on a crossing path hits the ego in a conflict zone. Every other NPC is in a cell around the ego.
            required = ["npc", "zone" if "zone" in fields else "cell", "side"]
        field.mapping(Keys(tuple(required), tuple(fields)))
    if "mistake" in fields and ("fault" not in fields or fields["fault"].value != "entered-lane"):
        raise fields["mistake"].error("this key only with the fault 'entered-lane'")

    def failure(inner: Field) -> str:
        return inner.some_text("name the class of the exception, such as AssertionError")

    return _record(
        field,
        Expect,
        failure=failure,
        npc=npc,
        zone=lambda inner: inner.choice(ZONES),
        mistake=lambda inner: inner.choice(LANE_CHANGES),
    )


def _xfail(field: Field) -> tuple[str, date]:
    fields = field.mapping(Keys(("reason", "until")))
    reason = fields["reason"].some_text('write the reason in quotes, as in reason: "issue 12"')
    return reason, fields["until"].day()


def _rate(field: Field) -> FailureRate:
    fields = field.mapping(Keys(("failing", "runs")))
    runs = fields["runs"].whole(1)
    return FailureRate(failing=fields["failing"].whole(0, runs), runs=runs)


def _perceived(field: Field) -> Sight:
    fields = field.mapping(Keys((), tuple(types_of(Sight))))
    values = {name: inner.value for name, inner in fields.items()}
    return _build(field, Sight, values)


class Saved(NamedTuple):
    """A corpus file with its finding, or with the reason why the file cannot be read."""

    path: Path
    finding: Finding | None = None
    error: str = ""

    @classmethod
    def read(cls, path: Path) -> Saved:
        """Read a corpus file. An error is stored, and is raised only when the file's item runs."""
        try:
            return cls(path=path, finding=load(path))
        except (CorpusError, OSError) as error:
            return cls(path=path, error=str(error))

    @property
    def id(self) -> str:
        return self.path.name.removesuffix(SUFFIX)

    @property
    def xfail(self) -> str | None:
        return None if self.finding is None else self.finding.xfail

    def is_accepted(self, today: date) -> bool:
        return self.finding is not None and self.finding.is_accepted(today)

    @property
    def is_crash(self) -> bool:
        return self.finding is not None and self.finding.expect.is_crash

    @property
    def needs_own_process(self) -> bool:
        """True if a run can end the process, hang or exhaust the memory."""
        if self.finding is None:
            return False
        expect = self.finding.expect
        return expect.is_crash or expect.outcome == "hang" or expect.failure == "MemoryError"

    def __repr__(self) -> str:
        return visible(f"<saved {self.id}>")


def named_file(given: str) -> Path:
    """Return the corpus file for a path, an id, or an item name as printed by pytest.

    Raises:
        CorpusError: if there is no such file below the current folder, or more than one.
    """
    path = Path(given)
    if path.is_file():
        return path
    _, _, name = given.rpartition("[")
    name = name.removesuffix("]").removeprefix("saved-").removesuffix(SUFFIX)
    files = {file: file.name.removesuffix(SUFFIX) for file in files_below(Path())}
    found = [file for file, other in files.items() if other == name]
    if len(found) == 1:
        return found[0]
    received = "no such file or id"
    fix = f"`{command('pytest_pafot', 'corpus', 'list')}` lists the files"
    names = list(dict.fromkeys(files.values()))
    near = [each for each in names if name in each]
    if not near:
        near = difflib.get_close_matches(name, names)
    if found:
        received = f"an id that occurs in {len(found)} files"
        fix = f"give one of the files: {', '.join(map(str, found))}"
    elif near:
        fix = f"did you mean {' or '.join(near[:3])}?"
    expected = (
        "the file of a saved scenario, or the id of a saved scenario below the current folder"
    )
    raise CorpusError(path, expected, received, fix)


def saved_in(folder: Path) -> list[Saved]:
    """Read all corpus files in a folder, sorted by id."""
    return [Saved.read(path) for path in files_in(folder)]


def refused_in(folder: Path, link: Path) -> list[Saved]:
    """Return the files in a folder outside the project, to which ``link`` leads, each with an error."""
    return [Saved(path=path, error=f"{path}: {refusal(link)}") for path in files_in(folder)]
