"""What the fixtures give."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pytest_pafot.corpus import layout

if TYPE_CHECKING:
    from pytest_pafot.findings.finding import Finding
    from pytest_pafot.run import Run
    from pytest_pafot.scenario import Scenario


class Simulate(Protocol):
    """What the fixture ``pafot_simulate`` gives."""

    def __call__(self, scenario: Scenario, ads_factory: Callable[[], Any], world: Any = None) -> Run:
        """One run of a scenario; without a world in that of the fixture ``pafot_world``."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Corpus:
    """What the fixture ``pafot_corpus`` gives: the saved scenarios of the module that asks for it.

    Attributes:
        folder: in which a folder for each test lies; it may not exist.
    """

    folder: Path

    def __iter__(self) -> Iterator[Finding]:
        """Every finding, by test and id.

        Raises:
            CorpusError: for a file that cannot be read.
        """
        from pytest_pafot.corpus.reader import load  # noqa: PLC0415

        for path in self.paths:
            yield load(path)

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def paths(self) -> list[Path]:
        """Of the files."""
        return sorted(self.folder.glob(f"*/*{layout.SUFFIX}"))
