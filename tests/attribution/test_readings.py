"""Do readers of only the trace come to the same verdicts? Each of 1,350 collisions was read without its verdict.

The file ``verdicts.txt`` has the verdicts on them, on a part of them in a bend, and on random ones at junctions. After
a change of the rules, ``python -m tests.attribution.test_readings`` writes the file again.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from tests.helpers.drives import bent
from tests.helpers.junctions import random_collision
from tests.helpers.readings import load
from tests.helpers.stages import mostly_oracle

VERDICTS = Path(__file__).with_name("verdicts.txt")
NOT_DEFENDED = {
    1, 9, 11, 40, 49, 66, 67, 68, 128, 147, 174, 195, 283, 289, 307, 338, 368, 384, 391, 481, 509, 547, 614,
    620, 647, 682, 709, 774, 956, 973, 1005, 1010, 1028, 1062, 1066, 1077, 1178, 1215, 1253, 1292, 1304, 1347,
}  # fmt: skip
"""Collisions whose verdict the reader would not defend; ``python -m tests.benchmarks.readings`` gives the reasons."""


def in_bend(trace):
    """Return the same run on a road that bends to the right."""
    vehicles, road = bent(*trace.states.swapaxes(0, 1), lane_count=4)
    return replace(trace, states=np.stack(vehicles, axis=1), **road)


def verdicts(every):
    """Return verdicts as lines, of which ``every`` third or all."""
    traces = {f"reading {read.number}": read.trace for read in load()[::every]}
    traces |= {
        f"{name} in a bend": in_bend(trace) for name, trace in [*traces.items()][:: 6 // every]
    }
    traces |= {f"junction {number}": random_collision(number) for number in range(0, 600, every)}
    found = [(name, rss_rule(trace)) for name, trace in traces.items()]
    return [
        f"{name}: {each.responsibility} {each.fault} at tick {each.tick}\n" for name, each in found
    ]


@pytest.mark.parametrize("every", mostly_oracle([1, 3], 3))
def test_readers_accept_all_verdicts_except_the_listed(every):
    reads = load()
    assert len(reads) == 1350
    read_again = reads[::every]
    disputed = {
        read.number for read in read_again if not read.accepts(rss_rule(read.trace).responsibility)
    }
    assert disputed == NOT_DEFENDED & {read.number for read in read_again}


@pytest.mark.parametrize("every", mostly_oracle([1, 3], 3))
def test_verdicts_are_the_kept_ones(every):
    kept = VERDICTS.read_text(encoding="utf-8").splitlines(keepends=True)
    found = verdicts(every)
    assert [line for line in found if line not in {*kept}] == []
    assert every > 1 or found == kept


if __name__ == "__main__":
    VERDICTS.write_text("".join(verdicts(1)), encoding="utf-8")
