"""The report page: one self-contained HTML file, made from the data that all items send; it needs no network.

A page has a list of findings, an article on each, and each search. Without its scripts it shows the same text. Its
content is plain frozen values: no arrays, no scenarios, nothing that computes. Positions are in the frame of the road:
*along* the road, and *across* it from the centre of lane 0 to the right. Headings are relative to the road, positive to
the right. Lengths are in m, times in s since the start of the run, speeds in m/s, accelerations in m/s^2, angles in
rad. None stands for a number that does not exist, such as the time to contact of vehicles that never touch. An empty
text stands for a text that does not exist.
"""

from __future__ import annotations

import json
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.campaign.events import Ending, Search
from pytest_pafot.corpus.layout import SEARCH_PART, SUFFIX, name_without
from pytest_pafot.findings.finding import IN_MEMORY
from pytest_pafot.findings.severity import Severity
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.report.session import Session
from pytest_pafot.searching.plain import from_plain
from pytest_pafot.support.files import write_whole
from pytest_pafot.support.process import installed_versions
from pytest_pafot.support.text import content_hash, json_in_script, plural, visible_lines

Numbers = tuple[float | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LaneView:
    """A lane of a bent road: its centre line in world coordinates, and its width [m]."""

    points: tuple[tuple[float, float], ...]
    width: float


Place = tuple[float, float, float]
"""A gap that grows with the ego's speed: its minimum [m], its value at a standstill [m], its growth [m per m/s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoadView:
    """The road and the grid, as far as a picture needs them.

    Attributes:
        lanes: position of each lane's centre across the road, from the left.
        clearance: gap between the ego and the cells ahead and behind.
        ahead, behind: gaps to the cells ahead of and behind the ego in attentive traffic: the minimum, the gap at a
            standstill, and the growth for each m/s of the ego's speed.
        shapes: the lanes of a bent road. For such a road *along* is the world's x, *across* its y, headings are
            those of the world, and ``lanes`` is empty.
    """

    lanes: tuple[float, ...]
    lane_width: float
    speed_limit: float
    clearance: float
    ahead: Place = (0.0, 0.0, 0.0)
    behind: Place = (0.0, 0.0, 0.0)
    shapes: tuple[LaneView, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneView:
    """The zone, where the way of a crossing NPC meets the ego's way.

    Attributes:
        name: entry and exit of the NPC's way.
        way: points of the NPC's way; empty if they are unknown.
        area: the points of the NPC's way at which the NPC would be in the ego's way.
        width: width of that area.
    """

    name: str
    way: tuple[tuple[float, float], ...] = ()
    area: tuple[tuple[float, float], ...] = ()
    width: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleView:
    """One vehicle of a run. Most attributes have one value per frame.

    Attributes:
        name: ``ego``, or ``NPC 0`` and so on.
        along, across: position of the vehicle's centre.
        acceleration: acceleration along the vehicle's way.
        gap: distance between the vehicle's box and the ego's box; empty for the ego.
        ttc: time to contact with the ego at constant velocities; empty for the ego.
        cells: grid cell that contains the vehicle's centre: 0 for the ego's place, None while the vehicle is not on the
            ego's way; empty for the ego.
        zone: the zone of an NPC that crosses; None for other vehicles.
        advantage: expected time between the ego and a crossing NPC at the zone; empty for other vehicles.
    """

    name: str
    length: float
    width: float
    along: Numbers
    across: Numbers
    heading: Numbers
    speed: Numbers
    acceleration: Numbers = ()
    gap: Numbers = ()
    ttc: Numbers = ()
    cells: tuple[int | None, ...] = ()
    zone: ZoneView | None = None
    advantage: Numbers = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class InstructionView:
    """One instruction to one NPC: for a cell, for a lane, or for crossing the ego's way.

    Attributes:
        npc: number of the NPC, from 0.
        start, end: time at which the instruction begins and ends.
        requested: the cell in the scenario; 0 if the instruction is not for a cell.
        cell: the cell that the NPC drove to; it differs from ``requested`` if the repair during the run changed it.
        speed: target speed.
        started: True if the run got as far as this instruction.
        arrived: time at which the NPC reached the cell, the lane or the zone; None if it did not.
        lane: ``keep``, ``left`` or ``right`` if the NPC drove to a lane; otherwise empty.
        zone: entry and exit of the NPC's way if it crosses the ego's way; otherwise empty.
        words: the instruction for a lane or for crossing in words.
    """

    npc: int
    start: float
    end: float
    requested: int
    cell: int
    speed: float
    started: bool
    arrived: float | None
    lane: str = ""
    zone: str = ""
    words: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventView:
    """The event of a run, such as a collision, which the page shows first. A failed check may have another moment.

    ``kind`` is the outcome of the run, such as ``collision``. The other fields are the time of the event, the NPC
    involved, and the side of the ego that was hit.
    """

    kind: str
    time: float
    npc: int | None = None
    side: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckView:
    """A failed check: the measured value, its unit and its bounds.

    Attributes:
        value: the worst value; None if it was not a finite number.
        at_most, at_least: the bounds; None for a bound that the check does not have.
        time: time of the worst value; None if unknown.
        values: one value per frame, the worst since the previous frame, cut at ``low`` and ``high``; empty if the
            check measured a single number.
        low, high: the range that a picture shows, including the bounds.
        is_cut: two booleans: True if there are values below ``low``, and if there are values above ``high``.
        broken: start and end of each time span in which a bound was broken, in order.
    """

    name: str
    unit: str
    value: float | None
    at_most: float | None = None
    at_least: float | None = None
    time: float | None = None
    values: Numbers = ()
    low: float = 0.0
    high: float = 1.0
    is_cut: tuple[bool, bool] = (False, False)
    broken: tuple[tuple[float, float], ...] = ()

    @property
    def begin(self) -> float | None:
        """The time from which the bound is broken [s]; without a curve the time of the worst value, if it is known."""
        return self.broken[0][0] if self.broken else self.time


Stretch = tuple[float, float, str]
"""Decisions that are the same: the time of the first one, the time of the next other one [s], and their words."""
Paragraph = tuple[str, str, tuple[tuple[str, tuple[str, ...]], ...]]
"""A title, which may be empty, sentences, and lines of the user's code by whom they are about."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunView:
    """A finding with one of its runs, as the report page shows it.

    Attributes:
        sentences: who did what, what was due or what avoids it, and who is responsible unless the headline says it; of
            a failed check, what the headline does not say of it; otherwise empty.
        besides: the collision of a run in which a check failed, with who is at fault; otherwise empty.
        deadline: what the ego should have done by when to avoid the collision, in a few words; empty if unknown, or if
            it is not at fault.
        happened: what else is known of the run and of the finding, in prose.
        decisions: decisions of the ego's ADS, in order; equal ones in succession are one stretch.
        assertion: the line of the test that failed, or the exception that was raised.
        responsibility: ``ego``, ``npc``, ``both`` or ``none``.
        runs: number of runs of the search that failed in this way.
        label: ``new``, ``still failing``, ``flaky`` and so on.
        vehicles: the ego, then the NPCs.
        times: times of the frames; empty if no run was recorded.
        instructions: instructions to all NPCs, ordered by NPC and gene.
        yaml: text of its file.
        check: the check that failed; None if something else failed.
        traffic: how the NPCs drive; empty for the paper's traffic.
        sighting: the finding, as the session saw it. It has its own message.
    """

    headline: str
    responsibility: str
    road: RoadView
    vehicles: tuple[VehicleView, ...]
    times: tuple[float, ...]
    instructions: tuple[InstructionView, ...]
    event: EventView
    yaml: str
    command: str = ""
    runs: int = 1
    label: str = ""
    sentences: tuple[str, ...] = ()
    besides: str = ""
    assertion: str = ""
    check: CheckView | None = None
    traffic: str = ""
    deadline: str = ""
    happened: tuple[Paragraph, ...] = ()
    decisions: tuple[Stretch, ...] = ()
    sighting: Seen | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)

    @property
    def seen(self) -> Seen:
        """The finding, as the session saw it.

        Raises:
            ValueError: if it is not known yet.
        """
        if self.sighting is None:
            raise ValueError("sighting: expected the finding of the view, received None; set it with replace")
        return self.sighting

    @property
    def test(self) -> str:
        """The name of its test, with its parameters."""
        return self.seen.finding.test.rpartition("::")[2]


