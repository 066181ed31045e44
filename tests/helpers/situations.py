"""Collisions with an expert's verdict: what happens, who is responsible, and by which rule.

The rules are those of docs/explanation/verdicts.md. The verdicts were first written from earlier rules, not from the
code's results; those that the five rules decide otherwise were changed to what these say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pytest_pafot.model.trace import HEADING, SPEED, Trace, X, Y
from pytest_pafot.world.kernel.lanes import Box, side_hit
from tests.helpers import drives, junctions
from tests.helpers.drives import HZ, bent, crash, merging
from tests.helpers.junctions import plan
from tests.helpers.traces import LENGTH, WIDTH, straight_lanes

LEFT, OWN, RIGHT, FAR = 0.0, 4.0, 8.0, 12.0
"""Centres of the lanes [m]. A vehicle without a lane drives in OWN."""


@dataclass(frozen=True, slots=True)
class Situation:
    """A collision, its verdict and why.

    Attributes:
        name: name of the situation.
        text: what happens.
        trace: function that makes the trace.
        responsibility, fault: verdict that an expert expects.
        rule: number of the rule of docs/explanation/verdicts.md that decides.
    """

    name: str
    text: str
    trace: Callable[[], Trace]
    responsibility: str
    fault: str | None
    rule: int


def driven(*place, **plan):
    """Return a vehicle whose plan gives the speed along the road; while it moves sideways, its body is faster."""
    states = drives.driven(*place, **plan)
    states[:, SPEED] /= np.cos(states[:, HEADING])
    return states


def hit(ego, *npcs, **road) -> Trace:
    """Return the run up to the ego's first contact with the first NPC, with the side that was hit."""
    trace = crash(ego, *npcs, **road)
    ego_before, npc_before = (
        Box(*states[[X, Y, HEADING]], LENGTH, WIDTH) for states in trace.states[-2, :2]
    )
    return replace(trace, collision=replace(trace.collision, side=side_hit(ego_before, npc_before)))


def turned(states, angle):
    """A vehicle that points so to the road where it stands [rad]."""
    states[states[:, SPEED] == 0, HEADING] = angle
    return states


def at_lane_end(ego, npc, *, end) -> Trace:
    """The same where the ego's lane ends somewhere."""
    lanes = list(straight_lanes())
    lanes[1] = replace(lanes[1], length=end)
    return hit(ego, npc, lanes=tuple(lanes))


def cut_in(gap, *, slower, brakes=(), ego_brakes=(), lasts=2.0) -> Trace:
    """The run in which an NPC from the left crosses the line into the ego's lane after 2.3 s, at a gap ahead of it."""
    speed = 20.0 - slower
    npc = driven(
        5.0 + gap + slower * 2.33,
        LEFT,
        speed=speed,
        brakes=brakes,
        shifts=[(2.0, OWN, lasts)],
        seconds=30.0,
    )
    return hit(driven(0.0, brakes=ego_brakes, seconds=30.0), npc)


def lane_change(gap, *, faster, brakes=(), npc_brakes=(), speed=20.0) -> Trace:
    """The run in which the ego comes from the left and crosses the line at 2.4 s, at a gap ahead of an NPC."""
    ego = driven(0.0, LEFT, speed=speed, brakes=brakes, shifts=[(2.0, OWN, 2.0)], seconds=30.0)
    npc = driven(-5.0 - gap - faster * 2.4, speed=speed + faster, brakes=npc_brakes, seconds=30.0)
    return hit(ego, npc)


def in_bend(ego, npc) -> Trace:
    """The same where the road bends to the right."""
    vehicles, road = bent(ego, npc)
    return hit(*vehicles, **road)


def at_ramp(ego, npc, *, on_ramp) -> Trace:
    """The same where one of the two comes from a ramp."""
    vehicles, road = merging(ego, npc, on_ramp=on_ramp)
    return hit(*vehicles, **road)


def weaving():
    """An ego that comes from the left and weaves in its new lane from 4 s, with a period of 3 s."""
    ego = driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)], seconds=30.0)
    since = np.maximum(np.arange(len(ego)) / HZ - 4.0, 0.0)
    ego[:, Y] += 0.6 * np.sin(since * 2 * np.pi / 3.0)
    ego[:, HEADING] = np.arctan2(np.gradient(ego[:, Y]) * HZ, 20.0)
    return ego


def oncoming(x, y):
    """A vehicle that drives towards the ego with 20 m/s."""
    states = driven(x, y, speed=-20.0)
    states[:, HEADING], states[:, SPEED] = np.pi, 20.0
    return states


