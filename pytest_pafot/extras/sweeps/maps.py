"""Sweeps: one scenario over a grid of two of its numbers, and what becomes of it at each point."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, Literal, get_args

from pytest_pafot import Highway, Outcome, Run, SavedScenario, Scenario, ScenarioError, SimulatorWorld, Trace, load
from pytest_pafot.extending import (
    SUFFIX,
    AdsFactory,
    Finding,
    ProcessLostError,
    Verdict,
    WorldData,
    base_world,
    chosen_world,
    driving,
    judged_with_drivers,
    refusals,
    require,
)
from pytest_pafot.extras.sweeps.entries import Entry, entry_of, fits
from pytest_pafot.extras.sweeps.numbers import Axis, unit_of, values_of, with_number, words_of
from pytest_pafot.support.errors import RequestError, check_asserts
from pytest_pafot.support.files import open_regular, write_whole
from pytest_pafot.support.references import described, factory_named
from pytest_pafot.support.text import ascii_text, csv_text, plural, spreadsheet_cell, visible, wrapped_to

Kind = Literal["avoided", "preventable", "unavoidable", "ADS error", "not as asked"]
"""What became of a point: ``avoided``; ``preventable``, it failed though a reference driver avoids it; ``unavoidable``,
it failed and no reference driver avoids it; ``ADS error``, the policy raised, took too long or gave no valid action;
``not as asked``, the situation did not come up as it was asked for."""

KINDS: tuple[Kind, ...] = get_args(Kind)
MARKS: dict[Kind, str] = dict(zip(KINDS, ".X#E?", strict=True))
"""The characters of points in a terminal."""
MEANINGS: dict[Kind, str] = {
    "avoided": "avoided",
    "preventable": "failed though a reference driver avoids it",
    "unavoidable": "unavoidable",
    "ADS error": "ended by an error of the ADS",
    "not as asked": "not as asked",
}
UNDRIVABLE = "cannot be driven: "
"""The beginning of the words on a point for which the world has no such scenario."""
WIDTH = 100
"""The width of a map, unless it goes to a terminal [columns]."""
TOLD: tuple[Kind, ...] = ("avoided", "preventable", "ADS error")
"""The kinds of points that say something about the policy."""
MOST_BYTES = 10_000_000
"""The largest file of a saved map."""
FIXED = ("scenario", "result", "words")
"""The columns of a saved map beside those of its axes."""

Index = tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """A point of a map.

    Attributes:
        at: the values of the axes there.
        kind: what became of it.
        words: what happened, in a line.
        avoided_by: a reference driver that avoids what the policy failed; empty if there is none.
        trace: the run; None if there is none.
    """

    at: tuple[float, ...]
    kind: Kind
    words: str
    avoided_by: str = ""
    trace: Trace | None = field(default=None, compare=False, repr=False)

    @property
    def fails(self) -> bool:
        """True if the policy failed."""
        return self.kind in ("preventable", "unavoidable", "ADS error")

    @property
    def ego_off(self) -> float:
        """By how much the ego was faster than asked as the first manoeuvre by distance began [m/s]; 0 if none did."""
        met = () if self.trace is None else Run(self.trace).asked
        return next((each.was - each.asked for each in met if each.what == "ego speed"), 0.0)

    @property
    def mark(self) -> str:
        """The character that stands for the kind."""
        return MARKS[self.kind]


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A point whose answer differs from that of an earlier map.

    Attributes:
        at: the values of the axes.
        before, now: what became of it.
    """

    at: tuple[float, ...]
    before: Kind
    now: Kind

    @property
    def is_worse(self) -> bool:
        """True if it was avoided before, and is not now."""
        return self.before == "avoided"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Sweep:
    """A map: what becomes of a scenario for each pair of values of two of its numbers.

    Attributes:
        name: the catalogue entry or the finding that was swept.
        axes: one or two axes.
        points: all points; the last axis changes fastest.
        changes: the points whose answer differs from that of the map given as ``against``.
        remarks: values outside of the ranges of an entry, in sentences.
        about: what happens in an entry, in a sentence; empty for a finding.
    """

    name: str
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]
    changes: tuple[Change, ...] = ()
    remarks: tuple[str, ...] = ()
    about: str = ""

    def count(self, kind: Kind) -> int:
        """Return the number of points of a kind."""
        return sum(point.kind == kind for point in self.points)

    @property
    def preventable(self) -> int:
        """The number of points that fail though a reference driver avoids them."""
        return self.count("preventable")

    @property
    def errors(self) -> int:
        """The number of points at which the policy raised, took too long or gave no valid action."""
        return self.count("ADS error")

    @property
    def not_as_asked(self) -> int:
        """The number of points at which the situation did not come up as asked."""
        return self.count("not as asked")

    @property
    def worse(self) -> tuple[Change, ...]:
        """The changes for the worse: avoided before, and now failed, or no longer as asked."""
        return tuple(change for change in self.changes if change.is_worse)

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of values on each axis."""
        return tuple(len(axis.values) for axis in self.axes)

    def point(self, *index: int) -> Point:
        """Return the point with these indices of the values of each axis."""
        flat = 0
        for size, each in zip(self.shape, index, strict=True):
            flat = flat * size + each
        return self.points[flat]

    def where(self, at: Sequence[float]) -> str:
        """Return a place on the map in words: ``gap 20 m, relative_speed -5.6 m/s``."""
        pairs = zip(self.axes, at, strict=True)
        return ", ".join(f"{axis.name} {short(value)} {axis.unit}".rstrip() for axis, value in pairs)

    @property
    def islands(self) -> tuple[str, ...]:
        """Groups of neighbouring points with one answer that lie between points with the other, each in a sentence.

        Where one of the two sides is harder, either a harder situation was avoided and an easier one failed, or the
        other way round; so :data:`TWO_SIDED` numbers are left out. A group that reaches from one end of an axis to the
        other is a limit and no island. Points that are unavoidable or were not as asked say nothing about the policy.
        """
        odd: dict[Index, tuple[Point, Point]] = {}
        for axis, size in enumerate(self.shape):
            if self.axes[axis].name.rpartition(".")[2] in TWO_SIDED:
                continue
            for first in product(*(range(1 if each == axis else other) for each, other in enumerate(self.shape))):
                self._find_between(odd, [(*first[:axis], each, *first[axis + 1 :]) for each in range(size)])
        sentences = []
        told = [index for index in product(*map(range, self.shape)) if self.point(*index).kind in TOLD]
        for group in _groups(told, lambda index: self.point(*index).fails):
            reaches = [{index[axis] for index in group} >= {0, size - 1} for axis, size in enumerate(self.shape)]
            if any(reaches) or not odd.keys() >= set(group):
                continue
            here, (low, high) = self.point(*group[0]), odd[group[0]]
            does = ("fails", "pass") if here.fails else ("passes", "fail")
            more = "" if len(group) == 1 else f" (and {plural(len(group) - 1, 'point')} beside it)"
            between = f"although {self.where(low.at)} and {self.where(high.at)} {does[1]}"
            sentences.append(f"{self.where(here.at)} {does[0]}{more}, {between}")
        return tuple(sentences)

    def _find_between(self, odd: dict[Index, tuple[Point, Point]], line: Sequence[Index]) -> None:
        """Add the points of a line that lie between two with another answer, each with these two."""
        runs: list[list[Index]] = []  # neighbouring points with the same answer, since the last unavoidable one
        for index in (*line, None):
            point = None if index is None else self.point(*index)
            if point is None or point.kind == "unavoidable":  # what is behind it is another kind of situation
                for before, run, after in zip(runs, runs[1:], runs[2:], strict=False):
                    for each in run:
                        odd.setdefault(each, (self.point(*before[-1]), self.point(*after[0])))
                runs = []
            elif index is not None and point.kind in TOLD:
                if not runs or self.point(*runs[-1][0]).fails != point.fails:
                    runs.append([])
                runs[-1].append(index)

    @property
    def headline(self) -> str:
        """The counts of all kinds in a line."""
        counts = Counter(point.kind for point in self.points)
        told = [f"{counts[kind]} {MEANINGS[kind]}" for kind in KINDS if counts[kind] or kind != "ADS error"]
        return f"{plural(len(self.points), 'point')}: {', '.join(told)}"

    @property
    def notes(self) -> tuple[str, ...]:
        """All else there is to say: on single points, on islands, and on what has changed."""
        return (*self._on_points(), *self.on_islands(), *self.remarks, *self._on_changes())

    def _on_points(self) -> Iterator[str]:
        odd = [point for point in self.points if point.kind == "not as asked"]
        undriven = [point for point in odd if point.trace is None]
        for kind, some in (
            ("ADS error", [point for point in self.points if point.kind == "ADS error"]),
            ("not as asked", [point for point in odd if point.trace is not None]),
            (f"{len(undriven)} of the points not as asked cannot be driven", undriven),
        ):
            if some:
                yield f"{kind}, such as {self.where(some[0].at)}: {some[0].words.removeprefix(UNDRIVABLE)}"
        if self.not_as_asked == len(self.points):
            yield "no point came up as asked, so this map says nothing about the policy"
        off = [each for each in (abs(point.ego_off) for point in self.points) if each > EGO_OFF]
        if off:
            yield (
                f"at {len(off)} of {plural(len(self.points), 'point')} the ego was up to {max(off):.1f} m/s off the "
                "speed asked for when a manoeuvre began; give the policy this speed as the one that it keeps"
            )
        failed = [point for point in odd if point.avoided_by]
        if failed:
            yield (
                f"{len(failed)} of the points not as asked ended in a failure that a reference driver avoids, such as "
                f"{self.where(failed[0].at)}"
            )

    def on_islands(self) -> Iterator[str]:
        """Yield the islands, in sentences."""
        islands = self.islands
        yield from (f"island: {sentence}" for sentence in islands[:MOST_NAMED])
        if len(islands) > MOST_NAMED:
            yield f"island: and {len(islands) - MOST_NAMED} more"

    def _on_changes(self) -> Iterator[str]:
        if self.changes:
            yield f"changed: {plural(len(self.changes), 'point')}, {len(self.worse)} for the worse"
        better = [change for change in self.changes if not change.is_worse]
        for change in [*self.worse, *better][:MOST_NAMED]:
            kinds = f"from {MEANINGS[change.before]} to {MEANINGS[change.now]}"
            yield f"{'worse' if change.is_worse else 'changed'}: {self.where(change.at)}, {kinds}"

    @property
    def legend(self) -> dict[Kind, str]:
        """The meanings of the kinds that occur."""
        used = {point.kind for point in self.points}
        return {kind: MEANINGS[kind] for kind in KINDS if kind in used}

    def explain(self, width: int = WIDTH) -> str:
        """Return the map as lines of ASCII: a column for each value of the last axis, a row for each of another."""
        *rows, columns = self.axes
        labels = [short(value) for value in columns.values]
        heads = [short(value) for value in rows[0].values] if rows else [""]
        axes = f"{rows[0].title} up, {columns.title} across" if rows else columns.title
        longest = max(map(len, labels)) + 1
        head = max(map(len, heads))
        cell = next((each for each in (longest, 2) if head + 1 + each * len(labels) <= width), 1)
        head, every = max(head, len(labels[0]) - cell - 1), -(-longest // cell)
        scale = ""
        for column in [*range(0, len(labels) - every, every), len(labels) - 1]:  # each ends above its column
            scale += labels[column].rjust(head + 1 + cell * (column + 1) - len(scale))
        lines = [*wrapped_to(self.name, width), *wrapped_to(self.headline, width), "", *wrapped_to(axes, width), scale]
        for row, name in reversed([*enumerate(heads)]):  # as in a picture, larger values are above
            points = [self.point(row, column) if rows else self.point(column) for column in range(len(labels))]
            lines.append(f"{name.rjust(head)} {''.join(point.mark.rjust(cell) for point in points)}")
        kinds = [f"{MARKS[kind]} {meaning}" for kind, meaning in self.legend.items()]
        legend = ["  ".join(kinds)]
        notes = [*(legend if len(legend[0]) <= width else kinds), *self.notes]
        told = [part for note in notes for part in wrapped_to(note, width)]
        return "\n".join(ascii_text(line).rstrip() for line in [*lines, "", *told])

    def __repr__(self) -> str:
        return f"<Sweep {self.name}, {self.headline}>"

    def __str__(self) -> str:
        return self.explain()

    def _repr_html_(self) -> str:
        html: str = import_module("pytest_pafot.extras.sweeps.drawing").frame(self)  # that module imports this one
        return html

    def csv(self) -> str:
        """Return the map as CSV: a row for each point, with the columns of the axes first."""
        names = [axis.name for axis in self.axes]
        rows = [
            [
                *(short(value) for value in point.at),
                spreadsheet_cell(self.name),
                point.kind,
                spreadsheet_cell(point.words),
            ]
            for point in self.points
        ]
        return csv_text([*names, *FIXED], rows)

    def save(self, path: str | Path) -> None:
        """Write the map as CSV, as a whole or not at all; ``against=`` reads it."""
        write_whole(Path(path), self.csv())


TWO_SIDED = ("slot", "side", "offset", "beside")
"""Numbers that are not harder in one direction, so that what lies between two of their values is no island."""
EGO_OFF = 0.3
"""The difference of the ego's speed to the one asked for [m/s] from which a map tells of it."""
MOST_NAMED = 6
"""The largest number of islands, and of changes, that are named."""


