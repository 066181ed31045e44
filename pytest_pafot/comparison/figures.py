"""The figures of a comparison: the paper's five, and two on distinct failures; all are readable without colours."""

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
from matplotlib.ticker import MaxNLocator

from pytest_pafot.comparison.markdown import BIN_SECONDS, PAPER, PAPER_GENERATIONS, Reported
from pytest_pafot.comparison.plan import Plan
from pytest_pafot.comparison.run_measures import SECONDS_PER_HOUR, Results, first_failures, of, survival
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
    "svg.hashsalt": "pytest-pafot",
    "hatch.linewidth": 0.7,
}
POINTS = 300  # number of points on a curve over time


class Style(NamedTuple):
    """The appearance of an algorithm in figures. Styles differ in lightness, line, marker and hatch."""

    colour: str
    line: Any
    marker: str
    hatch: str

    @property
    def bar(self) -> dict[str, Any]:
        """The keyword arguments with which matplotlib draws bars in this style."""
        return {"color": self.colour, "hatch": self.hatch, "edgecolor": "white", "linewidth": 0}

    @property
    def curve(self) -> dict[str, Any]:
        """The keyword arguments with which matplotlib draws lines with markers in this style."""
        return {"color": self.colour, "linestyle": self.line, "marker": self.marker}


STYLES = (
    Style("#17365d", "-", "o", ""),
    Style("#c8622c", "--", "s", "///"),
    Style("#8fae91", "-.", "^", "..."),
    Style("#6b4c9a", ":", "D", "xxx"),
    Style("#d9b310", (0, (5, 1, 1, 1, 1, 1)), "v", "\\\\\\"),
    Style("#3f9a9a", (0, (1, 1)), "P", "+++"),
    Style("#808080", (0, (8, 3)), "X", "---"),
    Style("#b8325a", (0, (3, 1)), "*", "ooo"),
)


def _each(results: Results) -> Iterator[tuple[int, str, Style, pd.DataFrame]]:
    """Yield the index, name and style of every algorithm, and the measures of its runs."""
    for place, name in enumerate(results.plan.names):
        yield place, name, STYLES[place % len(STYLES)], of(name, results.whole)


def _unique(results: Results) -> pd.DataFrame:
    return results.frame[~results.frame["reused"]]


def draw_all(results: Results, folder: Path) -> dict[str, str]:
    """Write every figure as PNG and SVG; return their titles by file name without ending."""
    titles: dict[str, str] = {}
    with mpl.rc_context(SETTINGS):
        for name, (title, draw, size) in FIGURES.items():
            figure = Figure(figsize=size, layout="constrained")
            draw(figure.subplots(), results)
            for ending, options in (("png", {"dpi": 160}), ("svg", {"metadata": {"Date": None}})):
                buffer = BytesIO()
                figure.savefig(buffer, format=ending, **options)
                figure.set_layout_engine("none")  # the second picture has the layout of the first: finding it is slow
                write_whole(folder / f"{name}.{ending}", buffer.getvalue())
            titles[name] = title
    return titles


def _totals(axes: Axes, results: Results) -> None:
    """Draw the total number of scenarios and collisions over all runs, next to the numbers of the paper."""
    width, reported = 0.36, [name for name in results.plan.names if name in PAPER]
    for place, name, style, runs in _each(results):
        counts = int(runs["collisions"].sum()), int(runs["scenarios"].sum())
        _stacked(axes, place - (width / 2 + 0.02 if name in reported else 0.0), width, counts, style, alpha=1.0)
        if name in reported:
            told = PAPER[name].collisions, PAPER[name].scenarios
            _stacked(axes, place + width / 2 + 0.02, width, told, style, alpha=0.35)
    axes.set_xticks(range(len(results.plan.names)), results.plan.names)
    axes.set_ylabel("scenarios in all runs")
    axes.grid(visible=False, axis="x")
    axes.margins(y=0.12)
    paler = "; pale: the paper's, on CARLA" if reported else ""
    axes.set_title(f"filled: collision, white: none{paler}", fontsize=9, loc="left")


def _stacked(axes: Axes, x: float, width: float, counts: tuple[int, int], style: Style, *, alpha: float) -> None:
    hits, total = counts
    edge: Any = {"edgecolor": "#444444", "linewidth": 0.8}
    axes.bar(x, hits, width, alpha=alpha, **style.bar)
    axes.bar(x, hits, width, facecolor="none", **edge)
    axes.bar(x, total - hits, width, bottom=hits, facecolor="white", **edge)
    text = f"{hits} of\n{total}\n" + (f"{hits / total:.0%}".replace("%", " %") if total else "")
    axes.annotate(text, (x, total), xytext=(0, 3), textcoords="offset points", ha="center", fontsize=7.5)


