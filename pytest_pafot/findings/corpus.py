"""The files of the corpus: one finding each, checked strictly when read, never half written.

The format is in docs/reference; :mod:`pytest_pafot.findings.emit` writes it and this module reads it.
"""

from __future__ import annotations

import contextlib
import difflib
import os
import re
import secrets
import stat
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from pytest_pafot.findings.document import MAX_BYTES, Document, DocumentError, Place, decoded, parse
from pytest_pafot.findings.emit import DEFAULT_GENE_SECONDS, VERSION, text_of
from pytest_pafot.findings.finding import Expect, Finding, Found, check_plain, is_id
from pytest_pafot.findings.names import CORPUS, folder_of, safe_name
from pytest_pafot.findings.responsibility import Responsibility
from pytest_pafot.grid import Cell
from pytest_pafot.scenario import PositionInstruction, Scenario, ScenarioError
from pytest_pafot.trace import Outcome, Side

__all__ = [
    "CORPUS",
    "SUFFIX",
    "CorpusError",
    "CorpusWriteError",
    "folder_of",
    "free_path",
    "list_files",
    "parsed",
    "read",
    "rewrite",
    "safe_name",
    "save",
    "write",
]

SUFFIX = ".pafot.yaml"
STALE_SECONDS = 600.0
"""A temporary file this much older than a new one was left behind by a process that was killed."""

_RULE = re.compile(r"(?:(?P<field>[a-z_]+(?:\[\d+\])*): )?expected (?P<expected>.*?), received (?P<received>.*)", re.S)
_SCENARIO_FIELDS = {"seed": ("seed",), "ego_lane": ("ego", "lane"), "ego_speed": ("ego", "speed")}
_OUTCOMES = tuple(str(outcome) for outcome in Outcome if outcome is not Outcome.INVALID)
_RESTORE = "restore the file from version control, or delete it"


class CorpusError(ValueError):
    """A file of the corpus that cannot be used.

    Attributes:
        path: of the file.
        line: counted from 1, or None where the fault has no line.
        field: such as ``scenario.npcs[0][3].cell``; empty where the fault has no field.
        expected, received, fix: what should be there, what is, and the way out.
    """

    def __init__(
        self, path: Path, *, line: int | None, field: str, expected: str, received: str, fix: str = _RESTORE
    ) -> None:
        place = f"{path}:{line}" if line is not None else f"{path}"
        name = f"{field}: " if field else ""
        super().__init__(f"{place}: {name}expected {expected}, received {received}; {fix}")
        self.path, self.line, self.field = path, line, field
        self.expected, self.received, self.fix = expected, received, fix


class CorpusWriteError(RuntimeError):
    """A finding that could not be written; nothing half written is left.

    Attributes:
        path: of the file that was to be written.
    """

    def __init__(self, path: Path, reason: str, fix: str) -> None:
        super().__init__(f"{path}: expected to write a finding, received: {reason}; {fix}")
        self.path = path


def read(path: Path) -> Finding:
    """The finding in a file; its id is the file's name.

    Raises:
        CorpusError: on any fault, with the place and the way out.
    """
    path = Path(path)
    return parsed(path, _content(path))


def parsed(path: Path, content: bytes, loader: type[Any] | None = None) -> Finding:
    """The finding in the content of a file; see :func:`read`. ``loader`` is for :func:`document.parse`."""
    try:
        document = parse(decoded(content), loader)
    except DocumentError as error:
        raise CorpusError(
            path, line=error.line, field="", expected=error.expected, received=error.received, fix=error.fix
        ) from None
    return _finding(path, _Field(path, document, (), document.value))


def write(path: Path, finding: Finding) -> bool:
    """Write a new file, all at once.

    Returns:
        whether it was written: False when the file is there already, as when another process was first.

    Raises:
        CorpusWriteError: when it cannot be written.
    """
    return _through_temporary(Path(path), finding, _publish)


def rewrite(path: Path, finding: Finding) -> Finding:
    """Replace a file's content, all at once; its name stays, and so does a reason for ``xfail`` that it has.

    A file that has gone is written anew; one that cannot be read is not overwritten.

    Returns:
        the finding as written.

    Raises:
        CorpusWriteError: when it cannot be written.
    """
    path = Path(path)
    kept = finding
    if finding.xfail is None and os.path.lexists(path):
        try:
            kept = replace(finding, xfail=read(path).xfail)
        except CorpusError as error:
            raise CorpusWriteError(path, f"a file that cannot be read ({error})", "correct or delete it") from error
    _through_temporary(path, kept, _replace)
    return kept


