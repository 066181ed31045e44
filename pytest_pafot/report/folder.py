"""A report as the files of a folder: the page, and an animated picture of each finding."""

from __future__ import annotations

import re
from collections.abc import Iterator

from pytest_pafot.report.animation import animate
from pytest_pafot.report.finding_markup import finding_keys
from pytest_pafot.report.page import render_page
from pytest_pafot.report.page_data import Report

PAGE = "index.html"


def report_files(report: Report) -> Iterator[tuple[str, bytes]]:
    """Name and content of each file, the page first; findings that nobody saw have no picture.

    Raises:
        AnimationError: when a picture is due and Pillow is missing; the page has been given by then.
    """
    yield PAGE, render_page(report).encode()
    for key, finding in zip(finding_keys(report.findings), report.findings, strict=True):
        if finding.times:
            yield re.sub(r"[^A-Za-z0-9._-]", "_", key) + ".png", animate(finding)