def sweep(
    what: str | Path | Finding | Scenario,
    ads: AdsFactory | str,
    *,
    over: Mapping[str, object],
    world: Any = None,
    holds: Callable[[Run], Any] | None = None,
    against: str | Path | Sweep | None = None,
    on_point: Callable[[int], None] | None = None,
    on_stop: Callable[[str], str] | None = None,
    **values: float,
) -> Sweep:
    """Drive a scenario for all values of one or two of its numbers, and return the map.

    Args:
        what: the name of a catalogue entry, a saved finding or its file, or a scenario.
        ads: the factory of the policy, or its ``module:factory[:argument]``.
        over: for each axis the name of a number, and its values: numbers, or ``"first:last:count"``. A number is a
            parameter of the entry, or is named by its place in the scenario: ``ego.speed``, ``npcs.0.0.speed`` for an
            instruction, ``npcs.0.steps.1.gap`` for a step of a manoeuvre.
        world: the world, or its name, such as ``"module:factory"``; by default that of the finding, or a highway.
        holds: the property, a function of a run that asserts; by default that there is no collision and the ego stays
            on the road.
        against: an earlier map, or the file that :meth:`Sweep.save` wrote.
        on_point: is called with the number of points driven so far.
        on_stop: is called with the points driven so far, as the text of a saved map, if Ctrl-C ends the map; the text
            that it returns is added to the interruption as a note.
        values: other parameters of the entry.

    Raises:
        RequestError: if an argument is wrong, the world has no reference drivers, or assertions are off for ``holds``.
    """
    if holds is not None:
        check_asserts(holds)
    if isinstance(world, str):
        world = chosen_world(world, place="world")
    if world is not None and not hasattr(world, "rollout"):
        raise RequestError(f"world: expected a world such as pafot.Highway(...), received {world!r:.80}")
    name, make = _source(what, world, values)
    if not isinstance(over, Mapping) or not 1 <= len(over) <= 2 or not all(isinstance(each, str) for each in over):
        raise RequestError(f"over: expected one or two axes, such as {{'gap': '0:60:7'}}, received {over!r:.80}")
    if against is not None and not isinstance(against, str | Path | Sweep):
        raise RequestError(f"against: expected a map or the file of one, received {against!r:.80}")
    axes = tuple(Axis(each, values_of(each, given), make.unit(each), make.about(each)) for each, given in over.items())
    twice = [each for each in over if each in values]
    if twice:
        raise RequestError(f"{twice[0]}: expected an axis or a value, received both")
    # A map names what is not the default, so that only maps of the same are compared.
    name += "" if world is None else f" in {_in_words(world)}"
    name += "" if holds is None else f", {getattr(holds, '__name__', type(holds).__name__)}"
    before = {} if against is None else _before(name, axes, against)  # before anything is driven
    factory = named_factory(ads)
    if not base_world(make.world).reference_drivers:
        raise RequestError(
            "sweep: expected a world with reference drivers, which tell what can be avoided, received "
            f"{make.world!r:.100}, which has none; write reference_drivers and rollout_reference(scenario, name)"
        )
    remarks = make.check(axes)
    with driving(make.world, factory) as drive:
        driver = _Driver(make, axes, holds or stays_safe, on_point, drive)
        try:
            for at in product(*(axis.values for axis in axes)):
                driver.drive(at)
        except KeyboardInterrupt as interrupt:
            if on_stop is not None:
                interrupt.add_note(on_stop(Sweep(name=name, axes=axes, points=tuple(driver.points)).csv()))
            raise
    found = tuple(driver.points)
    pairs = [(point, before[_key(point.at)]) for point in found] if before else []
    changes = tuple(Change(at=point.at, before=kind, now=point.kind) for point, kind in pairs if point.kind != kind)
    return Sweep(name=name, axes=axes, points=found, changes=changes, remarks=remarks, about=make.described)


