"""A second implementation of the attribution rules: every condition in plain loops.

The rules have the numbers of docs/explanation/verdicts.md, which leaves out exceptions. The program was written without
a look at the one that it checks. It is obvious rather than fast. Sides are +1 for right and -1 for left; ticks are
indices of the trace's rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

from pytest_pafot.model.trace import ACROSS, ALONG, ANGLE, HEADING, LANE, OFFSET, SPEED, STRETCH, X, Y
from tests.helpers.polygons import corners, point_to_segment, polygons_meet

STANDS = 0.1
MOVES_SIDEWAYS = 0.3
OFF_CENTRE = 0.375
BRAKES = 0.5
ROUNDING = 1e-9


@dataclass(frozen=True)
class Opinion:
    """A verdict: the responsible vehicle, the fault, and the tick where it begins."""

    responsibility: str
    fault: str | None
    tick: int


class Vehicle:
    """A vehicle's data from the trace, in the page's words; every list is indexed by tick."""

    def __init__(self, trace, index):
        self.hz = trace.physics_hz
        self.length, self.width = trace.sizes[index].tolist()
        self.rows = trace.states[:, index].tolist()
        self.body_speed = [row[SPEED] for row in self.rows]
        if trace.track is None:
            self._on_straight_road(trace)
        else:
            self._on_bend(trace, trace.track[:, index].tolist())
        self.is_straight = trace.track is None
        self.lane_width = [trace.lanes[max(int(row[LANE]), 0)].width for row in self.rows]
        self.speed = [v * math.cos(a) for v, a in zip(self.body_speed, self.angle, strict=True)]

    def _on_straight_road(self, trace):
        cos, sin = math.cos(trace.lanes[0].heading), math.sin(trace.lanes[0].heading)
        centres = [lane.y * cos - lane.x * sin for lane in trace.lanes]
        width = trace.lanes[0].width
        with_shoulders = [*centres, min(centres) - width, max(centres) + width]
        self.along = [row[X] * cos + row[Y] * sin for row in self.rows]
        self.across = [row[Y] * cos - row[X] * sin for row in self.rows]
        self.angle = [row[HEADING] - trace.lanes[0].heading for row in self.rows]
        self.centre = [
            centres[int(row[LANE])] if row[LANE] >= 0 else min(with_shoulders, key=lambda centre: abs(centre - y))
            for row, y in zip(self.rows, self.across, strict=True)
        ]
        self.lane = [nearest_lane(trace, row) for row in self.rows]
        self.stretch = [1.0] * len(self.rows)

    def _on_bend(self, trace, track):
        self.along = [row[ALONG] for row in track]
        self.across = [row[ACROSS] for row in track]
        self.angle = [row[ANGLE] for row in track]
        self.centre = [row[ACROSS] - row[OFFSET] for row in track]
        self.lane = [nearest_lane(trace, row) for row in self.rows]
        self.stretch = [row[STRETCH] for row in track]

    def reach(self, tick):
        """Return the distance from the centre to the front or back of the box along the road [m]."""
        angle = self.angle[tick]
        return (self.length * abs(math.cos(angle)) + self.width * abs(math.sin(angle))) / 2

    def side_reach(self, tick):
        angle = self.angle[tick]
        return (self.length * abs(math.sin(angle)) + self.width * abs(math.cos(angle))) / 2

    def edge(self, tick, side):
        """Return how far the box reaches to a side, counted in that direction [m]."""
        return side * self.across[tick] + self.side_reach(tick)

    def sideways(self, tick):
        """Return the speed to the right [m/s]."""
        if tick == 0:
            return self.body_speed[0] * math.sin(self.angle[0])
        was, now = self.rows[tick - 1], self.rows[tick]
        road = was[HEADING] - self.angle[tick - 1]
        return ((now[Y] - was[Y]) * math.cos(road) - (now[X] - was[X]) * math.sin(road)) * self.hz

    def deceleration(self, tick):
        return (self.body_speed[tick - 1] - self.body_speed[tick]) * self.hz if tick else 0.0

    def deceleration_along(self, tick):
        return (self.speed[tick - 1] - self.speed[tick]) * self.hz if tick else 0.0

    def off_centre(self, tick):
        """Return the distance from the lane's centre, positive to the right [m]."""
        return self.across[tick] - self.centre[tick]

    def is_over_its_line(self, tick, side):
        return self.edge(tick, side) > self.line(tick, side)

    def line(self, tick, side):
        """Return the position of its own lane's line on a side, counted in that direction [m]."""
        return side * self.centre[tick] + self.lane_width[tick] / 2


def metres(a, b, tick):
    """Return the metres driven between two vehicles, per metre of the way: the mean of both places' stretch."""
    return (a.stretch[tick] + b.stretch[tick]) / 2


def nearest_lane(trace, row):
    """Return the lane in a row of the trace, or the nearest lane if the vehicle is off the road."""
    if row[LANE] >= 0:
        return int(row[LANE])
    return min(range(len(trace.lanes)), key=lambda lane: distance_to(trace.lanes[lane], (row[X], row[Y])))


def distance_to(lane, place):
    """Return the distance from a place to the centre line of a lane [m]."""
    points = lane.points or ((lane.x, lane.y), end_of(lane))
    return min(point_to_segment(place, *piece) for piece in pairwise(points))


def gap(a, b, tick):
    return abs(a.along[tick] - b.along[tick]) * metres(a, b, tick) - a.reach(tick) - b.reach(tick)


def beside(a, b, tick):
    """Return the gap between the boxes across the road [m]; at most 0 if they are in one track."""
    return abs(a.across[tick] - b.across[tick]) - a.side_reach(tick) - b.side_reach(tick)


def in_one_track(a, b, tick):
    return beside(a, b, tick) <= 0


def is_behind(ego, npc, tick):
    """Return whether the ego is the vehicle behind; it is if the centres are level."""
    return ego.along[tick] <= npc.along[tick]


def side_of(other, own, tick):
    return 1 if other.across[tick] > own.across[tick] else -1


def safe_along(behind, ahead, tick):
    v, u = behind.speed[tick], ahead.speed[tick]
    return max(0.0, v * 1.0 + v * abs(v) / 12 - u * abs(u) / 16)


def safe_across(a, b, tick):
    closer = 0.0
    for own, other in ((a, b), (b, a)):
        s = side_of(other, own, tick) * own.sideways(tick)
        t = s + 0.2
        closer += s * 1.0 + 0.1 + t * abs(t) / 1.6
    return 0.1 + max(0.0, closer)


def giving_way(behind, ahead):
    """Return the gap that a vehicle must leave, from the speeds of the vehicles behind and ahead [m]."""
    dv = max(0.0, behind - ahead)
    return max(0.0, dv * 0.4 + dv**2 / (2 * 3.0) + ahead * 1.0)


def first_of_last_stretch(holds, last):
    """Return the first tick of the unbroken stretch in which ``holds`` is true up to ``last``, which always counts."""
    first = last
    while first > 0 and holds(first - 1):
        first -= 1
    return first


