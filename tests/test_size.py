"""The package stays small: each room has a ceiling of tokens in ``tests/size.txt``.

Whoever needs more in a room raises its ceiling in the same commit, and says why. The sum of all ceilings is at most the
number of the line ``(all)``, which only falls.

Tokens measure how much there is to read, whatever the length of a line. A room is the first folder below
``pytest_pafot``; the files directly in it are the room ``(top)``.
"""

import ast
import functools
import io
import re
import subprocess
import tokenize
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "pytest_pafot"
CEILINGS = Path(__file__).with_name("size.txt")
ALL = "(all)"
UNIT = "# tokens\n"
"""The first line of ``size.txt``. Earlier versions, with other units, have another one."""
NO_CODE = {"COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER", "ENCODING", "FSTRING_END"}
COMMENTS = re.compile(r"/\*.*?\*/|^\s*(#|//).*?$", re.DOTALL | re.MULTILINE)
"""Comments of several lines, and lines with only a comment, in Cython and JavaScript."""


def ceilings(text: str) -> dict[str, int]:
    """Return the ceiling of each room; ``#`` starts a comment."""
    stated = [line.partition("#")[0].split() for line in text.splitlines()]
    return {words[0]: int(words[1].replace(",", "")) for words in stated if words}


def count_tokens(path: Path) -> int:
    """Return the number of tokens of a file, without comments and docstrings."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        return len(re.findall(r"\w+|[^\w\s]", COMMENTS.sub("", text)))
    docstrings: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str):
            docstrings.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    tokens = f_strings = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        name = tokenize.tok_name[token.type]
        # Since Python 3.12, an f-string has several tokens. It counts as one, as before.
        f_strings -= name == "FSTRING_END"
        tokens += not f_strings and name not in NO_CODE and token.start[0] not in docstrings
        f_strings += name == "FSTRING_START"
    return tokens


@functools.cache
def rooms() -> Counter[str]:
    """Return the tokens of each room, which take a second to count."""
    counted: Counter[str] = Counter()
    for path in PACKAGE.rglob("*"):
        if path.suffix in {".py", ".pyx", ".pxd", ".js"}:
            parts = path.relative_to(PACKAGE).parts
            counted[parts[0] if len(parts) > 1 else "(top)"] += count_tokens(path)
    return counted


def test_no_room_has_more_tokens_than_its_ceiling() -> None:
    may_have = ceilings(CEILINGS.read_text(encoding="utf-8"))
    above = {
        name: (tokens, may_have.get(name, 0))
        for name, tokens in rooms().items()
        if tokens > may_have.get(name, 0)
    }
    assert not above, f"rooms above their ceilings in tests/size.txt, as (tokens, ceiling): {above}"


def test_every_ceiling_is_for_a_room_that_exists() -> None:
    gone = {*ceilings(CEILINGS.read_text(encoding="utf-8"))} - {*rooms(), ALL}
    assert not gone, f"tests/size.txt has ceilings for rooms that do not exist: {gone}"


def test_the_ceilings_have_no_larger_sum_than_the_package_may_have() -> None:
    may_have = ceilings(CEILINGS.read_text(encoding="utf-8"))
    most = may_have.pop(ALL)
    assert sum(may_have.values()) <= most


def test_the_ceiling_of_the_package_only_falls() -> None:
    def git(*arguments: str) -> str:
        try:
            done = subprocess.run(
                ["git", "-C", ROOT, *arguments], capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"needs git and the project's history: {error}")
        return done.stdout

    now = CEILINGS.read_text(encoding="utf-8")
    assert now.startswith(UNIT)
    commits = git("log", "-n", "2", "--format=%H", "--", "tests/size.txt").split()
    versions = [git("show", f"{commit}:tests/size.txt") for commit in reversed(commits)]
    # Versions with another unit, or without this line, cannot be compared.
    known = [ceilings(text) for text in [*versions, now] if text.startswith(UNIT)]
    most = [each[ALL] for each in known if ALL in each]
    assert most == sorted(most, reverse=True)


@pytest.mark.parametrize(
    ("name", "text", "tokens"),
    [
        ("a.py", '"""Docstring."""\n\n# comment\nx = """a\n\nb"""\n"""Of x."""\n', 3),
        ("a.py", 'def f():\n    """Two\n    lines."""\n    return 1  # one\n', 7),
        ("a.py", "x = f'{a + 1} {f\"{b}\"} c' + 'd'\n", 5),
        ("a.js", "// comment\n  /* two\nlines */\nlet a = 'b c';\nlet d;\n\n", 11),
        ("a.pxd", "# comment\n\ncdef int x\n", 3),
    ],
)
def test_comments_blank_lines_and_docstrings_are_no_tokens(
    name: str, text: str, tokens: int, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert count_tokens(path) == tokens