def named_factory(ads: AdsFactory | str) -> Any:
    """Return the factory that a text names, or the factory itself.

    Raises:
        RequestError: if there is none of this name, or if it is no factory.
    """
    if isinstance(ads, str):
        try:
            return factory_named(ads)
        except ValueError as error:
            raise RequestError(f"ads: {error}") from error
    if not callable(ads):
        raise RequestError(f"ads: expected a factory, such as the class MyPlanner, received {ads!r:.80}")
    return ads


def stays_safe(run: Run) -> None:
    """Assert that the ego neither collided nor left the road."""
    is_safe = run.outcome not in (Outcome.COLLISION, Outcome.OFF_ROAD)
    require(is_safe, "run.outcome not in (Outcome.COLLISION, Outcome.OFF_ROAD)", run.explain)


def short(value: float) -> str:
    """Return a number with at most four digits behind the point."""
    return f"{round(value, 4) + 0.0:g}"


# The scenario of each point.


@dataclass(frozen=True, slots=True)
class _Made:
    """The scenarios of a sweep: those of an entry with some values, or of one scenario."""

    source: Entry | Scenario
    values: Mapping[str, float]
    world: Any

    def unit(self, name: str) -> str:
        if isinstance(self.source, Entry) and name in self.source.parameters:
            return self.source.parameters[name].unit
        return unit_of(name)

    @property
    def described(self) -> str:
        """A sentence that says what happens in an entry; empty for a finding."""
        return self.source.about if isinstance(self.source, Entry) else ""

    def about(self, name: str) -> str:
        """Return in words what a number is."""
        if isinstance(self.source, Entry) and name in self.source.parameters:
            return self.source.parameters[name].about
        return words_of(name)

    def check(self, axes: tuple[Axis, ...]) -> tuple[str, ...]:
        """Return a sentence for each value outside of its range.

        Raises:
            RequestError: if there is no number of a name, or no scenario at any point: not a map without an answer.
        """
        remarks: tuple[str, ...] = ()
        if isinstance(self.source, Entry):
            spans = {axis.name: axis.values for axis in axes if "." not in axis.name}
            for name, value in ((name, value) for name, span in spans.items() for value in span):
                self.source.check({name: value})
            remarks = self.source.beyond({**{name: (value,) for name, value in self.values.items()}, **spans})
        errors = []
        for at in product(*(axis.values for axis in axes)):
            try:
                self([axis.name for axis in axes], at)
            except ScenarioError as error:
                errors.append(error)
            else:
                return remarks
        raise RequestError(f"sweep: expected a point that can be driven, received none: {errors[0]}")

    def __call__(self, names: Sequence[str], at: Sequence[float]) -> Scenario:
        given, scenario = dict(zip(names, at, strict=True)), self.source
        if isinstance(scenario, Entry):
            own = {name: given.pop(name) for name in names if "." not in name}
            scenario = scenario.scenario(self.world, **{**self.values, **own})
        for name, value in given.items():
            scenario = with_number(scenario, name, value)
        return scenario


