"""The option ``--pafot-report``."""

import html
import json
import re
from types import SimpleNamespace

import pytest

from pytest_pafot.attribution.sentences import AT_FAULT
from pytest_pafot.attribution.takeovers import sentence
from pytest_pafot.corpus.reader import load
from pytest_pafot.report.terminal import shrunk_lines
from tests.plugin.test_session_records import IS_CUT

DATA = re.compile(r'<script type="application/json" id="data">(.*?)</script>', re.DOTALL)


def read_page(path):
    """Return the text of a page, its findings and its searches: what is drawn of each, and what stands there."""
    text = path.read_text(encoding="utf-8").replace("<wbr>", "").replace("\u00a0", " ")
    drawn = json.loads(DATA.search(text)[1])
    articles = re.findall(r'<article id="finding-.*?</article>', text, re.DOTALL)
    findings = []
    for data, article in zip(drawn, articles, strict=True):
        tags = re.findall(r"<li>(.*?)</li>", article.partition("<footer>")[2])
        command = re.search(r'<span class="label">Command</span><code>(.*?)</code>', article)
        findings.append(
            SimpleNamespace(
                data=data,
                id=html.unescape(re.search(r'<p class="id">.*?<span>(.*?)</span></p>', article)[1]),
                label=html.unescape(tags[0]),
                tags=tags,
                runs=next(int(tag.split()[0]) for tag in tags if re.match(r"\d+ runs?\b", tag)),
                file=html.unescape(re.search(r'class="bar"><h4>(.*?)</h4>', article)[1]),
                command=command and html.unescape(command[1]),
            )
        )
    parts = re.findall(r'<article class="searches".*?</article>', text, re.DOTALL)
    searches = [" ".join(html.unescape(re.sub("<[^>]*>", " ", part)).split()) for part in parts]
    return text, findings, searches


@pytest.fixture
def page(project):
    return project.path / "report.html"


def test_the_page_has_the_find_and_its_search(failing, page):
    result = failing.run_once("--pafot-report=report.html")
    result.assert_outcomes(failed=2)
    text, (finding,), (search,) = read_page(page)
    assert (finding.id, finding.label) == (failing.only_id, "new")
    assert finding.command == f"pytest 'test_it.py::test_fails[saved-{failing.only_id}]'"
    assert finding.file == failing.files[0]
    assert finding.data["times"][0] == 0
    assert search.startswith("test_it.py::test_fails[search] runs 1 failed 1 ")
    assert search.endswith(" ended enough findings")
    assert html.escape(failing.only_file.read_text()) in text
    assert ERROR not in text
    result.stdout.fnmatch_lines(["report: report.html *"])


def test_page_counts_runs_of_new_and_known_findings(project, page):
    project.write("@pafot.search(SHORT)\ndef test_fails(run):\n    assert run.duration < 1\n")
    for label in ("new", "still failing"):
        project.run("--pafot-report=report.html", "--pafot-shrink-runs=0", runs=8)
        _, findings, (search,) = read_page(page)
        assert {finding.label for finding in findings} == {label}
        runs = int(re.search(r"failed (\d+)", search)[1])
        assert sum(finding.runs for finding in findings) == runs > 2


def test_accepted_failure_is_shown_with_its_reason(saved, page):
    saved.accept()
    saved.run("--pafot-report=report.html", runs=0).assert_outcomes(xfailed=1, skipped=1)
    (finding,) = read_page(page)[1]
    assert finding.label == "accepted: planner issue 12, until 9999-12-31"


def test_unsaved_finding_shows_the_command_of_its_search(failing, page):
    result = failing.run("--pafot-report=report.html", "--pafot-save=none")
    result.assert_outcomes(failed=2)
    assert failing.files == []
    _, (finding,), _ = read_page(page)
    assert finding.file == f"{finding.id}.pafot.yaml"
    again = "pytest 'test_it.py::test_fails[search]' --pafot-runs=4 --pafot-seed=1"
    assert finding.command == again


def test_unobserved_crash_is_listed_without_a_picture(project, page):
    project.write("@pafot.search(SHORT)\ndef test_a(run):\n    pass\n")
    project.leave_crash("test_it.py::test_a")
    project.run("--pafot-report=report.html", runs=0)
    _, (finding,), _ = read_page(page)
    assert finding.id.startswith("crash-")
    assert finding.data["times"] == []


def test_an_interrupted_session_writes_what_it_has(project, page):
    project.write(IS_CUT)
    result = project.run("--pafot-report=report.html", no_reraise_ctrlc=True)
    assert result.ret == pytest.ExitCode.INTERRUPTED
    text, findings, (search,) = read_page(page)
    ids = {name.split("/")[-1][:-11] for name in project.files}
    assert {finding.id for finding in findings} == ids
    assert "runs 2 failed 2 " in search
    assert search.endswith("ended interrupted")
    assert '<p class="warning">' in text


