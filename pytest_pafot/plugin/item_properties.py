"""Properties of items, which files for other tools have, such as those of ``--junitxml``.

They are those of pytest's own ``record_property``, each with the prefix ``pafot_``, so that workers of pytest-xdist
hand them over and none is taken for one of the user's.
"""

from __future__ import annotations

from collections.abc import Iterable, MutableSequence
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.text import visible

if TYPE_CHECKING:
    from pytest_pafot.findings.finding import Finding

PREFIX = "pafot_"

AS_SAVED = "pafot_saved"
"""Attribute of the report of a saved scenario that fails: its id and file as they are, for programs.

It is JSON in ASCII: pytest-xdist sends no text with bytes in it that are no characters, as names of files may have.
"""


def set_properties(properties: MutableSequence[tuple[str, Any]], **values: object) -> None:
    """Set properties of an item or of a report, each once and safe to show; those that are empty are left out."""
    names = {f"{PREFIX}{name}": visible(str(value)) for name, value in values.items() if value not in (None, "")}
    others = [each for each in properties if each[0] not in names]
    properties[:] = [*others, *names.items()]


def set_of_saved(item: pytest.Item, saved: Saved) -> None:
    """Set those of the item of a saved scenario, before anything can go wrong with it."""
    finding, file = saved.finding, relative(saved.path, item.config.rootpath)
    seed, signature = (None, None) if finding is None else (finding.found.seed, finding.signature.text)
    set_properties(item.user_properties, seed=seed, id=saved.id, signature=signature, file=file)


def of_findings(findings: Iterable[tuple[Finding, str]]) -> dict[str, str]:
    """Those that tell findings, with their files: for several, what stands in each is separated by commas."""
    columns: dict[str, list[str]] = {"id": [], "signature": [], "file": []}
    for finding, file in findings:
        for column, text in zip(columns.values(), (finding.id, finding.signature.text, file), strict=True):
            column.append(text)
    return {name: ", ".join(filter(None, column)) for name, column in columns.items()}
