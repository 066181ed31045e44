"""The writer of corpus files, in a format that people can read and compare."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, replace
from enum import Enum
from pathlib import Path
from typing import Any

import yaml

from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.corpus.reader import DEFAULT_GENE_SECONDS, MAX_BYTES, VERSION, load
from pytest_pafot.findings.finding import Expect, Finding
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.vehicle_type import CAR, PAPERS
from pytest_pafot.support.errors import CorpusError, FieldError, flag, sentence
from pytest_pafot.support.files import way_out, write_if_free, write_whole


class CorpusWriteError(RuntimeError):
    """An error for a finding that could not be written."""

    def __init__(self, path: Path, expected: str, received: str, fix: str) -> None:
        super().__init__(
            str(FieldError(field=f"{path}", expected=expected, received=received, fix=fix))
        )
        self.path = path


def write(path: Path, finding: Finding, *, over: bool = False) -> bool:
    """Write the file of a finding completely or not at all.

    Return False if the file already exists and ``over`` is false.

    Raises:
        CorpusWriteError: if the file cannot be written.
    """
    content = text_of(finding).encode()
    if len(content) > MAX_BYTES:
        # The reader would reject the file, so the finding would be lost.
        expected, fix = (
            f"a finding of at most {MAX_BYTES // 1024} KiB",
            "use fewer NPCs or fewer instructions per NPC",
        )
        raise CorpusWriteError(path, expected, f"one of {-(-len(content) // 1024)} KiB", fix)
    try:
        if not over:
            return write_if_free(path, content)
        write_whole(path, content)
        return True
    except OSError as error:
        fix = way_out(error, f"or choose another folder with {flag('corpus')}")
        raise CorpusWriteError(
            path, "a file for the finding", f"the error '{error.strerror or error}'", fix
        ) from error


def rewrite(path: Path, finding: Finding) -> Finding:
    """Replace the file of a finding, but keep its ``xfail``.

    Raises:
        CorpusWriteError: if the file cannot be written, or the old one cannot be read.
    """
    kept = finding
    if finding.xfail is None and os.path.lexists(path):
        try:
            # The user may have accepted the failure since this finding was read.
            there = load(path)
            kept = finding.accepting(there.xfail, there.xfail_until)
        except CorpusError as error:
            received = f"a file that cannot be read: {sentence(error.field, error.expected, error.received, '')}"
            raise CorpusWriteError(
                path, "a saved scenario to update", received, error.fix
            ) from error
    write(path, kept, over=True)
    return kept


def free_path(
    folder: Path, finding: Finding, passed: Collection[Path] = ()
) -> tuple[Path, Finding]:
    """Return a path for a new finding, and the finding with the id in that path.

    If a file already contains the finding, return the path of the file. ``passed`` contains the files whose replays
    pass.
    """
    # The id is a hash of the scenario before shrinking. If the file with that id was updated to another failure, and
    # the first failure is found again, the id is taken. The new file then gets the suffix -2, -3 and so on.
    number = 1
    while True:
        name = finding.id if number == 1 else f"{finding.id}-{number}"
        path = folder / f"{name}{SUFFIX}"
        if not os.path.lexists(path) or _holds(path, finding, is_guard=path in passed):
            return path, replace(finding, id=name)
        number += 1


def _holds(path: Path, finding: Finding, *, is_guard: bool) -> bool:
    try:
        saved = load(path)
    except CorpusError:
        return False  # a file that the user may still repair is not overwritten
    # A guard is a file whose replay passes. If it has another scenario, for example a shrunk one, both are kept.
    return saved.signature == finding.signature and not (
        is_guard and saved.scenario != finding.scenario
    )


# The content of a file.

WIDTH = 120

_SAFE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.+-/()<>=*' ")
_BEGINS = re.compile(r"[A-Za-z_]|\d+\.\d+\.\d")  # a word, or the number of a version
_TRUTHS = frozenset("yYnN")  # booleans in YAML 1.1, which PyYAML reads as strings
_RESOLVER: Any = yaml.resolver.Resolver()


def text_of(finding: Finding) -> str:
    """Return the content of a corpus file."""
    # not inside brackets
    test = finding.test if _is_plain(finding.test, also=":[],") else _quoted(finding.test)

    xfail = "# xfail: {reason, until}"  # a hint on how to accept the failure
    if finding.xfail is not None:
        xfail = f"xfail: {{reason: {_quoted(finding.xfail)}, until: {finding.xfail_until}}}"
    rate = finding.rate
    # People read these files in pull requests, so the scenario and its expected result come first.
    lines = [
        f"pafot: {VERSION}",
        *_scenario_lines(finding.scenario),
        *_expect_lines(finding.expect),
        *_filled(
            "found: ",
            {name: value for name, value in asdict(finding.found).items() if value is not None},
        ),
        *(
            []
            if finding.perception is None
            else _filled("perception: ", finding.perception.imperfections)
        ),
        *([] if finding.shrunk is None else _filled("shrunk: ", _known(asdict(finding.shrunk)))),
        *([] if rate is None else [f"rate: {{failing: {rate.failing}, runs: {rate.runs}}}"]),
        *([] if finding.flaky is None else [f"flaky: {_quoted(finding.flaky)}"]),
        f"test: {test}",
        *_filled("world: ", finding.world),
        xfail,
    ]
    return "\n".join(lines) + "\n"


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value not in (None, "")}


def scenario_data(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as JSON-compatible data with a name for each value."""
    fields: dict[str, Any] = {
        "seed": scenario.seed,
        "ego": {"lane": scenario.ego_lane, "speed": scenario.ego_speed},
    }
    if scenario.gene_seconds != DEFAULT_GENE_SECONDS:
        fields["gene_seconds"] = scenario.gene_seconds
    if scenario.traffic != PAPERS:
        fields["traffic"] = scenario.traffic
    vehicles = {
        f"NPC {npc}": each.plain() for npc, each in enumerate(scenario.vehicles) if each != CAR
    }
    chains = {
        f"NPC {npc}": [each.in_file() for each in chain] for npc, chain in enumerate(scenario.npcs)
    }
    return fields | ({"vehicles": vehicles} if vehicles else {}) | {"npcs": chains}


