"""The report as one self-contained HTML page: it needs no network, no library and no second file."""

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
"""The scripts in order; each uses what the previous ones define."""

FRAME_HEIGHT = 1010
"""Height of a page inside another page [px]."""
WORDS_HEIGHT = 480
"""Height of an embedded page that shows no run [px]."""
CURVE_HEIGHT = 180
"""Additional height for the curve of a check [px]."""
CROSSED_HEIGHT = 460
"""Additional height for a picture in which a vehicle crosses, and for the curve below it [px]."""


def render_page(report: Report, *, embedded: bool = False) -> str:
    """Render one self-contained page, to stand alone or to be embedded; equal reports give equal text."""
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
    """Return an ``<iframe>`` that holds the page, to embed it in a row of pytest-html or a notebook's output.

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
    """Return the data for the scripts, as JSON that can be inside a ``<script>`` element.

    Texts that the page already contains are left out. Nothing in the JSON can end the element or begin a comment, and
    everything beyond ASCII, such as U+2028, is escaped.
    """
    findings = tuple(replace(finding, yaml="", explanation="") for finding in report.findings)
    data = asdict(replace(report, findings=findings, errors=()))
    plain = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return quiet_json(plain).replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _nothing_found(report: Report) -> str:
    """Return the text of a page without findings: the property is confirmed only if everything ran to its end."""
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
