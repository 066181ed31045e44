"""The public catalogue is complete, lazy, and fast to import."""

import subprocess
import sys

import pytest

import pytest_pafot as pafot
from pytest_pafot.searches.options import OPTIONS
from pytest_pafot.searches.request import SearchArguments


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'serach'"):
        pafot.serach  # noqa: B018


def test_users_have_few_names_options_and_arguments_to_learn():
    assert len(pafot.__all__) <= 32
    assert len(OPTIONS) <= 21
    assert len(SearchArguments.__annotations__) <= 20


def test_dir_lists_the_catalogue_in_an_interactive_session(monkeypatch):
    monkeypatch.setattr(sys, "ps1", ">>> ", raising=False)
    assert set(pafot.__all__) <= set(dir(pafot))


FRESH = """
import inspect, sys
before = set(sys.modules)
import pytest_pafot
inspect.getmembers(pytest_pafot)
new = set(sys.modules) - before - {"pytest_pafot"}
assert not {name for name in new if name.split(".")[0] not in sys.stdlib_module_names}, new
from pytest_pafot import *
Highway(), World("highway-v0")
heavy = {"gymnasium", "highway_env", "matplotlib", "pandas", "pygame", "scipy", "torch"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
import pytest_pafot.searches.harness
assert callable(pytest_pafot.reject), "a module in the place of the function"
"""


def test_package_import_loads_only_the_standard_library():
    subprocess.run([sys.executable, "-c", FRESH], check=True)
