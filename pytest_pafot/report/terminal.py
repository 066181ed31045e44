"""Text for the terminal: progress, finds, and the summary of searches and replays.

Pure functions from values to lines of plain ASCII, at most 80 columns wide but for node ids, paths and the
user's own words. The values travel between processes as plain data.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

WIDTH = 80
MAX_FINDS = 20
"""Finds that are listed one by one."""

MAX_QUIET_REPLAYS = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Where a search is.

    Attributes:
        node_id: of the search.
        generation: that is in progress, from 1.
        generations: that were asked for.
        runs: simulated so far.
        failing: runs that the test rejected.
        finds: distinct ones that are new.
        seconds: since the search began.
        phase: what goes on after the generations, such as shrinking; empty while they run.
    """

    node_id: str
    generation: int
    generations: int
    runs: int
    failing: int
    finds: int
    seconds: float
    phase: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Find:
    """A distinct find that is new.

    Attributes:
        id: of the finding.
        node_id: under which it is reported.
        headline: one line that says what happened.
        path: of its file, or empty.
        problem: why there is no file, or empty.
        difference: what differed when it was run again, or empty.
        is_timed: it depends on wall-clock time.
        repeats: further runs that failed in the same way.
        shrunk: the size that the scenario was brought down to, and in how many runs; or empty.
    """

    id: str
    node_id: str
    headline: str
    path: str = ""
    problem: str = ""
    difference: str = ""
    is_timed: bool = False
    repeats: int = 0
    shrunk: str = ""

    @property
    def is_flaky(self) -> bool:
        """Whether running it again gave another run."""
        return bool(self.difference)

    @property
    def remark(self) -> str:
        """What a reader must know besides, in brackets, or nothing."""
        remarks = [
            f"flaky: {self.difference}" if self.is_flaky else "",
            "depends on wall-clock time" if self.is_timed else "",
        ]
        text = "; ".join(remark for remark in remarks if remark)
        return f" ({text})" if text else ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """How a search went.

    Attributes:
        node_id: of the search.
        algorithm: its name.
        profile: that the defaults came from.
        base_seed: that was given, or fresh.
        seed: of this search, derived from the base seed and the node id.
        generations: finished, of ``asked``.
        asked: generations that were asked for.
        reason: why it ended.
        seconds: it took.
        runs: simulated scenarios.
        known_runs: scenarios that were not simulated, since an earlier run showed what they do.
        invalid, npc, rejected, skipped: runs without a judgement, by kind.
        reached: share of Position-Instructions whose cell was reached; None where no run tells.
        no_interaction: runs in which no NPC came near the ego.
        failing: runs that the test rejected.
        finds: distinct ones that are new.
        unsaved: further ones that the limit of saved scenarios left out, with their runs.
        shrink_runs: taken to simplify the finds, beside ``runs``.
        known: failing runs by the id of the saved scenario that covers them.
        warnings: of the search's health.
        notes: anything else to be told once.
        coverage: one line on the Position-Instructions that the runs came to.
    """

    node_id: str
    algorithm: str = "pafot"
    profile: str = ""
    base_seed: int = 0
    seed: int = 0
    generations: int = 0
    asked: int = 0
    reason: str = ""
    seconds: float = 0.0
    runs: int = 0
    known_runs: int = 0
    invalid: int = 0
    npc: int = 0
    rejected: int = 0
    skipped: int = 0
    reached: float | None = None
    no_interaction: int = 0
    failing: int = 0
    finds: tuple[Find, ...] = ()
    unsaved: Mapping[str, int] = field(default_factory=dict)
    shrink_runs: int = 0
    known: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    coverage: str = ""

    def to_plain(self) -> dict[str, Any]:
        """Plain data, for another process."""
        plain = asdict(self)
        plain["finds"] = [asdict(find) for find in self.finds]
        plain["warnings"], plain["notes"] = list(self.warnings), list(self.notes)
        return plain

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """The inverse of :meth:`to_plain`."""
        values = dict(plain)
        values["finds"] = tuple(Find(**find) for find in values["finds"])
        values["warnings"], values["notes"] = tuple(values["warnings"]), tuple(values["notes"])
        return cls(**values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """How the replay of a saved scenario went.

    Attributes:
        node_id: of the item.
        label: ``fixed``, ``still failing``, ``drifted``, ``flaky``.
        detail: what differs, or empty.
    """

    node_id: str
    label: str
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Session:
    """Everything that the summary of a session shows.

    Attributes:
        searches: in the order in which they ended.
        replays: likewise.
        orphans: folders of saved scenarios whose test is gone, with their number of files.
        pruned: whether those were removed.
        strays: saved scenarios that lie in no folder of a test, each with where it should be.
        problems: anything that went wrong beside the tests.
        written: where reports are.
        interrupted: node ids of searches that began and did not end.
        notes: on the whole session.
    """

    searches: Sequence[Search] = ()
    replays: Sequence[Replay] = ()
    orphans: Sequence[tuple[str, int]] = ()
    pruned: bool = False
    strays: Sequence[tuple[str, str]] = ()
    problems: Sequence[str] = ()
    written: Sequence[str] = ()
    interrupted: Sequence[str] = ()
    notes: Sequence[str] = ()


def progress_line(progress: Progress, width: int = WIDTH) -> str:
    """One line, cut at the left of the node id, and at the end where even that does not make it fit."""
    speed = progress.runs / progress.seconds if progress.seconds > 0 else 0.0
    done = (
        f"{progress.generation}/{progress.generations} generations, {_plural(progress.runs, 'run')}, "
        f"{progress.failing} failing, {progress.finds} new, {speed:.0f}/s"
    )
    tail = f" {progress.phase or done}"
    room = max(12, width - len(tail) - 8)
    name = ascii_text(progress.node_id)
    name = name if len(name) <= room else f"...{name[3 - room :]}"
    return f"pafot: {name}{tail}"[:width]


def found_line(find: Find) -> list[str]:
    """Told the moment it is found."""
    where = f"  saved as {find.path}" if find.path else f"  not saved: {find.problem}"
    return [
        ascii_text(f"pafot: found {find.node_id}"),
        ascii_text(f"  {find.headline}{find.remark}"),
        ascii_text(where),
    ]


def shrunk_line(find: Find) -> list[str]:
    """Told when a find has become simpler."""
    return [ascii_text(f"pafot: shrunk {find.node_id}"), ascii_text(f"  {find.headline}"), f"  to {find.shrunk}"]


def find_section(
    find: Find, *, scenario: str, origin: str, explanation: str, content: str, details: Sequence[str] = ()
) -> str:
    """The section of a find's own report.

    Args:
        find: what it is about.
        scenario: in one line.
        origin: of the find, in one line.
        explanation: of the run, or empty where the failure's message has it.
        content: of the file that could not be written, or empty.
        details: further lines, each with a title of up to ten letters.
    """
    lines = [explanation.rstrip()] if explanation else []
    lines += [f"scenario   {scenario}", f"found by   {origin}{find.remark}", *details]
    if find.path:
        lines += [f"saved as   {find.path}", f'run again  pytest "{find.node_id}"']
    else:
        lines.append(f"not saved  {find.problem}")
    if content:
        lines += ["the file would be:", textwrap.indent(content.rstrip(), "  ")]
    return "\n".join(ascii_text(line) for line in "\n".join(lines).splitlines())


def search_failure(search: Search) -> str:
    """Why a searching item fails: its new finds, each of which is reported as an item of its own."""
    count = len(search.finds) + len(search.unsaved)
    lines = [f"{_plural(count, 'new finding')} in {_plural(search.runs, 'run')}:"]
    lines += [*_find_lines(search.finds), *_unsaved_lines(search.unsaved), *_wrapped(_origin(search))]
    return "\n".join(lines)


def search_lines(search: Search, *, verbose: bool = False) -> list[str]:
    """A search in the summary: two lines when it is well, more where there is something to say."""
    lines = [ascii_text(search.node_id), *_wrapped(_figures(search)), *_wrapped(_origin(search))]
    if verbose and search.coverage:
        lines += _wrapped(f"coverage: {search.coverage}")
    lines += [*_find_lines(search.finds), *_unsaved_lines(search.unsaved)]
    lines += [f"  known: {_plural(count, 'run')} covered by saved-{id_}" for id_, count in sorted(search.known.items())]
    for warning in search.warnings:
        lines += _wrapped(f"warning: {warning}")
    for note in search.notes:
        lines += _wrapped(f"note: {note}")
    return lines


def replay_lines(replays: Iterable[Replay]) -> list[str]:
    """All replays: a count by label, then those that a reader should look at."""
    replays = list(replays)
    if not replays:
        return []
    counts: dict[str, int] = {}
    for replay in replays:
        counts[replay.label] = counts.get(replay.label, 0) + 1
    figures = ", ".join(f"{count} {label}" for label, count in sorted(counts.items()))
    lines = [f"replayed {_plural(len(replays), 'saved scenario')}: {figures}"]
    shown = [replay for replay in replays if replay.label != "still failing"]
    for replay in shown[:MAX_QUIET_REPLAYS]:
        lines.append(ascii_text(f"  {replay.label}: {replay.node_id}"))
        lines += [f"  {line}" for line in _wrapped(replay.detail)]
    if len(shown) > MAX_QUIET_REPLAYS:
        lines.append(f"  ... and {len(shown) - MAX_QUIET_REPLAYS} more")
    return lines


def session_lines(session: Session, *, verbose: bool = False) -> list[str]:
    """The whole summary; empty when there is nothing to tell."""
    lines: list[str] = []
    for search in session.searches:
        lines += search_lines(search, verbose=verbose)
    lines += [
        ascii_text(f"{node_id}\n  ended before its time; what it found is saved") for node_id in session.interrupted
    ]
    lines += replay_lines(session.replays)
    for folder, count in session.orphans:
        verb = "removed" if session.pruned else "orphaned"
        lines.append(ascii_text(f"{verb}: {_plural(count, 'saved scenario')} of no test in {folder}"))
    if session.orphans and not session.pruned:
        lines += _wrapped("rename the folder to the test's new name, or remove it with --pafot-prune")
    for file, place in session.strays:
        lines.append(ascii_text(f"not run: {file}, which lies in no folder of a test; move it to {place}"))
    lines += [ascii_text(line) for line in session.written]
    for note in session.notes:
        lines += _wrapped(f"note: {note}")
    for problem in session.problems:
        lines += _wrapped(f"problem: {problem}")
    return [part for line in lines for part in line.splitlines()]


def ascii_text(text: str) -> str:
    """Text that any terminal and log can show."""
    return text.encode("ascii", "backslashreplace").decode("ascii")


def _figures(search: Search) -> str:
    parts = [f"{_plural(search.runs, 'run')} in {search.seconds:.1f} s"]
    if search.shrink_runs:
        parts.append(f"{search.shrink_runs} more to shrink")
    if search.known_runs:
        parts.append(f"{search.known_runs} not run again")
    parts.append(f"{search.failing} failing")
    unjudged = (
        (search.npc, "npc at fault"),
        (search.invalid, "invalid"),
        (search.rejected, "rejected"),
        (search.skipped, "skipped"),
        (search.no_interaction, "without interaction"),
    )
    parts += [f"{count} {what}" for count, what in unjudged if count]
    if search.reached is not None:
        parts.append(f"{search.reached:.0%} of genes reached")
    return ", ".join(parts)


def _origin(search: Search) -> str:
    return (
        f"{search.algorithm}, seed {search.seed} from --pafot-seed={search.base_seed} (profile {search.profile}), "
        f"{search.generations} of {_plural(search.asked, 'generation')}, ended: {search.reason}"
    )


def _find_lines(finds: Sequence[Find]) -> list[str]:
    """The finds; those that do not repeat come last, apart."""
    flaky = [find for find in finds if find.is_flaky]
    lines = _listed([find for find in finds if not find.is_flaky])
    return [*lines, f"  flaky, so never called fixed: {len(flaky)}", *_listed(flaky)] if flaky else lines


def _unsaved_lines(unsaved: Mapping[str, int]) -> list[str]:
    if not unsaved:
        return []
    names = ", ".join(f"{id_} ({_plural(count, 'run')})" for id_, count in list(unsaved.items())[:MAX_FINDS])
    more = f" and {len(unsaved) - MAX_FINDS} more" if len(unsaved) > MAX_FINDS else ""
    return _wrapped(f"{_plural(len(unsaved), 'further finding')} not saved (--pafot-max-saved): {names}{more}")


def _listed(finds: Sequence[Find]) -> list[str]:
    lines: list[str] = []
    for find in finds[:MAX_FINDS]:
        again = f", {_plural(find.repeats, 'more run')}" if find.repeats else ""
        lines.append(ascii_text(f"  saved-{find.id}{again}"))
        lines += [f"  {line}" for line in _wrapped(f"{find.headline}{find.remark}")]
        lines += [f"    shrunk to {find.shrunk}"] if find.shrunk else []
        lines += [f"    not saved: {ascii_text(find.problem)}"] if find.problem else []
    if len(finds) > MAX_FINDS:
        lines.append(f"  ... and {len(finds) - MAX_FINDS} more")
    return lines


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(
        ascii_text(text),
        width=WIDTH - 2,
        initial_indent="  ",
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
