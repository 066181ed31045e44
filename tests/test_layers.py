"""The rooms of the package and the direction in which imports go."""

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import pytest_pafot
from tests.helpers.walks import ROUTES

PACKAGE = Path(pytest_pafot.__file__).parent

ROOMS = (
    "support", "model", "criticality", "attribution", "oracle", "properties", "findings", "algorithms", "corpus",
    "world", "simulators", "execution", "strategies", "searches", "commands", "report", "plugin", "policies", "testing",
    "comparison", "export", "__main__",
)  # fmt: skip
"""The rooms in order: each may import the rooms before it, and itself."""

HOMES = {
    "yaml": {"corpus"},
    "cloudpickle": {"execution"},
    "distributed": {"execution"},
    "highway_env": {"world"},
    "gymnasium": {"world"},
    "hypothesis": {"strategies"},
    "pytest": {"plugin"},
    "_pytest": set(),
    "pluggy": set(),
    "pandas": {"comparison", "oracle"},
    "scipy": {"comparison"},
    "matplotlib": {"comparison"},
    "stable_baselines3": {"policies"},
    "sb3_contrib": {"policies"},
    "torch": {"policies"},
    "scenariogeneration": {"export"},
    "foxglove": {"export"},
    "commonroad": {"export"},
    "libsumo": {"simulators"},
    "sumolib": {"simulators"},
    "metadrive": {"simulators"},
}
"""Libraries that only some rooms may import."""

OPTIONAL = {
    "pandas", "scipy", "matplotlib", "stable_baselines3", "sb3_contrib", "torch", "scenariogeneration", "foxglove",
    "commonroad", "libsumo", "sumolib", "metadrive", "cloudpickle", "distributed",
}  # fmt: skip
"""Libraries that cost time to import, or that need not be installed."""

CLIMBS = {"collision": 4, "check": 4, "environment": 5, "workers": 3, "replay": 2}
"""For each route the number of pairs of files of which the lower one calls the higher one. Numbers here only fall.

Such a call is one of something that was passed in, so a reader of the lower file cannot see what it does.
"""

QUESTION = re.compile(
    r"isinstance\(.*\b(StraightRoad|NetworkRoad|JunctionRoad|Network|JunctionDirector)\b"
    r"|\b(track|crossings|straight_road) is (not )?None|\bis_(straight|bent)\b(?! = |: bool|: [Tt]rue)"
)
"""What asks a road, or a run on it, for its kind. A new kind of road must look at each such line."""

QUESTIONS = {
    "searches/request.py": 1,  # whether NPCs can cross at all
    "criticality/signals.py": 1,  # places on two ways are of use only together
    "model/trace.py": 1,  # the one place that chooses the kind
    "report/views.py": 1,  # two kinds of pictures, and the page has both
    # how far ahead is along the ego's heading there; and whether NPCs can cross
    "algorithms/evaluation.py": 1,
    "algorithms/space.py": 3,  # whether NPCs can cross at all
    # hands the straight road to whoever draws starts on it; an error about crossings where there are none
    "world/base_world.py": 2,
    # highway-env's vehicles have two compiled classes, by their lanes
    "world/driving/vehicles.py": 3,
    "world/engines/policies.py": 1,  # the same
    "world/gym_environment.py": 6,  # what options of highway-env do, and which routes it plans
    "world/gym_world.py": 2,  # how long runs of such an environment are, and who makes its policy
    "world/kernel/loop.py": 4,  # a C flag, because it is read at each tick
}
"""For each file the number of lines that match :data:`QUESTION`. Numbers here only fall: ask the road itself."""

HOOKS = ("pytest_",)
"""How the names of functions begin that pytest calls for whoever implements them: they may be in any file."""

OUTSIDE = {PACKAGE / "__init__.py"}
MODULES = [path for path in sorted(PACKAGE.rglob("*.py")) if path not in OUTSIDE]


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the statements directly inside a node, and those inside them; expressions are skipped for speed."""
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        inner = getattr(node, name, ())
        yield from inner if isinstance(inner, list) else ()


def walked(node: ast.AST) -> Iterator[ast.AST]:
    for inner in statements(node):
        yield inner
        yield from walked(inner)


@cache
def imports_of(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """Return the imports anywhere in a module, including those inside functions and only for types."""
    nodes = walked(ast.parse(path.read_text(encoding="utf-8")))
    return [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]


def imported_names(path: Path) -> list[str]:
    names = []
    for node in imports_of(path):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(path: Path, known: set[str]) -> set[str]:
    """Return the package's modules that a module imports anywhere, also inside functions and only for types."""
    names = set()
    for node in imports_of(path):
        if isinstance(node, ast.ImportFrom):
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in known else str(node.module) for name in inner}
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return (names & known) - {module_name(path)}


