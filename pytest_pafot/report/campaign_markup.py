"""What the page says of a search without a script: figures, tables and coverage, with a place for its curve."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pytest_pafot.grid import Cell
from pytest_pafot.report.markup import columns, details, facts, row, table, text
from pytest_pafot.report.page_data import CampaignView, CoverageRow, GenerationView
from pytest_pafot.text import plural

ENDS = {
    "": "early",
    "generations": "all generations done",
    "runs": "all runs done",
    "time": "time was over",
    "stopped": "enough was found",
    "error": "with an error",
}
"""Why a search ended."""


def campaign_article(view: CampaignView, index: int, *, is_open: bool = True) -> str:
    """One search, which can be folded: figures, a place for the curve of fitness, coverage."""
    finished, end = len(view.generations), ENDS.get(view.reason, view.reason)
    figures = (
        ("algorithm", view.algorithm),
        ("seed", view.seed),
        ("generations", finished if view.asked in (None, finished) else f"{finished} of {view.asked}"),
        ("runs", view.simulated),
        ("not run again", view.reused),
        ("ended", end),
    )
    failing = sum(each.failing for each in view.generations)
    folded = f"{plural(view.simulated, 'run')}, {failing} failing in its generations"
    folded += f", {plural(len(view.warnings), 'warning')}" if view.warnings else ""
    folded += f", ended {end}" if view.reason in ("error", "interrupted") else ""
    warnings = "".join(f'<p class="warning"><b>Warning</b> {text(warning)}</p>' for warning in view.warnings)
    judged = sum(count for _, count in view.responsibilities)
    return (
        f'<article class="campaign" data-campaign="{index}" aria-labelledby="campaign-{index}">'
        f"<details{' open' if is_open else ''}>"
        f'<summary><h3 id="campaign-{index}" class="id">{text(view.node_id)}</h3>'
        f'<span class="meta">{text(folded)}</span></summary>{facts(figures)}{warnings}<div class="fitness"></div>'
        f"{details('Generations as a table', _generation_table(view.generations))}"
        f'<div class="columns">{_counts("Runs by outcome", view.outcomes, view.simulated)}'
        f"{_counts('Runs by responsibility', view.responsibilities, judged)}</div>"
        "<h4>Coverage: instructions requested, driven and reached</h4>"
        '<p class="note">Requested: in the scenarios as the search asked for them. Driven: as far as the runs came, '
        'after repair. Reached: the NPC arrived in its cell.</p><div class="columns">'
        f"{_coverage('Cells', 'cell', view.cells)}{_coverage('Target speeds', 'speed', view.speeds)}"
        f"{_ring(view.steps)}</div></details></article>"
    )


def _generation_table(generations: Iterable[GenerationView]) -> str:
    head = columns("generation", "best fitness", "mean fitness", "failing", "")
    rows = []
    for each in generations:
        best, mean = ("-" if value is None else f"{value:.3f}" for value in (each.best, each.mean))
        remarks = ["random population after a restart"] if each.restarted else []
        if each.local_best is not None:
            result = "improved the incumbent" if each.local_replaced else "found nothing better"
            remarks.append(f"local search {result}")
        rows.append(row(str(each.generation), best, mean, f"{each.failing} of {each.population}", ", ".join(remarks)))
    return f'<div class="scroll tall">{table(head, rows)}</div>'


def _counts(title: str, counts: Iterable[tuple[str, int]], total: int) -> str:
    rows = "".join(row(text(name.replace("_", " ")), count, _bars(total, driven=count)) for name, count in counts)
    return f"<div><h4>{title}</h4><table><tbody>{rows}</tbody></table></div>" if rows else ""


def _coverage(title: str, what: str, rows: Sequence[CoverageRow]) -> str:
    top = max((each.requested for each in rows), default=0)
    body = []
    for each in rows:
        bars = _bars(top, requested=each.requested, driven=each.driven, reached=each.reached)
        body.append(row(text(each.label), each.requested, each.driven, each.reached, bars))
    return f"<div><h4>{title}</h4>{table(columns(what, 'requested', 'driven', 'reached', ''), body)}</div>"


def _ring(steps: Sequence[CoverageRow]) -> str:
    """From each cell a row: how often an NPC held it, stepped clockwise and stepped anticlockwise."""
    body = [
        f'<tr><th scope="row">{int(cell)} {cell.label}</th>{"".join(map(_step, steps[3 * cell - 3 : 3 * cell]))}</tr>'
        for cell in Cell
    ]
    grid = table(columns("from", "hold", "clockwise", "anticlockwise"), body)
    return f'<div><h4>Steps on the ring <span class="unit">driven / requested, reached</span></h4>{grid}</div>'


def _step(step: CoverageRow) -> str:
    figures = f"{step.driven} / {step.requested}, {step.reached}"
    return f"<td>{figures}</td>" if step.driven else f'<td class="never">{figures} <span class="flag">never</span></td>'


def _bars(top: int, **values: int) -> str:
    """Bars under each other, as shares of the top."""
    bars = "".join(
        f'<svg class="meter {kind}" viewBox="0 0 100 4" preserveAspectRatio="none">'
        f'<rect width="{100 * value / top if top else 0:.1f}" height="4"/></svg>'
        for kind, value in values.items()
    )
    return f'<span class="bars" aria-hidden="true">{bars}</span>'
