"""What an exporter is, and which one a name stands for: one of this package, or one that a package has registered."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from types import MappingProxyType
from typing import Protocol

from pytest_pafot.errors import FieldError
from pytest_pafot.findings.finding import Finding
from pytest_pafot.trace import Trace

GROUP = "pytest_pafot.exporters"
"""Of entry points; each is an :class:`Exporter` under the name of its format."""

BUILT_IN = tuple(
    metadata.EntryPoint(name, f"{__package__}.{module}:export", GROUP)
    for name, module in (
        ("commonroad", "commonroad_xml"),
        ("csv", "csv_table"),
        ("mcap", "foxglove_mcap"),
        ("xosc", "openscenario"),
    )
)
"""Those of this package, whose names no other can take."""

EXTRAS: Mapping[str, str] = MappingProxyType(
    {"scenariogeneration": "export", "foxglove": "export", "commonroad": "commonroad"}
)
"""By the library that a format needs, the extra that installs it."""


class Exporter(Protocol):
    """A run of a finding as files; a function is one."""

    def __call__(self, finding: Finding, trace: Trace) -> Mapping[str, bytes]:
        """The content of each file by its name, which begins with the finding's id. Writes nothing itself."""


class ExportError(FieldError):
    """A finding that cannot be exported as it was asked for."""


def exporter(name: str) -> Exporter:
    """The exporter of a format.

    Raises:
        ExportError: for an unknown name, and where the library that it needs, or the exporter, cannot be imported.
    """
    entries = {entry.name: entry for entry in (*metadata.entry_points(group=GROUP), *BUILT_IN)}
    if name not in entries:
        known, fix = ", ".join(sorted(entries)), "a package that registers it may not be installed here"
        raise ExportError(field="--to", expected=f"one of {known}", received=repr(name), fix=fix)
    try:
        made: Exporter = entries[name].load()
    except Exception as error:
        library = (getattr(error, "name", None) or "").partition(".")[0]
        is_missing = isinstance(error, ModuleNotFoundError) and library in EXTRAS
        fix = f"run `pip install 'pytest-pafot[{EXTRAS[library]}]'`" if is_missing else ""
        expected = f"the library {library}" if is_missing else f"that {entries[name].value} can be imported"
        received = "an environment without it" if is_missing else f"{type(error).__name__}: {error}"
        raise ExportError(field=f"--to {name}", expected=expected, received=received, fix=fix) from error
    return made
