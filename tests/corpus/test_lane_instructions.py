"""Scenarios of Lane-Instructions in files."""

import pytest

from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.model.instructions import LaneInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support.errors import CorpusError
from tests.findings.builders import plain_finding

PATH = "front-2-1f3a9c.pafot.yaml"


def scenario(*texts, **fields):
    """Return a scenario from texts such as "left@22 keep@24.5"."""
    pairs = [[gene.split("@") for gene in text.split()] for text in texts]
    return Scenario(npcs=[[LaneInstruction(lane, float(speed)) for lane, speed in chain] for chain in pairs], **fields)


BUSY = scenario("left@22.3 keep@24.1 right@7.7 right@7.7", "keep@21 left@3.4 left@26.8 keep@5")


def test_a_file_names_the_lane():
    assert "    - - {lane: left, speed: 22.3}\n      - {lane: keep, speed: 24.1}\n" in text_of(
        plain_finding(scenario=BUSY)
    )


@pytest.mark.parametrize(("wrong", "message"), [
    ("{lane: up, speed: 22.3}", r"scenario.npcs\[0\]\[0\].lane: expected one of keep, left, right, received 'up'"),
    ("{cell: 2, lane: left, speed: 1.0}", r"scenario.npcs\[0\]\[0\].lane: expected one of cell, speed"),
    ("{cell: 2, speed: 22.3}", r"npcs\[0\]\[1\].*: expected a PositionInstruction like npcs\[0\]\[0\]"),
    ("{lane: left, speed: 22.35}", r"speed: expected m/s"),
])  # fmt: skip
def test_file_error_is_reported_at_its_place(tmp_path, wrong, message):
    text = text_of(plain_finding(scenario=BUSY)).replace("{lane: left, speed: 22.3}", wrong)
    with pytest.raises(CorpusError, match=message):
        parsed(tmp_path / PATH, text.encode())