def text(value: object) -> str:
    """Escape a text for HTML, so that nothing in it is markup. Unprintable characters become visible escapes."""
    return escape(visible_lines(str(value)), quote=True)


def _facts(pairs: Iterable[tuple[str, object]]) -> str:
    rows = "".join(f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{rows}</dl>' if rows else ""


def _with_button(command: str) -> str:
    """Return the HTML of a command with a button that copies the command."""
    return (
        f'<div><p class="copyline"><span class="label">Command</span><code>{text(command)}</code>'
        '<button type="button" data-copy="code" aria-label="Copy: Command">Copy</button></p></div>'
    )


# The findings: their list, and an article on each with a place for its picture.

SYMBOLS = {"ego": "\u25cf", "npc": "\u25cb", "both": "\u25d0", "none": "\u2013", "check": "\u25b2", "error": "\u25a0"}
"""Symbols by who is responsible, of a failed check, or of an error of the ego's policy.

They differ at a glance, even without colour.
"""

WHO = {**AT_FAULT, "check": "failed check", "error": "policy error"}


def _who(finding: RunView) -> str:
    if finding.check is not None:
        return "check"
    return "error" if finding.event.kind in ("ads_error", "hang") else finding.responsibility


def _mark(finding: RunView) -> str:
    return f'<span class="mark" aria-hidden="true">{SYMBOLS.get(_who(finding), "?")}</span>'


def _keys(findings: Iterable[RunView]) -> list[str]:
    """Return a unique key for each finding, for links: its id, with a number if several findings share it."""
    seen = Counter[str]()
    keys = []
    for finding in findings:
        seen[finding.seen.id] += 1
        keys.append(finding.seen.id + (f"-{seen[finding.seen.id]}" if seen[finding.seen.id] > 1 else ""))
    return keys


def finding_list(findings: Sequence[RunView]) -> str:
    """Return an HTML list of links to all findings below the names of their tests; an empty text if there are none."""
    if not findings:
        return ""
    counts = Counter(map(_who, findings))
    summary = ", ".join(f"{SYMBOLS.get(who, '?')} {counts[who]} {WHO.get(who, who)}" for who in sorted(counts))
    listed = f'<p class="summary">{text(summary)}</p><div class="rows">'
    for test, group in groupby(zip(_keys(findings), findings, strict=True), key=lambda each: each[1].test):
        listed += f"<h3>{text(test)}</h3><ol>"
        for key, finding in group:
            listed += (
                f'<li><a href="#finding={text(quote(key, errors="replace"))}" data-key="{text(key)}">{_mark(finding)}'
                f'<span><span class="id">{text(finding.seen.id)}</span><span class="brief">{text(finding.headline)}'
                f"{text(f' ({finding.label})' if finding.label else '')}</span></span></a></li>"
            )
        listed += "</ol>"
    return f"{listed}</div>"


def finding_article(finding: RunView, index: int) -> str:
    """Return the HTML article on one finding, with an empty place for its picture."""
    seen, is_check = finding.seen, finding.check is not None
    tags = [] if finding.sentences or is_check else [WHO.get(_who(finding), finding.responsibility)]  # else said above
    if is_check and finding.responsibility != "none" and not finding.besides:
        tags.append(f"{WHO.get(finding.responsibility, finding.responsibility)} for the collision")
    tags += [plural(finding.runs, "run"), f"found in generation {seen.finding.found.generation}"]
    tags += filter(None, [finding.label, finding.traffic, seen.on_alike])
    deadline = f'; <span class="deadline">{text(finding.deadline)}</span>' if finding.deadline else ""
    parts = [
        f'<article id="finding-{index}" tabindex="-1" aria-labelledby="headline-{index}"><header>',
        f'<p class="id">{text(seen.id)}</p><h2 id="headline-{index}">{_mark(finding)} {text(finding.headline)}',
        "</h2>" if finding.besides else f"{deadline}</h2>",
        *(f'<p class="sentence">{text(each)}</p>' for each in finding.sentences),
    ]
    if finding.assertion and not is_check:
        parts.append(f'<p class="assertion"><code>{text(finding.assertion)}</code></p>')
    if finding.besides:
        parts.append(f'<p class="besides">{text(finding.besides)}{deadline}</p>')
    parts += [
        _with_button(finding.command) if finding.command else "",
        f'<ul class="tags">{"".join(f"<li>{text(tag)}</li>" for tag in tags)}</ul></header>',
        '<div class="player"></div>' if finding.times else '<p class="empty">There is no run to draw.</p>',
        _happened(finding.happened) if finding.happened else "",
        f'<section class="yaml"><div class="bar"><h4>{text(seen.path or seen.id + SUFFIX)}</h4>',
        '<button type="button" data-copy="pre">Copy the file</button></div>',
        f'<pre tabindex="0" aria-label="The file of this finding">{text(finding.yaml)}</pre></section></article>',
    ]
    return "".join(parts)


def _happened(paragraphs: Iterable[Paragraph]) -> str:
    """Return the HTML of what is known of a finding beside the sentences above its picture."""
    shown = ""
    for title, sentences, groups in paragraphs:
        run_in = f"<b>{text(title)}.</b> " if title else ""
        shown += f"<p>{run_in}{text(sentences)}</p>"
        for whom, rows in groups:
            lines = "".join(f"<li><code>{text(each)}</code></li>" for each in rows)
            shown += (f"<h4>{text(whom)}</h4>" if whom else "") + f"<ul>{lines}</ul>"
    return f'<section class="happened"><h3>What happened</h3>{shown}</section>'


def _further(findings: Sequence[Seen], whole: int, session: Session) -> str:
    """Return an HTML list of the findings that the page does not show whole; ``whole`` is the number of the others."""
    if not findings:
        return ""
    rows = "".join(
        f"<li><b>{text(each.id)}</b> {text(each.headline)}<br>"
        f"<code>{text(session.command(each, 'python', '-m', 'pytest'))}</code></li>"
        for each in findings
    )
    note = f"This page shows the {whole} worst findings whole. The others follow, the worst first."
    return _section(plural(len(findings), "further finding"), f'<p class="note">{note}</p><ul id="further">{rows}</ul>')


def _section(title: str, content: str) -> str:
    return f'<section class="campaigns"><h2>{text(title)}</h2>{content}</section>' if content else ""


def _search(search: Search) -> str:
    """Return the HTML article on one search."""
    made, asked = search.generations, search.asked.get("generations", search.generations)
    figures = (
        ("runs", search.runs),
        ("failing", search.failing),
        ("generations", made if asked == made else f"{made} of {asked}"),
        ("not run again", search.more_runs["known"]),
        ("outcomes", _counts(search.outcomes)),
        ("responsibility", _counts(search.responsibilities)),
        ("algorithm", search.algorithm),
        ("seed", search.seed),
        ("ended", search.reason.after_ended),
    )
    warnings = "".join(f'<p class="warning"><b>Warning</b> {text(warning)}</p>' for warning in search.warnings)
    return f'<article class="campaign"><h3 class="id">{text(search.node_id)}</h3>{_facts(figures)}{warnings}</article>'


def _counts(counts: Mapping[str, int]) -> str:
    ranked = sorted(counts.items(), key=lambda each: (-each[1], each[0]))
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in ranked)


