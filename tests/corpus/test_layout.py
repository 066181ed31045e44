import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.corpus.layout import CORPUS, files_in, folder_of_test, safe_name

RESERVED = {"con", "prn", "aux", "nul"} | {f"{port}{n}" for port in ("com", "lpt") for n in range(10)}


def test_a_corpus_lies_beside_the_file_of_its_test():
    folder = folder_of_test(Path("tests/deep/test_safety.py"), "test_it[4-slow]", CORPUS, Path())
    assert folder == Path("tests/deep/pafot_corpus/test_safety/test_it@4-slow")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("test_it", "test_it"),
        ("test_it[4-slow]", "test_it@4-slow"),
        ("test_it[0.5-a=b]", "test_it@0.5-a=b"),
        ("TestBraking::test_it", "TestBraking.test_it~27a9cbc3d2"),
        ("test_it[True]", "test_it@True~5b9d3f3f9b"),
        ("test_it[a/b]", "test_it@a-b~"),
        ("test_it[a b]", "test_it@a-b~"),
        ("con", "_con~"),
        ("nul.txt", "_nul.txt~"),
        ("", "_~"),
        ("..", "_~"),
        (".hidden", "hidden~"),
        ("test_it@4", "test_it@4~"),
        ("test_it[]", "test_it~"),
        ("trailing.", "trailing~"),
    ],
)
def test_names_stay_readable(text, name):
    assert safe_name(text).split("~")[0] == name.split("~")[0]
    assert ("~" in safe_name(text)) == ("~" in name)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("test_a", "Test_a"),
        ("test_it[A]", "test_it[a]"),
        ("test_it[a/b]", "test_it[a-b]"),
        ("test_it[a]", "test_it@a"),
        ("test_it[a]", "test_it-a-"),
        ("test_it[é]", "test_it[e\u0301]"),
        ("test_it[x" + "1" * 300 + "a]", "test_it[x" + "1" * 300 + "b]"),
        ("A.test_b", "A::test_b"),
        ("test_it", "test_it "),
        ("con", "_con"),
    ],
)
def test_names_that_look_alike_stay_apart(one, other):
    assert safe_name(one).casefold() != safe_name(other).casefold()


texts = st.one_of(
    st.text(max_size=120),
    st.text("aAb@[]~.:/-_ \\", max_size=12),
    st.sampled_from(sorted(RESERVED)).map(str.upper),
    st.builds("{}[{}]".format, st.sampled_from(["test_a", "TEST_A", "con"]), st.text(max_size=40)),
)


@given(texts)
def test_every_name_is_valid_on_every_file_system(text):
    name = safe_name(text)
    assert 0 < len(name) <= 80
    assert name.isascii()
    assert name == unicodedata.normalize("NFD", name)
    assert not set(name) & set('<>:"/\\|?*[]\x7f ')
    assert name.isprintable()
    assert name[-1] not in ". "
    assert name[0] not in ".-~"
    assert name.split(".")[0].casefold() not in RESERVED


@given(texts, texts)
def test_distinct_tests_have_distinct_folders_even_where_case_is_ignored(one, other):
    same = safe_name(one).casefold() == safe_name(other).casefold()
    assert same == (one == other)


@given(texts)
def test_a_name_is_no_other_test_s_name(text):
    name = safe_name(text)
    assert name == text or safe_name(name) != name


def test_files_are_listed_by_name_and_nothing_else_is(tmp_path):
    for name in ("b-2.pafot.yaml", "a-1.pafot.yaml", ".pafot-x.tmp", "notes.txt", "c.yaml"):
        (tmp_path / name).write_text("")
    assert [path.name for path in files_in(tmp_path)] == ["a-1.pafot.yaml", "b-2.pafot.yaml"]


def test_a_folder_that_is_not_there_has_no_files(tmp_path):
    assert files_in(tmp_path / "none") == []


def test_a_file_in_place_of_the_folder_and_a_loop_of_links_have_no_files(tmp_path):
    (tmp_path / "corpus").write_text("")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert files_in(tmp_path / "corpus") == files_in(tmp_path / "loop") == []
