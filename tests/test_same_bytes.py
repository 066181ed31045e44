"""The comparison of two trees leaves out seconds and paths by their place, and nothing else."""

from pathlib import Path

from tests.benchmarks.same_bytes import difference, masked
from tests.helpers.tables import table

TREE = Path("/home/me/tree")


@table(
    ("one", "other"),
    [
        ("=== 3 failed in 1.23s ===", "== 3 failed in 61.23s (0:01:01) =="),
        ("  9 runs, 4 to shrink in 1.8 s, 2 failing", "  9 runs, 4 to shrink in 12.0 s, 2 failing"),
        ("pafot: test_it.py::test_batch[search] 4/9 runs, 1 failing, 1 new, 2/s\n", ""),
        ("  170 decisions, 240 to shrink and 103 to find the moment\n", ""),
        ("test_it.py .FF\n", "test_it.py \npafot: test_it.py::test_batch[search] 4/9 runs\n.FF\n"),
        (f"{TREE}/pytest_pafot/support/interrupts.py:54: KeyboardInterrupt", "TREE/...: KeyboardInterrupt"),
    ],
)  # fmt: skip
def test_seconds_progress_and_paths_are_left_out(one, other):
    assert masked(one, TREE) == masked(other, TREE)


@table(
    ("one", "other"),
    [
        ("=== 3 failed in 1.23s ===", "=== 4 failed in 1.23s ==="),
        ("  9 runs, 4 to shrink in 1.8 s, 2 failing", "  9 runs, 5 to shrink in 1.8 s, 2 failing"),
        ("  9 runs, 4 to shrink in 1.8 s, 2 failing", "  9 runs, 4 to shrink in 1.8 s, 3 failing"),
        ("  The ego should have braked by 4.0 s but did not.", "  The ego should have braked by 4.1 s but did not."),
        ("pafot: found test_it.py::test_batch[saved-front-1]", "pafot: found test_it.py::test_batch[saved-front-2]"),
        ("test_it.py .FF", "test_it.py .F"),
        (f"rootdir: {TREE}2/x", f"rootdir: {TREE}3/x"),
    ],
)  # fmt: skip
def test_all_else_is_compared(one, other):
    assert masked(one, TREE) != masked(other, TREE)


def test_first_line_that_differs_is_named_with_both():
    before = {"1.csv": "a\nb\nc\n", "1.json": "{}"}
    assert difference(before, dict(before)) == ""
    assert difference(before, before | {"1.csv": "a\nB\nC\n"}) == "1.csv, line 2\n    - 'b\\n'\n    + 'B\\n'"
    assert difference(before, {"1.csv": "a\nb\nc\n"}) == "1.json, line 1\n    - '{}'\n    + '(no such file)'"
    assert "line 3" in difference(before, before | {"1.csv": "a\nb\nc"}), "the end of the last line counts, too"
    long = "x" * 1000
    assert difference({"1.csv": f"{long}1"}, {"1.csv": f"{long}2"}).endswith(f"    + '{'x' * 60}2'")
