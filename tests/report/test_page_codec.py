"""Views cross process borders and are embedded in pages as plain data."""

import json

from hypothesis import given

from pytest_pafot.report.page import data_json
from pytest_pafot.report.page_data import Report, RunView
from pytest_pafot.searching.plain import from_plain, plain
from tests.report.builders import values_of


@given(values_of(RunView))
def test_any_view_survives_json_and_its_script_element(view):
    assert from_plain(RunView, json.loads(json.dumps(plain(view)))) == view
    data = data_json(Report.of(view))
    assert data.isascii()
    assert not set("<>&") & set(data)
    assert json.loads(data)["findings"][0]["headline"] == view.headline
