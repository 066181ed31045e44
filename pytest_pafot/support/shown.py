"""Values that show themselves in notebooks, with the view of the report page.

The one place that reaches for a room above its own: what draws a run knows all others, and is looked up only when a
notebook, or a caller, asks for a view.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from pytest_pafot.support.files import write_whole

VIEWS = "pytest_pafot.report.notebook"


class Shown:
    """Shows itself where it is the last value of a notebook's cell."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        html: str = _views().html(self)
        return html


class Drawn(Shown):
    """A run that can be drawn, besides."""

    __slots__ = ()

    def plot(self, times: Sequence[float] | None = None) -> PngPicture:
        """The run from above at several moments, one below the other; needs Pillow.

        Args:
            times: of the moments [s]; by default the last four seconds up to the one that the run is about.

        Raises:
            AnimationError: without Pillow.
            ValueError: for a time that is not of the run.
        """
        return PngPicture(_views().plot(self, times))

    def animate(self) -> PngPicture:
        """The last eight seconds of the run from above, as a moving picture; needs Pillow.

        Raises:
            AnimationError: without Pillow, or with more vehicles than a small picture can show.
        """
        return PngPicture(_views().animate(self))


@dataclass(frozen=True, slots=True)
class PngPicture:
    """The content of a PNG file, which notebooks show; one of several frames moves there, and in browsers (APNG)."""

    content: bytes = field(repr=False)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to a file.

        Raises:
            ValueError: for a name that does not end in ``.png``.
        """
        if Path(path).suffix.lower() != ".png":
            raise ValueError(f"path: expected a name that ends in .png, received {str(path)!r}; the picture is a PNG")
        write_whole(Path(path), self.content)

    def __repr__(self) -> str:
        return f"<PngPicture of {len(self.content) / 1000:.0f} kB>"

    def _repr_png_(self) -> bytes:
        return self.content


def _views() -> Any:
    return import_module(VIEWS)
