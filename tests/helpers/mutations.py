"""Damage to corpus files, and an independent reading of the damaged text to check the loaded finding against."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import yaml

from pytest_pafot.findings.finding import Finding
from pytest_pafot.model.instructions import CrossingInstruction
from pytest_pafot.model.scenario import Scenario

LOOKALIKES = {"a": "\u0430", "e": "\u0435", "o": "\u043e", "p": "\u0440", "c": "\u0441", "i": "\u0456", "1": "\uff11",
              "0": "\uff10", "-": "\u2212", ".": "\u2024", ":": "\uff1a", " ": "\u00a0", "{": "\uff5b"}  # fmt: skip
ODD_NUMBERS = (
    "007", "0x1A", "0o17", "0b11", "1_000", "1:30", "1e3", "+5", "5.", ".5", "1.5e3", "-1", "-0.0", "0", ".nan", ".inf",
    "-.inf", "1.0e+300", "1.0e-300", "99999999999999999999", "3000000", "3", "2.5", "0.1", "1000", "61", "1.0e+9",
    "12345.6789", "5.0", "8", "2",
)  # fmt: skip
ODD_VALUES = (
    "yes", "no", "On", "TRUE", "True", "true", "false", "~", "null", "", "''", '""', '" "', "[]", "{}", "[1]", "{a: 1}",
    "'4'", '"4"', "text", "2026-11-20", "!!str 4", "!!int 4", "&a 4", "*a", "<<", "=", "!x 4", "|", ">", "? a", "- 1",
    "highway", "gym", "own", "collision", "safe", "none", "ego", "keep", "left", "highway-v0", "exit-v0", "merge-v0",
)  # fmt: skip

_VALUE = re.compile(r"(?<=: )[^,{}\[\]\n#|]+(?=[,}\]\n])")
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])")
_KEY = re.compile(r"[A-Za-z_]+(?=: )")

Mutation = Callable[[random.Random, str], str]


def _replaced(rng: random.Random, text: str, pattern: re.Pattern[str], by: Callable[[str], str]) -> str:
    found = list(pattern.finditer(text))
    if not found:
        return text
    place = rng.choice(found)
    return text[: place.start()] + by(place[0]) + text[place.end() :]


def _lines(change: Callable[[random.Random, list[str]], None]) -> Mutation:
    def mutate(rng: random.Random, text: str) -> str:
        lines = text.splitlines(keepends=True)
        change(rng, lines)
        return "".join(lines)

    return mutate


def _drop(rng: random.Random, lines: list[str]) -> None:
    del lines[rng.randrange(len(lines))]


def _duplicate(rng: random.Random, lines: list[str]) -> None:
    lines.insert(rng.randrange(len(lines)), rng.choice(lines))


def _swap(rng: random.Random, lines: list[str]) -> None:
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]


def _indent(rng: random.Random, lines: list[str]) -> None:
    index = rng.randrange(len(lines))
    lines[index] = rng.choice([f"  {lines[index]}", lines[index].removeprefix("  "), f"\t{lines[index]}"])


def _byte(rng: random.Random, text: str) -> str:
    at, new = rng.randrange(len(text)), chr(rng.choice([*range(32, 127), 9, 10, 0, 0x85, 0xA0, 0x2028, 0xFEFF]))
    return rng.choice([text[:at] + new + text[at:], text[:at] + text[at + 1 :], text[:at] + new + text[at + 1 :]])


def _cut(rng: random.Random, text: str) -> str:
    return text[: rng.randrange(len(text))]


def _lookalike(rng: random.Random, text: str) -> str:
    at = rng.choice([index for index, character in enumerate(text) if character in LOOKALIKES])
    return text[:at] + LOOKALIKES[text[at]] + text[at + 1 :]


def _key_renamed(rng: random.Random, text: str) -> str:
    def renamed(key: str) -> str:
        at = rng.randrange(len(key))
        return rng.choice(
            [key + "s", key[:at] + key[at + 1 :], key.upper(), rng.choice(_KEY.findall(text)), f"'{key}'"]
        )

    return _replaced(rng, text, _KEY, renamed)


def _key_repeated(rng: random.Random, text: str) -> str:
    entry = re.compile(r"[A-Za-z_]+: [^,{}\[\]\n#|]+(?=[,}\n])")
    return _replaced(rng, text, entry, lambda found: f"{found}, {found}")


def _anchored(rng: random.Random, text: str) -> str:
    return _replaced(rng, text, _VALUE, lambda value: rng.choice([f"&a {value}", "*a", f"!!str {value}", f"! {value}"]))


def _headed(rng: random.Random, text: str) -> str:
    return (
        rng.choice(["%YAML 1.1\n---\n", "%YAML 1.2\n---\n", "%TAG ! tag:x,2000:\n---\n", "---\n", "--- !!map\n"]) + text
    )


def _other_number(rng: random.Random, text: str) -> str:
    return _replaced(rng, text, _NUMBER, lambda _: rng.choice(ODD_NUMBERS))


def _scaled_number(rng: random.Random, text: str) -> str:
    def scaled(number: str) -> str:
        factor = rng.choice([-1, 0, 0.5, 2, 10, 1000, 10**6])
        return repr(float(number) * factor) if "." in number else str(int(int(number) * factor))

    return _replaced(rng, text, _NUMBER, scaled)


MUTATIONS: Mapping[str, Mutation] = {
    "byte": _byte,
    "cut short": _cut,
    "line dropped": _lines(_drop),
    "line repeated": _lines(_duplicate),
    "lines swapped": _lines(_swap),
    "line moved in or out": _lines(_indent),
    "key renamed": _key_renamed,
    "key repeated": _key_repeated,
    "value replaced": lambda rng, text: _replaced(rng, text, _VALUE, lambda _: rng.choice(ODD_VALUES)),
    "value quoted": lambda rng, text: _replaced(rng, text, _VALUE, lambda value: f'"{value}"'),
    "value nested": lambda rng, text: _replaced(
        rng, text, _VALUE, lambda value: rng.choice(["[{}]", "{{a: {}}}"]).format(value)
    ),
    "number odd": _other_number,
    "number scaled": _scaled_number,
    "look-alike": _lookalike,
    "anchor or tag": _anchored,
    "directive": _headed,
    "version": lambda rng, text: _replaced(rng, text, re.compile(r"(?<=pafot: )\d"), lambda _: rng.choice("0123")),
}


class UnclearError(Exception):
    """A text that a reader without knowledge of YAML's versions may misunderstand."""


