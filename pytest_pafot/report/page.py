"""The report page: one HTML file that needs no network, and shows the same text if scripts are disabled."""

from __future__ import annotations

import json
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from itertools import groupby
from string import Template
from typing import Any
from urllib.parse import quote

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.corpus.layout import SEARCH_PART, SUFFIX, name_without
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.report.session import Session
from pytest_pafot.searches.events import Ending, Search
from pytest_pafot.support.process import installed_versions
from pytest_pafot.support.text import (
    capitalised,
    content_hash,
    json_in_script,
    plural,
    visible_lines,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """A finding on the page, with its data, the number of runs with this failure, its label and its replay command."""

    seen: Seen
    view: Mapping[str, Any]
    runs: int = 1
    label: str = ""
    command: str = ""

    @property
    def test(self) -> str:
        """The name of the finding's test, including parameters."""
        return self.seen.finding.test.rpartition("::")[2]

    @property
    def who(self) -> str:
        """The side responsible for the collision, or ``check`` or ``error``."""
        if self.view["check"] is not None:
            return "check"
        return (
            "error"
            if self.view["event"]["kind"] in ("ads_error", "hang")
            else self.seen.responsible
        )


def text(value: object) -> str:
    """Escape a string for HTML, and make unprintable characters visible."""
    return escape(visible_lines(str(value)), quote=True)


def prose(value: object) -> str:
    """Escape a string for HTML, with line breaks only where a reader expects them."""
    joined = re.sub(r"(?<=\d) (?=m\b|s\b)|(?<=NPC) (?=\d)", "\u00a0", text(value))
    return re.sub(r"(?<=\w\w)/|_|::|\[", r"\g<0><wbr>", joined)


def _facts(pairs: Iterable[tuple[str, object]]) -> str:
    rows = "".join(
        f"<div><dt>{text(name)}</dt><dd>{prose(value)}</dd></div>"
        for name, value in pairs
        if value != ""
    )
    return f'<dl class="facts">{rows}</dl>' if rows else ""


def _with_button(command: str) -> str:
    return (
        f'<div><p class="copyline"><span class="label">Command</span><code>{text(command)}</code>'
        '<button type="button" data-copy="code" aria-label="Copy: Command">Copy</button></p></div>'
    )


# The list of findings, and an article on each finding, with space for a picture.

# The symbols can be distinguished without colour.
SYMBOLS = {
    "ego": "\u25cf",
    "npc": "\u25cb",
    "both": "\u25d0",
    "none": "\u2013",
    "check": "\u25b2",
    "error": "\u25a0",
}

WHO = {**AT_FAULT, "check": "failed check", "error": "policy error"}


def mark(finding: Shown) -> str:
    """Return the HTML for a finding's symbol."""
    return f'<span class="mark" aria-hidden="true">{SYMBOLS.get(finding.who, "?")}</span>'


def _keys(findings: Iterable[Shown]) -> list[str]:
    ids = [finding.seen.id for finding in findings]
    before = (ids[:number].count(id_) for number, id_ in enumerate(ids))
    return [f"{id_}-{count + 1}" if count else id_ for id_, count in zip(ids, before, strict=True)]


def finding_list(findings: Sequence[Shown]) -> str:
    """Return an HTML list of links to all findings, grouped by test."""
    if not findings:
        return ""
    counts = Counter(each.who for each in findings)
    names = {
        who: f"{name}s" if counts[who] > 1 and who in ("check", "error") else name
        for who, name in WHO.items()
    }
    summary = ", ".join(
        f"{SYMBOLS.get(who, '?')} {counts[who]} {names.get(who, who)}" for who in sorted(counts)
    )
    listed = f'<p class="summary">{text(summary)}</p><div class="rows">'
    for test, group in groupby(
        zip(_keys(findings), findings, strict=True), key=lambda each: each[1].test
    ):
        listed += f"<h3>{text(test)}</h3><ol>"
        for key, finding in group:
            listed += (
                f'<li><a href="#finding={text(quote(key, errors="replace"))}" data-key="{text(key)}">{mark(finding)}'
                f'<span><span class="id">{text(finding.seen.id)}</span><span class="brief">'
                f"{text('; '.join(filter(None, [finding.view['headline'], finding.label])))}</span></span>"
                "</a></li>"
            )
        listed += "</ol>"
    return f"{listed}</div>"


def finding_article(finding: Shown, index: int) -> str:
    """Return the HTML article about one finding, with an empty element for its picture."""
    seen, view, is_check, responsible = (
        finding.seen,
        finding.view,
        finding.who == "check",
        finding.seen.responsible,
    )
    besides, traffic = view["besides"], STYLES[seen.finding.scenario.traffic].described
    tags = [
        finding.label,
        view["assertion"] * (not is_check),
        traffic,
        plural(finding.runs, "run"),
        seen.worst,
    ]
    if is_check and responsible != "none" and not besides:
        tags.append(f"{WHO.get(responsible, responsible)} for the collision")
    parts = [
        f'<article id="finding-{index}" tabindex="-1" aria-labelledby="headline-{index}"><header>',
        f'<p class="id">{prose(finding.test)} <span>{text(seen.id)}</span></p>',
        f'<h2 id="headline-{index}">{mark(finding)} {prose(capitalised(view["headline"]))}</h2>',
        '<div class="told"><div>',
        *(
            f'<p class="sentence{" deed" * (each == view["deed"])}">{prose(each)}</p>'
            for each in view["sentences"]
        ),
    ]
    if besides:
        parts.append(
            f'<p class="besides">{prose(besides)} <span class="deed">{prose(view["deed"])}</span></p>'
        )
    parts += [
        f"</div>{_paragraphs(view['moment'])}</div></header>",
        '<div class="player"></div>'
        if view["times"]
        else '<p class="empty">There is no run to draw.</p>',
        f"<footer><ul>{''.join(f'<li>{text(tag)}</li>' for tag in tags if tag)}</ul>",
        f"{_with_button(finding.command)}</footer>",
        f"<h3>What happened</h3>{_paragraphs(view['happened'])}" if view["happened"] else "",
        f'<section class="yaml"><div class="bar"><h4>{prose(seen.path or seen.id + SUFFIX)}</h4>',
        '<button type="button" data-copy="pre">Copy the file</button></div>',
        f'<pre tabindex="0" aria-label="The file of this finding">{text(view["yaml"])}</pre></section></article>',
    ]
    return "".join(parts)


def _paragraphs(paragraphs: Iterable[Sequence[Any]]) -> str:
    shown = ""
    for title, sentences, groups in paragraphs:
        run_in = f"<b>{text(title)}.</b> " if title else ""
        shown += f"<p>{run_in}{prose(sentences)}</p>"
        for whom, rows in groups:
            lines = "".join(f"<li><code>{text(each)}</code></li>" for each in rows)
            shown += (f"<h4>{text(whom)}</h4>" if whom else "") + f"<ul>{lines}</ul>"
    return f'<section class="happened">{shown}</section>' if shown else ""


def _further(findings: Sequence[Seen], whole: int, session: Session) -> str:
    if not findings:
        return ""
    rows = "".join(
        f"<li><b>{text(each.id)}</b> {text(each.headline)}<br>"
        f"<code>{text(session.command(each, 'python', '-m', 'pytest'))}</code></li>"
        for each in findings
    )
    note = f"This page shows the {whole} worst findings in full. The others are listed here, the worst first."
    return _section(
        plural(len(findings), "more finding"),
        f'<p class="note">{note}</p><ul id="further">{rows}</ul>',
    )


def _section(title: str, content: str) -> str:
    return f'<section class="searches"><h2>{text(title)}</h2>{content}</section>' if content else ""


def _search(search: Search) -> str:
    made, asked = search.generations, search.asked.get("generations", search.generations)
    figures = (
        ("runs", search.runs),
        ("failed", search.failing),
        ("generations", (made or "") if asked == made else f"{made} of {asked}"),
        ("outcomes", _counts(search.outcomes)),
        ("responsibility", _counts(search.responsibilities)),
        ("algorithm", search.algorithm),
        ("seed", search.seed),
        ("ended", search.reason.after_ended),
    )
    warnings = "".join(
        f'<p class="warning"><b>Warning</b> {text(warning)}</p>' for warning in search.warnings
    )
    return f'<article class="searches"><h3 class="id">{prose(search.node_id)}</h3>{_facts(figures)}{warnings}</article>'


def _counts(counts: Mapping[str, int]) -> str:
    ranked = sorted(counts.items(), key=lambda each: (-each[1], each[0]))
    return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in ranked)


