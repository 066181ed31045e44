"""No damaged file is read differently from its text."""

import random
from pathlib import Path

import pytest
from hypothesis import settings

from pytest_pafot.corpus.reader import load, parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.support.errors import CorpusError
from tests.helpers.mutations import MUTATIONS, UnclearError, misread, says
from tests.helpers.tables import table

GOLDEN = sorted(Path(__file__).with_name("saved").glob("*.pafot.yaml"))
TEXTS = [path.read_text(encoding="utf-8") for path in GOLDEN]
EXAMPLES = settings.default.max_examples * 3 // 4
"""The number of examples for each kind of damage."""


def finding_of(text):
    try:
        return parsed(Path("mutant.pafot.yaml"), text.encode("utf-8", "surrogatepass"))
    except CorpusError:
        return None


@pytest.mark.parametrize("text", TEXTS, ids=[path.name for path in GOLDEN])
def test_a_file_is_read_as_what_it_says(text):
    assert misread(text, finding_of(text)) == []


@pytest.mark.parametrize("kind", MUTATIONS)
def test_damaged_file_is_refused_or_read_correctly(kind):
    rng = random.Random(kind)
    read = 0
    for _ in range(EXAMPLES):
        text = MUTATIONS[kind](rng, rng.choice(TEXTS))
        finding = finding_of(text)
        if finding is not None:
            assert misread(text, finding) == [], text
            read += 1
    assert read < EXAMPLES


@pytest.mark.parametrize(("old", "new"), [("\n        headway", "\n\t        headway"), ("headway: ", "head?way: ")])
def test_what_only_the_compiled_parser_reads_is_refused(old, new):
    text = TEXTS[0]
    assert old in text
    assert finding_of(text.replace(old, new, 1)) is None


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("seed: 0\n", "seed: 1\n"),
        ("is_minimal: true", "is_minimal: false"),
        ("lanes: 4", "lanes: 5"),
    ],
)
def test_the_judge_sees_a_difference(text, wrong):
    path = next(path for path in GOLDEN if path.name.startswith("collision-shrunk"))
    finding = load(path)
    damaged = text_of(finding).replace(text, wrong, 1)
    assert misread(damaged, finding) != []


@table("value", ["010", "1_0", "yes", "1:30", "~", "1e3", "&a 1", "!!int 1", "{a: 1, a: 2}"])
def test_the_judge_does_not_guess(value):
    with pytest.raises(UnclearError):
        says(f"a: {value}\n")
