"""The writer of corpus files, in a format that people can read and compare."""

from __future__ import annotations

import os
import re
import string
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, replace
from enum import Enum
from itertools import count
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
        super().__init__(str(FieldError(str(path), expected, received, fix)))


def write(path: Path, finding: Finding, *, over: bool = False) -> bool:
    """Write the file of a finding completely or not at all.

    Return False if the file already exists and ``over`` is false.

    Raises:
        CorpusWriteError: if the file cannot be written.
    """
    content = text_of(finding).encode()
    if len(content) > MAX_BYTES:
        # The reader would reject the file, so the finding would be lost.
        raise CorpusWriteError(
            path,
            f"a finding of at most {MAX_BYTES // 1024} KiB",
            f"one of {-(-len(content) // 1024)} KiB",
            "use fewer NPCs or fewer instructions per NPC",
        )
    try:
        if not over:
            return write_if_free(path, content)
        write_whole(path, content)
        return True
    except OSError as error:
        raise CorpusWriteError(
            path,
            "a file for the finding",
            f"the error '{error.strerror or error}'",
            way_out(error, f"or choose another folder with {flag('corpus')}"),
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
    name = finding.id
    for number in count(2):
        path = folder / f"{name}{SUFFIX}"
        if not os.path.lexists(path) or _holds(path, finding, is_guard=path in passed):
            break
        name = f"{finding.id}-{number}"
    return path, replace(finding, id=name)


def _holds(path: Path, finding: Finding, *, is_guard: bool) -> bool:
    try:
        saved = load(path)
    except CorpusError:
        return False  # a file that the user may still repair is not overwritten
    # A guard is a file whose replay passes. If it has another scenario, for example a shrunk one, both are kept.
    if is_guard and saved.scenario != finding.scenario:
        return False
    return saved.signature == finding.signature


# The content of a file.

WIDTH = 120

_SAFE = {*string.ascii_letters, *string.digits, *"_.+-/()<>=*' "}
_BEGINS = re.compile(r"[A-Za-z_]|\d+\.\d+\.\d")  # a word, or the number of a version
_TRUTHS = {"y", "Y", "n", "N"}  # booleans in YAML 1.1, which PyYAML reads as strings
_RESOLVER: Any = yaml.resolver.Resolver()


def text_of(finding: Finding) -> str:
    """Return the content of a corpus file."""
    xfail = "# xfail: {reason, until}"  # a hint on how to accept the failure
    if finding.xfail is not None:
        xfail = f"xfail: {{reason: {_quoted(finding.xfail)}, until: {finding.xfail_until}}}"
    test = _quoted(finding.test)
    if _is_plain(finding.test, also=":[],"):  # not inside brackets
        test = finding.test
    found = asdict(finding.found).items()
    # People read these files in pull requests, so the scenario and its expected result come first.
    lines = [f"pafot: {VERSION}"]
    lines += _scenario_lines(finding.scenario)
    lines += _expect_lines(finding.expect)
    lines += _filled("found: ", {name: value for name, value in found if value is not None})
    if finding.perception is not None:
        lines += _filled("perception: ", finding.perception.imperfections)
    if finding.shrunk is not None:
        lines += _filled("shrunk: ", _known(asdict(finding.shrunk)))
    if finding.rate is not None:
        lines += _filled("rate: ", asdict(finding.rate))
    if finding.flaky is not None:
        lines.append(f"flaky: {_quoted(finding.flaky)}")
    lines.append(f"test: {test}")
    lines += _filled("world: ", finding.world)
    lines.append(f"{xfail}\n")
    return "\n".join(lines)


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
    vehicles = {}
    for npc, vehicle in enumerate(scenario.vehicles):
        if vehicle != CAR:
            vehicles[f"NPC {npc}"] = vehicle.plain()
    if vehicles:
        fields["vehicles"] = vehicles
    chains = fields["npcs"] = {}
    for npc, chain in enumerate(scenario.npcs):
        chains[f"NPC {npc}"] = [each.in_file() for each in chain]
    return fields


def _scenario_lines(scenario: Scenario) -> Iterator[str]:
    yield "scenario:"
    for name, value in scenario_data(scenario).items():
        if name == "npcs":
            yield "  npcs:"
            for npc, chain in value.items():
                yield from _filled(f"    {npc}: ", chain)
        elif isinstance(value, dict):
            yield from _filled(f"  {name}: ", value)
        else:
            yield f"  {name}: {_scalar(value)}"


def _expect_lines(expect: Expect) -> Iterator[str]:
    values = asdict(expect)  # in the order of the dataclass
    values["check"] = _known(values["check"] or {})
    for last in ("situation", "traceback"):  # the longest ones
        values[last] = values.pop(last)
    entries = {}
    is_block = False
    for name, value in values.items():
        if value not in (None, "", {}) or name == "failure":
            entries[name] = value
            is_block = is_block or (isinstance(value, str) and "\n" in value)
    if not is_block:
        yield from _filled("expect: ", entries)
        return
    yield "expect:"
    for name, value in entries.items():
        if not isinstance(value, str) or not _fits_literal(value):
            yield f"  {name}: {_flow(value)}"
            continue
        # "|-" means that the string does not end with a line break.
        yield f"  {name}: |" if value.endswith("\n") else f"  {name}: |-"
        for line in value.removesuffix("\n").split("\n"):
            yield f"    {line}" if line else ""


def _fits_literal(text: str) -> bool:
    # YAML reads a literal block unchanged only if all of this is true.
    lines = text.removesuffix("\n").split("\n")
    is_printable = all(line.replace("\t", "").isprintable() for line in lines)
    if "\n" not in text or not is_printable:
        return False
    return all(line and line[0] not in " \t" for line in (lines[0], lines[-1]))


def _filled(head: str, value: Any, tail: str = "", column: int = 0) -> list[str]:
    # The lines of a mapping or list in flow style, wrapped to the width. The first line begins with `head`, and the
    # last line ends with `tail`. `column` is the indentation of `head`.
    if not value:
        return [head + _flow(value) + tail]
    opening, closing = "[]"
    entries = [("", each) for each in value]
    if isinstance(value, Mapping):
        opening, closing = "{}"
        entries = [(f"{_scalar(key)}: ", each) for key, each in value.items()]
    inner = column + len(head) + 1
    # The first line is indented for now, so that the length of each line is its last column.
    lines = [" " * column + head + opening]
    # A value that is too long for its line is wrapped by this function, below its own first entry. The entry after it
    # starts a new line.
    is_broken = False
    for index, (start, each) in enumerate(entries, 1):
        end = closing + tail if index == len(entries) else ","
        first = start + _flow(each) + end
        others: list[str] = []
        is_whole = True
        if inner + len(first) > WIDTH and isinstance(each, (Mapping, list, tuple)):
            is_whole = False
            first, *others = _filled(start, each, end, inner)
        has_room = len(lines[-1]) + 1 + len(first) <= WIDTH
        if index == 1:
            lines[0] += first
        elif is_whole and not is_broken and has_room:
            lines[-1] += f" {first}"
        else:
            lines.append(" " * inner + first)
        lines += others
        is_broken = bool(others)
    lines[0] = lines[0].removeprefix(" " * column)
    return lines


def _flow(value: object) -> str:
    if isinstance(value, Mapping):
        entries = [f"{_scalar(key)}: {_flow(inner)}" for key, inner in value.items()]
        return f"{{{', '.join(entries)}}}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_flow, value))}]"
    return _scalar(value)


def _scalar(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Cell):
        return value.label
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, Enum):
        value = value.value
    text = str(value)
    if not _is_plain(text):
        return _quoted(text)
    return text


