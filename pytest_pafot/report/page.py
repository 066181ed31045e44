"""The report as one self-contained HTML page: it needs no network, no library and no other file."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import asdict, replace
from html import escape
from importlib.resources import files
from string import Template

from pytest_pafot.report.markup import (
    campaign_article,
    copyable,
    facts,
    finding_article,
    finding_list,
    further_section,
    text,
)
from pytest_pafot.report.page_data import Report
from pytest_pafot.support.text import quiet_json

ASSETS = "pytest_pafot.report.assets"
STYLE = "page.css"
SCRIPTS = ("dom.js", "scene.js", "charts.js", "player.js", "table.js", "campaign.js", "main.js")
"""The page's scripts, in the order in which they run. Each uses what the earlier scripts define."""

FRAME_HEIGHT = 1010
"""Height of a report that is embedded in another page [px]."""
WORDS_HEIGHT = 480
"""Height of an embedded report that shows no run [px]."""
CURVE_HEIGHT = 180
"""Height that the curve of a failed check adds to an embedded report [px]."""
CROSSED_HEIGHT = 460
"""Height that a crossing vehicle adds to an embedded report, for the larger picture and a curve below it [px]."""


def render_page(report: Report, *, embedded: bool = False) -> str:
    """Render a report as one self-contained HTML page. ``embedded`` is True for a page inside another page.

    Equal reports give equal text.
    """
    style = _asset(STYLE)
    script = '"use strict";\n(() => {\n' + "\n".join(map(_asset, SCRIPTS)) + "})();\n"
    # The hashes allow only this style and these scripts, and no connection to anywhere.
    policy = f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}"
    kind = "embedded" if embedded else "whole"
    is_open = len(report.campaigns) == 1 and not embedded
    if embedded:  # A sandboxed frame may not save files.
        report = replace(report, findings=tuple(replace(finding, drive=None) for finding in report.findings))
    # Failures without a finding, with the text that pytest shows for them.
    ended = {view.node_id: "The search ended with an error." for view in report.campaigns if view.reason == "error"}
    errors = "".join(
        f'<article class="error" role="alert"><h2>{text(node_id)}</h2>'
        f"<p>{ended.get(node_id, 'It failed, and no finding on this page shows why.')}</p>"
        f"<pre>{text(told.strip())}</pre></article>"
        for node_id, told in report.errors
    )
    campaigns = "".join(campaign_article(view, index, is_open=is_open) for index, view in enumerate(report.campaigns))
    total = len(report.findings) + len(report.further)
    link = '<p class="note"><a href="#further">The others, as a table</a></p>' if report.further else ""
    searches = f'<section class="campaigns" aria-label="Searches"><h2>Searches</h2>{campaigns}</section>'
    return Template(_asset("page.html")).substitute(
        title=text(report.title),
        policy=f"{policy}; base-uri 'none'; form-action 'none'",
        style=style,
        script=script,
        kind=kind if len(report.findings) == 1 else f"{kind} listed",
        facts=facts(report.facts) + (copyable(report.command) if report.command else ""),
        count=len(report.findings) if not report.further else f"{len(report.findings)} of {total}",
        errors=errors,
        further=further_section(report.further, len(report.findings)),
        list=(finding_list(report.findings) or f'<p class="empty">{_nothing_found(report)}</p>') + link,
        articles="".join(finding_article(finding, index) for index, finding in enumerate(report.findings)),
        campaigns=searches if campaigns else "",
        data=data_json(report),
    )


def render_frame(report: Report) -> str:
    """Return an ``<iframe>`` that holds the report's page, for a row of pytest-html or the output of a notebook.

    The frame may run its own scripts. Everything else, such as saving files, is forbidden to it.
    """
    page = render_page(report, embedded=True)
    has_curve = any(finding.check is not None and finding.check.values for finding in report.findings)
    is_drawn = any(finding.times for finding in report.findings)
    height = (FRAME_HEIGHT if is_drawn else WORDS_HEIGHT) + (CURVE_HEIGHT if has_curve else 0)
    height += CROSSED_HEIGHT if any(finding.is_crossed for finding in report.findings) else 0
    return (
        f'<iframe class="pafot-finding" title="{text(report.title)}" sandbox="allow-scripts" '
        f'loading="lazy" width="100%" height="{height}" style="border:0" srcdoc="{escape(page)}"></iframe>'
    )


def data_json(report: Report) -> str:
    """Return the report's data for the page's scripts, as JSON that is safe inside a ``<script>`` element.

    Texts that the page contains as HTML are left out. Nothing in the JSON can end the element or begin a comment, and
    everything beyond ASCII, such as U+2028, is escaped.
    """
    findings = tuple(replace(finding, yaml="", explanation="") for finding in report.findings)
    data = asdict(replace(report, findings=findings, further=(), errors=()))
    plain = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return quiet_json(plain).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _nothing_found(report: Report) -> str:
    """Return the sentence on a page without findings. It says that the property held only if nothing was cut short."""
    ends = {view.reason for view in report.campaigns}
    if report.errors or "error" in ends:
        return "No findings, but an error stopped something before its end."
    if report.is_interrupted or ends & {"", "interrupted"}:
        return "No findings before the interrupt. The scenarios that had not run by then are untested."
    if any(row.failing for view in report.campaigns for row in view.generations):
        return "No new findings. Some runs failed, but saved scenarios already cover these failures."
    if "time" in ends:
        return "No findings before time ran out. The property held in every run that was evaluated by then."
    return "No findings. The property held in every evaluated run."


def _hash(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


def _asset(name: str) -> str:
    return files(ASSETS).joinpath(name).read_text(encoding="utf-8")
