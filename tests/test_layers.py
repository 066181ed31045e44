"""The rooms of the package and the direction in which imports go."""

import ast
from pathlib import Path

import pytest

import pytest_pafot

PACKAGE = Path(pytest_pafot.__file__).parent

ROOMS = (
    "grid", "scenario", "trace", "criticality", "findings", "searching", "world", "evaluation", "strategies", "report",
    "plugin", "__main__",
)  # fmt: skip
"""A room may import the rooms before it, and itself."""

HOMES = {
    "yaml": {"findings"},
    "highway_env": {"world"},
    "gymnasium": {"world"},
    "hypothesis": {"strategies"},
    "pytest": {"plugin"},
    "_pytest": set(),
    "pluggy": set(),
    "PIL": {"report"},
    "pandas": {"evaluation"},
    "scipy": {"evaluation"},
    "matplotlib": {"evaluation"},
    "pymoo": {"searching"},
    "ribs": {"searching"},
    "cmaes": {"searching"},
    "pytest_html": {"plugin"},
}
"""Libraries that only some rooms may know."""

MODULES = [path for path in sorted(PACKAGE.rglob("*.py")) if path.relative_to(PACKAGE) != Path("__init__.py")]


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imported_names(path: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def test_every_module_belongs_to_a_room():
    assert {room_of(path) for path in MODULES} <= set(ROOMS)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_room_imports_only_rooms_above_it(path):
    own = ROOMS.index(room_of(path))
    for name in imported_names(path):
        parts = name.split(".")
        if parts[0] == "pytest_pafot" and len(parts) > 1 and parts[1] in ROOMS:
            assert ROOMS.index(parts[1]) <= own, f"{path.name} imports {name}"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_library_is_known_only_to_its_rooms(path):
    for name in imported_names(path):
        homes = HOMES.get(name.split(".")[0])
        assert homes is None or room_of(path) in homes, f"{path.name} imports {name}"


def test_no_module_of_the_pure_rooms_touches_clock_or_global_randomness():
    forbidden = {"time", "random", "datetime", "secrets", "uuid"}
    for path in MODULES:
        if room_of(path) in ("grid", "scenario", "trace", "criticality", "searching"):
            assert not {name.split(".")[0] for name in imported_names(path)} & forbidden, path
