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
from pytest_pafot.corpus.layout import SUFFIX
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.report.session import Session
from pytest_pafot.report.terminal import command_for, findings_of, replay_counts, replays_of
from pytest_pafot.searches.events import Ending, Search, by_test
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
        if self.view["event"]["kind"] in ("ads_error", "hang"):
            return "error"
        return self.seen.responsible


def text(value: object) -> str:
    """Escape a string for HTML, and make unprintable characters visible."""
    return escape(visible_lines(str(value)), quote=True)


def prose(value: object) -> str:
    """Escape a string for HTML, with line breaks only where a reader expects them."""
    # A number stays on the line of its unit, and names may be broken after these characters.
    joined = re.sub(r"(?<=\d) (?=m\b|s\b)|(?<=NPC) (?=\d)", "\u00a0", text(value))
    return re.sub(r"(?<=\w\w)/|_|::|\[", r"\g<0><wbr>", joined)


def _facts(pairs: Iterable[tuple[str, object]]) -> str:
    rows = "".join(
        f"<div><dt>{text(name)}</dt><dd>{prose(value)}</dd></div>"
        for name, value in pairs
        if value != ""
    )
    return f'<dl class="facts">{rows}</dl>'


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


def finding_list(findings: Sequence[Shown]) -> str:
    """Return an HTML list of links to all findings, grouped by test."""
    if not findings:
        return ""
    tags = []
    for who, count in sorted(Counter(each.who for each in findings).items()):
        name = WHO.get(who, who)
        if count > 1 and who in ("check", "error"):
            name += "s"
        tags.append(f"{SYMBOLS.get(who, '?')} {count} {name}")
    listed = f'<p class="summary">{text(", ".join(tags))}</p><div class="rows">'
    seen = Counter[str]()
    for test, group in groupby(findings, key=lambda each: each.test):
        listed += f"<h3>{text(test)}</h3><ol>"
        for finding in group:
            id_ = key = finding.seen.id
            seen[id_] += 1
            if seen[id_] > 1:  # Findings of different tests can have the same id.
                key = f"{id_}-{seen[id_]}"
            brief = "; ".join(filter(None, [finding.view["headline"], finding.label]))
            listed += (
                f'<li><a href="#finding={text(quote(key, errors="replace"))}" data-key="{text(key)}">{mark(finding)}'
                f'<span><span class="id">{text(id_)}</span><span class="brief">{text(brief)}</span></span></a></li>'
            )
        listed += "</ol>"
    return f"{listed}</div>"


def finding_article(finding: Shown, index: int) -> str:
    """Return the HTML article about one finding, with an empty element for its picture."""
    seen, view = finding.seen, finding.view
    tags = [finding.label]
    if finding.who != "check":
        tags.append(view["assertion"])
    tags += [
        STYLES[seen.finding.scenario.traffic].described,
        plural(finding.runs, "run"),
        seen.worst,
    ]
    if finding.who == "check" and seen.responsible != "none" and not view["besides"]:
        tags.append(f"{WHO.get(seen.responsible, seen.responsible)} for the collision")
    article = (
        f'<article id="finding-{index}" tabindex="-1" aria-labelledby="headline-{index}"><header>'
        f'<p class="id">{prose(finding.test)} <span>{text(seen.id)}</span></p>'
        f'<h2 id="headline-{index}">{mark(finding)} {prose(capitalised(view["headline"]))}</h2>'
        '<div class="told"><div>'
    )
    for sentence in view["sentences"]:
        # The ego's error is emphasised.
        kind = "sentence deed" if sentence == view["deed"] else "sentence"
        article += f'<p class="{kind}">{prose(sentence)}</p>'
    if view["besides"]:
        deed = f'<span class="deed">{prose(view["deed"])}</span>'
        article += f'<p class="besides">{prose(view["besides"])} {deed}</p>'
    article += f"</div>{_paragraphs(view['moment'])}</div></header>"
    if view["times"]:
        article += '<div class="player"></div>'
    else:
        article += '<p class="empty">There is no run to draw.</p>'
    items = "".join(f"<li>{text(tag)}</li>" for tag in tags if tag)
    article += f"<footer><ul>{items}</ul>{_with_button(finding.command)}</footer>"
    if view["happened"]:
        article += f"<h3>What happened</h3>{_paragraphs(view['happened'])}"
    return (
        f'{article}<section class="yaml"><div class="bar"><h4>{prose(seen.path or seen.id + SUFFIX)}</h4>'
        '<button type="button" data-copy="pre">Copy the file</button></div>'
        f'<pre tabindex="0" aria-label="The file of this finding">{text(view["yaml"])}</pre></section></article>'
    )


def _paragraphs(paragraphs: Iterable[Sequence[Any]]) -> str:
    shown = ""
    for title, sentences, groups in paragraphs:
        content = prose(sentences)
        if title:
            content = f"<b>{text(title)}.</b> {content}"
        shown += f"<p>{content}</p>"
        for whom, rows in groups:
            if whom:
                shown += f"<h4>{text(whom)}</h4>"
            lines = "".join(f"<li><code>{text(each)}</code></li>" for each in rows)
            shown += f"<ul>{lines}</ul>"
    return f'<section class="happened">{shown}</section>' if shown else ""


def _further(findings: Sequence[Seen], whole: int, session: Session) -> str:
    rows = ""
    for each in findings:
        command = command_for(session, each, "python", "-m", "pytest")
        rows += (
            f"<li><b>{text(each.id)}</b> {text(each.headline)}<br><code>{text(command)}</code></li>"
        )
    note = f"This page shows the {whole} worst findings in full. The others are listed here, the worst first."
    content = f'<p class="note">{note}</p><ul id="further">{rows}</ul>'
    return _section(plural(len(findings), "more finding"), content)