class Crash:
    """A collision of the ego with an NPC, from their trace."""

    def __init__(self, trace):
        self.trace, self.hz, self.impact = trace, trace.physics_hz, trace.collision.tick
        self.vehicles = [Vehicle(trace, index) for index in range(trace.states.shape[1])]
        self.ego, self.npc = self.vehicles[0], self.vehicles[trace.collision.npc + 1]
        together = [in_one_track(self.ego, self.npc, 0)]
        for tick in range(1, self.impact + 1):  # a narrow vehicle that swerves in the lane has not left
            stays = together[-1] and self.ego.lane[tick] == self.npc.lane[tick]
            together.append(stays or in_one_track(self.ego, self.npc, tick))
        self.together = together
        self.joined = first_of_last_stretch(together.__getitem__, self.impact)
        self.danger = first_of_last_stretch(self.is_danger, self.impact)
        self.is_cut_in = self.is_drift = False

    def is_danger(self, tick):
        apart = gap(self.ego, self.npc, tick)
        pair = (self.ego, self.npc) if is_behind(self.ego, self.npc, tick) else (self.npc, self.ego)
        is_close_along = apart < safe_along(*pair, tick) or apart <= 0
        is_close_across = max(0.0, beside(self.ego, self.npc, tick)) < safe_across(self.ego, self.npc, tick)
        return is_close_along and (is_close_across or tick >= self.joined)

    def seconds(self, ticks):
        return ticks / self.hz

    def opinion(self, responsibility, fault=None, tick=None):
        tick = self.danger if tick is None else tick
        return Opinion(responsibility, fault, tick)

    def verdict(self):
        """Apply the rules in order, then the excuse for an ego that stands still."""
        opinion = self._by_the_first_rule_that_applies()
        is_excused = opinion.fault in ("leader-unanswered", "cut-in-unanswered") or self.is_drift
        if is_excused and opinion.responsibility == "ego" and self.stands() and not self.rolled_into_it():
            return self.opinion("npc", None, opinion.tick)
        return opinion

    def stands(self):
        return abs(self.ego.speed[self.impact]) <= STANDS

    def rolled_into_it(self):
        just_before = range(max(0, self.impact - int(0.5 * self.hz)), self.impact + 1)
        return any(self.ego.speed[tick] > STANDS for tick in just_before)

    def _by_the_first_rule_that_applies(self):
        mine = self.unless_given_up(self.ego, LaneChange.of(self, self.ego, self.npc))
        theirs = self.npc_moved_in_behind() or self.unless_given_up(self.npc, LaneChange.of(self, self.npc, self.ego))
        over = self.came_over()
        follows = self.danger > self.joined or self.joined == 0
        own = [each.moment for each in (mine, theirs) if each is not None]
        if over is not None and (follows or over[1].moment > max(own, default=-1)):
            return self.changed_lanes(*((over[1], None) if over[0] is self.ego else (None, over[1])))
        if follows:
            return self.one_follows_the_other()
        if mine is not None and theirs is not None and self.seconds(abs(mine.moment - theirs.moment)) > 1.0:
            mine, theirs = (mine, None) if mine.moment > theirs.moment else (None, theirs)
        if mine is not None or theirs is not None:
            return self.changed_lanes(mine, theirs)
        if gap(self.ego, self.npc, self.joined) <= 0:
            return self.drift()
        if self.joins_by_an_earlier_lane_change():
            return self._by_the_first_rule_that_applies()
        return self.one_follows_the_other()

    def joins_by_an_earlier_lane_change(self):
        """Count the two as in one track since an earlier lane change in this danger, if there is one."""
        joined = self.joined
        for tick in range(joined - 1, max(self.danger, 1) - 1, -1):
            if self.together[tick] and not self.together[tick - 1]:
                self.joined = tick
                changes = (LaneChange.of(self, self.ego, self.npc), LaneChange.of(self, self.npc, self.ego))
                kept = [self.unless_given_up(*each) for each in zip((self.ego, self.npc), changes, strict=True)]
                if any(each is not None for each in (*kept, self.npc_moved_in_behind())):
                    return True
        self.joined = joined
        return False

    def changed_lanes(self, mine, theirs):
        if mine is not None and theirs is not None:
            return self.both_changed_lanes(mine, theirs)
        return self.npc_changed_lanes(theirs) if mine is None else self.ego_changed_lanes(mine)

    # Rule 2, last paragraphs

    def unless_given_up(self, mover, change):
        """Return a lane change, or None if there is none or the mover gave it up."""
        if change is None or not mover.is_over_its_line(change.moment, change.side):
            return change
        is_in_its_lane = mover.rows[self.impact][LANE] == mover.rows[change.moment][LANE] >= 0
        is_back = is_in_its_lane and not mover.is_over_its_line(self.impact, change.side)
        return None if is_back else change

    def npc_moved_in_behind(self):
        """Return the NPC's latest lane change after they came into one track, or None."""
        found = [self.unless_given_up(self.npc, self.npc_moved_to(side)) for side in (-1, 1)]
        return max((change for change in found if change is not None), key=lambda change: change.moment, default=None)

    def npc_moved_to(self, side):
        """Return the NPC's last lane change to a side behind the ego, or None if there is none that matters."""
        for tick in range(self.impact, self.joined, -1):
            if not is_behind(self.ego, self.npc, tick - 1) and comes_over(self.npc, self.ego, tick, side):
                closed = 0.5 * (self.npc.speed[tick] - self.ego.speed[tick])
                return LaneChange(tick, tick, side) if gap(self.ego, self.npc, tick) >= closed else None
        return None

    def came_over(self):
        """Return the vehicle that came over and its lane change, or None."""
        first = max(self.danger, self.joined)
        for tick in range(self.impact, first, -1):
            is_ego_behind = is_behind(self.ego, self.npc, tick - 1)
            mover, other = (self.npc, self.ego) if is_ego_behind else (self.ego, self.npc)
            for side in (-1, 1):
                if comes_over(mover, other, tick, side):
                    return mover, LaneChange(first, tick, side)
        return None

    # Rule 3

    def ego_gives_way(self, at):
        """Return whether the ego gives way in a lane change ahead of the NPC, by its lowest speed in the change."""
        apart, then = gap(self.ego, self.npc, at), max(at, self.joined)
        return (
            apart > 0
            and apart >= giving_way(self.npc.speed[at], self.slowest_in_change(self.ego, at))
            and gap(self.ego, self.npc, then) >= giving_way(self.npc.speed[then], self.ego.speed[then])
        )

    def slowest_in_change(self, mover, at):
        """Return the mover's lowest speed in a lane change ahead of the other [m/s]."""
        end = min(self.impact, max(at, self.joined) + round(1.0 * self.hz))
        return min(mover.speed[at : end + 1])

    def both_changed_lanes(self, mine, theirs):
        at, later = mine.moment, max(mine.moment, theirs.moment)
        if not is_behind(self.ego, self.npc, at) and self.ego_gives_way(at):
            return self.npc_follows(at, tick=at)
        apart = gap(self.ego, self.npc, later)
        if not is_behind(self.ego, self.npc, later) and apart > 0:
            braked = self.braked_after_keeping_its_lane(later)
            if braked is not None:
                return self.npc_follows(braked, tick=theirs.moment, moved_in=theirs.moment)
            if apart >= 2.0 and self.npc_sped_up(later):
                return self.npc_follows(later, tick=theirs.moment, moved_in=theirs.moment)
        ego_behind = is_behind(self.ego, self.npc, self.joined)
        ahead, behind = (self.npc, self.ego) if ego_behind else (self.ego, self.npc)
        passed = self.duty_passes(ahead, behind, later)
        if passed is not None and ego_behind:
            return self.opinion(self.ego_or_both(theirs.moment), "leader-unanswered", passed.kept)
        if passed is not None:
            return self.npc_follows(passed.due, tick=passed.kept)
        return self.opinion("both", "entered-lane", at)

    def ego_changed_lanes(self, change):
        at = change.moment
        if is_behind(self.ego, self.npc, at):
            return self.opinion("ego", "entered-lane", at)
        apart = gap(self.ego, self.npc, at)
        had_room = apart > 0 and apart >= giving_way(self.npc.speed[at], self.ego.speed[at])
        answers_from = self.npc_answers_from(at, had_room)
        if answers_from is not None:
            return self.npc_follows(answers_from, tick=at)
        passed = self.duty_passes(self.ego, self.npc, at)
        if passed is not None:
            return self.npc_follows(passed.due, tick=passed.kept)
        due, is_ahead = max(at, self.danger - 1), gap(self.ego, self.npc, max(at, self.joined)) > 0
        if had_room and is_ahead and self.would_have_avoided(self.npc, self.ego, due):
            return self.opinion("both", "entered-lane", at)
        is_shared = self.has_second_chance(self.npc, self.ego, at) or (apart >= 2.0 and self.npc_sped_up_since(at))
        return self.opinion("both" if is_shared else "ego", "entered-lane", at)

    def npc_changed_lanes(self, change):
        at = change.moment
        if not is_behind(self.ego, self.npc, at) and gap(self.ego, self.npc, at) > 0:
            return self.npc_follows(at, tick=at, moved_in=at)
        self.is_cut_in = self.seconds(self.impact - at) <= 5.0
        if gap(self.ego, self.npc, at) <= 0 or gap(self.ego, self.npc, max(at, self.joined)) <= 0:
            return self.npc_unless_second_chance(at, moment=at)
        return self.cut_in(change)

    def npc_answers_from(self, at, had_room):
        """Return the tick from which the NPC must answer before the duty passes, or None."""
        if self.ego_gives_way(at):
            return at
        braked = self.braked_after_keeping_its_lane(at)
        if braked is not None:
            return braked
        kept_its_speed = min(self.ego.speed[at : self.impact + 1]) >= self.ego.speed[at] - 0.3
        return at if had_room and kept_its_speed and self.npc_sped_up(at) else None

    def braked_after_keeping_its_lane(self, since):
        """Return the tick at which the ego began to brake for nothing after it kept its lane since a tick, or None."""
        second = self.keeps_its_lane(self.ego, since)
        began = self.braked_for_nothing(self.ego, self.npc)
        return began if second is not None and began is not None and began >= second[1] else None

    def npc_sped_up(self, at):
        """Return whether the NPC, hardly faster than the ego at a tick, sped up into it."""
        return self.npc.speed[at] <= self.ego.speed[at] + 0.3 and self.npc_sped_up_since(at)

    def npc_sped_up_since(self, at):
        """Return whether the NPC sped up into the ego after a tick, whatever its speed then."""
        return self.sped_up_into(self.npc, self.ego, at + round(0.4 * self.hz))

    def sped_up_into(self, behind, ahead, first, nearer=math.inf):
        """Return whether the vehicle behind sped up into the other, and its lowest speed would have avoided it.

        It is enough if that would have kept it ``nearer`` metres further back.
        """
        if not self.gains_speed(behind, first):
            return False
        drive = Response(self, behind, ahead, first, delay=0.0, perceived=0.0)
        lowest = behind.speed[first]
        for tick in range(first, self.impact):
            drive.lag += (behind.speed[tick] - lowest) / self.hz
            lowest = min(lowest, behind.speed[tick + 1])
            if drive.is_contact(tick + 1):
                return False
        closing = max(0.0, lowest - ahead.speed[self.impact])
        return drive.straight_gap(self.impact) > closing**2 / (2 * 6.0) or drive.lag >= nearer

    def gains_speed(self, behind, first):
        """Return whether a vehicle is ever over 0.3 m/s faster than its lowest speed from a tick on up to then."""
        most, slowest = 0.0, first
        for tick in range(first, self.impact + 1):
            if behind.speed[tick] <= behind.speed[slowest]:
                slowest = tick
            most = max(most, behind.speed[tick] - behind.speed[slowest])
        return most > 0.3

    # Rule 4a

    def duty_passes(self, mover, other, since):
        """Return from when the duty passes to the other, which would have avoided the collision, or None."""
        second = self.keeps_its_lane(mover, since)
        if second is None:
            return None
        if not self.would_have_avoided(other, mover, max(second[1], self.danger - 1)):
            return None
        return Passed(*second)

    def keeps_its_lane(self, vehicle, since):
        """Return the first period since a tick in which the vehicle kept its lane for long enough, or None."""
        near = inside = 0
        for tick in range(since, self.impact + 1):
            off = abs(vehicle.off_centre(tick))
            near = near + 1 if off <= OFF_CENTRE else 0
            inside = inside + 1 if off + vehicle.side_reach(tick) <= vehicle.lane_width[tick] / 2 else 0
            for ticks, length in ((near, round(1.0 * self.hz)), (inside, round(2.0 * self.hz))):
                if ticks > length:
                    return tick - length, tick
        return None

    # Rule 4b

    def one_follows_the_other(self):
        if is_behind(self.ego, self.npc, self.danger):
            before = max(self.danger - 1, 0)
            if self.would_have_avoided(self.ego, self.npc, before) or (
                self.only_ego_came_sideways()
                and self.would_have_avoided(self.ego, self.npc, self.last_far_tick(before))
            ):
                return self.opinion(self.ego_or_both(), "leader-unanswered")
            return self.npc_unless_second_chance(self.danger, seen=before)
        return self.npc_follows(0, tick=self.danger)

    def only_ego_came_sideways(self):
        """Return whether the ego alone moved sideways when the two came into one track, later than the danger began."""
        if self.joined == 0 or self.danger > self.joined:
            return False
        side = side_of(self.npc, self.ego, self.joined - 1)
        ego, npc = side * self.ego.sideways(self.joined), -side * self.npc.sideways(self.joined)
        return ego >= MOVES_SIDEWAYS > npc

    def last_far_tick(self, before):
        """Return the last tick, up to the given one, at which the ego was not too close behind the NPC, or 0."""
        for tick in range(before, -1, -1):
            apart = gap(self.ego, self.npc, tick)
            is_close = 0 < apart < safe_along(self.ego, self.npc, tick)
            if not is_close or not is_behind(self.ego, self.npc, tick):
                return tick
        return 0

    def npc_follows(self, since, *, tick, moved_in=None):
        """Apply rule 4b since a tick from rule 3 or 4a, or 0; ``moved_in`` is when the NPC moved in behind the ego."""
        due = max(since, self.danger - 1, 0)
        braked, stop = self.braked_for_nothing(self.ego, self.npc, since, moved_in), self.stopped_for_nothing(moved_in)
        if braked is None and stop is None:
            return self.opinion("npc", None, tick)
        is_hard = braked is not None and self.is_harder_than_5(self.ego, (braked + 1, self.hard_braking(self.ego)[1]))
        fault, began = "braked-for-nothing" if is_hard else "stopped-for-nothing", stop
        if is_hard or stop is None:
            began, due = braked, max(since, min(due, braked))
        could = moved_in is not None or self.would_have_avoided(self.npc, self.ego, due)
        return self.opinion("both" if could else "ego", fault, began)

    # Rule 4c

    def has_second_chance(self, behind, ahead, named):
        """Return whether the vehicle behind had a second chance after the tick that the reason names first."""
        first = max(named, self.danger - 1) + round(1.0 * self.hz)
        looked_at = [
            tick
            for tick in range(first, self.impact)
            if behind.along[tick] < ahead.along[tick] and gap(behind, ahead, tick) > 0
        ]
        no_faster = [tick for tick in looked_at if behind.speed[tick] <= ahead.speed[tick]]
        if no_faster and self.would_have_avoided_a_cut_in(behind, ahead, no_faster[-1]):
            return True
        for tick in looked_at:
            if self.lets_the_brakes_go(behind, ahead, tick) and self.could_have_braked_on(behind, ahead, tick):
                return True
        return False

    def lets_the_brakes_go(self, behind, ahead, tick):
        """Return whether the vehicle behind releases the brakes for 0.4 s before the impact although it is faster."""
        end = tick + round(0.4 * self.hz)
        return (
            end <= self.impact
            and behind.speed[tick] > ahead.speed[tick]
            and self.is_braking(behind, tick)
            and not any(self.is_braking(behind, later) for later in range(tick + 1, end + 1))
        )

    def is_braking(self, vehicle, tick):
        """Return whether the step to a tick is one of a row of steps that slow down and together take 0.2 m/s."""
        if vehicle.deceleration(tick) < BRAKES:
            return False
        before, last = tick - 1, tick
        while vehicle.deceleration(before) >= BRAKES:
            before -= 1
        while last < self.impact and vehicle.deceleration(last + 1) >= BRAKES:
            last += 1
        return vehicle.body_speed[before] - vehicle.body_speed[last] >= 0.2

    def npc_unless_second_chance(self, named, moment=None, seen=None):
        """Return the verdict for an ego behind that is excused; ``moment`` is the time of the NPC's lane change.

        Rule 5 gives the tick ``seen``, from which the NPC can be seen.
        """
        if not (
            self.has_second_chance(self.ego, self.npc, named)
            or (seen is not None and self.ego_sped_up(seen))
            or self.ego_braked_less(max(named, self.danger - 1), is_after_change=moment is not None)
        ):
            return self.opinion("npc", None, named)
        is_shared = moment is not None and not self.stands() and self.cuts_in_soon_before(moment)
        return self.opinion("both" if is_shared else "ego", "leader-unanswered", named)

    def ego_sped_up(self, seen):
        """Return whether the ego sped up towards an NPC ahead, counted from a tick, and should not have."""
        first = seen + round(0.4 * self.hz)
        if first >= self.impact or self.is_as_far_back_as_asked(seen):
            return False
        drive = Response(self, self.ego, self.npc, first, delay=0.0, perceived=0.0)
        for tick in range(first, self.impact + 1):
            has_headway = drive.straight_gap(tick) >= 1.0 * self.ego.speed[tick]
            if self.ego.speed[tick] <= self.npc.speed[tick] and has_headway:
                first = tick
        return self.gains_speed(self.ego, first) and (
            self.sped_up_into(self.ego, self.npc, first, nearer=0.5)
            or self.would_have_avoided_a_cut_in(self.ego, self.npc, seen)
        )

    def ego_braked_less(self, since, is_after_change):
        """Return whether the ego braked at a tick, soon braked less, and would have avoided the collision otherwise."""
        was = self.ego.deceleration(since)
        if was < 1.3 or not is_behind(self.ego, self.npc, since) or gap(self.ego, self.npc, since) <= 0:
            return False
        count, needed = 0, math.ceil(0.4 * self.hz)
        for tick in range(since + 1, min(since + round(1.0 * self.hz), self.impact) + 1):
            is_weak = self.ego.deceleration(tick) < was / 2 and self.ego.speed[tick] > self.npc.speed[tick]
            count = count + 1 if is_weak else 0
            if count == needed:
                soon = Response(self, self.ego, self.npc, since, delay=0.4, perceived=0.0)
                late = Response(self, self.ego, self.npc, since, delay=1.0, perceived=0.0, kept=was)
                return soon.avoids(lambda tick: 6.0, brakes_on=self.is_cut_in) and (
                    not is_after_change or late.avoids(lambda tick: max(was, 6.0), brakes_on=self.is_cut_in)
                )
        return False

    # Rule 5

    def cut_in(self, change):
        at = change.moment
        seen = at
        while seen > change.start and self.is_seen(seen - 1, change) and self.is_seen(at, change):
            seen -= 1
        if gap(self.ego, self.npc, at) < 0.3 * self.ego.speed[at] and self.npc_brakes_hard(at, within=2.0):
            return self.npc_unless_it_was_ignored(at, seen)
        dv = self.ego.speed[seen] - self.npc.speed[seen]
        nobody_can = dv > 0 and gap(self.ego, self.npc, seen) <= dv * (1.4 + dv / (2 * 6.0))
        steps = range(seen + 1, min(self.impact, seen + round(1.6 * self.hz)) + 1)
        to_spare = 0.2 if any(self.ego.deceleration(tick) >= BRAKES for tick in steps) else 0.0
        if not nobody_can and self.would_have_avoided_a_cut_in(self.ego, self.npc, seen, to_spare):
            return self.opinion(self.ego_or_both(at), "cut-in-unanswered", at)
        passed = None if self.is_as_far_back_as_asked(seen) else self.duty_passes(self.npc, self.ego, at)
        if passed is not None:
            return self.opinion(self.ego_or_both(at), "leader-unanswered", passed.kept)
        return self.npc_unless_it_was_ignored(at, seen)

    def npc_unless_it_was_ignored(self, at, seen):
        """Return the opinion on a cut-in that excuses the ego, unless it hardly slowed down and braking hard helped."""
        opinion = self.npc_unless_second_chance(at, at, seen)
        counts_from = at + round(1.2 * self.hz)
        if opinion.responsibility != "npc" or self.stands() or self.impact < counts_from + round(0.5 * self.hz):
            return opinion
        lost = self.ego.speed[counts_from] - self.ego.speed[self.impact]
        calmly = 3.0 * self.seconds(self.impact - at - round(1.4 * self.hz))
        if lost < calmly and self.could_have_braked_on(self.ego, self.npc, at + round(1.0 * self.hz)):
            return self.opinion("both", "cut-in-unanswered", at)
        return opinion

    def npc_brakes_hard(self, at, *, within=math.inf):
        """Return whether the NPC begins to brake hard, for at least 0.4 s, within a time after a tick."""
        length = round(0.4 * self.hz)
        return any(
            all(self.npc.deceleration_along(tick + ticks) > 5.0 for ticks in range(1, length + 1))
            for tick in range(at, self.impact - length + 1)
            if self.seconds(tick - at) <= within
        )

    def ego_or_both(self, moment=None):
        """Return whether the ego or both are responsible; ``moment`` is the time of the NPC's lane change, if any."""
        if self.stands():
            return "ego"
        cut_in_and_braked = moment is not None and self.cuts_in_soon_before(moment) and self.npc_brakes_hard(moment)
        return "both" if cut_in_and_braked or self.npc_braked_close_for_nothing() else "ego"

    def npc_braked_close_for_nothing(self):
        began = self.braked_for_nothing(self.npc, self.ego)
        return began is not None and gap(self.ego, self.npc, began) <= 1.0 * self.ego.speed[began]

    def cuts_in_soon_before(self, at):
        """Return whether the NPC's lane change did not give way and was at most 5 s before the impact."""
        asked = [giving_way(self.ego.speed[at], v) for v in (self.npc.speed[at], self.slowest_in_change(self.npc, at))]
        gave_way = gap(self.ego, self.npc, at) >= max(asked)
        return not gave_way and self.seconds(self.impact - at) <= 5.0

    def is_seen(self, tick, change):
        return change.side * self.npc.off_centre(tick) > OFF_CENTRE

    # Rule 1

    def would_have_avoided(self, responder, other, due):
        """Return whether a follower would have avoided it: 1.0 s of delay, then 6 m/s^2."""
        drive = Response(self, responder, other, due, delay=1.0, perceived=0.0)
        return drive.avoids(lambda tick: 6.0, brakes_on=self.is_cut_in)

    def would_have_avoided_a_cut_in(self, responder, other, seen, to_spare=0.0):
        """Return whether 1.4 s of delay, then 3 (emergency: 6) m/s^2 avoid it, even with ``to_spare`` more seconds."""
        drive = self.response_to_a_cut_in(responder, other, seen)
        avoids = drive.avoids(Emergency(drive).deceleration, brakes_on=self.is_cut_in)
        if drive.mastered is not None:
            return self.would_have_avoided_a_cut_in(responder, other, drive.mastered, to_spare)
        late = self.response_to_a_cut_in(responder, other, seen, to_spare)
        return avoids and late.is_free(Emergency(late).deceleration, brakes_on=self.is_cut_in)

    def response_to_a_cut_in(self, responder, other, seen, to_spare=0.0):
        return Response(self, responder, other, seen, delay=1.4 + to_spare, perceived=0.4, to_cut_in=True)

    def is_as_far_back_as_asked(self, seen):
        """Return whether the ego is as far back at the impact as the response to a cut-in requires."""
        drive = self.response_to_a_cut_in(self.ego, self.npc, seen)
        drive.is_free(Emergency(drive).deceleration, brakes_on=self.is_cut_in)
        return drive.lag_at_impact <= 0

    def could_have_braked_on(self, responder, other, since):
        """Return whether braking at once with 6 m/s^2 would have avoided it."""
        drive = Response(self, responder, other, since, delay=0.0, perceived=0.0)
        return drive.avoids(lambda tick: 6.0, brakes_on=self.is_cut_in)

    # Rule 7

    def braked_for_nothing(self, braker, follower, since=0, moved_in=None):
        """Return the tick at which braking for nothing begins, or None."""
        stretch = self.hard_braking(braker)
        if stretch is None or stretch[1] < max(self.danger - round(1.0 * self.hz), since):
            return None
        began = end = stretch[0] - 1
        if self.is_harder_than_5(braker, stretch):
            end = min(self.impact, began + round(0.4 * self.hz))
        if self.counts(braker, follower, began, end, stretch[1], moved_in):
            return began
        return self.braked_on(began, stretch[1], moved_in) if braker is self.ego else None

    def braked_on(self, began, last, moved_in):
        """Return the tick from which the ego's braking went on for nothing after its last reason, or None."""
        ticks = range(max(0, began - round(1.6 * self.hz)), min(last, self.impact - 1) + 1)
        had_reason = [tick for tick in ticks if self.is_reason(self.ego, tick, self.ego.lane[ticks[-1]])]
        if not had_reason:
            return None
        rest = max(began, had_reason[-1]) + round(1.0 * self.hz)
        if rest >= last:
            return None
        had, lost = self.ego.body_speed[rest], self.ego.body_speed[rest] - self.ego.body_speed[last]
        if lost < max(had / 2, 5.0) or not self.counts(self.ego, self.npc, rest, rest, last, moved_in, has_reason=True):
            return None
        return rest

    def is_harder_than_5(self, braker, stretch):
        """Return whether the deceleration exceeds 5 m/s^2 at any tick of a stretch."""
        return any(braker.deceleration(tick) > 5.0 for tick in range(stretch[0], stretch[1] + 1))

    def hard_braking(self, braker):
        """Return the first and last tick of the stretch of hard braking that counts, or None."""
        found = [
            (first, last)
            for first, last in self.stretches(braker, 5.0)
            if self.seconds(last - first + 1) >= 0.4 - ROUNDING
        ]
        if braker is self.ego:
            for first, last in self.stretches(braker, 4.0):
                had, lost = braker.body_speed[first - 1], braker.body_speed[first - 1] - braker.body_speed[last]
                if lost >= max(had / 2, 5.0):
                    found.append((first, last))
        return max(found, key=lambda stretch: (stretch[1], -stretch[0]), default=None)

    def stretches(self, braker, hard):
        """Return the first and last ticks of the stretches up to the impact that brake harder than ``hard`` [m/s^2]."""
        found, first = [], None
        for tick in range(1, self.impact + 2):
            is_hard = tick <= self.impact and braker.deceleration(tick) > hard
            if not is_hard and first is not None:
                found.append((first, tick - 1))
            first = (first or tick) if is_hard else None
        return found

    def stopped_for_nothing(self, moved_in):
        """Return the tick at which the braking to a standstill begins, or None."""
        speed = self.ego.body_speed
        moving = [tick for tick in range(self.impact + 1) if speed[tick] > STANDS]
        if not moving:
            return None
        stood = moving[-1] + 1
        if self.seconds(self.impact - stood) < 3.0 - ROUNDING or self.npc.speed[self.danger] <= 3.0:
            return None
        began = next(tick for tick in range(stood, -1, -1) if tick == 0 or speed[tick] >= speed[tick - 1])
        if self.counts(self.ego, self.npc, began, stood, stood, moved_in):
            return began
        return self.braked_on(began, stood, moved_in)

    def counts(self, braker, follower, began, end, last, moved_in, *, has_reason=False):
        """Return whether braking was for nothing: it had no reason from 1.6 s before it began until ``end``.

        With ``has_reason``, reasons are not looked at.
        """
        is_ahead = is_behind(self.ego, self.npc, began) == (follower is self.ego)
        if not is_ahead or braker.speed[self.impact] >= braker.speed[began]:
            return False
        if gap(braker, follower, began) < 2.0 * (follower.speed[began] - braker.speed[began]):
            return False
        if braker.speed[self.impact] > STANDS and self.seconds(self.impact - last) > 3.0:
            return False
        if moved_in is not None and self.seconds(moved_in - last) > 1.0:
            return False
        if follower.speed[self.impact] > min(follower.speed[max(last, self.danger - 1) : self.impact + 1]) + 1.0:
            return False
        ticks = range(max(0, began - round(1.6 * self.hz)), end + 1)
        return has_reason or not any(self.is_reason(braker, tick, braker.lane[end]) for tick in ticks)

    def is_reason(self, braker, tick, lane):
        others = [vehicle for vehicle in self.vehicles if vehicle is not braker]
        is_leader = any(self.is_leader_a_reason(braker, other, tick) for other in others)
        is_entered = any(self.is_entering(braker, other, tick) for other in others)
        is_met = any(self.is_met_soon(braker, npc, tick) for npc in range(len(self.vehicles) - 1))
        return is_leader or is_entered or is_met or self.is_end_of_lane_near(braker, tick, lane)

    def is_met_soon(self, braker, npc, tick):
        """Return whether the braker and a crossing NPC are both within 4 s or 5 m of the NPC's zone, or in it."""
        zone = self.trace.zones[npc] if self.trace.zones else None
        crossing = self.vehicles[npc + 1]
        if zone is None or crossing is braker:
            return False
        pair = (braker, braker.along[tick], zone.ego), (crossing, self.trace.on_way[tick, npc], zone.npc)
        return all(
            place < last and first - place <= max(4.0 * vehicle.body_speed[tick], 5.0)
            for vehicle, place, (first, last) in pair
        )

    def is_ahead_or_side_by_side(self, braker, other, tick):
        return other.along[tick] > braker.along[tick] or gap(braker, other, tick) <= 0

    def is_leader_a_reason(self, braker, other, tick):
        if not self.is_ahead_or_side_by_side(braker, other, tick) or not in_one_track(braker, other, tick):
            return False
        apart, closing = gap(braker, other, tick), braker.speed[tick] - other.speed[tick]
        is_braking = other.deceleration_along(tick) > 5.0 and apart <= 4.0 * braker.speed[tick]
        return apart < max(safe_along(braker, other, tick), 5.0, 4.0 * closing) or is_braking

    def is_entering(self, braker, other, tick):
        if not self.is_ahead_or_side_by_side(braker, other, tick) or in_one_track(braker, other, tick):
            return False
        side = side_of(other, braker, tick)
        closing = side * (braker.sideways(tick) - other.sideways(tick))
        return (
            beside(braker, other, tick) < braker.lane_width[tick]
            and gap(braker, other, tick) <= 4.0 * braker.speed[tick]
            and closing >= MOVES_SIDEWAYS
        )

    def is_end_of_lane_near(self, braker, tick, lane):
        end = end_of(self.trace.lanes[lane])
        if any(math.dist(end, (other.x, other.y)) <= 1.0 for other in self.trace.lanes):
            return False
        place = braker.rows[tick][X], braker.rows[tick][Y]
        return math.dist(end, place) < 4.0 * braker.speed[tick]

    # Rule 8

    def drift(self):
        at, side = self.joined, side_of(self.npc, self.ego, self.joined)
        self.is_drift = True
        towards = side * self.ego.sideways(at), -side * self.npc.sideways(at)
        ego, npc = (speed >= MOVES_SIDEWAYS for speed in towards)
        if ego == npc:
            ego, npc = self.ego.is_over_its_line(at, side), self.npc.is_over_its_line(at, -side)
        if ego == npc:
            ego = towards[0] - towards[1] >= MOVES_SIDEWAYS
        return self.opinion("ego", "entered-lane", at) if ego else self.opinion("npc", None, at)


