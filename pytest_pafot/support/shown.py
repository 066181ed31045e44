"""Values that display themselves in notebooks, with the view of the report page.

This is the only module that uses a package above its own. The package that draws a run uses all others, so it is
imported only when a notebook or a caller requests a view.
"""

from __future__ import annotations

from importlib import import_module

VIEWS = "pytest_pafot.report.notebook"


class Shown:
    """A value that a notebook displays as a picture and a table, if it is the last value of a notebook cell."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        html: str = import_module(VIEWS).html(self)
        return html