def _curves(axes: Axes, results: Results, *, label: str, counts: Callable[[pd.DataFrame], pd.Series[bool]]) -> None:
    """Draw the mean over the runs as a curve up to the end of the shortest run, with a band for their middle half."""
    rows = _unique(results)
    rows = rows[counts(rows)]
    for _, name, style, runs in _each(results):
        times = np.linspace(0.0, runs["seconds"].min(), POINTS)
        of_runs = [of(name, rows[rows["run"] == run])["clock"].sort_values() for run in runs["run"]]
        cumulated = np.stack([np.searchsorted(at, times, side="right") for at in of_runs]).astype(np.float64)
        hours = times / SECONDS_PER_HOUR
        axes.fill_between(
            hours, *np.quantile(cumulated, [0.25, 0.75], axis=0), color=style.colour, alpha=0.15, linewidth=0
        )
        markers: Any = {"markevery": (POINTS // 12, POINTS // 6), "markersize": 4.5}
        axes.plot(hours, cumulated.mean(axis=0), label=name, **style.curve, **markers)
    axes.set(xlim=(0, None), ylim=(0, None), xlabel="simulated time of a run [h]", ylabel=label)
    axes.set_title("mean of the runs; band: their middle half", fontsize=9, loc="left")
    axes.legend(loc="upper left")


def _is_discovery(rows: pd.DataFrame) -> pd.Series[bool]:
    """Return for each row whether it is the first failure with its signature in its run."""
    known = rows[rows["is_ego_failure"]].duplicated(["algorithm", "run", "signature"])
    return rows["is_ego_failure"] & ~known.reindex(rows.index, fill_value=False)


def _grouped(
    axes: Axes, results: Results, *, column: str, label: str, reported: Callable[[Plan, Reported], float | None]
) -> None:
    """Draw a bar for every run of every algorithm, and the paper's mean as a line if it can be compared."""
    width = 0.8 / len(results.plan.names)
    for place, name, style, runs in _each(results):
        x = runs["run"] + 1 + (place - (len(results.plan.names) - 1) / 2) * width
        axes.bar(x, runs[column], width * 0.92, label=name, **style.bar)
        height = reported(results.plan, PAPER[name]) if name in PAPER else None
        if height is not None:
            axes.axhline(height, color=style.colour, linestyle=style.line, linewidth=1.1)
            axes.annotate(
                f"paper: {name}", (1.0, height), xycoords=("axes fraction", "data"), xytext=(3, 0),
                textcoords="offset points", va="center", fontsize=7.5, color="#333333", annotation_clip=False,
            )  # fmt: skip
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xticks(range(1, results.plan.runs + 1))
    axes.grid(visible=False, axis="x")
    axes.set(xlabel="run", ylabel=label)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(results.plan.names))


def _collision_times(axes: Axes, results: Results) -> None:
    edges = np.arange(0.0, np.ceil(results.longest / BIN_SECONDS) + 1) * BIN_SECONDS
    width = BIN_SECONDS * 0.84 / len(results.plan.names)
    for place, name, style, _ in _each(results):
        counts, _ = np.histogram(of(name, _unique(results))["collision_time"].dropna(), edges)
        x = edges[:-1] + BIN_SECONDS / 2 + (place - (len(results.plan.names) - 1) / 2) * width
        shares = 100 * counts / max(counts.sum(), 1)
        axes.bar(x, shares, width * 0.94, label=f"{name} ({counts.sum()})", **style.bar)
    axes.set_xticks(edges)
    axes.grid(visible=False, axis="x")
    axes.set(xlabel="time of the collision in its scenario [s]", ylabel="share of an algorithm's unique collisions [%]")
    axes.legend(loc="upper right")


def _first_failure(axes: Axes, results: Results) -> None:
    for _, name, style, runs in _each(results):
        estimate = survival(*first_failures(runs))
        hours = np.array([0.0, *estimate.times]) / SECONDS_PER_HOUR
        axes.step(hours, 100 * np.array([1.0, *estimate.shares]), where="post", markersize=4, label=name, **style.curve)
    axes.set(xlim=(0, None), ylim=(0, 103))
    axes.set(xlabel="simulated time of a run [h]", ylabel="runs without an ego-responsible failure [%]")
    axes.legend(loc="upper right")


FIGURES: Mapping[str, tuple[str, Callable[[Axes, Results], None], tuple[float, float]]] = {
    "totals": ("Scenarios and collisions in total, next to the paper's", _totals, (7.0, 3.8)),
    "collisions-over-time": (
        "Collisions over simulated time",
        partial(_curves, label="unique collisions of a run", counts=lambda rows: rows["outcome"] == "collision"),
        (6.0, 3.6),
    ),
    "unsafe-per-run": (
        "Colliding scenarios of each run",
        partial(
            _grouped,
            column="collisions",
            label="colliding scenarios of a run",
            reported=lambda plan, told: told.per_run[0] if plan.generations == PAPER_GENERATIONS else None,
        ),
        (7.4, 3.4),
    ),
    "time-to-collision": (
        "Mean time to a collision of each run",
        partial(
            _grouped,
            column="collision_time",
            label="mean time to a collision, if there is one [s]",
            reported=lambda plan, told: told.time_to_collision[0],
        ),
        (7.4, 3.4),
    ),
    "collision-times": ("When collisions happen", _collision_times, (7.0, 3.6)),
    "discoveries": (
        "Distinct ego-responsible failures over simulated time",
        partial(_curves, label="distinct ego-responsible failures of a run", counts=_is_discovery),
        (6.0, 3.6),
    ),
    "first-failure": ("Until the first ego-responsible failure (Kaplan-Meier)", _first_failure, (6.0, 3.6)),
}
"""The title, drawing function and size [inches] of each figure, by its file name without ending."""