# The whole page.

ASSETS = "pytest_pafot.report.assets"
SCRIPTS = ("dom.js", "scene.js", "charts.js", "player.js", "main.js")
"""The page's scripts, in the order in which they run. Each uses what the earlier scripts define."""

DRAWN = ("headline", "times", "vehicles", "road", "instructions", "decisions", "event", "check")
"""What the scripts read of a finding. The page has everything else as text."""

INTERRUPTED = '<p class="warning">The session was interrupted. This report has what ran before that.</p>'

WHOLE = 100
"""The largest number of findings that a page shows whole, the worst ones: each takes about 60 kB of the page."""


def write_page(path: Path, session: Session, *, title: str, command: str) -> str:
    """Write the page of a session, which ``command`` has started; return what is on it.

    Raises:
        OSError: if the file cannot be written.
    """
    page, told = render_page(session, title=title, command=command)
    write_whole(path, page.encode())
    return told


def render_page(session: Session, *, title: str, command: str) -> tuple[str, str]:
    """Render the record of a session as one self-contained HTML page, and say what is on it. Equal records, equal text.

    It has the findings that items sent for it, the worst of them whole, and the failures that none of them shows.
    """
    style = _asset("page.css")
    script = '"use strict";\n(() => {\n' + "\n".join(map(_asset, SCRIPTS)) + "})();\n"
    # The hashes allow only this style and these scripts, and no connection to anywhere.
    policy = f"default-src 'none'; style-src {content_hash(style)}; script-src {content_hash(script)}"
    seen, searches = session.findings, sorted(session.ended, key=lambda each: each.node_id)
    found = sorted((seen[node_id] for node_id in session.views), key=rank)
    views, more = by_test([_view(each, session) for each in found[:WHOLE]]), found[WHOLE:]
    # Searches fail because of their findings, too.
    shown = {*session.views, *(each.node_id for each in searches if each.finds and each.reason is not Ending.ERROR)}
    failures = {key: text for key, text in session.failures.items() if key[1] != "call" or key[0] not in shown}
    # Failures without a finding, with the text that pytest shows for them.
    ended = {each.node_id: "The search ended with an error." for each in searches if each.reason is Ending.ERROR}
    errors = "".join(
        f'<article class="error" role="alert"><h2>{text(node_id)}</h2>'
        f"<p>{ended.get(node_id, 'It failed, and no finding on this page shows why.')}</p>"
        f"<pre>{text(failure.strip())}</pre></article>"
        for (node_id, _), failure in sorted(failures.items())
    )
    is_interrupted = session.exit == 2
    searches = [each for each in searches if each.reason is not Ending.REPLAYS]
    told = plural(len(found), "finding")
    told = f"{plural(len(failures), 'error')}, {told}" if failures else told
    page = Template(_asset("page.html")).substitute(
        title=text(f"{title}: {told}"),
        policy=f"{policy}; base-uri 'none'; form-action 'none'",
        style=style,
        script=script,
        above=(INTERRUPTED if is_interrupted else "") + errors,
        count=f"{len(views)} of {len(found)}" if more else len(views),
        list=finding_list(views)
        or f'<p class="empty">{_nothing_found(searches, has_errors=bool(failures), is_interrupted=is_interrupted)}</p>',
        articles="".join(finding_article(finding, index) for index, finding in enumerate(views)),
        below=_further(more, len(views), session)
        + _section("Searches", "".join(map(_search, searches)))
        + _section("Session", _facts(session_facts(searches, session.replays)) + _with_button(command)),
        data=data_json(views),
    )
    return page, told


