"""The figures of a comparison: the paper's five, and two of distinct failures. Readable in grey, with units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pytest_pafot.comparison import statistics
from pytest_pafot.comparison.markdown import BIN_SECONDS
from pytest_pafot.comparison.paper import PAPER, PAPER_GENERATIONS, Reported
from pytest_pafot.comparison.run_measures import SECONDS_PER_HOUR, Results, first_failures, of
from pytest_pafot.files import write_whole
from pytest_pafot.trace import FloatArray

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
POINTS = 300
"""On a curve over time."""


@dataclass(frozen=True, slots=True)
class Style:
    """How an algorithm looks; colours differ in lightness, and everything else differs too."""

    colour: str
    line: str
    marker: str
    hatch: str


STYLES = (
    Style("#17365d", "-", "o", ""),
    Style("#c8622c", "--", "s", "///"),
    Style("#8fae91", "-.", "^", "..."),
    Style("#6b4c9a", ":", "D", "xxx"),
    Style("#d9b310", (0, (5, 1, 1, 1, 1, 1)), "v", "\\\\\\"),  # type: ignore[arg-type]
    Style("#3f9a9a", (0, (1, 1)), "P", "+++"),  # type: ignore[arg-type]
    Style("#808080", (0, (8, 3)), "X", "---"),  # type: ignore[arg-type]
    Style("#b8325a", (0, (3, 1)), "*", "ooo"),  # type: ignore[arg-type]
)


def style_of(results: Results, algorithm: str) -> Style:
    """How an algorithm looks, by its place."""
    return STYLES[results.plan.names.index(algorithm) % len(STYLES)]


def simulated(results: Results, algorithm: str) -> pd.DataFrame:
    """The rows of its unique scenarios."""
    return of(algorithm, results.frame[~results.frame["duplicate"]])


def draw_all(results: Results, folder: Path) -> dict[str, str]:
    """Write every figure as PNG and SVG.

    Returns:
        titles by the names of the files, without their endings.
    """
    titles: dict[str, str] = {}
    with mpl.rc_context(SETTINGS):
        for name, (title, draw, size) in FIGURES.items():
            figure = Figure(figsize=size, layout="constrained")
            draw(figure.subplots(), results)
            for ending, options in (("png", {"dpi": 160}), ("svg", {"metadata": {"Date": None}})):
                buffer = BytesIO()
                figure.savefig(buffer, format=ending, **options)
                write_whole(folder / f"{name}.{ending}", buffer.getvalue())
            titles[name] = title
    return titles


def _totals(axes: Axes, results: Results) -> None:
    """All scenarios, in total over all runs, and the paper's beside them."""
    width, reported = 0.36, [name for name in results.plan.names if name in PAPER]
    for place, name in enumerate(results.plan.names):
        style, runs = style_of(results, name), of(name, results.whole)
        counts = int(runs["collisions"].sum()), int(runs["scenarios"].sum())
        offset = -width / 2 - 0.02 if name in reported else 0.0
        _stacked(axes, place + offset, width, counts[0], counts[1], style, is_paper=False)
        if name in reported:
            told, beside = PAPER[name], place + width / 2 + 0.02
            _stacked(axes, beside, width, told.collisions, told.scenarios, style, is_paper=True)
    axes.set_xticks(range(len(results.plan.names)), results.plan.names)
    axes.set_ylabel("scenarios in all runs")
    axes.grid(visible=False, axis="x")
    axes.margins(y=0.12)
    note = "filled: collision, white: none"
    axes.set_title(note + ("; pale: the paper's, on CARLA" if reported else ""), fontsize=9, loc="left")


def _stacked(axes: Axes, x: float, width: float, hits: int, total: int, style: Style, *, is_paper: bool) -> None:
    alpha = 0.35 if is_paper else 1.0
    edge = "#444444"
    axes.bar(x, hits, width, color=style.colour, alpha=alpha, hatch=style.hatch, edgecolor="white", linewidth=0)
    axes.bar(x, hits, width, facecolor="none", edgecolor=edge, linewidth=0.8)
    axes.bar(x, total - hits, width, bottom=hits, facecolor="white", edgecolor=edge, linewidth=0.8)
    share = f"{hits / total:.0%}".replace("%", " %") if total else ""
    axes.annotate(
        f"{hits} of\n{total}\n{share}", (x, total), xytext=(0, 3), textcoords="offset points", ha="center", fontsize=7.5
    )


def _collisions_over_time(axes: Axes, results: Results) -> None:
    _curves(axes, results, lambda frame: frame["outcome"] == "collision", "unique collisions of a run")


def _discoveries(axes: Axes, results: Results) -> None:
    _curves(
        axes,
        results,
        lambda frame: (
            frame["is_ego_failure"]
            & ~frame.loc[frame["is_ego_failure"], "signature"].duplicated().reindex(frame.index, fill_value=False)
        ),
        "distinct ego-responsible failures of a run",
    )


