"""Do readers of only the trace come to the same verdicts? Each of 1,350 collisions was read without its verdict."""

import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from tests.helpers.readings import load
from tests.helpers.stages import mostly_oracle

NOT_DEFENDED = {
    141, 144, 264, 283, 286, 363, 481, 519, 593, 599, 601, 609, 614, 620, 647, 835, 897, 956, 973, 987, 1005,
    1010, 1037, 1062, 1066, 1218, 1222, 1257, 1304,
}  # fmt: skip
"""Collisions whose verdict the reader would not defend; ``python -m tests.benchmarks.readings`` gives the reasons."""


@pytest.mark.parametrize("every", mostly_oracle([1, 3], 3))
def test_readers_accept_all_verdicts_except_the_listed(every):
    reads = load()
    assert len(reads) == 1350
    read_again = reads[::every]
    disputed = {read.number for read in read_again if not read.accepts(rss_rule(read.trace).responsibility)}
    assert disputed == NOT_DEFENDED & {read.number for read in read_again}