def free_path(folder: Path, finding: Finding) -> tuple[Path, Finding]:
    """The path for a new finding, and the finding under the id that this gives it.

    The id is the finding's own, with ``-2``, ``-3`` ... appended while a file of that name holds another scenario
    or another failure: a file that was rewritten keeps its name, and what was first found under it can come back.
    A file that holds this very finding is no obstacle; :func:`write` then leaves it alone.
    """
    number = 1
    while True:
        name = finding.id if number == 1 else f"{finding.id}-{number}"
        path = Path(folder) / f"{name}{SUFFIX}"
        if not os.path.lexists(path) or _holds(path, finding):
            return path, replace(finding, id=name)
        number += 1


def save(folder: Path, finding: Finding) -> tuple[Path, Finding]:
    """Keep a new finding, whoever else is writing into the folder; under a free id if its own is taken.

    Returns:
        the file, which this call or another process wrote, and the finding under the id of the file.

    Raises:
        CorpusWriteError: when it cannot be written.
    """
    while True:
        path, named = free_path(folder, finding)
        if write(path, named) or _holds(path, finding):
            return path, named


def list_files(folder: Path) -> list[Path]:
    """The corpus files in a folder, sorted by name; none when there is no such folder.

    Raises:
        CorpusError: when the folder cannot be listed.
    """
    folder = Path(folder)
    try:
        return sorted(path for path in folder.iterdir() if path.name.endswith(SUFFIX))
    except FileNotFoundError:
        return []
    except OSError as error:
        received = error.strerror or str(error)
        fix = "make it a readable folder"
        raise CorpusError(folder, line=None, field="", expected="a folder", received=received, fix=fix) from error


def _content(path: Path) -> bytes:
    try:
        status = path.stat()
        if stat.S_ISREG(status.st_mode):
            with path.open("rb") as file:
                return file.read(MAX_BYTES + 1)
        received = "a folder" if stat.S_ISDIR(status.st_mode) else "something else"
    except OSError as error:
        received = error.strerror or str(error)
    raise CorpusError(path, line=None, field="", expected="a file that can be read", received=received)


def _holds(path: Path, finding: Finding) -> bool:
    try:
        saved = read(path)
    except CorpusError:
        return False
    return saved.scenario == finding.scenario and saved.signature == finding.signature


@dataclass(frozen=True, slots=True)
class _Field:
    """A value of a document with its place; every accessor checks the type or raises the error of that place."""

    path: Path
    document: Document
    place: Place
    value: Any

    @property
    def name(self) -> str:
        return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self.place).lstrip(".")

    def error(self, expected: str, fix: str, received: str | None = None) -> CorpusError:
        known = next(place for end in range(len(self.place), -1, -1) if (place := self.place[:end]) in self.lines)
        return CorpusError(
            self.path,
            line=self.lines[known],
            field=self.name,
            expected=expected,
            received=received or f"{self.value!r:.80}",
            fix=fix,
        )

    @property
    def lines(self) -> dict[Place, int]:
        return self.document.lines

    def at(self, *inner: str | int) -> _Field:
        value = self.value
        for part in inner:
            value = value[part]
        return _Field(self.path, self.document, (*self.place, *inner), value)

    def mapping(self, required: Collection[str], optional: Collection[str] = ()) -> dict[str, _Field]:
        fields = self.any_mapping()
        for key in fields:
            if key not in required and key not in optional:
                raise fields[key].error(_one_of([*required, *optional]), _guess(key, [*required, *optional]), repr(key))
        for key in required:
            if key not in fields:
                received = f"only {', '.join(fields)}" if fields else "nothing"
                raise self.error(f"the key '{key}'", "add it, or restore the file from version control", received)
        return fields

    def any_mapping(self) -> dict[str, _Field]:
        if not isinstance(self.value, dict):
            raise self.error("a mapping (key: value)", _RESTORE)
        return {key: self.at(key) for key in self.value}

    def items(self) -> list[_Field]:
        if not isinstance(self.value, list):
            raise self.error("a list", _RESTORE)
        return [self.at(index) for index in range(len(self.value))]

    def text(self) -> str:
        if not isinstance(self.value, str):
            raise self.error("text", "put it in quotes")
        return self.value

    def some_text(self, fix: str) -> str:
        if not isinstance(self.value, str) or not self.value.strip():
            raise self.error("some text", fix)
        return self.value

    def choice(self, options: Collection[str]) -> Any:
        if not isinstance(self.value, str) or self.value not in options:
            raise self.error(_one_of(options), _guess(str(self.value), options))
        return self.value

    def whole(self, low: int = 0, high: int | None = None) -> int:
        is_whole = isinstance(self.value, int) and not isinstance(self.value, bool)
        if not is_whole or self.value < low or (high is not None and self.value > high):
            top = "" if high is None else f" to {high}"
            raise self.error(f"a whole number from {low}{top}", "correct it")
        return int(self.value)

    def number(self) -> float:
        is_number = isinstance(self.value, (int, float)) and not isinstance(self.value, bool)
        if not is_number or not 0 <= self.value <= 1e9:
            raise self.error("a finite number, at least 0", "correct it")
        return float(self.value)