def _scenario_lines(scenario: Scenario) -> Iterator[str]:
    fields = scenario_data(scenario)
    npcs = fields.pop("npcs")
    yield "scenario:"
    for name, value in fields.items():
        yield from (
            _filled(f"  {name}: ", value)
            if isinstance(value, dict)
            else [f"  {name}: {_flow(value)}"]
        )
    yield "  npcs:"
    for name, chain in npcs.items():
        yield from _filled(f"    {name}: ", chain)


def _expect_lines(expect: Expect) -> Iterator[str]:
    values = asdict(expect)  # in the order of the dataclass
    values["check"] = _known(values["check"] or {})
    for last in ("situation", "traceback"):  # the longest ones
        values[last] = values.pop(last)
    entries = {
        name: value
        for name, value in values.items()
        if value not in (None, "", {}) or name == "failure"
    }
    if not any(isinstance(value, str) and "\n" in value for value in entries.values()):
        yield from _filled("expect: ", entries)
        return
    yield "expect:"
    yield from _block(entries)


def _block(entries: Mapping[str, Any]) -> Iterator[str]:
    for key, value in entries.items():
        if isinstance(value, str) and _fits_literal(value):
            # "|-" means that the string does not end with a line break.
            yield f"  {key}: |" if value.endswith("\n") else f"  {key}: |-"
            yield from (
                f"    {line}" if line else "" for line in value.removesuffix("\n").split("\n")
            )
        else:
            yield f"  {key}: {_flow(value)}"


def _fits_literal(text: str) -> bool:
    # YAML reads a literal block unchanged only if all of this is true.
    lines = text.removesuffix("\n").split("\n")
    is_plain = all(line.replace("\t", "").isprintable() for line in lines)
    return (
        "\n" in text
        and is_plain
        and all(line and line[0] not in " \t" for line in (lines[0], lines[-1]))
    )


def _filled(head: str, value: Any, tail: str = "", column: int = 0) -> list[str]:
    # The lines of a mapping or list in flow style, wrapped to the width. The first line begins with `head`, and the
    # last line ends with `tail`. `column` is the indentation of `head`.
    if not value:
        return [head + _flow(value) + tail]
    is_mapping = isinstance(value, Mapping)
    entries = list(value.items()) if is_mapping else [(None, each) for each in value]
    # A value that is too long for its line is wrapped by this function, below its own first entry. The entry after it
    # starts a new line.
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
    if isinstance(value, Mapping):
        return (
            "{" + ", ".join(f"{_scalar(key)}: {_flow(inner)}" for key, inner in value.items()) + "}"
        )
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return _scalar(value)


def _scalar(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Cell):
        return value.label
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return _number(value)
    text = str(value.value if isinstance(value, Enum) else value)
    return text if _is_plain(text) else _quoted(text)


def _is_plain(text: str, also: str = "") -> bool:
    # Whether YAML 1.1 and 1.2 read a string unchanged without quotes. `also` contains additional characters to allow.
    if not _SAFE.union(also).issuperset(text) or not _BEGINS.match(text):
        return False
    is_bounded = not text.endswith((" ", ":")) and ": " not in text and text not in _TRUTHS
    tag = _RESOLVER.resolve(yaml.ScalarNode, text, (True, False))
    return is_bounded and bool(tag == "tag:yaml.org,2002:str")


def _number(value: float) -> str:
    text = float.__repr__(value)
    if text in ("inf", "-inf"):
        return text.replace("inf", ".inf")
    # YAML 1.1 reads 1e-05 as a string, and 1.0e-05 as a number.
    mantissa, exponent, power = text.partition("e")
    return text if not exponent or "." in mantissa else f"{mantissa}.0e{power}"


def _quoted(text: str) -> str:
    return '"' + "".join(map(_escaped, text)) + '"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    if character.isprintable():
        return character
    if "\ud800" <= character <= "\udfff":
        # No text file in UTF-8 can contain a lone surrogate.
        return "\ufffd"
    # \n, \x1b, \u2028: YAML uses the same escapes
    return character.encode("unicode_escape").decode("ascii")
