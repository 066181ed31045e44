"""The format of corpus files: their keys, and their text, which people read and version control compares.

Version 2 stores the whole world, so a later change of a default does not change a saved scenario. Keys that are added
later are optional, and a file without them keeps its meaning.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from enum import Enum
from types import MappingProxyType
from typing import Any

import yaml

from pytest_pafot.findings.finding import Expect, Finding, Perceived
from pytest_pafot.model.driving_style import BOUNDS, PAPERS
from pytest_pafot.model.scenario import CrossingInstruction, PositionInstruction, Scenario

# The keys.

VERSION = 2
"""The version of the format that is written. No other version can be read."""


@dataclass(frozen=True, slots=True)
class Keys:
    """The required and the optional keys of a mapping in a corpus file."""

    required: tuple[str, ...]
    optional: tuple[str, ...] = ()


FILE = Keys(
    ("pafot", "test", "world", "scenario", "expect", "found"), ("perception", "original", "shrunk", "flaky", "xfail")
)

_BUILT_IN = ("clearance", "headway", "limits", "hang_limit")
WORLDS: Mapping[str, Keys] = MappingProxyType(
    {
        "highway": Keys(("kind", "lanes", "speed_limit", "physics_hz", "ads_hz", "duration", *_BUILT_IN)),
        "gym": Keys(("kind", "env_id", "config", "duration", *_BUILT_IN), ("wrappers", "planner_hz")),
        "own": Keys(("kind",), ("class", "data")),
    }
)
"""The keys of ``world``, by its kind. Of the user's own world, ``data`` holds what its ``to_dict`` returns."""

LIMITS = Keys(("acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"))
"""The keys of ``limits`` in a world."""

SCENARIO = Keys(("seed", "ego", "npcs"), ("gene_seconds", "traffic"))
"""The keys of ``scenario`` and ``original``. ``npcs`` holds a list of genes for each NPC."""

EGO = Keys(("lane", "speed"))
POSITION_INSTRUCTION = Keys(("cell", "speed"))
LANE_INSTRUCTION = Keys(("lane", "speed"))
CROSSING_INSTRUCTION = Keys(("zone", "slot", "speed"), ("act",))
TRAFFIC = Keys(("style",), tuple(BOUNDS))
"""The keys of ``traffic``, if it is not just the name of a style."""

XFAIL = Keys(("reason",), ("until",))
"""The keys of ``xfail``, if it is not just a reason."""

EXPECT = Keys(
    ("failure", "outcome", "time", "responsibility"),
    (
        *("assertion", "check", "message", "npc", "cell", "zone", "side", "fault", "mistake", "npc_manoeuvre"),
        *("ego_manoeuvre", "situation", "reference_drivers", "last_chance", "avoided_by", "escaped_by", "against"),
        "traceback",
    ),
)
EXPECT_OF_COLLISION = Keys((*EXPECT.required, "npc", "cell", "side"), EXPECT.optional)
EXPECT_IN_ZONE = Keys((*EXPECT.required, "npc", "zone", "side"), EXPECT.optional)
"""The keys of ``expect`` for a collision with a crossing NPC, off the ego's way."""
CHECK = Keys((), ("value", "at_most", "at_least", "unit"))
"""The keys of ``expect.check``."""
SITUATION = Keys(("npc", "time", "ahead", "lane", "ego_speed", "npc_speed"))
"""The keys of ``expect.situation``."""
ZONE_SITUATION = Keys(("npc", "time", "npc_enters", "ego_enters", "ego_speed", "npc_speed"))
"""The keys of ``expect.situation`` with a crossing NPC."""
LAST_CHANCE = Keys(("time", "driver", "action", "ego_action"))
"""The keys of ``expect.last_chance``."""
AVOIDANCE = Keys(("time", "braking"))
"""The keys of ``expect.avoided_by``."""
ESCAPE = Keys(("time", "driver", "braking", "braking_from", "due", "required"))
"""The keys of ``expect.escaped_by``."""

FOUND = Keys(("seed", "generation", "algorithm", "versions"), ("weights",))
PERCEPTION = Keys((), ("range", "latency", "noise", "dropout", "occlusion", "needed"))
SHRUNK = Keys(("rollouts", "is_minimal", "speeds"))
SPEEDS = Keys(("npc", "gene", "low", "high"))
"""The keys of each entry of the list ``shrunk.speeds``."""


