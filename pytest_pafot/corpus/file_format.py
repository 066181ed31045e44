"""The format of corpus files: which keys there are, and the text, which people read and version control compares.

Version 2 holds the world complete, so that no default that changes later changes what a saved scenario is. A key that
comes to it later is optional, and a file without it means what it meant before.
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

# Which keys there are.

VERSION = 2
"""The one that is written and read."""


@dataclass(frozen=True, slots=True)
class Keys:
    """Of a mapping in a file."""

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
"""Of worlds, by kind; what ``data`` is, the user's own world says by its ``to_dict``."""

LIMITS = Keys(("acceleration", "braking", "jerk", "lateral_acceleration", "overspeed", "heading"))
"""Of the key ``limits`` of a world."""

SCENARIO = Keys(("seed", "ego", "npcs"), ("gene_seconds", "traffic"))
"""Of ``scenario`` and ``original``; ``npcs`` is a list of lists of genes, in one of the next three forms."""

EGO = Keys(("lane", "speed"))
POSITION_INSTRUCTION = Keys(("cell", "speed"))
LANE_INSTRUCTION = Keys(("lane", "speed"))
CROSSING_INSTRUCTION = Keys(("zone", "slot", "speed"), ("act",))
TRAFFIC = Keys(("style",), tuple(BOUNDS))
"""Of ``traffic`` where it is no style alone."""

XFAIL = Keys(("reason",), ("until",))
"""Of ``xfail`` where it is no plain text."""

EXPECT = Keys(
    ("failure", "outcome", "time", "responsibility"),
    (
        *("assertion", "check", "message", "npc", "cell", "zone", "side", "fault", "npc_manoeuvre", "ego_manoeuvre"),
        *("situation", "reference_drivers", "last_chance", "avoided_by", "against", "traceback"),
    ),
)
EXPECT_OF_COLLISION = Keys((*EXPECT.required, "npc", "cell", "side"), EXPECT.optional)
EXPECT_IN_ZONE = Keys((*EXPECT.required, "npc", "zone", "side"), EXPECT.optional)
"""Of a collision with an NPC that crosses, off the ego's way."""
CHECK = Keys((), ("value", "at_most", "at_least", "unit"))
"""Of ``expect.check``."""
SITUATION = Keys(("npc", "time", "ahead", "lane", "ego_speed", "npc_speed"))
"""Of ``expect.situation``."""
ZONE_SITUATION = Keys(("npc", "time", "npc_enters", "ego_enters", "ego_speed", "npc_speed"))
"""Of that with an NPC that crosses."""
LAST_CHANCE = Keys(("time", "driver", "action", "ego_action"))
"""Of ``expect.last_chance``."""
AVOIDANCE = Keys(("time", "braking"))
"""Of ``expect.avoided_by``."""

FOUND = Keys(("seed", "generation", "algorithm", "versions"), ("weights",))
PERCEPTION = Keys((), ("range", "latency", "noise", "dropout", "occlusion", "needed"))
SHRUNK = Keys(("rollouts", "is_minimal", "speeds"))
SPEEDS = Keys(("npc", "gene", "low", "high"))
"""Of each entry of the list ``shrunk.speeds``."""


WIDTH = 120
COMMENT_COLUMN = 34
DEFAULT_GENE_SECONDS = 10.0

_SAFE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.+-/()<>=*' ")
_BEGINS = re.compile(r"[A-Za-z_]|\d+\.\d+\.\d")  # a word, or the number of a version
_TRUTHS = frozenset("yYnN")  # for YAML 1.1, but not for PyYAML
_RESOLVER: Any = yaml.resolver.Resolver()


def text_of(finding: Finding) -> str:
    """The file's whole text, with LF line ends."""
    test = finding.test if _is_plain(finding.test, also=":[],") else _quoted(finding.test)  # on a line of its own
    found = {key: getattr(finding.found, key) for key in (*FOUND.required, *FOUND.optional)}
    xfail = '# xfail: "reason"'  # the hint how to accept the failure
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
    """One flow mapping; a block of lines where a text has several lines itself."""
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
    for name in ("situation", "last_chance", "avoided_by"):
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
    """Whether a literal block gives the text back: printable lines, the first and the last with a beginning."""
    lines = text.removesuffix("\n").split("\n")
    is_plain = all(line.replace("\t", "").isprintable() for line in lines)
    return "\n" in text and is_plain and all(line and line[0] not in " \t" for line in (lines[0], lines[-1]))


def _filled(head: str, value: Any, tail: str = "", column: int = 0) -> list[str]:
    """Lines of a head, a mapping or list in flow style, and a tail, filled up to the width.

    What does not fit into a line goes on under its own first entry. The head begins in a column other than 0 where
    whoever calls puts the first line there.
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
    """A value in flow style, on one line."""
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
    """Whether a text needs no quotes: YAML 1.1 and 1.2 read it as that very text, inside brackets too.

    Further characters may be named that YAML gives no meaning outside brackets.
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
    """In double quotes, with everything escaped that is not printable.

    A lone surrogate, which no text file can hold, becomes the replacement character.
    """
    return '"' + "".join(map(_escaped, text)) + '"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    if character.isprintable():
        return character
    if "\ud800" <= character <= "\udfff":
        return "\ufffd"
    return character.encode("unicode_escape").decode("ascii")  # \n, \x1b, \u2028, as YAML writes them too
