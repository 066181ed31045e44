"""Planners of which some fail only where they see badly, and of which one fails anyway."""


class Careful:
    """Keeps so far from whoever is ahead in its lane, or comes there, that it can stop behind it."""

    def __call__(self, observation):
        ego = observation.ego
        steering = -0.02 * (ego.y - ego.lane * observation.lane_width) - 0.2 * ego.heading
        if self.is_near(ego, self.heeded(observation)):
            return -8.0, steering
        return 0.3 if ego.speed < 20.0 else 0.0, steering

    def heeded(self, observation):
        """Everybody."""
        return observation.others

    def is_near(self, ego, others):
        """Whether one of them is too near ahead."""
        room = 2.0 + 0.4 * ego.speed + ego.speed**2 / 16
        ahead = [(other.x - ego.x - other.length, other.speed) for other in others if abs(other.y - ego.y) < 3.2]
        return any(-2.0 < gap < max(2.0, room - speed**2 / 16) for gap, speed in ahead)


class Debouncing(Careful):
    """Brakes at the second decision in a row in which it sees a reason."""

    was_near = False

    def is_near(self, ego, others):
        """Whether one of them is, as one was a decision ago."""
        before, self.was_near = self.was_near, super().is_near(ego, others)
        return before and self.was_near


class GhostFiltering(Careful):
    """Takes a vehicle for a ghost that turns up in the midst of the road."""

    known = None

    def heeded(self, observation):
        """Those that it has seen ever since the start."""
        self.known = set(observation.ids) if self.known is None else self.known.intersection(observation.ids)
        return [
            other for other, number in zip(observation.others, observation.ids, strict=True) if number in self.known
        ]


class Oblivious(Careful):
    """Heeds nobody."""

    def heeded(self, observation):
        """Nobody."""
        return []
