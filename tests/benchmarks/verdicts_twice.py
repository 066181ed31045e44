"""Do two programs that were written independently come to the same verdicts on random collisions?

The rules are those of docs/explanation/verdicts.md.

    python -m tests.benchmarks.verdicts_twice [--collisions 2000] [--seed 0] [--policies NAME ...] [--workers 2]
        [--instructions cells]

The collisions are shared out evenly among the policies of ``tests.helpers.random_collisions``. The NPCs that do not
cross have Position-Instructions, or with ``--instructions lanes`` or ``both`` Lane-Instructions or either.

Prints by policy and by verdict how often the rules of the package and those of ``tests.helpers.pencil_and_paper`` agree
on who is responsible, on the fault and on the tick. Also prints each collision on which they disagree, with both
answers and the way to reproduce it, and each reason with a number that differs from the trace.
"""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.searching.space import Instructions
from tests.benchmarks.command import options
from tests.helpers import pencil_and_paper
from tests.helpers.random_collisions import POLICIES, collision
from tests.helpers.reasons import numbers


@dataclass(frozen=True)
class Compared:
    """Both answers to one collision, and whether the numbers of the reason are true."""

    policy: str
    verdict: str
    agrees: bool
    is_true: bool
    text: str


def compared(policy: str, number: int, seed: int, instructions: Instructions) -> Compared:
    """Compare both answers to a collision.

    Raises:
        LookupError: No collision is found.
    """
    found = collision(policy, number, seed, instructions)
    first, second = rss_rule(found.trace), pencil_and_paper.judge(found.trace)
    mine = (second.responsibility, second.fault, second.tick)
    theirs = (first.responsibility, first.fault, first.tick)
    try:
        said, true = numbers(found.trace, first)
    except (AssertionError, LookupError, StopIteration, ValueError) as error:
        # The reason describes something that did not happen.
        said, true = [first.reason], [repr(error)]
    text = (
        f"collision({policy!r}, {number}, {seed}, {instructions!r}) in {found.world!r}\n"
        f"    impact at tick {found.trace.collision.tick}, {found.trace.collision!r}\n"
        f"    package: {theirs}: {first.reason}\n    paper:   {mine}: {second.ticks}\n"
        f"    numbers: {said}, by the trace {true}"
    )
    return Compared(policy, f"{first.responsibility}, {first.fault or 'no fault'}", mine == theirs, said == true, text)


def table(compared: list[Compared], key: str) -> str:
    """Return the agreement by policy, or by verdict."""
    every = Counter(getattr(each, key) for each in compared)
    agreed = Counter(getattr(each, key) for each in compared if each.agrees)
    return "\n".join(f"{agreed[name]:6} of {count:5}  {name}" for name, count in sorted(every.items()))


def main() -> None:
    arguments = options(__doc__, collisions=2000, seed=0, policies=POLICIES, workers=2, instructions="cells")
    names, seed, instructions = arguments.policies, arguments.seed, arguments.instructions
    with ProcessPoolExecutor(arguments.workers) as pool:
        jobs = [
            pool.submit(compared, names[index % len(names)], index // len(names), seed, instructions)
            for index in range(arguments.collisions)
        ]
        done, without = [], Counter()
        for index, job in enumerate(jobs):
            try:
                done.append(job.result())
            except LookupError:
                without[names[index % len(names)]] += 1
                continue
            if not (done[-1].agrees and done[-1].is_true):
                print(done[-1].text, flush=True)
    print(f"by policy\n{table(done, 'policy')}\nby verdict\n{table(done, 'verdict')}")
    agree, true = sum(each.agrees for each in done), sum(each.is_true for each in done)
    print(f"{agree} of {len(done)} agree, {true} reasons have true numbers; no collision found: {dict(without)}")


if __name__ == "__main__":
    main()
