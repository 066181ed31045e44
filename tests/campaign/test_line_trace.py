"""The lines of a policy that run in its decisions."""

import importlib.util
import sys

import pytest

from pytest_pafot.campaign.line_trace import HELD, LineTrace, places_of, text_of, why_not
from pytest_pafot.support.errors import RequestError

SOURCE = """\
import json


class Planner:
    name = "planner"

    def __call__(self, time):
        json.dumps([time])
        if time > 2:
            return self.brakes(time)
        return 0.0

    def brakes(self, time):
        def strongly():
            return -6.0
        if time == 4:
            raise ValueError(time)
        return min([strongly() for each in range(2)])
"""


@pytest.fixture
def planner(tmp_path):
    return loaded(tmp_path / "planner.py")


def loaded(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("planner", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Planner


def numbers(trace, planner, times, decisions):
    """Return the numbers of the lines that ran in some decisions of a run."""

    def run():
        ads = trace.watched(planner)()
        for time in times:
            ads(time)

    return sorted(each.number for each in trace.lines_in(run, decisions))


def test_lines_of_the_asked_decisions_are_recorded(planner, tmp_path):
    trace = LineTrace()
    assert numbers(trace, planner, [1, 2, 3], range(2)) == [8, 9, 11]
    assert numbers(trace, planner, [1, 2, 3], range(2, 3)) == [8, 9, 10, 14, 15, 16, 18]
    assert numbers(trace, planner, [1, 2, 3], range(3)) == [8, 9, 10, 11, 14, 15, 16, 18]
    assert numbers(trace, planner, [1, 2, 3], range(9, 12)) == []


def test_lines_have_file_function_and_text(planner, tmp_path):
    trace = LineTrace()
    ads = trace.watched(planner)
    found = {each.number: each for each in trace.lines_in(lambda: ads()(3), range(1))}
    assert found[15].function == "Planner.brakes.<locals>.strongly"
    assert found[15].file == str(tmp_path / "planner.py")
    assert text_of(found[15]) == "return -6.0"
    assert {each.function for each in found.values() if each.number > 17} == {"Planner.brakes"}


def test_files_of_installed_packages_count_only_if_they_are_named(tmp_path):
    installed = tmp_path / "project" / "lib" / "site-packages" / "planner.py"
    assert numbers(LineTrace(), loaded(installed), [3], range(1)) == []
    assert numbers(LineTrace([installed]), loaded(installed), [3], range(1)) != []
    assert numbers(LineTrace([installed.parent]), loaded(installed), [3], range(1)) != []
    assert numbers(LineTrace(), loaded(tmp_path / "editable" / "planner.py"), [3], range(1)) != []


def test_a_line_counts_once_in_each_decision(planner):
    trace = LineTrace()
    ads = trace.watched(planner)()
    found = trace.lines_in(lambda: [ads(time) for time in (1, 3, 2)], range(3))
    assert {each.number: count for each, count in found.items() if each.number in (8, 10, 11, 15)} == {
        8: 3, 10: 1, 11: 2, 15: 1,
    }  # fmt: skip


def test_names_are_those_of_packages_and_folders(tmp_path):
    assert places_of(None) == places_of("") == []
    json, folder = places_of(f"json '{tmp_path}'")
    assert (json / "decoder.py").is_file()
    assert folder == tmp_path
    assert [path.name for path in places_of("this")] == ["this.py"]


@pytest.mark.parametrize("names", ["no_such_package", "nowhere/", "'", "os.path"])
def test_a_name_of_nothing_is_refused(names):
    with pytest.raises(RequestError, match=r"lines: expected .* received"):
        places_of(names)


def test_a_watched_ads_is_the_same_otherwise(planner, tmp_path):
    ads = LineTrace().watched(planner)()
    assert ads.name == "planner"
    assert (ads(1), ads(3)) == (0.0, -6.0)
    with pytest.raises(AttributeError, match="batch"):
        ads.batch  # noqa: B018
    with pytest.raises(ValueError, match="4"):
        ads(4)


def test_nothing_is_traced_after_an_exception(planner, tmp_path):
    trace = LineTrace()
    ads = trace.watched(planner)()
    with pytest.raises(ValueError, match="4"):
        trace.lines_in(lambda: ads(4), range(9))
    assert sys.gettrace() is None
    assert why_not() == ""


def test_each_ads_of_a_factory_counts_its_own_decisions(planner, tmp_path):
    trace = LineTrace()
    numbers(trace, planner, [1, 1, 1], range(3))
    assert numbers(trace, planner, [3], range(1)) == [8, 9, 10, 14, 15, 16, 18]


@pytest.mark.skipif(sys.version_info >= (3, 12), reason="there is sys.monitoring")
def test_a_tracer_of_somebody_else_is_left_alone():
    try:
        sys.settrace(lambda *arguments: None)
        assert why_not() == HELD
    finally:
        sys.settrace(None)
    assert why_not() == ""


@pytest.mark.skipif(sys.version_info < (3, 12), reason="there is no sys.monitoring")
def test_tools_of_somebody_else_are_left_alone(planner, tmp_path):
    for tool in (3, 4):
        assert why_not() == ""
        sys.monitoring.use_tool_id(tool, "other")
    try:
        assert why_not() == HELD
    finally:
        for tool in (3, 4):
            assert sys.monitoring.get_tool(tool) == "other"
            sys.monitoring.free_tool_id(tool)
    assert numbers(LineTrace(), planner, [1], range(1)) == [8, 9, 11]
