"""Every sample in README.md and docs/ works as it is printed.

Samples are fenced blocks, and their first line says what they are:

- ``# name.py`` (or .toml, .yml): a file that is written under this name;
- ``# pafot_corpus/....pafot.yaml``: a corpus file as an earlier command has written it;
- ``# last line of pafot_corpus/....pafot.yaml``: what replaces that line;
- ``$ pytest ...`` or ``$ python ...``: a command with what it prints.

The blocks of a document run in order, in one folder; ``<!-- new folder -->`` starts with an empty one. In expected
output ``...`` stands for anything, every number and every scenario's six digits for any other.
"""

import html
import importlib.util
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

import highway_env.road.road  # noqa: F401  pytester forgets modules that a run imports; compiled ones must stay
import pytest
import yaml

import pytest_pafot.plugin.replaying
import pytest_pafot.plugin.searcher
import pytest_pafot.strategies
import pytest_pafot.world.engine  # noqa: F401
from pytest_pafot.findings.corpus import parsed
from pytest_pafot.plugin.options import OPTIONS
from pytest_pafot.world import Highway, from_dict

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN = {"python", "console", "yaml", "toml"}
NOT_RUN = {"sh", "text"}
COMMANDS = {
    "the main job": "python -m pip install . && python -m pytest example_ads --pafot-generations=5",
    "the tests": 'python -m pip install ".[test]" && python -m pytest -n 2',
}

NEW_FOLDER = "<!-- new folder -->"
GENERATED = re.compile(r"<!-- generated: ([a-z-]+) -->\n(.*?)<!-- end of generated -->", re.DOTALL)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
VARIABLE = re.compile(r"(?<![0-9a-f])[0-9a-f]{6}(?![0-9a-f])|\d+(?:\.\d+)?")
CORPUS_NAME = re.compile(r"([a-z0-9-]+)-[0-9a-f]{6}(?=\.pafot\.yaml|\])")


class Block(NamedTuple):
    language: str
    first: str
    """The first line."""
    rest: str
    """All others."""


def text_of(document):
    return document.read_text(encoding="utf-8")


def blocks_of(text):
    return [Block(found[1], *found[2].partition("\n")[::2]) for found in FENCE.finditer(text)]


def stories():
    """The parts of all documents that run in a folder of their own."""
    for document in DOCUMENTS:
        for number, part in enumerate(GENERATED.sub("", text_of(document)).split(NEW_FOLDER)):
            if any(block.language in RUN for block in blocks_of(part)):
                yield pytest.param(part, id=f"{document.stem}-{number}")


def expected(output):
    """A pattern for the printed output: white space, numbers and ids are loose, ``...`` is anything."""
    parts = [part.split() for part in re.split(r"^\.\.\.$", output, flags=re.MULTILINE)]
    return [r"\s+".join(_loose(word) for word in words) for words in parts if words]


def _loose(word):
    kept = VARIABLE.split(word)
    found = VARIABLE.findall(word)
    loose = [r"[0-9a-f]{6}" if len(each) == 6 and "." not in each else r"[\d.]+" for each in found] + [""]
    return "".join(re.escape(part) + gap for part, gap in zip(kept, loose, strict=True))


def check_output(output, printed):
    position = 0
    for pattern in expected(output):
        found = re.compile(pattern).search(printed, position)
        assert found, f"not found in order:\n{pattern}\n\nin what was printed:\n{printed}"
        position = found.end()


class Folder:
    """Where a story runs."""

    def __init__(self, pytester):
        self.pytester = pytester
        self.path = pytester.path

    def show(self, block):
        name = block.first.removeprefix("# ")
        if block.language == "console":
            self.command(block)
        elif name.startswith("last line of "):
            self.replace_last_line(self.saved(name.removeprefix("last line of ")), block.rest)
        elif name.endswith(".pafot.yaml"):
            check_output(block.rest, self.saved(name).read_text(encoding="utf-8"))
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
        """The file of this name, whatever its scenario's digits are here."""
        path = self.path / self.with_own_ids(name)
        assert path.is_file(), f"{name}: expected among {self.ids}"
        return path

    def replace_last_line(self, path, line):
        lines = path.read_text(encoding="utf-8").splitlines()
        path.write_text("\n".join([*lines[:-1], line]), encoding="utf-8")

    @property
    def ids(self):
        return sorted(path.name.removesuffix(".pafot.yaml") for path in self.path.rglob("*.pafot.yaml"))

    def with_own_ids(self, text):
        """With the digits that the saved scenarios have here, on this machine."""

        def own(found):
            slug = found[1].rpartition("saved-")[2]
            same = [each for each in self.ids if each.startswith(f"{slug}-")]
            return found[0].replace(found[0][-6:], same[0][-6:]) if same else found[0]

        return CORPUS_NAME.sub(own, text)

    def command(self, block):
        assert block.first.startswith("$ "), f"a console block that does not begin with a command: {block.first}"
        program, *arguments = shlex.split(self.with_own_ids(block.first.removeprefix("$ ")))
        if program == "python":
            done = self.pytester.run(sys.executable, *arguments)
            check_output(block.rest, done.stdout.str())
            return
        assert program == "pytest", block.first
        # unraisableexception collects all garbage at the end of each session, which is slow and shows nothing here.
        others = ("sugar", "randomly", "hypothesispytest", "rerunfailures", "unraisableexception")
        quiet = [part for name in others for part in ("-p", f"no:{name}")]
        run = self.pytester.runpytest_subprocess if "-n" in arguments else self.pytester.runpytest_inprocess
        check_output(block.rest, run(*quiet, *arguments).stdout.str())


