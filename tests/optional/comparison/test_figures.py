"""All algorithms can be distinguished in the figures."""

import pytest

from pytest_pafot.comparison.figures import STYLES, draw_all
from pytest_pafot.comparison.plan import COLUMNS, run_rows
from pytest_pafot.comparison.run_measures import Results
from pytest_pafot.searching import ALGORITHMS
from pytest_pafot.support.text import csv_text


def test_each_algorithm_has_unique_colour_line_and_marker():
    assert len(STYLES) >= len(ALGORITHMS)
    for name in ("colour", "line", "marker"):
        assert len({getattr(style, name) for style in STYLES}) == len(STYLES), name


@pytest.mark.filterwarnings("error")
def test_runs_without_duration_end_and_are_drawn_without_warning(tmp_path, quick):
    """Each run fails at its first decision, and in two ways, so the setup is not at fault."""
    plan = quick(ads=f"{__name__}:failing_in_two_ways", algorithms=("random",), runs=1, seconds=3.0)
    rows = run_rows(plan, ("random", 0))
    (tmp_path / "results.csv").write_text(
        csv_text(tuple(COLUMNS), ([row.get(name) for name in COLUMNS] for row in rows))
    )
    results = Results.of(plan, tmp_path / "results.csv")
    assert (len(rows), results.horizon) == (12, 0.0)
    assert "discoveries" in draw_all(results, tmp_path)


def failing_in_two_ways():
    def drive(observation):
        raise (ValueError if observation.others[0].x > observation.ego.x else KeyError)("no plan")

    return drive
