"""Make the pictures of report pages in README.md, start/tutorial.md and guide/triage.md.

It runs searches of a sample and of two example policies, opens their pages in a headless Chromium, light and dark, and
saves screenshots. ``report_picture.py crash`` makes one alone; the search of ``report-fiss`` takes minutes. It
needs Chromium, and Pillow and fiss-planner in addition to the plugin:
``python -m pip install ".[fiss]" pillow && python docs/tools/report_picture.py``.
"""

from __future__ import annotations

import base64
import io
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
sys.path.insert(0, str(ROOT))

from tests.helpers.browser import Browser, Page, find_chromium  # noqa: E402

MAX_BYTES = 250_000


class Story(NamedTuple):
    """One picture and the search behind it.

    Attributes:
        name: the name of the picture.
        test: node id of the search.
        options: its further options.
        sample: the file of the test, if it is alone in a folder.
        size: width and height of the window [px].
        before: the time of the picture before the event [s], at which the vehicles may still be apart.
    """

    name: str
    test: str
    options: tuple[str, ...]
    sample: Path | None = None
    size: tuple[int, int] = (1280, 1300)
    before: float = 0.9


STORIES = (
    Story(
        "crash",
        "test_cruise.py",
        ("--pafot-seed=1",),
        DOCS / "start" / "test_cruise.py",
        (1100, 758),
        0.0,
    ),
    Story(
        "report-constant-speed",
        "example_ads/test_safety.py::test_never_at_fault_in_a_collision[constant-speed-search]",
        ("--pafot-runs=80", "--pafot-seed=8"),
    ),
    Story(
        "report-fiss",
        "example_ads/test_safety.py::test_fiss_is_never_at_fault_in_a_collision[search]",
        ("--pafot-runs=80", "--pafot-seed=1"),
    ),
)


def search(story: Story, folder: Path) -> Path:
    """Run a search, and return its page."""
    page, place = folder / f"{story.name}.html", ROOT
    if story.sample is not None:
        place = folder / "project"
        place.mkdir()
        shutil.copy(story.sample, place)
    command = [
        *(sys.executable, "-m", "pytest", story.test, "-p", "no:randomly", "-q"),
        *("--tb=no", f"--pafot-corpus={folder / 'corpus'}", f"--pafot-report={page}"),
        *story.options,
    ]
    return written(page, command, place)


def written(path: Path, command: Sequence[str], place: Path = ROOT) -> Path:
    """Run a command in a folder that writes a file, and return the path of the file."""
    environment = {
        name: value for name, value in os.environ.items() if name not in ("CI", "PYTEST_ADDOPTS")
    }
    environment["PYTHONPATH"] = os.pathsep.join(
        filter(None, [str(ROOT), environment.get("PYTHONPATH")])
    )
    done = subprocess.run(  # noqa: S603
        command, cwd=place, env=environment, capture_output=True, text=True, check=False
    )
    if not path.is_file():
        raise SystemExit(
            f"{command}: expected {path.name}, received this:\n{done.stdout}{done.stderr}"
        )
    return path


def shots(browser: Browser, page: Path, story: Story) -> Iterator[tuple[str, bytes]]:
    """Yield the suffix and the content of each picture of a page."""
    for scheme in ("light", "dark"):
        media = [("prefers-color-scheme", scheme), ("prefers-reduced-motion", "reduce")]
        opened = browser.open(page.as_uri(), width=story.size[0], height=story.size[1], media=media)
        _prepare(opened, story.before)
        shot = opened.send("Page.captureScreenshot", format="png")
        opened.close()
        yield "" if scheme == "light" else "-dark", _small(base64.b64decode(shot["data"]))


def _prepare(page: Page, before: float) -> None:
    """Go to the moment so long before the event [s], and remove paths of this machine and the date from the page."""
    page.evaluate(
        "for (const each of document.querySelectorAll('.searches .copyline, .searchs dl div'))"
        "  if (each.matches('.copyline') || each.textContent.startsWith('written')) each.remove();"
        "document.querySelector('h1').textContent = document.querySelector('h1').textContent.replace(/^.*: /, '');"
    )
    if not before:
        return
    shown = "Number(document.querySelector('article.current .player').dataset.time)"
    key = page.evaluate("document.querySelector('#list a[aria-current=true]').dataset.key")
    moment = round(page.evaluate(shown) - before, 2)
    page.evaluate(f"location.hash = 'finding={key}&t={moment}'")
    page.until(f"{shown} === {moment}")
    time.sleep(0.3)


def _small(content: bytes) -> bytes:
    """Return the same picture with as many colours as fit into the size."""
    image = Image.open(io.BytesIO(content)).convert("RGB")
    for colours in (256, 128, 64, 32):
        stream = io.BytesIO()
        image.quantize(colours, dither=Image.Dither.NONE).save(stream, "png", optimize=True)
        if stream.tell() <= MAX_BYTES:
            return stream.getvalue()
    raise SystemExit(f"expected a picture of at most {MAX_BYTES} bytes, received {stream.tell()}")


def main() -> None:
    """Write the pictures that are named as arguments, or all."""
    names = [story.name for story in STORIES]
    chosen = sys.argv[1:] or names
    if not set(chosen) <= set(names):
        raise SystemExit(f"expected {', '.join(names)}, received {' '.join(chosen)}")
    chromium = find_chromium()
    if chromium is None:
        raise SystemExit("expected chromium or google-chrome on PATH, found none")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        browser = Browser(chromium, folder / "profile")
        try:
            for story in (each for each in STORIES if each.name in chosen):
                for suffix, content in shots(browser, search(story, folder), story):
                    save(f"{story.name}{suffix}.png", content)
        finally:
            browser.close()


def save(name: str, content: bytes) -> None:
    """Write a picture of the documents."""
    (DOCS / name).write_bytes(content)
    print(f"{name}: {len(content)} bytes")


if __name__ == "__main__":
    main()