def _view(seen: Seen, session: Session) -> RunView:
    """Return the view of a finding with what only the session knows: its number of runs, its label and its command."""
    view = from_plain(RunView, json.loads(zlib.decompress(session.views[seen.node_id])))
    search = {name_without(SEARCH_PART, each.node_id): each for each in session.ended}.get(seen.test)
    runs = 1 + seen.alike.runs if search is None else search.known.get(seen.id, 1)
    parts: list[str] = [] if seen.label == "accepted" else [seen.label]
    if seen.label == "new":
        parts = [f"new ({seen.remark})" if seen.remark else "new"]
    elif seen.finding.xfail is not None:
        parts.append(f"accepted: {seen.finding.accepted}")
    command = session.command(seen, "pytest", name=seen.node_id)
    return replace(view, runs=runs, label=", ".join(parts), command=command, sighting=seen)


def data_json(views: Iterable[RunView]) -> str:
    """Return the findings for the page's scripts, as JSON that is safe inside a ``<script>`` element.

    It has only what they read. Nothing in the JSON can end the element or begin a comment, and everything beyond ASCII,
    such as U+2028, is escaped.
    """
    findings = [asdict(replace(finding, sighting=None)) for finding in views]
    data = [{name: finding[name] for name in DRAWN} for finding in findings]
    return json_in_script(json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":")))


