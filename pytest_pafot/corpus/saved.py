"""The reading of corpus files at collection, which does not fail for a file that cannot be read."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pytest_pafot.corpus.layout import SUFFIX, files_below, files_in, refusal
from pytest_pafot.support.errors import CorpusError, command
from pytest_pafot.support.text import visible

if TYPE_CHECKING:  # sessions without saved scenarios do not import findings
    from pytest_pafot.findings.finding import Finding


class Saved(NamedTuple):
    """A corpus file as collected, with its finding, or with an error that says why the file cannot be read."""

    path: Path
    finding: Finding | None = None
    error: str = ""

    @classmethod
    def read(cls, path: Path) -> Saved:
        """Read a corpus file. If that fails, the error is stored, and the file's item reports it when it runs."""
        from pytest_pafot.corpus.reader import load  # noqa: PLC0415  (yaml, which few sessions need)

        try:
            return cls(path=path, finding=load(path))
        except (CorpusError, OSError) as error:
            return cls(path=path, error=str(error))

    @property
    def id(self) -> str:
        """The id of the finding, which is the file's name without its suffix."""
        return self.path.name.removesuffix(SUFFIX)

    @property
    def xfail(self) -> str | None:
        """The reason why the failure is accepted; None if it is not accepted."""
        return None if self.finding is None else self.finding.xfail

    def is_accepted(self, today: date) -> bool:
        """Return whether the failure is accepted (``xfail``) on a day."""
        return self.finding is not None and self.finding.is_accepted(today)

    @property
    def is_crash(self) -> bool:
        """True if a process died in this scenario."""
        return self.finding is not None and self.finding.expect.is_crash

    @property
    def needs_own_process(self) -> bool:
        """True if a run of this scenario may end the process, never end, or use up all memory."""
        expect = None if self.finding is None else self.finding.expect
        return expect is not None and (self.is_crash or expect.outcome == "hang" or expect.failure == "MemoryError")

    def __repr__(self) -> str:
        return visible(f"<saved {self.id}>")


def named_file(given: str) -> Path:
    """Return the file of a saved scenario, given its path, its id, or the name of its item as pytest prints it.

    Raises:
        CorpusError: if there is no such file below the current folder, or more than one.
    """
    import difflib  # noqa: PLC0415  (of a command)

    if (path := Path(given)).is_file():
        return path
    name = given.rpartition("[")[2].removesuffix("]").removeprefix("saved-").removesuffix(SUFFIX)
    files = {file: file.name.removesuffix(SUFFIX) for file in files_below(Path())}
    found = [file for file, other in files.items() if other == name]
    if len(found) == 1:
        return found[0]
    expected = "the file of a saved scenario, or the id of a saved scenario below the current folder"
    if found:
        fix = f"give one of the files: {', '.join(map(str, found))}"
        raise CorpusError(path, expected, f"an id that {len(found)} files have", fix)
    names = list(dict.fromkeys(files.values()))
    near = [each for each in names if name in each] or difflib.get_close_matches(name, names)
    fix = (
        f"did you mean {' or '.join(near[:3])}?"
        if near
        else f"`{command('pytest_pafot', 'corpus', 'list')}` lists the files"
    )
    raise CorpusError(path, expected, "no such file or id", fix)


def saved_in(folder: Path) -> list[Saved]:
    """Read all corpus files in a folder; return them, sorted by id."""
    return [Saved.read(path) for path in files_in(folder)]


def refused_in(folder: Path, link: Path) -> list[Saved]:
    """Return the files of a folder as unreadable, because the folder is behind a link that leads out of the project."""
    return [Saved(path=path, error=f"{path}: {refusal(link)}") for path in files_in(folder)]
