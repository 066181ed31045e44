"""The modules that are imported with highway-env."""

import subprocess
import sys

import pytest

HEAVY = """
import sys
from pytest_pafot.world.stock import observation

heavy = {"matplotlib", "matplotlib.pyplot", "pandas"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)

import gymnasium, highway_env.vehicle.dynamics as dynamics
shown, _ = gymnasium.make("highway-v0").reset(seed=1)
assert shown.shape == (5, 5)
import matplotlib, pandas
assert observation.pd.DataFrame is pandas.DataFrame
assert dynamics.plt.subplots.__module__ == "matplotlib.pyplot"
assert heavy < set(sys.modules)
"""


@pytest.mark.processes
def test_plot_and_table_libraries_are_imported_when_used():
    subprocess.run([sys.executable, "-c", HEAVY], check=True)
