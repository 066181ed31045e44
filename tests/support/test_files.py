"""Files are written as a whole or not at all, and a killed writer's leftovers are removed."""

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from pytest_pafot.support import files
from pytest_pafot.support.files import append, open_regular, write_if_free, write_whole


def is_full(error):
    return error.errno == errno.ENOSPC


@pytest.fixture
def path(tmp_path):
    return tmp_path / "folder" / "of a test" / "file.txt"


@pytest.fixture(params=["hard links", "no hard links"])
def links(request, monkeypatch):
    if request.param == "no hard links":

        def refuse(self, target):
            raise PermissionError(errno.EPERM, "not permitted")

        monkeypatch.setattr(Path, "hardlink_to", refuse)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_pipe_receives_the_content_and_stays(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_whole(tmp_path / "pipe", "content")
    assert os.read(reader, 100) == b"content"
    os.close(reader)
    assert [each.name for each in tmp_path.iterdir()] == ["pipe"]
    assert (tmp_path / "pipe").is_fifo()


@pytest.mark.skipif(
    not Path("/proc/self/fd").is_dir(), reason="this system has no links to open files"
)
def test_link_of_the_system_to_an_open_file_stays(tmp_path):
    with (tmp_path / "output").open("wb") as output:
        output.write(b"before, ")
        output.flush()
        link = Path(f"/proc/self/fd/{output.fileno()}")
        write_whole(link, "content")
        assert link.is_symlink()
    assert (tmp_path / "output").read_bytes() == b"before, content"


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no device that is always full"
)
def test_full_device_is_an_error_and_stays():
    for write in (write_whole, append):
        with pytest.raises(OSError, check=is_full):
            write(Path("/dev/full"), "content")
    assert Path("/dev/full").is_char_device()


def test_failed_addition_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "file.txt"
    append(path, "first\n")
    parts = iter([1, OSError(errno.ENOSPC, "full")])
    real = os.write

    def write(descriptor, data):
        part = next(parts)
        if isinstance(part, OSError):
            raise part
        return real(descriptor, data[:part])

    monkeypatch.setattr(files.os, "write", write)
    with pytest.raises(OSError, check=is_full):
        append(path, "second\n")
    monkeypatch.undo()
    append(path, "third\n")
    assert path.read_text() == "first\nthird\n"


@pytest.mark.parametrize("write", [write_whole, write_if_free])
def test_file_is_written_with_folders_and_no_leftovers(path, write, links):
    assert bool(write(path, b"content")) == (write is write_if_free)
    assert not write_if_free(path, b"second")  # it is free once
    assert path.read_bytes() == b"content"
    assert list(path.parent.iterdir()) == [path]


def test_a_file_that_is_there_is_replaced(path):
    write_whole(path, "first")
    write_whole(path, "zw\u00f6lf\n")
    assert path.read_bytes() == "zw\u00f6lf\n".encode()
    assert list(path.parent.iterdir()) == [path]


def test_one_of_many_simultaneous_writers_wins_without_error(path):
    barrier = threading.Barrier(8)
    won = []

    def writer(number):
        barrier.wait()
        won.append((write_if_free(path, str(number).encode()), number))

    threads = [threading.Thread(target=writer, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(written for written, _ in won) == [False] * 7 + [True]
    assert path.read_text() == str(next(number for written, number in won if written))
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("write", [write_whole, write_if_free])
@pytest.mark.parametrize("call", ["publish", "fsync", "open"])
def test_failing_disk_leaves_the_old_file_intact(path, monkeypatch, write, call):
    write_whole(path, "before")

    def fail(*_args, **_options):
        raise OSError(errno.ENOSPC, "full")

    if call == "fsync":
        monkeypatch.setattr(os, "fsync", fail)
    elif call == "open":
        monkeypatch.setattr(Path, "open", fail)
    else:
        for name in ("hardlink_to", "rename", "replace"):
            monkeypatch.setattr(Path, name, fail)
        monkeypatch.setattr(os.path, "lexists", lambda path: False)
    with pytest.raises(OSError, check=is_full):
        write(path, b"content")
    monkeypatch.undo()
    assert list(path.parent.iterdir()) == [path]
    assert path.read_text() == "before"


WRITER = """
import sys, time
from pathlib import Path
from pytest_pafot.support import files
temporary, file = files._create(Path(sys.argv[1]))
file.write(b"half a fi")
file.flush()
print(temporary.name, flush=True)
time.sleep(60)
"""


@pytest.fixture
def writer(path):
    """Start a process that is writing a file; return it and the name of its temporary file."""
    path.parent.mkdir(parents=True)
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, path.parent], stdout=subprocess.PIPE, text=True
    ) as process:
        yield process, path.parent / process.stdout.readline().strip()
        process.kill()


@pytest.mark.parametrize("has_locks", [True, False])
def test_temporary_file_stays_while_its_process_lives(path, writer, monkeypatch, has_locks):
    def no_locks(descriptor):
        raise OSError(errno.ENOLCK, "No locks available")

    process, temporary = writer
    if not has_locks:  # the id of the process in the name decides
        monkeypatch.setattr(files, "_lock", no_locks)
    os.utime(temporary, (1.0, 1.0))
    write_if_free(path, b"content")
    assert sorted(path.parent.iterdir()) == sorted([temporary, path])
    process.kill()
    process.wait()
    write_whole(path, b"content")
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_only_regular_files_are_opened_without_following_links(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("mine")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(secret)
    (tmp_path / "dangling").symlink_to(tmp_path / "none")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for mode in ("rb", "r+b", "ab"):
        for name in ("link", "dangling", "loop", "zero", "pipe", "."):
            with pytest.raises(OSError, check=lambda error: error.errno == errno.EINVAL):
                open_regular(tmp_path / name, mode)
    with open_regular(tmp_path / "new", "ab") as file:
        file.write(b"content")
    with open_regular(tmp_path / "new") as file:
        assert file.read() == b"content"
    assert secret.read_text() == "mine"
    assert not (tmp_path / "none").exists()


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
def test_write_replaces_link_but_not_its_target(path, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("mine")
    path.parent.mkdir(parents=True)
    temporary = path.parent / ".pafot-1-00.tmp"
    for link in (path, temporary):
        link.symlink_to(secret)
    assert not write_if_free(path, b"content")
    with pytest.raises(OSError, match=str(path)):
        append(path, b"content")
    write_whole(path, b"content")
    assert (path.read_text(), path.is_symlink(), temporary.is_symlink()) == ("content", False, True)
    assert secret.read_text() == "mine"


def test_a_temporary_file_of_an_earlier_version_goes(path):
    path.parent.mkdir(parents=True)
    (path.parent / ".pafot-0123456789abcdef.tmp").write_text("half a fi")
    write_if_free(path, b"content")
    assert list(path.parent.iterdir()) == [path]


def test_taken_temporary_file_is_made_again(path, monkeypatch):
    path.parent.mkdir(parents=True)
    holding, taken = files.hold, []

    def taken_at_first(descriptor):
        if not taken:
            taken.extend(path.parent.iterdir())
            taken[0].unlink()
        return holding(descriptor)

    monkeypatch.setattr(files, "hold", taken_at_first)
    assert write_if_free(path, b"content")
    assert path.read_bytes() == b"content"


@pytest.mark.skipif(os.name == "nt", reason="permissions of files")
def test_file_has_the_permissions_of_a_new_file(path):
    before = os.umask(0o022)
    try:
        write_whole(path, "content")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o644
