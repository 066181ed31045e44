"""Configuration of the site: ``python -m sphinx -W --keep-going -n -b html docs build/site``.

Pages are plain Markdown that also reads well on a code host. This file adds what only a site needs: the navigation
from the lists of pages in each ``index.md``, copies of pictures and report pages that HTML inside a page names, and
words for the search.
"""

from __future__ import annotations

import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.errors import ExtensionError

import pytest_pafot

DOCS = Path(__file__).parent
ROOT = DOCS.parent

project = "pytest-pafot"
author = "the pytest-pafot developers"
release = version = pytest_pafot.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["tools", "_static", "_templates", "**/.pytest_cache"]
templates_path = ["_templates"]

html_theme = "furo"
html_title = f"{project} {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_search_scorer = str(DOCS / "_static" / "scorer.js")
html_show_copyright = False
html_theme_options = {"navigation_with_keys": False}

myst_heading_anchors = 4
smartquotes = False  # else the two hyphens of an option become a dash
myst_links_external_new_tab = False

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
# one list, like arguments
napoleon_custom_sections = [("Attributes", "params_style"), ("Keys", "params_style")]
default_role = "code"  # in a docstring `name` is code, as in Markdown
# types of other libraries; what a docstring names, see closest()
nitpick_ignore_regex = [("py:.*", ".*")]

_PICTURE = re.compile(
    r'<picture>\n<source media="[^"]*dark[^"]*" srcset="([^"]*)">\n<img src="([^"]*)" (.*)>\n</picture>'
)
_LIVE = re.compile(r"<!-- live -->.*?<!-- end of live -->", re.DOTALL)
_PLACE = re.compile(r'<a id="([^"]+)"></a>')
_FIRST_FIND = DOCS / "start" / "tutorial.md"
_SEARCHED = {
    "explanation/findings": "severity",
    "guide/environments": "intersection",
    "explanation/search": "aggressive",
}
"""Words that readers search for, by the page that answers them."""
_LISTED = re.compile(r"^- \[([^\]]*)\]\(([\w/.-]+)\.(?:md|rst)\)", re.MULTILINE)


def navigated(app: Sphinx, docname: str, content: list[str]) -> None:
    """Add a navigation to each page named index: its headings and its lists of pages, in their words."""
    if docname.rpartition("/")[2] == "index":
        _, *parts = re.split(r"^## (.*)$", f"## \n{content[0]}", flags=re.MULTILINE)
        for heading, body in zip(parts[::2], parts[1::2], strict=True):
            if pages := "\n".join(f"{words} <{page}>" for words, page in _LISTED.findall(body)):
                caption = f":caption: {heading}\n" if heading else ""
                content[0] += f"\n```{{toctree}}\n:hidden:\n{caption}\n{pages}\n```\n"


def themed(app: Sphinx, docname: str, content: list[str]) -> None:
    """Make pictures follow the page's switch between light and dark, and replace a live picture by its report page."""
    content[0] = _LIVE.sub(
        '<iframe class="report" src="finding.html" title="A report page"></iframe>', content[0]
    )
    content[0] = _PICTURE.sub(
        r'<img class="only-light" src="\2" \3><img class="only-dark" src="\1" \3>', content[0]
    )


def indexed(app: Sphinx, docname: str, content: list[str]) -> None:
    """Add the word that readers search for to the page's index.

    The search finds it there as it is written. In texts it finds only the stem, which "severity" shares with "several".
    """
    if word := _SEARCHED.get(docname):
        content[0] = content[0].replace("\n", f"\n\n```{{index}} ! {word}\n```\n", 1)


def placed(app: Sphinx, doctree: nodes.document) -> None:
    """Let pages link to places that HTML names, such as the rows of options; MyST itself knows headings alone."""
    places = app.env.metadata[app.env.docname].setdefault("myst_slugs", {})
    for place in _PLACE.findall("".join(node.astext() for node in doctree.findall(nodes.raw))):
        places.setdefault(place, (None, place, place))


def contributing(app: Sphinx, docname: str, content: list[str]) -> None:
    """Fill the contributors' page with the file from the root of the repository."""
    if docname == "maintain/contributing":
        text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
        content[0] = text.replace("](docs/", "](../")


def skipped(
    app: Sphinx, what: str, name: str, thing: object, skip: bool, options: object
) -> bool | None:
    """Skip members that only compiled classes have; the docstring of the class lists them."""
    return True if inspect.isgetsetdescriptor(thing) or inspect.ismemberdescriptor(thing) else None