_SPOKEN = {"true": True, "false": False, "null": None, "": None}
_INTEGER = re.compile(r"-?(0|[1-9][0-9]*)")
_REAL = re.compile(r"-?(0|[1-9][0-9]*)\.[0-9]+(e[-+][0-9]+)?")
_ODD = re.compile(
    r"[-+.]?[0-9][0-9_:]*\.?[0-9_]*([eE][-+]?[0-9]+)?|0[xob][0-9a-fA-F_]+|[-+]?\.(inf|nan)"
    r"|~|yes|no|on|off|true|false|null",
    re.IGNORECASE,
)
_DOTTED = re.compile(r"[0-9]+\.[0-9]+\.[0-9.]+")


def says(text: str) -> Any:
    """Return the content of a text: decimal numbers, ``true``, ``false``, ``null``, texts, lists and mappings.

    Raises:
        UnclearError: The content is ambiguous.
    """
    text = text.removeprefix("\ufeff")
    try:
        if any(isinstance(token, (yaml.AnchorToken, yaml.AliasToken, yaml.TagToken)) for token in yaml.scan(text)):
            raise UnclearError("anchors, aliases or tags")
        return _said(yaml.compose(text, Loader=yaml.BaseLoader))
    except yaml.YAMLError as error:
        raise UnclearError(f"no YAML for PyYAML's own parser: {error}") from error


def _said(node: Any) -> Any:
    if isinstance(node, yaml.SequenceNode):
        return [_said(each) for each in node.value]
    if isinstance(node, yaml.MappingNode):
        keys = [_said(key) for key, _ in node.value]
        if len(set(map(str, keys))) < len(keys) or not all(isinstance(key, str) for key in keys):
            raise UnclearError(f"keys {keys}")
        return {key: _said(value) for key, (_, value) in zip(keys, node.value, strict=True)}
    return node.value if node.style is not None else _plain(node.value)


