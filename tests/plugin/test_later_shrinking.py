"""``corpus shrink``: what it does later that time did not allow, what it leaves alone, and what it refuses."""

import os
import re
from argparse import Namespace
from dataclasses import replace

import pytest

from pytest_pafot.__main__ import main
from pytest_pafot.commands import corpus_command
from pytest_pafot.commands.corpus_command import session_of
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import CorpusWriteError, rewrite
from pytest_pafot.findings.shrink import sort_key
from pytest_pafot.findings.signature import PROCESS_CRASH
from pytest_pafot.support.errors import command
from tests.plugin.test_shrinking import COLLIDES

pytestmark = pytest.mark.usefixtures("shrinking")

links = pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")


@pytest.fixture
def unshrunk(project):
    """Return a project with a finding that was saved as it was found."""
    project.write(COLLIDES)
    project.run_once("--pafot-shrink-rollouts=0", generations=10, seed=2)
    return project


def shrink(project, *args, path=None):
    """Run the session of the command in this process."""
    given = [str(path or project.only_file), *args]
    return project.run(*session_of(Namespace(what="shrink", arguments=given))[3:], generations=None, seed=None)


def called(project, monkeypatch, *args):
    """Run the command, with its session in this process; return its exit code."""
    monkeypatch.chdir(project.path)

    def run(session, check):
        return Namespace(returncode=int(project.run(*session[3:], generations=None, seed=None).ret))

    monkeypatch.setattr(corpus_command.subprocess, "run", run)
    return main(["corpus", "shrink", *map(str, args)])


def test_file_has_what_the_search_would_have_written_with_more_time(unshrunk):
    before, name = load(unshrunk.only_file), unshrunk.files[0]
    result = shrink(unshrunk)
    assert result.ret == 0
    result.stdout.re_match_lines(
        [
            "collected .* / 1 selected",
            rf"{re.escape(name)}: shrunk from 2 NPCs, 4 instructions, 10 s to 1 NPC, 1 instruction, 5 s in \d+ runs",
        ]
    )
    now = load(unshrunk.only_file)
    unshrunk.forget()
    unshrunk.run_once(generations=10, seed=2)
    assert now == load(unshrunk.only_file)
    assert (now.original, now.id) == (before.scenario, before.id)
    assert now.shrunk.is_minimal
    assert now.expect.reference_drivers
    assert now.expect.avoided_by is not None


def test_file_is_left_to_the_last_byte_if_nothing_is_simpler(unshrunk):
    before, tries = {}, 0
    while unshrunk.contents != before:  # from a simpler scenario, other simpler ones can be reached
        before, tries = unshrunk.contents, tries + 1
        result = shrink(unshrunk)
    assert 2 <= tries <= 5
    assert result.ret == 0
    result.stdout.re_match_lines([rf"{re.escape(unshrunk.files[0])}: nothing simpler was found in \d+ runs"])


def test_limited_runs_go_on_from_what_is_there_and_are_added(unshrunk):
    found, sizes, runs = load(unshrunk.only_file).scenario, [], []
    for _ in range(2):
        result = shrink(unshrunk, "--pafot-shrink-rollouts=12")
        finding = load(unshrunk.only_file)
        sizes.append(sort_key(finding.scenario))
        runs.append(finding.shrunk.rollouts)
        assert finding.original == found
    assert sort_key(found) > sizes[0] > sizes[1]
    assert (runs[0], runs[1] > 12) == (12, True)
    result.stdout.fnmatch_lines(["*: shrunk * in 12 runs; it could be simpler, so the command may go on"])


def test_time_that_is_over_leaves_the_file_and_says_so(unshrunk):
    before = unshrunk.contents
    result = shrink(unshrunk, "--pafot-max-time=0")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["*: nothing simpler was found in 0 runs (out of time)"])
    assert unshrunk.contents == before


def test_accepted_file_is_shrunk_and_stays_accepted(unshrunk):
    file = unshrunk.only_file
    file.write_text(file.read_text().replace('# xfail: "reason"', 'xfail: "issue 12"'))
    result = shrink(unshrunk)
    assert result.ret == 0
    assert load(file).xfail == "issue 12"
    assert load(file).original is not None


def test_scenario_that_passes_now_is_not_shrunk(unshrunk):
    unshrunk.write(COLLIDES.replace("assert not run.collision", "pass"))
    before = unshrunk.contents
    result = shrink(unshrunk)
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        [f"{unshrunk.files[0]}: it does not fail as the file says: *; the file is left as it is"]
    )
    assert unshrunk.contents == before


def test_scenario_that_does_not_repeat_is_not_shrunk(unshrunk, monkeypatch):
    before = unshrunk.contents
    monkeypatch.setattr("pytest_pafot.campaign.bench.Bench.confirm", lambda *_: "another run")
    result = shrink(unshrunk)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*: it is flaky: another run; the file is left as it is"])
    assert unshrunk.contents == before


def test_file_that_cannot_be_written_stays_and_is_named(unshrunk, monkeypatch):
    before = unshrunk.contents

    def refuse(path, finding):
        raise CorpusWriteError(path, "Read-only file system", "mount it")

    monkeypatch.setattr("pytest_pafot.corpus.writer.rewrite", refuse)
    result = shrink(unshrunk)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*Read-only file system*"])
    assert unshrunk.contents == before


