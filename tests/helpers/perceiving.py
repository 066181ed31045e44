"""Planners, some of which fail only with poor perception, and one that always fails."""


class Careful:
    """Keep far enough from each vehicle ahead in its lane, or entering it, to stop behind it."""

    def __call__(self, observation):
        ego = observation.ego
        steering = -0.02 * (ego.y - ego.lane * observation.lane_width) - 0.2 * ego.heading
        if self.is_near(ego, self.heeded(observation)):
            return -8.0, steering
        return 0.3 if ego.speed < 20.0 else 0.0, steering

    def heeded(self, observation):
        """Return all other vehicles."""
        return observation.others

    def is_near(self, ego, others):
        """Return whether one of the others is too close ahead."""
        room = 2.0 + 0.4 * ego.speed + ego.speed**2 / 16
        ahead = [(other.x - ego.x - other.length, other.speed) for other in others if abs(other.y - ego.y) < 3.2]
        return any(-2.0 < gap < max(2.0, room - speed**2 / 16) for gap, speed in ahead)


class Debouncing(Careful):
    """Brake at the second decision in a row that sees a reason."""

    was_near = False

    def is_near(self, ego, others):
        """Return whether a vehicle is too close now and was at the last decision."""
        before, self.was_near = self.was_near, super().is_near(ego, others)
        return before and self.was_near


class GhostFiltering(Careful):
    """Ignore a vehicle that appears in the middle of the road, as if it were a ghost."""

    known = None

    def heeded(self, observation):
        """Return the vehicles that it has seen at every decision since the start."""
        self.known = set(observation.ids) if self.known is None else self.known.intersection(observation.ids)
        return [
            other for other, number in zip(observation.others, observation.ids, strict=True) if number in self.known
        ]


class Oblivious(Careful):
    """Ignore all vehicles."""

    def heeded(self, observation):
        """Return no vehicles."""
        return []
