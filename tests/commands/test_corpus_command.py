"""The command ``python -m pytest_pafot corpus``, which lists saved scenarios without running them."""

import errno
import json
import os
import shutil
import sys
from dataclasses import replace
from datetime import date
from pathlib import Path

import pytest

from pytest_pafot.__main__ import main
from pytest_pafot.corpus.reader import load
from pytest_pafot.corpus.writer import write
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from tests.findings.builders import plain_finding
from tests.helpers.hostile import unlisted


@pytest.fixture
def folder(tmp_path):
    for name, changes in (("a-111111", {}), ("b-222222", {"xfail": "issue 12", "xfail_until": date(2027, 1, 31)})):
        write(tmp_path / "test_it" / "test_x" / f"{name}.pafot.yaml", plain_finding(id=name, **changes))
    return tmp_path


def test_json_list_has_each_file_once(folder, capsys):
    assert main(["corpus", "list", "--no-tests", "--json", str(folder), str(folder / "test_it")]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["id"], row["xfail"]) for row in rows] == [("a-111111", None), ("b-222222", "issue 12")]


def test_unreadable_file_is_counted_and_exits_with_1(folder, capsys):
    (folder / "test_it" / "test_x" / "c.pafot.yaml").write_text("pafot: 99\n")
    assert main(["corpus", "stats", str(folder)]) == 1
    first, *counts = capsys.readouterr().out.splitlines()
    assert first == "3 saved scenarios, 1 broken, 1 xfail"
    assert ["kind", "2", plain_finding().signature.slug] in [line.split(maxsplit=2) for line in counts]


def test_a_folder_that_does_not_exist_is_refused(tmp_path, capsys):
    assert main(["corpus", "list", str(tmp_path / "none")]) == 2
    assert "corpus: expected a folder, received" in capsys.readouterr().err


@pytest.mark.parametrize("what", ["list", "stats", "join"])
def test_a_folder_that_cannot_be_listed_is_named(folder, capsys, monkeypatch, what):
    unlisted(monkeypatch, folder / "test_it")
    assert main(["corpus", what, str(folder)]) == 1
    assert capsys.readouterr().err == (
        f"corpus: {folder / 'test_it'}: expected a folder that can be listed, received Permission denied; let this "
        "user read it, restore it, or move it away\n"
    )


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not remove the current folder of a process")
def test_current_folder_that_was_removed_is_reported(tmp_path, monkeypatch, capsys):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert main(["corpus", "list"]) == 2
    assert "corpus: expected a current folder that exists, received No such file" in capsys.readouterr().err


def test_unwritable_output_is_reported_unlike_a_closed_pipe(folder, monkeypatch, capsys):
    end, start = os.pipe()
    os.close(end)
    with os.fdopen(start, "w") as head, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", head)
        assert main(["corpus", "list", "--no-tests", str(folder)]) == 141  # like a program that SIGPIPE has ended
    assert capsys.readouterr().err == ""
    if Path("/dev/full").exists():
        with Path("/dev/full").open("w") as full, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", full)
            assert main(["corpus", "list", "--no-tests", str(folder)]) == 2
        assert capsys.readouterr().err == (
            "corpus: expected a standard output that can be written, received No space left on device; "
            "free some space on the disk, or redirect it\n"
        )


def save(folder, **findings):
    """Write files into a folder, by id; each has chains with a number of instructions, and other given fields."""
    for name, (genes, changes) in findings.items():
        scenario = Scenario(npcs=((PositionInstruction(Cell.FRONT, 20.0), PositionInstruction(Cell(2), 8.0)) * genes,))
        write(folder / f"{name}.pafot.yaml", plain_finding(**{"id": name, "scenario": scenario} | changes))


IN_LANE_3 = Scenario(npcs=((PositionInstruction(Cell.FRONT, 20.0),),), ego_lane=3)
"""A scenario for a road of four lanes."""


def names(folder):
    return sorted(path.name.removesuffix(".pafot.yaml") for path in folder.rglob("*.pafot.yaml"))


def join(folder, capsys, *options):
    """Return the exit code, and the output without the folder's path."""
    code = main(["corpus", "join", *options, str(folder)])
    return code, capsys.readouterr().out.replace(f"{folder}{os.sep}", "").splitlines()


