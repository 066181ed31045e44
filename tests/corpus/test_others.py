"""The corpus in the package: failures of policies by others, which any search can begin with."""

import re

import pytest

import pytest_pafot as pafot
from pytest_pafot.campaign.beginnings import OTHERS, begun_with, others
from pytest_pafot.campaign.options import Settings
from pytest_pafot.campaign.request import build_space, checked_request
from pytest_pafot.corpus.layout import files_below
from pytest_pafot.searching import SearchSpace
from pytest_pafot.world.guard.own_worlds import base_world

FILES = files_below(others())


def test_there_are_files_of_several_policies():
    assert len({file.parent for file in FILES}) >= 10
    assert len({pafot.load(file).scenario for file in FILES}) == len(FILES) >= 30


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}-{file.name.split('.')[0]}")
def test_a_file_is_no_fault_of_an_npc_alone_and_tells_nothing_of_a_machine(file):
    saved = pafot.load(file)
    assert saved.expect.responsibility in ("ego", "both", "none")
    assert saved.finding.flaky is None
    assert not re.search(
        r"/(home|root|tmp|work|usr|opt)/|TMP|xfail: \S", file.read_text().replace('# xfail: "reason"', "")
    )


@pytest.mark.parametrize(
    "world",
    [
        pafot.Highway(),
        pafot.Highway(lanes=3, speed_limit=20.0),
        pafot.World("highway-fast-v0"),
        pafot.World("merge-v0"),
        pafot.World("roundabout-v0"),
    ],
    ids=["highway", "narrow", "highway-fast-v0", "merge-v0", "roundabout-v0"],
)
def test_a_search_in_any_world_can_begin_with_what_fits(world):
    settings = Settings(begin_with=OTHERS, algorithm="distinct", seed=0)
    request = checked_request({"ads": lambda: lambda seen: (0.0, 0.0), "world": world}, settings)
    space = build_space(request, world)
    begun, note = begun_with(OTHERS, space, world, request)
    assert len(begun.first) >= 3
    for scenario in begun.first:
        world.check_fits(scenario)
        assert scenario.traffic == space.traffic
        assert scenario.ego_lane in (space.ego_lanes or (space.ego_lane,))
    assert note == "" or note.endswith(f"of {len(FILES)} saved scenarios fit this search")


class Unchecked:
    """A world whose author did not write check_fits."""

    def __init__(self):
        self.speed_limit, self.longest_run, self.road = 26.8, 60.0, pafot.Highway().road

    def rollout(self, scenario, ads):
        raise NotImplementedError


def test_a_world_that_checks_nothing_gets_the_kinds_of_instructions_that_its_space_has():
    world = Unchecked()
    request = checked_request({"ads": lambda: 1, "world": world}, Settings(algorithm="distinct", seed=0))
    begun, _ = begun_with(OTHERS, SearchSpace(instructions="cells"), base_world(world), request)
    assert {type(gene) for scenario in begun.first for chain in scenario.npcs for gene in chain} == {
        pafot.PositionInstruction
    }


def test_everyday_traffic_is_not_asked_for_standing_cars():
    world, traffic = pafot.Highway(), pafot.Traffic("everyday")
    request = checked_request({"ads": lambda: 1, "world": world}, Settings(algorithm="distinct", seed=0))
    space = SearchSpace(instructions="both", traffic=traffic)
    begun, _ = begun_with(OTHERS, space, world, request)
    slowest = min(gene.speed for scenario in begun.first for chain in scenario.npcs for gene in chain)
    assert slowest >= traffic.least_speed(space.speed_limit) - 0.05 > 0
