import os
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.corpus.layout import (
    CORPUS,
    TestFolders,
    corpus_root,
    files_below,
    files_in,
    folder_of_module,
    folder_of_test,
    folders_below,
    is_corpus,
    may_be_of,
    module_named,
    module_of_file,
    safe_name,
)
from tests.helpers.hostile import CHARACTERS
from tests.helpers.tables import table

RESERVED = {"con", "prn", "aux", "nul"} | {
    f"{port}{n}" for port in ("com", "lpt") for n in range(10)
}


def test_corpus_folder_lies_next_to_its_test_file():
    folder = folder_of_test(Path("tests/deep/test_safety.py"), "test_it[4-slow]", CORPUS, Path())
    assert folder == Path("tests/deep/pafot_corpus/test_safety/test_it@4-slow")


@table(("text", "name"), [
    ("test_it", "test_it"),
    ("test_it[4-slow]", "test_it@4-slow"),
    ("test_it[0.5-a=b]", "test_it@0.5-a=b"),
    ("TestBraking::test_it", "TestBraking.test_it~0131"),
    ("test_REQ_001", "test_REQ_001~43"),
    ("TEST_IT", "TEST_IT~06"),
    ("test_" + "a" * 32 + "B", "test_" + "a" * 32 + "B~z011"),
    ("CON", "_CON~"),
    ("test_it[True]", "test_it@True~61"),
    ("test_it[a/b]", "test_it@a-b~"),
    ("nul.txt", "_nul.txt~"),
    ("", "_~"),
    (".hidden", "hidden~"),
    ("test_it[]", "test_it~"),
])  # fmt: skip
def test_names_stay_readable(text, name):
    assert safe_name(text).startswith(name)
    assert len(safe_name(text)) == len(name) + (10 if name.endswith("~") else 0)


@table(("one", "other"), [
    ("test_a", "Test_a"),
    ("test_it[A]", "test_it[a]"),
    ("test_it[a/b]", "test_it[a-b]"),
    ("test_it[é]", "test_it[e\u0301]"),
    ("test_it[x" + "1" * 300 + "a]", "test_it[x" + "1" * 300 + "b]"),
    ("A.test_b", "A::test_b"),
    ("K", "\u212a"),
    ("A" * 40, "A" * 35 + "a" * 5),
    ("test_it", "test_it "),
    ("con", "_con"),
])  # fmt: skip
def test_names_that_look_alike_stay_apart(one, other):
    assert safe_name(one).casefold() != safe_name(other).casefold()