def test_join_leaves_the_simplest_file_of_each_kind(tmp_path, capsys):
    other_kind = {"expect": replace(plain_finding().expect, outcome=Outcome.OFF_ROAD, npc=None, cell=None, side=None)}
    one, two = tmp_path / "test_it" / "test x", tmp_path / "test_it" / "test_y[a b]"
    save(one, a=(3, {}), b=(1, {}), c=(2, {}), d=(4, other_kind), e=(4, {"test": "tests/test_safety.py::test_other"}))
    save(two, f=(3, {}))
    (one / "notes.md").write_text("why")
    told = [f"would remove: test_it/test x/{name}: b.pafot.yaml shows the same failure and is as simple or simpler"
            for name in ("c.pafot.yaml", "a.pafot.yaml")]  # fmt: skip
    assert join(tmp_path, capsys) == (0, told)
    assert names(tmp_path) == list("abcdef")
    assert join(tmp_path, capsys, "--write") == (0, [line.replace("would remove", "removed") for line in told])
    assert names(tmp_path) == list("bdef")
    assert (one / "notes.md").exists()
    assert join(tmp_path, capsys, "--write") == (0, ["nothing to join"])


def test_join_leaves_older_files_with_entered_lane_fault_alone(tmp_path, capsys):
    """Moving into a vehicle's side or in front of it are two failures, but older files have one fault for both."""
    entered = {"expect": replace(plain_finding().expect, fault="entered-lane")}
    unanswered = {"expect": replace(plain_finding().expect, fault="leader-unanswered")}
    save(tmp_path, a=(1, entered), b=(2, entered), c=(1, unanswered), d=(2, unanswered))
    assert join(tmp_path, capsys, "--write")[0] == 0
    assert names(tmp_path) == ["a", "b", "c"]


def test_join_knows_the_mistake_of_a_lane_change(tmp_path, capsys):
    side, front = (
        {"expect": replace(plain_finding().expect, fault="entered-lane", mistake=mistake)}
        for mistake in ("moved-into-side", "moved-in-front")
    )
    save(tmp_path, a=(1, side), b=(2, side), c=(1, front))
    assert join(tmp_path, capsys, "--write")[0] == 0
    assert names(tmp_path) == ["a", "c"]


def test_join_loses_no_acceptance_and_keeps_firm_ones(tmp_path, capsys):
    accepted = {"xfail": "issue 12", "xfail_until": date(2027, 1, 31)}
    for name, files in {
        "accepted": {"a": (1, {}), "b": (2, accepted), "c": (3, accepted)},
        "differing": {"d": (1, accepted), "e": (2, {"xfail": "issue 13"}), "f": (3, {})},
        "flaky": {"g": (1, {"flaky": "other end"}), "h": (2, {})},
    }.items():
        save(tmp_path / name, **files)
    code, lines = join(tmp_path, capsys, "--write")
    assert code == 1
    assert names(tmp_path) == list("bdefh")
    assert lines == [
        "removed: accepted/c.pafot.yaml: b.pafot.yaml shows the same failure and is accepted",
        "removed: accepted/a.pafot.yaml: b.pafot.yaml shows the same failure and is accepted",
        "differing: d.pafot.yaml, e.pafot.yaml, f.pafot.yaml: left as they are: expected the same reason "
        "and day in their lines `xfail:`, received 2 different ones; write the same line in these files, and "
        "join again",
        "removed: flaky/g.pafot.yaml: h.pafot.yaml shows the same failure and is not flaky",
    ]


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_join_ignores_broken_files_and_linked_folders(tmp_path, capsys, monkeypatch):
    own, elsewhere = tmp_path / "own", tmp_path / "elsewhere"
    save(own, a=(1, {}))
    save(elsewhere, b=(2, {}), c=(3, {}))
    (own / "d.pafot.yaml").symlink_to(elsewhere / "b.pafot.yaml")
    (own / "sub").symlink_to(elsewhere, target_is_directory=True)
    (own / "e.pafot.yaml").write_text("pafot: 99\n")
    code, lines = join(own, capsys, "--write")
    assert code == 1
    (line,) = lines
    assert line.startswith("left as it is: e.pafot.yaml:1: ")
    assert names(tmp_path) == ["a", "b", "c", "d", "e"]
    monkeypatch.chdir(own)
    assert main(["corpus", "join", "--write", "sub"]) == 2
    assert "received the link" in capsys.readouterr().err
    assert names(elsewhere) == ["b", "c"]


