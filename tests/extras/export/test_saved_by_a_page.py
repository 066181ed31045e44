"""The page in headless Chromium saves the same file as the export command."""

from dataclasses import replace
from pathlib import Path

import numpy as np

import pytest_pafot as pafot
from pytest_pafot.__main__ import main
from pytest_pafot.commands.policy_reference import ads_factory
from pytest_pafot.extras.export.exporter import exporter
from pytest_pafot.model.trace import LANE, SPEED
from pytest_pafot.report.page import render_page
from pytest_pafot.report.page_data import Report
from pytest_pafot.report.views import drive_view, finding_view
from tests.report.builders import cut_in_trace, finding_of
from tests.report.test_page_in_browser import browser, pytestmark  # noqa: F401  (a fixture, and marks)

FILES = Path(__file__).parents[2] / "corpus" / "saved"


def saved_by(browser, page, folder):
    """Return the file that the displayed finding's button saves; the keyboard presses it."""
    since = len(browser.events)
    browser.send("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder), eventsEnabled=True)
    page.evaluate("document.querySelector('article.current .save-run').focus()")
    page.press("Enter")
    browser.until_told("Browser.downloadProgress", since, state="completed")
    (file,) = folder.iterdir()
    page.until(f"document.getElementById('status').textContent === 'Saved as {file.name}'")
    return file


def test_page_saves_run_as_the_export_command_does(browser, tmp_path):
    given = FILES / "collision-xfail.pafot.yaml"
    assert main(["export", str(given), "--to", "csv", "--ads", "constant_speed", "--out", str(tmp_path / "told")]) == 0
    saved = pafot.load(given)
    view = finding_view(saved.replay(ads_factory("constant_speed")).trace, saved.finding, node_id="t.py::test")
    path = tmp_path / "page.html"
    path.write_text(render_page(Report.of(view)), encoding="utf-8")
    page = browser.open(path.as_uri())
    file, (told,) = saved_by(browser, page, tmp_path / "saved"), (tmp_path / "told").iterdir()
    assert (file.name, file.read_bytes()) == (told.name, told.read_bytes())
    assert page.complaints == []
    page.close()


def test_numbers_of_any_size_are_saved_like_python(browser, tmp_path):
    trace = cut_in_trace()
    states = trace.states.copy()
    states[:, :, :LANE] *= 10.0 ** np.random.default_rng(1).integers(-30, 30, states[:, :, :LANE].shape)
    odd = [0.0, -0.0, 1e-4, 9.999e-5, 1e-5, 1e-7, 5e-324, 1e15, 1e16, 1e21, 1e22, 1.7e308, 123456789.125, 2.0**53]
    states[: len(odd), 0, SPEED] = odd
    strange = replace(trace, states=states)
    finding = finding_of(trace)
    view = replace(finding_view(trace, finding, node_id="t.py::test"), drive=drive_view(strange))
    path = tmp_path / "page.html"
    path.write_text(render_page(Report.of(view)), encoding="utf-8")
    page = browser.open(path.as_uri())
    file = saved_by(browser, page, tmp_path / "saved")
    assert {file.name: file.read_bytes()} == exporter("csv")(finding, strange)
    page.close()
