"""Edge cases of the ADS: of which kind it is, how it is given, and what it raises."""

import sys
import textwrap

import pytest

VEHICLES = {
    "mark": """
        from highway_env.vehicle.behavior import IDMVehicle

        @pafot.search(SHORT, ads=IDMVehicle, stop_after=1)
        def test_vehicle(run):
            assert run.duration < 1
    """,
    "fixture": """
        from highway_env.vehicle.behavior import IDMVehicle

        @pytest.fixture
        def idm():
            return IDMVehicle

        @pafot.search(SHORT, ads="idm", stop_after=1)
        def test_vehicle(run):
            assert run.duration < 1
    """,
    "partial": """
        import functools
        from highway_env.vehicle.behavior import IDMVehicle

        @pafot.search(SHORT, ads=functools.partial(IDMVehicle, enable_lane_change=False), stop_after=1)
        def test_vehicle(run):
            assert run.duration < 1
    """,
    "world": """
        from highway_env.vehicle.behavior import IDMVehicle

        @pafot.search(ads=IDMVehicle, world=pafot.World("highway-v0", duration=2.0), genes=1, stop_after=1)
        def test_vehicle(run):
            assert run.duration < 1
    """,
}

SLOW_VEHICLE = """
import time
from highway_env.vehicle.behavior import IDMVehicle

class Slow(IDMVehicle):
    def act(self, action=None):
        time.sleep(0.0002)
        super().act(action)

@pafot.search(SHORT, ads=Slow, shrink_rollouts=0)
def test_vehicle(run):
    assert not run.collision
    assert run.min_distance > 1.9
"""


class TestAVehicleClassIsItsOwnFactory:
    @pytest.mark.parametrize("given", VEHICLES)
    def test_for_a_search_and_for_the_replay_of_what_it_finds(self, project, given):
        project.write(textwrap.dedent(VEHICLES[given]))
        project.run("--pafot-shrink-rollouts=5").stdout.fnmatch_lines(["*1 new finding in 1 run*"])
        assert len(project.files) == 1
        project.run(generations=0).assert_outcomes(failed=1, skipped=1)

    @pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
    def test_for_the_processes_of_a_search_too(self, project):
        project.write(SLOW_VEHICLE)
        serial = project.run(generations=2)
        contents = project.contents
        for name in project.files:
            (project.path / name).unlink()
        parallel = project.run("--pafot-workers=2", generations=2)
        parallel.stdout.fnmatch_lines(["*--pafot-workers=2: in use after 3 runs of this process*"])
        assert (project.contents, parallel.parseoutcomes()) == (contents, serial.parseoutcomes())
        assert contents
