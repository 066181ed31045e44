import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given

from pytest_pafot.execution import crash_records
from pytest_pafot.execution.crash_records import (
    CrashRecord,
    CrashRecordError,
    leftovers,
    records_of,
)
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.support import files
from tests.findings.builders import scenarios

SCENARIO = Scenario(
    npcs=[[PositionInstruction(1, 25.0), PositionInstruction(2, 8.0)]], seed=7, gene_seconds=2.5
)
OWNER = "tests/test_safety.py::test_it[search]"
WORLD = {"kind": "highway", "lanes": 4}

CHILD = f"""
import os, sys, pathlib
from pytest_pafot.execution.crash_records import CrashRecord
from pytest_pafot.model.scenario import PositionInstruction, Scenario
record = CrashRecord(pathlib.Path(sys.argv[1]), {OWNER!r}, world={WORLD!r})
record.write(Scenario(npcs=[[PositionInstruction(5, 1.5)] * 40]))
record.write(Scenario(npcs=[[PositionInstruction(1, 25.0), PositionInstruction(2, 8.0)]], seed=7, gene_seconds=2.5))
"""


def child(folder, rest):
    return subprocess.Popen(
        [sys.executable, "-c", CHILD + rest, str(folder)], stdout=subprocess.PIPE, cwd=Path.cwd()
    )


def abandoned(folder, name, content):
    folder.mkdir(exist_ok=True)
    (folder / name).write_bytes(content)


def test_next_session_names_the_scenario_of_a_crash(tmp_path):
    with child(tmp_path, "os._exit(139)") as process:
        assert process.wait() == 139
    (left,) = leftovers(tmp_path)
    assert (left.owner, left.scenario, left.world) == (OWNER, SCENARIO, WORLD)
    assert left.path.name.startswith(f"{left.pid}-")


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_record_of_a_live_process_is_no_leftover(tmp_path):
    process = child(tmp_path, "print('ready', flush=True); __import__('time').sleep(60)")
    try:
        assert process.stdout.readline().strip() == b"ready"
        assert leftovers(tmp_path) == ()
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    assert [left.scenario for left in leftovers(tmp_path)] == [SCENARIO]


def test_a_reported_leftover_is_discarded_once(tmp_path):
    abandoned(tmp_path, "1-x.inflight", b"garbled\n")
    (left,) = leftovers(tmp_path)
    left.discard()
    left.discard()
    assert leftovers(tmp_path) == ()


def test_record_of_reused_process_id_is_a_leftover(tmp_path):
    with CrashRecord(tmp_path, OWNER) as record:
        record.write(SCENARIO)
        content = next(tmp_path.iterdir()).read_bytes()
        abandoned(tmp_path, f"{os.getpid()}-before.inflight", content)
        assert [left.path.name for left in leftovers(tmp_path)] == [
            f"{os.getpid()}-before.inflight"
        ]


def test_two_searches_of_one_process_do_not_interfere(tmp_path):
    with CrashRecord(tmp_path, "a") as one, CrashRecord(tmp_path, "b") as other:
        one.write(SCENARIO)
        other.write(SCENARIO)
        other.close()
        assert len(list(tmp_path.iterdir())) == 1
        assert leftovers(tmp_path) == ()


def test_without_a_scenario_nothing_is_written(tmp_path):
    with CrashRecord(tmp_path / "none", OWNER) as record:
        record.clear()
    assert not (tmp_path / "none").exists()


def test_between_two_scenarios_nobody_is_to_blame(tmp_path):
    with child(tmp_path, "record.clear(); os._exit(1)") as process:
        process.wait()
    assert leftovers(tmp_path) == ()
    assert list(tmp_path.iterdir()) == []


def test_closed_record_can_be_used_again(tmp_path):
    record = CrashRecord(tmp_path, OWNER)
    for _ in range(2):
        record.write(SCENARIO)
        assert len(list(tmp_path.iterdir())) == 1
        record.close()
        record.close()
        assert list(tmp_path.iterdir()) == []


@given(one=scenarios(), other=scenarios())
def test_last_written_scenario_is_always_recovered(tmp_path_factory, one, other):
    folder = tmp_path_factory.mktemp("inflight")
    record = CrashRecord(folder, 'nasty "owner"\n\ud800')
    record.write(one)
    record.write(other)
    (path,) = folder.iterdir()
    abandoned(folder, "0-copy.inflight", path.read_bytes())
    record.close()
    (left,) = leftovers(folder)
    assert (left.owner, left.scenario) == ('nasty "owner"\n\ud800', other)


@pytest.mark.parametrize("content", [
    b"{",
    b"\xff\xfe\n",
    b'{"owner": "a", "world": 3, "scenario": []}\n',
    json.dumps({"owner": "a", "world": None, "scenario": [[[[9, 1.0]]], 0, 1, 22.0, 10.0]}).encode(),
    json.dumps({"owner": "a", "world": None, "scenario": [[[["up", 1.0]]], 0, 1, 22.0, 10.0]}).encode(),
    b"[" * 100_000,
])  # fmt: skip
def test_a_garbled_record_is_still_a_leftover(tmp_path, content):
    abandoned(tmp_path, "77-x.inflight", content)
    (left,) = leftovers(tmp_path)
    assert (left.pid, left.owner, left.scenario) == (77, "", None)


