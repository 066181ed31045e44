"""What version 0.1.0 stored still replays with the same labels.

``stored`` has searches of roads, junctions and SUMO, their saved scenarios (one accepted, one flaky, one expected to
fail, one fixed, one found with another numpy), and the JSON file and the report page of a session that replays them.
A later version may add keys to the JSON file. If it removes a key or changes a meaning, the version of the file
increases, and the changelog says what changes for users.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# these decide what a session prints, and how it ends
SETTINGS = ("CI", "COLUMNS", "GITHUB_STEP_SUMMARY", "PYTEST_ADDOPTS")
STORED = Path(__file__).with_name("stored")
CHANGELOG = Path(__file__).parents[2] / "docs" / "changelog.md"
BEFORE = json.loads((STORED / "replayed.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def now(tmp_path_factory):
    """Replay the stored scenarios, and return the JSON file and the page of the session."""
    folder = tmp_path_factory.mktemp("upgrade")
    shutil.copytree(STORED / "corpus", folder / "pafot_corpus")
    shutil.copy(STORED / "saved.py", folder / "test_saved.py")
    (folder / "pytest.ini").write_text("[pytest]\n")
    options = ["--pafot-runs=0", "--pafot-json=now.json", "--pafot-report=page.html"]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-p",
            "no:randomly",
            *options,
        ],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if name not in SETTINGS},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == BEFORE["exit"], done.stdout + done.stderr
    session = json.loads((folder / "now.json").read_text("utf-8"))
    return session, (folder / "page.html").read_text("utf-8")


def by_node_id(session, *keys):
    return {each["node_id"]: [each[key] for key in keys] for each in session["findings"]}


def test_stored_scenarios_get_the_same_labels(now):
    session, _ = now
    keys = ("id", "status", "result", "signature", "responsible")
    assert by_node_id(session, *keys) == by_node_id(BEFORE, *keys)
    assert {each["status"] for each in BEFORE["findings"]} == {
        *("still failing", "accepted", "passes", "drifted")
    }


def test_the_json_file_has_all_keys_of_its_version(now):
    session, _ = now
    if session["pafot_json"] != BEFORE["pafot_json"]:
        assert f"`pafot_json` {session['pafot_json']}" in CHANGELOG.read_text("utf-8")
        return
    assert not BEFORE.keys() - session.keys()
    for before, each in zip(BEFORE["findings"], session["findings"], strict=True):
        assert not before.keys() - each.keys()


def test_the_page_names_the_same_failures(now):
    _, page = now
    before = (STORED / "page.html").read_text("utf-8")
    ids = [each["id"] for each in BEFORE["findings"] if each["result"] != "passed"]
    for id_ in ids:
        assert id_ in page
        assert id_ in before
    assert len(re.findall("<h2", page)) == len(re.findall("<h2", before))
