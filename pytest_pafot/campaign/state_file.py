"""The state of a search in one JSON file: all that decides what comes next.

The random numbers of a generation follow from the seed and its number, so that none are stored. The file is data: it is
limited and checked, and says at most how a search goes on.
"""

from __future__ import annotations

import errno
import json
import math
import os
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.campaign.request import RequestError
from pytest_pafot.corpus.layout import safe_name
from pytest_pafot.findings.shrink import Start
from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import ResumableSearch
from pytest_pafot.searching.campaign import Checkpoint
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.evaluation_cache import Remembered
from pytest_pafot.searching.events import CampaignFinished
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.plain import from_plain, plain
from pytest_pafot.support.errors import FieldError
from pytest_pafot.support.files import hold, open_regular, way_out, write_whole
from pytest_pafot.world import codec

VERSION = 4
"""Of the format; a file of another one is refused."""

MAX_BYTES = 1 << 28
"""A larger file is neither written nor read; ten thousand runs of four NPCs take some 10 MB."""

LOCK = ".lock"
"""In place of the ending of a state while a session goes on from it."""

SHARE = 50
"""Between two generations the file is written when so many times as long has passed as that took last time, new runs
aside, which have to be put into words once however seldom it is written."""

FLAG = BY_NAME["resume"].flag
ANEW = f"delete the file to begin the search anew, or give another folder with {FLAG}"
PARTS = ("version", "settings", "algorithm", "sums", "begun", "counts", "remembered")


Shown = tuple[Scenario, tuple[Start, ...]] | None
"""What a run shows of a find: the scenario as driven, with the start of each gene, where it fails in the same way."""

Answer = tuple[str, Shown]
"""An attempt to shrink a find: the id of the candidate, and what its run has shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EarlierFind:
    """A find of a search.

    Attributes:
        id: of its file.
        signature: by which it is told from others.
        repeats: further runs that failed in the same way.
        found: the scenario as found, its generation and the number of its run; None where it was only counted.
        is_due: whether it is yet to be simplified.
        answers: where it is due, what the attempts to shrink it have shown so far, in their order.
    """

    id: str
    signature: Signature
    repeats: int
    found: tuple[Scenario, int, int] | None
    is_due: bool
    answers: tuple[Answer, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """What a search knows and has counted, beside its algorithm.

    Attributes:
        before: ids of the saved scenarios that were there when it began; others with its seed are its own finds.
        seconds: of all its sessions so far.
        decides_for_many: whether the ADS has shown that it decides for many runs at once.
        finds: in the order in which they were found.
        known: see :class:`~pytest_pafot.campaign.search_loop.SearchLoop`, as the next five.
        random: see :class:`~pytest_pafot.campaign.resuming.RandomBeginning`: evaluated, runs, at_fault, otherwise.
        health: counts over all evaluations.
    """

    before: tuple[str, ...]
    seconds: float
    decides_for_many: bool
    finds: tuple[EarlierFind, ...]
    known: Counter[str]
    verdicts: Counter[str]
    caught: Counter[str]
    doubt: str
    broken: str | None
    fatal: tuple[Scenario, ...]
    random: tuple[int, int, int, int]
    health: Health


class NoNumberError(ValueError):
    """A word for a number, such as NaN, which JSON does not have."""


def state_path(folder: Path, node_id: str) -> Path:
    """The file of a test's search in the folder of all states."""
    return folder / f"{safe_name(node_id)}.json"