def linked(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    """Turn the pages that a docstring names into links, list columns, and stop napoleon from reading types."""
    lines[:] = [re.sub(r"\bdocs/([\w/-]+)\.md\b", r":doc:`/\1`", line) for line in lines]
    if what == "property":
        lines.insert(0, "")
    if isinstance(thing, Mapping):
        lines += ["", *(f"- ``{column}``: {text}" for column, text in thing.items())]


def closest(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.Node | None:
    """Return a link for a short name in a docstring, if exactly one object on the pages has this name."""
    if node.get("refdomain") != "py":
        return None
    domain, last = env.domains.python_domain, f".{node['reftarget'].rpartition('.')[2]}"
    # An object that is imported elsewhere has several names, but only one place.
    found = {
        (entry.docname, entry.node_id)
        for name, entry in domain.objects.items()
        if f".{name}".endswith(last)
    }
    if len(found) != 1:
        return None
    ((docname, place),) = found
    address = app.builder.get_relative_uri(node["refdoc"], docname)
    return nodes.reference("", "", content, internal=True, refuri=f"{address}#{place}")


def pictures() -> Iterator[Path]:
    """Yield the files that HTML inside pages may name. Sphinx does not see these names."""
    for suffix in ("png", "svg", "html"):
        yield from DOCS.rglob(f"*.{suffix}")


def copied(app: Sphinx, exception: Exception | None) -> None:
    """Copy pictures and report pages to where the pages expect them."""
    for path in pictures():
        place = Path(app.outdir) / path.relative_to(DOCS)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, place)


def found(app: Sphinx, exception: Exception | None) -> None:
    """Make the report page of the first finding, with the first command on that page and the files before it.

    Raises:
        ExtensionError: if the command makes no report page.
    """
    if exception is not None:
        return
    text = _FIRST_FIND.read_text(encoding="utf-8")
    before, command, _ = re.split(r"^\$ pytest (.*)$", text, maxsplit=1, flags=re.MULTILINE)
    python = [sys.executable, "-m", "pytest", *shlex.split(command)]
    plugins = {
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "PYTEST_PLUGINS": "pytest_pafot.plugin",
        "PYTEST_ADDOPTS": "",
    }
    variables = {**os.environ, "PYTHONPATH": str(ROOT), **plugins}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "my-planner")  # the page names it
        folder.mkdir()
        for name, content in re.findall(
            r"^```python\n# (\S+)\n(.*?)^```$", before, re.MULTILINE | re.DOTALL
        ):
            Path(folder, name).write_text(content, encoding="utf-8")
        done = subprocess.run(  # noqa: S603
            python, cwd=folder, env=variables, capture_output=True, text=True, check=False
        )
        page = Path(folder, "finding.html")
        if not page.is_file():
            raise ExtensionError(
                f"{_FIRST_FIND}: expected {page.name} of `pytest {command}`, received {done.stdout}"
            )
        shutil.copyfile(page, Path(app.outdir) / _FIRST_FIND.relative_to(DOCS).with_name(page.name))


def led(app: Sphinx, exception: Exception | None) -> None:
    """Check that each link to a place on a page leads to a place that exists.

    Raises:
        ExtensionError: if a link leads nowhere.
    """
    pages = (
        [Path(app.outdir, f"{name}.html").resolve() for name in app.env.found_docs]
        if exception is None
        else []
    )
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    places = {page: set(re.findall(r'\sid="([^"]*)"', text)) for page, text in texts.items()}
    dead = [
        f"{page.relative_to(app.outdir)}: {target}#{place}"
        for page, text in texts.items()
        for target, place in re.findall(r'href="([^":#]*)#([^"]+)"', text)
        if place not in places.get((page.parent / target).resolve() if target else page, {place})
    ]
    if dead:
        raise ExtensionError(
            "links to places that their pages do not have:\n" + "\n".join(sorted(set(dead)))
        )


def setup(app: Sphinx) -> None:
    """Connect the functions above to the events of Sphinx.

    Raises:
        ExtensionError: if a page to be found by a word does not exist.
    """
    if gone := [page for page in _SEARCHED if not (DOCS / f"{page}.md").is_file()]:
        raise ExtensionError(
            f"_SEARCHED: expected pages of {DOCS}, received {', '.join(gone)}; was a page renamed?"
        )
    for change in (contributing, navigated, themed, indexed):
        app.connect("source-read", change)
    app.connect("doctree-read", placed)
    app.connect("autodoc-skip-member", skipped)
    app.connect("autodoc-process-docstring", linked, priority=400)  # before napoleon
    app.connect("missing-reference", closest)
    app.connect("build-finished", copied)
    app.connect("build-finished", found)
    app.connect("build-finished", led)
