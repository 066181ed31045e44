"""The attribution rules against situations whose verdict an expert has written down in advance."""

import importlib.util
from pathlib import Path

import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table

ROOT = Path(__file__).parents[2]
ALL = [situation for group in SITUATIONS.values() for situation in group]


@table("situation", ALL)
def test_verdict_matches_the_one_an_expert_expects(situation):
    found = rss_rule(situation.trace())
    assert (found.responsibility, found.fault) == (situation.responsibility, situation.fault), found.sentences


def gallery():
    spec = importlib.util.spec_from_file_location("docs_gallery", ROOT / "docs" / "tools" / "gallery.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.stories
def test_gallery_page_reasons_and_pictures_are_up_to_date():
    module = gallery()
    page = module.PAGE.read_text(encoding="utf-8")
    assert module.written(page) == page, "run: python docs/tools/gallery.py"
    assert module.reasons() == module.REASONS.read_text(encoding="utf-8"), "run: python docs/tools/gallery.py"
    drawn = {path.name: path.read_text(encoding="utf-8") for path in module.PICTURES.iterdir()}
    assert module.pictures() == drawn, "run: python docs/tools/gallery.py"


def test_no_picture_is_heavy():
    assert max(path.stat().st_size for path in (ROOT / "docs" / "explanation" / "gallery").iterdir()) <= 4096