def _nothing_found(searches: Iterable[Search], *, has_errors: bool, is_interrupted: bool) -> str:
    """Return the sentence on a page without findings. It says that the property held only if nothing was cut short."""
    ends = {search.reason for search in searches}
    if has_errors or Ending.ERROR in ends:
        return "No findings, but an error stopped something before its end."
    if is_interrupted or Ending.INTERRUPTED in ends:
        return "No findings before the interrupt. The scenarios that had not run by then are untested."
    if any(search.failing for search in searches):
        return "No new findings. Some runs failed, but saved scenarios already cover these failures."
    if not all(end.is_complete for end in ends):
        return "No findings before time ran out. The property held in every run that was evaluated by then."
    return "No findings. The property held in every evaluated run."


def _asset(name: str) -> str:
    return files(ASSETS).joinpath(name).read_text(encoding="utf-8")


# What a page says of a session.


def rank(sighting: Seen) -> tuple[Any, ...]:
    """Return the key that sorts findings: new before known, then by responsibility, severity and number of runs."""
    worst = Severity.worst_first(sighting.responsible, sighting.severity)
    return sighting.label != "new", *worst, -sighting.alike.runs, sighting.node_id


def by_test(findings: Sequence[RunView]) -> tuple[RunView, ...]:
    """Put the findings of each test together, the test with the worst finding first."""
    tests = list(dict.fromkeys(finding.test for finding in findings))
    return tuple(sorted(findings, key=lambda finding: tests.index(finding.test)))


def session_facts(searches: Iterable[Search], replays: Iterable[Seen]) -> Iterator[tuple[str, str]]:
    """Yield names and values of facts on a session: seeds, replays, versions."""
    if seeds := dict.fromkeys(search.base_seed for search in searches):
        yield "base seed" if len(seeds) == 1 else "base seeds", ", ".join(map(str, seeds))
    replays = sorted(replays, key=lambda each: each.node_id)
    if replays:
        counts = sorted(Counter(each.label for each in replays).items())
        results = ", ".join(f"{count} {result}" for result, count in counts)
        yield "replayed", f"{plural(len(replays), 'saved scenario')}: {results}"
    for each in replays:
        if each.label == "drifted" or (each.label == "still failing" and each.on_search):
            yield each.label, f"{each.node_id}: {each.on_search or each.detail}"
    yield from installed_versions().items()
    yield "written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