def end_of(lane):
    if lane.points:
        return lane.points[-1]
    return lane.x + lane.length * math.cos(lane.heading), lane.y + lane.length * math.sin(lane.heading)


@dataclass(frozen=True)
class LaneChange:
    """Rule 2: a lane change to a side, from the first tick of the motion past the moment at the line."""

    start: int
    moment: int
    side: int

    @classmethod
    def of(cls, crash, mover, other):
        """Return the mover's lane change into the other's track, or None."""
        joined = crash.joined
        if joined == 0:
            return None
        side = side_of(other, mover, joined - 1)
        start = start_of_motion(mover, joined, side)
        if start is None:
            return None
        moment = last_crossing(mover, range(start, joined + 1), side)
        if moment is None and not mover.is_straight:
            line = side * other.centre[joined] - other.lane_width[joined] / 2
            moment = next((tick for tick in range(start, joined + 1) if mover.edge(tick, side) > line), None)
        return None if moment is None else cls(start, moment, side)


def start_of_motion(mover, last, side):
    """Return the first tick of the sideways motion that still continues at the last tick, or None."""
    moving = [tick for tick in range(last + 1) if side * mover.sideways(tick) >= MOVES_SIDEWAYS]
    if not moving or (last - moving[-1]) / mover.hz >= 0.5 - ROUNDING:
        return None
    start = moving[-1]
    for tick in reversed(moving):
        if (start - tick - 1) / mover.hz >= 0.5 - ROUNDING:
            break
        start = tick
    return start


