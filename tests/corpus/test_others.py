"""The corpus in the package: failures of policies by others, which any search can begin with."""

import re

import pytest

import pytest_pafot as pafot
from pytest_pafot.campaign.beginnings import OTHERS, begun_with, others
from pytest_pafot.campaign.options import Settings
from pytest_pafot.campaign.request import build_space, checked_request
from pytest_pafot.corpus.layout import files_below

FILES = files_below(others())


def test_there_are_files_of_several_policies():
    assert len({file.parent for file in FILES}) >= 10
    assert len({pafot.load(file).scenario for file in FILES}) == len(FILES) >= 30


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}-{file.name.split('.')[0]}")
def test_a_file_is_a_failure_for_which_the_ego_is_responsible_and_tells_nothing_of_a_machine(file):
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
    assert note == "" or "do not fit this world" in note