NOT_KEPT = [
    ("ads=lambda: lambda seen: None", "pass"), ("", "assert run.collided"),
    ("fitness=lambda trace: 'x'", "pass"), ("", "pafot.reject()"),
]  # fmt: skip
"""Searches with an ADS that fails at once, a misspelt property, a fitness that is no number, and no tested run."""
ERROR = '<article class="error"'


def test_page_shows_errors_first(project, page):
    tests = ["@pafot.search(SHORT)\ndef test_passes(run):\n    pass\n"]
    for number, (arguments, body) in enumerate(NOT_KEPT):
        tests.append(
            f"@pafot.search(SHORT, {arguments})\ndef test_drive_{number}(run):\n    {body}\n"
        )
    lost = "@pytest.fixture\ndef lost():\n    raise OSError('no map')\n"
    tests.append(
        f"{lost}\n@pafot.search(SHORT)\ndef test_drive_{len(NOT_KEPT)}(run, lost):\n    pass\n"
    )
    project.write("\n".join(tests))
    result = project.run("--pafot-report=report.html")
    result.assert_outcomes(passed=1, failed=len(NOT_KEPT), errors=1)
    errors, main, _ = page.read_text(encoding="utf-8").partition(ERROR)[2].partition("<main")
    assert main
    assert "test_passes" not in errors
    for number, error in enumerate(errors.split(ERROR)):
        assert f"test_it.py::test_drive_{number}[search]" in error
    assert f"({len(NOT_KEPT) + 1} errors, 0 findings)" in result.stdout.str()


ENDS = [
    ("pass", "--pafot-max-time=60"),  # the only one that is complete and has no failures
    ("pass", "--pafot-max-time=0"),
    ("raise KeyboardInterrupt", "-q"),
    ("pytest.exit('enough', returncode=3)", "-q"),
    ("assert run.duration < 1", "test_it.py::test_drive[search]"),  # failures that are known, and not replayed
]  # fmt: skip


def test_only_a_page_of_a_complete_search_without_failures_claims_success(project, page):
    said = []
    for body, option in ENDS:
        project.write(f"@pafot.search(SHORT)\ndef test_drive(run):\n    {body}\n")
        if "assert" in body:
            project.run("--pafot-shrink-runs=0")
        project.run("--pafot-report=report.html", option, no_reraise_ctrlc=True)
        said.append(re.search(r'<p class="empty">(.*?)</p>', page.read_text("utf-8"))[1])
    assert said[0] not in said[1:]


def test_session_without_search_or_replay_writes_no_page(project, page):
    project.write("def test_b():\n    pass\n")
    result = project.run("--pafot-report=report.html")
    assert not page.exists()
    result.stdout.fnmatch_lines(["*problem: --pafot-report=report.html: *"])


def test_page_shows_shrinking_and_the_careful_driver_after_replay(project, page, shrinking):
    project.write(
        "@pafot.search(SHORT, blame='ego')  # stop_after=1\ndef test_a(run):\n    assert not run.collision\n"
    )
    project.run("--pafot-report=report.html", runs=24, seed=4)
    (finding, *_) = [each for each in read_page(page)[1] if each.data["event"]["side"] == "front"]
    saved = load(project.path / finding.file)
    # a sentence of the page begins with a capital letter
    told = [each[1:] for each in shrunk_lines(saved)]
    text = read_page(page)[0]
    assert all(html.escape(each) in text for each in [*told, sentence(saved.expect.takeover)])
    ego, ghost = finding.data["vehicles"][0], finding.data["ghost"]
    first = ghost["first"]
    begin = finding.data["event"]["time"] - saved.expect.takeover
    assert finding.data["times"][first - 1] < begin <= finding.data["times"][first] + 0.04
    assert len(ghost["along"]) == len(ego["along"]) - first
    assert ghost["along"][0] == pytest.approx(ego["along"][first], abs=0.5)
    assert ghost["along"][-1] < ego["along"][-1] - 1.0, "it brakes"
    assert finding.data["headline"].endswith(f"; {AT_FAULT[saved.expect.responsibility]}")
    assert len(finding.data["vehicles"]) == 2
    project.run("--pafot-report=report.html", runs=0)
    (again,) = [each for each in read_page(page)[1] if each.id == finding.id]
    assert all(html.escape(each) in read_page(page)[0] for each in told)
    for same in ("vehicles", "times", "ghost", "event", "headline"):
        assert again.data[same] == finding.data[same]
