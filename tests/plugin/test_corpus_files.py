"""Edge cases 7, 9, 10, 15 and 17: files that are garbled, orphaned, read-only or taken."""

import os
import re

import pytest

GARBLED = {
    "an unknown version": (r"^pafot: 2", "pafot: 99", "pafot"),
    "an unknown key": (r"^scenario:", "colour: red\nscenario:", "colour"),
    "a cell that is no ring neighbour": (
        r"- - \{cell: \d(.*\n)",
        r"- - {cell: 1\g<1>      - {cell: 5, speed: 1.0}\n",
        "cell",
    ),
    "a world that is not complete": (r", lanes: 4", "", "world"),
    "a world with an engine": (r"lanes: 4", "lanes: 4, engine: kernel", "world.engine"),
    "cell 0": (r"cell: \d, speed", "cell: 0, speed", "cell"),
    "cell 9": (r"cell: \d, speed", "cell: 9, speed", "cell"),
    "a speed that is no number": (r"speed: [\d.]+\}", "speed: .nan}", "speed"),
    "an empty chain": (r"  npcs:\n(    .*\n)+", "  npcs:\n    - []\n", "npcs"),
    "an alias": (r"^test: .*", "test: &a x\nworld2: *a", ""),
    "no YAML": (r"^pafot: 2", "pafot: [1", ""),
    "nothing": (r"(?s).*", "", ""),
    "too much": (r"(?s)\Z", "#" * 300_000, ""),
}


@pytest.mark.parametrize("fault", GARBLED)
def test_a_garbled_file_is_one_failing_item_with_its_place(failing, fault):
    failing.run()
    pattern, replacement, field = GARBLED[fault]
    text = failing.only_file.read_text()
    garbled = re.sub(pattern, replacement, text, count=1, flags=re.MULTILINE)
    assert garbled != text
    failing.only_file.write_text(garbled)
    failing.write("def test_other():\n    pass\n", name="test_other")
    result = failing.run(generations=0)
    result.assert_outcomes(failed=1, passed=1, skipped=1)
    result.stdout.fnmatch_lines([f"*{failing.only_file.name}*{field}*expected *, received *"])


@pytest.mark.parametrize("name", ["with space", "\xfcber", "a%b", "copy (1)", "[x]"])
def test_a_file_whose_name_is_no_id_is_one_failing_item(failing, name):
    failing.run()
    failing.only_file.rename(failing.only_file.with_name(f"{name}.pafot.yaml"))
    result = failing.run(generations=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["*: expected a name of letters, digits*; rename the file"])


def test_crlf_line_ends_are_accepted(failing):
    failing.run()
    failing.only_file.write_bytes(failing.only_file.read_bytes().replace(b"\n", b"\r\n"))
    result = failing.run(generations=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["replay: still failing"])


def test_a_garbled_file_does_not_stop_the_search_of_its_item(failing):
    failing.run()
    failing.only_file.write_text("[")
    result = failing.run()
    assert result.parseoutcomes()["failed"] == 3
    assert len(failing.files) == 2


def test_a_deleted_file_is_found_again_under_its_name(failing):
    failing.run()
    first = failing.contents
    failing.only_file.unlink()
    failing.run().assert_outcomes(failed=2)
    assert failing.contents == first


def test_a_renamed_test_leaves_an_orphan_that_is_reported_and_kept(failing):
    failing.run()
    failing.write("@pafot.search(SHORT)\ndef test_renamed(run):\n    pass\n")
    result = failing.run()
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(
        ["orphaned: 1 saved scenario of no test in pafot_corpus/test_it/test_fails", "*--pafot-prune"]
    )
    assert failing.files


def test_a_renamed_module_leaves_an_orphan(failing):
    failing.run()
    failing.write("def test_other():\n    pass\n", name="test_other")
    (failing.path / "test_it.py").unlink()
    failing.run().stdout.fnmatch_lines(["orphaned: 1 saved scenario of no test in pafot_corpus/test_it/test_fails"])


METHOD = """
class TestClass:
    @pafot.search(SHORT, stop_after=1)
    def test_fails(self, run):
        assert not run
"""


