"""The extras know ever less of the inside of the core."""

import pytest_pafot
from tests.test_layers import EXTRAS, MODULES, imported_names, room_of

BEYOND_THE_DOOR: dict[str, int] = {}
"""The names that an extra imports from the inside of the core, neither public nor on the page for those who
extend it. Lower a number when it falls; never raise it."""


def test_an_extra_imports_ever_fewer_names_of_the_inside():
    free = ("pytest_pafot.support", "pytest_pafot.extras", "pytest_pafot.extending", "pytest_pafot.door")
    public = {f"pytest_pafot.{name}" for name in pytest_pafot.__all__}
    inside: dict[str, set[str]] = {}
    for path in MODULES:
        if room_of(path) in EXTRAS:
            names = {name for name in imported_names(path) if name.startswith("pytest_pafot.")} - public
            inside.setdefault(room_of(path), set()).update(name for name in names if not name.startswith(free))
    assert {room: len(names) for room, names in inside.items() if names} == BEYOND_THE_DOOR
