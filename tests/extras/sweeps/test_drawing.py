"""Maps on a page, in a notebook and as a picture."""

import base64
import hashlib
import io
import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.extras.sweeps import drawing
from pytest_pafot.extras.sweeps.drawing import COLOURS, page, png
from pytest_pafot.extras.sweeps.maps import MEANINGS
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.markup import content_hash
from pytest_pafot.support.text import visible
from tests.extras.sweeps.planted import keeps_speed, mapped
from tests.helpers.hostile import WORST
from tests.report.builders import HOSTILE
from tests.report.test_page import Reader

PICTURE = ("..X", ".#?")


def that_says(text):
    """Return a map that contains a text wherever one of a user or of a file can be; a sweep makes it printable."""
    text, made = visible(text), mapped(*PICTURE)
    axes = tuple(replace(axis, name=text) for axis in made.axes)
    points = tuple(replace(point, words=text) for point in made.points)
    return replace(made, name=text, axes=axes, points=points)


def data_of(text):
    return json.loads(Reader(text).raw["script:application/json"])["points"]


@pytest.fixture(scope="module")
def made():
    return mapped(*PICTURE)


def test_equal_maps_give_equal_pages(made):
    assert page(mapped(*PICTURE)) == page(made)


def test_hostile_text_stays_text_on_a_page():
    harmless = Reader(page(that_says("harmless")))
    expected = [(tag, list(attrs)) for tag, attrs in harmless.tags]
    for text in (*HOSTILE, WORST):
        told = page(that_says(text))
        assert told.encode("utf-8")
        hostile = Reader(told)
        assert [(tag, list(attrs)) for tag, attrs in hostile.tags] == expected, text
        assert hostile.raw["script:"] == harmless.raw["script:"]
        assert data_of(told)[0]["words"] == f"{MEANINGS['avoided']}: {visible(text)}"


def test_words_of_an_assertion_are_printable_on_a_page():
    def fails(run):
        raise AssertionError(WORST)

    made = mapped(*PICTURE, holds=fails)
    assert made.preventable + made.count("unavoidable") == 5
    assert all(point.words.isprintable() for point in made.points)
    assert "<img" not in page(made)


def test_page_allows_own_style_and_script_and_nothing_else(made):
    reader = Reader(page(made))
    policy = next(
        attrs["content"] for tag, attrs in reader.tags if attrs.get("http-equiv") == "Content-Security-Policy"
    )

    def hash_of(text):
        return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"

    assert policy == (
        f"default-src 'none'; style-src {hash_of(reader.raw['style:'])}; script-src {hash_of(reader.raw['script:'])}; "
        "base-uri 'none'; form-action 'none'"
    )
    assert content_hash(reader.raw["style:"]) in policy
    assert not {name for _, attrs in reader.tags for name in attrs if name.startswith("on") or name == "style"}


def test_page_refers_to_nothing_outside_itself(made):
    text = page(made)
    tags = {tag for tag, _ in Reader(text).tags}
    assert not {"link", "img", "iframe", "object", "embed", "base", "a", "form"} & tags
    assert not re.search(r"(?<!-)\b(src|href|action)=", text)
    assert {*re.findall(r"https?://[^\s\"'<]+", text)} <= {"http://www.w3.org/2000/svg"}
    assert "@import" not in text
    assert "url(" not in text


def test_each_point_tells_its_numbers_without_scripts(made):
    reader = Reader(page(made))
    buttons = {int(attrs["data-point"]): attrs for _, attrs in reader.tags if "data-point" in attrs}
    for number, point in enumerate(made.points):
        told = f"{made.where(point.at)}: {MEANINGS[point.kind]}; {point.words}"
        assert (buttons[number]["title"], buttons[number]["aria-label"]) == (told, told)
    assert [*buttons] == [3, 4, 5, 0, 1, 2]  # the largest row is the highest
    words = " ".join(reader.words)
    assert made.headline in words
    assert {kind for kind, meaning in MEANINGS.items() if meaning in words} == {*MEANINGS} - {"ADS error"}