def test_a_renamed_class_and_a_renamed_method_leave_orphans(project):
    source = METHOD
    project.write(source)
    project.run()
    project.write(source.replace("TestClass", "TestOther").replace("assert not run", "pass"))
    assert "orphaned: 1" in project.run().stdout.str()
    project.write(source.replace("test_fails", "test_renamed").replace("assert not run", "pass"))
    assert "orphaned: 1" in project.run().stdout.str()


def test_a_removed_parameter_leaves_an_orphan(project):
    source = """
@pytest.mark.parametrize("limit", [1, 2])
@pafot.search(SHORT, stop_after=1)
def test_it(run, limit):
    assert not limit
"""
    project.write(source)
    project.run()
    project.write(source.replace("[1, 2]", "[2]"))
    project.run(generations=0).stdout.fnmatch_lines(
        ["orphaned: 1 saved scenario of no test in pafot_corpus/test_it/test_it@1"]
    )


@pytest.mark.parametrize("place", ["pafot_corpus/test_it", "pafot_corpus", "."])
def test_a_file_that_lies_too_high_is_told_with_the_folder_where_it_should_be(failing, place):
    failing.run()
    home, id_ = failing.only_file.parent, failing.only_id
    failing.only_file.rename(failing.path / place / failing.only_file.name)
    result = failing.run(generations=0)
    result.assert_outcomes(skipped=1)
    assert told(result) == [
        f"{failing.files[0]}, which lies in no folder of a test; move it to pafot_corpus/test_it/test_fails"
    ]
    failing.only_file.rename(home / failing.only_file.name)
    again = failing.run(generations=0)
    again.assert_outcomes(failed=1, skipped=1)
    assert (failing.only_id, told(again)) == (id_, [])


def told(result):
    return [line.removeprefix("not run: ") for line in result.stdout.lines if line.startswith("not run: ")]


def test_a_file_in_a_folder_above_its_test_is_told_and_one_elsewhere_is_not_looked_for(failing):
    failing.run()
    for folder in ("safety/near", "notes"):
        (failing.path / folder).mkdir(parents=True)
    (failing.path / "test_it.py").rename(failing.path / "safety" / "near" / "test_it.py")
    content = failing.only_file.read_text().replace("test: test_it", "test: safety/near/test_it")
    failing.only_file.unlink()
    for folder in ("safety", "notes"):
        (failing.path / folder / "a.pafot.yaml").write_text(content)
    place = "safety/near/pafot_corpus/test_it/test_fails"
    expected = [f"safety/a.pafot.yaml, which lies in no folder of a test; move it to {place}"]
    assert told(failing.run(generations=0)) == expected
    assert told(failing.run("--pafot-corpus", failing.path / "all", generations=0)) == [
        expected[0].replace(place, "all/safety/near/test_it/test_fails")
    ]


@pytest.mark.parametrize(
    ("line", "place"),
    [("test: test_old.py::test_it", "the folder of test_old.py::test_it"), ("", "the folder of its test")],
)
def test_a_file_that_lies_too_high_and_names_no_collected_test_is_told(failing, line, place):
    (failing.path / "a.pafot.yaml").write_text(line)
    assert told(failing.run(generations=0)) == [f"a.pafot.yaml, which lies in no folder of a test; move it to {place}"]


def test_without_a_search_nobody_looks_for_files_that_lie_too_high(project):
    project.write("def test_ordinary():\n    pass\n")
    (project.path / "a.pafot.yaml").write_text("test: test_it.py::test_ordinary")
    assert "pafot.yaml" not in project.run(generations=None).stdout.str()


@pytest.mark.parametrize(
    "selection",
    [
        ["-k", "other"],
        ["test_it.py::test_other"],
        ["test_it.py::TestOther"],
        ["test_it.py::TestOther::test_method"],
        ["-m", "not pafot"],
        ["test_other.py"],
        ["--deselect", "test_it.py::test_fails"],
    ],
    ids=" ".join,
)
def test_a_selection_makes_no_orphans(project, selection):
    project.write(
        """
@pafot.search(SHORT, stop_after=1)
def test_fails(run):
    assert not run

def test_other():
    pass

class TestClass:
    @pafot.search(SHORT, stop_after=1)
    def test_fails(self, run):
        assert not run

class TestOther:
    def test_method(self):
        pass
"""
    )
    project.write("def test_other():\n    pass\n", name="test_other")
    project.run()
    assert len(project.files) == 2
    assert "orphaned:" not in project.run(*selection, generations=0).stdout.str()


