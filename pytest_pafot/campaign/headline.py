"""One line on what happened in a run that failed."""

from __future__ import annotations

from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.grid import Cell
from pytest_pafot.run import Run


def headline(run: Run, verdict: Verdict) -> str:
    """One line on a find: what happened in the run, and what the function said where that is not the same."""
    if verdict.is_ads and verdict.failure is not None:
        return f"{verdict.failure.kind}: {verdict.failure.message}"
    line = collision_in_short(run) or run.explain().splitlines()[0]
    first = verdict.failure.message.partition("\n")[0].strip() if verdict.failure is not None else ""
    is_bare = run.collision is not None and first.startswith("assert ")
    if is_bare or not first or line.partition(":")[0] in first:
        return line
    kind = "" if isinstance(verdict.exception, AssertionError) else f"{type(verdict.exception).__name__}: "
    return f"{kind}{first[:120]} ({line})"


def collision_in_short(run: Run) -> str:
    """One line on the collision of a run: when, with whom, and whose fault; empty without one."""
    hit = run.collision
    if hit is None:
        return ""
    place = hit.cell.label.replace("front", "ahead").replace("rear", "behind").replace("-", " ")
    place = f"on the {place}" if hit.cell in (Cell.LEFT, Cell.RIGHT) else place
    who = {"ego": "ego", "npc": "NPC", "both": "both"}.get(run.responsibility or "", "nobody")
    return f"collision after {hit.time:.1f} s: NPC {hit.npc} {place}, {who} at fault"
