"""What is told of a find that was made simpler, and tried with reference drivers."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.scenario import PositionInstruction
from pytest_pafot.text import plural


def simplified_lines(finding: Finding, tried: Sequence[str]) -> list[str]:
    """The size of a find before and after, and who would prevent it.

    Args:
        finding: as it is kept.
        tried: names of the reference drivers that were tried in its scenario.
    """
    lines: list[str] = []
    if finding.shrunk is not None:
        after = "as simple as it gets" if finding.original is None else f"to {size_of(finding.scenario)}"
        more = "" if finding.shrunk.is_minimal else ", and could be simpler"
        lines.append(f"shrunk     from {size_of(finding.original or finding.scenario)} {after}{more}")
    if tried:
        lines.append(f"preventable by {', '.join(finding.expect.preventable_by) or 'none of the reference drivers'}")
    return lines


def effort_lines(finding: Finding) -> list[str]:
    """How many runs shrinking took, and the speeds that still fail."""
    if finding.shrunk is None:
        return []
    return [
        f"shrunk in  {plural(finding.shrunk.rollouts, 'run')}",
        *(f"still      {sentence}" for sentence in speed_sentences(finding)),
    ]


def speed_sentences(finding: Finding) -> list[str]:
    """What is known of the speeds at which the scenario still fails."""
    sentences = []
    for interval in () if finding.shrunk is None else finding.shrunk.speeds:
        gene = finding.scenario.npcs[interval.npc][interval.gene]
        place = f"in cell {int(gene.cell)} ({gene.cell.label})" if isinstance(gene, PositionInstruction) else gene.goal
        speeds = f"any speed from {interval.low:.1f} to {interval.high:.1f} m/s"
        if interval.low == interval.high:
            speeds = f"only a speed of {interval.low:.1f} m/s"
        seconds = interval.gene * finding.scenario.gene_seconds
        sentences.append(f"NPC {interval.npc} from {seconds:g} s {place}: {speeds} still fails")
    return sentences
