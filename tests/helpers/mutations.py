"""Damage to corpus files."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Mapping

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
