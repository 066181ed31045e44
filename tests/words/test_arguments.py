"""What strategies and built-in properties say of arguments that they refuse."""

import pytest_pafot as pafot
from pytest_pafot import properties, strategies
from tests.helpers.refusals import error_of
from tests.test_properties import COMFORT, following
from tests.test_strategies import IMPOSSIBLE


def test_bounds_of_strategies_that_are_refused(snapshot):
    told = {f"{given}": error_of(strategies.scenarios, **given) for given in IMPOSSIBLE}
    assert told == snapshot


def test_arguments_of_properties_that_are_refused(snapshot):
    run = pafot.Run(following(100.0))
    told = {name: error_of(properties.comfort, run, **{name: -1.0}) for name in COMFORT}
    assert told | {"rules": error_of(properties.rss_distance, run, rules=2.0)} == snapshot
