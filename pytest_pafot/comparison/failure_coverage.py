"""How much of all that fails a run of a search has shown, rather than how often: the coverage inverted distance.

Source: Sorokin, Safin, Nejati, "Can search-based testing with Pareto optimization effectively cover failure-revealing
test inputs?", Empirical Software Engineering 2024, arXiv:2410.11769: the mean distance of the points of a reference set
to the nearest one that was found. Their points are inputs, and the reference set a grid of them. Here the inputs of
searches differ, Position- and Lane-Instructions, so that points are impacts; and no grid of 24 dimensions can be run,
so that the reference set is what all searches of a comparison have shown together.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import pandas as pd

from pytest_pafot.grid import Cell
from pytest_pafot.trace import FloatArray

SPEED_STEP = 5.0
"""In which the closing speeds of impacts are told apart [m/s]."""
SIDES = {"front": (1, 0), "right": (0, 1), "rear": (-1, 0), "left": (0, -1)}
"""Where a side of the ego is, as rows and columns of the grid are."""


def inverted_distances(frame: pd.DataFrame, is_counted: pd.Series[bool]) -> pd.Series[float]:
    """The distance of each run of a comparison, by its algorithm and number; infinite where a run shows nothing.

    0 says that the run shows all that any run shows; 1 that what is shown lies as far off as the whole range of a
    feature. Equal points count once, so that it is no advantage to show one of them often. Rows of ``frame`` that are
    not counted, such as those after a time, are part of the reference set all the same.
    """
    hits = frame[frame["failing"] & (frame["outcome"] == "collision") & ~frame["duplicate"]]
    impacts = zip(hits["cell"], hits["side"], hits["closing_speed"], strict=True)
    points = np.array([_point(Cell(int(cell)), side, speed) for cell, side, speed in impacts], dtype=np.float64)
    distances = dict.fromkeys(zip(frame["algorithm"], frame["run"], strict=True), math.inf)
    if len(points):
        points = points / np.maximum(np.ptp(points, axis=0), 1.0)
        reference, is_shown = np.unique(points, axis=0), is_counted[hits.index].to_numpy()
        for key, at in hits.groupby(["algorithm", "run"]).indices.items():
            distances[cast("tuple[str, int]", key)] = _mean_distance(reference, points[at[is_shown[at]]])
    return pd.Series(distances, dtype=float)


def _point(cell: Cell, side: str, closing_speed: float) -> tuple[float, ...]:
    """What an impact is told by: where the NPC was, which side of the ego was hit, and how fast.

    Not when: that would tell against algorithms with short runs.
    """
    return cell.row, cell.column, *SIDES[side], round(closing_speed / SPEED_STEP)


def _mean_distance(reference: FloatArray, shown: FloatArray) -> float:
    """Of each point of the reference set, shape [points, features], to the nearest one that is shown."""
    shown = np.unique(shown, axis=0)
    apart = np.linalg.norm(reference[:, None] - shown[None, :], axis=-1)
    return float(apart.min(axis=1, initial=math.inf).mean())