# The whole page.

ASSETS = "pytest_pafot.report.assets"
# The scripts in the order in which they run. Each uses functions of the earlier ones.
SCRIPTS = ("dom.js", "scene.js", "charts.js", "player.js", "main.js")

# The data that the scripts read. Everything else is in the page as text.
DRAWN = (
    "headline",
    "times",
    "vehicles",
    "road",
    "instructions",
    "decisions",
    "ghost",
    "event",
    "check",
)

INTERRUPTED = '<p class="warning">The session was interrupted. This report covers only what had run by then.</p>'

# The maximum number of findings that a page shows in full, the worst first. Each takes about 60 kB.
WHOLE = 100


def render_page(session: Session, *, title: str, command: str) -> tuple[str, str]:
    """Return the record of a session as an HTML page, and a summary of the page's content.

    Except for the time of writing, equal records give equal pages.
    """
    style = _asset("page.css")
    script = '"use strict";\n(() => {\n' + "\n".join(map(_asset, SCRIPTS)) + "})();\n"
    # With these hashes, a browser accepts only this style and these scripts, and opens no connection.
    policy = (
        f"default-src 'none'; style-src {content_hash(style)}; script-src {content_hash(script)}"
    )
    seen, searches = session.findings, sorted(session.ended, key=lambda each: each.node_id)
    found = sorted(
        (seen[node_id] for node_id in session.views),
        key=lambda each: (each.label != "new", *each.rank),
    )
    views, more = [_shown(each, session) for each in found[:WHOLE]], found[WHOLE:]
    tests = [each.test for each in views]
    # grouped by test, the test with the worst finding first
    views.sort(key=lambda each: tests.index(each.test))
    # A failure needs an article only if no finding explains it. Searches also fail because of their findings.
    shown = {
        *session.views,
        *(each.node_id for each in searches if each.finds and each.reason is not Ending.ERROR),
    }
    failures = {
        key: text
        for key, text in session.failures.items()
        if key[1] != "call" or key[0] not in shown
    }
    # The article on a failure without a finding shows pytest's text.
    ended = {
        each.node_id: "The search ended with an error."
        for each in searches
        if each.reason is Ending.ERROR
    }
    errors = "".join(
        f'<article class="error" role="alert"><h2>{text(node_id)}</h2>'
        f"<p>{ended.get(node_id, 'It failed, but no finding on this page explains why.')}</p>"
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
        layout="single" if len(views) < 2 else "",
        count=f"{len(views)} of {len(found)}" if more else len(views),
        list=finding_list(views)
        or f'<p class="empty">{_nothing_found(searches, has_errors=bool(failures), is_interrupted=is_interrupted)}</p>',
        articles="".join(finding_article(finding, index) for index, finding in enumerate(views)),
        below=_further(more, len(views), session)
        + _section("Searches", "".join(map(_search, searches)))
        + _section(
            "Session", _facts(session_facts(searches, session.replays)) + _with_button(command)
        ),
        data=data_json(views),
    )
    return page, told