@dataclass(slots=True, kw_only=True)
class StateFile:
    """The state of one search on disk.

    Attributes:
        path: of the file.
        settings: that the state must agree in, as plain data.
        algorithm: of the search.
        clock: seconds since any moment.
        problem: why it could not be written last time; empty where it could.
    """

    path: Path
    settings: Mapping[str, Any]
    algorithm: ResumableSearch
    clock: Callable[[], float]
    problem: str = ""
    _claim: BinaryIO | None = None  # an empty file beside it, under a lock
    _texts: dict[int, tuple[Remembered, str]] = field(default_factory=dict)  # of what is remembered, by identity
    _written_at: float = -math.inf
    _cost: float = 0.0

    def claim(self) -> None:
        """Keep other sessions from the state: of two that begin at the same one, the later to end would undo the other.

        Raises:
            RequestError: where another one has it, or a link is in the place of the file that says so.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = open_regular(self.path.with_suffix(LOCK), "ab")
        except OSError as error:
            if error.errno == errno.EINVAL:
                raise self._unreadable(self.path.with_suffix(LOCK), error) from None
            return  # Nothing can be written here; the state itself says so.
        if not hold(file.fileno(), is_inherited=False):  # A worker that a killed session leaves behind does no harm.
            file.close()
            raise RequestError(
                f"{self.path}: expected a search that no other session makes now, received one that another session "
                f"is at; wait until that has ended, or give another folder with {FLAG}"
            )
        self._claim = file

    def release(self) -> None:
        """Let other sessions have the state."""
        if self._claim is None:
            return
        path = self.path.with_suffix(LOCK)
        with suppress(OSError), self._claim:
            if os.name != "nt":
                path.unlink()  # while it is locked, so that nobody locks what is removed then
        if os.name == "nt":
            with suppress(OSError):  # Windows removes no open file, nor one that another session has by now.
                path.unlink()

    def read(self) -> tuple[Counts, Checkpoint[Any]] | None:
        """The state; None where there is none yet.

        Raises:
            RequestError: for a file that is none, is of another search, or cannot be read.
        """
        data = self._data()
        if data is None:
            return None
        version = data.get("version")
        if version != VERSION:
            # What is no state may be a secret, of which nothing is shown.
            self._refuse(
                f"a state of version {VERSION}", f"version {version if isinstance(version, int) else 'unknown'}"
            )
        if set(data) != set(PARTS):
            self._refuse(f"the keys {', '.join(PARTS)}", "others")
        if not isinstance(data["settings"], dict):
            self._refuse("settings: a mapping", f"{data['settings']!r:.60}")
        differ = codec.differences("", data["settings"], self.settings)
        if differ:
            self._refuse("the state of this search", f"one that differs: {'; '.join(differ)}")
        checkpoint = Checkpoint(
            state=self._part(data, "algorithm", self.algorithm.restored),
            sums=self._part(data, "sums", partial(from_plain, CampaignFinished)),
            begun=self._part(data, "begun", partial(from_plain, tuple[tuple[Evaluation, bool], ...])),
            remembered=self._part(data, "remembered", partial(from_plain, tuple[Remembered, ...])),
        )
        return self._part(data, "counts", partial(from_plain, Counts)), checkpoint

    def offer(self, checkpoint: Callable[[], Checkpoint[Any]], counts: Callable[[], Counts]) -> None:
        """Write the state at a border of two generations, unless that would take too large a share of the time."""
        if self.clock() - self._written_at >= SHARE * self._cost:
            self.write(checkpoint(), counts())

    def write(self, checkpoint: Checkpoint[Any], counts: Counts) -> None:
        """Write the state, as a whole or not at all; what keeps it from being written is told, and ends no search.

        Raises:
            RequestError: where an algorithm stores of itself what JSON cannot hold.
        """
        known, self._texts = self._texts, {}
        for run in checkpoint.remembered:
            # Each is put into words once: there may be ten thousand, of which few are new.
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
                f"{FLAG}: expected data that JSON can hold from the method stored of {type(self.algorithm).__name__}, "
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

    def _part(self, data: Mapping[str, Any], name: str, read: Callable[[Any], Any]) -> Any:
        try:
            return read(data[name])
        except FieldError as error:
            self._refuse(f"{name}{error.field}: {error.expected}", error.received)
        except (ValueError, TypeError, LookupError) as error:  # of an algorithm of the user's own
            self._refuse(f"{name}: data that can be restored", f"{type(error).__name__}: {error!s:.100}")

    def _data(self) -> dict[str, Any] | None:
        try:
            with open_regular(self.path) as file:
                content = file.read(MAX_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise self._unreadable(self.path, error) from None
        if len(content) > MAX_BYTES:
            self._refuse(f"at most {MAX_BYTES} bytes", "more")
        try:
            data = json.loads(content, parse_constant=_no_constant)
        except NoNumberError as error:
            self._refuse("the JSON of a search's state", str(error))
        except json.JSONDecodeError as error:
            self._refuse("the JSON of a search's state", f"JSON with a fault in line {error.lineno}")
        except (ValueError, RecursionError) as error:  # whose text may quote the file
            self._refuse("the JSON of a search's state", type(error).__name__)
        if not isinstance(data, dict):
            self._refuse("a mapping", f"a {type(data).__name__}")
        return data

    def _unreadable(self, path: Path, error: OSError) -> RequestError:
        fix = way_out(error, f"or give another folder with {FLAG}")
        return RequestError(f"{path}: expected a file that can be read, received: {error.strerror or error}; {fix}")

    def _refuse(self, expected: str, received: str) -> NoReturn:
        raise self.refused(f"expected {expected}, received {received}")

    def refused(self, why: object) -> RequestError:
        """The state cannot be used, with the way out."""
        return RequestError(f"{self.path}: {why}; {ANEW}")


def _json(data: Any) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False)


def _no_constant(name: str) -> NoReturn:
    raise NoNumberError(f"{name} is no number of JSON")
