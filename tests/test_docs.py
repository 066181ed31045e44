"""Every sample in README.md and docs/ works as it is printed.

Samples are fenced blocks, and their first line says what they are:

- ``# name.py`` (or .toml, .yml): a file with this name;
- ``# pafot_corpus/....pafot.yaml``: a corpus file that an earlier command has written;
- ``# last line of pafot_corpus/....pafot.yaml``: the replacement for that line;
- ``$ pytest ...`` or ``$ python ...``: a command with its output.

The blocks of a document run in order, in one folder; ``<!-- new folder -->`` starts with an empty one. In expected
output a line ``...`` stands for anything; everything else is compared, except for white space. The output of ``pytest``
ends with its summary line (``1 failed, 2 passed in 0.4s``), which also gives the exit status; ``$ python`` exits with
0.

Seconds of wall clock vary, as in that line and in ``decisions took 1.0 s``. For other numbers that vary, a comment
before the block names the texts that contain them: ``<!-- varies: 3 of 4 workers | pid 17 -->``. The blocks in a folder
with ``<!-- needs: library -->`` only run if that library is installed.

If the output has changed on purpose, this command updates the samples whose words are the same; read the diff:

    PAFOT_REFRESH=1 python -m pytest tests/test_docs.py -m stories
"""

import importlib
import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from contextlib import nullcontext
from dataclasses import fields
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import highway_env.road.road  # noqa: F401  pytester forgets modules that a run imports; compiled ones must stay
import pytest
import yaml

import pytest_pafot.plugin.replay_item
import pytest_pafot.plugin.search_item
import pytest_pafot.searches.replays
import pytest_pafot.strategies
import pytest_pafot.world.engines.policies
from pytest_pafot import __main__
from pytest_pafot.corpus.reader import parsed
from pytest_pafot.findings.finding import Expect, Found
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.searches.options import BY_NAME, OPTIONS
from pytest_pafot.searches.request import SearchArguments
from pytest_pafot.world import Highway, from_dict
from tests.helpers.sessions import command_in_a_copy, copied_workers, in_process, quick_sessions
from tests.helpers.tables import table

ROOT = Path(__file__).parents[1]
PAGES = [path for path in sorted(ROOT.glob("docs/**/*.md")) if ".pytest_cache" not in path.parts]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
COMPARISONS = ROOT / "docs" / "comparisons"
RUN = {"python", "console", "yaml", "toml"}
NOT_RUN = {"sh", "text"}
COMMANDS = {
    "the main job": "python -m pip install . && cd docs/start && python -m pytest --rootdir=. test_cruise.py "
    "--pafot-seed=1",
    "the tests": 'python -m pip install ".[test]" && python -m pytest -n 2',
}

NEW_FOLDER = "<!-- new folder -->"
GENERATED = re.compile(r"<!-- generated: ([a-z-]+) -->\n(.*?)<!-- end of generated -->", re.DOTALL)
FENCE = re.compile(
    r"(?:^<!-- varies: ([^\n]*) -->\n)?^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE
)
NEEDS = re.compile(r"^<!-- needs: (\w+) -->$", re.MULTILINE)
NUMBER = re.compile(r"(?<![0-9a-f])[0-9a-f]{6}(?![0-9a-f])|\d+(?:\.\d+)?")
WALL_CLOCK = re.compile(
    r"\bin [\d.]+s(?= =|$)|\bdecisions took [\d.]+ s|failed, in [\d.]+ s", re.MULTILINE
)
SUMMARY = re.compile(r"(?:=+ )?(\d+ [a-z]+(?:, \d+ [a-z]+)*) in [\d.]+s(?: =+)?")
REFRESH = "PAFOT_REFRESH"
CORPUS_NAME = re.compile(r"([a-z0-9-]+)-[0-9a-f]{6}(?=\.pafot\.yaml|\])")


class Block(NamedTuple):
    varies: tuple[str, ...]
    """The texts whose numbers vary."""
    language: str
    first: str
    """The first line."""
    rest: str
    """All other lines."""


