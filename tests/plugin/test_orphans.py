"""Saved scenarios that no test runs are reported, and stay."""

import pytest


def test_misplaced_files_are_reported_with_their_test(saved):
    home = saved.only_file
    text, places = home.read_text(), ["pafot_corpus/test_it", "pafot_corpus", "."]
    home.unlink()
    for number, place in enumerate(places):
        (saved.path / place / f"a-{number}.pafot.yaml").write_text(text)
    result = saved.run(generations=0)
    result.assert_outcomes(skipped=1)
    assert sorted(told(result)) == [
        f"{name}: it is in no test's folder; move it to the folder of test_it.py::test_fails, or delete it"
        for name in saved.files
    ]
    saved.forget()
    home.write_text(text)
    again = saved.run(generations=0)
    again.assert_outcomes(failed=1, skipped=1)
    assert told(again) == []


def told(result):
    return [line.removeprefix("not run: ") for line in result.stdout.lines if line.startswith("not run: ")]


def test_misplaced_file_is_found_above_its_test_and_where_pytest_collects(saved):
    for folder in ("safety/near", "notes", "all"):
        (saved.path / folder).mkdir(parents=True)
    (saved.path / "test_it.py").rename(saved.path / "safety" / "near" / "test_it.py")
    content = saved.only_file.read_text().replace("test: test_it", "test: safety/near/test_it")
    saved.only_file.unlink()
    for folder in ("safety", "notes"):
        (saved.path / folder / "a.pafot.yaml").write_text(content)
    place = "the folder of safety/near/test_it.py::test_fails"
    above = f"safety/a.pafot.yaml: it is in no test's folder; move it to {place}, or delete it"
    for args, home in ([], "safety/near/pafot_corpus"), (["--pafot-corpus", saved.path / "all"], "all/safety/near"):
        expected = f"notes/a.pafot.yaml: it is in no corpus; move it to {home}/test_it/test_fails, or delete it"
        assert told(saved.run(*args, generations=0)) == [expected, above]
    assert told(saved.run("safety", generations=0)) == [above]


def test_misplaced_files_without_collected_test_are_reported(failing):
    (failing.path / "a.pafot.yaml").write_text("test: test_old.py::test_it")
    (failing.path / "b.pafot.yaml").write_text("")
    assert told(failing.run(generations=0)) == [
        "a.pafot.yaml: it is in no test's folder; move it to the folder of test_old.py::test_it, or delete it",
        "b.pafot.yaml: it is in no test's folder; move it to the folder of its test, or delete it",
    ]


def test_corpus_with_another_name_and_no_test_says_what_to_name(saved):
    (saved.path / "elsewhere").mkdir()
    (saved.path / "pafot_corpus").rename(saved.path / "elsewhere" / "corpus")
    result = saved.run("elsewhere", generations=0)
    assert (result.ret, told(result)) == (
        pytest.ExitCode.NO_TESTS_COLLECTED,
        [
            "elsewhere/corpus/test_it/test_fails: no test that replays it was collected; name its test file, and "
            "--pafot-corpus= if it is not next to it"
        ],
    )
    assert told(saved.run("elsewhere", "--ignore-glob=*.pafot.yaml", generations=0)) == []
    saved.run("test_it.py", "--pafot-corpus=elsewhere/corpus", generations=0).assert_outcomes(failed=1, skipped=1)


def test_misplaced_files_are_ignored_without_a_search(project):
    project.write("def test_ordinary():\n    pass\n")
    (project.path / "a.pafot.yaml").write_text("test: test_it.py::test_ordinary")
    assert "pafot.yaml" not in project.run(generations=None).stdout.str()


def test_a_skipped_test_is_no_orphan(saved):
    source = (saved.path / "test_it.py").read_text()
    (saved.path / "test_it.py").write_text(source.replace("def test_fails", "@pytest.mark.skip\ndef test_fails"))
    assert "orphaned:" not in saved.run(generations=0).stdout.str()
    (saved.path / "test_it.py").write_text(f"import pytest\npytest.skip('all', allow_module_level=True)\n{source}")
    assert "orphaned:" not in saved.run(generations=0).stdout.str()


def test_a_misplaced_file_above_a_test_is_named_alone(project):
    one = "@pafot.search(SHORT)  # stop_after=1\ndef test_fails(run):\n    assert not run\n"
    project.write(one, name="test_top")
    project.write(one, name="tests/test_low")
    corpus = project.path / "all"
    project.run("--pafot-corpus", corpus, "--pafot-shrink-rollouts=0")
    files = project.files
    assert {name.split("/")[1] for name in files} == {"test_top", "tests"}
    (corpus / "tests" / "test_low" / "a.pafot.yaml").write_text("test: tests/test_low.py::test_fails")
    result = project.run("--pafot-corpus", corpus, generations=0)
    assert told(result) == [
        "all/tests/test_low/a.pafot.yaml: it is in no test's folder; "
        "move it to the folder of tests/test_low.py::test_fails, or delete it"
    ]


def test_corpus_above_a_folder_given_to_pytest_is_looked_at_too(saved, monkeypatch):
    """A test that has moved into the folder has left its corpus behind; one that is still there is only left out."""
    monkeypatch.setenv("CI", "true")
    (saved.path / "tests").mkdir()
    (saved.path / "tests" / "test_other.py").write_text("def test_other():\n    pass\n")
    saved.run("tests", generations=0).assert_outcomes(passed=1)
    (saved.path / "test_it.py").rename(saved.path / "tests" / "test_it.py")
    result = saved.run("tests", generations=0)
    result.assert_outcomes(passed=1, skipped=1, errors=1)
    result.stdout.fnmatch_lines(
        ["*the test of 1 saved scenario is gone (CI is set; --pafot-allow-orphans lets it pass):*"]
    )
