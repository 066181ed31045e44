"""The state of a search in one JSON file: everything on which its continuation depends.

The random numbers of a generation follow from the seed and the generation's number, so none are stored. The file is
untrusted data: its size is limited, it is checked, and it can affect only how a search goes on.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TypeVar

from pytest_pafot.corpus.layout import safe_name
from pytest_pafot.searching.ask_tell import ResumableSearch
from pytest_pafot.searching.evaluation import Evaluation, Remembered
from pytest_pafot.searching.events import CampaignFinished
from pytest_pafot.searching.plain import from_plain, plain
from pytest_pafot.searching.plan import Checkpoint
from pytest_pafot.support.errors import FieldError, RequestError, flag
from pytest_pafot.support.files import hold, open_regular, way_out, write_whole
from pytest_pafot.support.text import differences, visible

VERSION = 10
"""The version of the state's format. With a state of any other version a search begins anew."""

MAX_BYTES = 1 << 28
"""The largest state that is written or read [bytes]. Ten thousand runs of four NPCs take about 10 MB."""

LOCK = ".lock"
"""The suffix of the lock file next to a state. The lock file exists while a session uses the state."""

SHARE = 50
"""The shortest time from one write of the state to the next, as a multiple of the time for a write.

So writing takes at most 2 % of the session. The time to convert new runs to text is not included, because each run is
converted only once.
"""

T = TypeVar("T")

FLAG = flag("resume")
ANEW = f"delete the file to start the search from scratch, or give another folder with {FLAG}"
PARTS = ("version", "settings", "algorithm", "sums", "begun", "counts", "remembered")


def state_path(folder: Path, node_id: str) -> Path:
    """Return the path of the state of a test's search in the folder of states."""
    return folder / f"{safe_name(node_id)}.json"