def _shown(seen: Seen, session: Session) -> Shown:
    view = json.loads(zlib.decompress(session.views[seen.node_id]))
    search = {name_without(SEARCH_PART, each.node_id): each for each in session.ended}.get(
        seen.test
    )
    runs = 1 + seen.alike.runs if search is None else search.known.get(seen.id, 1)
    parts: list[str] = [] if seen.label == "accepted" else [seen.result]
    if seen.label == "new":
        parts = [f"new ({seen.remark})" if seen.remark else "new"]
    elif seen.finding.xfail is not None:
        parts.append(f"accepted: {seen.finding.accepted}")
    command = session.command(seen, "pytest", name=seen.node_id)
    return Shown(seen=seen, view=view, runs=runs, label=", ".join(parts), command=command)


def data_json(findings: Iterable[Shown]) -> str:
    """Return the data for the page's scripts, as JSON that is safe inside a ``<script>`` element."""
    data = [{name: each.view[name] for name in DRAWN} for each in findings]
    return json_in_script(
        json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    )


def _nothing_found(searches: Iterable[Search], *, has_errors: bool, is_interrupted: bool) -> str:
    # The page states that the property held only if nothing ended early.
    ends = {search.reason for search in searches}
    if has_errors or Ending.ERROR in ends:
        return "No findings, but an error ended a test or a search early."
    if is_interrupted or Ending.INTERRUPTED in ends:
        return "No findings before the interruption. The remaining scenarios were not tested."
    if any(search.failing for search in searches):
        return (
            "No new findings. Some runs failed, but saved scenarios already cover these failures."
        )
    if not all(end.is_complete for end in ends):
        return "No findings before time ran out. The property held in all runs that were evaluated until then."
    return "No findings. The property held in all evaluated runs."


def _asset(name: str) -> str:
    return files(ASSETS).joinpath(name).read_text(encoding="utf-8")


# The facts about a session.


def session_facts(searches: Iterable[Search], replays: Iterable[Seen]) -> Iterator[tuple[str, str]]:
    """Yield the names and values of facts about a session, such as seeds, replays and versions."""
    if seeds := dict.fromkeys(search.base_seed for search in searches):
        yield "base seed" if len(seeds) == 1 else "base seeds", ", ".join(map(str, seeds))
    replays = sorted(replays, key=lambda each: each.node_id)
    if replays:
        counts = sorted(Counter(each.result for each in replays).items())
        results = ", ".join(f"{count} {result}" for result, count in counts)
        yield "replayed", f"{plural(len(replays), 'saved scenario')}: {results}"
    for each in replays:
        if each.result.startswith(("drifted", "passed")):
            yield (
                each.result,
                ": ".join(filter(None, [each.node_id, each.on_search or each.detail])),
            )
    yield from installed_versions().items()
    yield "written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