def _curves(axes: Axes, results: Results, counts: Callable[[pd.DataFrame], Any], label: str) -> None:
    """Means over the runs as far as all of them reach, and the range of their middle half."""
    for name in results.plan.names:
        runs, style = of(name, results.whole), style_of(results, name)
        times = np.linspace(0.0, runs["seconds"].min(), POINTS)
        rows = np.stack([_cumulated(run, counts, times) for _, run in simulated(results, name).groupby("run")])
        hours = times / SECONDS_PER_HOUR
        low, high = np.quantile(rows, [0.25, 0.75], axis=0)
        axes.fill_between(hours, low, high, color=style.colour, alpha=0.15, linewidth=0)
        axes.plot(
            hours,
            rows.mean(axis=0),
            color=style.colour,
            linestyle=style.line,
            marker=style.marker,
            markevery=(POINTS // 12, POINTS // 6),
            markersize=4.5,
            label=name,
        )
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("simulated time of a run [h]")
    axes.set_ylabel(label)
    axes.set_title("mean of the runs; band: their middle half", fontsize=9, loc="left")
    axes.legend(loc="upper left")


def _cumulated(frame: pd.DataFrame, counts: Callable[[pd.DataFrame], Any], times: FloatArray) -> FloatArray:
    """How many rows count until each time."""
    at = np.sort(frame["clock"].to_numpy(dtype=float)[np.asarray(counts(frame), dtype=bool)])
    return np.searchsorted(at, times, side="right").astype(np.float64)


def _unsafe_per_run(axes: Axes, results: Results) -> None:
    reported = (lambda told: float(told.per_run[0])) if results.plan.generations == PAPER_GENERATIONS else None
    _grouped(axes, results, "collisions", "colliding scenarios of a run", reported)


def _time_to_collision(axes: Axes, results: Results) -> None:
    _grouped(
        axes,
        results,
        "collision_time",
        "mean time to a collision, where there is one [s]",
        lambda told: told.time_to_collision[0],
    )


def _grouped(
    axes: Axes, results: Results, column: str, label: str, reported: Callable[[Reported], float] | None
) -> None:
    """A bar for every run of every algorithm, and the paper's mean as a line where it can be compared."""
    width = 0.8 / len(results.plan.names)
    for place, name in enumerate(results.plan.names):
        runs, style = of(name, results.whole), style_of(results, name)
        x = runs["run"] + 1 + (place - (len(results.plan.names) - 1) / 2) * width
        axes.bar(
            x,
            runs[column],
            width * 0.92,
            color=style.colour,
            hatch=style.hatch,
            edgecolor="white",
            linewidth=0,
            label=name,
        )
        if name in PAPER and reported is not None:
            height = reported(PAPER[name])
            axes.axhline(height, color=style.colour, linestyle=style.line, linewidth=1.1)
            axes.annotate(
                f"paper: {name}",
                (1.0, height),
                xycoords=("axes fraction", "data"),
                xytext=(3, 0),
                textcoords="offset points",
                va="center",
                fontsize=7.5,
                color="#333333",
                annotation_clip=False,
            )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xticks(range(1, results.plan.runs + 1))
    axes.grid(visible=False, axis="x")
    axes.set_xlabel("run")
    axes.set_ylabel(label)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(results.plan.names))


def _collision_times(axes: Axes, results: Results) -> None:
    edges = np.arange(0.0, np.ceil(results.longest / BIN_SECONDS) + 1) * BIN_SECONDS
    width = BIN_SECONDS * 0.84 / len(results.plan.names)
    for place, name in enumerate(results.plan.names):
        style = style_of(results, name)
        times = simulated(results, name)["collision_time"].dropna().to_numpy(dtype=float)
        counts, _ = np.histogram(times, edges)
        shares = 100 * counts / max(counts.sum(), 1)
        x = edges[:-1] + BIN_SECONDS / 2 + (place - (len(results.plan.names) - 1) / 2) * width
        axes.bar(
            x, shares, width * 0.94, color=style.colour, hatch=style.hatch, edgecolor="white", linewidth=0,
            label=f"{name} ({counts.sum()})",
        )  # fmt: skip
    axes.set_xticks(edges)
    axes.grid(visible=False, axis="x")
    axes.set_xlabel("time of the collision in its scenario [s]")
    axes.set_ylabel("share of an algorithm's unique collisions [%]")
    axes.legend(loc="upper right")


def _first_failure(axes: Axes, results: Results) -> None:
    for name in results.plan.names:
        style = style_of(results, name)
        estimate = statistics.survival(*first_failures(of(name, results.whole)))
        hours = np.array([0.0, *estimate.times]) / SECONDS_PER_HOUR
        shares = 100 * np.array([1.0, *estimate.shares])
        axes.step(
            hours, shares, where="post", color=style.colour, linestyle=style.line, marker=style.marker, markersize=4,
            label=name,
        )  # fmt: skip
    axes.set_xlim(left=0)
    axes.set_ylim(0, 103)
    axes.set_xlabel("simulated time of a run [h]")
    axes.set_ylabel("runs without an ego-responsible failure [%]")
    axes.legend(loc="upper right")


Draw = Callable[[Axes, Results], None]

FIGURES: Mapping[str, tuple[str, Draw, tuple[float, float]]] = {
    "totals": ("Scenarios and collisions in total, beside the paper's", _totals, (7.0, 3.8)),
    "collisions-over-time": ("Collisions over simulated time", _collisions_over_time, (6.0, 3.6)),
    "unsafe-per-run": ("Colliding scenarios of each run", _unsafe_per_run, (7.4, 3.4)),
    "time-to-collision": ("Mean time to a collision of each run", _time_to_collision, (7.4, 3.4)),
    "collision-times": ("When collisions happen", _collision_times, (7.0, 3.6)),
    "discoveries": ("Distinct ego-responsible failures over simulated time", _discoveries, (6.0, 3.6)),
    "first-failure": ("Until the first ego-responsible failure (Kaplan-Meier)", _first_failure, (6.0, 3.6)),
}
"""Title, function and size [inches] by the name of the file."""
