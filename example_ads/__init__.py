"""Driving policies to search: careful ones, intentionally flawed ones, and published ones behind adapters.

Each module has a factory ``make()`` that returns a fresh ADS (or, for highway-env's own drivers, the vehicle class).
An installed pytest-pafot provides them as ``pytest_pafot.example_ads``.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path

MOVES_SIDEWAYS = 0.3
"""The lateral speed from which an adapter takes a vehicle to be changing lanes [m/s]."""


def import_from_clone(variable: str, repository: str, commit: str, package: str) -> Path:
    """Import a package that is only on GitHub from the user's clone, and return the folder of the clone.

    Args:
        variable: the environment variable that contains the folder.
        repository: owner and name on GitHub.
        commit: the version for which the adapter was written.
        package: the path of the package in the clone.

    Raises:
        ImportError: if the variable does not name a folder with this package.
    """
    folder = Path(os.environ.get(variable, "")).absolute()
    if variable not in os.environ or not (folder / package).is_dir():
        raise ImportError(
            f"{variable}: expected the folder of a clone of https://github.com/{repository} at commit {commit}, "
            f"received {os.environ.get(variable)!r}; clone it and set the environment variable {variable} to its folder"
        )
    # The folder is on the path only for this import. Its other packages, such as `tests`, could hide those of the user.
    parent = str((folder / package).parent)
    sys.path.insert(0, parent)
    try:
        imported = importlib.import_module(Path(package).name)
    finally:
        sys.path.remove(parent)
    place = str(imported.__file__ or next(iter(imported.__path__)))  # a package without __init__.py has no file
    if not Path(place).is_relative_to(folder):
        raise ImportError(
            f"{variable}: expected the package {Path(package).name} of {folder}, received {place}, of the "
            "same name and imported before; rename your own module"
        )
    return folder


def lane_ahead(lane_centres: Sequence[float], y: float, lateral_velocity: float) -> int | None:
    """Return the lane to whose centre a vehicle is moving; None if it is not changing lanes, or beyond the last one.

    Args:
        lane_centres: the y of each lane's centre [m].
        y: the vehicle's y [m].
        lateral_velocity: its velocity along y [m/s].
    """
    ways = [(abs(centre - y), lane) for lane, centre in enumerate(lane_centres) if (centre - y) * lateral_velocity > 0]
    return min(ways)[1] if ways and abs(lateral_velocity) >= MOVES_SIDEWAYS else None
