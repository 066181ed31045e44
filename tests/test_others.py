"""Each failure on the page about policies of others happens as its sentences say, without this package.

The policies that only a clone has need the folder of the clones as ``PAFOT_CLONES``.
"""

import importlib.util
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SECTIONS = runpy.run_path(str(ROOT / "docs" / "tools" / "others.py"))["sections"]()
CLONES = Path(os.environ.get("PAFOT_CLONES", ROOT))
WITHOUT_PICTURES = """\
from metadrive.engine.base_engine import BaseEngine

BaseEngine.try_pull_asset = lambda engine: None
"""
"""MetaDrive downloads models and textures at its first start, which a run without pictures does not need."""


def numbers(text):
    return {float(each) for each in re.findall(r"(?<![\w.^])\d+(?:\.\d+)?", text)}


def absent(code):
    """Return the libraries and the files of clones that a program needs and that are not here."""
    libraries = set(re.findall(r"^(?:from|import) (\w+)", code, re.MULTILINE))
    missing = sorted(each for each in libraries if importlib.util.find_spec(each) is None)
    return missing + [
        each for each in re.findall(r'load\("(.*?)"', code) if not (CLONES / each).exists()
    ]


def test_ten_policies_have_a_picture_three_sentences_and_a_short_program_of_their_own():
    assert len(SECTIONS) == 10
    for name, (said, code) in SECTIONS.items():
        assert (ROOT / f"docs/explanation/others/{name}.svg").stat().st_size < 60_000
        assert len(re.findall(r"[.] |[.]$", said.replace("\n", " "))) == 3, said
        assert len([line for line in code.splitlines() if line]) <= 20
        assert "pafot" not in code


@pytest.mark.stories
@pytest.mark.parametrize("name", SECTIONS)
def test_failure_happens_with_the_numbers_of_its_sentences(name):
    said, code = SECTIONS[name]
    if missing := absent(code):
        pytest.skip(f"needs {', '.join(missing)}")
    command = [sys.executable, "-c", WITHOUT_PICTURES + code if "metadrive" in code else code]
    done = subprocess.run(
        command, cwd=CLONES, capture_output=True, text=True, check=False, timeout=300
    )
    printed = done.stdout.strip().rpartition("\n")[2]
    assert done.returncode == 0, done.stderr
    assert f"<title>{printed}</title>" in (ROOT / f"docs/explanation/others/{name}.svg").read_text(
        encoding="utf-8"
    )
    measured = {each for each in numbers(said) if each not in numbers(code)}
    assert measured <= numbers(printed), printed
    assert numbers(printed) & numbers(said)
