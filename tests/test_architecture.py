"""The page about the rooms is true: every room, library, file and name on it agrees with the code."""

import ast
import re
from functools import cache

from tests.test_layers import HOMES, MODULES, PACKAGE, ROOMS, room_of

ROOT = PACKAGE.parent
PAGE = (ROOT / "docs" / "maintain" / "architecture.md").read_text(encoding="utf-8")
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
EXPLANATION = "".join(
    page.read_text(encoding="utf-8")
    for page in sorted((ROOT / "docs" / "explanation").glob("*.md"))
)

ROOM_ROW = re.compile(r"^\| `(\w+)` \| (.+?) \|(.*)\|$", re.MULTILINE)
MENTION = re.compile(r"`((?:[\w.-]+/)*[\w.-]+\.(?:py|toml)|(?:[\w.-]+/)+)(?::([\w.]+))?`")


def section(heading, page=PAGE):
    return page.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]


def rooms_on_the_page():
    return {
        name: set(re.findall(r"`(\w+)`", libraries))
        for name, _, libraries in ROOM_ROW.findall(section("The rooms"))
    }


def mentions():
    """Return files and names on the page, in the explanation, and in the pages for contributors."""
    return sorted(
        {(path, name) for path, name in MENTION.findall(PAGE + EXPLANATION + CONTRIBUTING)}
    )


def place(path):
    """Return the path of a named file or folder, in the package or in the repository."""
    return next((at for at in (PACKAGE / path, ROOT / path) if at.exists()), None)


def defined(body):
    """Return the names that statements define, including those inside classes."""
    names = {}
    for node in body:
        if isinstance(node, ast.ClassDef):
            names[node.name] = defined(node.body)
        elif isinstance(node, ast.FunctionDef):
            names[node.name] = {}
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {
                each.id: {}
                for target in targets
                for each in ast.walk(target)
                if isinstance(each, ast.Name)
            }
    return names


def test_page_lists_the_rooms_in_import_order_and_which_libraries_they_know():
    there = {room_of(path) for path in MODULES}
    assert list(rooms_on_the_page()) == [room for room in ROOMS if room in there]
    known = {
        room: {library for library, homes in HOMES.items() if room in homes}
        for room in rooms_on_the_page()
    }
    assert rooms_on_the_page() == known


@cache
def defined_in(path):
    return defined(ast.parse(path.read_text(encoding="utf-8")).body)


def is_there(path, name):
    """Return whether there is such a file or folder, and a name in it if one is given."""
    there = place(path)
    if there is None or not name:
        return there is not None
    names = defined_in(there)
    for part in name.split("."):
        if part not in names:
            return False
        names = names[part]
    return True


def test_what_is_named_is_there():
    assert [f"{path}:{name}" for path, name in mentions() if not is_there(path, name)] == []


def entries():
    """Return the rows of the tables of rules, and the paragraphs about how to add something."""
    places = section("Where to find each part", EXPLANATION).partition("\n# ")[0]
    rows = re.findall(r"^\| (?!---|Section).*\|$", places, re.MULTILINE)
    added = section("How to extend the package", CONTRIBUTING)
    return [*rows, *re.findall(r"^\*\*.*?(?=\n\n|\Z)", added, re.MULTILINE | re.DOTALL)]


def test_every_rule_and_recipe_mentions_the_code():
    assert len(entries()) > 20
    assert [entry for entry in entries() if not MENTION.search(entry)] == []