def _plain(text: str) -> Any:
    if text in _SPOKEN:
        return _SPOKEN[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _REAL.fullmatch(text) or text in (".inf", "-.inf"):
        return float(text.replace(".inf", "inf"))
    if _ODD.fullmatch(text) and not _DOTTED.fullmatch(text):
        raise UnclearError(text)
    return text


PARTS = ("check", "situation", "avoided_by")
"""The fields of an expectation that are themselves values with several fields."""


def holds(finding: Finding) -> dict[str, Any]:
    """Return a finding in the layout of its file, including everything that a file may leave out."""
    expect, found, shrunk = finding.expect, finding.found, finding.shrunk
    return {
        "test": finding.test,
        "world": dict(finding.world),
        "scenario": _scenario(finding.scenario),
        "original": None if finding.original is None else _scenario(finding.original),
        "expect": {name: getattr(expect, name) for name in expect.__slots__}
        | {"reference_drivers": dict(expect.reference_drivers)}
        | {name: None if (part := getattr(expect, name)) is None else asdict(part) for name in PARTS},
        "found": {name: getattr(found, name) for name in found.__slots__} | {"versions": dict(found.versions)},
        "perception": finding.perception,  # no damaged file has it
        "shrunk": None
        if shrunk is None
        else {
            "rollouts": shrunk.rollouts,
            "is_minimal": shrunk.is_minimal,
        },
        "rate": None if finding.rate is None else asdict(finding.rate),
        "flaky": finding.flaky,
        "xfail": _accepted(finding),
    }


def _accepted(finding: Finding) -> Any:
    until = finding.xfail_until
    return None if until is None else {"reason": finding.xfail, "until": until.isoformat()}


def _scenario(scenario: Scenario) -> dict[str, Any]:
    def gene(instruction: Any) -> dict[str, Any]:
        target = instruction.target
        if isinstance(instruction, CrossingInstruction):
            return {name: getattr(instruction, name) for name in ("zone", "slot", "speed", "act")}
        return {"lane" if isinstance(target, str) else "cell": target, "speed": instruction.speed}

    return {
        "seed": scenario.seed,
        "ego": {"lane": scenario.ego_lane, "speed": scenario.ego_speed},
        "gene_seconds": scenario.gene_seconds,
        "traffic": scenario.traffic,
        "npcs": [[gene(each) for each in chain] for chain in scenario.npcs],
    }


DEFAULTS: Mapping[str, Any] = {
    "gene_seconds": 10.0,
    "traffic": "paper",
    "reference_drivers": {},
    "assertion": "",
    "message": "",
    "against": "",
    "traceback": "",
    "act": "pass",
    "steps": [],
}
"""The defaults, other than None, of what a file may leave out."""


def differences(said: Any, held: Any, place: str = "") -> list[str]:
    """Return how the loaded data differ from the text; what the text leaves out must have its default."""
    if isinstance(said, Mapping) and isinstance(held, Mapping):
        inner = [line for key in said if key in held for line in differences(said[key], held[key], f"{place}.{key}")]
        unheard = [f"{place}.{key}: said, not held" for key in said if key not in held]
        made_up = [key for key in held if key not in said and held[key] != DEFAULTS.get(key)]
        return inner + unheard + [f"{place}.{key}: held as {held[key]!r}, not said" for key in made_up]
    if isinstance(said, list) and isinstance(held, list):
        if len(said) != len(held):
            return [f"{place}: {len(said)} said, {len(held)} held"]
        return [
            line for index in range(len(said)) for line in differences(said[index], held[index], f"{place}[{index}]")
        ]
    is_same = said == held and isinstance(said, bool) == isinstance(held, bool)
    return [] if is_same else [f"{place}: said {said!r}, held {held!r}"]


def misread(text: str, finding: Finding) -> list[str]:
    """Return how a loaded finding differs from its text."""
    try:
        said = says(text)
    except UnclearError as error:
        return [f"read, although it is not clear what it says: {error}"]
    version = said.pop("pafot", None)
    if version != 2:
        return [f"read as of version {version!r}"]
    return differences(said, holds(finding))
