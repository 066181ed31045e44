"""A search that continues in a later session finds, reports and saves the same as one long session."""

import errno
import importlib
import json
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.campaign import state_file
from pytest_pafot.findings.sighting import Sighting
from pytest_pafot.searching import GenerationalSearch, GenerationState, from_plain, plain, sample
from pytest_pafot.searching.events import Evaluated, GenerationFinished, NewBest
from pytest_pafot.support.errors import RequestError
from tests.helpers.stages import mostly_oracle

SHORT = {
    "population": 4,
    "genes": 2,
    "gene_seconds": 5,
    "npcs": 2,
    "seed": 7,
    "shrink_rollouts": 2,
    "node_id": "test_it.py::test_it",
}


def never_collides(run):
    pafot.check(run.npcs[0].gap, name="keeps off", at_least=0.2)
    assert not run.collision


def searched(corpus="corpus", resume="states", **options):
    given = {**SHORT, "ads": constant_speed.make, "holds": never_collides, "corpus": corpus, "resume": resume}
    return pafot.explore(**(given | options))


@pytest.fixture
def search(tmp_path, monkeypatch):
    """Return searches in a new folder, which also has the states of all searches."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(state_file, "SHARE", 0)  # a state at each border, however long writing takes
    return searched


def searched_in(folder, **options):
    """Return what a search in a folder finds, and its files there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(state_file, "SHARE", 0)
        exploration = searched(**options)
    return exploration, files(folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Run one long search; return it and its files."""
    return searched_in(tmp_path_factory.mktemp("whole"), resume=None, runs=24)


@pytest.fixture(scope="module")
def first_session(tmp_path_factory):
    """Run a search that can continue after its findings; return it and its folder."""
    folder = tmp_path_factory.mktemp("first")
    return searched_in(folder, runs=20)[0], folder


@pytest.fixture
def first(search, tmp_path, first_session):
    """Return the same search as if it had run here."""
    exploration, folder = first_session
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    assert exploration.findings
    return exploration


@pytest.fixture(scope="module")
def after_7_runs(tmp_path_factory):
    """Return the name and the text of a search's state."""
    folder = tmp_path_factory.mktemp("begun")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        searched(runs=7)
    path = state_of(folder)
    return path.name, path.read_text()


@pytest.fixture
def begun(search, tmp_path, after_7_runs):
    """Return the state of a search that can continue."""
    name, text = after_7_runs
    path = tmp_path / "states" / name
    path.parent.mkdir()
    path.write_text(text)
    return path


def files(folder):
    return {path.name: path.read_text() for path in sorted(folder.rglob("*.pafot.yaml"))}


def body(*explorations):
    """Return the report by generation and place; if something was reported twice, the later report."""
    told = {}
    for event in (event for each in explorations for event in each):
        if isinstance(event, Evaluated):
            told[event.generation, 0, event.index] = event
        elif isinstance(event, GenerationFinished):
            told[event.generation, 1] = event
        elif isinstance(event, NewBest):
            told[event.generation, 2] = event
    return told


def state_of(folder):
    (path,) = (folder / "states").iterdir()
    return path


@pytest.mark.parametrize("algorithm", mostly_oracle(["distinct", "random"], "distinct"))
def test_four_sessions_are_one_long_one(search, tmp_path, request, algorithm):
    if algorithm == "distinct":
        whole, saved = request.getfixturevalue("whole")
    else:
        whole = search("whole", resume=None, runs=24, algorithm=algorithm)
        saved = files(tmp_path / "whole")
    parts = [search(runs=6, algorithm=algorithm) for _ in range(4)]
    assert files(tmp_path / "corpus") == saved != {}
    assert body(*[part.events for part in parts]) == body(whole.events)
    evaluated = [event for part in parts for event in part.events if isinstance(event, Evaluated)]
    assert len(evaluated) == len(body(*[part.events for part in parts]).keys() & {
        (event.generation, 0, event.index) for event in evaluated
    })  # fmt: skip
    assert [finding for part in parts for finding in part.findings] == list(whole.findings)
    check_summaries(whole.summary, [part.summary for part in parts])


def check_summaries(whole, parts):
    """Check that each summary covers all sessions so far, but only its own new findings."""
    last = parts[-1]
    for name in (
        "runs",
        "known_runs",
        "failing",
        "outcomes",
        "responsibilities",
        "generations",
        "random_failing",
        "random_runs",
        "reached",
        "warnings",
        "drawn",
    ):
        assert getattr(last, name) == getattr(whole, name)
    assert (last.budget, last.seed) == (24, whole.seed)
    counted = {find.id: 1 + find.repeats for part in parts[-1:] for find in part.finds}
    assert counted | dict(last.known) == {find.id: 1 + find.repeats for find in whole.finds}
    assert [part.runs for part in parts] == [6, 12, 18, 24]
    assert last.notes[0] == "resumed after 18 runs of earlier sessions"
    assert not parts[0].notes


@pytest.mark.parametrize(("share", "places"), [(0, (2, 6)), (10**9, (5,))], ids=["each border is written", "few are"])
def test_killed_session_continues_from_last_state(search, tmp_path, monkeypatch, whole, share, places):
    monkeypatch.setattr(state_file, "SHARE", share)
    (whole, saved), heard = whole, []

    def killed_at(number, what):
        def listen(event):
            heard.append(event)
            if isinstance(event, what):
                counted.append(event)
                if len(counted) > number:
                    raise KeyboardInterrupt

        counted = []
        return listen

    for number in places:
        with pytest.raises(KeyboardInterrupt):
            search(runs=24, on_event=killed_at(number, Evaluated))
    with pytest.raises(KeyboardInterrupt):  # while its findings are simplified
        search(generations=1, on_event=killed_at(0, Sighting))
    done = json.loads(state_of(tmp_path).read_text())["sums"][3]
    last = search(runs=24 - done, on_event=heard.append)
    assert files(tmp_path / "corpus") == saved != {}
    assert body(heard) == body(whole.events)
    assert {each.id for each in last.findings} <= {each.id for each in whole.findings}


def test_an_interrupt_is_not_held_back_after_a_listener_has_raised(search):
    def raises_at(kind):
        def listen(event):
            if isinstance(event, kind):
                raise RuntimeError

        return listen

    before = signal.getsignal(signal.SIGINT)
    search(runs=20, max_time=1e-9)
    for kind in (Sighting, Evaluated, GenerationFinished):
        with pytest.raises(RuntimeError) as raised:
            search(runs=24, on_event=raises_at(kind))
        # The traceback has all that was open.
        assert signal.getsignal(signal.SIGINT) is before, raised.tb


def test_session_interrupted_while_it_examines_a_finding_is_continued_with_it(search, tmp_path):
    def interrupted(event):
        if isinstance(event, Sighting) and event.moment is not None:
            raise KeyboardInterrupt

    whole = search("whole", resume=None, runs=24)
    with pytest.raises(KeyboardInterrupt):
        search(runs=20, on_event=interrupted)
    search(runs=4)
    assert files(tmp_path / "corpus") == files(tmp_path / "whole")
    assert len(whole.findings) > 1


def test_finished_finding_is_reported_only_once(search, first):
    again = search(runs=4)
    assert not {each.id for each in again.findings} & {each.id for each in first.findings}


def test_finding_with_deleted_file_is_found_again(search, tmp_path, first):
    saved = files(tmp_path / "corpus")
    for path in (tmp_path / "corpus").rglob("*.pafot.yaml"):
        path.unlink()
    assert {each.id for each in search(runs=1).findings} == {each.id for each in first.findings}
    assert files(tmp_path / "corpus") == saved != {}


def test_a_find_under_another_name_is_there(search, tmp_path, first):
    for path in (tmp_path / "corpus").rglob("*.pafot.yaml"):
        path.rename(path.with_name(f"renamed-{path.name}"))
    assert not search(runs=1).findings


def test_scenarios_saved_before_the_search_stay_known(search, tmp_path):
    other = search(resume=None, runs=16, seed=3)
    first, second = search(runs=8), search(runs=8)
    ids = {each.id for each in other.findings}
    assert not search(resume=None, runs=16).findings  # The corpus already has all of them.
    assert sum(second.summary.known.values()) == second.summary.failing - sum(
        1 + f.repeats for f in second.summary.finds
    )
    assert ids & set(second.summary.known)
    assert not ids & {each.id for each in (*first.findings, *second.findings)}


def refused(search, match, **options):
    with pytest.raises(RequestError, match=match) as caught:
        search(runs=4, **options)
    return str(caught.value)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"seed": 6}, "seed 7 in the file, 6 now"),
        ({"population": 5}, "algorithm.population 4 in the file, 5 now"),
        ({"algorithm": "random"}, "algorithm.name 'distinct' in the file, 'random' now"),
        ({"npcs": 3}, "space.npcs 2 in the file, 3 now"),
        ({"lanes": 3}, "world.*4 in the file, 3 now"),
        ({"blame": "ego"}, "blame 'any' in the file, 'ego' now"),
        ({"fitness": "paper"}, "fitness 'default' in the file, 'paper' now"),
    ],
)
def test_state_of_other_settings_names_both_values(search, begun, options, match):
    before = begun.read_text()
    text = refused(search, match, **options)
    assert text.startswith(str(begun))
    assert "delete the file to start the search from scratch" in text
    assert begun.read_text() == before


