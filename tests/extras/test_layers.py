"""The extras know nothing of the inside of the core."""

import pytest_pafot
from tests.test_layers import EXTRAS, MODULES, imported_names, room_of


def test_an_extra_imports_only_what_a_package_of_somebody_else_may_import():
    free = ("pytest_pafot.support", "pytest_pafot.extras", "pytest_pafot.extending", "pytest_pafot.door")
    public = {f"pytest_pafot.{name}" for name in pytest_pafot.__all__}
    inside = [
        f"{path}: {name}"
        for path in MODULES
        if room_of(path) in EXTRAS
        for name in imported_names(path)
        if name.startswith("pytest_pafot.") and name not in public and not name.startswith(free)
    ]
    assert inside == []
