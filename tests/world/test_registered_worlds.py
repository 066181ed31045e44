"""Worlds of installed packages: a file names a registered kind of world, and no other code."""

import pytest

from pytest_pafot import Highway, WorldError
from pytest_pafot.world.codec import GROUP, changes, described, from_dict, is_code
from tests.helpers.tables import table


class Ring:
    """A user's own world that a file can describe."""

    speed_limit, longest_run = 26.8, 10.0

    def __init__(self, lanes):
        self.lanes = lanes

    def rollout(self, scenario, ads_factory):
        return Highway(lanes=self.lanes, duration=10.0).rollout(scenario, ads_factory)

    def to_dict(self):
        return {"lanes": self.lanes}

    @classmethod
    def from_dict(cls, data):
        return cls(data["lanes"])


class Broken(Ring):
    @classmethod
    def from_dict(cls, data):
        return "no world"


class Unwritable(Ring):
    def to_dict(self):
        return {"lanes": object()}


@pytest.fixture
def ring(register):
    register(GROUP, ring=f"{__name__}:Ring")


@pytest.mark.usefixtures("ring")
def test_file_with_kind_and_data_restores_the_world():
    data = described(Ring(3))
    assert data == {"kind": "ring", "data": {"lanes": 3}}
    assert not is_code(data)
    assert changes(data, Ring(4)) == []
    again = from_dict(data)
    assert (type(again), again.lanes) == (Ring, 3)


def test_unregistered_world_is_described_by_its_class():
    assert described(Ring(3)) == {"kind": "own", "class": "Ring", "data": {"lanes": 3}}


@pytest.mark.usefixtures("ring")
def test_derived_class_is_not_registered_with_its_base():
    assert described(Broken(3))["kind"] == "own"


def test_only_entry_points_of_its_package_are_imported(register):
    register(GROUP, other="no_such_package:Ring", ring=f"{__name__}:Ring")
    assert described(Ring(3))["kind"] == "ring"


def test_the_kinds_of_this_package_cannot_be_taken(register):
    register(GROUP, highway=f"{__name__}:Ring", own=f"{__name__}:Ring")
    assert from_dict({"kind": "highway"}) == Highway()
    assert described(Ring(3))["kind"] == "own"


def test_wrappers_in_a_file_are_refused_with_both_ways_to_give_them():
    with pytest.raises(WorldError, match=r"world\.wrappers: .*in the test, or by --world module:factory"):
        from_dict({"kind": "gym", "env_id": "highway-v0", "wrappers": ["FlattenObservation"]})


@pytest.mark.usefixtures("ring")
@table("kind", ["rings", "tests.world.test_registered_worlds:Ring", "os:system", "", None])
def test_unknown_kind_is_refused_with_known_kinds(kind):
    message = r"world.kind: expected one of gym, highway, ring, received .*; a package .*pytest_pafot.worlds may not be"
    with pytest.raises(WorldError, match=message):
        from_dict({"kind": kind, "data": {"lanes": 3}})


@pytest.mark.parametrize(
    ("value", "data", "message"),
    [
        ("no_such_package:Ring", {"lanes": 3}, r"that no_such_package:Ring, .*, can be imported, received ModuleNot"),
        (f"{__name__}:Ringg", {"lanes": 3}, r"can be imported, received AttributeError"),
        (
            f"{__name__}:Ring",
            {"lane": 3},
            r"world.data: expected data that .*Ring.from_dict accepts, .*; it raised KeyError",
        ),
        (f"{__name__}:Broken", {}, r"returns a world, received 'no world', which has no rollout, to_dict, speed_limit"),
    ],
)
def test_data_without_world_is_refused_with_cause(register, value, data, message):
    register(GROUP, ring=value)
    with pytest.raises(WorldError, match=message):
        from_dict({"kind": "ring", "data": data})


@pytest.mark.usefixtures("ring")
@pytest.mark.parametrize("world", [{"kind": "ring"}, {"kind": "ring", "lanes": 3}])
def test_all_but_the_kind_is_in_its_data(world):
    with pytest.raises(WorldError, match=r"world \(kind ring\): expected the field data, received (none|lanes)"):
        from_dict(world)


def test_unwritable_data_is_refused_before_finding_is_lost(register):
    register(GROUP, ring=f"{__name__}:Unwritable")
    with pytest.raises(WorldError, match=r"Unwritable.to_dict: .*expected plain data"):
        described(Unwritable(3))
