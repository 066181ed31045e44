import errno
import os
import re
import threading
from dataclasses import replace
from datetime import date

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import CorpusWriteError, free_path, rewrite, write
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from pytest_pafot.model.vehicle_type import VehicleType
from pytest_pafot.support.errors import CorpusError
from tests.findings.builders import plain_finding


@pytest.fixture
def path(tmp_path):
    return tmp_path / "pafot_corpus" / "test_safety" / "test_it" / "front-2-1f3a9c.pafot.yaml"


def other_scenario():
    return Scenario(npcs=[[PositionInstruction(6, 25.0)]])


def test_new_file_comes_with_folders_and_who_comes_second_changes_nothing(path):
    assert write(path, plain_finding())
    assert not write(path, plain_finding(scenario=other_scenario()))
    assert load(path) == plain_finding()
    assert list(path.parent.iterdir()) == [path]


def test_vehicles_are_one_readable_line_and_read_back(path):
    bus = VehicleType(name="bus", length=12.0, width=2.5, acceleration=1.2)
    scenario = Scenario(
        npcs=[[PositionInstruction(cell, 25.0)] for cell in (1, 2, 3)],
        vehicles=("car", bus, "truck"),
    )
    write(path, plain_finding(scenario=scenario))
    line = "  vehicles: {NPC 1: {name: bus, length: 12.0, width: 2.5, acceleration: 1.2}, NPC 2: truck}"
    assert line in path.read_text().splitlines()
    assert load(path).scenario == scenario


def test_file_is_never_visible_half_written(path):
    write(path, plain_finding())
    finding = plain_finding(test="t" * 5000)
    stop = threading.Event()
    seen = set()

    def reader():
        while not stop.is_set():
            seen.add(len(load(path).test))

    thread = threading.Thread(target=reader)
    thread.start()
    for turn in range(24):
        rewrite(path, finding if turn % 2 else plain_finding())
    stop.set()
    thread.join()
    assert seen <= {5000, len(plain_finding().test)}


def test_rewrite_preserves_file_name_and_xfail_reason_unless_it_has_its_own(path):
    accepted = {"xfail": "planner issue 12", "xfail_until": date(2027, 1, 31)}
    write(path, plain_finding(**accepted))
    smaller = plain_finding(scenario=other_scenario())
    assert rewrite(path, smaller) == load(path) == replace(smaller, **accepted)
    assert list(path.parent.iterdir()) == [path]
    rewrite(path, plain_finding(xfail="new", xfail_until=date(2027, 2, 28)))
    assert load(path).xfail == "new"


def test_rewrite_of_a_vanished_file_creates_it_again(path):
    rewrite(path, plain_finding())
    assert load(path) == plain_finding()


def test_unreadable_file_is_never_overwritten_and_its_name_not_reused(path):
    path.parent.mkdir(parents=True)
    path.write_text("the user is editing this")
    with pytest.raises(CorpusWriteError):
        rewrite(path, plain_finding())
    assert free_path(path.parent, plain_finding())[1].id == "front-2-1f3a9c-2"
    assert path.read_text() == "the user is editing this"


def test_an_unchanged_finding_gives_an_unchanged_file(path):
    write(path, plain_finding())
    before = path.read_bytes()
    rewrite(path, load(path))
    assert path.read_bytes() == before
    assert b"\r" not in before


def test_finding_gets_its_own_id_if_free_and_retains_it_when_saved(path):
    assert free_path(path.parent, plain_finding()) == (path, plain_finding())
    write(path, plain_finding())
    assert free_path(path.parent, plain_finding())[0] == path


def test_finding_with_a_shrunk_file_retains_its_path_unless_that_passes(path):
    write(path, plain_finding(scenario=plain_finding().scenario.truncated(1)))
    assert free_path(path.parent, plain_finding())[0] == path
    assert free_path(path.parent, plain_finding(), passed=[path])[0] != path


def test_name_taken_by_another_finding_gets_a_number(path):
    other = replace(plain_finding().expect, outcome=Outcome.OFF_ROAD)
    write(path, plain_finding(expect=other))
    second, finding = free_path(path.parent, plain_finding())
    assert (second.name, finding.id) == ("front-2-1f3a9c-2.pafot.yaml", "front-2-1f3a9c-2")
    write(second, replace(finding, expect=other))
    assert free_path(path.parent, plain_finding())[1].id == "front-2-1f3a9c-3"


@pytest.mark.parametrize("function", [write, rewrite])
def test_folder_creation_failure_is_one_clear_error(tmp_path, function):
    (tmp_path / "pafot_corpus").write_text("a file where the folder should be")
    path = tmp_path / "pafot_corpus" / "test_it" / "front-2-1f3a9c.pafot.yaml"
    with pytest.raises(CorpusWriteError, match="--pafot-corpus") as caught:
        function(path, plain_finding())
    assert str(caught.value).startswith(str(path))


def test_finding_too_large_to_read_back_is_refused(path):
    with pytest.raises(CorpusWriteError, match="256 KiB"):
        write(path, plain_finding(test="t" * 300_000))
    assert not path.exists()


FAILURES = [
    errno.ENOSPC, errno.EROFS, errno.EACCES, errno.ENAMETOOLONG, errno.ELOOP, errno.EIO,
]  # fmt: skip


@pytest.mark.parametrize("number", FAILURES)
def test_failed_write_names_its_cause_and_leaves_nothing(path, monkeypatch, number):
    def fail(descriptor):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(CorpusWriteError, match=re.escape(os.strerror(number))):
        write(path, plain_finding())
    assert list(path.parent.iterdir()) == []


def test_errors_are_apart_from_each_other():
    assert not issubclass(CorpusWriteError, CorpusError)