def test_a_skipped_test_is_no_orphan(failing):
    failing.run()
    source = (failing.path / "test_it.py").read_text()
    (failing.path / "test_it.py").write_text(source.replace("def test_fails", "@pytest.mark.skip\ndef test_fails"))
    assert "orphaned:" not in failing.run(generations=0).stdout.str()
    (failing.path / "test_it.py").write_text(f"import pytest\npytest.skip('all', allow_module_level=True)\n{source}")
    assert "orphaned:" not in failing.run(generations=0).stdout.str()


def test_a_module_that_cannot_be_imported_makes_no_orphans(failing):
    failing.run()
    failing.write("import nothing_of_this_name\n")
    assert "orphaned:" not in failing.run("--pafot-prune").stdout.str()
    assert failing.files


def test_prune_removes_orphans_and_nothing_else(project):
    source = "@pafot.search(SHORT, stop_after=1)\ndef test_a(run):\n    assert not run\n"
    project.write(source + source.replace("test_a", "test_b"))
    project.run()
    project.write(source)
    result = project.run("--pafot-prune", generations=0)
    result.stdout.fnmatch_lines(["removed: 1 saved scenario of no test in pafot_corpus/test_it/test_b"])
    assert [name.split("/")[2] for name in project.files] == ["test_a"]


def test_prune_spares_what_lies_below_a_file_that_lies_too_high(project):
    one = "@pafot.search(SHORT, stop_after=1)\ndef test_fails(run):\n    assert not run\n"
    project.write(one, name="test_top")
    project.write(one, name="tests/test_low")
    corpus = project.path / "all"
    project.run("--pafot-corpus", corpus)
    files = project.files
    assert {name.split("/")[1] for name in files} == {"test_top", "tests"}
    (corpus / "tests" / "test_low" / "a.pafot.yaml").write_text("test: tests/test_low.py::test_fails")
    result = project.run("--pafot-corpus", corpus, "--pafot-prune", generations=0)
    assert set(files) < set(project.files)
    assert told(result) == [
        "all/tests/test_low/a.pafot.yaml, which lies in no folder of a test; move it to all/tests/test_low/test_fails"
    ]


@pytest.mark.skipif(os.name == "nt", reason="folders have no write permission on Windows")
@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_checkout_loses_no_find(failing):
    failing.path.chmod(0o555)
    try:
        result = failing.run("-p", "no:cacheprovider")
    finally:
        failing.path.chmod(0o755)
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["not saved  *", "the file would be:", "  pafot: 2*"])


def test_a_corpus_that_cannot_be_written_loses_no_find(failing):
    (failing.path / "pafot_corpus").write_text("a file where the folder should be")
    result = failing.run()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["  not saved: *expected to write a finding*", "the file would be:", "  pafot: 2*"])


RAISES = """
import os, tempfile, threading

class Planner:
    def __call__(self, observation):
        if observation.time < 1:
            return 0.0, 0.0
        file = tempfile.mkdtemp() + "/model.bin"
        raise RuntimeError(f"{self!r} of {threading.current_thread()!r}, pid {os.getpid()}: no {file} in {__file__}")

@pafot.search(SHORT, ads=Planner, stop_after=1)
def test_fails(run):
    pass
"""


def test_the_same_seed_gives_the_same_bytes_in_another_process_and_folder(project):
    texts = []
    for folder in ("first", "second"):
        project.write(RAISES, name=f"{folder}/test_it")
        place = project.path / folder
        project.run("--rootdir", place, place, subprocess=True).assert_outcomes(failed=2)
        (file,) = place.rglob("*.pafot.yaml")
        texts.append(file.read_bytes())
    assert texts[0] == texts[1]
    assert b"Planner object at ADDRESS> of <_MainThread(MainThread, started N)>, pid N: no TMP/model.bin in" in texts[0]


def test_what_a_killed_process_left_half_written_goes_with_the_next_session(failing):
    failing.run()
    leftover = failing.only_file.with_name(".pafot-1-0123456789abcdef.tmp")
    leftover.write_text("half a fi")
    failing.run(generations=0).assert_outcomes(failed=1, skipped=1)
    assert not leftover.exists()