WIDTH = 120
COMMENT_COLUMN = 34
DEFAULT_GENE_SECONDS = 10.0

_SAFE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.+-/()<>=*' ")
_BEGINS = re.compile(r"[A-Za-z_]|\d+\.\d+\.\d")  # a word, or the number of a version
_TRUTHS = frozenset("yYnN")  # booleans in YAML 1.1, which PyYAML reads as text
_RESOLVER: Any = yaml.resolver.Resolver()


def text_of(finding: Finding) -> str:
    """Return the text of the corpus file of a finding, with LF line ends."""
    test = finding.test if _is_plain(finding.test, also=":[],") else _quoted(finding.test)  # on a line of its own
    found = {key: getattr(finding.found, key) for key in (*FOUND.required, *FOUND.optional)}
    xfail = '# xfail: "reason"'  # a hint on how to accept the failure
    if finding.xfail is not None:
        reason, until = _quoted(finding.xfail), finding.xfail_until
        xfail = f"xfail: {reason}" if until is None else f"xfail: {{reason: {reason}, until: {until}}}"
    lines = [
        f"{f'pafot: {VERSION}':30}# format version",
        f"test: {test}",
        *_filled("world: ", finding.world),
        *_scenario_lines("scenario", finding.scenario),
        *_expect_lines(finding.expect),
        *_filled("found: ", {key: value for key, value in found.items() if value or key in FOUND.required}),
        *([] if finding.perception is None else _filled("perception: ", _perceived(finding.perception))),
        *([] if finding.original is None else _scenario_lines("original", finding.original)),
        *([] if finding.shrunk is None else _filled("shrunk: ", asdict(finding.shrunk))),
        *([] if finding.flaky is None else [f"flaky: {_quoted(finding.flaky)}"]),
        xfail,
    ]
    return "\n".join(lines) + "\n"


def _perceived(perception: Perceived) -> dict[str, Any]:
    needed = {} if perception.needed is None else {"needed": perception.needed}
    return {**perception.sight.to_dict(), **needed}


def _scenario_lines(key: str, scenario: Scenario) -> Iterator[str]:
    yield f"{key}:"
    yield f"  seed: {scenario.seed}"
    yield f"  ego: {{lane: {scenario.ego_lane}, speed: {_number(scenario.ego_speed)}}}"
    if scenario.gene_seconds != DEFAULT_GENE_SECONDS:
        yield f"  gene_seconds: {_number(scenario.gene_seconds)}"
    if scenario.traffic != PAPERS:
        yield f"  traffic: {_flow(scenario.traffic.plain())}"
    yield "  npcs:"
    for chain in scenario.npcs:
        for gene, instruction in enumerate(chain):
            bullet = "    - - " if gene == 0 else "      - "
            if isinstance(instruction, PositionInstruction):
                entry = f"{bullet}{{cell: {instruction.target}, speed: {_number(instruction.speed)}}}"
                yield f"{entry:{COMMENT_COLUMN}}# {instruction.cell.label}"
            elif isinstance(instruction, CrossingInstruction):
                parts = {name: getattr(instruction, name) for name in CROSSING_INSTRUCTION.required}
                yield bullet + _flow(parts if instruction.act == "pass" else {**parts, "act": instruction.act})
            else:
                yield f"{bullet}{{lane: {instruction.target}, speed: {_number(instruction.speed)}}}"