def _source(what: Any, world: Any, values: Mapping[str, float]) -> tuple[str, _Made]:
    """Return the name of what is swept, and the maker of its scenarios."""
    if isinstance(what, Path) or (isinstance(what, str) and what.endswith(SUFFIX)):
        what = load(what)
    if values and not isinstance(what, str):
        raise RequestError(f"sweep: expected no parameters for a scenario, received {', '.join(values)}")
    if isinstance(what, SavedScenario):
        what = what.finding
    if isinstance(what, Finding):
        place = WorldData(what.world).made() if world is None else world
        sight = "" if what.perception is None else ", with perfect sight"
        return f"{what.id}{sight}", _Made(what.scenario, {}, place)
    if isinstance(what, Scenario):
        place = entry_of("r157/cut-in").world(None) if world is None else world
        return what.id, _Made(what, {}, place)
    entry = entry_of(what)
    entry.check(values)
    told = [entry.name, *(f"{name}={short(value)}" for name, value in values.items())]
    return " ".join(told), _Made(entry, values, entry.world(world))


def _in_words(world: Any) -> str:
    """Return a world as its environment, or as what differs from the default highway."""
    if isinstance(world, SimulatorWorld):
        return world.maker.__name__
    if not isinstance(world, Highway):
        return str(getattr(world, "env_id", type(world).__name__))
    default = Highway().to_dict()
    given = [f"{name}={value}" for name, value in world.to_dict().items() if value != default.get(name)]
    return " ".join([type(world).__name__, *given])


