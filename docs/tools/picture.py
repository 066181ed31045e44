"""Make terminal.svg, the picture in the README, from the real output of a session.

It writes the two files of the README into an empty folder, runs the README's command there and renders the terminal's
output. It needs rich in addition to the plugin: ``python -m pip install rich && python docs/tools/picture.py``.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.terminal_theme import TerminalTheme
from rich.text import Text

README = Path(__file__).parents[2] / "README.md"
PICTURE = Path(__file__).parents[1] / "terminal.svg"
COLUMNS = 104

_FILE = re.compile(r"```python\n# (\S+)\n(.*?)```", re.DOTALL)
_COMMAND = re.compile(r"```console\n\$ (pytest .*)\n")

PALE, DARK = (205, 210, 218), (24, 27, 33)
NORMAL = [DARK, (240, 98, 98), (126, 198, 120), (226, 192, 106), (108, 168, 240), (198, 132, 226), (96, 196, 204), PALE]
GREY, WHITE = (110, 118, 130), (255, 255, 255)
THEME = TerminalTheme(DARK, PALE, NORMAL, [GREY, *NORMAL[1:7], WHITE])

SVG = """<svg class="rich-terminal" viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg">
<style>
.{unique_id}-matrix {{
  font-family: ui-monospace, SFMono-Regular, Menlo, Consolas, "DejaVu Sans Mono", "Liberation Mono", monospace;
  font-size: {char_height}px; line-height: {line_height}px;
}}
{styles}
</style>
<defs>
<clipPath id="{unique_id}-clip-terminal">
<rect x="0" y="0" width="{terminal_width}" height="{terminal_height}" />
</clipPath>
{lines}
</defs>
{chrome}
<g transform="translate({terminal_x}, {terminal_y})" clip-path="url(#{unique_id}-clip-terminal)">
{backgrounds}
<g class="{unique_id}-matrix">
{matrix}
</g>
</g>
</svg>
"""
"""The frame of the picture. It uses no web fonts, because code hosts do not load them."""


def session(folder: Path) -> str:
    """Return the terminal output of the README's first command, with colours and without pytest's header."""
    text = README.read_text(encoding="utf-8")
    for name, content in _FILE.findall(text):
        (folder / name).write_text(content, encoding="utf-8")
    found = _COMMAND.search(text)
    if found is None:
        raise SystemExit(f"{README}: expected a console block that begins with `$ pytest`, found none")
    arguments = shlex.split(found[1])[1:]
    quiet = ["--color=yes", "--no-header", "-p", "no:sugar", "-p", "no:randomly"]
    environment = {name: value for name, value in os.environ.items() if name not in ("CI", "BUILD_NUMBER")}
    command = [sys.executable, "-m", "pytest", *arguments, *quiet]
    environment["COLUMNS"] = str(COLUMNS)
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)  # noqa: S603
    if "saved as" not in done.stdout:
        raise SystemExit(f"{found[1]}: expected a finding, received this:\n{done.stdout}{done.stderr}")
    return f"\033[1;32m$\033[0m \033[1m{found[1]}\033[0m\n{done.stdout}"


def picture(output: str) -> str:
    """Return an SVG of a terminal with this output."""
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        console = Console(record=True, width=COLUMNS, file=nowhere, color_system="truecolor", force_terminal=True)
        console.print(Text.from_ansi(output.rstrip()), soft_wrap=False, no_wrap=False, highlight=False)
        return console.export_svg(title="", theme=THEME, code_format=SVG, unique_id="pafot")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        PICTURE.write_text(picture(session(Path(folder))), encoding="utf-8", newline="\n")
