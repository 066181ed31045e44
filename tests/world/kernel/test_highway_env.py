"""highway-env's equations are in the kernel, so another highway-env is refused until somebody has compared it."""

import inspect
import tomllib
from hashlib import sha256
from importlib import import_module, metadata
from pathlib import Path

import pytest

NEWEST = "1.12.1"
"""The newest highway-env with which the kernel was compared."""

COPIED = {
    "vehicle.kinematics": ("Vehicle", "068baa95667d"),
    "vehicle.controller": ("ControlledVehicle MDPVehicle", "d7a865a7e7bf"),
    "vehicle.behavior": ("IDMVehicle", "2309208fc995"),
    "vehicle.objects": ("RoadObject", "7d7d4583e9c4"),
    "road.lane": ("AbstractLane StraightLane SineLane CircularLane", "79b213440365"),
    "road.road": ("RoadNetwork Road", "8050cd6a822a"),
    "road.regulation": ("RegulatedRoad", "b92392c433a5"),
    "utils": (
        "are_polygons_intersecting do_every has_corner_inside lmap not_zero point_in_rotated_rectangle "
        "rotated_rectangles_intersect wrap_to_pi",
        "b6c41111ab25",
    ),
    "envs.common.observation": ("KinematicObservation ExitObservation", "5f95143034e9"),
    "envs.common.action": ("ContinuousAction DiscreteMetaAction", "5d4c3985cbea"),
}
"""For each module of highway-env, the names whose equations the kernel has, and the digest of their sources."""

TO_CHECK = f"""
The kernel (pytest_pafot/world/kernel) has the equations of highway-env {NEWEST}, operation by operation.
Before another version is allowed in pyproject.toml:
1. Read `git diff` of highway-env's sources between the two versions, for the names in COPIED and those that they call.
   Change the kernel, and pytest_pafot/world/gym_environment.py for options of environments, in the same way.
2. Run `python -m pytest -n 2 -m oracle` and `python -m pytest -n 2 tests/world`, which compare runs with env.step.
3. Search `docs` and `tests` for the old version. Saved scenarios of users are `drifted` if a run changes: say so in
   docs/changelog.md.
4. Set NEWEST and the digests of COPIED here, and the bound in pyproject.toml and docs/explanation/search.md.
"""


def digest(module, names):
    found = import_module(f"highway_env.{module}")
    return sha256(
        "".join(inspect.getsource(getattr(found, name)) for name in names.split()).encode()
    ).hexdigest()[:12]


@pytest.mark.skipif(
    metadata.version("highway-env") != NEWEST, reason=f"the digests are those of {NEWEST}"
)
def test_what_the_kernel_copies_from_highway_env_is_what_was_compared():
    found = {module: (names, digest(module, names)) for module, (names, _) in COPIED.items()}
    assert found == COPIED, TO_CHECK


def test_no_later_highway_env_can_be_installed_than_was_compared():
    root = Path(__file__).parents[3]
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"highway-env>=1.12,<={NEWEST}" in project["dependencies"], TO_CHECK
    page = (root / "docs/explanation/search.md").read_text(encoding="utf-8")
    assert f"highway-env 1.12 to {NEWEST}" in page, TO_CHECK
