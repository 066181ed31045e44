"""The figures of a comparison. All of them can be read in black and white."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pytest_pafot.comparison.run_measures import SECONDS_PER_HOUR, Results, rows_of
from pytest_pafot.support.files import write_whole

SETTINGS: Any = {
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
}
POINTS = 300  # number of points on a curve over time


class Style(NamedTuple):
    """The appearance of an algorithm in figures. Styles differ in lightness, line style and marker."""

    colour: str
    line: Any
    marker: str


STYLES = (
    Style("#17365d", "-", "o"),
    Style("#c8622c", "--", "s"),
    Style("#8fae91", "-.", "^"),
    Style("#6b4c9a", ":", "D"),
    Style("#d9b310", (0, (5, 1, 1, 1, 1, 1)), "v"),
    Style("#3f9a9a", (0, (1, 1)), "P"),
    Style("#808080", (0, (8, 3)), "X"),
    Style("#b8325a", (0, (3, 1)), "*"),
)


def _algorithms(results: Results) -> Iterator[tuple[str, Style, pd.DataFrame]]:
    for index, name in enumerate(results.plan.names):
        yield name, STYLES[index % len(STYLES)], rows_of(name, results.runs)


def draw_all(results: Results, folder: Path) -> dict[str, str]:
    """Write every figure as a PNG file. Return the titles by file name without the suffix."""
    with mpl.rc_context(SETTINGS):
        for name, (_, draw) in FIGURES.items():
            figure = Figure(figsize=(6.0, 3.6), layout="constrained")
            draw(figure.subplots(), results)
            buffer = BytesIO()
            figure.savefig(buffer, format="png", dpi=160)
            write_whole(folder / f"{name}.png", buffer.getvalue())
    return {name: title for name, (title, _) in FIGURES.items()}


def _curves(
    axes: Axes, results: Results, *, label: str, counts: Callable[[pd.DataFrame], pd.Series[bool]]
) -> None:
    # The mean of all runs as a curve, with a band for the middle half of the runs.
    rows = results.frame[counts(results.frame)]
    times = np.linspace(0.0, results.horizon, POINTS)
    hours = times / SECONDS_PER_HOUR
    for name, style, runs in _algorithms(results):
        totals = []
        for run in runs["run"]:
            at = rows_of(name, rows[rows["run"] == run])["clock"].sort_values()
            totals.append(np.searchsorted(at, times, side="right"))
        cumulated = np.stack(totals).astype(np.float64)
        axes.fill_between(
            hours,
            *np.quantile(cumulated, [0.25, 0.75], axis=0),
            color=style.colour,
            alpha=0.15,
            linewidth=0,
        )
        axes.plot(
            hours,
            cumulated.mean(axis=0),
            label=name,
            color=style.colour,
            linestyle=style.line,
            marker=style.marker,
            markevery=(POINTS // 12, POINTS // 6),
            markersize=4.5,
        )
    axes.set(xlim=(0, None), ylim=(0, None), xlabel="simulated time per run [h]", ylabel=label)
    axes.set_title("mean of the runs; band: middle half of the runs", fontsize=9, loc="left")
    axes.legend(loc="upper left")


def _is_discovery(rows: pd.DataFrame) -> pd.Series[bool]:
    # For each row, whether it is the first failure with its signature in its run.
    known = rows[rows["is_ego_failure"]].duplicated(["algorithm", "run", "signature"])
    return rows["is_ego_failure"] & ~known.reindex(rows.index, fill_value=False)


# The title and the drawing function of each figure, by its file name without the suffix.
FIGURES: Mapping[str, tuple[str, Callable[[Axes, Results], None]]] = {
    "discoveries": (
        "Distinct ego-responsible failures over simulated time",
        partial(_curves, label="distinct ego-responsible failures per run", counts=_is_discovery),
    ),
    "collisions-over-time": (
        "Collisions over simulated time",
        partial(
            _curves,
            label="unique collisions per run",
            counts=lambda rows: rows["outcome"] == "collision",
        ),
    ),
}
