"""The inventory of saved scenarios whose test is gone; pytest collects it."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import visible_lines

SHOWN = 20  # the largest number of lines of pytest's output that an error repeats


@dataclass(frozen=True, slots=True, kw_only=True)
class Inventory:
    """What pytest collects in the current folder.

    Attributes:
        root: the rootdir, to which all paths are relative.
        orphans: the saved scenarios whose test is gone, by path, each with what was expected.
        problem: why some files are not known; empty if all were collected.
    """

    root: Path
    orphans: Mapping[str, str] = field(default_factory=dict)
    problem: str = ""

    @classmethod
    def collected(cls, arguments: Sequence[str] = ()) -> Self:
        """Let pytest collect the tests in a process of its own, and return what it found.

        ``arguments`` are arguments of pytest, such as folders of tests.

        Raises:
            RequestError: if pytest did not come to an end.
        """
        with tempfile.TemporaryDirectory() as folder:
            told = Path(folder) / "inventory.json"
            plugins = ["-p", "pafot", "-p", "pytest_pafot.plugin.inventory_session", f"--inventory-to={told}"]
            command = [sys.executable, "-m", "pytest", *plugins, "--collect-only", "-qq", "--color=no", *arguments]
            ended = subprocess.run(command, check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)  # noqa: S603
            output = "\n".join(ended.stdout.decode(errors="replace").splitlines()[-SHOWN:])
            if not told.is_file():
                said = (
                    f":\n{visible_lines(output)}" if output else " no output; a conftest.py or a test file may end it"
                )
                raise RequestError(
                    f"expected pytest to collect the tests here, received exit code {ended.returncode} and{said}"
                )
            data = json.loads(told.read_text(encoding="ascii"))
        return cls(
            root=Path(data["root"]),
            orphans=data["orphans"],
            problem=visible_lines(output) if data["failed"] else "",
        )
