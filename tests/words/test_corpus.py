"""What is said of saved scenarios that cannot be read or written."""

import os
from pathlib import Path

import yaml

from pytest_pafot.corpus.reader import load, located, parse, parsed, saved_in
from pytest_pafot.corpus.writer import rewrite, text_of, write
from pytest_pafot.world import Highway
from tests.corpus import test_instructions as instructions
from tests.corpus.test_reader import (
    BROKEN,
    LOCATED,
    NAME,
    NESTED,
    NO_DOCUMENTS,
    NO_FILES,
    SECRETS,
    TEXT,
    swapped,
)
from tests.corpus.test_writer import FAILURES
from tests.findings.builders import plain_finding
from tests.helpers.refusals import error_of


def refused(content, path=Path(NAME)):
    # PyYAML's other parser has other words for what is no YAML
    content = content.encode() if isinstance(content, str) else content
    return error_of(parsed, path, content, yaml.SafeLoader)


def test_each_broken_rule_of_a_saved_scenario_is_told_with_its_remedy(snapshot):
    told = {f"{old} -> {new}": refused(swapped(old, new)) for old, new, *_ in BROKEN}
    told |= {
        f"{old} -> {new}": refused(text.replace(old, new), instructions.PATH)
        for text, old, new, _ in instructions.BROKEN
    }
    world = {**Highway().to_dict(), "ego": {"name": "bus", "length": 12.0}}
    told["ego"] = refused(text_of(plain_finding(world=world)))
    late = swapped("pafot: 3", "#").replace("seed: 7", "seed: oops") + "pafot: 3\n"
    told["version at the end"] = refused(late)
    for number, (part, error, *_) in enumerate(LOCATED):
        told[f"{number}: {error}"] = located(Path(NAME), part, error)
    assert told == snapshot


def test_what_is_no_saved_scenario_is_told_without_its_content(snapshot, tmp_path):
    told = {f"{content[:60]}": refused(content) for content, _ in NO_DOCUMENTS}
    told |= {name: refused(content) for name, content in SECRETS.items()}
    told["nested"] = refused(NESTED)
    told["values"] = refused(f"pafot: 3\nworld: {{kind: own, data: [{'1,' * 40_000}]}}\n")
    told["a.yaml"] = refused(TEXT, Path("a.yaml"))
    told["run.xosc"] = error_of(parse, Path("run.xosc"), b"<OpenSCENARIO/>")
    for name, make in NO_FILES.items():
        path = tmp_path / name.replace(" ", "-") / NAME
        path.parent.mkdir()
        make(path)
        told[name] = error_of(load, path)
    place = tmp_path / "pafot_corpus" / "test_it" / "test_it" / NAME
    place.parent.mkdir(parents=True)
    place.symlink_to(tmp_path / "secret")
    told["link out of the corpus"] = error_of(load, place)
    place.unlink()
    place.write_text("pafot: 4")
    told["in a corpus"] = saved_in(place.parent)[0].error
    assert told == snapshot


def test_failed_write_suggests_a_remedy_for_its_cause(snapshot, tmp_path, monkeypatch):
    path, told = tmp_path / "corpus" / NAME, {}
    told["too large"] = error_of(write, path, plain_finding(test="t" * 300_000))
    (tmp_path / "file").touch()
    told["no folder"] = error_of(write, tmp_path / "file" / NAME, plain_finding())
    path.parent.mkdir()
    path.write_text("the user is editing this")
    told["unreadable"] = error_of(rewrite, path, plain_finding())
    path.unlink()
    for number in FAILURES:

        def fail(descriptor, number=number):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fail)
        told[os.strerror(number)] = error_of(write, path, plain_finding())
    assert told == snapshot