@dataclass(slots=True)
class _Driver:
    """The points of a sweep that were driven so far."""

    make: _Made
    axes: tuple[Axis, ...]
    holds: Callable[[Run], Any]
    on_point: Callable[[int], None] | None
    run_of: Callable[[Scenario], Run]
    points: list[Point] = field(default_factory=list)

    def drive(self, at: tuple[float, ...]) -> None:
        """Add the point at some values of the axes."""
        self.points.append(self._driven(at))
        if self.on_point is not None:
            self.on_point(len(self.points))

    def _driven(self, at: tuple[float, ...]) -> Point:
        try:
            scenario = self.make([axis.name for axis in self.axes], at)
        except ScenarioError as error:
            return Point(at=at, kind="not as asked", words=f"{UNDRIVABLE}{error}")
        why = fits(scenario, self.make.world)
        if why:
            return Point(at=at, kind="not as asked", words=f"{UNDRIVABLE}{why}")
        try:
            with refusals():
                run = self.run_of(scenario)
        except RequestError:
            raise
        except ProcessLostError as lost:  # no error of a point, which a test that counts failures may not count
            raise RequestError(f"ads: {lost.advice}. It was at {self._named(at)}") from None
        except Exception as error:  # what a policy raises as it drives is part of its run
            received = f"one that raises {described(error)}"
            raise RequestError(f"ads: expected a factory of a policy, received {received}; correct it") from error
        found = judged(run, self.holds)
        raised = found.error
        if raised is not None:
            raise RequestError(
                f"holds: expected a function that asserts, received {type(raised).__name__}: {visible(str(raised))} at "
                f"{self._named(at)}; correct the function"
            ) from raised
        return Point(at=at, kind=found.kind, words=visible(found.words), avoided_by=found.avoided_by, trace=run.trace)

    def _named(self, at: tuple[float, ...]) -> str:
        return ", ".join(f"{axis.name}={short(value)}" for axis, value in zip(self.axes, at, strict=True))


