"""What ``pafot.metadrive`` refuses before MetaDrive is needed, and what it says where MetaDrive is missing."""

import subprocess
import sys

import pytest

import pytest_pafot as pafot
from pytest_pafot.simulators import metadrive
from tests.helpers.refusals import refused
from tests.helpers.tables import table

NEEDS_3_11 = pytest.mark.skipif(
    sys.version_info >= (3, 12), reason="there is no MetaDrive for this Python"
)


def missing(place):
    """Use a world of MetaDrive where MetaDrive or its Python is missing."""
    place.setattr(metadrive, "find_spec", lambda name: None)
    return pafot.metadrive().road


def of_later_python(place):
    place.setattr(metadrive, "version_info", (3, 13, 1))
    return pafot.metadrive().road


@pytest.mark.parametrize("use", [pytest.param(missing, marks=NEEDS_3_11), of_later_python])
def test_without_metadrive_or_its_python_the_world_is_refused(monkeypatch, use):
    with refused("pafot.metadrive"):
        use(monkeypatch)


WRONG = {
    "another letter": ({"map": "SXS"}, "map"),
    "no letter": ({"map": ""}, "map"),
    "a number": ({"map": 3}, "map"),
    "no lanes": ({"lanes": 0}, "lanes"),
    "an unknown observation": ({"observation": "camera"}, "observation"),
    "an unknown sensor": ({"sensors": {"camera": {}}}, "sensors"),
    "noise": ({"sensors": {"lidar": {"gaussian_noise": 0.1}}}, "sensors"),
    "an option of another sensor": ({"sensors": {"side_detector": {"num_others": 1}}}, "sensors"),
    "a negative number of lasers": ({"sensors": {"lidar": {"num_lasers": -1}}}, "sensors.lidar.num_lasers"),
    "a list of sensors": ({"sensors": ["lidar"]}, "sensors"),
    "another vehicle": ({"ego": "truck"}, "ego"),
}  # fmt: skip


def use(place, arguments):
    """Use a world as if MetaDrive was installed."""
    place.setattr(metadrive, "find_spec", lambda name: True)
    place.setattr(metadrive, "version_info", (3, 11, 2))
    return pafot.metadrive(**arguments).road


@table(("arguments", "field"), WRONG.values())
def test_wrong_arguments_are_refused_by_name(monkeypatch, arguments, field):
    with refused(field):
        use(monkeypatch, arguments)


FRESH = """
import sys
import pytest_pafot as pafot
pafot.metadrive(), pafot.sumo(), pafot.simulators.metadrive.expert
assert not {"metadrive", "panda3d", "libsumo", "sumolib"} & set(sys.modules)
"""


def test_a_world_of_a_simulator_imports_it_at_the_first_use():
    subprocess.run([sys.executable, "-c", FRESH], check=True)