def floors(arrows: dict[str, set[str]]) -> dict[str, int]:
    """Return the floor of each module, which is higher than that of each module that it imports."""

    @cache
    def floor(module: str) -> int:
        return 1 + max(map(floor, arrows[module]), default=0)

    return {module: floor(module) for module in arrows}


def climbs(calls: Iterable[tuple[str, str, str]], floor: dict[str, int]) -> dict[str, set[str]]:
    """Return the functions by which a lower module calls a higher one, by both modules."""
    found: dict[str, set[str]] = {}
    for caller, called, function in calls:
        if caller and floor[called] > floor[caller] and not function.startswith(HOOKS):
            found.setdefault(f"{caller} -> {called}", set()).add(function)
    return found


def arrows_of_the_package() -> dict[str, set[str]]:
    known = {module_name(path) for path in MODULES}
    return {module_name(path): imported_modules(path, known) for path in MODULES}


def test_every_module_belongs_to_a_room():
    assert {room_of(path) for path in MODULES} <= set(ROOMS)


def test_a_room_imports_only_rooms_below_it():
    above = []
    for path in MODULES:
        own = ROOMS.index(room_of(path))
        for name in imported_names(path):
            room = name.removeprefix("pytest_pafot.").split(".")[0]
            if name.startswith("pytest_pafot.") and room in ROOMS and ROOMS.index(room) > own:
                above.append(f"{path.relative_to(PACKAGE)} imports {name}")
    assert above == []


def test_an_optional_library_is_imported_at_import_time_only_by_three_rooms():
    at_import = set()
    for path in MODULES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            names = [each.name for each in node.names] if isinstance(node, ast.Import) else []
            names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
            at_import |= {room_of(path) for name in names if name.split(".")[0] in OPTIONAL}
    assert at_import == {"comparison", "export", "simulators"}


def test_a_library_is_known_only_to_its_rooms():
    strangers = [
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in MODULES
        for name in imported_names(path)
        if room_of(path) not in HOMES.get(name.split(".")[0], ROOMS)
    ]
    assert strangers == []


def test_only_one_module_imports_highway_env_because_it_postpones_plot_and_table_libraries():
    importers = [
        path
        for path in MODULES
        if any(name.split(".")[0] == "highway_env" for name in imported_names(path))
    ]
    assert importers == [PACKAGE / "world" / "stock.py"]


def test_no_modules_import_each_other_in_a_circle():
    TopologicalSorter(arrows_of_the_package()).prepare()  # it raises CycleError with the circle


def test_pure_rooms_use_no_clock_or_global_randomness():
    forbidden = {"time", "random", "datetime", "secrets", "uuid"}
    for path in MODULES:
        if room_of(path) in ("model", "oracle", "criticality", "attribution", "algorithms"):
            assert not {name.split(".")[0] for name in imported_names(path)} & forbidden, path


@pytest.mark.skipif(not hasattr(os, "fork"), reason="each route is followed in a fork")
def test_no_route_climbs_more_often_than_before(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "tests.helpers.walks", str(tmp_path)],
        cwd=PACKAGE.parent, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
        env={name: value for name, value in os.environ.items() if name != "CI"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    # it imports what it is asked for
    floor = floors(arrows_of_the_package()) | {"pytest_pafot": sys.maxsize}
    wrong = []
    for route in ROUTES:
        calls = json.loads((tmp_path / f"{route}.json").read_text())
        names = [
            (*(module_name(PACKAGE / file) if file else "" for file in files), each)
            for *files, each in calls
        ]
        found, most = climbs(names, floor), CLIMBS[route]
        print(f"{route}: {len({called for _, called, _ in names})} files, {len(found)} climbs")
        if len(found) > most:
            new = "\n".join(
                f"    {pair}: {', '.join(sorted(functions))}"
                for pair, functions in sorted(found.items())
            )
            wrong.append(
                f"{route}: {len(found)} climbs, at most {most} are allowed; remove the new ones of\n{new}"
            )
        if len(found) < most:
            wrong.append(
                f"{route}: {len(found)} climbs, fewer than {most}: lower the number in CLIMBS"
            )
    assert not wrong, "\n".join(wrong)


def test_questions_about_the_kind_of_a_road_only_become_fewer():
    found = {
        str(path.relative_to(PACKAGE)): sum(
            map(bool, map(QUESTION.search, path.read_text(encoding="utf-8").split("\n")))
        )
        for path in PACKAGE.rglob("*.py")
    }
    assert {path: count for path, count in sorted(found.items()) if count} == QUESTIONS
