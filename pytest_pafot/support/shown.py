"""Values that display themselves in notebooks, with the view of the report page.

This is the only module that uses a package above its own. The package that draws a run uses all others, so it is
imported only when a notebook or a caller requests a view.
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
    """A value that a notebook displays as a picture and a table, if it is the last value of a notebook cell."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        html: str = _views().html(self)
        return html


class Drawn(Shown):
    """A run that notebooks display, and that can be drawn as a picture or an animation."""

    __slots__ = ()

    def plot(self, times: Sequence[float] | None = None) -> PngPicture:
        """Draw the run from above at several times, one picture below the other; needs Pillow.

        Args:
            times: the times [s]; by default, the last four seconds up to the collision or most critical moment.

        Raises:
            AnimationError: without Pillow.
            ValueError: if a time is outside the run.
        """
        return PngPicture(_views().plot(self, times))

    def animate(self) -> PngPicture:
        """Draw eight seconds of the run from above as an animated picture; needs Pillow.

        They end at most two seconds after the decisive moment, and not before the eighth second.

        Raises:
            AnimationError: without Pillow, or if the run has too many vehicles for a small picture.
        """
        return PngPicture(_views().animate(self))


@dataclass(frozen=True, slots=True)
class PngPicture:
    """The content of a PNG file, which notebooks display; with several frames it is an animation (APNG)."""

    content: bytes = field(repr=False)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the picture to a file.

        Raises:
            ValueError: if the name of the file does not end in ``.png``.
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