def test_page_plays_the_runs_that_were_driven():
    sweep = pafot.sweep("r157/cut-in", keeps_speed, over={"gap": [0, 30]})
    for told, point in zip(data_of(page(sweep)), sweep.points, strict=True):
        frames, trace = np.array(told["frames"]), point.trace
        assert frames.shape == (len(told["times"]), 2, 4)
        assert frames[0, 0].tolist() == [0, 0, 0, pytest.approx(trace.states[0, 0, 3])]
        assert told["times"][-1] == pytest.approx(trace.duration, abs=0.01)
        distance = trace.states[-1, 1, :2] - trace.states[0, 0, :2]
        assert frames[-1, 1, :2] == pytest.approx(distance, abs=1e-3)
        assert len(told["lanes"]) == len(trace.lanes)
        assert told["sizes"] == trace.sizes.tolist()


def test_page_plays_no_run_of_points_without_one():
    made = mapped("..", "?.")
    played = ["frames" in told for told in data_of(page(made))]
    assert played == [point.trace is not None for point in made.points]
    assert played.count(False) == 1


def test_only_so_many_runs_are_played_those_to_prevent_first(monkeypatch):
    monkeypatch.setattr(drawing, "MOST_PLAYED", 2)
    told = data_of(page(mapped("...", "..X")))
    assert ["frames" in each for each in told] == [True, False, True, False, False, False]


def test_notebook_frames_the_page_and_only_runs_its_scripts():
    for text in ("a map", *HOSTILE):
        made = that_says(text)
        ((tag, attrs),) = Reader(made._repr_html_()).tags
        assert (tag, attrs["sandbox"], attrs["title"]) == ("iframe", "allow-scripts", visible(text))
        assert attrs["srcdoc"] == page(made)


def test_page_of_one_axis_has_one_row():
    sweep = pafot.sweep("r157/cut-in", keeps_speed, over={"gap": "0:60:3"})
    tags = [tag for tag, attrs in Reader(page(sweep)).tags if tag == "tr"]
    assert len(tags) == 2
    assert "<caption>Gap at which it begins to change lanes [m] across</caption>" in page(sweep)
    assert "A slower vehicle changes into the ego" in page(sweep)


def cells_of(picture):
    """Return the rows and columns of cells in a picture of a checkerboard, counted by changes of colour."""
    image = pytest.importorskip("PIL.Image").open(io.BytesIO(picture))
    pixels = np.asarray(image.convert("RGB"))
    coloured = [(pixels == tuple(bytes.fromhex(COLOURS[kind][1:]))).all(axis=-1) for kind in ("avoided", "preventable")]
    marks = np.select(coloured, [1, 2], 0)

    def changes(line):
        line = line[line > 0]
        return 1 + np.count_nonzero(np.diff(line)) if line.size else 0

    columns = np.array([changes(line) for line in marks])
    rows = np.flatnonzero(columns == columns.max())  # the legend has fewer
    grid = marks[rows[0] : rows[-1] + 1]
    return max(map(changes, grid.T)), columns.max()


def test_picture_has_a_cell_for_each_point():
    pytest.importorskip("matplotlib")
    picture = png(mapped("X.X.X", ".X.X.", "X.X.X"))
    assert picture.startswith(b"\x89PNG\r\n\x1a\n")
    assert cells_of(picture) == (3, 5)
    assert png(mapped("X.X.X", ".X.X.", "X.X.X")) == picture


def test_points_that_are_not_as_asked_are_hatched():
    image = pytest.importorskip("PIL.Image").open(io.BytesIO(png(mapped("???", "???"))))
    middle = np.asarray(image.convert("L"))[image.height // 3, :]
    inside = middle[image.width // 4 : 3 * image.width // 4] < 200
    lines = np.count_nonzero(np.diff(inside.astype(int)) == 1)
    assert lines > 10  # oblique lines on white; without them there are at most the three edges of cells


def test_picture_has_a_line_on_an_island():
    pytest.importorskip("matplotlib")
    image = pytest.importorskip("PIL.Image")
    pictures = (("...", "...", "XXX"), ("...", ".X.", "..."))
    without, island = (image.open(io.BytesIO(png(mapped(*picture)))).height for picture in pictures)
    assert without < island


def test_picture_without_matplotlib_says_what_to_install(monkeypatch, made):
    monkeypatch.setitem(sys.modules, "matplotlib.colors", None)
    with pytest.raises(RequestError, match=r"png: expected matplotlib to be installed; pip install .*\[compare\]"):
        png(made)


def test_colours_differ_in_lightness():
    def lightness(colour):
        red, green, blue = bytes.fromhex(colour[1:])
        return 0.2126 * red + 0.7152 * green + 0.0722 * blue

    light = sorted(map(lightness, COLOURS.values()))
    assert min(np.diff(light)) > 10