def _finding(path: Path, top: _Field) -> Finding:
    name = path.name.removesuffix(SUFFIX)
    if not path.name.endswith(SUFFIX) or not is_id(name):
        expected = f"a name of letters, digits, '.', '_' and '-' before {SUFFIX}"
        raise CorpusError(path, line=None, field="", expected=expected, received=path.name, fix="rename the file")
    _check_version(top)
    fields = top.mapping(("pafot", "test", "world", "scenario", "expect", "found"), ("xfail",))
    scenario = _scenario(fields["scenario"])
    return Finding(
        id=name,
        test=fields["test"].some_text("name the test's node id, such as tests/test_safety.py::test_it"),
        world=_world(fields["world"]),
        scenario=scenario,
        expect=_expect(fields["expect"], len(scenario.npcs)),
        found=_found(fields["found"]),
        xfail=fields["xfail"].some_text('write the reason in quotes, as in xfail: "issue 12"')
        if "xfail" in fields
        else None,
    )


def _check_version(top: _Field) -> None:
    """The version comes first: of a newer one, nothing else can be judged."""
    fields = top.any_mapping()
    if "pafot" not in fields:
        raise top.error(f"the key 'pafot' with the version {VERSION}", _RESTORE, "a document without it")
    version = fields["pafot"]
    if isinstance(version.value, bool) or version.value != VERSION or not isinstance(version.value, int):
        fix = f"install the pytest-pafot that wrote it; this one reads version {VERSION}"
        raise version.error(f"the format version {VERSION}", fix)


def _world(field: _Field) -> dict[str, Any]:
    world = {key: inner.value for key, inner in field.any_mapping().items()}
    for key, value in world.items():
        try:
            check_plain(field.at(key).name, value)
            check_plain(field.name, {key: None})
        except ValueError as error:
            raise field.at(key).error("plain data", "correct it", str(error)) from None
    return world


def _scenario(field: _Field) -> Scenario:
    fields = field.mapping(("seed", "ego", "npcs"), ("gene_seconds",))
    ego = fields["ego"].mapping(("lane", "speed"))
    chains = tuple(tuple(_gene(gene) for gene in chain.items()) for chain in fields["npcs"].items())
    try:
        return Scenario(
            npcs=chains,
            seed=fields["seed"].whole(),
            ego_lane=ego["lane"].whole(),
            ego_speed=ego["speed"].number(),
            gene_seconds=fields["gene_seconds"].number() if "gene_seconds" in fields else DEFAULT_GENE_SECONDS,
        )
    except ScenarioError as error:
        raise _rule_broken(field, error) from None


def _gene(field: _Field) -> PositionInstruction:
    fields = field.mapping(("cell", "speed"))
    cell = Cell(fields["cell"].whole(1, 8))
    try:
        return PositionInstruction(cell, fields["speed"].number())
    except ScenarioError as error:
        raise _rule_broken(field, error) from None


