"""The parts of the page that need no script: everything that is text. The pictures are added by the scripts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from html import escape
from textwrap import dedent
from urllib.parse import quote

from pytest_pafot.grid import Cell
from pytest_pafot.report.page_data import (
    CampaignView,
    CoverageRow,
    FindingView,
    GenerationView,
    InstructionView,
    Report,
    ShrinkView,
)

SYMBOLS = {"ego": "\u25cf", "npc": "\u25cb", "both": "\u25d0", "none": "\u2013"}
"""Beside the word, so that a glance tells responsibilities apart without colour."""

WHO = {"ego": "ego responsible", "npc": "NPC responsible", "both": "both responsible", "none": "nobody responsible"}

ENDS = {
    "": "early",
    "generations": "all generations done",
    "time": "time was over",
    "stopped": "enough was found",
    "error": "with an error",
}
"""Why a search ended."""

_UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufdd0-\ufdef\ufffe\uffff]")


def text(value: object) -> str:
    """Any text as HTML: escaped, and with a replacement for characters that no page can hold."""
    return escape(_UNPRINTABLE.sub("\ufffd", str(value)), quote=True)


def session_facts(report: Report) -> str:
    """Versions, seeds and the command of the session."""
    rows = "".join(f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in report.facts)
    facts = f'<dl class="facts">{rows}</dl>' if rows else ""
    return facts + (copyable("Command", report.command) if report.command else "")


def finding_keys(findings: Iterable[FindingView]) -> tuple[str, ...]:
    """By which links and files name findings: their ids, numbered where several tests share one."""
    keys: dict[str, None] = {}
    for finding in findings:
        number = 1
        while (key := finding.id if number == 1 else f"{finding.id}-{number}") in keys:
            number += 1
        keys[key] = None
    return tuple(keys)


def errors(report: Report) -> str:
    """What failed by no finding, with what pytest says of it; empty where nothing did."""
    ended = {view.node_id: "The search ended with an error." for view in report.campaigns if view.reason == "error"}
    return "".join(
        f'<article class="error" role="alert"><h2>{text(node_id)}</h2>'
        f"<p>{ended.get(node_id, 'It failed, and no finding on this page shows that.')}</p>"
        f"<pre>{text(told.strip())}</pre></article>"
        for node_id, told in report.errors
    )


def nothing_found(report: Report) -> str:
    """What a page without findings says of the property: that it held only where everything ran to its end."""
    ends = {view.reason for view in report.campaigns}
    if report.errors or "error" in ends:
        return "No findings, since not everything ran to its end: an error came first."
    if report.is_interrupted or ends & {"", "interrupted"}:
        return "No findings until the interrupt. What had not run by then says nothing."
    if any(row.failing for view in report.campaigns for row in view.generations):
        return "No new findings. Runs that failed are known: a saved scenario covers them."
    if "time" in ends:
        return "No findings until time was over. Every run that was judged by then kept the property."
    return "No findings. Every judged run kept the property."


def finding_list(findings: Sequence[FindingView]) -> str:
    """Links to all findings, with counts; empty without any."""
    if not findings:
        return ""
    groups: dict[str, list[str]] = {}
    for index, (key, finding) in enumerate(zip(finding_keys(findings), findings, strict=True)):
        groups.setdefault(finding.test, []).append(_list_item(finding, key, index))
    parts = [f'<p class="summary">{text(_summary(findings))}</p>', _filter(findings) if len(findings) > 1 else ""]
    for number, (test, items) in enumerate(groups.items()):
        name = f'<h3 id="group-{number}">{text(test.rpartition("::")[2])} <span class="count">{len(items)}</span></h3>'
        listed = f'<ol aria-labelledby="group-{number}">{"".join(items)}</ol>' if len(groups) > 1 else ""
        parts.append(f'<div class="group">{name}{listed}</div>' if listed else f"<ol>{''.join(items)}</ol>")
    return "".join(parts)


def _list_item(finding: FindingView, key: str, index: int) -> str:
    return (
        f'<li><a href="#finding={text(quote(key, errors="replace"))}" data-index="{index}" data-key="{text(key)}" '
        f'data-outcome="{text(finding.event.kind)}" data-words="{text(_words(finding))}">'
        f'<span class="mark" aria-hidden="true">{_symbol(finding)}</span>'
        f'<span class="what"><span class="id">{text(finding.id)}</span>'
        f'<span class="headline">{text(finding.headline)}</span>'
        f'<span class="meta">{text(_meta(finding))}</span></span></a></li>'
    )


def _words(finding: FindingView) -> str:
    """What the filter looks through."""
    return " ".join([finding.node_id, finding.headline, finding.assertion, _meta(finding), finding.path]).lower()


def _filter(findings: Sequence[FindingView]) -> str:
    """Fields that leave some findings out of the list; they need the script."""
    counts = Counter(finding.event.kind for finding in findings)
    options = "".join(
        f'<option value="{text(kind)}">{text(kind.replace("_", " "))} ({count})</option>'
        for kind, count in sorted(counts.items())
    )
    return (
        '<div class="filter"><input type="search" id="filter" placeholder="Filter" aria-controls="list" '
        'aria-label="Filter findings by text"><select id="outcome" aria-label="Filter findings by outcome">'
        f'<option value="">all outcomes</option>{options}</select>'
        '<p id="nothing" hidden>No finding is like this.</p></div>'
    )


def article(finding: FindingView, index: int) -> str:
    """One finding in words; an empty place for its picture."""
    parts = [
        f'<article id="finding-{index}" data-index="{index}" tabindex="-1" aria-labelledby="headline-{index}">',
        f'<header><p class="id">{text(finding.id)}</p><h2 id="headline-{index}">{text(finding.headline)}</h2>',
        f'<p class="assertion"><code>{text(finding.assertion)}</code></p>' if finding.assertion else "",
        _tags(finding),
        "</header>",
        '<div class="player"></div>' if finding.times else '<p class="empty">Nobody saw a run to draw.</p>',
        "<section><h3>What happened</h3>",
        f'<pre class="explanation">{text(dedent(finding.explanation).strip())}</pre></section>',
        _shrink_section(finding.shrink),
        _instruction_table(finding),
        '<section class="keep"><h3>Run it again</h3>',
        copyable("Command", finding.command),
        f'<div class="yaml"><div class="bar"><h4>{text(finding.path or finding.id + ".pafot.yaml")}</h4>',
        '<button type="button" class="copy" data-copy="pre">Copy the file</button></div>',
        f'<pre tabindex="0" aria-label="The file of this finding">{text(finding.yaml)}</pre></div></section>',
        "</article>",
    ]
    return "".join(parts)


def campaign(view: CampaignView, index: int, *, is_open: bool = True) -> str:
    """One search, which can be folded: figures, a place for the curve of fitness, coverage."""
    figures = (
        ("algorithm", view.algorithm),
        ("seed", view.seed),
        ("generations", _of(len(view.generations), view.asked)),
        ("runs", view.simulated),
        ("not run again", view.reused),
        ("ended", ENDS.get(view.reason, view.reason)),
    )
    rows = "".join(f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in figures)
    warnings = "".join(f'<p class="warning"><b>Warning</b> {text(warning)}</p>' for warning in view.warnings)
    parts = [
        f'<article class="campaign" data-campaign="{index}" aria-labelledby="campaign-{index}">'
        f"<details{' open' if is_open else ''}>",
        f'<summary><h3 id="campaign-{index}" class="id">{text(view.node_id)}</h3>'
        f'<span class="meta">{text(_in_short(view))}</span></summary><dl class="facts">{rows}</dl>{warnings}',
        '<div class="fitness"></div>',
        _details("Generations as a table", _generation_table(view.generations)),
        '<div class="columns">',
        _counts("Runs by outcome", view.outcomes, view.simulated),
        _counts("Runs by responsibility", view.responsibilities, sum(count for _, count in view.responsibilities)),
        "</div>",
        "<h4>Coverage: instructions requested, driven and reached</h4>",
        '<p class="note">Requested: in the scenarios as the search asked for them. Driven: as far as the runs came, '
        "after repair. Reached: the NPC arrived in its cell.</p>",
        '<div class="columns">',
        _coverage("Cells", "cell", view.cells),
        _coverage("Target speeds", "speed", view.speeds),
        _ring(view.steps),
        "</div></details></article>",
    ]
    return "".join(parts)


def _in_short(view: CampaignView) -> str:
    """A folded search in a line."""
    warned = f", {_plural(len(view.warnings), 'warning')}" if view.warnings else ""
    warned += f", ended {ENDS.get(view.reason, view.reason)}" if view.reason in ("error", "interrupted") else ""
    failing = sum(row.failing for row in view.generations)
    return f"{_plural(view.simulated, 'run')}, {failing} failing in its generations{warned}"


def copyable(label: str, value: str) -> str:
    """A line of text with a button that copies it."""
    return (
        f'<p class="copyline"><span class="label">{text(label)}</span><code>{text(value)}</code>'
        f'<button type="button" class="copy" data-copy="code" aria-label="Copy: {text(label)}">Copy</button></p>'
    )


def _symbol(finding: FindingView) -> str:
    return SYMBOLS.get(finding.responsibility, "?")


def _meta(finding: FindingView) -> str:
    parts = [WHO.get(finding.responsibility, finding.responsibility), _plural(finding.runs, "run")]
    if finding.generation is not None:
        parts.append(f"first in generation {finding.generation}")
    return ", ".join([*parts, *([finding.label] if finding.label else [])])


def _summary(findings: Sequence[FindingView]) -> str:
    counts = Counter(finding.responsibility for finding in findings)
    known = [name for name in SYMBOLS if counts[name]]
    names = [*known, *sorted(set(counts) - set(known))]
    return ", ".join(f"{counts[name]} {WHO.get(name, name)}" for name in names)


def _tags(finding: FindingView) -> str:
    who = WHO.get(finding.responsibility, finding.responsibility)
    tags = [f'<span aria-hidden="true">{_symbol(finding)}</span> {text(who)}', text(_plural(finding.runs, "run"))]
    if finding.generation is not None:
        tags.append(f"first in generation {finding.generation}")
    if finding.label:
        tags.append(text(finding.label))
    if finding.preventable_by:
        tags.append("preventable by " + text(", ".join(finding.preventable_by)))
    elif finding.preventable_tried:
        tags.append("no reference driver prevents it (tried: " + text(", ".join(finding.preventable_tried)) + ")")
    items = "".join(f"<li>{tag}</li>" for tag in tags)
    return f'<ul class="tags">{items}</ul><p class="test">{text(finding.node_id)}</p>'


def _shrink_section(shrink: ShrinkView | None) -> str:
    if shrink is None:
        return ""
    notes = "".join(f'<p class="note">{text(note)}</p>' for note in shrink.notes)
    if shrink.original == shrink.shrunk:
        return f"<section><h3>Nothing simpler found in {_plural(shrink.rollouts, 'run')}</h3>{notes}</section>"
    rows = (
        ("NPCs", shrink.original_npcs, shrink.shrunk_npcs),
        ("instructions", shrink.original_instructions, shrink.shrunk_instructions),
    )
    body = "".join(f'<tr><th scope="row">{name}</th><td>{a}</td><td>{b}</td></tr>' for name, a, b in rows)
    body += (
        f'<tr class="chains"><th scope="row">chains</th><td>{_lines(shrink.original)}</td>'
        f"<td>{_lines(shrink.shrunk)}</td></tr>"
    )
    return (
        f"<section><h3>Shrunk in {_plural(shrink.rollouts, 'run')}</h3>{notes}"
        '<div class="scroll"><table><thead><tr><th></th><th scope="col">as found</th><th scope="col">shrunk</th></tr>'
        f"</thead><tbody>{body}</tbody></table></div></section>"
    )


def _instruction_table(finding: FindingView) -> str:
    rows = "".join(
        f'<tr{"" if row.started else " class=unstarted"}><th scope="row">NPC {row.npc}</th><td>{row.start:.1f}</td>'
        f"<td>{_goal(row)}</td><td>{row.speed:.1f}</td>"
        f"<td>{_reached(row.started, row.arrived)}</td></tr>"
        for row in finding.instructions
    )
    head = "".join(
        f'<th scope="col">{name}</th>' for name in ("NPC", "from [s]", "cell or lane", "speed [m/s]", "reached")
    )
    table = f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    return _details("Instructions as a table", table)


def _goal(row: InstructionView) -> str:
    if row.lane:
        return "keep lane" if row.lane == "keep" else f"lane {row.lane}"
    return f"{_cell(row.cell)}{_repaired(row.requested, row.cell)}"


def _reached(started: bool, arrived: float | None) -> str:
    if not started:
        return "not begun"
    return "not reached" if arrived is None else f"at {arrived:.1f} s"


def _cell(cell: int) -> str:
    return f"{cell} {Cell(cell).label}"


def _repaired(requested: int, cell: int) -> str:
    return "" if requested == cell else f" (requested {_cell(requested)})"


def _generation_table(generations: Iterable[GenerationView]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{row.generation}</th><td>{_number(row.best)}</td><td>{_number(row.mean)}</td>'
        f"<td>{row.failing} of {row.population}</td><td>{text(_remark(row))}</td></tr>"
        for row in generations
    )
    head = "".join(
        f'<th scope="col">{name}</th>' for name in ("generation", "best fitness", "mean fitness", "failing", "")
    )
    return f'<div class="scroll tall"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def _remark(row: GenerationView) -> str:
    parts = ["random population after a restart"] if row.restarted else []
    if row.local_best is not None:
        result = "improved the incumbent" if row.local_replaced else "found nothing better"
        parts.append(f"local search {result}")
    return ", ".join(parts)


def _counts(title: str, counts: Iterable[tuple[str, int]], total: int) -> str:
    rows = "".join(
        f'<tr><th scope="row">{text(name.replace("_", " "))}</th><td>{count}</td><td>{_bar(count, total)}</td></tr>'
        for name, count in counts
    )
    return f"<div><h4>{title}</h4><table><tbody>{rows}</tbody></table></div>" if rows else ""


def _coverage(title: str, what: str, rows: Sequence[CoverageRow]) -> str:
    top = max((row.requested for row in rows), default=0)
    has_reached = any(row.reached is not None for row in rows)
    body = "".join(
        f'<tr><th scope="row">{text(row.label)}</th><td>{row.requested}</td><td>{row.driven}</td>'
        + (f"<td>{row.reached}</td>" if has_reached else "")
        + f"<td>{_bars(row, top)}</td></tr>"
        for row in rows
    )
    names = [what, "requested", "driven", *(["reached"] if has_reached else []), ""]
    head = "".join(f'<th scope="col">{name}</th>' for name in names)
    return f"<div><h4>{title}</h4><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _ring(steps: Sequence[CoverageRow]) -> str:
    """From each cell a row: how often an NPC held it, stepped clockwise and stepped anticlockwise."""
    if len(steps) != 24:
        return ""
    has_reached = any(row.reached is not None for row in steps)
    body = "".join(
        f'<tr><th scope="row">{_cell(int(cell))}</th>'
        + "".join(_ring_cell(row, has_reached=has_reached) for row in steps[3 * cell - 3 : 3 * cell])
        + "</tr>"
        for cell in Cell
    )
    what = "driven / requested, reached" if has_reached else "driven / requested"
    return (
        f'<div><h4>Steps on the ring <span class="unit">{what}</span></h4><table><thead><tr><th scope="col">from</th>'
        '<th scope="col">hold</th><th scope="col">clockwise</th><th scope="col">anticlockwise</th></tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _ring_cell(row: CoverageRow, *, has_reached: bool) -> str:
    mark = ' class="never"' if row.driven == 0 else ""
    reached = f", {row.reached}" if has_reached else ""
    never = ' <span class="flag">never</span>' if row.driven == 0 else ""
    return f"<td{mark}>{row.driven} / {row.requested}{reached}{never}</td>"


def _bars(row: CoverageRow, top: int) -> str:
    inner = _meter("driven", row.driven, top) + ("" if row.reached is None else _meter("reached", row.reached, top))
    return f'<span class="bars" aria-hidden="true">{_meter("requested", row.requested, top)}{inner}</span>'


def _bar(count: int, total: int) -> str:
    return f'<span class="bars" aria-hidden="true">{_meter("driven", count, total)}</span>'


def _meter(kind: str, value: int, top: int) -> str:
    share = 100 * value / top if top else 0
    return (
        f'<svg class="meter {kind}" viewBox="0 0 100 4" preserveAspectRatio="none">'
        f'<rect width="{share:.1f}" height="4"/></svg>'
    )


def _details(summary: str, body: str) -> str:
    return f"<details><summary>{summary}</summary>{body}</details>"


def _lines(lines: Iterable[str]) -> str:
    return "".join(f"<div>{text(line)}</div>" for line in lines)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _of(count: int, asked: int) -> str:
    return str(count) if count == asked else f"{count} of {asked}"


def _plural(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"