@pytest.mark.parametrize(
    ("world", "changes", "why"),
    [
        ({"lanes": 4000000}, {}, "world.lanes: expected a whole number from 3 to 6, received"),
        ({"duration": 1e9}, {}, "world.duration: expected a number from"),
        ({"lanes": 3}, {"scenario": IN_LANE_3}, "scenario.ego.lane: expected"),
    ],
    ids=["lanes", "duration", "scenario"],
)
def test_join_never_keeps_a_file_that_no_session_would_run(tmp_path, capsys, world, changes, why):
    save(tmp_path, a=(1, {"world": plain_finding().world | world, **changes}), b=(2, {}), c=(3, {}))
    code, lines = join(tmp_path, capsys, "--write")
    assert (code, names(tmp_path)) == (1, ["a", "b"])
    assert lines[0].startswith("left as it is: a.pafot.yaml:")
    assert why in lines[0]
    assert lines[1].startswith("removed: c.pafot.yaml: b.pafot.yaml shows")


def test_join_reports_a_file_that_cannot_be_removed(tmp_path, capsys, monkeypatch):
    save(tmp_path, a=(1, {}), b=(2, {}))

    def refuse(path, missing_ok=False):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    code, (line,) = join(tmp_path, capsys, "--write")
    assert (code, names(tmp_path)) == (1, ["a", "b"])
    assert line.startswith("not removed: b.pafot.yaml: ")
    assert line.endswith("mount it so that it can be written, then join again")


def add(capsys, folder, *sources, options=("--write",)):
    """Return the exit code and the lines of adding other corpora to a folder."""
    code = main(["corpus", "join", *options, *(f"--from={source}" for source in sources), str(folder)])
    return code, capsys.readouterr().out.replace(f"{folder.parent}{os.sep}", "").splitlines()


@pytest.fixture
def corpora(tmp_path):
    """Return the folder of a project with a saved scenario, and two machines that have it, and two of its kind."""
    folders = [tmp_path / name for name in ("here", "machine-1", "machine-2")]
    for folder in folders:
        save(folder / "test_it" / "test_x", **{"own-111111": (2, {})})
    save(folders[1] / "test_it" / "test_x", **{"more-222222": (1, {"xfail": "issue 12"})})
    save(folders[2] / "test_it" / "test_x", **{"more-222222": (3, {}), "other-333333": (1, {"test": "a.py::b"})})
    return folders


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*.pafot.yaml")}


def test_other_corpora_are_added_and_nothing_is_lost_in_any_order(corpora, tmp_path, capsys):
    """The own file of this kind may pass here, and then those of the machines are new."""
    here, *machines = corpora
    shutil.copytree(here, tmp_path / "again")
    before = contents(here)
    code, told = add(capsys, here, *machines, options=())
    assert (code, contents(here)) == (0, before)
    assert told[0] == (
        "would add: here/test_it/test_x/more-222222.pafot.yaml: from machine-1/test_it/test_x/more-222222.pafot.yaml"
    )
    code, told = add(capsys, here, *machines)
    assert (code, [line.partition(":")[0] for line in told]) == (0, ["added"] * 3)
    assert names(here) == ["more-222222", "more-222222-2", "other-333333", "own-111111"]
    assert before.items() <= contents(here).items()
    assert add(capsys, here, *machines) == (0, ["nothing to join"])
    add(capsys, tmp_path / "again", *reversed(machines))
    assert contents(tmp_path / "again") == contents(here)


def results_of(path, **labels):
    """Write the results of a session that labelled some files of the current folder."""
    folder = "test_it/test_x"
    findings = [
        {"node_id": name, "file": f"{folder}/{name}.pafot.yaml", "status": label} for name, label in labels.items()
    ]
    path.write_text(json.dumps({"pafot_json": 1, "exit": 1, "findings": findings}))