def text_of(document):
    return document.read_text(encoding="utf-8")


def place(document):
    """Return the path of a document in the repository, without its suffix."""
    return document.relative_to(ROOT).with_suffix("").as_posix()


def blocks_of(text):
    return [
        Block(
            tuple((found[1] or "").split(" | ")) if found[1] else (),
            found[2],
            *found[3].partition("\n")[::2],
        )
        for found in FENCE.finditer(text)
    ]


def stories():
    """Yield the parts of all documents that run in their own folders."""
    for document in DOCUMENTS:
        for number, part in enumerate(GENERATED.sub("", text_of(document)).split(NEW_FOLDER)):
            if any(block.language in RUN for block in blocks_of(part)):
                absent = [
                    name for name in NEEDS.findall(part) if importlib.util.find_spec(name) is None
                ]
                marks = [pytest.mark.skip(reason=f"needs {name}") for name in absent]
                yield pytest.param(document, part, id=f"{place(document)}-{number}", marks=marks)


def pattern(text, varying):
    """Return a pattern for a text: white space, rules of ``=`` and some numbers may differ.

    Args:
        text: The text as in a document.
        varying: Returns whether the number at a place in the text varies.
    """
    parts = []
    for found in re.finditer(rf"\s+|={{3,}}|{NUMBER.pattern}|.", text.strip()):
        if found[0].isspace():
            parts.append(r"\s+")
        elif found[0].startswith("==="):
            parts.append("=+")
        elif NUMBER.fullmatch(found[0]) and varying(found.start()):
            parts.append(
                r"[0-9a-f]{6}" if len(found[0]) == 6 and "." not in found[0] else r"[\d.]+"
            )
        else:
            parts.append(re.escape(found[0]))
    return re.compile("".join(parts))


def compared(text, varies):
    """Return the pattern of a text in which only seconds of wall clock, and the numbers in ``varies``, may differ."""
    text = text.strip()
    spans = [found.span() for found in WALL_CLOCK.finditer(text)]
    spans += [found.span() for each in varies for found in re.finditer(re.escape(each), text)]
    return pattern(text, lambda place: any(start <= place < end for start, end in spans))


def check_output(block, printed):
    """Check a block against the printed output. Return it as it should be."""
    # pytest adds it after the first minute
    printed = re.sub(r"(\bin [\d.]+s) \(\d+:\d\d:\d\d\)", r"\1", printed)
    position, right = 0, block.rest
    for part in re.split(r"^\.\.\.$", block.rest, flags=re.MULTILINE):
        found = compared(part, block.varies).search(printed, position)
        near = found or pattern(part, lambda _: True).search(printed, position)
        if found is None:
            advice = (
                f"with PAFOT_REFRESH=1 the document has:\n{near[0]}"
                if near
                else "edit the document by hand"
            )
            if near is None or not os.environ.get(REFRESH):
                pytest.fail(
                    f"the document says, in this order:\n{part}\n{advice}\n\nall that is printed:\n{printed}"
                )
            right = right.replace(part.strip(), near[0], 1)
        position = near.end()
    if block.language == "console" and not block.rest.rstrip().endswith("..."):
        assert not printed[position:].strip(), (
            f"the document ends before what is printed does:\n{printed[position:]}"
        )
    return right


def check_end(block, result):
    """Check that a pytest sample ends with the last printed line, the summary, and agrees with the exit status."""
    last = block.rest.rstrip().rpartition("\n")[2]
    summary = SUMMARY.fullmatch(last)
    assert summary, (
        f"expected {block.first} to end with a summary line such as `2 passed in 0.4s`, not with: {last}"
    )
    assert result.ret == (1 if re.search(r"\b(failed|errors?)\b", summary[1]) else 0)