@dataclass(frozen=True, slots=True)
class Judged:
    """The answer for a run that was asked for: the verdict, the kind, words, and a reference driver that avoids it."""

    verdict: Verdict
    kind: Kind
    words: str
    avoided_by: str = ""

    @property
    def error(self) -> BaseException | None:
        """The exception of the property itself, if it is none with which properties state that they do not hold."""
        is_told = self.verdict.is_ads or self.verdict.asserts
        return self.verdict.exception if self.verdict.failed and not is_told else None


def judged(run: Run, holds: Callable[[Run], Any], test_file: str | None = None) -> Judged:
    """Judge a run that was asked for. A failure counts whoever is at fault, if a reference driver avoids it.

    An error of the policy itself counts in any case.
    """
    verdict, line, avoiding = judged_with_drivers(run, holds, test_file)
    if verdict.kind in ("invalid", "rejected", "skipped"):
        return Judged(verdict, "not as asked", f"{verdict.kind}: the run says nothing about the policy")
    what = f"{line}; {avoiding or 'no reference driver'} avoids it" if line else run.explain().splitlines()[0]
    if verdict.is_ads:
        return Judged(verdict, "ADS error", line, avoiding)
    missed = [each.words for each in run.asked if not each.is_met]
    if missed:
        return Judged(verdict, "not as asked", "; ".join([*missed, what]), avoiding)
    if not verdict.failed:
        return Judged(verdict, "avoided", what)
    return Judged(verdict, "preventable" if avoiding else "unavoidable", what, avoiding)