def test_with_results_only_files_that_still_fail_are_joined(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(Path("test_it", "test_x"), a=(1, {}), b=(2, {}), c=(3, {}), d=(4, {}))
    results_of(Path("pafot.json"), a="fixed", b="still failing", c="still failing")
    assert main(["corpus", "join", "--write", "--results=pafot.json"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "removed: test_it/test_x/c.pafot.yaml: b.pafot.yaml shows the same failure and is as simple or simpler"
    ]
    assert names(tmp_path) == ["a", "b", "d"]


def test_adding_fails_for_a_finding_that_does_not_come_along(corpora, tmp_path, capsys):
    """Otherwise a job that keeps only the results of a machine would lose what the machine has found."""
    here, machine, _ = corpora
    results_of(machine / "pafot.json", **{"more-222222": "new", "gone-444444": "new", "own-111111": "still failing"})
    (machine / "test_it" / "test_x" / "broken.pafot.yaml").write_text("pafot: 99\n")
    (tmp_path / "nothing").mkdir()
    code, told = add(capsys, here, machine, tmp_path / "nothing")
    assert code == 1
    assert told[0].startswith("not added: machine-1/test_it/test_x/broken.pafot.yaml:1: pafot: expected the format ")
    assert told[1:3] == [
        "nothing added: nothing: it has neither saved scenarios nor results, pafot.json; see whether its machine has "
        "searched",
        "not added: test_it/test_x/gone-444444.pafot.yaml: machine-1/pafot.json names it as a new finding; bring the "
        "corpus of its machine along",
    ]
    assert names(here) == ["more-222222", "own-111111"]


def test_differing_acceptances_of_one_scenario_are_told(corpora, capsys):
    here, machine, _ = corpora
    file = machine / "test_it" / "test_x" / "own-111111.pafot.yaml"
    file.write_text(file.read_text().replace('# xfail: "reason"', 'xfail: "issue 12"'))
    before = contents(here)
    code, (_, told) = add(capsys, here, machine)
    assert (code, contents(here).items() >= before.items()) == (1, True)
    place = "test_it/test_x/own-111111.pafot.yaml"
    assert told == (
        f"not added: machine-1/{place}: expected the acceptance of here/{place}, received issue 12; write the same "
        f"line `xfail:` in both, or none in machine-1/{place}"
    )


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_nothing_is_added_through_a_link(corpora, tmp_path, capsys):
    here, machine, _ = corpora
    (here / "test_it").rename(tmp_path / "elsewhere")
    (here / "test_it").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    code, (told,) = add(capsys, here, machine)
    assert (code, "received the link" in told, names(tmp_path / "elsewhere")) == (1, True, ["own-111111"])


def test_other_corpora_come_into_one_folder_that_exists(tmp_path, capsys):
    assert main(["corpus", "join", "--from=nowhere", str(tmp_path)]) == 2
    assert "expected a folder, received nowhere" in capsys.readouterr().err
    assert main(["corpus", "join", f"--from={tmp_path}", str(tmp_path), str(tmp_path)]) == 2
    assert "expected one FOLDER with --from, received several" in capsys.readouterr().err


def accept(*arguments):
    return main(["corpus", "accept", *arguments, "--reason", "TICKET-7"])


def test_accepting_a_failure_changes_one_listed_line(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    file = folder / "test_it" / "test_x" / "a-111111.pafot.yaml"
    before = file.read_text().replace("scenario:", "# ours\nscenario:")
    file.write_text(before)
    assert accept("a-111111", "--until", "2999-01-31") == 0
    line = 'xfail: {reason: "TICKET-7", until: 2999-01-31}'
    assert file.read_text() == before.replace('# xfail: "reason"', line)
    assert accept(str(file)) == 0
    assert file.read_text() == before.replace('# xfail: "reason"', 'xfail: "TICKET-7"')
    capsys.readouterr()
    assert main(["corpus", "list", "--no-tests", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines()[1].endswith("  accepted")


def test_a_failure_is_accepted_as_flaky_only_up_to_a_day(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    file = folder / "test_it" / "test_x" / "a-111111.pafot.yaml"
    before = file.read_text()
    assert accept("a-111111", "--flaky") == 2
    assert capsys.readouterr().err == (
        "corpus: expected a last day with --flaky, received none; add --until=YYYY-MM-DD\n"
    )
    assert file.read_text() == before
    assert accept("a-111111", "--flaky", "--until", "2999-01-31") == 0
    line = 'xfail: {reason: "TICKET-7", until: 2999-01-31, flaky: true}'
    assert file.read_text() == before.replace('# xfail: "reason"', line)
    assert capsys.readouterr().out.endswith("a-111111.pafot.yaml: accepted as flaky until 2999-01-31: TICKET-7\n")
    assert main(["corpus", "list", "--no-tests", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines()[1].endswith("  accepted until 2999-01-31, flaky")
    assert accept("a-111111", "--until", "2999-01-31") == 0  # no longer flaky
    assert load(file) == replace(load(file), xfail="TICKET-7", xfail_until=date(2999, 1, 31), xfail_flaky=False)


def test_a_full_disk_leaves_the_file_as_it_was(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    file = folder / "test_it" / "test_x" / "a-111111.pafot.yaml"
    before = file.read_bytes()

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert accept("a-111111", "--flaky", "--until", "2999-01-31") == 1
    assert capsys.readouterr().err == (
        "corpus: a-111111: expected a file that can be written, received No space left on device; "
        "free some space on the disk, then accept it again\n"
    )
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == sorted(file.parent.glob("*.pafot.yaml"))


def test_several_failures_are_accepted_despite_a_wrong_id(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    assert accept("a-111111", "none", "b-222222") == 1
    told = capsys.readouterr()
    assert told.out.splitlines() == [
        f"test_it/test_x/{name}.pafot.yaml: accepted for good: TICKET-7" for name in ("a-111111", "b-222222")
    ]
    assert told.err.startswith("corpus: none: expected the file of a saved scenario")
    assert all('xfail: "TICKET-7"' in file.read_text() for file in folder.rglob("*.pafot.yaml"))


def test_xfail_is_appended_but_never_replaces_several_lines(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    file = folder / "test_it" / "test_x" / "a-111111.pafot.yaml"
    bare = file.read_text().replace('# xfail: "reason"\n', "")
    file.write_text(bare)
    assert accept("a-111111") == 0
    assert file.read_text() == bare + 'xfail: "TICKET-7"\n'
    over_lines = bare + "xfail:\n  {reason: x}\n"
    file.write_text(over_lines)
    assert accept("a-111111") == 1
    assert f"corpus: {file.relative_to(folder)}:" in capsys.readouterr().err
    assert file.read_text() == over_lines


@pytest.mark.parametrize(
    ("day", "told"),
    [
        ("soon", "expected a day such as 2027-01-31, received 'soon'"),
        ("2026-01-31", "expected today or a later day, received 2026-01-31, which is over"),
    ],
)
def test_a_day_that_is_none_or_over_is_told(folder, capsys, monkeypatch, day, told):
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit, match="2"):
        accept("a-111111", "--until", day)
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("form", ["{}", "saved-{}", "test_it.py::test_x[saved-{}]", "{}.pafot.yaml"])
def test_an_id_is_that_which_pytest_prints(folder, capsys, monkeypatch, form):
    monkeypatch.chdir(folder)
    assert accept(form.format("a-111111")) == 0
    assert capsys.readouterr().out == "test_it/test_x/a-111111.pafot.yaml: accepted for good: TICKET-7\n"


@pytest.mark.parametrize(
    ("wrong", "fix"),
    [
        ("111111", "did you mean a-111111?"),
        ("b-222", "did you mean b-222222?"),
        ("other", "`python -m pytest_pafot corpus list` lists the files"),
    ],
)
def test_an_id_that_no_file_has_is_told_with_those_like_it(folder, capsys, monkeypatch, wrong, fix):
    monkeypatch.chdir(folder)
    write(folder / "test_it" / "test_y" / "a-111111.pafot.yaml", plain_finding(id="a-111111"))  # told only once
    assert accept(wrong) == 1
    assert capsys.readouterr().err == (
        f"corpus: {wrong}: expected the file of a saved scenario, or the id of a saved scenario below the "
        f"current folder, received no such file or id; {fix}\n"
    )


def test_accept_refuses_ambiguous_id_but_takes_file_path(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    write(folder / "test_it" / "test_y" / "a-111111.pafot.yaml", plain_finding(id="a-111111"))
    assert accept("a-111111") == 1
    assert "received an id that 2 files have; give one of the files: test_it/test_x/" in capsys.readouterr().err
    assert accept("test_it/test_y/a-111111.pafot.yaml") == 0
