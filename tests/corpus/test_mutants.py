"""No damaged file is read differently from its text."""

import random
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import settings

from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.support.errors import CorpusError

TEXTS = [
    path.read_text(encoding="utf-8")
    for path in sorted(Path(__file__).with_name("saved").glob("*.pafot.yaml"))
]
EXAMPLES = settings.default.max_examples * 3 // 4
"""The number of examples for each kind of damage."""
VALUE, KEY, NUMBER = (
    r"(?<=: )[^,{}\[\]\n#|]+(?=[,}\]\n])",
    r"[A-Za-z_]+(?=: )",
    r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.])",
)
NUMBERS = (
    "007", "0x1A", "0o17", "0b11", "1_000", "1:30", "1e3", "+5", "5.", ".5", "1.5e3", "-1", "-0.0", "0", ".nan", ".inf",
    "1.0e+300", "1.0e-300", "99999999999999999999", "3000000", "3", "2.5", "0.1", "61", "12345.6789", "8", "2",
)  # fmt: skip
ODD = (
    "yes", "On", "TRUE", "true", "false", "~", "null", "", "''", '" "', "[]", "{}", "[1]", "{a: 1}", '"4"', "text",
    "2026-11-20", "!!str 4", "&a 4", "*a", "<<", "=", "|", ">", "? a", "- 1", "highway", "gym", "own", "collision",
    "none", "ego", "left",
)  # fmt: skip
AROUND = ('"{}"', "[{}]", "{{a: {}}}", "&a {}", "!!str {}", "! {}", "{0}, {0}")
CHARACTERS = (
    *map(chr, range(32, 127)),
    *"\t\n\0\x85\xa0\u2028\ufeff\u0430\u043e\uff11\u2212\uff1a",
    "",
)


def replaced(pattern, by):
    """Return a function that replaces one of the matches of a pattern in a text."""

    def damage(rng, text):
        found = rng.choice([*re.finditer(pattern, text, re.DOTALL)])
        return text[: found.start()] + by(rng, found[0]) + text[found.end() :]

    return damage


def scaled(rng, number):
    factor = rng.choice([-1, 0, 0.5, 2, 10, 1000, 10**6])
    return repr(float(number) * factor) if "." in number else str(int(int(number) * factor))


def moved(rng, text):
    """Return a text of which a line is dropped, repeated elsewhere, or moved in or out."""
    lines = text.splitlines(keepends=True)
    at = rng.randrange(len(lines))
    lines[at : at + 1] = rng.choice(
        [[], [rng.choice(lines), lines[at]], [f"  {lines[at]}"], [lines[at].lstrip(" ")]]
    )
    return "".join(lines)


DAMAGES = {
    "value": replaced(VALUE, lambda rng, _: rng.choice(ODD)),
    "around a value": replaced(VALUE, lambda rng, value: rng.choice(AROUND).format(value)),
    "number": replaced(NUMBER, lambda rng, _: rng.choice(NUMBERS)),
    "scaled number": replaced(NUMBER, scaled),
    "key": replaced(
        KEY,
        lambda rng, key: rng.choice([f"{key}s", key[1:], key.upper(), "lanes", "seed", f"'{key}'"]),
    ),
    "repeated entry": replaced(
        r"[A-Za-z_]+: [^,{}\[\]\n#|]+(?=[,}\n])", lambda rng, entry: f"{entry}, {entry}"
    ),
    "character": replaced(".", lambda rng, old: rng.choice(["", old]) + rng.choice(CHARACTERS)),
    "line": moved,
    "end": lambda rng, text: text[: rng.randrange(len(text))],
    "head": lambda rng, text: (
        rng.choice(["%YAML 1.1\n---\n", "%TAG ! tag:x,2000:\n---\n", "---\n", "--- !!map\n"]) + text
    ),
}
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
    if found or not isinstance(node, yaml.ScalarNode) or node.style is not None:
        return found or {place: str(node.value)}
    try:
        return {place: float(node.value.replace(".inf", "inf"))}
    except ValueError:
        return {place: WORDS.get(node.value, node.value)}


def misread(text, finding):
    """Return the places at which a text, and that of the finding that was read from it, say different things."""
    said, read = (
        leaves(yaml.compose(each.removeprefix("\ufeff"), yaml.BaseLoader))
        for each in (text, text_of(finding))
    )
    differing = {place for place in said.keys() & read.keys() if said[place] != read[place]}
    missing = {place for place in said.keys() - read.keys() if said[place] not in UNWRITTEN}
    return differing | missing | (read.keys() - said.keys())


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_file_is_refused_or_read_correctly(kind):
    rng = random.Random(kind)
    read = 0
    for _ in range(EXAMPLES):
        text = DAMAGES[kind](rng, rng.choice(TEXTS))
        finding = finding_of(text)
        if finding is not None:
            assert misread(text, finding) == set(), text
            read += 1
    assert read < EXAMPLES


@pytest.mark.parametrize(
    ("old", "new"), [("\n        headway", "\n\t        headway"), ("headway: ", "head?way: ")]
)
def test_what_only_the_compiled_parser_reads_is_refused(old, new):
    text = next(text for text in TEXTS if old in text)
    assert finding_of(text.replace(old, new, 1)) is None
