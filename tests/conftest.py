"""Tables of highway-env without the arithmetic of pandas, which takes most of the time of making an environment."""

from unittest.mock import patch

import numpy as np
import pandas
import pytest
from highway_env.envs.common.observation import KinematicObservation
from highway_env.utils import lmap

STOCK = KinematicObservation.normalize_obs


def normalized(self, table):
    """Normalise a table as highway-env does, to the last bit."""
    if not self.features_range:
        STOCK(self, table.iloc[:, :0])  # It chooses the ranges.
    values = table.to_numpy(dtype=float, copy=True)
    for column, feature in enumerate(table.columns):
        if feature in self.features_range:
            values[:, column] = lmap(values[:, column], self.features_range[feature], [-1, 1])
            if self.clip:
                values[:, column] = np.clip(values[:, column], -1, 1)
    return pandas.DataFrame(values, columns=table.columns)


@pytest.fixture(autouse=True, scope="module")
def quick_tables():
    """Let highway-env normalise quickly. The package's own tables are equal to both, so a difference would be seen."""
    with patch.object(KinematicObservation, "normalize_obs", normalized):
        yield
