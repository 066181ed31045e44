"""Views cross process borders and are embedded in pages as plain data."""

import json

from hypothesis import given

from pytest_pafot.report.page import data_json
from pytest_pafot.report.page_data import Report
from pytest_pafot.searching.plain import from_plain, plain
from tests.report.builders import values_of


@given(values_of(Report))
def test_any_report_survives_json_and_its_script_element(report):
    assert from_plain(Report, json.loads(json.dumps(plain(report)))) == report
    data = data_json(report)
    assert data.isascii()
    assert not set("<>&") & set(data)
    assert json.loads(data)["title"] == report.title