class Folder:
    """The folder in which a story runs."""

    def __init__(self, pytester, document):
        self.pytester = pytester
        self.document = document
        self.path = pytester.path

    def show(self, block):
        name = block.first.removeprefix("# ")
        if block.language == "console":
            self.command(block)
        elif name.startswith("last line of "):
            self.replace_last_line(self.saved(name.removeprefix("last line of ")), block.rest)
        elif name.endswith(".pafot.yaml"):
            self.compare(block, self.saved(name).read_text(encoding="utf-8"))
        elif re.fullmatch(r"[\w./-]+\.(py|toml|yml)", name):
            self.write(name, block.rest)
        else:
            pytest.fail(f"a block that says neither its file's name nor a command: {block}")

    def write(self, name, content):
        if name.endswith(".toml"):
            keys = tomllib.loads(content)["tool"]["pytest"]
            assert set(keys) <= {option.key for option in OPTIONS}
        if name.endswith(".yml"):
            yaml.safe_load(content)
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content, encoding="utf-8")

    def saved(self, name):
        """Return the file of this name. The digits of its scenario may differ here."""
        path = self.path / self.with_own_ids(name)
        assert path.is_file(), f"{name}: expected among {self.ids}"
        return path

    def replace_last_line(self, path, line):
        lines = path.read_text(encoding="utf-8").splitlines()
        path.write_text("\n".join([*lines[:-1], line]), encoding="utf-8")

    @property
    def ids(self):
        return sorted(
            path.name.removesuffix(".pafot.yaml") for path in self.path.rglob("*.pafot.yaml")
        )

    def with_own_ids(self, text):
        """Replace the digits of saved scenarios in a text by those of this machine."""

        def own(found):
            slug = found[1].rpartition("saved-")[2]
            same = [each for each in self.ids if each.startswith(f"{slug}-")]
            return found[0].replace(found[0][-6:], same[0][-6:]) if same else found[0]

        return CORPUS_NAME.sub(own, text)

    def command(self, block):
        assert block.first.startswith("$ "), (
            f"a console block that does not begin with a command: {block.first}"
        )
        program, *arguments = shlex.split(self.with_own_ids(block.first.removeprefix("$ ")))
        if [program, *arguments[:2]] == ["python", "-m", "pytest_pafot"]:
            with pytest.MonkeyPatch.context() as patch:  # replay starts pytest
                patch.setenv("PYTEST_PLUGINS", "pytest_pafot.plugin")
                done = command_in_a_copy(*arguments[1:])
            self.compare(block, done.out)
            assert done.code == (arguments[2] == "replay")  # of a failure
            return
        if program in ("python", "git"):
            with pytest.MonkeyPatch.context() as patch:  # git bisect starts pytest
                patch.setenv("PYTEST_PLUGINS", "pytest_pafot.plugin")
                patch.setenv(
                    "PATH", os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
                )
                done = self.pytester.run(
                    sys.executable if program == "python" else program, *arguments
                )
            self.compare(block, done.stdout.str())
            assert done.ret == 0
            return
        assert program == "pytest", block.first
        # unraisableexception collects all garbage at the end of each session, which is slow and not needed here.
        result = in_process(
            self.pytester, "-p", "pafot", "-p", "no:unraisableexception", *arguments
        )
        self.compare(block, result.stdout.str())
        check_end(block, result)

    def compare(self, block, printed):
        """Compare the output with the document, or update the document."""
        right = check_output(block, printed)
        if right != block.rest:
            text = text_of(self.document).replace(block.rest, right)
            renamed = zip(NUMBER.findall(block.rest), NUMBER.findall(right), strict=True)
            for old, new in {(old, new) for old, new in renamed if old != new and len(old) == 6}:
                text = text.replace(old, new)  # in commands and sentences, too
            self.document.write_text(text, encoding="utf-8")