@dataclass(slots=True, kw_only=True)
class StateFile:
    """The state of one search on disk.

    Attributes:
        path: the path of the file.
        settings: the settings that the state must have, as plain data.
        algorithm: the algorithm of the search.
        clock: returns the seconds since some fixed moment.
        problem: why the last write failed; empty if it did not fail.
        anew: why the search begins anew although there was a state, and where that is now; empty otherwise.
    """

    path: Path
    settings: Mapping[str, Any]
    algorithm: ResumableSearch
    clock: Callable[[], float]
    problem: str = ""
    anew: str = ""
    _claim: BinaryIO | None = None  # an empty, locked file next to the state
    _texts: dict[int, tuple[Remembered, str]] = field(default_factory=dict)  # texts of remembered runs, by identity
    _written_at: float = -math.inf
    _cost: float = 0.0

    def claim(self) -> None:
        """Lock the state against other sessions. If two sessions used it, one of them would undo the other's work.

        Raises:
            RequestError: if another session uses the state, or if the lock file is a link.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = open_regular(self.path.with_suffix(LOCK), "ab")
        except OSError as error:
            if error.errno == errno.EINVAL:
                raise self._unreadable(self.path.with_suffix(LOCK), error) from None
            return  # Nothing can be written here; writing the state reports that.
        if not hold(file.fileno(), is_inherited=False):  # not inherited: a worker of a killed session must not hold it
            file.close()
            raise RequestError(
                f"{self.path}: expected a search that no other session runs now, received one that is running; wait "
                f"until that session has ended, or give another folder with {FLAG}"
            )
        self._claim = file

    def release(self) -> None:
        """Release the state for other sessions."""
        if self._claim is None:
            return
        path = self.path.with_suffix(LOCK)
        with suppress(OSError), self._claim:
            if os.name != "nt":
                path.unlink()  # while it is locked, so that no other session locks a file that is then removed
        if os.name == "nt":
            with suppress(OSError):  # Windows cannot remove an open file, such as one that a new session has locked.
                path.unlink()

    def read(self, kind: type[T]) -> tuple[T, Checkpoint[Any]] | None:
        """Return the counts, as a value of a class, and the checkpoint of the plan.

        None if there is no state yet, or only one of other versions.

        Raises:
            RequestError: if the file is not a state, belongs to another search, or cannot be read.
        """
        try:
            # Anyone may have written the file: it may be a pipe, or larger than the memory.
            with open_regular(self.path) as file:
                content = file.read(MAX_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._unreadable(self.path, error) from None
        if len(content) > MAX_BYTES:
            self._refuse(f"at most {MAX_BYTES} bytes", "more")
        json_of_state = "the JSON of a search's state"
        try:
            data = json.loads(
                content,
                parse_constant=lambda name: self._refuse(json_of_state, f"{name}, which is not a number in JSON"),
            )
        except json.JSONDecodeError as error:
            self._refuse(json_of_state, f"invalid JSON in line {error.lineno}")
        except (ValueError, RecursionError) as error:  # only its type, because its text may quote the file
            self._refuse(json_of_state, type(error).__name__)
        if not isinstance(data, dict):
            self._refuse("a mapping", f"a {type(data).__name__}")
        version, settings = data.get("version"), data.get("settings")
        if not isinstance(version, int):  # The file may be a secret, so its content is not printed.
            self._refuse(f"a state of version {VERSION}", "version unknown")
        # Other versions drive other runs. That is no error of the user, so the search begins again, with a note.
        then = settings.get("versions") if isinstance(settings, dict) else None
        if version != VERSION or (then is not None and then != self.settings["versions"]):
            of_format = f"of version {version} of its format, not {VERSION}"
            self._begin_anew(of_format if version != VERSION else f"of other versions ({visible(f'{then!r:.200}')})")
            return None
        if set(data) != set(PARTS):
            self._refuse(f"the keys {', '.join(PARTS)}", "others")
        if not isinstance(data["settings"], dict):
            self._refuse("settings: a mapping", f"{data['settings']!r:.60}")
        # Of the same versions, other settings are a mistake: what was found before would not be found by this search.
        differ = differences("", data["settings"], self.settings)
        if differ:
            self._refuse("the state of this search", f"one that differs: {'; '.join(differ)}")
        checkpoint = Checkpoint(
            state=self._part(data, "algorithm", self.algorithm.restored),
            sums=self._part(data, "sums", partial(from_plain, CampaignFinished)),
            begun=self._part(data, "begun", partial(from_plain, tuple[tuple[Evaluation, bool], ...])),
            remembered=self._part(data, "remembered", partial(from_plain, tuple[Remembered, ...])),
        )
        return self._part(data, "counts", partial(from_plain, kind)), checkpoint

    @property
    def is_due(self) -> bool:
        """True unless writing the state now would take too large a share of the time."""
        return self.clock() - self._written_at >= SHARE * self._cost

    def write(self, checkpoint: Checkpoint[Any], counts: object) -> None:
        """Write the state, as a whole or not at all. An error of the file system is only reported.

        Raises:
            RequestError: if an algorithm stores data that JSON cannot represent.
        """
        known, self._texts = self._texts, {}
        for run in checkpoint.remembered:
            # Convert each run to text only once: there may be ten thousand, of which few are new.
            self._texts[id(run)] = known.get(id(run)) or (run, _json(plain(run)))
        began = self.clock()
        parts = {
            "version": VERSION,
            "settings": self.settings,
            "sums": plain(replace(checkpoint.sums, seconds=0.0)),
            "begun": plain(checkpoint.begun),
            "counts": plain(counts),
        }
        lines = [f"{json.dumps(name)}: {_json(part)}" for name, part in parts.items()]
        remembered = ",\n".join(text for _, text in self._texts.values())
        data = self.algorithm.stored(checkpoint.state)
        try:
            lines += [f'"algorithm": {_json(data)}', f'"remembered": [{remembered}]']
        except (TypeError, ValueError) as error:
            raise RequestError(
                f"{FLAG}: expected the method stored of {type(self.algorithm).__name__} to return data for JSON, "
                f"received {data!r:.100} ({error}); see pytest_pafot.searching.plain"
            ) from None
        content = ("{" + ",\n".join(lines) + "}\n").encode()
        try:
            if len(content) > MAX_BYTES:
                self.problem = f"{self.path}: expected a state of at most {MAX_BYTES} bytes, received {len(content)}"
            else:
                write_whole(self.path, content)
                self.problem = ""
        except OSError as error:
            reason, fix = error.strerror or error, way_out(error, f"or give another folder with {FLAG}")
            self.problem = f"{self.path}: expected to write the state of the search, received: {reason}; {fix}"
        self._written_at = self.clock()
        self._cost = self._written_at - began

    def _begin_anew(self, what: str) -> None:
        """Rename the state, because no search can resume the state of other versions.

        An upgrade is no mistake of the user, and a refusal would leave every night without a search. The state is not
        removed, since it alone knows findings that were not saved.
        """
        names = (self.path.with_suffix(f".old-{number}.json") for number in count(1))
        aside = next(name for name in names if not os.path.lexists(name))
        try:
            self.path.rename(aside)
        except OSError as error:
            raise self._unreadable(self.path, error) from None
        self.anew = f"began anew, because the state is {what}; it is kept as {aside}"

    def _part(self, data: Mapping[str, Any], name: str, read: Callable[[Any], Any]) -> Any:
        try:
            return read(data[name])
        except FieldError as error:
            self._refuse(f"{name}{error.field}: {error.expected}", error.received)
        except (ValueError, TypeError, LookupError) as error:  # raised by the user's own algorithm
            self._refuse(f"{name}: data that can be restored", f"{type(error).__name__}: {error!s:.100}")

    def _unreadable(self, path: Path, error: OSError) -> RequestError:
        fix = way_out(error, f"or give another folder with {FLAG}")
        return RequestError(f"{path}: expected a file that can be read, received: {error.strerror or error}; {fix}")

    def _refuse(self, expected: str, received: str) -> NoReturn:
        raise self.refused(f"expected {expected}, received {received}")

    def refused(self, why: object) -> RequestError:
        """Return the error for a state that cannot be used, with what the user can do."""
        return RequestError(f"{self.path}: {why}; {ANEW}")


def _json(data: Any) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False)
