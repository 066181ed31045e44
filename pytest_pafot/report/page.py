"""The report as one HTML page that needs nothing else: no network, no library, no second file."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import asdict, replace
from html import escape
from importlib.resources import files
from string import Template

from pytest_pafot.report.markup import campaign_article, copyable, facts, finding_article, finding_list, text
from pytest_pafot.report.page_data import Report
from pytest_pafot.support.text import quiet_json

ASSETS = "pytest_pafot.report.assets"
STYLE = "page.css"
SCRIPTS = ("dom.js", "scene.js", "charts.js", "player.js", "table.js", "campaign.js", "main.js")
"""In this order; each adds to what the ones before it define."""

FRAME_HEIGHT = 1010
"""Of a page inside another one [px]."""
WORDS_HEIGHT = 480
"""Of one that shows no run [px]."""
CURVE_HEIGHT = 180
"""What the curve of a check needs besides [px]."""
CROSSED_HEIGHT = 460
"""What a picture in which somebody crosses needs besides, and the curve that comes with it [px]."""


def render_page(report: Report, *, embedded: bool = False) -> str:
    """One self-contained page, for itself or inside another one; the same report gives the same text."""
    style = _asset(STYLE)
    script = '"use strict";\n(() => {\n' + "\n".join(map(_asset, SCRIPTS)) + "})();\n"
    # This very style and script, and no connection to anywhere.
    policy = f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}"
    kind = "embedded" if embedded else "whole"
    is_open = len(report.campaigns) == 1 and not embedded
    if embedded:  # A frame may not save files.
        report = replace(report, findings=tuple(replace(finding, drive=None) for finding in report.findings))
    # What failed by no finding, with what pytest says of it.
    ended = {view.node_id: "The search ended with an error." for view in report.campaigns if view.reason == "error"}
    errors = "".join(
        f'<article class="error" role="alert"><h2>{text(node_id)}</h2>'
        f"<p>{ended.get(node_id, 'It failed, and no finding on this page shows that.')}</p>"
        f"<pre>{text(told.strip())}</pre></article>"
        for node_id, told in report.errors
    )
    campaigns = "".join(campaign_article(view, index, is_open=is_open) for index, view in enumerate(report.campaigns))
    searches = f'<section class="campaigns" aria-label="Searches"><h2>Searches</h2>{campaigns}</section>'
    return Template(_asset("page.html")).substitute(
        title=text(report.title),
        policy=f"{policy}; base-uri 'none'; form-action 'none'",
        style=style,
        script=script,
        kind=kind if len(report.findings) == 1 else f"{kind} listed",
        facts=facts(report.facts) + (copyable(report.command) if report.command else ""),
        count=len(report.findings),
        errors=errors,
        list=finding_list(report.findings) or f'<p class="empty">{_nothing_found(report)}</p>',
        articles="".join(finding_article(finding, index) for index, finding in enumerate(report.findings)),
        campaigns=searches if campaigns else "",
        data=data_json(report),
    )


def render_frame(report: Report) -> str:
    """An ``<iframe>`` that holds the page, for a place in another one: a row of pytest-html's, or a notebook's output.

    The frame may run its own scripts and nothing else.
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
    """What the scripts draw from, as JSON that can stand inside a ``<script>`` element.

    Texts that the page holds already are left out. Nothing in it can end the element or begin a comment, and
    everything beyond ASCII is escaped, U+2028 among it.
    """
    findings = tuple(replace(finding, yaml="", explanation="") for finding in report.findings)
    data = asdict(replace(report, findings=findings, errors=()))
    plain = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return quiet_json(plain).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _nothing_found(report: Report) -> str:
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


def _hash(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


def _asset(name: str) -> str:
    return files(ASSETS).joinpath(name).read_text(encoding="utf-8")
