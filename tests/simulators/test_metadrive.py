"""What ``pafot.metadrive`` refuses before MetaDrive is needed, and what it says where MetaDrive is missing."""

import subprocess
import sys

import pytest

import pytest_pafot as pafot
from pytest_pafot.simulators import metadrive
from pytest_pafot.world import WorldError
from tests.helpers.tables import table

NEEDS_3_11 = pytest.mark.skipif(
    sys.version_info >= (3, 12), reason="there is no MetaDrive for this Python"
)


@NEEDS_3_11
def test_without_metadrive_the_error_names_the_extra(monkeypatch):
    monkeypatch.setattr(metadrive, "find_spec", lambda name: None)
    with pytest.raises(
        WorldError,
        match=r"0.4.3 on Python 3.11, received no MetaDrive. Run `pip install 'pytest-pafot\[metad",
    ):
        _ = pafot.metadrive().road


def test_with_a_later_python_the_error_names_the_python(monkeypatch):
    monkeypatch.setattr(metadrive, "version_info", (3, 13, 1))
    with pytest.raises(
        WorldError, match=r"received Python 3.13. Run `pip install '.*'` with Python 3.11"
    ):
        _ = pafot.metadrive().road


@table(("arguments", "message"), [
    ({"map": "SXS"},
     'map: expected a string of the letters "S" (straight) and "C" (curve), such as "SSSCSS", received \'SXS\''),
    ({"map": ""}, "map: expected a string"),
    ({"map": 3}, "map: expected a string"),
    ({"lanes": 0}, "lanes: expected a whole number from 1 to 12, received 0"),
    ({"observation": "camera"},
     'observation: expected None (for a planner), "lidar" or "vehicle", received \'camera\''),
    ({"sensors": {"camera": {}}}, "sensors: expected only num_lasers and distance for lidar, side_detector, lane_l"),
    ({"sensors": {"lidar": {"gaussian_noise": 0.1}}}, "received {'lidar': {'gaussian_noise': 0.1}}"),
    ({"sensors": {"side_detector": {"num_others": 1}}}, "sensors: expected only num_lasers"),
    ({"sensors": {"lidar": {"num_lasers": -1}}}, "sensors.lidar.num_lasers: expected a whole number from 0 to 1000"),
    ({"sensors": ["lidar"]}, "sensors: expected only num_lasers and distance for lidar"),
])  # fmt: skip
def test_wrong_arguments_are_refused_by_name(monkeypatch, arguments, message):
    monkeypatch.setattr(metadrive, "find_spec", lambda name: True)
    monkeypatch.setattr(metadrive, "version_info", (3, 11, 2))
    with pytest.raises(WorldError) as refused:
        _ = pafot.metadrive(**arguments).road
    assert message in str(refused.value)


def test_another_vehicle_than_metadrives_is_refused():
    with pytest.raises(
        WorldError, match=r"ego: expected MetaDrive's own vehicle, received 'truck'\. Omit ego="
    ):
        pafot.metadrive(ego="truck")


FRESH = """
import sys
import pytest_pafot as pafot
pafot.metadrive(), pafot.sumo(), pafot.simulators.metadrive.expert
assert not {"metadrive", "panda3d", "libsumo", "sumolib"} & set(sys.modules)
"""


def test_a_world_of_a_simulator_imports_it_at_the_first_use():
    subprocess.run([sys.executable, "-c", FRESH], check=True)