def comes_over(mover, other, tick, side):
    """Return whether the mover crosses the line into a lane in which the other already is."""
    before = tick - 1
    crosses = mover.is_over_its_line(tick, side) and not mover.is_over_its_line(before, side)
    if not crosses or side * mover.sideways(tick) < MOVES_SIDEWAYS:
        return False
    if mover.rows[before][LANE] < 0 or other.rows[before][LANE] < 0:
        return False
    lanes = side * (other.centre[before] - mover.centre[before]) / mover.lane_width[before]
    return 0.5 <= lanes <= 1.5


def last_crossing(mover, motion, side):
    """Return the first tick of the last stretch in which the box was over its lane's line, or None."""
    first, was_over = None, False
    for tick in motion:
        is_over = mover.is_over_its_line(tick, side)
        has_passed = tick > motion[0] and side * (mover.centre[tick] - mover.centre[tick - 1]) > 1.0
        if is_over and (has_passed or not was_over):
            first = tick
        was_over = is_over
    return first


@dataclass(frozen=True)
class Passed:
    """Rule 4a: the tick from which the mover kept its lane, and the tick at which the duty passes."""

    kept: int
    due: int


class Response:
    """Rule 1: the responder drives its recorded line at computed speeds."""

    LONGEST = 12.0

    def __init__(self, crash, responder, other, since, *, delay, perceived, to_cut_in=False, kept=0.0):
        self.crash, self.responder, self.other, self.since = crash, responder, other, since
        self.hz, self.impact, self.to_cut_in, self.kept = crash.hz, crash.impact, to_cut_in, kept
        self.delay = round(delay * self.hz)
        self.due = since + self.delay
        self.perceived = since + round(perceived * self.hz)
        self.speeds = {since: responder.speed[since]}
        self.others_speeds = dict(enumerate(other.speed[: self.impact + 1]))
        self.lag = self.lag_at_impact = self.others_way = 0.0
        self.mastered = None

    def avoids(self, deceleration, *, brakes_on=False):
        """Return whether it would have avoided the collision, and the real driver has not answered."""
        is_free = self.is_free(deceleration, brakes_on=brakes_on)
        if self.since >= self.impact or self.has_answered():
            return False
        if self.to_cut_in:
            self.mastered = self.last_mastered()
        return is_free

    def is_free(self, deceleration, *, brakes_on):
        """Return whether there is no contact; with ``brakes_on``, the other continues to brake after the impact."""
        is_hit = False
        for tick in range(self.since, self.impact):
            self.speeds[tick + 1] = self.next_speed(tick, deceleration(tick))
            self.lag += (self.responder.speed[tick] - self.speeds[tick]) / self.hz
            is_hit = is_hit or self.is_contact(tick + 1)
        self.lag_at_impact = self.lag
        return not is_hit and self.is_free_after_the_impact(deceleration, brakes_on)

    def next_speed(self, tick, deceleration):
        """Return the speed after the step that begins at a tick [m/s]."""
        own, is_due = self.speeds[tick], tick + 1 >= self.due
        braked = max(0.0, own - (deceleration if is_due else self.kept) / self.hz) if self.slows_down(tick) else own
        if is_due or tick + 1 > self.impact:
            return braked
        recorded = self.responder.speed[tick + 1]
        return recorded if tick + 1 <= self.perceived else min(braked, recorded)

    def slows_down(self, tick):
        own, other = self.speeds[tick], self.others_speeds[tick]
        is_too_close = self.to_cut_in and self.straight_gap(tick) < own * 1.0 and other - own < 2.0
        return own > other or is_too_close

    def has_answered(self):
        ticks = range(self.since, self.impact + 1)
        was_never_faster = all(self.responder.speed[tick] <= self.speeds[tick] + 0.1 for tick in ticks)
        is_as_slow = self.responder.speed[self.impact] <= self.speeds[self.impact] + (0.5 if self.to_cut_in else 0.1)
        return was_never_faster or (is_as_slow and self.lag_at_impact <= 0.2 * self.responder.speed[self.impact])

    def last_mastered(self):
        """Return the last tick up to which the real driver had answered, or None."""
        last = None
        for tick in range(self.since, self.impact + 1):
            own = self.responder.speed[tick]
            if own > self.speeds[tick] + 0.1:
                break
            if tick >= self.due and own <= self.other.speed[tick]:
                last = tick
        return last

    def ahead_by(self, tick):
        """Return how far the other's centre is ahead of the responder's computed place [m]."""
        at = min(tick, self.impact)
        apart = (self.other.along[at] - self.responder.along[at]) * metres(self.other, self.responder, at)
        return apart + self.lag + self.others_way

    def is_contact(self, tick):
        own, other = self.responder, self.other
        places = (0.0, own.across[tick], own.angle[tick]), (self.ahead_by(tick), other.across[tick], other.angle[tick])
        if abs(places[1][0]) > (math.hypot(own.length, own.width) + math.hypot(other.length, other.width)) / 2:
            return False
        boxes = corners(places[0], own.length, own.width), corners(places[1], other.length, other.width)
        return polygons_meet(*boxes)

    def straight_gap(self, tick):
        """Return the gap at a tick, as if the boxes were straight; negative if the responder has passed [m]."""
        return self.ahead_by(tick) - (self.responder.length + self.other.length) / 2

    def is_free_after_the_impact(self, deceleration, brakes_on):
        tick = self.impact
        falls = max(0.0, self.other.deceleration_along(tick)) if brakes_on else 0.0
        while True:
            own, other = self.speeds[tick], self.others_speeds[tick]
            still_brakes = falls > ROUNDING and other > 0
            if (not still_brakes and own <= other) or (tick - self.impact) / self.hz >= self.LONGEST:
                return True
            self.speeds[tick + 1] = self.next_speed(tick, deceleration(tick))
            self.others_speeds[tick + 1] = max(0.0, other - falls / self.hz) if still_brakes else other
            self.lag -= own / self.hz
            self.others_way += other / self.hz
            tick += 1
            if self.straight_gap(tick) <= 0:
                return False


