"""Snapshots of the complete texts that users see: only the tests in this folder check the wording.

``pytest tests/words --snapshot-update`` rewrites the snapshots; read the differences before you commit them. A test
compares a string, an exception, or a table of these by name: ``assert {"too slow": text, ...} == snapshot``.
"""

import re
import sys
from datetime import date
from pathlib import Path

import pytest

# Sessions of the plugin run in the same small project as in tests/plugin.
from tests.plugin.conftest import *  # noqa: F403

ROOT = Path(__file__).parents[2]
PACKAGES = "gymnasium|highway-env|hypothesis|numpy|pluggy|pytest|pytest-pafot|python|Python|PyYAML"
CHANGES = [
    # pytest's own lines: the header, rules as wide as the terminal, the progress, and how long the session took
    (r"^(platform|rootdir:|configfile:|plugins:|cachedir:|Using --randomly-seed).*\n", ""),
    (r"([=_!-])\1{3,}", r"\1\1\1"),
    (r" +\[ *\d+%\]$", ""),
    (r"\bin \d+\.\d+s( \([\d:]+\))?", "in TIME"),
    (r"\btook [\d.,]+ (ms|s|min|h)\b", "took TIME"),
    (r"\b(pid|process) \d+", r"\1 N"),
    (r"\S+\.inflight\b", "RECORD.inflight"),
    (r"(\.\./)*\bpafot-\w{8}/", "TEMPORARY/"),
    (r"\b0x[0-9a-f]{6,}", "0xADDRESS"),
    (r"\bVehicle #\d+", "Vehicle #N"),  # highway-env numbers vehicles by their addresses
    (r"\bTODAY \d\d:\d\d(:\d\d)? UTC", "NOW"),
    (rf"\b({PACKAGES})([\s-]|==)\d+(\.\w+)+", r"\1\2VERSION"),
    (r"^pafot: .* \d+/\d+ runs, .*\n", ""),  # the progress, which only slow searches show
    (r"^(pafot: kernel) .*", r"\1 KIND"),  # compiled or interpreted
    # Python before and after 3.13 underlines other parts of a line. Compiled modules have other tracebacks.
    (r"^[E ]*[ ~^]*[~^]{2}[ ~^]*\n", ""),
    (r"ROOT/pytest_pafot/\S+\.py:\d+", "ROOT/pytest_pafot/MODULE.py:LINE"),
    (r"^( +ROOT/pytest_pafot/MODULE.py:LINE: .*Warning: .*\n) +.*\n", r"\1"),
    (r'^[E ]*File "[^"]*(pytest_pafot|site-packages)/[^"]*", line \d+, in .*\n([E ] {3,}.*\n)?', ""),
]  # fmt: skip
"""Regular expressions for what differs between machines, and what replaces it."""


def normal(text: str, folders: Path) -> str:
    """Return a text with placeholders for all paths, times and numbers that differ between machines.

    Args:
        text: What a user would see.
        folders: The folder of the temporary folders of all tests.
    """
    text = re.sub(rf"(/private)?{re.escape(str(folders))}/[^/\s:'\"`]+", "FOLDER", text)
    for path, name in ((ROOT, "ROOT"), (sys.prefix, "PREFIX"), (date.today(), "TODAY")):
        text = text.replace(str(path), name)
    for pattern, placeholder in CHANGES:
        text = re.sub(pattern, placeholder, text, flags=re.MULTILINE)
    return text


@pytest.fixture(autouse=True)
def outside_of_ci(monkeypatch):
    """Let sessions end as on a user's machine: pytest does not shorten its summary in CI."""
    for name in ("CI", "BUILD_NUMBER"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def snapshot(snapshot, tmp_path_factory):
    """Return the snapshot of this test, with which strings and exceptions are compared in their normal form."""

    def normalise(data, path):
        if isinstance(data, BaseException):
            data = f"{type(data).__name__}: {data}"
        is_text = isinstance(data, str)
        return normal(data, tmp_path_factory.getbasetemp()) if is_text else data

    return snapshot.with_defaults(matcher=normalise)
