"""Which verdicts would a reader of the trace call wrong? The collisions of ``tests.helpers.readings``.

    python -m tests.benchmarks.readings [--sets 1 2 3 4 5 6 7]

Prints by set how many verdicts the reader would not defend, against the ego and in its favour, and each of those with
the reader's answer.
"""

from __future__ import annotations

from collections import Counter

from pytest_pafot import Run
from tests.benchmarks.command import options
from tests.helpers.readings import load


def main() -> None:
    for number in map(int, options(__doc__, sets=[1, 2, 3, 4, 5, 6, 7]).sets):
        counts: Counter[str] = Counter()
        for read in (each for each in load() if each.read_in == number):
            run = Run(read.trace)
            side = "excused" if run.responsibility == "npc" else "blamed"
            counts[side] += 1
            if not read.accepts(run.responsibility):
                counts[f"{side}, not defended"] += 1
                print(f"{read.number}: readers {read.answers}\n{run.explain()}", flush=True)
        print(f"set {number}: {dict(counts)}", flush=True)


if __name__ == "__main__":
    main()
