"""Views cross process borders and are embedded in pages as plain data."""

import json
from dataclasses import dataclass

import pytest
from hypothesis import given

from pytest_pafot.report.page import data_json
from pytest_pafot.report.page_data import CampaignView, FindingView, Report, ShrinkView, decode, encode
from tests.report.builders import real_report, values_of


@given(values_of(Report))
def test_any_report_comes_back_from_json_as_it_was_and_survives_its_script_element(report):
    assert decode(Report, json.loads(json.dumps(encode(report)))) == report
    for kind, views in ((FindingView, report.findings), (CampaignView, report.campaigns)):
        assert [decode(kind, json.loads(json.dumps(encode(view)))) for view in views] == [*views]
    data = data_json(report)
    assert data.isascii()
    assert not set("<>&") & set(data)
    assert json.loads(data)["title"] == report.title


def test_a_real_report_comes_back_as_it_was():
    report = real_report()
    assert decode(Report, json.loads(json.dumps(encode(report), allow_nan=False))) == report


def test_whole_numbers_of_json_become_the_floats_that_they_were():
    finding = real_report().findings[0]
    plain = encode(finding)
    plain["road"]["lane_width"] = 4
    back = decode(FindingView, plain)
    assert type(back.road.lane_width) is float


def test_an_unknown_key_is_refused_by_name():
    plain = encode(ShrinkView(original=(), shrunk=(), original_npcs=2, shrunk_npcs=1, original_instructions=4,
                                shrunk_instructions=2, rollouts=9))  # fmt: skip
    with pytest.raises(ValueError, match=r"ShrinkView: expected the keys .* received .*'more'"):
        decode(ShrinkView, plain | {"more": 1})


def test_what_is_no_plain_data_is_refused():
    @dataclass(frozen=True)
    class Odd:
        field: object

    with pytest.raises(TypeError, match="received complex"):
        encode(Odd(field=1j))