def test_a_name_that_another_finding_has_taken_is_not_overwritten(failing):
    failing.run()
    text = failing.only_file.read_text().replace("AssertionError", "ValueError")
    failing.only_file.write_text(text)
    (failing.path / "test_it.py").write_text(
        (failing.path / "test_it.py")
        .read_text()
        .replace("assert run.duration < 1", "assert run.duration < 1 or run.scenario.seed")
    )
    failing.run()
    assert text in failing.contents.values()


def test_what_a_died_process_ran_is_reported_and_saved_in_the_next_session(project):
    project.write(
        """
import os

SESSION = os.getpid()

@pafot.search(SHORT)
def test_dies(run):
    if os.environ.get("DIE") or (os.getpid() != SESSION and not os.environ.get("MENDED")):
        os._exit(9)
"""
    )
    project.pytester._monkeypatch.setenv("DIE", "1")
    assert project.run(subprocess=True).ret == 9
    assert project.files == []
    project.pytester._monkeypatch.delenv("DIE")
    result = project.run()
    result.assert_outcomes(failed=2)
    assert project.only_id.startswith("crash-")
    result.stdout.fnmatch_lines(["*died while it ran this scenario*"])
    # Reported once: from now on the file speaks for itself.
    project.pytester._monkeypatch.setenv("MENDED", "1")
    result = project.run()
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["*1 fixed"])


PASSES = """
@pafot.search(SHORT)
def test_lives(run):
    pass
"""


def test_what_a_died_process_ran_is_reported_even_when_only_replays_run(project):
    project.write(PASSES)
    project.leave_crash("test_it.py::test_lives")
    project.run(generations=0).assert_outcomes(failed=2)
    project.mend()
    project.run(generations=0).assert_outcomes(passed=1, skipped=1)


def test_a_crash_that_is_an_ordinary_failure_now_says_so(failing):
    failing.leave_crash("test_it.py::test_fails")
    failing.run(generations=0)
    failing.mend()
    result = failing.run(generations=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["*the process died in the file, collision at * now"])


def test_a_search_in_which_a_process_died_runs_nothing_in_the_session_and_covers_further_deaths(project):
    project.write(PASSES)
    project.leave_crash("test_it.py::test_lives")
    project.run().assert_outcomes(failed=2)
    project.leave_behind(f"test_it.py::test_lives[saved-{project.only_id}]")
    result = project.run("test_it.py::test_lives[search]")
    result.assert_outcomes(failed=1)  # an ADS that ends all other processes: there is no valid run
    result.stdout.fnmatch_lines([f"*known: 4 runs covered by saved-{project.only_id}*", "*note: ran as with *"])


def test_a_killed_session_leaves_no_false_crash_of_a_replay(failing):
    failing.run()
    failing.leave_behind(f"test_it.py::test_fails[saved-{failing.only_id}]")
    for _ in range(2):
        result = failing.run(generations=0)
        result.assert_outcomes(failed=1, skipped=1)
        result.stdout.fnmatch_lines(["replay: still failing"])


def test_what_a_died_process_ran_is_told_even_when_its_test_does_not_run(project):
    project.write(PASSES)
    project.leave_behind("test_old.py::test_dies")
    result = project.run()
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["  problem: a process (pid *) died while test_old.py::test_dies ran*"])


def test_a_file_that_is_copied_to_another_parametrisation_keeps_its_id(project):
    project.write(
        """
@pytest.mark.parametrize("limit", [1, 2])
@pafot.search(SHORT, stop_after=1)
def test_short(run, limit):
    assert run.duration < limit
"""
    )
    project.run("-k", "1-")
    id_ = project.only_id
    other = project.only_file.parent.with_name("test_short@2")
    other.mkdir()
    (other / project.only_file.name).write_text(project.only_file.read_text())
    result = project.run("-v", generations=0)
    result.assert_outcomes(failed=2, skipped=2)
    for limit in (1, 2):
        result.stdout.fnmatch_lines([f"test_it.py::test_short[[]{limit}-saved-{id_}[]] FAILED*"])