def _rule_broken(field: _Field, error: ScenarioError) -> CorpusError:
    """A scenario's own error, at the place in the file that it is about."""
    rule = _RULE.fullmatch(str(error))
    if rule is None:
        return field.error("a valid scenario", "correct it", str(error))
    name = rule["field"] or ""
    key = name.partition("[")[0]
    inner: tuple[str | int, ...] = _SCENARIO_FIELDS.get(key, (key,) if key else ())
    inner += tuple(int(index) for index in re.findall(r"\[(\d+)\]", name))
    if key == "npcs" and len(inner) == 3:
        inner += ("cell",)
    received, _, hint = rule["received"].partition("; ")
    fix = hint if hint and "Scenario.repaired" not in hint else "correct it, or delete the file"
    return field.at(*inner).error(rule["expected"], fix, received)


def _expect(field: _Field, npcs: int) -> Expect:
    required = ("failure", "outcome", "time", "responsibility")
    optional = ("assertion", "message", "npc", "cell", "side", "preventable_by", "traceback")
    fields = field.mapping(required, optional)
    outcome = Outcome(fields["outcome"].choice(_OUTCOMES))
    if outcome is Outcome.COLLISION:
        field.mapping((*required, "npc", "cell", "side"), optional)

    def given(key: str, get: Callable[[_Field], Any], default: Any = None) -> Any:
        return get(fields[key]) if key in fields else default

    return Expect(
        failure=fields["failure"].text(),
        assertion=given("assertion", _Field.text, ""),
        message=given("message", _Field.text, ""),
        outcome=outcome,
        time=fields["time"].number(),
        npc=given("npc", lambda inner: inner.whole(0, npcs - 1)),
        cell=given("cell", lambda inner: Cell(inner.whole(1, 8))),
        side=given("side", lambda inner: inner.choice(get_args(Side))),
        responsibility=fields["responsibility"].choice(get_args(Responsibility)),
        preventable_by=given("preventable_by", lambda inner: tuple(name.text() for name in inner.items()), ()),
        traceback=given("traceback", _Field.text, ""),
    )


def _found(field: _Field) -> Found:
    fields = field.mapping(("seed", "generation", "algorithm", "versions"))
    return Found(
        seed=fields["seed"].whole(),
        generation=fields["generation"].whole(),
        algorithm=fields["algorithm"].text(),
        versions={name: version.text() for name, version in fields["versions"].any_mapping().items()},
    )


def _one_of(options: Collection[str]) -> str:
    return f"one of {', '.join(options)}"


def _guess(word: str, options: Collection[str]) -> str:
    close = difflib.get_close_matches(word, list(options), n=1)
    return f"did you mean {close[0]!r}?" if close else "correct or remove it"


def _through_temporary(path: Path, finding: Finding, finish: Callable[[Path, Path], bool]) -> bool:
    content = text_of(finding).encode()
    if len(content) > MAX_BYTES:
        reason = f"{len(content) // 1024} KiB, more than the {MAX_BYTES // 1024} KiB that are read back"
        raise CorpusWriteError(path, reason, "use fewer or shorter chains")
    temporary = path.parent / f".pafot-{secrets.token_hex(8)}.tmp"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            _sweep(path.parent, newest=_write_through(temporary, content))
            return finish(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        fix = "make the folder writable, or choose another one with --pafot-corpus"
        raise CorpusWriteError(path, error.strerror or str(error), fix) from error


def _write_through(temporary: Path, content: bytes) -> float:
    """Write a file down to the disk; its time of modification [s]."""
    with temporary.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
        return os.fstat(file.fileno()).st_mtime


def _sweep(folder: Path, newest: float) -> None:
    """Remove the temporary files of processes that were killed, by the clock of the file system itself."""
    for other in folder.glob(".pafot-*.tmp"):
        with contextlib.suppress(OSError):  # what cannot be removed does no harm: its name is no corpus file's
            if newest - other.stat().st_mtime > STALE_SECONDS:
                other.unlink()


def _publish(temporary: Path, path: Path) -> bool:
    """Give a new file its name unless that is taken; the system decides between two who try at once."""
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        return False
    except (OSError, NotImplementedError):
        return _rename_if_free(temporary, path)
    return True


def _rename_if_free(temporary: Path, path: Path) -> bool:
    """Without hard links. Windows refuses to rename onto a file; elsewhere the later of two equal files stays."""
    if os.path.lexists(path):
        return False
    try:
        temporary.rename(path)
    except FileExistsError:
        return False
    return True


def _replace(temporary: Path, path: Path) -> bool:
    temporary.replace(path)
    return True