@pytest.fixture
def folder(pytester, monkeypatch, document):
    quick_sessions(monkeypatch)
    copied_workers(monkeypatch)
    for name in ("CI", "BUILD_NUMBER", "PYTEST_ADDOPTS", "GITHUB_STEP_SUMMARY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    for name in ("AUTHOR", "COMMITTER"):  # so that a commit always has the same hash
        for what, value in {
            "NAME": "Ann",
            "EMAIL": "ann@example.org",
            "DATE": "2026-10-05T09:00:00+0000",
        }.items():
            monkeypatch.setenv(f"GIT_{name}_{what}", value)
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    # other installed plugins may print and warn
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    return Folder(pytester, document)


@pytest.mark.stories
@pytest.mark.parametrize(("document", "story"), list(stories()))
def test_samples_work_as_printed(story, folder):
    for block in blocks_of(story):
        if block.language in RUN:
            folder.show(block)


@pytest.mark.stories
def test_samples_have_the_right_types(tmp_path):
    """Each story is a package, and so is each of its states in which a file has a new version."""
    for number, (_, story) in enumerate(each.values for each in stories()):
        files, version = {}, 0
        for block in [each for each in blocks_of(story) if each.language == "python"]:
            name = block.first.removeprefix("# ")
            version += name in files
            files[name] = block.rest
            own = "|".join(path.removesuffix(".py") for path in files)
            for path, text in files.items():
                file = tmp_path / f"story_{number}_{version}" / path
                file.parent.mkdir(parents=True, exist_ok=True)
                inside = re.sub(
                    rf"^from ({own}) import", r"from .\1 import", text, flags=re.MULTILINE
                )
                file.write_text(
                    re.sub(rf"^import ({own})$", r"from . import \1", inside, flags=re.MULTILINE),
                    "utf-8",
                )
    options = [
        "--check-untyped-defs",
        "--ignore-missing-imports",
        "--explicit-package-bases",
        "--config-file=",
    ]
    command = [sys.executable, "-m", "mypy", *options, f"--cache-dir={os.devnull}", "."]
    environ = {**os.environ, "MYPYPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environ, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


SAMPLE = """
<!-- varies: took 0.030 s -->
```console
$ pytest -q
...
E  after 6.3 s in cell 2, took 0.030 s
  20 runs and 9 decisions took 1.0 s
...
saved as front-d175c6
1 failed in 0.43s
```
"""
PRINTED = (
    "F\nE   after 6.3 s in cell 2, took 0.125 s\n\n20 runs and 9 decisions took 12.5 s more\nsaved as front-d175c6\n"
    "1 failed in 7.1s\n"
)


def test_numbers_are_compared_except_times_and_named_ones_up_to_the_end():
    (block,) = blocks_of(SAMPLE)
    assert check_output(block, PRINTED) == block.rest
    with pytest.raises(AssertionError, match="the document ends before what is printed does"):
        check_output(block, PRINTED + "and more\n")


@pytest.mark.parametrize(("old", "new"), [
    ("6.3", "6.4"), ("cell 2", "cell 12"), ("20 runs", "21 runs"), ("d175c6", "d175c7"), ("1 f", "2 f"),
])  # fmt: skip
def test_different_number_fails_and_says_how_to_refresh(old, new, monkeypatch):
    monkeypatch.delenv(REFRESH, raising=False)
    (block,) = blocks_of(SAMPLE)
    with pytest.raises(
        pytest.fail.Exception, match=f"(?s)the document says.*{old}.*with PAFOT_REFRESH=1 .*{new}"
    ):
        check_output(block, PRINTED.replace(old, new))


@table(("rest", "code", "holds"), [
    ("...\n2 passed in 0.1s\n", 0, True),
    ("=== 1 passed, 1 xfailed in 0.1s ===\n", 0, True),
    ("1 failed, 2 passed in 0.1s\n", 1, True),
    ("2 passed in 0.1s\n", 1, False),
    ("1 failed in 0.1s\n", 0, False),
    ("2 passed\n...\n", 0, False),
])  # fmt: skip
def test_pytest_sample_ends_with_summary_matching_exit_status(rest, code, holds):
    with nullcontext() if holds else pytest.raises(AssertionError):
        check_end(Block((), "console", "$ pytest", rest), SimpleNamespace(ret=code))


def test_every_block_says_its_language():
    languages = [
        (place(document), block.language)
        for document in DOCUMENTS
        for block in blocks_of(text_of(document))
    ]
    assert [each for each in languages if each[1] not in RUN | NOT_RUN] == []


def test_readme_has_commands_to_install_and_run():
    blocks = [f"<!-- {name} -->\n```sh\n{command}\n```" for name, command in COMMANDS.items()]
    assert [block for block in blocks if block not in text_of(ROOT / "README.md")] == []


def tool(name):
    spec = importlib.util.spec_from_file_location(
        f"docs_{name}", ROOT / "docs" / "tools" / f"{name}.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_as_the_code_has_it():
    module = tool("generate")
    for page in module.REFERENCE:
        assert module.generated(text_of(page)) == text_of(page), (
            "run: python docs/tools/generate.py"
        )
    present = [name for name, _ in GENERATED.findall("".join(map(text_of, module.REFERENCE)))]
    assert sorted(present) == sorted(module.sections())


@pytest.mark.stories
def test_every_program_that_measures_can_be_imported():
    for command in tool("figures").BENCHMARKS.values():
        assert importlib.import_module(f"tests.benchmarks.{command.split()[0]}").main


def test_measured_tables_have_one_place_and_agree_with_their_files():
    figures = tool("figures")
    places = re.findall(r"<!-- measured: ([a-z-]+) -->", "".join(map(text_of, DOCUMENTS)))
    assert sorted(places) == sorted(figures.OVERVIEWS)
    for name, (page, overview) in figures.OVERVIEWS.items():
        table = figures.markdown(overview(COMPARISONS))
        assert f"<!-- measured: {name} -->\n{table}<!-- end of measured -->" in text_of(ROOT / page)


def test_reference_has_a_row_for_every_option():
    module = tool("generate")
    tables, grouped = (
        module.sections(),
        [name for names in module.OPTION_GROUPS.values() for name in names],
    )
    assert sorted(grouped) == sorted(option.name for option in OPTIONS)
    rows = [row for group in module.OPTION_GROUPS for row in tables[group].splitlines()[2:]]
    for name, row in zip(grouped, rows, strict=True):
        option = BY_NAME[name]
        names = (option.key,) if option.everywhere else ()
        assert all(f"`{name}`" in row for name in names)
        assert (f"`{option.name}=`" in row) is (option.everywhere and option.is_argument)
        assert option.flag in row


def test_reference_has_a_row_for_every_argument_of_the_mark_and_every_key_of_a_file():
    module = tool("generate")
    arguments = [name for names in module.MARKER_GROUPS.values() for name in names]
    assert sorted(arguments) == sorted(SearchArguments.__annotations__)
    keys = {name for names in module.FILE_TEXTS for name in names.split(", ")}
    parts = {"expect": Expect, "found": Found, "shrunk": Shrunk}
    stored = {f"{part}.{field.name}" for part, cls in parts.items() for field in fields(cls)}
    assert {key for key in keys if key.partition(".")[0] in parts} == stored


@pytest.mark.parametrize("command", ["", *__main__.COMMANDS, "corpus list", "corpus accept"])
def test_no_help_names_a_file_of_the_documentation(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        __main__.main([*command.split(), "--help"])
    assert not re.search(r"\bdocs/|\.md\b", capsys.readouterr().out)


def test_example_of_a_corpus_file_can_be_read():
    (example,) = (
        block
        for name, block in GENERATED.findall(text_of(ROOT / "docs/reference/files.md"))
        if name == "example-file"
    )
    content = example.removeprefix("```yaml\n").removesuffix("```\n")
    finding = parsed(Path("front-2-1f3a9c.pafot.yaml"), content.encode())
    assert from_dict(dict(finding.world)) == Highway()


@pytest.mark.stories
def test_every_documentation_tool_can_be_imported(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    tools = {path.name for path in Path("docs", "tools").glob("*.py")}
    for name in sorted(tools):
        runpy.run_path(f"docs/tools/{name}")
    assert capsys.readouterr() == ("", "")


@pytest.mark.stories
def test_the_moving_picture_shows_what_its_sample_finds(tmp_path):
    crash = tool("crash_picture")
    policy = runpy.run_path(str(crash.SAMPLE))[crash.POLICY]
    assert crash.drawn(crash.found(tmp_path), policy) == text_of(crash.PICTURE), (
        "run: python docs/tools/crash_picture.py"
    )


def test_every_page_that_code_names_exists():
    code = [
        path
        for room in ("pytest_pafot", "tests", "docs", "example_ads")
        for path in (ROOT / room).rglob("*.py")
    ]
    named = {name for path in code for name in re.findall(r"\bdocs/[\w/-]+\.md\b", text_of(path))}
    assert named
    assert {name for name in named if not (ROOT / name).is_file()} == set()
    titles = {text_of(document).partition("\n")[0].removeprefix("# ") for document in DOCUMENTS}
    assert {
        title for path in code for title in re.findall(r'\bpage "([^"{]+)"', text_of(path))
    } <= titles


def test_every_page_is_listed_in_one_index():
    listed = []
    for index in (ROOT / "docs").rglob("index.md"):
        links = re.findall(r"^- \[[^\]]*\]\(([\w/.-]+)\)", text_of(index), re.MULTILINE)
        listed += [place((index.parent / link).resolve()) for link in links]
    pages = [*PAGES, *(ROOT / "docs").rglob("*.rst")]
    assert sorted([*listed, "docs/index"]) == sorted(map(place, pages))


def test_site_has_every_public_name_and_package():
    pages = "".join(map(text_of, (ROOT / "docs" / "api").glob("*.rst")))
    modules = re.findall(r"^\.\. automodule:: (\S+)", pages, re.MULTILINE)
    lists = [
        path
        for path in (ROOT / "pytest_pafot").glob("*/__init__.py")
        if "__all__ = " in text_of(path)
    ]
    assert {f"pytest_pafot.{path.parent.name}" for path in lists} <= set(modules)
    names = {
        name for each in modules for name in getattr(importlib.import_module(each), "__all__", ())
    }
    names |= {each.removeprefix("pytest_pafot.") for each in modules}
    names |= set(re.findall(r"^\.\. auto\w+:: pytest_pafot\.(\w+)$", pages, re.MULTILINE))
    assert set(pytest_pafot.__all__) <= names


def anchor(heading):
    """Return the anchor that code hosts make from a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@cache
def anchors(document):
    text = FENCE.sub("", text_of(document))
    headings = {anchor(heading) for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}
    return headings | set(re.findall(r'<a id="([^"]+)"></a>', text))


def links():
    """Yield every link and picture inside the repository, with its document."""
    for document in DOCUMENTS:
        for target in re.findall(
            r"(?:\]\(|src=\"|srcset=\")([^)\"\s]+)", FENCE.sub("", text_of(document))
        ):
            if "://" not in target:
                yield document, target


def leads_somewhere(document, target):
    name, _, section = target.partition("#")
    path = (document.parent / name).resolve() if name else document
    return path.exists() and (not section or section in anchors(path))


def test_every_link_inside_of_the_repository_leads_somewhere():
    assert [
        f"{place(document)}: {target}"
        for document, target in links()
        if not leads_somewhere(document, target)
    ] == []


def test_every_option_in_the_documents_exists():
    flags = {option.flag for option in OPTIONS}
    used = [
        (place(document), flag)
        for document in DOCUMENTS
        for flag in re.findall(r"--pafot-[a-z]+(?:-[a-z]+)*", text_of(document))
    ]
    assert [each for each in used if each[1] not in flags] == []


def workflows():
    for document in DOCUMENTS:
        for block in blocks_of(text_of(document)):
            if block.first.startswith("# .github/workflows/"):
                yield yaml.safe_load(block.rest)


def test_searching_job_has_more_time_than_its_searches():
    for workflow in workflows():
        commands = {
            name: " ".join(step.get("run", "") for step in job["steps"])
            for name, job in workflow["jobs"].items()
        }
        searching = {name: text for name, text in commands.items() if "--pafot-runs=0" not in text}
        assert searching
        for name, text in searching.items():
            (seconds,) = re.findall(r"--pafot-max-time=(\d+)", text)  # of the only search
            assert workflow["jobs"][name]["timeout-minutes"] * 60 >= int(seconds) + 15 * 60
