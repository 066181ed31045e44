"""A report as the files of a folder."""

from dataclasses import replace

import pytest

from pytest_pafot.report.page import render_page
from pytest_pafot.report.page_data import Report
from pytest_pafot.report.session_report import report_files
from tests.report.builders import real_report

pytest.importorskip("PIL.Image", reason="Pillow draws the animations")


def short(finding, **more):
    """A single frame, so that drawing it is quick."""
    return replace(finding, times=finding.times[:1], **more)


def test_the_page_comes_first_then_a_picture_of_each_finding():
    findings = tuple(map(short, real_report().findings))
    report = replace(real_report(), findings=findings)
    files = dict(report_files(report))
    assert list(files) == ["index.html", *(f"{finding.id}.png" for finding in findings)]
    assert files["index.html"].decode() == render_page(report)
    assert files[f"{findings[0].id}.png"].startswith(b"\x89PNG")


def test_a_finding_that_nobody_saw_has_no_picture():
    report = Report(title="t", findings=(replace(real_report().findings[0], times=(), vehicles=()),))
    assert [name for name, _ in report_files(report)] == ["index.html"]


def test_findings_of_one_id_have_files_of_their_own_and_names_that_any_system_takes():
    finding = short(real_report().findings[0], id="../a b")
    names = [name for name, _ in report_files(Report(title="t", findings=(finding, finding)))]
    assert names == ["index.html", ".._a_b.png", ".._a_b-2.png"]