TOLD = {
    "One follows the other": {
        "slow-leader-ignored": (
            "The ego runs into a vehicle that drives 10 m/s, and does not brake.",
            lambda: hit(driven(0.0), driven(100.0, speed=10.0)),
            "ego", "leader-unanswered", 3,
        ),
        "hit-from-behind": (
            "An NPC with 26 m/s runs into the ego from behind.",
            lambda: hit(driven(0.0), driven(-60.0, speed=26.0)),
            "npc", None, 3,
        ),
        "standing-vehicle-ignored": (
            "A vehicle has stood in the ego's lane all the time, 150 m ahead. The ego does not brake.",
            lambda: hit(driven(0.0), driven(155.0, speed=0.0)),
            "ego", "leader-unanswered", 3,
        ),
        "hard-brake-ahead-ignored": (
            "A vehicle 2 s ahead brakes with 8 m/s^2 to a standstill. The ego does not brake.",
            lambda: hit(driven(0.0), driven(45.0, brakes=[(2.0, 8.0, 0.0)])),
            "ego", "leader-unanswered", 3,
        ),
        "braked-too-gently": (
            "A vehicle 2 s ahead brakes with 8 m/s^2 to a standstill. The ego brakes 1 s later, with only 3 m/s^2.",
            lambda: hit(driven(0.0, brakes=[(3.0, 3.0, 0.0)]), driven(45.0, brakes=[(2.0, 8.0, 0.0)])),
            "ego", "leader-unanswered", 3,
        ),
        "braked-too-late": (
            "A vehicle 2 s ahead brakes with 8 m/s^2 to a standstill. The ego brakes as hard, but 3 s later.",
            lambda: hit(driven(0.0, brakes=[(5.0, 8.0, 0.0)]), driven(45.0, brakes=[(2.0, 8.0, 0.0)])),
            "ego", "leader-unanswered", 3,
        ),
        "leader-stops-dead": (
            "A vehicle 1.5 s ahead of the ego stops within 8 m. The ego brakes a second later, with 6 m/s^2.",
            lambda: hit(driven(0.0, brakes=[(3.0, 6.0, 0.0)]), driven(35.0, brakes=[(2.0, 30.0, 0.0)])),
            "npc", None, 3,
        ),
        "steers-behind-one-on-the-line": (
            "A vehicle with 3 m/s drives on the line next to the ego's lane. The ego steers into its track and does "
            "not brake.",
            lambda: hit(driven(0.0, 5.4, speed=12.0, shifts=[(5.0, 3.6, 1.0)]), driven(64.0, 1.8, speed=3.0)),
            "ego", "leader-unanswered", 3,
        ),
        "began-too-close": (
            "The run begins with the ego 7 m behind a vehicle that brakes with 8 m/s^2 at once.",
            lambda: hit(driven(0.0), driven(12.0, brakes=[(0.0, 8.0, 0.0)])),
            "npc", None, 3,
        ),
        "ego-tailgates": (
            "The ego comes up to 2 m behind a vehicle and stays there. 5 s later that vehicle brakes with 4 m/s^2.",
            lambda: hit(driven(0.0, speed=25.0, brakes=[(7.0, 5.0, 20.0)]), driven(44.5, brakes=[(13.0, 4.0, 0.0)])),
            "ego", "leader-unanswered", 3,
        ),
        "npc-tailgates": (
            "An NPC comes up to 2 m behind the ego and stays there. 5 s later the ego brakes with 4 m/s^2.",
            lambda: hit(driven(0.0, brakes=[(13.0, 4.0, 0.0)]), driven(-44.5, speed=25.0, brakes=[(7.0, 5.0, 20.0)])),
            "npc", None, 3,
        ),
        "ego-speeds-up-behind-a-close-leader": (
            "The run begins with the ego 8 m behind a vehicle of equal speed. After 3 s the ego speeds up.",
            lambda: hit(driven(0.0, brakes=[(3.0, -2.0, 26.0)]), driven(13.0)),
            "ego", "leader-unanswered", 3,
        ),
    },
    "Braking hard": {
        "braked-for-nothing": (
            "On a free road the ego brakes with 9 m/s^2. An NPC 2 s behind it does not brake.",
            lambda: hit(driven(0.0, brakes=[(4.0, 9.0, 0.0)]), driven(-45.0)),
            "both", "braked-for-nothing", 4,
        ),
        "braked-for-nothing-unavoidable": (
            "On a free road the ego brakes with 9.8 m/s^2. The NPC behind has little more than RSS requires for 8 "
            "m/s^2.",
            lambda: hit(driven(0.0, brakes=[(4.0, 9.8, 0.0)]), driven(-34.0, brakes=[(5.0, 6.0, 0.0)])),
            "ego", "braked-for-nothing", 4,
        ),
        "braked-for-nothing-tailgated": (
            "On a free road the ego brakes with 9 m/s^2 ahead of an NPC that has come up to 2 m behind it.",
            lambda: hit(driven(0.0, brakes=[(13.0, 9.0, 0.0)]), driven(-44.5, speed=25.0, brakes=[(7.0, 5.0, 20.0)])),
            "both", "braked-for-nothing", 4,
        ),
        "braked-beside-a-neighbour": (
            "The ego brakes with 9 m/s^2 for a slower vehicle that keeps the adjacent lane.",
            lambda: hit(driven(0.0, brakes=[(4.0, 9.0, 5.0)]), driven(-45.0), driven(60.0, LEFT, speed=10.0)),
            "both", "braked-for-nothing", 4,
        ),
        "braked-after-the-leader-had-left": (
            "A slower vehicle ahead leaves the lane. 3 s later the ego brakes with 9 m/s^2.",
            lambda: hit(
                driven(0.0, brakes=[(8.0, 9.0, 5.0)]),
                driven(-45.0),
                driven(80.0, speed=14.0, shifts=[(2.0, RIGHT, 3.0)]),
            ),
            "both", "braked-for-nothing", 4,
        ),
        "brake-check-after-a-lane-change": (
            "The ego changes lanes 45 m ahead of an NPC, and 6 s later brakes with 9 m/s^2 on a free road.",
            lambda: lane_change(45.0, faster=0.0, brakes=[(8.0, 9.0, 0.0)]),
            "both", "braked-for-nothing", 4,
        ),
        "braked-for-a-leader-that-brakes": (
            "A vehicle 60 m ahead brakes with 8 m/s^2, and 0.5 s later the ego, too. The NPC 2 s behind does not "
            "brake.",
            lambda: hit(driven(0.0, brakes=[(4.5, 8.0, 2.0)]), driven(-45.0), driven(65.0, brakes=[(4.0, 8.0, 2.0)])),
            "npc", None, 3,
        ),
        "braked-for-an-obstacle": (
            "The ego brakes with 8 m/s^2 for a vehicle that stands 50 m ahead. The NPC 2 s behind does not brake.",
            lambda: hit(driven(0.0, brakes=[(4.0, 8.0, 0.0)]), driven(-45.0), driven(135.0, speed=0.0)),
            "npc", None, 3,
        ),
        "braked-for-an-entering-vehicle": (
            "The ego brakes with 8 m/s^2 for a vehicle that comes into its lane 20 m ahead.",
            lambda: hit(
                driven(0.0, brakes=[(4.0, 8.0, 8.0)]),
                driven(-45.0),
                driven(29.0, LEFT, speed=19.0, shifts=[(3.7, OWN, 3.0)]),
            ),
            "npc", None, 3,
        ),
        "braked-for-the-end-of-the-lane": (
            "The ego brakes with 7 m/s^2, 40 m before its lane ends.",
            lambda: at_lane_end(driven(0.0, brakes=[(4.0, 7.0, 0.0)]), driven(-45.0), end=120.0),
            "npc", None, 3,
        ),
        "braked-moderately": (
            "On a free road the ego brakes with 3.9 m/s^2 to 5 m/s. The NPC 2 s behind does not brake.",
            lambda: hit(driven(0.0, brakes=[(4.0, 3.9, 5.0)]), driven(-45.0)),
            "npc", None, 3,
        ),
        "braked-moderately-to-a-crawl": (
            "On a free road the ego brakes with 4.5 m/s^2 to 2 m/s. The NPC 2 s behind does not brake.",
            lambda: hit(driven(0.0, brakes=[(4.0, 4.5, 2.0)]), driven(-45.0)),
            "both", "braked-for-nothing", 4,
        ),
        "braked-for-a-moment": (
            "On a free road the ego brakes with 9 m/s^2 for a quarter of a second. The NPC 1.4 s behind never brakes.",
            lambda: hit(driven(0.0, brakes=[(4.0, 9.0, 17.6)]), driven(-34.0)),
            "npc", None, 3,
        ),
        "leader-brakes-for-nothing-1.8-s-ahead": (
            "A vehicle 1.8 s ahead of the ego brakes with 8 m/s^2 on a free road. The ego brakes 2 s later, with 4 "
            "m/s^2.",
            lambda: hit(driven(0.0, brakes=[(7.0, 4.0, 0.0)]), driven(41.0, brakes=[(5.0, 8.0, 0.0)])),
            "ego", "leader-unanswered", 3,
        ),
        "leader-brakes-for-a-standing-vehicle": (
            "A vehicle 0.5 s ahead of the ego brakes with 8 m/s^2 for one that stands. The ego brakes 1 s later, with "
            "6 m/s^2.",
            lambda: hit(
                driven(0.0, brakes=[(6.0, 6.0, 0.0)]), driven(15.0, brakes=[(5.0, 8.0, 0.0)]), driven(148.0, speed=0.0)
            ),
            "ego", "leader-unanswered", 3,
        ),
    },
    "Standing": {
        "npc-stands-askew": (
            "A vehicle has stood askew all the time, half in the ego's lane. The ego does not brake.",
            lambda: hit(driven(0.0), turned(driven(150.0, 1.8, speed=0.0), 0.4)),
            "ego", "leader-unanswered", 3,
        ),
        "stopped-for-nothing": (
            "On a free road the ego brakes gently to a standstill. 5 s later an NPC runs into it.",
            lambda: hit(driven(0.0, brakes=[(2.0, 3.0, 0.0)], seconds=25.0), driven(-172.0, seconds=25.0)),
            "both", "stopped-for-nothing", 4,
        ),
        "brakes-while-the-one-ahead-stays": (
            "The ego brakes with 6 m/s^2 to a standstill for one ahead that brakes, too. An NPC behind does not brake.",
            lambda: hit(
                driven(0.0, brakes=[(1.0, 6.0, 0.0)]),
                driven(-60.0),
                driven(30.0, speed=12.0, brakes=[(0.5, 3.0, 0.0)]),
            ),
            "npc", None, 3,
        ),
        "stopped-in-a-queue": (
            "The ego brakes gently to a standstill behind a vehicle that stands. 5 s later an NPC runs into the ego.",
            lambda: hit(
                driven(0.0, brakes=[(2.0, 3.0, 0.0)], seconds=25.0),
                driven(-172.0, seconds=25.0),
                driven(120.0, speed=0.0, seconds=25.0),
            ),
            "npc", None, 3,
        ),
        "stopped-at-the-end-of-the-lane": (
            "The ego brakes gently to a standstill at the end of its lane. 5 s later an NPC runs into it.",
            lambda: at_lane_end(
                driven(0.0, brakes=[(2.0, 3.0, 0.0)], seconds=25.0), driven(-172.0, seconds=25.0), end=112.0
            ),
            "npc", None, 3,
        ),
        "stopped-for-a-moment": (
            "On a free road the ego brakes gently to a standstill. 2 s later an NPC runs into it.",
            lambda: hit(driven(0.0, brakes=[(2.0, 3.0, 0.0)], seconds=25.0), driven(-111.0, seconds=25.0)),
            "npc", None, 3,
        ),
        "stopped-askew-for-nothing": (
            "On a free road the ego stops askew, half in the next lane. An NPC in that lane hits it 5 s later.",
            lambda: hit(
                turned(driven(0.0, speed=10.0, brakes=[(2.0, 2.5, 0.0)], shifts=[(2.0, 2.2, 3.0)]), -0.4),
                driven(-180.0, LEFT),
            ),
            "both", "stopped-for-nothing", 4,
        ),
        "stopped-askew-behind-another": (
            "The ego stops askew behind a standing vehicle, half in the next lane. An NPC in that lane hits it 5 s "
            "later.",
            lambda: hit(
                turned(driven(0.0, speed=10.0, brakes=[(2.0, 2.5, 0.0)], shifts=[(2.0, 2.2, 3.0)]), -0.4),
                driven(-180.0, LEFT),
                driven(50.0, speed=0.0),
            ),
            "npc", None, 3,
        ),
        "stopped-in-a-lane-change": (
            "The ego moves in 6 m ahead of an NPC and brakes with 8 m/s^2. It stands when the NPC hits it.",
            lambda: hit(
                driven(0.0, LEFT, speed=10.0, brakes=[(2.5, 8.0, 0.0)], shifts=[(2.0, OWN, 1.5)]),
                driven(-11.0, speed=10.0, brakes=[(3.2, 3.0, 0.0)]),
            ),
            "ego", "entered-lane", 2,
        ),
    },
    "An NPC comes into the ego's lane": {
        "cut-in-3-m-and-brakes": (
            "An NPC of equal speed moves in 3 m ahead of the ego. 0.6 s later it brakes with 8 m/s^2.",
            lambda: cut_in(3.0, slower=0.0, brakes=[(3.0, 8.0, 0.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "cut-in-4-m-slower": (
            "An NPC that is 4 m/s slower moves in 4 m ahead of the ego.",
            lambda: cut_in(4.0, slower=4.0),
            "npc", None, 2,
        ),
        "cut-in-10-m-slower": (
            "An NPC that is 10 m/s slower moves in 10 m ahead of the ego. By the rules, no driver can avoid it.",
            lambda: cut_in(10.0, slower=10.0),
            "npc", None, 2,
        ),
        "cut-in-20-m-slower": (
            "An NPC that is 10 m/s slower moves in 20 m ahead of the ego. Nobody has to master that, but the ego does "
            "not even brake.",
            lambda: cut_in(20.0, slower=10.0),
            "both", "cut-in-unanswered", 3,
        ),
        "cut-in-15-m-slower": (
            "An NPC that is 4 m/s slower moves in 15 m ahead. The ego does not brake.",
            lambda: cut_in(15.0, slower=4.0),
            "both", "cut-in-unanswered", 3,
        ),
        "cut-in-30-m-slower": (
            "An NPC that is 10 m/s slower moves in 30 m ahead. The ego does not brake.",
            lambda: cut_in(30.0, slower=10.0),
            "both", "cut-in-unanswered", 3,
        ),
        "cut-in-answered-too-gently": (
            "An NPC that is 10 m/s slower moves in 30 m ahead. The ego brakes soon, but with only 1.5 m/s^2.",
            lambda: cut_in(30.0, slower=10.0, ego_brakes=[(2.7, 1.5, 0.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "cut-in-answered-in-vain": (
            "An NPC that is 10 m/s slower moves in 30 m ahead and brakes with 8 m/s^2. The ego brakes 1 s later, with "
            "6 m/s^2.",
            lambda: cut_in(30.0, slower=10.0, brakes=[(2.6, 8.0, 0.0)], ego_brakes=[(3.6, 6.0, 0.0)]),
            "npc", None, 2,
        ),
        "braked-before-its-answer-was-due": (
            "An NPC that is 4 m/s slower moves in 12 m ahead and brakes with 8 m/s^2. The ego already brakes 0.5 s "
            "later, with 9 m/s^2.",
            lambda: cut_in(12.0, slower=4.0, brakes=[(2.4, 8.0, 0.0)], ego_brakes=[(2.9, 9.0, 0.0)]),
            "npc", None, 2,
        ),
        "ego-speeds-up-after-a-cut-in": (
            "An NPC of equal speed moves in 4 m ahead. 2 s later the ego speeds up.",
            lambda: cut_in(4.0, slower=0.0, ego_brakes=[(4.4, -2.0, 26.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "cut-in-far-ahead-and-slow": (
            "An NPC that drives 5 m/s moves in 80 m ahead. The ego does not brake.",
            lambda: cut_in(80.0, slower=15.0),
            "ego", "leader-unanswered", 3,
        ),
        "cut-in-45-m-and-slow": (
            "An NPC that drives 8 m/s moves in 45 m ahead. The ego does not brake.",
            lambda: cut_in(45.0, slower=12.0),
            "ego", "cut-in-unanswered", 3,
        ),
        "leader-since-a-close-cut-in": (
            "An NPC that is 4 m/s slower moves in 5 m ahead, draws away to 13 m and then slows down with 3 m/s^2. The "
            "ego does not brake.",
            lambda: cut_in(5.0, slower=4.0, brakes=[(2.4, -4.0, 22.0), (9.0, 3.0, 8.0)]),
            "ego", "cut-in-unanswered", 3,
        ),
        "npc-brake-checks": (
            "A faster NPC overtakes the ego and moves in 3 m ahead. 1.5 s later, 10 m ahead, it brakes with 8 m/s^2. "
            "The ego does not brake.",
            lambda: cut_in(2.0, slower=-5.0, brakes=[(3.9, 8.0, 0.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "npc-brake-checks-an-ego-that-brakes-gently": (
            "The same, but the ego brakes with 2 m/s^2 from 1.8 s after the moment on.",
            lambda: cut_in(2.0, slower=-5.0, brakes=[(3.9, 8.0, 0.0)], ego_brakes=[(4.3, 2.0, 8.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "npc-brake-checks-an-ego-that-brakes-hard-but-late": (
            "The same, but the ego brakes with 8 m/s^2 from 2.7 s after the moment on.",
            lambda: cut_in(2.0, slower=-5.0, brakes=[(3.9, 8.0, 0.0)], ego_brakes=[(5.2, 8.0, 8.0)]),
            "npc", None, 2,
        ),
        "npc-enters-across-two-lanes": (
            "An NPC that is 6 m/s slower comes across two lanes in one motion, 8 m ahead.",
            lambda: hit(driven(0.0), driven(13.0 + 6 * 5.6, FAR, speed=14.0, shifts=[(2.0, OWN, 6.0)])),
            "npc", None, 2,
        ),
        "npc-enters-behind": (
            "An NPC that is 6 m/s faster moves in 15 m behind the ego and runs into it.",
            lambda: hit(driven(0.0), driven(-32.0, RIGHT, speed=26.0, shifts=[(1.6, OWN, 2.0)])),
            "npc", None, 2,
        ),
        "npc-swipes-the-ego": (
            "An NPC next to the ego moves sideways into it.",
            lambda: hit(driven(0.0), driven(1.0, LEFT, shifts=[(2.0, OWN, 3.0)])),
            "npc", None, 2,
        ),
        "npc-drifts": (
            "An NPC next to the ego drifts into it with 0.2 m/s.",
            lambda: hit(driven(0.0), driven(1.0, LEFT, shifts=[(2.0, OWN, 20.0)])),
            "npc", None, 5,
        ),
        "npc-swerves-into-the-side": (
            "An NPC next to the ego swerves into it with 4 m/s. The ego brakes with 8 m/s^2 at once.",
            lambda: hit(driven(0.0, brakes=[(2.2, 8.0, 0.0)]), driven(2.0, LEFT, shifts=[(2.0, OWN, 1.0)])),
            "npc", None, 2,
        ),
        "sped-up-after-it-had-survived-a-cut-in": (
            "An NPC that is 4 m/s slower moves in close ahead. The ego brakes until it is slower. A second later it "
            "speeds up into the NPC.",
            lambda: cut_in(4.0, slower=4.0, lasts=4.0, ego_brakes=[(2.6, 8.0, 15.0), (4.4, -3.0, 24.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "cut-in-answered-with-nothing-to-spare": (
            "An NPC that is 8 m/s slower moves in 16 m ahead. The ego brakes 1.4 s later, with 6 m/s^2.",
            lambda: cut_in(16.0, slower=8.0, ego_brakes=[(3.7, 6.0, 0.0)]),
            "npc", None, 2,
        ),
        "speeds-up-behind-a-cut-in-that-nobody-can-answer": (
            "An NPC that is 2 m/s slower moves in 2.5 m ahead and speeds up. The ego speeds up into it.",
            lambda: cut_in(2.5, slower=2.0, brakes=[(2.3, -3.0, 19.6)], ego_brakes=[(3.9, -3.0, 26.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "sped-up-behind-a-cut-in-that-brakes": (
            "An NPC that is 4 m/s slower moves in 12 m ahead. The ego speeds up by 3 m/s. Then the NPC brakes with 8 "
            "m/s^2.",
            lambda: cut_in(12.0, slower=4.0, brakes=[(4.3, 8.0, 0.0)], ego_brakes=[(2.8, -2.0, 23.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "recovered-its-speed-behind-a-cut-in": (
            "An NPC that is 4 m/s slower moves in 21 m ahead. The ego brakes, then follows it a second behind. 3 s "
            "later the NPC stops within 3 m.",
            lambda: cut_in(
                21.0,
                slower=4.0,
                brakes=[(9.0, 80.0, 0.0)],
                ego_brakes=[(3.0, 4.0, 15.5), (5.0, -0.5, 16.0), (10.4, 8.0, 0.0)],
            ),
            "npc", None, 2,
        ),
        "let-the-brakes-go-behind-a-cut-in": (
            "An NPC that is 10 m/s slower moves in 20 m ahead. The ego brakes, but releases the brakes when it is "
            "still 4 m/s faster.",
            lambda: cut_in(20.0, slower=10.0, ego_brakes=[(2.9, 8.0, 14.0)]),
            "both", "cut-in-unanswered", 3,
        ),
        "creeps-into-one-that-had-cut-in": (
            "An NPC that is 10 m/s slower moves in 20 m ahead. The ego brakes until it is 0.5 m/s faster, and creeps "
            "into the NPC 15 s later.",
            lambda: cut_in(20.0, slower=10.0, ego_brakes=[(2.9, 8.0, 10.5)]),
            "ego", "cut-in-unanswered", 3,
        ),
        "creeps-into-one-that-stands-half-in-its-lane": (
            "An NPC comes half into the ego's lane, 20 m ahead, and stops. The ego brakes to 1.5 m/s, releases the "
            "brakes 7 m behind it and creeps into it.",
            lambda: hit(
                driven(0.0, brakes=[(2.7, 9.5, 1.5)]),
                driven(48.3, LEFT, speed=10.0, brakes=[(2.6, 4.0, 0.0)], shifts=[(2.0, 2.2, 1.1)]),
            ),
            "ego", "leader-unanswered", 3,
        ),
        "speeds-up-behind-one-half-in-its-lane": (
            "An NPC comes half into the ego's lane, 20 m ahead. The ego brakes to its speed, follows for 4 s and "
            "speeds up into it.",
            lambda: hit(
                driven(0.0, brakes=[(2.9, 8.0, 10.0), (8.0, -2.0, 20.0)]),
                driven(48.3, LEFT, speed=10.0, shifts=[(2.0, 2.2, 1.1)]),
            ),
            "ego", "cut-in-unanswered", 3,
        ),
    },
    "The ego changes lanes": {
        "lane-change-1-m-ahead": (
            "The ego changes lanes 1 m ahead of an NPC that is 4 m/s faster.",
            lambda: lane_change(1.0, faster=4.0),
            "ego", "entered-lane", 2,
        ),
        "lane-change-2-m-ahead": (
            "The ego changes lanes 2 m ahead of an NPC that is 4 m/s faster.",
            lambda: lane_change(2.0, faster=4.0),
            "ego", "entered-lane", 2,
        ),
        "lane-change-10-m-ahead": (
            "The ego changes lanes 10 m ahead of an NPC that is 8 m/s faster.",
            lambda: lane_change(10.0, faster=8.0),
            "ego", "entered-lane", 2,
        ),
        "follower-lets-the-brakes-go": (
            "The ego changes lanes 10 m ahead of an NPC that is 8 m/s faster. The NPC brakes, but releases the brakes "
            "when it is still 2 m/s faster.",
            lambda: lane_change(10.0, faster=8.0, npc_brakes=[(2.9, 8.0, 22.0)]),
            "both", "entered-lane", 2,
        ),
        "lane-change-28-m-ahead": (
            "The ego changes lanes 28 m ahead of an NPC that is 8 m/s faster. Once the ego has kept its new lane, only "
            "a second is left.",
            lambda: lane_change(28.0, faster=8.0),
            "both", "entered-lane", 2,
        ),
        "lane-change-40-m-ahead": (
            "The ego changes lanes 40 m ahead of an NPC that is 8 m/s faster. The NPC never brakes.",
            lambda: lane_change(40.0, faster=8.0),
            "npc", None, 2,
        ),
        "lane-change-80-m-ahead": (
            "The ego changes lanes 80 m ahead of an NPC that is 8 m/s faster. The NPC never brakes.",
            lambda: lane_change(80.0, faster=8.0),
            "npc", None, 3,
        ),
        "lane-change-15-m-ahead-settled": (
            "The ego changes lanes 15 m ahead of an NPC that is 2 m/s faster. The NPC does not brake in the next 7 s.",
            lambda: lane_change(15.0, faster=2.0),
            "npc", None, 2,
        ),
        "follower-speeds-up-after-room": (
            "The ego changes lanes 25 m ahead of an NPC of equal speed, which then speeds up to 30 m/s.",
            lambda: lane_change(25.0, faster=0.0, npc_brakes=[(4.0, -3.0, 30.0)]),
            "npc", None, 2,
        ),
        "follower-speeds-up-after-settling": (
            "The ego changes lanes 10 m ahead of an NPC of equal speed. 3 s later the NPC speeds up.",
            lambda: lane_change(10.0, faster=0.0, npc_brakes=[(5.4, -3.0, 30.0)]),
            "npc", None, 2,
        ),
        "follower-speeds-up-behind-an-ego-that-weaves": (
            "The ego changes lanes 15 m ahead of an NPC of equal speed and weaves by 0.6 m. 10 s later the NPC speeds "
            "up.",
            lambda: hit(weaving(), driven(-20.0, brakes=[(14.0, -3.0, 30.0)], seconds=30.0)),
            "npc", None, 2,
        ),
        "brake-check-after-cutting-in": (
            "The ego changes lanes 5 m ahead of an NPC of equal speed and brakes with 9 m/s^2 as soon as it is in the "
            "new lane.",
            lambda: lane_change(5.0, faster=0.0, brakes=[(4.0, 9.0, 0.0)]),
            "both", "entered-lane", 2,
        ),
        "brake-check-long-after-cutting-in": (
            "The ego changes lanes 5 m ahead of an NPC of equal speed, keeps the new lane for 4 s and brakes with 9 "
            "m/s^2.",
            lambda: lane_change(5.0, faster=0.0, brakes=[(8.0, 9.0, 0.0)]),
            "both", "braked-for-nothing", 4,
        ),
        "follower-floors-it": (
            "The ego changes lanes 6 m ahead of an NPC that drives only 4.5 m/s. The NPC at once speeds up with 5 "
            "m/s^2.",
            lambda: lane_change(6.9, faster=-1.5, speed=6.0, npc_brakes=[(2.1, -5.0, 20.0)]),
            "both", "entered-lane", 2,
        ),
        "follower-floors-it-behind-a-close-lane-change": (
            "The ego changes lanes 6 m ahead of an NPC of equal speed. The NPC at once speeds up with 4 m/s^2.",
            lambda: lane_change(6.0, faster=0.0, npc_brakes=[(2.6, -4.0, 30.0)]),
            "both", "entered-lane", 2,
        ),
        "npc-moves-in-behind-an-ego-over-the-line": (
            "The ego reaches 0.3 m over its lane line and goes back. An NPC that is 6 m/s faster comes into its lane "
            "behind it.",
            lambda: hit(
                driven(0.0, LEFT, speed=10.0, shifts=[(2.0, 1.3, 1.0), (3.4, LEFT, 1.0)]),
                driven(-33.0, speed=16.0, shifts=[(2.6, LEFT, 1.6)]),
            ),
            "npc", None, 2,
        ),
        "follower-entered-later": (
            "The ego changes lanes. 4 s later a faster NPC moves into the same lane, 18 m behind, and runs into it.",
            lambda: hit(
                driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(-49.0, RIGHT, speed=24.0, shifts=[(6.0, OWN, 2.0)])
            ),
            "npc", None, 2,
        ),
        "ego-swipes": (
            "The ego moves sideways into an NPC next to it.",
            lambda: hit(driven(0.0, shifts=[(2.0, LEFT, 3.0)]), driven(1.0, LEFT)),
            "ego", "entered-lane", 2,
        ),
        "ego-drifts": (
            "The ego drifts with 0.2 m/s into an NPC next to it.",
            lambda: hit(driven(0.0, shifts=[(2.0, LEFT, 20.0)]), driven(1.0, LEFT)),
            "ego", "entered-lane", 5,
        ),
        "ego-enters-behind-a-slower-one": (
            "The ego changes lanes 10 m behind an NPC that is 8 m/s slower and runs into it.",
            lambda: hit(driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(15.0 + 8 * 2.4, speed=12.0)),
            "ego", "entered-lane", 2,
        ),
        "ego-enters-across-two-lanes": (
            "The ego comes across two lanes in one motion into an NPC that has kept its lane.",
            lambda: hit(driven(0.0, LEFT, shifts=[(2.0, RIGHT, 5.0)]), driven(2.0, RIGHT)),
            "ego", "entered-lane", 2,
        ),
        "ego-overtakes-into-oncoming-traffic": (
            "The ego moves into the lane of an oncoming NPC, which is 80 m away.",
            lambda: hit(driven(0.0, shifts=[(2.0, LEFT, 2.0)]), oncoming(180.0, LEFT)),
            "ego", "entered-lane", 2,
        ),
        "npc-on-the-wrong-side": (
            "An NPC comes towards the ego in the ego's lane. The ego brakes with 5 m/s^2 when the NPC is 200 m away.",
            lambda: hit(driven(0.0, brakes=[(3.0, 5.0, 0.0)]), oncoming(325.0, OWN)),
            "npc", None, 3,
        ),
        "both-enter-side-by-side": (
            "The ego and an NPC move into the lane between them, side by side.",
            lambda: hit(driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(1.0, RIGHT, shifts=[(2.2, OWN, 2.0)])),
            "both", "entered-lane", 5,
        ),
        "both-enter-ego-10-m-ahead": (
            "The ego and an NPC that is 6 m/s faster move into the lane between them, the ego 10 m ahead.",
            lambda: hit(
                driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(-30.0, RIGHT, speed=26.0, shifts=[(2.2, OWN, 2.0)])
            ),
            "npc", None, 3,
        ),
        "both-enter-ego-with-room": (
            "The ego and an NPC that is 6 m/s faster move into the lane between them, the ego 45 m ahead. The NPC "
            "never brakes.",
            lambda: hit(
                driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(-65.0, RIGHT, speed=26.0, shifts=[(2.2, OWN, 2.0)])
            ),
            "npc", None, 3,
        ),
        "both-enter-and-follow-for-long": (
            "The ego and an NPC move into the lane between them, the ego 12 m ahead. 13 s later the NPC speeds up.",
            lambda: hit(
                driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)], seconds=30.0),
                driven(-17.0, RIGHT, shifts=[(2.2, OWN, 2.0)], brakes=[(15.0, -3.0, 30.0)], seconds=30.0),
            ),
            "npc", None, 3,
        ),
        "both-enter-and-the-one-behind-floors-it": (
            "The ego, with 8 m/s, and an NPC move into the lane between them, the ego 6 m ahead. The NPC at once "
            "speeds up.",
            lambda: hit(
                driven(0.0, LEFT, speed=8.0, shifts=[(2.0, OWN, 2.0)]),
                driven(-11.0, RIGHT, speed=8.0, shifts=[(2.2, OWN, 2.0)], brakes=[(2.7, -5.0, 20.0)]),
            ),
            "npc", None, 3,
        ),
        "both-enter-behind-a-slower-one": (
            "The ego and an NPC that is 5 m/s slower move into the lane between them, the NPC 30 m ahead. The ego "
            "never brakes.",
            lambda: hit(
                driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(47.0, RIGHT, speed=15.0, shifts=[(2.2, OWN, 2.0)])
            ),
            "ego", "leader-unanswered", 3,
        ),
        "ego-enters-where-one-has-just-entered": (
            "An NPC moves into the lane between it and the ego. 2.5 s later the ego does, too, next to the NPC.",
            lambda: hit(driven(0.0, LEFT, shifts=[(4.5, OWN, 2.0)]), driven(1.0, RIGHT, shifts=[(2.0, OWN, 2.0)])),
            "ego", "entered-lane", 2,
        ),
        "ego-given-up-its-lane-change": (
            "The ego moves 0.8 m to the left and back. 3 s later an NPC next to it moves into the ego.",
            lambda: hit(
                driven(0.0, shifts=[(1.0, 3.2, 1.0), (2.0, OWN, 1.0)]), driven(1.0, LEFT, shifts=[(6.0, OWN, 2.0)])
            ),
            "npc", None, 2,
        ),
        "ego-moved-two-lanes-away": (
            "The ego changes to a lane two lanes away from an NPC's. 5 s later the NPC moves into the ego's side.",
            lambda: hit(
                driven(0.0, LEFT, shifts=[(1.0, OWN, 2.0)]),
                driven(1.0, FAR, shifts=[(3.0, RIGHT, 2.0), (8.0, OWN, 2.0)]),
            ),
            "npc", None, 2,
        ),
    },
    "Bends and ramps": {
        "bend-brake-ahead-ignored": (
            "In a bend the vehicle 2 s ahead of the ego brakes with 6 m/s^2. The ego does not brake.",
            lambda: in_bend(driven(0.0), driven(45.0, brakes=[(2.0, 6.0, 0.0)])),
            "ego", "leader-unanswered", 3,
        ),
        "bend-cut-in": (
            "In a bend an NPC that is 6 m/s slower moves in 5 m ahead of the ego.",
            lambda: in_bend(driven(0.0), driven(10.0 + 6 * 2.4, LEFT, speed=14.0, shifts=[(2.0, OWN, 2.0)])),
            "npc", None, 2,
        ),
        "bend-npc-runs-wide": (
            "In a bend an NPC on the inside drifts outwards, into the ego next to it.",
            lambda: in_bend(driven(0.0), driven(1.0, RIGHT, shifts=[(2.0, OWN, 4.0)])),
            "npc", None, 2,
        ),
        "bend-ego-runs-wide": (
            "In a bend the ego drifts outwards, into an NPC next to it.",
            lambda: in_bend(driven(0.0, shifts=[(2.0, LEFT, 4.0)]), driven(1.0, LEFT)),
            "ego", "entered-lane", 2,
        ),
        "ramp-npc-merges-close": (
            "An NPC that is 6 m/s slower merges from a ramp 6 m ahead of the ego.",
            lambda: at_ramp(driven(-54.0), driven(0.0, speed=14.0), on_ramp=1),
            "npc", None, 2,
        ),
        "ramp-npc-merges-35-m-ahead": (
            "An NPC that is 6 m/s slower merges from a ramp 35 m ahead of the ego. The ego does not brake.",
            lambda: at_ramp(driven(-83.0), driven(0.0, speed=14.0), on_ramp=1),
            "ego", "cut-in-unanswered", 3,
        ),
    },
    "Where ways cross": {
        "crossing-from-the-left-ignored": (
            "The ego drives with 8 m/s into a crossing, half a second before an NPC from the left that has priority.",
            lambda: junctions.hit(plan("west straight", 6, 8), plan("north straight", 6.5, 8)),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-from-the-right-ignored": (
            "The ego drives with 8 m/s into a crossing, 0.3 s after an NPC from the right that has priority.",
            lambda: junctions.hit(plan("west straight", 6, 8), plan("south straight", 5.7, 8)),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-braked-too-little": (
            "An NPC from the left has priority. The ego brakes two seconds before it would enter, but with only 2 "
            "m/s^2.",
            lambda: junctions.hit(plan("west straight", 6, 8, (4.0, -2.0, 3.0)), plan("north straight", 7, 8)),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-sets-off-in-front": (
            "The ego stops before a crossing. It sets off 2.5 s before an NPC from the left arrives, which has "
            "priority.",
            lambda: junctions.hit(
                plan("west straight", 4, 8, (2.0, -3.5, 0.0), (8.0, 2.5, 8.0)), plan("north straight", 10.5, 8)
            ),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-npc-has-no-priority": (
            "An NPC from the left that has no priority drives into the crossing half a second before the ego.",
            lambda: junctions.hit(plan("west straight", 6, 8), plan("north straight", 5.5, 8), priority="ego"),
            "npc", None, 1,
        ),
        "crossing-npc-has-no-priority-and-is-slow": (
            "An NPC from the left without priority drives in with 3 m/s, two seconds before the ego. The ego never "
            "brakes.",
            lambda: junctions.hit(plan("west straight", 6, 8), plan("north straight", 4, 3), priority="ego"),
            "both", "entered-taken-zone", 1,
        ),
        "crossing-one-stands-in-it-ego-has-priority": (
            "An NPC from the left without priority has stood in the crossing for 4.7 s. The ego never brakes.",
            lambda: junctions.hit(
                plan("west straight", 9, 8), plan("north straight", 3, 5, (3.3, -5.0, 0.0)), priority="ego"
            ),
            "ego", "entered-taken-zone", 1,
        ),
        "crossing-one-stands-in-it-npc-has-priority": (
            "An NPC from the left that has priority has stood in the crossing for 4.7 s. The ego never brakes.",
            lambda: junctions.hit(plan("west straight", 9, 8), plan("north straight", 3, 5, (3.3, -5.0, 0.0))),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-stopped-in-it-far-ahead": (
            "The ego stops in a crossing behind a queue. An NPC from the left, with priority, drives in five seconds "
            "after the ego and never brakes.",
            lambda: junctions.hit(
                plan("west straight", 4, 5, (4.6, -5.0, 0.0)),
                plan("north straight", 9, 8),
                others=[plan("grid", 2.0, 5, (3.9, -5.0, 0.0))],
            ),
            "npc", None, 1,
        ),
        "crossing-stopped-in-it-near-ahead": (
            "The ego stops in a crossing behind a queue. An NPC from the left, with priority and 10 m/s, drives in 2.5 "
            "seconds after the ego and never brakes.",
            lambda: junctions.hit(
                plan("west straight", 7, 5, (7.4, -5.0, 0.0)),
                plan("north straight", 9.5, 10),
                others=[plan("grid", 5.0, 5, (6.9, -5.0, 0.0))],
            ),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-npc-waits-and-drives-in-late": (
            "An NPC from the left that has priority waits at the line. It sets off just as the ego drives into the "
            "crossing.",
            lambda: junctions.hit(
                plan("west straight", 8, 5), plan("north straight", 4.75, 8, (3.5, -4.0, 0.0), (7.9, 5.0, 8.0))
            ),
            "npc", None, 1,
        ),
        "crossing-npc-waits-and-sets-off-with-the-ego": (
            "An NPC from the left with priority waits. It sets off a second before the ego enters, too late for the "
            "ego to respond.",
            lambda: junctions.hit(
                plan("west straight", 8, 5), plan("north straight", 4.75, 8, (3.5, -4.0, 0.0), (7.1, 3.0, 8.0))
            ),
            "none", None, 1,
        ),
        "crossing-npc-slows-down-before-it": (
            "An NPC from the left that has priority slows down from 10 to 6 m/s well before the crossing. The ego does "
            "not wait.",
            lambda: junctions.hit(plan("west straight", 6.5, 8), plan("north straight", 5.2, 10, (2.0, -2.0, 6.0))),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-npc-speeds-up-towards-it": (
            "An NPC from the left, with priority and 4 m/s, would pass after the ego. Too late for the ego to respond, "
            "it speeds up with 5 m/s^2.",
            lambda: junctions.hit(plan("west straight", 8, 8), plan("north straight", 10.5, 4, (6.6, 5.0, 12.0))),
            "none", None, 1,
        ),
        "crossing-without-priorities": (
            "Neither vehicle has priority. The ego and an NPC from the right drive into the crossing together.",
            lambda: junctions.hit(plan("west straight", 6, 8), plan("south straight", 6, 8), priority="none"),
            "both", "did-not-give-way", 1,
        ),
        "crossing-without-priorities-npc-first": (
            "Neither has priority. An NPC from the right has been in the crossing for 3.5 s when the ego drives in.",
            lambda: junctions.hit(plan("west straight", 8, 8), plan("south straight", 4.5, 1.5), priority="none"),
            "ego", "did-not-give-way", 1,
        ),
        "crossing-waits-and-is-hit-from-behind": (
            "The ego stops before the crossing, because an NPC comes from the left. Two seconds later a following NPC "
            "runs into the ego.",
            lambda: junctions.hit(
                plan("west straight", 4, 8, (2.0, -3.5, 0.0)),
                plan("grid", 8.0, 8),
                others=[plan("north straight", 6.5, 5)],
            ),
            "npc", None, 3,
        ),
        "crossing-brakes-hard-for-one-and-is-hit": (
            "The ego brakes with 7 m/s^2 for an NPC from the right that has priority. An NPC 0.8 s behind runs into "
            "it.",
            lambda: junctions.hit(
                plan("west straight", 6, 12, (4.8, -7.0, 2.0)),
                plan("grid", 7.2, 12),
                others=[plan("south straight", 6.0, 8)],
            ),
            "npc", None, 3,
        ),
        "crossing-brakes-hard-for-none-and-is-hit": (
            "The ego brakes with 7 m/s^2 before a crossing that the only crossing NPC has passed. An NPC 0.8 s behind "
            "runs into it.",
            lambda: junctions.hit(
                plan("west straight", 6, 12, (4.8, -7.0, 2.0)),
                plan("grid", 7.2, 12),
                others=[plan("south straight", 2.0, 8)],
            ),
            "both", "braked-for-nothing", 4,
        ),
    },
    "Where ways turn across": {
        "turns-left-across-oncoming": (
            "The ego turns left in front of an oncoming NPC that has priority.",
            lambda: junctions.hit(plan("west left", 6, 6), plan("east straight", 6.5, 10)),
            "ego", "did-not-give-way", 1,
        ),
        "oncoming-turns-left-across": (
            "An oncoming NPC turns left in front of the ego, which has priority.",
            lambda: junctions.hit(plan("west straight", 6, 9), plan("east left", 5.2, 6), priority="ego"),
            "npc", None, 1,
        ),
        "oncoming-turns-left-across-slowly": (
            "An oncoming NPC turns left with 4 m/s, two seconds before the ego arrives, which has priority. The ego "
            "never brakes.",
            lambda: junctions.hit(plan("west straight", 6, 9), plan("east left", 3.9, 4), priority="ego"),
            "both", "entered-taken-zone", 1,
        ),
        "turns-left-into-one-from-the-left": (
            "The ego turns left and drives into an NPC from the left, which has priority and is already in the "
            "crossing.",
            lambda: junctions.hit(plan("west left", 6, 6), plan("north straight", 5.4, 6)),
            "ego", "did-not-give-way", 1,
        ),
    },
    "Where ways merge": {
        "turns-right-in-front": (
            "The ego turns right with 4 m/s. A second later an NPC from the left, which has priority, arrives with 12 "
            "m/s.",
            lambda: junctions.hit(plan("west right", 6, 4), plan("north straight", 7.1, 12)),
            "ego", "did-not-give-way", 1,
        ),
        "turns-right-far-in-front": (
            "The ego turns right. 4.5 s later an NPC from the left, with priority, arrives and speeds up from 6 to 12 "
            "m/s.",
            lambda: junctions.hit(plan("west right", 6, 4), plan("north straight", 10.5, 6, (10.0, 3.0, 12.0))),
            "npc", None, 1,
        ),
        "turns-right-in-front-and-is-hit-later": (
            "The ego turns right in front of an NPC with 12 m/s and priority. The NPC brakes hard to 5 m/s and runs "
            "into the ego after the zone.",
            lambda: junctions.hit(plan("west right", 6, 4), plan("north straight", 7.3, 12, (6.5, -6.0, 5.0))),
            "both", "did-not-give-way", 1,
        ),
        "npc-turns-right-in-front": (
            "An NPC from the right turns right in front of the ego, which has priority.",
            lambda: junctions.hit(plan("west straight", 6, 12), plan("south right", 5.0, 4), priority="ego"),
            "npc", None, 1,
        ),
        "npc-turns-right-far-in-front": (
            "An NPC from the right turns right 4.5 s before the ego, which has priority, arrives. The ego never "
            "brakes.",
            lambda: junctions.hit(plan("west straight", 8, 8), plan("south right", 3.5, 4), priority="ego"),
            "ego", "leader-unanswered", 3,
        ),
        "joins-the-circle-in-front": (
            "The ego joins a circle with 6 m/s. 0.7 s later an NPC in the circle arrives with 10 m/s.",
            lambda: junctions.hit(plan("join", 6, 6), plan("circle", 6.7, 10)),
            "ego", "did-not-give-way", 1,
        ),
        "joins-the-circle-beside": (
            "The ego joins a circle and drives into the side of an NPC that is just ahead and as fast.",
            lambda: junctions.hit(plan("join", 6, 8), plan("circle", 5.7, 8)),
            "ego", "did-not-give-way", 1,
        ),
        "joins-the-circle-behind-one-that-stops": (
            "The ego joins a circle two seconds behind an NPC. The NPC then stops with 3 m/s^2, and the ego never "
            "brakes.",
            lambda: junctions.hit(plan("join", 8, 8), plan("circle", 6.0, 8, (8.0, -3.0, 0.0))),
            "ego", "leader-unanswered", 3,
        ),
        "npc-joins-the-circle-in-front": (
            "An NPC joins a circle 0.7 s before the ego, which is in the circle and has priority, arrives there.",
            lambda: junctions.hit(plan("circle", 4.7, 10), plan("join", 4, 5), priority="ego"),
            "npc", None, 1,
        ),
    },
}  # fmt: skip
"""By heading and name: text, trace, responsibility, fault and rule of a Situation."""
SITUATIONS = {
    heading: tuple(Situation(name, *told) for name, told in each.items())
    for heading, each in TOLD.items()
}