def _is_plain(text: str, also: str = "") -> bool:
    # Whether YAML 1.1 and 1.2 read a string unchanged without quotes. `also` contains additional characters to allow.
    if not _SAFE.union(also).issuperset(text) or not _BEGINS.match(text):
        return False
    if text.endswith((" ", ":")) or ": " in text or text in _TRUTHS:
        return False
    tag = _RESOLVER.resolve(yaml.ScalarNode, text, (True, False))
    return bool(tag == "tag:yaml.org,2002:str")


def _number(value: float) -> str:
    text = float.__repr__(value)
    if text in ("inf", "-inf"):
        return text.replace("inf", ".inf")
    # YAML 1.1 reads 1e-05 as a string, and 1.0e-05 as a number.
    mantissa, exponent, power = text.partition("e")
    if exponent and "." not in mantissa:
        return f"{mantissa}.0e{power}"
    return text


def _quoted(text: str) -> str:
    return f'"{"".join(map(_escaped, text))}"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return f"\\{character}"
    if character.isprintable():
        return character
    if "\ud800" <= character <= "\udfff":
        # No text file in UTF-8 can contain a lone surrogate.
        return "\ufffd"
    # \n, \x1b, \u2028: YAML uses the same escapes
    return character.encode("unicode_escape").decode("ascii")