POLICY = "from core_of_resumed import STEERING\n\n\ndef make():\n    return lambda observation: (0.0, STEERING)\n"


def test_a_state_of_changed_code_is_refused_by_file_name(search, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "policy_of_resumed.py").write_text(POLICY)
    core = tmp_path / "core_of_resumed.py"
    core.write_text("STEERING = 0.0\n")
    make = importlib.import_module("policy_of_resumed").make
    search(ads=make, runs=4)
    assert search(ads=make, runs=4).summary.runs == 8
    core.write_text("STEERING = 0.1\n")
    text = refused(search, r"code\.core_of_resumed\.py 'sha256:\w+' in the file, 'sha256:\w+' now", ads=make)
    assert "delete the file to start the search from scratch" in text
    state_of(tmp_path).unlink()
    assert search(ads=make, runs=4).summary.runs == 4


def changed(change):
    """Return a function that damages the data of a state."""

    def fault(text):
        data = json.loads(text)
        change(data)
        return json.dumps(data)

    return fault


FAULTS = {
    "truncated": (lambda text: text[: len(text) // 2], "expected the JSON of a search's state, received invalid JSON"),
    "empty": (lambda text: "", "expected the JSON of a search's state"),
    "no text": (lambda text: b"\xff\xfe\x00", "expected the JSON of a search's state, received UnicodeDecodeError"),
    "another kind": (lambda text: "[1, 2]", "expected a mapping, received"),
    "deep": (lambda text: "[" * 100_000, "expected the JSON of a search's state, received RecursionError"),
    "NaN": (lambda text: text.replace('"version": 10', '"version": NaN'), "NaN, which is not"),
    "version": (changed(lambda data: data.update(version="2")), "expected a state of version 10, received vers"),
    "extra key": (changed(lambda data: data.update(run="rm")), "expected the keys version, settings"),
    "missing key": (changed(lambda data: data.pop("begun")), "expected the keys version, settings"),
    "settings": (changed(lambda data: data.update(settings=3)), "expected settings: a mapping, received 3"),
    "sums": (changed(lambda data: data["sums"].__setitem__(2, "many")), r"expected sums\[2\]: a whole number, rec"),
    "algorithm": (changed(lambda data: data.update(algorithm={})), "expected algorithm: a list of 9 values, received"),
    "scenario": (
        changed(lambda data: data["begun"][0][0][0][0][0][0].__setitem__(0, 12)),
        r"expected begun\[0\]\[0\]\[0\].*cell: a whole number from 1",
    ),
    "too few begun": (changed(lambda data: data["begun"].pop()), "sums: expected .* evaluated scenarios, rec"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_invalid_state_is_refused_and_left_unchanged(search, begun, fault):
    change, expected = FAULTS[fault]
    content = change(begun.read_text())
    begun.write_bytes(content if isinstance(content, bytes) else content.encode())
    before = begun.read_bytes()
    assert "delete the file" in refused(search, expected)
    assert begun.read_bytes() == before


@pytest.mark.parametrize(
    ("upgrade", "what"),
    [
        (changed(lambda data: data["settings"]["versions"].update(numpy="1.0")), "of other versions ({"),
        (changed(lambda data: data.update(version=2)), "of version 2 of its format, not "),
    ],
    ids=["numpy", "format"],
)
def test_search_begins_anew_after_an_upgrade(search, begun, upgrade, what):
    text = upgrade(begun.read_text())
    for number in (1, 2):
        begun.write_text(text)
        again = search(runs=4)
        kept = begun.with_suffix(f".old-{number}.json")
        (note,) = (each for each in again.summary.notes if each.startswith("began anew"))
        assert note.startswith(f"began anew, because the state is {what}")
        assert note.endswith(f"it is kept as {kept}")
        assert (again.summary.runs, kept.read_text()) == (4, text)
    assert not any(each.startswith("began anew") for each in search(runs=4).summary.notes)


@pytest.mark.parametrize(
    "secret",
    ['{"version": 10, "HUSH": "HUSH"}', '{"version": "HUSH"}', '"HUSH"', '["HUSH"]', "HUSH=1", '{"a": "\\HUSH"}'],
)
def test_content_of_invalid_state_is_never_printed(search, begun, secret):
    begun.write_text(secret)
    assert "HUSH" not in refused(search, "expected")


@pytest.mark.skipif(os.name == "nt", reason="links need rights on Windows")
@pytest.mark.parametrize("place", ["state", "lock", "folder", "corpus"])
def test_links_are_not_followed_for_state_or_corpus(search, begun, tmp_path, place):
    secret, folder = tmp_path / "secret", tmp_path / "elsewhere"
    secret.write_text('{"version": "HUSH"}')
    link = {"state": begun, "lock": begun.with_suffix(".lock"), "folder": begun.parent, "corpus": tmp_path / "corpus"}
    if place == "folder":
        begun.parent.rename(folder)
    elif place == "corpus":
        link["corpus"].mkdir()
        link["corpus"] /= "test_it"
        folder.mkdir()
    else:
        link[place].unlink(missing_ok=True)
    link[place].symlink_to(folder if place in ("folder", "corpus") else secret)
    before = [*folder.rglob("*")]
    assert "HUSH" not in refused(search, "received.* link")
    assert (secret.read_text(), [*folder.rglob("*")]) == ('{"version": "HUSH"}', before)
    assert link[place].is_symlink()


@pytest.mark.usefixtures("begun")
def test_too_large_state_file_is_refused_unread(search, monkeypatch):
    monkeypatch.setattr(state_file, "MAX_BYTES", 1000)
    refused(search, "expected at most 1000 bytes, received more")


def test_file_instead_of_folder_is_refused_with_hint(search, tmp_path):
    (tmp_path / "states").write_text("a file in the place of the folder")
    assert "there is a file where a folder should be: rename or delete it" in refused(
        search, "expected a file that can be"
    )


def test_unwritable_state_is_reported_without_ending_the_search(search, monkeypatch):
    def full(path, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(state_file, "write_whole", full)
    summary = search(runs=4).summary
    assert summary.runs == 4
    assert "expected to write the state of the search, received: No space left on device; free" in summary.notes[0]


def test_state_that_is_too_large_is_not_written(search, tmp_path, monkeypatch):
    monkeypatch.setattr(state_file, "MAX_BYTES", 100)
    assert "expected a state of at most 100 bytes" in search(runs=4).summary.notes[0]
    assert not list(tmp_path.glob("states/*"))


def test_an_algorithm_that_cannot_go_on_is_refused(search):
    text = refused(search, "--pafot-resume: expected an algorithm that can be resumed", algorithm="pafot")
    assert "received 'pafot'" in text


class Climbing(GenerationalSearch):
    """A user's own algorithm that can continue."""

    name = "climbing"

    def start(self, rng):
        return GenerationState()

    def propose(self, state, rng):
        return state, [sample(self.space, rng) for _ in range(self.population)]

    def stored(self, state):
        return plain(state)

    def restored(self, data):
        return from_plain(GenerationState, data)


class Unstorable(Climbing):
    def stored(self, state):
        return {"state": {state.generation}}


def test_algorithm_with_unstorable_state_is_refused_early(search, tmp_path):
    refused(
        search,
        "--pafot-resume: expected the method stored of Unstorable .*, received .*0.*searching",
        algorithm=Unstorable,
    )
    assert not list(tmp_path.glob("states/*"))


def test_an_algorithm_of_ones_own_goes_on(search):
    whole = search("whole", resume=None, runs=12, algorithm=Climbing)
    parts = [search(runs=6, algorithm=Climbing) for _ in range(2)]
    assert body(*[part.events for part in parts]) == body(whole.events)


class Repeating(Climbing):
    def propose(self, state, rng):
        return state, [sample(self.space, rng)] * self.population


def test_reused_scenarios_cost_later_sessions_no_runs(search):
    given = {"algorithm": Repeating, "holds": lambda run: None}
    first, last = search(runs=2, **given), search(runs=1, **given).summary
    assert sum(isinstance(event, Evaluated) for event in first.events) > 2
    assert (last.runs, last.budget) == (3, 3)
    assert last.notes[0] == "resumed after 2 runs of earlier sessions"


def test_function_parameter_of_algorithm_works_across_processes(search, tmp_path):
    @dataclass(frozen=True)
    class Guided(Climbing):
        guide: Callable = field(default=constant_speed.make, kw_only=True)

    search(runs=4, algorithm=Guided)
    told = json.loads(state_of(tmp_path).read_text())["settings"]["algorithm"]["guide"]
    assert told == "example_ads.constant_speed:make"