class Emergency:
    """Braking of the responder to a cut-in, tick by tick."""

    def __init__(self, drive):
        self.drive, self.count, self.first = drive, 0, None

    def deceleration(self, tick):
        """Return the deceleration at a tick; call it for every tick in order [m/s^2]."""
        drive = self.drive
        own, other = drive.speeds[tick], drive.others_speeds[tick]
        self.count = self.count + 1 if self.is_one(tick, own - other) else 0
        if self.first is None and self.count >= round(0.4 * drive.hz):
            self.first = tick - self.count + 1
        acts = self.first is not None and tick + 1 >= self.first + drive.delay
        if acts and tick >= self.first + drive.delay and own <= other:  # it has acted
            self.count, self.first, acts = 0, None, False
        return 6.0 if acts else 3.0

    def is_one(self, tick, closing):
        speeds = self.drive.others_speeds
        falls = (speeds[tick - 1] - speeds[tick]) * self.drive.hz if tick else 0.0
        return (closing > 0 and self.drive.straight_gap(tick) / closing < 2.0) or falls > 5.0


class Comer:
    """A vehicle on one of two ways that meet, as rule 9 sees it."""

    def __init__(self, trace, vehicle):
        zone = trace.zones[trace.collision.npc]
        column = trace.on_way[:, vehicle - 1] if vehicle else trace.track[:, 0, ALONG]
        self.hz, self.impact = trace.physics_hz, trace.collision.tick
        self.place, self.speed = column.tolist(), trace.states[:, vehicle, SPEED].tolist()
        self.first, self.last = zone.npc if vehicle else zone.ego
        self.length = trace.sizes[vehicle].tolist()[0]
        self.has_priority = zone.priority == ("npc" if vehicle else "ego")
        self.boxes = [
            corners((row[X], row[Y], row[HEADING]), *trace.sizes[vehicle].tolist())
            for row in trace.states[:, vehicle].tolist()
        ]
        self.enters, tick = None, self.impact
        while tick >= 0 and self.place[tick] >= self.first - 1.0:
            if self.enters is None or self.place[tick] >= self.first:
                self.enters = tick
            tick -= 1

    def is_within(self):
        return self.first - 1.0 <= self.place[self.impact] <= self.last + 1.0

    def left(self, tick):
        """Return the distance to the end of its stretch [m]."""
        return self.last - self.place[tick]

    def chance_to_stop(self):
        found = self.last_to_stop_before(self.first, self.enters)
        return 0 if found is None else found

    def braking_chance(self):
        """Return the last tick at which it brakes already and can still stop before its stretch, or None."""
        return self.last_to_stop_before(self.first, self.enters, is_braking=True)

    def last_to_stop_before(self, place, end, *, is_braking=False):
        """Return the last tick before ``end`` at which it can still stop before a place, or None."""
        for tick in range(end)[::-1]:
            v = self.speed[tick]
            can = v * (0.4 if is_braking else 1.0) + v**2 / 12 <= place - self.place[tick]
            brakes = tick > 0 and (self.speed[tick - 1] - v) * self.hz >= 1.3
            if can and (brakes or not is_braking):
                return tick
        return None

    def look(self, chance):
        return [tick for tick in range(chance + 1) if chance - tick <= round(0.6 * self.hz)]

    def leaves(self):
        """Return when it leaves its stretch [s]; like all times here, this may be after the impact."""
        for tick in range(self.enters, self.impact + 1):
            if self.left(tick) <= 0:
                return tick / self.hz
        still = self.left(self.impact)
        return self.impact / self.hz + still / self.speed[self.impact] if self.speed[self.impact] > 0 else math.inf

    def foreseen(self, tick, when):
        """Return the place and speed at a time, as an observer would predict them at a tick."""
        v, duration = self.speed[tick], when - tick / self.hz
        if v <= 0:
            return self.place[tick], 0.0
        falls = (self.speed[tick - 1] - v) * self.hz if tick > 0 else 0.0
        if falls < 1.3:
            return self.place[tick] + v * duration, v
        if duration >= v / falls:
            return self.place[tick] + v * v / falls / 2, 0.0
        after = v - falls * duration
        return self.place[tick] + duration * (v + after) / 2, after

    def lowest_for_a_second(self, tick):
        return min(self.speed[tick : min(tick + self.hz, self.impact) + 1])


