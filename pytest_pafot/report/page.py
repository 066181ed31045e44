"""The report as one HTML page that needs nothing else: no network, no library, no second file."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import replace
from html import escape
from importlib.resources import files
from string import Template

from pytest_pafot.report import markup
from pytest_pafot.report.page_codec import encode
from pytest_pafot.report.page_data import FindingView, Report

ASSETS = "pytest_pafot.report.assets"
STYLE = "page.css"
SCRIPTS = ("dom.js", "scene.js", "charts.js", "player.js", "campaign.js", "main.js")
"""In this order; each adds to what the ones before it define."""

FRAME_HEIGHT = 1010
"""Of a finding inside another page [px]."""


def render_page(report: Report) -> str:
    """One self-contained page; the same report gives the same text."""
    return _rendered(report, embedded=False)


def render_frame(finding: FindingView) -> str:
    """An ``<iframe>`` that holds the page of a single finding, for a row of another report such as pytest-html's.

    The frame may run its own scripts and nothing else.
    """
    page = _rendered(Report(title=finding.headline, findings=(finding,)), embedded=True)
    return (
        f'<iframe class="pafot-finding" title="{markup.text(finding.headline)}" sandbox="allow-scripts" '
        f'loading="lazy" width="100%" height="{FRAME_HEIGHT}" style="border:0" srcdoc="{escape(page)}"></iframe>'
    )


def data_json(report: Report) -> str:
    """What the scripts draw from, as JSON that can stand inside a ``<script>`` element.

    Texts that the page holds already are left out. Nothing in it can end the element or begin a comment, and
    everything beyond ASCII is escaped, U+2028 among it.
    """
    findings = tuple(replace(finding, yaml="", explanation="") for finding in report.findings)
    slim = replace(report, findings=findings, errors=())
    plain = json.dumps(encode(slim), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return plain.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _rendered(report: Report, *, embedded: bool) -> str:
    style = _asset(STYLE)
    script = '"use strict";\n(() => {\n' + "\n".join(map(_asset, SCRIPTS)) + "})();\n"
    is_open = len(report.campaigns) == 1
    campaigns = "".join(markup.campaign(view, index, is_open=is_open) for index, view in enumerate(report.campaigns))
    return Template(_asset("page.html")).substitute(
        title=markup.text(report.title),
        policy=_policy(style, script),
        style=style,
        script=script,
        kind="embedded" if embedded else "whole",
        facts=markup.session_facts(report),
        count=len(report.findings),
        errors=markup.errors(report),
        list=markup.finding_list(report.findings) or f'<p class="empty">{markup.nothing_found(report)}</p>',
        articles="".join(markup.article(finding, index) for index, finding in enumerate(report.findings)),
        campaigns=f'<section class="campaigns" aria-label="Searches"><h2>Searches</h2>{campaigns}</section>'
        if campaigns
        else "",
        data=data_json(report),
    )


def _policy(style: str, script: str) -> str:
    """A content security policy: this very style and script, and no connection to anywhere."""
    sources = f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}"
    return f"{sources}; base-uri 'none'; form-action 'none'"


def _hash(content: str) -> str:
    digest = hashlib.sha256(content.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def _asset(name: str) -> str:
    return files(ASSETS).joinpath(name).read_text(encoding="utf-8")
