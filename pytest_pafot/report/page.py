"""The report page: one self-contained HTML file, made from the data that all items send; it needs no network.

A page has a list of findings, an article on each, and each search. Without its scripts it shows the same text.
"""

from __future__ import annotations

import json
import pickle
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any
from urllib.parse import quote

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.campaign.events import Ending, SearchSummary
from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.findings.labels import Label
from pytest_pafot.findings.severity import Severity
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.report.page_data import (
    Chains,
    Errors,
    Paragraph,
    Report,
    RunView,
)
from pytest_pafot.report.terminal import parameter_shares
from pytest_pafot.support.errors import flag
from pytest_pafot.support.files import write_whole
from pytest_pafot.support.markup import content_hash, json_in_script
from pytest_pafot.support.text import plural, visible_lines
from pytest_pafot.support.versions import installed_versions

# The HTML that the report page has without its scripts: a list of findings, an article on each, and each search.


def text(value: object) -> str:
    """Escape a text for HTML, so that nothing in it is markup. Unprintable characters become visible escapes."""
    return escape(visible_lines(str(value)), quote=True)


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """Return pairs of name and value as an HTML description list."""
    rows = "".join(f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{rows}</dl>' if rows else ""


def copyable(command: str) -> str:
    """Return the HTML of a command with a button that copies the command."""
    return (
        f'<p class="copyline"><span class="label">Command</span><code>{text(command)}</code>'
        '<button type="button" class="copy" data-copy="code" aria-label="Copy: Command">Copy</button></p>'
    )


def table(head: str, rows: Iterable[str]) -> str:
    """Build an HTML table from its head, made by :func:`columns`, and its rows, made by :func:`row`."""
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def columns(*names: str) -> str:
    """Build the head of an HTML table from the names of its columns."""
    return "".join(f'<th scope="col">{name}</th>' for name in names)


def row(name: str, *cells: object) -> str:
    """Build a row of an HTML table. The name and the cells are HTML already, so they are not escaped."""
    return f'<tr><th scope="row">{name}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'


# The page's text on findings without a script: their list, and an article on each with a place for its picture.

SYMBOLS = {"ego": "\u25cf", "npc": "\u25cb", "both": "\u25d0", "none": "\u2013", "check": "\u25b2", "error": "\u25a0"}
"""Symbols by who is responsible, of a failed check, or of an error of the ego's policy.

They differ at a glance, even without colour.
"""

FOUND_IN = "found in generation"
MEANINGS = {
    FOUND_IN: "The search drives one generation of scenarios after another; 0 is the first.",
}
"""Explanations of the tags that begin with these words."""

WHO = {**AT_FAULT, "check": "failed check", "error": "policy error"}


def finding_keys(findings: Iterable[RunView]) -> tuple[str, ...]:
    """Return a unique key for each finding, for links and files: its id, with a number if several findings share it."""
    keys: dict[str, None] = {}
    for finding in findings:
        number = 1
        while (key := finding.id if number == 1 else f"{finding.id}-{number}") in keys:
            number += 1
        keys[key] = None
    return tuple(keys)


def finding_list(findings: Sequence[RunView]) -> str:
    """Return an HTML list of links to all findings, with counts; an empty text if there are none."""
    if not findings:
        return ""
    tests: dict[str, dict[str, list[str]]] = {}
    labels: dict[str, set[str]] = {}  # of each test; a label that all its findings have is said in its heading
    for finding in findings:
        labels.setdefault(finding.test[0], set()).add(finding.label.partition(" (")[0])
    for index, (key, finding) in enumerate(zip(finding_keys(findings), findings, strict=True)):
        meta = ", ".join(_tags(finding))
        # The text that the filter searches.
        searched = [finding.node_id, finding.headline, finding.assertion, meta, finding.path]
        words = " ".join(searched).lower()
        heading, parameters = finding.test
        kind, badge = _kind(finding), "" if len(labels[heading]) == 1 else finding.label.partition(" (")[0]
        name, dash, number = finding.id.rpartition("-") if "-" in finding.id else (finding.id, "", "")
        tests.setdefault(heading, {}).setdefault(parameters, []).append(
            f'<li><a href="#finding={text(quote(key, errors="replace"))}" data-index="{index}" data-key="{text(key)}" '
            f'data-outcome="{text(kind)}" data-words="{text(words)}" title="{text(finding.headline)}">'
            f'<span class="mark" aria-hidden="true">{SYMBOLS.get(_who(finding), "?")}</span>'
            f'<span class="line"><span class="id"><span class="kind">{text(name)}</span>{dash}{text(number)}</span>'
            f'<span class="brief">{text(_brief(finding))}</span></span>'
            + (f'<span class="badge">{text(badge)}</span>' if badge else "")
            + "</a></li>"
        )
    counts = Counter(map(_who, findings))
    names = [*(name for name in SYMBOLS if counts[name]), *sorted(set(counts) - set(SYMBOLS))]
    summary = ", ".join(
        f"{SYMBOLS.get(name, '?')} "
        + (plural(counts[name], WHO[name]) if name in ("check", "error") else f"{counts[name]} {WHO.get(name, name)}")
        for name in names
    )
    is_one = len(tests) == 1 and list(tests[findings[0].test[0]]) == [""]
    said = {test: min(each) for test, each in labels.items() if len(each) == 1}
    if len(said) == len(tests) and len(set(said.values())) == 1 and (same := min(said.values())):
        said, summary = {}, f"{summary}; {'all ' if len(findings) > 1 else ''}{same}"
    above = f'<p class="summary">{text(summary)}</p>{_filter(findings) if len(findings) > 1 else ""}'
    if is_one:
        return f'{above}<div class="rows"><ol>{"".join(tests[findings[0].test[0]][""])}</ol></div>'
    listed = f'{above}<div class="rows">'
    for place, (title, policies) in enumerate(tests.items()):
        count = ", ".join(filter(None, [str(sum(map(len, policies.values()))), text(said.get(title, ""))]))
        listed += f'<div class="group"><h3 id="group-{place}">{text(title)} <span class="count">{count}</span></h3>'
        for order, (parameters, items) in enumerate(policies.items()):
            label = f"group-{place}-{order}" if parameters else f"group-{place}"
            policy = f'<h4 id="{label}">{text(parameters)} <span class="count">{len(items)}</span></h4>'
            ordered = f'<ol aria-labelledby="{label}">{"".join(items)}</ol>'
            listed += f'<div class="group">{policy}{ordered}</div>' if parameters else ordered
        listed += "</div>"
    return f"{listed}</div>"


def _brief(finding: RunView) -> str:
    """Return when and what, so short that it fits under a finding's name: ``4.2 s: NPC 3 ahead``. Its mark says who."""
    if finding.check is None and finding.event.kind not in ("collision", "ads_error", "hang"):
        return finding.headline
    time = finding.event.time if finding.check is None else finding.check.begin
    what = (finding.headline.partition(": ")[2] or finding.headline).removesuffix(f", {WHO.get(_who(finding))}")
    return f"{'' if time is None else f'{time:.1f} s: '}{what}"


def further_section(findings: Sequence[RunView], whole: int) -> str:
    """Return an HTML table of the findings that the page does not show whole; an empty text if there are none.

    ``whole`` is the number of findings that it shows whole.
    """
    if not findings:
        return ""
    alone = flag("report", "one.html")
    rows = (
        row(
            text(finding.id),
            f"<p>{text('; '.join(filter(None, [finding.headline, finding.besides, finding.deadline])))}</p>"
            f'<p class="note">{text(", ".join([*_tags(finding)[1:], finding.path or finding.node_id]))}</p>'
            f"<code>{text(f'{finding.command} {alone}')}</code>",
        )
        for finding in findings
    )
    listed = table(columns("finding", "what happened, its file, and the command for a page of it alone"), rows)
    count = plural(len(findings), "further finding")
    note = f"This page shows the {whole} worst findings whole. The others follow, the worst first."
    return (
        f'<section class="campaigns" id="further" aria-label="Further findings"><h2>{count}</h2>'
        f'<p class="note">{note}</p><div class="scroll">{listed}</div></section>'
    )


def parameter_section(searches: Iterable[SearchSummary]) -> str:
    """Return for each parametrised test an HTML table of how often which parameters failed; empty without one."""
    shown = ""
    for test, shares in parameter_shares(searches).items():
        rows = (
            row(
                text(each.parameters),
                f"{each.failing} of {each.runs}",
                "" if each.impact is None else f"{each.impact:.1f} m/s",
            )
            for each in shares
        )
        names = "parameters", "failing random scenarios", "hardest impact"
        shown += f'<h3 class="id">{text(test)}</h3><div class="scroll">{table(columns(*names), rows)}</div>'
    if not shown:
        return ""
    title = "Parameters that fail most"
    return f'<section class="campaigns" id="parameters" aria-label="{title}"><h2>{title}</h2>{shown}</section>'


def _session_section(report: Report) -> str:
    """Return the HTML of the facts on the session and of its command; empty if there are none."""
    shown = facts(report.facts) + (copyable(report.command) if report.command else "")
    title = "<h2>Session</h2>"
    return f'<section class="campaigns session" aria-label="Session">{title}{shown}</section>' if shown else ""


def _filter(findings: Sequence[RunView]) -> str:
    """Return the input fields that filter the list of findings. They work only with the page's script."""
    options = ""
    for kind, count in sorted(Counter(map(_kind, findings)).items()):
        options += f'<option value="{text(kind)}">{text(kind.replace("_", " "))} ({count})</option>'
    return (
        '<div class="filter"><input type="search" id="filter" placeholder="Filter" aria-controls="list" '
        'aria-label="Filter findings by text"><select id="outcome" aria-label="Filter findings by outcome">'
        f'<option value="">all outcomes</option>{options}</select>'
        '<p id="nothing" hidden>No finding matches.</p></div>'
    )


def finding_article(finding: RunView, index: int) -> str:
    """Return the HTML article on one finding, with an empty place for its picture."""
    claim = f'<p class="assertion"><code>{text(finding.assertion)}</code></p>' if finding.assertion else ""
    tags = _tags(finding)[1 if finding.sentences or finding.check is not None else 0 :]  # said above
    sentences = "".join(f'<p class="sentence">{text(each)}</p>' for each in finding.sentences)
    tags += [finding.traffic] if finding.traffic else []
    mark = f'<span class="mark" aria-hidden="true">{SYMBOLS.get(_who(finding), "?")}</span>'
    deadline = f'; <span class="deadline">{text(finding.deadline)}</span>' if finding.deadline else ""
    besides = f'<p class="besides">{text(finding.besides)}{deadline}</p>' if finding.besides else ""
    own = "" if finding.besides else deadline
    parts = [
        f'<article id="finding-{index}" data-index="{index}" tabindex="-1" aria-labelledby="headline-{index}">',
        f'<header><p class="id">{text(finding.id)}</p>',
        f'<h2 id="headline-{index}">{mark} {text(finding.headline)}{own}</h2>',
        sentences + (claim if finding.check is None else ""),
        besides,
        copyable(finding.command) if finding.command else "",
        f'<ul class="tags">{"".join(map(_tag, tags))}</ul>',
        "</header>",
        '<div class="player"></div>' if finding.times else '<p class="empty">There is no run to draw.</p>',
        _happened_section(finding.happened) if finding.happened else "",
        _shrunk_section(finding.found, finding.shrunk) if finding.found and finding.shrunk else "",
        _file_section(finding) if finding.yaml else "",
        "</article>",
    ]
    return "".join(parts)


def _tag(tag: str) -> str:
    """Return the HTML of a tag, with an explanation if it is a word of the search."""
    meaning = next((words for beginning, words in MEANINGS.items() if tag.startswith(beginning)), "")
    title = f' title="{text(meaning)}"' if meaning else ""
    return f"<li{title}>{text(tag)}</li>"


def _happened_section(paragraphs: Iterable[Paragraph]) -> str:
    """Return the HTML of what is known of a finding beside the sentences above its picture."""
    shown = ""
    for title, sentences, groups in paragraphs:
        run_in = f"<b>{text(title)}.</b> " if title else ""
        shown += f"<p>{run_in}{text(sentences)}</p>"
        for whom, rows in groups:
            # A browser would break an arrow of two characters between them.
            drawn = [text(each.replace(" -> ", " \u2192 ")) for each in rows]
            lines = "".join(f"<li><code>{each}</code></li>" for each in drawn)
            shown += (f"<h4>{text(whom)}</h4>" if whom else "") + f"<ul>{lines}</ul>"
    return f'<section class="happened"><h3>What happened</h3>{shown}</section>'


def _shrunk_section(found: Chains, shrunk: Chains) -> str:
    """Return the HTML of a scenario as it was found next to what it shrank to, in columns of equal width."""
    columns_of = ""
    for title, (size, npcs) in (("Found", found), ("Shrunk", shrunk)):
        chains = "".join(
            f"<li><b>NPC {number}</b><ol>{''.join(f'<li>{text(each)}</li>' for each in chain)}</ol></li>"
            for number, chain in enumerate(npcs)
        )
        columns_of += f'<div><h4>{title}: {text(size)}</h4><ul class="chains">{chains}</ul></div>'
    return f'<section><h3>Found and shrunk</h3><div class="pair">{columns_of}</div></section>'


def _file_section(finding: RunView) -> str:
    """Return the HTML of the text of a finding's file."""
    return (
        '<section class="keep">'
        f'<div class="yaml"><div class="bar"><h4>{text(finding.path or finding.id + SUFFIX)}</h4>'
        '<button type="button" class="copy" data-copy="pre">Copy the file</button></div>'
        f'<pre tabindex="0" aria-label="The file of this finding">{text(finding.yaml)}</pre></div></section>'
    )


def _who(finding: RunView) -> str:
    if finding.check is not None:
        return "check"
    return "error" if finding.event.kind in ("ads_error", "hang") else finding.responsibility


def _kind(finding: RunView) -> str:
    return finding.event.kind if finding.check is None else WHO["check"]


def _tags(finding: RunView) -> list[str]:
    """Return short texts that distinguish a finding from others, such as who is responsible for the collision."""
    tags = [WHO.get(_who(finding), finding.responsibility)]
    if finding.check is not None and finding.responsibility != "none" and not finding.besides:
        tags.append(f"{WHO.get(finding.responsibility, finding.responsibility)} for the collision")
    tags += [plural(finding.runs, "run")] if finding.runs else []
    tags += [] if finding.sighting is None else [f"{FOUND_IN} {finding.sighting.finding.found.generation}"]
    return [*tags, finding.label] if finding.label else tags


# The page's text on a search.


def search_article(search: SearchSummary, index: int, *, is_open: bool = True) -> str:
    """Return the HTML article on one search; ``is_open`` is False if it is folded until the reader opens it."""
    made, end = search.generations, search.reason.after_ended
    figures = (
        ("algorithm", search.algorithm),
        ("seed", search.seed),
        ("generations", made if search.asked in (None, made) else f"{made} of {search.asked}"),
        ("runs", search.runs),
        ("not run again", search.known_runs),
        ("ended", end),
    )
    folded = f"{plural(search.runs, 'run')}, {search.failing} failing"
    folded += f", {plural(len(search.warnings), 'warning')}" if search.warnings else ""
    folded += f", ended {end}" if search.reason.is_broken_off else ""
    warnings = "".join(f'<p class="warning"><b>Warning</b> {text(warning)}</p>' for warning in search.warnings)
    return (
        f'<article class="campaign" aria-labelledby="campaign-{index}">'
        f"<details{' open' if is_open else ''}>"
        f'<summary><h3 id="campaign-{index}" class="id">{text(search.node_id)}</h3>'
        f'<span class="meta">{text(folded)}</span></summary>{facts(figures)}{warnings}'
        f'<div class="columns">{_counts("Runs by outcome", search.outcomes)}'
        f"{_counts('Runs by responsibility', search.responsibilities)}</div></details></article>"
    )


def _counts(title: str, counts: Mapping[str, int]) -> str:
    """Return an HTML table of counts, the largest first, each with a bar; a bar of all of them fills the width."""
    total = sum(counts.values())
    rows = "".join(
        row(
            text(name.replace("_", " ")),
            count,
            '<svg class="meter" viewBox="0 0 100 4" preserveAspectRatio="none" aria-hidden="true">'
            f'<rect width="{100 * count / total if total else 0:.1f}" height="4"/></svg>',
        )
        for name, count in sorted(counts.items(), key=lambda each: (-each[1], each[0]))
    )
    return f"<div><h4>{title}</h4><table><tbody>{rows}</tbody></table></div>" if rows else ""


# The report as one self-contained HTML page: it needs no network, no library and no other file.

ASSETS = "pytest_pafot.report.assets"
STYLE = "page.css"
SCRIPTS = ("dom.js", "scene.js", "charts.js", "player.js", "main.js")
"""The page's scripts, in the order in which they run. Each uses what the earlier scripts define."""

DRAWN = (
    "headline", "times", "vehicles", "road", "grid", "instructions", "decisions", "event", "check",
)  # fmt: skip
"""What the scripts read of a finding. The page has everything else as text."""

INTERRUPTED = '<p class="warning">The session was interrupted. This report has what ran before that.</p>'


def render_page(report: Report) -> str:
    """Render a report as one self-contained HTML page.

    Equal reports give equal text.
    """
    style = _asset(STYLE)
    script = '"use strict";\n(() => {\n' + "\n".join(map(_asset, SCRIPTS)) + "})();\n"
    # The hashes allow only this style and these scripts, and no connection to anywhere.
    policy = f"default-src 'none'; style-src {content_hash(style)}; script-src {content_hash(script)}"
    is_open = len(report.searches) == 1
    # Failures without a finding, with the text that pytest shows for them.
    ended = {each.node_id: "The search ended with an error." for each in report.searches if each.reason is Ending.ERROR}
    errors = "".join(
        f'<article class="error" role="alert"><h2>{text(node_id)}</h2>'
        f"<p>{ended.get(node_id, 'It failed, and no finding on this page shows why.')}</p>"
        f"<pre>{text(failure.strip())}</pre></article>"
        for node_id, failure in report.errors
    )
    searches = "".join(search_article(each, index, is_open=is_open) for index, each in enumerate(report.searches))
    total = len(report.findings) + len(report.further)
    rest = plural(len(report.further), "further finding")
    link = f'<p class="note"><a href="#further">{rest}, as a table</a></p>' if report.further else ""
    section = f'<section class="campaigns" aria-label="Searches"><h2>Searches</h2>{searches}</section>'
    return Template(_asset("page.html")).substitute(
        title=text(report.title),
        policy=f"{policy}; base-uri 'none'; form-action 'none'",
        style=style,
        script=script,
        interrupted=INTERRUPTED if report.is_interrupted else "",
        count=len(report.findings) if not report.further else f"{len(report.findings)} of {total}",
        errors=errors,
        further=further_section(report.further, len(report.findings)) + parameter_section(report.searches),
        list=(finding_list(report.findings) or f'<p class="empty">{_nothing_found(report)}</p>') + link,
        articles="".join(finding_article(finding, index) for index, finding in enumerate(report.findings)),
        searches=(section if searches else "") + _session_section(report),
        data=data_json(report),
    )


def data_json(report: Report) -> str:
    """Return the report's data for the page's scripts, as JSON that is safe inside a ``<script>`` element.

    It has only what they read. Nothing in the JSON can end the element or begin a comment, and everything beyond ASCII,
    such as U+2028, is escaped.
    """
    findings = [asdict(replace(finding, sighting=None)) for finding in report.findings]
    data = {"findings": [{name: finding[name] for name in DRAWN} for finding in findings]}
    return json_in_script(json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":")))