class Crossing:
    """Rule 9: a collision with an NPC that crosses."""

    def __init__(self, trace):
        npc = trace.collision.npc
        self.trace, self.is_merge = trace, trace.zones[npc].kind == "merging"
        self.impact = trace.collision.tick
        self.ego, self.npc = Comer(trace, 0), Comer(trace, npc + 1)
        has_row = [not math.isnan(along) for along in trace.track[:, npc + 1, ALONG].tolist()]
        self.until = max((tick for tick, is_on_way in enumerate(has_row) if is_on_way), default=-1)
        self.since = self.until
        while self.since > 0 and has_row[self.since - 1]:
            self.since -= 1
        is_lane = self.until > self.since and self.impact - self.until <= 1.0 * self.ego.hz
        self.lane = Crash(part_of(trace, self.since, self.until)) if is_lane else None

    def verdict(self):
        if self.lane is not None and self.lane.danger > 0:
            return self.by_lane()
        both_within = self.ego.is_within() and self.npc.is_within()
        both_entered = self.ego.enters is not None and self.npc.enters is not None
        if both_within or (self.is_merge and self.lane is not None and both_entered):
            opinion = self.by_priority()
            if opinion is not None:
                return opinion
        return self.by_lane() if self.lane is not None else Opinion("none", None, self.impact)

    def by_lane(self):
        found = self.lane.verdict()
        return Opinion(found.responsibility, found.fault, found.tick + self.since)

    def by_priority(self):
        self.rude = [one for one in (self.ego, self.npc) if not one.has_priority and self.gives_no_way(one)]
        self.blind = [one for one in (self.ego, self.npc) if one not in self.rude and self.enters_taken(one)]
        failed = self.rude + self.blind
        if not failed:
            return None
        fault = "did-not-give-way" if self.ego in self.rude else None
        fault = "entered-taken-zone" if self.ego in self.blind else fault
        who = "both" if len(failed) == 2 else "ego" if self.ego in failed else "npc"
        return Opinion(who, fault, failed[0].enters)

    def other(self, one):
        return self.npc if one is self.ego else self.ego

    def gives_no_way(self, one):
        return self.chance_not_taken(one) is not None

    def chance_not_taken(self, one):
        """Return the first of its chances at which it foresaw the other and did not give way, or None."""
        chances, braking = [one.chance_to_stop()], one.braking_chance()
        if braking is not None and braking > chances[0]:
            chances.append(braking)
        return next((chance for chance in chances if self.foresaw_the_other(one, chance)), None)

    def foresaw_the_other(self, one, chance):
        other, at = self.other(one), one.enters / one.hz
        for tick in one.look(chance):
            reaches = other.foreseen(tick, one.leaves())[0] >= other.first
            place, v = other.foreseen(tick, at)
            is_near = self.merges_too_close(one, other, place, v) if self.is_merge else is_abrupt(other, place, v)
            if reaches and is_near:
                return True
        return False

    def merges_too_close(self, one, other, place, v):
        mine, theirs = one.left(one.enters), other.last - place
        apart = abs(mine - theirs) - one.length / 2 - other.length / 2
        if mine <= theirs:
            return apart < giving_way(v, one.lowest_for_a_second(one.enters))
        own = one.speed[one.enters]
        return apart < max(0.0, own * 1.0 + own * abs(own) / 12 - v * abs(v) / 16)

    def enters_taken(self, one):
        return (self.last_to_slow_down(one) if self.is_merge else self.last_to_stop_short(one)) is not None

    def last_to_stop_short(self, one):
        """Return the last tick at which it could see that the other is in the way, and still stop, or None."""
        other, touches = self.other(one), self.impact
        while touches > 0 and polygons_meet(one.boxes[touches - 1], other.boxes[self.impact]):
            touches -= 1
        chances = [
            one.last_to_stop_before(one.place[touches], touches, is_braking=is_braking) for is_braking in (False, True)
        ]
        if None not in chances and chances[1] <= chances[0]:
            chances.pop()
        for chance in chances:
            for tick in [] if chance is None else one.look(chance)[::-1]:
                when = max(one.enters, tick) / one.hz
                if tick >= other.enters and other.foreseen(tick, when)[0] < other.last:
                    return tick
        return None

    def last_to_slow_down(self, one):
        """Return the last tick at which it could have slowed down behind a vehicle that merges ahead, or None."""
        other = self.other(one)
        for at in reversed(range(other.enters, one.enters)):
            dv = max(0.0, one.speed[at] - min(other.speed[at : self.impact + 1]))
            lead = one.left(at) - other.left(at)
            if lead > 0 and lead - (one.length + other.length) / 2 >= dv * 1.0 + dv**2 / 12:
                return at
        return None


def is_abrupt(other, place, v):
    """Return whether the other is in the zone or must brake harder than 3 m/s^2 to stop before it."""
    return place < other.last and other.first - place < v * 1.0 + v**2 / 6


def part_of(trace, first, last):
    """Return the part of a run between two ticks."""
    rows = {name: getattr(trace, name)[first : last + 1] for name in ("states", "track", "on_way")}
    return replace(trace, **rows, collision=replace(trace.collision, tick=last - first))


def judge(trace):
    """Return the verdict on a collision."""
    npc = trace.collision.npc
    crosses = bool(trace.zones) and trace.zones[npc] is not None
    return (Crossing if crosses else Crash)(trace).verdict()
