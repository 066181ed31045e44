"""``pafot.recorded``: what others recorded or wrote, by the columns or the outermost element of the file."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pytest_pafot import Scenario, catalogue
from pytest_pafot.extending import RequestError
from pytest_pafot.extras.recordings import commonroad_scenario, highd, levelx, ngsim, openscenario_story, own_csv
from pytest_pafot.extras.recordings.openscenario_cast import Options
from pytest_pafot.extras.recordings.recording import LANE_WIDTH, Recording, RecordingError
from pytest_pafot.extras.recordings.tables import Between, Table
from pytest_pafot.extras.recordings.xml_data import read_xml
from pytest_pafot.support.errors import FieldError, is_collecting, plain_number
from pytest_pafot.support.text import shown


class TableFormat(NamedTuple):
    """A format of tables: its name, the columns by which it is recognised, and its reader."""

    name: str
    columns: Sequence[str]
    read: Callable[[Path, Between], Recording]


TABLES = (
    TableFormat("export --to csv", own_csv.COLUMNS, own_csv.read),
    TableFormat("highD", highd.COLUMNS, highd.read),
    TableFormat("inD, rounD, exiD", levelx.COLUMNS, levelx.read),
    TableFormat("NGSIM", ngsim.COLUMNS, ngsim.read),
)
"""All formats of tables. The first one whose columns a file has reads it."""
WIDEST = 20.0
"""The largest width of a lane [m]."""


class Refused:
    """A stand-in for a file that was refused while pytest imported a test file: the items that use it fail.

    Only they do, and not the other tests of their file. Every use that is not ``@pafot.recorded(...)``,
    ``@pafot.catalogue(...)`` or ``@pafot.search(around=...)`` raises the error at once.
    """

    def __init__(self, error: Exception) -> None:
        self._error = error

    @property
    def entries(self) -> Any:
        """Raise the error: the catalogue asks this of a recording when an item runs."""
        raise RequestError(str(self._error)) from self._error

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # pytest asks each object of a test file for some of these
            raise AttributeError(name)
        return self.entries

    def __call__(self, test: Any) -> Any:
        """Mark a test as the recording would."""
        return catalogue(self)(test)


def recorded(
    path: str | os.PathLike[str],
    ego: object = None,
    *,
    between: tuple[float, float] | None = None,
    vehicles: Sequence[str | Path] = (),
    without: Sequence[str] = (),
    lane_width: float = LANE_WIDTH,
) -> Recording | Scenario:
    """Read what others recorded or wrote: tracks as a ``Recording``, and manoeuvres of OpenSCENARIO as a ``Scenario``.

    The file is data: it is read within limits, and no other file that it names is opened. Tracks are tables of
    ``python -m pytest_pafot export --to csv``, highD, inD, rounD, exiD (their ``..tracks.csv``, next to the other two
    files of the recording) or NGSIM, scenarios of CommonRoad, and trajectories of OpenSCENARIO.
    ``recorded(...).scenario(at=...)`` makes a scenario of them.

    Of OpenSCENARIO 1.x, speed actions, changes of lanes and lane offsets are read, which begin by simulation time, at
    a distance or headway between the ego and the vehicle, or after another event. What the file has the ego do later
    is left out, because the policy drives it. Speeds and lanes relative to the ego's are relative to its first ones.
    All else is refused with its name and place. Roads are not read: lanes with negative numbers are taken to lie side
    by side on the right side of a straight road.

    Args:
        path: the file.
        ego: the name of the vehicle in whose place the policy drives. A recording is turned so that the road is along
            x in its direction. By default, the vehicle with a name like ``ego``, if there is one.
        between: the first and the last time of the rows to read, on the clock of the data [s]; all by default.
        vehicles: for OpenSCENARIO, the files of catalogues with the vehicles that the file refers to.
        without: for OpenSCENARIO, the names of elements that are left out, such as ``EnvironmentAction``, because the
            scenario is the same without them.
        lane_width: for OpenSCENARIO, the width of lanes in places and distances that are in metres [m].

    Raises:
        RecordingError: if the file cannot be read; the message names the place, what was expected, and the way out.
        RequestError: if there is no such vehicle. While pytest imports a test file, neither error is raised, but the
            tests that use what is returned fail with its message.
    """
    try:
        _check(path, between, vehicles, without, lane_width)
        found = _read(Path(path), between, Options(None if ego is None else str(ego), vehicles, without, lane_width))
        return found if ego is None or isinstance(found, Scenario) else found.seen_from(ego)
    except (RequestError, FieldError) as error:
        if not is_collecting():
            raise
        refused: Any = Refused(error)
        return refused  # type: ignore[no-any-return]


def _read(file: Path, between: Between, options: Options) -> Recording | Scenario:
    try:
        if not file.is_file():
            what = "is a folder" if file.is_dir() else "is no regular file" if file.exists() else "does not exist"
            received = f"received {str(file)!r:.200}, which {what}"
            raise RequestError(f"recorded: expected a file, {received}; correct the path")
        with file.open("rb") as content:
            # Byte order marks come first, and in UTF-16 there is a zero at each letter.
            is_xml = content.read(200).replace(b"\0", b"").lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n").startswith(b"<")
        if is_xml:
            root = read_xml(file)
            if root.tag == openscenario_story.ROOT:
                return openscenario_story.read(root, between, options)
            if root.tag == commonroad_scenario.ROOT:
                return commonroad_scenario.read(root, between)
            expected = f"{openscenario_story.ROOT} or {commonroad_scenario.ROOT}"
            raise root.error(expected, root.tag[:60], "convert the file to one of them")
        table = Table(file)
        known = [each for each in TABLES if all(name.lower() in table.columns for name in each.columns)]
        if not known:
            expected = "the columns of " + ", or ".join(f"{each.name} ({', '.join(each.columns)})" for each in TABLES)
            is_text = len(table.columns) > 1 and not any("\0" in name for name in table.columns)
            names = "rename the columns to those of one of them"
            fix = names if is_text else "save it with commas between the cells, in UTF-8"
            raise RecordingError(file, expected, ", ".join(table.columns)[:200] or "none", fix, line=1)
        return known[0].read(file, between)
    except OSError as error:
        received = f"received {str(error.filename or file)!r:.200}: {error.strerror}"
        raise RequestError(f"recorded: expected a file that can be read, {received}; correct the path") from None


def _check(path: object, between: object, vehicles: object, without: object, lane_width: object) -> None:
    """Refuse arguments that would be misread: a text is a sequence of letters, and a width below 0 swaps the sides."""
    if not isinstance(path, str | os.PathLike):
        raise RequestError(f"recorded: expected the path of a file, received {shown(path)}; write its name as a text")
    times = [*map(plain_number, between)] if isinstance(between, Sequence) and not isinstance(between, str) else []
    if between is not None and (len(times) != 2 or times[0] is None or times[1] is None or times[0] > times[1]):
        raise RequestError(
            f"recorded: expected a first and a last time [s], such as between=(0, 60), received {shown(between)}"
        )
    for name, value in (("vehicles", vehicles), ("without", without)):
        if isinstance(value, str | os.PathLike):
            raise RequestError(
                f"recorded: expected a list, such as {name}=[{str(value)!r:.60}], received {shown(value)}"
            )
    width = plain_number(lane_width)
    if width is None or not 0 < width <= WIDEST:
        raise RequestError(
            f"recorded: expected lane_width in metres, above 0 and at most {WIDEST:g}, received {shown(lane_width)}"
        )
