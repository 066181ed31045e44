"""Strangers' texts have no effect wherever they are displayed, and can still be recognised."""

import contextlib
import io
import json
import re
from collections import Counter
from dataclasses import replace
from datetime import date
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_pafot.__main__ import main
from pytest_pafot.corpus.reader import Saved, load
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.plugin.collection import saved_part
from pytest_pafot.plugin.item import set_properties
from pytest_pafot.report import page, session_record, terminal
from pytest_pafot.report.session_record import to_text
from pytest_pafot.searches import saved_scenario
from pytest_pafot.searches.events import Ending, Progress, Search
from pytest_pafot.support.errors import CorpusError, FieldError
from pytest_pafot.support.text import (
    ascii_text,
    fitted_lines,
    markdown_table,
    quiet_json,
    visible,
    visible_lines,
    wrapped_to,
)
from tests.findings.builders import plain_finding, sighting
from tests.helpers.hostile import TEXTS, obeyed
from tests.helpers.tables import table
from tests.report.builders import session_of

WIDTHS = st.integers(20, 120)


@table(("text", "shown"), [
    ("a\n\x1b[2J\x9b\u202e\u2028\ud800\xa0", r"a\n\x1b[2J\x9b\u202e\u2028\ud800\xa0"),
    ("::error::a ::b test.py::c", r"\x3a:error::a \x3a:b test.py::c"),
    ("##[group]a##vso[x] ## # a", r"\x23#[group]a\x23#vso[x] ## # a"),
    ("na\u00efve \U0001f697 C:\\x", "na\u00efve \U0001f697 C:\\x"),
])  # fmt: skip
def test_active_characters_are_escaped_and_others_unchanged(text, shown):
    assert visible(text) == shown


@given(TEXTS, WIDTHS)
def test_visible_text_is_one_harmless_line(text, width):
    for shown in (
        visible(text),
        ascii_text(text),
        str(FieldError(text)),
        str(FieldError(field=text, received=text)),
    ):
        assert obeyed(shown) == []
        assert "\n" not in shown
        assert visible(shown) == shown
        assert obeyed("\n".join(wrapped_to(shown, width))) == []
    assert obeyed("\n".join(fitted_lines([text, f"E   {text}"], width))) == []
    assert visible_lines(text).count("\n") == text.count("\n")
    assert obeyed(visible_lines(text).replace("\t", " ")) == []
    assert obeyed(saved_part(text)) == []
    assert json.loads(quiet_json(json.dumps(text))) == text


@given(TEXTS, TEXTS, WIDTHS)
def test_no_line_of_the_terminal_is_obeyed(text, other, width):
    find = sighting(
        node_id=text, headline=other, path=text, detail=other, finding={"flaky": f"- {text}"}
    )
    search = Search(
        node_id=text, generations=1, kinds=Counter(failed=1, passed=2), seconds=1.0, finds=(find,), known={text: 1},
        algorithm=other, seed=1, base_seed=1, reason=Ending.MAX_TIME, warnings=(text,), notes=(other,),
        against=text, drawn=other,
    )  # fmt: skip
    replay = sighting(
        headline=text, node_id=f"{text} again", label="drifted", detail=other, against=text
    )
    session = session_of(
        searches=[search, Search(node_id=other, seed=1)], seen=[replay], unnamed=[text], left=[other],
        problems=[text], written=[visible(text)], warnings=[text], notes=[text],
    )  # fmt: skip
    progress = Progress(
        node_id=text,
        generation=1,
        generations=2,
        runs=1,
        budget=None,
        failing=0,
        finds=0,
        seconds=1,
    )
    lines = [*terminal.session_lines(session, width=width), terminal.found_line(find)]
    for is_whole in (False, True):
        unsaved = replace(find, path="")
        lines += terminal.block_lines(
            unsaved, text, place=other, text=text, width=width, is_whole=is_whole
        )
    assert obeyed("\n".join([*lines, terminal.progress_line(progress, width)])) == []
    assert all("\n" not in line and line.isascii() for line in lines)


@given(TEXTS, TEXTS)
def test_job_summary_and_tables_contain_no_foreign_markup(text, other):
    kept = {
        "test": f"- {text}",
        "flaky": f"- {text}",
        "xfail": f"- {other}",
        "xfail_until": date(2027, 1, 31),
    }
    found = sighting(
        "a", node_id=text, finding=kept, label="drifted", path=other, headline=other, detail=text
    )
    record = session_of(
        seen=[found],
        searches=[Search(node_id=text, against=text)],
        warnings=[text],
        problems=[text],
    )
    record.results[text], record.reasons[text] = "failed", other
    record.unread[f"{text} again"] = {"id": text, "file": text, "test": other, "replay": text}
    record.reasons[f"{text} again"] = text
    shown = session_record.markdown(record)
    assert obeyed(shown.replace("\u200b", "")) == []
    outside = re.sub(r"(`+).*?(?<!`)\1(?!`)", "", shown)
    assert not re.search(r"<(?!br>|/?span>)|(?<!\\)\||@(?!&#8203;)|\$(?!</span>)", outside)
    written = to_text(record, root="")
    assert json.loads(written)["findings"][0]["xfail"]["reason"] == kept["xfail"]
    assert obeyed(written) == []
    table = markdown_table([text], [[other]])
    assert obeyed(table) == []
    assert table.count("\n") == 2


@given(TEXTS)
def test_pages_and_junit_files_contain_no_foreign_markup(text):
    shown = page.text(text)
    assert obeyed(shown.replace("\t", " ")) == []
    assert not re.search("[<>\"']", shown)
    properties = []
    set_properties(properties, file=text, seed=1)
    element = ElementTree.Element("property", dict(properties))
    assert obeyed(ElementTree.tostring(element, "unicode")) == []


@settings(max_examples=6)  # each reads nineteen files
@given(TEXTS.filter(str.strip))
def test_corpus_command_output_contains_no_control_sequences(tmp_path_factory, text):
    folder = tmp_path_factory.mktemp("corpus")
    expect = replace(plain_finding().expect, assertion=text, failure=text)
    finding = plain_finding(
        test=text, flaky=text, xfail=text, xfail_until=date(2027, 1, 31), expect=expect
    )
    (folder / "a.pafot.yaml").write_text(text_of(finding), encoding="utf-8")
    shown = (
        repr(saved_scenario.load(folder / "a.pafot.yaml")),
        repr(Saved(path=folder / f"{text}.pafot.yaml")),
    )
    assert list(map(obeyed, shown)) == [[], []]
    broken = (
        json.dumps(text),
        f"{json.dumps(text)}: 1",
        text_of(finding) + f"{json.dumps(text)}: 1\n",
    )
    for number, content in enumerate(broken):
        path = folder / f"b{number}.pafot.yaml"
        path.write_text(content, encoding="utf-8")
        with pytest.raises(CorpusError) as raised:
            load(path)
        assert obeyed(str(raised.value)) == []
        assert "\n" not in str(raised.value)
    told = io.StringIO()
    with contextlib.redirect_stdout(told):
        main(["corpus", "list", str(folder)])
    assert obeyed(told.getvalue()) == []
