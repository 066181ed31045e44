"""What the page says of findings without a script: their list, and an article on each with a place for its picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from textwrap import dedent
from urllib.parse import quote

from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.grid import Cell
from pytest_pafot.report.markup import columns, copyable, details, row, table, text
from pytest_pafot.report.page_data import CheckView, FindingView, InstructionView, ShrinkView
from pytest_pafot.text import plural

SYMBOLS = {"ego": "\u25cf", "npc": "\u25cb", "both": "\u25d0", "none": "\u2013", "check": "\u25b2"}
"""Beside the word, so that a glance tells responsibilities apart without colour."""

WHO = {
    "ego": "ego responsible",
    "npc": "NPC responsible",
    "both": "both responsible",
    "none": "nobody responsible",
    "check": "failed check",
}

SAVE_RUN = '<p class="save"><button type="button" class="save-run" hidden>Save the run as CSV</button></p>'
"""Shown by a script that can do it."""


def finding_keys(findings: Iterable[FindingView]) -> tuple[str, ...]:
    """By which links and files name findings: their ids, numbered where several tests share one."""
    keys: dict[str, None] = {}
    for finding in findings:
        number = 1
        while (key := finding.id if number == 1 else f"{finding.id}-{number}") in keys:
            number += 1
        keys[key] = None
    return tuple(keys)


def finding_list(findings: Sequence[FindingView]) -> str:
    """Links to all findings, with counts; empty without any."""
    if not findings:
        return ""
    groups: dict[str, list[str]] = {}
    for index, (key, finding) in enumerate(zip(finding_keys(findings), findings, strict=True)):
        groups.setdefault(finding.test, []).append(_list_item(finding, key, index))
    counts = Counter(map(_who, findings))
    names = [*(name for name in SYMBOLS if counts[name]), *sorted(set(counts) - set(SYMBOLS))]
    summary = ", ".join(
        plural(counts[name], WHO[name]) if name == "check" else f"{counts[name]} {WHO.get(name, name)}"
        for name in names
    )
    listed = f'<p class="summary">{text(summary)}</p>{_filter(findings) if len(findings) > 1 else ""}'
    if len(groups) == 1:
        return f"{listed}<ol>{''.join(groups[findings[0].test])}</ol>"
    for number, (test, items) in enumerate(groups.items()):
        name = f'<h3 id="group-{number}">{text(test.rpartition("::")[2])} <span class="count">{len(items)}</span></h3>'
        listed += f'<div class="group">{name}<ol aria-labelledby="group-{number}">{"".join(items)}</ol></div>'
    return listed


def _list_item(finding: FindingView, key: str, index: int) -> str:
    meta = ", ".join(_tags(finding))
    # What the filter looks through.
    words = " ".join([finding.node_id, finding.headline, finding.assertion, meta, finding.path]).lower()
    return (
        f'<li><a href="#finding={text(quote(key, errors="replace"))}" data-index="{index}" data-key="{text(key)}" '
        f'data-outcome="{text(_kind(finding))}" data-words="{text(words)}">'
        f'<span class="mark" aria-hidden="true">{SYMBOLS.get(_who(finding), "?")}</span>'
        f'<span class="what"><span class="id">{text(finding.id)}</span><span class="headline">{text(finding.headline)}'
        f'</span><span class="meta">{text(meta)}</span></span></a></li>'
    )


def _filter(findings: Sequence[FindingView]) -> str:
    """Fields that leave some findings out of the list; they need the script."""
    options = ""
    for kind, count in sorted(Counter(map(_kind, findings)).items()):
        options += f'<option value="{text(kind)}">{text(kind.replace("_", " "))} ({count})</option>'
    return (
        '<div class="filter"><input type="search" id="filter" placeholder="Filter" aria-controls="list" '
        'aria-label="Filter findings by text"><select id="outcome" aria-label="Filter findings by outcome">'
        f'<option value="">all outcomes</option>{options}</select>'
        '<p id="nothing" hidden>No finding is like this.</p></div>'
    )


def finding_article(finding: FindingView, index: int) -> str:
    """One finding in words; an empty place for its picture."""
    parts = [
        f'<article id="finding-{index}" data-index="{index}" tabindex="-1" aria-labelledby="headline-{index}">',
        f'<header><p class="id">{text(finding.id)}</p><h2 id="headline-{index}">{text(finding.headline)}</h2>',
        _assertion(finding) if finding.check is None else _check_figures(finding.check),
        f"{_tag_list(finding)}{_test(finding)}</header>",
        '<div class="player"></div>' if finding.times else '<p class="empty">There is no run to draw.</p>',
        _explanation(finding),
        "" if finding.shrink is None else _shrink_section(finding.shrink),
        details("Instructions as a table", instruction_table(finding.instructions)),
        _keep_section(finding) if finding.yaml else "",
        "</article>",
    ]
    return "".join(parts)


def _explanation(finding: FindingView) -> str:
    words = text(dedent(finding.explanation).strip())
    return f'<section><h3>What happened</h3><pre class="explanation">{words}</pre></section>' if words else ""


def _test(finding: FindingView) -> str:
    return f'<p class="test">{text(finding.node_id)}</p>' if finding.node_id else ""


def _keep_section(finding: FindingView) -> str:
    """The command that runs it again, where there is one, its run as a table, and its file."""
    command = f"<h3>Run it again</h3>{copyable('Command', finding.command)}" if finding.command else ""
    return (
        f'<section class="keep">{command}{SAVE_RUN if finding.drive else ""}'
        f'<div class="yaml"><div class="bar"><h4>{text(finding.path or finding.id + SUFFIX)}</h4>'
        '<button type="button" class="copy" data-copy="pre">Copy the file</button></div>'
        f'<pre tabindex="0" aria-label="The file of this finding">{text(finding.yaml)}</pre></div></section>'
    )


def _assertion(finding: FindingView) -> str:
    return f'<p class="assertion"><code>{text(finding.assertion)}</code></p>' if finding.assertion else ""


def _check_figures(check: CheckView) -> str:
    """Value, bound and moment of a check, and for how long its bound was broken."""
    unit = f' <span class="unit">{text(check.unit)}</span>' if check.unit else ""
    seconds = ' <span class="unit">s</span>'
    bounds = (("at most", check.at_most), ("at least", check.at_least))
    figures = [(check.name, "no number" if check.value is None else f"{check.value:.4g}{unit}")]
    figures += [(name, f"{bound:g}{unit}") for name, bound in bounds if bound is not None]
    figures += [] if check.time is None else [("worst at", f"{check.time:.2f}{seconds}")]
    if check.broken:
        times = f" {len(check.broken)} times" if len(check.broken) > 1 else ""
        first, last = check.broken[0][0], check.broken[-1][1]
        figures.append((f"broken{times}", f"{first:.1f} to {last:.1f}{seconds}"))
    shown = "".join(f"<div><dt>{text(name)}</dt><dd>{figure}</dd></div>" for name, figure in figures)
    return f'<dl class="figures">{shown}</dl>'


def _who(finding: FindingView) -> str:
    return finding.responsibility if finding.check is None else "check"


def _kind(finding: FindingView) -> str:
    return finding.event.kind if finding.check is None else WHO["check"]


def _tags(finding: FindingView) -> list[str]:
    """What tells a finding from others at a glance."""
    tags = [WHO.get(_who(finding), finding.responsibility)]
    if finding.check is not None and finding.responsibility != "none":
        tags.append(f"{WHO.get(finding.responsibility, finding.responsibility)} for the collision")
    tags += [plural(finding.runs, "run")] if finding.runs else []
    tags += [] if finding.generation is None else [f"first in generation {finding.generation}"]
    return [*tags, finding.label] if finding.label else tags


def _tag_list(finding: FindingView) -> str:
    who, *tags = _tags(finding)
    tags += [each for each in (finding.prevention, finding.perception) if each]
    mark = f'<span aria-hidden="true">{SYMBOLS.get(_who(finding), "?")}</span>'
    items = "".join(f"<li>{text(tag)}</li>" for tag in tags)
    return f'<ul class="tags"><li>{mark} {text(who)}</li>{items}</ul>'


def _shrink_section(shrink: ShrinkView) -> str:
    notes = "".join(f'<p class="note">{text(note)}</p>' for note in shrink.notes)
    if shrink.original == shrink.shrunk:
        return f"<section><h3>Nothing simpler found in {plural(shrink.rollouts, 'run')}</h3>{notes}</section>"
    chains = ("".join(f"<div>{text(chain)}</div>" for chain in each) for each in (shrink.original, shrink.shrunk))
    rows = (
        row("NPCs", shrink.original_npcs, shrink.shrunk_npcs),
        row("instructions", shrink.original_instructions, shrink.shrunk_instructions),
        row("chains", *chains, attributes=' class="chains"'),
    )
    sizes = table(f"<th></th>{columns('as found', 'shrunk')}", rows)
    title = f"Shrunk in {plural(shrink.rollouts, 'run')}"
    return f'<section><h3>{title}</h3>{notes}<div class="scroll">{sizes}</div></section>'


def instruction_table(instructions: Iterable[InstructionView]) -> str:
    """What the NPCs are told, and whether they did it."""
    rows = []
    for told in instructions:
        reached = "not reached" if told.arrived is None else f"at {told.arrived:.1f} s"
        cells = f"{told.start:.1f}", _goal(told), f"{told.speed:.1f}", reached if told.started else "not begun"
        rows.append(row(f"NPC {told.npc}", *cells, attributes="" if told.started else " class=unstarted"))
    head = columns("NPC", "from [s]", "cell or lane", "speed [m/s]", "reached")
    return f'<div class="scroll">{table(head, rows)}</div>'


def _goal(told: InstructionView) -> str:
    if told.lane:
        return "keep lane" if told.lane == "keep" else f"lane {told.lane}"
    names = [f"{cell} {Cell(cell).label}" for cell in (told.cell, told.requested)]
    return names[0] if told.requested == told.cell else f"{names[0]} (requested {names[1]})"
