"""Read a corpus file: return its strictly checked finding, or raise an error that names line, field and remedy.

The format is described in docs/reference/corpus-files.md. The keys are defined in
:mod:`pytest_pafot.corpus.file_format`.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, get_args

from pytest_pafot.attribution.last_chance import Avoidance, Escape, LastChance
from pytest_pafot.attribution.mistakes import LANE_CHANGES, Manoeuvre
from pytest_pafot.attribution.responsibility import Fault, Responsibility
from pytest_pafot.corpus import file_format
from pytest_pafot.corpus.file_format import DEFAULT_GENE_SECONDS, VERSION, Keys
from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.corpus.yaml_document import MAX_BYTES, NOT_SHOWN, Lines, Place, parse
from pytest_pafot.findings.finding import MAX_NUMBER, Bounded, Expect, Finding, Found, Perceived, check_plain, is_id
from pytest_pafot.findings.shrink import Shrunk, SpeedInterval
from pytest_pafot.findings.signature import ZONES
from pytest_pafot.findings.situation import Situation, ZoneSituation
from pytest_pafot.model.driving_style import PAPERS, STYLES, Traffic
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import (
    ACTS,
    REPAIR,
    SHIFTS,
    CrossingInstruction,
    Gene,
    Scenario,
    ScenarioError,
    gene_of,
)
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome, Side
from pytest_pafot.oracle.run import ReferenceOutcome
from pytest_pafot.support.errors import RESTORE, CorpusError, FieldError, plain_number, plain_whole
from pytest_pafot.support.files import open_regular
from pytest_pafot.support.text import day_of

# Values of a corpus file with their places. Every access checks the type; every error names line, field and way out.


@dataclass(frozen=True, slots=True)
class Field:
    """A value in a document, with its place. Each method checks the value, and raises an error that names the place."""

    path: Path
    lines: Lines
    place: Place
    value: Any

    @property
    def name(self) -> str:
        """The name of the value in an error, such as ``scenario.npcs[0][3].cell``."""
        return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self.place).lstrip(".")

    def error(self, expected: str, fix: str = RESTORE, received: str | None = None) -> CorpusError:
        """Return an error about the value, with its line or the nearest line that is known."""
        places = (self.place[:end] for end in range(len(self.place), -1, -1))
        line = next(self.lines[place] for place in places if place in self.lines)
        return CorpusError(self.path, expected, received or f"{self.value!r:.80}", fix, field=self.name, line=line)

    def at(self, part: str | int) -> Field:
        """Return the value under a key, or at an index, of this mapping or list."""
        return Field(self.path, self.lines, (*self.place, part), self.value[part])

    def mapping(self, keys: Keys) -> dict[str, Field]:
        """Return the values of this mapping; it must have all required keys and no unknown keys."""
        fields = self.any_mapping()
        known = [*keys.required, *keys.optional]
        for key in fields:
            if key not in known:
                raise fields[key].error(f"{_one_of(known)} (format {VERSION})", _guess(key, known), repr(key))
        for key in keys.required:
            if key not in fields:
                received = f"only {', '.join(fields)}" if fields else "nothing"
                raise self.error(f"the key '{key}'", "add it, or restore the file from version control", received)
        return fields

    def any_mapping(self) -> dict[str, Field]:
        """Return the values of this mapping, which may have any keys."""
        if not isinstance(self.value, dict):
            raise self.error("a mapping (key: value)")
        return {key: self.at(key) for key in self.value}

    def items(self) -> list[Field]:
        """Return the values of this list."""
        if not isinstance(self.value, list):
            raise self.error("a list")
        return [self.at(index) for index in range(len(self.value))]

    def text(self) -> str:
        """Return the value; it must be a text."""
        if not isinstance(self.value, str):
            raise self.error("text", "put it in quotes")
        return self.value

    def some_text(self, fix: str) -> str:
        """Return the value; it must be a text that is not blank. ``fix`` is the advice in the error."""
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.error("some text", fix)
        return self.value

    def choice(self, options: Collection[str]) -> Any:
        """Return the value; it must be a text among the options."""
        if not isinstance(self.value, str) or self.value not in options:
            raise self.error(_one_of(options), _guess(str(self.value), options))
        return self.value

    def whole(self, low: int = 0, high: int | None = None) -> int:
        """Return the value; it must be a whole number within limits."""
        number = plain_whole(self.value)
        if number is None or number < low or (high is not None and number > high):
            top = "" if high is None else f" to {high}"
            raise self.error(f"a whole number from {low}{top}", "correct it")
        return number

    def day(self) -> date:
        """Return the value as a day; it must be a text such as 2027-01-31."""
        day = day_of(self.value) if isinstance(self.value, str) else None
        if day is None:
            raise self.error("a day of the calendar, as year-month-day", "write it as 2027-01-31")
        return day

    def truth(self) -> bool:
        """Return the value; it must be true or false."""
        if not isinstance(self.value, bool):
            raise self.error("true or false", "correct it")
        return self.value

    def number(self, low: float = 0.0) -> float:
        """Return the value; it must be a finite number that is not below ``low``."""
        number = plain_number(self.value)
        if number is None or not low <= number <= MAX_NUMBER:
            raise self.error(f"a finite number, at least {low:g}", "correct it")
        return float(number)


def _one_of(options: Collection[str]) -> str:
    """Return the words for a choice in an error, such as "one of a, b"."""
    return f"one of {', '.join(options)}"


def _guess(word: str, options: Collection[str]) -> str:
    """Return the advice for an unknown word: similar words, if there are any."""
    close = difflib.get_close_matches(word, list(options), n=1)
    return f"did you mean {close[0]!r}?" if close else "correct or remove it"


MAX_RECEIVED = 300
_SCENARIO_FIELDS = {"seed": ("seed",), "ego_lane": ("ego", "lane"), "ego_speed": ("ego", "speed")}
_OUTCOMES = tuple(str(outcome) for outcome in Outcome if outcome is not Outcome.INVALID)


def load(path: str | os.PathLike[str]) -> Finding:
    """Read a corpus file and return its finding. The finding's id is the file's name.

    Raises:
        CorpusError: if anything in the file is wrong. The message names the place and what to do.
    """
    path = Path(path)
    return parsed(path, content_of(path))


def parsed(path: Path, content: bytes, loader: type[Any] | None = None) -> Finding:
    """Return the finding in the content of a file, like :func:`load`.

    ``loader`` is passed to :func:`yaml_document.parse`.
    """
    __tracebackhide__ = True  # pytest's --showlocals would print the content
    top = _top(path, content, loader)
    name = path.name.removesuffix(SUFFIX)
    if not path.name.endswith(SUFFIX) or not is_id(name):
        expected = f"a name of letters, digits, '.', '_' and '-' before {SUFFIX}"
        raise CorpusError(path, expected, path.name, "rename the file")
    fields = top.mapping(file_format.FILE)
    scenario = _scenario(fields["scenario"])
    reason, until = _given(fields, "xfail", _xfail, (None, None))
    return Finding(
        id=name,
        test=fields["test"].some_text("name the test's node id, such as tests/test_safety.py::test_it"),
        world=_world(fields["world"]),
        scenario=scenario,
        expect=_expect(fields["expect"], len(scenario.npcs)),
        found=_found(fields["found"]),
        perception=_given(fields, "perception", _perceived),
        original=_given(fields, "original", _scenario),
        shrunk=_given(fields, "shrunk", lambda field: _shrunk(field, scenario)),
        flaky=_given(fields, "flaky", lambda field: field.some_text("say what differed, or remove the line")),
        xfail=reason,
        xfail_until=until,
    )


def located(path: Path, part: str, error: Exception) -> CorpusError:
    """Return an error about a part of a valid file, with the line of the part.

    ``error`` was raised when the part, which is ``world`` or ``scenario``, was built or run.
    """
    try:
        return _rule_broken(_top(path, content_of(path)).at(part), error)
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


def _top(path: Path, content: bytes, loader: type[Any] | None = None) -> Field:
    """Return the top value of the document in a file, after its version is checked."""
    __tracebackhide__ = True
    value, lines = parse(path, content, loader)
    top = Field(path, lines, (), value)
    if not isinstance(value, dict):
        raise top.error("a mapping (key: value)", received=NOT_SHOWN)
    if "pafot" not in value:  # checked first: nothing else can be checked in a file of a newer version
        raise top.error(f"the key 'pafot' with the version {VERSION}", received="a document without this key")
    version = top.at("pafot")
    is_whole = isinstance(version.value, int) and not isinstance(version.value, bool)
    if not is_whole or version.value != VERSION:
        fix = f"install the pytest-pafot that wrote it; this one reads version {VERSION}"
        # Without a version, this may be some other file with a secret under that key, so its value is not printed.
        raise version.error(f"the format version {VERSION}", fix, None if is_whole else "no whole number")
    return top


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
    if isinstance(kind, str) and kind in file_format.WORLDS:
        field.mapping(file_format.WORLDS[kind])
        if "limits" in fields:
            fields["limits"].mapping(file_format.LIMITS)
    return world


def _scenario(field: Field) -> Scenario:
    fields = field.mapping(file_format.SCENARIO)
    ego = fields["ego"].mapping(file_format.EGO)
    chains: Any = tuple(tuple(_gene(gene) for gene in chain.items()) for chain in fields["npcs"].items())
    try:
        return Scenario(
            npcs=chains,
            seed=fields["seed"].whole(),
            ego_lane=ego["lane"].whole(),
            ego_speed=ego["speed"].number(),
            gene_seconds=_given(fields, "gene_seconds", Field.number, DEFAULT_GENE_SECONDS),
            traffic=_given(fields, "traffic", _traffic, PAPERS),
        )
    except ScenarioError as error:
        raise _rule_broken(field, error) from None


def _traffic(field: Field) -> Traffic:
    if isinstance(field.value, str):
        return Traffic(field.choice(STYLES))
    if not isinstance(field.value, dict):
        expected = f"{_one_of(STYLES)}, or a mapping with a style and parts"
        raise field.error(expected, "write such as `everyday`, or `{style: everyday, least_gap: 4.0}`")
    fields = field.mapping(file_format.TRAFFIC)
    style = fields.pop("style").choice(STYLES)
    parts = {name: inner.number() for name, inner in fields.items()}
    try:
        return Traffic(style, **parts)
    except FieldError as error:
        raise _rule_broken(field, error) from None


def _gene(field: Field) -> Gene:
    has_lane = "lane" in field.any_mapping() and "cell" not in field.any_mapping()
    crosses = "zone" in field.any_mapping() and not field.value.keys() & {"cell", "lane"}
    kinds = file_format.LANE_INSTRUCTION, file_format.CROSSING_INSTRUCTION, file_format.POSITION_INSTRUCTION
    fields = field.mapping(kinds[0 if has_lane else 1 if crosses else 2])
    numbers = {
        name: fields[name].number(low) for name, low in (("slot", -MAX_NUMBER), ("speed", 0.0)) if name in fields
    }
    try:
        if crosses:
            gene: Gene = CrossingInstruction(
                zone=fields["zone"].text(), act=_given(fields, "act", lambda act: act.choice(ACTS), "pass"), **numbers
            )
        else:
            target: Any = fields["lane"].choice(SHIFTS) if has_lane else Cell(fields["cell"].whole(1, 8))
            gene = gene_of(target, numbers["speed"])
    except ScenarioError as error:
        raise _rule_broken(field, error) from None
    for name, unit in (("slot", "seconds"), ("speed", "m/s")):
        if name in numbers and getattr(gene, name) != numbers[name]:  # the gene has rounded the number
            raise fields[name].error(f"{unit} in steps of 0.1", f"write {getattr(gene, name)}")
    return gene


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


def _expect(field: Field, npcs: int) -> Expect:
    fields = field.mapping(file_format.EXPECT)
    outcome = Outcome(fields["outcome"].choice(_OUTCOMES))
    if outcome is Outcome.COLLISION:
        field.mapping(file_format.EXPECT_IN_ZONE if "zone" in fields else file_format.EXPECT_OF_COLLISION)
    if "mistake" in fields and ("fault" not in fields or fields["fault"].value != "entered-lane"):
        raise fields["mistake"].error("no mistake without the fault entered-lane, because other faults say it")
    return Expect(
        failure=fields["failure"].some_text("name the class of the exception, such as AssertionError"),
        assertion=_given(fields, "assertion", Field.text, ""),
        check=_given(fields, "check", _check),
        message=_given(fields, "message", Field.text, ""),
        outcome=outcome,
        time=fields["time"].number(),
        npc=_given(fields, "npc", lambda inner: inner.whole(0, npcs - 1)),
        cell=_given(fields, "cell", lambda inner: Cell(inner.whole(1, 8))),
        zone=_given(fields, "zone", lambda inner: inner.choice(ZONES)),
        side=_given(fields, "side", lambda inner: inner.choice(get_args(Side))),
        situation=_given(fields, "situation", lambda inner: _situation(inner, npcs)),
        responsibility=fields["responsibility"].choice(get_args(Responsibility)),
        fault=_given(fields, "fault", lambda inner: inner.choice(get_args(Fault))),
        mistake=_given(fields, "mistake", lambda inner: inner.choice(LANE_CHANGES)),
        npc_manoeuvre=_given(fields, "npc_manoeuvre", lambda inner: inner.choice(get_args(Manoeuvre))),
        ego_manoeuvre=_given(fields, "ego_manoeuvre", lambda inner: inner.choice(get_args(Manoeuvre))),
        reference_drivers={
            name: inner.choice(get_args(ReferenceOutcome))
            for name, inner in _given(fields, "reference_drivers", Field.any_mapping, {}).items()
        },
        last_chance=_given(fields, "last_chance", _last_chance),
        avoided_by=_given(fields, "avoided_by", _avoidance),
        escaped_by=_given(fields, "escaped_by", _escape),
        against=_given(fields, "against", Field.text, ""),
        traceback=_given(fields, "traceback", Field.text, ""),
    )


def _xfail(field: Field) -> tuple[str, date | None]:
    """Return why the failure is accepted, and the last day on which it is accepted; None for no last day."""
    fix = 'write the reason in quotes, as in xfail: "issue 12" or xfail: {reason: "issue 12", until: 2027-01-31}'
    if not isinstance(field.value, dict):
        return field.some_text(fix), None
    fields = field.mapping(file_format.XFAIL)
    return fields["reason"].some_text(fix), _given(fields, "until", Field.day)


def _check(field: Field) -> Bounded:
    fields = field.mapping(file_format.CHECK)
    value, at_most, at_least = (
        _given(fields, name, lambda inner: inner.number(-MAX_NUMBER)) for name in ("value", "at_most", "at_least")
    )
    return Bounded(value=value, at_most=at_most, at_least=at_least, unit=_given(fields, "unit", Field.text, ""))


def _situation(field: Field, npcs: int) -> Situation | ZoneSituation:
    if "npc_enters" in field.any_mapping():
        fields = field.mapping(file_format.ZONE_SITUATION)
        return ZoneSituation(
            npc=fields["npc"].whole(0, npcs - 1),
            time=fields["time"].number(),
            npc_enters=fields["npc_enters"].number(-MAX_NUMBER),
            ego_enters=fields["ego_enters"].number(-MAX_NUMBER),
            ego_speed=fields["ego_speed"].number(-MAX_NUMBER),
            npc_speed=fields["npc_speed"].number(-MAX_NUMBER),
        )
    fields = field.mapping(file_format.SITUATION)
    return Situation(
        npc=fields["npc"].whole(0, npcs - 1),
        time=fields["time"].number(),
        ahead=fields["ahead"].number(-MAX_NUMBER),
        lane=fields["lane"].whole(-int(MAX_NUMBER), int(MAX_NUMBER)),
        ego_speed=fields["ego_speed"].number(-MAX_NUMBER),
        npc_speed=fields["npc_speed"].number(-MAX_NUMBER),
    )


def _last_chance(field: Field) -> LastChance:
    fields = field.mapping(file_format.LAST_CHANCE)
    return LastChance(
        time=fields["time"].number(),
        driver=fields["driver"].text(),
        action=_action(fields["action"]),
        ego_action=_action(fields["ego_action"]),
    )


def _avoidance(field: Field) -> Avoidance:
    fields = field.mapping(file_format.AVOIDANCE)
    return Avoidance(time=fields["time"].number(), braking=fields["braking"].number())


def _escape(field: Field) -> Escape:
    fields = field.mapping(file_format.ESCAPE)
    numbers = {name: inner.number() for name, inner in fields.items() if name != "driver"}
    return Escape(driver=fields["driver"].text(), **numbers)


def _action(field: Field) -> tuple[float, float]:
    values = field.items()
    if len(values) != 2:
        raise field.error("acceleration [m/s^2] and steering [rad]")
    return values[0].number(-1e9), values[1].number(-1e9)


def _found(field: Field) -> Found:
    fields = field.mapping(file_format.FOUND)
    return Found(
        seed=fields["seed"].whole(),
        generation=fields["generation"].whole(),
        algorithm=fields["algorithm"].text(),
        versions={name: version.text() for name, version in fields["versions"].any_mapping().items()},
        weights=_given(fields, "weights", Field.text, ""),
    )


def _perceived(field: Field) -> Perceived:
    fields = field.mapping(file_format.PERCEPTION)
    try:
        sight = Sight(**{name: inner.value for name, inner in fields.items() if name != "needed"})
    except FieldError as error:
        raise _rule_broken(field, error) from None
    needed = _given(fields, "needed", lambda inner: tuple(name.choice(sight.imperfections) for name in inner.items()))
    return Perceived(sight=sight, needed=needed)


def _shrunk(field: Field, scenario: Scenario) -> Shrunk:
    fields = field.mapping(file_format.SHRUNK)
    speeds = []
    for entry in fields["speeds"].items():
        interval = entry.mapping(file_format.SPEEDS)
        npc, low = interval["npc"].whole(0, len(scenario.npcs) - 1), interval["low"].number()
        gene, high = interval["gene"].whole(0, len(scenario.npcs[npc]) - 1), interval["high"].number()
        if low > high:
            raise interval["high"].error(f"at least the low end, {low:g}", "restore the file from version control")
        speeds.append(SpeedInterval(npc=npc, gene=gene, low=low, high=high))
    return Shrunk(rollouts=fields["rollouts"].whole(), is_minimal=fields["is_minimal"].truth(), speeds=tuple(speeds))
