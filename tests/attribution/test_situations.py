"""The attribution rules against situations whose verdict an expert has written down in advance."""

import importlib.util
from pathlib import Path

from pytest_pafot.attribution.responsibility import rss_rule
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table

ROOT = Path(__file__).parents[2]
ALL = [situation for group in SITUATIONS.values() for situation in group]


@table("situation", ALL)
def test_verdict_matches_the_one_an_expert_expects(situation):
    found = rss_rule(situation.trace())
    assert (found.responsibility, found.fault) == (situation.responsibility, situation.fault), (
        found.sentences
    )


def test_picture_of_the_page_on_verdicts_is_up_to_date():
    path = ROOT / "docs" / "tools" / "verdict_picture.py"
    spec = importlib.util.spec_from_file_location("verdict_picture", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.picture() == module.PICTURE.read_text(encoding="utf-8"), (
        "run: python docs/tools/verdict_picture.py"
    )
