"""The saved scenarios next to the page on policies of others."""

import re
from pathlib import Path

import pytest

import pytest_pafot as pafot

FILES = sorted((Path(__file__).parents[2] / "docs/explanation/others").glob("*.pafot.yaml"))


def test_there_is_a_file_of_each_of_ten_policies():
    assert len({pafot.load(file).scenario for file in FILES}) == len(FILES) == 10


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name.split(".")[0])
def test_a_file_is_no_fault_of_an_npc_alone_and_tells_nothing_of_a_machine(file):
    saved = pafot.load(file)
    assert saved.expect.responsibility in ("ego", "both", "none")
    assert saved.finding.flaky is None
    assert not re.search(
        r"/(home|root|tmp|work|usr|opt)/|TMP|xfail: \S", file.read_text().replace("# xfail: {reason, until}", "")
    )