def test_each_project_has_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(crash_records.tempfile, "tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    (tmp_path / "same").symlink_to(tmp_path)
    own, other = records_of(tmp_path), records_of(tmp_path / "other")
    with CrashRecord(own, OWNER) as record:
        record.write(SCENARIO)
        assert record.error is None
        assert len(list(own.iterdir())) == 1
    assert own == records_of(tmp_path / "same")
    assert own.parent == other.parent
    assert own != other
    assert [each.stat().st_mode & 0o777 for each in (own, own.parent)] == [0o700, 0o700]


@pytest.mark.skipif(os.name == "nt", reason="each user has a folder for temporary files on Windows")
@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize("is_link", [False, True], ids=["open to others", "a link"])
def test_folder_that_others_could_have_planted_is_refused(tmp_path, is_link, level):
    folder = tmp_path / "own" / "project"
    place = [folder.parent, folder][level]
    place.parent.mkdir(mode=0o700, exist_ok=True)
    if is_link:
        (tmp_path / "elsewhere" / "project").mkdir(parents=True)
        place.symlink_to(tmp_path / "elsewhere")
    else:
        place.mkdir()
        place.chmod(0o777)
    with CrashRecord(folder, OWNER) as record:
        record.write(SCENARIO)
    assert "the scenario is not recorded if this process crashes" in str(record.error)
    assert f"other users can write to {place}" in str(record.error)
    assert "Delete that folder, or set TMPDIR to a folder that belongs to you. " in str(
        record.error
    )
    with pytest.raises(CrashRecordError, match=f"other users can write to {place}"):
        leftovers(folder)


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_folder_of_records_follows_no_links(tmp_path):
    folder, secret = tmp_path / "records", tmp_path / "secret"
    secret.write_text('{"owner": "HUSH"}')
    folder.mkdir()
    blank = tmp_path / "blank"
    blank.write_text("\n")
    os.mkfifo(folder / "1-pipe.inflight")
    for number, target in enumerate(
        [secret, blank, tmp_path / "none", "/dev/zero", "5-x.inflight"]
    ):
        (folder / f"{number + 2}-x.inflight").symlink_to(target)
    before = sorted(folder.iterdir())
    assert leftovers(folder) == ()
    (tmp_path / "link").symlink_to(folder)
    (folder / "9-x.inflight").write_text("\n")  # it would be removed
    with pytest.raises(CrashRecordError, match="other users can write to"):
        leftovers(tmp_path / "link")
    with CrashRecord(tmp_path / "link", OWNER) as record:
        record.write(SCENARIO)
    assert "other users can write to" in str(record.error)
    assert sorted(folder.iterdir()) == sorted([*before, folder / "9-x.inflight"])
    assert (blank.read_text(), secret.exists()) == ("\n", True)


def test_only_records_are_looked_at(tmp_path):
    abandoned(tmp_path, "notes.txt", b"mine")
    (tmp_path / "folder.inflight").mkdir()
    assert leftovers(tmp_path) == ()
    assert leftovers(tmp_path / "none") == ()


def test_unreadable_folder_of_records_is_a_typed_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CrashRecordError, match="expected a writable folder"):
        leftovers(tmp_path / "file")


def test_unwritable_folder_never_stops_the_search(tmp_path):
    (tmp_path / "file").write_text("")
    with CrashRecord(tmp_path / "file" / "inflight", OWNER) as record:
        record.write(SCENARIO)
        error = record.error
        record.write(SCENARIO)
        record.clear()
    assert isinstance(error, CrashRecordError)
    assert record.error is error
    assert "the scenario is not recorded if this process crashes" in str(error)


def test_full_disk_never_stops_the_search(tmp_path, monkeypatch):
    record = CrashRecord(tmp_path, OWNER)
    record.write(SCENARIO)

    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(crash_records.os, "write", full)
    record.write(SCENARIO)
    monkeypatch.undo()
    assert "No space left on device" in str(record.error)
    record.close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="locks of Windows always work")
def test_without_locks_the_process_id_decides(tmp_path, monkeypatch):
    def unsupported(_descriptor):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(files, "_lock", unsupported)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    with CrashRecord(tmp_path, OWNER) as record:
        record.write(SCENARIO)
        assert record.error is None
        abandoned(tmp_path, f"{gone.pid}-x.inflight", b"garbled")
        assert [left.pid for left in leftovers(tmp_path)] == [gone.pid]


def test_record_removed_by_another_session_is_created_again(tmp_path, monkeypatch):
    lock, taken = files._lock, []

    def interrupted(descriptor):
        if not taken:
            taken.append(next(tmp_path.iterdir()))
            taken[0].unlink()
        lock(descriptor)

    monkeypatch.setattr(files, "_lock", interrupted)
    with CrashRecord(tmp_path, OWNER) as record:
        record.write(SCENARIO)
        assert len(list(tmp_path.iterdir())) == 1
        assert next(tmp_path.iterdir()) != taken[0]


def test_recording_is_cheap_beside_any_run(tmp_path, monkeypatch):
    with CrashRecord(tmp_path, OWNER) as record:
        record.write(SCENARIO)
        calls = []
        for name in (
            "open",
            "close",
            "lseek",
            "write",
            "ftruncate",
            "fsync",
            "rename",
            "replace",
            "unlink",
            "stat",
        ):
            call = getattr(os, name)
            monkeypatch.setattr(
                os,
                name,
                lambda *given, _n=name, _c=call, **o: (calls.append(_n), _c(*given, **o))[1],
            )
        record.write(SCENARIO)
        record.clear()
        monkeypatch.undo()
    assert calls == ["lseek", "write"] * 2
