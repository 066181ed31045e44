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


FROZEN = """
import datetime, sys, time
from pytest_pafot.support import monotonic

class Date(datetime.date): ...
class Datetime(datetime.datetime, Date): ...
datetime.date, datetime.datetime = Date, Datetime
clocks = {id(getattr(time, name)) for name in ("time", "monotonic", "perf_counter")}
for module in list(sys.modules.values()):
    for name in [name for name, value in vars(module).items() if id(value) in clocks]:
        setattr(module, name, lambda: 0.0)

from pytest_pafot.world.stock import observation
assert observation.pd.DataFrame({"x": [1]}).x.sum() == 1
assert (datetime.date, datetime.datetime) == (Date, Datetime)
assert 0.0 == time.monotonic() < monotonic() < monotonic()
"""


@pytest.mark.processes
def test_pandas_can_be_imported_while_a_test_freezes_the_clock():
    """As freezegun does it. Parts of pandas are compiled for the true classes, and the process died."""
    subprocess.run([sys.executable, "-c", FROZEN], check=True)