def _section(title: str, content: str) -> str:
    return f'<section class="searches"><h2>{text(title)}</h2>{content}</section>'


def _search(search: Search) -> str:
    made, asked = search.generations, search.asked.get("generations", search.generations)
    generations = made or ""
    if asked != made:
        generations = f"{made} of {asked}"
    figures = (
        ("runs", search.runs),
        ("failed", search.failing),
        ("generations", generations),
        ("outcomes", _counts(search.outcomes)),
        ("responsibility", _counts(search.responsibilities)),
        ("algorithm", search.algorithm),
        ("seed", search.seed),
        ("ended", search.reason.after_ended),
    )
    article = (
        f'<article class="searches"><h3 class="id">{prose(search.node_id)}</h3>{_facts(figures)}'
    )
    for warning in search.warnings:
        article += f'<p class="warning"><b>Warning</b> {text(warning)}</p>'
    return f"{article}</article>"


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
    searches = sorted(session.ended, key=lambda each: each.node_id)
    seen = findings_of(session)
    found = [seen[node_id] for node_id in session.views]
    # New findings come first, because nobody has seen them yet.
    found.sort(key=lambda each: (each.label != "new", *each.rank))
    more = found[WHOLE:]
    views = [_shown(each, session) for each in found[:WHOLE]]
    tests = [each.test for each in views]
    # grouped by test, the test with the worst finding first
    views.sort(key=lambda each: tests.index(each.test))
    failures = _unexplained(session, searches)
    driven = [each for each in searches if each.reason is not Ending.REPLAYS]
    told = plural(len(found), "finding")
    if failures:
        told = f"{plural(len(failures), 'error')}, {told}"
    above = ""
    if session.exit == 2:
        above = INTERRUPTED
    count = str(len(views))
    below = ""
    if more:
        count += f" of {len(found)}"
        below = _further(more, len(views), session)
    if driven:
        below += _section("Searches", "".join(map(_search, driven)))
    facts = _facts(session_facts(driven, replays_of(session)))
    listing = finding_list(views)
    if not listing:
        listing = f'<p class="empty">{_nothing_found(driven, failures, session.exit)}</p>'
    style = _asset("page.css")
    script = '"use strict";\n(() => {\n' + "\n".join(map(_asset, SCRIPTS)) + "})();\n"
    # With these hashes, a browser accepts only this style and these scripts, and opens no connection.
    allowed = f"style-src {content_hash(style)}; script-src {content_hash(script)}"
    page = Template(_asset("page.html")).substitute(
        title=text(f"{title}: {told}"),
        policy=f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'",
        style=style,
        script=script,
        above=above + "".join(failures),
        layout="single" if len(views) < 2 else "",
        count=count,
        list=listing,
        articles="".join(finding_article(finding, index) for index, finding in enumerate(views)),
        below=below + _section("Session", facts + _with_button(command)),
        data=data_json(views),
    )
    return page, told


def _unexplained(session: Session, searches: Iterable[Search]) -> list[str]:
    """Return articles with pytest's texts about the failures that no finding on the page explains."""
    explained = set(session.views)
    ended = {}
    for search in searches:
        if search.reason is Ending.ERROR:
            ended[search.node_id] = "The search ended with an error."
        elif search.finds:  # It failed because of its findings.
            explained.add(search.node_id)
    articles = []
    for (node_id, phase), failure in sorted(session.failures.items()):
        # A finding does not explain a failed set-up or teardown.
        if phase == "call" and node_id in explained:
            continue
        why = ended.get(node_id, "It failed, but no finding on this page explains why.")
        articles.append(
            f'<article class="error" role="alert"><h2>{text(node_id)}</h2>'
            f"<p>{why}</p><pre>{text(failure.strip())}</pre></article>"
        )
    return articles


def _shown(seen: Seen, session: Session) -> Shown:
    search = by_test(session.ended).get(seen.test)
    runs = 1 + seen.alike.runs
    if search is not None:  # It is a replay, whose failure the search may have met again.
        runs = search.known.get(seen.id, 1)
    label: str = seen.result
    if seen.label == "new" and seen.remark:
        label = f"new ({seen.remark})"
    elif seen.label == "accepted":
        label = f"accepted: {seen.finding.accepted}"
    elif seen.finding.xfail is not None:
        label += f", accepted: {seen.finding.accepted}"
    return Shown(
        seen=seen,
        view=json.loads(zlib.decompress(session.views[seen.node_id])),
        runs=runs,
        label=label,
        command=command_for(session, seen, "pytest", name=seen.node_id),
    )


def data_json(findings: Iterable[Shown]) -> str:
    """Return the data for the page's scripts, as JSON that is safe inside a ``<script>`` element."""
    data = [{name: each.view[name] for name in DRAWN} for each in findings]
    return json_in_script(json.dumps(data, allow_nan=False, separators=(",", ":")))


def _nothing_found(searches: Iterable[Search], failures: Sequence[str], code: int | None) -> str:
    # The page states that the property held only if nothing ended early.
    ends = {search.reason for search in searches}
    if failures or Ending.ERROR in ends:
        return "No findings, but an error ended a test or a search early."
    if code == 2 or Ending.INTERRUPTED in ends:
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
    seeds = [str(seed) for seed in dict.fromkeys(search.base_seed for search in searches)]
    if seeds:
        yield "base seed" if len(seeds) == 1 else "base seeds", ", ".join(seeds)
    replays = sorted(replays, key=lambda each: each.node_id)
    if replays:
        yield "replayed", replay_counts(replays)
    for each in replays:
        if each.result.startswith(("drifted", "passed")):
            parts = [each.node_id, each.on_search or each.detail]
            yield each.result, ": ".join(filter(None, parts))
    yield from installed_versions().items()
    yield "written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