def _expect_lines(expect: Expect) -> Iterator[str]:
    """Yield the lines of ``expect``: a flow mapping in braces, or a block if one of its texts has several lines."""
    first = (
        "failure",
        "assertion",
        "check",
        "message",
        "outcome",
        "time",
        "npc",
        "cell",
        "zone",
        "side",
        "responsibility",
    )
    names = [each.name for each in fields(expect) if each.name not in ("situation", "traceback")]
    order = dict.fromkeys([*first, *names, "situation", "traceback"])
    values = {name: getattr(expect, name) for name in order}
    values["check"] = (
        {} if expect.check is None else {k: v for k, v in asdict(expect.check).items() if v not in (None, "")}
    )
    for name in ("situation", "last_chance", "avoided_by", "escaped_by"):
        values[name] = {} if values[name] is None else asdict(values[name])
    entries = {name: value for name, value in values.items() if value not in (None, "", {}) or name == "failure"}
    if not any(isinstance(value, str) and "\n" in value for value in entries.values()):
        yield from _filled("expect: ", entries)
        return
    yield "expect:"
    for key, value in entries.items():
        if isinstance(value, str) and _fits_literal(value):
            yield f"  {key}: |" if value.endswith("\n") else f"  {key}: |-"
            yield from (f"    {line}" if line else "" for line in value.removesuffix("\n").split("\n"))
        else:
            yield f"  {key}: {_flow(value)}"


def _fits_literal(text: str) -> bool:
    """Return whether a text can be written as a literal block, from which YAML reads it unchanged.

    For that, all lines must be printable, and the first and the last line must not be empty or indented.
    """
    lines = text.removesuffix("\n").split("\n")
    is_plain = all(line.replace("\t", "").isprintable() for line in lines)
    return "\n" in text and is_plain and all(line and line[0] not in " \t" for line in (lines[0], lines[-1]))


def _filled(head: str, value: Any, tail: str = "", column: int = 0) -> list[str]:
    """Return the lines of a mapping or list in flow style, wrapped to the width.

    The text begins with ``head`` and ends with ``tail``. A value that does not fit into a line continues below its
    first entry. ``column`` is the column at which the caller will put the head.
    """
    if not value:
        return [head + _flow(value) + tail]
    is_mapping = isinstance(value, Mapping)
    entries = list(value.items()) if is_mapping else [(None, each) for each in value]
    opening, closing = "{}" if is_mapping else "[]"
    lines, inner, is_broken = [head + opening], column + len(head) + 1, False
    for index, (key, each) in enumerate(entries):
        start = "" if key is None else f"{_scalar(key)}: "
        end = closing + tail if index == len(entries) - 1 else ","
        whole = start + _flow(each) + end
        is_whole = inner + len(whole) <= WIDTH or not isinstance(each, (Mapping, list, tuple))
        first, *others = [whole] if is_whole else _filled(start, each, end, inner)
        at = len(lines[-1]) + (column if len(lines) == 1 else 0)
        if index == 0:
            lines[-1] += first
        elif is_whole and not is_broken and at + 1 + len(first) <= WIDTH:
            lines[-1] += f" {first}"
        else:
            lines.append(" " * inner + first)
        lines += others
        is_broken = bool(others)
    return lines


def _flow(value: object) -> str:
    """Return the YAML of a value in flow style, on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_scalar(key)}: {_flow(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return _scalar(value)


def _scalar(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return _number(value)
    text = str(value.value if isinstance(value, Enum) else value)
    return text if _is_plain(text) else _quoted(text)


def _is_plain(text: str, also: str = "") -> bool:
    """Return whether a text needs no quotes, because YAML 1.1 and 1.2 read it unchanged, also inside brackets.

    ``also`` are more characters to allow, for a text outside of brackets.
    """
    if not _SAFE.union(also).issuperset(text) or not _BEGINS.match(text):
        return False
    is_bounded = not text.endswith((" ", ":")) and ": " not in text and text not in _TRUTHS
    tag = _RESOLVER.resolve(yaml.ScalarNode, text, (True, False))
    return is_bounded and bool(tag == "tag:yaml.org,2002:str")


def _number(value: float) -> str:
    text = float.__repr__(value)
    if text in ("inf", "-inf"):
        return text.replace("inf", ".inf")
    mantissa, exponent, power = text.partition("e")
    return text if not exponent or "." in mantissa else f"{mantissa}.0e{power}"


def _quoted(text: str) -> str:
    """Return a text in double quotes for YAML. Characters that are not printable are escaped.

    A lone surrogate, which no text file can contain, becomes the replacement character.
    """
    return '"' + "".join(map(_escaped, text)) + '"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    if character.isprintable():
        return character
    if "\ud800" <= character <= "\udfff":
        return "\ufffd"
    return character.encode("unicode_escape").decode("ascii")  # \n, \x1b, \u2028: YAML uses the same escapes
