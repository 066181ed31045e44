"""Free NPCs as instructions: their text, their file, their words, and the errors about others."""

import json
import pickle
from pathlib import Path

import pytest
from hypothesis import given

from pytest_pafot import Free, Manoeuvre, Scenario, ScenarioError, strategies
from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.support.errors import CorpusError
from tests.findings.builders import plain_finding
from tests.helpers.tables import table

PATH = Path("front-2-1f3a9c.pafot.yaml")
BEHIND = Free(beside=-1, ahead=-20.0, speed=24.5, driver="mobil")


@given(strategies.free_npcs(drivers=["idm", "last-version"]))
def test_texts_are_read_back(free):
    scenario = Scenario(npcs=((free,),))
    again = Scenario.from_canonical(json.loads(scenario.canonical()))
    finding = plain_finding(scenario=scenario)
    assert again == scenario == pickle.loads(pickle.dumps(scenario))
    assert parsed(PATH, text_of(finding).encode()) == finding


def test_words_and_file():
    scenario = Scenario(npcs=((BEHIND,), (Manoeuvre(beside=1, ahead=5.0, speed=20.0),)))
    assert scenario.canonical().startswith('[[[["free",24.5,-1,-20.0,"mobil"]],[["manoeuvre"')
    assert str(scenario).endswith(
        ": 24.5 m/s 20 m behind, 1 lane left, driven by mobil; 20 m/s 5 m ahead, 1 lane right>"
    )
    text = text_of(plain_finding(scenario=scenario))
    assert "    - - {beside: -1, ahead: -20.0, speed: 24.5, driver: mobil}\n" in text
    assert "    - - {beside: 1, ahead: 5.0, speed: 20.0}\n" in text


@table(
    ("fields", "message"),
    [
        (
            {"driver": "a/b"},
            r"driver: expected idm, mobil, policy, or a name in drivers= of the search, received 'a/b'",
        ),
        ({"driver": None}, r"driver: expected idm"),
        ({"beside": 9}, r"beside: expected a whole number of lanes from -8 to 8"),
        ({"beside": 0, "ahead": 0.0}, r"ahead: expected a distance other than 0 in the ego's lane"),
        ({"speed": -1.0}, r"speed: expected m/s, at least 0"),
    ],
)
def test_wrong_fields_are_refused(fields, message):
    with pytest.raises(ScenarioError, match=message):
        Free(**{"beside": 1, "ahead": 20.0, "speed": 20.0, "driver": "idm", **fields})


def test_file_names_the_place_of_a_wrong_driver():
    text = text_of(plain_finding(scenario=Scenario(npcs=((BEHIND,),))))
    with pytest.raises(CorpusError, match="driver: expected idm, mobil, policy, or a name"):
        parsed(PATH, text.replace("driver: mobil", "driver: a b").encode())
    with pytest.raises(CorpusError, match="expected one of"):
        parsed(PATH, text.replace("driver: mobil", "drivers: mobil").encode())
