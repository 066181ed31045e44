"""No damaged file is read differently from its text."""

import random
from pathlib import Path

import pytest
import yaml
from hypothesis import settings

from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.support.errors import CorpusError
from tests.helpers.mutations import MUTATIONS

TEXTS = [path.read_text(encoding="utf-8") for path in Path(__file__).with_name("saved").glob("*.pafot.yaml")]
EXAMPLES = settings.default.max_examples * 3 // 4
"""The number of examples for each kind of damage."""
WORDS = {"true": True, "false": False, "null": None, "": None}
UNWRITTEN = ("pass", "paper", 10.0, "none", None, "")
"""What a file may say, and a written one leaves out, because it is the default."""


def finding_of(text):
    try:
        return parsed(Path("mutant.pafot.yaml"), text.encode("utf-8", "surrogatepass"))
    except CorpusError:
        return None


def leaves(node, place=""):
    """Return what a text says, by place: numbers, and words without quotes, as such, and everything else as text."""
    found = {}
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            found |= leaves(value, f"{place}.{key.value}")
    elif isinstance(node, yaml.SequenceNode):
        for number, value in enumerate(node.value):
            found |= leaves(value, f"{place}[{number}]")
    if found or node.style is not None or not isinstance(node, yaml.ScalarNode):
        return found or {place: str(node.value)}
    try:
        return {place: float(node.value.replace(".inf", "inf"))}
    except ValueError:
        return {place: WORDS.get(node.value, node.value)}


def misread(text, finding):
    """Return the places at which a text, and that of the finding that was read from it, say different things."""
    said, read = (
        leaves(yaml.compose(each.removeprefix("\ufeff"), yaml.BaseLoader)) for each in (text, text_of(finding))
    )
    differing = {place for place in said.keys() & read.keys() if said[place] != read[place]}
    missing = {place for place in said.keys() - read.keys() if said[place] not in UNWRITTEN}
    return differing | missing | (read.keys() - said.keys())


@pytest.mark.parametrize("kind", MUTATIONS)
def test_damaged_file_is_refused_or_read_correctly(kind):
    rng = random.Random(kind)
    read = 0
    for _ in range(EXAMPLES):
        text = MUTATIONS[kind](rng, rng.choice(TEXTS))
        finding = finding_of(text)
        if finding is not None:
            assert misread(text, finding) == set(), text
            read += 1
    assert read < EXAMPLES


@pytest.mark.parametrize(("old", "new"), [("\n        headway", "\n\t        headway"), ("headway: ", "head?way: ")])
def test_what_only_the_compiled_parser_reads_is_refused(old, new):
    text = next(text for text in TEXTS if old in text)
    assert finding_of(text.replace(old, new, 1)) is None