@pytest.fixture
def folder(pytester, monkeypatch):
    for name in ("CI", "BUILD_NUMBER", "PYTEST_ADDOPTS", *(option.variable for option in OPTIONS)):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return Folder(pytester)


@pytest.mark.parametrize("story", list(stories()))
def test_samples_work_as_printed(story, folder):
    for block in blocks_of(story):
        if block.language in RUN:
            folder.show(block)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_block_says_its_language(document):
    assert {block.language for block in blocks_of(text_of(document))} <= RUN | NOT_RUN


@pytest.mark.parametrize("name", COMMANDS)
def test_the_readme_has_the_commands_that_install_and_run(name):
    block = f"<!-- {name} -->\n```sh\n{COMMANDS[name]}\n```"
    assert block in text_of(ROOT / "README.md")


def test_the_picture_shows_what_the_readme_runs():
    readme = text_of(ROOT / "README.md")
    (command, *_) = re.findall(r"^\$ (.*)$", readme, re.MULTILINE)
    picture = html.unescape(re.sub("<[^>]*>", "", text_of(ROOT / "docs" / "terminal.svg"))).replace("\xa0", " ")
    assert command in picture, "run: python docs/picture.py"
    assert set(re.findall(r"saved-[a-z0-9-]+", readme)) <= set(re.findall(r"saved-[a-z0-9-]+", picture))
    assert str(ROOT) not in picture


def generator():
    spec = importlib.util.spec_from_file_location("docs_generate", ROOT / "docs" / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_as_the_code_has_it():
    module = generator()
    text = text_of(module.REFERENCE)
    assert module.generated(text) == text, "run: python docs/generate.py"


def test_every_generated_section_is_in_the_reference():
    module = generator()
    present = [name for name, _ in GENERATED.findall(text_of(module.REFERENCE))]
    assert sorted(present) == sorted(module.sections())


def test_the_example_of_a_corpus_file_can_be_read_and_replayed():
    (example,) = (
        block for name, block in GENERATED.findall(text_of(ROOT / "docs/reference.md")) if name == "example-file"
    )
    content = example.removeprefix("```yaml\n").removesuffix("```\n")
    finding = parsed(Path("front-2-1f3a9c.pafot.yaml"), content.encode())
    assert from_dict(dict(finding.world)) == Highway()


def test_the_generator_runs_as_a_script():
    code = "import runpy; print(len(runpy.run_path('docs/generate.py')['sections']()))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def anchor(heading):
    """As code hosts make it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def anchors(document):
    return {anchor(heading) for heading in re.findall(r"^#+ (.*)$", FENCE.sub("", text_of(document)), re.MULTILINE)}


def links():
    for document in DOCUMENTS:
        for target in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", text_of(document))):
            if "://" not in target:
                yield pytest.param(document, target, id=f"{document.name}-{target}")


@pytest.mark.parametrize(("document", "target"), list(links()))
def test_every_link_inside_of_the_repository_leads_somewhere(document, target):
    name, _, section = target.partition("#")
    path = (document.parent / name).resolve() if name else document
    assert path.exists()
    assert not section or section in anchors(path)


def test_every_option_in_the_documents_exists():
    flags = {option.flag for option in OPTIONS}
    for document in DOCUMENTS:
        used = set(re.findall(r"--pafot-[a-z]+(?:-[a-z]+)*", text_of(document)))
        assert used <= flags, document.name


def workflows():
    for document in DOCUMENTS:
        for block in blocks_of(text_of(document)):
            if block.first.startswith("# .github/workflows/"):
                yield pytest.param(yaml.safe_load(block.rest), id=document.name)


@pytest.mark.parametrize("workflow", list(workflows()))
def test_a_job_that_searches_is_allowed_more_time_than_its_options_allow_the_searches(workflow):
    commands = {name: " ".join(step.get("run", "") for step in job["steps"]) for name, job in workflow["jobs"].items()}
    searching = {name: text for name, text in commands.items() if "--pafot-generations=0" not in text}
    assert searching
    for name, text in searching.items():
        (seconds,) = re.findall(r"--pafot-total-time=(\d+)", text)  # --pafot-max-time is for each of any number
        assert workflow["jobs"][name]["timeout-minutes"] * 60 >= int(seconds) + 15 * 60
