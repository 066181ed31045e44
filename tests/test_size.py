"""The package stays small: each room has a ceiling of code lines in ``tests/size.txt``, and the ceilings only fall.

A code line is a line of a ``.py``, ``.pyx``, ``.pxd`` or ``.js`` file that is not blank, not only a comment and not
part of a docstring. A room is the first folder below ``pytest_pafot``; the files directly in it are the room ``(top)``.
"""

import ast
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
NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT),
    *(tokenize.DEDENT, tokenize.ENDMARKER, tokenize.ENCODING),
}


def ceilings(text: str) -> dict[str, int]:
    """Return the ceiling of each room; ``#`` starts a comment."""
    stated = [line.partition("#")[0].split() for line in text.splitlines()]
    return {words[0]: int(words[1].replace(",", "")) for words in stated if words}


def docstring_lines(tree: ast.Module) -> set[int]:
    """Return the lines of bare strings that begin a module, class or function, or follow an assignment."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        may_begin = isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        )
        for before, each in zip([None, *body], body, strict=False):
            is_text = isinstance(each, ast.Expr) and isinstance(
                getattr(each.value, "value", None), str
            )
            if is_text and (
                (before is None and may_begin) or isinstance(before, ast.Assign | ast.AnnAssign)
            ):
                lines.update(range(each.lineno, (each.end_lineno or each.lineno) + 1))
    return lines


def python_lines(text: str) -> int:
    """Return the number of code lines of Python."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    blank = {number for number, line in enumerate(text.splitlines(), 1) if not line.strip()}
    return len(lines - docstring_lines(ast.parse(text)) - blank)


def script_lines(text: str) -> int:
    """Return the number of code lines of JavaScript, in which a comment of several lines has these to itself."""
    lines = re.sub(r"^\s*/\*.*?\*/$", "", text, flags=re.DOTALL | re.MULTILINE).splitlines()
    return sum(bool(line.strip()) and not line.strip().startswith("//") for line in lines)


def code_lines(path: Path) -> int:
    """Return the number of code lines of a file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return python_lines(text)
    if path.suffix == ".js":
        return script_lines(text)
    return sum(
        bool(line.strip()) and not line.strip().startswith("#") for line in text.splitlines()
    )


def rooms() -> Counter[str]:
    """Return the code lines of each room."""
    counted: Counter[str] = Counter()
    for path in PACKAGE.rglob("*"):
        if path.suffix in {".py", ".pyx", ".pxd", ".js"} and "__pycache__" not in path.parts:
            parts = path.relative_to(PACKAGE).parts
            counted[parts[0] if len(parts) > 1 else "(top)"] += code_lines(path)
    return counted


def test_no_room_has_more_code_lines_than_its_ceiling() -> None:
    may_have = ceilings(CEILINGS.read_text(encoding="utf-8"))
    counted = rooms()
    above = {
        name: (lines, may_have.get(name, 0))
        for name, lines in counted.items()
        if lines > may_have.get(name, 0)
    }
    assert not above, f"rooms above their ceilings in tests/size.txt, as (lines, ceiling): {above}"
    gone = {*may_have} - {*counted}
    assert not gone, f"tests/size.txt has ceilings for rooms that do not exist: {gone}"


def test_the_sum_of_the_ceilings_only_falls() -> None:
    def git(*arguments: str) -> str:
        try:
            done = subprocess.run(
                ["git", "-C", ROOT, *arguments], capture_output=True, text=True, check=True
            )
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"needs git and the project's history: {error}")
        return done.stdout

    commits = git("log", "-n", "2", "--format=%H", "--", "tests/size.txt").split()
    versions = [git("show", f"{commit}:tests/size.txt") for commit in reversed(commits)]
    sums = [
        sum(ceilings(text).values()) for text in [*versions, CEILINGS.read_text(encoding="utf-8")]
    ]
    assert sums == sorted(sums, reverse=True)


@pytest.mark.parametrize(
    ("name", "text", "lines"),
    [
        ("a.py", '"""Docstring."""\n\n# comment\nx = """a\n\nb"""\n"""Of x."""\n', 2),
        ("a.py", 'def f():\n    """Two\n    lines."""\n    return 1  # one\n', 2),
        ("a.js", "// comment\n  /* two\nlines */\nlet a = '//';\nlet b = /[/*]/;\n\n", 2),
        ("a.pxd", "# comment\n\ncdef int x\n", 1),
    ],
)
def test_comments_blank_lines_and_docstrings_are_no_code_lines(
    name: str, text: str, lines: int, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    assert code_lines(path) == lines