def test_searches_and_other_files_are_left_out(unshrunk):
    unshrunk.write(COLLIDES + "\ndef test_other():\n    assert False\n")
    result = shrink(unshrunk)
    result.assert_outcomes(passed=1, deselected=2)


@pytest.mark.parametrize("how", ["file", "id"])
def test_command_takes_a_file_or_an_id(unshrunk, monkeypatch, how):
    given = unshrunk.files[0] if how == "file" else unshrunk.only_id
    assert called(unshrunk, monkeypatch, given, "--") == 0
    assert load(unshrunk.only_file).shrunk.is_minimal


def told(capsys):
    """Return the only line that the command wrote to the standard error."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_file_that_does_not_exist_is_refused(unshrunk, monkeypatch, capsys):
    assert called(unshrunk, monkeypatch, "no-such-file.pafot.yaml") == 2
    assert told(capsys).startswith("corpus: no-such-file.pafot.yaml: expected the file of a saved scenario, or the id")


@links
@pytest.mark.parametrize("place", ["file", "folder"])
def test_link_is_refused(unshrunk, monkeypatch, capsys, place):
    link = unshrunk.path / ("link.pafot.yaml" if place == "file" else "link")
    link.symlink_to(unshrunk.only_file if place == "file" else unshrunk.only_file.parent)
    given = link.name if place == "file" else f"link/{unshrunk.only_file.name}"
    assert called(unshrunk, monkeypatch, given) == 2
    assert "received a link, which may lead to files of other people; give the file itself" in told(capsys)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"flaky": "another run"}, "a flaky one, whose scenario does not give the same run each time"),
        ({"failure": PROCESS_CRASH}, "one in which a process died"),
    ],
)
def test_finding_that_may_not_repeat_is_refused(unshrunk, monkeypatch, capsys, changes, why):
    finding = load(unshrunk.only_file)
    flaky, failure = changes.get("flaky"), changes.get("failure", finding.expect.failure)
    rewrite(unshrunk.only_file, replace(finding, flaky=flaky, expect=replace(finding.expect, failure=failure)))
    assert called(unshrunk, monkeypatch, unshrunk.files[0]) == 2
    line = told(capsys)
    assert f"expected a finding that can be shrunk, received {why}" in line
    assert line.endswith(f"`{command('pytest', unshrunk.files[0])}` replays it")


def test_unreadable_file_is_refused(unshrunk, monkeypatch, capsys):
    unshrunk.only_file.write_text("pafot: 99\n")
    assert called(unshrunk, monkeypatch, unshrunk.files[0]) == 2
    assert told(capsys).startswith(f"corpus: {unshrunk.files[0]}:1: pafot: expected")


@pytest.mark.parametrize("gone", ["test", "module"])
def test_file_whose_test_is_gone_is_refused(unshrunk, monkeypatch, capsys, gone):
    if gone == "test":
        unshrunk.write(COLLIDES.replace("test_collides", "test_others"))
    else:
        (unshrunk.path / "test_it.py").unlink()
    before = unshrunk.contents
    assert called(unshrunk, monkeypatch, unshrunk.files[0]) == 2
    told = capsys.readouterr()
    assert ("whose test is gone" in told.err) or ("test_it.py does not exist" in told.out + told.err)
    assert unshrunk.contents == before


def test_finding_that_was_not_shrunk_names_the_command(project):
    project.write("@pafot.search(SHORT)  # stop_after=1\ndef test_fails(run):\n    assert run.scenario.id == ''\n")
    result = project.run_once("--pafot-max-time=0", generations=10, seed=2)
    name = project.files[0]
    result.stdout.fnmatch_lines(
        [
            f"saved as   {name}",
            "note       not *: out of time",
            f"shrink it  python -m pytest_pafot corpus shrink {name}",
            "  note: --pafot-max-time ended before 1 new finding was shrunk: python -m pytest_pafot corpus shrink FILE "
            "goes on",
        ]
    )
    assert shrink(project).ret == 0
    assert load(project.only_file).original is not None


def test_commands_name_the_corpus_of_the_command_line(project):
    project.write("@pafot.search(SHORT)  # stop_after=1\ndef test_fails(run):\n    assert run.scenario.id == ''\n")
    result = project.run_once("--pafot-max-time=0", "--pafot-corpus=other", generations=10, seed=2)
    name = project.files[0]
    assert name.startswith("other/")
    result.stdout.fnmatch_lines(
        [
            f"  saved; run it with: pytest {name} --pafot-corpus=other",
            f"shrink it  python -m pytest_pafot corpus shrink {name} -- --pafot-corpus=other",
        ]
    )
    assert shrink(project, "--pafot-corpus=other").ret == 0
    assert load(project.only_file).original is not None


@pytest.mark.processes
def test_worker_shrinks_as_well(unshrunk):
    pytest.importorskip("xdist")
    result = shrink(unshrunk, "-n1")
    assert result.ret == 0
    result.stdout.fnmatch_lines([f"{unshrunk.files[0]}: shrunk from *"])