texts = st.one_of(
    st.text(CHARACTERS, max_size=120),
    st.text("aAb@[]~.:/-_ \\", max_size=12),
    st.sampled_from(sorted(RESERVED)).map(str.upper),
    st.builds(
        "{}[{}]".format,
        st.sampled_from(["test_a", "TEST_A", "con"]),
        st.text(CHARACTERS, max_size=40),
    ),
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
def test_distinct_tests_have_distinct_folders_ignoring_case(one, other):
    same = safe_name(one).casefold() == safe_name(other).casefold()
    assert same == (one == other)


@given(texts)
def test_a_name_is_no_other_test_s_name(text):
    name = safe_name(text)
    assert name == text or safe_name(name) != name


def test_only_saved_scenarios_are_listed_sorted_by_name(tmp_path):
    for name in ("b-2.pafot.yaml", "a-1.pafot.yaml", ".pafot-x.tmp", "notes.txt", "c.yaml"):
        (tmp_path / name).write_text("")
    assert [path.name for path in files_in(tmp_path)] == ["a-1.pafot.yaml", "b-2.pafot.yaml"]


def test_what_is_no_folder_contains_no_saved_files(tmp_path):
    (tmp_path / "corpus").write_text("")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert [files_in(tmp_path / name) for name in ("none", "corpus", "loop")] == [[], [], []]


def test_folders_are_listed_once_despite_links(tmp_path):
    place = tmp_path / "corpus" / "test_a" / "test_it"
    place.mkdir(parents=True)
    (place / "a-1.pafot.yaml").write_text("")
    for number in range(12):
        (place / f"up{number}").symlink_to(tmp_path / "corpus")
    (place / "none.pafot.yaml").symlink_to(place / "none.pafot.yaml")
    assert files_below(tmp_path) == [place / "a-1.pafot.yaml", place / "none.pafot.yaml"]
    assert folders_below(tmp_path) == [place]


ROOT = Path("/projects/project")


@pytest.mark.skipif(os.name == "nt", reason="absolute paths are written as on other systems")
@table(("corpus", "root"), [
    ("pafot_corpus", "/projects/project/tests/deep/pafot_corpus"),
    ("found/here", "/projects/project/tests/deep/found/here"),
    ("/all", "/all/tests/deep"),
])  # fmt: skip
def test_corpus_folder_maps_back_to_its_test_file(corpus, root):
    test_file = ROOT / "tests" / "deep" / "test_safety.py"
    assert corpus_root(test_file, corpus, ROOT) == Path(root)
    assert folder_of_module(test_file, corpus, ROOT) == Path(root) / "test_safety"
    file = folder_of_test(test_file, "test_it[4-slow]", corpus, ROOT) / "front-2-1f3a9c.pafot.yaml"
    assert module_of_file(file, corpus, ROOT) == test_file


@pytest.mark.skipif(os.name == "nt", reason="absolute paths are written as on other systems")
def test_file_outside_rootdir_uses_top_of_shared_corpus():
    assert corpus_root(Path("/elsewhere/test_safety.py"), "/all", ROOT) == Path("/all")


@pytest.mark.skipif(os.name == "nt", reason="absolute paths are written as on other systems")
@table(("file", "corpus"), [
    ("/projects/project/a.pafot.yaml", "pafot_corpus"),
    ("/a.pafot.yaml", "pafot_corpus"),
    ("/projects/project/other/test_safety/test_it/a.pafot.yaml", "pafot_corpus"),
    ("/other/test_safety/test_it/a.pafot.yaml", "/all"),
])  # fmt: skip
def test_file_outside_any_corpus_has_no_test_file(file, corpus):
    assert module_of_file(Path(file), corpus, ROOT) is None


@pytest.mark.skipif(os.name == "nt", reason="absolute paths are written as on other systems")
@table(("path", "corpus", "holds"), [
    ("/projects/tests/pafot_corpus", "pafot_corpus", True),
    ("/projects/tests/found/here", "found/here", True),
    ("/projects/tests/here", "found/here", False),
    ("/projects/all", "/projects/all", True),
    ("/elsewhere/projects/all", "/projects/all", False),
])  # fmt: skip
def test_folder_named_by_the_option_is_a_corpus(path, corpus, holds):
    assert is_corpus(Path(path), Path(corpus)) is holds


def test_folder_name_leads_to_its_test_file(tmp_path):
    (tmp_path / "Test_Safety.py").write_text("")
    assert module_named(tmp_path, safe_name("Test_Safety")) == tmp_path / "Test_Safety.py"
    assert module_named(tmp_path, "test_gone") == tmp_path / "test_gone.py"


IDENTIFIERS = st.from_regex(
    r"[^\W\d]\w{0,70}", fullmatch=True, alphabet=CHARACTERS
) | st.sampled_from(["con", "_", "test_\u00e9", "test_a"])


@given(
    test=st.lists(IDENTIFIERS, min_size=1, max_size=3).map("::".join),
    parameters=st.text(CHARACTERS, max_size=20),
)
def test_folder_of_a_test_matches_its_name(test, parameters):
    assert may_be_of(safe_name(test), test)
    assert may_be_of(safe_name(f"{test}[{parameters}]"), test)


@given(
    st.lists(st.tuples(IDENTIFIERS, st.none() | st.text(CHARACTERS, max_size=4)), max_size=9),
    IDENTIFIERS,
)
def test_folders_of_a_test_are_found_among_all(tmp_path_factory, others, test):
    module = tmp_path_factory.mktemp("module")
    for name, parameters in [*others, (test, None), (test, "1")]:
        (module / safe_name(name if parameters is None else f"{name}[{parameters}]")).mkdir(
            exist_ok=True
        )
    for name in (test, *(name for name, _ in others)):
        assert TestFolders(module).folders_of(name) == [
            each for each in sorted(module.iterdir()) if may_be_of(each.name, name)
        ]


def test_folder_of_longer_name_belongs_to_another_test():
    # whose ending is not in the folder's name
    assert may_be_of(safe_name("TestA::\u00aa[0]"), "TestA::\u00aa")
    for other in ("test_ab", "test_ab[1]", "test_ab[A]", "test_a_b[A]", "TestX::test_a"):
        assert not may_be_of(safe_name(other), "test_a")
        assert not may_be_of(safe_name(f"TestX::{other}"), "TestX::test_a")


def test_names_over_eighty_characters_end_with_a_digest():
    assert safe_name("a" * 80) == "a" * 80
    assert safe_name("a" * 81).startswith("a" * 68 + "~")
    assert len(safe_name("a" * 81)) == 79
    assert safe_name("a" * 81) != safe_name("a" * 82)
