"""Corpus files that are garbled, deleted, read-only or taken cost at most their own item, and no finding is lost."""

import re

import pytest

from tests.plugin.conftest import CONFTEST

GARBLED = [
    (r"^pafot: 3", "pafot: 99"),
    (r"^scenario:", "colour: red\nscenario:"),
    (r"cell: [a-z-]+, speed", "cell: 9, speed"),
    (r"^pafot: 3", "pafot: [1"),
    (r"(?s).*", ""),
    (r"(?s)\Z", "#" * 300_000),
]


def test_each_garbled_file_or_invalid_name_fails_one_item_with_location(saved):
    text, first = saved.only_file.read_text(), saved.only_file
    for number, (pattern, replacement) in enumerate(GARBLED):
        garbled = re.sub(pattern, replacement, text, count=1, flags=re.MULTILINE)
        assert garbled != text
        first.with_name(f"garbled-{number}.pafot.yaml").write_text(garbled)
    first.unlink()
    for name in ("with space", "\xfcber", "a%b", "copy (1)", "[x]"):
        first.with_name(f"{name}.pafot.yaml").write_text(text)
    saved.write("def test_other():\n    pass\n", name="test_other")
    result = saved.run("--pafot-json=pafot.json", runs=0)
    result.assert_outcomes(failed=len(saved.files), passed=1, skipped=1)
    assert len(saved.files) == len(GARBLED) + 5
    assert all(
        each.status == "error" and f"{each.id}.pafot.yaml" in each.detail
        for each in saved.record.findings
    )


def test_garbled_file_does_not_stop_its_search(saved):
    saved.only_file.write_text("[")
    result = saved.run()
    assert result.parseoutcomes()["failed"] == 3
    assert len(saved.files) == 2


def test_unwritable_corpus_loses_no_finding(failing):
    (failing.path / "pafot_corpus").write_text("a file where the folder should be")
    result = failing.run()
    result.assert_outcomes(failed=2)
    assert "  pafot: 3" in result.outlines


RAISES = """
import os, tempfile, threading

class Planner:
    def __call__(self, observation):
        if observation.time < 1:
            return 0.0, 0.0
        file = tempfile.mkdtemp() + "/model.bin"
        raise RuntimeError(f"{self!r} of {threading.current_thread()!r}, pid {os.getpid()}: no {file} in {__file__}")

@pafot.search(SHORT, ads=Planner)  # stop_after=1
def test_fails(run): pass
"""


@pytest.mark.processes
def test_same_seed_gives_same_bytes_in_another_process(project):
    texts = []
    for folder, process in (("first", {"apart": True}), ("second", {"fresh": True})):
        project.write(RAISES, name=f"{folder}/test_it")
        place = project.path / folder
        project.run("--rootdir", place, place, **process).assert_outcomes(failed=2)
        (file,) = place.rglob("*.pafot.yaml")
        texts.append(file.read_bytes())
    assert texts[0] == texts[1]
    assert (
        b"Planner object at ADDRESS> of <_MainThread(MainThread, started N)>, pid N: no TMP/model.bin in"
        in texts[0]
    )


def test_half_written_leftovers_disappear_in_the_next_session(saved):
    leftover = saved.only_file.with_name(".pafot-1-0123456789abcdef.tmp")
    leftover.write_text("half a fi")
    saved.run(runs=0).assert_outcomes(failed=1, skipped=1)
    assert not leftover.exists()


def test_failure_saved_meanwhile_by_another_session_still_fails(saved):
    """The file covers it, but came too late for an item that would fail for it."""
    file, id_, elsewhere = saved.only_file, saved.only_id, saved.path / "late"
    file.rename(elsewhere)
    late = f"def pytest_collection_finish():\n    import os\n    os.rename({str(elsewhere)!r}, {str(file)!r})\n"
    saved.pytester.makeconftest(CONFTEST + late)
    result = saved.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines([f"* failed like {id_}"])
    saved.pytester.makeconftest(CONFTEST)
    saved.run().assert_outcomes(failed=1, passed=1)