def _nothing_found(report: Report) -> str:
    """Return the sentence on a page without findings. It says that the property held only if nothing was cut short."""
    ends = {search.reason for search in report.searches}
    if report.errors or Ending.ERROR in ends:
        return "No findings, but an error stopped something before its end."
    if report.is_interrupted or ends & {Ending.UNKNOWN, Ending.INTERRUPTED}:
        return "No findings before the interrupt. The scenarios that had not run by then are untested."
    if any(search.failing for search in report.searches):
        return "No new findings. Some runs failed, but saved scenarios already cover these failures."
    if not all(end.is_complete for end in ends):
        return "No findings before time ran out. The property held in every run that was evaluated by then."
    return "No findings. The property held in every evaluated run."


def _asset(name: str) -> str:
    return files(ASSETS).joinpath(name).read_text(encoding="utf-8")


# The report page of a session: the data from all items are collected, sorted and written to files.

WHOLE = 100
"""The largest number of findings that a page shows whole, the worst ones: each takes about 80 kB of the page."""


@dataclass(slots=True, kw_only=True)
class Draft:
    """The part of a session's report that is known so far; ``--pafot-report`` names the target.

    Findings are stored by node id. What only whole findings show of a finding is compressed, because it
    takes half a megabyte, and a session may have thousands.
    """

    target: str
    findings: dict[str, RunView] = field(default_factory=dict)
    _whole: dict[str, bytes] = field(default_factory=dict)

    def take(self, finding: RunView) -> None:
        """Add the view of a failing finding."""
        self.findings[finding.node_id] = _as_row(finding)
        self._whole[finding.node_id] = zlib.compress(pickle.dumps(replace(finding, sighting=None)), level=1)

    def report(
        self,
        *,
        project: str,
        command: str,
        findings: Iterable[RunView],
        errors: Errors,
        is_interrupted: bool,
        searches: Sequence[SearchSummary] = (),
        replays: Iterable[Sighting] = (),
    ) -> Report:
        """Return the finished report, in an order that does not depend on which item ran first.

        ``findings`` are the findings of this draft, with what became known at the end of the session. Only the worst
        are whole findings of the report. ``searches`` and ``replays`` are those that it shows.
        """
        ranked = sorted(findings, key=_rank)
        whole = [self._completed(finding) for finding in ranked[:WHOLE]]
        # The worst test first, of each test the worst parameters, and of these the worst finding.
        groups = list(dict.fromkeys(finding.test for finding in whole))
        tests = list(dict.fromkeys(test for test, _ in groups))
        return Report(
            title=f"{project}: {_numbers(ranked, errors)}",
            facts=tuple(_facts(searches, replays)),
            command=command,
            findings=tuple(sorted(whole, key=lambda each: (tests.index(each.test[0]), groups.index(each.test)))),
            further=tuple(map(_as_row, ranked[WHOLE:])),
            searches=tuple(sorted(searches, key=lambda search: search.node_id)),
            errors=errors,
            is_interrupted=is_interrupted,
        )

    def _completed(self, finding: RunView) -> RunView:
        """Return a finding with everything that was compressed of it."""
        packed = self._whole.get(finding.node_id)
        if packed is None:
            return finding
        whole: RunView = pickle.loads(zlib.decompress(packed))  # noqa: S301  (of this process)
        return replace(whole, runs=finding.runs, label=finding.label, sighting=finding.sighting)


