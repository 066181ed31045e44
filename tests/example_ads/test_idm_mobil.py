"""IDM+MOBIL is highway-env's own vehicle class, unchanged."""

import subprocess
import sys

from example_ads import idm_mobil


def test_the_ads_is_the_vehicle_class_itself():
    from highway_env.vehicle.behavior import IDMVehicle

    assert idm_mobil.make() is IDMVehicle


def test_importing_the_example_does_not_import_highway_env():
    code = "import sys, example_ads.idm_mobil; print('highway_env' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "False"
