"""The public catalogue: complete, lazy, and free to import."""

import subprocess
import sys

import pytest

import pytest_pafot as pafot


def test_every_public_name_can_be_reached():
    for name in pafot.__all__:
        assert getattr(pafot, name) is not None


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'serach'"):
        pafot.serach  # noqa: B018


def test_dir_lists_the_catalogue():
    assert set(pafot.__all__) <= set(dir(pafot))


def test_importing_the_package_imports_nothing_else():
    code = (
        "import sys; before = set(sys.modules); import pytest_pafot;"
        "new = set(sys.modules) - before - {'pytest_pafot'};"
        "assert not {name for name in new if name.split('.')[0] not in sys.stdlib_module_names}, new"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_importing_a_world_does_not_import_highway_env():
    code = "import sys, pytest_pafot as p; p.Highway(); p.World; assert 'highway_env' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_function_that_rejects_stays_a_function_once_its_module_is_imported():
    code = "import pytest_pafot as p, pytest_pafot.campaign.verdict; assert callable(p.reject)"
    subprocess.run([sys.executable, "-c", code], check=True)
