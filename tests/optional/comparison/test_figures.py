"""All algorithms can be distinguished in the figures."""

import pytest
from matplotlib.figure import Figure

from pytest_pafot.comparison.algorithm_run import run_rows, text_of
from pytest_pafot.comparison.figures import STYLES, draw_all
from pytest_pafot.comparison.run_measures import Results
from pytest_pafot.searching import ALGORITHMS


def test_each_algorithm_has_unique_colour_line_and_marker():
    assert len(STYLES) >= len(ALGORITHMS)
    for name in ("colour", "line", "marker", "hatch"):
        assert len({getattr(style, name) for style in STYLES}) == len(STYLES), name


@pytest.mark.filterwarnings("error")
def test_runs_without_duration_are_drawn_without_warning(tmp_path, quick, monkeypatch):
    """Each run fails at its first decision, and in two ways, so the setup is not at fault."""
    plan = quick(ads="tests.optional.comparison.test_figures:failing_in_two_ways", algorithms=("random",), runs=1)
    (tmp_path / "results.csv").write_text(text_of(run_rows(plan, "random", 0)))
    results = Results.of(plan, tmp_path / "results.csv")
    assert results.horizon == 0.0
    monkeypatch.setattr(Figure, "savefig", laid_out)
    assert "first-failure" in draw_all(results, tmp_path)


def laid_out(figure, buffer, *, format, **options):  # noqa: A002
    """Trigger once everything that may warn about the content of a figure."""
    if format == "svg":
        figure.draw_without_rendering()


def failing_in_two_ways():
    def drive(observation):
        raise (ValueError if observation.others[0].x > observation.ego.x else KeyError)("no plan")

    return drive