def _facts(searches: Iterable[SearchSummary], replays: Iterable[Sighting]) -> Iterator[tuple[str, str]]:
    if seeds := dict.fromkeys(search.base_seed for search in searches):
        yield "base seed" if len(seeds) == 1 else "base seeds", ", ".join(map(str, seeds))
    replays = sorted(replays, key=lambda each: each.node_id)
    if replays:
        counts = sorted(Counter(each.result for each in replays).items())
        results = ", ".join(f"{count} {result}" for result, count in counts)
        yield "replayed", f"{plural(len(replays), 'saved scenario')}: {results}"
    for each in replays:
        if each.label in (Label.DRIFTED, Label.JUDGED_OTHERWISE):
            yield Label.DRIFTED, f"{each.node_id}: {each.detail}"
        elif each.elsewhere:
            yield each.label, f"{each.node_id}: {each.elsewhere}"
    yield from installed_versions().items()
    yield "written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def write_report(target: str, path: Path, report: Report) -> str:
    """Write a report to a path, the absolute path of ``target``, and return a line on what was written.

    Raises:
        OSError: if the file cannot be written.
    """
    write_whole(path, render_page(report).encode())
    return f"report: {target} ({_numbers((*report.findings, *report.further), report.errors)})"


def _as_row(finding: RunView) -> RunView:
    """Return a finding without what only a whole finding shows: its run, and the text of its file."""
    check = None if finding.check is None else replace(finding.check, values=(), broken=())
    road = replace(finding.road, lanes=(), shapes=())
    nothing: dict[str, Any] = dict.fromkeys(("vehicles", "times", "instructions", "decisions", "grid", "happened"), ())
    nothing |= {"found": None, "shrunk": None}
    return replace(finding, yaml="", check=check, road=road, **nothing)


def _rank(finding: RunView) -> tuple[Any, ...]:
    """Return the key that sorts findings: new before known, then by responsibility, severity and number of runs."""
    severity = None
    if finding.sighting is not None:
        severity = finding.sighting.severity
    worst = Severity.worst_first(finding.responsibility, severity)
    return not finding.label.startswith(Label.NEW), *worst, -finding.runs, finding.node_id


def _numbers(findings: Sequence[object], errors: Sequence[object]) -> str:
    """Return the number of errors, if there are any, and of findings, in words."""
    found = plural(len(findings), "finding")
    return f"{plural(len(errors), 'error')}, {found}" if errors else found