def _groups(odd: Iterable[Index], kind: Callable[[Index], bool]) -> Iterator[list[Index]]:
    """Yield groups of neighbouring indices of the same kind, in order."""
    left = dict.fromkeys(sorted(odd))
    while left:
        group, queue = [], [next(iter(left))]
        del left[queue[0]]
        while queue:
            index = queue.pop()
            group.append(index)
            for axis, step in product(range(len(index)), (-1, 1)):
                other = (*index[:axis], index[axis] + step, *index[axis + 1 :])
                if other in left and kind(other) == kind(index):
                    del left[other]
                    queue.append(other)
        yield sorted(group)


# An earlier map.


Before = Mapping[tuple[str, ...], Kind]
"""The answers of an earlier map, by the values of the axes as text."""


def _before(name: str, axes: tuple[Axis, ...], against: str | Path | Sweep) -> Before:
    """Return the answers of an earlier map of the same scenario over the same points.

    Raises:
        RequestError: if it is the map of something else, or its file cannot be read.
    """
    names = [axis.name for axis in axes]
    if isinstance(against, Sweep):
        if against.name != name or [axis.name for axis in against.axes] != names:
            told = f"{against.name} over {' and '.join(axis.name for axis in against.axes)}"
            raise RequestError(f"against: expected a map of {name} over {' and '.join(names)}, received one of {told}")
        found: Before = {_key(point.at): point.kind for point in against.points}
    else:
        found = _read(name, names, against)
    points = {_key(at) for at in product(*(axis.values for axis in axes))}
    if points != found.keys():
        other = min(points ^ found.keys())
        raise RequestError(
            f"against: expected a map with the same {len(points)} points, received one with {len(found)}; they differ "
            f"at {', '.join(map('='.join, zip(names, other, strict=True)))}; sweep the same values, or save a new map"
        )
    return found


def _key(at: Sequence[float]) -> tuple[str, ...]:
    return tuple(map(short, at))


def _read(scenario: str, names: Sequence[str], path: str | Path) -> Before:
    """Return the answers in the file of a saved map.

    Raises:
        RequestError: if the file cannot be read, or is the map of something else.
    """

    def wrong(expected: str, received: object) -> RequestError:
        return RequestError(
            f"against: {visible(str(path))}: expected {expected}, received {visible(str(received))!s:.80}"
        )

    try:
        with open_regular(Path(path)) as file:
            content = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise wrong("the file of a saved map", error.strerror or error) from None
    if len(content) > MOST_BYTES:
        raise wrong(f"at most {MOST_BYTES} bytes", "more")
    try:
        rows = list(csv.DictReader(io.StringIO(content.decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise wrong("CSV in UTF-8", error) from None
    columns = list(rows[0]) if rows else []
    if columns != [*names, *FIXED]:
        expected = f"the columns {', '.join([*names, *FIXED])}, with the axes in the same order"
        raise wrong(expected, ", ".join(map(str, columns)) or "no rows")
    found: dict[tuple[str, ...], Kind] = {}
    for row in rows:
        if row["scenario"] != spreadsheet_cell(scenario):
            raise wrong(f"a map of {scenario}", row["scenario"])
        if row["result"] not in KINDS:
            raise wrong(f"one of {', '.join(KINDS)} as the result", row["result"])
        try:
            found[_key([float(row[name]) for name in names])] = row["result"]
        except (TypeError, ValueError):
            raise wrong("numbers in the columns of the axes", [row[name] for name in names]) from None
    return found
