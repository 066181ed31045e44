"""Does the kernel drive as highway-env's objects do? Both simulate random runs of every kind, compared to the last bit.

    python -m tests.benchmarks.kernel_against_highway_env [--runs 3000] [--first 0]

highway-env's objects simulate each run twice: with numpy's functions as they are, and with those of
``tests.helpers.c_library``, which round the same on every processor. The latter must give the same run to the last bit.
The former must give the same outcome, and no vehicle may be more than a centimetre from its place in the kernel. A
sample of this is in the suite.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from pytest_pafot.world import kernel
from tests.benchmarks.command import options
from tests.helpers.c_library import c_library
from tests.helpers.engine_cases import Case, differences


def main() -> None:
    arguments = options(__doc__, runs=3000, first=0)
    outcomes: Counter[str] = Counter()
    egos: Counter[str] = Counter()
    same_bits = same_as_numpy = 0
    furthest, flips = 0.0, []
    for seed in range(arguments.first, arguments.first + arguments.runs):
        case = Case.random(seed)
        fast = case.run("kernel")
        with c_library():
            exact = case.run("highway-env")
        stock = case.run("highway-env")
        differs = differences(fast, exact)
        same_bits += not differs
        same_as_numpy += not differences(fast, stock)
        outcomes[str(fast.outcome)] += 1
        egos[case.ego.__name__] += 1
        if differs:
            print(f"seed {seed}: {case.ego.__name__} in {case.world}: {', '.join(differs)}")
        if (fast.outcome, fast.states.shape) == (stock.outcome, stock.states.shape):
            apart = float(np.abs(fast.states[..., :2] - stock.states[..., :2]).max())
            furthest = max(furthest, apart)
            if apart > 0.01:
                print(f"seed {seed}: {case.ego.__name__}: {apart * 1e3:.1f} mm apart with numpy's; {fast!r}")
        else:
            flips.append(f"seed {seed}: {case.ego.__name__}: {fast!r} and {stock!r}")
    print(f"kernel {'compiled' if kernel.is_compiled() else 'interpreted'}, {arguments.runs} runs")
    print(f"outcomes {dict(outcomes)}")
    print(f"egos {dict(egos)}")
    print(f"with the C library's functions: {same_bits} the same to the last bit")
    print(f"with numpy's: {same_as_numpy} the same to the last bit, {len(flips)} with another end, the others within")
    print(f"{furthest * 1e3:.4f} mm")
    for flip in flips:
        print(flip)


if __name__ == "__main__":
    main()
